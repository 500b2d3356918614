//! Du-MIE: two mutual-information estimators that shape the team reward (paper Eqs. 3–6).
//!
//! r̃ = r + `Σ_i` Σ_{j≠i} [ α ι^{ji} `I_JSD(m^{ji`}; a^i) − β (1 − ι^{ji}) `I_CLUB(m^{ji`}; a^i) ]
//!
//! JSD (lower bound) learns from a ring of delivered pairs, CLUB (upper bound) from a ring of lost ones; both are
//! shared over all ordered links. Values are per sample; negatives are cyclic shifts of the action at fixed message,
//! so none is its own partner.

use super::TrainError;
use super::config::{DumieConfig, LostMessage, Negatives, Shaping};
use super::replay::Ring;
use crate::algo::Batch;
use crate::mi::conditional::{ConditionalTape, GaussianConditional};
use crate::mi::critic::{CriticTape, Separable};
use crate::mi::losses;
use crate::nn::{Adam, AdamConfig, Params};
use crate::rng::{self, Seeds, Stream};
use crate::schema::{Episode, Layout};

/// What the estimators report; `None` where there was nothing to estimate from.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DumieMetrics {
    /// JSD value of the training minibatch (shifted or not, as configured).
    pub jsd: Option<f64>,
    /// JSD value of pairs that the critic has not learned from yet.
    pub jsd_heldout: Option<f64>,
    /// CLUB value of the training minibatch, nats.
    pub club: Option<f64>,
    /// CLUB value of pairs that q has not learned from yet, nats.
    pub club_heldout: Option<f64>,
}

/// Pairs of one class.
#[derive(Debug, Default)]
struct Pairs {
    messages: Vec<f32>,
    actions: Vec<f32>,
    /// Which transition of the batch each pair belongs to.
    rows: Vec<usize>,
}

impl Pairs {
    fn clear(&mut self) {
        self.messages.clear();
        self.actions.clear();
        self.rows.clear();
    }

    fn push(&mut self, widths: [usize; 2], message: &[f32], action: &[f32], row: usize) {
        self.messages.extend_from_slice(message);
        self.messages.resize(self.messages.len() + widths[0] - message.len(), 0.0);
        self.actions.extend_from_slice(action);
        self.actions.resize(self.actions.len() + widths[1] - action.len(), 0.0);
        self.rows.push(row);
    }

    fn len(&self) -> usize {
        self.rows.len()
    }
}

/// One estimator's parameters, optimiser and ring.
#[derive(Debug)]
pub struct Estimator {
    /// Parameters, flat.
    pub params: Params,
    /// Optimiser.
    pub adam: Adam,
    /// The newest pairs of its class.
    pub ring: Ring,
    /// Pairs that came since the last update, at most a ring's worth: held out until then.
    fresh: Pairs,
}

impl Estimator {
    /// The pairs held out until the next update: messages and actions, flat.
    pub(super) fn fresh(&self) -> [&[f32]; 2] {
        [&self.fresh.messages, &self.fresh.actions]
    }

    /// Takes over held-out pairs of a checkpoint; false when their lengths do not fit.
    pub(super) fn restore_fresh(&mut self, messages: Vec<f32>, actions: Vec<f32>) -> bool {
        let [m, a] = self.ring.widths;
        let pairs = messages.len() / m;
        let fits = messages.len() == pairs * m && actions.len() == pairs * a;
        self.fresh = Pairs { messages, actions, rows: vec![0; pairs] };
        fits
    }
}

/// The dual estimator.
#[derive(Debug)]
pub struct Dumie {
    config: DumieConfig,
    weights: [f64; 2],
    learners: Vec<usize>,
    widths: [usize; 2],
    observation: Vec<usize>,
    action: Vec<usize>,
    critic: Separable,
    q: GaussianConditional,
    /// JSD over delivered pairs.
    pub jsd: Estimator,
    /// CLUB over lost pairs.
    pub club: Estimator,
    critic_tape: CriticTape,
    q_tape: ConditionalTape,
    pairs: [Pairs; 2],
    negatives: Vec<u32>,
    values: Vec<f32>,
    grads: [Vec<f32>; 3],
}

impl Dumie {
    /// Fresh estimators for episodes of this layout; `weights` are α and β.
    ///
    /// # Errors
    /// [`TrainError::Nn`] when candle refuses the allocation.
    pub fn new(layout: &Layout, config: DumieConfig, weights: [f64; 2], seeds: &Seeds) -> Result<Self, TrainError> {
        let learners = layout.learners();
        let observation: Vec<usize> = learners.iter().map(|&a| layout.agents[a].observation).collect();
        let action: Vec<usize> = learners.iter().map(|&a| layout.agents[a].action).collect();
        let widest = |v: &[usize]| v.iter().copied().max().unwrap_or(1).max(1);
        let widths = [widest(&observation), widest(&action)];
        let critic = Separable::paper(widths[0], widths[1]);
        let q = GaussianConditional::paper(widths[0], widths[1]);
        let estimator = |init: &dyn Fn(&mut Stream, &mut Vec<f32>), name: &str| -> Result<Estimator, TrainError> {
            let mut params = Vec::new();
            init(&mut seeds.stream(name), &mut params);
            Ok(Estimator {
                adam: Adam::new(AdamConfig::new(config.learning_rate), params.len()),
                params: Params::new(params)?,
                ring: Ring::new(config.ring, widths),
                fresh: Pairs::default(),
            })
        };
        Ok(Self {
            jsd: estimator(&|rng, out| critic.init(rng, out), "jsd")?,
            club: estimator(&|rng, out| q.init(rng, out), "club")?,
            config,
            weights,
            learners,
            widths,
            observation,
            action,
            critic,
            q,
            critic_tape: CriticTape::default(),
            q_tape: ConditionalTape::default(),
            pairs: Default::default(),
            negatives: Vec::new(),
            values: Vec::new(),
            grads: Default::default(),
        })
    }

    /// Puts an episode's pairs into the rings.
    pub fn observe(&mut self, episode: &Episode) {
        let n = self.learners.len();
        for row in 0..episode.steps {
            for (j, &sender) in self.learners.iter().enumerate() {
                for (i, &receiver) in self.learners.iter().enumerate() {
                    if i == j {
                        continue;
                    }
                    let estimator = if episode.delivered(n, row, j, i) { &mut self.jsd } else { &mut self.club };
                    let zero = self.config.lost_message == LostMessage::Zero && !episode.delivered(n, row, j, i);
                    let message = if zero { &[][..] } else { episode.messages[sender].row(row) };
                    let action = episode.actions[receiver].row(row);
                    estimator.ring.push(message, action);
                    if estimator.fresh.len() < self.config.ring {
                        estimator.fresh.push(self.widths, message, action, row);
                    }
                }
            }
        }
    }

    /// k steps of each estimator whose ring is full enough, and what they report. With a stream for them, held-out
    /// values come first, from the pairs observed since the last call; they change nothing else.
    ///
    /// # Errors
    /// [`TrainError::Nn`].
    pub fn train(&mut self, rng: &mut Stream, heldout: Option<&mut Stream>) -> Result<DumieMetrics, TrainError> {
        let mut metrics = DumieMetrics::default();
        if let Some(rng) = heldout {
            metrics.jsd_heldout = self.heldout(true, rng);
            metrics.club_heldout = self.heldout(false, rng);
        }
        self.jsd.fresh.clear();
        self.club.fresh.clear();
        for _ in 0..self.config.k {
            if self.jsd.ring.len() >= self.config.start {
                metrics.jsd = Some(self.train_jsd(rng)?);
            }
            if self.club.ring.len() >= self.config.start {
                metrics.club = Some(self.train_club(rng)?);
            }
        }
        Ok(metrics)
    }

    fn train_jsd(&mut self, rng: &mut Stream) -> Result<f64, TrainError> {
        let n = self.config.batch;
        let [batch, _] = &mut self.pairs;
        self.jsd.ring.sample(rng, n, &mut batch.messages, &mut batch.actions);
        shifts(rng, n, self.config.negatives, &mut self.negatives);
        let params = self.jsd.params.read();
        let tape = &mut self.critic_tape;
        self.critic.scores(&params, &batch.messages, &batch.actions, n, &self.negatives, tape);
        self.values.resize(n, 0.0);
        let [positive, negative, grads] = &mut self.grads;
        positive.resize(n, 0.0);
        negative.resize(self.negatives.len(), 0.0);
        let loss = losses::jsd(&tape.positive, &tape.negative, &mut self.values, positive, negative);
        grads.clear();
        grads.resize(params.len(), 0.0);
        self.critic.backward(&params, &batch.messages, &batch.actions, tape, positive, negative, grads);
        drop(params);
        let adam = &mut self.jsd.adam;
        self.jsd.params.update(|p| adam.step(p, grads))?;
        Ok(self.displayed(-loss))
    }

    fn train_club(&mut self, rng: &mut Stream) -> Result<f64, TrainError> {
        let n = self.config.batch;
        let [_, batch] = &mut self.pairs;
        self.club.ring.sample(rng, n, &mut batch.messages, &mut batch.actions);
        shifts(rng, n, self.config.negatives, &mut self.negatives);
        let params = self.club.params.read();
        let tape = &mut self.q_tape;
        self.q.forward(&params, &batch.messages, n, tape);
        self.values.resize(n, 0.0);
        let value = losses::club_values(tape.mu(), tape.logvar(), &batch.actions, &self.negatives, &mut self.values);
        let [grad_mu, grad_logvar, grads] = &mut self.grads;
        grad_mu.resize(n * self.widths[1], 0.0);
        grad_logvar.resize(n * self.widths[1], 0.0);
        losses::nll(tape.mu(), tape.logvar(), &batch.actions, n, grad_mu, grad_logvar);
        grads.clear();
        grads.resize(params.len(), 0.0);
        self.q.backward(&params, &batch.messages, tape, grad_mu, grad_logvar, grads);
        drop(params);
        let adam = &mut self.club.adam;
        self.club.params.update(|p| adam.step(p, grads))?;
        Ok(value)
    }

    /// Mean value of one class on the pairs that its estimator has not seen, once it has learned at all.
    fn heldout(&mut self, delivered: bool, rng: &mut Stream) -> Option<f64> {
        let estimator = if delivered { &mut self.jsd } else { &mut self.club };
        let pairs = std::mem::take(&mut estimator.fresh);
        let value = (estimator.adam.t > 0 && pairs.len() > 1).then(|| {
            let mean = self.values_of(&pairs, delivered, rng);
            if delivered { self.displayed(mean) } else { mean }
        });
        if delivered {
            self.jsd.fresh = pairs;
        } else {
            self.club.fresh = pairs;
        }
        value
    }

    /// Per-sample values of one class into `self.values`; JSD shifted, CLUB in nats. Returns the mean.
    fn values_of(&mut self, pairs: &Pairs, delivered: bool, rng: &mut Stream) -> f64 {
        let n = pairs.len();
        shifts(rng, n, self.config.negatives, &mut self.negatives);
        self.values.resize(n, 0.0);
        if delivered {
            let (params, tape) = (self.jsd.params.read(), &mut self.critic_tape);
            self.critic.scores(&params, &pairs.messages, &pairs.actions, n, &self.negatives, tape);
            losses::jsd_values(&tape.positive, &tape.negative, &mut self.values)
        } else {
            let (params, tape) = (self.club.params.read(), &mut self.q_tape);
            self.q.forward(&params, &pairs.messages, n, tape);
            losses::club_values(tape.mu(), tape.logvar(), &pairs.actions, &self.negatives, &mut self.values)
        }
    }

    /// A JSD value on the configured scale: shifted, or as the paper prints it.
    fn displayed(&self, shifted: f64) -> f64 {
        if self.config.jsd_shift { shifted } else { shifted - 2.0 * core::f64::consts::LN_2 }
    }

    /// The shaping bonus of each transition of a minibatch, `[B]`.
    pub fn bonus(&mut self, batch: &Batch, rng: &mut Stream, bonus: &mut Vec<f32>) {
        let (n, o, a) =
            (self.learners.len(), self.observation.iter().sum::<usize>(), self.action.iter().sum::<usize>());
        let mut classes = std::mem::take(&mut self.pairs);
        classes.iter_mut().for_each(Pairs::clear);
        for row in 0..batch.rows {
            let (observations, actions) = (&batch.observations[row * o..], &batch.actions[row * a..]);
            let mut message_at = 0;
            for j in 0..n {
                let message = &observations[message_at..message_at + self.observation[j]];
                let mut action_at = 0;
                for i in 0..n {
                    if i != j {
                        let delivered = batch.link[(row * n + j) * n + i];
                        let zero = !delivered && self.config.lost_message == LostMessage::Zero;
                        let message = if zero { &[][..] } else { message };
                        let action = &actions[action_at..action_at + self.action[i]];
                        classes[usize::from(!delivered)].push(self.widths, message, action, row);
                    }
                    action_at += self.action[i];
                }
                message_at += self.observation[j];
            }
        }
        bonus.clear();
        bonus.resize(batch.rows, 0.0);
        for (class, pairs) in classes.iter().enumerate() {
            let delivered = class == 0;
            let weight = if delivered { self.weights[0] } else { -self.weights[1] } as f32;
            let estimator = if delivered { &self.jsd } else { &self.club };
            let learned = estimator.ring.len() >= self.config.start && estimator.adam.t > 0;
            if weight == 0.0 || !learned || pairs.len() < 2 {
                continue;
            }
            self.values_of(pairs, delivered, rng);
            let shift = if delivered && !self.config.jsd_shift { 2.0 * core::f32::consts::LN_2 } else { 0.0 };
            for (&row, value) in pairs.rows.iter().zip(&self.values) {
                bonus[row] += weight * (value - shift);
            }
        }
        self.pairs = classes;
    }

    /// The shaping bonus of each step of an episode, for shaping at rollout, `[T]`; empty when shaping is elsewhere.
    pub fn bonus_at_rollout(&mut self, episode: &Episode, rng: &mut Stream) -> Vec<f32> {
        let mut bonus = Vec::new();
        if self.config.shaping == Shaping::AtRollout {
            let rows = episode.steps;
            let mut batch = Batch { rows, ..Batch::default() };
            for row in 0..rows {
                for &agent in &self.learners {
                    batch.observations.extend_from_slice(episode.observations[agent].row(row));
                    batch.actions.extend_from_slice(episode.actions[agent].row(row));
                }
            }
            batch.link.extend_from_slice(&episode.link[..rows * self.learners.len() * self.learners.len()]);
            self.bonus(&batch, rng, &mut bonus);
        }
        bonus
    }
}

/// `k` random cyclic shifts of `0..n`, as `[n, k]` indices: derangements without a draw per element.
fn shifts(rng: &mut Stream, n: usize, negatives: Negatives, out: &mut Vec<u32>) {
    let Negatives::Count(k) = negatives else {
        *out = crate::mi::all_others(n);
        return;
    };
    let offsets: Vec<usize> = (0..k).map(|_| 1 + rng::below(rng, n - 1)).collect();
    out.clear();
    out.extend((0..n).flat_map(|i| offsets.iter().map(move |&o| ((i + o) % n) as u32)));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema::{AgentSpec, Controller, Matrix};

    fn layout() -> Layout {
        let agent = |name: &str| AgentSpec {
            name: name.to_owned(),
            team: "t".to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation: 1,
            message: 1,
            action: 1,
        };
        Layout { agents: vec![agent("a"), agent("b")], state_fields: vec![] }
    }

    /// Both agents act as they hear on delivered links, and at random on lost ones.
    fn episode(index: u64) -> Episode {
        let mut rng = Seeds::new(3).indexed_stream("e", index);
        let steps = 25;
        let mut e = Episode { steps, ..Episode::default() };
        let mut draw = |n: usize| Matrix { data: (0..n).map(|_| rng::normal(&mut rng) as f32).collect(), width: 1 };
        e.observations = vec![draw(steps + 1), draw(steps + 1)];
        e.messages.clone_from(&e.observations);
        e.actions = vec![draw(steps), draw(steps)];
        e.link = (0..=steps).flat_map(|t| [true, t % 2 == 0, t % 2 == 1, true]).collect();
        for t in 0..steps {
            // even rows: a → b is delivered; odd rows: b → a
            let (receiver, sender) = if t % 2 == 0 { (1, 0) } else { (0, 1) };
            e.actions[receiver].data[t] = e.messages[sender].data[t];
        }
        e.reward = vec![0.0; steps];
        e
    }

    fn trained(weights: [f64; 2]) -> Dumie {
        let config = DumieConfig { learning_rate: 1e-2, batch: 256, ..DumieConfig::default() };
        let mut dumie = Dumie::new(&layout(), config, weights, &Seeds::new(1)).unwrap();
        for index in 0..60 {
            dumie.observe(&episode(index));
        }
        for index in 0..300 {
            dumie.train(&mut Seeds::new(2).indexed_stream("t", index), None).unwrap();
        }
        dumie.observe(&episode(1000));
        dumie
    }

    #[test]
    fn jsd_finds_what_delivered_messages_tell_and_club_that_lost_ones_tell_nothing() {
        let mut dumie = trained([0.01, 0.01]);
        let metrics = dumie.train(&mut Seeds::new(2).stream("last"), Some(&mut Seeds::new(2).stream("held"))).unwrap();
        assert!(metrics.jsd_heldout.unwrap() > 0.1, "{metrics:?}");
        assert!(metrics.club_heldout.unwrap().abs() < 0.1, "{metrics:?}");
    }

    #[test]
    fn the_bonus_is_alpha_jsd_where_delivered_and_minus_beta_club_where_lost() {
        let row = |delivered| Batch {
            rows: 2,
            observations: vec![1.0, -1.0, -1.0, 1.0],
            actions: vec![-1.0, 1.0, 1.0, -1.0],
            link: [true, delivered, delivered, true].repeat(2),
            ..Batch::default()
        };
        let bonus = |weights, delivered| {
            let mut out = Vec::new();
            trained(weights).bonus(&row(delivered), &mut Seeds::new(5).stream("b"), &mut out);
            out
        };
        let [one, two] = [bonus([1.0, 0.0], true), bonus([2.0, 5.0], true)];
        assert!(one.iter().all(|&b| b != 0.0) && one.iter().zip(&two).all(|(a, b)| (2.0 * a - b).abs() < 1e-5));
        assert_eq!(bonus([1.0, 0.0], false), [0.0, 0.0]);
        let [one, two] = [bonus([0.0, 1.0], false), bonus([9.0, 2.0], false)];
        assert!(one.iter().all(|&b| b != 0.0) && one.iter().zip(&two).all(|(a, b)| (2.0 * a - b).abs() < 1e-5));
    }

    #[test]
    fn shaping_at_rollout_equals_shaping_the_same_rows_as_a_minibatch() {
        let mut dumie = trained([0.5, 0.5]);
        dumie.config.shaping = Shaping::AtRollout;
        let e = episode(77);
        let stored = dumie.bonus_at_rollout(&e, &mut Seeds::new(6).stream("b"));
        assert_eq!(stored.len(), 25);
        let spread = stored.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        assert!(spread > 0.01, "{stored:?}");
        dumie.config.shaping = Shaping::Minibatch;
        assert!(dumie.bonus_at_rollout(&e, &mut Seeds::new(6).stream("b")).is_empty());
    }
}
