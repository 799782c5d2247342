#![doc = include_str!("../README.md")]

mod board;
mod check;
mod detect;
mod file;
mod planar;
mod solve;
mod tag36h11;

pub use board::{Board, BoardError};
pub use check::{CheckError, CheckLimits, Frame, Limit, Measure, check_cameras};
pub use detect::{GrayImage, Tag, detect, gray_pixels};
pub use file::{CalibrationFileError, read_calibration};
pub use planar::{BoardView, board_pose};
pub use solve::{
    CalibratedCamera, Calibration, CalibrationError, CameraViews, Table, View, check_swapped,
    solve, table,
};
