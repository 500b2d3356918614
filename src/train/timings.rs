//! Where a run's time went: `timings.parquet`, one row per row of metrics. It is the one file of a run that is not the
//! same every time.

use std::path::Path;
use std::time::Instant;

use polars::prelude::{Column, ParquetReader, SerReader as _};

use super::{TrainError, metrics};

const FILE: &str = "timings.parquet";

/// What the time of a run is spent on, in the order of the columns.
#[derive(Clone, Copy, Debug)]
pub(super) enum Phase {
    /// Worlds, acting, links, storing.
    Rollout,
    /// Minibatches, estimators, critic, actors.
    Update,
    /// Tests during training.
    Evaluation,
    /// Writing the run directory.
    Checkpoint,
}

/// The columns of `timings.parquet` after `step` and `update`, each with what it says.
pub const TIMING_COLUMNS: [(&str, &str); 5] = [
    ("rollout_seconds", "wall time spent on worlds, acting, links and storing since the last row"),
    ("update_seconds", "wall time spent on updates since the last row"),
    ("evaluation_seconds", "wall time spent on tests since the last row"),
    ("checkpoint_seconds", "wall time spent on writing the run directory since the last row"),
    (
        "steps_per_second",
        "environment steps since the last row (or the checkpoint that a process went on from), per second of these four together",
    ),
];

/// One row: step, update, and the values of [`TIMING_COLUMNS`].
#[derive(Clone, Copy, Debug, PartialEq)]
struct Row {
    step: u64,
    update: u64,
    values: [f64; TIMING_COLUMNS.len()],
}

/// Adds up the time of each phase.
#[derive(Debug, Default)]
pub(super) struct Clock {
    since: Option<Instant>,
    spent: [f64; 4],
    /// Environment steps where the time that is being counted began.
    from: u64,
    rows: Vec<Row>,
}

impl Clock {
    /// Starts to count.
    pub(super) fn start(&mut self) {
        self.since = Some(Instant::now());
    }

    /// Counts the time since the last call to `phase`.
    pub(super) fn stop(&mut self, phase: Phase) {
        let now = Instant::now();
        if let Some(since) = self.since.replace(now) {
            self.spent[phase as usize] += (now - since).as_secs_f64();
        }
    }

    /// Ends a row.
    pub(super) fn log(&mut self, step: u64, update: u64) {
        self.stop(Phase::Update);
        let [a, b, c, d] = std::mem::take(&mut self.spent);
        let steps = step - std::mem::replace(&mut self.from, step);
        self.rows.push(Row { step, update, values: [a, b, c, d, steps as f64 / (a + b + c + d)] });
    }

    /// Takes over the rows that an earlier process wrote up to `update`, and counts from environment step `step` on. What
    /// cannot be read is left out: it decides nothing.
    pub(super) fn resume(&mut self, dir: &Path, step: u64, update: u64) {
        self.from = step;
        self.rows = crate::io::caught(|| read(&dir.join(FILE))).flatten().unwrap_or_default();
        self.rows.retain(|row| row.update <= update);
    }

    pub(super) fn write(&self, dir: &Path) -> Result<(), TrainError> {
        let whole = |name: &str, value: fn(&Row) -> u64| {
            Column::new(name.into(), self.rows.iter().map(|r| value(r) as i64).collect::<Vec<_>>())
        };
        let mut columns = vec![whole("step", |r| r.step), whole("update", |r| r.update)];
        for (at, (name, _)) in TIMING_COLUMNS.iter().enumerate() {
            columns.push(Column::new((*name).into(), self.rows.iter().map(|r| r.values[at]).collect::<Vec<_>>()));
        }
        metrics::write_parquet(&dir.join(FILE), columns)
    }
}

fn read(path: &Path) -> Option<Vec<Row>> {
    let frame = ParquetReader::new(std::fs::File::open(path).ok()?).finish().ok()?;
    let whole = |name: &str| -> Option<Vec<u64>> {
        frame.column(name).ok()?.i64().ok()?.iter().map(|v| v.and_then(|v| u64::try_from(v).ok())).collect()
    };
    let (steps, updates) = (whole("step")?, whole("update")?);
    let mut rows: Vec<Row> =
        steps.iter().zip(updates).map(|(&step, update)| Row { step, update, values: [0.0; 5] }).collect();
    for (at, (name, _)) in TIMING_COLUMNS.iter().enumerate() {
        let column = frame.column(name).ok()?.f64().ok()?.clone();
        rows.iter_mut().zip(column.iter()).for_each(|(row, value)| row.values[at] = value.unwrap_or(f64::NAN));
    }
    Some(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_an_earlier_process_are_kept_up_to_the_checkpoint() {
        let dir = tempfile::tempdir().unwrap();
        let mut clock = Clock::default();
        for update in 1..=4 {
            clock.start();
            clock.stop(Phase::Rollout);
            clock.log(100 * update, update);
        }
        clock.write(dir.path()).unwrap();
        let mut later = Clock::default();
        later.resume(dir.path(), 350, 3);
        assert_eq!(later.rows, clock.rows[..3]);
        later.spent = [2.0, 0.0, 0.0, 0.0];
        later.log(400, 4);
        assert!((later.rows[3].values[4] - 25.0).abs() < 0.1, "50 steps in two seconds: {:?}", later.rows[3]);
        crate::io::write_atomic(&dir.path().join(FILE), b"not a table").unwrap();
        later.resume(dir.path(), 300, 3);
        assert_eq!(later.rows, []);
    }
}
