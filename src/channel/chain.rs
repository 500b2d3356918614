//! Independent losses and burst chains: counts of what follows a run of losses, and the chain they earn.
//!
//! In a chain of the `markov` link only state 0 delivers, so that a delivered message says the state, and with K states of
//! the form "back to 0, else one further" so does the number of losses since: what the link bits identify is the
//! probability of delivery after m losses in a row, m = 0, 1, …. Chains of another form with the same probabilities give
//! the same bits; the fitted one has this form, and its last state stands for all longer runs.

use super::score::gain;
use super::{ChannelError, Observations};
use crate::rng::{Seeds, permutation};

/// Losses in a row that are told apart; longer runs count as this many.
pub const MAX_LOSSES: usize = 15;

/// Messages that a state must have led to, for a chain to have it and for its probability to be reported.
pub(super) const LEAST_VISITS: u64 = 20;

/// Parts of the episodes by which the order is chosen.
const FOLDS: usize = 5;

/// Standard errors by which a chain must beat independent losses.
pub(super) const EARNED: f64 = 3.0;

/// What followed m losses in a row, and what came first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Runs {
    /// First messages of an episode: all, lost.
    pub first: [u64; 2],
    /// Messages after m losses in a row: all, lost; the last counts longer runs too.
    pub after: [[u64; 2]; MAX_LOSSES + 1],
}

impl Runs {
    /// Counts one sequence of messages, lost or not.
    pub fn add(&mut self, lost: &[bool]) {
        let mut run = None;
        for &lost in lost {
            let count = run.map_or(&mut self.first, |m: usize| &mut self.after[m.min(MAX_LOSSES)]);
            count[0] += 1;
            count[1] += u64::from(lost);
            run = Some(if lost { run.unwrap_or(0) + 1 } else { 0 });
        }
    }

    /// The counts of an episode.
    pub(super) fn of(observations: &Observations, episode: usize) -> Self {
        let mut runs = Self::default();
        observations.sequences(episode).for_each(|sequence| runs.add(&observations.lost[sequence]));
        runs
    }

    fn combine(&mut self, other: &Self, op: fn(u64, u64) -> u64) {
        let counts = self.first.iter_mut().chain(self.after.iter_mut().flatten());
        for (own, others) in counts.zip(other.first.iter().chain(other.after.iter().flatten())) {
            *own = op(*own, *others);
        }
    }

    /// The sum of several counts.
    pub(super) fn sum<'a>(all: impl Iterator<Item = &'a Self>) -> Self {
        let mut sum = Self::default();
        all.for_each(|runs| sum.combine(runs, |a, b| a + b));
        sum
    }

    /// All messages, lost ones.
    pub(super) fn total(&self) -> [u64; 2] {
        self.after.iter().fold(self.first, |sum, count| [sum[0] + count[0], sum[1] + count[1]])
    }

    /// What followed m or more losses.
    pub(super) fn from(&self, m: usize) -> [u64; 2] {
        self.after[m..].iter().fold([0; 2], |sum, count| [sum[0] + count[0], sum[1] + count[1]])
    }

    /// The most states of a chain whose every state was left often enough.
    fn most_states(&self) -> usize {
        (2..=MAX_LOSSES + 1).take_while(|&states| self.from(states - 1)[0] >= LEAST_VISITS).last().unwrap_or(1)
    }
}

/// A fitted chain: loss probabilities of the first message and after m losses in a row, m up to the last state. With one
/// state losses are independent, and the first message is like all others.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Chain {
    /// Of the first message.
    pub(super) first: f64,
    /// In each state.
    pub(super) lost: Vec<f64>,
    /// Bounds that keep a prediction off 0 and 1: half a message in the data.
    floor: f64,
}

impl Chain {
    /// The chain of `states` states that fits best.
    pub(super) fn fit(runs: &Runs, states: usize) -> Self {
        let share = |[all, lost]: [u64; 2]| if all == 0 { 0.0 } else { lost as f64 / all as f64 };
        let total = runs.total();
        let floor = 0.5 / (total[0] + 1) as f64;
        if states < 2 {
            return Self { first: share(total), lost: vec![share(total)], floor };
        }
        let state = |m: usize| share(if m + 1 == states { runs.from(m) } else { runs.after[m] });
        Self { first: share(runs.first), lost: (0..states).map(state).collect(), floor }
    }

    /// Predicted loss probability after `run` losses in a row; `None`: the first message.
    fn predict(&self, run: Option<usize>) -> f64 {
        let p = run.map_or(self.first, |m| self.lost[m.min(self.lost.len() - 1)]);
        p.clamp(self.floor, 1.0 - self.floor)
    }

    /// Appends the predicted loss probability of each message of an episode, one message ahead.
    pub(super) fn predict_episode(&self, observations: &Observations, episode: usize, out: &mut Vec<f64>) {
        for sequence in observations.sequences(episode) {
            let mut run = None;
            for &lost in &observations.lost[sequence] {
                out.push(self.predict(run));
                run = Some(if lost { run.unwrap_or(0) + 1 } else { 0 });
            }
        }
    }

    /// Log-likelihood of counts, nats.
    fn log_likelihood(&self, runs: &Runs) -> f64 {
        let term = |[all, lost]: [u64; 2], p: f64| lost as f64 * p.ln() + (all - lost) as f64 * (1.0 - p).ln();
        let after: f64 = runs.after.iter().enumerate().map(|(m, &count)| term(count, self.predict(Some(m)))).sum();
        term(runs.first, self.predict(None)) + after
    }

    /// Rows of the transition matrix: back to state 0, else one further.
    pub(super) fn matrix(&self) -> Vec<Vec<f64>> {
        let states = self.lost.len();
        let row = |(s, &lost): (usize, &f64)| {
            let mut row = vec![0.0; states];
            row[0] = 1.0 - lost;
            row[(s + 1).min(states - 1)] = lost;
            row
        };
        self.lost.iter().enumerate().map(row).collect()
    }
}

/// The number of states that held-out likelihood chooses, and by how much it beats independent losses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Order {
    /// States; 1: no chain is earned.
    pub(super) states: usize,
    /// Gain of the best chain over independent losses, nats per message.
    pub(super) gain: f64,
    /// Its standard error over episodes.
    pub(super) error: f64,
}

/// Chooses the number of states from counts per episode: every episode is predicted by chains fitted on the other folds;
/// a chain must beat independent losses by [`EARNED`] standard errors, and of the chains the smallest one within one
/// standard error of the best is taken.
pub(super) fn choose_order(runs: &[Runs], seeds: &Seeds) -> Order {
    let total = Runs::sum(runs.iter());
    let most = total.most_states();
    let mut likelihoods = vec![vec![0.0; runs.len()]; most];
    let order = permutation(&mut seeds.stream("folds"), runs.len());
    for fold in 0..FOLDS.min(runs.len()) {
        let held: Vec<usize> = order.iter().copied().skip(fold).step_by(FOLDS).collect();
        let mut rest = total;
        rest.combine(&Runs::sum(held.iter().map(|&e| &runs[e])), |a, b| a - b);
        for (states, likelihood) in likelihoods.iter_mut().enumerate() {
            let chain = Chain::fit(&rest, states + 1);
            for &e in &held {
                likelihood[e] = chain.log_likelihood(&runs[e]);
            }
        }
    }
    let messages: Vec<u64> = runs.iter().map(|r| r.total()[0]).collect();
    let sum = |states: usize| likelihoods[states - 1].iter().sum::<f64>();
    let Some(best) = (2..=most).max_by(|&a, &b| sum(a).total_cmp(&sum(b)).then(b.cmp(&a))) else {
        return Order { states: 1, gain: 0.0, error: 0.0 };
    };
    let against = |states: usize| gain(&likelihoods[best - 1], &likelihoods[states - 1], &messages);
    let (gain, error) = against(1);
    let smallest = (2..=most).find(|&states| {
        let (behind, error) = against(states);
        behind <= error
    });
    let states = if gain > EARNED * error { smallest.unwrap_or(best) } else { 1 };
    Order { states, gain, error }
}

/// The chain that the episodes earn.
///
/// # Errors
/// [`ChannelError::NoChain`].
pub(super) fn earned(observations: &Observations, episodes: &[usize], seeds: &Seeds) -> Result<usize, ChannelError> {
    let runs: Vec<Runs> = episodes.iter().map(|&e| Runs::of(observations, e)).collect();
    let Order { states, gain, error } = choose_order(&runs, seeds);
    if states == 1 {
        let path = observations.source.path.clone();
        return Err(ChannelError::NoChain { gain, error, margin: EARNED, path });
    }
    Ok(states)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::bernoulli;

    /// Counts per episode of a chain that loses with these probabilities after m losses (the last: and more).
    fn simulate(lost: &[f64], first: f64, episodes: usize, seed: u64) -> Vec<Runs> {
        let mut stream = Seeds::new(seed).stream("chain");
        let mut one = || {
            let mut runs = Runs::default();
            for _ in 0..6 {
                let (mut sequence, mut run) = (Vec::new(), None::<usize>);
                for _ in 0..26 {
                    let p = run.map_or(first, |m| lost[m.min(lost.len() - 1)]);
                    let this = bernoulli(&mut stream, p);
                    run = Some(if this { run.unwrap_or(0) + 1 } else { 0 });
                    sequence.push(this);
                }
                runs.add(&sequence);
            }
            runs
        };
        (0..episodes).map(|_| one()).collect()
    }

    #[test]
    fn runs_of_losses_are_counted() {
        let mut runs = Runs::default();
        runs.add(&[false, true, true, false, false]);
        runs.add(&[true, true, false]);
        assert_eq!(runs.first, [2, 1]);
        assert_eq!(runs.after[..3], [[2, 1], [2, 2], [2, 0]]);
        assert_eq!((runs.total(), runs.from(1)), ([8, 4], [4, 2]));
        let mut long = Runs::default();
        long.add(&[true; 40]);
        assert_eq!(long.after[MAX_LOSSES], [25, 25]);
    }

    #[test]
    fn the_last_state_pools_longer_runs_and_the_matrix_is_the_links() {
        let mut runs = Runs::default();
        runs.add(&[false, true, true, false, false]);
        let chain = Chain::fit(&runs, 2);
        assert_eq!((chain.first, chain.lost.clone()), (0.0, vec![0.5, 0.5]));
        assert_eq!(chain.matrix(), [[0.5, 0.5], [0.5, 0.5]]);
        let three = Chain { first: 0.0, lost: vec![0.1, 0.4, 0.7], floor: 1e-15 };
        assert_eq!(three.matrix(), [[0.9, 0.1, 0.0], [0.6, 0.0, 0.4], [1.0 - 0.7, 0.0, 0.7]]);
        let expected = 2.0 * 0.9_f64.ln() + 0.1_f64.ln() + 0.4_f64.ln() + (1.0 - 0.7_f64).ln();
        let mut longer = Runs::default();
        longer.add(&[false, true, true, false, false, false]);
        assert!(
            (three.log_likelihood(&longer) - expected).abs() < 1e-12,
            "first message, then 0 1 2 0 0 losses before"
        );
    }

    #[test]
    fn no_chain_is_earned_by_independent_losses_and_one_is_by_bursts() {
        let mut wrong = 0;
        for seed in 0..100 {
            wrong += usize::from(choose_order(&simulate(&[0.2], 0.2, 100, seed), &Seeds::new(seed)).states > 1);
        }
        assert!(wrong <= 1, "{wrong} of 100 found bursts where there are none");
        for seed in 0..20 {
            let order = choose_order(&simulate(&[0.06, 0.4, 0.29, 0.13], 0.0, 100, seed), &Seeds::new(seed));
            assert!((2..=4).contains(&order.states), "{order:?}");
            let late = choose_order(&simulate(&[0.2, 0.2], 0.0, 100, seed), &Seeds::new(seed));
            assert!(late.states > 1, "the first message always arrives: {late:?}");
        }
        let long = choose_order(&simulate(&[0.1, 0.2, 0.55, 0.9], 0.0, 400, 1), &Seeds::new(1));
        assert_eq!(long.states, 4, "{long:?}");
    }
}
