//! Trains the classifier of the `learned` link: a small perceptron on the pair's relative state, then its temperature.
//!
//! Training runs in `f32` through `nn`, on one thread; the link itself computes in `f64` (see `link::Classifier`), and
//! every figure that is reported is the link's.

use super::Observations;
use crate::link::{Classifier, Dense, FEATURES};
use crate::nn::{Activation, Adam, AdamConfig, Mlp, Tape, clip_norm};
use crate::rng::{Seeds, permutation};

/// Width of the two hidden layers.
const HIDDEN: usize = 16;
/// Most messages to train on, and to stop by: a random part of them, where there are more.
const MOST: [usize; 2] = [200_000, 50_000];
const BATCH: usize = 512;
/// Passes over the training messages, at most.
const EPOCHS: usize = 60;
/// Passes without a better validation loss after which training ends.
const PATIENCE: usize = 12;
/// Learning rate at the start; it falls linearly to a fiftieth.
const RATE: f32 = 0.01;
/// The temperatures that are tried lie within a factor of this of 1.
const TEMPERATURES: f64 = 20.0;

/// Messages as the perceptron takes them.
struct Set {
    x: Vec<f32>,
    lost: Vec<bool>,
}

/// Trains on the messages of the `train` episodes, stops by those of the `validation` episodes and calibrates on them.
/// `progress` is told the share that is done.
pub(super) fn train(
    observations: &Observations,
    states: &[[f64; FEATURES.len()]],
    [train, validation]: [&[usize]; 2],
    seeds: &Seeds,
    progress: &dyn Fn(f64),
) -> Classifier {
    let messages = |episodes: &[usize], most: usize, name: &str| -> Vec<usize> {
        let all: Vec<usize> = episodes.iter().flat_map(|&e| observations.episode(e)).collect();
        let order = permutation(&mut seeds.stream(name), all.len());
        order.into_iter().take(most).map(|i| all[i]).collect()
    };
    let [train, validation] = [messages(train, MOST[0], "train"), messages(validation, MOST[1], "validation")];
    let (mean, scale) = moments(&train, states);
    let set = |messages: &[usize]| Set {
        x: messages.iter().flat_map(|&m| standardised(&states[m], &mean, &scale)).collect(),
        lost: messages.iter().map(|&m| observations.lost[m]).collect(),
    };
    let (train, held) = (set(&train), set(&validation));
    let mlp = Mlp::new(&[FEATURES.len(), HIDDEN, HIDDEN, 1], Activation::Relu, Activation::Identity);
    let params = descend(&mlp, &train, &held, seeds, progress);
    let layers = (0..mlp.layers()).map(|layer| {
        let ([outputs, inputs], at) = mlp.weight(layer);
        let numbers = |from: usize, n: usize| params[from..from + n].iter().map(|&w| f64::from(w)).collect();
        Dense {
            weight: (0..outputs).map(|o| numbers(at + o * inputs, inputs)).collect(),
            bias: numbers(at + outputs * inputs, outputs),
        }
    });
    let mut classifier = Classifier {
        features: FEATURES.map(ToOwned::to_owned).to_vec(),
        body_fields: observations.body_fields.clone(),
        mean: mean.to_vec(),
        scale: scale.to_vec(),
        layers: layers.collect(),
        temperature: 1.0,
    };
    let logits: Vec<f64> = validation.iter().map(|&m| classifier.logit(&states[m])).collect();
    classifier.temperature = temperature(&logits, &held.lost);
    classifier
}

/// Mean and one over the standard deviation of each feature; 0 for one that does not vary.
fn moments(messages: &[usize], states: &[[f64; FEATURES.len()]]) -> ([f64; FEATURES.len()], [f64; FEATURES.len()]) {
    let n = messages.len() as f64;
    let mean: [f64; FEATURES.len()] = std::array::from_fn(|f| messages.iter().map(|&m| states[m][f]).sum::<f64>() / n);
    let scale = std::array::from_fn(|f| {
        let variance = messages.iter().map(|&m| (states[m][f] - mean[f]).powi(2)).sum::<f64>() / n;
        if variance > 1e-18 { 1.0 / variance.sqrt() } else { 0.0 }
    });
    (mean, scale)
}

fn standardised(
    state: &[f64; FEATURES.len()],
    mean: &[f64; FEATURES.len()],
    scale: &[f64; FEATURES.len()],
) -> [f32; FEATURES.len()] {
    std::array::from_fn(|f| ((state[f] - mean[f]) * scale[f]) as f32)
}

/// Loss of a logit, −ln P(what happened), nats, and its derivative.
fn log_loss(logit: f64, lost: bool) -> (f64, f64) {
    let p = 1.0 / (1.0 + (-logit).exp());
    let softplus = (-logit.abs()).exp().ln_1p() + logit.max(0.0);
    if lost { (softplus - logit, p - 1.0) } else { (softplus, p) }
}

/// Minimises the mean log loss by Adam; gives the parameters of the pass with the best validation loss.
fn descend(mlp: &Mlp, train: &Set, held: &Set, seeds: &Seeds, progress: &dyn Fn(f64)) -> Vec<f32> {
    let mut params = Vec::new();
    mlp.init(&mut seeds.stream("init"), &mut params);
    let mut adam = Adam::new(AdamConfig::new(RATE), params.len());
    let (mut tape, mut grads) = (Tape::default(), vec![0.0; params.len()]);
    let (mut x, mut grad) = (Vec::new(), Vec::new());
    let mut best = (f64::INFINITY, params.clone(), 0);
    for epoch in 0..EPOCHS {
        progress(epoch as f64 / EPOCHS as f64);
        adam.config.learning_rate = RATE * (1.0 - 0.98 * epoch as f32 / EPOCHS as f32);
        let order = permutation(&mut seeds.indexed_stream("epoch", epoch as u64), train.lost.len());
        for batch in order.chunks(BATCH) {
            x.clear();
            for &m in batch {
                x.extend_from_slice(&train.x[m * FEATURES.len()..(m + 1) * FEATURES.len()]);
            }
            let logits = mlp.forward(&params, &x, batch.len(), &mut tape);
            grad.clear();
            let slope = |(&m, &logit): (&usize, &f32)| log_loss(f64::from(logit), train.lost[m]).1 / batch.len() as f64;
            grad.extend(batch.iter().zip(logits).map(|pair| slope(pair) as f32));
            grads.fill(0.0);
            mlp.backward(&params, &x, &mut tape, &grad, &mut grads, None);
            clip_norm(&mut grads, 5.0);
            adam.step(&mut params, &grads);
        }
        let logits = mlp.forward(&params, &held.x, held.lost.len(), &mut tape);
        let loss: f64 = logits.iter().zip(&held.lost).map(|(&logit, &lost)| log_loss(f64::from(logit), lost).0).sum();
        if loss < best.0 {
            best = (loss, params.clone(), epoch);
        } else if epoch - best.2 >= PATIENCE {
            break;
        }
    }
    best.1
}

/// The temperature with the least log loss (Guo et al. 2017), by golden section over its logarithm: the loss is convex in
/// one over the temperature.
fn temperature(logits: &[f64], lost: &[bool]) -> f64 {
    let loss = |log_t: f64| -> f64 {
        let t = log_t.exp();
        logits.iter().zip(lost).map(|(&logit, &lost)| log_loss(logit / t, lost).0).sum()
    };
    let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
    let (mut low, mut high) = (-TEMPERATURES.ln(), TEMPERATURES.ln());
    for _ in 0..60 {
        let (a, b) = (high - golden * (high - low), low + golden * (high - low));
        if loss(a) <= loss(b) { high = b } else { low = a }
    }
    (0.5 * (low + high)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{bernoulli, normal, uniform};

    #[test]
    fn the_log_loss_is_the_textbooks() {
        let sigmoid = |z: f64| 1.0 / (1.0 + (-z).exp());
        for z in [-3.0, 0.0, 0.7, 40.0] {
            assert!((log_loss(z, false).0 + (1.0 - sigmoid(z)).max(1e-300).ln()).abs() < 1e-9 || z > 30.0);
            assert!((log_loss(z, true).0 + sigmoid(z).ln()).abs() < 1e-12, "{z}");
            let slope = (log_loss(z + 1e-6, true).0 - log_loss(z - 1e-6, true).0) / 2e-6;
            assert!((slope - log_loss(z, true).1).abs() < 1e-6, "{z}");
        }
        assert_eq!(log_loss(800.0, false).0, 800.0);
    }

    #[test]
    fn the_temperature_undoes_a_scale() {
        let mut rng = Seeds::new(1).stream("t");
        let (mut logits, mut lost) = (Vec::new(), Vec::new());
        for _ in 0..40_000 {
            let z = 2.0 * normal(&mut rng);
            lost.push(bernoulli(&mut rng, 1.0 / (1.0 + (-z).exp())));
            logits.push(3.0 * z);
        }
        let found = temperature(&logits, &lost);
        assert!((found - 3.0).abs() < 0.1, "{found}"); // standard error about 0.02
        let certain: Vec<bool> = logits.iter().map(|&z| z > 0.0).collect();
        assert!(temperature(&logits, &certain) < 0.051, "the lower bound, when the classes are apart");
    }

    #[test]
    fn a_known_loss_probability_is_learned() {
        // loss probability 0.1 within distance 1, 0.7 beyond: nothing does better than these
        let mut rng = Seeds::new(3).stream("pairs");
        let episodes = 60;
        let mut observations = Observations::of_trace(
            &crate::link::Trace {
                agents: vec!["a".to_owned(), "b".to_owned()],
                starts: (0..=episodes).map(|e| e * 100).collect(),
                bits: vec![true; episodes * 200],
                sha256: String::new(),
            },
            std::path::Path::new("t"),
        );
        let mut states = Vec::new();
        for lost in &mut observations.lost {
            let [dx, dy] = [uniform(&mut rng, -1.5, 1.5), uniform(&mut rng, -1.5, 1.5)];
            let distance = (dx * dx + dy * dy).sqrt();
            states.push([dx, dy, distance, 0.0, 0.0]);
            *lost = bernoulli(&mut rng, if distance > 1.0 { 0.7 } else { 0.1 });
        }
        let train: Vec<usize> = (0..45).collect();
        let held: Vec<usize> = (45..60).collect();
        let classifier = super::train(&observations, &states, [&train, &held], &Seeds::new(1), &|_| ());
        let at = |d: f64| classifier.probability(classifier.logit(&[d, 0.0, d, 0.0, 0.0]));
        for (distance, p) in [(0.3, 0.1), (0.8, 0.1), (1.2, 0.7), (1.45, 0.7)] {
            assert!((at(distance) - p).abs() < 0.09, "at {distance}: {}", at(distance));
        }
        assert_eq!(classifier.scale[3..], [0.0, 0.0], "what does not vary is left out");
    }
}
