//! The executable of the node.

fn main() -> std::process::ExitCode {
    node_kit::main::<motion_watchdog::MotionWatchdogParameters>(
        "motion_watchdog",
        motion_watchdog::start,
    )
}
