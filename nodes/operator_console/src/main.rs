//! The operator_console node.

use std::process::ExitCode;

fn main() -> ExitCode {
    node_kit::main::<operator_console::OperatorConsoleParameters>(
        "operator_console",
        operator_console::start,
    )
}
