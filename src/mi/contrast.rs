//! What the estimators that train a critic by a variational objective share: training, the held-out value with its
//! interval, the p-value and the warnings.

use serde::{Deserialize, Serialize};

use super::bounds::{Objective, infonce};
use super::fit::{Fit, Model, Training, fit, nothing_learnt, training};
use super::prepare::{Prepared, gather, prepare, tied};
use super::scorer::{CriticKind, Scorer};
use super::{
    Estimate, Interval, Kind, MiError, Protocol, Unit, all_others, block_interval, derangements, p_value, permuted_rows,
};
use crate::registry::{RegistryError, Spec};
use crate::rng::{self, Seeds, Stream};
use crate::schema::Samples;

/// Every score as it is.
const ANY: (f32, f32) = (f32::NEG_INFINITY, f32::INFINITY);
/// Validation rows that the range of scores is taken from.
const VALIDATED: usize = 4096;
/// Share of the mean of e^T that one sample may have before the value is said to hang on it.
const HEAVY: f64 = 0.1;

/// How the value is read off held-out scores.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Reading {
    /// `InfoNCE` over all rows that are scored against each other.
    InfoNce,
    /// E\[T\] + 1 − E\[e^T\].
    Nwj,
    /// E\[T\] − ln E\[e^T\], in the second mean T held to ± this.
    DonskerVaradhan(f32),
}

/// An estimator of this family.
pub(super) struct Contrast {
    pub(super) name: &'static str,
    pub(super) kind: Kind,
    pub(super) objective: Objective,
    pub(super) reading: Reading,
    pub(super) critic: CriticKind,
}

/// Parameters of an estimator that trains a critic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Params {
    pub(super) critic: CriticKind,
}

/// Which critic a user wants.
pub(super) fn critic(spec: &Spec) -> Result<CriticKind, RegistryError> {
    spec.params().map(|Params { critic }| critic)
}

/// The critic under training, and its buffers.
struct Trainee {
    scorer: Scorer,
    objective: Objective,
    negatives: usize,
    grad_positive: Vec<f32>,
    grad_negative: Vec<f32>,
}

impl Trainee {
    fn pass(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, rng: &mut Stream) {
        let k = self.negatives.min(n - 1);
        self.scorer.scores(params, x, y, n, &derangements(rng, n, k));
    }
}

impl Model for Trainee {
    const DECAY: f32 = 0.5;

    fn init(&self, rng: &mut Stream) -> Vec<f32> {
        self.scorer.init(rng)
    }

    fn loss(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, rng: &mut Stream, grads: &mut [f32]) -> f64 {
        self.pass(params, x, y, n, rng);
        let (positive, negative) = (self.scorer.positive(), self.scorer.negative());
        self.grad_positive.resize(positive.len(), 0.0);
        self.grad_negative.resize(negative.len(), 0.0);
        let loss = self.objective.loss(positive, negative, &mut self.grad_positive, &mut self.grad_negative);
        self.scorer.backward(params, [x, y], [&self.grad_positive, &self.grad_negative], grads);
        loss
    }

    fn score(&mut self, params: &[f32], x: &[f32], y: &[f32], n: usize, rng: &mut Stream) -> f64 {
        self.pass(params, x, y, n, rng);
        self.objective.value(self.scorer.positive(), self.scorer.negative())
    }
}

/// A trained critic on held-out rows.
pub(super) struct Reader {
    pub(super) scorer: Scorer,
    pub(super) params: Vec<f32>,
    /// Whether it beat T = 0 on the validation part.
    pub(super) learnt: bool,
    /// Contributions of the test rows, whose mean is the value.
    pub(super) values: Vec<f64>,
    pub(super) of: Interval,
    /// How much more it scores on episodes that it was trained on, at least 0.
    pub(super) gap: f64,
    pub(super) warnings: Vec<String>,
}

impl Contrast {
    fn trainee(&self, data: &Prepared) -> Trainee {
        Trainee {
            scorer: Scorer::new(self.critic, data.x_width, data.y_width),
            objective: self.objective,
            negatives: self.critic.negatives(),
            grad_positive: Vec::new(),
            grad_negative: Vec::new(),
        }
    }

    /// The training of the critic.
    pub(super) fn training(&self, samples: &Samples, seeds: &Seeds) -> Option<Training> {
        let data = prepare(samples, seeds).ok()?;
        let score = if self.objective == Objective::JensenShannon { "2·JSD" } else { "bound, nats" };
        training(&mut self.trainee(&data), score, &data, seeds)
    }

    /// The name of the row.
    pub(super) fn full_name(&self) -> String {
        match self.critic {
            CriticKind::Separable => self.name.to_owned(),
            CriticKind::Concatenated => format!("{}:concatenated", self.name),
        }
    }

    /// Trains a critic and reads it on the test part; `None` when no value was finite.
    pub(super) fn read(&self, data: &Prepared, seeds: &Seeds) -> Option<Reader> {
        let mut model = self.trainee(data);
        let Fit { params, steps, .. } = fit(&mut model, data, seeds)?;
        let mut scorer = model.scorer;
        let held_out = data.train.len().min(data.test.len());
        // a critic held to the range of its validation scores is a critic too, and stays sane far from all data
        let looked = &data.validation[..data.validation.len().min(VALIDATED)];
        let validated = self.held(&mut scorer, &params, data, looked, ANY, seeds);
        let mut held = |rows: &[u32]| self.held(&mut scorer, &params, data, rows, validated.range, seeds);
        let trained_on = held(&data.train[..held_out]).values(self.reading);
        let trained_on = trained_on.iter().sum::<f64>() / held_out as f64;
        let held = held(&data.test);
        let values = held.values(self.reading);
        let of = block_interval(&values, &data.test_blocks);
        let mut warnings = self.warnings(&held, trained_on, of);
        warnings.extend((steps == 0).then(|| nothing_learnt("the critic")));
        let gap = (trained_on - of.mean).max(0.0);
        of.mean.is_finite().then_some(Reader { scorer, params, learnt: steps > 0, values, of, gap, warnings })
    }

    /// The row.
    pub(super) fn row(&self, samples: &Samples, protocol: Protocol, seeds: &Seeds) -> Result<Estimate, MiError> {
        let data = prepare(samples, seeds)?;
        let mut read = self.read(&data, seeds).ok_or_else(|| diverged(samples))?;
        let mut row = self.row_of(samples, &data, read.of, self.kind, read.learnt);
        row.p_value = null(&mut read.scorer, &read.params, samples, &data, protocol, seeds);
        row.warnings.extend(tied(samples));
        row.warnings.extend(read.warnings);
        Ok(row)
    }

    /// A row with its value, and with an interval if anything was learnt.
    pub(super) fn row_of(
        &self,
        samples: &Samples,
        data: &Prepared,
        of: Interval,
        kind: Kind,
        learnt: bool,
    ) -> Estimate {
        let mut row = Estimate::new(&self.full_name(), &samples.labels, of.mean, Unit::Nats, kind, data.test.len());
        row.n_effective = of.n_effective;
        if learnt {
            (row.interval_low, row.interval_high) = (Some(of.low), Some(of.high));
        }
        row.warnings.clone_from(&data.warnings);
        row
    }

    fn warnings(&self, held: &Held, trained_on: f64, of: Interval) -> Vec<String> {
        let mut out = Vec::new();
        if trained_on - of.mean > (4.0 * of.error).max(0.1) {
            let found = format!("{trained_on:.3} on training and {:.3} on held-out episodes", of.mean);
            out.push(format!("train and held-out disagree: {found}; more episodes would help"));
        }
        let ceiling = libm::log(held.side as f64);
        if self.reading == Reading::InfoNce && of.mean > 0.8 * ceiling {
            out.push(format!("near the ceiling of ln {} = {ceiling:.2}: the truth may be far higher", held.side));
        }
        let heaviest = held.heaviest();
        if self.reading != Reading::InfoNce && heaviest > HEAVY {
            let share = 100.0 * heaviest;
            out.push(format!(
                "{share:.0} % of the mean of e^T hangs on one sample: the value scatters more than it says"
            ));
        }
        out
    }

    /// Scores of these rows, each against all others of its square; the scores held to a range.
    fn held(
        &self,
        scorer: &mut Scorer,
        params: &[f32],
        data: &Prepared,
        rows: &[u32],
        (least, most): (f32, f32),
        seeds: &Seeds,
    ) -> Held {
        let n = rows.len();
        let order = rng::permutation(&mut seeds.stream("squares"), n);
        let squares = n.div_ceil(self.critic.square());
        let clip = if let Reading::DonskerVaradhan(clip) = self.reading { clip } else { f32::INFINITY };
        let mut out = Held {
            positive: vec![0.0; n],
            infonce: vec![0.0; n],
            exponential: vec![0.0; n],
            mean: 0.0,
            range: (f32::INFINITY, f32::NEG_INFINITY),
            side: n / squares,
        };
        let (mut x, mut y, mut within) = (Vec::new(), Vec::new(), Vec::new());
        let mut total = 0.0;
        for square in 0..squares {
            // random squares: the others of a row come from all episodes, not from its own
            let members = &order[square * n / squares..(square + 1) * n / squares];
            let own: Vec<u32> = members.iter().map(|&i| rows[i]).collect();
            gather(&data.x, data.x_width, &own, &mut x);
            gather(&data.y, data.y_width, &own, &mut y);
            let others = all_others(own.len());
            scorer.scores(params, &x, &y, own.len(), &others);
            let k = own.len() - 1;
            for (at, (&i, others_of)) in members.iter().zip(scorer.negative().chunks_exact(k)).enumerate() {
                let own = scorer.positive()[at].max(least).min(most);
                out.positive[i] = f64::from(own);
                within.clear();
                within.extend(others_of.iter().map(|t| t.max(least).min(most)));
                out.infonce[i] = infonce(own, &within);
                out.range.0 = within.iter().fold(out.range.0.min(own), |a, &t| a.min(t));
                out.range.1 = out.range.1.max(own);
                if self.reading == Reading::InfoNce {
                    // its scores have a level of their own for every x
                    out.range.1 = within.iter().fold(out.range.1, |a, &t| a.max(t));
                }
                for (&t, &j) in within.iter().zip(&others[at * k..(at + 1) * k]) {
                    let e = libm::exp(f64::from(t.clamp(-clip, clip))) / k as f64;
                    out.exponential[i] += e;
                    out.exponential[members[j as usize]] += e;
                    total += e;
                }
            }
        }
        out.mean = total / n as f64;
        // a pair belongs to its row and to its column: both at once would count the mean twice
        let mean = out.mean;
        for e in &mut out.exponential {
            *e -= mean;
        }
        out
    }
}

/// A critic on held-out rows.
struct Held {
    /// T of each pair.
    positive: Vec<f64>,
    /// `InfoNCE` of each row.
    infonce: Vec<f64>,
    /// What each row, as a row and as a column, contributes to the mean of e^T; its mean is `mean`.
    exponential: Vec<f64>,
    mean: f64,
    /// Least score of any two rows, and greatest of a pair (`InfoNCE`: of any two).
    range: (f32, f32),
    /// Rows scored against each other.
    side: usize,
}

impl Held {
    /// Contributions of the rows to the value, whose mean it is.
    fn values(&self, reading: Reading) -> Vec<f64> {
        let pairs = self.positive.iter().zip(&self.exponential);
        match reading {
            Reading::InfoNce => self.infonce.clone(),
            Reading::Nwj => pairs.map(|(t, e)| t + 1.0 - e).collect(),
            // ln E by its tangent at the mean: same value, and the right spread over episodes
            Reading::DonskerVaradhan(_) => pairs.map(|(t, e)| t + 1.0 - e / self.mean - libm::log(self.mean)).collect(),
        }
    }

    /// The largest share that one row has in the mean of e^T.
    fn heaviest(&self) -> f64 {
        let most = self.exponential.iter().copied().fold(0.0, f64::max);
        most / (self.mean * self.exponential.len() as f64)
    }
}

/// No value was finite.
pub(super) fn diverged(samples: &Samples) -> MiError {
    MiError::Diverged { columns: format!("{} and {}", samples.labels.x, samples.labels.y) }
}

/// Whole test episodes permuted, critic kept. The second means do not change, so E\[T\] is compared.
fn null(
    scorer: &mut Scorer,
    params: &[f32],
    samples: &Samples,
    data: &Prepared,
    protocol: Protocol,
    seeds: &Seeds,
) -> Option<f64> {
    let span = |e: u32| samples.starts[e as usize] as u32..samples.starts[e as usize + 1] as u32;
    let all: Vec<u32> = data.test_episodes.iter().flat_map(|&e| span(e)).collect();
    let mut place = vec![0; samples.x.rows()];
    all.iter().enumerate().for_each(|(i, &r)| place[r as usize] = i as u32);
    let (mut x, mut y) = (Vec::new(), Vec::new());
    gather(&data.x, data.x_width, &all, &mut x);
    gather(&data.y, data.y_width, &data.test, &mut y);
    let mut rng = seeds.stream("null");
    let mut draw = |b: usize| {
        let rows = match b {
            0 => data.test.clone(),
            _ => permuted_rows(samples, &data.test_episodes, &data.test, &mut rng),
        };
        rows.into_iter().map(|r| place[r as usize]).collect()
    };
    let sums = scorer.sums(params, [&x, &y], data.test.len(), &mut (0..=protocol.permutations).map(&mut draw));
    p_value(sums[0], &sums[1..])
}

#[cfg(test)]
mod tests {
    use super::*;

    const NWJ: Contrast = Contrast {
        name: "nwj",
        kind: Kind::LowerBound,
        objective: Objective::Nwj,
        reading: Reading::Nwj,
        critic: CriticKind::Separable,
    };

    fn held(exponential: &[f64], positive: f64) -> Held {
        let n = exponential.len();
        Held {
            positive: vec![positive; n],
            infonce: vec![positive; n],
            exponential: exponential.to_vec(),
            mean: exponential.iter().sum::<f64>() / n as f64,
            range: ANY,
            side: n,
        }
    }

    #[test]
    fn disagreement_ceiling_and_a_heavy_sample_are_warned_of() {
        let even = held(&[1.0; 50], 3.5);
        let blocks: Vec<u32> = (0..50).collect();
        let of = |held: &Held, reading| block_interval(&held.values(reading), &blocks);
        let value = of(&even, Reading::Nwj);
        assert_eq!(NWJ.warnings(&even, 3.55, value), [""; 0]);
        assert_eq!(
            NWJ.warnings(&even, 4.0, value),
            ["train and held-out disagree: 4.000 on training and 3.500 on held-out episodes; more episodes would help"]
        );
        let infonce = Contrast { name: "infonce", reading: Reading::InfoNce, ..NWJ };
        assert_eq!(
            infonce.warnings(&even, 3.5, of(&even, Reading::InfoNce)),
            ["near the ceiling of ln 50 = 3.91: the truth may be far higher"]
        );
        let mut one = vec![1.0; 50];
        one[7] = 51.0;
        let heavy = held(&one, 3.5);
        let value = of(&heavy, Reading::Nwj);
        assert_eq!(
            NWJ.warnings(&heavy, 2.0, value),
            ["51 % of the mean of e^T hangs on one sample: the value scatters more than it says"]
        );
    }

    #[test]
    fn contributions_average_to_the_bound_on_all_pairs_of_a_square() {
        let seeds = Seeds::new(5);
        let mut rng = seeds.stream("data");
        let n = 60;
        let mut draw = || (0..n).map(|_| rng::normal(&mut rng) as f32).collect::<Vec<_>>();
        let (x, y) = (draw(), draw());
        let rows: Vec<u32> = (0..n as u32).collect();
        let data = Prepared {
            x,
            x_width: 1,
            y,
            y_width: 1,
            train: rows.clone(),
            validation: rows.clone(),
            test: rows.clone(),
            test_blocks: rows.clone(),
            test_episodes: rows.clone(),
            warnings: Vec::new(),
        };
        let mut scorer = Scorer::new(CriticKind::Separable, 1, 1);
        let params: Vec<f32> =
            scorer.init(&mut seeds.stream("init")).iter().map(|p| p + 0.2 * rng::normal(&mut rng) as f32).collect();
        let held = NWJ.held(&mut scorer, &params, &data, &rows, ANY, &seeds);
        // one square: the bounds over all n (n − 1) pairs, whatever their order
        scorer.scores(&params, &data.x, &data.y, n, &all_others(n));
        let readings = [
            (Reading::InfoNce, Objective::InfoNce),
            (Reading::Nwj, Objective::Nwj),
            (Reading::DonskerVaradhan(f32::INFINITY), Objective::DonskerVaradhan { running: 0.0 }),
        ];
        for (reading, objective) in readings {
            let expected = objective.value(scorer.positive(), scorer.negative());
            let found = held.values(reading).iter().sum::<f64>() / n as f64;
            assert!((found - expected).abs() < 1e-5 * expected.abs().max(1.0), "{reading:?}: {found} {expected}");
        }
    }
}
