//! Scenarios: particle worlds with agents, rewards and observations.
//!
//! A scenario is immutable after it is built; all that changes during an episode is in [`World`]. Adding one: write
//! `scenario/<name>.rs` with an `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,` below.

mod world;

use serde_json::{Map, Value};

pub use world::World;

use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Stream;
use crate::schema::{AgentSpec, Layout};

/// All scenarios.
pub const SCENARIOS: &[Entry<Build>] = &[];

/// Builds a scenario from its checked parameters.
pub type Build = fn(&Spec) -> Result<Box<dyn Scenario>, RegistryError>;

/// Builds the scenario that `spec` names.
///
/// # Errors
/// [`RegistryError`] for an unknown name or a parameter out of its range.
pub fn build(spec: &Spec) -> Result<Box<dyn Scenario>, RegistryError> {
    (crate::registry::find("scenario", SCENARIOS, &spec.name)?.build)(spec)
}

/// A task: who is there, how the world starts, what agents see, what they earn.
///
/// Flat buffers concatenate the agents in order: `observations` has `Σ observation` elements, `actions` `Σ action`.
pub trait Scenario: Send + Sync {
    /// Name, profile and every constant, resolved: what the manifest records, and what [`build`] accepts again.
    fn parameters(&self) -> Map<String, Value>;

    /// Agents in order; `message` holds the default width (the sender's observation for communicators, else 0).
    fn agents(&self) -> &[AgentSpec];

    /// Names of the state vector's elements, in [`Scenario::state`] order.
    fn state_fields(&self) -> Vec<String>;

    /// Steps in an episode (time limit).
    fn steps(&self) -> usize {
        25
    }

    /// World units in one unit of `distance` links by default (design §6).
    fn link_unit(&self) -> f64 {
        0.25
    }

    /// What the reward counts, in one line for tables: conventions differ by factors between papers.
    fn reward_convention(&self) -> &'static str;

    /// A world of this scenario's bodies, not yet placed.
    fn world(&self) -> World;

    /// Places all bodies for a new episode.
    fn reset(&self, world: &mut World, rng: &mut Stream);

    /// Writes every agent's observation into the flat buffer.
    fn observe(&self, world: &World, observations: &mut [f32]);

    /// Writes the actions of the scripted agents (the prey) into the flat buffer; leaves the others alone.
    fn scripted(&self, world: &World, rng: &mut Stream, actions: &mut [f32]);

    /// Writes the oracle's actions of the policy agents (a hand-written rule that sees the whole state).
    fn oracle(&self, world: &World, actions: &mut [f32]);

    /// Moves the world by one step of `dt` under all agents' actions and writes each agent's reward.
    /// Returns the team reward that a trainer optimises.
    fn step(&self, world: &mut World, actions: &[f32], rewards: &mut [f32]) -> f32;

    /// Writes the simulator state, in [`Scenario::state_fields`] order, world units.
    fn state(&self, world: &World, out: &mut Vec<f64>) {
        world.write_state(out);
    }

    /// The shape of its episodes.
    fn layout(&self) -> Layout {
        Layout {
            agents: self.agents().to_vec(),
            state_fields: self.state_fields(),
        }
    }
}

/// Offsets of each agent's slice in a flat buffer, and the total as the last element.
pub fn offsets(agents: &[AgentSpec], width: fn(&AgentSpec) -> usize) -> Vec<usize> {
    let mut offsets = vec![0];
    for agent in agents {
        offsets.push(offsets[offsets.len() - 1] + width(agent));
    }
    offsets
}
