//! Episodes: each a pure function of the seed and its number; computed in parallel, stored in order.

use std::sync::atomic::{AtomicBool, Ordering};

use rayon::iter::{IntoParallelIterator as _, ParallelIterator as _};

use super::{Policy, RecordError, View, Widths, part, part_mut};
use crate::link::Link;
use crate::rng::Seeds;
use crate::scenario::{Scenario, Worlds};
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

/// Episodes that one thread plays together, at most: a trained team acts faster on many rows.
const TOGETHER: u64 = 16;

/// Memory that a block may take, bytes; a block holds at least one episode.
const BLOCK_BYTES: usize = 32 << 20;

impl Recording<'_> {
    /// The shape of its episodes: the scenario's, with the policy's message widths.
    pub fn layout(&self) -> Layout {
        let mut layout = self.scenario.layout();
        let widths = self.policy.message_widths(self.scenario);
        layout.agents.iter_mut().zip(widths).for_each(|(agent, width)| agent.message = width);
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
        self.together(&self.layout(), index, 1).pop().unwrap_or_default()
    }

    /// The episodes from number `first` on, `count` of them, all worlds moved together: the same episodes as one by one,
    /// to the bit. `layout` is this recording's.
    pub fn together(&self, layout: &Layout, first: u64, count: usize) -> Vec<Episode> {
        let (scenario, agents, steps) = (self.scenario, &layout.agents, self.scenario.steps());
        let root = Seeds::new(self.seed).child("record");
        let nodes: Vec<Seeds> = (0..count as u64).map(|i| root.indexed("episode", first + i)).collect();
        let children = |name: &str| nodes.iter().map(|node| node.child(name)).collect::<Vec<_>>();
        let w = Widths::of(scenario, agents.iter().map(|a| a.message).collect());
        let communicators = layout.communicators();
        let mut observations = vec![0.0; count * w.observations];
        let mut messages = vec![0.0; count * w.messages];
        let mut actions = vec![0.0; count * w.actions];
        let (mut rewards, mut team) = (vec![0.0; count * agents.len()], vec![0.0; count]);
        let mut link = vec![true; count * w.link];
        let mut bodies = vec![[0.0; 4]; communicators.len()];

        let mut worlds = Worlds::new(scenario, count);
        nodes.iter().enumerate().for_each(|(i, node)| worlds.reset(i, &mut node.stream("world")));
        let mut rules: Vec<_> = nodes.iter().map(|node| node.stream("scripted")).collect();
        let start = |(node, index): (&Seeds, u64)| self.link.start(communicators.len(), index, node);
        let mut links: Vec<_> = children("link").iter().zip(first..).map(start).collect();
        let mut policy = self.policy.start_together(scenario, first, &children("policy"));
        let start = |i: u64| Episode::with_capacity(layout, first + i, steps);
        let mut episodes: Vec<Episode> = (0..count as u64).map(start).collect();
        for t in 0..=steps {
            worlds.observe(&mut observations);
            policy.send(&observations, &mut messages);
            for (i, episode) in episodes.iter_mut().enumerate() {
                let (state, bits) = (worlds.state(i), part_mut(&mut link, w.link, i));
                let world = scenario.shape().world(state);
                for (body, &agent) in bodies.iter_mut().zip(&communicators) {
                    let ([x, y], [vx, vy]) = (world.position(agent), world.velocity(agent));
                    *body = [x, y, vx, vy];
                }
                links[i].emit(&bodies, bits);
                episode.state.extend_from_slice(state);
                append(&mut episode.observations, part(&observations, w.observations, i));
                append(&mut episode.messages, part(&messages, w.messages, i));
                episode.link.extend_from_slice(bits);
            }
            if t == steps {
                break; // the last row has no action
            }
            let view = View { state: worlds.states(), observations: &observations, messages: &messages, link: &link };
            policy.act(&view, &mut actions);
            worlds.scripted(&mut rules, &mut actions);
            worlds.step(&actions, &mut rewards, &mut team);
            for (i, episode) in episodes.iter_mut().enumerate() {
                append(&mut episode.actions, part(&actions, w.actions, i));
                episode.reward.push(team[i]);
                let own = part(&rewards, agents.len(), i);
                episode.rewards.iter_mut().zip(own).for_each(|(column, &r)| column.push(r));
            }
        }
        for episode in &mut episodes {
            episode.steps = steps;
        }
        episodes
    }

    /// What `figure` makes of the groups of episodes that `first..end` is played in, in order, on all threads of the
    /// caller's pool.
    fn in_groups<T: Send>(
        &self,
        layout: &Layout,
        [first, end]: [u64; 2],
        figure: impl Fn(Vec<Episode>) -> Vec<T> + Sync,
    ) -> Vec<T> {
        let count = end.saturating_sub(first);
        let share = count.div_ceil(rayon::current_num_threads() as u64);
        let size = share.min(TOGETHER).min(default_block(layout, self.scenario.steps()) as u64).max(1);
        let play = |group: u64| {
            let from = first + group * size;
            figure(self.together(layout, from, size.min(end - from) as usize))
        };
        (0..count.div_ceil(size)).into_par_iter().flat_map_iter(play).collect()
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
            self.in_groups(&layout, [first, end.min(self.episodes)], |episodes| episodes)
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
    let figure = |e: &Episode| EpisodeReturn { episode_return: e.episode_return(), loss_rate: loss_rate(e, n) };
    let end = first.saturating_add(count);
    recording.in_groups(&layout, [first, end], |episodes| episodes.iter().map(figure).collect())
}
