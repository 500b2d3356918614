//! A critic of either kind with its buffers: separable, or one perceptron over x and y side by side.

use serde::{Deserialize, Serialize};

use super::critic::{CriticTape, Separable, dot};
use super::fit::silence;
use super::prepare::gather;
use crate::nn::{Activation, Mlp, Tape};
use crate::rng::Stream;

/// Which critic scores a pair.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum CriticKind {
    /// The dot product of an embedding of x and one of y, 64-64-32 on either side.
    #[default]
    Separable,
    /// One perceptron, 64-64-1, over x and y side by side: freer, and dearer by the number of negatives.
    Concatenated,
}

impl CriticKind {
    /// Negatives per pair in training.
    pub(super) fn negatives(self) -> usize {
        match self {
            Self::Separable => 64,
            Self::Concatenated => 16,
        }
    }

    /// Rows that are scored all against all.
    pub(super) fn square(self) -> usize {
        match self {
            Self::Separable => 1024,
            Self::Concatenated => 256,
        }
    }
}

/// A critic and what its last pass left.
pub(super) enum Scorer {
    Separable(Separable, Box<CriticTape>),
    Concatenated(Box<Concatenated>),
}

/// A perceptron over `[x, y]`, the pairs that it scored last, and their scores.
pub(super) struct Concatenated {
    mlp: Mlp,
    tape: Tape,
    pairs: Vec<f32>,
    positive: Vec<f32>,
    negative: Vec<f32>,
    grads: Vec<f32>,
}

impl Scorer {
    pub(super) fn new(kind: CriticKind, x_width: usize, y_width: usize) -> Self {
        match kind {
            CriticKind::Separable => Self::Separable(Separable::deep(x_width, y_width), Box::default()),
            CriticKind::Concatenated => Self::Concatenated(Box::new(Concatenated {
                mlp: Mlp::new(&[x_width + y_width, 64, 64, 1], Activation::Relu, Activation::Identity),
                tape: Tape::default(),
                pairs: Vec::new(),
                positive: Vec::new(),
                negative: Vec::new(),
                grads: Vec::new(),
            })),
        }
    }

    /// Fresh parameters with which every score is 0.
    pub(super) fn init(&self, rng: &mut Stream) -> Vec<f32> {
        let mut params = Vec::new();
        match self {
            Self::Separable(critic, _) => {
                critic.init(rng, &mut params);
                silence(&critic.x, &mut params);
            }
            Self::Concatenated(critic) => {
                critic.mlp.init(rng, &mut params);
                silence(&critic.mlp, &mut params);
            }
        }
        params
    }

    /// Scores `x` `[n, x]` with `y` `[n, y]`, and with the rows of `y` that `negatives` `[n, k]` names (any k).
    pub(super) fn scores(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, negatives: &[u32]) {
        match self {
            Self::Separable(critic, tape) => critic.scores(params, x, y, n, negatives, tape),
            Self::Concatenated(critic) => critic.scores(params, x, y, n, negatives),
        }
    }

    /// Scores of the pairs, `[n]`.
    pub(super) fn positive(&self) -> &[f32] {
        match self {
            Self::Separable(_, tape) => &tape.positive,
            Self::Concatenated(critic) => &critic.positive,
        }
    }

    /// Scores with the negatives, `[n, k]`.
    pub(super) fn negative(&self) -> &[f32] {
        match self {
            Self::Separable(_, tape) => &tape.negative,
            Self::Concatenated(critic) => &critic.negative,
        }
    }

    /// Sum of the scores of the rows of `x` that a pick names with the `n` rows of `y`, for each of `picks`.
    pub(super) fn sums(
        &mut self,
        params: &[f32],
        [x, y]: [&[f32]; 2],
        n: usize,
        picks: &mut dyn Iterator<Item = Vec<u32>>,
    ) -> Vec<f64> {
        match self {
            Self::Separable(critic, _) => {
                // every row is embedded once
                let (mut tape_x, mut tape_y) = (Tape::default(), Tape::default());
                let (px, py) = params.split_at(critic.x.parameters());
                let ex = critic.x.forward(px, x, x.len() / critic.x.inputs(), &mut tape_x);
                let ey = critic.y.forward(py, y, n, &mut tape_y);
                let width = critic.x.outputs();
                let row = |i: u32| &ex[i as usize * width..(i as usize + 1) * width];
                let sum = |pick: Vec<u32>| {
                    pick.iter().zip(ey.chunks_exact(width)).map(|(&i, y)| f64::from(dot(row(i), y))).sum()
                };
                picks.map(sum).collect()
            }
            Self::Concatenated(critic) => {
                let width = critic.mlp.inputs() - y.len() / n;
                let mut picked = Vec::new();
                let sum = |pick: Vec<u32>| {
                    gather(x, width, &pick, &mut picked);
                    critic.scores(params, &picked, y, n, &[]);
                    critic.positive.iter().map(|&t| f64::from(t)).sum()
                };
                picks.map(sum).collect()
            }
        }
    }

    /// Backward pass of the last [`Self::scores`]: adds ∂L/∂params to `grads`, given ∂L/∂scores.
    pub(super) fn backward(
        &mut self,
        params: &[f32],
        [x, y]: [&[f32]; 2],
        [grad_positive, grad_negative]: [&[f32]; 2],
        grads: &mut [f32],
    ) {
        match self {
            Self::Separable(critic, tape) => {
                critic.backward(params, x, y, tape, grad_positive, grad_negative, grads);
            }
            Self::Concatenated(critic) => {
                critic.grads.clear();
                critic.grads.extend_from_slice(grad_positive);
                critic.grads.extend_from_slice(grad_negative);
                critic.mlp.backward(params, &critic.pairs, &mut critic.tape, &critic.grads, grads, None);
            }
        }
    }
}

impl Concatenated {
    fn scores(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, negatives: &[u32]) {
        let (x_width, y_width) = (x.len() / n, y.len() / n);
        let k = negatives.len() / n;
        self.pairs.clear();
        let mut push = |i: usize, j: usize| {
            self.pairs.extend_from_slice(&x[i * x_width..(i + 1) * x_width]);
            self.pairs.extend_from_slice(&y[j * y_width..(j + 1) * y_width]);
        };
        for i in 0..n {
            push(i, i);
        }
        negatives.iter().enumerate().for_each(|(at, &j)| push(at / k, j as usize));
        let scores = self.mlp.forward(params, &self.pairs, n + negatives.len(), &mut self.tape);
        let (positive, negative) = scores.split_at(n);
        self.positive.clear();
        self.positive.extend_from_slice(positive);
        self.negative.clear();
        self.negative.extend_from_slice(negative);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::bounds::Objective;
    use crate::mi::derangements;
    use crate::rng::{self, Seeds};

    #[test]
    fn both_critics_have_the_gradient_that_differences_show_and_start_at_zero() {
        for kind in [CriticKind::Separable, CriticKind::Concatenated] {
            let mut rng = Seeds::new(4).stream("scorer");
            let mut scorer = Scorer::new(kind, 3, 2);
            let mut params = scorer.init(&mut rng);
            let (n, k) = (40, 4);
            let mut draw = |n: usize| (0..n).map(|_| rng::normal(&mut rng) as f32).collect::<Vec<_>>();
            let (x, y) = (draw(n * 3), draw(n * 2));
            let noise = draw(params.len());
            let negatives = derangements(&mut rng, n, k);
            scorer.scores(&params, &x, &y, n, &negatives);
            assert!(scorer.positive().iter().chain(scorer.negative()).all(|&t| t == 0.0));
            params.iter_mut().zip(noise).for_each(|(p, v)| *p += 0.1 * v);
            let (mut gp, mut gn, mut grads) = (vec![0.0; n], vec![0.0; n * k], vec![0.0; params.len()]);
            scorer.scores(&params, &x, &y, n, &negatives);
            let mut objective = Objective::Nwj;
            objective.loss(scorer.positive(), scorer.negative(), &mut gp, &mut gn);
            scorer.backward(&params, [&x, &y], [&gp, &gn], &mut grads);
            let square: f64 = grads.iter().map(|&g| f64::from(g) * f64::from(g)).sum();
            let mut at = |h: f64| {
                let moved: Vec<f32> = params.iter().zip(&grads).map(|(p, g)| p + (h * f64::from(*g)) as f32).collect();
                scorer.scores(&moved, &x, &y, n, &negatives);
                -objective.value(scorer.positive(), scorer.negative())
            };
            let h = 3e-3 / square.sqrt();
            let slope = (at(h) - at(-h)) / (2.0 * h);
            assert!((slope / square - 1.0).abs() < 2e-2, "{kind:?}: {slope} against {square}");
        }
    }
}
