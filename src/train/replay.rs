//! Replay memory: the newest episodes, whole, in flat arrays; and the rings of delivered and lost messages.

use std::ops::ControlFlow;

use rand::Rng;

use super::TrainError;
use crate::algo::Batch;
use crate::rng;
use crate::schema::{AgentSpec, Episode, Layout};
use crate::storage::{EpisodeSource, Rows};

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
    /// Whether messages are made by encoders.
    encoded: bool,
    learners: Vec<usize>,
    names: Vec<String>,
    /// Widths of a row: observations, actions, links.
    widths: [usize; 3],
    /// Per learner, width of its observation and of its action.
    own: [Vec<usize>; 2],
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
    /// An empty memory for episodes of this layout; learners must be the communicators. `encoded` says whether encoders
    /// make the messages: updates compute them anew from the observations, and what an episode says was sent is not
    /// looked at. Otherwise a message must be the sender's observation.
    ///
    /// # Errors
    /// [`TrainError::Store`] when learners and communicators differ, or `capacity` is less than an episode.
    pub fn new(layout: &Layout, steps: usize, capacity: usize, encoded: bool) -> Result<Self, TrainError> {
        let learners = layout.learners();
        if learners.is_empty() || learners != layout.communicators() {
            return Err(TrainError::Store("the learners must be the communicators, and at least one".to_owned()));
        }
        if capacity < steps || steps == 0 {
            return Err(TrainError::Store(format!("replay {capacity} holds no episode of {steps} steps")));
        }
        let own =
            |width: fn(&AgentSpec) -> usize| learners.iter().map(|&a| width(&layout.agents[a])).collect::<Vec<_>>();
        let own = [own(|a| a.observation), own(|a| a.action)];
        Ok(Self {
            steps,
            capacity: capacity / steps,
            pushed: 0,
            encoded,
            names: learners.iter().map(|&a| layout.agents[a].name.clone()).collect(),
            widths: [own[0].iter().sum(), own[1].iter().sum(), learners.len() * learners.len()],
            own,
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
        self.pushed.min(self.capacity as u64) as usize * self.steps
    }

    /// Whether it is empty.
    pub fn is_empty(&self) -> bool {
        self.pushed == 0
    }

    /// Makes the arrays as long as `episodes` episodes need. Fresh memory comes from the system as zeros and is touched
    /// only when it is filled.
    fn resize(&mut self, episodes: usize) {
        fn to<T: Clone + Default>(array: &mut Vec<T>, length: usize) {
            if array.is_empty() {
                *array = vec![T::default(); length];
            } else {
                array.resize(length, T::default());
            }
        }
        let [o, a, l] = self.widths;
        let (t, rows) = (episodes * self.steps, episodes * (self.steps + 1));
        to(&mut self.observations, rows * o);
        to(&mut self.link, rows * l);
        to(&mut self.actions, t * a);
        to(&mut self.reward, t);
        to(&mut self.bonus, t);
    }

    /// Adds all episodes that are left in a store, without shaping; what [`Replay::push`] would make of them, from whole
    /// columns. Returns how many they are.
    ///
    /// # Errors
    /// As [`Replay::push`], and [`TrainError::Storage`] when the store cannot be read; the memory then holds only a part.
    pub fn fill(&mut self, source: &mut dyn EpisodeSource) -> Result<u64, TrainError> {
        let (before, agents) = (self.pushed, self.learners.clone());
        let slots = |pushed: u64| pushed.min(self.capacity as u64) as usize;
        let expected = slots(before.saturating_add(source.manifest().episodes));
        self.resize(expected);
        let mut refused = Ok(());
        let read = source.read_rows(&agents, &mut |rows| {
            refused = self.push_rows(rows);
            if refused.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        });
        self.resize(self.len() / self.steps); // the store may have held less than it said
        read?;
        refused.map(|()| self.pushed - before)
    }

    /// Adds rows that follow those before.
    fn push_rows(&mut self, rows: &Rows<'_>) -> Result<(), TrainError> {
        self.check_rows(rows)?;
        let ([o, a, l], t, period) = (self.widths, self.steps, self.steps + 1);
        let slot = (self.pushed % self.capacity as u64) as usize;
        let needed = slot + (rows.step + rows.count).div_ceil(period);
        if needed.min(self.capacity) * t > self.reward.len() {
            self.resize(needed.min(self.capacity));
        }
        let (mut from, mut at) = (0, slot * period + rows.step);
        while from < rows.count {
            // as many rows as fit before the ring begins anew
            let n = (rows.count - from).min(self.capacity * period - at);
            interleave(&mut self.observations[at * o..(at + n) * o], &self.own[0], &rows.observations, from);
            self.link[at * l..(at + n) * l].copy_from_slice(&rows.link[from * l..(from + n) * l]);
            let mut done = 0;
            while done < n {
                let (episode, step) = ((at + done) / period, (at + done) % period);
                let (here, acted) = ((period - step).min(n - done), (t - step).min(n - done));
                let (row, to) = (from + done, episode * t + step);
                interleave(&mut self.actions[to * a..(to + acted) * a], &self.own[1], &rows.actions, row);
                self.reward[to..to + acted].copy_from_slice(&rows.reward[row..row + acted]);
                self.bonus[to..to + acted].fill(0.0);
                done += here;
            }
            (from, at) = (from + n, 0);
        }
        self.pushed += rows.ends.len() as u64;
        Ok(())
    }

    /// Every episode has T steps, and sends what it observes, unless an encoder sends.
    fn check_rows(&self, rows: &Rows<'_>) -> Result<(), TrainError> {
        let period = self.steps + 1;
        let ends = rows.ends.iter().enumerate();
        let mut lengths = ends.map(|(k, &end)| (k, rows.step + end - k * period));
        if let Some((k, steps)) = lengths.find(|&(_, steps)| steps != self.steps) {
            return Err(self.length(rows.episode + k as u64, &steps.to_string()));
        }
        let whole = rows.ends.len();
        if rows.step + rows.count - whole * period > self.steps {
            return Err(self.length(rows.episode + whole as u64, &format!("more than {}", self.steps)));
        }
        if self.encoded {
            return Ok(());
        }
        for ((name, observation), message) in self.names.iter().zip(&rows.observations).zip(&rows.messages) {
            if !std::ptr::eq(*observation, *message) && observation != message {
                let differs = observation.iter().zip(*message).position(|(o, m)| o != m).unwrap_or(0);
                let row = differs / (observation.len() / rows.count).max(1);
                let episode = rows.episode + rows.ends.partition_point(|&end| end < row) as u64;
                return Err(not_observed(episode, name));
            }
        }
        Ok(())
    }

    fn length(&self, episode: u64, steps: &str) -> TrainError {
        TrainError::Store(format!("episode {episode} has {steps} steps, the trainer needs {}", self.steps))
    }

    /// Adds an episode, forgetting the oldest when full. `bonus` is the shaping stored at rollout `[T]`, or empty.
    ///
    /// # Errors
    /// [`TrainError::Store`] when the episode has another length, or a message is not the sender's observation.
    pub fn push(&mut self, episode: &Episode, bonus: &[f32]) -> Result<(), TrainError> {
        if episode.steps != self.steps {
            return Err(self.length(episode.index, &episode.steps.to_string()));
        }
        for (name, &a) in self.names.iter().zip(&self.learners).filter(|_| !self.encoded) {
            if episode.messages[a].data != episode.observations[a].data {
                return Err(not_observed(episode.index, name));
            }
        }
        let [o, a, l] = self.widths;
        let slot = (self.pushed % self.capacity as u64) as usize;
        let rows = self.steps + 1;
        if self.reward.len() <= slot * self.steps {
            self.resize(slot + 1);
        }
        let [observed, acted] = [&episode.observations, &episode.actions]
            .map(|columns| self.learners.iter().map(|&a| &columns[a].data[..]).collect::<Vec<_>>());
        interleave(&mut self.observations[slot * rows * o..(slot + 1) * rows * o], &self.own[0], &observed, 0);
        interleave(&mut self.actions[slot * self.steps * a..(slot + 1) * self.steps * a], &self.own[1], &acted, 0);
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

fn not_observed(episode: u64, name: &str) -> TrainError {
    TrainError::Store(format!(
        "episode {episode}: message.{name} is not observation.{name}; only policies that send their observation can warm-start"
    ))
}

/// Lays columns of these widths side by side, row by row, from their row `from` on until `out` is full.
fn interleave(out: &mut [f32], widths: &[usize], columns: &[&[f32]], from: usize) {
    let (row, mut at) = (widths.iter().sum::<usize>().max(1), 0);
    for (column, &width) in columns.iter().zip(widths).filter(|(_, width)| **width > 0) {
        for (out, values) in out.chunks_exact_mut(row).zip(column[from * width..].chunks_exact(width)) {
            out[at..at + width].copy_from_slice(values);
        }
        at += width;
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
        let mut replay = Replay::new(&layout(), 4, 12, false).unwrap();
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
        let mut replay = Replay::new(&layout(), 4, 12, false).unwrap();
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
        let mut replay = Replay::new(&layout(), 4, 12, false).unwrap();
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
