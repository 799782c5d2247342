//! Operators: who approves proposals and confirms steps.

use clap::ValueEnum;

/// Who decides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum OperatorKind {
    /// Approves every proposal, and confirms steps by the simulator's reward
    Auto,
    /// Asks the person at the terminal
    Terminal,
    /// Serves a page on which a person decides, and prints its address
    Web,
    /// A person who only watches: every proposal is carried out, and the goal module, or with the oracle the motion's
    /// outcome, says which goal is next. Ctrl-C ends the run
    Watch,
    /// Nobody here: another program on the topics decides
    None,
}
