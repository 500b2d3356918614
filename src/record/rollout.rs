//! Episodes: each a pure function of the seed and its number; computed in parallel, stored in order.

use std::sync::atomic::{AtomicBool, Ordering};

use rayon::iter::{IntoParallelIterator as _, ParallelIterator as _};

use super::{Policy, RecordError, View};
use crate::link::Link;
use crate::rng::Seeds;
use crate::scenario::{Scenario, Scratch};
use crate::schema::{Episode, Layout, Manifest};
use crate::storage::EpisodeSink;

/// What is recorded.
#[derive(Clone, Copy)]
pub struct Recording<'a> {
    /// The task.
    pub scenario: &'a dyn Scenario,
    /// Which messages arrive.
    pub link: &'a dyn Link,
    /// Who sends and acts.
    pub policy: &'a dyn Policy,
    /// The user's seed.
    pub seed: u64,
    /// How many episodes.
    pub episodes: u64,
}

/// How it is computed; changes nothing in the result.
#[derive(Clone, Copy, Debug, Default)]
pub struct Options {
    /// Threads; 0 is one per core.
    pub threads: usize,
    /// Episodes computed at once; 0 chooses by their size. At most two blocks are in memory.
    pub block: usize,
}

/// How a recording ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Recorded {
    /// Episodes the sink has taken: 0 to this number, without gaps.
    pub episodes: u64,
    /// Whether it was stopped before the end.
    pub interrupted: bool,
}

/// The figures of one episode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EpisodeReturn {
    /// Sum of the team reward.
    pub episode_return: f64,
    /// Lost share of the off-diagonal link bits over the steps with `is_last = false`; 0 where there are no links.
    pub loss_rate: f64,
}

/// Memory that a block may take, bytes; a block holds at least one episode.
const BLOCK_BYTES: usize = 32 << 20;

impl Recording<'_> {
    /// The shape of its episodes: the scenario's, with the policy's message widths.
    pub fn layout(&self) -> Layout {
        let mut layout = self.scenario.layout();
        for (i, agent) in layout.agents.iter_mut().enumerate() {
            agent.message = if agent.communicator { self.policy.message_width(self.scenario, i) } else { 0 };
        }
        layout
    }

    /// The unsealed manifest of a store of these episodes.
    pub fn manifest(&self) -> Manifest {
        let [scenario, link, policy] =
            [self.scenario.parameters(), self.link.parameters(), self.policy.parameters()].map(Into::into);
        let manifest = Manifest::new(self.seed, scenario, link, policy, &self.layout());
        Manifest { planned: self.episodes, ..manifest }
    }

    /// Episode number `index`: the same for the same seed, whoever asks and in whatever order.
    pub fn episode(&self, index: u64) -> Episode {
        self.episode_of(&self.layout(), index)
    }

    fn episode_of(&self, layout: &Layout, index: u64) -> Episode {
        let (scenario, agents, steps) = (self.scenario, &layout.agents, self.scenario.steps());
        let seeds = Seeds::new(self.seed).child("record").indexed("episode", index);
        let total = |width: fn(&crate::schema::AgentSpec) -> usize| agents.iter().map(width).sum();
        let mut observations = vec![0.0; total(|a| a.observation)];
        let mut messages = vec![0.0; total(|a| a.message)];
        let mut actions = vec![0.0; total(|a| a.action)];
        let mut rewards = vec![0.0; agents.len()];
        let communicators = layout.communicators();
        let mut link = vec![true; communicators.len() * communicators.len()];
        let mut bodies = vec![[0.0; 4]; communicators.len()];

        let (mut state, mut scratch) = (vec![0.0; scenario.shape().width()], Scratch::default());
        scenario.reset(&mut state, &mut seeds.stream("world"));
        let mut rule = seeds.stream("scripted");
        let mut links = self.link.start(communicators.len(), index, &seeds.child("link"));
        let mut policy = self.policy.start(scenario, &seeds.child("policy"));
        let mut episode = Episode::with_capacity(layout, index, steps);
        for t in 0..=steps {
            scenario.observe(&state, &mut observations);
            policy.send(&observations, &mut messages);
            let world = scenario.shape().world(&state);
            for (body, &agent) in bodies.iter_mut().zip(&communicators) {
                let ([x, y], [vx, vy]) = (world.position(agent), world.velocity(agent));
                *body = [x, y, vx, vy];
            }
            links.emit(&bodies, &mut link);
            episode.state.extend_from_slice(&state);
            append(&mut episode.observations, &observations);
            append(&mut episode.messages, &messages);
            episode.link.extend_from_slice(&link);
            if t == steps {
                break; // the last row has no action
            }
            let view = View { state: &state, observations: &observations, messages: &messages, link: &link };
            policy.act(&view, &mut actions);
            scenario.scripted(&state, &mut rule, &mut actions);
            scenario.step(&mut state, &actions, &mut rewards, &mut scratch);
            append(&mut episode.actions, &actions);
            episode.reward.push(scenario.team_reward(&rewards));
            episode.rewards.iter_mut().zip(&rewards).for_each(|(column, &r)| column.push(r));
        }
        episode.steps = steps;
        episode
    }

    /// Computes all episodes in blocks, in parallel, and appends them in order, while the next block is computed, from
    /// a thread of the pool. `committed` is told of every episode once it survives a kill; when `stop`
    /// turns true the recording ends after the block at hand.
    ///
    /// # Errors
    /// [`RecordError::NoEpisodes`], [`RecordError::LinkEnds`], [`RecordError::Storage`] when the sink refuses,
    /// [`RecordError::Threads`].
    pub fn record(
        &self,
        sink: &mut dyn EpisodeSink,
        options: Options,
        committed: &mut dyn FnMut(&Episode),
        stop: &AtomicBool,
    ) -> Result<Recorded, RecordError> {
        if self.episodes == 0 {
            return Err(RecordError::NoEpisodes);
        }
        super::check_link(self.link, self.episodes)?;
        let threads = options.threads;
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .map_err(|e| RecordError::Threads { threads, reason: e.to_string() })?;
        let layout = self.layout();
        let size = if options.block == 0 { default_block(&layout, self.scenario.steps()) } else { options.block };
        let compute = |first: u64| -> Vec<Episode> {
            let end = if stop.load(Ordering::Relaxed) { first } else { first.saturating_add(size as u64) };
            (first..end.min(self.episodes)).into_par_iter().map(|i| self.episode_of(&layout, i)).collect()
        };
        let mut done = 0;
        let mut block = pool.install(|| compute(0));
        while !block.is_empty() && !stop.load(Ordering::Relaxed) {
            let next = done + block.len() as u64;
            let append = || sink.append_all(&block).and_then(|()| sink.commit());
            // both halves split into small tasks, so that no thread waits for the other half
            let (appended, computed) = pool.install(|| rayon::join(append, || compute(next)));
            done = appended?;
            block.iter().for_each(&mut *committed);
            block = computed;
        }
        Ok(Recorded { episodes: done, interrupted: done < self.episodes })
    }
}

/// Splits a flat row among the agents' columns.
fn append(columns: &mut [crate::schema::Matrix], row: &[f32]) {
    let mut rest = row;
    for column in columns {
        let (own, others) = rest.split_at(column.width);
        column.data.extend_from_slice(own);
        rest = others;
    }
}

/// Episodes in a block: what fits in [`BLOCK_BYTES`], at most 256.
fn default_block(layout: &Layout, steps: usize) -> usize {
    let floats: usize = layout.agents.iter().map(|a| a.observation + a.message + a.action + 1).sum();
    let row = 4 * floats + 8 * layout.state_fields.len() + layout.communicators().len().pow(2);
    (BLOCK_BYTES / ((steps + 1) * row).max(1)).clamp(1, 256)
}

/// Lost share of the off-diagonal link bits of the steps with `is_last = false`, among `n` communicators; 0 if n < 2.
pub fn loss_rate(episode: &Episode, n: usize) -> f64 {
    let bits = &episode.link[..episode.steps * n * n];
    let links = episode.steps * n * n.saturating_sub(1);
    let lost = bits.iter().filter(|&&delivered| !delivered).count();
    if links == 0 { 0.0 } else { lost as f64 / links as f64 }
}

/// Returns and realised loss of `count` episodes from number `first` on, in order; parallel, nothing is stored.
pub fn returns(recording: &Recording<'_>, first: u64, count: u64) -> Vec<EpisodeReturn> {
    let layout = recording.layout();
    let n = layout.communicators().len();
    let one = |index| {
        let episode = recording.episode_of(&layout, index);
        EpisodeReturn { episode_return: episode.episode_return(), loss_rate: loss_rate(&episode, n) }
    };
    (first..first.saturating_add(count)).into_par_iter().map(one).collect()
}
