//! `sctn launch`: the whole graph on a problem's seed, under an operator, recorded.

pub mod graph;
pub mod operator;
mod recording;

use crate::demos::demonstration;
use crate::root::Root;
use anyhow::{Context as _, Result, bail};
use bags::Demonstration;
use clap::Args;
use gctn::Device;
use graph::{Graph, Settings};
use heightmap::Heightmap;
use msgs::convert::{self, heightmap_from_msg};
use msgs::sctn_msgs::{ConfirmationRefused, Goal, PickPlace, Reward, StepConfirmation, StepResult};
use multiravens::{Environment, EpisodeSeed, Problem};
use node_kit::{Node, Qos, ns_from_stamp, plain_node, wait_for_end, when};
use operator::{OperatorKind, Prompt, RequireApproval, confirmation, described};
use recording::{LAST_HEIGHTMAP, LAST_WORDS, LAST_WORDS_ELSEWHERE, RunRecorder};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use step_protocol::{Operator, OperatorDecision, ProposalId, Question, StepOutcome, Unasked};

/// With nothing heard for so long, something is broken. Wall time: it decides no outcome, only when to give up.
const PATIENCE: Duration = Duration::from_secs(60);
/// With no step going on for so long, a message may have been lost: the automatic operator repeats what it said.
const SILENCE: Duration = Duration::from_secs(25);
/// Refusals of an approval in a row after which the operator gives up.
const MAX_REFUSALS: u32 = 5;

/// The goal module that an operator answers to.
const ORACLE: &str = "oracle";
/// The goal module that asks the policy whether a step is done.
const SEQUENCE: &str = "sequence";
/// A run whose last goal is reached may still owe the result and reward of its last step.
const LAST_RESULT: Duration = Duration::from_secs(5);
/// Pages learn of the end of the run before their console ends.
const LAST_LOOK: Duration = Duration::from_secs(2);

/// Arguments of `sctn launch`.
#[derive(Args)]
pub struct Launch {
    /// Problem to solve
    #[arg(long)]
    problem: String,
    /// Seed of the episode (test: from 10,000 up)
    #[arg(long)]
    seed: u64,
    /// Start of the scene that the demonstration is shown from: the same fixtures and goal, the loose objects elsewhere
    /// [default: the very start that is to be solved]
    #[arg(long)]
    demonstration_seed: Option<u64>,
    /// Who approves proposals and confirms steps
    #[arg(long, value_enum, default_value = "auto")]
    operator: OperatorKind,
    /// What says which goal is next: the operator, or what is seen after a motion
    #[arg(long, value_parser = ["oracle", "image_distance", "embedding", SEQUENCE], default_value = ORACLE)]
    goal_module: String,
    /// Which proposals the operator approves before they are carried out [default: always; never with --operator watch]
    #[arg(long, value_enum)]
    require_approval: Option<RequireApproval>,
    /// With --require-approval unsure, a proposal of at least this probability of success is carried out unasked
    #[arg(long, default_value_t = 0.99)]
    sure_probability: f32,
    /// Checkpoint of the policy [default: the shipped one; with --demonstration-seed or --goal-module sequence, or where the
    /// problem has no goals, the shipped one for any start]
    #[arg(long)]
    checkpoint: Option<PathBuf>,
    /// Where the policy computes: cpu, cuda or cuda:N
    #[arg(long, default_value_t)]
    device: Device,
    /// Checkpoint for the goal module of that name [default: the shipped one]
    #[arg(long)]
    embedding: Option<PathBuf>,
    /// Stop every motion when the page of the person who decides is closed, hidden or has lost its link for a second
    #[arg(long)]
    require_presence: bool,
    /// Folder of the tasks that --operator web can have repeated; what is taught is saved there
    #[arg(long, default_value = "out/library")]
    library: PathBuf,
    /// Folder for the bag, the demonstration, logs and a picture of the last heightmap
    #[arg(long)]
    record: Option<PathBuf>,
    /// Record also what the cameras send
    #[arg(long, requires = "record")]
    record_images: bool,
    /// Run each node as a process of its own
    #[arg(long)]
    processes: bool,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

/// How a run ended.
#[derive(Debug, Serialize)]
struct Report {
    problem: String,
    seed: u64,
    completed: bool,
    reward: f64,
    steps: usize,
    bag: Option<PathBuf>,
}

impl Launch {
    pub fn run(self, root: &Root) -> Result<()> {
        self.device.check()?;
        let problem = root.problem(&self.problem)?;
        let work_cell = root.work_cell()?;
        let (max_steps, has_goals) = {
            let mut environment = Environment::new(&problem, &work_cell);
            environment.reset(self.seed)?;
            (environment.max_steps(), environment.goal_count() > 0)
        };
        let temporary = tempfile::tempdir().context("folder for the demonstration")?;
        let folder = self
            .record
            .clone()
            .unwrap_or_else(|| temporary.path().to_owned());
        let bag = folder.join("run");
        if bag.exists() {
            bail!(
                "{}: already holds a run; name another folder",
                folder.display()
            );
        }
        std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
        let shown = self.demonstration(&problem, &work_cell, &folder, has_goals)?;
        let (problems_dir, name) = root.problem_place(&self.problem);
        let settings = Settings {
            problem: name,
            problems_dir: std::path::absolute(problems_dir)?,
            seed: self.seed,
            checkpoint: self.checkpoint.clone().unwrap_or_else(|| {
                if shown.is_none()
                    || self.demonstration_seed.is_some()
                    || self.goal_module == SEQUENCE
                {
                    root.any_start_checkpoint()
                } else {
                    root.shipped_checkpoint()
                }
            }),
            demonstration: shown,
            device: self.device,
            goal_module: self.goal_module.clone(),
            embedding: self
                .embedding
                .clone()
                .unwrap_or_else(|| root.shipped_embedding()),
            operated: self.operator != OperatorKind::Watch,
            require_approval: self.require_approval(),
            sure_probability: self.sure_probability,
            require_presence: self.require_presence,
            console: match self.operator {
                OperatorKind::Web => Some(graph::Console {
                    address_file: std::path::absolute(temporary.path().join("console"))?,
                    library: std::path::absolute(&self.library)?,
                    program: std::env::current_exe().context("path of the program")?,
                    training: std::path::absolute(self.library.with_file_name("training"))?,
                }),
                _ => None,
            },
        };
        gctn::set_threads(1);
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()
            .context("tokio runtime")?;
        let report = runtime.block_on(self.session(root, &settings, &folder, max_steps));
        runtime.shutdown_timeout(Duration::from_millis(500));
        let report = report?;
        println!(
            "{} after {} steps, reward {:.3}",
            if report.completed {
                "completed"
            } else {
                "not completed"
            },
            report.steps,
            report.reward
        );
        if self.record.is_some() {
            println!("bag: {}", bag.display());
            println!("last heightmap: {}", folder.join("heightmap.png").display());
        }
        if self.json {
            println!("{}", serde_json::to_string(&report)?);
        }
        if !report.completed {
            bail!("{} with seed {} was not completed", self.problem, self.seed);
        }
        Ok(())
    }

    /// What the run repeats; `None` where the problem has no goals: then a person teaches it.
    fn demonstration(
        &self,
        problem: &Problem,
        work_cell: &ur5::WorkCell,
        folder: &Path,
        has_goals: bool,
    ) -> Result<Option<PathBuf>> {
        if !has_goals {
            if self.operator != OperatorKind::Web {
                bail!(
                    "{} has no goals: there is nothing to demonstrate; teach it with --operator web",
                    self.problem
                );
            }
            println!(
                "{} has no goals: teach it at the operator's page",
                self.problem
            );
            return Ok(None);
        }
        let shown_seed = EpisodeSeed {
            scene: self.seed,
            start: self.demonstration_seed.unwrap_or(self.seed),
        };
        println!("demonstrating {} with seed {shown_seed}", self.problem);
        let shown = folder.join("demonstration");
        if shown.exists() {
            let found = Demonstration::read(&shown)?;
            let expected = format!("{}, seed {shown_seed}", problem.name());
            let seed = EpisodeSeed {
                scene: found.seed,
                start: found.start_seed,
            };
            let found = format!("{}, seed {seed}", found.problem);
            if found != expected {
                bail!(
                    "{}: a demonstration of {found}, expected {expected}",
                    shown.display()
                );
            }
        } else {
            demonstration(problem, work_cell, shown_seed)?.write(&shown)?;
        }
        Ok(Some(std::path::absolute(shown)?))
    }

    fn require_approval(&self) -> RequireApproval {
        let usual = match self.operator {
            OperatorKind::Watch => RequireApproval::Never,
            _ => RequireApproval::Always,
        };
        self.require_approval.unwrap_or(usual)
    }

    /// Which proposals wait for an approval, as the executor has it.
    fn rule(&self) -> step_protocol::RequireApproval {
        let threshold = self.sure_probability;
        match self.require_approval() {
            RequireApproval::Always => step_protocol::RequireApproval::Always,
            RequireApproval::Unsure => step_protocol::RequireApproval::Unsure { threshold },
            RequireApproval::Never => step_protocol::RequireApproval::Never,
        }
    }

    async fn session(
        &self,
        root: &Root,
        settings: &Settings,
        folder: &Path,
        max_steps: usize,
    ) -> Result<Report> {
        // Subscriptions stand before the nodes start: nothing of the run is missed.
        let recorder = self
            .record
            .as_ref()
            .map(|_| RunRecorder::start(&folder.join("run"), settings, self.record_images))
            .transpose()?;
        let (context, node) = plain_node("sctn_launch", &[])?;
        let results = match recorder {
            Some(_) => RunRecorder::kept_results(),
            None => "step_result".to_owned(),
        };
        let confirms = settings.operated && settings.goal_module == ORACLE;
        let mut desk = Desk::new(&node, &results, confirms, self.rule())?;
        let mut graph = if self.processes {
            Graph::spawn(root, settings, &folder.join("logs"))?
        } else {
            Graph::compose(root, settings, &context)?
        };
        let run = async {
            // The nodes hear the operator, and so does the recorder.
            let listeners = settings.listeners() + usize::from(recorder.is_some());
            graph.bring_up(&node, listeners).await?;
            if let Some(console) = &settings.console {
                let file = &console.address_file;
                let page =
                    std::fs::read_to_string(file).with_context(|| file.display().to_string())?;
                println!("operator console: {}", page.trim());
            }
            if let Some(recorder) = &recorder {
                recorder.wait_for_desk().await;
            }
            tokio::select! {
                ended = desk.work(self.operator, max_steps) => ended,
                error = graph.failure() => Err(error),
                () = when(recorder.as_ref().map(RunRecorder::ended)) => Err(anyhow::anyhow!("the recording ended before the run")),
            }
        };
        let ended = tokio::select! {
            ended = run => ended,
            result = wait_for_end() => result.and(Err(anyhow::anyhow!("stopped by a signal"))),
        };
        if let Some(recorder) = &recorder {
            let measured_ns = ended.is_ok().then_some(desk.measured_ns);
            recorder.last_words(measured_ns).await;
        }
        let last_words = match self.operator {
            OperatorKind::None => LAST_WORDS_ELSEWHERE,
            _ => LAST_WORDS,
        };
        tokio::time::sleep(last_words).await;
        graph.stop(&context).await;
        let bag = match recorder {
            Some(recorder) => {
                let recording = recorder.finish().await?;
                if let Some(shortcoming) = recording.shortcoming() {
                    bail!("{}: {shortcoming}", recording.bag.display());
                }
                Some(recording.bag)
            }
            None => None,
        };
        if let Some(heightmap) = desk.last_heightmap()?
            && self.record.is_some()
        {
            heightmap::picture::write_heightmap(&folder.join("heightmap.png"), &heightmap, None)?;
        }
        ended?;
        let Desk {
            steps,
            total_reward,
            complete,
            ..
        } = desk;
        Ok(Report {
            problem: self.problem.clone(),
            seed: self.seed,
            completed: complete,
            reward: total_reward,
            steps,
            bag,
        })
    }
}

/// The operator's desk in a run: what arrives, what is decided, how far the run is.
struct Desk {
    node: Node,
    /// Whether the operator says which goal is next.
    confirms: bool,
    /// See [`Launch::rule`].
    rule: step_protocol::RequireApproval,
    /// Whether the executor carries proposals out by itself.
    unasked: Unasked,
    /// Whether the last goal is said to be reached.
    goals_reached: bool,
    proposals: node_kit::Subscription<PickPlace>,
    /// Proposals that came as goals of the executor's action.
    accepted: node_kit::Subscription<PickPlace>,
    results: node_kit::Subscription<StepResult>,
    refused: node_kit::Subscription<ConfirmationRefused>,
    rewards: node_kit::Subscription<Reward>,
    goals: node_kit::Subscription<Goal>,
    heightmaps: node_kit::Subscription<msgs::sctn_msgs::Heightmap>,
    confirmations: node_kit::Publisher<StepConfirmation>,
    operator: Operator,
    /// The motion that was asked about last.
    confirmed: Option<ProposalId>,
    step_count: u32,
    step_started: Instant,
    refusals: u32,
    steps: usize,
    total_reward: f64,
    /// Stamp of the last reward.
    measured_ns: i64,
    complete: bool,
    last_heightmap: Option<msgs::sctn_msgs::Heightmap>,
}

impl Desk {
    /// `results`: the topic of step results, or of those that are safe.
    fn new(
        node: &Node,
        results: &str,
        confirms: bool,
        rule: step_protocol::RequireApproval,
    ) -> Result<Self> {
        Ok(Self {
            node: node.clone(),
            confirms,
            rule,
            unasked: Unasked::new(rule),
            goals_reached: false,
            proposals: node.subscription("pick_place", Qos::Latched)?,
            accepted: node.subscription("pick_place_goal", Qos::Event)?,
            results: node.subscription(results, Qos::Event)?,
            refused: node.subscription("confirmation_refused", Qos::Event)?,
            rewards: node.subscription("reward", Qos::Event)?,
            goals: node.subscription("goal", Qos::Latched)?,
            heightmaps: node.subscription("heightmap", Qos::Latched)?,
            confirmations: node.publisher("step_confirmation", Qos::Event)?,
            operator: Operator::new(true),
            confirmed: None,
            step_count: 0,
            step_started: Instant::now(),
            refusals: 0,
            steps: 0,
            total_reward: 0.0,
            measured_ns: 0,
            complete: false,
            last_heightmap: None,
        })
    }

    fn last_heightmap(&mut self) -> Result<Option<Heightmap>> {
        let message = self.last_heightmap.take();
        message
            .map(heightmap_from_msg)
            .transpose()
            .context("topic heightmap")
    }

    /// Until the run is over: the goal is complete, or the steps are used up.
    async fn work(&mut self, kind: OperatorKind, max_steps: usize) -> Result<()> {
        let alone = matches!(kind, OperatorKind::Auto | OperatorKind::Watch);
        let web = kind == OperatorKind::Web;
        // A person has the last word on the last step too.
        let done = |desk: &Self| desk.complete && (!web || !desk.confirms || desk.goals_reached);
        let mut heard = Instant::now();
        while !done(self) && (self.steps < max_steps || !alone) {
            let silence = tokio::time::sleep_until((heard + SILENCE).into());
            let mut questions = Vec::new();
            tokio::select! {
                message = self.proposals.recv() => match convert::proposal_from_msg(&message) {
                    Ok(proposal) => questions.extend(self.operator.on_proposal(proposal)),
                    Err(error) => self.proposals.reject(error),
                },
                message = self.accepted.recv() => match convert::proposal_from_msg(&message) {
                    Ok(proposal) => questions.extend(self.operator.on_proposal(proposal)),
                    Err(error) => self.accepted.reject(error),
                },
                message = self.results.recv() => questions.extend(self.result(kind, &message)?),
                message = self.rewards.recv() => match convert::reward_from_msg(&message) {
                    Ok(reward) => {
                        self.total_reward = reward.total;
                        self.measured_ns = ns_from_stamp(&message.header.stamp);
                        questions.extend(self.operator.on_reward(reward));
                    }
                    Err(error) => self.rewards.reject(error),
                },
                goal = self.goals.recv() => {
                    self.step_count = goal.step_count;
                    self.goals_reached = goal.complete;
                    match convert::goal_from_msg(goal) {
                        Ok(goal) => self.operator.on_goal(&goal),
                        Err(error) => self.goals.reject(error),
                    }
                }
                refused = self.refused.recv() => {
                    tracing::warn!("confirmation of {} refused: {}", refused.proposal_id, refused.message);
                }
                heightmap = self.heightmaps.recv() => {
                    self.last_heightmap = Some(heightmap);
                    continue;
                }
                () = tokio::time::sleep(LAST_RESULT), if self.goals_reached && !self.confirms => break,
                () = silence, if kind == OperatorKind::Auto => {
                    questions = self.operator.on_silence();
                    tracing::warn!("no step has gone on for {} s: repeating the last decision", SILENCE.as_secs());
                }
                () = tokio::time::sleep(PATIENCE), if alone => {
                    bail!("no message from any node for {} s: see the logs of the nodes", PATIENCE.as_secs());
                }
            }
            heard = Instant::now();
            for question in questions {
                self.answer(kind, question).await?;
            }
        }
        self.wait_for_last_heightmap().await;
        if web {
            // Open pages show the end of the run.
            tokio::time::sleep(LAST_LOOK).await;
        }
        Ok(())
    }

    fn result(&mut self, kind: OperatorKind, message: &StepResult) -> Result<Option<Question>> {
        let result = match convert::result_from_msg(message) {
            Ok(result) => result,
            Err(error) => {
                self.results.reject(error);
                return Ok(None);
            }
        };
        if matches!(
            result.outcome,
            StepOutcome::Fault | StepOutcome::Stopped | StepOutcome::NotHome
        ) {
            self.unasked.stop();
        } else if result.outcome.motion().is_some() {
            self.unasked.go_on(self.rule);
        }
        if matches!(kind, OperatorKind::Web | OperatorKind::None) {
            // Whoever decides, in the page or by topic, sees faults and refusals, and decides how to go on.
            return Ok(self.operator.on_result(result));
        }
        if result.outcome == StepOutcome::Fault {
            bail!("the robot failed: {}", result.reason);
        }
        if result.outcome == StepOutcome::Refused {
            tracing::warn!("proposal {} refused: {}", result.proposal_id, result.reason);
            self.refusals += 1;
            if self.refusals >= MAX_REFUSALS {
                bail!(
                    "{MAX_REFUSALS} refusals in a row, the last one: {}",
                    result.reason
                );
            }
        }
        Ok(self.operator.on_result(result))
    }

    async fn answer(&mut self, kind: OperatorKind, question: Question) -> Result<()> {
        match &question {
            Question::Approve(proposal) => {
                self.step_started = Instant::now();
                println!("{}", described(proposal, self.step_count));
            }
            Question::Confirm { result, reward, .. } => {
                // The same motion may be asked about again: see `Operator::on_silence`.
                if self.confirmed.replace(result.proposal_id) != Some(result.proposal_id) {
                    self.steps += 1;
                }
                self.complete = reward.is_some_and(|reward| reward.complete);
                self.refusals = 0;
                let (delta, total) =
                    reward.map_or((f64::NAN, f64::NAN), |reward| (reward.delta, reward.total));
                println!(
                    "    {}, delta reward {delta:+.3}, reward {total:.3}, {:.1} s",
                    result.outcome.name(),
                    self.step_started.elapsed().as_secs_f64()
                );
            }
        }
        let decision = match kind {
            OperatorKind::None | OperatorKind::Watch | OperatorKind::Web => return Ok(()),
            _ if !self.confirms && matches!(question, Question::Confirm { .. }) => return Ok(()),
            _ if self.moves_unasked(&question) => return Ok(()),
            OperatorKind::Auto => question.automatic_answer(),
            OperatorKind::Terminal => {
                let ask = question.clone();
                self.node.spawn_blocking(move || terminal(&ask)).await??
            }
        };
        if decision == OperatorDecision::Stop {
            self.unasked.stop();
        }
        let message = confirmation(&self.node, question.proposal_id(), decision, "sctn launch")?;
        self.confirmations.publish(message);
        Ok(())
    }

    /// The executor carries the proposal out by itself.
    fn moves_unasked(&self, question: &Question) -> bool {
        match question {
            Question::Approve(proposal) => self.unasked.moves(self.rule, proposal),
            Question::Confirm { .. } => false,
        }
    }

    /// Reward and heightmap of the last step come in any order.
    async fn wait_for_last_heightmap(&mut self) {
        let seen = |message: &Option<msgs::sctn_msgs::Heightmap>| {
            message
                .as_ref()
                .map(|message| ns_from_stamp(&message.header.stamp))
        };
        while seen(&self.last_heightmap) < Some(self.measured_ns) {
            let next = tokio::time::timeout(LAST_HEIGHTMAP, self.heightmaps.recv()).await;
            match next {
                Ok(heightmap) => self.last_heightmap = Some(heightmap),
                Err(_) => return tracing::warn!("no heightmap came after the last step"),
            }
        }
    }
}

/// Asks the person at the terminal.
fn terminal(question: &Question) -> Result<OperatorDecision> {
    use std::io::Write;
    let prompt = Prompt::of(question);
    loop {
        print!("    {}: ", prompt.text);
        std::io::stdout().flush()?;
        let mut line = String::new();
        if std::io::stdin().read_line(&mut line)? == 0 {
            bail!("the terminal was closed: nobody is left to decide");
        }
        if let Some(decision) = prompt.decision(&line) {
            return Ok(decision);
        }
    }
}
