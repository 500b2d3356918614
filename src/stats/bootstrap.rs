//! Percentile bootstrap, from a named node of the seed tree.

use crate::rng::{Seeds, below};
use crate::stats::{Interval, quantile};

/// Percentile bootstrap interval of `statistic` at confidence `level` from `resamples` resamples of `values`.
///
/// `None` of fewer than two values or no resamples. With fewer than about ten values prefer
/// [`crate::stats::t_interval`]: the percentile method is too narrow there.
pub fn bootstrap_interval(
    values: &[f64],
    statistic: impl Fn(&[f64]) -> f64,
    level: f64,
    resamples: usize,
    seeds: &Seeds,
) -> Option<Interval> {
    stratified_interval(&[values], statistic, level, resamples, seeds)
}

/// The same over several tasks: values are resampled within each task (stratum), then pooled for `statistic`.
///
/// `None` when a stratum is empty, when all hold fewer than two values, or without resamples.
pub fn stratified_interval(
    strata: &[&[f64]],
    statistic: impl Fn(&[f64]) -> f64,
    level: f64,
    resamples: usize,
    seeds: &Seeds,
) -> Option<Interval> {
    if resamples == 0 || strata.iter().any(|s| s.is_empty()) || strata.iter().all(|s| s.len() < 2) {
        return None;
    }
    let mut stream = seeds.stream("bootstrap");
    let mut pooled = Vec::with_capacity(strata.iter().map(|s| s.len()).sum());
    let replicates: Vec<f64> = (0..resamples)
        .map(|_| {
            pooled.clear();
            for stratum in strata {
                pooled.extend((0..stratum.len()).map(|_| stratum[below(&mut stream, stratum.len())]));
            }
            statistic(&pooled)
        })
        .collect();
    let tail = (1.0 - level) / 2.0;
    Some(Interval { low: quantile(&replicates, tail), high: quantile(&replicates, 1.0 - tail) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::normal;
    use crate::stats::{iqm, mean, standard_error};

    #[test]
    fn the_interval_of_a_mean_is_near_the_normal_one() {
        let mut stream = Seeds::new(3).stream("sample");
        let values: Vec<f64> = (0..400).map(|_| normal(&mut stream)).collect();
        let interval = bootstrap_interval(&values, mean, 0.95, 2000, &Seeds::new(1)).unwrap();
        let half = 1.96 * standard_error(&values);
        assert!((interval.high - mean(&values) - half).abs() < 0.012, "{interval:?}");
        assert!((mean(&values) - interval.low - half).abs() < 0.012, "{interval:?}");
    }

    #[test]
    fn equal_seeds_give_equal_intervals_and_others_do_not() {
        let values: Vec<f64> = (0..20).map(f64::from).collect();
        let at = |seed| bootstrap_interval(&values, iqm, 0.9, 200, &Seeds::new(seed)).unwrap();
        assert_eq!(at(1), at(1));
        assert_ne!(at(1), at(2));
    }

    #[test]
    fn strata_are_never_mixed() {
        // each task is constant, so within-task resampling cannot move the pooled mean
        let interval = stratified_interval(&[&[0.0, 0.0], &[10.0, 10.0]], mean, 0.95, 100, &Seeds::new(1)).unwrap();
        assert_eq!(interval, Interval { low: 5.0, high: 5.0 });
        assert_eq!(stratified_interval(&[&[], &[1.0, 2.0]], mean, 0.95, 100, &Seeds::new(1)), None);
    }
}
