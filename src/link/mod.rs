//! Links: which messages arrive. A link prior `f_θ` of the paper (Eq. 1), also used as test channel.
//!
//! A link is immutable; the state of one episode's links is a [`LinkEpisode`]. Every directed link draws from its own
//! stream, so the same bits come out for any thread and agent order. Adding one: write `link/<name>.rs` with an
//! `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,` below.

mod distance;
mod dropout;
mod file;
mod learned;
mod markov;
mod mixture;
mod none;
mod perfect;
mod suite;
mod trace;

use std::path::Path;

use serde_json::{Map, Value};

pub use file::{FITTED_KIND, FITTED_LIMIT};
pub use learned::{Classifier, Dense, FEATURES, features};
pub use suite::{Channel, SUITES, channel, suite};
pub use trace::Trace;

use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{Seeds, Stream};

/// All links.
pub const LINKS: &[Entry<Build>] = &[
    perfect::ENTRY,
    none::ENTRY,
    dropout::ENTRY,
    markov::ENTRY,
    distance::ENTRY,
    mixture::ENTRY,
    trace::ENTRY,
    learned::ENTRY,
    file::ENTRY,
];

/// Links within links that are followed: a `file` may name itself.
const MAX_DEPTH: u8 = 4;

/// Reads recorded link bits; a room above gives it, since links know no files of ours.
pub type ReadTrace = fn(&Path) -> Result<Trace, RegistryError>;

/// What a link may want to know about the scenario it is used in.
#[derive(Clone, Debug)]
pub struct Setting {
    /// World units of one unit of distance, where the user gave none.
    pub distance_unit: f64,
    /// Names of the communicators, in order; empty: unknown, and not checked.
    pub communicators: Vec<String>,
    /// Fields of a communicator's own state, `x y vx vy …`; empty: unknown, and not checked.
    pub body_fields: Vec<String>,
    /// Steps of an episode; 0: unknown, and not checked.
    pub steps: usize,
    /// How recorded link bits are read.
    pub read_trace: ReadTrace,
    /// How many links this one stands in.
    depth: u8,
}

impl Setting {
    /// A setting of which no more is known than the unit of distance, world units.
    pub fn new(distance_unit: f64, read_trace: ReadTrace) -> Self {
        let (communicators, body_fields) = (Vec::new(), Vec::new());
        Self { distance_unit, communicators, body_fields, steps: 0, read_trace, depth: 0 }
    }
}

/// Builds a link from its checked parameters.
pub type Build = fn(&Spec, &Setting) -> Result<Box<dyn Link>, RegistryError>;

/// Builds the link that `spec` names.
///
/// # Errors
/// [`RegistryError`] for an unknown name, a parameter out of its range, a file that cannot be used, or a link that does
/// not fit the setting.
pub fn build(spec: &Spec, setting: &Setting) -> Result<Box<dyn Link>, RegistryError> {
    (crate::registry::find("link", LINKS, &spec.name)?.build)(spec, setting)
}

/// Builds a link that stands within another one.
fn build_inner(outer: &Spec, inner: &Spec, setting: &Setting) -> Result<Box<dyn Link>, RegistryError> {
    if setting.depth >= MAX_DEPTH {
        return Err(
            outer.invalid(format!("links stand more than {MAX_DEPTH} deep within each other: name them directly"))
        );
    }
    build(inner, &Setting { depth: setting.depth + 1, ..setting.clone() })
}

/// A body as links see it: position `[x, y]` in world units, then velocity in world units per second.
pub type Body = [f64; 4];

/// A link prior or test channel.
pub trait Link: Send + Sync {
    /// Every parameter, resolved: what the manifest records, and what [`build`] accepts again.
    fn parameters(&self) -> Map<String, Value>;

    /// The links of episode number `episode` among `n` communicators; `seeds` is the episode's own node of the seed tree.
    fn start(&self, n: usize, episode: u64, seeds: &Seeds) -> Box<dyn LinkEpisode>;

    /// How many episodes it has, if they end (a trace): whoever plays more must refuse beforehand.
    fn episodes(&self) -> Option<u64> {
        None
    }
}

/// The links of one episode, called once per row (T + 1 times), in order.
pub trait LinkEpisode: Send {
    /// Writes the link bits `[sender][receiver]` of the next row, diagonal included (always true).
    /// `bodies` are the communicators' at the time of sending.
    fn emit(&mut self, bodies: &[Body], bits: &mut [bool]);
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

/// A setting for tests, in which no trace can be read.
#[cfg(test)]
fn test_setting(distance_unit: f64) -> Setting {
    Setting::new(distance_unit, |path| Err(RegistryError::Data(format!("no traces here: {}", path.display()))))
}

/// The bits of `rows` rows of one episode of a link, for tests.
#[cfg(test)]
fn emit_rows(link: &dyn Link, n: usize, rows: usize, episode: u64) -> Vec<Vec<bool>> {
    let mut state = link.start(n, episode, &Seeds::new(1).indexed("episode", episode));
    let bodies: Vec<Body> = (0..n).map(|i| [i as f64, 0.0, 0.0, 0.0]).collect();
    let emit = |_| {
        let mut bits = vec![false; n * n];
        state.emit(&bodies, &mut bits);
        assert!((0..n).all(|i| bits[i * n + i]), "the diagonal is true");
        bits
    };
    (0..rows).map(emit).collect()
}
