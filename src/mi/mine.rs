//! # What it is
//!
//! MINE: the Donsker–Varadhan lower bound, its gradient divided by a running mean.
//!
//! # Definition
//!
//! I ≥ `E_p`\[T\] − ln `E_q`\[e^T\], p the pairs, q the product of the margins: all pairs of different rows within random squares of
//! at most 1024 (256) held-out rows. In training the gradient of the second term is that of `E_q`\[e^T\] over its running
//! mean (0.99 per step).
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
//! As `nwj`; besides, ln of a mean over few pairs is too low, so that the value itself leans upwards.
//! A critic that
//! never beats T = 0 on the validation part stays T = 0: the value is 0 and has no interval, and it says so.
//!
//! # Reference
//!
//! Belghazi et al. 2018, arXiv 1801.04062, eq. 12; Donsker, Varadhan 1983.
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
    name: "mine",
    summary: "Donsker-Varadhan lower bound with MINE's running mean",
    reference: "Belghazi et al. 2018, arXiv 1801.04062",
    value: Some("critic"),
    build,
};

struct Mine(Contrast);

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    Ok(Box::new(Mine(Contrast {
        name: "mine",
        kind: Kind::LowerBound,
        objective: Objective::DonskerVaradhan { running: 0.0 },
        reading: Reading::DonskerVaradhan(f32::INFINITY),
        critic: critic(spec)?,
    })))
}

impl Estimator for Mine {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        Ok(vec![self.0.row(samples, *protocol, seeds)?])
    }

    fn training(&self, samples: &Samples, seeds: &Seeds) -> Option<Training> {
        self.0.training(samples, seeds)
    }
}
