//! Who is in an episode, and how wide each of their columns is.

use serde::{Deserialize, Serialize};

use super::SchemaError;

/// Who chooses an agent's actions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Controller {
    /// The policy under study.
    Policy,
    /// A rule of the scenario (the prey).
    Scripted,
}

/// One agent of a scenario. Widths are element counts; 0 means that the column is absent from a store.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AgentSpec {
    /// Unique name, `adversary_0`; letters, digits and `_` only.
    pub name: String,
    /// Team name, `predators`.
    pub team: String,
    /// Who chooses its actions.
    pub controller: Controller,
    /// Whether a trainer optimises it.
    pub learner: bool,
    /// Whether it sends and receives messages.
    pub communicator: bool,
    /// Width of `observation.<name>`.
    pub observation: usize,
    /// Width of `message.<name>`.
    pub message: usize,
    /// Width of `action.<name>`.
    pub action: usize,
}

/// The shape of an episode: its agents in order and the names of its state fields.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Agents in manifest order.
    pub agents: Vec<AgentSpec>,
    /// Names of the state vector's elements, in order.
    pub state_fields: Vec<String>,
}

impl Layout {
    /// Most agents and widest column that any reader accepts: a bound for hostile files.
    pub const MAX_AGENTS: usize = 4096;
    /// Widest column that any reader accepts.
    pub const MAX_WIDTH: usize = 1 << 20;
    /// Most bytes that a row holds, and so the least memory a reader needs.
    pub const MAX_ROW_BYTES: usize = 48 << 20;

    /// Indices of the communicators, in order: the rows and columns of the link matrix.
    pub fn communicators(&self) -> Vec<usize> {
        (0..self.agents.len()).filter(|&a| self.agents[a].communicator).collect()
    }

    /// Indices of the learners, in order.
    pub fn learners(&self) -> Vec<usize> {
        (0..self.agents.len()).filter(|&a| self.agents[a].learner).collect()
    }

    /// Ordered pairs (sender, receiver) of distinct communicators, as agent indices, sender-major.
    pub fn links(&self) -> Vec<(usize, usize)> {
        let c = self.communicators();
        c.iter().flat_map(|&s| c.iter().filter(move |&&r| r != s).map(move |&r| (s, r))).collect()
    }

    /// Names of the state fields of agent `name`, without its name: `x y vx vy`.
    pub fn body_fields(&self, name: &str) -> Vec<String> {
        let own = |field: &String| Some(field.strip_prefix(name)?.strip_prefix('.')?.to_owned());
        self.state_fields.iter().filter_map(own).collect()
    }

    /// Checks names and widths.
    ///
    /// # Errors
    /// [`SchemaError::Manifest`] that names the agent.
    pub fn check(&self) -> Result<(), SchemaError> {
        let fail = |m: String| Err(SchemaError::Manifest(m));
        if self.agents.is_empty() || self.agents.len() > Self::MAX_AGENTS {
            return fail(format!("expected 1 to {} agents, found {}", Self::MAX_AGENTS, self.agents.len()));
        }
        if self.state_fields.len() > Self::MAX_WIDTH {
            return fail(format!("{} state fields are over the limit of {}", self.state_fields.len(), Self::MAX_WIDTH));
        }
        for (i, agent) in self.agents.iter().enumerate() {
            let name = &agent.name;
            if name.is_empty() || name.len() > 64 || !name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_') {
                return fail(format!("agent name {name:?}: use 1 to 64 letters, digits and underscores"));
            }
            if self.agents[..i].iter().any(|a| a.name == *name) {
                return fail(format!("agent name {name:?} occurs twice"));
            }
            if agent.observation.max(agent.message).max(agent.action) > Self::MAX_WIDTH {
                return fail(format!("agent {name}: a column is wider than {}", Self::MAX_WIDTH));
            }
        }
        let agents: usize = self.agents.iter().map(|a| 4 * (a.observation + a.message + a.action + 1)).sum();
        let row = 8 * self.state_fields.len() + self.communicators().len().pow(2) + agents;
        if row > Self::MAX_ROW_BYTES {
            return fail(format!("a row of {row} bytes is over the limit of {}", Self::MAX_ROW_BYTES));
        }
        Ok(())
    }
}
