//! Node that holds the demonstration sequence and latches the next-step goal.
//!
//! Which goal is next is decided in [`Oracle`], which knows no ROS node.

mod oracle;
mod parameters;

use std::time::Duration;

use anyhow::Context as _;
use bags::Demonstration;
use gctn::{Embedded, Embedding};
use heightmap::Workspace;
use msgs::{
    convert,
    sctn_msgs::{Goal, Heightmap, PickPlace, StepConfirmation, StepResult},
    std_msgs::Header,
};
use node_kit::{Active, Level, Node, Publisher, Qos};
use tracing::{info, warn};

pub use oracle::{Change, Decider, Oracle, Refusal, SequenceError, sequence};
pub use parameters::{GoalModule, GoalOracleParameters};

/// How long the first goal waits for policy and executor, so that none of their first words is lost.
const PEERS: Duration = Duration::from_secs(5);

/// Reads the demonstration; what it returns walks through its goals.
pub async fn configure(node: Node, parameters: GoalOracleParameters) -> anyhow::Result<OracleNode> {
    let path = parameters.demonstration()?.to_owned();
    let demonstration = Demonstration::read(&path).context("parameter demonstration")?;
    let goals = sequence(&demonstration, &parameters.world_frame)
        .with_context(|| format!("parameter demonstration: {}", path.display()))?;
    let decider = match (parameters.goal_module, parameters.require_confirmation) {
        (GoalModule::ImageDistance | GoalModule::Embedding, _) => Decider::Image,
        (GoalModule::Oracle, true) => Decider::Operator,
        (GoalModule::Oracle, false) => Decider::Outcome,
    };
    let images = || {
        std::iter::once(demonstration.observation(0))
            .chain(demonstration.goals())
            .cloned()
            .collect()
    };
    let known = match parameters.goal_module {
        GoalModule::Oracle => None,
        GoalModule::ImageDistance => Some(Known::Images(images())),
        GoalModule::Embedding => {
            let embedding = Embedding::load(&parameters.embedding);
            let known = embedding.and_then(|embedding| Known::embedded(embedding, images()));
            Some(known.context("parameter embedding")?)
        }
    };

    Ok(OracleNode {
        goal: node.publisher("goal", Qos::Latched)?,
        refusals: node.publisher("step_result", Qos::Event)?,
        oracle: Oracle::new(goals, decider),
        matching: known.map(|known| Matching {
            workspace: demonstration.observation(0).workspace,
            known,
        }),
        parameters,
    })
}

/// The configured node. While it is inactive the run stays where it is.
pub struct OracleNode {
    parameters: GoalOracleParameters,
    oracle: Oracle,
    /// With a goal module that looks at the images.
    matching: Option<Matching>,
    goal: Publisher<Goal>,
    refusals: Publisher<StepResult>,
}

impl Active for OracleNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let mut proposals = node.subscription::<PickPlace>("pick_place", Qos::Latched)?;
        let mut results = node.subscription::<StepResult>("step_result", Qos::Event)?;
        let mut confirmations =
            node.subscription::<StepConfirmation>("step_confirmation", Qos::Event)?;
        let mut matcher = match &mut self.matching {
            Some(matching) => Some(Matcher {
                heightmaps: node.subscription::<Heightmap>("heightmap", Qos::Latched)?,
                matching,
                newest: None,
            }),
            None => None,
        };
        let oracle = &mut self.oracle;

        for topic in [proposals.topic(), results.topic()] {
            if !node.graph().wait_for_publisher(topic, PEERS).await {
                info!("nobody publishes {topic} yet; the first goal is latched all the same");
            }
        }
        latch(node, &self.goal, oracle);
        loop {
            let change = tokio::select! {
                proposal = proposals.recv() => {
                    oracle.proposed(&proposal);
                    Change::None
                }
                result = results.recv() => oracle.result(&result),
                () = observed(&mut matcher) => Change::None,
                confirmation = confirmations.recv() => {
                    oracle.confirmed(&confirmation).unwrap_or_else(|refusal| {
                        warn!("confirmation refused: {refusal}");
                        confirmations.reject(format_args!("refused: {refusal}"));
                        self.refusals.publish(refused(node, &self.parameters, &confirmation, &refusal));
                        Change::None
                    })
                }
            };
            let change = match (change, &mut matcher) {
                (Change::None, Some(matcher)) => matcher.decide(oracle),
                (change, _) => change,
            };
            match change {
                Change::None => {}
                Change::Goal(_) => latch(node, &self.goal, oracle),
                Change::Stopped => {
                    info!("stopped by the operator");
                    report(node, oracle);
                }
            }
        }
    }
}

/// What a goal module that looks at the images knows.
struct Matching {
    /// Of the demonstration.
    workspace: Workspace,
    known: Known,
}

/// The goal modules that look at the images.
struct Matcher<'a> {
    heightmaps: node_kit::Subscription<Heightmap>,
    matching: &'a mut Matching,
    /// With its stamp.
    newest: Option<(Duration, heightmap::Heightmap)>,
}

/// What is compared with: what was seen before the first step, then each goal.
enum Known {
    Images(Vec<heightmap::Heightmap>),
    Embedded(Box<Embedding>, Vec<Embedded>),
}

impl Known {
    fn embedded(
        embedding: Embedding,
        images: Vec<heightmap::Heightmap>,
    ) -> Result<Self, gctn::Error> {
        let embedded = images.iter().map(|image| embedding.embed(image));
        let embedded = embedded.collect::<Result<_, _>>()?;
        Ok(Self::Embedded(Box::new(embedding), embedded))
    }

    /// How many goals are reached, as far as can be seen.
    fn reached(&self, seen: &heightmap::Heightmap) -> Result<Option<usize>, gctn::Error> {
        match self {
            Self::Images(images) => Ok(seen.nearest(images)),
            Self::Embedded(embedding, images) => {
                Ok(Embedding::nearest(&embedding.embed(seen)?, images))
            }
        }
    }
}

impl Matcher<'_> {
    /// Decides by the newest heightmap, if it was seen after the motion that waits for one.
    fn decide(&mut self, oracle: &mut Oracle) -> Change {
        let moved = oracle.waits_for_image();
        let moved = moved.and_then(|stamp| convert::time_from_msg(&stamp).ok());
        let seen = self
            .newest
            .take_if(|(seen, _)| moved.is_some_and(|moved| *seen >= moved));
        let Some((_, heightmap)) = seen else {
            return Change::None;
        };
        match self.matching.known.reached(&heightmap) {
            Ok(Some(reached)) => oracle.matched(reached),
            Ok(None) => Change::None,
            Err(error) => {
                self.heightmaps.reject(error);
                Change::None
            }
        }
    }
}

/// Waits for a heightmap; for ever where none is asked for.
async fn observed(matcher: &mut Option<Matcher<'_>>) {
    let Some(matcher) = matcher else {
        return std::future::pending().await;
    };
    let message = matcher.heightmaps.recv().await;
    let read = convert::time_from_msg(&message.header.stamp)
        .and_then(|stamp| Ok((stamp, convert::heightmap_from_msg(message)?)));
    match read {
        // One of another table would be infinitely far from all images alike.
        Ok((_, heightmap)) if heightmap.workspace != matcher.matching.workspace => {
            matcher.heightmaps.reject(format_args!(
                "workspace is {:?}, expected that of the demonstration, {:?}",
                heightmap.workspace, matcher.matching.workspace
            ));
        }
        Ok(read) => matcher.newest = Some(read),
        Err(error) => matcher.heightmaps.reject(error),
    }
}

fn latch(node: &Node, goal: &Publisher<Goal>, oracle: &Oracle) {
    goal.publish(oracle.goal());
    let (step, count, attempt) = oracle.progress();
    if oracle.is_complete() {
        info!("all {count} steps are done");
    } else {
        info!("goal: step {step} of {count}, attempt {attempt}");
    }
    report(node, oracle);
}

fn report(node: &Node, oracle: &Oracle) {
    let (step, count, attempt) = oracle.progress();
    let message = if oracle.is_stopped() {
        format!("stopped at step {step} of {count}")
    } else if oracle.is_complete() {
        format!("all {count} steps are done")
    } else {
        format!("step {step} of {count}, attempt {attempt}")
    };
    node.diagnostics().set("goal", Level::Ok, message, []);
}

/// The operator's tools see a refusal where they see the executor's.
fn refused(
    node: &Node,
    parameters: &GoalOracleParameters,
    confirmation: &StepConfirmation,
    refusal: &Refusal,
) -> StepResult {
    StepResult {
        header: Header {
            stamp: node.now(),
            frame_id: parameters.world_frame.clone(),
        },
        proposal_id: confirmation.proposal_id,
        outcome: StepResult::REFUSED,
        reason: refusal.to_string(),
        ..StepResult::default()
    }
}
