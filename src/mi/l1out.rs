//! # What it is
//!
//! The leave-one-out upper bound: how much likelier a fitted q(y|x) finds y beside its own x than beside the others on average.
//!
//! # Definition
//!
//! E\[ln `q(y_i|x_i)` − ln `mean_{j≠i}` `q(y_i|x_j)`\], q the diagonal Gaussian of `club`.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`; nats, on held-out episodes.
//!
//! # Parameters
//!
//! None. q and its training as for `club`; the mean runs over at most 512 others. The p-value is that of `club`.
//!
//! # When it fails
//!
//! An upper bound only when q is good, as `club`, but far tighter: with the exact q it tends to the information itself. A q that
//! never beats the margin on the validation part stays the margin: the value is 0 and has no interval, and it says so.
//!
//! # Reference
//!
//! Poole, Ozair, van den Oord, Alemi, Tucker 2019, arXiv 1905.06922.
//!
//! # Differences from the reference implementation
//!
//! Held-out value; at most 512 others, each sample meeting the next ones in one random circle.

use super::club::{Fitted, q_training};
use super::{Build, Estimate, Estimator, Kind, MiError, Protocol, Training};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::Samples;

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "l1out",
    summary: "leave-one-out upper bound with the density of club",
    reference: "Poole et al. 2019, arXiv 1905.06922",
    value: None,
    build,
};

struct LeaveOneOut;

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    spec.no_params()?;
    Ok(Box::new(LeaveOneOut))
}

impl Estimator for LeaveOneOut {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        let fitted = Fitted::new(samples, seeds)?;
        let p = fitted.held.p_value(samples, &fitted.data, *protocol, seeds);
        Ok(vec![fitted.row("l1out", Kind::UpperBound, &fitted.held.leave_one_out(seeds), p)?])
    }

    fn training(&self, samples: &Samples, seeds: &Seeds) -> Option<Training> {
        q_training(samples, seeds)
    }
}
