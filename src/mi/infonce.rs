//! # What it is
//!
//! Contrastive predictive coding's lower bound: how surely a critic picks the own y of an x among many. Steady, and blind above
//! its ceiling.
//!
//! # Definition
//!
//! I ≥ mean\[T(`x_i`, `y_i`) − ln `mean_j` e^T(`x_i`, `y_j`)\], j over all K rows of a random square of held-out rows, K at most
//! 1024 (256 for the concatenated critic).
//! T is held to the range that its scores have on the validation part. Given z: I(x; y, z) − I(x; z), each such a bound by a critic
//! of its own on the same samples; the difference is an estimate, no bound.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`, any widths; nats, on held-out episodes.
//!
//! # Parameters
//!
//! `critic`: `separable` (the default) or `concatenated`.
//! Training as for `jsd`: Adam 2e-3 falling to 0, weight decay 0.5, at most 600 steps of 256 pairs with 64 derangements (16 for
//! the concatenated critic), stopped on the validation episodes. The p-value given z exchanges x within cells of at most sixteen held-out samples with
//! neighbouring z, critics kept, if every sample is its own episode and z has at most three columns. The interval given z is that of
//! the difference, each critic being allowed what it loses between training and held-out episodes, and never wholly below 0.
//!
//! # When it fails
//!
//! It never exceeds ln K; a value above 0.8 ln K is warned of. Few samples: the held-out value falls to 0. A critic that
//! never beats T = 0 on the validation part stays T = 0: the value is 0 and has no interval, and it says so. Given z, where z
//! tells nearly all of x or of y: the difference of two large values scatters, and either may be near its ceiling. A critic of z
//! alone that learned nothing leaves to y what z tells: then there is no interval.
//!
//! # Reference
//!
//! van den Oord, Li, Vinyals 2018, arXiv 1807.03748; the ceiling: `McAllester`, Stratos 2020.
//!
//! # Differences from the reference implementation
//!
//! Implementations commonly report the value of the last training batch; here training, stopping and reporting have
//! episodes of their own.

use super::bounds::Objective;
use super::contrast::{Contrast, Reading, critic};
use super::{Build, Estimate, Estimator, Kind, MiError, Protocol, Training, contrast_given};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::Samples;

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "infonce",
    summary: "contrastive lower bound: steady, at most ln K; given z the difference of two",
    reference: "van den Oord, Li, Vinyals 2018, arXiv 1807.03748",
    value: Some("critic"),
    build,
};

struct InfoNce(Contrast);

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    Ok(Box::new(InfoNce(Contrast {
        name: "infonce",
        kind: Kind::LowerBound,
        objective: Objective::InfoNce,
        reading: Reading::InfoNce,
        critic: critic(spec)?,
    })))
}

impl Estimator for InfoNce {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        let row = match &samples.z {
            None => self.0.row(samples, *protocol, seeds),
            Some(z) => contrast_given::row(&self.0, samples, z, *protocol, seeds),
        };
        Ok(vec![row?])
    }

    fn takes_given(&self) -> bool {
        true
    }

    fn training(&self, samples: &Samples, seeds: &Seeds) -> Option<Training> {
        // given z two critics are trained, on other samples
        samples.z.is_none().then(|| self.0.training(samples, seeds))?
    }
}
