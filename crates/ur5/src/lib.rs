#![doc = include_str!("../README.md")]

mod arm;
mod trajectory;
mod work_cell;

pub use arm::{Arm, DhLengths, Joints, Solutions, Unreachable};
pub use trajectory::{JointTrajectory, PlanError, Sampler, TrajectoryPoint};
pub use work_cell::{Body, Frame, Shape, WorkCell, WorkCellError};
