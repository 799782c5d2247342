//! The executable of the node.

fn main() -> std::process::ExitCode {
    node_kit::main::<sim_workcell::SimWorkcellParameters>("sim_workcell", sim_workcell::start)
}
