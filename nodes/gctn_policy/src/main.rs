//! The gctn_policy node.

use std::process::ExitCode;

fn main() -> ExitCode {
    node_kit::main::<gctn_policy::GctnPolicyParameters>("gctn_policy", gctn_policy::start)
}
