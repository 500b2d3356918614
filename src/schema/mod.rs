//! The shared vocabulary: agents, episodes, manifests. Imports nothing of the crate.
//!
//! Words: a *communicator* is an agent that sends and receives; the *link bit* of the directed link j→i is true when
//! the message was delivered; a *lost* message reaches the receiver as zeros. Shapes are row-major.

mod agents;
mod episode;
mod manifest;
mod samples;

pub use agents::{AgentSpec, Controller, Layout};
pub use episode::{Episode, Matrix};
pub use manifest::{Manifest, Part, SELF_SHA256_PLACEHOLDER, hex};
pub use samples::{Columns, Exchange, NOTE, SampleLabels, Samples};

/// Major version of the rollout schema that this program writes and reads.
pub const SCHEMA_VERSION: u32 = 1;

/// Seconds of simulated time in one step.
pub const STEP_SECS: f64 = 0.1;

/// What can be wrong with data that claims to follow the schema.
#[derive(Debug, thiserror::Error)]
pub enum SchemaError {
    /// An array has the wrong number of elements.
    #[error("column {column}: expected {expected} values, found {found}")]
    Length {
        /// Column name as in the store.
        column: String,
        /// Elements needed.
        expected: usize,
        /// Elements found.
        found: usize,
    },
    /// A value breaks a rule of the schema.
    #[error("column {column}: {message}")]
    Value {
        /// Column name as in the store.
        column: String,
        /// Which rule, and where.
        message: String,
    },
    /// The manifest is not of a version that this program knows.
    #[error(
        "schema version {found} is newer than the {SCHEMA_VERSION} this program reads: install the ccmarl release that wrote it (the manifest's `ccmarl` field names it)"
    )]
    Version {
        /// Version found.
        found: u32,
    },
    /// The manifest cannot be understood.
    #[error("manifest: {0}")]
    Manifest(String),
}
