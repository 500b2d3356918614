//! # What it is
//! Recorded link bits, replayed: episode e of the recording gives the bits of episode e.
//!
//! # Definition
//! ι^{ji}\_t is what the trace holds for (episode, step t, sender j, receiver i). Nothing is drawn.
//!
//! # Shapes and units
//! Bits `[N, N]` per row, T + 1 rows an episode. A trace of exactly T rows (a table of `ccmarl pairs`) is taken too: the
//! row after the last action then repeats the one before.
//!
//! # Parameters
//! `path` of a rollout store, or of a CSV, TSV or Parquet table with the columns episode, step, sender, receiver, delivered
//! (`trace:data/tag`); episodes and steps count from 0 without gaps, every ordered pair of agents has a row in each.
//! `sha256`: the trace's own digest (of a store: its content), which must match when given. `cycle` starts again after
//! the last episode; without it, playing more episodes than the trace has is refused.
//!
//! # When it fails
//! Its agents are not the scenario's communicators (by name, or by number from 0), an episode has fewer rows than the
//! scenario's, a row is missing or there twice.
//!
//! # Reference
//! Trace-driven evaluation, as in TMC (Zhang et al. 2020), whose chains were fitted on 802.11ac traces.
//!
//! # Differences from the reference implementation
//! None known.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Body, Build, Link, LinkEpisode, Setting, for_each_link};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;

/// The link's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "trace",
    summary: "replays the link bits of a store, or of a table (episode, step, sender, receiver, delivered)",
    reference: "trace-driven evaluation",
    value: Some("path"),
    build,
};

/// Recorded link bits of a team.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Trace {
    /// Who sends and receives, in order.
    pub agents: Vec<String>,
    /// Rows of episode e are `starts[e]..starts[e + 1]`.
    pub starts: Vec<usize>,
    /// `[rows, N(N − 1)]`, sender-major without the diagonal; true: delivered.
    pub bits: Vec<bool>,
    /// Digest of the data, 64 hex digits.
    pub sha256: String,
}

impl Trace {
    /// Directed links.
    pub fn links(&self) -> usize {
        self.agents.len() * self.agents.len().saturating_sub(1)
    }

    /// Episodes.
    pub fn episodes(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Rows of an episode.
    pub fn rows(&self, episode: usize) -> usize {
        self.starts[episode + 1] - self.starts[episode]
    }

    /// The trace with its agents in the order of `names`.
    ///
    /// # Errors
    /// One line that names the agents on both sides, when they are not the same ones.
    fn ordered(self, names: &[String]) -> Result<Self, String> {
        let numbered = |i: usize, own: &String| *own == names[i] || own.parse() == Ok(i);
        let place = |i: usize| self.agents.iter().position(|own| numbered(i, own));
        let places: Option<Vec<usize>> = (0..names.len()).map(place).collect();
        let n = self.agents.len();
        let Some(places) = places.filter(|p| p.len() == n) else {
            let (own, names) = (named(&self.agents), named(names));
            return Err(format!(
                "its agents are {own}, the scenario's communicators {names}: rename them, or number them from 0"
            ));
        };
        if places.iter().enumerate().all(|(i, &p)| i == p) {
            return Ok(Self { agents: names.to_vec(), ..self });
        }
        // where the link from i to j stands without the diagonal
        let at = |i: usize, j: usize| i * (n - 1) + j - usize::from(j > i);
        let mut from = vec![0; self.links()];
        for_each_link(n, |s, r, link| from[link] = at(places[s], places[r]));
        let rows = self.bits.chunks_exact(self.links());
        let bits = rows.flat_map(|row| from.iter().map(|&link| row[link])).collect();
        Ok(Self { agents: names.to_vec(), bits, ..self })
    }
}

/// Up to eight names.
fn named(names: &[String]) -> String {
    let shown = names.iter().take(8).map(String::as_str).collect::<Vec<_>>().join(", ");
    if names.len() > 8 { format!("{shown} and {} more", names.len() - 8) } else { shown }
}

#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Params {
    path: PathBuf,
    #[serde(default)]
    sha256: Option<String>,
    #[serde(default)]
    cycle: bool,
}

struct Replay {
    params: Params,
    trace: Arc<Trace>,
}

fn build(spec: &Spec, setting: &Setting) -> Result<Box<dyn Link>, RegistryError> {
    let mut params: Params = spec.params()?;
    let trace = (setting.read_trace)(&params.path)?;
    let fail = |message: String| Err(refused(&message, &params.path));
    if let Some(expected) = params.sha256.as_ref().filter(|sha256| **sha256 != trace.sha256) {
        return fail(format!(
            "sha256 {expected} was recorded, found {}: it is another trace, or it was changed",
            trace.sha256
        ));
    }
    let trace = if setting.communicators.is_empty() {
        trace
    } else {
        trace.ordered(&setting.communicators).map_err(|message| refused(&message, &params.path))?
    };
    if let Some(short) = (0..trace.episodes()).find(|&e| trace.rows(e) < setting.steps) {
        let (found, steps) = (trace.rows(short), setting.steps);
        return fail(format!(
            "episode {short} has {found} steps, the scenario's have {steps}: set the scenario's steps to {found} or fewer, or record longer ones"
        ));
    }
    if trace.episodes() == 0 {
        return fail("it has no episodes: record some".to_owned());
    }
    params.sha256 = Some(trace.sha256.clone());
    Ok(Box::new(Replay { params, trace: Arc::new(trace) }))
}

fn refused(message: &str, path: &Path) -> RegistryError {
    RegistryError::Data(format!("trace: {message}: {}", path.display()))
}

impl Link for Replay {
    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, &self.params)
    }

    fn episodes(&self) -> Option<u64> {
        (!self.params.cycle).then_some(self.trace.episodes() as u64)
    }

    fn start(&self, n: usize, episode: u64, _seeds: &Seeds) -> Box<dyn LinkEpisode> {
        let episodes = self.trace.episodes() as u64;
        let episode = if self.params.cycle { episode % episodes } else { episode };
        // beyond the last episode there are no rows, and nothing is delivered
        let at = |e: u64| self.trace.starts[e.min(episodes) as usize];
        let rows = at(episode)..at(episode.saturating_add(1));
        Box::new(Episode { trace: Arc::clone(&self.trace), n, next: rows.start, end: rows.end })
    }
}

struct Episode {
    trace: Arc<Trace>,
    n: usize,
    next: usize,
    end: usize,
}

impl LinkEpisode for Episode {
    fn emit(&mut self, _bodies: &[Body], bits: &mut [bool]) {
        let (n, own, links) = (self.n, self.trace.agents.len(), self.trace.links());
        let row = self.trace.bits[..self.end * links].chunks_exact(links.max(1)).nth(self.next);
        bits.fill(true);
        // a pair that the trace does not have, or a row beyond its end, loses
        for_each_link(n, |s, r, _| {
            let known = s < own && r < own;
            bits[s * n + r] = known && row.is_some_and(|row| row[s * (own - 1) + r - usize::from(r > s)]);
        });
        // a trace of exactly T rows repeats the last one
        self.next = if self.next + 1 == self.end && row.is_some() { self.next } else { self.next + 1 };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::emit_rows;

    /// Two agents, two episodes of 3 and 2 rows; the bits of a→b, then of b→a.
    fn read(path: &Path) -> Result<Trace, RegistryError> {
        if path != Path::new("t") {
            return Err(RegistryError::Data(format!("no such file or directory: {}", path.display())));
        }
        let bits = [1, 0, 0, 1, 1, 1, 0, 0, 1, 0].map(|b| b == 1).to_vec();
        let agents = vec!["a".to_owned(), "b".to_owned()];
        Ok(Trace { agents, starts: vec![0, 3, 5], bits, sha256: "7".repeat(64) })
    }

    fn setting(names: &[&str], steps: usize) -> Setting {
        let communicators = names.iter().map(|&n| n.to_owned()).collect();
        Setting { communicators, steps, ..Setting::new(1.0, read) }
    }

    fn spec() -> Spec {
        Spec::new("trace").with("path", "t")
    }

    /// Bits 0→1 and 1→0 of `rows` rows of an episode.
    fn bits(link: &dyn Link, episode: u64, rows: usize) -> Vec<[u8; 2]> {
        emit_rows(link, 2, rows, episode).iter().map(|b| [u8::from(b[1]), u8::from(b[2])]).collect()
    }

    #[test]
    fn the_bits_come_back_in_the_order_of_the_scenarios_agents() {
        let link = build(&spec(), &setting(&["a", "b"], 2)).unwrap();
        assert_eq!(bits(&*link, 0, 3), [[1, 0], [0, 1], [1, 1]]);
        assert_eq!(bits(&*link, 1, 3), [[0, 0], [1, 0], [1, 0]], "the last row stands for the one after it");
        let turned = build(&spec(), &setting(&["b", "a"], 2)).unwrap();
        assert_eq!(bits(&*turned, 0, 3), [[0, 1], [1, 0], [1, 1]]);
        assert_eq!((link.episodes(), bits(&*link, 2, 1)), (Some(2), vec![[0, 0]]), "beyond the end nothing arrives");
        let cycle = build(&spec().with("cycle", true), &setting(&["a", "b"], 2)).unwrap();
        assert_eq!((cycle.episodes(), bits(&*cycle, 3, 2)), (None, bits(&*link, 1, 2)));
        assert_eq!(link.parameters()["sha256"], "7".repeat(64));
    }

    #[test]
    fn what_does_not_fit_says_what_is_needed() {
        let error = |spec: Spec, setting: Setting| build(&spec, &setting).err().unwrap().to_string();
        assert_eq!(
            error(spec(), setting(&["a", "c"], 2)),
            "trace: its agents are a, b, the scenario's communicators a, c: rename them, or number them from 0: t"
        );
        assert_eq!(
            error(spec(), setting(&["a", "b"], 3)),
            "trace: episode 1 has 2 steps, the scenario's have 3: set the scenario's steps to 2 or fewer, or record longer ones: t"
        );
        let other = error(spec().with("sha256", "0"), setting(&["a", "b"], 2));
        assert!(other.starts_with("trace: sha256 0 was recorded, found 777"), "{other}");
        assert_eq!(error(Spec::new("trace").with("path", "x"), setting(&[], 0)), "no such file or directory: x");
        assert_eq!(error(Spec::new("trace"), setting(&[], 0)), "trace: missing field `path`");
    }

    #[test]
    fn agents_may_be_numbered() {
        let mut trace = read(Path::new("t")).unwrap();
        trace.agents = vec!["1".to_owned(), "0".to_owned()];
        let names = ["x".to_owned(), "y".to_owned()];
        assert_eq!(trace.clone().ordered(&names).unwrap().bits[..2], [false, true]);
        assert!(trace.ordered(&names[..1]).is_err());
    }
}
