//! # What it is
//!
//! The Jensen–Shannon lower bound of Deep `InfoMax`, trained and then read on a held-out part; and, from the same critic,
//! values in nats. The paper's estimator for delivered messages.
//!
//! # Definition
//!
//! With a critic T: `jsd` = `E_p`\[ln 2 − sp(−T)\] − `E_q`\[sp(T) − ln 2\], p the pairs, q the product of the margins. At its
//! optimum T = ln p/q, and `jsd` = 2·JSD(p‖q) ∈ \[0, 2 ln 2\]: monotone in the information, but not on its scale. In nats:
//! `jsd-plugin` `E_p`\[T\], an estimate; `jsd-nwj` `E_p`\[T\] + 1 − `E_q`\[e^T\] and `jsd-dv` `E_p`\[T\] − ln `E_q`\[e^T\], lower bounds;
//! `jsd-certified` Ξ at the lower confidence limit of JSD, a lower bound whatever the critic: Ξ = −ln s where the pair
//! P = (1, 0), Q = (s, 1 − s) has that JSD.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`, any widths. Unit `jsd` for `jsd` (the paper's printed value is 2 ln 2 less), else nats.
//!
//! # Parameters
//!
//! None. Critic: two `ReLU` layers of 64 and an embedding of 32 on either side, their dot product; 16 derangements;
//! Adam 2e-3 falling to 0, weight decay 0.5, at most 600 steps of 256 pairs, stopped on the validation episodes, by
//! which the scores are then shifted and scaled once, and held to 3 above the pairs' and to one
//! range below all that they have there.
//!
//! # When it fails
//!
//! Few samples: held-out values fall to 0, which is honest. A critic that never beats T = 0 on the validation part stays
//! T = 0: all values are 0 and have no interval, and it says so. `jsd-nwj` and `jsd-dv` scatter as e^I. The p-value (held-out episodes permuted, critic kept) is
//! that of `jsd` and is printed on all five rows.
//!
//! # Reference
//!
//! Hjelm et al. 2019 (arXiv 1808.06670); Nguyen, Wainwright, Jordan 2010; Donsker, Varadhan 1983; the certified form:
//! arXiv 2510.20644.
//!
//! # Differences from the reference implementation
//!
//! Deep `InfoMax` and its descendants report the value of the last training batch; here training, stopping and
//! reporting have episodes of their own.

use std::f64::consts::LN_2;

use super::critic::{CriticTape, Separable, dot};
use super::fit::{Fit, Model, Training, fit, nothing_learnt, silence, training};
use super::prepare::{Prepared, gather, prepare, tied};
use super::{
    Build, Estimate, Estimator, Interval, Kind, MiError, Protocol, Unit, block_interval, derangements, losses, p_value,
    permuted_rows,
};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{Seeds, Stream};
use crate::schema::Samples;

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "jsd",
    summary: "Jensen-Shannon lower bound with its values in nats; the paper's choice for delivered messages",
    reference: "Hjelm et al. 2019, arXiv 1808.06670",
    value: None,
    build,
};

/// Product samples per pair.
const NEGATIVES: usize = 16;
/// How far held-out scores may lie above those of the validation part: more than ordinary samples ever do.
const BEYOND: f32 = 3.0;

struct Jsd;

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    spec.no_params()?;
    Ok(Box::new(Jsd))
}

/// The critic under training, and its buffers.
struct Trainee {
    critic: Separable,
    tape: CriticTape,
    values: Vec<f32>,
    grad_positive: Vec<f32>,
    grad_negative: Vec<f32>,
}

impl Trainee {
    fn new(data: &Prepared) -> Self {
        Self {
            critic: Separable::deep(data.x_width, data.y_width),
            tape: CriticTape::default(),
            values: Vec::new(),
            grad_positive: Vec::new(),
            grad_negative: Vec::new(),
        }
    }

    /// Corrects the scores in the tape; returns the mean value that they then have.
    fn rescale(&mut self, scale: Scale) -> f64 {
        let CriticTape { positive, negative, .. } = &mut self.tape;
        positive.iter_mut().chain(negative.iter_mut()).for_each(|t| *t = scale.of(*t));
        losses::jsd_values(positive, negative, &mut self.values)
    }
}

impl Model for Trainee {
    const DECAY: f32 = 0.5;

    fn init(&self, rng: &mut Stream) -> Vec<f32> {
        let mut params = Vec::with_capacity(self.critic.parameters());
        self.critic.init(rng, &mut params);
        // T = 0 at the start
        silence(&self.critic.x, &mut params);
        params
    }

    fn loss(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, rng: &mut Stream, grads: &mut [f32]) -> f64 {
        self.critic.scores(params, x, y, n, &derangements(rng, n, NEGATIVES), &mut self.tape);
        self.values.resize(n, 0.0);
        self.grad_positive.resize(n, 0.0);
        self.grad_negative.resize(n * NEGATIVES, 0.0);
        let CriticTape { positive, negative, .. } = &self.tape;
        let loss = losses::jsd(positive, negative, &mut self.values, &mut self.grad_positive, &mut self.grad_negative);
        self.critic.backward(params, x, y, &mut self.tape, &self.grad_positive, &self.grad_negative, grads);
        loss
    }

    fn score(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, rng: &mut Stream) -> f64 {
        self.critic.scores(params, x, y, n, &derangements(rng, n, NEGATIVES), &mut self.tape);
        self.values.resize(n, 0.0);
        losses::jsd_values(&self.tape.positive, &self.tape.negative, &mut self.values)
    }
}

impl Estimator for Jsd {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        let data = prepare(samples, seeds)?;
        let mut model = Trainee::new(&data);
        let diverged = || MiError::Diverged { columns: format!("{} and {}", samples.labels.x, samples.labels.y) };
        let Fit { params, steps, .. } = fit(&mut model, &data, seeds).ok_or_else(diverged)?;
        let (mut x, mut y) = (Vec::new(), Vec::new());
        gather(&data.x, data.x_width, &data.validation, &mut x);
        gather(&data.y, data.y_width, &data.validation, &mut y);
        model.score(&params, &x, &y, data.validation.len(), &mut seeds.stream("validation score"));
        let scale = if steps == 0 { Scale::AS_IS } else { Scale::fit(&model.tape).held_to(&model.tape) };
        let held_out = data.train.len().min(data.test.len());
        gather(&data.x, data.x_width, &data.train[..held_out], &mut x);
        gather(&data.y, data.y_width, &data.train[..held_out], &mut y);
        model.score(&params, &x, &y, held_out, &mut seeds.stream("train score"));
        let trained_on = model.rescale(scale);
        gather(&data.x, data.x_width, &data.test, &mut x);
        gather(&data.y, data.y_width, &data.test, &mut y);
        model.score(&params, &x, &y, data.test.len(), &mut seeds.stream("test score"));
        model.rescale(scale);
        let held = Held::new(&model, &data, scale);
        let p = held.p_value(samples, &model.critic, &params, &data, *protocol, seeds);
        let mut rows = held.rows(samples);
        if rows.iter().any(|r| !r.value.is_finite()) {
            return Err(diverged());
        }
        let mut warnings = data.warnings.clone();
        warnings.extend(tied(samples));
        if trained_on - held.jsd.mean > (4.0 * held.jsd.error).max(0.1) {
            let found = format!("{trained_on:.3} jsd on training and {:.3} on held-out episodes", held.jsd.mean);
            warnings.push(format!("train and held-out disagree: {found}; more episodes would help"));
        }
        if held.jsd.mean > 0.9 * 2.0 * LN_2 {
            warnings.push("near the ceiling of 2 ln 2: the values in nats are too low".to_owned());
        }
        warnings.extend((steps == 0).then(|| nothing_learnt("the critic")));
        for row in &mut rows {
            if steps == 0 {
                (row.interval_low, row.interval_high) = (None, None);
            }
            row.p_value = p;
            row.warnings.clone_from(&warnings);
        }
        Ok(rows)
    }

    fn training(&self, samples: &Samples, seeds: &Seeds) -> Option<Training> {
        let data = prepare(samples, seeds).ok()?;
        training(&mut Trainee::new(&data), "2·JSD", &data, seeds)
    }
}

/// A correction of the critic's scores, T ← slope T + offset: logistic regression on the validation part. Without it
/// `E_p`\[T\] inherits the level at which training happened to stop. Scores far outside those of the validation part are
/// held to them: far from all data the critic extrapolates, and one e^T there was worth −3e10.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Scale {
    slope: f32,
    offset: f32,
    least: f32,
    most: f32,
}

impl Scale {
    const AS_IS: Self = Self { slope: 1.0, offset: 0.0, least: f32::NEG_INFINITY, most: f32::INFINITY };

    fn of(self, t: f32) -> f32 {
        (self.slope * t + self.offset).max(self.least).min(self.most)
    }

    /// The same, held to [`BEYOND`] above the greatest score of a pair in the tape, and to one range under the least.
    fn held_to(self, tape: &CriticTape) -> Self {
        let free = Self { least: f32::NEG_INFINITY, most: f32::INFINITY, ..self };
        let pairs = || tape.positive.iter().map(|&t| free.of(t));
        let least = pairs().chain(tape.negative.iter().map(|&t| free.of(t))).fold(f32::INFINITY, f32::min);
        let most = pairs().fold(f32::NEG_INFINITY, f32::max);
        Self { least: least - (most - least).abs(), most: most + BEYOND, ..self }
    }

    /// Maximises `jsd` on the scores in the tape by Newton's method, held to (1, 0) by the weight of one pair.
    fn fit(tape: &CriticTape) -> Self {
        let pairs = || tape.positive.iter().map(|&t| (t, 1.0, 1.0));
        let others = || tape.negative.iter().map(|&t| (t, 0.0, 1.0 / NEGATIVES as f64));
        let (mut slope, mut offset) = (1.0, 0.0);
        for _ in 0..20 {
            let (mut gradient, mut hessian) = ([slope - 1.0, offset], [1.0, 0.0, 1.0]);
            for (t, label, weight) in pairs().chain(others()) {
                let t = f64::from(t);
                let p = 1.0 / (1.0 + libm::exp(-slope * t - offset));
                let (error, curvature) = (weight * (p - label), weight * p * (1.0 - p));
                gradient = [gradient[0] + error * t, gradient[1] + error];
                hessian = [hessian[0] + curvature * t * t, hessian[1] + curvature * t, hessian[2] + curvature];
            }
            let determinant = hessian[0] * hessian[2] - hessian[1] * hessian[1];
            let step = [
                (hessian[2] * gradient[0] - hessian[1] * gradient[1]) / determinant,
                (hessian[0] * gradient[1] - hessian[1] * gradient[0]) / determinant,
            ];
            (slope, offset) = (slope - step[0].clamp(-0.5, 0.5), offset - step[1].clamp(-0.5, 0.5));
            if step[0].abs() + step[1].abs() < 1e-9 {
                break;
            }
        }
        if slope.is_finite() && offset.is_finite() {
            Self { slope: slope as f32, offset: offset as f32, ..Self::AS_IS }
        } else {
            Self::AS_IS
        }
    }
}

/// The critic's scores on the test part, and what they average to.
struct Held<'a> {
    positive: &'a [f32],
    /// `mean_k` e^T of each sample's negatives.
    exponential: Vec<f64>,
    blocks: &'a [u32],
    jsd: Interval,
    scale: Scale,
}

impl<'a> Held<'a> {
    fn new(model: &'a Trainee, data: &'a Prepared, scale: Scale) -> Self {
        let values: Vec<f64> = model.values.iter().map(|&v| f64::from(v)).collect();
        let mean = |t: &[f32]| t.iter().map(|&t| libm::exp(f64::from(t))).sum::<f64>() / t.len() as f64;
        let exponential = model.tape.negative.chunks_exact(NEGATIVES).map(mean).collect();
        let jsd = block_interval(&values, &data.test_blocks);
        Self { positive: &model.tape.positive, exponential, blocks: &data.test_blocks, jsd, scale }
    }

    fn rows(&self, samples: &Samples) -> Vec<Estimate> {
        let n = self.positive.len();
        let row = |name: &str, unit, kind, of: Interval| {
            let mut row = Estimate::new(name, &samples.labels, of.mean, unit, kind, n);
            (row.interval_low, row.interval_high) = (Some(of.low), Some(of.high));
            row.n_effective = of.n_effective;
            row
        };
        let mean = self.exponential.iter().sum::<f64>() / n as f64;
        let with = |of: &dyn Fn(f64) -> f64| {
            let pairs = self.positive.iter().zip(&self.exponential);
            let values: Vec<f64> = pairs.map(|(&t, &e)| f64::from(t) + of(e)).collect();
            block_interval(&values, self.blocks)
        };
        let limit = |value: f64| certified((value / 2.0).clamp(0.0, LN_2));
        let mut sure = row("jsd-certified", Unit::Nats, Kind::LowerBound, self.jsd);
        sure.value = limit(self.jsd.low);
        (sure.interval_low, sure.interval_high) = (Some(sure.value), Some(limit(self.jsd.high)));
        vec![
            row("jsd", Unit::Jsd, Kind::LowerBound, self.jsd),
            row("jsd-plugin", Unit::Nats, Kind::Estimate, with(&|_| 0.0)),
            row("jsd-nwj", Unit::Nats, Kind::LowerBound, with(&|e| 1.0 - e)),
            // ln E by its tangent at the mean: same value, and the right spread over episodes
            row("jsd-dv", Unit::Nats, Kind::LowerBound, with(&|e| 1.0 - e / mean - libm::log(mean))),
            sure,
        ]
    }

    /// Whole test episodes permuted, critic kept. The product term does not change, so `E_p`\[−sp(−T)\] is compared.
    fn p_value(
        &self,
        samples: &Samples,
        critic: &Separable,
        params: &[f32],
        data: &Prepared,
        protocol: Protocol,
        seeds: &Seeds,
    ) -> Option<f64> {
        // embeddings of every x in the test episodes, of which the permutation picks
        let width = critic.x.outputs();
        let span = |e: u32| samples.starts[e as usize] as u32..samples.starts[e as usize + 1] as u32;
        let all: Vec<u32> = data.test_episodes.iter().flat_map(|&e| span(e)).collect();
        let (mut x, mut y, mut tapes) =
            (Vec::new(), Vec::new(), [crate::nn::Tape::default(), crate::nn::Tape::default()]);
        gather(&data.x, data.x_width, &all, &mut x);
        gather(&data.y, data.y_width, &data.test, &mut y);
        let (px, py) = params.split_at(critic.x.parameters());
        let [tx, ty] = &mut tapes;
        let (ex, ey) = (critic.x.forward(px, &x, all.len(), tx), critic.y.forward(py, &y, data.test.len(), ty));
        let mut place = vec![0u32; samples.x.rows()];
        all.iter().enumerate().for_each(|(i, &r)| place[r as usize] = i as u32);
        let statistic = |rows: &[u32]| {
            let score = |(y, &r): (&[f32], &u32)| {
                let at = place[r as usize] as usize * width;
                f64::from(-losses::softplus(-self.scale.of(dot(y, &ex[at..at + width]))))
            };
            ey.chunks_exact(width).zip(rows).map(score).sum::<f64>()
        };
        let mut rng = seeds.stream("null");
        let null: Vec<f64> = (0..protocol.permutations)
            .map(|_| statistic(&permuted_rows(samples, &data.test_episodes, &data.test, &mut rng)))
            .collect();
        p_value(statistic(&data.test), &null)
    }
}

/// Ξ: the least information, in nats, of any pair of distributions whose Jensen–Shannon divergence is `jsd` ∈ \[0, ln 2\].
pub fn certified(jsd: f64) -> f64 {
    // JSD of P = (1, 0), Q = (s, 1 − s) falls from ln 2 to 0 as s goes from 0 to 1
    let of = |s: f64| {
        let middle = if s > 0.0 { s * libm::log(2.0 * s / (1.0 + s)) } else { 0.0 };
        0.5 * (libm::log(2.0 / (1.0 + s)) + middle + (1.0 - s) * LN_2)
    };
    if jsd <= 0.0 {
        return 0.0;
    }
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..200 {
        let middle = f64::midpoint(low, high);
        if of(middle) > jsd { low = middle } else { high = middle }
    }
    -libm::log(high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::run::tests::{linear_samples, samples_of};
    use crate::rng;

    fn rows(samples: &Samples) -> Vec<Estimate> {
        Jsd.estimate(samples, &Protocol { permutations: 19 }, &Seeds::new(1)).unwrap()
    }

    #[test]
    fn scores_are_held_only_far_outside_what_validation_showed() {
        let mut tape = CriticTape::default();
        (tape.positive, tape.negative) = (vec![0.0, 2.0], vec![-1.0, 5.0]);
        let scale = Scale { slope: 2.0, offset: 1.0, ..Scale::AS_IS }.held_to(&tape);
        assert_eq!(scale, Scale { slope: 2.0, offset: 1.0, least: -7.0, most: 8.0 });
        assert_eq!([-9.0, -2.0, 3.0, 30.0].map(|t| scale.of(t)), [-7.0, -3.0, 7.0, 8.0]);
    }

    #[test]
    fn tails_without_variance_leave_all_five_values_sane() {
        for seed in 0..5 {
            let mut rng = Seeds::new(seed).stream("cauchy");
            let mut cauchy = || vec![rng::normal(&mut rng) / rng::normal(&mut rng)];
            let (x, y): (Vec<_>, Vec<_>) = (0..1000).map(|_| (cauchy(), cauchy())).unzip();
            for row in rows(&samples_of(&x, &y)) {
                assert!((-1e3..1.0).contains(&row.value), "{}: {}", row.estimator, row.value);
            }
        }
    }

    #[test]
    fn a_critic_that_learned_nothing_gives_no_interval_and_says_so() {
        let wide = (0..20).map(|seed| rows(&linear_samples(0.0, 100, 10, seed)));
        for row in wide.into_iter().find(|rows| rows[0].value.abs() < 1e-6).unwrap() {
            assert_eq!((row.interval_low, row.interval_high), (None, None), "{}", row.estimator);
            assert!(row.value.abs() < 1e-6, "{row:?}");
            assert!(row.warnings[0].starts_with("the critic learned nothing that holds on the validation"), "{row:?}");
        }
        assert!(rows(&linear_samples(0.8, 1000, 1, 1)).iter().all(|r| r.interval_low.is_some()));
    }

    #[test]
    fn the_certified_bound_equals_its_published_values() {
        // JSD of the bivariate normal and Ξ(JSD), rounded to four digits
        for (jsd, xi) in [
            (0.0013, 0.0036),
            (0.0120, 0.0348),
            (0.0370, 0.1085),
            (0.1079, 0.3267),
            (0.2143, 0.6880),
            (0.4416, 1.7172),
            (0.5751, 2.7817),
        ] {
            let slope = (certified(jsd + 1e-4) - certified(jsd)) / 1e-4;
            assert!((certified(jsd) - xi).abs() < 6e-5 * (1.0 + slope), "{jsd}: {}", certified(jsd));
        }
        assert_eq!(certified(0.0), 0.0);
        assert!(certified(LN_2) > 30.0);
    }
}
