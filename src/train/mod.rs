//! Training: the loop that joins scenario, link, learner and Du-MIE; replay, checkpoints, observers, evaluation.

mod arrays;
mod checkpoint;
pub mod config;
mod config_file;
mod difference;
mod directory;
pub mod dumie;
mod estimator;
mod evaluate;
mod finite;
mod metrics;
mod protocol;
pub mod replay;
mod run;
mod tensorboard;
mod timings;
mod trainer;
mod warm;

use std::path::PathBuf;

pub use config::TrainConfig;
pub use config_file::Given;
pub use estimator::Estimator;
pub use evaluate::{
    ChannelSummary, EVALUATION_COLUMNS, EvaluationRow, evaluate, evaluation_seed, summarise, write_evaluation,
};
pub use metrics::{METRIC_COLUMNS, METRIC_KEYS, MetricsRow};
pub use protocol::{EvaluationConfig, LastTest, Protocol, STANDARD_COLUMNS};
pub use run::{Options, Progress, Report, train};
pub use timings::TIMING_COLUMNS;
pub use trainer::Trainer;

/// What can go wrong with a training run.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// Files.
    #[error(transparent)]
    Io(#[from] crate::io::IoError),
    /// Plugin names and parameters.
    #[error(transparent)]
    Registry(#[from] crate::registry::RegistryError),
    /// Networks.
    #[error(transparent)]
    Nn(#[from] crate::nn::NnError),
    /// A store.
    #[error(transparent)]
    Storage(#[from] crate::storage::StorageError),
    /// Recording.
    #[error(transparent)]
    Record(#[from] crate::record::RecordError),
    /// Tables.
    #[error("could not write a table: {0}")]
    Table(#[from] polars::error::PolarsError),
    /// A configuration file that cannot be read.
    #[error("configuration: {message}: {}", path.display())]
    Config {
        /// What is wrong, with line and column.
        message: String,
        /// The line of the file and a mark below it, on lines of their own; empty where the place is not known.
        excerpt: String,
        /// Where.
        path: PathBuf,
    },
    /// A value out of its range.
    #[error("{name}: {message}")]
    Value {
        /// Its name in the configuration.
        name: String,
        /// What was expected and found.
        message: String,
    },
    /// A store or episode that the trainer cannot use.
    #[error("cannot train on this: {0}")]
    Store(String),
    /// Numbers stopped being numbers.
    #[error("the run diverged at step {step}, update {update}: {what} is no longer finite; lower the learning rates; the last good checkpoint is kept: {}", path.display())]
    Diverged {
        /// Environment step.
        step: u64,
        /// Updates before.
        update: u64,
        /// Which tensor.
        what: String,
        /// Run directory.
        path: PathBuf,
    },
    /// Somebody else writes there.
    #[error("another process is training into this directory: wait for its end, or give another --out: {}", .0.display())]
    Busy(PathBuf),
    /// A checkpoint that does not belong to this run.
    #[error("cannot resume: {message}: {}", path.display())]
    Resume {
        /// What differs, and what to do.
        message: String,
        /// Where.
        path: PathBuf,
    },
}
