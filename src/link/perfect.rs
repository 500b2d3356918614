//! # What it is
//! Every message arrives: full communication.
//!
//! # Definition
//! ι^{ji} = 1.
//!
//! # Shapes and units
//! Bits `[N, N]`, all true.
//!
//! # Parameters
//! None.
//!
//! # When it fails
//! Never; as a training prior it makes policies that fail on lossy links.
//!
//! # Reference
//! The `unrestricted` test environment and FC-MADDPG of arXiv 2512.03528.
//!
//! # Differences from the reference implementation
//! None known.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Body, Build, Link, LinkEpisode};
use crate::registry::Entry;
use crate::rng::Seeds;

/// The link's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "perfect",
    summary: "every message arrives",
    reference: "arXiv 2512.03528, unrestricted",
    value: None,
    build: |spec, _| Ok(Box::new(spec.params::<Perfect>()?)),
};

#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Perfect {}

impl Link for Perfect {
    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, self)
    }

    fn start(&self, _n: usize, _episode: u64, _seeds: &Seeds) -> Box<dyn LinkEpisode> {
        Box::new(*self)
    }
}

impl LinkEpisode for Perfect {
    fn emit(&mut self, _bodies: &[Body], bits: &mut [bool]) {
        bits.fill(true);
    }
}
