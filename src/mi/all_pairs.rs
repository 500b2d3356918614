//! Every action of a minibatch as a negative of every message: the parent code's N × N, a block of rows at a time.
//!
//! JSD leaves out the pair itself, CLUB does not, as there. CLUB needs no N × N: the mean of (`y_k` − μ)² over all k is
//! that of the moments of y.
#![expect(clippy::inline_always, reason = "instructions of a set are only generated in code inlined into its entry")]

use std::f64::consts::LN_2;

use super::critic::Separable;
use super::losses::softplus;
use crate::nn::{Finish, LANES, Left, Level, Operation, Product, Simd, Tape, exp, ln};

/// Messages whose scores are computed together.
const BLOCK: usize = 48;

/// Factors 1 + e^{−|t|} ≤ 2 that are multiplied before a logarithm is taken.
const FACTORS: usize = 64;

/// Buffers of one evaluation; reused.
#[derive(Debug, Default)]
pub(crate) struct AllPairs {
    x: Tape,
    y: Tape,
    /// The embedding of y by feature, `[features, n]`, n rounded up to whole vectors.
    lines: Vec<f32>,
    /// Scores of a block of messages, then their slopes.
    scores: Vec<f32>,
    grad_x: Vec<f32>,
    grad_y: Vec<f32>,
}

impl AllPairs {
    /// Shifted JSD values per pair into `values` `[n]`; returns their mean. With `grads`, adds the gradient of −mean.
    /// Embeddings must be whole vectors wide.
    pub(crate) fn jsd(
        &mut self,
        critic: &Separable,
        params: &[f32],
        [x, y]: [&[f32]; 2],
        values: &mut [f32],
        grads: Option<&mut [f32]>,
    ) -> f64 {
        let (n, width) = (values.len(), critic.x.outputs());
        let line = n.next_multiple_of(LANES);
        let (px, py) = params.split_at(critic.x.parameters());
        let Self { x: tape_x, y: tape_y, lines, scores, grad_x, grad_y } = self;
        let ex = critic.x.forward(px, x, n, tape_x);
        let ey = critic.y.forward(py, y, n, tape_y);
        lines.clear();
        lines.resize(width * line, 0.0);
        for (f, to) in lines.chunks_exact_mut(line).enumerate() {
            to.iter_mut().zip(ey[f..].iter().step_by(width)).for_each(|(to, from)| *to = *from);
        }
        let learn = grads.is_some();
        if learn {
            grad_x.resize(n * width, 0.0);
            grad_y.clear();
            grad_y.resize(n * width, 0.0);
        }
        scores.resize(BLOCK * line, 0.0);
        let mut total = 0.0;
        for start in (0..n).step_by(BLOCK) {
            let rows = BLOCK.min(n - start);
            let block = start * width..(start + rows) * width;
            Product {
                size: [rows, line, width],
                a: Left { data: &ex[block.clone()], row: width, col: 1 },
                b: lines,
                c: scores,
                finish: Finish::Set,
            }
            .compute();
            let of_pairs = 1.0 / (n * (n - 1)) as f32;
            for (at, (value, scores)) in
                values[start..start + rows].iter_mut().zip(scores.chunks_exact_mut(line)).enumerate()
            {
                let own = scores[start + at];
                // columns beyond n score 0, and softplus 0 = ln 2
                let sum = Level::best().run(SumOfSoftplus { scores, slope: learn.then_some(of_pairs) })
                    - (line - n) as f64 * LN_2
                    - f64::from(softplus(own));
                let found = 2.0 * LN_2 - f64::from(softplus(-own)) - sum / (n - 1) as f64;
                *value = found as f32;
                total += found;
                if learn {
                    scores[start + at] = -1.0 / (n as f32 * (1.0 + own.exp()));
                }
            }
            if learn {
                Product {
                    size: [rows, width, n],
                    a: Left { data: scores, row: line, col: 1 },
                    b: ey,
                    c: &mut grad_x[block.clone()],
                    finish: Finish::Set,
                }
                .compute();
                Product {
                    size: [n, width, rows],
                    a: Left { data: scores, row: 1, col: line },
                    b: &ex[block],
                    c: grad_y,
                    finish: Finish::Add,
                }
                .compute();
            }
        }
        if let Some(grads) = grads {
            let (gx, gy) = grads.split_at_mut(critic.x.parameters());
            critic.x.backward(px, x, tape_x, grad_x, gx, None);
            critic.y.backward(py, y, tape_y, grad_y, gy, None);
        }
        total / n as f64
    }
}

/// Sum of softplus over scores (whole vectors of them); with a slope, each score becomes slope · logistic(score).
struct SumOfSoftplus<'a> {
    scores: &'a mut [f32],
    slope: Option<f32>,
}

impl Operation for SumOfSoftplus<'_> {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> f64 {
        let (zero, one) = (s.splat(0.0), s.splat(1.0));
        let mut total = 0.0;
        for chunk in self.scores.chunks_mut(FACTORS * LANES) {
            // sixteen sums and sixteen products, in as many vectors as they take
            let (mut above, mut products) = ([zero; 4], [one; 4]);
            for scores in chunk.chunks_exact_mut(LANES) {
                for (part, scores) in scores.chunks_exact_mut(S::WIDTH).enumerate() {
                    let t = s.load(scores);
                    let e = exp(s, s.min(t, s.sub(zero, t)));
                    above[part] = s.add(above[part], s.max(zero, t));
                    products[part] = s.mul(products[part], s.add(one, e));
                    if let Some(slope) = self.slope {
                        let share = s.div(s.splat(slope), s.add(one, e));
                        s.store(scores, s.positive(t, share, s.mul(e, share)));
                    }
                }
            }
            for part in 0..LANES / S::WIDTH {
                above[part] = s.add(above[part], ln(s, products[part]));
            }
            total += f64::from(s.sum16(above));
        }
        total
    }
}

/// vCLUB values per sample against every y, in nats; returns their mean. See `losses::club_values`.
///
/// `mu`, `precision` (1/σ²) and `y` are `[n, d]`.
pub(crate) fn club_all([mu, precision, y]: [&[f32]; 3], values: &mut [f32]) -> f64 {
    let n = values.len();
    let d = y.len() / n;
    values.fill(0.0);
    for c in 0..d {
        let column = || y[c..].iter().step_by(d).map(|&y| f64::from(y));
        let mean = column().sum::<f64>() / n as f64;
        let variance = column().map(|y| (y - mean) * (y - mean)).sum::<f64>() / n as f64;
        for (i, value) in values.iter_mut().enumerate() {
            let (mu, own) = (f64::from(mu[i * d + c]), f64::from(y[i * d + c]));
            let squares = variance + (mean - mu) * (mean - mu) - (own - mu) * (own - mu);
            *value += (0.5 * f64::from(precision[i * d + c]) * squares) as f32;
        }
    }
    values.iter().map(|&v| f64::from(v)).sum::<f64>() / n as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::critic::CriticTape;
    use crate::mi::{all_others, losses};
    use crate::rng::{self, Seeds};

    #[test]
    fn values_loss_and_gradient_equal_those_over_the_list_of_all_others() {
        let mut rng = Seeds::new(1).stream("all");
        for n in [2, 17, 64, 131] {
            let critic = Separable::paper(7, 3);
            let mut params = Vec::new();
            critic.init(&mut rng, &mut params);
            for p in &mut params {
                *p *= 3.0;
            }
            let mut draw = |n: usize| (0..n).map(|_| rng::normal(&mut rng) as f32).collect::<Vec<_>>();
            let (x, y) = (draw(n * 7), draw(n * 3));
            let negatives = all_others(n);
            let (mut tape, mut expected) = (CriticTape::default(), vec![0.0; n]);
            critic.scores(&params, &x, &y, n, &negatives, &mut tape);
            let (mut gp, mut gn) = (vec![0.0; n], vec![0.0; negatives.len()]);
            let loss = losses::jsd(&tape.positive, &tape.negative, &mut expected, &mut gp, &mut gn);
            let mut reference = vec![0.0; params.len()];
            critic.backward(&params, &x, &y, &mut tape, &gp, &gn, &mut reference);
            let mut all = AllPairs::default();
            for learn in [true, false, true] {
                let (mut values, mut grads) = (vec![0.0; n], vec![0.0; params.len()]);
                let wanted = learn.then_some(&mut grads[..]);
                let mean = all.jsd(&critic, &params, [&x, &y], &mut values, wanted);
                assert!((mean + loss).abs() < 1e-5 * (1.0 + loss.abs()), "{mean} and {loss}");
                for (a, b) in values.iter().zip(&expected) {
                    assert!((a - b).abs() < 1e-5 * (1.0 + b.abs()), "{a} and {b} of {n}");
                }
                let scale = reference.iter().fold(1.0f32, |m, g| m.max(g.abs()));
                for (a, b) in grads.iter().zip(&reference).filter(|_| learn) {
                    assert!((a - b).abs() < 1e-5 * scale, "{a} and {b} of {n}");
                }
            }
            // CLUB counts the pair itself
            let (mu, logvar) = (&x[..n * 3], &x[n * 3..n * 6]);
            let precision: Vec<f32> = logvar.iter().map(|v| (-v).exp()).collect();
            let everyone: Vec<u32> = (0..n).flat_map(|_| 0..n as u32).collect();
            let (mut values, mut expected) = (vec![0.0; n], vec![0.0; n]);
            let mean = losses::club_values(mu, logvar, &y, &everyone, &mut expected);
            let found = club_all([mu, &precision, &y], &mut values);
            assert!((found - mean).abs() < 1e-5 * (1.0 + mean.abs()), "{found} and {mean}");
        }
    }
}
