//! Algorithms: one linear file each; presets name the paper's rows.
//!
//! Adding a row of the paper (or a variant of it): add a preset in `presets.rs` and its line below. Adding an
//! algorithm: write `algo/<name>.rs` top to bottom, then its presets.

mod actors;
mod config;
mod maddpg;
mod presets;
mod team;

pub use actors::{Actors, RunPolicyError};
pub use config::{ActorStep, MaddpgConfig, Masks, Messages};
pub use maddpg::{Batch, Maddpg, UpdateMetrics};
pub use presets::Preset;
pub use team::{Team, TeamScratch};

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
