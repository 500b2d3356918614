//! Links: which messages arrive. A link prior f_θ of the paper (Eq. 1), also used as test channel.
//!
//! A link is immutable; the state of one episode's links is a [`LinkEpisode`]. Every directed link draws from its own
//! stream, so the same bits come out for any thread and agent order. Adding one: write `link/<name>.rs` with an
//! `ENTRY`, and add `mod <name>;` and `<name>::ENTRY,` below.

use serde_json::{Map, Value};

use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;

/// All links.
pub const LINKS: &[Entry<Build>] = &[];

/// What a link may want to know about the scenario it is used in.
#[derive(Clone, Copy, Debug)]
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
