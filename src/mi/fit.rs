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

/// A network under training, looked at again and again.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Training {
    /// What the scores are, with their unit.
    pub score: &'static str,
    /// Steps, and the scores of the training and of the validation part after them.
    pub looks: Vec<(usize, f64, f64)>,
    /// Steps after which the network was best on the validation part: this is the one that is used.
    pub chosen: usize,
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
    looked_at(model, data, seeds, &mut |_, _, _, _| ())
}

/// What [`fit`] does, looked at: the same training, since a score leaves the model as it was.
pub(super) fn training<M: Model>(
    model: &mut M,
    score: &'static str,
    data: &Prepared,
    seeds: &Seeds,
) -> Option<Training> {
    let mut out = Training { score, ..Training::default() };
    let (mut x, mut y) = (Vec::new(), Vec::new());
    // as many rows as of the validation part: the scores of some models depend on how many there are
    let looked = &data.train[..data.train.len().min(data.validation.len()).min(LOOK)];
    gather(&data.x, data.x_width, looked, &mut x);
    gather(&data.y, data.y_width, looked, &mut y);
    let mut look = |model: &mut M, params: &[f32], step: usize, validation: f64| {
        let train = model.score(params, &x, &y, looked.len(), &mut seeds.stream("validation"));
        out.looks.push((step, train, validation));
    };
    out.chosen = looked_at(model, data, seeds, &mut look)?.steps;
    Some(out)
}

/// What is told at every look: the model, its parameters, the step and the score of the validation part.
type Look<'a, M> = &'a mut dyn FnMut(&mut M, &[f32], usize, f64);

fn looked_at<M: Model>(model: &mut M, data: &Prepared, seeds: &Seeds, look: Look<'_, M>) -> Option<Fit> {
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
            look(model, &params, step, score);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::prepare::prepare;
    use crate::mi::run::tests::linear_samples;

    /// y ≈ w x by least squares.
    struct Line;

    impl Model for Line {
        const DECAY: f32 = 0.0;

        fn init(&self, _: &mut Stream) -> Vec<f32> {
            vec![0.0]
        }

        fn loss(&mut self, w: &[f32], x: &[f32], y: &[f32], n: usize, _: &mut Stream, grads: &mut [f32]) -> f64 {
            let errors = || x.iter().zip(y).map(|(x, y)| (x, w[0] * x - y));
            grads[0] += errors().map(|(x, e)| 2.0 * e * x).sum::<f32>() / n as f32;
            errors().map(|(_, e)| f64::from(e * e)).sum::<f64>() / n as f64
        }

        fn score(&mut self, w: &[f32], x: &[f32], y: &[f32], n: usize, rng: &mut Stream) -> f64 {
            -self.loss(w, x, y, n, rng, &mut [0.0])
        }
    }

    #[test]
    fn looking_at_the_training_changes_nothing_and_the_chosen_look_is_the_best() {
        let seeds = Seeds::new(3);
        let data = prepare(&linear_samples(0.4, 2000, 1, 4), &seeds).unwrap();
        let plain = fit(&mut Line, &data, &seeds).unwrap();
        let watched = training(&mut Line, "score", &data, &seeds).unwrap();
        assert_eq!((watched.chosen, watched.looks[0].0), (plain.steps, 0));
        let best = watched.looks.iter().max_by(|a, b| a.2.total_cmp(&b.2)).unwrap();
        assert_eq!((best.0, best.2), (plain.steps, plain.score));
        // 1 − ρ² of the variance stays
        assert!((plain.params[0] - 0.4).abs() < 0.1 && (best.1 + 0.84).abs() < 0.12, "{best:?}");
    }
}
