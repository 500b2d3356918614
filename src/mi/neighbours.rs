//! What the nearest-neighbour estimators share: their row, its interval and its p-value, whatever the terms that they
//! average.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use statrs::function::gamma::digamma;

use super::counts::Categories;
use super::gaussian::{copy, determined};
use super::given::{NO_NULL, cells, too_wide};
use super::interval::{block_interval, t_quantile};
use super::knn::{Points, Tree, within};
use super::part::Part;
use super::prepare::{all_tied, points, tied};
use super::{Estimate, Kind, MiError, Protocol, Unit, p_value};
use crate::registry::{RegistryError, Spec};
use crate::rng::Seeds;
use crate::schema::{Columns, Samples};
use crate::stats::mean;

/// Standardised distances that differ by less are equal: what rounding makes of values on a grid.
const SAME: f64 = 1e-14;
/// The same, as a share of the distance.
const SAME_SHARE: f64 = 1e-9;

/// The variance times the number m of samples grows as m/(m + 9 k): measured on normals without dependence, k = 3, as 0.34
/// at m = 50, 0.43 at 100, 0.48 at 250, 0.51 at 500; it grows less with dependence.
const GROWTH: f64 = 9.0;

/// Samples per value of a discrete side, in k, under which the value is said to be too high.
const PER_VALUE: usize = 4;

/// Most values of a side of numbers that counts as discrete; more are steps of a continuous scale.
const NUMBERS: usize = 20;

/// Samples among which it is looked whether those of an episode are neighbours because they follow each other.
const FOLLOWED: usize = 4000;

/// What the warning begins with that they are.
pub(super) const DEPENDENT: &str = "samples of an episode are each other's neighbours";

/// Joint columns above which the estimate is said to be too low.
const WIDE: usize = 8;

/// The local terms of an estimator, `[n]` in nats: their mean is the estimate. Takes x, y and k.
pub(super) type Terms = fn(&Points, &Points, usize) -> Vec<f64>;

/// The local terms given z. Takes x, y, z and k.
pub(super) type TermsGiven = fn(&Points, &Points, &Points, usize) -> Vec<f64>;

/// Parameters of a nearest-neighbour estimator.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Params {
    k: usize,
}

impl Default for Params {
    fn default() -> Self {
        Self { k: 3 }
    }
}

/// A nearest-neighbour estimator.
pub(super) struct Neighbours {
    pub(super) name: &'static str,
    pub(super) k: usize,
    pub(super) terms: Terms,
    /// The terms given z, if it has such.
    pub(super) given: Option<TermsGiven>,
    /// Whether it is made for values that occur more than once.
    pub(super) for_ties: bool,
}

impl Neighbours {
    /// Reads k from the parameters.
    pub(super) fn new(
        name: &'static str,
        spec: &Spec,
        terms: Terms,
        given: Option<TermsGiven>,
        for_ties: bool,
    ) -> Result<Self, RegistryError> {
        let Params { k } = spec.params()?;
        spec.in_range("k", k as f64, 1.0, 1000.0)?;
        Ok(Self { name, k, terms, given, for_ties })
    }

    /// The row.
    pub(super) fn row(&self, samples: &Samples, protocol: Protocol, seeds: &Seeds) -> Result<Estimate, MiError> {
        let (labels, n) = (&samples.labels, samples.len());
        let needed = (self.k + 1).max(10);
        if n < needed {
            return Err(MiError::TooFewSamples { needed, widths: samples.x.width() + samples.y.width(), found: n });
        }
        let mut warnings = samples.notes.clone();
        let x = points(&samples.x, &samples.rows, &labels.x, &mut warnings)?;
        let y = points(&samples.y, &samples.rows, &labels.y, &mut warnings)?;
        let label = labels.given.as_deref().unwrap_or_default();
        let z = samples.z.as_deref().map(|z| points(z, &samples.rows, label, &mut warnings)).transpose()?;
        let width = x.width + y.width + z.as_ref().map_or(0, |z| z.width);
        let all = Part::all(samples);
        // the rows of `from` give x, those of `rows` y and z
        let terms = |from: &[u32], rows: &[u32]| match (&z, self.given) {
            (Some(z), Some(given)) => given(&picked(&x, from), &picked(&y, rows), &picked(z, rows), self.k),
            _ => (self.terms)(&picked(&x, from), &picked(&y, rows), self.k),
        };
        let local = terms(&all.rows, &all.rows);
        let value = mean(&local);
        let name = format!("{}:{}", self.name, self.k);
        let mut out = Estimate::new(&name, labels, value, Unit::Nats, Kind::Estimate, n);
        out.n_effective = block_interval(&local, &samples.episodes()).n_effective;
        let statistic = |from: &[u32], rows: &[u32]| mean(&terms(from, rows));
        let limits = Limits::of(width);
        let wide_z = z.as_ref().and_then(|z| too_wide(z.width));
        let part = Part::drawn(samples, limits.interval, &seeds.child("interval"));
        let subsampled = part.subsampled_error(n, 4 * (self.k + 1), seeds, &|rows| statistic(rows, rows));
        if let Some(of) = subsampled.filter(|_| wide_z.is_none()) {
            // what more samples would still change is an error too, of known sign: in more than two columns no small one
            let (half, drift) =
                (of.error_on(n, GROWTH * self.k as f64) * t_quantile(of.degrees + 1), of.drift(value, n));
            (out.interval_low, out.interval_high) =
                (Some(value - half + drift.min(0.0)), Some(value + half + drift.max(0.0)));
        }
        let part = Part::drawn(samples, limits.null, &seeds.child("null"));
        if let Some(why) = wide_z {
            warnings.push(why);
            warnings.push(
                "no interval: among neighbours in so many columns of z, z still tells of both x and y".to_owned(),
            );
        } else if protocol.permutations > 0 {
            let under_null = |from: &[u32]| statistic(from, &part.rows);
            let null = match &z {
                None => Some(part.null(samples, protocol, seeds, &under_null)),
                Some(z) => part.null_within(&cells(&picked(z, &part.rows)), protocol, seeds, &under_null),
            };
            match null {
                Some(null) => out.p_value = p_value(under_null(&part.rows), &null),
                None => warnings.push(NO_NULL.to_owned()),
            }
        }
        if out.p_value.is_some_and(|p| p > 0.05) {
            out.interval_low = out.interval_low.map(|low| low.min(0.0));
        }
        for (columns, label) in [(&samples.x, &labels.x), (&samples.y, &labels.y)] {
            warnings.extend(self.few_per_value(columns, &samples.rows, label).filter(|_| self.for_ties));
        }
        let followed = followed(samples, [&x, &y], z.as_ref(), self.k, seeds);
        if let Some(share) = followed {
            (out.interval_low, out.interval_high) = (None, None);
            warnings.push(format!(
                "{DEPENDENT}: in {:.0} % of them the next one is nearer than the k-th neighbour, so the value is too high; take one \
                 step per episode (of a store: --where 'step = 12'), or gcmi",
                100.0 * share
            ));
        }
        if all.len() < 20 {
            warnings.push(format!("few blocks: the interval rests on {} episodes", all.len()));
        }
        if !self.for_ties {
            if z.is_none() && determined(&picked(&x, &all.rows), &picked(&y, &all.rows)) {
                out.value = f64::INFINITY;
                (out.interval_low, out.interval_high) = (None, None);
                warnings.push(copy(labels));
            }
            warnings.extend(tied(samples));
        }
        // all that k neighbours among n samples can show
        let ceiling = digamma(n as f64) - digamma(self.k as f64);
        if out.value.is_finite() && value > 0.8 * ceiling {
            warnings.push(format!("near the ceiling of ψ(n) − ψ(k) = {ceiling:.2}: the truth may be far higher"));
        }
        if width >= WIDE && followed.is_none() {
            warnings.push(format!("{width} columns: nearest neighbours see too little dependence in so many"));
        }
        out.warnings = warnings;
        Ok(out)
    }
}

/// The share of samples whose next one in the same episode is nearer than their k-th neighbour, if it is more than chance
/// makes it: then neighbours tell of time (Theiler 1986), and the estimate is too high.
fn followed(samples: &Samples, sides: [&Points; 2], z: Option<&Points>, k: usize, seeds: &Seeds) -> Option<f64> {
    let part = Part::drawn(samples, FOLLOWED, &seeds.child("followed"));
    if part.len() == part.rows.len() {
        return None;
    }
    let parts: Vec<Points> = sides.into_iter().chain(z).map(|side| picked(side, &part.rows)).collect();
    let joint = Points::joined(&parts.iter().collect::<Vec<_>>());
    let (radii, blocks) = (Tree::new(&joint).kth(k), part.blocks());
    let pairs: Vec<usize> = (0..joint.len() - 1).filter(|&i| blocks[i] == blocks[i + 1]).collect();
    let is_near = |i: usize| {
        let sides = joint.row(i).iter().zip(joint.row(i + 1));
        sides.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) < radii[i] * (1.0 - SAME_SHARE)
    };
    let share = pairs.iter().filter(|&&i| is_near(i)).count() as f64 / pairs.len().max(1) as f64;
    (share > 0.05 + 4.0 * k as f64 / joint.len() as f64).then_some(share)
}

impl Neighbours {
    /// Says when a discrete side has few samples per value: neighbours then come from other values.
    fn few_per_value(&self, columns: &Columns, rows: &[u32], label: &str) -> Option<String> {
        let words = (0..columns.width()).all(|c| columns.is_words(c));
        if !words && !all_tied(columns, rows) {
            return None;
        }
        let of = Categories::new(columns).of;
        let values: BTreeSet<u32> = rows.iter().map(|&r| of[r as usize]).collect();
        if !words && values.len() > NUMBERS {
            return None;
        }
        (rows.len() < PER_VALUE * self.k * values.len()).then(|| {
            let each = (rows.len() as f64 / values.len() as f64).round();
            format!("about {each} samples per value of {label}, k = {}: the value is too high", self.k)
        })
    }
}

/// The radius, inclusive, within which points are closer than `distance`; at distance 0: within which they are equal.
pub(super) fn closer_than(distance: f64) -> f64 {
    if distance <= SAME { SAME } else { distance - SAME.max(SAME_SHARE * distance) }
}

/// The radius, inclusive, within which points are no farther than `distance`.
pub(super) fn up_to(distance: f64) -> f64 {
    distance + SAME.max(SAME_SHARE * distance)
}

/// Whether points at this distance are equal.
pub(super) fn is_zero(distance: f64) -> bool {
    distance <= SAME
}

/// Samples behind what is computed many times over; less where neighbours cost more.
struct Limits {
    interval: usize,
    null: usize,
}

impl Limits {
    fn of(width: usize) -> Self {
        if width <= 4 { Self { interval: 20_000, null: 4000 } } else { Self { interval: 6000, null: 1500 } }
    }
}

fn picked(points: &Points, rows: &[u32]) -> Points {
    let data = rows.iter().flat_map(|&r| points.row(r as usize).iter().copied()).collect();
    Points { data, width: points.width }
}

/// The value of `ksg1` alone, in nats, on rows that are finite and already scaled: x `[n, d_x]`, y `[n, d_y]`.
///
/// # Panics
/// When there are fewer than k + 1 rows, or not as many of y as of x.
pub fn ksg1_value(x: &Columns, y: &Columns, k: usize) -> f64 {
    assert!(k > 0 && x.rows() > k && x.rows() == y.rows(), "ksg1 needs pairs, and more of them than neighbours");
    let points = |c: &Columns| Points { data: c.data.clone(), width: c.width() };
    mean(&super::ksg1::terms(&points(x), &points(y), k))
}

/// ψ(1), …, ψ(n) at their index, by ψ(m + 1) = ψ(m) + 1/m; index 0 is not used.
pub(super) fn digammas(n: usize) -> Vec<f64> {
    let mut out = Vec::with_capacity(n + 1);
    out.push(f64::NAN);
    let mut psi = digamma(1.0);
    for m in 1..=n {
        out.push(psi);
        psi += 1.0 / m as f64;
    }
    out
}

/// The local terms given z, from the radius and the number of neighbours of each sample.
pub(super) fn given_terms(
    [x, y, z]: [&Points; 3],
    radii: &[f64],
    psi: &[f64],
    neighbours: impl Fn(usize) -> usize,
) -> Vec<f64> {
    let in_xz = within(&Points::joined(&[x, z]), radii);
    let in_yz = within(&Points::joined(&[y, z]), radii);
    let in_z = within(z, radii);
    let of = |count: u32| psi[count as usize];
    (0..z.len()).map(|i| psi[neighbours(i)] + of(in_z[i]) - of(in_xz[i]) - of(in_yz[i])).collect()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::mi::ESTIMATORS;
    use crate::mi::run::tests::{linear_samples, samples_of};
    use crate::rng;

    /// Two independent AR(1) series in episodes of ten steps.
    fn slow(phi: f64, episodes: usize) -> Samples {
        let mut rng = Seeds::new(8).stream("slow");
        let mut column = || {
            let mut rows = Vec::new();
            for _ in 0..episodes {
                let mut value = rng::normal(&mut rng);
                for _ in 0..10 {
                    rows.push(vec![value]);
                    value = phi * value + (1.0 - phi * phi).sqrt() * rng::normal(&mut rng);
                }
            }
            rows
        };
        let (x, y) = (column(), column());
        Samples { starts: (0..=episodes).map(|e| 10 * e).collect::<Vec<_>>().into(), ..samples_of(&x, &y) }
    }

    #[test]
    fn neighbours_that_tell_of_time_are_said_and_auto_takes_another() {
        let one = |name: &str, samples: &Samples| {
            let entry = crate::registry::find("estimator", ESTIMATORS, name).unwrap();
            let built = (entry.build)(&Spec::new(name)).unwrap();
            built.estimate(samples, &Protocol { permutations: 19 }, &Seeds::new(1)).unwrap().remove(0)
        };
        let says = |row: &Estimate| row.warnings.iter().any(|w| w.starts_with(DEPENDENT));
        let dependent = slow(0.998, 100);
        for name in ["ksg1", "ksg2", "ksg-mixed"] {
            let found = one(name, &dependent);
            assert!(found.value > 0.2 && says(&found) && found.interval_low.is_none(), "{found:?}");
            let free = one(name, &slow(0.0, 100));
            assert!(!says(&free) && free.interval_low.is_some(), "{free:?}");
        }
        let auto = one("auto", &dependent);
        assert!(auto.value < 0.2 && !says(&auto), "{auto:?}");
    }

    /// Points of two widths with correlated first columns; `levels` > 0 rounds to so many steps per unit.
    pub(in crate::mi) fn pair(n: usize, widths: [usize; 2], levels: f64, seed: u64) -> (Points, Points) {
        let mut rng = Seeds::new(seed).stream("pair");
        let (mut x, mut y) = (Vec::new(), Vec::new());
        let rounded = |v: f64| if levels > 0.0 { (v * levels).round() / levels } else { v };
        for _ in 0..n {
            let shared = rng::normal(&mut rng);
            x.extend((0..widths[0]).map(|_| rounded(0.8 * shared + 0.6 * rng::normal(&mut rng))));
            y.extend((0..widths[1]).map(|_| rounded(0.8 * shared + 0.6 * rng::normal(&mut rng))));
        }
        (Points { data: x, width: widths[0] }, Points { data: y, width: widths[1] })
    }

    /// Holds `terms` to `reference`, which compares all pairs: given the distances in x and y from i to all others, in
    /// billionths, it returns the term of i.
    pub(in crate::mi) fn assert_equals_all_pairs(terms: Terms, reference: fn(&[[u64; 2]], usize) -> f64) {
        for (case, (n, widths)) in
            [(40, [1, 1]), (300, [1, 1]), (257, [1, 3]), (300, [2, 2]), (150, [5, 5]), (64, [25, 25])]
                .into_iter()
                .enumerate()
        {
            for (levels, k) in [(0.0, 3), (0.0, 1), (0.0, 10), (10.0, 3), (2.0, 4), (0.5, 3)] {
                let (x, y) = pair(n, widths, levels, case as u64);
                let apart = |p: &Points, i: usize, j: usize| {
                    let widest = p.row(i).iter().zip(p.row(j)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    (widest * 1e9).round() as u64
                };
                let found = terms(&x, &y, k);
                assert_eq!(found.len(), n);
                for (i, found) in found.into_iter().enumerate() {
                    let others = (0..n).filter(|&j| j != i);
                    let distances: Vec<[u64; 2]> = others.map(|j| [apart(&x, i, j), apart(&y, i, j)]).collect();
                    let expected = reference(&distances, k);
                    assert!(
                        (found - expected).abs() < 1e-7,
                        "n {n} levels {levels} k {k} point {i}: {found} {expected}"
                    );
                }
            }
        }
    }

    fn row(name: &str, samples: &Samples, permutations: usize) -> Estimate {
        let spec = Spec::parse("estimator", ESTIMATORS, name).unwrap();
        let estimator = (crate::registry::find("estimator", ESTIMATORS, &spec.name).unwrap().build)(&spec).unwrap();
        estimator.estimate(samples, &Protocol { permutations }, &Seeds::new(1)).unwrap().remove(0)
    }

    #[test]
    fn the_correlated_normal_is_recovered_by_all() {
        for (rho, truth) in [(0.0, 0.0), (0.75, 0.4133), (0.95, 1.1640)] {
            let samples = linear_samples(rho, 3000, 1, 5);
            for name in ["ksg1", "ksg2", "ksg-mixed"] {
                let found = row(name, &samples, 39);
                assert_eq!(found.estimator, format!("{name}:3"));
                assert!((found.value - truth).abs() < 0.05, "{name} {rho}: {}", found.value);
                let (low, high) = (found.interval_low.unwrap(), found.interval_high.unwrap());
                assert!(low < truth + 0.02 && truth - 0.02 < high && high - low < 0.16, "{name} {rho}: {low} {high}");
                assert_eq!(found.p_value.unwrap() <= 0.05, rho > 0.0, "{name} {rho}: {:?}", found.p_value);
                assert!(found.warnings.is_empty(), "{:?}", found.warnings);
            }
        }
    }

    #[test]
    fn k_is_read_from_the_name_and_bounded() {
        let samples = linear_samples(0.5, 200, 1, 1);
        assert_eq!(row("ksg", &samples, 0).estimator, "ksg1:3");
        assert_eq!(row("ksg:5", &samples, 0), row("ksg1:5", &samples, 0));
        for (text, message) in [
            ("ksg1:0", "ksg1: k must be in [1, 1000], found 0"),
            ("ksg2:1001", "ksg2: k must be in [1, 1000], found 1001"),
            ("ksg-mixed:1.5", "ksg-mixed: k: invalid type: floating point `1.5`, expected usize"),
        ] {
            let spec = Spec::parse("estimator", ESTIMATORS, text).unwrap();
            let entry = crate::registry::find("estimator", ESTIMATORS, &spec.name).unwrap();
            assert_eq!((entry.build)(&spec).err().unwrap().to_string(), message);
        }
    }

    #[test]
    fn copies_ties_many_columns_and_few_samples_are_named() {
        let normal = linear_samples(0.5, 200, 1, 1);
        let copied = Samples { y: std::sync::Arc::clone(&normal.x), ..normal.clone() };
        let found = row("ksg", &copied, 0);
        assert!(found.value.is_infinite() && found.interval_low.is_none());
        assert_eq!(found.warnings, ["infinite (copy): y is a linear function of x"]);
        let steps: Vec<Vec<f64>> = (0..60).map(|i| vec![f64::from(i * i % 7)]).collect();
        let others: Vec<Vec<f64>> = (0..60).map(|i| vec![f64::from(i * 7 % 5)]).collect();
        let tied = row("ksg2", &samples_of(&steps, &others), 0).warnings.join("; ");
        assert!(tied.contains("more than once; ksg-mixed and discrete are made for such"), "{tied}");
        assert_eq!(row("ksg-mixed", &samples_of(&steps, &others), 0).warnings, [""; 0]);
        let bent: Vec<Vec<f64>> = normal.x.data.iter().map(|&v| vec![(0.3 * v).exp()]).collect();
        let x: Vec<Vec<f64>> = normal.x.data.iter().map(|&v| vec![v]).collect();
        let near = row("ksg", &samples_of(&x, &bent), 0).warnings.join("; ");
        assert!(near.contains("near the ceiling of ψ(n) − ψ(k) = 4.37"), "{near}");
        let wide = row("ksg", &linear_samples(0.5, 200, 4, 1), 0).warnings.join("; ");
        assert!(wide.contains("8 columns: nearest neighbours see too little"), "{wide}");
        let few = linear_samples(0.5, 10, 1, 1);
        let spec = Spec::parse("estimator", ESTIMATORS, "ksg:10").unwrap();
        let estimator = (ESTIMATORS.iter().find(|e| e.name == "ksg").unwrap().build)(&spec).unwrap();
        let error = estimator.estimate(&few, &Protocol::default(), &Seeds::new(1)).unwrap_err();
        assert_eq!(error, MiError::TooFewSamples { needed: 11, widths: 2, found: 10 });
    }

    #[test]
    fn given_terms_equal_comparing_all_pairs_and_the_common_cause_explains() {
        for levels in [0.0, 3.0] {
            let (x, y) = pair(200, [1, 2], levels, 7);
            let (z, _) = pair(200, [2, 1], levels, 8);
            let apart = |p: &Points, i: usize, j: usize| {
                let widest = p.row(i).iter().zip(p.row(j)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                (widest * 1e9).round() as u64
            };
            let found = crate::mi::ksg1::terms_given(&x, &y, &z, 3);
            for (i, found) in found.into_iter().enumerate() {
                let others: Vec<[u64; 3]> =
                    (0..200).filter(|&j| j != i).map(|j| [apart(&x, i, j), apart(&y, i, j), apart(&z, i, j)]).collect();
                let mut joint: Vec<u64> = others.iter().map(|d| d[0].max(d[1]).max(d[2])).collect();
                joint.sort_unstable();
                let radius = joint[2].max(1);
                let psi = |of: &dyn Fn(&[u64; 3]) -> u64| {
                    digamma(1.0 + others.iter().filter(|d| of(d) < radius).count() as f64)
                };
                let expected = digamma(3.0) + psi(&|d| d[2]) - psi(&|d| d[0].max(d[2])) - psi(&|d| d[1].max(d[2]));
                assert!((found - expected).abs() < 1e-7, "{levels} {i}: {found} {expected}");
            }
        }
        // x = c + e, y = c + f: dependent, and given c not
        let noise = linear_samples(0.0, 1500, 2, 3);
        let column = |of: &dyn Fn(&[f64], &[f64]) -> f64| -> Vec<Vec<f64>> {
            (0..1500).map(|r| vec![of(noise.x.row(r), noise.y.row(r))]).collect()
        };
        let mut samples = samples_of(&column(&|a, b| a[0] + 0.5 * b[0]), &column(&|a, b| a[0] + 0.5 * b[1]));
        samples.labels.given = Some("c".to_owned());
        let causes = [column(&|a, _| a[0]), column(&|a, _| a[1])].map(|z| samples_of(&z, &z).x);
        for name in ["ksg1", "ksg-mixed"] {
            let [explained, useless] = causes
                .each_ref()
                .map(|z| row(name, &Samples { z: Some(std::sync::Arc::clone(z)), ..samples.clone() }, 39));
            // x and y correlate by 0.8: −½ ln 0.36 = 0.5108
            assert!(explained.value.abs() < 0.06 && explained.p_value.unwrap() > 0.02, "{name}: {explained:?}");
            assert!((useless.value - 0.5108).abs() < 0.1 && useless.p_value == Some(0.025), "{name}: {useless:?}");
            assert_eq!(useless.given.as_deref(), Some("c"));
        }
        samples.z = Some(std::sync::Arc::clone(&causes[0]));
        samples.starts = (0..=150).map(|e| 10 * e).collect::<Vec<_>>().into();
        let trajectories = row("ksg1", &samples, 39);
        assert_eq!((trajectories.p_value, trajectories.warnings), (None, vec![NO_NULL.to_owned()]));
    }

    #[test]
    fn wide_z_leaves_no_p_value_and_no_interval() {
        let noise = linear_samples(0.0, 300, 8, 3);
        let column = |c: usize| -> Vec<Vec<f64>> {
            (0..300).map(|r| vec![noise.x.row(r)[0] + 0.4 * noise.y.row(r)[c]]).collect()
        };
        for width in [3, 4, 8] {
            let z: Vec<Vec<f64>> = (0..300).map(|r| noise.x.row(r)[..width].to_vec()).collect();
            let mut samples = samples_of(&column(0), &column(1));
            samples.z = Some(samples_of(&z, &z).x);
            for name in ["ksg1", "ksg-mixed"] {
                let found = row(name, &samples, 39);
                let told = |start: &str| found.warnings.iter().any(|w| w.starts_with(start));
                assert_eq!(
                    (found.p_value.is_some(), found.interval_low.is_some()),
                    (width == 3, width == 3),
                    "{found:?}"
                );
                assert_eq!((told("no p-value"), told("no interval")), (width > 3, width > 3), "{found:?}");
            }
        }
    }

    #[test]
    fn noise_beside_words_of_few_samples_is_said_to_be_too_high_and_may_be_nothing() {
        for (words, few) in [(28, true), (7, true), (3, false)] {
            let mut above = 0;
            for seed in 0..10 {
                let mut rng = Seeds::new(seed).stream("words");
                let x: Vec<Vec<f64>> = (0..60).map(|_| vec![rng::normal(&mut rng)]).collect();
                let y: Vec<Vec<f64>> = (0..60).map(|_| vec![rng::below(&mut rng, words) as f64]).collect();
                let mut samples = samples_of(&x, &y);
                samples.y = std::sync::Arc::new(Columns { words: vec![true], ..(*samples.y).clone() });
                let found = row("ksg-mixed", &samples, 99);
                let told =
                    found.warnings.iter().any(|w| w.contains("samples per value of y, k = 3: the value is too high"));
                assert_eq!(told, few, "{words}: {:?}", found.warnings);
                above += usize::from(found.interval_low.is_some_and(|low| low > 0.0));
                assert!(found.p_value.unwrap() <= 0.05 || found.interval_low.is_none_or(|low| low <= 0.0), "{found:?}");
            }
            // as many as p-values are small
            assert!(above <= 3, "{words}: {above} of 10 intervals above 0");
        }
    }

    #[test]
    fn the_interval_covers_the_truth_as_often_as_it_says() {
        let truth = 0.413339;
        let covered = (0..100)
            .filter(|&seed| {
                let found = row("ksg", &linear_samples(0.75, 400, 1, 1000 + seed), 0);
                found.interval_low.unwrap() <= truth && truth <= found.interval_high.unwrap()
            })
            .count();
        // 95 % of 100: 89 or fewer has probability 0.01, all has 0.006
        assert!((89..=100).contains(&covered), "{covered}");
    }

    #[test]
    fn digamma_by_recurrence_keeps_its_digits() {
        let table = digammas(100_000);
        for m in [1, 2, 10, 1000, 100_000] {
            assert!((table[m] - digamma(m as f64)).abs() < 1e-11, "{m}");
        }
    }
}
