//! Du-MIE: two mutual-information estimators that shape the team reward (paper Eqs. 3–6).
//!
//! r̃ = r + `Σ_i` Σ_{j≠i} [ α ι^{ji} `I_JSD(m^{ji`}; a^i) − β (1 − ι^{ji}) `I_CLUB(m^{ji`}; a^i) ]
//!
//! JSD (lower bound) learns from delivered pairs, CLUB (upper bound) from lost ones; both are shared over all ordered
//! links, or each link has its own. Values are per sample; negatives are cyclic shifts of the action at fixed message,
//! so none is its own partner, or all actions of the minibatch.
//!
//! Where encoders make the messages, rings hold what was sent at rollout, as does shaping at rollout, and may be older
//! than the encoders; what is computed from replay (shaping on a minibatch, pairs from replay) sees what the encoders of
//! now would send. So with pairs from replay JSD and CLUB are of the code as it is, their held-out values of pairs as sent.

use super::TrainError;
use super::config::{DumieConfig, Estimators, LostMessage, PairSource, Shaping};
use super::estimator::{Class, Estimator, Nets, Pairs, Place};
use super::replay::Replay;
use crate::algo::{Batch, Senders};
use crate::rng::{self, Seeds, Stream};
use crate::schema::{Episode, Layout};

/// Draws of a transition per pair wanted before a class counts as absent from replay.
const TRIES: usize = 64;

/// What the estimators report; `None` where there was nothing to estimate from.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DumieMetrics {
    /// JSD value of the training minibatch (shifted or not, as configured); mean over estimators, as all four.
    pub jsd: Option<f64>,
    /// JSD value of pairs that the critic has not learned from yet.
    pub jsd_heldout: Option<f64>,
    /// CLUB value of the training minibatch, nats.
    pub club: Option<f64>,
    /// CLUB value of pairs that q has not learned from yet, nats.
    pub club_heldout: Option<f64>,
}

/// The dual estimator.
#[derive(Debug)]
pub struct Dumie {
    config: DumieConfig,
    weights: [f64; 2],
    learners: Vec<usize>,
    /// Where each learner's observation, message and action lie in a transition.
    observation: Vec<Place>,
    message: Vec<Place>,
    action: Vec<Place>,
    nets: Nets,
    /// JSD over delivered pairs: one, or one per ordered link.
    pub jsd: Vec<Estimator>,
    /// CLUB over lost pairs: one, or one per ordered link.
    pub club: Vec<Estimator>,
    /// A minibatch's pairs, by class and estimator.
    pairs: [Vec<Pairs>; 2],
    /// Of pairs from replay, what each sender saw, and what its encoder makes of it, sender after sender.
    seen: Vec<Vec<f32>>,
    sent: Vec<f32>,
}

impl Dumie {
    /// Fresh estimators for episodes of this layout; `weights` are α and β.
    ///
    /// # Errors
    /// [`TrainError::Nn`] when candle refuses the allocation.
    pub fn new(layout: &Layout, config: DumieConfig, weights: [f64; 2], seeds: &Seeds) -> Result<Self, TrainError> {
        let learners = layout.learners();
        let places = |width: fn(&crate::schema::AgentSpec) -> usize| -> Vec<Place> {
            let mut at = 0;
            let place = |&agent: &usize| {
                let width = width(&layout.agents[agent]);
                at += width;
                [at - width, width]
            };
            learners.iter().map(place).collect()
        };
        let (observation, message, action) = (places(|a| a.observation), places(|a| a.message), places(|a| a.action));
        let widest = |places: &[Place]| places.iter().map(|p| p[1]).max().unwrap_or(1).max(1);
        let widths = [widest(&message), widest(&action)];
        let links = learners.len() * learners.len().saturating_sub(1);
        let nets = Nets::new(widths, config.negatives, links);
        let count = if config.estimators == Estimators::Shared { 1 } else { links };
        let mut made = [Vec::new(), Vec::new()];
        for (made, name) in made.iter_mut().zip(["jsd", "club"]) {
            for link in 0..count {
                let mut rng = if count == 1 { seeds.stream(name) } else { seeds.indexed_stream(name, link as u64) };
                let mut params = Vec::new();
                if name == "jsd" {
                    nets.critic.init(&mut rng, &mut params);
                } else {
                    nets.q.init(&mut rng, &mut params);
                }
                made.push(Estimator::new(params, config.learning_rate, config.ring, widths)?);
            }
        }
        let [jsd, club] = made;
        let pairs = [(); 2].map(|()| (0..count).map(|_| Pairs::default()).collect());
        let (seen, sent) = (vec![Vec::new(); learners.len()], Vec::new());
        Ok(Self { config, weights, learners, observation, message, action, nets, jsd, club, pairs, seen, sent })
    }

    /// Every estimator with its name: `jsd`, `club`, or with the link's number behind it (sender by receiver).
    pub fn named(&self) -> impl Iterator<Item = (String, &Estimator)> {
        let name = |class: &'static str, link: usize, of: usize| {
            if of == 1 { class.to_owned() } else { format!("{class}.{link}") }
        };
        let jsd = self.jsd.iter().enumerate().map(move |(at, e)| (name("jsd", at, self.jsd.len()), e));
        jsd.chain(self.club.iter().enumerate().map(move |(at, e)| (name("club", at, self.club.len()), e)))
    }

    /// All estimators in the order of [`Self::named`], to restore them.
    pub fn all_mut(&mut self) -> impl Iterator<Item = &mut Estimator> {
        self.jsd.iter_mut().chain(&mut self.club)
    }

    /// Number of the estimator for messages of learner `j` to learner `i`.
    fn estimator(&self, j: usize, i: usize) -> usize {
        if self.config.estimators == Estimators::Shared { 0 } else { link(self.learners.len(), j, i) }
    }

    /// Puts an episode's pairs into the rings.
    pub fn observe(&mut self, episode: &Episode) {
        let n = self.learners.len();
        for row in 0..episode.steps {
            for j in 0..n {
                for i in (0..n).filter(|&i| i != j) {
                    let (delivered, at) = (episode.delivered(n, row, j, i), self.estimator(j, i));
                    let zero = self.config.lost_message == LostMessage::Zero && !delivered;
                    let message = if zero { &[][..] } else { episode.messages[self.learners[j]].row(row) };
                    let action = episode.actions[self.learners[i]].row(row);
                    let estimators = if delivered { &mut self.jsd } else { &mut self.club };
                    estimators[at].observe(message, action);
                }
            }
        }
    }

    /// k steps of each estimator whose ring is full enough, and what they report. With a stream for them, held-out
    /// values come first, from the pairs observed since the last call; they change nothing else. `senders` make
    /// the messages of pairs from replay; `None` where a message is the observation.
    ///
    /// # Errors
    /// [`TrainError::Nn`].
    pub fn train(
        &mut self,
        replay: &Replay,
        mut senders: Option<&mut Senders<'_>>,
        rng: &mut Stream,
        heldout: Option<&mut Stream>,
    ) -> Result<DumieMetrics, TrainError> {
        let mut means = [[0.0; 2]; 4];
        let mut count = |at: usize, value: f64| means[at] = [means[at][0] + value, means[at][1] + 1.0];
        if let Some(rng) = heldout {
            for (at, class, estimators) in [(1, Class::Delivered, &self.jsd), (3, Class::Lost, &self.club)] {
                for estimator in estimators {
                    self.nets.heldout(class, estimator, rng).into_iter().for_each(|value| count(at, value));
                }
            }
        }
        self.all_mut().for_each(Estimator::forget_fresh);
        for step in 0..self.config.k {
            for (at, class) in [(0, Class::Delivered), (2, Class::Lost)] {
                for index in 0..self.jsd.len() {
                    let value = self.learn((class, index), replay, senders.as_deref_mut(), rng)?;
                    // what is reported is the last step's
                    value.into_iter().filter(|_| step + 1 == self.config.k).for_each(|value| count(at, value));
                }
            }
        }
        let [jsd, jsd_heldout, club, club_heldout] = means.map(|[sum, count]| (count > 0.0).then(|| sum / count));
        let shift = |value: Option<f64>| value.map(|v| self.displayed(v));
        Ok(DumieMetrics { jsd: shift(jsd), jsd_heldout: shift(jsd_heldout), club, club_heldout })
    }

    /// One step of one estimator, when it has pairs enough.
    fn learn(
        &mut self,
        (class, index): (Class, usize),
        replay: &Replay,
        senders: Option<&mut Senders<'_>>,
        rng: &mut Stream,
    ) -> Result<Option<f64>, TrainError> {
        let estimators = if class == Class::Delivered { &mut self.jsd } else { &mut self.club };
        let estimator = &mut estimators[index];
        if estimator.ring.len() < self.config.start {
            return Ok(None);
        }
        if self.config.pairs == PairSource::Rings {
            return self.nets.learn(class, estimator, self.config.batch, rng).map(Some);
        }
        let mut pairs = std::mem::take(&mut self.pairs[0][index]);
        let mut seen = senders.is_some().then(|| std::mem::take(&mut self.seen));
        let found = self.filter((class, index), replay, rng, &mut pairs, seen.as_deref_mut());
        let messages = match (senders, seen) {
            (Some(senders), Some(seen)) => {
                if found {
                    self.encode(senders, &seen);
                }
                self.seen = seen;
                &self.sent
            }
            _ => &replay.observations,
        };
        let estimators = if class == Class::Delivered { &mut self.jsd } else { &mut self.club };
        let Estimator { params, adam, .. } = &mut estimators[index];
        let data = [&messages[..], &replay.actions];
        let value = if found { Some(self.nets.step(class, params, adam, &pairs, data, rng)?) } else { None };
        self.pairs[0][index] = pairs;
        Ok(value)
    }

    /// What the senders of a minibatch of pairs send on what each of them saw, where [`Self::filter`] said it would lie.
    fn encode(&mut self, senders: &mut Senders<'_>, seen: &[Vec<f32>]) {
        let all: usize = self.message.iter().map(|p| p[1]).sum();
        self.sent.resize(self.config.batch * all, 0.0);
        for (j, seen) in seen.iter().enumerate() {
            let ([start, _], rows) = (self.message[j], seen.len() / self.observation[j][1].max(1));
            let sent = senders.encode_of(j, seen, rows);
            self.sent[self.config.batch * start..][..sent.len()].copy_from_slice(sent);
        }
    }

    /// Draws pairs of one class from all of replay; false when it hardly has any. Messages lie in replay's observations,
    /// or with `seen`, which takes what the sender of each pair saw, in what the encoders make of that: room for a
    /// minibatch per sender.
    fn filter(
        &self,
        (class, index): (Class, usize),
        replay: &Replay,
        rng: &mut Stream,
        pairs: &mut Pairs,
        mut seen: Option<&mut [Vec<f32>]>,
    ) -> bool {
        let n = self.learners.len();
        pairs.clear();
        pairs.reserve(self.config.batch);
        for (seen, [_, width]) in seen.iter_mut().flat_map(|seen| seen.iter_mut()).zip(&self.observation) {
            seen.clear();
            seen.reserve(self.config.batch * width);
        }
        for _ in 0..TRIES * self.config.batch {
            let transition = rng::below(rng, replay.len());
            let of = if self.jsd.len() == 1 { rng::below(rng, n * (n - 1)) } else { index };
            let (j, i) = (of / (n - 1), of % (n - 1));
            let i = i + usize::from(i >= j);
            let [observed, action, bits] = replay.places(transition);
            let delivered = replay.link[bits + j * n + i];
            if delivered == (class == Class::Delivered) {
                let [[start, width], to] = self.pair(delivered, j, i);
                let start = match &mut seen {
                    None => observed + start,
                    Some(seen) => {
                        let [from, own] = self.observation[j];
                        let row = seen[j].len() / own.max(1);
                        seen[j].extend_from_slice(&replay.observations[observed + from..][..own]);
                        self.config.batch * start + row * self.message[j][1]
                    }
                };
                pairs.push([start, width], [action + to[0], to[1]], transition);
                if pairs.len() == self.config.batch {
                    return true;
                }
            }
        }
        false
    }

    /// Where message j → i and action i lie in a transition.
    fn pair(&self, delivered: bool, j: usize, i: usize) -> [Place; 2] {
        let [start, width] = self.message[j];
        let zero = !delivered && self.config.lost_message == LostMessage::Zero;
        [[start, if zero { 0 } else { width }], self.action[i]]
    }

    /// A JSD value on the configured scale: shifted, or as the paper prints it.
    fn displayed(&self, shifted: f64) -> f64 {
        if self.config.jsd_shift { shifted } else { shifted - 2.0 * core::f64::consts::LN_2 }
    }

    /// The shaping bonus of each transition of a minibatch, `[B]`; `messages` are all learners', `[B, M]`: their
    /// observations, or what their encoders send.
    ///
    /// # Panics
    /// When `messages` has another length: what was not encoded must not pass for a message.
    pub fn bonus(&mut self, batch: &Batch, messages: &[f32], rng: &mut Stream, bonus: &mut Vec<f32>) {
        let n = self.learners.len();
        let width = |places: &[Place]| places.iter().map(|p| p[1]).sum::<usize>();
        let (m, a) = (width(&self.message), width(&self.action));
        assert_eq!(messages.len(), batch.rows * m, "a message per learner and transition");
        let mut classes = std::mem::take(&mut self.pairs);
        for pairs in classes.iter_mut().flatten() {
            pairs.clear();
            pairs.reserve(batch.rows * n * (n - 1) / self.jsd.len());
        }
        for (row, bits) in batch.link.chunks_exact(n * n).enumerate() {
            for j in 0..n {
                for i in (0..n).filter(|&i| i != j) {
                    let delivered = bits[j * n + i];
                    let [message, action] = self.pair(delivered, j, i);
                    let pairs = &mut classes[usize::from(!delivered)][self.estimator(j, i)];
                    pairs.push([row * m + message[0], message[1]], [row * a + action[0], action[1]], row);
                }
            }
        }
        bonus.clear();
        bonus.resize(batch.rows, 0.0);
        for (class, all) in [Class::Delivered, Class::Lost].into_iter().zip(&classes) {
            let delivered = class == Class::Delivered;
            let (weight, estimators) =
                if delivered { (self.weights[0], &self.jsd) } else { (-self.weights[1], &self.club) };
            let shift = if delivered && !self.config.jsd_shift { 2.0 * core::f32::consts::LN_2 } else { 0.0 };
            for (pairs, estimator) in all.iter().zip(estimators) {
                let learned = estimator.ring.len() >= self.config.start && estimator.adam.t > 0;
                if weight == 0.0 || !learned || pairs.len() < 2 {
                    continue;
                }
                self.nets.evaluate(class, estimator, pairs, [messages, &batch.actions], rng);
                for (&row, value) in pairs.rows.iter().zip(&self.nets.values) {
                    bonus[row as usize] += weight as f32 * (value - shift);
                }
            }
        }
        self.pairs = classes;
    }

    /// The shaping bonus of each step of an episode, for shaping at rollout, `[T]`; empty when shaping is elsewhere.
    pub fn bonus_at_rollout(&mut self, episode: &Episode, rng: &mut Stream) -> Vec<f32> {
        let mut bonus = Vec::new();
        if self.config.shaping == Shaping::AtRollout {
            // negatives are cyclic shifts: in the order of time all would lie equally far off
            let order = rng::permutation(rng, episode.steps);
            let (mut batch, links) = (Batch { rows: episode.steps, ..Batch::default() }, self.learners.len().pow(2));
            let mut messages = Vec::new();
            for &row in &order {
                for &agent in &self.learners {
                    messages.extend_from_slice(episode.messages[agent].row(row));
                    batch.actions.extend_from_slice(episode.actions[agent].row(row));
                }
                batch.link.extend_from_slice(&episode.link[row * links..(row + 1) * links]);
            }
            let mut found = Vec::new();
            self.bonus(&batch, &messages, rng, &mut found);
            bonus.resize(episode.steps, 0.0);
            order.iter().zip(found).for_each(|(&row, value)| bonus[row] = value);
        }
        bonus
    }
}

/// Number of the ordered link j → i of `n` learners.
fn link(n: usize, j: usize, i: usize) -> usize {
    j * (n - 1) + i - usize::from(i > j)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::algo::{Maddpg, MaddpgConfig, Messages};
    use crate::nn::{Activation, Tape};
    use crate::schema::{AgentSpec, Controller, Matrix};
    use crate::train::config::Negatives;

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

    fn config() -> DumieConfig {
        DumieConfig { learning_rate: 1e-2, batch: 256, ..DumieConfig::default() }
    }

    fn replay(episodes: u64) -> Replay {
        let mut replay = Replay::new(&layout(), 25, 10_000, false).unwrap();
        (0..episodes).for_each(|index| replay.push(&episode(index), &[]).unwrap());
        replay
    }

    fn trained_as(config: DumieConfig, weights: [f64; 2]) -> (Dumie, Replay) {
        let (mut dumie, replay) = (Dumie::new(&layout(), config, weights, &Seeds::new(1)).unwrap(), replay(60));
        for index in 0..60 {
            dumie.observe(&episode(index));
        }
        for index in 0..300 {
            dumie.train(&replay, None, &mut Seeds::new(2).indexed_stream("t", index), None).unwrap();
        }
        dumie.observe(&episode(1000));
        (dumie, replay)
    }

    fn trained(weights: [f64; 2]) -> Dumie {
        trained_as(config(), weights).0
    }

    #[test]
    fn jsd_finds_what_delivered_messages_tell_and_club_that_lost_ones_tell_nothing_in_every_variant() {
        let variants = [
            config(),
            DumieConfig { negatives: Negatives::All, ..config() },
            DumieConfig { pairs: PairSource::Replay, ..config() },
            DumieConfig { estimators: Estimators::PerLink, ..config() },
            DumieConfig { estimators: Estimators::PerLink, pairs: PairSource::Replay, k: 2, ..config() },
        ];
        for config in variants {
            let estimators = if config.estimators == Estimators::Shared { 2 } else { 4 };
            let (mut dumie, replay) = trained_as(config, [0.01, 0.01]);
            assert_eq!(dumie.named().count(), estimators);
            let mut heldout = Seeds::new(2).stream("held");
            let metrics = dumie.train(&replay, None, &mut Seeds::new(2).stream("last"), Some(&mut heldout)).unwrap();
            for jsd in [metrics.jsd, metrics.jsd_heldout] {
                assert!(jsd.unwrap() > 0.1, "{metrics:?} {:?}", dumie.config);
            }
            for club in [metrics.club, metrics.club_heldout] {
                assert!(club.unwrap().abs() < 0.1, "{metrics:?} {:?}", dumie.config);
            }
        }
    }

    #[test]
    fn the_estimators_of_a_link_see_its_pairs_alone() {
        let config = DumieConfig { estimators: Estimators::PerLink, ring: 1000, ..config() };
        let mut dumie = Dumie::new(&layout(), config, [1.0, 1.0], &Seeds::new(1)).unwrap();
        let names: Vec<String> = dumie.named().map(|(name, _)| name).collect();
        assert_eq!(names, ["jsd.0", "jsd.1", "club.0", "club.1"]);
        let e = episode(0);
        dumie.observe(&e);
        // even steps deliver a → b, odd ones b → a
        let [first, second] = [0, 1].map(|link| &dumie.jsd[link].ring);
        assert_eq!((first.len(), second.len()), (13, 12));
        assert_eq!(first.messages, e.messages[0].data[..25].iter().step_by(2).copied().collect::<Vec<_>>());
        assert_eq!(second.actions, e.actions[0].data[1..25].iter().step_by(2).copied().collect::<Vec<_>>());
    }

    #[test]
    fn pairs_from_replay_are_those_of_the_class_and_a_class_that_is_absent_teaches_nothing() {
        let (mut dumie, replay) = trained_as(DumieConfig { pairs: PairSource::Replay, ..config() }, [1.0, 1.0]);
        let (mut pairs, mut rng) = (Pairs::default(), Seeds::new(3).stream("f"));
        assert!(dumie.filter((Class::Delivered, 0), &replay, &mut rng, &mut pairs, None));
        assert_eq!(pairs.len(), 256);
        let [x, y] = pairs.of([&replay.observations, &replay.actions]);
        // on delivered links the receiver does what it heard
        assert!(x.starts.iter().zip(y.starts).all(|(x_at, y_at)| x.data[*x_at as usize] == y.data[*y_at as usize]));
        let mut lossless = replay.clone();
        lossless.link.fill(true);
        let before = dumie.club[0].params.read().to_vec();
        let metrics = dumie.train(&lossless, None, &mut rng, None).unwrap();
        assert!(metrics.jsd.is_some() && metrics.club.is_none(), "{metrics:?}");
        assert_eq!(before, *dumie.club[0].params.read());
    }

    #[test]
    fn pairs_from_replay_hold_what_the_encoder_of_the_sender_makes_of_what_it_saw() {
        let mut layout = layout();
        let encoder = MaddpgConfig { messages: Messages::Encoder, message_width: Some(3), ..MaddpgConfig::default() };
        let agents: Vec<&AgentSpec> = layout.agents.iter().collect();
        let mut learner = Maddpg::new(&agents, Activation::Tanh, encoder, &Seeds::new(1)).unwrap();
        layout.agents.iter_mut().for_each(|agent| agent.message = 3);
        let config = DumieConfig { pairs: PairSource::Replay, ..config() };
        let mut dumie = Dumie::new(&layout, config, [1.0, 1.0], &Seeds::new(1)).unwrap();
        let (replay, mut rng, mut pairs) = (replay(20), Seeds::new(3).stream("f"), Pairs::default());
        let (mut seen, mut tape) = (vec![Vec::new(); 2], Tape::default());
        assert!(dumie.filter((Class::Delivered, 0), &replay, &mut rng, &mut pairs, Some(&mut seen)));
        dumie.encode(&mut learner.senders().unwrap(), &seen);
        let [x, y] = pairs.of([&dumie.sent, &replay.actions]);
        let (actors, params) = (&learner.actors, learner.params.actors.read().to_vec());
        let mut from = [0, 0];
        for pair in 0..256 {
            // who acts is the receiver, and what it does is what the other saw
            let action = y.starts[pair] as usize;
            let (transition, sender) = (action / 2, 1 - action % 2);
            assert_eq!(pairs.rows[pair] as usize, transition);
            let saw = replay.observations[replay.places(transition)[0] + sender];
            assert_eq!(y.data[action], saw, "on delivered links the receiver does what it heard");
            let exact = actors.encoders[sender].forward(&params[actors.encoder_range(sender)], &[saw], 1, &mut tape);
            let (sent, width) = (&x.data[x.starts[pair] as usize..], x.widths[pair]);
            assert!(width == 3 && exact.iter().zip(sent).all(|(a, b)| (a - b).abs() < 1e-6), "pair {pair}");
            from[sender] += 1;
        }
        assert!(from.iter().all(|&pairs| pairs > 50) && pairs.len() == 256, "{from:?}");
        // a class that replay does not have teaches nothing, whoever would have sent
        let mut lossless = replay.clone();
        lossless.link.fill(true);
        (0..60).for_each(|index| dumie.observe(&sent(&mut learner, episode(index))));
        let metrics = dumie.train(&lossless, learner.senders().as_mut(), &mut rng, None).unwrap();
        assert!(metrics.jsd.is_some() && metrics.club.is_none(), "{metrics:?}");
    }

    /// The episode with what the learner's encoders make of its observations.
    fn sent(learner: &mut Maddpg, mut episode: Episode) -> Episode {
        let mut senders = learner.senders().unwrap();
        for (j, message) in episode.messages.iter_mut().enumerate() {
            *message = Matrix { data: senders.encode_of(j, &episode.observations[j].data, 26).to_vec(), width: 3 };
        }
        episode
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
            let (batch, mut out) = (row(delivered), Vec::new());
            trained(weights).bonus(&batch, &batch.observations, &mut Seeds::new(5).stream("b"), &mut out);
            out
        };
        let [one, two] = [bonus([1.0, 0.0], true), bonus([2.0, 5.0], true)];
        assert!(one.iter().all(|&b| b != 0.0) && one.iter().zip(&two).all(|(a, b)| (2.0 * a - b).abs() < 1e-5));
        assert_eq!(bonus([1.0, 0.0], false), [0.0, 0.0]);
        // what encoders sent stands in for the observations
        let seen = Batch { observations: vec![9.0; 4], ..row(true) };
        let mut encoded = Vec::new();
        trained([1.0, 0.0]).bonus(&seen, &row(true).observations, &mut Seeds::new(5).stream("b"), &mut encoded);
        assert_eq!(encoded, one);
        let [one, two] = [bonus([0.0, 1.0], false), bonus([9.0, 2.0], false)];
        assert!(one.iter().all(|&b| b != 0.0) && one.iter().zip(&two).all(|(a, b)| (2.0 * a - b).abs() < 1e-5));
    }

    #[test]
    #[should_panic(expected = "a message per learner and transition")]
    fn messages_that_were_not_made_do_not_pass_for_observations() {
        let batch = Batch { rows: 2, link: vec![true; 8], actions: vec![0.0; 4], ..Batch::default() };
        trained([1.0, 0.0]).bonus(&batch, &[], &mut Seeds::new(5).stream("b"), &mut Vec::new());
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

    #[test]
    fn the_negatives_of_an_episode_do_not_all_lie_equally_far_off_in_time() {
        let config = DumieConfig { negatives: Negatives::Count(1), shaping: Shaping::AtRollout, ..config() };
        let (mut dumie, _) = trained_as(config, [1.0, 0.0]);
        // b hears and does 1, −1, 1, …: a shift in time would give equal steps equal negatives
        let sign = |t: usize| if t.is_multiple_of(2) { 1.0 } else { -1.0 };
        let mut e = Episode { steps: 24, link: [true, true, false, true].repeat(25), ..Episode::default() };
        e.messages = vec![Matrix { data: (0..25).map(sign).collect(), width: 1 }; 2];
        e.actions = vec![Matrix { data: (0..24).map(sign).collect(), width: 1 }; 2];
        for stream in 0..5 {
            let bonus = dumie.bonus_at_rollout(&e, &mut Seeds::new(6).indexed_stream("b", stream));
            let distinct: std::collections::BTreeSet<u32> = bonus.iter().step_by(2).map(|b| b.to_bits()).collect();
            assert!(distinct.len() > 1, "{bonus:?}");
        }
    }
}
