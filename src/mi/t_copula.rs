//! # What it is
//!
//! The information of a Student's t copula fitted to the ranks: `gcmi` for columns that share a heavy tail, where large
//! values come together even without correlation.
//!
//! # Definition
//!
//! Each column is replaced by Q(rank/(n + 1)), Q the quantile function of Student's t with ν degrees of freedom, equal values having the
//! mean of their ranks. ν and the correlation matrix R of all columns maximise the copula's likelihood. With h the entropy
//! of a multivariate t distribution, I = h(x) + h(y) − h(x, y); given z: h(x, z) + h(y, z) − h(z) − h(x, y, z). The bias that
//! normal samples would have (as for `gaussian`) is subtracted. Where the likelihood of the effective samples gains less than
//! 3.32 over ν = ∞ (χ² at one in a hundred), the value is that of `gcmi`, and the interval reaches up to the heaviest tail that is possible.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`, all samples; the value in nats.
//!
//! # Parameters
//!
//! None. The interval is from subsamples of whole episodes, ranked and fitted anew around ν; it reaches down to 0 where the p-value
//! is over 0.05. The p-value permutes whole episodes and fits each time, in at most 2000 samples. Given z there is neither.
//!
//! # When it fails
//!
//! It is an estimate and no bound: where the copula is another one, the value may be too low or too high. That is looked for: the fitted
//! density ratio as a critic has an `infonce` bound in up to 2000 samples (of those it was fitted to, so a little too good for many
//! columns and few samples), and a value above that bound's interval is warned of and has no interval. Given z there is no such check.
//! One ν is shared by all columns. With few distinct values ranks say little.
//!
//! # Reference
//!
//! Demarta, `McNeil` 2005, International Statistical Review 73, 111–129 (the copula); Arellano-Valle, Contreras-Reyes, Genton
//! 2013, Scandinavian Journal of Statistics 40 (entropies of t distributions).
//!
//! # Differences from the reference implementation
//!
//! None known: on samples of the t distribution it comes to its closed form.

use rayon::prelude::*;

use super::bounds::infonce;
use super::gcmi::in_scores;
use super::interval::{Scatter, block_interval, t_quantile};
use super::linear::{Moments, Symmetric};
use super::part::{Part, Subsampled};
use super::prepare::{scales, tied};
use super::student::{COLLINEAR, Copula, Tail, Widths, correlation, doubled_ranks, identity};
use super::{Build, Estimate, Estimator, MiError, NOTE, Protocol, gaussian, p_value};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::{Columns, Samples};

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "t-copula",
    summary: "Student's t copula: gcmi for columns that share a heavy tail",
    reference: "Demarta, McNeil 2005; Arellano-Valle et al. 2013",
    value: None,
    build,
};

/// Degrees of freedom that are tried: from the first down by this factor, so many times.
const DEGREES: (f64, f64, usize) = (60.0, 1.4, 14);
/// How close, in such steps, the fits lie that find the summit.
const CLOSE: f64 = 0.2;
/// Degrees of freedom of the null test: fixed, so that the observed pairs have no part in their choice.
const COARSE: [f64; 4] = [f64::INFINITY, 8.0, 3.0, 1.3];
/// Steps of EM from no correlation, and from a neighbour's.
const STEPS: (usize, usize) = (12, 4);
/// Least gain in log-likelihood over the normal copula: half the 99 % quantile of χ² with one degree of freedom.
const GAIN: f64 = 3.32;
/// Loss of log-likelihood up to which a number of degrees of freedom is possible: half the 95 % quantile of that χ².
const POSSIBLE: f64 = 1.92;
/// Most samples that a null test fits, and of which all pairs are scored.
const PART: usize = 2000;
/// Share of the ceiling ln n above which `InfoNCE` proves too little to compare with.
const CEILING: f64 = 0.5;
/// What the warning about a copula that does not fit begins with.
pub(super) const MISFIT: &str = "the t copula does not fit";

/// What the note about a copula without tails begins with.
pub(super) const LIGHT: &str = "note: no tail heavier than normal";

/// Said of every value given z.
const UNCHECKED: &str =
    "given z nobody checks whether the t copula fits: no interval, no p-value; compare with gcmi and ksg";

struct TCopula;

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    spec.no_params()?;
    Ok(Box::new(TCopula))
}

impl Estimator for TCopula {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        let normal = in_scores(samples);
        let gcmi = |protocol| gaussian::estimate("t-copula", &normal, protocol, seeds);
        // what refuses samples, finds copies, and stands when there are no tails
        let mut row = gcmi(Protocol { permutations: 0 })?;
        row.warnings.extend(tied(samples));
        if row.value.is_infinite() {
            return Ok(vec![row]);
        }
        let ranked = Ranked::new(&normal)?;
        let fitted = ranked.fit(&samples.rows, row.n_effective / samples.len() as f64);
        let Fitted::Heavy(fit) = fitted else {
            let mut light = Estimate { warnings: row.warnings, ..gcmi(*protocol)? };
            light.warnings.push(format!("{LIGHT}: the value is that of gcmi"));
            if let (Fitted::Light(Some(fit)), Some(high)) = (fitted, light.interval_high) {
                light.interval_high = Some(high.max(ranked.information(&fit)));
            }
            return Ok(vec![light]);
        };
        Ok(vec![ranked.heavy(samples, &fit, *protocol, seeds, row)])
    }

    fn takes_given(&self) -> bool {
        true
    }
}

/// Degrees of freedom and correlations of the best copula.
struct Fit {
    tail: Tail,
    correlation: Symmetric,
}

/// What the likelihood says of tails.
enum Fitted {
    /// The best copula.
    Heavy(Fit),
    /// The normal copula will do; the heaviest tail that it is not clearly better than, if any.
    Light(Option<Fit>),
}

/// Samples as doubled ranks.
struct Ranked {
    /// Of x and y, and z: `[all rows, width]` each.
    sides: [(Vec<u32>, usize); 3],
    widths: Widths,
    /// Samples that the ranks are of.
    n: usize,
    /// By doubled rank.
    occur: Vec<bool>,
}

impl Ranked {
    fn new(samples: &Samples) -> Result<Self, MiError> {
        let side = |columns: &Columns, label: &str| -> Result<(Vec<u32>, usize), MiError> {
            let kept = scales(columns, &samples.rows, label, &mut Vec::new())?;
            let all = (0..columns.rows()).map(|r| columns.row(r));
            let data: Vec<f64> = all.flat_map(|row| kept.iter().map(move |s| row[s.column])).collect();
            let mut moments = Moments::new(kept.len());
            samples.rows.iter().for_each(|&r| moments.add_row(&data[r as usize * kept.len()..][..kept.len()]));
            // a function of the columns before it has no ranks of its own
            let own: Vec<bool> = moments.covariance().cholesky(COLLINEAR).pivots.iter().map(|p| *p > 0.0).collect();
            let width = own.iter().filter(|own| **own).count();
            let data: Vec<f64> =
                data.iter().zip(own.iter().cycle()).filter(|(_, own)| **own).map(|(v, _)| *v).collect();
            Ok((doubled_ranks(&data, width, &samples.rows), width))
        };
        let given = samples.labels.given.as_deref().unwrap_or_default();
        let of_z = samples.z.as_ref().map_or(Ok((Vec::new(), 0)), |z| side(z, given))?;
        let sides = [side(&samples.x, &samples.labels.x)?, side(&samples.y, &samples.labels.y)?, of_z];
        Ok(Self::of(sides, samples.len()))
    }

    /// The ranks that some of the rows have among themselves: a sample of its own, whose rows are numbered from 0.
    fn of_part(&self, rows: &[u32]) -> Self {
        let all: Vec<u32> = (0..rows.len() as u32).collect();
        let side = |(ranks, width): &(Vec<u32>, usize)| {
            let data: Vec<f64> = rows
                .iter()
                .flat_map(|&r| &ranks[r as usize * width..][..*width])
                .map(|&rank| f64::from(rank))
                .collect();
            (doubled_ranks(&data, *width, &all), *width)
        };
        Self::of([side(&self.sides[0]), side(&self.sides[1]), side(&self.sides[2])], rows.len())
    }

    /// Of `n` samples with these ranks of x, y and z.
    fn of(sides: [(Vec<u32>, usize); 3], n: usize) -> Self {
        let mut occur = vec![false; 2 * n + 3];
        for &rank in sides.iter().flat_map(|(ranks, _)| ranks) {
            occur[rank as usize] = true;
        }
        let widths = Widths { x: sides[0].1, y: sides[1].1, z: sides[2].1 };
        Self { sides, widths, n, occur }
    }

    fn tail(&self, degrees: f64) -> Tail {
        Tail::new(degrees, self.n, &self.occur)
    }

    /// Quantiles of `tail`: x of the rows `from` beside y and z of `rows`, `[rows, width]`.
    fn quantiles(&self, tail: &Tail, from: &[u32], rows: &[u32]) -> Vec<f64> {
        let mut out = Vec::with_capacity(rows.len() * self.widths.all());
        for (&from, &row) in from.iter().zip(rows) {
            for (at, (ranks, width)) in [from, row, row].into_iter().zip(&self.sides) {
                out.extend(ranks[at as usize * width..][..*width].iter().map(|&rank| tail.quantile(rank)));
            }
        }
        out
    }

    fn copula<'a>(&self, tail: &'a Tail, correlation: &'a Symmetric) -> Copula<'a> {
        Copula { tail, correlation, widths: self.widths }
    }

    /// The information of a fitted copula, nats.
    fn information(&self, fit: &Fit) -> f64 {
        self.copula(&fit.tail, &fit.correlation).information()
    }

    /// The best copula of `rows`; a log-likelihood counts for the `independent` share of them.
    fn fit(&self, rows: &[u32], independent: f64) -> Fitted {
        let fit = |degrees: f64, start: Option<&Symmetric>| {
            let tail = self.tail(degrees);
            let quantiles = self.quantiles(&tail, rows, rows);
            let none = identity(self.widths.all());
            let steps = if start.is_some() { STEPS.1 } else { STEPS.0 };
            let correlation = correlation(&quantiles, &tail, start.unwrap_or(&none), steps);
            let likelihood =
                self.copula(&tail, &correlation).log_likelihood(&quantiles) * rows.len() as f64 * independent;
            (likelihood, Fit { tail, correlation })
        };
        let (normal, first) = fit(f64::INFINITY, None);
        let (most, factor, count) = DEGREES;
        let mut tried: Vec<(f64, Fit)> = vec![fit(most, Some(&first.correlation))];
        while tried.len() < count {
            let last = &tried[tried.len() - 1];
            let next = fit(last.1.tail.degrees / factor, Some(&last.1.correlation));
            let falls = next.0 < last.0;
            tried.push(next);
            if falls {
                break;
            }
        }
        // over a whole step the likelihood is no parabola: three close fits around the first summit find the second
        if let [.., (before, _), (best, middle), (after, _)] = tried.as_slice() {
            let near = middle.tail.degrees * libm::pow(factor, -summit([*before, *best, *after]));
            let beside = |steps: f64| fit(near * libm::pow(factor, -steps), Some(&middle.correlation));
            let close = [beside(-CLOSE), beside(0.0), beside(CLOSE)];
            let last = beside(CLOSE * summit([close[0].0, close[1].0, close[2].0]));
            tried.extend(close.into_iter().chain([last]));
        }
        let most = tried.iter().map(|t| t.0).fold(normal, f64::max);
        if most - normal > GAIN {
            let best = tried.into_iter().reduce(|a, b| if b.0 > a.0 { b } else { a });
            return best.map_or(Fitted::Light(None), |(_, fit)| Fitted::Heavy(fit));
        }
        let possible = tried.into_iter().map(|(likelihood, fit)| (most - likelihood <= POSSIBLE, fit));
        let possible = possible.filter_map(|(possible, fit)| possible.then_some(fit));
        Fitted::Light(possible.reduce(|a, b| if b.tail.degrees < a.tail.degrees { b } else { a }))
    }

    /// The row of a copula with a heavy tail; `row` has what does not depend on it.
    fn heavy(&self, samples: &Samples, fit: &Fit, protocol: Protocol, seeds: &Seeds, mut row: Estimate) -> Estimate {
        let (rows, widths) = (&samples.rows, self.widths);
        let bias = gaussian::bias(rows.len() as f64, widths.x, widths.y, widths.z);
        let copula = self.copula(&fit.tail, &fit.correlation);
        let seen = copula.information();
        row.value = seen - bias;
        let local = copula.local(&self.quantiles(&fit.tail, rows, rows));
        let blocks = samples.episodes();
        row.n_effective = block_interval(&local, &blocks).n_effective;
        row.warnings.push(format!("{NOTE}{:.1} degrees of freedom", fit.tail.degrees));
        (row.interval_low, row.interval_high) = (None, None);
        if samples.z.is_some() {
            row.warnings.push(UNCHECKED.to_owned());
            return row;
        }
        let misfit = self.misfit(fit, samples, row.value, seeds);
        row.p_value = self.p_value(samples, protocol, seeds);
        if misfit.is_none()
            && let Some(of) = self.error(fit, samples, seeds)
        {
            // without dependence some scatter remains, as for gaussian
            let chance = libm::sqrt((widths.x * widths.y) as f64 / 2.0) / row.n_effective;
            let scatter = Scatter { seen, error: of.error, chance, n: row.n_effective };
            let (low, high) = scatter.around(row.value, t_quantile(of.degrees + 1));
            let low = if row.p_value.is_some_and(|p| p > 0.05) { low.min(0.0) } else { low };
            (row.interval_low, row.interval_high) = (Some(low), Some(high));
        }
        row.warnings.extend(misfit);
        row
    }

    /// Standard error and its degrees of freedom, by subsamples that are fitted around `fit`.
    fn error(&self, fit: &Fit, samples: &Samples, seeds: &Seeds) -> Option<Subsampled> {
        // ranks are estimates too: a subsample has its own
        let information = |rows: &[u32]| {
            let part = self.of_part(rows);
            let all: Vec<u32> = (0..rows.len() as u32).collect();
            let of = |step: f64| {
                let tail = part.tail(fit.tail.degrees * libm::pow(DEGREES.1, step));
                let quantiles = part.quantiles(&tail, &all, &all);
                let correlation = correlation(&quantiles, &tail, &fit.correlation, STEPS.1);
                let copula = part.copula(&tail, &correlation);
                (copula.log_likelihood(&quantiles), copula.information())
            };
            let [below, at, above] = [of(-0.5), of(0.0), of(0.5)];
            // the information at the summit, by the parabola through the three
            let t = summit([below.0, at.0, above.0]);
            at.1 + 0.5 * t * (above.1 - below.1) + 0.5 * t * t * (above.1 - 2.0 * at.1 + below.1)
        };
        let least = 3 * self.widths.all();
        Part::all(samples).subsampled_error(samples.len(), least, &seeds.child("error"), &information)
    }

    /// The p-value of the information that a coarsely fitted copula sees.
    fn p_value(&self, samples: &Samples, protocol: Protocol, seeds: &Seeds) -> Option<f64> {
        let part = Part::drawn(samples, PART, &seeds.child("null"));
        let tails = COARSE.map(|degrees| self.tail(degrees));
        let none = identity(self.widths.all());
        let information = |from: &[u32]| {
            let of = |tail: &Tail| {
                let quantiles = self.quantiles(tail, from, &part.rows);
                let correlation = correlation(&quantiles, tail, &none, STEPS.1);
                let copula = self.copula(tail, &correlation);
                let local = copula.local(&quantiles);
                (copula.log_likelihood(&quantiles), local.iter().sum::<f64>() / local.len() as f64)
            };
            let best = tails.iter().map(of).reduce(|a, b| if b.0 > a.0 { b } else { a });
            best.map_or(f64::NAN, |(_, information)| information)
        };
        p_value(information(&part.rows), &part.null(samples, protocol, seeds, &information))
    }

    /// The warning when the value is more than the fitted density ratio can prove of the samples.
    fn misfit(&self, fit: &Fit, samples: &Samples, value: f64, seeds: &Seeds) -> Option<String> {
        let part = Part::drawn(samples, PART, &seeds.child("misfit"));
        if value > CEILING * libm::log(part.rows.len() as f64) {
            return Some(format!(
                "{MISFIT}, or nobody can tell: {value:.2} nats are more than {} samples prove",
                part.rows.len()
            ));
        }
        let blocks = part.blocks();
        let proved = block_interval(&self.proved(fit, &part.rows, &blocks), &blocks);
        (value > proved.high).then(|| {
            format!(
                "{MISFIT}: as a critic it proves {:.3} nats (95 %: {:.3} to {:.3}); take auto",
                proved.mean, proved.low, proved.high
            )
        })
    }

    /// The `InfoNCE` bound of each row by the fitted density ratio, against y of all other episodes.
    fn proved(&self, fit: &Fit, rows: &[u32], blocks: &[u32]) -> Vec<f64> {
        let (widths, tail) = (self.widths, &fit.tail);
        let (dx, dy, width) = (widths.x, widths.y, widths.all());
        let quantiles = self.quantiles(tail, rows, rows);
        let [of_x, of_y, both] = [0..dx, dx..width, 0..width].map(|c| fit.correlation.block(c).cholesky(COLLINEAR));
        // whitening is linear: of (x, y) it is that of (x, 0) and that of (0, y) together
        let mut scratch = Vec::new();
        let mut white = |row: &[f64]| {
            both.distance(row, &mut scratch);
            scratch.clone()
        };
        let (zero_x, zero_y) = (vec![0.0; dx], vec![0.0; dy]);
        let whites: Vec<[Vec<f64>; 2]> = quantiles
            .chunks_exact(width)
            .map(|row| [white(&[&row[..dx], &zero_y].concat()), white(&[&zero_x, &row[dx..]].concat())])
            .collect();
        let mut scratch = Vec::new();
        let alone: Vec<[f64; 2]> = quantiles
            .chunks_exact(width)
            .map(|row| {
                let (x, y) = (of_x.distance(&row[..dx], &mut scratch), of_y.distance(&row[dx..], &mut scratch));
                [tail.decay(dx, x), tail.decay(dy, y)]
            })
            .collect();
        // constants are the same for every pair and leave InfoNCE as it is
        let score = |i: usize, j: usize| {
            let distance: f64 = whites[i][0].iter().zip(&whites[j][1]).map(|(a, b)| (a + b) * (a + b)).sum();
            (alone[i][0] + alone[j][1] - tail.decay(width, distance)) as f32
        };
        let bound = |i: usize| {
            let others: Vec<f32> = (0..rows.len()).filter(|&j| blocks[j] != blocks[i]).map(|j| score(i, j)).collect();
            infonce(score(i, i), &others)
        };
        (0..rows.len()).into_par_iter().map(bound).collect()
    }
}

/// Where a parabola through three values, one step apart, is highest: steps from the middle one, at most two.
fn summit([before, middle, after]: [f64; 3]) -> f64 {
    let curvature = before - 2.0 * middle + after;
    if curvature < 0.0 {
        (0.5 * (before - after) / curvature).clamp(-2.0, 2.0)
    } else {
        2.0 * (after - before).signum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::Kind;
    use crate::mi::run::tests::{linear_samples, samples_of};
    use crate::mi::tasks::TASKS;

    fn one(samples: &Samples) -> Estimate {
        TCopula.estimate(samples, &Protocol { permutations: 39 }, &Seeds::new(1)).unwrap().remove(0)
    }

    fn task(id: &str, n: usize) -> (Samples, f64) {
        let task = TASKS.iter().find(|t| t.id == id).unwrap();
        (task.samples(n, &mut Seeds::new(3).stream(id)), task.truth)
    }

    #[test]
    fn samples_of_the_t_distribution_come_to_its_closed_form() {
        for id in ["student-identity-1-1-1", "student-identity-2-2-2", "asinh-student-identity-5-5-2"] {
            let (samples, truth) = task(id, 4000);
            let found = one(&samples);
            assert!((found.value - truth).abs() < 0.03, "{id}: {} of {truth}", found.value);
            assert!(found.interval_low.unwrap() < truth && found.interval_high.unwrap() > truth, "{id}: {found:?}");
            assert!(found.p_value.unwrap() <= 0.05 && !found.warnings.join(";").contains(MISFIT), "{found:?}");
            assert_eq!(found.kind, Kind::Estimate);
        }
    }

    #[test]
    fn the_summit_is_that_of_the_parabola_and_bounded() {
        assert!((summit([0.0, 3.0, 4.0]) - 1.0).abs() < 1e-12);
        assert_eq!([summit([0.0, 0.0, 1.0]), summit([1.0, 0.0, 0.0]), summit([0.0, 1.0, 1.99])], [2.0, -2.0, 2.0]);
    }

    #[test]
    fn a_value_that_the_fitted_ratio_does_not_prove_is_warned_of() {
        let (samples, truth) = task("student-identity-2-2-2", 1000);
        let ranked = Ranked::new(&samples).unwrap();
        let Fitted::Heavy(fit) = ranked.fit(&samples.rows, 1.0) else { panic!("a tail") };
        let warning = |value: f64| ranked.misfit(&fit, &samples, value, &Seeds::new(1));
        assert_eq!(warning(truth), None);
        let found = warning(truth + 0.2).unwrap();
        assert!(
            found.starts_with("the t copula does not fit: as a critic it proves 0.") && found.ends_with("take auto")
        );
        let found = warning(3.6).unwrap();
        assert_eq!(found, "the t copula does not fit, or nobody can tell: 3.60 nats are more than 1000 samples prove");
    }

    #[test]
    fn without_a_tail_it_is_gcmi() {
        let samples = linear_samples(0.75, 2000, 2, 3);
        let found = one(&samples);
        let gcmi = super::super::gcmi::ENTRY;
        let gcmi = (gcmi.build)(&Spec::new("gcmi")).unwrap();
        let gcmi = gcmi.estimate(&samples, &Protocol { permutations: 39 }, &Seeds::new(1)).unwrap().remove(0);
        assert_eq!((found.value, found.interval_low, found.p_value), (gcmi.value, gcmi.interval_low, gcmi.p_value));
        assert!(found.warnings.iter().any(|w| w.starts_with("note: no tail heavier than normal")), "{found:?}");
        let none = one(&linear_samples(0.0, 2000, 2, 4));
        assert!(none.value.abs() < 0.01 && none.p_value.unwrap() > 0.05, "{none:?}");
    }

    #[test]
    fn a_shared_scale_is_dependence_and_own_scales_are_none() {
        // x and y divided by the same χ, or each by its own
        let (shared, _) = task("student-identity-1-1-1", 2000);
        let (other, _) = task("student-identity-2-2-1", 2000);
        let column = |samples: &Columns| (0..2000).map(|r| vec![samples.row(r)[0]]).collect::<Vec<_>>();
        let apart = one(&samples_of(&column(&shared.x), &column(&other.x)));
        assert!(one(&shared).value > 0.19 && apart.value < 0.01, "{apart:?}");
        assert!(apart.p_value.unwrap() > 0.05, "{apart:?}");
    }

    #[test]
    fn given_a_third_of_its_columns_the_t_distribution_keeps_its_closed_form() {
        // of five columns x: x₀ against x₁ given x₂, ν = 2: h(2) + h(2) − h(1) − h(3) = 0.0424
        let (samples, _) = task("student-identity-5-5-2", 4000);
        let column = |c: usize| (0..4000).map(|r| vec![samples.x.row(r)[c]]).collect::<Vec<_>>();
        let mut three = samples_of(&column(0), &column(1));
        three.z = Some(samples_of(&column(2), &column(2)).x);
        let found = one(&three);
        assert!((found.value - 0.0424).abs() < 0.02, "{found:?}");
        assert!(found.p_value.is_none() && found.interval_low.is_none(), "{found:?}");
        assert!(found.warnings.contains(&UNCHECKED.to_owned()), "{found:?}");
    }

    #[test]
    fn columns_that_repeat_others_have_no_part_in_the_tail() {
        // x = (a, e^a) and y independent: were the copy counted, the tail would look heavy (ν = 1.6, 0.117 nats)
        let none = linear_samples(0.0, 1000, 1, 8);
        let x: Vec<Vec<f64>> = none.x.data.iter().map(|a| vec![*a, a.exp()]).collect();
        let y: Vec<Vec<f64>> = none.y.data.iter().map(|b| vec![*b]).collect();
        let found = one(&samples_of(&x, &y));
        assert!(found.value < 0.005 && found.interval_low.unwrap() <= 0.0, "{found:?}");
    }

    #[test]
    fn a_copula_that_does_not_fit_has_no_interval_and_a_light_tail_reaches_up() {
        // three columns of one tail beside an independent one: the shared ν invents dependence
        let (tail, _) = task("student-identity-5-5-2", 1500);
        let noise = linear_samples(0.0, 1500, 1, 6);
        let x: Vec<Vec<f64>> = (0..1500).map(|r| tail.x.row(r)[..4].to_vec()).collect();
        let y: Vec<Vec<f64>> = (0..1500).map(|r| vec![noise.x.row(r)[0]]).collect();
        let found = one(&samples_of(&x, &y));
        let warned = found.warnings.iter().any(|w| w.starts_with(MISFIT));
        assert!(warned == found.interval_low.is_none(), "{found:?}");
        assert!(warned || found.interval_low.unwrap() <= 0.0, "{found:?}");
        // 2000 samples do not show 25 degrees of freedom, whose information is 0.00078
        let light = one(&linear_samples(0.0, 2000, 1, 5));
        assert!(light.interval_high.unwrap() > 0.00078, "{light:?}");
    }

    #[test]
    fn copies_are_infinite_and_errors_are_those_of_gcmi() {
        let x: Vec<Vec<f64>> = linear_samples(0.0, 100, 1, 1).x.data.iter().map(|&v| vec![v]).collect();
        let y: Vec<Vec<f64>> = x.iter().map(|v| vec![v[0].powi(3)]).collect();
        assert!(one(&samples_of(&x, &y)).value.is_infinite());
        let constant = TCopula.estimate(&samples_of(&x, &vec![vec![2.0]; 100]), &Protocol::default(), &Seeds::new(1));
        assert_eq!(constant.unwrap_err(), MiError::Constant { column: "y".to_owned() });
    }
}
