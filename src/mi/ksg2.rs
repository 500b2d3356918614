//! # What it is
//!
//! The second nearest-neighbour estimator of Kraskov, Stögbauer and Grassberger: a rectangle around the neighbours
//! instead of a square. The one that Kraskov's own tool MILCA and JIDT's tests hold values of.
//!
//! # Definition
//!
//! I = ψ(k) − 1/k + ψ(n) − mean\[ψ(`n_x`) + ψ(`n_y`)\]. Of the samples no farther than the k-th nearest, in the maximum
//! norm over all columns, `ε_x` is the largest distance in x and `ε_y` in y; `n_x` counts the others **within** `ε_x`.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`, all samples, each column standardised; the value in nats.
//!
//! # Parameters
//!
//! `k` ≥ 1, 3 by default. Interval and p-value as for `ksg1`.
//!
//! # When it fails
//!
//! As `ksg1`. It differs from it by up to 0.3 nats on the same data, so the variant must be named beside a value. When more
//! than k samples are at the k-th distance, all of them count as neighbours.
//!
//! # Reference
//!
//! Kraskov, Stögbauer, Grassberger 2004, Phys. Rev. E 69, 066138, eq. 9.
//!
//! # Differences from the reference implementation
//!
//! MILCA takes the first k of samples at equal distances, here all count; no noise is added; distances that differ by less
//! than a billionth are equal.

use super::knn::{Points, Tree, within};
use super::neighbours::{Neighbours, digammas, up_to};
use super::{Build, Estimate, Estimator, MiError, Protocol};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::Samples;

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "ksg2",
    summary: "k nearest neighbours, second variant: rectangles, as MILCA computes it",
    reference: "Kraskov, Stögbauer, Grassberger 2004, Phys. Rev. E 69, 066138",
    value: Some("k"),
    build,
};

struct Ksg2(Neighbours);

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    Ok(Box::new(Ksg2(Neighbours::new("ksg2", spec, terms, None, false)?)))
}

impl Estimator for Ksg2 {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        Ok(vec![self.0.row(samples, *protocol, seeds)?])
    }
}

fn terms(x: &Points, y: &Points, k: usize) -> Vec<f64> {
    let tree = Tree::new(&Points::joined(&[x, y]));
    let radii: Vec<f64> = tree.kth(k).into_iter().map(up_to).collect();
    let extents = tree.extents(x.width, &radii);
    let within = |points, part: usize| within(points, &extents.iter().map(|e| up_to(e[part])).collect::<Vec<_>>());
    let (n, psi) = (x.len(), digammas(x.len()));
    let constant = psi[k] - 1.0 / k as f64 + psi[n];
    let others = |count: u32| psi[count as usize - 1];
    within(x, 0).into_iter().zip(within(y, 1)).map(|(x, y)| constant - others(x) - others(y)).collect()
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
            let near: Vec<&[u64; 2]> = others.iter().filter(|d| d[0].max(d[1]) <= joint[k - 1]).collect();
            let count = |part: usize| {
                let extent = near.iter().map(|d| d[part]).max().unwrap();
                others.iter().filter(|d| d[part] <= extent).count() as f64
            };
            let (k, n) = (k as f64, others.len() as f64 + 1.0);
            digamma(k) - 1.0 / k + digamma(n) - digamma(count(0)) - digamma(count(1))
        });
    }
}
