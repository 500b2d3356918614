//! Re-simulation: every step of a store again, from its recorded state and actions, whoever wrote it.

use super::RecordError;
use crate::registry::Spec;
use crate::scenario::{Scenario, Scratch, offsets};
use crate::schema::{Episode, Layout, Manifest, Matrix};

/// Largest difference that two correct programs may have in a state column, world units.
pub const STATE_TOLERANCE: f64 = 1e-9;

/// Largest difference in observations and rewards (stored as `f32`), as a part of max(1, |value|).
pub const FLOAT_TOLERANCE: f64 = 1e-6;

/// How far a column of a store is from its re-simulation.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Difference {
    /// The column.
    pub column: String,
    /// Largest difference, as a part of max(1, |value|).
    pub largest: f64,
    /// What it may be.
    pub tolerance: f64,
    /// Episode and step of the largest one.
    pub episode: u64,
    /// Row within the episode.
    pub step: usize,
}

impl Difference {
    /// Whether the column is what the scenario would have produced.
    pub fn holds(&self) -> bool {
        self.largest <= self.tolerance
    }

    fn compare<T: Copy + Into<f64>>(&mut self, episode: u64, step: usize, found: &[T], expected: &[T]) {
        for (&found, &expected) in found.iter().zip(expected) {
            let (found, expected): (f64, f64) = (found.into(), expected.into());
            let difference = (found - expected).abs() / expected.abs().max(1.0);
            if difference.is_nan() || difference > self.largest {
                (self.largest, self.episode, self.step) = (difference, episode, step);
            }
        }
    }
}

/// Builds the scenario that a store's manifest names.
///
/// # Errors
/// [`RecordError::Scenario`] when it cannot be built, [`RecordError::Mismatch`] when it names none.
pub fn scenario_of(manifest: &Manifest) -> Result<Box<dyn Scenario>, RecordError> {
    let named = manifest.scenario.clone();
    let spec: Spec = serde_json::from_value(named).map_err(|e| RecordError::Mismatch(format!("scenario: {e}")))?;
    Ok(crate::scenario::build(&spec)?)
}

/// Compares the columns of a store with those of its scenario; messages may be of any width.
fn check_layout(scenario: &dyn Scenario, layout: &Layout) -> Result<(), RecordError> {
    let fail = |message: String| Err(RecordError::Mismatch(message));
    let (fields, agents) = (scenario.state_fields(), scenario.agents());
    if fields != layout.state_fields {
        let other = fields.iter().zip(&layout.state_fields).find(|(a, b)| a != b);
        let what = other.map_or(String::new(), |(a, b)| format!(", and {b} stands where {a} should"));
        let (expected, found) = (fields.len(), layout.state_fields.len());
        return fail(format!("state_fields: the scenario has {expected}, the store {found}{what}"));
    }
    if agents.len() != layout.agents.len() {
        return fail(format!("agents: the scenario has {}, the store {}", agents.len(), layout.agents.len()));
    }
    for (own, other) in agents.iter().zip(&layout.agents) {
        if (&own.name, own.observation, own.action) != (&other.name, other.observation, other.action) {
            let show = |a: &crate::schema::AgentSpec| {
                format!("{} (observation {}, action {})", a.name, a.observation, a.action)
            };
            return fail(format!(
                "agents: the scenario has {}, the store {}: another profile?",
                show(own),
                show(other)
            ));
        }
    }
    Ok(())
}

/// A store's episodes played again: the state and rewards that each recorded state and its actions lead to, and the
/// observations of every row, compared with what is recorded.
pub struct Resimulation {
    scenario: Box<dyn Scenario>,
    scratch: Scratch,
    state: Difference,
    observations: Vec<Difference>,
    reward: Difference,
    rewards: Vec<Difference>,
    /// Where each agent's observation lies in a flat buffer.
    observation_offsets: Vec<usize>,
}

impl std::fmt::Debug for Resimulation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Resimulation").field("scenario", &self.scenario.parameters()).finish_non_exhaustive()
    }
}

impl Resimulation {
    /// Builds the scenario that a store's manifest names; its columns must be the store's.
    ///
    /// # Errors
    /// [`RecordError::Scenario`] when it cannot be built, [`RecordError::Mismatch`] when its columns are others.
    pub fn of(manifest: &Manifest) -> Result<Self, RecordError> {
        let (scenario, layout) = (scenario_of(manifest)?, manifest.layout());
        check_layout(&*scenario, &layout)?;
        let column = |column: String, tolerance| Difference { column, largest: 0.0, tolerance, episode: 0, step: 0 };
        let named =
            |kind: &str| layout.agents.iter().map(|a| column(format!("{kind}.{}", a.name), FLOAT_TOLERANCE)).collect();
        Ok(Self {
            scratch: Scratch::default(),
            state: column("state".to_owned(), STATE_TOLERANCE),
            observations: named("observation"),
            reward: column("reward".to_owned(), FLOAT_TOLERANCE),
            rewards: named("reward"),
            observation_offsets: offsets(scenario.agents(), |a| a.observation),
            scenario,
        })
    }

    /// The differences so far, per column: `state`, `observation.*`, `reward`, `reward.*`.
    pub fn differences(self) -> Vec<Difference> {
        let all = std::iter::once(self.state).chain(self.observations);
        all.chain(std::iter::once(self.reward)).chain(self.rewards).collect()
    }

    /// Plays an episode of the store again, step by step, each from its recorded state.
    ///
    /// # Errors
    /// [`RecordError::Mismatch`] for a state or an action that the scenario cannot have.
    pub fn play(&mut self, e: &Episode) -> Result<(), RecordError> {
        let (scenario, width) = (&*self.scenario, self.scenario.shape().width());
        let at = |step: usize, message: &str| format!("episode {} step {step}: {message}", e.index);
        let mut seen = vec![0.0; self.observation_offsets[e.observations.len()]];
        let mut rewards = vec![0.0; e.rewards.len()];
        let (mut actions, mut next) = (Vec::new(), Vec::new());
        for (step, recorded) in e.state.chunks_exact(width.max(1)).enumerate() {
            scenario.check_state(recorded).map_err(|m| RecordError::Mismatch(at(step, &m)))?;
            scenario.observe(recorded, &mut seen);
            for (a, (column, found)) in self.observations.iter_mut().zip(&e.observations).enumerate() {
                let own = &seen[self.observation_offsets[a]..self.observation_offsets[a + 1]];
                column.compare(e.index, step, found.row(step), own);
            }
            if step == e.steps {
                break; // the last row has no action
            }
            actions.clear();
            for (agent, taken) in scenario.agents().iter().zip(&e.actions) {
                let taken = Matrix::row(taken, step);
                let checked = scenario.space().check(taken);
                checked.map_err(|m| RecordError::Mismatch(at(step, &format!("action.{}: {m}", agent.name))))?;
                actions.extend_from_slice(taken);
            }
            next.clear();
            next.extend_from_slice(recorded);
            scenario.step(&mut next, &actions, &mut rewards, &mut self.scratch);
            self.state.compare(e.index, step + 1, &e.state[(step + 1) * width..(step + 2) * width], &next);
            self.reward.compare(e.index, step, &e.reward[step..=step], &[scenario.team_reward(&rewards)]);
            for (a, column) in self.rewards.iter_mut().enumerate() {
                column.compare(e.index, step, &e.rewards[a][step..=step], &rewards[a..=a]);
            }
        }
        Ok(())
    }
}
