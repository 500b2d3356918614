//! Estimators on tasks of known information: how far off, and how often the interval holds the truth.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};

use polars::prelude::Column;
use rayon::prelude::*;
use serde::Serialize;

use super::form::{Row, number, text};
use super::tasks::Task;
use super::{Estimate, Kind, Plan, Unit};
use crate::rng::{Seeds, Stream};
use crate::schema::Samples;

/// What samples of known information are drawn from.
pub trait Source: Send + Sync {
    /// Its name, which its random numbers come from.
    fn id(&self) -> String;
    /// Its information, nats.
    fn truth(&self) -> f64;
    /// About `n` samples.
    fn samples(&self, n: usize, rng: &mut Stream) -> Samples;
}

impl Source for Task {
    fn id(&self) -> String {
        self.id.to_owned()
    }

    fn truth(&self) -> f64 {
        self.truth
    }

    fn samples(&self, n: usize, rng: &mut Stream) -> Samples {
        Self::samples(self, n, rng)
    }
}

/// One estimator on one task, over seeds.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Calibrated {
    /// Task.
    pub task: String,
    /// Its information, nats.
    pub truth: f64,
    /// Estimator.
    pub estimator: String,
    /// What its value is to the truth.
    pub kind: Kind,
    /// Seeds that gave a finite value.
    pub seeds: usize,
    /// Mean of the values, nats.
    pub mean: f64,
    /// Standard deviation of the values, nats; none of one seed.
    pub deviation: Option<f64>,
    /// Mean absolute error, nats.
    pub error: f64,
    /// Share of the intervals that hold the truth; none without intervals.
    pub covered: Option<f64>,
    /// Share of the p-values that are at most 0.05: false positives where the truth is 0, else the power; none without
    /// p-values.
    pub rejected: Option<f64>,
}

impl Row for Calibrated {
    fn columns(rows: &[Self]) -> Vec<Column> {
        vec![
            text("task", rows, |r| Some(r.task.clone())),
            number("truth", rows, |r| Some(r.truth)),
            text("estimator", rows, |r| Some(r.estimator.clone())),
            text("kind", rows, |r| Some(r.kind.name().to_owned())),
            Column::new("seeds".into(), rows.iter().map(|r| r.seeds as u64).collect::<Vec<u64>>()),
            number("mean", rows, |r| Some(r.mean)),
            number("deviation", rows, |r| r.deviation),
            number("error", rows, |r| Some(r.error)),
            number("covered", rows, |r| r.covered),
            number("rejected", rows, |r| r.rejected),
        ]
    }
}

impl Calibrated {
    /// Whether the mean is within a tenth of the truth, or 0.03 nats.
    pub fn is_right(&self) -> bool {
        (self.mean - self.truth).abs() <= (0.1 * self.truth).max(0.03)
    }
}

/// The rows of one estimator by their names, in the order of first appearance.
type ByName = Vec<(String, Vec<Estimate>)>;

/// The rows of all estimators on one draw of one task, each with its estimator's place in the plan.
pub struct Drawn {
    task: usize,
    seed: u64,
    rows: Vec<(usize, Estimate)>,
}

/// Runs every estimator of the plan on `seeds` draws of `n` samples of every task, in parallel, and hands out each draw
/// as soon as it is there; once `stop` is raised, no draw is started.
pub fn calibrate<S: Source>(
    tasks: &[S],
    plan: &Plan,
    n: usize,
    seeds: u64,
    stop: &AtomicBool,
    tell: &(dyn Fn(Drawn) + Sync),
) {
    let root = Seeds::new(plan.seed).child("calibrate");
    let draws: Vec<(usize, u64)> = (0..tasks.len()).flat_map(|t| (0..seeds).map(move |s| (t, s))).collect();
    draws.par_iter().filter(|_| !stop.load(Ordering::SeqCst)).for_each(|&(task, seed)| {
        let own = root.child(&tasks[task].id()).indexed("seed", seed);
        let samples = tasks[task].samples(n, &mut own.stream("samples"));
        let of = |(place, (name, estimator)): (usize, &super::Named)| {
            let rows = estimator.estimate(&samples, &plan.protocol, &own.child(name)).unwrap_or_default();
            rows.into_iter().map(move |row| (place, row))
        };
        let rows = plan.estimators.iter().enumerate().flat_map(of).collect();
        tell(Drawn { task, seed, rows });
    });
}

/// What draws say about estimators, by task and then by estimator; some draws may be missing. Values on another scale
/// than nats are left out.
pub fn calibrated<S: Source>(tasks: &[S], mut draws: Vec<Drawn>) -> Vec<Calibrated> {
    draws.sort_by_key(|draw| (draw.task, draw.seed));
    // by task, by estimator as asked, and by its rows as they come
    let mut groups: BTreeMap<(usize, usize), ByName> = BTreeMap::new();
    for Drawn { task, rows, .. } in draws {
        let finite = |r: &(usize, Estimate)| r.1.unit == Unit::Nats && r.1.value.is_finite();
        for (place, row) in rows.into_iter().filter(finite) {
            let group = groups.entry((task, place)).or_default();
            match group.iter().position(|(name, _)| *name == row.estimator) {
                Some(at) => group[at].1.push(row),
                None => group.push((row.estimator.clone(), vec![row])),
            }
        }
    }
    let summaries = |((t, _), group): ((usize, usize), ByName)| {
        group.into_iter().map(move |(estimator, rows)| summary(&tasks[t], estimator, &rows))
    };
    groups.into_iter().flat_map(summaries).collect()
}

fn summary(task: &impl Source, estimator: String, rows: &[Estimate]) -> Calibrated {
    let n = rows.len() as f64;
    let mean = rows.iter().map(|r| r.value).sum::<f64>() / n;
    let squares: f64 = rows.iter().map(|r| (r.value - mean) * (r.value - mean)).sum();
    let intervals: Vec<(f64, f64)> = rows.iter().filter_map(|r| r.interval_low.zip(r.interval_high)).collect();
    let truth = task.truth();
    let holding = intervals.iter().filter(|(low, high)| *low <= truth && truth <= *high).count();
    let p_values: Vec<f64> = rows.iter().filter_map(|r| r.p_value).collect();
    let small = p_values.iter().filter(|p| **p <= 0.05).count();
    Calibrated {
        task: task.id(),
        truth,
        estimator,
        kind: rows[0].kind,
        seeds: rows.len(),
        mean,
        deviation: (rows.len() > 1).then(|| libm::sqrt(squares / (n - 1.0))),
        error: rows.iter().map(|r| (r.value - truth).abs()).sum::<f64>() / n,
        covered: (!intervals.is_empty()).then(|| holding as f64 / intervals.len() as f64),
        rejected: (!p_values.is_empty()).then(|| small as f64 / p_values.len() as f64),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mi::TASKS;
    use crate::mi::run::tests::plan;

    fn all(tasks: &[Task], plan: &Plan, n: usize, seeds: u64) -> Vec<Calibrated> {
        let told = std::sync::Mutex::new(Vec::new());
        calibrate(tasks, plan, n, seeds, &AtomicBool::new(false), &|draw| told.lock().unwrap().push(draw));
        calibrated(tasks, told.into_inner().unwrap())
    }

    #[test]
    fn exact_estimators_are_right_on_their_own_tasks_and_seeds_and_threads_do_not_mix() {
        let tasks: Vec<Task> = TASKS.iter().filter(|t| t.id.starts_with("multinormal-dense-3")).copied().collect();
        let found = all(&tasks, &plan(&["gaussian", "ksg1"], 0, 1), 2000, 10);
        assert_eq!(found.iter().map(|c| c.estimator.as_str()).collect::<Vec<_>>(), ["gaussian", "ksg1:3"]);
        let gaussian = &found[0];
        assert!(gaussian.is_right() && gaussian.error < 0.03 && gaussian.covered.unwrap() >= 0.7, "{gaussian:?}");
        assert!(gaussian.seeds == 10 && gaussian.deviation.unwrap() < 0.04, "{gaussian:?}");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let alone = pool.install(|| all(&tasks, &plan(&["gaussian"], 0, 1), 2000, 10));
        assert_eq!(alone[0], found[0]);
    }

    #[test]
    fn an_estimator_that_fails_on_a_draw_leaves_the_others_in_their_places() {
        struct Moody;
        impl crate::mi::Estimator for Moody {
            fn estimate(
                &self,
                samples: &Samples,
                _: &crate::mi::Protocol,
                _: &Seeds,
            ) -> Result<Vec<Estimate>, crate::mi::MiError> {
                if samples.x.data[0] > 0.0 {
                    return Err(crate::mi::MiError::Diverged { columns: String::new() });
                }
                Ok(vec![Estimate::new("moody", &samples.labels, 0.5, Unit::Nats, Kind::Estimate, 9)])
            }
        }
        let mut plan = plan(&["gaussian"], 0, 1);
        plan.estimators.insert(0, ("moody".to_owned(), Box::new(Moody)));
        let found = all(&TASKS[..1], &plan, 50, 20);
        let names: Vec<(&str, bool)> = found.iter().map(|c| (c.estimator.as_str(), c.seeds == 20)).collect();
        assert_eq!(names, [("moody", false), ("gaussian", true)]);
    }

    #[test]
    fn a_summary_by_hand() {
        let labels = crate::schema::SampleLabels::default();
        let row = |value, low, high| {
            let mut row = Estimate::new("e", &labels, value, Unit::Nats, Kind::Estimate, 9);
            (row.interval_low, row.interval_high) = (Some(low), Some(high));
            row
        };
        let task = TASKS[3];
        let mut rows = [row(0.3, 0.2, 0.32), row(0.4, 0.3, 0.5)];
        (rows[0].p_value, rows[1].p_value) = (Some(0.05), Some(0.06));
        let found = summary(&task, "e".to_owned(), &rows);
        assert!((found.mean - 0.35).abs() < 1e-12 && (found.error - 0.05).abs() < 1e-12);
        assert!((found.deviation.unwrap() - 0.005f64.sqrt()).abs() < 1e-12);
        assert_eq!((found.covered, found.is_right(), found.rejected), (Some(0.5), true, Some(0.5)));
    }
}
