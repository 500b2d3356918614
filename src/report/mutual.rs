//! Mutual-information tables: reading them, choosing what a heat map shows.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::figure::Cell;
use crate::io::sha256_file;
use crate::report::ReportError;
use crate::report::columns::Columns;

/// Estimators that are preferred for the heat map, best first; else the first of the file.
const PREFERRED: [&str; 1] = ["jsd-plugin"];

/// One file of estimates.
#[derive(Clone, Debug)]
pub(super) struct MutualFile {
    /// Where it came from.
    pub path: PathBuf,
    /// Its digest.
    pub sha256: String,
    /// Its rows, as they stand.
    pub rows: Vec<Estimate>,
}

/// One row of estimates: design's output row.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Estimate {
    pub estimator: String,
    pub x: String,
    pub y: String,
    pub sender: Option<String>,
    pub receiver: Option<String>,
    pub delivered: Option<bool>,
    pub value: Option<f64>,
    pub unit: String,
    pub kind: String,
    pub interval: Option<(f64, f64)>,
    pub p_value: Option<f64>,
    pub n: i64,
    pub warnings: String,
}

impl Estimate {
    /// `delivered`, `lost` or `all messages`.
    pub(super) fn class(&self) -> &'static str {
        match self.delivered {
            Some(true) => "delivered",
            Some(false) => "lost",
            None => "all messages",
        }
    }
}

/// Reads a table of estimates.
///
/// # Errors
/// [`ReportError`] that names column and file.
pub(super) fn read(path: &Path) -> Result<MutualFile, ReportError> {
    let table = Columns::open_filled(path)?;
    let (estimator, x, y) = (table.text("estimator")?, table.text("x")?, table.text("y")?);
    let (sender, receiver) = (table.text_or_null("sender")?, table.text_or_null("receiver")?);
    let (delivered, value) = (table.bits_or_null("delivered")?, table.numbers_or_null("value")?);
    let (unit, kind) = (table.text("unit")?, table.text("kind")?);
    let (low, high) = (table.numbers_or_null("interval_low")?, table.numbers_or_null("interval_high")?);
    let (p_value, n, warnings) =
        (table.numbers_or_null("p_value")?, table.whole("n")?, table.text_or_null("warnings")?);
    let rows = (0..n.len()).map(|i| Estimate {
        estimator: estimator[i].clone(),
        x: x[i].clone(),
        y: y[i].clone(),
        sender: sender[i].clone(),
        receiver: receiver[i].clone(),
        delivered: delivered[i],
        value: value[i],
        unit: unit[i].clone(),
        kind: kind[i].clone(),
        interval: low[i].zip(high[i]),
        p_value: p_value[i],
        n: n[i],
        warnings: warnings[i].clone().unwrap_or_default(),
    });
    Ok(MutualFile { path: path.to_owned(), sha256: sha256_file(path)?.0, rows: rows.collect() })
}

/// What a heat map of one file shows.
pub(super) struct Map {
    /// The estimator drawn.
    pub estimator: String,
    /// Its unit.
    pub unit: String,
    /// `estimate`, `lower bound` or `upper bound`.
    pub kind: String,
    /// Cells, delivered panel first.
    pub cells: Vec<Cell>,
    /// One sentence: means over links.
    pub seen: String,
}

/// Chooses the estimator and lays out its links; `None` when no row names sender and receiver with a finite value.
pub(super) fn map(file: &MutualFile) -> Option<Map> {
    let links = || {
        file.rows
            .iter()
            .filter_map(|r| Some((r, r.sender.as_ref()?, r.receiver.as_ref()?, r.value.filter(|v| v.is_finite())?)))
    };
    let preferred = PREFERRED.iter().find_map(|name| links().find(|(r, ..)| r.estimator == *name));
    let chosen = preferred.or_else(|| links().next())?.0;
    let mut agents: Vec<&String> = links().flat_map(|(_, s, r, _)| [s, r]).collect();
    agents.sort_by_key(|a| (a.len(), *a)); // agent_2 before agent_10
    agents.dedup();
    let mut cells = Vec::new();
    let mut words = Vec::new();
    for class in ["delivered", "lost", "all messages"] {
        let of_class: Vec<_> =
            links().filter(|(r, ..)| r.estimator == chosen.estimator && r.class() == class).collect();
        if of_class.is_empty() {
            continue;
        }
        for sender in &agents {
            for receiver in &agents {
                let found = of_class.iter().find(|(_, s, r, _)| s == sender && r == receiver);
                cells.push(Cell {
                    panel: class.to_owned(),
                    sender: (*sender).clone(),
                    receiver: (*receiver).clone(),
                    value: found.map_or(f64::NAN, |f| f.3),
                });
            }
        }
        let values: Vec<f64> = of_class.iter().map(|f| f.3).collect();
        let mean = crate::stats::mean(&values);
        words.push(format!("{class} {mean:.3} {} on average over {} links", chosen.unit, values.len()));
    }
    let bound = match chosen.kind.as_str() {
        "estimate" => String::new(),
        kind => format!(" The value is a {kind}."),
    };
    let seen = format!("{}: {}.{bound}", chosen.estimator, words.join("; "));
    let (estimator, unit, kind) = (chosen.estimator.clone(), chosen.unit.clone(), chosen.kind.clone());
    Some(Map { estimator, unit, kind, cells, seen })
}

/// A value as a reader wants it: a deterministic copy has infinitely many nats.
pub(super) fn number(value: Option<f64>) -> String {
    match value {
        None => "–".to_owned(),
        Some(v) if v == f64::INFINITY => "infinite".to_owned(),
        Some(v) if v.is_nan() => "undefined".to_owned(),
        Some(v) => format!("{v:.4}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn estimate(estimator: &str, sender: &str, receiver: &str, delivered: bool, value: f64) -> Estimate {
        Estimate {
            estimator: estimator.to_owned(),
            x: "message".to_owned(),
            y: "action".to_owned(),
            sender: Some(sender.to_owned()),
            receiver: Some(receiver.to_owned()),
            delivered: Some(delivered),
            value: Some(value),
            unit: "nats".to_owned(),
            kind: "lower bound".to_owned(),
            interval: None,
            p_value: None,
            n: 10,
            warnings: String::new(),
        }
    }

    #[test]
    fn the_map_prefers_the_plug_in_estimate_and_keeps_classes_apart() {
        let rows = vec![
            estimate("jsd", "a", "b", true, 9.0),
            estimate("jsd-plugin", "a", "b", true, 0.4),
            estimate("jsd-plugin", "b", "a", true, 0.6),
            estimate("jsd-plugin", "a", "b", false, 0.0),
        ];
        let map = map(&MutualFile { path: PathBuf::new(), sha256: String::new(), rows }).unwrap();
        assert_eq!(map.estimator, "jsd-plugin");
        assert_eq!(map.cells.len(), 8, "2 panels of 2 by 2");
        assert!(map.cells[0].value.is_nan() && map.cells[1].value == 0.4 && map.cells[5].value == 0.0);
        assert_eq!(
            map.seen,
            "jsd-plugin: delivered 0.500 nats on average over 2 links; lost 0.000 nats on average over 1 links. The \
             value is a lower bound."
        );
    }
}
