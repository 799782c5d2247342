//! The camera_fusion node.

use std::process::ExitCode;

fn main() -> ExitCode {
    node_kit::main::<camera_fusion::CameraFusionParameters>("camera_fusion", camera_fusion::start)
}
