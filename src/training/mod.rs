//! Training: the alternating optimisation of eq. 14, from demonstrations to weights.
//!
//! The whole state of a training is a [`Checkpoint`]: flat parameters with their moments, and the
//! number of epochs that are done. Everything random in an epoch comes from the seed and the
//! epoch's number, so a training that is resumed goes on bit for bit as one that never stopped.

#[cfg(feature = "train")]
mod adam;
#[cfg(feature = "train")]
mod anchors;
mod config;
#[cfg(feature = "train")]
mod optimisation;
mod report;
#[cfg(feature = "train")]
mod selection;
#[cfg(feature = "train")]
pub mod sweep;

#[cfg(feature = "train")]
pub use adam::Adam;
pub use config::{AdversaryConfig, MannerConfig, SelectionConfig, SettingError, TrainingConfig};
#[cfg(feature = "train")]
pub use optimisation::{
    Checkpoint, CheckpointError, Outcome, Progress, Trained, TrainingError, train,
};
pub use report::{EpochReport, LatentStatistics, MeanTerms};
