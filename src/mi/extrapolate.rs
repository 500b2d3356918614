//! How a value moves with the number of samples: the estimate on all, on halves and on quarters, and the line to 1/n = 0.

use super::{Estimator, Protocol, Unit};
use crate::rng::{self, Seeds};
use crate::schema::{Exchange, Samples};

/// Parts into which the samples are dealt, one division after another.
pub const DIVISIONS: [usize; 3] = [1, 2, 4];

/// A value on a part of the samples.
#[derive(Clone, Debug, PartialEq)]
pub struct PartValue {
    /// Estimator, or the one of its values that is in nats.
    pub estimator: String,
    /// Into how many the samples were dealt.
    pub division: usize,
    /// Samples of this part.
    pub n: usize,
    /// Value.
    pub value: f64,
}

/// Values on parts, and the line through the means of the divisions by least squares.
#[derive(Clone, Debug, PartialEq)]
pub struct Extrapolated {
    /// Values by part.
    pub parts: Vec<PartValue>,
    /// Where the line meets 1/n = 0.
    pub limit: f64,
    /// Its slope.
    pub slope: f64,
}

/// The first value in nats on part `part` of `division`, without a p-value; `None` when the
/// part is too small for the estimator or the value is not finite.
///
/// Whole episodes are dealt out: at random, or as neighbours where they are one series.
pub fn part_value(
    estimator: &dyn Estimator,
    samples: &Samples,
    division: usize,
    part: usize,
    seeds: &Seeds,
) -> Option<PartValue> {
    let blocks = samples.episodes();
    let mut episodes = blocks.clone();
    episodes.dedup();
    let count = episodes.len();
    let order = match samples.exchange {
        Exchange::Episodes => rng::permutation(&mut seeds.indexed_stream("parts", division as u64), count),
        Exchange::Shift => (0..count).collect(),
    };
    let mut chosen = vec![false; samples.starts.len()];
    for &at in &order[count * part / division..count * (part + 1) / division] {
        chosen[episodes[at] as usize] = true;
    }
    let rows = samples.rows.iter().zip(&blocks).filter(|(_, b)| chosen[**b as usize]).map(|(r, _)| *r).collect();
    let own = Samples { rows, ..samples.clone() };
    let found = estimator.estimate(&own, &Protocol { permutations: 0 }, seeds).ok()?;
    let of = found.into_iter().find(|r| r.unit == Unit::Nats && r.value.is_finite())?;
    Some(PartValue { estimator: of.estimator, division, n: own.len(), value: of.value })
}

/// The line through the means of the divisions over 1/n; `None` without two divisions.
pub fn extrapolated(mut parts: Vec<PartValue>) -> Option<Extrapolated> {
    parts.sort_by(|a, b| (a.division, a.n).cmp(&(b.division, b.n)).then(a.value.total_cmp(&b.value)));
    let means: Vec<(f64, f64)> = parts
        .chunk_by(|a, b| a.division == b.division)
        .map(|same| {
            let mean = |of: fn(&PartValue) -> f64| same.iter().map(of).sum::<f64>() / same.len() as f64;
            (1.0 / mean(|p| p.n as f64), mean(|p| p.value))
        })
        .collect();
    let count = means.len() as f64;
    let (x, y) = (means.iter().map(|m| m.0).sum::<f64>() / count, means.iter().map(|m| m.1).sum::<f64>() / count);
    let spread: f64 = means.iter().map(|m| (m.0 - x) * (m.0 - x)).sum();
    let slope = means.iter().map(|m| (m.0 - x) * (m.1 - y)).sum::<f64>() / spread;
    (means.len() > 1 && slope.is_finite()).then_some(Extrapolated { parts, limit: y - slope * x, slope })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::run::tests::{linear_samples, plan};

    #[test]
    fn the_bias_of_counts_falls_as_one_over_n_and_the_line_takes_it_away() {
        // independent categories: the plug-in value is (K − 1)² / 2n too high
        let mut samples = linear_samples(0.0, 4000, 1, 5);
        let cut = |c: &crate::schema::Columns| {
            let data = c.data.iter().map(|v| (v * 2.0).round().clamp(-3.0, 3.0)).collect();
            std::sync::Arc::new(crate::schema::Columns::new(data, c.names.clone()))
        };
        (samples.x, samples.y) = (cut(&samples.x), cut(&samples.y));
        let plan = plan(&["discrete"], 0, 1);
        let of = |division: usize, part| {
            part_value(&*plan.estimators[0].1, &samples, division, part, &Seeds::new(1)).unwrap()
        };
        let places = DIVISIONS.iter().flat_map(|&d| (0..d).map(move |part| (d, part)));
        let parts: Vec<PartValue> = places.map(|(division, part)| of(division, part)).collect();
        let all: Vec<usize> = parts.iter().map(|p| p.n).collect();
        assert_eq!(all, [4000, 2000, 2000, 1000, 1000, 1000, 1000]);
        let (whole, found) = (parts[0].value, extrapolated(parts).unwrap());
        // (7 − 1)² / 2 = 18
        assert!((found.slope / 18.0 - 1.0).abs() < 0.3, "{}", found.slope);
        assert!(found.limit.abs() < 0.4 * whole, "{} after {whole}", found.limit);
        assert!(extrapolated(vec![PartValue { estimator: String::new(), division: 1, n: 9, value: 0.0 }]).is_none());
        // too few for any estimate
        assert_eq!(part_value(&*plan.estimators[0].1, &linear_samples(0.0, 3, 1, 5), 4, 0, &Seeds::new(1)), None);
    }

    #[test]
    fn parts_of_a_series_are_neighbours_and_all_parts_together_are_all_samples() {
        let mut samples = linear_samples(0.5, 400, 1, 6);
        samples.starts = (0..=40).map(|e| 10 * e).collect::<Vec<_>>().into();
        let plan = plan(&["gaussian"], 0, 1);
        let of =
            |samples: &Samples, part| part_value(&*plan.estimators[0].1, samples, 2, part, &Seeds::new(1)).unwrap();
        assert_eq!(of(&samples, 0).n + of(&samples, 1).n, 400);
        let shuffled = of(&samples, 0).value;
        samples.exchange = Exchange::Shift;
        let first = Samples { rows: (0..200).collect(), ..samples.clone() };
        let alone = plan.estimators[0].1.estimate(&first, &Protocol { permutations: 0 }, &Seeds::new(1)).unwrap();
        assert_eq!(of(&samples, 0).value, alone[0].value);
        assert_ne!(shuffled, alone[0].value);
    }
}
