//! Node that holds the demonstration sequence and latches the next-step goal.
//!
//! Which goal is next is decided in [`Oracle`], which knows no ROS node.

mod oracle;
mod parameters;

use std::{path::Path, time::Duration};

use anyhow::Context as _;
use bags::Demonstration;
use gctn::{Embedded, Embedding};
use msgs::{
    convert::{self, ConvertError},
    sctn_msgs::{
        CaptureGoal, CaptureGoalRequest, CaptureGoalResponse, Goal, Heightmap, LoadDemonstration,
        LoadDemonstrationRequest, LoadDemonstrationResponse, PickPlace, SetStep, SetStepRequest,
        SetStepResponse, StepConfirmation, StepResult,
    },
    std_msgs::Header,
};
use node_kit::{Active, Level, Node, Once, Publisher, Qos};
use tracing::{info, warn};

pub use oracle::{
    Capture, CaptureError, Change, Decider, NoSuchStep, Oracle, Refusal, SequenceError, sequence,
};
pub use parameters::{GoalModule, GoalOracleParameters};

/// How long the first goal waits for policy and executor, so that none of their first words is lost.
const PEERS: Duration = Duration::from_secs(5);

/// Reads the demonstration; what it returns walks through its goals.
pub async fn configure(node: Node, parameters: GoalOracleParameters) -> anyhow::Result<OracleNode> {
    let shown = match parameters.demonstration()? {
        Some(path) => Some(Shown::read(path, &parameters.world_frame)?),
        None => None,
    };
    let decider = match (parameters.goal_module, parameters.require_confirmation) {
        (GoalModule::ImageDistance | GoalModule::Embedding, _) => Decider::Image,
        (GoalModule::Oracle, true) => Decider::Operator,
        (GoalModule::Oracle, false) => Decider::Outcome,
    };
    let (goals, start) = shown.map_or((Vec::new(), None), |shown| (shown.goals, Some(shown.start)));
    let eye = match parameters.goal_module {
        GoalModule::Oracle | GoalModule::ImageDistance => Eye::Images(Vec::new()),
        GoalModule::Embedding => {
            let embedding = Embedding::load(&parameters.embedding);
            Eye::Embedded(
                Box::new(embedding.context("parameter embedding")?),
                Vec::new(),
            )
        }
    };
    Ok(OracleNode {
        goal: node.publisher::<Goal>("goal", Qos::Latched)?,
        refusals: node.publisher::<StepResult>("step_result", Qos::Event)?,
        oracle: Oracle::new(goals, decider),
        start,
        newest: None,
        eye,
        loads: Once::default(),
        captures: Once::default(),
        steps: Once::default(),
        node,
        parameters,
    })
}

impl Active for OracleNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let mut proposals = node.subscription::<PickPlace>("pick_place", Qos::Latched)?;
        let mut results = node.subscription::<StepResult>("step_result", Qos::Event)?;
        let mut confirmations =
            node.subscription::<StepConfirmation>("step_confirmation", Qos::Event)?;
        let mut heightmaps = node.subscription::<Heightmap>("heightmap", Qos::Latched)?;
        let mut load = node.service_server::<LoadDemonstration>("~/load_demonstration")?;
        let mut capture = node.service_server::<CaptureGoal>("~/capture_goal")?;
        let mut set_step = node.service_server::<SetStep>("~/set_step")?;
        // The newest that comes from now on.
        self.newest = None;

        for topic in [proposals.topic(), results.topic()] {
            if !node.graph().wait_for_publisher(topic, PEERS).await {
                info!("nobody publishes {topic} yet; the first goal is latched all the same");
            }
        }
        self.latch();
        loop {
            let change = tokio::select! {
                proposal = proposals.recv() => {
                    self.oracle.proposed(&proposal);
                    Change::None
                }
                result = results.recv() => self.oracle.result(&result),
                heightmap = heightmaps.recv() => {
                    if let Err(reason) = self.observed(heightmap) {
                        heightmaps.reject(reason);
                    }
                    Change::None
                }
                confirmation = confirmations.recv() => {
                    self.oracle.confirmed(&confirmation).unwrap_or_else(|refusal| {
                        warn!("confirmation refused: {refusal}");
                        confirmations.reject(format_args!("refused: {refusal}"));
                        self.refuse(&confirmation, &refusal);
                        Change::None
                    })
                }
                (call, request) = load.recv() => {
                    let (response, change) = self.load(request).await;
                    load.respond(call, response);
                    change
                }
                (call, request) = capture.recv() => {
                    // What was seen before the call is to be known before it.
                    while let Some(heightmap) = heightmaps.try_recv() {
                        if let Err(reason) = self.observed(heightmap) {
                            heightmaps.reject(reason);
                        }
                    }
                    let (response, change) = self.capture(request);
                    capture.respond(call, response);
                    change
                }
                (call, request) = set_step.recv() => {
                    let (response, change) = self.set_step(&request);
                    set_step.respond(call, response);
                    change
                }
            };
            let change = match change {
                Change::None => self.match_image(),
                change => change,
            };
            match change {
                Change::None => {}
                Change::Goal(_) => self.latch(),
                Change::Stopped => {
                    info!("stopped by the operator");
                    self.report();
                }
            }
        }
    }
}

/// A demonstration as goals.
struct Shown {
    name: String,
    goals: Vec<Goal>,
    /// What was seen before the first step.
    start: heightmap::Heightmap,
}

impl Shown {
    /// Errors name the path.
    fn read(path: &Path, world_frame: &str) -> anyhow::Result<Self> {
        let shown = path.display();
        let demonstration =
            Demonstration::read(path).with_context(|| format!("demonstration {shown}"))?;
        let goals = sequence(&demonstration, world_frame)
            .with_context(|| format!("demonstration {shown}"))?;
        Ok(Self {
            name: goals
                .first()
                .map(|goal| goal.demonstration.clone())
                .unwrap_or_default(),
            start: demonstration.observation(0).clone(),
            goals,
        })
    }
}

/// What is seen, and since when.
struct Observation {
    stamp: Duration,
    heightmap: heightmap::Heightmap,
    message: Heightmap,
    /// It has said already which goal is next, or could not.
    judged: bool,
}

/// How the goal modules that look at images compare them, and what they compare with: what was seen before
/// the first step, then each goal. Empty until it is needed, and again when the goals change.
enum Eye {
    Images(Vec<heightmap::Heightmap>),
    Embedded(Box<Embedding>, Vec<Embedded>),
}

impl Eye {
    fn forget(&mut self) {
        match self {
            Self::Images(images) => images.clear(),
            Self::Embedded(_, images) => images.clear(),
        }
    }

    /// How many goals are reached, as far as can be seen.
    fn reached(
        &mut self,
        seen: &heightmap::Heightmap,
        images: impl Iterator<Item = heightmap::Heightmap>,
    ) -> Result<Option<usize>, gctn::Error> {
        match self {
            Self::Images(known) => {
                if known.is_empty() {
                    known.extend(images);
                }
                Ok(seen.nearest(&*known))
            }
            Self::Embedded(embedding, known) => {
                if known.is_empty() {
                    let embedded = images.map(|image| embedding.embed(&image));
                    *known = embedded.collect::<Result<_, _>>()?;
                }
                Ok(Embedding::nearest(&embedding.embed(seen)?, known))
            }
        }
    }
}

/// The configured node. While it is inactive the run stays where it is.
pub struct OracleNode {
    node: Node,
    parameters: GoalOracleParameters,
    oracle: Oracle,
    goal: Publisher<Goal>,
    refusals: Publisher<StepResult>,
    /// What was seen before the first step of the demonstration.
    start: Option<heightmap::Heightmap>,
    newest: Option<Observation>,
    eye: Eye,
    loads: Once<LoadDemonstrationResponse>,
    captures: Once<CaptureGoalResponse>,
    steps: Once<SetStepResponse>,
}

impl OracleNode {
    fn latch(&self) {
        match self.oracle.goal() {
            Some(goal) => {
                let (step, count, attempt) = self.oracle.progress();
                if goal.complete {
                    info!("all {count} steps are done");
                } else {
                    info!("goal: step {step} of {count}, attempt {attempt}");
                }
                self.goal.publish(goal);
            }
            None => info!("no goals yet: call ~/load_demonstration or ~/capture_goal"),
        }
        self.report();
    }

    fn report(&self) {
        let (step, count, attempt) = self.oracle.progress();
        let message = if count == 0 {
            "no goals yet: call ~/load_demonstration or ~/capture_goal".to_owned()
        } else if self.oracle.is_stopped() {
            format!("stopped at step {step} of {count}")
        } else if self.oracle.is_complete() {
            format!("all {count} steps are done")
        } else {
            format!("step {step} of {count}, attempt {attempt}")
        };
        let level = if count == 0 { Level::Warn } else { Level::Ok };
        self.node.diagnostics().set("goal", level, message, []);
    }

    /// Takes what is seen; says what is wrong with it.
    fn observed(&mut self, message: Heightmap) -> Result<(), String> {
        let world = &self.parameters.world_frame;
        if message.header.frame_id != *world {
            let actual = &message.header.frame_id;
            return Err(format!("header.frame_id is {actual:?}, expected {world:?}"));
        }
        let text = |error: ConvertError| error.to_string();
        let stamp = convert::time_from_msg(&message.header.stamp).map_err(text)?;
        let heightmap = convert::heightmap_from_msg(message.clone()).map_err(text)?;
        // One of another table would be infinitely far from all images alike.
        if let Some(start) = &self.start
            && start.workspace != heightmap.workspace
        {
            return Err(format!(
                "workspace is {:?}, expected that of the demonstration, {:?}",
                heightmap.workspace, start.workspace
            ));
        }
        self.newest = Some(Observation {
            stamp,
            heightmap,
            message,
            judged: false,
        });
        Ok(())
    }

    /// The goal modules that look at images: decides by the newest heightmap, once, if it was seen after the
    /// motion that waits for one.
    fn match_image(&mut self) -> Change {
        let moved = self.oracle.waits_for_image();
        let moved = moved.and_then(|stamp| convert::time_from_msg(&stamp).ok());
        let (Some(moved), Some(seen), Some(start)) = (moved, &mut self.newest, &self.start) else {
            return Change::None;
        };
        if seen.stamp < moved || seen.judged {
            return Change::None;
        }
        seen.judged = true;
        let goals = self.oracle.images().cloned();
        // They were heightmaps before.
        let goals = goals.filter_map(|image| convert::heightmap_from_msg(image).ok());
        let images = std::iter::once(start.clone()).chain(goals);
        match self.eye.reached(&seen.heightmap, images) {
            Ok(Some(reached)) => self.oracle.matched(reached),
            Ok(None) => Change::None,
            Err(error) => {
                warn!("what is seen cannot be compared: {error}");
                Change::None
            }
        }
    }

    /// The operator's tools see a refusal where they see the executor's.
    fn refuse(&self, confirmation: &StepConfirmation, refusal: &Refusal) {
        self.refusals.publish(StepResult {
            header: Header {
                stamp: self.node.now(),
                frame_id: self.parameters.world_frame.clone(),
            },
            proposal_id: confirmation.proposal_id,
            outcome: StepResult::REFUSED,
            reason: refusal.to_string(),
            ..StepResult::default()
        });
    }

    async fn load(
        &mut self,
        request: LoadDemonstrationRequest,
    ) -> (LoadDemonstrationResponse, Change) {
        let refusal = |message: String| {
            warn!("load_demonstration: {message}");
            LoadDemonstrationResponse {
                message,
                ..Default::default()
            }
        };
        match self.loads.answered(&request.request_id) {
            Err(invalid) => return (refusal(invalid.to_string()), Change::None),
            Ok(Some(answer)) => return (answer, Change::None),
            Ok(None) => {}
        }
        let world_frame = self.parameters.world_frame.clone();
        let reading = self
            .node
            .spawn_blocking(move || Shown::read(Path::new(&request.path), &world_frame));
        let read = reading.await.context("reading panicked").flatten();
        let (answer, change) = match read {
            Ok(shown) => {
                let answer = LoadDemonstrationResponse {
                    success: true,
                    message: format!("{}, {} steps", shown.name, shown.goals.len()),
                    demonstration: shown.name,
                    step_count: shown.goals.len() as u32,
                };
                info!("loaded {}", answer.message);
                self.start = Some(shown.start);
                self.eye.forget();
                (answer, self.oracle.load(shown.goals))
            }
            Err(error) => (refusal(format!("{error:#}")), Change::None),
        };
        self.loads.remember(&request.request_id, answer.clone());
        (answer, change)
    }

    fn capture(&mut self, request: CaptureGoalRequest) -> (CaptureGoalResponse, Change) {
        let (_, count, _) = self.oracle.progress();
        let refusal = |message: String| {
            warn!("capture_goal: {message}");
            CaptureGoalResponse {
                message,
                step_count: count,
                ..Default::default()
            }
        };
        match self.captures.answered(&request.request_id) {
            Err(invalid) => return (refusal(invalid.to_string()), Change::None),
            Ok(Some(answer)) => return (answer, Change::None),
            Ok(None) => {}
        }
        let (answer, change) = match self.take_capture(&request) {
            Ok((stamp, step, change)) => {
                let (_, step_count, _) = self.oracle.progress();
                let answer = CaptureGoalResponse {
                    success: true,
                    message: format!("the heightmap of {:.3} s", stamp.as_secs_f64()),
                    step,
                    step_count,
                };
                self.eye.forget();
                info!("captured {} as step {step} of {step_count}", answer.message);
                (answer, change)
            }
            Err(reason) => (refusal(reason), Change::None),
        };
        self.captures.remember(&request.request_id, answer.clone());
        (answer, change)
    }

    fn take_capture(
        &mut self,
        request: &CaptureGoalRequest,
    ) -> Result<(Duration, u32, Change), String> {
        let seen = self.newest.as_ref().ok_or("no heightmap has arrived")?;
        let moved = convert::time_from_msg(&self.oracle.moved_until());
        let moved = moved.map_err(|error| error.to_string())?;
        if seen.stamp < moved {
            return Err(format!(
                "the newest heightmap is of {:.3} s, before the last motion ended at {:.3} s",
                seen.stamp.as_secs_f64(),
                moved.as_secs_f64()
            ));
        }
        if self.start.is_none() && self.parameters.goal_module != GoalModule::Oracle {
            return Err(
                "this goal_module needs the image before the first step: load a demonstration"
                    .into(),
            );
        }
        let capture = Capture {
            heightmap: seen.message.clone(),
            append: request.append,
            module: request.module.clone(),
            settings: request.settings,
        };
        let captured = self.oracle.capture(capture);
        let (step, change) = captured.map_err(|error| error.to_string())?;
        Ok((seen.stamp, step, change))
    }

    fn set_step(&mut self, request: &SetStepRequest) -> (SetStepResponse, Change) {
        let known = self.steps.answered(&request.request_id);
        if let Ok(Some(answer)) = known {
            return (answer, Change::None);
        }
        let valid = known.is_ok();
        let change = match known {
            Ok(_) => self
                .oracle
                .set_step(request.step)
                .map_err(|none| none.to_string()),
            Err(invalid) => Err(invalid.to_string()),
        };
        let (step, step_count, attempt) = self.oracle.progress();
        let answer = |success, message| SetStepResponse {
            success,
            message,
            step,
            step_count,
            attempt,
        };
        let (answer, change) = match change {
            Ok(change) => (answer(true, String::new()), change),
            Err(reason) => {
                warn!("set_step: {reason}");
                (answer(false, reason), Change::None)
            }
        };
        if valid {
            self.steps.remember(&request.request_id, answer.clone());
        }
        (answer, change)
    }
}
