//! A minibatch, its tiles of rows, and the critic's view of them: all observations, then all actions.

use super::Actors;
use crate::nn::{Input, Mlp};

/// A minibatch of B transitions; O and A are all learners' observation and action widths together.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// B.
    pub rows: usize,
    /// `[B, O]`.
    pub observations: Vec<f32>,
    /// `[B, O]`.
    pub next_observations: Vec<f32>,
    /// `[B, A]`.
    pub actions: Vec<f32>,
    /// `[B, N, N]`, sender by receiver.
    pub link: Vec<bool>,
    /// `[B, N, N]`.
    pub next_link: Vec<bool>,
    /// Raw team reward `[B]`.
    pub reward: Vec<f32>,
    /// Shaping bonus stored at rollout `[B]`; zeros when shaping is computed on the minibatch or off.
    pub bonus: Vec<f32>,
}

/// Consecutive rows of a batch.
pub(super) struct Tile<'a> {
    pub(super) observations: &'a [f32],
    pub(super) next_observations: &'a [f32],
    pub(super) actions: &'a [f32],
    pub(super) link: &'a [bool],
    pub(super) next_link: &'a [bool],
    pub(super) reward: &'a [f32],
}

impl<'a> Tile<'a> {
    pub(super) fn of(batch: &'a Batch, start: usize, rows: usize, widths: Widths, learners: usize) -> Self {
        let [o, a, l] =
            [widths.observations, widths.actions, learners * learners].map(|w| start * w..(start + rows) * w);
        Self {
            observations: &batch.observations[o.clone()],
            next_observations: &batch.next_observations[o],
            actions: &batch.actions[a],
            link: &batch.link[l.clone()],
            next_link: &batch.next_link[l],
            reward: &batch.reward[start..start + rows],
        }
    }
}

/// Widths of the critic's input: all observations, then all actions.
#[derive(Clone, Copy)]
pub(super) struct Widths {
    pub(super) observations: usize,
    pub(super) actions: usize,
}

impl Widths {
    pub(super) fn of(actors: &Actors) -> Self {
        Self { observations: actors.observation.iter().sum(), actions: actors.networks.iter().map(Mlp::outputs).sum() }
    }

    pub(super) fn joint(self) -> usize {
        self.observations + self.actions
    }

    /// Columns of actor `i`'s action in the critic's input.
    pub(super) fn action(self, actors: &Actors, i: usize) -> std::ops::Range<usize> {
        let start = self.observations + actors.networks[..i].iter().map(Mlp::outputs).sum::<usize>();
        start..start + actors.networks[i].outputs()
    }

    /// Lays rows into the critic's input rows, from column `at`.
    pub(super) fn put(self, joint: &mut [f32], rows: &[f32], at: usize) {
        let width = rows.len() * self.joint() / joint.len();
        for (to, from) in joint.chunks_exact_mut(self.joint()).zip(rows.chunks_exact(width)) {
            to[at..at + width].copy_from_slice(from);
        }
    }

    pub(super) fn input(self, joint: &[f32]) -> Input<'_> {
        Input { data: joint, stride: self.joint() }
    }
}
