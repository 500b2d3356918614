//! Training of an estimator's networks: Adam on minibatches, stopped on validation.

use super::prepare::{Prepared, gather};
use crate::nn::{Adam, AdamConfig, Mlp, clip_norm};
use crate::rng::{self, Seeds, Stream};

const BATCH: usize = 256;
const STEPS: usize = 600;
/// Steps between two looks at the validation part.
const EVERY: usize = 25;
/// Looks without improvement before training ends.
const PATIENCE: usize = 6;
const LEARNING_RATE: f32 = 2e-3;
/// Validation rows looked at; more cost time and change little.
const LOOK: usize = 4096;

/// What is trained.
pub(super) trait Model {
    /// Decoupled weight decay per unit of learning rate: more helps small samples and hurts strong dependence.
    const DECAY: f32;

    /// Fresh parameters, at which the score is that of "x tells nothing".
    fn init(&self, rng: &mut Stream) -> Vec<f32>;

    /// Loss on a minibatch of `n` pairs; adds its gradient to `grads`.
    fn loss(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, rng: &mut Stream, grads: &mut [f32]) -> f64;

    /// Score on `n` pairs, to be maximised; the same stream every time.
    fn score(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, rng: &mut Stream) -> f64;
}

/// The parameters that scored best on the validation part.
pub(super) struct Fit {
    pub(super) params: Vec<f32>,
    score: f64,
    /// Steps after which they were reached; 0: nothing was learnt that holds on the validation part.
    pub(super) steps: usize,
}

/// Said of networks that never beat "x tells nothing" on the validation part, whose values are 0 by construction.
pub(super) fn nothing_learnt(network: &str) -> String {
    format!(
        "{network} learned nothing that holds on the validation episodes: its 0 is no evidence of independence; give more \
         episodes, or compare ksg or gaussian"
    )
}

/// Zeroes the last layer of `mlp`, whose parameters are `params`: its output is 0 for every input.
pub(super) fn silence(mlp: &Mlp, params: &mut [f32]) {
    let (_, last) = mlp.weight(mlp.layers() - 1);
    params[last..mlp.parameters()].fill(0.0);
}

/// Trains on the training part and keeps the parameters that score best on the validation part; `None` when no score
/// was finite.
pub(super) fn fit<M: Model>(model: &mut M, data: &Prepared, seeds: &Seeds) -> Option<Fit> {
    let mut params = model.init(&mut seeds.stream("init"));
    let mut adam = Adam::new(AdamConfig::new(LEARNING_RATE), params.len());
    let (mut order_rng, mut loss_rng) = (seeds.stream("order"), seeds.stream("negatives"));
    let (mut x, mut y, mut vx, mut vy) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let looked = &data.validation[..data.validation.len().min(LOOK)];
    gather(&data.x, data.x_width, looked, &mut vx);
    gather(&data.y, data.y_width, looked, &mut vy);
    let batch = BATCH.min(data.train.len());
    let (mut order, mut rows) = (Vec::new(), Vec::new());
    let mut grads = vec![0.0; params.len()];
    let mut best: Option<Fit> = None;
    let mut waited = 0;
    for step in 0..=STEPS {
        if step % EVERY == 0 {
            let score = model.score(&params, &vx, &vy, looked.len(), &mut seeds.stream("validation"));
            if score.is_finite() && best.as_ref().is_none_or(|b| score > b.score) {
                best = Some(Fit { params: params.clone(), score, steps: step });
                waited = 0;
            } else {
                waited += 1;
            }
            if waited == PATIENCE {
                break;
            }
        }
        if order.len() < batch {
            order = rng::permutation(&mut order_rng, data.train.len());
        }
        rows.clear();
        rows.extend(order.drain(order.len() - batch..).map(|i| data.train[i]));
        gather(&data.x, data.x_width, &rows, &mut x);
        gather(&data.y, data.y_width, &rows, &mut y);
        grads.fill(0.0);
        model.loss(&params, &x, &y, batch, &mut loss_rng, &mut grads);
        clip_norm(&mut grads, 5.0);
        // linear decay to zero: the last steps average out the noise of the minibatches
        let rate = LEARNING_RATE * (1.0 - step as f32 / STEPS as f32);
        adam.config.learning_rate = rate;
        adam.step(&mut params, &grads);
        for p in &mut params {
            *p *= 1.0 - rate * M::DECAY;
        }
    }
    best
}
