//! # What it is
//!
//! SMILE: the Donsker–Varadhan value of a critic trained as `jsd`, its scores held to ± 5 in the second mean. Less variance than
//! `mine`, for some bias.
//!
//! # Definition
//!
//! `E_p`\[T\] − ln `E_q`\[e^clip(T, −5, 5)\], p the pairs, q the product of the margins: all pairs of different rows within random
//! squares of at most 1024 (256) held-out rows.
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
//! The clipped value is no bound: it exceeds the truth where the scores do not stay within ± 5. A critic that never beats
//! T = 0 on the validation part stays T = 0, and the value has no interval.
//!
//! # Reference
//!
//! Song, Ermon 2020, arXiv 1910.06222, τ = 5.
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
    name: "smile",
    summary: "clipped Donsker-Varadhan value of a critic trained as jsd",
    reference: "Song, Ermon 2020, arXiv 1910.06222",
    value: Some("critic"),
    build,
};

/// τ of the paper's experiments.
const CLIP: f32 = 5.0;

struct Smile(Contrast);

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    Ok(Box::new(Smile(Contrast {
        name: "smile",
        kind: Kind::Estimate,
        objective: Objective::JensenShannon,
        reading: Reading::DonskerVaradhan(CLIP),
        critic: critic(spec)?,
    })))
}

impl Estimator for Smile {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        Ok(vec![self.0.row(samples, *protocol, seeds)?])
    }

    fn training(&self, samples: &Samples, seeds: &Seeds) -> Option<Training> {
        self.0.training(samples, seeds)
    }
}
