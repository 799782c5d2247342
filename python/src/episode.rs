//! One episode: an environment, the demonstration whose images are its goals, and what a step shows.

use heightmap::{Heightmap, Workspace};
use multiravens::{Environment, EnvironmentError, EpisodeSeed, Problem, StepReport};
use pick_place::{Outcome, PickPlace};
use std::sync::Arc;
use ur5::WorkCell;

/// Which image of the demonstration is the goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GoalKind {
    /// None: no demonstration is made.
    None,
    /// v_k, the next one to be reached, and v_{k-1} before it.
    Next,
    /// v_D, the last one.
    Final,
}

/// What an episode shows.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    pub goal: GoalKind,
    /// The demonstration begins from another start of the scene.
    pub other_start: bool,
    /// Camera images are part of the observation.
    pub cameras: bool,
    /// The demonstrator says before each step what it would do.
    pub demonstrator: bool,
}

/// Why an episode could not go on. Nothing has moved.
#[derive(Debug, thiserror::Error)]
pub enum EpisodeError {
    #[error(transparent)]
    Environment(#[from] Box<EnvironmentError>),
    #[error(
        "seed {tried:?}: the demonstrator does not complete the scene, so that there are no goals: expected another seed"
    )]
    NoDemonstration { tried: Vec<u64> },
    #[error("the episode has not begun: expected a reset first")]
    NotBegun,
}

impl From<EnvironmentError> for EpisodeError {
    fn from(error: EnvironmentError) -> Self {
        Self::Environment(Box::new(error))
    }
}

/// What a camera shows.
pub struct CameraImage {
    pub name: String,
    pub rows: usize,
    pub cols: usize,
    pub rgb: Vec<u8>,
    pub depth_m: Vec<f32>,
}

/// What there is to know after a reset or a step.
pub struct Frame {
    pub observation: Heightmap,
    pub goal: Option<Arc<Heightmap>>,
    pub previous_goal: Option<Arc<Heightmap>>,
    pub cameras: Vec<CameraImage>,
    pub reward: f64,
    pub terminated: bool,
    pub truncated: bool,
    pub seed: EpisodeSeed,
    pub step: usize,
    pub module: Option<&'static str>,
    pub total_reward: f64,
    pub goals_reached: Vec<usize>,
    pub outcome: Option<Outcome>,
    pub demonstrator_action: Option<[f64; 6]>,
}

/// An outcome in words.
pub fn outcome_name(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Placed => "placed",
        Outcome::NoContact => "no_contact",
        Outcome::GraspFailed => "grasp_failed",
        Outcome::Dropped => "dropped",
        Outcome::LagAborted => "lag_aborted",
    }
}

/// An environment with its goals.
pub struct Episode {
    environment: Environment,
    options: Options,
    begun: bool,
    /// v_0 to v_D of the shown demonstration.
    images: Vec<Arc<Heightmap>>,
    /// Images of the sequence that have been reached: the next goal is the one after them.
    reached: usize,
    /// What the demonstrator said last: an action of the same numbers is this one, to the last bit.
    said: Option<PickPlace>,
}

impl Episode {
    pub fn new(problem: &Problem, work_cell: &WorkCell, options: Options) -> Self {
        Self {
            environment: Environment::new(problem, work_cell),
            options,
            begun: false,
            images: Vec::new(),
            reached: 0,
            said: None,
        }
    }

    /// Begins the episode of the first of these seeds whose scene the demonstrator completes.
    pub fn reset(&mut self, seeds: &[EpisodeSeed]) -> Result<Frame, EpisodeError> {
        self.begun = false;
        for &seed in seeds {
            if self.options.goal != GoalKind::None && !self.make_goals(seed)? {
                continue;
            }
            self.environment.reset(seed)?;
            self.reached = 0;
            self.begun = true;
            return self.frame(None);
        }
        Err(EpisodeError::NoDemonstration {
            tried: seeds.iter().map(|seed| seed.scene).collect(),
        })
    }

    /// Refuses what [`Self::step`] would refuse.
    pub fn check(&self, action: &[f64; 6]) -> Result<(), EpisodeError> {
        if !self.begun {
            return Err(EpisodeError::NotBegun);
        }
        if self.environment.is_done() {
            return Err(EnvironmentError::Over.into());
        }
        let workspace = Workspace::RAVENS;
        let action = PickPlace::from_array(*action);
        for (which, pose) in [("pick", action.pick), ("place", action.place)] {
            let inside = workspace.pixel(&pose.translation.vector.into()).is_some();
            if !(inside && pose.rotation.angle().is_finite()) {
                return Err(EnvironmentError::Action {
                    which,
                    pose,
                    workspace,
                }
                .into());
            }
        }
        Ok(())
    }

    /// Carries out an action.
    pub fn step(&mut self, given: &[f64; 6]) -> Result<Frame, EpisodeError> {
        self.check(given)?;
        let same = |said: &PickPlace| said.to_array().map(f64::to_bits) == given.map(f64::to_bits);
        let action = self
            .said
            .filter(same)
            .unwrap_or_else(|| PickPlace::from_array(*given));
        let report = self.environment.step(&action)?;
        // As the operator of the paper does: a gain is the next image, a loss the one before.
        if report.delta_reward > 0.0 {
            self.reached = (self.reached + 1).min(self.images.len().saturating_sub(1));
        } else if report.delta_reward < 0.0 {
            self.reached = self.reached.saturating_sub(1);
        }
        self.frame(Some(&report))
    }

    /// What the first camera saw when the last observation was made: rows, columns, colours.
    pub fn picture(&self) -> Result<(usize, usize, Vec<u8>), EpisodeError> {
        let view = self.environment.cell().views().next();
        let view = view.filter(|_| self.begun).ok_or(EpisodeError::NotBegun)?;
        let intrinsics = view.camera.intrinsics;
        Ok((intrinsics.height, intrinsics.width, view.rgb.to_vec()))
    }

    fn make_goals(&mut self, seed: EpisodeSeed) -> Result<bool, EpisodeError> {
        let shown = match self.options.other_start {
            false => seed,
            true => EpisodeSeed {
                scene: seed.scene,
                start: seed.start + 1,
            },
        };
        let demonstration = crate::demonstration::record(&mut self.environment, shown)?;
        let images = std::iter::once(demonstration.observation(0)).chain(demonstration.goals());
        self.images = images.cloned().map(Arc::new).collect();
        Ok(self.environment.is_complete() && self.images.len() > 1)
    }

    fn frame(&mut self, report: Option<&StepReport>) -> Result<Frame, EpisodeError> {
        let environment = &mut self.environment;
        let observation = environment.observe()?.clone();
        let cameras = match self.options.cameras {
            true => camera_images(environment),
            false => Vec::new(),
        };
        let done = environment.is_done();
        let terminated = environment.is_complete();
        self.said = match self.options.demonstrator && !done {
            true => environment.demonstrate(),
            false => None,
        };
        let last = self.images.len().saturating_sub(1);
        let next = (self.reached + 1).min(last);
        let image = |index: usize| self.images.get(index).cloned();
        let (goal, previous_goal) = match self.options.goal {
            GoalKind::None => (None, None),
            GoalKind::Next => (image(next), image(next.saturating_sub(1))),
            GoalKind::Final => (image(last), None),
        };
        Ok(Frame {
            observation,
            goal,
            previous_goal,
            cameras,
            reward: report.map_or(0.0, |report| report.delta_reward),
            terminated,
            truncated: done && !terminated,
            seed: environment.seed(),
            step: environment.steps(),
            module: environment.module(),
            total_reward: environment.total_reward(),
            goals_reached: environment.goals_reached(),
            outcome: report.map(|report| report.outcome),
            demonstrator_action: self.said.as_ref().map(PickPlace::to_array),
        })
    }
}

fn camera_images(environment: &Environment) -> Vec<CameraImage> {
    let views = environment.cell().views();
    views
        .map(|view| CameraImage {
            name: view.camera.name.clone(),
            rows: view.camera.intrinsics.height,
            cols: view.camera.intrinsics.width,
            rgb: view.rgb.to_vec(),
            depth_m: view.depth_m.to_vec(),
        })
        .collect()
}
