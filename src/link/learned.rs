//! # What it is
//! A learned link prior: a small classifier of the pair's relative state, calibrated by a temperature.
//!
//! # Definition
//! ι^{ji} ~ Bernoulli(1 − σ(f(s^{ij}) / T)), independent given the states; f is a perceptron with `ReLU` on the
//! standardised features, σ the logistic function, T the temperature.
//!
//! # Shapes and units
//! Features per ordered pair, receiver minus sender: `dx`, `dy` and `distance` in world units, `dvx`, `dvy` in world
//! units per second; standardised as `(feature − mean) · scale`. Weights are `[outputs, inputs]`, the last layer has one
//! output, the logit of a loss. All arithmetic is `f64` in a fixed order with + − × ÷ √ and `libm::exp`, never a fused or
//! vectorised product: the same bits on every x86-64, as recordings promise.
//!
//! # Parameters
//! `features`, `body_fields` (the fields of a communicator's state in the data it was fitted on), `mean`, `scale`,
//! `layers` (up to 8, up to 512 wide), `temperature` in [1e-3, 1e3]. `ccmarl fit-link --model learned` writes them;
//! use them with `file:link.json`.
//!
//! # When it fails
//! The scenario's agents have other state fields than those of the data. Beyond the states of the data it extrapolates.
//! Losses in bursts are not in it: see `markov`.
//!
//! # Reference
//! The learned binary classifier `f_θ(s^{ij})` of arXiv 2512.03528, Eq. 1; temperature: Guo et al. 2017.
//!
//! # Differences from the reference implementation
//! The paper names such a prior and gives no network.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::{Body, Build, Link, LinkEpisode, Setting, for_each_link};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{Seeds, Stream, bernoulli};

/// The link's line in the registry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "learned",
    summary: "a calibrated classifier of the pair's relative state, as `ccmarl fit-link` writes it",
    reference: "arXiv 2512.03528, Eq. 1",
    value: None,
    build,
};

/// Names of the features of an ordered pair.
pub const FEATURES: [&str; 5] = ["dx", "dy", "distance", "dvx", "dvy"];

const MAX_LAYERS: usize = 8;
const MAX_WIDTH: usize = 512;

/// The relative state of an ordered pair, as [`FEATURES`] names it: receiver minus sender.
pub fn features(sender: &Body, receiver: &Body) -> [f64; FEATURES.len()] {
    let [dx, dy, dvx, dvy] = std::array::from_fn(|i| receiver[i] - sender[i]);
    [dx, dy, (dx * dx + dy * dy).sqrt(), dvx, dvy]
}

/// One layer: `weight` `[outputs, inputs]`, `bias` `[outputs]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dense {
    /// Weights, one row per output.
    pub weight: Vec<Vec<f64>>,
    /// Biases.
    pub bias: Vec<f64>,
}

/// The classifier: everything that the link needs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Classifier {
    /// Names of its features: [`FEATURES`].
    pub features: Vec<String>,
    /// Fields of a communicator's state in the data.
    pub body_fields: Vec<String>,
    /// Mean of each feature.
    pub mean: Vec<f64>,
    /// One over the standard deviation of each feature.
    pub scale: Vec<f64>,
    /// Layers, `ReLU` between them; the last has one output.
    pub layers: Vec<Dense>,
    /// Divides the logit.
    pub temperature: f64,
}

/// Memory for a pass, reused.
#[derive(Clone, Debug, Default)]
struct Scratch {
    layer: Vec<f64>,
    next: Vec<f64>,
}

impl Classifier {
    /// The logit of a loss before the temperature.
    pub fn logit(&self, features: &[f64; FEATURES.len()]) -> f64 {
        self.pass(features, &mut Scratch::default())
    }

    fn pass(&self, features: &[f64; FEATURES.len()], scratch: &mut Scratch) -> f64 {
        let Scratch { layer, next } = scratch;
        layer.clear();
        layer.extend(features.iter().zip(&self.mean).zip(&self.scale).map(|((f, mean), scale)| (f - mean) * scale));
        for (depth, dense) in self.layers.iter().enumerate() {
            let last = depth + 1 == self.layers.len();
            next.clear();
            next.extend(dense.weight.iter().zip(&dense.bias).map(|(row, &bias)| {
                let mut sum = bias;
                for (weight, input) in row.iter().zip(&*layer) {
                    sum += weight * input;
                }
                if last { sum } else { sum.max(0.0) }
            }));
            std::mem::swap(layer, next);
        }
        layer[0]
    }

    /// Probability that the message is lost, from a logit.
    pub fn probability(&self, logit: f64) -> f64 {
        1.0 / (1.0 + libm::exp(-logit / self.temperature))
    }

    fn check(&self, spec: &Spec) -> Result<(), RegistryError> {
        if self.features != FEATURES {
            let message =
                format!("features: this program computes {}, found {}", FEATURES.join(", "), self.features.join(", "));
            return Err(spec.invalid(message));
        }
        let mut inputs = FEATURES.len();
        let length = |what: String, expected: usize, found: usize| {
            if expected == found {
                Ok(())
            } else {
                Err(spec.invalid(format!("{what}: expected {expected} values, found {found}")))
            }
        };
        length("mean".to_owned(), inputs, self.mean.len())?;
        length("scale".to_owned(), inputs, self.scale.len())?;
        if !(1..=MAX_LAYERS).contains(&self.layers.len()) {
            return Err(spec.invalid(format!("expected 1 to {MAX_LAYERS} layers, found {}", self.layers.len())));
        }
        for (i, dense) in self.layers.iter().enumerate() {
            let outputs = dense.weight.len();
            if !(1..=MAX_WIDTH).contains(&outputs) || (i + 1 == self.layers.len() && outputs != 1) {
                let wanted = if i + 1 == self.layers.len() {
                    "1 output".to_owned()
                } else {
                    format!("1 to {MAX_WIDTH} outputs")
                };
                return Err(spec.invalid(format!("layer {i}: expected {wanted}, found {outputs}")));
            }
            length(format!("layer {i}, bias"), outputs, dense.bias.len())?;
            for (row, weights) in dense.weight.iter().enumerate() {
                length(format!("layer {i}, weights of output {row}"), inputs, weights.len())?;
            }
            inputs = outputs;
        }
        let numbers = self.mean.iter().chain(&self.scale);
        let weights = self.layers.iter().flat_map(|dense| dense.weight.iter().flatten().chain(&dense.bias));
        if let Some(bad) = numbers.chain(weights).find(|v| v.is_nan() || v.abs() > 1e9) {
            return Err(spec.invalid(format!("expected numbers within ±1e9, found {bad}")));
        }
        spec.in_range("temperature", self.temperature, 1e-3, 1e3)
    }
}

struct Learned(Arc<Classifier>);

fn build(spec: &Spec, setting: &Setting) -> Result<Box<dyn Link>, RegistryError> {
    if spec.params.is_empty() {
        return Err(spec.invalid("it needs its weights: `ccmarl fit-link --model learned --out link.json` writes them, and file:link.json uses them"));
    }
    let classifier: Classifier = spec.params()?;
    classifier.check(spec)?;
    if !setting.body_fields.is_empty() && classifier.body_fields != setting.body_fields {
        let (own, found) = (classifier.body_fields.join(" "), setting.body_fields.join(" "));
        return Err(spec.invalid(format!(
            "it was fitted on agents with the state {own}, the scenario's have {found}: fit it on a store of this scenario"
        )));
    }
    Ok(Box::new(Learned(Arc::new(classifier))))
}

impl Link for Learned {
    fn parameters(&self) -> Map<String, Value> {
        crate::registry::resolved(ENTRY.name, &*self.0)
    }

    fn start(&self, n: usize, _episode: u64, seeds: &Seeds) -> Box<dyn LinkEpisode> {
        let (classifier, streams) = (Arc::clone(&self.0), super::streams(n, seeds));
        Box::new(Episode { classifier, n, streams, scratch: Scratch::default() })
    }
}

struct Episode {
    classifier: Arc<Classifier>,
    n: usize,
    streams: Vec<Stream>,
    scratch: Scratch,
}

impl LinkEpisode for Episode {
    fn emit(&mut self, bodies: &[Body], bits: &mut [bool]) {
        let n = self.n;
        bits.fill(true);
        for_each_link(n, |s, r, link| {
            let logit = self.classifier.pass(&features(&bodies[s], &bodies[r]), &mut self.scratch);
            bits[s * n + r] = !bernoulli(&mut self.streams[link], self.classifier.probability(logit));
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::{emit_rows, test_setting};

    /// Loses beyond distance 1.5: logit = 8 relu(distance − 1.5) − 8 relu(1.5 − distance), over temperature 0.1.
    fn spec() -> Spec {
        let dense = |weight: Vec<Vec<f64>>, bias: Vec<f64>| Dense { weight, bias };
        let classifier = Classifier {
            features: FEATURES.map(ToOwned::to_owned).to_vec(),
            body_fields: ["x", "y", "vx", "vy"].map(ToOwned::to_owned).to_vec(),
            mean: vec![0.0, 0.0, 1.0, 0.0, 0.0],
            scale: vec![1.0, 1.0, 2.0, 1.0, 1.0],
            layers: vec![
                dense(vec![vec![0.0, 0.0, 0.5, 0.0, 0.0], vec![0.0, 0.0, -0.5, 0.0, 0.0]], vec![-0.5, 0.5]),
                dense(vec![vec![8.0, -8.0]], vec![0.0]),
            ],
            temperature: 0.1,
        };
        serde_json::from_value(Value::Object(crate::registry::resolved("learned", &classifier))).unwrap()
    }

    #[test]
    fn the_classifier_is_what_its_weights_say() {
        let classifier: Classifier = spec().params().unwrap();
        let at = |distance: f64| classifier.logit(&features(&[1.0, 1.0, 0.0, 0.0], &[1.0, 1.0 + distance, 0.0, 0.0]));
        assert_eq!([at(1.0), at(1.5), at(2.0)], [-4.0, 0.0, 4.0]);
        assert_eq!(classifier.probability(0.0), 0.5);
        assert!((classifier.probability(-0.1) - 0.268_941_421_369_995_1).abs() < 1e-15);
        assert_eq!(features(&[0.0, 1.0, 2.0, 3.0], &[3.0, 5.0, 1.0, 1.0]), [3.0, 4.0, 5.0, -1.0, -2.0]);
    }

    #[test]
    fn bits_follow_the_probabilities() {
        let link = build(&spec(), &test_setting(0.25)).unwrap();
        let rows = emit_rows(&*link, 4, 2000, 0);
        assert!(rows.iter().all(|b| b[1] && !b[2] && !b[3]), "distances 1, 2 and 3");
        assert_eq!(rows, emit_rows(&*link, 4, 2000, 0));
    }

    #[test]
    fn weights_that_do_not_fit_are_refused() {
        let error = |spec: Spec| build(&spec, &test_setting(1.0)).err().unwrap().to_string();
        assert!(error(Spec::new("learned")).contains("file:link.json uses them"));
        assert_eq!(error(spec().with("mean", vec![0.0; 4])), "learned: mean: expected 5 values, found 4");
        assert_eq!(error(spec().with("temperature", 0)), "learned: temperature must be in [0.001, 1000], found 0");
        assert_eq!(
            error(spec().with("scale", vec![1e12; 5])),
            "learned: expected numbers within ±1e9, found 1000000000000"
        );
        let features = error(spec().with("features", vec!["dz"]));
        assert!(features.ends_with("computes dx, dy, distance, dvx, dvy, found dz"), "{features}");
        let wide = serde_json::json!([{"weight": [[1, 1, 1, 1, 1], [1, 1, 1, 1, 1]], "bias": [0, 0]}]);
        assert_eq!(error(spec().with("layers", wide)), "learned: layer 0: expected 1 output, found 2");
        let ragged = serde_json::json!([{"weight": [[1, 1]], "bias": [0]}]);
        assert_eq!(
            error(spec().with("layers", ragged)),
            "learned: layer 0, weights of output 0: expected 5 values, found 2"
        );
        let fields = ["x", "y", "vx", "vy", "c0", "c1"].map(ToOwned::to_owned).to_vec();
        let setting = Setting { body_fields: fields, ..test_setting(1.0) };
        assert_eq!(
            build(&spec(), &setting).err().unwrap().to_string(),
            "learned: it was fitted on agents with the state x y vx vy, the scenario's have x y vx vy c0 c1: fit it on a store of this scenario"
        );
    }
}
