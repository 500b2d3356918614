//! Link bits as observations: per episode and ordered pair a sequence of messages, lost or not, with the pair's state.

use std::path::{Path, PathBuf};

use serde::{Serialize, Serializer};
use serde_json::Value;

use super::ChannelError;
use crate::link::{Body, FEATURES, Trace, features};
use crate::record::{is_link_table, read_trace, scenario_of};
use crate::schema::{Episode, Layout};
use crate::storage::EpisodeSource;

/// Most messages that are held in memory; a fit uses the first whole episodes up to here.
const MAX_MESSAGES: usize = 4_000_000;

/// Episodes that shall fit in there: where there are too many links for it, every k-th one is used.
const WANTED_EPISODES: usize = 50;

/// Where observations come from: what a fitted file says about its data.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DataSource {
    /// The path as given; in JSON what it looks like, since it need not be UTF-8.
    #[serde(serialize_with = "shown")]
    pub path: PathBuf,
    /// Of a store the digest of its content, of a table that of the file; 64 hex digits.
    pub sha256: String,
    /// Episodes in it.
    pub episodes: u64,
    /// Episodes that were used: the first ones.
    pub used: usize,
    /// The scenario, of a store.
    pub scenario: Value,
    /// Names of the state's elements, of a store.
    pub state_fields: Vec<String>,
    /// World units of one unit of `distance`.
    pub distance_unit: f64,
}

fn shown<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&path.display())
}

/// Messages by episode, ordered pair and step, in this order; the row after the last action is one too.
#[derive(Clone, Debug, PartialEq)]
pub struct Observations {
    /// Where they come from.
    pub source: DataSource,
    /// Who sends and receives, in order.
    pub agents: Vec<String>,
    /// Fields of a communicator's own state: `x y vx vy`.
    pub body_fields: Vec<String>,
    /// Whether each message was lost.
    pub lost: Vec<bool>,
    /// Relative state of the pair at each message, as [`FEATURES`] names it; or why there is none.
    pub features: Result<Vec<[f64; FEATURES.len()]>, String>,
    /// Sequence q = episode · links + link is messages `starts[q]..starts[q + 1]`.
    starts: Vec<usize>,
    /// Every how many-th directed link is used.
    pub(super) stride: usize,
}

impl Observations {
    /// Reads a rollout store, or a table of link bits.
    ///
    /// # Errors
    /// [`ChannelError`] when it cannot be read, or no model can be fitted to it: no links, one class only, too few
    /// episodes.
    pub fn read(path: &Path) -> Result<Self, ChannelError> {
        let observations = if is_link_table(path)? {
            Self::of_trace(&read_trace(path)?, path)
        } else {
            Self::of_source(crate::storage::open(path)?.as_mut(), path)?
        };
        observations.check()?;
        Ok(observations)
    }

    /// The messages of a store.
    ///
    /// # Errors
    /// [`ChannelError::Storage`], [`ChannelError::Value`].
    pub fn of_source(source: &mut dyn EpisodeSource, path: &Path) -> Result<Self, ChannelError> {
        let manifest = source.manifest().clone();
        // a store of somebody else's world has no unit of ours
        let distance_unit = scenario_of(&manifest).map_or(1.0, |scenario| scenario.link_unit());
        let mut out = Self::empty(&manifest.layout(), path);
        let bodies = Bodies::of(&manifest.layout());
        if let Err(reason) = &bodies {
            out.features = Err(reason.clone());
        }
        while let Some(episode) = source.next_episode()? {
            if !out.takes(episode.rows()) {
                break;
            }
            out.push(&episode, bodies.as_ref().ok())?;
        }
        out.source = DataSource {
            sha256: manifest.content,
            episodes: manifest.episodes,
            scenario: manifest.scenario,
            distance_unit,
            ..out.source
        };
        Ok(out)
    }

    /// The messages of a trace, which has no states.
    pub fn of_trace(trace: &Trace, path: &Path) -> Self {
        let layout = Layout { agents: Vec::new(), state_fields: Vec::new() };
        let mut out = Self::empty(&layout, path);
        out.agents.clone_from(&trace.agents);
        out.features = Err("a table of link bits has none".to_owned());
        for episode in 0..trace.episodes() {
            let rows = trace.starts[episode]..trace.starts[episode + 1];
            if !out.takes(rows.len()) {
                break;
            }
            for link in (0..trace.links()).step_by(out.stride) {
                out.lost.extend(rows.clone().map(|row| !trace.bits[row * trace.links() + link]));
                out.starts.push(out.lost.len());
            }
            out.source.used += 1;
        }
        out.source.sha256.clone_from(&trace.sha256);
        out.source.episodes = trace.episodes() as u64;
        out
    }

    fn empty(layout: &Layout, path: &Path) -> Self {
        let agents: Vec<String> = layout.communicators().iter().map(|&a| layout.agents[a].name.clone()).collect();
        let body_fields = agents.first().map(|name| layout.body_fields(name)).unwrap_or_default();
        let source = DataSource {
            path: path.to_owned(),
            sha256: String::new(),
            episodes: 0,
            used: 0,
            scenario: Value::Null,
            state_fields: layout.state_fields.clone(),
            distance_unit: 1.0,
        };
        Self { source, agents, body_fields, lost: Vec::new(), features: Ok(Vec::new()), starts: vec![0], stride: 1 }
    }

    /// Whether another episode of so many rows fits; the first one says how many links are used.
    fn takes(&mut self, rows: usize) -> bool {
        if self.source.used == 0 {
            let links = self.agents.len() * self.agents.len().saturating_sub(1);
            self.stride = (links * rows * WANTED_EPISODES).div_ceil(MAX_MESSAGES).clamp(1, links.max(1));
        }
        self.lost.len() + rows * self.links() <= MAX_MESSAGES
    }

    /// Appends an episode.
    fn push(&mut self, episode: &Episode, bodies: Option<&Bodies>) -> Result<(), ChannelError> {
        let (n, rows, width) = (self.agents.len(), episode.rows(), self.source.state_fields.len());
        let mut states: Vec<Body> = Vec::new();
        if let Some(bodies) = bodies {
            for row in 0..rows {
                let state = &episode.state[row * width..(row + 1) * width];
                for at in &bodies.0 {
                    if let Some(&bad) = at.iter().flatten().find(|&&i| state[i].is_nan() || state[i].abs() > 1e9) {
                        let (field, path) = (self.source.state_fields[bad].clone(), self.source.path.clone());
                        let value = state[bad];
                        return Err(ChannelError::Value { field, episode: episode.index, step: row, value, path });
                    }
                    states.push(at.map(|i| i.map_or(0.0, |i| state[i])));
                }
            }
        }
        let pairs = (0..n * n).map(|cell| (cell / n, cell % n)).filter(|(s, r)| s != r);
        for (s, r) in pairs.step_by(self.stride) {
            self.lost.extend((0..rows).map(|row| !episode.delivered(n, row, s, r)));
            self.starts.push(self.lost.len());
            if let (Ok(all), false) = (&mut self.features, states.is_empty()) {
                all.extend((0..rows).map(|row| features(&states[row * n + s], &states[row * n + r])));
            }
        }
        self.source.used += 1;
        Ok(())
    }

    /// Refuses what no model can be fitted to.
    ///
    /// # Errors
    /// [`ChannelError::NoLinks`], [`ChannelError::OneClass`], [`ChannelError::TooFewEpisodes`],
    /// [`ChannelError::TooLong`].
    pub fn check(&self) -> Result<(), ChannelError> {
        let path = self.source.path.clone();
        if self.agents.len() < 2 {
            return Err(ChannelError::NoLinks { found: self.agents.len(), path });
        }
        let (messages, lost) = (self.messages(), self.lost.iter().filter(|&&lost| lost).count());
        if messages > 0 && (lost == 0 || lost == messages) {
            let (class, link) = if lost == 0 { ("delivered", "perfect") } else { ("lost", "none") };
            return Err(ChannelError::OneClass { messages, class, link, path });
        }
        if self.episodes() < super::LEAST_EPISODES && (self.episodes() as u64) < self.source.episodes {
            return Err(ChannelError::TooLong { needed: super::LEAST_EPISODES, messages: MAX_MESSAGES, path });
        }
        if self.episodes() < super::LEAST_EPISODES {
            return Err(ChannelError::TooFewEpisodes { needed: super::LEAST_EPISODES, found: self.episodes(), path });
        }
        Ok(())
    }

    /// Episodes that are used.
    pub fn episodes(&self) -> usize {
        self.source.used
    }

    /// Messages.
    pub fn messages(&self) -> usize {
        self.lost.len()
    }

    /// Directed links that are used.
    pub fn links(&self) -> usize {
        (self.agents.len() * self.agents.len().saturating_sub(1)).div_ceil(self.stride)
    }

    /// The sequences of an episode, one per directed link, as ranges of messages.
    pub fn sequences(&self, episode: usize) -> impl Iterator<Item = std::ops::Range<usize>> + '_ {
        let first = episode * self.links();
        (first..first + self.links()).map(|q| self.starts[q]..self.starts[q + 1])
    }

    /// The messages of an episode.
    pub fn episode(&self, episode: usize) -> std::ops::Range<usize> {
        self.starts[episode * self.links()]..self.starts[(episode + 1) * self.links()]
    }

    /// The relative states, for a model that needs them.
    pub(super) fn states(&self, model: &'static str) -> Result<&[[f64; FEATURES.len()]], ChannelError> {
        self.features.as_deref().map_err(|reason| ChannelError::NoPositions {
            model,
            reason: reason.clone(),
            path: self.source.path.clone(),
        })
    }
}

/// Where each communicator's x, y, vx and vy lie in a row of state; velocities may be missing.
struct Bodies(Vec<[Option<usize>; 4]>);

impl Bodies {
    fn of(layout: &Layout) -> Result<Self, String> {
        let at = |name: &str, field: &str| layout.state_fields.iter().position(|f| *f == format!("{name}.{field}"));
        let body = |&agent: &usize| {
            let name = &layout.agents[agent].name;
            let [x, y, vx, vy] = ["x", "y", "vx", "vy"].map(|field| at(name, field));
            if x.is_none() || y.is_none() {
                return Err(format!("the store has no state {name}.x and {name}.y"));
            }
            Ok([x, y, vx, vy])
        };
        layout.communicators().iter().map(body).collect::<Result<_, _>>().map(Self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trace(bits: &[u8], starts: &[usize]) -> Trace {
        let agents = vec!["a".to_owned(), "b".to_owned()];
        Trace { agents, starts: starts.to_vec(), bits: bits.iter().map(|&b| b == 1).collect(), sha256: "0".repeat(64) }
    }

    #[test]
    fn messages_stand_by_episode_link_and_step() {
        let observations = Observations::of_trace(&trace(&[1, 0, 0, 1, 1, 1], &[0, 2, 3]), Path::new("t.csv"));
        assert_eq!(observations.lost, [false, true, true, false, false, false]);
        assert_eq!(observations.sequences(0).collect::<Vec<_>>(), [0..2, 2..4]);
        assert_eq!(observations.episode(1), 4..6);
        let error = observations.states("distance").unwrap_err().to_string();
        assert_eq!(
            error,
            "distance needs the agents' positions, and a table of link bits has none: fit dropout or markov, or give a rollout store: t.csv"
        );
    }

    #[test]
    fn a_path_that_is_not_utf_8_is_written_as_it_looks() {
        use std::os::unix::ffi::OsStrExt as _;
        let path = Path::new(std::ffi::OsStr::from_bytes(b"t\xff.csv"));
        let source = Observations::of_trace(&trace(&[1, 0, 0, 1, 1, 1], &[0, 2, 3]), path).source;
        assert_eq!(source.path, path, "errors name it as it is");
        assert_eq!(serde_json::to_value(&source).unwrap()["path"], "t\u{fffd}.csv");
    }

    #[test]
    fn of_many_links_some_are_used_and_of_long_episodes_none() {
        let names = |n: usize| (0..n).map(|i| i.to_string()).collect();
        let trace = |n: usize, rows: usize, episodes: usize| Trace {
            agents: names(n),
            starts: (0..=episodes).map(|e| e * rows).collect(),
            bits: (0..n * (n - 1) * rows * episodes).map(|i| i % 7 > 0).collect(),
            sha256: String::new(),
        };
        // 9900 links of 20 rows are 198 000 messages an episode: every third link lets 50 episodes fit
        let many = Observations::of_trace(&trace(100, 20, 12), Path::new("t"));
        assert_eq!((many.stride, many.links(), many.episodes(), many.messages()), (3, 3300, 12, 12 * 20 * 3300));
        assert_eq!(many.sequences(1).nth(1), Some(20 * 3301..20 * 3302));
        assert_eq!(
            many.lost[20 * 3301],
            !trace(100, 20, 12).bits[20 * 9900 + 3],
            "the fourth link of the second episode"
        );
        let long = Observations::of_trace(&trace(2, 500_000, 11), Path::new("t"));
        assert_eq!((long.stride, long.episodes()), (2, 8));
        let error = long.check().unwrap_err().to_string();
        assert!(error.starts_with("10 episodes of one link hold more than 4000000 messages"), "{error}");
    }

    #[test]
    fn one_class_or_few_episodes_say_what_is_needed() {
        let of = |trace: &Trace| Observations::of_trace(trace, Path::new("t")).check().unwrap_err().to_string();
        let one = of(&trace(&[1; 4], &[0, 1, 2]));
        assert!(
            one.starts_with("all 4 messages were delivered: a fit needs delivered and lost ones; record over"),
            "{one}"
        );
        assert!(one.ends_with("or use the link perfect as it is: t"), "{one}");
        assert!(of(&trace(&[0; 4], &[0, 1, 2])).contains("all 4 messages were lost"));
        let few = of(&trace(&[0, 1, 1, 1], &[0, 1, 2]));
        assert!(few.starts_with("expected at least 10 episodes, found 2: "), "{few}");
    }
}
