//! The two estimators of the Du-MIE: their networks, what they learn from, one step of learning, values of pairs.

use super::TrainError;
use super::config::Negatives;
use super::replay::Ring;
use crate::mi::all_pairs::{AllPairs, club_all};
use crate::mi::conditional::{ConditionalTape, GaussianConditional};
use crate::mi::critic::Separable;
use crate::mi::losses;
use crate::mi::shifted::{Picked, Shifted, club_shifted, draw_shifts};
use crate::nn::{Adam, AdamConfig, Params, exp_in_place};
use crate::rng::{self, Stream};

/// Which messages an estimator looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Class {
    /// Delivered ones: JSD.
    Delivered,
    /// Lost ones: CLUB.
    Lost,
}

/// Pairs as places: each message and each action lies somewhere in a flat array.
#[derive(Debug, Default)]
pub(super) struct Pairs {
    messages: [Vec<u32>; 2],
    actions: [Vec<u32>; 2],
    /// Which transition of the minibatch, or of replay, each pair belongs to.
    pub(super) rows: Vec<u32>,
}

/// Where a vector starts and how long it is.
pub(super) type Place = [usize; 2];

impl Pairs {
    pub(super) fn clear(&mut self) {
        for list in self.messages.iter_mut().chain(&mut self.actions).chain([&mut self.rows]) {
            list.clear();
        }
    }

    /// Makes room for this many pairs.
    pub(super) fn reserve(&mut self, pairs: usize) {
        for list in self.messages.iter_mut().chain(&mut self.actions).chain([&mut self.rows]) {
            list.reserve(pairs);
        }
    }

    pub(super) fn push(&mut self, message: Place, action: Place, row: usize) {
        for (lists, place) in [(&mut self.messages, message), (&mut self.actions, action)] {
            lists.iter_mut().zip(place).for_each(|(list, part)| list.push(part as u32));
        }
        self.rows.push(row as u32);
    }

    pub(super) fn len(&self) -> usize {
        self.rows.len()
    }

    /// Messages and actions, in these arrays.
    pub(super) fn of<'a>(&'a self, [messages, actions]: [&'a [f32]; 2]) -> [Picked<'a>; 2] {
        let pick = |data, [starts, widths]: &'a [Vec<u32>; 2]| Picked { data, starts, widths };
        [pick(messages, &self.messages), pick(actions, &self.actions)]
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
    fresh: Ring,
}

impl Estimator {
    /// A fresh one that keeps `ring` pairs of these widths.
    pub(super) fn new(
        params: Vec<f32>,
        learning_rate: f32,
        ring: usize,
        widths: [usize; 2],
    ) -> Result<Self, TrainError> {
        Ok(Self {
            adam: Adam::new(AdamConfig::new(learning_rate), params.len()),
            params: Params::new(params)?,
            ring: Ring::new(ring, widths),
            fresh: Ring::new(ring, widths),
        })
    }

    /// Takes a pair.
    pub(super) fn observe(&mut self, message: &[f32], action: &[f32]) {
        self.ring.push(message, action);
        if self.fresh.len() < self.fresh.capacity {
            self.fresh.push(message, action);
        }
    }

    /// Forgets which pairs were held out: they are about to be learned from.
    pub(super) fn forget_fresh(&mut self) {
        self.fresh.clear();
    }

    /// The pairs held out until the next update: messages and actions, flat.
    pub(super) fn fresh(&self) -> [&[f32]; 2] {
        [&self.fresh.messages, &self.fresh.actions]
    }

    /// Takes over held-out pairs of a checkpoint; false when their lengths do not fit.
    pub(super) fn restore_fresh(&mut self, messages: Vec<f32>, actions: Vec<f32>) -> bool {
        let [m, a] = self.ring.widths;
        let pairs = messages.len() / m;
        let fits = messages.len() == pairs * m && actions.len() == pairs * a && pairs <= self.fresh.capacity;
        self.fresh = Ring { pushed: pairs as u64, messages, actions, ..self.fresh.clone() };
        fits
    }
}

/// Shapes of both estimators' networks, and buffers; reused, so that a step allocates nothing once it is warm.
#[derive(Debug)]
pub(super) struct Nets {
    pub(super) critic: Separable,
    pub(super) q: GaussianConditional,
    negatives: Negatives,
    /// Pairs at least so far apart are of different transitions.
    near: usize,
    shifted: Shifted,
    all: AllPairs,
    q_tape: ConditionalTape,
    pairs: Pairs,
    x: Vec<f32>,
    y: Vec<f32>,
    shifts: Vec<usize>,
    precision: Vec<f32>,
    squares: Vec<f32>,
    grads: [Vec<f32>; 3],
    /// Per-sample values of the last evaluation or step; JSD shifted, CLUB in nats.
    pub(super) values: Vec<f32>,
}

impl Nets {
    /// The paper's networks for messages and actions of these widths.
    pub(super) fn new(widths: [usize; 2], negatives: Negatives, near: usize) -> Self {
        Self {
            critic: Separable::paper(widths[0], widths[1]),
            q: GaussianConditional::paper(widths[0], widths[1]),
            negatives,
            near,
            shifted: Shifted::default(),
            all: AllPairs::default(),
            q_tape: ConditionalTape::default(),
            pairs: Pairs::default(),
            x: Vec::new(),
            y: Vec::new(),
            shifts: Vec::new(),
            precision: Vec::new(),
            squares: Vec::new(),
            grads: Default::default(),
            values: Vec::new(),
        }
    }

    /// One step on `n` pairs drawn from the estimator's ring; returns the minibatch's mean value before it.
    pub(super) fn learn(
        &mut self,
        class: Class,
        of: &mut Estimator,
        n: usize,
        rng: &mut Stream,
    ) -> Result<f64, TrainError> {
        let mut pairs = std::mem::take(&mut self.pairs);
        pairs.clear();
        let [m, a] = of.ring.widths;
        for _ in 0..n {
            let at = rng::below(rng, of.ring.len());
            pairs.push([at * m, m], [at * a, a], 0);
        }
        let Estimator { params, adam, ring, .. } = of;
        let value = self.step(class, params, adam, &pairs, [&ring.messages, &ring.actions], rng);
        self.pairs = pairs;
        value
    }

    /// One step on these pairs; returns their mean value before it.
    pub(super) fn step(
        &mut self,
        class: Class,
        params: &Params,
        adam: &mut Adam,
        pairs: &Pairs,
        data: [&[f32]; 2],
        rng: &mut Stream,
    ) -> Result<f64, TrainError> {
        let n = pairs.len();
        let [_, _, grads] = &mut self.grads;
        grads.clear();
        grads.resize(params.len(), 0.0);
        let value = match class {
            Class::Delivered => self.jsd(&params.read(), pairs, data, 1, true, rng),
            Class::Lost => {
                let read = params.read();
                let value = self.club(&read, pairs, data, 1, rng);
                let [grad_mu, grad_logvar, grads] = &mut self.grads;
                let tape = &mut self.q_tape;
                grad_mu.resize(self.y.len(), 0.0);
                grad_logvar.resize(self.y.len(), 0.0);
                losses::nll(tape.mu(), tape.logvar(), &self.y, n, grad_mu, grad_logvar);
                self.q.backward(&read, &self.x, tape, grad_mu, grad_logvar, grads);
                value
            }
        };
        let [_, _, grads] = &self.grads;
        params.update(|p| adam.step(p, grads))?;
        Ok(value)
    }

    /// Mean value of pairs that an estimator holds out, in an order that says nothing.
    pub(super) fn heldout(&mut self, class: Class, of: &Estimator, rng: &mut Stream) -> Option<f64> {
        let n = of.fresh.len();
        if of.adam.t == 0 || n < 2 {
            return None;
        }
        let mut pairs = std::mem::take(&mut self.pairs);
        pairs.clear();
        let [m, a] = of.fresh.widths;
        for at in rng::permutation(rng, n) {
            pairs.push([at * m, m], [at * a, a], 0);
        }
        let mean = self.values_of(class, &of.params.read(), &pairs, of.fresh(), 1, rng);
        self.pairs = pairs;
        Some(mean)
    }

    /// Values of the pairs of a minibatch's transitions into `self.values`; returns the mean.
    pub(super) fn evaluate(
        &mut self,
        class: Class,
        of: &Estimator,
        pairs: &Pairs,
        data: [&[f32]; 2],
        rng: &mut Stream,
    ) {
        self.values_of(class, &of.params.read(), pairs, data, self.near, rng);
    }

    fn values_of(
        &mut self,
        class: Class,
        params: &[f32],
        pairs: &Pairs,
        data: [&[f32]; 2],
        near: usize,
        rng: &mut Stream,
    ) -> f64 {
        match class {
            Class::Delivered => self.jsd(params, pairs, data, near, false, rng),
            Class::Lost => self.club(params, pairs, data, near, rng),
        }
    }

    /// Shifted JSD values, and with `learn` the gradient of minus their mean.
    fn jsd(
        &mut self,
        params: &[f32],
        pairs: &Pairs,
        data: [&[f32]; 2],
        near: usize,
        learn: bool,
        rng: &mut Stream,
    ) -> f64 {
        let (n, [messages, actions]) = (pairs.len(), pairs.of(data));
        self.values.resize(n, 0.0);
        let [_, _, grads] = &mut self.grads;
        let Negatives::Count(k) = self.negatives else {
            messages.dense(self.critic.x.inputs(), &mut self.x);
            actions.dense(self.critic.y.inputs(), &mut self.y);
            let grads = learn.then_some(&mut grads[..]);
            return self.all.jsd(&self.critic, params, [&self.x, &self.y], &mut self.values, grads);
        };
        draw_shifts(rng, n, k, near, &mut self.shifts);
        if learn {
            -self.shifted.loss(&self.critic, params, [messages, actions], &self.shifts, &mut self.values, grads)
        } else {
            self.shifted.values(&self.critic, params, [messages, actions], &self.shifts, &mut self.values)
        }
    }

    /// CLUB values in nats; inputs and q's outputs stay in `self`.
    fn club(&mut self, params: &[f32], pairs: &Pairs, data: [&[f32]; 2], near: usize, rng: &mut Stream) -> f64 {
        let (n, [messages, actions]) = (pairs.len(), pairs.of(data));
        self.values.resize(n, 0.0);
        messages.dense(self.q.mu.inputs(), &mut self.x);
        actions.dense(self.q.mu.outputs(), &mut self.y);
        self.q.forward(params, &self.x, n, &mut self.q_tape);
        self.precision.clear();
        self.precision.extend(self.q_tape.logvar().iter().map(|v| -v));
        exp_in_place(&mut self.precision);
        let of = [self.q_tape.mu(), &self.precision, &self.y];
        let Negatives::Count(k) = self.negatives else {
            return club_all(of, &mut self.values);
        };
        draw_shifts(rng, n, k, near, &mut self.shifts);
        club_shifted(of, &self.shifts, &mut self.squares, &mut self.values)
    }
}
