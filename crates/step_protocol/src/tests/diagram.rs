//! The pictures of the state machines in `docs/guide/step.md`, made by driving the machines.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use crate::{ApprovalGate, OperatorDecision, ProposalId, ProposalStatus, StepOutcome};

use super::{gate, tracker};

const GUIDE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/guide/step.md");
const BEGIN: &str = "<!-- made by `UPDATE_GUIDE=1 cargo test -p step_protocol the_guide` -->\n";
const END: &str = "<!-- end -->\n";

/// What can happen to proposal 7 at the gate.
#[derive(Clone, Copy)]
enum Event {
    Decision(OperatorDecision),
    NewerProposal,
    ActionCanceled,
    MotionEnds,
    MotionBreaksOff,
}

impl Event {
    fn all() -> Vec<Self> {
        let mut events: Vec<_> = OperatorDecision::ALL
            .iter()
            .copied()
            .map(Self::Decision)
            .collect();
        events.extend([
            Self::NewerProposal,
            Self::ActionCanceled,
            Self::MotionEnds,
            Self::MotionBreaksOff,
        ]);
        events
    }

    fn name(self) -> String {
        match self {
            Self::Decision(decision) => decision.name().to_uppercase(),
            Self::NewerProposal => "a newer proposal".into(),
            Self::ActionCanceled => "its action goal is cancelled".into(),
            Self::MotionEnds => "the motion ends".into(),
            Self::MotionBreaksOff => "a stop or a fault ends the motion".into(),
        }
    }

    fn happen(self, gate: &mut ApprovalGate) {
        let id = ProposalId(7);
        match self {
            Self::Decision(decision) => {
                gate.on_confirmation(id, decision, &gate::READY, gate::NOW);
            }
            Self::NewerProposal => {
                gate::propose(gate, gate::proposal(8));
            }
            Self::ActionCanceled => gate.withdraw(id),
            Self::MotionEnds | Self::MotionBreaksOff if gate.moving().is_none() => {}
            Self::MotionEnds => {
                gate.finish(gate::NOW, false);
            }
            Self::MotionBreaksOff => {
                gate.finish(gate::NOW, true);
            }
        }
    }
}

/// Every status that a proposal can reach, and what leads from one to the next.
fn gate_diagram() -> String {
    let mut paths: Vec<(ProposalStatus, Vec<Event>)> = vec![(ProposalStatus::Pending, Vec::new())];
    let mut edges: BTreeMap<(ProposalStatus, ProposalStatus), Vec<String>> = BTreeMap::new();
    let mut next = 0;
    while let Some((from, path)) = paths.get(next).cloned() {
        next += 1;
        for event in Event::all() {
            let mut gate = gate::gate();
            path.iter().for_each(|event| event.happen(&mut gate));
            event.happen(&mut gate);
            let to = gate.status(ProposalId(7)).expect("a proposal's status");
            if to != from {
                edges.entry((from, to)).or_default().push(event.name());
            }
            if paths.iter().all(|(known, _)| *known != to) {
                let path = path.iter().copied().chain([event]).collect();
                paths.push((to, path));
            }
        }
    }
    let mut diagram = "```mermaid\nstateDiagram-v2\n".to_owned();
    let _ = writeln!(diagram, "    [*] --> Pending: a valid proposal");
    for ((from, to), events) in edges {
        let _ = writeln!(diagram, "    {from:?} --> {to:?}: {}", events.join(", "));
    }
    diagram + "```\n"
}

/// What the goal is after a motion with each outcome and each decision on it.
fn tracker_table() -> String {
    let decisions = [
        OperatorDecision::Advance,
        OperatorDecision::Retry,
        OperatorDecision::StepBack,
        OperatorDecision::Stop,
    ];
    let mut table = "| `step_result` |".to_owned();
    for decision in decisions {
        let _ = write!(
            table,
            " `{}` |",
            decision.name().to_uppercase().replace(' ', "_")
        );
    }
    table += "\n|---|---|---|---|---|\n";
    let steps = StepOutcome::ALL.iter().filter(|one| !one.is_of_home());
    for &outcome in steps {
        let _ = write!(table, "| `{outcome:?}` |");
        for decision in decisions {
            let _ = write!(table, " {} |", goal_after(outcome, decision));
        }
        table.push('\n');
    }
    table
}

fn goal_after(outcome: StepOutcome, decision: OperatorDecision) -> &'static str {
    let mut tracker = tracker::tracker(3);
    // The second goal is the present one.
    tracker.set_step(2).expect("three steps");
    tracker.on_proposal(&tracker::proposal(7, 2, 0));
    let mut result = tracker::result(7, outcome, 5);
    if outcome == StepOutcome::Refused {
        result.status = Some(ProposalStatus::Pending);
    }
    tracker.on_result(&result);
    let (_, _, before) = tracker.progress();
    let said = tracker.on_confirmation(&tracker::says(decision, 7));
    match (tracker.is_stopped(), said, tracker.progress()) {
        (true, ..) => "the run ends",
        (_, Err(_), (2, _, 0)) => "refused",
        (_, Err(_), _) => "refused; the next attempt has begun",
        (_, Ok(_), (3, ..)) => "the next goal",
        (_, Ok(_), (1, ..)) => "the goal before",
        (_, Ok(_), (2, _, attempt)) if attempt > before => "the same goal, next attempt",
        (_, Ok(_), _) => "waits for a motion",
    }
}

#[test]
fn the_guide_shows_the_machines_as_they_are() {
    let made = format!(
        "{BEGIN}\n{}\nThe next goal follows from the outcome and the operator's decision:\n\n{}\n{END}",
        gate_diagram(),
        tracker_table()
    );
    let guide = std::fs::read_to_string(GUIDE).expect("the guide");
    let begin = guide.find(BEGIN).expect("the place of the pictures");
    let end = guide.find(END).expect("the end of the pictures") + END.len();
    if std::env::var_os("UPDATE_GUIDE").is_some() {
        let updated = guide[..begin].to_owned() + &made + &guide[end..];
        std::fs::write(Path::new(GUIDE), updated).expect("the guide");
        return;
    }
    assert_eq!(guide[begin..end], made, "run the command of the comment");
}

#[test]
fn only_an_approval_leads_to_a_motion() {
    let diagram = gate_diagram();
    let to_moving: Vec<_> = diagram
        .lines()
        .filter(|line| line.contains("--> Moving"))
        .map(str::trim)
        .collect();
    assert_eq!(to_moving, ["Pending --> Moving: APPROVE"]);
}
