//! # What it is
//! Each message is lost on its own with probability p.
//!
//! # Definition
//! ι^{ji}_t ~ Bernoulli(1 − p), independent over links and steps.
//!
//! # Shapes and units
//! Bits `[N, N]`; p is a probability.
//!
//! # Parameters
//! `p` in [0, 1], required: `dropout:0.2`.
//!
//! # When it fails
//! Real links lose in bursts: see `markov`.
//!
//! # Reference
//! Message-Dropout (Kim, Cho and Sung, AAAI 2019); the prior of CC-MADDPG at p = 0.2 (arXiv 2512.03528).
//!
//! # Differences from the reference implementation
//! No rescaling of what arrives by 1/(1 − p).

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Body, Build, Link, LinkEpisode, for_each_link};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{Seeds, Stream, bernoulli};

/// The link's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "dropout",
    summary: "each message is lost with probability p",
    reference: "Kim, Cho and Sung 2019 (Message-Dropout)",
    value: Some("p"),
    build,
};

#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Dropout {
    p: f64,
}

fn build(spec: &Spec, _setting: &super::Setting) -> Result<Box<dyn Link>, RegistryError> {
    let dropout: Dropout = spec.params()?;
    spec.in_range("p", dropout.p, 0.0, 1.0)?;
    Ok(Box::new(dropout))
}

impl Link for Dropout {
    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, self)
    }

    fn start(&self, n: usize, _episode: u64, seeds: &Seeds) -> Box<dyn LinkEpisode> {
        Box::new(Episode { p: self.p, n, streams: super::streams(n, seeds) })
    }
}

struct Episode {
    p: f64,
    n: usize,
    streams: Vec<Stream>,
}

impl LinkEpisode for Episode {
    fn emit(&mut self, _bodies: &[Body], bits: &mut [bool]) {
        let n = self.n;
        bits.fill(true);
        for_each_link(n, |s, r, link| bits[s * n + r] = !bernoulli(&mut self.streams[link], self.p));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::{emit_rows, test_setting};

    fn link(p: f64) -> Result<Box<dyn Link>, RegistryError> {
        build(&Spec::new("dropout").with("p", p), &test_setting(1.0))
    }

    #[test]
    fn the_rate_of_loss_is_p_on_every_link() {
        let rows = emit_rows(&*link(0.2).unwrap(), 3, 20_000, 0);
        for cell in (0..9).filter(|c| c % 4 != 0) {
            let lost = rows.iter().filter(|bits| !bits[cell]).count() as f64 / rows.len() as f64;
            assert!((lost - 0.2).abs() < 0.0142, "link {cell}: {lost}"); // 5 standard errors
        }
        assert!(emit_rows(&*link(0.0).unwrap(), 3, 100, 0).iter().flatten().all(|&b| b));
        assert!(emit_rows(&*link(1.0).unwrap(), 2, 100, 0).iter().all(|bits| !bits[1] && !bits[2]));
    }

    #[test]
    fn a_pair_of_agents_has_the_same_bits_in_a_larger_team() {
        let (two, four) = (emit_rows(&*link(0.5).unwrap(), 2, 50, 3), emit_rows(&*link(0.5).unwrap(), 4, 50, 3));
        assert!(two.iter().zip(&four).all(|(a, b)| a[1] == b[1] && a[2] == b[4]));
    }

    #[test]
    fn p_outside_of_zero_to_one_is_refused() {
        for p in [-0.1, 1.5] {
            let error = link(p).err().unwrap().to_string();
            assert_eq!(error, format!("dropout: p must be in [0, 1], found {p}"));
        }
        let missing = build(&Spec::new("dropout"), &test_setting(1.0)).err().unwrap().to_string();
        assert_eq!(missing, "dropout: missing field `p`");
    }
}
