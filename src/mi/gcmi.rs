//! # What it is
//!
//! Gaussian-copula information: `gaussian` after every column has been given a normal margin by its ranks. Blind to
//! monotone changes of any column, and to outliers.
//!
//! # Definition
//!
//! Each column is replaced by Φ⁻¹(rank/(n + 1)), equal values having the mean of their ranks; then the bias-corrected
//! log-determinants of `gaussian`, given z too, whose columns are replaced likewise.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`, all samples; the value in nats.
//!
//! # Parameters
//!
//! None. Interval and p-value as for `gaussian`.
//!
//! # When it fails
//!
//! A lower bound (of all joint densities with these margins and this correlation of normal scores, the normal copula
//! has least information), and a loose one where the dependence is not in that correlation: 0.00 instead of 0.22 for
//! Student's t with one degree of freedom. With few distinct values the margins cannot be made normal.
//!
//! # Reference
//!
//! Ince, Giordano, Kayser, Rousselet, Gross, Schyns 2017, Human Brain Mapping 38, 1541–1573.
//!
//! # Differences from the reference implementation
//!
//! The reference breaks ties by position, so that its value depends on the order of the samples.

use std::sync::Arc;

use statrs::distribution::{ContinuousCDF as _, Normal};

use super::prepare::tied;
use super::student::doubled_ranks;
use super::{Build, Estimate, Estimator, Kind, MiError, Protocol, gaussian};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::{Columns, Samples};

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "gcmi",
    summary: "Gaussian copula: gaussian after every column is made normal by its ranks",
    reference: "Ince et al. 2017, Human Brain Mapping 38, 1541-1573",
    value: None,
    build,
};

struct Gcmi;

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    spec.no_params()?;
    Ok(Box::new(Gcmi))
}

impl Estimator for Gcmi {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        let mut row = gaussian::estimate("gcmi", &in_scores(samples), *protocol, seeds)?;
        row.kind = Kind::LowerBound;
        row.warnings.extend(tied(samples));
        Ok(vec![row])
    }

    fn takes_given(&self) -> bool {
        true
    }
}

/// The samples with every column replaced by its normal scores.
pub(super) fn in_scores(samples: &Samples) -> Samples {
    let scores = |columns: &Columns| Arc::new(normal_scores(columns, &samples.rows));
    let z = samples.z.as_deref().map(scores);
    Samples { x: scores(&samples.x), y: scores(&samples.y), z, ..samples.clone() }
}

/// Every value's place among the values of its column in `rows`, as a normal quantile; rows outside `rows` likewise.
fn normal_scores(columns: &Columns, rows: &[u32]) -> Columns {
    let (normal, n) = (Normal::standard(), rows.len() as f64);
    let score = |&rank: &u32| normal.inverse_cdf(0.5 * f64::from(rank) / (n + 1.0));
    Columns::new(doubled_ranks(&columns.data, columns.width(), rows).iter().map(score).collect(), columns.names.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::run::tests::{linear_samples, samples_of};

    fn one(samples: &Samples) -> Estimate {
        Gcmi.estimate(samples, &Protocol { permutations: 39 }, &Seeds::new(1)).unwrap().remove(0)
    }

    #[test]
    fn scores_are_quantiles_of_mean_ranks() {
        let columns = Columns::new(vec![5.0, -1.0, 5.0, 100.0, 7.0, 200.0], vec!["a".to_owned()]);
        let scores = normal_scores(&columns, &[0, 1, 2, 3]).data;
        let quantile = |p: f64| Normal::standard().inverse_cdf(p);
        // 7 lies between the samples, 200 above all of them
        let expected = [0.5, 0.2, 0.5, 0.8, 0.7, 0.9].map(quantile);
        assert!(scores.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{scores:?}");
    }

    #[test]
    fn monotone_changes_of_a_column_change_nothing() {
        let plain = linear_samples(0.75, 2000, 2, 3);
        let bent = |columns: &Columns| {
            let data = columns.data.iter().map(|v| v.exp() + 3.0 * v).collect();
            Arc::new(Columns::new(data, columns.names.clone()))
        };
        let changed = Samples { x: bent(&plain.x), y: bent(&plain.y), ..plain.clone() };
        let (a, b) = (one(&plain), one(&changed));
        assert_eq!(a, b);
        assert!((a.value - 0.4133).abs() < 0.04 && a.p_value.unwrap() < 0.05, "{a:?}");
        assert!(a.interval_low.unwrap() < 0.43 && a.interval_high.unwrap() > 0.39);
        assert_eq!(a.kind, Kind::LowerBound);
    }

    #[test]
    fn a_monotone_copy_is_infinite_and_a_constant_is_named() {
        let x: Vec<Vec<f64>> = linear_samples(0.0, 100, 1, 1).x.data.iter().map(|&v| vec![v]).collect();
        let y: Vec<Vec<f64>> = x.iter().map(|v| vec![v[0].powi(3)]).collect();
        let found = one(&samples_of(&x, &y));
        assert!(found.value.is_infinite(), "{found:?}");
        let constant = Gcmi.estimate(&samples_of(&x, &vec![vec![2.0]; 100]), &Protocol::default(), &Seeds::new(1));
        assert_eq!(constant.unwrap_err(), MiError::Constant { column: "y".to_owned() });
    }
}
