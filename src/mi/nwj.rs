//! # What it is
//!
//! The lower bound of Nguyen, Wainwright and Jordan: without bias for any critic, and with a variance that grows as e^I.
//!
//! # Definition
//!
//! I ≥ `E_p`\[T\] + 1 − `E_q`\[e^T\], p the pairs, q the product of the margins: all pairs of different rows within random squares
//! of at most 1024 (256) held-out rows.
//! T is held to the range that its scores have on the validation part.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`, any widths; nats, on held-out episodes.
//!
//! # Parameters
//!
//! `critic`: `separable` (the default) or `concatenated`.
//! Training as for `jsd`: Adam 2e-3 falling to 0, weight decay 0.5, at most 600 steps of 256 pairs with 64 derangements (16 for
//! the concatenated critic), stopped on the validation episodes.
//!
//! # When it fails
//!
//! Strong dependence: e^T of a few pairs decides, which is warned of. Few samples: the held-out value falls to 0. A critic that
//! never beats T = 0 on the validation part stays T = 0: the value is 0 and has no interval, and it says so.
//!
//! # Reference
//!
//! Nguyen, Wainwright, Jordan 2010, IEEE Trans. Information Theory 56; variance: Song, Ermon 2020, arXiv 1910.06222.
//!
//! # Differences from the reference implementation
//!
//! Implementations commonly report the value of the last training batch; here training, stopping and reporting have
//! episodes of their own.

use super::bounds::Objective;
use super::contrast::{Contrast, Reading, critic};
use super::{Build, Estimate, Estimator, Kind, MiError, Protocol, Training};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::Samples;

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "nwj",
    summary: "lower bound without bias, whose variance grows as e^I",
    reference: "Nguyen, Wainwright, Jordan 2010",
    value: Some("critic"),
    build,
};

struct Nwj(Contrast);

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    Ok(Box::new(Nwj(Contrast {
        name: "nwj",
        kind: Kind::LowerBound,
        objective: Objective::Nwj,
        reading: Reading::Nwj,
        critic: critic(spec)?,
    })))
}

impl Estimator for Nwj {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        Ok(vec![self.0.row(samples, *protocol, seeds)?])
    }

    fn training(&self, samples: &Samples, seeds: &Seeds) -> Option<Training> {
        self.0.training(samples, seeds)
    }
}
