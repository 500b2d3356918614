//! # What it is
//!
//! Chooses by what the columns are, and says so. For continuous columns it asks estimators that err in different
//! places, and takes the largest answer.
//!
//! # Definition
//!
//! A side is discrete when its columns are words, or its samples take at most twenty values and n/20. Both sides
//! discrete: `discrete-mm`. Words, or most values of a side repeated: `ksg-mixed`. Else every column is replaced by its normal scores
//! (`gcmi`), which changes no information, and the largest of `gcmi`, `ksg1` and `t-copula` (up to ten columns; the latter not given z,
//! and only if it fits) and `infonce` (from 200 samples in 20 episodes; not given z) is taken: the first and the last are lower
//! bounds, `ksg1` errs to low values in more than two columns, and `t-copula` counts where its own density ratio proves its value.
//!
//! # Shapes and units
//!
//! x `[n, d_x]`, y `[n, d_y]`; nats. One row called `auto`; its first note names the choice and the other values.
//!
//! # Parameters
//!
//! None. Kind and interval are those of the chosen row; where a critic that learned nothing is the largest with its 0, the interval of
//! the next, reaching to 0. The p-value is the smallest of those that have one, times the number of estimators asked
//! (Bonferroni), at most 1.
//!
//! # When it fails
//!
//! The largest of several values leans upwards by about their scatter: 0.01 nats at n = 5000 without dependence, more where samples
//! are not independent. On slow series the p-value rejects too often: 13 of 100 at φ = 0.98. Where all
//! of them are too low it is too low: spirals in three columns and more.
//!
//! # Reference
//!
//! The tasks that the rule was compared on: Czyż, Grabowski, Vogt, Beerenwinkel, Marx 2023, arXiv 2306.11078.
//!
//! # Differences from the reference implementation
//!
//! None: the rule is ours.

use super::counts::Categories;
use super::gcmi::in_scores;
use super::neighbours::DEPENDENT;
use super::prepare::tied;
use super::t_copula::{LIGHT, MISFIT};
use super::{Build, ESTIMATORS, Estimate, Estimator, MiError, NOTE, Protocol};
use crate::registry::{Entry, RegistryError, Spec, find};
use crate::rng::Seeds;
use crate::schema::{Columns, Samples};

/// The registry's entry.
pub(super) const ENTRY: Entry<Build> = Entry {
    name: "auto",
    summary: "chooses by types, ties, width and size, cross-checks, and says why",
    reference: "compared on the tasks of Czyz et al. 2023, arXiv 2306.11078",
    value: None,
    build,
};

/// Most values of a discrete side that is not words.
const VALUES: usize = 20;
/// Most columns for nearest neighbours.
const NARROW: usize = 10;
/// Fewest samples, and episodes, for a trained critic.
const TRAINABLE: (usize, usize) = (200, 20);

struct Auto;

fn build(spec: &Spec) -> Result<Box<dyn Estimator>, RegistryError> {
    spec.no_params()?;
    Ok(Box::new(Auto))
}

/// What to ask, and why.
#[derive(Debug, PartialEq, Eq)]
struct Choice {
    estimators: Vec<&'static str>,
    /// Whether columns are replaced by their normal scores.
    scores: bool,
    why: String,
}

impl Estimator for Auto {
    fn estimate(&self, samples: &Samples, protocol: &Protocol, seeds: &Seeds) -> Result<Vec<Estimate>, MiError> {
        let choice = choose(samples);
        let scored = choice.scores.then(|| in_scores(samples));
        let mut rows = Vec::new();
        let asked = choice.estimators.len() as f64;
        for name in &choice.estimators {
            let built = find("estimator", ESTIMATORS, name).and_then(|entry| (entry.build)(&Spec::new(name)));
            // the names are our own: there is nothing to report
            let Ok(estimator) = built else { continue };
            // the last row of `discrete` is the corrected one
            rows.extend(estimator.estimate(scored.as_ref().unwrap_or(samples), protocol, &seeds.child(name))?.pop());
        }
        let least = rows.iter().filter_map(|r| r.p_value).reduce(f64::min);
        // a copula that does not fit is no answer, and one without tails is gcmi's
        rows.retain(|r| !r.warnings.iter().any(|w| w.starts_with(MISFIT) || w.starts_with(LIGHT)));
        // nor is one whose neighbours tell of time, where there is another
        let tells_of_time = |r: &Estimate| r.warnings.iter().any(|w| w.starts_with(DEPENDENT));
        if !rows.iter().all(tells_of_time) {
            rows.retain(|r| !tells_of_time(r));
        }
        let values = rows.iter().map(|r| format!("{} {:.3}", r.estimator, r.value)).collect::<Vec<_>>().join(", ");
        let Some(mut row) = largest(rows) else { return Ok(Vec::new()) };
        let others = if asked > 1.0 { format!(", the largest of {values} on normal scores") } else { String::new() };
        row.warnings.insert(0, format!("{NOTE}{} chosen: {}{others}", row.estimator, choice.why));
        "auto".clone_into(&mut row.estimator);
        row.p_value = least.map(|p| (p * asked).min(1.0));
        Ok(vec![row])
    }

    fn takes_words(&self) -> bool {
        true
    }

    fn takes_given(&self) -> bool {
        true
    }
}

/// The row with the largest value. One without an interval (a critic that learned nothing, whose 0 is a floor) takes the
/// interval and the warnings of the next, reaching to its value.
fn largest(mut rows: Vec<Estimate>) -> Option<Estimate> {
    let place = |rows: &[Estimate]| {
        let places = 0..rows.len();
        places.reduce(|best, next| if rows[next].value > rows[best].value { next } else { best })
    };
    let mut row = rows.remove(place(&rows)?);
    if row.interval_low.is_none()
        && row.value.is_finite()
        && let Some(next) = place(&rows).map(|at| rows.swap_remove(at))
    {
        row.interval_low = next.interval_low.map(|low| low.min(row.value));
        row.interval_high = next.interval_high.map(|high| high.max(row.value));
        (row.warnings, row.n, row.n_effective) = (next.warnings, next.n, next.n_effective);
    }
    Some(row)
}

fn choose(samples: &Samples) -> Choice {
    let (n, labels) = (samples.len(), &samples.labels);
    let words = |c: &Columns| (0..c.width()).filter(|&i| c.is_words(i)).count();
    let distinct = |c: &Columns| {
        let of = Categories::new(c).of;
        let mut found: Vec<u32> = samples.rows.iter().map(|&r| of[r as usize]).collect();
        found.sort_unstable();
        found.dedup();
        found.len()
    };
    let few = |c: &Columns| words(c) == c.width() || distinct(c) <= VALUES.min(n / 20);
    let sides = || [&samples.x, &samples.y].into_iter().chain(&samples.z);
    if sides().all(|c| few(c)) {
        let why = format!("{} and {} take few values", labels.x, labels.y);
        return Choice { estimators: vec!["discrete"], scores: false, why };
    }
    let repeated = tied(samples).is_some();
    if repeated || sides().any(|c| words(c) > 0) {
        let why = if repeated { "values repeat" } else { "words beside numbers" };
        return Choice { estimators: vec!["ksg-mixed"], scores: false, why: why.to_owned() };
    }
    let width: usize = sides().map(|c| c.width()).sum();
    let mut estimators = vec!["gcmi"];
    if width <= NARROW {
        estimators.push("ksg1");
        if samples.z.is_none() {
            estimators.push("t-copula");
        }
    }
    let mut episodes = samples.episodes();
    episodes.dedup();
    if samples.z.is_none() && n >= TRAINABLE.0 && episodes.len() >= TRAINABLE.1 {
        estimators.push("infonce");
    }
    Choice { estimators, scores: true, why: format!("{width} continuous columns, {n} samples") }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::mi::run::tests::{linear_samples, samples_of};
    use crate::rng;

    fn one(samples: &Samples) -> Estimate {
        Auto.estimate(samples, &Protocol { permutations: 99 }, &Seeds::new(1)).unwrap().remove(0)
    }

    fn column(values: impl Iterator<Item = f64>) -> Vec<Vec<f64>> {
        values.map(|v| vec![v]).collect()
    }

    #[test]
    fn the_choice_follows_what_the_columns_are() {
        let names = |samples: &Samples| choose(samples).estimators;
        let normal = linear_samples(0.5, 400, 1, 1);
        assert_eq!(names(&normal), ["gcmi", "ksg1", "t-copula", "infonce"]);
        assert_eq!(names(&linear_samples(0.5, 400, 6, 1)), ["gcmi", "infonce"]);
        assert_eq!(names(&linear_samples(0.5, 150, 1, 1)), ["gcmi", "ksg1", "t-copula"]);
        let given = Samples { z: Some(Arc::clone(&normal.x)), ..normal.clone() };
        assert_eq!(names(&given), ["gcmi", "ksg1"]);
        let die = column((0..400).map(|i| f64::from(i * i % 7)));
        let coin = column((0..400).map(|i| f64::from(i % 2)));
        assert_eq!(names(&samples_of(&die, &coin)), ["discrete"]);
        let numbers = column(normal.x.data.iter().copied());
        assert_eq!(names(&samples_of(&numbers, &coin)), ["ksg-mixed"]);
        let mut words = samples_of(&numbers, &column((0..400).map(f64::from)));
        words.y = Arc::new(Columns { words: vec![true], ..(*words.y).clone() });
        assert_eq!(names(&words), ["ksg-mixed"]);
        assert_eq!(choose(&words).why, "words beside numbers");
    }

    #[test]
    fn the_largest_row_has_an_interval_that_holds_it() {
        let labels = crate::schema::SampleLabels::default();
        let row = |name: &str, value: f64, ends: Option<(f64, f64)>| {
            let mut row = Estimate::new(name, &labels, value, crate::mi::Unit::Nats, crate::mi::Kind::Estimate, 9);
            (row.interval_low, row.interval_high) = ends.unzip();
            row
        };
        let rows = [row("a", -0.2, Some((-0.3, -0.1))), row("b", -0.1, Some((-0.2, -0.05))), row("c", 0.0, None)];
        let found = largest(rows.to_vec()).unwrap();
        assert_eq!((found.estimator.as_str(), found.interval_low, found.interval_high), ("c", Some(-0.2), Some(0.0)));
        assert_eq!(largest(rows[..2].to_vec()).unwrap(), rows[1]);
        assert_eq!(largest(vec![rows[2].clone()]).unwrap().interval_low, None);
        let copy = [row("a", 1.0, Some((0.9, 1.1))), row("b", f64::INFINITY, None)];
        assert_eq!(largest(copy.to_vec()).unwrap().interval_low, None);
        assert!(largest(Vec::new()).is_none());
    }

    #[test]
    fn dependence_of_every_shape_is_found_and_none_is_not() {
        let mut rng = Seeds::new(2).stream("shapes");
        let x: Vec<f64> = (0..2000).map(|_| rng::normal(&mut rng)).collect();
        let noise: Vec<f64> = (0..2000).map(|_| rng::normal(&mut rng)).collect();
        let linear = samples_of(
            &column(x.iter().copied()),
            &column(x.iter().zip(&noise).map(|(x, e)| 0.75 * x + 0.4375f64.sqrt() * e)),
        );
        let found = one(&linear);
        assert!((found.value - 0.4133).abs() < 0.05 && found.p_value.unwrap() <= 0.05, "{found:?}");
        assert_eq!(found.estimator, "auto");
        assert!(found.warnings[0].starts_with("note: ") && found.warnings[0].contains("gcmi 0."), "{found:?}");
        // y = x² + noise/10: no correlation, KSG 1.99
        let square = column(x.iter().zip(&noise).map(|(x, e)| x * x + 0.1 * e));
        let found = one(&samples_of(&column(x.iter().copied()), &square));
        assert!((found.value - 1.99).abs() < 0.15 && found.warnings[0].contains("ksg1:3 chosen"), "{found:?}");
        let none = one(&samples_of(&column(x.iter().copied()), &column(noise.iter().copied())));
        assert!(none.value < 0.05 && none.p_value.unwrap() > 0.05, "{none:?}");
        // monotone changes of a column change nothing
        let bent = samples_of(&column(x.iter().map(|x| x.exp())), &column(linear.y.data.iter().map(|y| y.powi(3))));
        assert_eq!(one(&bent).value, one(&linear).value);
    }
}
