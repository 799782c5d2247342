//! The executable of the node with a planted fault, for `cargo xtask campaign --planted`.

fn main() -> std::process::ExitCode {
    node_kit::main::<suction_executor::SuctionExecutorParameters>(
        "suction_executor",
        suction_executor::start,
    )
}
