//! One recorded episode in memory: T steps, T + 1 rows.

use sha2::{Digest as _, Sha256};

use super::{Layout, SchemaError};

/// A row-major `f32` matrix.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Matrix {
    /// Elements, row by row.
    pub data: Vec<f32>,
    /// Columns. A matrix of width 0 has no rows.
    pub width: usize,
}

impl Matrix {
    /// An empty matrix of `width` columns with room for `rows`.
    pub fn with_capacity(rows: usize, width: usize) -> Self {
        Self { data: Vec::with_capacity(rows * width), width }
    }

    /// Rows.
    pub fn rows(&self) -> usize {
        self.data.len().checked_div(self.width).unwrap_or(0)
    }

    /// Row `r`, `[width]`.
    pub fn row(&self, r: usize) -> &[f32] {
        &self.data[r * self.width..(r + 1) * self.width]
    }
}

/// One episode of T steps. Row T carries the final observation, messages and links; actions and rewards have T rows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Episode {
    /// 0-based number within the store.
    pub index: u64,
    /// T.
    pub steps: usize,
    /// True when the last row is a terminal state; false when time ran out.
    pub terminal: bool,
    /// Simulator state before the action, `[(T+1), S]`, world units.
    pub state: Vec<f64>,
    /// Per agent `[(T+1), observation]`.
    pub observations: Vec<Matrix>,
    /// Per agent, what it sent, before the channel, `[(T+1), message]`; width 0 for who does not send.
    pub messages: Vec<Matrix>,
    /// Link bits `[(T+1), N, N]`, sender by receiver over the communicators, diagonal true.
    pub link: Vec<bool>,
    /// Per agent `[T, action]`; width 0 for who does not act.
    pub actions: Vec<Matrix>,
    /// Team reward `[T]`.
    pub reward: Vec<f32>,
    /// Per agent `[T]`.
    pub rewards: Vec<Vec<f32>>,
}

impl Episode {
    /// An empty episode of this layout with room for `steps` steps.
    pub fn with_capacity(layout: &Layout, index: u64, steps: usize) -> Self {
        let n = layout.communicators().len();
        let matrices = |rows: usize, width: fn(&super::AgentSpec) -> usize| {
            layout.agents.iter().map(|a| Matrix::with_capacity(rows, width(a))).collect()
        };
        Self {
            index,
            steps: 0,
            terminal: false,
            state: Vec::with_capacity((steps + 1) * layout.state_fields.len()),
            observations: matrices(steps + 1, |a| a.observation),
            messages: matrices(steps + 1, |a| a.message),
            link: Vec::with_capacity((steps + 1) * n * n),
            actions: matrices(steps, |a| a.action),
            reward: Vec::with_capacity(steps),
            rewards: vec![Vec::with_capacity(steps); layout.agents.len()],
        }
    }

    /// Rows: T + 1.
    pub fn rows(&self) -> usize {
        self.steps + 1
    }

    /// Sum of the team reward over the episode.
    pub fn episode_return(&self) -> f64 {
        self.reward.iter().map(|&r| f64::from(r)).sum()
    }

    /// Link bit from communicator `sender` to `receiver` (positions among `n` communicators) at `row`.
    pub fn delivered(&self, n: usize, row: usize, sender: usize, receiver: usize) -> bool {
        self.link[(row * n + sender) * n + receiver]
    }

    /// Checks every length against the layout, and the link diagonal.
    ///
    /// # Errors
    /// [`SchemaError::Length`] or [`SchemaError::Value`] that names the column.
    pub fn check(&self, layout: &Layout) -> Result<(), SchemaError> {
        let length = |column: String, expected: usize, found: usize| {
            if expected == found { Ok(()) } else { Err(SchemaError::Length { column, expected, found }) }
        };
        let (t, agents) = (self.steps, layout.agents.len());
        length("state".to_owned(), (t + 1) * layout.state_fields.len(), self.state.len())?;
        length("agents".to_owned(), agents, self.observations.len())?;
        length("agents".to_owned(), agents, self.messages.len())?;
        length("agents".to_owned(), agents, self.actions.len())?;
        length("agents".to_owned(), agents, self.rewards.len())?;
        for (i, agent) in layout.agents.iter().enumerate() {
            length(
                format!("observation.{}", agent.name),
                (t + 1) * agent.observation,
                self.observations[i].data.len(),
            )?;
            length(format!("message.{}", agent.name), (t + 1) * agent.message, self.messages[i].data.len())?;
            length(format!("action.{}", agent.name), t * agent.action, self.actions[i].data.len())?;
            length(format!("reward.{}", agent.name), t, self.rewards[i].len())?;
        }
        length("reward".to_owned(), t, self.reward.len())?;
        let n = layout.communicators().len();
        length("link".to_owned(), (t + 1) * n * n, self.link.len())?;
        for row in 0..=t {
            if let Some(c) = (0..n).find(|&c| !self.delivered(n, row, c, c)) {
                let message = format!("step {row}: the diagonal must be true, communicator {c} has false");
                return Err(SchemaError::Value { column: "link".to_owned(), message });
            }
        }
        Ok(())
    }

    /// SHA-256 of the content, independent of container, compression and agent-column order on disk.
    ///
    /// Over: `steps`, `terminal`, then per column in manifest order its little-endian elements: state, observations,
    /// messages, link (one byte each), actions, reward, rewards.
    pub fn content_hash(&self) -> [u8; 32] {
        let mut hash = Sha256::new();
        hash.update(b"ccmarl episode v1");
        hash.update((self.steps as u64).to_le_bytes());
        hash.update([u8::from(self.terminal)]);
        if cfg!(target_endian = "little") {
            hash.update(bytemuck::cast_slice::<f64, u8>(&self.state));
        } else {
            self.state.iter().for_each(|v| hash.update(v.to_le_bytes()));
        }
        let floats = |hash: &mut Sha256, data: &[f32]| {
            if cfg!(target_endian = "little") {
                hash.update(bytemuck::cast_slice::<f32, u8>(data));
            } else {
                for value in data {
                    hash.update(value.to_le_bytes());
                }
            }
        };
        for m in self.observations.iter().chain(&self.messages) {
            floats(&mut hash, &m.data);
        }
        hash.update(self.link.iter().map(|&b| u8::from(b)).collect::<Vec<u8>>());
        for m in &self.actions {
            floats(&mut hash, &m.data);
        }
        floats(&mut hash, &self.reward);
        for r in &self.rewards {
            floats(&mut hash, r);
        }
        hash.finalize().into()
    }
}
