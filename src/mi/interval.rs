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

/// How an information scatters.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scatter {
    /// The information seen, before its bias was subtracted.
    pub(super) seen: f64,
    /// Standard error by the spread of the contributions: what dependence brings.
    pub(super) error: f64,
    /// Standard error that remains where there is no dependence.
    pub(super) chance: f64,
    /// Independent samples.
    pub(super) n: f64,
}

impl Scatter {
    /// Ends of the interval of the information around its bias-corrected `value`, `t` standard errors wide.
    ///
    /// All I with |value − I| ≤ t √(V(I) + chance²). V, the variance that dependence brings, is error² where I is what was
    /// seen; where little is seen it is 2 I/n (the limit of weak dependence, of any kind), and the two are joined with the
    /// weights seen and chance. Around there it is taken to grow with I as 1 − e^(−2I) does, which is exact for one pair of normals.
    /// An interval value ± t·error would be twice too wide without dependence. The value itself is always inside.
    pub(super) fn around(self, value: f64, t: f64) -> (f64, f64) {
        let weak = 2.0 / self.n;
        let seen = self.seen.max(0.0);
        let weight = seen + self.chance;
        let ratio = if weight > 0.0 { (self.error * self.error + weak * self.chance) / weight } else { weak };
        let slope = if seen > 1e-9 { ratio * 2.0 * seen / libm::expm1(2.0 * seen) } else { ratio };
        let shift = 0.5 * t * t * slope;
        let variance = ratio * seen + slope * (value - seen) + self.chance * self.chance;
        let square = shift * shift + t * t * variance;
        let half = libm::sqrt(square.max(0.0));
        ((value + shift - half).min(value), (value + shift + half).max(value))
    }
}

impl Scatter {
    /// An upper end that holds for normals however few: the largest I with I − value ≤ t √(V(I) + chance²), V growing as
    /// 1 − e^(−2I) all the way, and error² no more than 1 + n/16 times what normals have, 2 I/n. Of twenty samples the
    /// spread of the contributions says little, and a V that grows along its tangent has no end.
    pub(super) fn highest(self, value: f64, t: f64) -> f64 {
        let (weak, seen) = (2.0 / self.n, self.seen.max(0.0));
        let square = (self.error * self.error).min((1.0 + self.n / 16.0) * weak * seen);
        let weight = seen + self.chance;
        let ratio = if weight > 0.0 { (square + weak * self.chance) / weight } else { weak };
        // V(seen) = ratio · seen
        let limit = if seen > 1e-9 { ratio * seen / -libm::expm1(-2.0 * seen) } else { 0.5 * ratio };
        let end = |i: f64| value + t * libm::sqrt(limit * -libm::expm1(-2.0 * i.max(0.0)) + self.chance * self.chance);
        // concave and rising: from above it falls to its largest fixed point
        (0..200).fold(value.max(0.0) + t * libm::sqrt(limit + self.chance * self.chance), |i, _| end(i))
    }
}

/// Degrees of freedom above which Student's quantile is the normal one and its first correction.
const NORMAL: f64 = 1e4;

/// The two-sided 95 % quantile of Student's t for `blocks` independent blocks.
pub(super) fn t_quantile(blocks: usize) -> f64 {
    let degrees = blocks.saturating_sub(1).max(1) as f64;
    if degrees > NORMAL {
        // z + (z³ + z)/4ν, right to eight digits; the search for Student's quantile is right to four at a million, and does
        // not end at a hundred million
        return 1.959_963_984_540_054 + 2.372_271_5 / degrees;
    }
    StudentsT::new(0.0, 1.0, degrees).map_or(f64::NAN, |t| t.inverse_cdf(0.975))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quantile_falls_to_that_of_the_normal_and_is_found_at_any_number_of_blocks() {
        assert!((t_quantile(5) - 2.776_445).abs() < 1e-5);
        // 1.960 201 at ten thousand degrees, on either side of where the expansion begins
        assert!([t_quantile(10_001), t_quantile(10_002)].iter().all(|t| (t - 1.960_201_2).abs() < 1e-5));
        let [large, larger] = [t_quantile(1_000_000), t_quantile(100_000_000)];
        assert!(large >= larger && large - larger < 3e-6, "{large} {larger}");
    }

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
    fn without_dependence_the_interval_is_that_of_chance_and_with_much_the_usual_one() {
        // no dependence seen: 0 is inside as long as χ² ≤ 1 + 1.96 √2
        let at = |chi: f64| {
            let n = 1000.0;
            let seen = chi / (2.0 * n);
            let scatter = Scatter { seen, error: libm::sqrt(2.0 * seen / n), chance: libm::sqrt(0.5) / n, n };
            scatter.around((chi - 1.0) / (2.0 * n), 1.96)
        };
        assert!(at(3.7).0 < 0.0 && at(3.85).0 > 0.0, "{:?} {:?}", at(3.7), at(3.85));
        // the value is inside, even where it is negative
        assert!(at(0.0).0 <= -0.5e-3 && at(0.0).1 > 0.0, "{:?}", at(0.0));
        let much = Scatter { seen: 1.0, error: 0.01, chance: 1e-5, n: 5000.0 };
        let (low, high) = much.around(1.0, 2.0);
        assert!((low - 0.98).abs() < 5e-4 && (high - 1.02).abs() < 5e-4, "{low} {high}");
        let nothing = Scatter { seen: 0.0, error: 0.0, chance: 0.0, n: 10.0 };
        assert!(nothing.around(0.0, 2.0).1.is_finite());
    }

    #[test]
    fn copies_within_a_block_add_no_information() {
        let once = block_interval(&[1.0, 2.0, 6.0], &[0, 1, 2]);
        let thrice = block_interval(&[1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 6.0, 6.0, 6.0], &[0, 0, 0, 1, 1, 1, 2, 2, 2]);
        assert!((once.error - thrice.error).abs() < 1e-12);
        assert!(thrice.n_effective < 3.0 && thrice.blocks == 3);
    }
}
