#![doc = include_str!("../README.md")]

mod arm;
mod at_home;
mod calibration;
mod trajectory;
mod work_cell;

pub use arm::{Arm, DhLengths, Joints, LimitError, Solutions, Unreachable, joints_text};
pub use at_home::AtHome;
pub use calibration::ArmCalibration;
pub use trajectory::{JointTrajectory, PlanError, Sampler, TrajectoryPoint};
pub use work_cell::{Body, Frame, Shape, WorkCell, WorkCellError};
