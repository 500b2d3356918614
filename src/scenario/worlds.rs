//! Many worlds of one scenario in flat arrays, stepped together: the same numbers, to the bit, as one by one.

use super::{Scenario, Scratch};
use crate::rng::Stream;

/// Rows of state of `count` worlds, one after the other. No method allocates after the first step.
///
/// Flat buffers concatenate the worlds in order: `observations` `[count · Σ observation]`, `actions` `[count · Σ action]`,
/// `rewards` `[count · agents]`, `team` `[count]`.
pub struct Worlds<'a> {
    scenario: &'a dyn Scenario,
    width: usize,
    observation: usize,
    action: usize,
    state: Vec<f64>,
    scratch: Scratch,
}

impl std::fmt::Debug for Worlds<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Worlds").field("count", &self.len()).field("state", &self.state).finish_non_exhaustive()
    }
}

impl<'a> Worlds<'a> {
    /// `count` worlds, everything at rest in the origin: reset them.
    pub fn new(scenario: &'a dyn Scenario, count: usize) -> Self {
        let agents = scenario.agents();
        let width = scenario.shape().width();
        Self {
            scenario,
            width,
            observation: agents.iter().map(|a| a.observation).sum(),
            action: agents.iter().map(|a| a.action).sum(),
            state: vec![0.0; count * width],
            scratch: Scratch::default(),
        }
    }

    /// How many.
    pub fn len(&self) -> usize {
        self.state.len().checked_div(self.width).unwrap_or(0)
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.state.is_empty()
    }

    /// The state of world `i`, as the `state` column holds it.
    pub fn state(&self, i: usize) -> &[f64] {
        &self.state[i * self.width..(i + 1) * self.width]
    }

    /// The states of all worlds, one after the other.
    pub fn states(&self) -> &[f64] {
        &self.state
    }

    /// Starts a new episode in world `i`.
    pub fn reset(&mut self, i: usize, rng: &mut Stream) {
        self.scenario.reset(&mut self.state[i * self.width..(i + 1) * self.width], rng);
    }

    /// Writes all worlds' observations.
    pub fn observe(&self, observations: &mut [f32]) {
        let rows = observations.chunks_exact_mut(self.observation);
        for (state, row) in self.state.chunks_exact(self.width).zip(rows) {
            self.scenario.observe(state, row);
        }
    }

    /// Writes the actions of the scripted agents; every world draws from its own stream.
    pub fn scripted(&self, rngs: &mut [Stream], actions: &mut [f32]) {
        let rows = actions.chunks_exact_mut(self.action).zip(rngs);
        for (state, (row, rng)) in self.state.chunks_exact(self.width).zip(rows) {
            self.scenario.scripted(state, rng, row);
        }
    }

    /// Moves every world by one step.
    pub fn step(&mut self, actions: &[f32], rewards: &mut [f32], team: &mut [f32]) {
        let agents = self.scenario.agents().len();
        let rows = actions.chunks_exact(self.action).zip(rewards.chunks_exact_mut(agents)).zip(team);
        for (state, ((actions, rewards), team)) in self.state.chunks_exact_mut(self.width).zip(rows) {
            self.scenario.step(state, actions, rewards, &mut self.scratch);
            *team = self.scenario.team_reward(rewards);
        }
    }
}
