//! How well predicted loss probabilities are: log-likelihood, Brier score, balanced accuracy, calibration.
//!
//! Sums are kept per episode, the unit that is held out and resampled.

use serde::Serialize;

use super::Observations;
use crate::rng::{Seeds, below};
use crate::stats::{Interval, clopper_pearson, quantile};

/// Bins of equal width over the predicted probability (Guo et al. 2017).
const BINS: usize = 15;

/// Resamples of the episodes behind an interval.
const RESAMPLES: usize = 500;

/// Sums over the messages of an episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Tally {
    /// Σ ln P(what happened), nats.
    pub(super) log: f64,
    /// Σ (p − lost)².
    brier: f64,
    /// Messages and hits of a prediction p > ½, per class: delivered, lost.
    classes: [[u64; 2]; 2],
    /// Per bin: messages, lost ones, Σ p.
    bins: [(u64, u64, f64); BINS],
}

impl Tally {
    /// Counts the messages of one episode under the predicted loss probabilities, all within (0, 1).
    pub(super) fn of(lost: &[bool], predicted: &[f64]) -> Self {
        let mut tally = Self::default();
        for (&lost, &p) in lost.iter().zip(predicted) {
            tally.log += if lost { p.ln() } else { (1.0 - p).ln() };
            let miss = p - f64::from(u8::from(lost));
            tally.brier += miss * miss;
            let class = &mut tally.classes[usize::from(lost)];
            class[0] += 1;
            class[1] += u64::from((p > 0.5) == lost);
            let bin = &mut tally.bins[((p * BINS as f64) as usize).min(BINS - 1)];
            *bin = (bin.0 + 1, bin.1 + u64::from(lost), bin.2 + p);
        }
        tally
    }

    fn add(&mut self, other: &Self) {
        self.log += other.log;
        self.brier += other.brier;
        for (own, others) in self.classes.iter_mut().flatten().zip(other.classes.iter().flatten()) {
            *own += others;
        }
        for (own, others) in self.bins.iter_mut().zip(&other.bins) {
            *own = (own.0 + others.0, own.1 + others.1, own.2 + others.2);
        }
    }

    /// Messages.
    pub(super) fn messages(&self) -> u64 {
        self.classes[0][0] + self.classes[1][0]
    }

    /// Log-likelihood per message, Brier score, balanced accuracy (NaN with one class), calibration error.
    fn figures(&self) -> [f64; 4] {
        let n = self.messages() as f64;
        let recall = |class: [u64; 2]| class[1] as f64 / class[0] as f64;
        let off: f64 = self.bins.iter().map(|&(_, lost, p)| (lost as f64 - p).abs()).sum();
        [self.log / n, self.brier / n, 0.5 * (recall(self.classes[0]) + recall(self.classes[1])), off / n]
    }
}

/// A figure with its 95 % interval, episodes resampled.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// The figure.
    pub value: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// A bin of the reliability figure.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Bin {
    /// Mean predicted loss probability.
    pub predicted: f64,
    /// Share of lost messages.
    pub observed: f64,
    /// Messages.
    pub messages: u64,
    /// Exact interval of the share, simultaneous 95 % over the bins, messages taken as independent.
    pub low: f64,
    /// Its upper end.
    pub high: f64,
}

/// How well a model predicts the messages of episodes that it was not fitted on.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Score {
    /// Episodes.
    pub episodes: usize,
    /// Messages.
    pub messages: u64,
    /// Mean log-likelihood per message, nats.
    pub log_likelihood: Estimate,
    /// Mean squared error of the predicted probability.
    pub brier: Estimate,
    /// Mean of the shares of delivered and of lost messages that a prediction above ½ gets right; `None` when only one
    /// class is held out.
    pub balanced_accuracy: Option<Estimate>,
    /// Mean distance of predicted and observed shares over 15 bins, weighted by messages.
    pub calibration_error: Estimate,
    /// Bins that hold messages.
    pub reliability: Vec<Bin>,
}

impl Score {
    /// The score of the episodes' tallies.
    pub(super) fn of(tallies: &[Tally], seeds: &Seeds) -> Self {
        let sum = |chosen: &mut dyn Iterator<Item = usize>| {
            let mut total = Tally::default();
            chosen.for_each(|e| total.add(&tallies[e]));
            total
        };
        let total = sum(&mut (0..tallies.len()));
        let mut stream = seeds.stream("score");
        let mut resampled = vec![Vec::new(); 4];
        for _ in 0..RESAMPLES {
            let figures = sum(&mut (0..tallies.len()).map(|_| below(&mut stream, tallies.len()))).figures();
            for (all, figure) in resampled.iter_mut().zip(figures) {
                if figure.is_finite() {
                    all.push(figure);
                }
            }
        }
        let figures = total.figures();
        let estimate = |i: usize| Estimate {
            value: figures[i],
            low: quantile(&resampled[i], 0.025),
            high: quantile(&resampled[i], 0.975),
        };
        let filled = total.bins.iter().filter(|bin| bin.0 > 0).count();
        let level = 1.0 - 0.05 / filled.max(1) as f64;
        let bin = |&(messages, lost, p): &(u64, u64, f64)| {
            let Interval { low, high } = clopper_pearson(lost, messages, level);
            let n = messages as f64;
            Bin { predicted: p / n, observed: lost as f64 / n, messages, low, high }
        };
        Self {
            episodes: tallies.len(),
            messages: total.messages(),
            log_likelihood: estimate(0),
            brier: estimate(1),
            balanced_accuracy: figures[2].is_finite().then(|| estimate(2)),
            calibration_error: estimate(3),
            reliability: total.bins.iter().filter(|bin| bin.0 > 0).map(bin).collect(),
        }
    }
}

/// Tallies of episodes under a prediction: `predict(episode, out)` appends one loss probability per message, in order.
pub(super) fn tallies(
    observations: &Observations,
    episodes: &[usize],
    mut predict: impl FnMut(usize, &mut Vec<f64>),
) -> Vec<Tally> {
    let mut predicted = Vec::new();
    let one = |&episode: &usize| {
        predicted.clear();
        predict(episode, &mut predicted);
        Tally::of(&observations.lost[observations.episode(episode)], &predicted)
    };
    episodes.iter().map(one).collect()
}

/// Mean difference of log-likelihood per message between two models on the same episodes, and its standard error over
/// episodes, nats.
pub(super) fn gain(better: &[f64], worse: &[f64], messages: &[u64]) -> (f64, f64) {
    let episodes = better.len() as f64;
    let total = messages.iter().sum::<u64>() as f64;
    let differences: Vec<f64> = better.iter().zip(worse).map(|(a, b)| a - b).collect();
    (differences.iter().sum::<f64>() / total, crate::stats::sd(&differences) * episodes.sqrt() / total)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_of_a_hand_made_prediction() {
        let lost = [true, false, false, true];
        let tally = Tally::of(&lost, &[0.9, 0.1, 0.6, 0.6]);
        let [log, brier, balanced, calibration] = tally.figures();
        let expected = (0.9_f64.ln() + 0.9_f64.ln() + 0.4_f64.ln() + 0.6_f64.ln()) / 4.0;
        assert!((log - expected).abs() < 1e-15);
        assert!((brier - (0.01 + 0.01 + 0.36 + 0.16) / 4.0).abs() < 1e-15);
        assert_eq!(balanced, 0.75, "one of two delivered, both lost ones");
        // bins: 0.9 (lost), 0.1 (delivered), twice 0.6 (one lost): |1 − 0.9| + |0 − 0.1| + |1 − 1.2| over 4
        assert!((calibration - 0.1).abs() < 1e-12, "{calibration}");
    }

    #[test]
    fn intervals_hold_the_figures_and_one_class_has_no_balance() {
        let tallies: Vec<Tally> = (0..40).map(|e| Tally::of(&[e % 4 == 0, false], &[0.3, 0.3])).collect();
        let score = Score::of(&tallies, &Seeds::new(1));
        assert_eq!((score.episodes, score.messages, score.reliability.len()), (40, 80, 1));
        for estimate in [score.log_likelihood, score.brier, score.calibration_error, score.balanced_accuracy.unwrap()] {
            assert!(estimate.low <= estimate.value && estimate.value <= estimate.high, "{estimate:?}");
        }
        let bin = score.reliability[0];
        assert_eq!((bin.observed, bin.messages), (0.125, 80));
        assert!(bin.low < 0.125 && 0.125 < bin.high && (bin.predicted - 0.3).abs() < 1e-12);
        let one = Score::of(&[Tally::of(&[false], &[0.2])], &Seeds::new(1));
        assert_eq!(one.balanced_accuracy, None);
    }

    #[test]
    fn a_gain_is_per_message_with_its_error_over_episodes() {
        let (gain, error) = gain(&[3.0, 5.0], &[1.0, 1.0], &[2, 2]);
        assert_eq!(gain, 1.5);
        assert!((error - 2.0_f64.sqrt() * 2.0_f64.sqrt() / 4.0).abs() < 1e-15);
    }
}
