//! # What it is
//!
//! vCLUB, the contrastive log-ratio upper bound: how much likelier a fitted q(y|x) finds y beside its own x than beside
//! another. The paper's estimator for lost messages.
//!
//! # Definition
//!
//! `club` = `E_p`\[ln q(y|x)\] − `E_q`\[ln q(y|x)\], the second mean over the product of the margins; q is a diagonal Gaussian
//! whose mean and log-variance are perceptrons. `club-l1out` = E\[ln `q(y_i|x_i)` − ln mean_{j≠i} `q(y_i|x_j)`\], the
//! leave-one-out bound. `club-fit` = `E_p`\[ln q(y|x) − ln r(y)\], r the Gaussian margin of the training part: how good q is.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`; all three in nats, on held-out episodes.
//!
//! # Parameters
//!
//! None. Networks: two `ReLU` layers of 64, log-variance within ±10; Adam 2e-3 falling to 0, weight decay 2.0, at most 600 steps of 256
//! pairs, stopped on the validation episodes.
//!
//! # When it fails
//!
//! It is loose: ρ²/(1 − ρ²) for normals with the exact q, 3.1 times the information at ρ = 0.75. With a poor q it is no
//! upper bound at all: when q is worse than r (`club-fit` < 0), no better than r, or another row's lower bound lies above it,
//! it says so. A q that never beats r on the validation part stays r: all values are 0, and have no interval.
//!
//! # Reference
//!
//! Cheng et al. 2020, arXiv 2006.12013; leave-one-out: Poole et al. 2019, arXiv 1905.06922.
//!
//! # Differences from the reference implementation
//!
//! Held-out value; the mean over the product is taken over all other test rows in closed form instead of one
//! permutation; the log-variance is not confined to (−1, 1). The leave-one-out mean runs over at most 512 others.

use super::conditional::{ConditionalTape, GaussianConditional};
use super::fit::{Fit, Model, Training, fit, nothing_learnt, silence, training};
use super::prepare::{Prepared, gather, prepare, tied};
use super::{
    Build, Estimate, Estimator, Kind, MiError, Protocol, Unit, block_interval, losses, p_value, permuted_rows,
};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::{self, Seeds, Stream};
use crate::schema::Samples;

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "club",
    summary: "contrastive log-ratio upper bound (vCLUB) with leave-one-out beside it; the paper's choice for lost messages",
    reference: "Cheng et al. 2020, arXiv 2006.12013",
    value: None,
    build,
};

/// Others behind the leave-one-out mean.
const OTHERS: usize = 512;

struct Club;

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    spec.no_params()?;
    Ok(Box::new(Club))
}

/// q under training, and its buffers.
struct Trainee {
    q: GaussianConditional,
    tape: ConditionalTape,
    grad_mu: Vec<f32>,
    grad_logvar: Vec<f32>,
}

impl Trainee {
    fn new(data: &Prepared) -> Self {
        Self {
            q: GaussianConditional::deep(data.x_width, data.y_width),
            tape: ConditionalTape::default(),
            grad_mu: Vec::new(),
            grad_logvar: Vec::new(),
        }
    }
}

/// The training of q.
pub(super) fn q_training(samples: &Samples, seeds: &Seeds) -> Option<Training> {
    let data = prepare(samples, seeds).ok()?;
    training(&mut Trainee::new(&data), "mean ln q, nats", &data, seeds)
}

impl Model for Trainee {
    const DECAY: f32 = 2.0;

    fn init(&self, rng: &mut Stream) -> Vec<f32> {
        let mut params = Vec::with_capacity(self.q.parameters());
        self.q.init(rng, &mut params);
        // q = r at the start
        let (mu, logvar) = params.split_at_mut(self.q.mu.parameters());
        silence(&self.q.mu, mu);
        silence(&self.q.logvar, logvar);
        params
    }

    fn loss(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, _: &mut Stream, grads: &mut [f32]) -> f64 {
        self.q.forward(params, x, n, &mut self.tape);
        self.grad_mu.resize(y.len(), 0.0);
        self.grad_logvar.resize(y.len(), 0.0);
        let (mu, logvar) = (self.tape.mu(), self.tape.logvar());
        let loss = losses::nll(mu, logvar, y, n, &mut self.grad_mu, &mut self.grad_logvar);
        self.q.backward(params, x, &mut self.tape, &self.grad_mu, &self.grad_logvar, grads);
        loss
    }

    fn score(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, _: &mut Stream) -> f64 {
        self.q.forward(params, x, n, &mut self.tape);
        let mut values = vec![0.0; n];
        losses::log_density(self.tape.mu(), self.tape.logvar(), y, &mut values);
        values.iter().sum::<f64>() / n as f64
    }
}

impl Estimator for Club {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        let fitted = Fitted::new(samples, seeds)?;
        let p = fitted.held.p_value(samples, &fitted.data, *protocol, seeds);
        let bound = fitted.held.contributions(&fitted.data.test);
        Ok(vec![
            fitted.row("club", Kind::UpperBound, &bound, p)?,
            fitted.row("club-l1out", Kind::UpperBound, &fitted.held.leave_one_out(seeds), p)?,
            fitted.row("club-fit", Kind::Estimate, &fitted.held.gain(&fitted.data), p)?,
        ])
    }

    fn training(&self, samples: &Samples, seeds: &Seeds) -> Option<Training> {
        q_training(samples, seeds)
    }
}

/// q fitted to the training part, on the held-out part.
pub(super) struct Fitted<'a> {
    samples: &'a Samples,
    pub(super) data: Prepared,
    pub(super) held: Held,
    warnings: Vec<String>,
    /// Whether q is another than the margin.
    learnt: bool,
}

impl<'a> Fitted<'a> {
    pub(super) fn new(samples: &'a Samples, seeds: &Seeds) -> Result<Self, MiError> {
        let data = prepare(samples, seeds)?;
        let mut model = Trainee::new(&data);
        let Fit { params, steps, .. } = fit(&mut model, &data, seeds).ok_or_else(|| diverged(samples))?;
        let held = Held::new(&mut model, &params, samples, &data);
        let fit_gain = block_interval(&held.gain(&data), &data.test_blocks);
        let mut warnings = data.warnings.clone();
        warnings.extend(tied(samples));
        if fit_gain.mean < -0.01 && fit_gain.high < 0.0 {
            warnings.push(format!("poor q: {:.3} nats worse than the margin on held-out episodes", -fit_gain.mean));
        }
        let learnt = steps > 0;
        if !learnt {
            warnings.push(nothing_learnt("q"));
        } else if fit_gain.low <= 0.0 {
            warnings.push(
                "q fits no better than the margin: an upper bound only if there is no dependence that a normal q cannot \
                 show; compare ksg"
                    .to_owned(),
            );
        }
        Ok(Self { samples, data, held, warnings, learnt })
    }

    /// A row from the contributions of the test samples.
    pub(super) fn row(
        &self,
        name: &str,
        kind: Kind,
        contributions: &[f64],
        p: Option<f64>,
    ) -> Result<Estimate, MiError> {
        let of = block_interval(contributions, &self.data.test_blocks);
        if !of.mean.is_finite() {
            return Err(diverged(self.samples));
        }
        let n = self.data.test.len();
        let mut row = Estimate::new(name, &self.samples.labels, of.mean, Unit::Nats, kind, n);
        if self.learnt {
            (row.interval_low, row.interval_high) = (Some(of.low), Some(of.high));
        }
        row.n_effective = of.n_effective;
        row.p_value = p;
        row.warnings.clone_from(&self.warnings);
        Ok(row)
    }
}

fn diverged(samples: &Samples) -> MiError {
    MiError::Diverged { columns: format!("{} and {}", samples.labels.x, samples.labels.y) }
}

/// q on every row of the test episodes, and the test part's y.
pub(super) struct Held {
    /// Where a row stands below.
    place: Vec<u32>,
    mu: Vec<f32>,
    logvar: Vec<f32>,
    /// Mean over the test part's y of −½ (y − μ)²/σ², per row of the test episodes.
    product: Vec<f64>,
    y: Vec<f32>,
    test: Vec<u32>,
    width: usize,
}

impl Held {
    fn new(model: &mut Trainee, params: &[f32], samples: &Samples, data: &Prepared) -> Self {
        let span = |e: u32| samples.starts[e as usize] as u32..samples.starts[e as usize + 1] as u32;
        let all: Vec<u32> = data.test_episodes.iter().flat_map(|&e| span(e)).collect();
        let (mut x, mut y) = (Vec::new(), Vec::new());
        gather(&data.x, data.x_width, &all, &mut x);
        gather(&data.y, data.y_width, &data.test, &mut y);
        model.q.forward(params, &x, all.len(), &mut model.tape);
        let mut place = vec![0; samples.x.rows()];
        all.iter().enumerate().for_each(|(i, &r)| place[r as usize] = i as u32);
        let (width, n) = (data.y_width, data.test.len() as f64);
        // Σ_j (y_j − μ)² = n (variance + (mean − μ)²)
        let column = |c: usize| y.iter().skip(c).step_by(width).map(|&v| f64::from(v));
        let means: Vec<f64> = (0..width).map(|c| column(c).sum::<f64>() / n).collect();
        let spreads: Vec<f64> =
            (0..width).map(|c| column(c).map(|v| (v - means[c]) * (v - means[c])).sum::<f64>() / n).collect();
        let (mu, logvar) = (model.tape.mu().to_vec(), model.tape.logvar().to_vec());
        let term = |i: usize| {
            let (c, mu) = (i % width, f64::from(mu[i]));
            -0.5 * libm::exp(-f64::from(logvar[i])) * (spreads[c] + (means[c] - mu) * (means[c] - mu))
        };
        let product = (0..all.len()).map(|r| (r * width..(r + 1) * width).map(term).sum()).collect();
        Self { place, mu, logvar, product, y, test: data.test.clone(), width }
    }

    fn row(&self, row: u32) -> std::ops::Range<usize> {
        let at = self.place[row as usize] as usize * self.width;
        at..at + self.width
    }

    /// vCLUB per test sample when row `rows[i]`'s x stands beside `y_i`.
    fn contributions(&self, rows: &[u32]) -> Vec<f64> {
        let n = rows.len() as f64;
        let value = |(y, &r): (&[f32], &u32)| {
            let at = self.row(r);
            let own: f64 = y
                .iter()
                .zip(&self.mu[at.clone()])
                .zip(&self.logvar[at])
                .map(|((y, mu), logvar)| f64::from(-0.5 * (y - mu) * (y - mu) * (-logvar).exp()))
                .sum();
            // the mean over the others: the mean over all, without its own term
            let others = (n * self.product[self.place[r as usize] as usize] - own) / (n - 1.0);
            own - others
        };
        self.y.chunks_exact(self.width).zip(rows).map(value).collect()
    }

    /// ln q of test sample i's y beside row `row`'s x.
    pub(super) fn log_q(&self, i: usize, row: u32) -> f64 {
        let (y, at) = (&self.y[i * self.width..(i + 1) * self.width], self.row(row));
        let parts = y.iter().zip(&self.mu[at.clone()]).zip(&self.logvar[at]);
        parts.map(|((&y, &mu), &logvar)| losses::log_normal(mu, logvar, y)).sum()
    }

    /// ln q(y|x) − ln r(y); the training part has mean 0 and variance 1.
    fn gain(&self, data: &Prepared) -> Vec<f64> {
        let margin = |y: &[f32]| y.iter().map(|&y| losses::log_normal(0.0, 0.0, y)).sum::<f64>();
        let rows = self.y.chunks_exact(self.width).zip(&data.test).enumerate();
        rows.map(|(i, (y, &r))| self.log_q(i, r) - margin(y)).collect()
    }

    pub(super) fn leave_one_out(&self, seeds: &Seeds) -> Vec<f64> {
        let n = self.test.len();
        let others = (n - 1).min(OTHERS);
        // each sample meets the next ones in one random circle: never itself, all equally often
        let circle = rng::permutation(&mut seeds.stream("circle"), n);
        let constant: Vec<f64> =
            self.test.iter().map(|&r| self.row(r).map(|i| f64::from(self.logvar[i])).sum()).collect();
        let precision: Vec<f32> = self.logvar.iter().map(|l| (-l).exp()).collect();
        let mut values = vec![0.0; n];
        let mut logs = vec![0.0; others];
        for (at, &i) in circle.iter().enumerate() {
            let y = &self.y[i * self.width..(i + 1) * self.width];
            let log_q = |j: usize| {
                let row = self.row(self.test[j]);
                let parts = y.iter().zip(&self.mu[row.clone()]).zip(&precision[row]);
                let square: f32 = parts.map(|((y, mu), p)| (y - mu) * (y - mu) * p).sum();
                -0.5 * (f64::from(square) + constant[j])
            };
            for (log, step) in logs.iter_mut().zip(1..) {
                *log = log_q(circle[(at + step) % n]);
            }
            let most = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let sum: f64 = logs.iter().map(|l| libm::exp(l - most)).sum();
            values[i] = log_q(i) - most - libm::log(sum / others as f64);
        }
        values
    }

    pub(super) fn p_value(&self, samples: &Samples, data: &Prepared, protocol: Protocol, seeds: &Seeds) -> Option<f64> {
        let statistic = |rows: &[u32]| self.contributions(rows).iter().sum::<f64>();
        let mut rng = seeds.stream("null");
        let null: Vec<f64> = (0..protocol.permutations)
            .map(|_| statistic(&permuted_rows(samples, &data.test_episodes, &data.test, &mut rng)))
            .collect();
        p_value(statistic(&data.test), &null)
    }
}
