//! Rows of estimates: how they are printed, which file they go to, and what is said about jobs that gave none.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::outputs::{self, Write};
use super::ui;
use crate::mi::{self, Estimate, Job, JobResult, Kind};
use crate::schema::{SampleLabels, Samples};
use crate::{Error, io};

/// A job that gave no rows, and why.
pub(super) type Failure = (Job, mi::MiError);

/// How the rows are written to a file of this name, which must not hold anything that is not ours.
pub(super) fn writer(path: &Path, inputs: &[PathBuf], force: bool) -> anyhow::Result<Write<Estimate>> {
    let real = |p: &Path| p.canonicalize().ok();
    if real(path).is_some() && inputs.iter().any(|input| real(path) == real(input)) {
        let message = format!("--out would replace the input: {}", path.display());
        return Err(Error::Usage(message).into());
    }
    Ok(outputs::table(path, force)?)
}

/// All rows, and the jobs that gave none; an error when no job gave any.
pub(super) fn split(results: Vec<JobResult>) -> Result<(Vec<Estimate>, Vec<Failure>), Error> {
    let (mut rows, mut failures) = (Vec::new(), Vec::new());
    for JobResult { job, rows: result } in results {
        match result {
            Ok(found) => rows.extend(found),
            Err(error) => failures.push((job, error)),
        }
    }
    match failures.pop() {
        Some((_, error)) if rows.is_empty() => Err(error.into()),
        last => {
            failures.extend(last);
            Ok((rows, failures))
        }
    }
}

/// The word for a class of messages.
pub(super) fn class(delivered: bool) -> &'static str {
    if delivered { "delivered" } else { "lost" }
}

/// `agent_0 → agent_1 delivered`, or `a,b → c`; behind a comma, which part of the data.
pub(super) fn place(labels: &SampleLabels) -> String {
    let within = labels.within.as_ref().map_or(String::new(), |within| format!(", {within}"));
    if let Some(delivered) = labels.delivered {
        let agent = |agent: &Option<String>| agent.clone().unwrap_or_else(|| "all".to_owned());
        let lag = labels.y.rsplit_once("[+").map_or(String::new(), |(_, lag)| format!(" [+{lag}"));
        return format!("{} → {} {}{lag}{within}", agent(&labels.sender), agent(&labels.receiver), class(delivered));
    }
    match &labels.given {
        Some(given) => format!("{} ; {} | {given}{within}", labels.x, labels.y),
        None => format!("{} ; {}{within}", labels.x, labels.y),
    }
}

/// What stands before a value that is a bound.
pub(super) fn sign(kind: Kind) -> &'static str {
    match kind {
        Kind::LowerBound => "≥ ",
        Kind::UpperBound => "≤ ",
        Kind::Estimate => "",
    }
}

/// Four decimals, and no minus sign before a zero.
pub(super) fn decimals(value: f64) -> String {
    let text = format!("{value:.4}");
    if text == "-0.0000" { "0.0000".to_owned() } else { text }
}

/// The rows as a table for people, with their warnings below.
pub(super) fn print(rows: &[Estimate], samples: &[Samples]) -> anyhow::Result<()> {
    let mut warnings: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    let mut lines = Vec::new();
    let mut places = rows.iter().map(|row| {
        samples.iter().map(|s| &s.labels).find(|l| {
            (&l.x, &l.y, &l.sender, &l.receiver) == (&row.x, &row.y, &row.sender, &row.receiver)
                && (l.delivered, &l.group) == (row.delivered, &row.group)
        })
    });
    let mut before = String::new();
    for row in rows {
        let here = places.next().flatten().map(place).unwrap_or_default();
        let sign = sign(row.kind);
        let value = if row.value.is_infinite() {
            "infinite (copy)".to_owned()
        } else {
            format!("{sign}{}", decimals(row.value))
        };
        let interval = row.interval_low.zip(row.interval_high);
        lines.push(vec![
            if here == before { String::new() } else { here.clone() },
            row.estimator.clone(),
            value,
            interval.map_or_else(String::new, |(low, high)| format!("{} … {}", decimals(low), decimals(high))),
            row.unit.name().to_owned(),
            row.p_value.map_or_else(String::new, mi::p_text),
            row.n.to_string(),
            format!("{:.0}", row.n_effective),
        ]);
        for warning in &row.warnings {
            let named = warnings.entry(warning).or_default();
            if !named.contains(&here) {
                named.push(here.clone());
            }
        }
        before = here;
    }
    ui::print_table(&["samples", "estimator", "value", "95 % interval", "unit", "p", "n", "n_eff"], &lines)?;
    if samples.iter().any(|s| s.labels.group.split(',').next() == Some("row")) {
        ui::print("each row was taken as independent; give --group or --time if rows belong together")?;
    }
    for (warning, places) in warnings {
        let shown = places.iter().take(3).map(String::as_str).collect::<Vec<_>>().join(", ");
        let more = if places.len() > 3 { format!(" and {} more", places.len() - 3) } else { String::new() };
        let kind = if warning.starts_with(mi::NOTE) { "" } else { "warning: " };
        ui::print(&format!("{kind}{} ({}{more})", io::printable(warning), io::printable(&shown)))?;
    }
    Ok(())
}
