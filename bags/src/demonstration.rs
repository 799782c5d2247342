//! Demonstrations as bags.

use crate::{BagError, BagReader, BagWriter, Compression, Qos, RawMessage};
use heightmap::Heightmap;
use msgs::convert::{self, ConvertError};
use msgs::sctn_msgs;
use pick_place::{Outcome, PickPlace, PrimitiveSettings};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use step_protocol::{GoalSequence, NoGoals, ShownStep, goal_steps, goals_of};

/// One step: observation, action and result.
#[derive(Clone, Debug, PartialEq)]
pub struct DemonstrationStep {
    /// The workspace before the action.
    pub observation: Heightmap,
    /// The action.
    pub action: PickPlace,
    /// Heights and speeds of the action.
    pub settings: PrimitiveSettings,
    /// Task module that the action belongs to.
    pub module: String,
    /// Change of the reward by the action.
    pub delta_reward: f64,
    /// How the action ended.
    pub outcome: Outcome,
}

/// A sequence of steps that solves a problem.
#[derive(Clone, Debug, PartialEq)]
pub struct Demonstration {
    /// Name of the problem.
    pub problem: String,
    /// Seed of the scene: fixtures, objects and goal.
    pub seed: u64,
    /// Seed of the start: where the loose objects lay. That of the scene for the scene's own start.
    pub start_seed: u64,
    /// The steps.
    pub steps: Vec<DemonstrationStep>,
    /// The workspace after the last step.
    pub last: Heightmap,
}

/// A bag that holds no demonstration.
#[derive(Debug, thiserror::Error)]
pub enum DemonstrationError {
    /// The bag cannot be written or read.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// A note of the bag is missing or no value.
    #[error("{}: no demonstration: custom_data.{key} is {actual:?}, expected {expected}", path.display())]
    Note {
        /// The bag.
        path: PathBuf,
        /// The note.
        key: &'static str,
        /// What it says.
        actual: Option<String>,
        /// What would do.
        expected: &'static str,
    },
    /// A message cannot be converted.
    #[error("{}: topic {topic}, step {step}: {source}", path.display())]
    Message {
        /// The bag.
        path: PathBuf,
        /// The topic.
        topic: &'static str,
        /// Number of the step, from 1.
        step: usize,
        /// What is wrong.
        source: ConvertError,
    },
    /// A recorded run needs one topic of each of its types.
    #[error("{}: topics of type {type_name}: {found}, expected one with messages", path.display())]
    Topics {
        /// The bag.
        path: PathBuf,
        /// The type.
        type_name: &'static str,
        /// Their names.
        found: String,
    },
    /// A recorded run of which nothing can be learned.
    #[error("{}: none of the run's {proposals} proposals was placed, confirmed by the operator and observed", path.display())]
    NoSteps {
        /// The bag.
        path: PathBuf,
        /// Proposals in it.
        proposals: usize,
    },
    /// Messages are missing or out of order.
    #[error("{}: step {step}: {actual}, expected {expected}", path.display())]
    Order {
        /// The bag.
        path: PathBuf,
        /// Number of the step, from 1.
        step: usize,
        /// What came.
        actual: String,
        /// What should have come.
        expected: &'static str,
    },
}

pub(crate) const HEIGHTMAP: &str = "/heightmap";
const GOAL: &str = "/goal";
pub(crate) const PICK_PLACE: &str = "/pick_place";
const STEP_RESULT: &str = "/step_result";
const REWARD: &str = "/reward";
const FRAME: &str = "world";

/// Demonstrations have no clock: the observation before step `index` is `index` seconds old.
fn time(index: usize) -> Duration {
    Duration::from_secs(index as u64)
}

/// Within the second of a step: when the action was decided and when it was over.
const DECIDED: Duration = Duration::from_millis(250);
const OVER: Duration = Duration::from_millis(750);

impl Demonstration {
    /// The images that a policy is to reach, in order (v1 to vD in the paper): see [`step_protocol::goal_steps`].
    pub fn goals(&self) -> Vec<&Heightmap> {
        let reached = self.goal_steps().into_iter();
        reached.map(|index| self.observation(index + 1)).collect()
    }

    /// For people: problem, seed of the scene, and that of the start where it is not the scene's own.
    pub fn name(&self) -> String {
        let mut name = format!("{}/{}", self.problem, self.seed);
        if self.start_seed != self.seed {
            name += &format!("/{}", self.start_seed);
        }
        name
    }

    /// Indices of the steps after which an image is a goal: see [`step_protocol::goal_steps`].
    pub fn goal_steps(&self) -> Vec<usize> {
        goal_steps(self.steps.iter().map(|step| step.delta_reward))
    }

    /// The goals for a goal tracker; images are moved, not copied.
    ///
    /// # Errors
    /// No step earned a reward.
    pub fn into_goals(self) -> Result<GoalSequence, NoGoals> {
        let name = self.name();
        let mut after = Arc::new(self.last);
        let mut steps = Vec::with_capacity(self.steps.len());
        for step in self.steps.into_iter().rev() {
            let before = Arc::new(step.observation);
            steps.push(ShownStep {
                delta_reward: step.delta_reward,
                module: step.module,
                settings: step.settings,
                after: std::mem::replace(&mut after, before),
            });
        }
        steps.reverse();
        goals_of(&self.problem, &name, after, &steps)
    }

    /// The workspace before step `index`, from 0; after the last step for any larger one.
    pub fn observation(&self, index: usize) -> &Heightmap {
        self.steps
            .get(index)
            .map_or(&self.last, |step| &step.observation)
    }

    /// Writes the bag. What an earlier try has left half-written is replaced, a whole bag is not.
    pub fn write(&self, path: &Path) -> Result<(), DemonstrationError> {
        self.write_with(path, Compression::default())
    }

    /// [`Self::write`] with another compression.
    pub fn write_with(
        &self,
        path: &Path,
        compression: Compression,
    ) -> Result<(), DemonstrationError> {
        BagWriter::discard_partial(path)?;
        let mut bag = BagWriter::create(path, compression)?;
        bag.note("problem", &self.problem);
        bag.note("seed", self.seed);
        bag.note("start_seed", self.start_seed);
        let heightmaps = bag.add::<sctn_msgs::Heightmap>(HEIGHTMAP, Qos::LATCHED)?;
        let goals = bag.add::<sctn_msgs::Goal>(GOAL, Qos::LATCHED)?;
        let actions = bag.add::<sctn_msgs::PickPlace>(PICK_PLACE, Qos::RELIABLE)?;
        let results = bag.add::<sctn_msgs::StepResult>(STEP_RESULT, Qos::RELIABLE)?;
        let rewards = bag.add::<sctn_msgs::Reward>(REWARD, Qos::RELIABLE)?;
        let error = |topic, index| {
            move |source| DemonstrationError::Message {
                path: path.to_owned(),
                topic,
                step: index + 1,
                source,
            }
        };
        let heightmap = |index: usize| {
            let header = convert::header(time(index), FRAME)?;
            // How many views were fused is not part of a demonstration.
            convert::heightmap_to_msg(self.observation(index).clone(), header, 0, 0.0)
        };
        let goal_steps = self.goal_steps();
        let mut total = 0.0;
        for (index, step) in self.steps.iter().enumerate() {
            bag.write(
                heightmaps,
                time(index),
                &heightmap(index).map_err(error(HEIGHTMAP, index))?,
            )?;
            let header = convert::header(time(index), FRAME).map_err(error(PICK_PLACE, index))?;
            let settings = convert::settings_to_msg(&step.settings);
            let number = index as u32 + 1;
            let reached = goal_steps.partition_point(|goal_step| *goal_step < index);
            if let Some(goal_step) = goal_steps.get(reached) {
                let before = reached
                    .checked_sub(1)
                    .map_or(0, |last| goal_steps[last] + 1);
                let message = sctn_msgs::Goal {
                    header: header.clone(),
                    problem: self.problem.clone(),
                    demonstration: self.name(),
                    step: reached as u32 + 1,
                    step_count: goal_steps.len() as u32,
                    module: step.module.clone(),
                    settings,
                    heightmap: heightmap(goal_step + 1).map_err(error(GOAL, index))?,
                    previous: heightmap(before).map_err(error(GOAL, index))?,
                    ..Default::default()
                };
                bag.write(goals, time(index), &message)?;
            }
            let action = sctn_msgs::PickPlace {
                header,
                id: u64::from(number),
                problem: self.problem.clone(),
                step: number,
                pick: convert::pose2d_to_msg(&step.action.pick),
                place: convert::pose2d_to_msg(&step.action.place),
                pick_score: 1.0,
                place_score: 1.0,
                settings,
                module: step.module.clone(),
                ..Default::default()
            };
            bag.write(actions, time(index) + DECIDED, &action)?;
            let over = time(index) + OVER;
            let header = convert::header(over, FRAME).map_err(error(STEP_RESULT, index))?;
            let result = sctn_msgs::StepResult {
                header: header.clone(),
                proposal_id: u64::from(number),
                outcome: convert::outcome_to_msg(step.outcome),
                ..Default::default()
            };
            bag.write(results, over, &result)?;
            total += step.delta_reward;
            let complete = goal_steps.last() == Some(&index);
            bag.write(
                rewards,
                over,
                &sctn_msgs::Reward {
                    header,
                    delta: step.delta_reward,
                    total,
                    complete,
                },
            )?;
        }
        let count = self.steps.len();
        bag.write(
            heightmaps,
            time(count),
            &heightmap(count).map_err(error(HEIGHTMAP, count))?,
        )?;
        Ok(bag.finish()?)
    }

    /// Reads a bag that [`Self::write`] wrote, or that of a recorded run: see [`Self::read_run`].
    pub fn read(path: &Path) -> Result<Self, DemonstrationError> {
        if let Some((demonstration, _)) = Self::read_run(path)? {
            return Ok(demonstration);
        }
        let bag = BagReader::open(path)?;
        let note = |key: &'static str| bag.notes().get(key).cloned();
        let bad = |key, expected| DemonstrationError::Note {
            path: path.to_owned(),
            key,
            actual: note(key),
            expected,
        };
        let problem = note("problem").ok_or_else(|| bad("problem", "the name of a problem"))?;
        let seed = note("seed")
            .and_then(|seed| seed.parse().ok())
            .ok_or_else(|| bad("seed", "a seed"))?;
        // Bags of before there were other starts have no such note.
        let start_seed = match note("start_seed") {
            None => seed,
            Some(start) => start.parse().map_err(|_| bad("start_seed", "a seed"))?,
        };

        let mut messages = Steps {
            path,
            messages: bag.messages(),
            step: 1,
        };
        let mut steps = Vec::new();
        let mut observation = messages
            .heightmap()?
            .ok_or_else(|| messages.order("the end".into(), HEIGHTMAP))?;
        while let Some(action) = messages.next::<sctn_msgs::PickPlace>(PICK_PLACE)? {
            let settings =
                messages.convert(PICK_PLACE, convert::settings_from_msg(&action.settings))?;
            let poses = messages.convert(PICK_PLACE, convert::pick_place_from_msg(&action))?;
            let result: sctn_msgs::StepResult = messages.expect(STEP_RESULT)?;
            let outcome =
                messages.convert(STEP_RESULT, convert::outcome_from_msg(result.outcome))?;
            let reward: sctn_msgs::Reward = messages.expect(REWARD)?;
            let next = messages
                .heightmap()?
                .ok_or_else(|| messages.order("the end".into(), HEIGHTMAP))?;
            if !reward.delta.is_finite() {
                return Err(messages.order(
                    format!("a delta reward of {}", reward.delta),
                    "a finite one",
                ));
            }
            steps.push(DemonstrationStep {
                observation: std::mem::replace(&mut observation, next),
                action: poses,
                settings,
                module: action.module,
                delta_reward: reward.delta,
                outcome,
            });
            messages.step += 1;
        }
        Ok(Self {
            problem,
            seed,
            start_seed,
            steps,
            last: observation,
        })
    }
}

/// The messages of a demonstration in their order.
struct Steps<'a> {
    path: &'a Path,
    messages: crate::Messages<'a>,
    step: usize,
}

impl Steps<'_> {
    fn order(&self, actual: String, expected: &'static str) -> DemonstrationError {
        DemonstrationError::Order {
            path: self.path.to_owned(),
            step: self.step,
            actual,
            expected,
        }
    }

    fn convert<T>(
        &self,
        topic: &'static str,
        result: Result<T, ConvertError>,
    ) -> Result<T, DemonstrationError> {
        let (path, step) = (self.path.to_owned(), self.step);
        result.map_err(|source| DemonstrationError::Message {
            path,
            topic,
            step,
            source,
        })
    }

    /// The next message, which must be of this topic; none at the end. Goals follow from the rest.
    fn next<T: msgs::Interface>(
        &mut self,
        topic: &'static str,
    ) -> Result<Option<T>, DemonstrationError> {
        let other = |message: &Result<RawMessage, BagError>| !matches!(message, Ok(message) if message.topic.name == GOAL);
        let Some(message) = self.messages.find(other).transpose()? else {
            return Ok(None);
        };
        if message.topic.name != topic {
            return Err(self.order(format!("a message on {}", message.topic.name), topic));
        }
        Ok(Some(message.decode()?))
    }

    fn expect<T: msgs::Interface>(&mut self, topic: &'static str) -> Result<T, DemonstrationError> {
        self.next(topic)?
            .ok_or_else(|| self.order("the end".into(), topic))
    }

    fn heightmap(&mut self) -> Result<Option<Heightmap>, DemonstrationError> {
        let message = self.next::<sctn_msgs::Heightmap>(HEIGHTMAP)?;
        message
            .map(|message| self.convert(HEIGHTMAP, convert::heightmap_from_msg(message)))
            .transpose()
    }
}
