//! What can go wrong.

use std::path::PathBuf;

/// What can go wrong in this crate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A value in a configuration makes no sense.
    #[error("{what} is {actual}, expected {expected}")]
    Config {
        /// Name of the value.
        what: &'static str,
        /// Its value.
        actual: String,
        /// What was expected.
        expected: &'static str,
    },
    /// A heightmap of another grid than the network's.
    #[error("the heightmap has {actual}, the network expects {expected}")]
    Workspace {
        /// The heightmap's grid.
        actual: String,
        /// The network's grid.
        expected: String,
    },
    /// An observation or a goal whose parts do not fit, or that is not finite.
    #[error("the {what}: {source}")]
    Heightmap {
        /// Observation or goal.
        what: &'static str,
        /// What is wrong with it.
        source: heightmap::HeightmapError,
    },
    /// A goal without an image that the network is conditioned on.
    #[error("the network is conditioned on {conditioning}, but {what} is missing")]
    GoalMissing {
        /// Which image.
        what: &'static str,
        /// What the network is conditioned on.
        conditioning: crate::GoalConditioning,
    },
    /// A goal with a final goal, though the network is not conditioned on it.
    #[error("the network is conditioned on {conditioning}, but there is a final goal beside")]
    GoalTooMany {
        /// What the network is conditioned on.
        conditioning: crate::GoalConditioning,
    },
    /// A sample of a step that is done, for a network that cannot say so.
    #[error("sample {index}: the step is done already, which only the network matching learns")]
    Done {
        /// Index of the sample in the batch.
        index: usize,
    },
    /// A training label off the heightmap, or not finite.
    #[error(
        "sample {index}: the {what} pose ({x_m} m, {y_m} m, {yaw_rad} rad) is not on the heightmap"
    )]
    Label {
        /// Index of the sample in the batch.
        index: usize,
        /// Pick or place.
        what: &'static str,
        /// World position, x.
        x_m: f64,
        /// World position, y.
        y_m: f64,
        /// Yaw in the world.
        yaw_rad: f64,
    },
    /// A batch of another size than configured.
    #[error("a batch of {actual} samples, expected {expected}")]
    Batch {
        /// Samples given.
        actual: usize,
        /// Samples configured.
        expected: usize,
    },
    /// A batch that was made for another gradient step.
    #[error(
        "a batch of the gradient step after {actual} others, expected the one after {expected}"
    )]
    BatchStep {
        /// Steps before the one that it was made for.
        actual: u64,
        /// Steps done.
        expected: u64,
    },
    /// A demonstration with too few images to tell one from the other.
    #[error("demonstration {index} has {actual} images, expected at least 2")]
    Sequence {
        /// Index of the demonstration in the batch.
        index: usize,
        /// Images given.
        actual: usize,
    },
    /// The network's output is not finite, or training diverged.
    #[error("{what} is not finite{}", step.map(|step| format!(" at step {step}")).unwrap_or_default())]
    NotFinite {
        /// Which quantity.
        what: &'static str,
        /// Training step, when training.
        step: Option<u64>,
    },
    /// Every cell is excluded from picking.
    #[error("all cells are within the disks about the {count} excluded picks")]
    NothingToPick {
        /// Number of excluded picks.
        count: usize,
    },
    /// A file that is no checkpoint of this crate, or a broken one.
    #[error("{}: {problem}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// A tensor in a checkpoint that does not fit the network.
    #[error("{}: tensor {tensor}: {problem}", path.display())]
    CheckpointTensor {
        /// The file.
        path: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The file system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// The device cannot be used.
    #[error("device {device} cannot be used: {problem}")]
    NoCuda {
        /// The device.
        device: crate::Device,
        /// The reason.
        problem: String,
    },
    /// libtorch refused.
    #[error("libtorch: {0}")]
    Torch(#[from] tch::TchError),
}
