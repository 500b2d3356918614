//! What a run reports while it learns: one row per logging interval, as Parquet and as `TensorBoard` events.

use std::path::Path;

use polars::prelude::{Column, DataFrame, ParquetWriter};

use super::{TrainError, tensorboard};

/// The nullable columns of `metrics.parquet`, in order, each with what it says.
pub const METRIC_COLUMNS: [(&str, &str); 16] = [
    ("return_mean", "mean return of the training episodes since the last row, with exploration noise"),
    ("td_loss", "mean squared TD error of the minibatches, before each step"),
    ("actor_objective", "mean Q(o, π(o, M)), which the actors climb"),
    ("q_mean", "mean Q(o, a) of the minibatches"),
    ("critic_grad_norm", "mean L2 norm of the critic's gradient before clipping"),
    ("actor_grad_norm", "mean of the largest actor gradient norm before clipping"),
    ("encoder_grad_norm", "mean of the largest message encoder's gradient norm before clipping"),
    (
        "jsd",
        "JSD value of the estimator's minibatches (shifted scale unless configured), not nats; messages as sent, or with \
pairs = \"replay\" as message encoders would send them now",
    ),
    ("jsd_heldout", "JSD value of pairs that the critic had not learned from; messages as sent"),
    ("club", "CLUB value of the estimator's minibatches, nats; messages as for jsd"),
    ("club_heldout", "CLUB value of pairs that q had not learned from, nats; messages as sent"),
    ("shaping_mean", "mean shaping bonus per transition"),
    ("shaping_std", "standard deviation of the shaping bonus over the minibatch"),
    ("loss_rate", "share of messages lost in the training episodes since the last row"),
    ("noise_scale", "scale of the exploration noise"),
    ("evaluation_return", "mean return of the last test over the training prior, without noise (protocol standard)"),
];

/// The columns before them, which every row has.
pub const METRIC_KEYS: [(&str, &str); 3] = [
    ("step", "environment steps so far, all worlds together"),
    ("update", "updates so far"),
    ("episode", "training episodes so far"),
];

/// One row of metrics.
#[derive(Clone, Debug, PartialEq)]
pub struct MetricsRow {
    /// Environment steps so far.
    pub step: u64,
    /// Updates so far.
    pub update: u64,
    /// Episodes so far.
    pub episode: u64,
    /// Values in the order of [`METRIC_COLUMNS`]; `None` where nothing was measured.
    pub values: [Option<f64>; METRIC_COLUMNS.len()],
}

impl MetricsRow {
    /// Numbers that a row is in a checkpoint.
    pub(super) const NUMBERS: usize = METRIC_KEYS.len() + METRIC_COLUMNS.len();

    pub(super) fn to_numbers(&self) -> Vec<f64> {
        let keys = [self.step, self.update, self.episode].map(|key| key as f64);
        keys.into_iter().chain(self.values.iter().map(|v| v.unwrap_or(f64::NAN))).collect()
    }

    pub(super) fn from_numbers(numbers: &[f64]) -> Self {
        let at = |i: usize| numbers.get(i).copied().unwrap_or(f64::NAN);
        Self {
            step: at(0) as u64,
            update: at(1) as u64,
            episode: at(2) as u64,
            values: std::array::from_fn(|i| Some(at(METRIC_KEYS.len() + i)).filter(|v| !v.is_nan())),
        }
    }
}

/// Means over a logging interval. Survives a checkpoint as plain numbers.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Means {
    pub(super) sums: [f64; METRIC_COLUMNS.len()],
    pub(super) counts: [f64; METRIC_COLUMNS.len()],
}

impl Means {
    /// Adds one observation of the column `name`.
    pub(super) fn add(&mut self, name: &str, value: impl Into<Option<f64>>) {
        if let (Some(value), Some(at)) = (value.into(), METRIC_COLUMNS.iter().position(|(n, _)| *n == name)) {
            self.sums[at] += value;
            self.counts[at] += 1.0;
        }
    }

    /// The means, and a fresh start.
    pub(super) fn take(&mut self) -> [Option<f64>; METRIC_COLUMNS.len()] {
        let Self { sums, counts } = std::mem::take(self);
        std::array::from_fn(|i| (counts[i] > 0.0).then(|| sums[i] / counts[i]))
    }
}

/// Writes a data frame as Parquet, whole or not at all.
pub(super) fn write_parquet(path: &Path, columns: Vec<Column>) -> Result<(), TrainError> {
    let height = columns.first().map_or(0, Column::len);
    let mut frame = DataFrame::new(height, columns)?;
    let mut bytes = Vec::new();
    ParquetWriter::new(&mut bytes).finish(&mut frame)?;
    Ok(crate::io::write_atomic(path, &bytes)?)
}

/// Writes `metrics.parquet` and the `TensorBoard` events of a run.
pub(super) fn write(dir: &Path, rows: &[MetricsRow]) -> Result<(), TrainError> {
    let whole = |name: &str, value: fn(&MetricsRow) -> u64| {
        Column::new(name.into(), rows.iter().map(|r| value(r) as i64).collect::<Vec<_>>())
    };
    let mut columns = vec![whole("step", |r| r.step), whole("update", |r| r.update), whole("episode", |r| r.episode)];
    for (at, (name, _)) in METRIC_COLUMNS.iter().enumerate() {
        columns.push(Column::new((*name).into(), rows.iter().map(|r| r.values[at]).collect::<Vec<_>>()));
    }
    write_parquet(&dir.join("metrics.parquet"), columns)?;
    let events: Vec<(i64, Vec<(&str, f64)>)> = rows
        .iter()
        .map(|row| {
            let values = METRIC_COLUMNS.iter().zip(row.values).filter_map(|((name, _), v)| Some((*name, v?))).collect();
            (row.step as i64, values)
        })
        .collect();
    Ok(crate::io::write_atomic(&dir.join("events.out.tfevents.ccmarl"), &tensorboard::event_file(&events))?)
}
