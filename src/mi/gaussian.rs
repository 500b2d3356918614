//! # What it is
//!
//! The mutual information that x and y would have, were they jointly normal: exact for linear relations with normal
//! noise, instant, and a sanity check for everything else.
//!
//! # Definition
//!
//! I = ½ \[ln |`S_x`| + ln |`S_y`| − ln |`S_xy`|\] with S the sample covariances, less its bias for normal samples,
//! ½ \[`b(d_x)` + `b(d_y)` − `b(d_x` + `d_y`)\], b(d) = Σ_{i=1..d} ψ((n − i)/2), ψ the digamma function. Given z: the same of what a
//! linear regression on z leaves of x and y, with n less the columns of z in b.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`, all samples; the value in nats.
//!
//! # Parameters
//!
//! None. The interval is a jackknife over at most 50 groups of whole episodes, joined with the scatter √(`d_x` `d_y`/2)/n of no
//! dependence: all I that the value lies within t standard errors of, the variance growing with I; of few samples (a jackknife
//! of twenty is noise) no more than a small multiple of what normals have. The p-value permutes whole episodes.
//!
//! # When it fails
//!
//! It sees linear dependence alone: y = x² gives 0. Heavy tails spoil the covariance. Constant and collinear columns
//! are left out with a warning. When y is a linear function of x the value is infinite.
//!
//! # Reference
//!
//! The bias is that of the log-determinant of a Wishart matrix: Misra, Singh, Demchuk 2005, J. Multivariate Analysis 92.
//!
//! # Differences from the reference implementation
//!
//! None known: equals −½ ln(1 − r²) in one dimension before the bias correction.

use statrs::function::gamma::digamma;

use super::gaussian_pass::GaussianPass;
use super::given::residuals;
use super::interval::{Scatter, block_interval, t_quantile};
use super::knn::Points;
use super::linear::{Moments, Symmetric};
use super::part::Part;
use super::prepare::{Scale, scales, some_of, tied};
use super::{Build, Estimate, Estimator, Kind, MiError, OnePass, Protocol, Unit, p_value};
use crate::registry::{Entry, RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::{Columns, SampleLabels, Samples};
use crate::stats::mean;

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "gaussian",
    summary: "log-determinants of covariances: exact for linear normal relations",
    reference: "bias: Misra, Singh, Demchuk 2005",
    value: None,
    build,
};

/// Unexplained share of a column's variance under which it counts as a linear function of others.
pub(super) const COLLINEAR: f64 = 1e-10;
/// Groups of the jackknife.
pub(super) const GROUPS: usize = 50;

struct Gaussian;

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    spec.no_params()?;
    Ok(Box::new(Gaussian))
}

impl Estimator for Gaussian {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        let mut row = estimate("gaussian", samples, *protocol, seeds)?;
        row.warnings.extend(tied(samples));
        Ok(vec![row])
    }

    fn takes_given(&self) -> bool {
        true
    }

    fn one_pass(&self) -> Option<Box<dyn OnePass>> {
        Some(Box::<GaussianPass>::default())
    }
}

/// The row of an estimator called `name`.
pub(super) fn estimate(name: &str, samples: &Samples, protocol: Protocol, seeds: &Seeds) -> Result<Estimate, MiError> {
    let (mut warnings, labels) = (samples.notes.clone(), &samples.labels);
    let (samples, given) = &residuals(samples, &mut warnings)?;
    let x = Scaled::new(&samples.x, samples, &labels.x, &mut warnings)?;
    let y = Scaled::new(&samples.y, samples, &labels.y, &mut warnings)?;
    let (dx, dy, n) = (x.columns.len(), y.columns.len(), samples.len());
    let needed = (2 * (dx + dy + given)).max(10);
    if n < needed {
        return Err(MiError::TooFewSamples { needed, widths: dx + dy + given, found: n });
    }
    let information = |moments: &Moments| information(moments, dx, dy, *given);
    let blocks = samples.episodes();
    let groups = groups(&blocks);
    let mut parts = vec![Moments::new(dx + dy); groups.last().map_or(0, |g| g + 1)];
    let mut row = Vec::with_capacity(dx + dy);
    for (&r, &group) in samples.rows.iter().zip(&groups) {
        row.clear();
        x.push(r, &mut row);
        y.push(r, &mut row);
        parts[group].add_row(&row);
    }
    let mut total = Moments::new(dx + dy);
    for part in &parts {
        total.add(part, 1.0);
    }
    let value = information(&total);
    let mut out = Estimate::new(name, labels, value, Unit::Nats, Kind::Estimate, n);
    if value.is_infinite() {
        warnings.push(copy(labels));
    } else {
        let local = local_information(samples, &x, &y, &total);
        out.n_effective = block_interval(&local, &blocks).n_effective;
        interval(&mut out, (dx * dy) as f64, &total, &parts, dx + dy + given, &information);
        if parts.len() < 10 {
            warnings.push(format!("few blocks: the interval rests on {} episodes", parts.len()));
        }
    }
    let statistic = |from: &[u32]| {
        let (mut moments, mut row) = (Moments::new(dx + dy), Vec::with_capacity(dx + dy));
        for (&from, &r) in from.iter().zip(&samples.rows) {
            row.clear();
            x.push(from, &mut row);
            y.push(r, &mut row);
            moments.add_row(&row);
        }
        information(&moments)
    };
    let part = Part::all(samples);
    let null = part.null(samples, protocol, seeds, &statistic);
    out.p_value = p_value(value, &null);
    out.warnings = warnings;
    Ok(out)
}

/// What stands beside an infinite value.
pub(super) fn copy(labels: &SampleLabels) -> String {
    format!("infinite (copy): {} is a linear function of {}", labels.y, labels.x)
}

/// Whether x determines a column of y linearly, or y one of x. Both standardised, of the same rows.
pub(super) fn determined(x: &Points, y: &Points) -> bool {
    let mut moments = Moments::new(x.width + y.width);
    let mut row = Vec::new();
    for i in 0..x.len() {
        row.clear();
        row.extend_from_slice(x.row(i));
        row.extend_from_slice(y.row(i));
        moments.add_row(&row);
    }
    let joint = moments.covariance();
    let lost = |part: Symmetric| part.cholesky(COLLINEAR).pivots.iter().filter(|p| **p == 0.0).count();
    let alone = lost(joint.block(0..x.width)) + lost(joint.block(x.width..x.width + y.width));
    x.len() > x.width + y.width && lost(joint) > alone
}

/// Which columns are used, and how they are scaled so that sums of squares keep their digits.
struct Scaled<'a> {
    source: &'a Columns,
    columns: Vec<Scale>,
}

impl<'a> Scaled<'a> {
    fn new(source: &'a Columns, samples: &Samples, label: &str, warnings: &mut Vec<String>) -> Result<Self, MiError> {
        let mut scaled = Self { source, columns: scales(source, &samples.rows, label, warnings)? };
        let mut moments = Moments::new(scaled.columns.len());
        let mut row = Vec::new();
        for &r in &samples.rows {
            row.clear();
            scaled.push(r, &mut row);
            moments.add_row(&row);
        }
        let pivots = moments.covariance().cholesky(COLLINEAR).pivots;
        let names: Vec<&str> = scaled.columns.iter().map(|s| source.names[s.column].as_str()).collect();
        let collinear: Vec<&str> = names.iter().zip(&pivots).filter(|(_, p)| **p == 0.0).map(|(n, _)| *n).collect();
        if !collinear.is_empty() && samples.len() > scaled.columns.len() {
            warnings.push(format!("linear functions of the columns before them, left out: {}", some_of(&collinear)));
            let mut kept = pivots.iter();
            scaled.columns.retain(|_| kept.next().is_some_and(|&p| p > 0.0));
        }
        Ok(scaled)
    }

    fn push(&self, row: u32, out: &mut Vec<f64>) {
        let row = self.source.row(row as usize);
        out.extend(self.columns.iter().map(|s| s.of(row)));
    }
}

/// Group of each sample: whole neighbouring episodes, at most [`GROUPS`] groups of nearly equal numbers of episodes.
fn groups(blocks: &[u32]) -> Vec<usize> {
    let mut episodes = blocks.to_vec();
    episodes.dedup();
    let count = episodes.len();
    let mut at = 0;
    let group = |&b: &u32| {
        while episodes[at] != b {
            at += 1;
        }
        at * GROUPS.min(count) / count
    };
    blocks.iter().map(group).collect()
}

/// Bias-corrected information in nats; infinite when x determines a column of y. `given` columns of z have been taken
/// out of x and y, and cost a degree of freedom each.
fn information(moments: &Moments, dx: usize, dy: usize, given: usize) -> f64 {
    information_of(&moments.covariance(), moments.n, dx, dy, given)
}

/// The same by the covariance of x and y, taken over `n` samples.
pub(super) fn information_of(joint: &Symmetric, n: f64, dx: usize, dy: usize, given: usize) -> f64 {
    let log_det = |pivots: &[f64]| pivots.iter().map(|&p| libm::log(p)).sum::<f64>();
    // the joint pivots start with those of x alone; what follows is y given x
    let pivots = joint.cholesky(COLLINEAR).pivots;
    let alone = joint.block(dx..dx + dy).cholesky(COLLINEAR).pivots;
    0.5 * (log_det(&alone) - log_det(&pivots[dx..])) - bias(n, dx, dy, given)
}

/// What the value is too high by, for `n` normal samples, nats.
pub(super) fn bias(n: f64, dx: usize, dy: usize, given: usize) -> f64 {
    let of = |d: usize| (1..=d).map(|i| digamma((n - (given + i) as f64) / 2.0)).sum::<f64>();
    0.5 * (of(dx) + of(dy) - of(dx + dy))
}

/// ½ \[`m_x` + `m_y` − `m_xy`\] per sample, m the squared Mahalanobis distances: its spread over samples and over episodes
/// says how many independent samples there are. The columns have mean zero.
fn local_information(samples: &Samples, x: &Scaled<'_>, y: &Scaled<'_>, total: &Moments) -> Vec<f64> {
    let (dx, dy, joint) = (x.columns.len(), y.columns.len(), total.covariance());
    let [of_x, of_y, of_both] = [0..dx, dx..dx + dy, 0..dx + dy].map(|c| joint.block(c).cholesky(COLLINEAR));
    let (mut row, mut scratch) = (Vec::new(), Vec::new());
    let local = |&r: &u32| {
        row.clear();
        x.push(r, &mut row);
        y.push(r, &mut row);
        let alone = of_x.distance(&row[..dx], &mut scratch) + of_y.distance(&row[dx..], &mut scratch);
        0.5 * (alone - of_both.distance(&row, &mut scratch))
    };
    samples.rows.iter().map(local).collect()
}

/// Gives a row its interval, by a jackknife over `parts` of `width` columns. Without dependence the value is χ² with
/// `degrees` = `d_x` `d_y` degrees of freedom over 2n, whose scatter a jackknife misses.
pub(super) fn interval(
    out: &mut Estimate,
    degrees: f64,
    total: &Moments,
    parts: &[Moments],
    width: usize,
    information: &dyn Fn(&Moments) -> f64,
) {
    let n = out.n_effective;
    let error = jackknife(total, parts, width, information);
    if parts.len() > 1 && error.is_finite() {
        let seen = out.value + degrees / (2.0 * n);
        let scatter = Scatter { seen, error, chance: libm::sqrt(degrees / 2.0) / n, n };
        let t = t_quantile(parts.len());
        let (low, high) = scatter.around(out.value, t);
        (out.interval_low, out.interval_high) = (Some(low), Some(high.min(scatter.highest(out.value, t))));
    }
}

/// Standard error by a jackknife over the parts, error² = (G − 1)/G Σ (`θ_g` − θ̄)².
fn jackknife(total: &Moments, parts: &[Moments], width: usize, information: &dyn Fn(&Moments) -> f64) -> f64 {
    let g = parts.len() as f64;
    let left_out = parts.iter().map(|part| {
        let mut rest = total.clone();
        rest.add(part, -1.0);
        if rest.n > (width + 2) as f64 { information(&rest) } else { f64::NAN }
    });
    let left_out: Vec<f64> = left_out.collect();
    let center = mean(&left_out);
    let squares: f64 = left_out.iter().map(|v| (v - center) * (v - center)).sum();
    libm::sqrt((g - 1.0) / g * squares)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::run::tests::{linear_samples, samples_of};

    fn one(samples: &Samples) -> Estimate {
        Gaussian.estimate(samples, &Protocol::default(), &Seeds::new(1)).unwrap().remove(0)
    }

    #[test]
    fn the_correlated_normal_has_its_closed_form() {
        for (rho, truth) in [(0.0, 0.0), (0.75, 0.4133), (0.99, 1.9585)] {
            let found = one(&linear_samples(rho, 5000, 1, 7));
            assert!((found.value - truth).abs() < 0.03, "{rho}: {}", found.value);
            assert!(found.interval_low.unwrap() < truth + 0.01 && found.interval_high.unwrap() > truth - 0.01);
            assert_eq!(found.p_value.unwrap() < 0.01, rho > 0.0);
            assert_eq!(found.n, 5000);
        }
    }

    #[test]
    fn given_a_common_cause_nothing_is_left_and_given_noise_everything() {
        // x = c + e, y = c + f: ½ ln 4/3 without z, 0 given c; x and y + x given nothing of use: unchanged
        let noise = linear_samples(0.0, 4000, 3, 11);
        let column = |of: fn(&[f64], &[f64]) -> f64| -> Vec<Vec<f64>> {
            (0..4000).map(|r| vec![of(noise.x.row(r), noise.y.row(r))]).collect()
        };
        let mut samples = samples_of(&column(|a, b| a[0] + b[1]), &column(|a, b| a[0] + b[2]));
        let plain = one(&samples);
        assert!((plain.value - 0.5 * (4f64 / 3.0).ln()).abs() < 0.02, "{}", plain.value);
        samples.z = Some(samples_of(&column(|a, _| a[0]), &column(|a, _| a[0])).x);
        let common = one(&samples);
        assert!(common.value.abs() < 0.002 && common.p_value.unwrap() > 0.01, "{common:?}");
        samples.z = Some(samples_of(&column(|a, _| a[1]), &column(|a, _| a[0])).x);
        let useless = one(&samples);
        assert!((useless.value - plain.value).abs() < 0.005 && useless.p_value.unwrap() < 0.01, "{useless:?}");
    }

    #[test]
    fn the_interval_of_twenty_samples_ends_and_covers() {
        let at = |rho: f64, n: usize| -> Vec<[f64; 3]> {
            let one = |seed| {
                let protocol = Protocol { permutations: 0 };
                let found = Gaussian.estimate(&linear_samples(rho, n, 1, seed), &protocol, &Seeds::new(1)).unwrap();
                [found[0].interval_low.unwrap(), found[0].value, found[0].interval_high.unwrap()]
            };
            (0..400).map(one).collect()
        };
        let mut highs: Vec<f64> = at(0.0, 20).iter().map(|r| r[2]).collect();
        highs.sort_unstable_by(f64::total_cmp);
        assert!(highs[200] < 0.42 && highs[399] < 1.3, "{} {}", highs[200], highs[399]);
        for (rho, n) in [(0.0, 20), (0.6, 20), (0.6, 50), (0.3, 500)] {
            let truth = -0.5 * libm::log(1.0 - rho * rho);
            let rows = at(rho, n);
            let covered = rows.iter().filter(|[low, _, high]| *low <= truth && truth <= *high).count();
            assert!(rows.iter().all(|[low, value, high]| low <= value && value <= high));
            // 95 % of 400 is 380; 366 or fewer has probability 0.002
            assert!(covered > 366, "{rho} {n}: {covered} of 400");
        }
    }

    #[test]
    fn the_bias_of_many_columns_is_subtracted() {
        let mean: f64 = (0..20).map(|seed| one(&linear_samples(0.0, 200, 8, seed)).value).sum::<f64>() / 20.0;
        // uncorrected: 8 · 8 / (2 · 200) = 0.16
        assert!(mean.abs() < 0.02, "{mean}");
    }

    #[test]
    fn copies_constants_and_collinear_columns_are_named() {
        let x: Vec<Vec<f64>> = (0..50).map(|i| vec![f64::from(i * i % 17), 3.0, f64::from(2 * (i * i % 17))]).collect();
        let y: Vec<Vec<f64>> = x.iter().map(|r| vec![1.0 - r[0]]).collect();
        let found = one(&samples_of(&x, &y));
        assert!(found.value.is_infinite() && found.interval_low.is_none());
        let all = found.warnings.join("; ");
        for part in ["constant, left out: x1", "left out: x2", "infinite (copy): y is a linear function of x", "tied"] {
            assert!(all.contains(part), "{part:?} in {all:?}");
        }
        let constant = Gaussian.estimate(&samples_of(&y, &vec![vec![1.0]; 50]), &Protocol::default(), &Seeds::new(1));
        assert_eq!(constant.unwrap_err(), MiError::Constant { column: "y".to_owned() });
        let few = Gaussian.estimate(&samples_of(&x[..9], &y[..9]), &Protocol::default(), &Seeds::new(1));
        assert_eq!(few.unwrap_err(), MiError::TooFewSamples { needed: 10, widths: 2, found: 9 });
    }
}
