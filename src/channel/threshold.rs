//! A hard range: the distance up to which messages arrive.

use crate::link::FEATURES;

/// A fitted range.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Range {
    /// World units: the middle of the gap that splits the classes best.
    pub(super) reach: f64,
    /// Lower end of the interval. Without contradictions the largest delivered distance: no hard range below it can be.
    pub(super) low: f64,
    /// Upper end. Without contradictions the smallest lost distance: no hard range there or above can be.
    pub(super) high: f64,
    /// Messages that arrived from beyond the range, or were lost within it.
    pub(super) contradictions: u64,
    /// Probability of such a message, half a message added.
    pub(super) error: f64,
}

/// ln 0.05's share of a likelihood ratio: half the 95 % point of χ² with one degree of freedom.
const RATIO: f64 = 1.920_729_410_347_062;

/// The range that contradicts the fewest messages.
///
/// With contradictions, each message is taken to contradict with one probability, and the interval is that of the
/// likelihood ratio at 95 %, approximate. Without, it is exact whatever the sample.
pub(super) fn fit(mut messages: Vec<(f64, bool)>) -> Range {
    messages.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let n = messages.len() as u64;
    let end = messages.last().map_or(0.0, |m| m.0);
    let delivered = messages.iter().filter(|m| !m.1).count() as u64;
    // the range lies below all distances at first, then moves past one distance after the other
    let mut wrong = delivered;
    let mut cuts = vec![(0.0, messages.first().map_or(0.0, |m| m.0), wrong)];
    for (i, &(distance, lost)) in messages.iter().enumerate() {
        wrong = if lost { wrong + 1 } else { wrong - 1 };
        let next = messages.get(i + 1).map_or(end, |m| m.0);
        if next > distance || i + 1 == messages.len() {
            cuts.push((distance, next, wrong));
        }
    }
    let fewest = cuts.iter().map(|c| c.2).min().unwrap_or(0);
    let best: Vec<&(f64, f64, u64)> = cuts.iter().filter(|c| c.2 == fewest).collect();
    let middle = best.get(best.len() / 2).map_or((0.0, 0.0), |c| (c.0, c.1));
    let likelihood = |k: u64| {
        let share = k as f64 / n.max(1) as f64;
        let term = |count: u64, p: f64| if count == 0 { 0.0 } else { count as f64 * p.ln() };
        term(k, share) + term(n - k, 1.0 - share)
    };
    let top = likelihood(fewest);
    let possible = |c: &&(f64, f64, u64)| c.2 == fewest || top - likelihood(c.2) <= RATIO;
    let low = cuts.iter().filter(possible).map(|c| c.0).fold(f64::INFINITY, f64::min);
    let high = cuts.iter().filter(possible).map(|c| c.1).fold(0.0, f64::max);
    let error = (fewest as f64 + 0.5) / (n + 1) as f64;
    Range { reach: 0.5 * (middle.0 + middle.1), low, high, contradictions: fewest, error: error.min(0.5) }
}

impl Range {
    /// Predicted loss probability of a message.
    pub(super) fn predict(&self, features: &[f64; FEATURES.len()]) -> f64 {
        if features[2] <= self.reach { self.error } else { 1.0 - self.error }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_contradictions_the_interval_is_the_gap() {
        let found = fit(vec![(0.7, false), (0.9, true), (0.3, false), (1.5, true), (0.3, false), (0.9, true)]);
        assert_eq!((found.low, found.high, found.reach, found.contradictions), (0.7, 0.9, 0.8, 0));
        assert_eq!(found.error, 0.5 / 7.0);
        assert_eq!(found.predict(&[0.0, 0.0, 0.8, 0.0, 0.0]), found.error);
        assert_eq!(found.predict(&[0.0, 0.0, 0.81, 0.0, 0.0]), 1.0 - found.error);
    }

    #[test]
    fn with_contradictions_it_is_wider() {
        // 200 messages at 0.005, 0.010, …, 1.000; lost beyond 0.5, and every 25th contradicts
        let messages = (1..=200).map(|i| (f64::from(i) * 0.005, (i > 100) != (i % 25 == 0))).collect();
        let found = fit(messages);
        // the message at 0.5 was lost: a range just below it contradicts one message fewer
        assert_eq!(found.contradictions, 7);
        assert!(found.low <= 0.5 && 0.5 <= found.high && found.high - found.low < 0.05, "{found:?}");
        assert!((found.reach - 0.4975).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn equal_distances_of_both_classes_are_not_split() {
        let found = fit(vec![(0.5, true), (0.5, false), (0.2, false), (0.8, true)]);
        assert_eq!(found.contradictions, 1);
        assert!(found.low <= 0.2 && found.high >= 0.8, "{found:?}");
    }
}
