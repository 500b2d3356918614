//! All jobs of a command in parallel: every set of samples with every estimator, in a fixed order.

use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::{Estimate, Estimator, Kind, MiError, Protocol, Unit};
use crate::rng::Seeds;
use crate::schema::{SampleLabels, Samples};

/// An estimator and its name.
pub type Named = (String, Box<dyn Estimator>);

/// What to run.
pub struct Plan {
    /// Estimators with their names.
    pub estimators: Vec<Named>,
    /// What all hold to.
    pub protocol: Protocol,
    /// Root of all randomness.
    pub seed: u64,
}

/// One estimator on one set of samples.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Job {
    /// Estimator.
    pub estimator: String,
    /// Samples.
    pub labels: SampleLabels,
}

/// How a job ended.
#[derive(Debug)]
pub struct JobResult {
    /// Which job.
    pub job: Job,
    /// Its rows, or why there are none.
    pub rows: Result<Vec<Estimate>, MiError>,
}

/// Runs every estimator on every set of samples on rayon's current pool; `done` is called after each job.
///
/// The result does not depend on the number of threads: a job's randomness comes from its name.
pub fn run(samples: &[Samples], plan: &Plan, done: &(dyn Fn() + Sync)) -> Vec<JobResult> {
    let results = std::sync::Mutex::new(Vec::new());
    run_each(samples, plan, &AtomicBool::new(false), &|place, result| {
        results.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push((place, result));
        done();
    });
    let results = results.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    in_order(results, plan.estimators.len())
}

/// As [`run()`], but hands out each result, with its place among all, as soon as it is there; once `stop` is raised, no
/// job is started.
pub fn run_each(samples: &[Samples], plan: &Plan, stop: &AtomicBool, tell: &(dyn Fn(usize, JobResult) + Sync)) {
    let jobs: Vec<(&Samples, &Named)> =
        samples.iter().flat_map(|s| plan.estimators.iter().map(move |e| (s, e))).collect();
    jobs.par_iter().enumerate().for_each(|(place, &(samples, (name, estimator)))| {
        if stop.load(Ordering::SeqCst) {
            return;
        }
        let labels = samples.labels.clone();
        let seeds = job_seeds(plan.seed, &labels, name);
        let rows = fits(samples, &**estimator).and_then(|()| estimator.estimate(samples, &plan.protocol, &seeds));
        tell(place, JobResult { job: Job { estimator: name.clone(), labels }, rows });
    });
}

/// Results by their places among all jobs, rows of the same samples compared with each other; some may be missing.
/// `estimators` is the number of them that run on the same samples.
pub fn in_order(mut results: Vec<(usize, JobResult)>, estimators: usize) -> Vec<JobResult> {
    let per_samples = estimators.max(1);
    results.sort_by_key(|(place, _)| *place);
    for same_samples in results.chunk_by_mut(|a, b| a.0 / per_samples == b.0 / per_samples) {
        compare(same_samples);
    }
    results.into_iter().map(|(_, result)| result).collect()
}

/// What a job draws from.
pub fn job_seeds(seed: u64, labels: &SampleLabels, estimator: &str) -> Seeds {
    let command = Seeds::new(seed).child("estimate-mi");
    command.child(&format!("{}/{}/{:?}", labels.x, labels.y, labels.delivered)).child(estimator)
}

/// Whether the estimator can take the samples at all.
///
/// # Errors
/// [`MiError::Given`], [`MiError::Words`].
pub fn fits(samples: &Samples, estimator: &dyn Estimator) -> Result<(), MiError> {
    if samples.z.is_some() && !estimator.takes_given() {
        return Err(MiError::Given);
    }
    let all = [&samples.x, &samples.y].into_iter().chain(&samples.z);
    let words: Vec<&str> =
        all.flat_map(|c| (0..c.width()).filter(|&i| c.is_words(i)).map(|i| c.names[i].as_str())).collect();
    if words.is_empty() || estimator.takes_words() {
        return Ok(());
    }
    Err(MiError::Words { columns: words.join(", ") })
}

/// An upper bound below a lower bound of the same samples is none.
fn compare(results: &mut [(usize, JobResult)]) {
    let rows = || results.iter().flat_map(|r| r.1.rows.iter().flatten());
    let lower = rows()
        .filter(|r| r.kind == Kind::LowerBound && r.unit == Unit::Nats)
        .filter_map(|r| Some((r.interval_low?, r.estimator.clone())))
        .filter(|(low, _)| *low > 0.0)
        .max_by(|a, b| a.0.total_cmp(&b.0));
    let Some((low, name)) = lower else { return };
    for row in results.iter_mut().flat_map(|r| r.1.rows.iter_mut().flatten()) {
        if row.kind == Kind::UpperBound && row.value + 1e-3 < low {
            row.warnings.push(format!("below the lower bound {name} ({low:.3}): q fits badly, this is no upper bound"));
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::mi::ESTIMATORS;
    use crate::registry::Spec;
    use crate::rng;
    use crate::schema::{Columns, Exchange};

    /// Samples from rows, each its own episode; columns x0, x1, … and y0, y1, …
    pub(in crate::mi) fn samples_of(x: &[Vec<f64>], y: &[Vec<f64>]) -> Samples {
        let columns = |rows: &[Vec<f64>], name: &str| {
            let names = (0..rows[0].len()).map(|i| format!("{name}{i}")).collect();
            Arc::new(Columns::new(rows.concat(), names))
        };
        Samples {
            x: columns(x, "x"),
            y: columns(y, "y"),
            z: None,
            starts: (0..=x.len()).collect::<Vec<_>>().into(),
            rows: (0..x.len() as u32).collect(),
            exchange: Exchange::Episodes,
            labels: SampleLabels {
                x: "x".to_owned(),
                y: "y".to_owned(),
                group: "row".to_owned(),
                ..SampleLabels::default()
            },
            notes: Vec::new(),
        }
    }

    /// `width` columns on either side, the first pair correlated by `rho`, all else independent normals.
    pub(in crate::mi) fn linear_samples(rho: f64, n: usize, width: usize, seed: u64) -> Samples {
        let mut rng = Seeds::new(seed).stream("linear");
        let mut draw = |width: usize| (0..width).map(|_| rng::normal(&mut rng)).collect::<Vec<f64>>();
        let (mut x, mut y) = (Vec::new(), Vec::new());
        for _ in 0..n {
            let (a, mut b) = (draw(width), draw(width));
            b[0] = rho * a[0] + (1.0 - rho * rho).sqrt() * b[0];
            x.push(a);
            y.push(b);
        }
        samples_of(&x, &y)
    }

    pub(in crate::mi) fn plan(names: &[&str], permutations: usize, seed: u64) -> Plan {
        let build = |name: &&str| {
            let entry = crate::registry::find("estimator", ESTIMATORS, name).unwrap();
            ((*name).to_owned(), (entry.build)(&Spec::new(name)).unwrap())
        };
        Plan { estimators: names.iter().map(build).collect(), protocol: Protocol { permutations }, seed }
    }

    fn rows(samples: &Samples, plan: &Plan) -> Vec<Estimate> {
        run(std::slice::from_ref(samples), plan, &|| ()).into_iter().flat_map(|r| r.rows.unwrap()).collect()
    }

    #[test]
    fn independent_wide_data_give_nothing_on_held_out_rows() {
        let rows = rows(&linear_samples(0.0, 1000, 10, 1), &plan(&["jsd", "gaussian"], 99, 1));
        for row in rows.iter().filter(|r| r.kind == Kind::LowerBound) {
            assert!(row.value <= 0.02, "{}: {}", row.estimator, row.value);
        }
        assert!(rows.iter().all(|r| r.p_value.unwrap() > 0.01), "{rows:?}");
    }

    #[test]
    fn club_below_a_lower_bound_says_so() {
        let labels = SampleLabels::default();
        let job = |row: Estimate| JobResult {
            job: Job { estimator: row.estimator.clone(), labels: labels.clone() },
            rows: Ok(vec![row]),
        };
        let upper = Estimate::new("club", &labels, 0.1, Unit::Nats, Kind::UpperBound, 9);
        let other = upper.clone();
        let mut lower = Estimate::new("jsd-nwj", &labels, 0.5, Unit::Nats, Kind::LowerBound, 9);
        lower.interval_low = Some(0.4);
        let results = in_order(vec![(3, job(lower)), (0, job(other)), (2, job(upper))], 2);
        assert_eq!(results[0].rows.as_ref().unwrap()[0].warnings, [""; 0], "other samples");
        let warnings = &results[1].rows.as_ref().unwrap()[0].warnings;
        assert_eq!(*warnings, ["below the lower bound jsd-nwj (0.400): q fits badly, this is no upper bound"]);
    }

    #[test]
    fn a_raised_flag_starts_nothing_new() {
        let sets: Vec<Samples> = (0..20).map(|i| linear_samples(0.6, 100, 1, i)).collect();
        let (plan, stop) = (plan(&["gaussian"], 0, 1), AtomicBool::new(false));
        let told = std::sync::Mutex::new(Vec::new());
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        pool.install(|| {
            run_each(&sets, &plan, &stop, &|place, result| {
                told.lock().unwrap().push((place, result));
                stop.store(told.lock().unwrap().len() == 3, Ordering::SeqCst);
            });
        });
        let told = in_order(told.into_inner().unwrap(), 1);
        assert_eq!(told.len(), 3);
        let whole = run(&sets, &plan, &|| ());
        let value = |r: &JobResult| r.rows.as_ref().unwrap()[0].value;
        assert!(told.iter().all(|r| whole.iter().any(|w| value(w) == value(r))));
    }

    #[test]
    fn results_do_not_depend_on_the_number_of_threads() {
        let sets: Vec<Samples> = (0..3).map(|i| linear_samples(0.6, 300, 2, i)).collect();
        let plan = plan(&["gaussian", "club", "jsd"], 19, 5);
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let results = pool.install(|| run(&sets, &plan, &|| ()));
            results.into_iter().flat_map(|r| r.rows.unwrap()).collect::<Vec<_>>()
        };
        assert_eq!(with(1), with(3));
    }
}
