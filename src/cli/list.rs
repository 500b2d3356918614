//! `ccmarl list`: every registered plugin.

use clap::Args as ClapArgs;
use clap::builder::PossibleValuesParser;
use serde::Serialize;

use super::Outcome;
use super::ui::{self, Format};
use crate::link;
use crate::registry::Entry;

/// Lists the entries of a kind.
type List = fn(&'static str) -> Vec<Listed>;

/// The registries: a kind's name and its entries. A new registry is one line here.
const KINDS: &[(&str, List)] = &[
    ("scenario", |kind| listed(kind, crate::scenario::SCENARIOS)),
    ("link", |kind| listed(kind, link::LINKS)),
    ("policy", |kind| listed(kind, crate::record::POLICIES)),
    ("format", |kind| listed(kind, crate::storage::FORMATS)),
    ("estimator", |kind| listed(kind, crate::mi::ESTIMATORS)),
    ("algorithm", |kind| listed(kind, crate::algo::ALGORITHMS)),
    ("figure", |kind| listed(kind, crate::figure::FIGURES)),
    ("suite", suites),
    ("channel", channels),
    ("metric", metrics),
];

/// One plugin as `list` prints it.
#[derive(Debug, Serialize)]
struct Listed {
    kind: &'static str,
    name: &'static str,
    /// What stands on the command line: `name` or `name:value`.
    syntax: String,
    summary: String,
    reference: &'static str,
}

/// Arguments of `list`.
#[derive(Debug, ClapArgs)]
pub(super) struct Args {
    /// Only plugins of this kind
    #[arg(value_name = "KIND", value_parser = PossibleValuesParser::new(KINDS.iter().map(|(kind, _)| *kind)))]
    kind: Option<String>,
    /// How to print the list
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Prints the plugins, sorted by kind and name.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let wanted = |kind: &str| args.kind.as_deref().is_none_or(|k| k == kind);
    let mut all: Vec<Listed> = KINDS.iter().filter(|(k, _)| wanted(k)).flat_map(|(kind, list)| list(kind)).collect();
    all.sort_by_key(|plugin| (plugin.kind, plugin.name));
    match args.format {
        Format::Json => ui::print_json(&all)?,
        Format::Table => {
            let cells = |p: &Listed| [p.kind, &p.syntax, &p.summary, p.reference].map(ToOwned::to_owned).to_vec();
            ui::print_table(&["kind", "name", "what it is", "reference"], &all.iter().map(cells).collect::<Vec<_>>())?;
        }
    }
    Ok(Outcome::Done)
}

/// The entries of one registry.
fn listed<B>(kind: &'static str, entries: &[Entry<B>]) -> Vec<Listed> {
    let list = |e: &Entry<B>| Listed {
        kind,
        name: e.name,
        syntax: e.value.map_or_else(|| e.name.to_owned(), |value| format!("{}:{value}", e.name)),
        summary: e.summary.to_owned(),
        reference: e.reference,
    };
    entries.iter().map(list).collect()
}

/// The suites of test channels.
fn suites(kind: &'static str) -> Vec<Listed> {
    let row = |suite: &&'static str| {
        let ids: Vec<_> = link::suite(suite).into_iter().flatten().map(|channel| channel.id).collect();
        tested(kind, suite, format!("the channels {}", ids.join(", ")))
    };
    link::SUITES.iter().map(row).collect()
}

/// The test channels of all suites.
fn channels(kind: &'static str) -> Vec<Listed> {
    let all = link::SUITES.iter().flat_map(|suite| link::suite(suite).into_iter().flatten());
    all.map(|channel| tested(kind, channel.id, format!("the link {} as test channel", channel.spec))).collect()
}

/// The columns of a run's tables.
fn metrics(kind: &'static str) -> Vec<Listed> {
    use crate::train::{METRIC_COLUMNS, METRIC_KEYS, STANDARD_COLUMNS, TIMING_COLUMNS};
    let metrics = METRIC_KEYS.iter().chain(&METRIC_COLUMNS).map(|column| (column, "metrics.parquet of a run"));
    let timings = TIMING_COLUMNS.iter().map(|column| (column, "timings.parquet of a run"));
    // `step` is among the metrics
    let tests = STANDARD_COLUMNS.iter().skip(1).map(|column| (column, "evaluation_standard.parquet of a run"));
    let listed = |(&(name, summary), reference): (&(&'static str, &'static str), &'static str)| Listed {
        kind,
        name,
        syntax: name.to_owned(),
        summary: summary.to_owned(),
        reference,
    };
    metrics.chain(timings).chain(tests).map(listed).collect()
}

fn tested(kind: &'static str, name: &'static str, summary: String) -> Listed {
    Listed { kind, name, syntax: name.to_owned(), summary, reference: "arXiv 2512.03528, experiments" }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_entry_shows_how_it_is_written() {
        let entry = |name, value| Entry { name, summary: "loses messages", reference: "Eq. 1", value, build: () };
        let plugins = listed("link", &[entry("dropout", Some("p")), entry("perfect", None)]);
        assert_eq!(plugins[0].syntax, "dropout:p");
        assert_eq!(plugins[1].syntax, "perfect");
    }
}
