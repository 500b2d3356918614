//! # What it is
//!
//! The first nearest-neighbour estimator of Kraskov, Stögbauer and Grassberger: no model, little bias in few columns.
//! `ksg` is the same with its usual k = 3.
//!
//! # Definition
//!
//! I = ψ(k) + ψ(n) − mean\[ψ(`n_x` + 1) + ψ(`n_y` + 1)\]. ε is the distance from sample i to its k-th nearest other one
//! in the maximum norm over all columns; `n_x` counts the others that are **closer** than ε in x, `n_y` in y; where ε = 0,
//! those that are equal. Given z: I = ψ(k) − mean\[ψ(`n_xz` + 1) + ψ(`n_yz` + 1) − ψ(`n_z` + 1)\], ε over all columns of x, y and z.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`, all samples, each column standardised; the value in nats.
//!
//! # Parameters
//!
//! `k` ≥ 1, 3 by default: more lowers the variance and raises the bias. The interval is by subsampling whole episodes (at
//! most 20,000 samples; 6,000 above four columns), reaching farther where the value still drifts as samples are added; the p-value permutes them (at most 4,000; 1,500). Given z, x is permuted
//! within cells of at most sixteen samples with neighbouring z, if every sample is its own episode; beyond three columns of z
//! there is neither p-value nor interval, since neighbours in so many still differ in z. With a p-value above 0.05 the interval
//! reaches down to 0.
//!
//! # When it fails
//!
//! Too low in many columns (25 + 25 normal columns, n = 5000: 0.15 instead of 1.02), and where the information is near
//! its ceiling ψ(n) − ψ(k). Ties break it (see `ksg-mixed`). A bootstrap of it is invalid. Neighbours in time count as
//! neighbours: on slow series and slow episodes it is too high. The p-value knows; where the next sample of an episode is often
//! nearer than the k-th neighbour, that is said, there is no interval, and `auto` takes another.
//!
//! # Reference
//!
//! Kraskov, Stögbauer, Grassberger 2004, Phys. Rev. E 69, 066138, eq. 8; given z: Frenzel, Pompe 2007, Phys. Rev. Lett. 99,
//! 204101; interval: Holmes, Nemenman 2019, arXiv 1903.09280.
//!
//! # Differences from the reference implementation
//!
//! No noise is added to break ties, so the same samples give the same value; the paper does not say what counts at
//! ε = 0. Distances that differ by less than a billionth are equal. The value is never cut at 0.

use super::knn::{Points, Tree, within};
use super::neighbours::{Neighbours, closer_than, digammas, given_terms};
use super::{Build, Estimate, Estimator, MiError, Protocol};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::Samples;

const REFERENCE: &str = "Kraskov, Stögbauer, Grassberger 2004, Phys. Rev. E 69, 066138";

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "ksg1",
    summary: "k nearest neighbours, first variant: no model, best in few columns",
    reference: REFERENCE,
    value: Some("k"),
    build,
};

/// The name under which most know it.
pub(super) const USUAL: Entry<Build> =
    Entry { name: "ksg", summary: "ksg1, under the name that most know it by", ..ENTRY };

struct Ksg1(Neighbours);

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    Ok(Box::new(Ksg1(Neighbours::new("ksg1", spec, terms, Some(terms_given), false)?)))
}

impl Estimator for Ksg1 {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        Ok(vec![self.0.row(samples, *protocol, seeds)?])
    }

    fn takes_given(&self) -> bool {
        true
    }
}

/// Local terms; `ψ(n_x + 1)` is ψ of the count with the sample itself.
pub(super) fn terms(x: &Points, y: &Points, k: usize) -> Vec<f64> {
    let radii: Vec<f64> = Tree::new(&Points::joined(&[x, y])).kth(k).into_iter().map(closer_than).collect();
    let (n, psi) = (x.len(), digammas(x.len()));
    let of = |count: u32| psi[count as usize];
    within(x, &radii).into_iter().zip(within(y, &radii)).map(|(x, y)| psi[k] + psi[n] - of(x) - of(y)).collect()
}

/// Local terms given z.
pub(super) fn terms_given(x: &Points, y: &Points, z: &Points, k: usize) -> Vec<f64> {
    let radii: Vec<f64> = Tree::new(&Points::joined(&[x, y, z])).kth(k).into_iter().map(closer_than).collect();
    given_terms([x, y, z], &radii, &digammas(x.len()), |_| k)
}

#[cfg(test)]
mod tests {
    use statrs::function::gamma::digamma;

    use super::*;
    use crate::mi::neighbours::tests::assert_equals_all_pairs;

    #[test]
    fn terms_equal_comparing_all_pairs() {
        assert_equals_all_pairs(terms, |others, k| {
            let mut joint: Vec<u64> = others.iter().map(|d| d[0].max(d[1])).collect();
            joint.sort_unstable();
            let radius = joint[k - 1];
            let closer = |part: usize| others.iter().filter(|d| d[part] < radius.max(1)).count() as f64;
            let n = others.len() as f64 + 1.0;
            digamma(k as f64) + digamma(n) - digamma(closer(0) + 1.0) - digamma(closer(1) + 1.0)
        });
    }
}
