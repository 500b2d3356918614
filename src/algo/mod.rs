//! Algorithms: one linear file each; presets name the paper's rows.
//!
//! Adding a row of the paper (or a variant of it): add a preset in `presets.rs` and its line below. Adding an
//! algorithm: write `algo/<name>.rs` top to bottom, then its presets.

mod actor_file;
mod actors;
mod batch;
mod config;
mod encoders;
mod maddpg;
mod presets;
mod team;

pub use actors::{Actors, RunPolicyError};
pub use batch::Batch;
pub use config::{ActorStep, MaddpgConfig, Masks, Messages};
pub use encoders::{EncoderScratch, Senders};
pub use maddpg::{Maddpg, UpdateMetrics};
pub use presets::Preset;
pub use team::{Sight, Team, TeamScratch};

use crate::registry::{Entry, RegistryError};

/// All algorithms, under the ids of the published tables.
pub const ALGORITHMS: &[Entry<fn() -> Preset>] = &[
    presets::CC_MADDPG,
    presets::DROPOUT_MADDPG_02,
    presets::DROPOUT_MADDPG_05,
    presets::DROPOUT_MADDPG_08,
    presets::FC_MADDPG,
    presets::MADDPG,
];

/// The preset called `name`.
///
/// # Errors
/// [`RegistryError::Unknown`] with the nearest names.
pub fn preset(name: &str) -> Result<Preset, RegistryError> {
    Ok((crate::registry::find("algorithm", ALGORITHMS, name)?.build)())
}

/// A learner that sends what it observes, for tests.
#[cfg(test)]
fn agent(name: &str, observation: usize, action: usize) -> crate::schema::AgentSpec {
    crate::schema::AgentSpec {
        name: name.to_owned(),
        team: "team".to_owned(),
        controller: crate::schema::Controller::Policy,
        learner: true,
        communicator: true,
        observation,
        message: observation,
        action,
    }
}
