//! # What it is
//!
//! The nearest-neighbour estimator for mixtures: columns may be continuous, discrete, or continuous with values that
//! occur many times.
//!
//! # Definition
//!
//! I = mean\[ψ(`k_i`) + ln n − ψ(`c_x`) − ψ(`c_y`)\]. ε is the distance to the k-th nearest other sample, as for `ksg1`.
//! Where ε > 0: `k_i` = k, and `c_x`, `c_y` count the samples closer than ε in x, in y, with sample i itself. Where ε = 0:
//! `k_i`, `c_x`, `c_y` count the samples equal to i, with i itself, in all columns, in x, in y. Given z: I = mean\[ψ(`k_i`) +
//! ψ(`c_z`) − ψ(`c_xz`) − ψ(`c_yz`)\].
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
//! In many columns, as `ksg1`. Numbers that code three or more categories get distances that mean nothing: leave them as
//! words, which are far from each other, so that neighbours share them; a word of k or fewer samples borrows neighbours
//! from the next in the alphabet. With fewer than about 4k samples per value of a discrete side it is too high, without
//! dependence too (0.2 nats in 60 samples of seven values), and says so. For discrete columns alone, `discrete` is exact.
//!
//! # Reference
//!
//! Gao, Kannan, Oh, Viswanath 2017, `NeurIPS`, arXiv 1709.06212; given z: Mesner, Shalizi 2021, IEEE Trans. Information
//! Theory 67 (without its cut at 0).
//!
//! # Differences from the reference implementation
//!
//! As the authors' code, which has ψ of the counts where the paper has ln. Distances that differ by less than a
//! billionth are equal (there: 1e-15), so that values on a decimal grid are tied although they are rounded.

use super::knn::{Points, Tree, within};
use super::neighbours::{Neighbours, closer_than, digammas, given_terms, is_zero};
use super::{Build, Estimate, Estimator, MiError, Protocol};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::Samples;

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "ksg-mixed",
    summary: "k nearest neighbours for mixtures of continuous and discrete, and for ties",
    reference: "Gao, Kannan, Oh, Viswanath 2017, arXiv 1709.06212",
    value: Some("k"),
    build,
};

struct KsgMixed(Neighbours);

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    Ok(Box::new(KsgMixed(Neighbours::new("ksg-mixed", spec, terms, Some(terms_given), true)?)))
}

impl Estimator for KsgMixed {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        Ok(vec![self.0.row(samples, *protocol, seeds)?])
    }

    fn takes_words(&self) -> bool {
        true
    }

    fn takes_given(&self) -> bool {
        true
    }
}

fn terms(x: &Points, y: &Points, k: usize) -> Vec<f64> {
    let tree = Tree::new(&Points::joined(&[x, y]));
    let kth = tree.kth(k);
    let radii: Vec<f64> = kth.iter().copied().map(closer_than).collect();
    // where ε > 0 this counts what is closer, which nobody asks for
    let equal = if kth.iter().any(|&e| is_zero(e)) { tree.within(&radii) } else { Vec::new() };
    let (in_x, in_y) = (within(x, &radii), within(y, &radii));
    let (n, psi) = (x.len(), digammas(x.len()));
    let ln = libm::log(n as f64);
    let neighbours = |i: usize| if is_zero(kth[i]) { equal[i] as usize } else { k };
    (0..n).map(|i| psi[neighbours(i)] + ln - psi[in_x[i] as usize] - psi[in_y[i] as usize]).collect()
}

fn terms_given(x: &Points, y: &Points, z: &Points, k: usize) -> Vec<f64> {
    let tree = Tree::new(&Points::joined(&[x, y, z]));
    let kth = tree.kth(k);
    let radii: Vec<f64> = kth.iter().copied().map(closer_than).collect();
    let equal = tree.within(&radii);
    let neighbours = |i: usize| if is_zero(kth[i]) { equal[i] as usize } else { k };
    given_terms([x, y, z], &radii, &digammas(x.len()), neighbours)
}

#[cfg(test)]
mod tests {
    use statrs::function::gamma::digamma;

    use super::*;
    use crate::mi::neighbours::tests::assert_equals_all_pairs;
    use crate::mi::run::tests::samples_of;

    #[test]
    fn terms_equal_comparing_all_pairs() {
        assert_equals_all_pairs(terms, |others, k| {
            let mut joint: Vec<u64> = others.iter().map(|d| d[0].max(d[1])).collect();
            joint.sort_unstable();
            let radius = joint[k - 1];
            let counted = |d: u64| d < radius || (radius == 0 && d == 0);
            let count = |of: fn(&[u64; 2]) -> u64| 1.0 + others.iter().filter(|d| counted(of(d))).count() as f64;
            let own = if radius > 0 { k as f64 } else { count(|d| d[0].max(d[1])) };
            digamma(own) + (others.len() as f64 + 1.0).ln() - digamma(count(|d| d[0])) - digamma(count(|d| d[1]))
        });
    }

    #[test]
    fn two_normals_chosen_by_a_coin_have_the_integral_of_their_densities() {
        // y = coin, x ~ N(coin, 1): I = Σ_c ½ ∫ φ(x − c) ln φ(x − c)/m(x) dx, by the trapezoid rule
        let normal = |x: f64, c: f64| (-0.5 * (x - c) * (x - c)).exp() / std::f64::consts::TAU.sqrt();
        let step = 1e-3;
        let truth: f64 = (-8000..=9000)
            .map(|i| {
                let x = f64::from(i) * step;
                let (p, q) = (normal(x, 0.0), normal(x, 1.0));
                let m = f64::midpoint(p, q);
                0.5 * step * (p * (p / m).ln() + q * (q / m).ln())
            })
            .sum();
        let mut rng = Seeds::new(1).stream("coin");
        let y: Vec<Vec<f64>> = (0..5000).map(|_| vec![f64::from(crate::rng::bernoulli(&mut rng, 0.5))]).collect();
        let x: Vec<Vec<f64>> = y.iter().map(|y| vec![y[0] + crate::rng::normal(&mut rng)]).collect();
        let found = build(&Spec::new("ksg-mixed"))
            .unwrap()
            .estimate(&samples_of(&x, &y), &Protocol { permutations: 0 }, &Seeds::new(1))
            .unwrap()
            .remove(0);
        assert!((found.value - truth).abs() < 0.03, "{} against {truth}", found.value);
    }
}
