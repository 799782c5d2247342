//! Operators: who approves proposals and confirms steps.

use clap::ValueEnum;

/// Which proposals an operator approves before they are carried out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RequireApproval {
    /// Every one
    Always,
    /// Those that are not sure to succeed
    Unsure,
    /// None, until a stop or a fault
    Never,
}

impl RequireApproval {
    /// As the executor's parameter of that name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Always => "always",
            Self::Unsure => "unsure",
            Self::Never => "never",
        }
    }
}

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
