//! Problems as episodes: reset, observe, step.

use crate::cell::{Cell, CellError, Rehearsal, Watched};
use crate::problem::Problem;
use crate::render::{LIGHT, RenderError, RgbdImage};
use crate::seed::{Draws, EpisodeSeed, stream};
use crate::tasks::{Care, Demonstrator, Move, ParameterError, Task};
use camera_noise::{ClutterItem, DepthSteps, Perturbation, Rig};
use heightmap::{
    Camera, Fusion, FusionError, Heightmap, StillFusion, StillSettings, View, Workspace,
};
use nalgebra::{Isometry2, UnitComplex, Vector2, Vector3};
use pick_place::{ExecuteError, Outcome, PickPlace, PrimitiveSettings};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::time::Duration;
use ur5::WorkCell;

/// Stream of the seed's random numbers that the demonstrator draws from; the modules use 0, 1, ...
const DEMONSTRATOR_STREAM: u64 = 1 << 32;
/// Stream that disturbances are drawn from.
const DISTURBANCE_STREAM: u64 = 1 << 35;
/// A disturbed action grips at most so far beside what was meant along x and y, ...
const GRIP_BESIDE_M: f64 = 0.03;
/// ... or sets down so far beside it, ...
const SET_DOWN_BESIDE_M: f64 = 0.05;
/// ... turned by at most this against it.
const SET_DOWN_TURNED_RAD: f64 = 0.6;

/// A problem in a simulated work cell.
///
/// An [`EpisodeSeed`] gives the same scene and start, and the same actions the same states, bit for bit.
/// The demonstrator draws from its own stream of random numbers.
pub struct Environment {
    problem: Problem,
    cell: Cell,
    tasks: Vec<Progress>,
    demonstrator: Demonstrator,
    disturber: ChaCha8Rng,
    /// What the demonstrator's last action does in the present state, if it has rehearsed it.
    cached_rehearsal: Option<(PickPlace, Rehearsal)>,
    /// The order in which the demonstrator has to reach the goals, if one was set.
    order: Vec<usize>,
    seed: EpisodeSeed,
    steps: usize,
    fusion: Fusion,
    heightmap: Heightmap,
    perturbed: Option<Perturbed>,
}

/// What the cameras do to the images of this environment.
struct Perturbed {
    model: Perturbation,
    session: u64,
    rig: Rig,
    /// Images taken in this session by each camera.
    frame: u64,
    fusion: StillFusion,
}

impl Perturbed {
    /// Where the depths of clean views have steps.
    fn depth_steps(&self, views: &[View<'_>]) -> Vec<DepthSteps> {
        let steps = |view: &View<'_>| {
            let intrinsics = &view.camera.intrinsics;
            self.rig.depth_steps(intrinsics, view.depth_m)
        };
        views.iter().map(steps).collect()
    }

    /// The images that the cameras take of clean views, each with the camera as the fusion believes it to stand.
    fn take(&mut self, views: &[View<'_>], steps: &[DepthSteps]) -> Vec<(Camera, RgbdImage)> {
        let mut images = Vec::new();
        for (index, (view, steps)) in views.iter().zip(steps).enumerate() {
            if self.rig.is_missing(index) {
                continue;
            }
            let mut image = RgbdImage {
                rgb: view.rgb.to_vec(),
                depth_m: view.depth_m.to_vec(),
            };
            let intrinsics = &view.camera.intrinsics;
            self.rig.apply_with_steps(
                index,
                intrinsics,
                self.frame,
                steps,
                &mut image.rgb,
                &mut image.depth_m,
            );
            images.push((self.rig.believed(index, view.camera), image));
        }
        self.frame += 1;
        images
    }
}

struct Progress {
    name: &'static str,
    task: Box<dyn Task>,
    /// Goals reached, by their index in the task, ascending.
    reached: Vec<usize>,
}

impl Progress {
    fn is_complete(&self) -> bool {
        self.reached.len() == self.task.goal_count()
    }
}

/// Rewards after a step, from the true state of the bodies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Assessment {
    /// Change of the total reward by this step; negative where a goal was lost again.
    pub delta_reward: f64,
    /// Reward of the present state: the mean over the modules of the share of goals reached.
    pub total_reward: f64,
    /// Whether every goal of every module is reached.
    pub complete: bool,
    /// Whether the episode is over: complete, or out of steps.
    pub done: bool,
}

/// What a step has done.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepReport {
    /// How the primitive ended.
    pub outcome: Outcome,
    /// Change of the total reward by this step; negative where a goal was lost again.
    pub delta_reward: f64,
    /// Reward of the present state.
    pub total_reward: f64,
    /// Whether every goal of every module is reached.
    pub complete: bool,
    /// Whether the episode is over: complete, or out of steps.
    pub done: bool,
    /// The module that was being solved, whose primitive settings were used.
    pub module: &'static str,
    /// Whether all bodies came to rest.
    pub settled: bool,
    /// Simulated time since the reset.
    pub time: Duration,
}

/// Why an environment could not do what it was told. Nothing has moved after `Action` and `Over`.
#[derive(Debug, thiserror::Error)]
pub enum EnvironmentError {
    /// An action that is not finite or not over the workspace.
    #[error("{which} pose x {x_m} m, y {y_m} m, yaw {yaw_rad} rad: expected finite and in x {x0}..{x1}, y {y0}..{y1}",
        x_m = pose.translation.x, y_m = pose.translation.y, yaw_rad = pose.rotation.angle(),
        x0 = workspace.origin_m.x, x1 = workspace.origin_m.x + workspace.cols as f64 * workspace.pixel_size_m,
        y0 = workspace.origin_m.y, y1 = workspace.origin_m.y + workspace.rows as f64 * workspace.pixel_size_m)]
    Action {
        /// `pick` or `place`.
        which: &'static str,
        /// The pose.
        pose: Isometry2<f64>,
        /// Where it should be.
        workspace: Workspace,
    },
    /// A step after the end of the episode.
    #[error("the episode is over: reset first")]
    Over,
    /// What a seed draws does not fit on the table.
    #[error("problem {problem}, seed {seed}, module {module}: {source}")]
    Build {
        /// Name of the problem.
        problem: String,
        /// The seed.
        seed: EpisodeSeed,
        /// Name of the module.
        module: &'static str,
        /// What does not fit.
        source: ParameterError,
    },
    /// The bodies of a new episode did not come to rest.
    #[error("problem {problem}, seed {seed}: the scene does not come to rest")]
    Restless {
        /// Name of the problem.
        problem: String,
        /// The seed.
        seed: EpisodeSeed,
    },
    /// An order of goals that this episode has not got.
    #[error("order of goals {order:?}: expected each of 0 to {last} at most once", last = goals - 1)]
    Order {
        /// The order.
        order: Vec<usize>,
        /// Number of goals of the episode.
        goals: usize,
    },
    /// The simulated hardware refused.
    #[error(transparent)]
    Cell(#[from] CellError),
    /// The primitive could not start or go on.
    #[error(transparent)]
    Primitive(#[from] ExecuteError<CellError>),
    /// A camera's image could not be rendered.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The images could not be fused.
    #[error(transparent)]
    Fusion(#[from] FusionError),
}

impl Environment {
    /// An environment that has to be [`Self::reset`] before its first step.
    pub fn new(problem: &Problem, work_cell: &WorkCell) -> Self {
        Self {
            problem: problem.clone(),
            cell: Cell::new(work_cell),
            tasks: Vec::new(),
            demonstrator: stream(0, DEMONSTRATOR_STREAM).into(),
            disturber: stream(0, DISTURBANCE_STREAM),
            cached_rehearsal: None,
            order: Vec::new(),
            seed: 0.into(),
            steps: 0,
            fusion: Fusion::default(),
            heightmap: Heightmap::new(Workspace::RAVENS),
            perturbed: None,
        }
    }

    /// Lets the cameras do what the model says, from the next reset on; `None`: they are perfect.
    pub fn set_perturbation(&mut self, model: Option<&Perturbation>) {
        self.perturbed = model.map(|model| Perturbed {
            model: model.clone(),
            session: 0,
            rig: Rig::draw(model, self.cell.cameras(), 0, 0),
            frame: 0,
            fusion: StillFusion::new(StillSettings {
                frames: model.frames,
                ..StillSettings::default()
            }),
        });
        if model.is_none() {
            self.cell.perturb(LIGHT, Vec::new());
        }
    }

    /// Which session of the cameras the next reset begins. The errors of the calibration are drawn from the scene's seed alone, light,
    /// colours, clutter and noise from the session too: a demonstration and its repetition are two sessions.
    pub fn set_session(&mut self, session: u64) {
        if let Some(perturbed) = &mut self.perturbed {
            perturbed.session = session;
        }
    }

    /// What the cameras do in this episode, if they are not perfect.
    pub fn rig(&self) -> Option<&Rig> {
        self.perturbed.as_ref().map(|perturbed| &perturbed.rig)
    }

    /// Draws the rig of this episode; clutter that would stand in a body of the task is left out.
    fn draw_rig(&mut self) {
        let Some(perturbed) = &mut self.perturbed else {
            return;
        };
        let cameras = self.cell.cameras();
        let rig = Rig::draw(
            &perturbed.model,
            cameras,
            self.seed.scene,
            perturbed.session,
        );
        let world = self.cell.world();
        let free = |item: &&ClutterItem| {
            world.bodies().all(|body| {
                let pose = world.pose(body);
                let away = item.pose.translation.vector.xy() - pose.translation.vector.xy();
                // No farther than this does a shape reach along the table, however it is turned.
                let shape = world.shape(body);
                let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
                let reach_m = Vector3::from(axes.map(|axis| shape.extent_m(&axis))).norm();
                away.norm() > 0.5 * item.size_m.norm() + reach_m
            })
        };
        let clutter = rig.clutter().iter().filter(free).copied().collect();
        let light = rig.light(&LIGHT);
        perturbed.rig = rig;
        perturbed.frame = 0;
        self.cell.perturb(light, clutter);
    }

    /// Begins the episode of a seed: a number alone is a scene with its own start.
    pub fn reset(&mut self, seed: impl Into<EpisodeSeed>) -> Result<(), EnvironmentError> {
        let seed = seed.into();
        self.seed = seed;
        self.order.clear();
        self.steps = 0;
        self.tasks.clear();
        self.cell.clear();
        self.cached_rehearsal = None;
        self.demonstrator.rng = stream(seed.start, DEMONSTRATOR_STREAM);
        self.disturber = stream(seed.start, DISTURBANCE_STREAM);
        for (index, placement) in self.problem.modules().iter().enumerate() {
            let mut draws = Draws::new(seed, index as u64);
            let world = self.cell.world_mut();
            let built = placement.module.build(world, &placement.anchor, &mut draws);
            let task = built.map_err(|source| EnvironmentError::Build {
                problem: self.problem.name().to_owned(),
                seed,
                module: placement.name,
                source,
            })?;
            self.tasks.push(Progress {
                name: placement.name,
                task,
                reached: Vec::new(),
            });
        }
        if !self.cell.settle()? {
            let problem = self.problem.name().to_owned();
            return Err(EnvironmentError::Restless { problem, seed });
        }
        for progress in &mut self.tasks {
            progress.reached = progress.task.goals_reached(self.cell.world());
        }
        self.draw_rig();
        Ok(())
    }

    /// What the three cameras see, fused; with a perturbation the median of as many frames as it says.
    pub fn observe(&mut self) -> Result<&Heightmap, EnvironmentError> {
        self.cell.render()?;
        let views: Vec<View<'_>> = self.cell.views().collect();
        let Some(perturbed) = &mut self.perturbed else {
            self.fusion.fuse(&views, &mut self.heightmap)?;
            return Ok(&self.heightmap);
        };
        perturbed.fusion.forget();
        let steps = perturbed.depth_steps(&views);
        for _ in 0..perturbed.model.frames {
            let images = perturbed.take(&views, &steps);
            let taken: Vec<View<'_>> = images.iter().map(|(c, i)| i.view(c)).collect();
            perturbed.fusion.push(&taken, &Workspace::RAVENS)?;
        }
        perturbed.fusion.median(&mut self.heightmap);
        Ok(&self.heightmap)
    }

    /// Tells the demonstrator, for all episodes from now on, how sure to make of what it rehearses.
    pub fn set_care(&mut self, care: Care) {
        self.demonstrator.care = care;
    }

    /// Tells the demonstrator, until the next reset, in which order to reach the goals, numbered as in
    /// [`Self::goals_reached`]. Goals that are not named come last, in any order.
    pub fn follow(&mut self, order: &[usize]) -> Result<(), EnvironmentError> {
        let goals = self.goal_count();
        let once = |(index, goal): (usize, &usize)| *goal < goals && !order[..index].contains(goal);
        if !order.iter().enumerate().all(once) {
            let order = order.to_vec();
            return Err(EnvironmentError::Order { order, goals });
        }
        self.order = order.to_vec();
        Ok(())
    }

    /// The demonstrator's next action; `None` when it knows none.
    pub fn demonstrate(&mut self) -> Option<PickPlace> {
        let index = self.current()?;
        let first = self.first_goal(index);
        let progress = &mut self.tasks[index];
        let goals = first..first + progress.task.goal_count();
        let ordered = self.order.iter().filter(|goal| goals.contains(*goal));
        let mut ordered = ordered.map(|goal| goal - first);
        let next = ordered.find(|goal| !progress.reached.contains(goal));
        let Move { action, rehearsal } =
            progress
                .task
                .demonstrate(&self.cell, &mut self.demonstrator, next)?;
        self.cached_rehearsal = rehearsal.map(|rehearsal| (action, rehearsal));
        Some(action)
    }

    /// With a probability carries out, badly, what the demonstrator means to do next: it grips or sets
    /// down beside, as a policy may miss. That is no step of the episode, and the demonstrator goes on
    /// from what came of it. Says whether it did.
    pub fn disturb(&mut self, probability: f64) -> Result<bool, EnvironmentError> {
        if self.is_complete() || !self.disturber.random_bool(probability.clamp(0.0, 1.0)) {
            return Ok(false);
        }
        let (Some(settings), Some(mut action)) = (self.settings(), self.demonstrate()) else {
            return Ok(false);
        };
        self.cached_rehearsal = None;
        let grips_beside = self.disturber.random_bool(0.5);
        let mut off = || self.disturber.random_range(-1.0..1.0);
        let beside = Vector2::new(off(), off());
        if grips_beside {
            action.pick.translation.vector += beside * GRIP_BESIDE_M;
        } else {
            action.place.translation.vector += beside * SET_DOWN_BESIDE_M;
            action.place.rotation *= UnitComplex::new(off() * SET_DOWN_TURNED_RAD);
        }
        // At the edge of the workspace there is not always a beside.
        if check(&action).is_err() {
            return Ok(false);
        }
        let arm = self.cell.work_cell().arm.clone();
        pick_place::execute(&mut self.cell, &arm, &action, &settings, |_| ())?;
        for progress in &mut self.tasks {
            progress.reached = progress.task.goals_reached(self.cell.world());
        }
        Ok(true)
    }

    /// Carries out what somebody else would do where it reaches no further goal. That is no step of the episode, and the demonstrator goes
    /// on from what came of it. Says whether it was such a mistake: nothing has moved where it was none.
    ///
    /// # Errors
    /// The action is outside the workspace, or cannot be simulated.
    pub fn mistake(&mut self, action: &PickPlace) -> Result<bool, EnvironmentError> {
        check(action)?;
        let Some(settings) = self.settings() else {
            return Ok(false);
        };
        let rehearsal = self.cell.rehearse(action, &settings)?;
        let mut reaches_more = false;
        for progress in &mut self.tasks {
            let goals = progress.task.goals_reached(rehearsal.world());
            reaches_more |= goals.iter().any(|goal| !progress.reached.contains(goal));
        }
        if reaches_more {
            // A task remembers the last world that it was asked about.
            for progress in &mut self.tasks {
                progress.task.goals_reached(self.cell.world());
            }
            return Ok(false);
        }
        self.cached_rehearsal = None;
        self.cell.adopt(rehearsal);
        for progress in &mut self.tasks {
            progress.reached = progress.task.goals_reached(self.cell.world());
        }
        Ok(true)
    }

    /// Carries out an action with the settings of the module being solved, and assesses it. What the
    /// demonstrator has just rehearsed is not simulated again.
    pub fn step(&mut self, action: &PickPlace) -> Result<StepReport, EnvironmentError> {
        match self.cached_rehearsal.take() {
            Some((cached_rehearsal, rehearsal)) if cached_rehearsal == *action => {
                self.step_by(action, |cell, _| Ok(cell.adopt(rehearsal)))
            }
            _ => self.step_watched(action, |_| ()),
        }
    }

    /// [`Self::step`], simulated and looked at after every physics step.
    pub fn step_watched(
        &mut self,
        action: &PickPlace,
        mut watch: impl FnMut(&Cell),
    ) -> Result<StepReport, EnvironmentError> {
        self.cached_rehearsal = None;
        self.step_by(action, |cell, settings| {
            let arm = cell.work_cell().arm.clone();
            let watch = |cell: &mut Cell| {
                watch(cell);
                Ok::<_, CellError>(())
            };
            let mut watched = Watched { cell, watch };
            pick_place::execute(&mut watched, &arm, action, settings, |_| ())
        })
    }

    fn step_by(
        &mut self,
        action: &PickPlace,
        carry_out: impl FnOnce(
            &mut Cell,
            &PrimitiveSettings,
        ) -> Result<Outcome, ExecuteError<CellError>>,
    ) -> Result<StepReport, EnvironmentError> {
        check(action)?;
        let module = self.module();
        let (Some(settings), false) = (self.settings(), self.is_done()) else {
            return Err(EnvironmentError::Over);
        };
        let outcome = carry_out(&mut self.cell, &settings)?;
        let assessment = self.assess();
        Ok(StepReport {
            outcome,
            delta_reward: assessment.delta_reward,
            total_reward: assessment.total_reward,
            complete: assessment.complete,
            done: assessment.done,
            module: module.unwrap_or_default(),
            settled: self.cell.is_settled(),
            time: self.cell.time(),
        })
    }

    /// Ends a step: looks at the settled bodies, once after every action. [`Self::step`] does this;
    /// who drives the cell tick by tick calls it when the arm is back home.
    pub fn assess(&mut self) -> Assessment {
        let before = self.total_reward();
        self.steps += 1;
        for progress in &mut self.tasks {
            progress.reached = progress.task.goals_reached(self.cell.world());
        }
        let total_reward = self.total_reward();
        Assessment {
            delta_reward: total_reward - before,
            total_reward,
            complete: self.is_complete(),
            done: self.is_done(),
        }
    }

    /// Reward of the present state: the mean over the modules with goals of the share of them that is reached.
    pub fn total_reward(&self) -> f64 {
        let wanted = |p: &&Progress| p.task.goal_count() > 0;
        let shares = self.tasks.iter().filter(wanted);
        let shares = shares.map(|p| p.reached.len() as f64 / p.task.goal_count() as f64);
        let modules = self.tasks.iter().filter(wanted).count();
        shares.sum::<f64>() / modules.max(1) as f64
    }

    /// Whether every goal of every module is reached. Without goals, never.
    pub fn is_complete(&self) -> bool {
        self.goal_count() > 0 && self.tasks.iter().all(Progress::is_complete)
    }

    /// Whether the episode is over: complete, or out of steps.
    pub fn is_done(&self) -> bool {
        self.is_complete() || self.steps >= self.max_steps()
    }

    /// Steps taken since the reset.
    pub fn steps(&self) -> usize {
        self.steps
    }

    /// Steps after which the episode is over: the sum over the modules.
    pub fn max_steps(&self) -> usize {
        self.tasks.iter().map(|p| p.task.max_steps()).sum()
    }

    /// Number of goals of all modules together.
    pub fn goal_count(&self) -> usize {
        self.tasks.iter().map(|p| p.task.goal_count()).sum()
    }

    /// The goals that are reached, ascending: those of the first module count from 0, those of the next
    /// one go on from there.
    pub fn goals_reached(&self) -> Vec<usize> {
        let mut first = 0;
        let mut reached = Vec::new();
        for progress in &self.tasks {
            reached.extend(progress.reached.iter().map(|goal| first + goal));
            first += progress.task.goal_count();
        }
        reached
    }

    /// The module being solved: the first that is not complete.
    pub fn module(&self) -> Option<&'static str> {
        self.current().map(|index| self.tasks[index].name)
    }

    /// Primitive settings of the module being solved.
    pub fn settings(&self) -> Option<PrimitiveSettings> {
        self.current()
            .map(|index| self.tasks[index].task.settings())
    }

    /// The tasks of this episode, by module, in the order in which they are solved.
    pub fn tasks(&self) -> impl Iterator<Item = (&'static str, &dyn Task)> {
        self.tasks.iter().map(|p| (p.name, p.task.as_ref()))
    }

    /// The problem.
    pub fn problem(&self) -> &Problem {
        &self.problem
    }

    /// The seed of this episode.
    pub fn seed(&self) -> EpisodeSeed {
        self.seed
    }

    /// The simulated hardware.
    pub fn cell(&self) -> &Cell {
        &self.cell
    }

    /// The simulated hardware, for a node that drives it.
    pub fn cell_mut(&mut self) -> &mut Cell {
        self.cached_rehearsal = None;
        &mut self.cell
    }

    /// Equal for equal states of the bodies at equal times.
    pub fn state_hash(&self) -> u64 {
        self.cell.world().state_hash()
    }

    fn current(&self) -> Option<usize> {
        self.tasks.iter().position(|p| !p.is_complete())
    }

    /// Number of a module's first goal among those of all modules.
    fn first_goal(&self, module: usize) -> usize {
        let before = &self.tasks[..module];
        before.iter().map(|p| p.task.goal_count()).sum()
    }
}

/// Refuses poses that are not finite or not over the workspace.
fn check(action: &PickPlace) -> Result<(), EnvironmentError> {
    let workspace = Workspace::RAVENS;
    for (which, pose) in [("pick", action.pick), ("place", action.place)] {
        let inside = workspace.pixel(&pose.translation.vector.into()).is_some();
        if !(inside && pose.rotation.angle().is_finite()) {
            return Err(EnvironmentError::Action {
                which,
                pose,
                workspace,
            });
        }
    }
    Ok(())
}
