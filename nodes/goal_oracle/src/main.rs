//! The goal_oracle node.

use std::process::ExitCode;

fn main() -> ExitCode {
    node_kit::main::<goal_oracle::GoalOracleParameters>("goal_oracle", goal_oracle::start)
}
