//! Learning curves: training returns in windows of environment steps.

use crate::figure::{Curve, Point};
use crate::report::{ReportError, Run, returns};
use crate::stats::{mean, t_interval};

/// Most points of a curve: as many as a figure can show.
const WINDOWS: usize = 80;

/// Learning curves of one task.
pub(super) struct Curves {
    /// Mean over seeds with its interval, or one curve per run when a series has fewer than three seeds.
    pub lines: Vec<Curve>,
    /// Length of a window, environment steps.
    pub window: f64,
    /// Whether any curve is a mean over seeds.
    pub bands: bool,
    /// One sentence: where each series ended.
    pub seen: String,
}

/// The curves of runs that logged returns; `None` when none did.
///
/// # Errors
/// [`ReportError::Duplicate`].
pub(super) fn curves(runs: &[&Run]) -> Result<Option<Curves>, ReportError> {
    let trained: Vec<&Run> = runs.iter().copied().filter(|r| !r.training.is_empty()).collect();
    let last = trained.iter().flat_map(|r| r.training.iter().map(|t| t.0)).max().unwrap_or(0);
    let Some(rows) = trained.iter().map(|r| r.training.len()).min() else {
        return Ok(None);
    };
    let count = rows.clamp(1, WINDOWS);
    let window = (last.max(1) as f64) / count as f64;
    let mut all = Vec::new();
    let mut ends = Vec::new();
    let mut bands = false;
    for (series, group) in returns::series(&trained)? {
        let runs: Vec<Vec<Option<f64>>> = group.iter().map(|r| windows(&r.training, window, count)).collect();
        let middle = |k: usize| (k as f64 + 0.5) * window;
        if runs.len() >= 3 {
            bands = true;
            let points = (0..count).filter_map(|k| {
                let values: Vec<f64> = runs.iter().filter_map(|r| r[k]).collect();
                let band = t_interval(&values, 0.95).filter(|_| values.len() == runs.len())?;
                Some(Point { step: middle(k), value: mean(&values), band: Some((band.low, band.high)) })
            });
            all.push(Curve { series: series.clone(), points: points.collect() });
        } else {
            for run in &runs {
                let points = run
                    .iter()
                    .enumerate()
                    .filter_map(|(k, value)| Some(Point { step: middle(k), value: (*value)?, band: None }));
                all.push(Curve { series: series.clone(), points: points.collect() });
            }
        }
        let tail = |run: &&Run| {
            let from = run.training.last().map_or(0.0, |t| 0.9 * t.0 as f64);
            mean(&run.training.iter().filter(|t| t.0 as f64 >= from).map(|t| t.1).collect::<Vec<_>>())
        };
        ends.push(format!("{series} {:.1}", mean(&group.iter().map(tail).collect::<Vec<_>>())));
    }
    let seen = format!("Mean return with exploration noise over the last tenth of training: {}.", ends.join("; "));
    Ok(Some(Curves { lines: all, window, bands, seen }))
}

/// Mean of the logged returns in each of `count` windows.
fn windows(training: &[(i64, f64)], window: f64, count: usize) -> Vec<Option<f64>> {
    let mut sums = vec![(0.0, 0_usize); count];
    for &(step, value) in training {
        // a row at step s covers the steps up to s: the window that ends at s takes it
        let place = ((step as f64 / window).ceil() as usize).clamp(1, count) - 1;
        sums[place].0 += value;
        sums[place].1 += 1;
    }
    sums.into_iter().map(|(sum, n)| (n > 0).then(|| sum / n as f64)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registry::Spec;
    use crate::report::published::tests::run;

    #[test]
    fn a_window_takes_the_rows_that_end_in_it() {
        let rows = [(100, 1.0), (200, 3.0), (300, 5.0), (400, 7.0)];
        assert_eq!(windows(&rows, 200.0, 2), [Some(2.0), Some(6.0)]);
        assert_eq!(windows(&rows[..1], 200.0, 2), [Some(1.0), None]);
    }

    #[test]
    fn three_seeds_make_one_curve_with_a_band_and_two_make_two_without() {
        let seeds = |n: u64| -> Vec<Run> {
            (0..n)
                .map(|seed| {
                    let mut r = run("simple_tag", 3, "fc-maddpg", Spec::new("perfect"));
                    r.seed = seed;
                    r.training = vec![(100, seed as f64), (200, seed as f64)];
                    r
                })
                .collect()
        };
        let three = seeds(3);
        let result = curves(&three.iter().collect::<Vec<_>>()).unwrap().unwrap();
        assert_eq!((result.lines.len(), result.bands, result.window), (1, true, 100.0));
        let point = result.lines[0].points[0];
        assert_eq!((point.step, point.value), (50.0, 1.0));
        assert!((point.band.unwrap().1 - 1.0 - 4.302652729696142 / 3.0_f64.sqrt()).abs() < 1e-9);
        let two = seeds(2);
        let result = curves(&two.iter().collect::<Vec<_>>()).unwrap().unwrap();
        assert_eq!((result.lines.len(), result.bands), (2, false));
    }
}
