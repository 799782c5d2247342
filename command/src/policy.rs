//! Which policy a command uses, and where it computes.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use gctn::{Device, Policy, Precision};

use crate::root::Root;

/// The policy of a command.
#[derive(Args)]
pub struct PolicyArguments {
    /// Checkpoint of the policy [default: the shipped one]
    #[arg(long)]
    checkpoint: Option<PathBuf>,
    /// Where the policy computes: cpu, cuda or cuda:N
    #[arg(long, default_value_t)]
    device: Device,
}

impl PolicyArguments {
    /// The checkpoint.
    pub fn checkpoint(&self, root: &Root) -> PathBuf {
        let given = self.checkpoint.clone();
        given.unwrap_or_else(|| root.shipped_checkpoint())
    }

    /// Loads it on its device, in 32-bit floats.
    ///
    /// # Errors
    /// The device cannot be had, or the checkpoint cannot be read.
    pub fn load(&self, root: &Root) -> Result<Policy> {
        self.device.check()?;
        let checkpoint = self.checkpoint(root);
        Ok(Policy::load_for(&checkpoint, self.device, Precision::F32)?)
    }
}
