//! Scenarios: particle worlds with agents, rewards and observations.
//!
//! A scenario is immutable after it is built; all that changes during an episode is in [`World`]. Adding one: write
//! `scenario/<name>.rs` with an `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,` below.

mod decoder;
mod simple_spread;
mod simple_tag;
mod world;

use serde_json::{Map, Value};

pub use decoder::Decoder;
pub use world::{Body, Integration, Laws, Physics, World};

use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Stream;
use crate::schema::{AgentSpec, Layout};

/// All scenarios.
pub const SCENARIOS: &[Entry<Build>] = &[simple_spread::ENTRY, simple_tag::ENTRY];

/// Most agents of a scenario: observations grow as the square of it.
pub const MAX_AGENTS: usize = 1000;

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

    /// The team reward of a step from the agents' rewards, where it follows from them.
    fn team_reward(&self, _rewards: &[f32]) -> Option<f32> {
        None
    }

    /// Moves the world by one step of `dt` under all agents' actions and writes each agent's reward.
    /// Returns the team reward that a trainer optimises.
    fn step(&self, world: &mut World, actions: &[f32], rewards: &mut [f32]) -> f32;

    /// Writes the simulator state, in [`Scenario::state_fields`] order, world units.
    fn state(&self, world: &World, out: &mut Vec<f64>) {
        world.write_state(out);
    }

    /// The shape of its episodes.
    fn layout(&self) -> Layout {
        Layout { agents: self.agents().to_vec(), state_fields: self.state_fields() }
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

/// Checks what every particle scenario takes: profile, number of agents, steps, laws of motion.
fn check_common(spec: &Spec, profile: &str, agents: usize, steps: usize, laws: &Laws) -> Result<(), RegistryError> {
    match profile {
        "paper" => {}
        "mpe2" => return Err(spec.invalid("profile \"mpe2\" is not there yet: use \"paper\"")),
        other => return Err(spec.invalid(format!("unknown profile {other:?}: use \"paper\""))),
    }
    if !(1..=MAX_AGENTS).contains(&agents) {
        return Err(spec.invalid(format!("agents must be in [1, {MAX_AGENTS}], found {agents}")));
    }
    if !(1..=10_000).contains(&steps) {
        return Err(spec.invalid(format!("steps must be in [1, 10000], found {steps}")));
    }
    spec.in_range("dt", laws.dt, 1e-4, 1.0)?;
    spec.in_range("damping", laws.damping, 0.0, 1.0)?;
    spec.in_range("contact_force", laws.contact_force, 0.0, 1e4)?;
    spec.in_range("contact_margin", laws.contact_margin, 1e-9, 1.0)
}

/// `x y vx vy` of the agents, then `x y` of `landmarks` landmarks.
fn body_fields(agents: &[AgentSpec], landmarks: usize) -> Vec<String> {
    let moving = agents.iter().flat_map(|a| ["x", "y", "vx", "vy"].map(|c| format!("{}.{c}", a.name)));
    moving.chain((0..landmarks).flat_map(|l| ["x", "y"].map(|c| format!("landmark_{l}.{c}")))).collect()
}

/// Places bodies uniformly in the square of half width `half`, at rest.
fn scatter(positions: &mut [[f64; 2]], half: f64, rng: &mut Stream) {
    for p in positions {
        *p = [crate::rng::uniform(rng, -half, half), crate::rng::uniform(rng, -half, half)];
    }
}

/// Writes numbers one after the other into a flat observation buffer.
struct Writer<'a> {
    rest: &'a mut [f32],
}

impl Writer<'_> {
    fn pair(&mut self, pair: [f64; 2]) {
        let (head, tail) = std::mem::take(&mut self.rest).split_at_mut(2);
        head.copy_from_slice(&[pair[0] as f32, pair[1] as f32]);
        self.rest = tail;
    }

    /// The offset from `body` to `other`, or zeros beyond the squared radius.
    fn seen(&mut self, world: &World, body: usize, other: usize, squared_radius: f64) -> bool {
        let d = world.offset(body, other);
        let seen = d[0] * d[0] + d[1] * d[1] <= squared_radius;
        self.pair(if seen { d } else { [0.0; 2] });
        seen
    }
}
