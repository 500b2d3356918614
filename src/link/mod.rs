//! Links: which messages arrive. A link prior `f_θ` of the paper (Eq. 1), also used as test channel.
//!
//! A link is immutable; the state of one episode's links is a [`LinkEpisode`]. Every directed link draws from its own
//! stream, so the same bits come out for any thread and agent order. Adding one: write `link/<name>.rs` with an
//! `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,` below.

mod distance;
mod dropout;
mod markov;
mod none;
mod perfect;
mod suite;

use serde_json::{Map, Value};

pub use suite::{Channel, SUITES, channel, suite};

use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{Seeds, Stream};

/// All links.
pub const LINKS: &[Entry<Build>] = &[perfect::ENTRY, none::ENTRY, dropout::ENTRY, markov::ENTRY, distance::ENTRY];

/// What a link may want to know about the scenario it is used in.
#[derive(Clone, Debug)]
pub struct Setting {
    /// World units of one unit of distance, where the user gave none.
    pub distance_unit: f64,
}

/// Builds a link from its checked parameters.
pub type Build = fn(&Spec, &Setting) -> Result<Box<dyn Link>, RegistryError>;

/// Builds the link that `spec` names.
///
/// # Errors
/// [`RegistryError`] for an unknown name or a parameter out of its range.
pub fn build(spec: &Spec, setting: &Setting) -> Result<Box<dyn Link>, RegistryError> {
    (crate::registry::find("link", LINKS, &spec.name)?.build)(spec, setting)
}

/// A link prior or test channel.
pub trait Link: Send + Sync {
    /// Every parameter, resolved: what the manifest records, and what [`build`] accepts again.
    fn parameters(&self) -> Map<String, Value>;

    /// The links of one episode among `n` communicators; `seeds` is the episode's own node of the seed tree.
    fn start(&self, n: usize, seeds: &Seeds) -> Box<dyn LinkEpisode>;
}

/// The links of one episode, called once per row (T + 1 times), in order.
pub trait LinkEpisode: Send {
    /// Writes the link bits `[sender][receiver]` of the next row, diagonal included (always true).
    /// `positions` are the communicators' at the time of sending, world units.
    fn emit(&mut self, positions: &[[f64; 2]], bits: &mut [bool]);
}

/// Calls `f(sender, receiver, link index)` for every directed link among `n`, in row-major order.
pub(crate) fn for_each_link(n: usize, mut f: impl FnMut(usize, usize, usize)) {
    let mut link = 0;
    for s in 0..n {
        for r in 0..n {
            if s != r {
                f(s, r, link);
                link += 1;
            }
        }
    }
}

/// One stream per directed link among `n`, in row-major order. The stream of a pair is the same for every `n`.
fn streams(n: usize, seeds: &Seeds) -> Vec<Stream> {
    let mut streams = Vec::with_capacity(n * n.saturating_sub(1));
    for s in 0..n {
        let sender = seeds.indexed("sender", s as u64);
        streams.extend((0..n).filter(|&r| r != s).map(|r| sender.indexed_stream("receiver", r as u64)));
    }
    streams
}

/// The bits of `rows` rows of one episode of a link, for tests.
#[cfg(test)]
fn emit_rows(link: &dyn Link, n: usize, rows: usize, episode: u64) -> Vec<Vec<bool>> {
    let mut state = link.start(n, &Seeds::new(1).indexed("episode", episode));
    let positions: Vec<[f64; 2]> = (0..n).map(|i| [i as f64, 0.0]).collect();
    let emit = |_| {
        let mut bits = vec![false; n * n];
        state.emit(&positions, &mut bits);
        assert!((0..n).all(|i| bits[i * n + i]), "the diagonal is true");
        bits
    };
    (0..rows).map(emit).collect()
}
