//! Replay memory: the newest episodes, whole, in flat arrays; and the rings of delivered and lost messages.

use rand::Rng;

use super::TrainError;
use crate::algo::Batch;
use crate::rng;
use crate::schema::{Episode, Layout};

/// The newest `capacity` transitions, as whole episodes of `steps` steps. Observations are kept once per row; the row
/// after a transition's is its successor.
#[derive(Clone, Debug)]
pub struct Replay {
    /// Steps per episode, T.
    pub steps: usize,
    /// Episodes kept at most.
    pub capacity: usize,
    /// Episodes pushed so far.
    pub pushed: u64,
    learners: Vec<usize>,
    names: Vec<String>,
    widths: [usize; 3],
    /// `[episode, T + 1, O]`.
    pub observations: Vec<f32>,
    /// `[episode, T + 1, N²]`.
    pub link: Vec<bool>,
    /// `[episode, T, A]`.
    pub actions: Vec<f32>,
    /// `[episode, T]`.
    pub reward: Vec<f32>,
    /// Shaping stored at rollout `[episode, T]`; zeros when shaping is not stored.
    pub bonus: Vec<f32>,
}

impl Replay {
    /// An empty memory for episodes of this layout; learners must be the communicators, and a message the sender's
    /// observation.
    ///
    /// # Errors
    /// [`TrainError::Store`] when learners and communicators differ, or `capacity` is less than an episode.
    pub fn new(layout: &Layout, steps: usize, capacity: usize) -> Result<Self, TrainError> {
        let learners = layout.learners();
        if learners.is_empty() || learners != layout.communicators() {
            return Err(TrainError::Store("the learners must be the communicators, and at least one".to_owned()));
        }
        if capacity < steps || steps == 0 {
            return Err(TrainError::Store(format!("replay {capacity} holds no episode of {steps} steps")));
        }
        let sum =
            |width: fn(&crate::schema::AgentSpec) -> usize| learners.iter().map(|&a| width(&layout.agents[a])).sum();
        Ok(Self {
            steps,
            capacity: capacity / steps,
            pushed: 0,
            names: learners.iter().map(|&a| layout.agents[a].name.clone()).collect(),
            widths: [sum(|a| a.observation), sum(|a| a.action), learners.len() * learners.len()],
            learners,
            observations: Vec::new(),
            link: Vec::new(),
            actions: Vec::new(),
            reward: Vec::new(),
            bonus: Vec::new(),
        })
    }

    /// Transitions in memory.
    pub fn len(&self) -> usize {
        self.reward.len()
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.reward.is_empty()
    }

    /// Adds an episode, forgetting the oldest when full. `bonus` is the shaping stored at rollout `[T]`, or empty.
    ///
    /// # Errors
    /// [`TrainError::Store`] when the episode has another length, or a message is not the sender's observation.
    pub fn push(&mut self, episode: &Episode, bonus: &[f32]) -> Result<(), TrainError> {
        if episode.steps != self.steps {
            return Err(TrainError::Store(format!(
                "episode {} has {} steps, the trainer needs {}",
                episode.index, episode.steps, self.steps
            )));
        }
        for (name, &a) in self.names.iter().zip(&self.learners) {
            if episode.messages[a].data != episode.observations[a].data {
                return Err(TrainError::Store(format!(
                    "episode {}: message.{name} is not observation.{name}; only policies that send their observation can warm-start",
                    episode.index
                )));
            }
        }
        let [o, a, l] = self.widths;
        let slot = (self.pushed % self.capacity as u64) as usize;
        let rows = self.steps + 1;
        if self.reward.len() <= slot * self.steps {
            self.observations.resize((slot + 1) * rows * o, 0.0);
            self.link.resize((slot + 1) * rows * l, false);
            self.actions.resize((slot + 1) * self.steps * a, 0.0);
            self.reward.resize((slot + 1) * self.steps, 0.0);
            self.bonus.resize((slot + 1) * self.steps, 0.0);
        }
        interleave(
            &mut self.observations[slot * rows * o..(slot + 1) * rows * o],
            o,
            &self.learners,
            &episode.observations,
        );
        interleave(
            &mut self.actions[slot * self.steps * a..(slot + 1) * self.steps * a],
            a,
            &self.learners,
            &episode.actions,
        );
        self.link[slot * rows * l..(slot + 1) * rows * l].copy_from_slice(&episode.link);
        let range = slot * self.steps..(slot + 1) * self.steps;
        self.reward[range.clone()].copy_from_slice(&episode.reward);
        if bonus.is_empty() {
            self.bonus[range].fill(0.0);
        } else {
            self.bonus[range].copy_from_slice(bonus);
        }
        self.pushed += 1;
        Ok(())
    }

    /// Takes over the arrays of a checkpoint: observations, actions, reward, bonus; link; episodes pushed.
    ///
    /// # Errors
    /// What does not fit, as text.
    pub(super) fn restore(&mut self, arrays: [Vec<f32>; 4], link: Vec<bool>, pushed: u64) -> Result<(), String> {
        let episodes = pushed.min(self.capacity as u64) as usize;
        let [o, a, l] = self.widths;
        let (t, rows) = (episodes * self.steps, episodes * (self.steps + 1));
        let found = [arrays[0].len(), arrays[1].len(), arrays[2].len(), arrays[3].len(), link.len()];
        let expected = [rows * o, t * a, t, t, rows * l];
        if found != expected {
            return Err(format!("the replay arrays have lengths {found:?}, expected {expected:?}"));
        }
        let [observations, actions, reward, bonus] = arrays;
        (self.observations, self.actions, self.reward, self.bonus) = (observations, actions, reward, bonus);
        (self.link, self.pushed) = (link, pushed);
        Ok(())
    }

    /// Where a transition's observations, actions and link bits start in their arrays.
    pub(super) fn places(&self, transition: usize) -> [usize; 3] {
        let [o, a, l] = self.widths;
        let row = transition + transition / self.steps;
        [row * o, transition * a, row * l]
    }

    /// Gives each row of `batch` the link bits of another transition, for o and o' alike ([`Masks::Redrawn`]).
    ///
    /// [`Masks::Redrawn`]: crate::algo::Masks::Redrawn
    pub fn redraw_links<R: Rng + ?Sized>(&self, rng: &mut R, batch: &mut Batch) {
        let l = self.widths[2];
        for (now, next) in batch.link.chunks_exact_mut(l).zip(batch.next_link.chunks_exact_mut(l)) {
            let [_, _, at] = self.places(rng::below(rng, self.len()));
            now.copy_from_slice(&self.link[at..at + l]);
            next.copy_from_slice(&self.link[at..at + l]);
        }
    }

    /// Draws `rows` transitions with replacement into `batch`.
    pub fn sample<R: Rng + ?Sized>(&self, rng: &mut R, rows: usize, batch: &mut Batch) {
        let [o, a, l] = self.widths;
        batch.rows = rows;
        for buffer in [
            &mut batch.observations,
            &mut batch.next_observations,
            &mut batch.actions,
            &mut batch.reward,
            &mut batch.bonus,
        ] {
            buffer.clear();
        }
        batch.link.clear();
        batch.next_link.clear();
        for _ in 0..rows {
            let transition = rng::below(rng, self.len());
            let row = transition + transition / self.steps;
            batch.observations.extend_from_slice(&self.observations[row * o..(row + 1) * o]);
            batch.next_observations.extend_from_slice(&self.observations[(row + 1) * o..(row + 2) * o]);
            batch.link.extend_from_slice(&self.link[row * l..(row + 1) * l]);
            batch.next_link.extend_from_slice(&self.link[(row + 1) * l..(row + 2) * l]);
            batch.actions.extend_from_slice(&self.actions[transition * a..(transition + 1) * a]);
            batch.reward.push(self.reward[transition]);
            batch.bonus.push(self.bonus[transition]);
        }
    }
}

/// Lays the learners' matrices side by side, row by row.
fn interleave(out: &mut [f32], width: usize, learners: &[usize], columns: &[crate::schema::Matrix]) {
    let mut at = 0;
    for &agent in learners {
        let column = &columns[agent];
        for (row, out) in out.chunks_exact_mut(width).enumerate() {
            out[at..at + column.width].copy_from_slice(column.row(row));
        }
        at += column.width;
    }
}

/// A ring of (message, action) pairs of all links, each padded with zeros to the widest.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ring {
    /// Pairs kept at most.
    pub capacity: usize,
    /// Pairs pushed so far.
    pub pushed: u64,
    /// Widths of a message and of an action.
    pub widths: [usize; 2],
    /// `[pairs, message]`.
    pub messages: Vec<f32>,
    /// `[pairs, action]`.
    pub actions: Vec<f32>,
}

impl Ring {
    /// An empty ring.
    pub fn new(capacity: usize, widths: [usize; 2]) -> Self {
        Self { capacity, widths, ..Self::default() }
    }

    /// Pairs in the ring.
    pub fn len(&self) -> usize {
        self.pushed.min(self.capacity as u64) as usize
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.pushed == 0
    }

    /// Adds a pair, forgetting the oldest when full.
    pub fn push(&mut self, message: &[f32], action: &[f32]) {
        let slot = (self.pushed % self.capacity as u64) as usize;
        let [m, a] = self.widths;
        self.messages.resize(self.messages.len().max((slot + 1) * m), 0.0);
        self.actions.resize(self.actions.len().max((slot + 1) * a), 0.0);
        for (buffer, width, value) in [(&mut self.messages, m, message), (&mut self.actions, a, action)] {
            let target = &mut buffer[slot * width..(slot + 1) * width];
            target[..value.len()].copy_from_slice(value);
            target[value.len()..].fill(0.0);
        }
        self.pushed += 1;
    }

    /// Forgets everything.
    pub(super) fn clear(&mut self) {
        self.pushed = 0;
        self.messages.clear();
        self.actions.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Seeds;
    use crate::schema::{AgentSpec, Controller, Matrix};

    fn layout() -> Layout {
        let agent = |name: &str, communicator| AgentSpec {
            name: name.to_owned(),
            team: "t".to_owned(),
            controller: Controller::Policy,
            learner: communicator,
            communicator,
            observation: 2,
            message: if communicator { 2 } else { 0 },
            action: 1,
        };
        Layout { agents: vec![agent("a", true), agent("prey", false), agent("b", true)], state_fields: vec![] }
    }

    /// An episode whose every number tells where it came from.
    fn episode(index: u64, steps: usize) -> Episode {
        let mut e = Episode { index, steps, ..Episode::with_capacity(&layout(), index, steps) };
        for agent in 0..3 {
            let value = |row: usize, c: usize| (index * 1000 + row as u64 * 10) as f32 + agent as f32 + c as f32 / 10.0;
            let fill = |rows: usize, width: usize| Matrix {
                data: (0..rows).flat_map(|r| (0..width).map(move |c| value(r, c))).collect(),
                width,
            };
            e.observations[agent] = fill(steps + 1, 2);
            e.messages[agent] = if agent == 1 { Matrix::default() } else { fill(steps + 1, 2) };
            e.actions[agent] = fill(steps, 1);
            e.rewards[agent] = vec![0.0; steps];
        }
        e.reward = (0..steps).map(|t| (index * 100 + t as u64) as f32).collect();
        e.link = (0..=steps).flat_map(|t| [true, t % 2 == 0, t % 3 == 0, true]).collect();
        e
    }

    #[test]
    fn a_sampled_transition_is_one_row_and_its_successor_also_after_the_ring_wrapped() {
        let mut replay = Replay::new(&layout(), 4, 12).unwrap();
        for index in 0..5 {
            replay.push(&episode(index, 4), &[]).unwrap();
        }
        assert_eq!(replay.len(), 12);
        let mut batch = Batch::default();
        replay.sample(&mut Seeds::new(1).stream("s"), 200, &mut batch);
        for i in 0..200 {
            let (e, t) = (batch.reward[i] as u64 / 100, batch.reward[i] as u64 % 100);
            assert!((2..5).contains(&e) && t < 4);
            let (here, next) = ((e * 1000 + t * 10) as f32, (e * 1000 + t * 10 + 10) as f32);
            assert_eq!(batch.observations[i * 4..i * 4 + 4], [here, here + 0.1, here + 2.0, here + 2.1]);
            assert_eq!(batch.next_observations[i * 4], next);
            assert_eq!(batch.actions[i * 2..i * 2 + 2], [here, here + 2.0]);
            assert_eq!(batch.link[i * 4 + 1], t % 2 == 0);
            assert_eq!(batch.next_link[i * 4 + 2], (t + 1) % 3 == 0);
        }
    }

    #[test]
    fn redrawn_links_are_those_of_some_transition_for_both_observations() {
        let mut replay = Replay::new(&layout(), 4, 12).unwrap();
        (0..3).for_each(|index| replay.push(&episode(index, 4), &[]).unwrap());
        let (mut batch, mut rng) = (Batch::default(), Seeds::new(1).stream("s"));
        replay.sample(&mut rng, 500, &mut batch);
        let kept = batch.clone();
        replay.redraw_links(&mut rng, &mut batch);
        assert_eq!(batch.link, batch.next_link);
        assert_ne!(batch.link, kept.link);
        assert_eq!(batch.observations, kept.observations);
        // of the steps 0..4, two deliver a → b and two (0 and 3) b → a
        for (at, steps) in [(1, 2.0), (2, 2.0)] {
            let delivered = batch.link.iter().skip(at).step_by(4).filter(|&&bit| bit).count() as f64;
            assert!((delivered / 500.0 - steps / 4.0).abs() < 0.1, "{at}: {delivered}");
        }
    }

    #[test]
    fn episodes_that_cannot_train_are_refused_by_name() {
        let mut replay = Replay::new(&layout(), 4, 12).unwrap();
        let error = replay.push(&episode(0, 3), &[]).unwrap_err().to_string();
        assert!(error.contains("episode 0 has 3 steps, the trainer needs 4"), "{error}");
        let mut other = episode(7, 4);
        other.messages[2].data[0] += 1.0;
        let error = replay.push(&other, &[]).unwrap_err().to_string();
        assert!(error.contains("message.b is not observation.b"), "{error}");
    }

    #[test]
    fn a_ring_keeps_the_newest_pairs_and_pads_with_zeros() {
        let mut ring = Ring::new(2, [3, 1]);
        ring.push(&[1.0, 2.0, 3.0], &[1.0]);
        ring.push(&[4.0, 5.0, 6.0], &[2.0]);
        ring.push(&[7.0], &[3.0]);
        assert_eq!((ring.len(), &ring.messages[..]), (2, &[7.0, 0.0, 0.0, 4.0, 5.0, 6.0][..]));
    }
}
