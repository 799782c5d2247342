//! Task modules: one file or folder each, and one line each in [`REGISTRY`].

use crate::cell::{Cell, Rehearsal};
use crate::seed::Draws;
use crate::world::World;
use nalgebra::{Isometry2, Isometry3, Vector2};
use pick_place::{Outcome, PickPlace, PrimitiveSettings};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::de::DeserializeOwned;
use serde_yaml_ng::Value;
use std::fmt;

pub mod arranging;
mod chaining;
mod placing;
mod routing;
mod stacking;

/// All task modules: the name in problem files, and what reads and checks their parameters.
pub const REGISTRY: &[(&str, Configure)] = &[
    ("arranging", arranging::configure),
    ("chaining", configure::<chaining::Chaining>),
    ("placing", configure::<placing::Placing>),
    ("routing", configure::<routing::Routing>),
    ("stacking", configure::<stacking::Stacking>),
];

/// Reads the `parameters` of a module in a problem file.
pub type Configure = fn(Value) -> Result<Box<dyn TaskModule>, ParameterError>;

/// A module without parameters has its defaults.
fn configure<M>(parameters: Value) -> Result<Box<dyn TaskModule>, ParameterError>
where
    M: TaskModule + Default + DeserializeOwned + 'static,
{
    Ok(Box::new(match parameters {
        Value::Null => M::default(),
        given => read(given)?,
    }))
}

/// Reads parameters; an error names the field.
fn read<M: DeserializeOwned>(parameters: Value) -> Result<M, ParameterError> {
    serde_path_to_error::deserialize(parameters).map_err(|error| {
        let at = error.path().to_string();
        // The path of the whole is a dot.
        let at = if at == "." { String::new() } else { at };
        field(at, error.into_inner().to_string())
    })
}

/// A parameter that a module does not take.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}{reason}", if field.is_empty() { String::new() } else { format!("{field}: ") })]
pub struct ParameterError {
    /// Where it is, such as `goals[2].at.x_m`; empty for all parameters together.
    pub field: String,
    /// What is wrong with it, and what was expected.
    pub reason: String,
}

fn field(field: impl Into<String>, reason: String) -> ParameterError {
    ParameterError {
        field: field.into(),
        reason,
    }
}

/// A task module with its parameters: what an episode's task is drawn from.
pub trait TaskModule: Send + Sync + fmt::Debug {
    /// Refuses parameters out of range, or that cannot be met about this anchor.
    fn check(&self, anchor: &Isometry2<f64>) -> Result<(), ParameterError>;

    /// Edge lengths, along the anchor's x and y, of the rectangle about the anchor that holds all
    /// the module's bodies at the start and in the goal.
    fn footprint_m(&self) -> Vector2<f64>;

    /// Draws a task and adds its bodies to the world, about the anchor. Only where the loose bodies
    /// lie may depend on the start: the same scene has the same bodies, in the same order, and the
    /// same goals.
    ///
    /// # Errors
    /// When what the seed draws does not fit on the table.
    fn build(
        &self,
        world: &mut World,
        anchor: &Isometry2<f64>,
        draws: &mut Draws,
    ) -> Result<Box<dyn Task>, ParameterError>;
}

/// A task of one episode.
pub trait Task: Send {
    /// Number of delta rewards: `n` of the paper's table I (for routing also the stretch).
    fn goal_count(&self) -> usize;

    /// Steps after which an episode is over.
    fn max_steps(&self) -> usize;

    /// Heights and speeds of the primitive while this task is being solved.
    fn settings(&self) -> PrimitiveSettings;

    /// Where things should be: what the reward looks at.
    fn goal_poses(&self) -> Vec<Isometry3<f64>>;

    /// The goals that are reached, by their index in [`Self::goal_poses`], ascending. Called once on
    /// the settled start and once after every step, in order, so that a task may remember what was
    /// reached before.
    fn goals_reached(&mut self, world: &World) -> Vec<usize>;

    /// Number of goals reached, at most [`Self::goal_count`].
    fn reached(&mut self, world: &World) -> usize {
        self.goals_reached(world).len()
    }

    /// The next action of a stochastic demonstrator that sees the true state; nothing when there
    /// is nothing left to do. With `next` it reaches for this goal, else for any that may come next.
    fn demonstrate(
        &mut self,
        cell: &Cell,
        demonstrator: &mut Demonstrator,
        next: Option<usize>,
    ) -> Option<Move>;
}

/// Who demonstrates: what it draws its actions from, and how sure it makes of those that it rehearses.
#[derive(Debug, Clone)]
pub struct Demonstrator {
    /// Stream that all choices are drawn from.
    pub rng: ChaCha8Rng,
    /// How far a rehearsed move may be missed.
    pub care: Care,
}

impl From<ChaCha8Rng> for Demonstrator {
    fn from(rng: ChaCha8Rng) -> Self {
        let care = Care::default();
        Self { rng, care }
    }
}

/// How sure a demonstrator makes of the moves that it rehearses, those of chains and cables, before it makes one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Care {
    /// A move succeeds in two rehearsals within 1 mm of what is meant.
    #[default]
    Usual,
    /// A move succeeds once as it is made and in four more rehearsals, gripped and set down within 6 mm of what is meant:
    /// what a policy that grips a little beside would achieve too. With a chain the first guess is the middle of what others are
    /// drawn from, so that equal scenes are mostly shown equal moves.
    Careful,
}

impl Care {
    /// Rehearsals, each with other noise, in which a move has to succeed.
    fn rehearsals(self) -> usize {
        match self {
            Self::Usual => 2,
            Self::Careful => 5,
        }
    }

    /// Noise along x and y of the rehearsals after the first.
    fn noise_m(self) -> f64 {
        match self {
            Self::Usual => NOISE_M,
            Self::Careful => 6e-3,
        }
    }
}

/// A demonstrator's action.
pub struct Move {
    /// The action.
    pub action: PickPlace,
    /// What it does in the present state, where that was rehearsed.
    pub rehearsal: Option<Rehearsal>,
}

impl From<PickPlace> for Move {
    fn from(action: PickPlace) -> Self {
        Self {
            action,
            rehearsal: None,
        }
    }
}

/// Moves that a demonstrator rehearses at most before it takes the best of them.
const GUESSES: usize = 20;
/// A demonstrator grips and sets down within this distance of what it means along x and y.
const NOISE_M: f64 = 1e-3;

/// For what cannot be foretold, a cable or a chain: carries out guesses on a copy of the cell until
/// one reaches exactly one goal more, the `next` one if there is one, with noise and again with other
/// noise. If none does, the best.
///
/// `guess` receives the number of earlier guesses and returns `None` when there are no more; `reached` says which goals are reached in a
/// world, before the move and after a rehearsal.
fn rehearsed(
    cell: &Cell,
    settings: &PrimitiveSettings,
    demonstrator: &mut Demonstrator,
    mut guess: impl FnMut(usize, &mut ChaCha8Rng) -> Option<PickPlace>,
    next: Option<usize>,
    reached: impl Fn(&World) -> Vec<usize>,
) -> Option<Move> {
    let Demonstrator { rng, care } = demonstrator;
    let rehearsals = care.rehearsals();
    let before = reached(cell.world()).len();
    let succeeds = |after: &Vec<usize>| {
        after.len() == before + 1 && next.is_none_or(|goal| after.contains(&goal))
    };
    // By rehearsals that went well, and whether anything is gained.
    let mut best: Option<((usize, bool), Move)> = None;
    for index in 0..GUESSES {
        let Some(meant) = guess(index, rng) else {
            break;
        };
        let mut moves = Vec::with_capacity(rehearsals);
        for index in 0..rehearsals {
            let noise_m = if index == 0 { NOISE_M } else { care.noise_m() };
            moves.push(PickPlace {
                pick: near(&meant.pick, noise_m, rng),
                place: near(&meant.place, noise_m, rng),
            });
        }
        let mut good = 0;
        let mut gains = false;
        let mut first = Move::from(moves[0]);
        for (index, action) in moves.iter().enumerate() {
            let rehearsal = cell.rehearse(action, settings).ok();
            let placed = rehearsal
                .as_ref()
                .filter(|rehearsal| rehearsal.outcome() == Outcome::Placed);
            let after = placed.map(|rehearsal| reached(rehearsal.world()));
            if index == 0 {
                gains = after.as_ref().is_some_and(|after| after.len() > before);
                first.rehearsal = rehearsal;
            }
            if !after.as_ref().is_some_and(succeeds) {
                break;
            }
            good += 1;
        }
        if best.as_ref().is_none_or(|(most, _)| (good, gains) > *most) {
            best = Some(((good, gains), first));
        }
        if good == rehearsals {
            break;
        }
    }
    best.map(|(_, best)| best)
}

/// A pose with noise along x and y.
fn near(pose: &Isometry2<f64>, noise_m: f64, rng: &mut ChaCha8Rng) -> Isometry2<f64> {
    let mut noise = || rng.random_range(-noise_m..noise_m);
    Isometry2::new(
        pose.translation.vector + Vector2::new(noise(), noise()),
        pose.rotation.angle(),
    )
}

/// Refuses a value outside a range.
fn check_range(name: &str, value: f64, low: f64, high: f64) -> Result<(), ParameterError> {
    // NaN is in no range.
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(field(name, format!("is {value}, expected {low} to {high}")))
    }
}

/// A planar pose lifted to a height.
fn at_height(pose: &Isometry2<f64>, z_m: f64) -> Isometry3<f64> {
    let yaw = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, pose.rotation.angle());
    let t = pose.translation;
    Isometry3::from_parts(nalgebra::Translation3::new(t.x, t.y, z_m), yaw)
}
