//! What may move: the approvals of an operator against what the executor knows.
//!
//! Pure: no clock, no middleware. Only the newest proposal can be approved, once; what came before
//! is remembered so that a refusal can say what became of it.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use heightmap::{Heightmap, Workspace};
use pick_place::{PickPlace, PrimitiveSettings};

use crate::status::DriverStatus;

/// Heightmaps kept, by stamp, until the proposals that were made from them arrive.
const HEIGHTMAPS: usize = 64;
/// Proposals whose fate is remembered.
const PROPOSALS: usize = 1024;
/// Messages that are no proposal, of which it is remembered why.
const INVALID: usize = 64;

/// What a proposal must keep to.
#[derive(Clone, Debug, PartialEq)]
pub struct Rules {
    /// Frame of proposals.
    pub frame: String,
    /// Where pick and place poses may lie.
    pub workspace: Workspace,
    /// Largest heights and speeds.
    pub most: PrimitiveSettings,
    /// A cell of the heightmap has changed when its height differs by more.
    pub observation_tolerance_m: f32,
    /// The observation has changed when more than this share of its cells has.
    pub observation_changed_fraction: f64,
    /// The driver's streams may not be older.
    pub status_max_age: Duration,
}

/// A proposal as it arrived, unchecked.
#[derive(Clone, Debug, PartialEq)]
pub struct Proposal {
    /// Identifies it.
    pub id: u64,
    /// Frame of its poses.
    pub frame: String,
    /// Stamp of the heightmap that it was made from.
    pub stamp: Duration,
    /// The poses.
    pub action: PickPlace,
    /// The heights and speeds.
    pub settings: PrimitiveSettings,
}

/// What an operator can say to the executor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Carry the proposal out.
    Approve,
    /// Do not.
    Reject,
    /// Stop what moves, and withdraw what is proposed.
    Stop,
}

/// How a confirmation is answered at once, without motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// The confirmation or its proposal is not valid.
    Refused,
    /// The operator rejected the proposal.
    Rejected,
    /// The operator withdrew the proposal by a stop.
    Stopped,
}

/// What has become of a proposal that arrived.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Proposed {
    /// It can be approved.
    Open,
    /// It came before; nothing has changed.
    Repeated,
    /// It cannot be approved, for this reason.
    Invalid(String),
}

/// What is to be done about a confirmation.
#[derive(Clone, Debug, PartialEq)]
pub enum Verdict {
    /// Move; [`Gate::finish`] has to follow.
    Move(Box<Proposal>),
    /// Stop the motion under way.
    Cancel,
    /// Report, with the reason.
    Answer(Answer, String),
    /// Something it needs may still be on its way: ask again a little later, then refuse for this
    /// reason.
    Wait(String),
    /// Nothing to do or to say.
    Nothing,
}

impl Verdict {
    fn refuse(reason: impl Into<String>) -> Self {
        Self::Answer(Answer::Refused, reason.into())
    }
}

/// What became of a proposal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    Open,
    Superseded,
    Moving,
    Done,
    Rejected,
    Withdrawn,
}

impl Fate {
    fn reason(self, id: u64) -> String {
        let what = match self {
            Self::Open => "is open",
            Self::Superseded => "was superseded by a newer one",
            Self::Moving => "is already being carried out",
            Self::Done => "was already carried out",
            Self::Rejected => "was already rejected",
            Self::Withdrawn => "was withdrawn by a stop",
        };
        format!("proposal {id} {what}")
    }
}

/// The newest proposal.
#[derive(Debug)]
struct Newest {
    id: u64,
    /// The proposal, or what is wrong with it.
    checked: Result<Proposal, String>,
    /// The heightmap that it was made from, once it has arrived.
    own: Option<Arc<Heightmap>>,
}

/// Decides what may move.
#[derive(Debug)]
pub struct Gate {
    rules: Rules,
    /// The first of each stamp, oldest first.
    heightmaps: VecDeque<(Duration, Arc<Heightmap>)>,
    /// The newest observation.
    present: Option<(Duration, Arc<Heightmap>)>,
    newest: Option<Newest>,
    /// Oldest first; the last is the newest proposal's.
    fates: VecDeque<(u64, Fate)>,
    /// What came as a proposal and is none, and why. Kept apart: no number of them takes anything from a proposal.
    invalid: VecDeque<(u64, String)>,
    moving: Option<u64>,
    /// The arm is on its way home at an operator's call.
    homing: bool,
    /// Observations from before the end of the last motion are no ground to move on.
    moved_until: Option<Duration>,
}

impl Gate {
    /// A gate that knows of nothing yet.
    pub fn new(rules: Rules) -> Self {
        Self {
            rules,
            heightmaps: VecDeque::new(),
            present: None,
            newest: None,
            fates: VecDeque::new(),
            invalid: VecDeque::new(),
            moving: None,
            homing: false,
            moved_until: None,
        }
    }

    /// From the next confirmation on.
    pub fn set_rules(&mut self, rules: Rules) {
        self.rules = rules;
    }

    /// The proposal that is being carried out.
    pub fn moving(&self) -> Option<u64> {
        self.moving
    }

    /// Takes the newest observation.
    pub fn observe(&mut self, stamp: Duration, heightmap: Heightmap) {
        let known = self.heightmaps.iter().find(|(known, _)| *known == stamp);
        let heightmap = match known {
            // The same frame may come again; another of the same stamp is a change.
            Some((_, known)) if **known == heightmap => Arc::clone(known),
            Some(_) => Arc::new(heightmap),
            None => {
                if self.heightmaps.len() == HEIGHTMAPS {
                    self.heightmaps.pop_front();
                }
                let heightmap = Arc::new(heightmap);
                self.heightmaps.push_back((stamp, Arc::clone(&heightmap)));
                heightmap
            }
        };
        self.present = Some((stamp, heightmap));
        self.find_own();
    }

    /// Holds on to the heightmap of the newest proposal, however many come after it.
    fn find_own(&mut self) {
        if let Some(Newest {
            checked: Ok(proposal),
            own: own @ None,
            ..
        }) = &mut self.newest
        {
            let known = self
                .heightmaps
                .iter()
                .find(|(stamp, _)| *stamp == proposal.stamp);
            *own = known.map(|(_, heightmap)| Arc::clone(heightmap));
        }
    }

    /// Takes a proposal, or what is wrong with the message of that id. A valid one supersedes the one before; what is no
    /// proposal supersedes nothing, so that nobody's garbage takes away what the operator was offered.
    pub fn propose(&mut self, id: u64, proposal: Result<Proposal, String>) -> Proposed {
        if self.fate(id).is_some() {
            if let Some(newest) = &mut self.newest
                && newest.id == id
                && newest.checked.is_ok()
                && !same(&newest.checked, &proposal)
            {
                let reason = format!("proposal {id} came twice with different contents");
                newest.checked = Err(reason.clone());
                return Proposed::Invalid(reason);
            }
            return Proposed::Repeated;
        }
        if self.why_invalid(id).is_some() {
            return Proposed::Repeated;
        }
        let checked = proposal.and_then(|proposal| {
            self.rules.check(&proposal)?;
            Ok(proposal)
        });
        if let Err(reason) = checked {
            if self.invalid.len() == INVALID {
                self.invalid.pop_front();
            }
            self.invalid.push_back((id, reason.clone()));
            return Proposed::Invalid(reason);
        }
        self.set_fate_of_open(Fate::Superseded);
        if self.fates.len() == PROPOSALS {
            self.fates.pop_front();
        }
        self.fates.push_back((id, Fate::Open));
        self.newest = Some(Newest {
            id,
            checked,
            own: None,
        });
        self.find_own();
        Proposed::Open
    }

    fn why_invalid(&self, id: u64) -> Option<&str> {
        let mut known = self.invalid.iter().rev();
        known
            .find(|(known, _)| *known == id)
            .map(|(_, reason)| reason.as_str())
    }

    /// What to say of an id that has no fate.
    fn unknown(&self, id: u64) -> Verdict {
        match self.why_invalid(id) {
            Some(reason) => Verdict::refuse(reason),
            None => Verdict::Wait(format!("proposal {id} is unknown")),
        }
    }

    /// Takes a confirmation at a monotonic time. `plan` says why the motion cannot be planned from
    /// where the robot is, if it cannot.
    pub fn confirm(
        &mut self,
        id: u64,
        decision: Decision,
        status: &DriverStatus,
        now: Duration,
        plan: impl FnOnce(&DriverStatus, &Proposal) -> Result<(), String>,
    ) -> Verdict {
        match decision {
            Decision::Approve => self.approve(id, status, now, plan),
            Decision::Reject => self.reject(id),
            Decision::Stop => self.stop(id),
        }
    }

    /// Says why a proposal cannot be approved any more; whether it can be now, only [`Self::confirm`] knows.
    pub fn open(&self, id: u64) -> Result<(), String> {
        match (self.fate(id), &self.newest) {
            (None, _) => Err(self
                .why_invalid(id)
                .map_or_else(|| format!("proposal {id} is unknown"), str::to_owned)),
            (Some(Fate::Open), Some(newest)) if newest.id == id => {
                newest.checked.as_ref().map(drop).map_err(String::clone)
            }
            (Some(fate), _) => Err(fate.reason(id)),
        }
    }

    /// Takes a proposal back that nobody has approved yet.
    pub fn withdraw(&mut self, id: u64) {
        if self.fate(id) == Some(Fate::Open) {
            self.set_fate(id, Fate::Withdrawn);
        }
    }

    /// Asks whether the arm may go home, as an operator has called for; [`Self::finish`] has to
    /// follow where it may.
    ///
    /// # Errors
    /// Says why not.
    pub fn go_home(&mut self, status: &DriverStatus, now: Duration) -> Result<(), String> {
        if let Some(id) = self.moving {
            return Err(format!("proposal {id} is being carried out"));
        }
        if let Some(obstacle) = status.obstacle(now, self.rules.status_max_age) {
            return Err(obstacle);
        }
        self.homing = true;
        Ok(())
    }

    /// The motion of [`Verdict::Move`] or [`Self::go_home`] has ended; `until` is the ROS time from
    /// which on observations show its result.
    pub fn finish(&mut self, until: Duration) {
        let moved = self.moving.take();
        if let Some(id) = moved {
            self.set_fate(id, Fate::Done);
        }
        if moved.is_some() || std::mem::take(&mut self.homing) {
            self.moved_until = Some(until);
        }
    }

    fn approve(
        &mut self,
        id: u64,
        status: &DriverStatus,
        now: Duration,
        plan: impl FnOnce(&DriverStatus, &Proposal) -> Result<(), String>,
    ) -> Verdict {
        match self.fate(id) {
            None => return self.unknown(id),
            Some(Fate::Open) => {}
            Some(fate) => return Verdict::refuse(fate.reason(id)),
        }
        if let Some(moving) = self.moving {
            return Verdict::refuse(format!(
                "proposal {id} was approved while proposal {moving} is being carried out"
            ));
        }
        if self.homing {
            return Verdict::refuse(format!(
                "proposal {id} was approved while the arm is on its way home"
            ));
        }
        // Only the newest proposal is open.
        let newest = match &self.newest {
            Some(newest) if newest.id == id => newest,
            _ => return Verdict::refuse(Fate::Superseded.reason(id)),
        };
        let proposal = match &newest.checked {
            Ok(proposal) => proposal,
            Err(reason) => return Verdict::refuse(reason.clone()),
        };
        if let Some(obstacle) = status.obstacle(now, self.rules.status_max_age) {
            return Verdict::refuse(format!("proposal {id}: {obstacle}"));
        }
        if let Some(until) = self.moved_until
            && proposal.stamp < until
        {
            return Verdict::refuse(format!(
                "proposal {id} was made from an observation at {}, before the last motion ended at {}",
                seconds(proposal.stamp),
                seconds(until)
            ));
        }
        if let Err(verdict) = self.unchanged(proposal, newest.own.as_deref()) {
            return verdict;
        }
        if let Err(reason) = plan(status, proposal) {
            return Verdict::refuse(format!("proposal {id}: {reason}"));
        }
        let proposal = Box::new(proposal.clone());
        self.set_fate(id, Fate::Moving);
        self.moving = Some(id);
        Verdict::Move(proposal)
    }

    fn reject(&mut self, id: u64) -> Verdict {
        match self.fate(id) {
            None => self.unknown(id),
            Some(Fate::Open) => {
                self.set_fate(id, Fate::Rejected);
                Verdict::Answer(Answer::Rejected, "rejected by the operator".into())
            }
            Some(fate) => Verdict::refuse(fate.reason(id)),
        }
    }

    /// A stop is honoured whatever proposal it names.
    fn stop(&mut self, id: u64) -> Verdict {
        let withdrawn = self.set_fate_of_open(Fate::Withdrawn);
        if self.moving.is_some() || self.homing {
            return Verdict::Cancel;
        }
        match self.fate(id) {
            None => Verdict::refuse(format!("proposal {id} is unknown; nothing was moving")),
            Some(Fate::Withdrawn) if withdrawn => Verdict::Answer(
                Answer::Stopped,
                "stopped by the operator; nothing was moving".into(),
            ),
            // After its result: a word to others.
            Some(_) => Verdict::Nothing,
        }
    }

    /// Whether the newest heightmap shows what the proposal's own does.
    fn unchanged(&self, proposal: &Proposal, own: Option<&Heightmap>) -> Result<(), Verdict> {
        let id = proposal.id;
        let (Some(own), Some((stamp, newest))) = (own, &self.present) else {
            return Err(Verdict::Wait(format!(
                "proposal {id}: the heightmap of {}, which it was made from, has not arrived",
                seconds(proposal.stamp)
            )));
        };
        if own.workspace != newest.workspace {
            return Err(Verdict::refuse(format!(
                "proposal {id}: the heightmap of {} covers another workspace than the one that it was made from",
                seconds(*stamp)
            )));
        }
        let changed = own.changed_fraction(newest, self.rules.observation_tolerance_m);
        if changed > self.rules.observation_changed_fraction {
            return Err(Verdict::refuse(format!(
                "proposal {id}: the observation has changed since: {:.2} % of the cells of the heightmap of {} by more than {} m, expected at most {:.2} %",
                100.0 * changed,
                seconds(*stamp),
                self.rules.observation_tolerance_m,
                100.0 * self.rules.observation_changed_fraction
            )));
        }
        Ok(())
    }

    fn fate(&self, id: u64) -> Option<Fate> {
        let mut known = self.fates.iter().rev();
        known.find(|(known, _)| *known == id).map(|(_, fate)| *fate)
    }

    fn set_fate(&mut self, id: u64, fate: Fate) {
        let mut known = self.fates.iter_mut().rev();
        if let Some((_, known)) = known.find(|(known, _)| *known == id) {
            *known = fate;
        }
    }

    /// Says whether a proposal was open.
    fn set_fate_of_open(&mut self, fate: Fate) -> bool {
        let mut open = self.fates.iter_mut().rev();
        match open.find(|(_, fate)| *fate == Fate::Open) {
            Some((_, open)) => {
                *open = fate;
                true
            }
            None => false,
        }
    }
}

impl Rules {
    /// Checks what can be checked of a proposal by itself.
    fn check(&self, proposal: &Proposal) -> Result<(), String> {
        let id = proposal.id;
        if proposal.frame != self.frame {
            return Err(format!(
                "proposal {id}: frame is `{}`, expected `{}`",
                proposal.frame, self.frame
            ));
        }
        let PickPlace { pick, place } = &proposal.action;
        for (which, pose) in [("pick", pick), ("place", place)] {
            let (x, y, yaw) = (
                pose.translation.x,
                pose.translation.y,
                pose.rotation.angle(),
            );
            if !(x.is_finite() && y.is_finite() && yaw.is_finite()) {
                return Err(format!(
                    "proposal {id}: {which} pose x {x} m, y {y} m, yaw {yaw} rad is not finite"
                ));
            }
            if self
                .workspace
                .pixel(&pose.translation.vector.into())
                .is_none()
            {
                let Workspace {
                    origin_m,
                    rows,
                    cols,
                    pixel_size_m,
                    ..
                } = self.workspace;
                return Err(format!(
                    "proposal {id}: {which} pose x {x:.4} m, y {y:.4} m lies outside the workspace, x {}..{} m, y {}..{} m",
                    origin_m.x,
                    origin_m.x + cols as f64 * pixel_size_m,
                    origin_m.y,
                    origin_m.y + rows as f64 * pixel_size_m,
                ));
            }
        }
        let (settings, most) = (&proposal.settings, &self.most);
        let ranges = [
            ("clearance_m", settings.clearance_m, most.clearance_m),
            ("lift_m", settings.lift_m, most.lift_m),
            ("travel_m_s", settings.travel_m_s, most.travel_m_s),
            ("carry_m_s", settings.carry_m_s, most.carry_m_s),
            ("descend_m_s", settings.descend_m_s, most.descend_m_s),
            (
                "acceleration_m_s2",
                settings.acceleration_m_s2,
                most.acceleration_m_s2,
            ),
        ];
        for (name, value, most) in ranges {
            // Not a number fails both comparisons.
            if !(value > 0.0 && value <= most) {
                return Err(format!(
                    "proposal {id}: settings.{name} is {value}, expected above 0 and at most {most}"
                ));
            }
        }
        Ok(())
    }
}

/// Whether a message says what is known. Broken ones are not compared: they hold NaN.
fn same(known: &Result<Proposal, String>, repeated: &Result<Proposal, String>) -> bool {
    matches!((known, repeated), (Ok(known), Ok(repeated)) if known == repeated)
}

fn seconds(stamp: Duration) -> String {
    format!("{:.3} s", stamp.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::status::tests::ready;
    use nalgebra::Isometry2;

    const NOW: Duration = Duration::from_secs(100);

    fn rules() -> Rules {
        Rules {
            frame: "world".into(),
            workspace: Workspace::RAVENS,
            most: PrimitiveSettings {
                clearance_m: 0.5,
                lift_m: 0.5,
                travel_m_s: 1.0,
                carry_m_s: 1.0,
                descend_m_s: 0.2,
                acceleration_m_s2: 5.0,
            },
            observation_tolerance_m: 0.005,
            observation_changed_fraction: 0.001,
            status_max_age: Duration::from_secs(1),
        }
    }

    fn proposal(id: u64) -> Proposal {
        Proposal {
            id,
            frame: "world".into(),
            stamp: Duration::from_secs(5),
            action: PickPlace {
                pick: Isometry2::new(nalgebra::Vector2::new(0.4, 0.2), 0.0),
                place: Isometry2::new(nalgebra::Vector2::new(0.5, -0.2), 1.0),
            },
            settings: PrimitiveSettings {
                clearance_m: 0.1,
                lift_m: 0.05,
                travel_m_s: 0.8,
                carry_m_s: 0.5,
                descend_m_s: 0.1,
                acceleration_m_s2: 2.5,
            },
        }
    }

    /// A gate that has seen a heightmap and proposal 7, made from it.
    fn gate() -> Gate {
        let mut gate = Gate::new(rules());
        gate.observe(Duration::from_secs(5), Heightmap::new(Workspace::RAVENS));
        assert_eq!(gate.propose(7, Ok(proposal(7))), Proposed::Open);
        gate
    }

    fn decide(gate: &mut Gate, id: u64, decision: Decision) -> Verdict {
        gate.confirm(id, decision, &ready(NOW), NOW, |_, _| Ok(()))
    }

    fn approve(gate: &mut Gate, id: u64) -> Verdict {
        decide(gate, id, Decision::Approve)
    }

    #[track_caller]
    fn invalid(gate: &mut Gate, proposal: Proposal) -> String {
        match gate.propose(proposal.id, Ok(proposal)) {
            Proposed::Invalid(reason) => reason,
            other => panic!("expected an invalid proposal, found {other:?}"),
        }
    }

    #[track_caller]
    fn assert_refused(gate: &Gate, verdict: Verdict, expected: &[&str]) {
        let Verdict::Answer(Answer::Refused, reason) = &verdict else {
            panic!("expected a refusal, found {verdict:?}");
        };
        for part in expected {
            assert!(reason.contains(part), "{reason:?} lacks {part:?}");
        }
        assert_eq!(gate.moving(), None);
    }

    #[test]
    fn an_approved_proposal_moves_once() {
        let mut gate = gate();
        assert_eq!(approve(&mut gate, 7), Verdict::Move(Box::new(proposal(7))));
        assert_eq!(gate.moving(), Some(7));
        gate.finish(Duration::from_secs(9));
        assert_eq!(gate.moving(), None);
    }

    #[test]
    fn nothing_moves_without_a_confirmation() {
        let mut gate = gate();
        gate.observe(Duration::from_secs(6), Heightmap::new(Workspace::RAVENS));
        assert_eq!(gate.propose(8, Ok(proposal(8))), Proposed::Open);
        assert_eq!(gate.moving(), None);
    }

    #[test]
    fn a_rejected_proposal_does_not_move_and_cannot_be_approved_any_more() {
        let mut gate = gate();
        let verdict = decide(&mut gate, 7, Decision::Reject);
        assert!(
            matches!(verdict, Verdict::Answer(Answer::Rejected, _)),
            "{verdict:?}"
        );
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["7", "already rejected"]);
        let verdict = decide(&mut gate, 7, Decision::Reject);
        assert_refused(&gate, verdict, &["7", "already rejected"]);
    }

    #[test]
    fn a_stale_approval_moves_nothing() {
        let mut gate = gate();
        assert_eq!(gate.propose(8, Ok(proposal(8))), Proposed::Open);
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["7", "superseded"]);
        // The newer one is not touched by that.
        assert!(matches!(approve(&mut gate, 8), Verdict::Move(_)));
    }

    #[test]
    fn a_duplicate_approval_moves_nothing() {
        let mut gate = gate();
        assert!(matches!(approve(&mut gate, 7), Verdict::Move(_)));
        let verdict = approve(&mut gate, 7);
        assert!(
            matches!(&verdict, Verdict::Answer(Answer::Refused, r) if r.contains("already being carried out")),
            "{verdict:?}"
        );
        gate.finish(Duration::from_secs(9));
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["7", "already carried out"]);
    }

    #[test]
    fn a_proposal_that_is_sent_again_cannot_be_approved_again() {
        let mut gate = gate();
        assert!(matches!(approve(&mut gate, 7), Verdict::Move(_)));
        gate.finish(Duration::from_secs(4));
        assert_eq!(gate.propose(7, Ok(proposal(7))), Proposed::Repeated);
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["already carried out"]);
        // Nor one from further back.
        assert_eq!(gate.propose(8, Ok(proposal(8))), Proposed::Open);
        assert_eq!(gate.propose(7, Ok(proposal(7))), Proposed::Repeated);
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["already carried out"]);
    }

    #[test]
    fn an_unknown_approval_waits_for_its_proposal_and_moves_nothing() {
        let mut gate = gate();
        let verdict = approve(&mut gate, 99);
        assert!(
            matches!(&verdict, Verdict::Wait(r) if r.contains("99") && r.contains("unknown")),
            "{verdict:?}"
        );
        assert_eq!(gate.moving(), None);
        assert!(matches!(
            decide(&mut gate, 99, Decision::Reject),
            Verdict::Wait(_)
        ));
    }

    #[test]
    fn an_approval_while_moving_is_refused() {
        let mut gate = gate();
        assert!(matches!(approve(&mut gate, 7), Verdict::Move(_)));
        assert_eq!(gate.propose(8, Ok(proposal(8))), Proposed::Open);
        let verdict = approve(&mut gate, 8);
        assert!(
            matches!(&verdict, Verdict::Answer(Answer::Refused, r) if r.contains('8') && r.contains("proposal 7")),
            "{verdict:?}"
        );
        assert_eq!(gate.moving(), Some(7));
    }

    #[test]
    fn a_pose_with_nan_or_outside_the_workspace_moves_nothing() {
        for (bad, expected) in [
            (f64::NAN, "not finite"),
            (f64::INFINITY, "not finite"),
            (0.9, "outside the workspace"),
        ] {
            for which in ["pick", "place"] {
                let mut gate = gate();
                let mut bad_one = proposal(8);
                let pose = match which {
                    "pick" => &mut bad_one.action.pick,
                    _ => &mut bad_one.action.place,
                };
                pose.translation.x = bad;
                let error = invalid(&mut gate, bad_one);
                assert!(error.contains(which) && error.contains(expected), "{error}");
                let verdict = approve(&mut gate, 8);
                assert_refused(&gate, verdict, &["8", which, expected]);
                // It has taken nothing from the one before.
                let verdict = approve(&mut gate, 7);
                assert_eq!(verdict, Verdict::Move(Box::new(proposal(7))));
            }
        }
        let mut gate = gate();
        let mut turned = proposal(8);
        turned.action.place = Isometry2::new(nalgebra::Vector2::new(0.5, 0.0), f64::NAN);
        assert!(invalid(&mut gate, turned).contains("not finite"));
    }

    #[test]
    fn a_message_that_is_no_proposal_moves_nothing() {
        let mut gate = gate();
        let broken = || Err("proposal 8: x is not finite".to_owned());
        assert!(matches!(gate.propose(8, broken()), Proposed::Invalid(_)));
        assert_eq!(gate.propose(8, broken()), Proposed::Repeated);
        let verdict = approve(&mut gate, 8);
        assert_refused(&gate, verdict, &["x is not finite"]);
    }

    #[test]
    fn no_number_of_messages_that_are_no_proposals_takes_away_the_one_that_is() {
        let mut gate = gate();
        for id in 100..5000 {
            let mut garbage = proposal(id);
            garbage.action.pick.translation.x = 7.0;
            invalid(&mut gate, garbage);
        }
        let verdict = decide(&mut gate, 4999, Decision::Reject);
        assert_refused(&gate, verdict, &["4999", "outside the workspace"]);
        assert!(matches!(approve(&mut gate, 7), Verdict::Move(_)));
    }

    #[test]
    fn settings_out_of_range_move_nothing() {
        for bad in [f64::NAN, 0.0, -1.0, 100.0] {
            let mut gate = gate();
            let mut fast = proposal(8);
            fast.settings.carry_m_s = bad;
            invalid(&mut gate, fast);
            let verdict = approve(&mut gate, 8);
            assert_refused(&gate, verdict, &["8", "carry_m_s"]);
        }
    }

    #[test]
    fn a_proposal_in_another_frame_moves_nothing() {
        let mut gate = gate();
        let mut elsewhere = proposal(8);
        elsewhere.frame = "front_camera".into();
        invalid(&mut gate, elsewhere);
        let verdict = approve(&mut gate, 8);
        assert_refused(&gate, verdict, &["front_camera", "world"]);
    }

    #[test]
    fn an_id_that_stands_for_two_contents_moves_nothing() {
        let mut gate = gate();
        let mut other = proposal(7);
        other.action.place.translation.y = 0.1;
        assert!(invalid(&mut gate, other).contains("different contents"));
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["7", "different contents"]);
    }

    #[test]
    fn an_approval_after_the_observation_changed_moves_nothing() {
        let mut gate = gate();
        let mut changed = Heightmap::new(Workspace::RAVENS);
        changed.height_m[..100].fill(0.02);
        gate.observe(Duration::from_secs(6), changed.clone());
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["7", "observation has changed", "6.000 s"]);
        // A small change is noise.
        changed.height_m[20..].fill(0.0);
        gate.observe(Duration::from_secs(7), changed);
        assert!(matches!(approve(&mut gate, 7), Verdict::Move(_)));
    }

    #[test]
    fn another_heightmap_of_the_same_stamp_is_a_change() {
        let mut gate = gate();
        gate.observe(Duration::from_secs(5), Heightmap::new(Workspace::RAVENS));
        let mut changed = Heightmap::new(Workspace::RAVENS);
        changed.height_m[..100].fill(0.02);
        gate.observe(Duration::from_secs(5), changed);
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["7", "observation has changed"]);
        gate.observe(Duration::from_secs(5), Heightmap::new(Workspace::RAVENS));
        assert!(matches!(approve(&mut gate, 7), Verdict::Move(_)));
    }

    #[test]
    fn a_slow_operator_may_approve_after_many_observations() {
        let mut gate = gate();
        for second in 6..6 + 2 * HEIGHTMAPS as u64 {
            let stamp = Duration::from_secs(second);
            gate.observe(stamp, Heightmap::new(Workspace::RAVENS));
        }
        assert!(matches!(approve(&mut gate, 7), Verdict::Move(_)));
    }

    #[test]
    fn an_approval_waits_for_the_heightmap_that_the_proposal_was_made_from() {
        let mut gate = gate();
        let mut early = proposal(8);
        early.stamp = Duration::from_secs(6);
        assert_eq!(gate.propose(8, Ok(early)), Proposed::Open);
        let verdict = approve(&mut gate, 8);
        assert!(
            matches!(&verdict, Verdict::Wait(r) if r.contains("6.000 s")),
            "{verdict:?}"
        );
        gate.observe(Duration::from_secs(6), Heightmap::new(Workspace::RAVENS));
        assert!(matches!(approve(&mut gate, 8), Verdict::Move(_)));
    }

    #[test]
    fn an_observation_from_before_the_last_motion_is_no_ground_to_move() {
        let mut gate = gate();
        assert!(matches!(approve(&mut gate, 7), Verdict::Move(_)));
        gate.finish(Duration::from_secs(9));
        assert_eq!(gate.propose(8, Ok(proposal(8))), Proposed::Open);
        let verdict = approve(&mut gate, 8);
        assert_refused(&gate, verdict, &["8", "5.000 s", "9.000 s"]);
    }

    #[test]
    fn a_stale_status_or_a_protective_stop_moves_nothing_and_the_proposal_stays_open() {
        let mut gate = gate();
        let late = NOW + Duration::from_secs(3);
        let verdict = gate.confirm(7, Decision::Approve, &ready(NOW), late, |_, _| Ok(()));
        assert_refused(&gate, verdict, &["7", "joint_states", "3.0 s"]);
        let stopped = DriverStatus {
            safety_mode: Some(3),
            ..ready(NOW)
        };
        let verdict = gate.confirm(7, Decision::Approve, &stopped, NOW, |_, _| Ok(()));
        assert_refused(&gate, verdict, &["7", "PROTECTIVE_STOP"]);
        let verdict = gate.confirm(
            7,
            Decision::Approve,
            &DriverStatus::default(),
            NOW,
            |_, _| Ok(()),
        );
        assert_refused(&gate, verdict, &["7", "robot mode"]);
        assert!(matches!(approve(&mut gate, 7), Verdict::Move(_)));
    }

    #[test]
    fn a_motion_that_cannot_be_planned_is_refused() {
        let mut gate = gate();
        let verdict = gate.confirm(7, Decision::Approve, &ready(NOW), NOW, |_, proposal| {
            Err(format!(
                "{} is out of reach",
                proposal.action.pick.translation.x
            ))
        });
        assert_refused(&gate, verdict, &["7", "0.4 is out of reach"]);
    }

    #[test]
    fn a_stop_cancels_the_motion_whatever_proposal_it_names() {
        for id in [7, 99] {
            let mut gate = gate();
            assert!(matches!(approve(&mut gate, 7), Verdict::Move(_)));
            assert_eq!(decide(&mut gate, id, Decision::Stop), Verdict::Cancel);
            assert_eq!(gate.moving(), Some(7));
        }
    }

    #[test]
    fn a_stop_while_nothing_moves_withdraws_the_proposal() {
        let mut gate = gate();
        let verdict = decide(&mut gate, 7, Decision::Stop);
        assert!(
            matches!(verdict, Verdict::Answer(Answer::Stopped, _)),
            "{verdict:?}"
        );
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["7", "withdrawn"]);
        // Said again, or after a result, it is not news.
        assert_eq!(decide(&mut gate, 7, Decision::Stop), Verdict::Nothing);
        let verdict = decide(&mut gate, 99, Decision::Stop);
        assert_refused(&gate, verdict, &["99", "unknown"]);
    }

    #[test]
    fn a_withdrawn_proposal_cannot_be_approved_and_says_so() {
        let mut gate = gate();
        assert_eq!(gate.open(7), Ok(()));
        assert!(gate.open(99).unwrap_err().contains("unknown"));
        gate.withdraw(7);
        assert!(gate.open(7).unwrap_err().contains("withdrawn"));
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["7", "withdrawn"]);
        let mut bad = proposal(8);
        bad.frame = "camera".into();
        gate.propose(8, Ok(bad));
        assert!(gate.open(8).unwrap_err().contains("camera"));
        // One that moves is not taken back.
        gate.propose(9, Ok(proposal(9)));
        assert!(matches!(approve(&mut gate, 9), Verdict::Move(_)));
        gate.withdraw(9);
        assert!(gate.open(9).unwrap_err().contains("being carried out"));
    }

    #[test]
    fn the_arm_goes_home_at_a_call_when_nothing_else_moves() {
        let mut gate = gate();
        let stopped = DriverStatus {
            safety_mode: Some(3),
            ..ready(NOW)
        };
        let reason = gate.go_home(&stopped, NOW).unwrap_err();
        assert!(reason.contains("PROTECTIVE_STOP"), "{reason}");
        gate.go_home(&ready(NOW), NOW).unwrap();
        let verdict = approve(&mut gate, 7);
        assert_refused(&gate, verdict, &["7", "on its way home"]);
        assert_eq!(decide(&mut gate, 99, Decision::Stop), Verdict::Cancel);
        gate.finish(Duration::from_secs(9));
        // The stop has withdrawn what was proposed, and the old observation is none any more.
        gate.propose(8, Ok(proposal(8)));
        let verdict = approve(&mut gate, 8);
        assert_refused(&gate, verdict, &["8", "9.000 s"]);
        gate.observe(Duration::from_secs(9), Heightmap::new(Workspace::RAVENS));
        let mut fresh = proposal(9);
        fresh.stamp = Duration::from_secs(9);
        gate.propose(9, Ok(fresh));
        assert!(matches!(approve(&mut gate, 9), Verdict::Move(_)));
        let reason = gate.go_home(&ready(NOW), NOW).unwrap_err();
        assert!(reason.contains("proposal 9"), "{reason}");
    }

    #[test]
    fn memory_is_bounded() {
        let mut gate = gate();
        for id in 0..10_000 {
            gate.propose(id, Ok(proposal(id)));
            gate.observe(Duration::from_millis(id), Heightmap::new(Workspace::RAVENS));
        }
        assert_eq!(gate.fates.len(), PROPOSALS);
        assert_eq!(gate.heightmaps.len(), HEIGHTMAPS);
    }
}
