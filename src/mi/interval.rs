//! Intervals from per-sample contributions, with episodes as blocks.

use statrs::distribution::{ContinuousCDF as _, StudentsT};

/// A mean with its cluster-robust error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// Mean of the contributions.
    pub mean: f64,
    /// Standard error of the mean, blocks being independent; 0 with fewer than two blocks.
    pub error: f64,
    /// Lower end of the 95 % interval.
    pub low: f64,
    /// Upper end of the 95 % interval.
    pub high: f64,
    /// Independent samples that would give the same error, at least 1 and at most the number of samples.
    pub n_effective: f64,
    /// Number of blocks.
    pub blocks: usize,
}

/// Mean and 95 % interval of `values`, whose `blocks` (equal numbers stand together) are independent of each other.
///
/// Error² = B/(B−1) `Σ_b` (Σ_{i∈b} (`v_i` − v̄))² / n², with Student's t at B − 1 degrees of freedom.
pub fn block_interval(values: &[f64], blocks: &[u32]) -> Interval {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let (mut squares, mut spread, mut count) = (0.0, 0.0, 0);
    let mut at = 0;
    while at < values.len() {
        let end = at + blocks[at..].iter().take_while(|&&b| b == blocks[at]).count();
        let sum: f64 = values[at..end].iter().map(|v| v - mean).sum();
        squares += sum * sum;
        spread += values[at..end].iter().map(|v| (v - mean) * (v - mean)).sum::<f64>();
        count += 1;
        at = end;
    }
    let b = f64::from(count);
    let error = if count < 2 { 0.0 } else { libm::sqrt(b / (b - 1.0) * squares) / n };
    let iid = spread / (n - 1.0).max(1.0);
    let n_effective = if error > 0.0 { (iid / (error * error)).clamp(1.0, n) } else { n };
    let half = error * t_quantile(count as usize);
    Interval { mean, error, low: mean - half, high: mean + half, n_effective, blocks: count as usize }
}

/// The two-sided 95 % quantile of Student's t for `blocks` independent blocks.
pub(super) fn t_quantile(blocks: usize) -> f64 {
    let degrees = blocks.saturating_sub(1).max(1) as f64;
    StudentsT::new(0.0, 1.0, degrees).map_or(f64::NAN, |t| t.inverse_cdf(0.975))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_of_one_give_the_usual_standard_error() {
        let values = [1.0, 2.0, 3.0, 4.0, 10.0];
        let found = block_interval(&values, &[0, 1, 2, 3, 4]);
        // variance 12.5, t(4) = 2.776445
        assert!((found.mean - 4.0).abs() < 1e-12 && (found.error - (12.5f64 / 5.0).sqrt()).abs() < 1e-12);
        assert!((found.high - 4.0 - 2.776_445 * found.error).abs() < 1e-5);
        assert!((found.n_effective - 5.0).abs() < 1e-9);
    }

    #[test]
    fn copies_within_a_block_add_no_information() {
        let once = block_interval(&[1.0, 2.0, 6.0], &[0, 1, 2]);
        let thrice = block_interval(&[1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 6.0, 6.0, 6.0], &[0, 0, 0, 1, 1, 1, 2, 2, 2]);
        assert!((once.error - thrice.error).abs() < 1e-12);
        assert!(thrice.n_effective < 3.0 && thrice.blocks == 3);
    }
}
