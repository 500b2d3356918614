//! Scenarios: particle worlds with agents, rewards and observations.
//!
//! A scenario is immutable after it is built; all that changes during an episode is a row of `f64`, the `state` column
//! of the store. Adding one: write `scenario/<name>.rs` with an `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,`
//! below.

mod action;
mod params;
mod simple_adversary;
mod simple_reference;
mod simple_spread;
mod simple_tag;
mod world;
mod worlds;

use serde_json::{Map, Value};

pub use action::{ActionError, ActionSpace, Decoder};
pub use params::MAX_AGENTS;
pub use world::{Body, Integration, Laws, Physics, Scratch, Shape, World};
pub use worlds::Worlds;

use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Stream;
use crate::schema::{AgentSpec, Controller, Layout};

/// All scenarios.
pub const SCENARIOS: &[Entry<Build>] =
    &[simple_adversary::ENTRY, simple_reference::ENTRY, simple_spread::ENTRY, simple_tag::ENTRY];

/// Builds a scenario from its checked parameters.
pub type Build = fn(&Spec) -> Result<Box<dyn Scenario>, RegistryError>;

/// Builds the scenario that `spec` names.
///
/// # Errors
/// [`RegistryError`] for an unknown name or a parameter out of its range.
pub fn build(spec: &Spec) -> Result<Box<dyn Scenario>, RegistryError> {
    (crate::registry::find("scenario", SCENARIOS, &spec.name)?.build)(spec)
}

/// What every scenario has: who is there, what they can do, how bodies move, and for how long.
#[derive(Clone, Debug)]
pub struct Base {
    /// Agents in order; `message` holds the default width (the sender's observation for communicators, else 0).
    pub agents: Vec<AgentSpec>,
    /// What each of them can do.
    pub space: ActionSpace,
    /// How bodies move.
    pub physics: Physics,
    /// Steps in an episode (time limit).
    pub steps: usize,
    /// What of the agents' rewards a trainer optimises.
    pub team: Team,
}

impl Base {
    /// Actions with which every agent heads for a body and brakes in time: for oracles.
    fn head_for(&self, state: &[f64], actions: &mut [f32], target: impl Fn(usize) -> usize) {
        let (space, world) = (self.space, self.physics.world(state));
        for (agent, action) in actions.chunks_exact_mut(space.width()).enumerate() {
            let wish = world.offset(agent, target(agent)).map(|c| 5.0 * c);
            let bound = space.decoder.bound();
            space.encode(self.physics.control_towards(agent, world.velocity(agent), wish, bound), action);
        }
    }
}

/// What a team earns, from what its agents earn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Team {
    /// The first agent's reward (which all share, or which all are to maximise).
    First,
    /// The sum over all agents.
    Sum,
}

/// A task: who is there, how the world starts, what agents see, what they earn.
///
/// Flat buffers concatenate the agents in order: `observations` has `Σ observation` elements, `actions` `Σ action`. A
/// `state` is a row `[shape().width()]` in [`Scenario::state_fields`] order, world units.
pub trait Scenario: Send + Sync {
    /// What every scenario has.
    fn base(&self) -> &Base;

    /// Name, profile and every constant, resolved: what the manifest records, and what [`build`] accepts again.
    fn parameters(&self) -> Map<String, Value>;

    /// What the reward counts, in one line for tables: conventions differ by factors between papers.
    fn reward_convention(&self) -> &'static str;

    /// Places all bodies for a new episode.
    fn reset(&self, state: &mut [f64], rng: &mut Stream);

    /// Writes every agent's observation into the flat buffer.
    fn observe(&self, state: &[f64], observations: &mut [f32]);

    /// Writes the actions of the scripted agents (the prey) into the flat buffer; leaves the others alone.
    fn scripted(&self, _state: &[f64], _rng: &mut Stream, _actions: &mut [f32]) {}

    /// Writes the oracle's actions of the policy agents (a hand-written rule that sees the whole state).
    fn oracle(&self, state: &[f64], actions: &mut [f32]);

    /// Moves the world by one step of `dt` under all agents' actions and writes each agent's reward.
    fn step(&self, state: &mut [f64], actions: &[f32], rewards: &mut [f32], scratch: &mut Scratch);

    /// The team reward of a step, which a trainer optimises, from the agents' rewards.
    fn team_reward(&self, rewards: &[f32]) -> f32 {
        match self.base().team {
            Team::First => rewards[0],
            Team::Sum => rewards.iter().map(|&r| f64::from(r)).sum::<f64>() as f32,
        }
    }

    /// World units in one unit of `distance` links by default (design §6).
    fn link_unit(&self) -> f64 {
        0.25
    }

    /// Agents in order.
    fn agents(&self) -> &[AgentSpec] {
        &self.base().agents
    }

    /// What every agent can do.
    fn space(&self) -> ActionSpace {
        self.base().space
    }

    /// Where everything lies in a row of state.
    fn shape(&self) -> Shape {
        self.base().physics.shape()
    }

    /// Names of the elements of a row of state.
    fn state_fields(&self) -> Vec<String> {
        self.shape().fields(self.agents())
    }

    /// Steps in an episode (time limit).
    fn steps(&self) -> usize {
        self.base().steps
    }

    /// The shape of its episodes.
    fn layout(&self) -> Layout {
        Layout { agents: self.agents().to_vec(), state_fields: self.state_fields() }
    }

    /// Checks a row of state that came from outside: as many elements as fields, finite, goals that exist.
    ///
    /// # Errors
    /// One line that names the field and what is allowed.
    fn check_state(&self, state: &[f64]) -> Result<(), String> {
        let shape = self.shape();
        if state.len() != shape.width() {
            return Err(format!("state must have {} elements, found {}", shape.width(), state.len()));
        }
        let fail = |at: usize, must: &str| {
            Err(format!("state field {} must be {must}, found {}", self.state_fields()[at], state[at]))
        };
        if let Some(at) = state.iter().position(|v| !v.is_finite()) {
            return fail(at, "finite");
        }
        let lands = |goal: f64| goal.fract() == 0.0 && (0.0..shape.landmarks as f64).contains(&goal);
        match shape.goals_at().find(|&at| !lands(state[at])) {
            Some(at) => fail(at, &format!("a landmark's number in [0, {}]", shape.landmarks - 1)),
            None => Ok(()),
        }
    }
}

/// Every constant, the name among them, in which a recorded world differs from this one, as "key was a `when` and is b
/// here". A constant that was not recorded has its default; a record that names no world differs in nothing.
pub fn differences(recorded: &Map<String, Value>, here: &dyn Scenario, when: &str) -> Vec<String> {
    let Some(Value::String(name)) = recorded.get("name") else { return Vec::new() };
    let mut params = recorded.clone();
    params.retain(|key, value| key != "name" && !value.is_null());
    let there = build(&Spec { name: name.clone(), params }).map_or_else(|_| recorded.clone(), |s| s.parameters());
    let here = here.parameters();
    let shown = |map: &Map<String, Value>, key: &str| map.get(key).map_or("unset".to_owned(), ToString::to_string);
    let keys = there.keys().chain(here.keys().filter(|key| !there.contains_key(*key)));
    keys.filter(|key| there.get(*key) != here.get(*key))
        .map(|key| format!("{key} was {} {when} and is {} here", shown(&there, key), shown(&here, key)))
        .collect()
}

/// Offsets of each agent's slice in a flat buffer, and the total as the last element.
pub fn offsets(agents: &[AgentSpec], width: fn(&AgentSpec) -> usize) -> Vec<usize> {
    let mut offsets = vec![0];
    for agent in agents {
        offsets.push(offsets[offsets.len() - 1] + width(agent));
    }
    offsets
}

/// An agent under policy control that learns and communicates.
fn learner(name: String, team: &str, observation: usize, action: usize) -> AgentSpec {
    AgentSpec {
        name,
        team: team.to_owned(),
        controller: Controller::Policy,
        learner: true,
        communicator: true,
        observation,
        message: observation,
        action,
    }
}

/// Puts bodies uniformly into the square of half width `half`.
fn scatter(shape: Shape, state: &mut [f64], bodies: std::ops::Range<usize>, half: f64, rng: &mut Stream) {
    for body in bodies {
        let place = [crate::rng::uniform(rng, -half, half), crate::rng::uniform(rng, -half, half)];
        shape.place(state, body, place);
    }
}

/// A writer per agent, over its part of the flat buffer of observations.
fn writers<'a>(agents: &[AgentSpec], observations: &'a mut [f32]) -> impl Iterator<Item = (usize, Writer<'a>)> {
    let mut rest = observations;
    agents.iter().enumerate().map(move |(i, agent)| {
        let (own, others) = std::mem::take(&mut rest).split_at_mut(agent.observation);
        rest = others;
        (i, Writer { rest: own })
    })
}

/// Writes numbers one after the other into a flat observation buffer.
struct Writer<'a> {
    rest: &'a mut [f32],
}

impl Writer<'_> {
    fn numbers(&mut self, numbers: &[f64]) {
        let (head, tail) = std::mem::take(&mut self.rest).split_at_mut(numbers.len());
        for (to, &from) in head.iter_mut().zip(numbers) {
            *to = from as f32;
        }
        self.rest = tail;
    }

    fn pair(&mut self, pair: [f64; 2]) {
        self.numbers(&pair);
    }

    /// The offset from `body` to `other`, or zeros beyond the squared radius.
    fn seen(&mut self, world: World<'_>, body: usize, other: usize, squared_radius: f64) -> bool {
        let d = world.offset(body, other);
        let seen = d[0] * d[0] + d[1] * d[1] <= squared_radius;
        self.pair(if seen { d } else { [0.0; 2] });
        seen
    }
}
