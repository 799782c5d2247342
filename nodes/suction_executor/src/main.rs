//! The executable of the node.

fn main() -> std::process::ExitCode {
    node_kit::main::<suction_executor::SuctionExecutorParameters>(
        "suction_executor",
        suction_executor::start,
    )
}
