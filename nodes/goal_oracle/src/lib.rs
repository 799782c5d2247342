//! Node that holds the demonstration sequence and publishes the next-step goal.
//!
//! Which goal is next is decided in [`GoalTracker`], which knows no ROS node.

mod parameters;

use std::{path::Path, sync::Arc, time::Duration};

use anyhow::{Context as _, bail};
use bags::Demonstration;
use gctn::{Embedded, Embedding, GoalConditioning, Policy};
use msgs::{
    convert,
    sctn_msgs::{
        CaptureGoal, CaptureGoalRequest, CaptureGoalResponse, ConfirmationRefused, Goal, Heightmap,
        LoadDemonstration, LoadDemonstrationRequest, LoadDemonstrationResponse, PickPlace,
        PrimitiveSettings, SetStep, SetStepRequest, SetStepResponse, StepConfirmation, StepResult,
    },
};
use node_kit::{Active, Level, Node, Publisher, Qos, ReplyCache, Subscription};
#[cfg(not(test))]
use node_kit::{Context, NodeLife, RosArguments};
use step_protocol::{
    Capture, Change, ConfirmationRefusal, GoalSequence, GoalTracker, Observation, ProposalId,
    StepJudge,
};
use tracing::{info, warn};

pub use parameters::{GoalModule, GoalOracleParameters};

/// How long the first goal waits for policy and executor, so that none of their first words is lost.
const PEERS: Duration = Duration::from_secs(5);

/// Starts the node in a context. It is compiled here, once, and not anew in every program that has it; tests of this library have no use for it.
#[cfg(not(test))]
pub fn start(context: &Context, arguments: &RosArguments) -> anyhow::Result<NodeLife> {
    context.start("goal_oracle", arguments, configure)
}

/// Reads the demonstration; returns the node that walks through its goals.
pub async fn configure(node: Node, parameters: GoalOracleParameters) -> anyhow::Result<OracleNode> {
    let sequence = match parameters.demonstration()? {
        Some(path) => read_goals(path)?,
        None => GoalSequence::default(),
    };
    let judge = match (parameters.goal_module, parameters.require_confirmation) {
        (GoalModule::ImageDistance | GoalModule::Embedding | GoalModule::Sequence, _) => {
            StepJudge::Image
        }
        (GoalModule::Oracle, true) => StepJudge::Operator,
        (GoalModule::Oracle, false) => StepJudge::Outcome,
    };
    let matcher = match parameters.goal_module {
        GoalModule::Oracle | GoalModule::ImageDistance => ImageMatcher::Distance,
        GoalModule::Embedding => {
            let embedding = Embedding::load(&parameters.embedding);
            let embedding = embedding.context("parameter embedding")?;
            ImageMatcher::Embedding(Box::new(embedding), Vec::new())
        }
        GoalModule::Sequence => {
            let policy = Policy::load(&parameters.checkpoint).context("parameter checkpoint")?;
            let conditioning = policy.config().conditioning;
            if conditioning != GoalConditioning::Sequence {
                bail!(
                    "parameter checkpoint: {} is conditioned on {conditioning:?}, expected one trained with conditioning sequence",
                    parameters.checkpoint.display()
                );
            }
            ImageMatcher::Sequence(Box::new(policy))
        }
    };
    Ok(OracleNode {
        goal: node.publisher::<Goal>("goal", Qos::Latched)?,
        refusals: node.publisher::<ConfirmationRefused>("confirmation_refused", Qos::Event)?,
        tracker: GoalTracker::new(sequence, judge),
        newest: None,
        matcher,
        loads: ReplyCache::default(),
        captures: ReplyCache::default(),
        steps: ReplyCache::default(),
        node,
        parameters,
    })
}

/// The goals of a demonstration bag. Errors name the path.
fn read_goals(path: &Path) -> anyhow::Result<GoalSequence> {
    let shown = path.display();
    let demonstration =
        Demonstration::read(path).with_context(|| format!("demonstration {shown}"))?;
    let goals = demonstration.into_goals();
    goals.with_context(|| format!("demonstration {shown}"))
}

/// A proposal was published, or came as a goal of the executor's action.
fn follow_proposal(
    tracker: &mut GoalTracker,
    topic: &Subscription<PickPlace>,
    message: &PickPlace,
) {
    match convert::proposal_from_msg(message) {
        Ok(proposal) => tracker.on_proposal(&proposal),
        Err(error) => topic.reject(error),
    }
}

impl Active for OracleNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let mut proposals = node.subscription::<PickPlace>("pick_place", Qos::Latched)?;
        let mut accepted = node.subscription::<PickPlace>("pick_place_goal", Qos::Event)?;
        let mut results = node.subscription::<StepResult>("step_result", Qos::Event)?;
        let mut confirmations =
            node.subscription::<StepConfirmation>("step_confirmation", Qos::Event)?;
        let mut heightmaps = node.subscription::<Heightmap>("heightmap", Qos::Latched)?;
        let mut load =
            node.idempotent_server::<LoadDemonstration>("~/load_demonstration", &self.loads)?;
        let mut capture =
            node.idempotent_server::<CaptureGoal>("~/capture_goal", &self.captures)?;
        let mut set_step = node.idempotent_server::<SetStep>("~/set_step", &self.steps)?;
        // The newest that comes from now on.
        self.newest = None;

        for topic in [proposals.topic(), results.topic()] {
            if !node.graph().wait_for_publisher(topic, PEERS).await {
                info!("nobody publishes {topic} yet; the first goal is latched all the same");
            }
        }
        self.publish_goal();
        loop {
            let change = tokio::select! {
                proposal = proposals.recv() => {
                    follow_proposal(&mut self.tracker, &proposals, &proposal);
                    Change::None
                }
                proposal = accepted.recv() => {
                    follow_proposal(&mut self.tracker, &accepted, &proposal);
                    Change::None
                }
                result = results.recv() => match convert::result_from_msg(&result) {
                    Ok(result) => self.tracker.on_result(&result),
                    Err(error) => {
                        results.reject(error);
                        Change::None
                    }
                },
                heightmap = heightmaps.recv() => {
                    if let Err(reason) = self.observed(heightmap) {
                        heightmaps.reject(reason);
                    }
                    Change::None
                }
                confirmation = confirmations.recv() => {
                    let read = convert::confirmation_from_msg(&confirmation);
                    let change = read.and_then(|read| self.tracker.on_confirmation(&read));
                    change.unwrap_or_else(|refusal| {
                        confirmations.reject(format_args!("refused: {refusal}"));
                        self.refuse(ProposalId(confirmation.proposal_id), &refusal);
                        Change::None
                    })
                }
                (call, request) = load.recv(refused_load) => {
                    let (response, change) = self.load(request).await;
                    load.respond(call, response);
                    change
                }
                (call, request) = capture.recv(|reason| refused_capture(&self.tracker, reason)) => {
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
                (call, request) = set_step.recv(|reason| refused_step(&self.tracker, reason)) => {
                    let (response, change) = self.set_step(&request);
                    set_step.respond(call, response);
                    change
                }
            };
            for (id, refusal) in self.tracker.take_refused() {
                self.refuse(id, &refusal);
            }
            let change = match change {
                Change::None => self.match_image(),
                change => change,
            };
            match change {
                Change::None => {}
                Change::Goal(_) => self.publish_goal(),
                Change::Stopped => {
                    info!("stopped by the operator");
                    self.report();
                }
            }
        }
    }
}

/// How the goal modules that look at images compare them. What is embedded is kept until the goals change.
enum ImageMatcher {
    Distance,
    Embedding(Box<Embedding>, Vec<Embedded>),
    /// Conditioned on the images before and after a step.
    Sequence(Box<Policy>),
}

/// A step is done when the policy gives it at least this probability.
const DONE: f64 = 0.5;

impl ImageMatcher {
    /// The goals have changed.
    fn forget(&mut self) {
        if let Self::Embedding(_, known) = self {
            known.clear();
        }
    }

    /// How many goals are reached, where it was `before` of them before the motion. `images`: that of the start, then those to be
    /// reached. By distance and embedding it is the index of the nearest image. None where the matcher cannot say.
    fn reached<'a>(
        &mut self,
        seen: &heightmap::Heightmap,
        images: impl Iterator<Item = &'a heightmap::Heightmap>,
        before: usize,
    ) -> Result<Option<usize>, gctn::Error> {
        match self {
            Self::Distance => Ok(seen.nearest(images)),
            Self::Embedding(embedding, known) => {
                if known.is_empty() {
                    let embedded = images.map(|image| embedding.embed(image));
                    *known = embedded.collect::<Result<_, _>>()?;
                }
                Ok(Embedding::nearest(&embedding.embed(seen)?, known))
            }
            Self::Sequence(policy) => {
                let images: Vec<_> = images.collect();
                // Step `index`, from 0, leads from one image to the next.
                let is_done = |index: usize| match images.get(index..index + 2) {
                    Some([previous, image]) => policy
                        .done(seen, gctn::Goal::step(previous, image))
                        .map(|probability| probability.map(|probability| probability >= DONE)),
                    _ => Ok(None),
                };
                if is_done(before)? == Some(true) {
                    return Ok(Some(before + 1));
                }
                let undone = match before.checked_sub(1) {
                    Some(last) => is_done(last)? == Some(false),
                    None => false,
                };
                Ok(Some(before - usize::from(undone)))
            }
        }
    }
}

/// What is seen.
struct Newest {
    observation: Observation,
    /// It has decided already which goal is next, or could not.
    judged: bool,
}

/// The configured node. While it is inactive the run stays where it is.
pub struct OracleNode {
    node: Node,
    parameters: GoalOracleParameters,
    tracker: GoalTracker,
    goal: Publisher<Goal>,
    refusals: Publisher<ConfirmationRefused>,
    newest: Option<Newest>,
    matcher: ImageMatcher,
    loads: ReplyCache<LoadDemonstrationResponse>,
    captures: ReplyCache<CaptureGoalResponse>,
    steps: ReplyCache<SetStepResponse>,
}

impl OracleNode {
    fn publish_goal(&self) {
        let world = &self.parameters.world_frame;
        let goal = self.tracker.goal();
        match goal.map(|goal| convert::goal_to_msg(&goal, world)) {
            Some(Ok(goal)) => {
                let (step, count, attempt) = self.tracker.progress();
                if goal.complete {
                    info!("all {count} steps are done");
                } else {
                    info!("goal: step {step} of {count}, attempt {attempt}");
                }
                self.goal.publish(goal);
            }
            Some(Err(error)) => warn!("the goal cannot be published: {error}"),
            None => info!("no goals yet: call ~/load_demonstration or ~/capture_goal"),
        }
        self.report();
    }

    fn report(&self) {
        let (step, count, attempt) = self.tracker.progress();
        let message = if count == 0 {
            "no goals yet: call ~/load_demonstration or ~/capture_goal".to_owned()
        } else if self.tracker.is_stopped() {
            format!("stopped at step {step} of {count}")
        } else if self.tracker.is_complete() {
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
        let observation =
            convert::observation_from_msg(message).map_err(|error| error.to_string())?;
        // One of another workspace would be infinitely far from all images alike.
        let workspace = observation.heightmap.workspace;
        if let Some(start) = self.tracker.start()
            && start.workspace != workspace
        {
            return Err(format!(
                "workspace is {workspace:?}, expected that of the demonstration, {:?}",
                start.workspace
            ));
        }
        self.newest = Some(Newest {
            observation,
            judged: false,
        });
        Ok(())
    }

    /// The goal modules that look at images: decides by the newest heightmap, once, if it was seen after the motion that waits
    /// for one.
    fn match_image(&mut self) -> Change {
        let moved = self.tracker.waits_for_image();
        let (Some(moved), Some(seen)) = (moved, &mut self.newest) else {
            return Change::None;
        };
        let Some(images) = self.tracker.known_images() else {
            return Change::None;
        };
        if seen.observation.stamp < moved || seen.judged {
            return Change::None;
        }
        seen.judged = true;
        let heightmap = &seen.observation.heightmap;
        let (step, _, _) = self.tracker.progress();
        match self.matcher.reached(heightmap, images, step as usize - 1) {
            Ok(Some(reached)) => self.tracker.on_image_match(reached),
            Ok(None) => Change::None,
            Err(error) => {
                warn!("what is seen cannot be compared: {error}");
                Change::None
            }
        }
    }

    fn refuse(&self, id: ProposalId, refusal: &ConfirmationRefusal) {
        warn!("confirmation refused: {refusal}");
        let now = self.node.clock().time();
        let world = &self.parameters.world_frame;
        match convert::confirmation_refused_to_msg(id, refusal, now, world) {
            Ok(message) => self.refusals.publish(message),
            Err(error) => warn!("the refusal cannot be published: {error}"),
        }
    }

    async fn load(
        &mut self,
        request: LoadDemonstrationRequest,
    ) -> (LoadDemonstrationResponse, Change) {
        let reading = self
            .node
            .spawn_blocking(move || read_goals(Path::new(&request.path)));
        let read = reading.await.context("reading panicked").flatten();
        match read {
            Ok(sequence) => {
                let goals = &sequence.goals;
                let name = goals.first().map(|goal| goal.demonstration.clone());
                let name = name.unwrap_or_default();
                let answer = LoadDemonstrationResponse {
                    success: true,
                    message: format!("{name}, {} steps", goals.len()),
                    demonstration: name,
                    step_count: goals.len() as u32,
                };
                info!("loaded {}", answer.message);
                self.matcher.forget();
                (answer, self.tracker.load(sequence))
            }
            Err(error) => (refused_load(format!("{error:#}")), Change::None),
        }
    }

    fn capture(&mut self, request: CaptureGoalRequest) -> (CaptureGoalResponse, Change) {
        match self.take_capture(&request) {
            Ok((stamp, step, change)) => {
                let (_, step_count, _) = self.tracker.progress();
                let answer = CaptureGoalResponse {
                    success: true,
                    message: format!("the heightmap of {:.3} s", stamp.as_secs_f64()),
                    step,
                    step_count,
                };
                self.matcher.forget();
                info!("captured {} as step {step} of {step_count}", answer.message);
                (answer, change)
            }
            Err(reason) => (refused_capture(&self.tracker, reason), Change::None),
        }
    }

    fn take_capture(
        &mut self,
        request: &CaptureGoalRequest,
    ) -> Result<(Duration, u32, Change), String> {
        let seen = self.newest.as_ref().ok_or("no heightmap has arrived")?;
        let Observation {
            stamp,
            heightmap,
            coverage,
            ..
        } = &seen.observation;
        let (stamp, moved) = (*stamp, self.tracker.moved_until());
        if stamp < moved {
            return Err(format!(
                "the newest heightmap is of {:.3} s, before the last motion ended at {:.3} s",
                stamp.as_secs_f64(),
                moved.as_secs_f64()
            ));
        }
        if self.tracker.start().is_none() && self.parameters.goal_module != GoalModule::Oracle {
            return Err(
                "this goal_module needs the image before the first step: load a demonstration"
                    .into(),
            );
        }
        let given = request.settings != PrimitiveSettings::default();
        let settings = given.then(|| convert::settings_from_msg(&request.settings));
        let settings = settings.transpose();
        let capture = Capture {
            image: Arc::clone(heightmap),
            coverage: *coverage,
            append: request.append,
            module: request.module.clone(),
            settings: settings.map_err(|error| format!("settings.{error}"))?,
        };
        let captured = self.tracker.capture(capture);
        let (step, change) = captured.map_err(|error| error.to_string())?;
        Ok((stamp, step, change))
    }

    fn set_step(&mut self, request: &SetStepRequest) -> (SetStepResponse, Change) {
        match self.tracker.set_step(request.step) {
            Ok(change) => {
                let answer = step_response(&self.tracker, true, String::new());
                (answer, change)
            }
            Err(none) => (refused_step(&self.tracker, none.to_string()), Change::None),
        }
    }
}

fn refused_load(message: String) -> LoadDemonstrationResponse {
    warn!("load_demonstration: {message}");
    LoadDemonstrationResponse {
        message,
        ..Default::default()
    }
}

fn refused_capture(tracker: &GoalTracker, message: String) -> CaptureGoalResponse {
    warn!("capture_goal: {message}");
    let (_, step_count, _) = tracker.progress();
    CaptureGoalResponse {
        message,
        step_count,
        ..Default::default()
    }
}

fn refused_step(tracker: &GoalTracker, message: String) -> SetStepResponse {
    warn!("set_step: {message}");
    step_response(tracker, false, message)
}

fn step_response(tracker: &GoalTracker, success: bool, message: String) -> SetStepResponse {
    let (step, step_count, attempt) = tracker.progress();
    SetStepResponse {
        success,
        message,
        step,
        step_count,
        attempt,
    }
}
