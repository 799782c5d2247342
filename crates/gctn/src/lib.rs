//! Goal-Conditioned Transporter Networks in libtorch: networks, losses, augmentation, checkpoints.
//!
//! The only crate that knows libtorch. A [`Policy`] turns two heightmaps, what is seen and what it should
//! become, into a pick and a place pose in SE(2); a [`Trainer`] makes one from demonstrated steps.

mod augment;
mod batch;
mod calibration;
mod candidates;
mod checkpoint;
mod config;
mod correlation;
mod device;
mod embedding;
mod error;
mod input;
mod losses;
mod network;
mod optimiser;
mod policy;
mod sample;
mod trainer;

pub use batch::{Batch, BatchMaker};
pub use calibration::{Calibration, Evidence};
pub use checkpoint::{ModelCard, Storage, average, calibrate};
pub use config::{
    Augmentation, Compact, Device, EmbeddingConfig, EmbeddingTraining, GoalConditioning, GrConvnet,
    Interpolation, Matching, Network, NetworkConfig, PlaceLoss, Precision, Resnet43, Schedule,
    SensorNoise, TrainingConfig,
};
pub use device::convolution_tflops;
pub use embedding::{Embedded, Embedding, EmbeddingLoss, EmbeddingTrainer};
pub use error::Error;
pub use policy::{Decision, Policy, ScoreMap};
pub use sample::{Goal, Sample};
pub use trainer::{Losses, Trainer};

use std::sync::atomic::{AtomicUsize, Ordering};

static THREADS: AtomicUsize = AtomicUsize::new(1);

/// Sets how many threads libtorch computes with, in the whole process; 1 unless said. Sums are split by
/// thread: another number gives other last bits.
pub fn set_threads(threads: usize) {
    THREADS.store(threads.clamp(1, 1024), Ordering::Relaxed);
    apply_threads();
}

/// Sets the threads for work that the calling thread starts: OpenMP keeps the number by thread.
fn apply_threads() {
    tch::set_num_threads(THREADS.load(Ordering::Relaxed) as i32);
}
