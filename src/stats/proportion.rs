//! Proportions: the exact interval of one, and whether several samples share theirs.

use statrs::distribution::{ChiSquared, ContinuousCDF as _};
use statrs::function::beta::checked_beta_reg;

use super::Interval;

/// The exact interval (Clopper and Pearson 1934) of a probability at confidence `level`, from `k` successes in `n`
/// trials; [0, 1] without trials. It covers at least as often as it says.
pub fn clopper_pearson(k: u64, n: u64, level: f64) -> Interval {
    let (k, tail) = (k.min(n) as f64, (1.0 - level) / 2.0);
    let n = n as f64;
    let low = if k == 0.0 { 0.0 } else { beta_quantile(k, n - k + 1.0, tail) };
    let high = if k == n { 1.0 } else { beta_quantile(k + 1.0, n - k, 1.0 - tail) };
    Interval { low, high }
}

/// The quantile of a beta distribution, by bisection to the last place.
fn beta_quantile(a: f64, b: f64, p: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..100 {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        if checked_beta_reg(a, b, middle).is_ok_and(|mass| mass < p) { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// Pearson's chi-square test.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChiSquare {
    /// Σ (found − expected)² / expected.
    pub statistic: f64,
    /// Degrees of freedom.
    pub freedom: u64,
    /// Probability of a statistic at least as large when the samples share their distribution.
    pub p_value: f64,
}

/// Pearson's test that all samples, `counts[sample][category]`, share one distribution over the categories.
///
/// Neighbouring categories are put together until each is expected at least five times in every sample. `None` when
/// fewer than two samples or categories are left.
///
/// # Panics
/// When the samples have different numbers of categories.
pub fn homogeneity(counts: &[&[u64]]) -> Option<ChiSquare> {
    let categories = counts.first()?.len();
    assert!(counts.iter().all(|sample| sample.len() == categories), "samples of equally many categories");
    let samples: Vec<&[u64]> = counts.iter().copied().filter(|s| s.iter().any(|&c| c > 0)).collect();
    let sizes: Vec<f64> = samples.iter().map(|s| s.iter().sum::<u64>() as f64).collect();
    let total: f64 = sizes.iter().sum();
    let smallest = sizes.iter().copied().fold(f64::INFINITY, f64::min);
    let (mut pooled, mut open) = (Vec::<Vec<f64>>::new(), vec![0.0; samples.len()]);
    let enough = |column: &[f64]| column.iter().sum::<f64>() * smallest / total >= 5.0;
    for category in 0..categories {
        samples.iter().zip(&mut open).for_each(|(sample, sum)| *sum += sample[category] as f64);
        if enough(&open) {
            pooled.push(std::mem::replace(&mut open, vec![0.0; samples.len()]));
        }
    }
    if let Some(last) = pooled.last_mut() {
        last.iter_mut().zip(&open).for_each(|(sum, rest)| *sum += rest);
    }
    if samples.len() < 2 || pooled.len() < 2 {
        return None;
    }
    let mut statistic = 0.0;
    for column in &pooled {
        let share = column.iter().sum::<f64>() / total;
        statistic += column.iter().zip(&sizes).map(|(c, n)| (c - n * share).powi(2) / (n * share)).sum::<f64>();
    }
    let freedom = ((samples.len() - 1) * (pooled.len() - 1)) as u64;
    let p_value = ChiSquared::new(freedom as f64).ok()?.sf(statistic);
    Some(ChiSquare { statistic, freedom, p_value })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exact_intervals_equal_known_ones() {
        // closed forms at the ends: 1 − (α/2)^(1/n); the others from R's binom.test
        for (k, n, low, high) in [
            (0, 10, 0.0, 1.0 - 0.025_f64.powf(0.1)),
            (10, 10, 0.025_f64.powf(0.1), 1.0),
            (5, 10, 0.187_086_028, 0.812_913_972),
            (1, 100, 0.000_253_146, 0.054_459_385),
            (0, 0, 0.0, 1.0),
        ] {
            let found = clopper_pearson(k, n, 0.95);
            assert!((found.low - low).abs() < 1e-8 && (found.high - high).abs() < 1e-8, "{k} of {n}: {found:?}");
        }
    }

    #[test]
    fn exact_intervals_cover_by_the_binomial_itself() {
        // the definition: with the truth at an end, the tail beyond k has mass (1 − level) / 2
        let (k, n) = (7_u64, 40_u64);
        let mass = |p: f64, from: u64, to: u64| -> f64 {
            let choose = |i: u64| (0..i).fold(1.0, |c, j| c * (n - j) as f64 / (j + 1) as f64);
            (from..=to).map(|i| choose(i) * p.powi(i as i32) * (1.0 - p).powi((n - i) as i32)).sum()
        };
        let found = clopper_pearson(k, n, 0.99);
        assert!((mass(found.low, k, n) - 0.005).abs() < 1e-9);
        assert!((mass(found.high, 0, k) - 0.005).abs() < 1e-9);
        assert!(clopper_pearson(200_000, 1_000_000, 0.95).high < 0.201);
    }

    #[test]
    fn homogeneity_equals_the_textbook() {
        // scipy.stats.chi2_contingency([[10, 10, 20], [20, 20, 20]]): 2.7777…, p = 0.24935
        let found = homogeneity(&[&[10, 10, 20], &[20, 20, 20]]).unwrap();
        assert!((found.statistic - 25.0 / 9.0).abs() < 1e-12 && found.freedom == 2, "{found:?}");
        assert!((found.p_value - (-25.0_f64 / 18.0).exp()).abs() < 1e-12);
    }

    #[test]
    fn rare_categories_are_put_together() {
        let found = homogeneity(&[&[100, 50, 3, 2, 1, 0], &[90, 60, 2, 1, 1, 1]]).unwrap();
        assert_eq!(found.freedom, 2, "three categories: 100, 50, and the rest (11 in all)");
        assert_eq!(homogeneity(&[&[100, 0], &[100, 0]]), None);
        assert_eq!(homogeneity(&[&[3, 3], &[0, 0]]), None);
    }
}
