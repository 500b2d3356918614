//! # What it is
//! No message arrives: messages off.
//!
//! # Definition
//! ι^{ji} = 0 for j ≠ i.
//!
//! # Shapes and units
//! Bits `[N, N]`, true on the diagonal only.
//!
//! # Parameters
//! None.
//!
//! # When it fails
//! Never; there are no delivered pairs to estimate information on.
//!
//! # Reference
//! The training link of the MADDPG row of arXiv 2512.03528, and the honest test of a policy without communication.
//!
//! # Differences from the reference implementation
//! The paper tests its MADDPG row with live messages; this channel is the eighth test column, beside that reading.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Body, Build, Link, LinkEpisode};
use crate::registry::Entry;
use crate::rng::Seeds;

/// The link's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "none",
    summary: "no message arrives",
    reference: "arXiv 2512.03528, MADDPG",
    value: None,
    build: |spec, _| Ok(Box::new(spec.params::<Silent>()?)),
};

#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Silent {}

struct Diagonal {
    n: usize,
}

impl Link for Silent {
    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, self)
    }

    fn start(&self, n: usize, _episode: u64, _seeds: &Seeds) -> Box<dyn LinkEpisode> {
        Box::new(Diagonal { n })
    }
}

impl LinkEpisode for Diagonal {
    fn emit(&mut self, _bodies: &[Body], bits: &mut [bool]) {
        bits.fill(false);
        bits.iter_mut().step_by(self.n + 1).for_each(|own| *own = true);
    }
}
