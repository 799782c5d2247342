//! MultiRavens on Rapier: simulated work cell, rendering, task modules, problems, demonstrators.

mod camera_rig;
mod cell;
mod colors;
mod environment;
pub mod health;
mod problem;
pub mod render;
mod seed;
pub mod tasks;
pub mod world;

pub use cell::{Cell, CellError, MAX_LAG_M, MotionEnd, Rehearsal, Tick, Watched};
pub use environment::{Assessment, Environment, EnvironmentError, StepReport};
pub use problem::{Placement, Problem, ProblemError};
pub use seed::{Draws, EpisodeSeed};
pub use tasks::{Care, Demonstrator, Move, Task, TaskModule};
