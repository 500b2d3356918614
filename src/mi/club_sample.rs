//! # What it is
//!
//! vCLUB-S: `club` with one negative per sample instead of all.
//!
//! # Definition
//!
//! E\[ln `q(y_i|x_i)` − ln `q(y_{s(i)}|x_i)`\], s one random derangement of the held-out samples, q the diagonal Gaussian of `club`.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`; nats, on held-out episodes.
//!
//! # Parameters
//!
//! None. q and its training as for `club`; the p-value is that of `club`.
//!
//! # When it fails
//!
//! As `club`, with more variance: there is no reason to prefer it but comparison with published values.
//!
//! # Reference
//!
//! Cheng et al. 2020, arXiv 2006.12013, section 3.3.
//!
//! # Differences from the reference implementation
//!
//! Held-out value; a derangement instead of a permutation.

use super::club::{Fitted, q_training};
use super::{Build, Estimate, Estimator, Kind, MiError, Protocol, Training};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{self, Seeds};
use crate::schema::Samples;

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "club-sample",
    summary: "vCLUB with one sampled negative per sample",
    reference: "Cheng et al. 2020, arXiv 2006.12013",
    value: None,
    build,
};

struct ClubSample;

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    spec.no_params()?;
    Ok(Box::new(ClubSample))
}

impl Estimator for ClubSample {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        let fitted = Fitted::new(samples, seeds)?;
        let p = fitted.held.p_value(samples, &fitted.data, *protocol, seeds);
        let test = &fitted.data.test;
        let others = rng::derangement(&mut seeds.stream("negatives"), test.len());
        let log_q = |i: usize, x: usize| fitted.held.log_q(i, test[x]);
        let values: Vec<f64> = others.iter().enumerate().map(|(i, &other)| log_q(i, i) - log_q(other, i)).collect();
        Ok(vec![fitted.row("club-sample", Kind::UpperBound, &values, p)?])
    }

    fn training(&self, samples: &Samples, seeds: &Seeds) -> Option<Training> {
        q_training(samples, seeds)
    }
}
