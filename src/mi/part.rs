//! Samples taken by whole episodes: a part of them when all would cost too much, the permutations of a null test, and
//! errors by subsampling.

use rayon::prelude::*;

use super::given::permuted_within;
use super::{Protocol, permuted_rows};
use crate::rng::{self, Seeds};
use crate::schema::{Exchange, Samples};

/// Groups into which one round of subsampling deals the episodes: few, since small groups tell less of all samples.
const GROUPS: usize = 4;
/// Rounds of subsampling.
const ROUNDS: usize = 10;
/// Fewest episodes in a part, if there are as many.
const LEAST: usize = 20;

/// What subsampling says about a statistic.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Subsampled {
    /// Its standard error on all samples, should its variance fall as their number.
    pub(super) error: f64,
    /// Degrees of freedom of that.
    pub(super) degrees: usize,
    /// Its mean over groups.
    mean: f64,
    /// Samples of a group.
    size: f64,
}

impl Subsampled {
    /// The error on `n` samples of a statistic whose variance times the number m of samples grows as m/(m + `growth`).
    pub(super) fn error_on(self, n: usize, growth: f64) -> f64 {
        self.error * libm::sqrt((1.0 + growth / self.size) / (1.0 + growth / n as f64))
    }

    /// How far a statistic with this value on `n` samples may still be from where it goes as samples are added, if what
    /// is left falls as 1/√n.
    pub(super) fn drift(self, value: f64, n: usize) -> f64 {
        (value - self.mean) / (libm::sqrt(n as f64 / self.size) - 1.0)
    }
}

/// Some episodes, ascending, and their samples.
pub(super) struct Part {
    episodes: Vec<u32>,
    /// The samples' rows, ascending.
    pub(super) rows: Vec<u32>,
    /// Where the samples of each episode stand in `rows`; one more at the end.
    bounds: Vec<usize>,
}

impl Part {
    /// All samples.
    pub(super) fn all(samples: &Samples) -> Self {
        let blocks = samples.episodes();
        let mut bounds: Vec<usize> = (0..blocks.len()).filter(|&i| i == 0 || blocks[i] != blocks[i - 1]).collect();
        let episodes = bounds.iter().map(|&i| blocks[i]).collect();
        bounds.push(blocks.len());
        Self { episodes, rows: samples.rows.clone(), bounds }
    }

    /// Whole episodes drawn until they hold `limit` samples (and are at least twenty); neighbours when only shifts are
    /// exchangeable.
    pub(super) fn drawn(samples: &Samples, limit: usize, seeds: &Seeds) -> Self {
        let all = Self::all(samples);
        if all.rows.len() <= limit {
            return all;
        }
        let count = all.episodes.len();
        let mut rng = seeds.stream("part");
        let order = match samples.exchange {
            Exchange::Episodes => rng::permutation(&mut rng, count),
            Exchange::Shift => {
                let start = rng::below(&mut rng, count);
                (start..count).chain((0..start).rev()).collect()
            }
        };
        let least = if samples.exchange == Exchange::Episodes { LEAST } else { 1 };
        let (mut chosen, mut held) = (Vec::new(), 0);
        for e in order {
            if held >= limit && chosen.len() >= least {
                break;
            }
            held += all.bounds[e + 1] - all.bounds[e];
            chosen.push(e);
        }
        chosen.sort_unstable();
        let mut part = Self { episodes: Vec::new(), rows: Vec::new(), bounds: vec![0] };
        for e in chosen {
            part.episodes.push(all.episodes[e]);
            part.rows.extend_from_slice(&all.rows[all.bounds[e]..all.bounds[e + 1]]);
            part.bounds.push(part.rows.len());
        }
        part
    }

    /// Number of episodes.
    pub(super) fn len(&self) -> usize {
        self.episodes.len()
    }

    /// Episode of each of the rows.
    pub(super) fn blocks(&self) -> Vec<u32> {
        let spans = self.bounds.windows(2).zip(&self.episodes);
        spans.flat_map(|(span, &episode)| std::iter::repeat_n(episode, span[1] - span[0])).collect()
    }

    /// `statistic` under draws of the null: it is given, for each of the rows, the row whose x takes its place.
    pub(super) fn null(
        &self,
        samples: &Samples,
        protocol: Protocol,
        seeds: &Seeds,
        statistic: &(dyn Fn(&[u32]) -> f64 + Sync),
    ) -> Vec<f64> {
        let draw = |b: usize| {
            let mut rng = seeds.indexed_stream("null", b as u64);
            statistic(&permuted_rows(samples, &self.episodes, &self.rows, &mut rng))
        };
        (0..protocol.permutations).into_par_iter().map(draw).collect()
    }

    /// `statistic` under draws of the null given z, under which x is exchanged within `cells` of rows with alike z (by
    /// their places in `rows`); `None` when samples stand in episodes.
    pub(super) fn null_within(
        &self,
        cells: &[Vec<u32>],
        protocol: Protocol,
        seeds: &Seeds,
        statistic: &(dyn Fn(&[u32]) -> f64 + Sync),
    ) -> Option<Vec<f64>> {
        let draw = |b: usize| {
            let mut rng = seeds.indexed_stream("null", b as u64);
            let places = permuted_within(cells, self.rows.len(), &mut rng);
            statistic(&places.into_iter().map(|i| self.rows[i as usize]).collect::<Vec<_>>())
        };
        (self.len() == self.rows.len()).then(|| (0..protocol.permutations).into_par_iter().map(draw).collect())
    }

    /// The standard error that `statistic` has on `n` samples, and its mean on fewer: the episodes are dealt into
    /// four groups, ten times over, and the variance between groups is scaled by their size (Holmes, Nemenman 2019).
    /// `None` when two groups of `least` samples cannot be made.
    pub(super) fn subsampled_error(
        &self,
        n: usize,
        least: usize,
        seeds: &Seeds,
        statistic: &(dyn Fn(&[u32]) -> f64 + Sync),
    ) -> Option<Subsampled> {
        let groups = GROUPS.min(self.len() / 2).min(self.rows.len() / least.max(1));
        if groups < 2 {
            return None;
        }
        let round = |round: usize| {
            let order = rng::permutation(&mut seeds.indexed_stream("subsample", round as u64), self.len());
            let value = |group: usize| {
                let mut dealt: Vec<usize> = order.iter().skip(group).step_by(groups).copied().collect();
                dealt.sort_unstable();
                let rows: Vec<u32> =
                    dealt.iter().flat_map(|&e| self.rows[self.bounds[e]..self.bounds[e + 1]].iter().copied()).collect();
                statistic(&rows)
            };
            let values: Vec<f64> = (0..groups).map(value).collect();
            let mean = values.iter().sum::<f64>() / groups as f64;
            (mean, values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>())
        };
        let rounds: Vec<(f64, f64)> = (0..ROUNDS).into_par_iter().map(round).collect();
        let between = rounds.iter().map(|r| r.1).sum::<f64>() / (ROUNDS * (groups - 1)) as f64;
        let mean = rounds.iter().map(|r| r.0).sum::<f64>() / ROUNDS as f64;
        let size = self.rows.len() as f64 / groups as f64;
        let error = libm::sqrt(between * size / n as f64);
        let degrees = (ROUNDS * (groups - 1)).min(self.len() - 1);
        error.is_finite().then_some(Subsampled { error, degrees, mean, size })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::run::tests::{linear_samples, samples_of};

    #[test]
    fn the_subsampled_error_of_a_mean_is_its_standard_error() {
        let samples = linear_samples(0.0, 2000, 1, 1);
        let mean = |rows: &[u32]| rows.iter().map(|&r| samples.x.data[r as usize]).sum::<f64>() / rows.len() as f64;
        let found = Part::all(&samples).subsampled_error(2000, 5, &Seeds::new(1), &mean).unwrap();
        let (error, degrees) = (found.error, found.degrees);
        let expected = 1.0 / 2000f64.sqrt();
        // a mean of 2000 is the mean of means of 500, and what falls as 1/√n is known from both
        assert!(found.drift(mean(&samples.rows), 2000).abs() < 1e-12);
        let falling = |rows: &[u32]| 1.0 - 1.0 / (rows.len() as f64).sqrt();
        let found = Part::all(&samples).subsampled_error(2000, 5, &Seeds::new(1), &falling).unwrap();
        // the variance of 500, and of 2000 if it grows as m/(m + 500)
        assert!((found.error_on(2000, 500.0) - found.error * 1.6f64.sqrt()).abs() < 1e-12);
        assert!((found.drift(falling(&samples.rows), 2000) - 1.0 / 2000f64.sqrt()).abs() < 1e-12);
        assert!((error / expected - 1.0).abs() < 0.25, "{error} against {expected}");
        assert_eq!(degrees, 30);
    }

    #[test]
    fn samples_that_repeat_within_an_episode_count_once() {
        let mut samples = linear_samples(0.0, 400, 1, 2);
        let thrice: Vec<Vec<f64>> = samples.x.data.iter().flat_map(|&v| vec![vec![v]; 3]).collect();
        samples =
            Samples { starts: (0..=400).map(|e| 3 * e).collect::<Vec<_>>().into(), ..samples_of(&thrice, &thrice) };
        let mean = |rows: &[u32]| rows.iter().map(|&r| samples.x.data[r as usize]).sum::<f64>() / rows.len() as f64;
        let Subsampled { error, .. } = Part::all(&samples).subsampled_error(1200, 5, &Seeds::new(1), &mean).unwrap();
        assert!((error * 400f64.sqrt() - 1.0).abs() < 0.25, "{error}");
    }

    #[test]
    fn a_drawn_part_holds_whole_episodes_and_neighbours_of_a_series() {
        let mut samples = linear_samples(0.0, 1000, 1, 3);
        samples.starts = (0..=100).map(|e| 10 * e).collect::<Vec<_>>().into();
        let part = Part::drawn(&samples, 300, &Seeds::new(1));
        assert_eq!((part.len(), part.rows.len()), (30, 300));
        assert!(part.rows.chunks(10).all(|c| c[0] % 10 == 0 && c[9] == c[0] + 9));
        samples.exchange = Exchange::Shift;
        let part = Part::drawn(&samples, 300, &Seeds::new(2));
        assert!(part.rows.windows(2).all(|w| w[1] == w[0] + 1) && part.rows.len() == 300);
        assert_eq!(Part::drawn(&samples, 1000, &Seeds::new(1)).rows, samples.rows);
        assert!(Part::all(&linear_samples(0.0, 3, 1, 1)).subsampled_error(3, 1, &Seeds::new(1), &|_| 0.0).is_none());
    }
}
