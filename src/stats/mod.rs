//! Statistics: pure functions of slices.
//!
//! The unit of a comparison is the seed (one training run), never the episode. Every interval is two-sided.

mod bootstrap;
mod exact;
mod proportion;

pub use bootstrap::{bootstrap_interval, stratified_interval};
pub use exact::ExactSum;
pub use proportion::{ChiSquare, clopper_pearson, homogeneity};

use statrs::distribution::{ContinuousCDF as _, StudentsT};

/// A two-sided interval `[low, high]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// Arithmetic mean; NaN of nothing.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Sample standard deviation (n − 1 below); NaN of fewer than two values.
pub fn sd(values: &[f64]) -> f64 {
    if values.len() < 2 {
        return f64::NAN;
    }
    let center = mean(values);
    let squares: f64 = values.iter().map(|v| (v - center) * (v - center)).sum();
    (squares / (values.len() - 1) as f64).sqrt()
}

/// Standard error of the mean, `sd / √n`; NaN of fewer than two values.
pub fn standard_error(values: &[f64]) -> f64 {
    sd(values) / (values.len() as f64).sqrt()
}

/// Quantile `p ∈ [0, 1]`, linear between the order statistics (type 7); NaN of nothing.
pub fn quantile(values: &[f64], p: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    quantile_of_sorted(&sorted, p)
}

fn quantile_of_sorted(sorted: &[f64], p: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else {
        return f64::NAN;
    };
    let position = p.clamp(0.0, 1.0) * last as f64;
    let below = (position.floor() as usize).min(last);
    let above = (below + 1).min(last);
    sorted[below] + (position - below as f64) * (sorted[above] - sorted[below])
}

/// Slope of the least-squares line through `(x, y)` points; NaN of fewer than two different x.
pub fn slope(points: &[(f64, f64)]) -> f64 {
    let n = points.len() as f64;
    let (x, y) = (points.iter().map(|p| p.0).sum::<f64>() / n, points.iter().map(|p| p.1).sum::<f64>() / n);
    let across: f64 = points.iter().map(|p| (p.0 - x) * (p.0 - x)).sum();
    let together: f64 = points.iter().map(|p| (p.0 - x) * (p.1 - y)).sum();
    if across > 0.0 { together / across } else { f64::NAN }
}

/// Interquartile mean: the mean after ⌊n/4⌋ values are cut from each end; NaN of nothing.
pub fn iqm(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let cut = sorted.len() / 4;
    mean(&sorted[cut..sorted.len() - cut])
}

/// Student's interval for the mean at confidence `level`, n − 1 degrees of freedom; `None` of fewer than two values.
pub fn t_interval(values: &[f64], level: f64) -> Option<Interval> {
    let freedom = values.len().checked_sub(1).filter(|&f| f > 0)?;
    let t = StudentsT::new(0.0, 1.0, freedom as f64).ok()?.inverse_cdf(0.5 + level / 2.0);
    let (center, half) = (mean(values), t * standard_error(values));
    Some(Interval { low: center - half, high: center + half })
}

/// Probability that a value of `x` exceeds one of `y`, ties counted half (Mann–Whitney U over n·m); NaN when either
/// is empty.
pub fn probability_of_improvement(x: &[f64], y: &[f64]) -> f64 {
    let score = |a: f64, b: f64| {
        if a > b { 1.0 } else { f64::from(u8::from(a == b)) / 2.0 }
    };
    let wins: f64 = x.iter().flat_map(|&a| y.iter().map(move |&b| score(a, b))).sum();
    wins / (x.len() * y.len()) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_and_quantiles_of_a_known_sample() {
        let values = [2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0];
        assert_eq!(mean(&values), 5.0);
        assert!((sd(&values) - (32.0_f64 / 7.0).sqrt()).abs() < 1e-15);
        assert!((standard_error(&values) - (4.0_f64 / 7.0).sqrt()).abs() < 1e-15);
        assert_eq!(quantile(&[4.0, 1.0, 3.0, 2.0], 0.5), 2.5);
        assert_eq!(quantile(&[4.0, 1.0, 3.0, 2.0], 0.25), 1.75);
        assert_eq!((quantile(&values, 0.0), quantile(&values, 1.0)), (2.0, 9.0));
    }

    #[test]
    fn iqm_cuts_a_quarter_from_each_end() {
        assert_eq!(iqm(&[100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -100.0]), 3.5);
        assert_eq!(iqm(&[1.0, 2.0, 9.0]), 4.0, "three values: nothing to cut");
    }

    #[test]
    fn students_interval_of_three_values() {
        // t(0.975; 2) = 4.302652729696142; mean 2, standard error 1/√3
        let interval = t_interval(&[1.0, 2.0, 3.0], 0.95).unwrap();
        let half = 4.302652729696142 / 3.0_f64.sqrt();
        assert!((interval.high - 2.0 - half).abs() < 1e-9 && (2.0 - interval.low - half).abs() < 1e-9);
        assert_eq!(t_interval(&[1.0], 0.95), None);
    }

    #[test]
    fn probability_of_improvement_counts_ties_half() {
        assert_eq!(probability_of_improvement(&[1.0, 2.0], &[0.0, 2.0]), (1.0 + 0.0 + 1.0 + 0.5) / 4.0);
        assert_eq!(probability_of_improvement(&[3.0], &[1.0, 2.0]), 1.0);
        assert!(probability_of_improvement(&[], &[1.0]).is_nan());
    }

    #[test]
    fn nothing_is_not_a_number_and_no_panic() {
        for value in [mean(&[]), sd(&[1.0]), standard_error(&[]), quantile(&[], 0.5), iqm(&[])] {
            assert!(value.is_nan());
        }
    }
}
