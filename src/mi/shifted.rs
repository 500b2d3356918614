//! The paper's critic scored against cyclic shifts of the actions: what Du-MIE learns and shapes by.
//!
//! Negative k of pair i is the action of pair i + `shift_k`: a derangement, drawn once per minibatch. Pairs stand as
//! columns, so that neighbours fill a vector and a shift is an offset; with the first layer's bias as one more input
//! that is 1, embedding, scores and gradients are products and sliding sums.
#![expect(clippy::inline_always, reason = "instructions of a set are only generated in code inlined into its entry")]

use std::f64::consts::LN_2;

use rand::Rng;

use super::critic::Separable;
use crate::nn::{Finish, LANES, Left, Level, Lines, Mlp, Operation, Product, Simd, SlidingDots, SlidingSums, exp, ln};
use crate::rng;

/// Shifts are drawn from so many neighbours: what they reach stays in the first-level cache.
const WINDOW: usize = 256;

/// Factors 1 + e^{−|t|} ≤ 2 that are multiplied before a logarithm is taken.
const FACTORS: usize = 64;

/// Draws `k` cyclic shifts of `n` rows, each at least `near` rows away (where there are rows enough), so that no row is
/// its own partner. Rows must come in an order that says nothing.
pub(crate) fn draw_shifts<R: Rng + ?Sized>(rng: &mut R, n: usize, k: usize, near: usize, shifts: &mut Vec<usize>) {
    let far = n.saturating_sub(near).min(near + WINDOW);
    let range = if near < far { near..far } else { 1..n.min(1 + WINDOW) };
    shifts.clear();
    shifts.extend((0..k).map(|_| range.start + rng::below(rng, range.len())));
}

/// Vectors that lie somewhere in `data`: the message, or the action, of each pair.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Picked<'a> {
    pub(crate) data: &'a [f32],
    /// Where each vector starts.
    pub(crate) starts: &'a [u32],
    /// How long each is; the rest, up to what a network takes, is zeros.
    pub(crate) widths: &'a [u32],
}

impl Picked<'_> {
    /// Lays them out as rows of `width`, padded with zeros.
    pub(crate) fn dense(self, width: usize, rows: &mut Vec<f32>) {
        rows.clear();
        rows.resize(self.starts.len() * width, 0.0);
        self.lay(width, rows);
    }

    /// Copies them into rows that start `stride` apart.
    fn lay(self, stride: usize, rows: &mut [f32]) {
        for ((row, &start), &width) in rows.chunks_exact_mut(stride).zip(self.starts).zip(self.widths) {
            row[..width as usize].copy_from_slice(&self.data[start as usize..(start + width) as usize]);
        }
    }

    /// Their component `c`, one after the other.
    fn component(self, c: usize, all: bool, line: &mut [f32]) {
        let values = line.iter_mut().zip(self.starts);
        if all {
            values.for_each(|(to, &start)| *to = self.data[start as usize + c]);
        } else {
            let within = |start: u32, width: u32| if c < width as usize { self.data[start as usize + c] } else { 0.0 };
            values.zip(self.widths).for_each(|((to, &start), &width)| *to = within(start, width));
        }
    }
}

/// One side of the pairs as columns: a line per input and a last line of ones.
#[derive(Debug, Default)]
struct Side {
    /// `[inputs + 1, stride]`; column c holds row (c − left) mod n.
    columns: Vec<f32>,
    stride: usize,
    /// `[outputs, inputs + 1]`: weight and bias.
    weight: Vec<f32>,
    /// `[outputs, stride]`.
    embedding: Vec<f32>,
    zeros: Vec<f32>,
    /// ∂loss/∂embedding, `[outputs, n]`, n rounded up to whole vectors.
    grad: Vec<f32>,
    /// The rows with a last input of 1, rounded up to whole vectors.
    rows: Vec<f32>,
    grad_weight: Vec<f32>,
}

impl Side {
    /// Lays out vectors, `left` columns repeated before them and at least `right` after, and embeds them.
    fn embed(&mut self, mlp: &Mlp, params: &[f32], picked: Picked<'_>, left: usize, right: usize) {
        let n = picked.starts.len();
        let ([outputs, inputs], _) = mlp.weight(0);
        self.stride = (left + n.next_multiple_of(LANES) + right).next_multiple_of(LANES);
        // lines a multiple of 4096 bytes apart would share one set of the cache
        if self.stride.is_multiple_of(1024) {
            self.stride += LANES;
        }
        let stride = self.stride;
        resize(&mut self.columns, (inputs + 1) * stride);
        let all = picked.widths.iter().all(|&width| width as usize == inputs);
        for (c, line) in self.columns.chunks_exact_mut(stride).take(inputs).enumerate() {
            picked.component(c, all, &mut line[left..left + n]);
            (0..left).rev().for_each(|at| line[at] = line[at + n]);
            (left + n..stride).for_each(|at| line[at] = line[at - n]);
        }
        self.columns[inputs * stride..].fill(1.0);
        let (weight, bias) = params.split_at(outputs * inputs);
        self.weight.clear();
        for (weight, bias) in weight.chunks_exact(inputs).zip(bias) {
            self.weight.extend_from_slice(weight);
            self.weight.push(*bias);
        }
        resize(&mut self.zeros, stride);
        resize(&mut self.embedding, outputs * stride);
        Product {
            size: [outputs, stride, inputs + 1],
            a: Left { data: &self.weight, row: inputs + 1, col: 1 },
            b: &self.columns,
            c: &mut self.embedding,
            finish: Finish::Bias { bias: &self.zeros, leak: LEAK },
        }
        .compute();
    }

    fn lines(&self) -> Lines<'_> {
        Lines { data: &self.embedding, stride: self.stride }
    }

    /// From ∂loss/∂embedding in `grad`: adds the gradient of the layer's parameters to `grads`.
    fn backward(&mut self, mlp: &Mlp, picked: Picked<'_>, left: usize, grads: &mut [f32]) {
        let (n, ([outputs, inputs], _)) = (picked.starts.len(), mlp.weight(0));
        let line = n.next_multiple_of(LANES);
        for (grad, value) in self.grad.chunks_exact_mut(line).zip(self.embedding.chunks_exact(self.stride)) {
            grad.iter_mut().zip(&value[left..]).for_each(|(g, v)| *g = if *v > 0.0 { *g } else { LEAK * *g });
        }
        let width = (inputs + 1).next_multiple_of(LANES);
        self.rows.clear();
        self.rows.resize(n * width, 0.0);
        picked.lay(width, &mut self.rows);
        self.rows.chunks_exact_mut(width).for_each(|row| row[inputs] = 1.0);
        resize(&mut self.grad_weight, outputs * width);
        Product {
            size: [outputs, width, n],
            a: Left { data: &self.grad, row: line, col: 1 },
            b: &self.rows,
            c: &mut self.grad_weight,
            finish: Finish::Set,
        }
        .compute();
        let (weight, bias) = grads.split_at_mut(outputs * inputs);
        for ((to, bias), from) in weight.chunks_exact_mut(inputs).zip(bias).zip(self.grad_weight.chunks_exact(width)) {
            to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
            *bias += from[inputs];
        }
    }
}

/// Factor of the critic's `LeakyReLU` below zero.
const LEAK: f32 = 0.01;

fn resize(buffer: &mut Vec<f32>, len: usize) {
    buffer.resize(len, 0.0);
}

/// Buffers of one evaluation; reused, so that nothing is allocated once it is warm.
#[derive(Debug, Default)]
pub(crate) struct Shifted {
    x: Side,
    y: Side,
    /// Shift 0 (the pairs), then the shifts.
    shifts: Vec<usize>,
    offsets: Vec<usize>,
    /// Scores, then ∂loss/∂scores: a line per shift, the first `left` columns a repetition of the last.
    scores: Vec<f32>,
    stride: usize,
    left: usize,
    n: usize,
}

impl Shifted {
    /// Scores the pairs (x, y) and every x against y shifted, by the paper's one-layer critic.
    fn score(&mut self, critic: &Separable, params: &[f32], [x, y]: [Picked<'_>; 2], shifts: &[usize]) {
        let n = x.starts.len();
        let reach = shifts.iter().copied().max().unwrap_or(0);
        (self.left, self.n) = (reach.next_multiple_of(LANES), n);
        self.shifts.clear();
        self.shifts.push(0);
        self.shifts.extend_from_slice(shifts);
        let (px, py) = params.split_at(critic.x.parameters());
        self.x.embed(&critic.x, px, x, self.left, 0);
        self.y.embed(&critic.y, py, y, 0, reach);
        self.stride = self.x.stride;
        resize(&mut self.scores, self.shifts.len() * self.stride);
        Level::best().run(SlidingDots {
            n,
            features: critic.x.outputs(),
            a: self.x.lines(),
            a_offset: self.left,
            b: self.y.lines(),
            shifts: &self.shifts,
            out: &mut self.scores,
            out_stride: self.stride,
            out_offset: self.left,
        });
    }

    /// Shifted JSD values per pair into `values` `[n]`; returns their mean. See `losses::jsd_values`.
    pub(crate) fn values(
        &mut self,
        critic: &Separable,
        params: &[f32],
        pairs: [Picked<'_>; 2],
        shifts: &[usize],
        values: &mut [f32],
    ) -> f64 {
        self.score(critic, params, pairs, shifts);
        self.jsd(values, false)
    }

    /// The loss −mean value, its per-pair values, and its gradient added to `grads`.
    pub(crate) fn loss(
        &mut self,
        critic: &Separable,
        params: &[f32],
        pairs: [Picked<'_>; 2],
        shifts: &[usize],
        values: &mut [f32],
        grads: &mut [f32],
    ) -> f64 {
        let n = values.len();
        self.score(critic, params, pairs, shifts);
        let loss = -self.jsd(values, true);
        let (left, line) = (self.left, n.next_multiple_of(LANES));
        for scores in self.scores.chunks_exact_mut(self.stride) {
            scores[left + n..].fill(0.0);
            (0..left).rev().for_each(|at| scores[at] = scores[at + n]);
        }
        let features = critic.x.outputs();
        // column i of x meets y at i + shift; column j of y met x at j − shift
        self.offsets.clear();
        self.offsets.resize(self.shifts.len(), left);
        resize(&mut self.x.grad, features * line);
        let g = Lines { data: &self.scores, stride: self.stride };
        Level::best().run(SlidingSums {
            n,
            features,
            g,
            g_offsets: &self.offsets,
            b: self.y.lines(),
            b_offsets: &self.shifts,
            out: &mut self.x.grad,
            out_stride: line,
        });
        self.offsets.iter_mut().zip(&self.shifts).for_each(|(offset, shift)| *offset -= shift);
        resize(&mut self.y.grad, features * line);
        Level::best().run(SlidingSums {
            n,
            features,
            g,
            g_offsets: &self.offsets,
            b: self.x.lines(),
            b_offsets: &self.offsets,
            out: &mut self.y.grad,
            out_stride: line,
        });
        let (gx, gy) = grads.split_at_mut(critic.x.parameters());
        let [x, y] = pairs;
        self.x.backward(&critic.x, x, left, gx);
        self.y.backward(&critic.y, y, 0, gy);
        loss
    }

    /// Values from the scores; with `slopes`, the scores become ∂loss/∂scores.
    fn jsd(&mut self, values: &mut [f32], slopes: bool) -> f64 {
        let (n, left, stride) = (self.n, self.left, self.stride);
        Level::best().run(Jsd { scores: &mut self.scores, stride, left, values, slopes });
        values.iter().map(|&v| f64::from(v)).sum::<f64>() / n as f64
    }
}

/// Values and slopes of the JSD objective over lines of scores.
struct Jsd<'a> {
    scores: &'a mut [f32],
    stride: usize,
    left: usize,
    values: &'a mut [f32],
    slopes: bool,
}

impl Operation for Jsd<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { scores, stride, left, values, slopes } = self;
        let (n, k) = (values.len(), scores.len() / stride - 1);
        let (zero, one) = (s.splat(0.0), s.splat(1.0));
        let mut lanes = [0.0; LANES];
        for i in (0..n).step_by(S::WIDTH) {
            let (mut largest, mut product, mut logs) = (zero, one, zero);
            let mut up = zero;
            for line in 0..=k {
                let at = line * stride + left + i;
                let t = s.load(&scores[at..]);
                // the pair counts as sp(−t), the others as sp(t)
                let t = if line == 0 { s.sub(zero, t) } else { t };
                let e = exp(s, s.min(t, s.sub(zero, t)));
                let above = s.max(zero, t);
                if line == 0 {
                    up = s.add(above, ln(s, s.add(one, e)));
                } else {
                    largest = s.add(largest, above);
                    product = s.mul(product, s.add(one, e));
                    if line.is_multiple_of(FACTORS) {
                        (logs, product) = (s.add(logs, ln(s, product)), one);
                    }
                }
                if slopes {
                    let share = s.div(one, s.add(one, e));
                    let slope = s.positive(t, share, s.mul(e, share));
                    let weight = if line == 0 { -1.0 / n as f32 } else { 1.0 / (n * k) as f32 };
                    s.store(&mut scores[at..], s.mul(s.splat(weight), slope));
                }
            }
            let down = s.add(largest, s.add(logs, ln(s, product)));
            let both = s.fma(down, s.splat(1.0 / k as f32), up);
            s.store(&mut lanes, s.sub(s.splat(2.0 * LN_2 as f32), both));
            let end = n.min(i + S::WIDTH);
            values[i..end].copy_from_slice(&lanes[..end - i]);
        }
    }
}

/// vCLUB values per sample against shifts of y, in nats; returns their mean. See `losses::club_values`.
///
/// `mu`, `precision` (1/σ²) and `y` are `[n, d]`; `squares` is overwritten.
pub(crate) fn club_shifted(
    [mu, precision, y]: [&[f32]; 3],
    shifts: &[usize],
    squares: &mut Vec<f32>,
    values: &mut [f32],
) -> f64 {
    let (n, share) = (values.len(), 1.0 / shifts.len() as f32);
    let d = y.len() / n;
    // mean_k (y_k − μ)² − (y − μ)², along whole rows so that neighbours fill a vector
    squares.clear();
    squares.extend(mu.iter().zip(y).map(|(mu, y)| -(y - mu) * (y - mu)));
    for &shift in shifts {
        let (first, last) = squares.split_at_mut((n - shift) * d);
        let (mu_first, mu_last) = mu.split_at((n - shift) * d);
        for (squares, mu, y) in [(first, mu_first, &y[shift * d..]), (last, mu_last, y)] {
            for ((square, mu), y) in squares.iter_mut().zip(mu).zip(y) {
                *square += share * (y - mu) * (y - mu);
            }
        }
    }
    let rows = squares.chunks_exact(d).zip(precision.chunks_exact(d));
    for (value, (squares, precision)) in values.iter_mut().zip(rows) {
        *value = 0.5 * squares.iter().zip(precision).map(|(s, p)| s * p).sum::<f32>();
    }
    values.iter().map(|&v| f64::from(v)).sum::<f64>() / n as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::critic::CriticTape;
    use crate::mi::losses;
    use crate::rng::Seeds;

    /// The same pairs as lists of indices.
    fn listed(n: usize, shifts: &[usize]) -> Vec<u32> {
        (0..n).flat_map(|i| shifts.iter().map(move |s| ((i + s) % n) as u32)).collect()
    }

    #[test]
    fn values_loss_and_gradient_equal_those_over_lists_of_negatives() {
        let mut rng = Seeds::new(1).stream("shifted");
        for (n, k) in [(1024, 16), (300, 16), (37, 3), (5, 2), (2, 1), (150, 130)] {
            let critic = Separable::paper(18, 5);
            let mut params = Vec::new();
            critic.init(&mut rng, &mut params);
            for p in &mut params {
                *p *= 3.0;
            }
            let mut draw = |n: usize| (0..n).map(|_| rng::normal(&mut rng) as f32).collect::<Vec<_>>();
            let (x, y) = (draw(n * 18), draw(n * 5));
            let mut shifts = Vec::new();
            draw_shifts(&mut rng, n, k, 6, &mut shifts);
            let negatives = listed(n, &shifts);
            let (mut tape, mut expected) = (CriticTape::default(), vec![0.0; n]);
            critic.scores(&params, &x, &y, n, &negatives, &mut tape);
            let (mut gp, mut gn) = (vec![0.0; n], vec![0.0; n * k]);
            let loss = losses::jsd(&tape.positive, &tape.negative, &mut expected, &mut gp, &mut gn);
            let mut reference = vec![0.0; params.len()];
            critic.backward(&params, &x, &y, &mut tape, &gp, &gn, &mut reference);
            let mut shifted = Shifted::default();
            let lists = [18u32, 5].map(|w| ((0..n as u32).map(|i| i * w).collect::<Vec<_>>(), vec![w; n]));
            let pick = |data, side: usize| Picked { data, starts: &lists[side].0, widths: &lists[side].1 };
            let pairs = [pick(&x, 0), pick(&y, 1)];
            for _ in 0..2 {
                let (mut values, mut grads) = (vec![0.0; n], vec![0.0; params.len()]);
                let found = shifted.loss(&critic, &params, pairs, &shifts, &mut values, &mut grads);
                assert!((found - loss).abs() < 1e-5 * (1.0 + loss.abs()), "{found} and {loss}");
                let scale = reference.iter().fold(1.0f32, |m, g| m.max(g.abs()));
                for (a, b) in grads.iter().zip(&reference) {
                    assert!((a - b).abs() < 1e-5 * scale, "{a} and {b} of {n}, {k}");
                }
                let mean = shifted.values(&critic, &params, pairs, &shifts, &mut values);
                assert!((mean + found).abs() < 1e-6);
                for (a, b) in values.iter().zip(&expected) {
                    assert!((a - b).abs() < 1e-5 * (1.0 + b.abs()), "{a} and {b} of {n}, {k}");
                }
            }
            let (mu, logvar) = (&x[..n * 5], &x[n * 5..n * 10]);
            let precision: Vec<f32> = logvar.iter().map(|v| (-v).exp()).collect();
            let (mut values, mut expected) = (vec![0.0; n], vec![0.0; n]);
            let mean = losses::club_values(mu, logvar, &y, &negatives, &mut expected);
            let found = club_shifted([mu, &precision, &y], &shifts, &mut Vec::new(), &mut values);
            assert!((found - mean).abs() < 1e-4 * (1.0 + mean.abs()), "{found} and {mean}");
        }
    }

    #[test]
    fn shorter_vectors_are_padded_with_zeros() {
        let (data, starts) = ([1.0, 2.0, 3.0, 4.0], [1, 0]);
        let picked = Picked { data: &data, starts: &starts, widths: &[3, 0] };
        let mut rows = Vec::new();
        picked.dense(3, &mut rows);
        assert_eq!(rows, [2.0, 3.0, 4.0, 0.0, 0.0, 0.0]);
        let mut line = [9.0; 2];
        picked.component(2, false, &mut line);
        assert_eq!(line, [4.0, 0.0]);
    }

    #[test]
    fn shifts_are_derangements_at_least_near_and_at_most_a_window_away() {
        let mut rng = Seeds::new(2).stream("shifts");
        let mut shifts = Vec::new();
        for (n, near, range) in [(5000, 6, 6..262), (100, 6, 6..94), (12, 6, 1..12), (2, 6, 1..2), (1000, 1, 1..257)] {
            draw_shifts(&mut rng, n, 5000, near, &mut shifts);
            assert!(shifts.iter().all(|s| range.contains(s)), "{n}: {range:?}");
            assert_eq!(shifts.iter().min(), Some(&range.start));
            assert_eq!(shifts.iter().max(), Some(&(range.end - 1)));
        }
    }
}
