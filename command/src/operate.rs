//! `sctn operate`: a person at a terminal decides for a graph that runs, on a real cell too.

use crate::launch::operator::{Prompt, confirmation, described};
use anyhow::{Context as _, Result};
use clap::Args;
use msgs::convert;
use msgs::sctn_msgs::{
    ConfirmationRefused, Goal, OperatorPresence, PickPlace, PlannedMotion, ProposeHome,
    ProposeHomeRequest, ProposeHomeResponse, StepConfirmation, StepResult,
};
use node_kit::{
    CallOptions, Node, Publisher, Qos, ServiceClient, Subscription, plain_node, wait_for_end,
};
use std::io::Write as _;
use std::sync::Arc;
use std::time::Duration;
use step_protocol::{
    Operator, OperatorDecision, PRESENCE_PERIOD, ProposalId, Question, RECOVERY_TIMEOUT,
    StepOutcome,
};
use tokio::signal::unix;
use tokio::sync::mpsc;
use tokio::time::interval;

/// Arguments of `sctn operate`.
#[derive(Args)]
pub struct Operate {
    /// Name of the person who decides, for the record [default: of the user]
    #[arg(long)]
    name: Option<String>,
    /// Do not ask whether a step has succeeded: the goal module says so
    #[arg(long)]
    approve_only: bool,
    /// The graph's time is that of /clock: a simulated cell
    #[arg(long)]
    use_sim_time: bool,
    /// Name of the executor
    #[arg(long, default_value = "suction_executor")]
    executor: String,
    /// ROS arguments: -r __ns:=/cell
    #[arg(last = true)]
    ros: Vec<String>,
}

/// The executor plans and checks a way home.
const HOME_TIMEOUT: CallOptions = CallOptions {
    attempts: 1,
    timeout: RECOVERY_TIMEOUT,
};
/// A last decision takes so long to be sent.
const LAST_WORD: Duration = Duration::from_millis(300);
const HELP: &str = "at any time: [s]top, [h]ome, [p]ut down what is held, [r]etry the step that was broken off, [q]uit";

impl Operate {
    pub fn run(self) -> Result<()> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()
            .context("tokio runtime")?;
        let ended = runtime.block_on(self.session());
        // The thread that reads the terminal may still wait for a line.
        runtime.shutdown_background();
        ended
    }

    async fn session(self) -> Result<()> {
        let mut arguments = vec![
            "-p".to_owned(),
            format!("use_sim_time:={}", self.use_sim_time),
        ];
        arguments.extend(self.ros.clone());
        let (context, node) = plain_node("sctn_operate", &arguments)?;
        let mut terminal = Terminal::new(&node, &self)?;
        println!("{HELP}");
        let mut lines = lines_of_terminal();
        let mut presence = interval(PRESENCE_PERIOD);
        let signal = wait_for_end();
        tokio::pin!(signal);
        // Whoever closes the window of the terminal hangs up.
        let mut hangup = unix::signal(unix::SignalKind::hangup()).context("SIGHUP")?;
        let ended = loop {
            tokio::select! {
                line = lines.recv() => match line {
                    Some(line) if line.trim().eq_ignore_ascii_case("q") => break "ended by the operator",
                    Some(line) => terminal.on_line(&line)?,
                    None => break "the terminal was closed",
                },
                _ = hangup.recv() => break "the terminal was closed",
                result = &mut signal => {
                    result?;
                    break "ended by a signal";
                }
                _ = presence.tick() => terminal.say_presence(true),
                () = terminal.listen() => {}
            }
        };
        // Nobody is left to stop it.
        if terminal.moving.is_some() {
            terminal.decide(terminal.subject(), OperatorDecision::Stop)?;
        }
        terminal.say_presence(false);
        tokio::time::sleep(LAST_WORD).await;
        // A closed terminal shows nothing.
        let _ = writeln!(std::io::stdout(), "{ended}");
        context.shutdown();
        Ok(())
    }
}

/// What is typed, line by line, until the terminal is closed.
fn lines_of_terminal() -> mpsc::UnboundedReceiver<String> {
    let (sender, receiver) = mpsc::unbounded_channel();
    std::thread::spawn(move || {
        for line in std::io::stdin().lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                return;
            }
        }
    });
    receiver
}

/// What is to be decided.
enum Due {
    /// About a proposal or a step.
    Question(Box<Question>),
    /// Whether the arm goes home.
    Home(ProposalId),
}

impl Due {
    fn prompt(&self) -> Prompt {
        match self {
            Self::Question(question) => Prompt::of(question),
            Self::Home(_) => Prompt::APPROVE,
        }
    }

    fn proposal_id(&self) -> ProposalId {
        match self {
            Self::Question(question) => question.proposal_id(),
            Self::Home(id) => *id,
        }
    }

    /// Whether an answer moves the arm.
    fn moves(&self) -> bool {
        match self {
            Self::Question(question) => matches!(**question, Question::Approve(_)),
            Self::Home(_) => true,
        }
    }
}

/// What arrives, and what is decided.
struct Terminal {
    node: Node,
    name: String,
    approve_only: bool,
    proposals: Subscription<PickPlace>,
    /// Proposals that came as goals of the executor's action.
    accepted: Subscription<PickPlace>,
    planned: Subscription<PlannedMotion>,
    results: Subscription<StepResult>,
    refused: Subscription<ConfirmationRefused>,
    goals: Subscription<Goal>,
    confirmations: Publisher<StepConfirmation>,
    presence: Publisher<OperatorPresence>,
    home: Arc<ServiceClient<ProposeHome>>,
    put_down: Arc<ServiceClient<ProposeHome>>,
    /// Answers to calls for the way home, and whether what is held is to be put down before.
    home_sender: mpsc::UnboundedSender<(bool, Result<ProposeHomeResponse, String>)>,
    homes: mpsc::UnboundedReceiver<(bool, Result<ProposeHomeResponse, String>)>,
    operator: Operator,
    step_count: u32,
    due: Option<Due>,
    /// The executor's newest plan: of which proposal, and why there is none.
    plan: Option<(ProposalId, String)>,
    /// The approved proposal whose result has not come yet.
    moving: Option<ProposalId>,
    /// The proposal whose motion a stop or a fault has broken off: its step can be tried again.
    broken_off: Option<ProposalId>,
}

impl Terminal {
    fn new(node: &Node, given: &Operate) -> Result<Self> {
        let user = || std::env::var("USER").ok().filter(|name| !name.is_empty());
        let (home_sender, homes) = mpsc::unbounded_channel();
        Ok(Self {
            node: node.clone(),
            name: given
                .name
                .clone()
                .or_else(user)
                .unwrap_or_else(|| "sctn operate".into()),
            approve_only: given.approve_only,
            proposals: node.subscription("pick_place", Qos::Latched)?,
            accepted: node.subscription("pick_place_goal", Qos::Event)?,
            planned: node.subscription("planned_motion", Qos::Latched)?,
            results: node.subscription("step_result", Qos::Event)?,
            refused: node.subscription("confirmation_refused", Qos::Event)?,
            goals: node.subscription("goal", Qos::Latched)?,
            confirmations: node.publisher("step_confirmation", Qos::Event)?,
            presence: node.publisher("operator_presence", Qos::Event)?,
            home: Arc::new(node.service_client(&format!("{}/propose_home", given.executor))?),
            put_down: Arc::new(
                node.service_client(&format!("{}/propose_put_down", given.executor))?,
            ),
            home_sender,
            homes,
            operator: Operator::new(false),
            step_count: 0,
            due: None,
            plan: None,
            moving: None,
            broken_off: None,
        })
    }

    /// Takes the next message.
    async fn listen(&mut self) {
        let question = tokio::select! {
            message = self.proposals.recv() => match convert::proposal_from_msg(&message) {
                Ok(proposal) => self.operator.on_proposal(proposal),
                Err(error) => {
                    self.proposals.reject(error);
                    None
                }
            },
            message = self.accepted.recv() => match convert::proposal_from_msg(&message) {
                Ok(proposal) => self.operator.on_proposal(proposal),
                Err(error) => {
                    self.accepted.reject(error);
                    None
                }
            },
            message = self.results.recv() => self.on_result(&message),
            goal = self.goals.recv() => {
                self.on_goal(goal);
                None
            }
            plan = self.planned.recv() => {
                self.on_plan(ProposalId(plan.proposal_id), plan.reason);
                None
            }
            refused = self.refused.recv() => {
                println!("refused: {}", refused.message);
                None
            }
            Some((puts_down, answer)) = self.homes.recv() => {
                self.on_home(puts_down, answer);
                None
            }
        };
        if let Some(question) = question {
            self.ask(question);
        }
    }

    fn ask(&mut self, question: Question) {
        match &question {
            Question::Approve(proposal) => println!("{}", described(proposal, self.step_count)),
            Question::Confirm { .. } if self.approve_only => return,
            Question::Confirm { .. } => {}
        }
        self.due = Some(Due::Question(Box::new(question)));
        self.prompt();
    }

    /// Says what is to be decided; a proposal once the executor has planned it.
    fn prompt(&self) {
        let Some(due) = &self.due else {
            return;
        };
        match &self.plan {
            Some((id, reason)) if due.moves() && *id == due.proposal_id() && !reason.is_empty() => {
                println!("    cannot be carried out: {reason}");
            }
            plan if due.moves() && plan.as_ref().map(|(id, _)| *id) != Some(due.proposal_id()) => {}
            _ => {
                print!("    {}: ", due.prompt().text);
                // A closed terminal is told where it is read.
                let _ = std::io::stdout().flush();
            }
        }
    }

    fn on_plan(&mut self, id: ProposalId, reason: String) {
        self.plan = Some((id, reason));
        if self
            .due
            .as_ref()
            .is_some_and(|due| due.moves() && due.proposal_id() == id)
        {
            self.prompt();
        }
    }

    fn on_goal(&mut self, message: Goal) {
        self.step_count = message.step_count;
        if message.complete {
            println!("the last goal is reached");
            self.due = None;
        }
        match convert::goal_from_msg(message) {
            Ok(goal) => self.operator.on_goal(&goal),
            Err(error) => self.goals.reject(error),
        }
    }

    fn on_result(&mut self, message: &StepResult) -> Option<Question> {
        let result = match convert::result_from_msg(message) {
            Ok(result) => result,
            Err(error) => {
                self.results.reject(error);
                return None;
            }
        };
        println!("    {} {}", result.outcome.name(), result.reason);
        self.moving.take_if(|moving| *moving == result.proposal_id);
        if matches!(
            result.outcome,
            StepOutcome::Fault | StepOutcome::Stopped | StepOutcome::NotHome
        ) {
            println!(
                "    the arm stands where it is: [h]ome proposes the way home, [p]ut down lowers what is held first, [r]etry tries the step again"
            );
        }
        if result.arm_moved() && !result.outcome.is_of_home() {
            let breaks_off = matches!(result.outcome, StepOutcome::Fault | StepOutcome::Stopped);
            self.broken_off = breaks_off.then_some(result.proposal_id);
        }
        self.operator.on_result(result)
    }

    fn on_home(&mut self, puts_down: bool, answer: Result<ProposeHomeResponse, String>) {
        match answer {
            Ok(answer) if answer.success && answer.needs_approval => {
                match puts_down {
                    true => {
                        println!("what is held is put down where it was picked, then the way home")
                    }
                    false => println!("the way home, slowly, straight up first"),
                }
                self.due = Some(Due::Home(ProposalId(answer.proposal_id)));
                self.prompt();
            }
            Ok(answer) if answer.success => println!("the arm goes home"),
            Ok(answer) => println!("no way home: {}", answer.message),
            Err(error) => println!("no way home: {error}"),
        }
    }

    /// Something was typed.
    fn on_line(&mut self, line: &str) -> Result<()> {
        let key = line.trim().to_lowercase();
        if key == "s" {
            let subject = self.subject();
            self.due = None;
            return self.decide(subject, OperatorDecision::Stop);
        }
        if key == "h" || key == "p" {
            let puts_down = key == "p";
            let client = Arc::clone(if puts_down {
                &self.put_down
            } else {
                &self.home
            });
            let sender = self.home_sender.clone();
            tokio::spawn(async move {
                let answer = client
                    .call(&ProposeHomeRequest::default(), &HOME_TIMEOUT)
                    .await;
                // The session may be over.
                let _ = sender.send((puts_down, answer.map_err(|error| error.to_string())));
            });
            return Ok(());
        }
        if key == "r" {
            return match self.broken_off.take() {
                Some(id) => {
                    println!("the step is tried again once its next proposal is approved");
                    self.decide(id, OperatorDecision::Retry)
                }
                None => {
                    println!("no step was broken off; {HELP}");
                    Ok(())
                }
            };
        }
        let Some(due) = &self.due else {
            println!("nothing is to be decided; {HELP}");
            return Ok(());
        };
        let Some(decision) = due.prompt().decision(&key) else {
            println!("{}; {HELP}", due.prompt().text);
            return Ok(());
        };
        let id = due.proposal_id();
        let planned = self
            .plan
            .as_ref()
            .is_some_and(|(planned, reason)| *planned == id && reason.is_empty());
        if decision == OperatorDecision::Approve && !planned {
            println!("not yet: the executor has not planned it");
            return Ok(());
        }
        self.due = None;
        if decision == OperatorDecision::Approve {
            self.moving = Some(id);
        }
        self.decide(id, decision)
    }

    /// The proposal that a stop names: the one that moves, the one that was asked about, or none.
    fn subject(&self) -> ProposalId {
        let asked = || self.due.as_ref().map(Due::proposal_id);
        self.moving.or_else(asked).unwrap_or(ProposalId(0))
    }

    fn decide(&self, id: ProposalId, decision: OperatorDecision) -> Result<()> {
        self.say_presence(true);
        let message = confirmation(&self.node, id, decision, &self.name)?;
        self.confirmations.publish(message);
        Ok(())
    }

    fn say_presence(&self, is_present: bool) {
        let mut message = OperatorPresence {
            operator_name: self.name.clone(),
            is_present,
            ..OperatorPresence::default()
        };
        message.header.stamp = self.node.now();
        self.presence.publish(message);
    }
}
