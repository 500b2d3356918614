//! `ccmarl list`: every registered plugin.

use clap::Args as ClapArgs;
use clap::builder::PossibleValuesParser;
use serde::Serialize;

use serde_json::{Map, Value, json};

use super::Outcome;
use super::ui::{self, Format};
use crate::registry::{self, Entry, RegistryError, Spec};
use crate::scenario;
use crate::{algo, link};

/// The profiles of every scenario.
const PROFILES: [&str; 2] = ["paper", "mpe2"];

/// Lists the entries of a kind.
type List = fn(&'static str) -> Vec<Listed>;

/// The registries: a kind's name and its entries. A new registry is one line here.
const KINDS: &[(&str, List)] = &[
    ("scenario", |kind| listed(kind, scenario::SCENARIOS)),
    ("link", |kind| listed(kind, link::LINKS)),
    ("policy", |kind| listed(kind, crate::record::POLICIES)),
    ("format", |kind| listed(kind, crate::storage::FORMATS)),
    ("estimator", |kind| listed(kind, crate::mi::ESTIMATORS)),
    ("algorithm", |kind| listed(kind, algo::ALGORITHMS)),
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
    /// Only this one, with its parameters: a scenario's defaults (for --set), a link's, an algorithm's prior
    #[arg(requires = "kind")]
    name: Option<String>,
    /// How to print the list
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Prints the plugins, sorted by kind and name.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let wanted = |kind: &str| args.kind.as_deref().is_none_or(|k| k == kind);
    let mut all: Vec<Listed> = KINDS.iter().filter(|(k, _)| wanted(k)).flat_map(|(kind, list)| list(kind)).collect();
    all.sort_by_key(|plugin| (plugin.kind, plugin.name));
    if let (Some(kind), Some(name)) = (&args.kind, &args.name) {
        return one(&all, kind, name, args.format);
    }
    match args.format {
        Format::Json => ui::print_json(&all)?,
        Format::Table => {
            let cells = |p: &Listed| [p.kind, &p.syntax, &p.summary, p.reference].map(ToOwned::to_owned).to_vec();
            ui::print_table(&["kind", "name", "what it is", "reference"], &all.iter().map(cells).collect::<Vec<_>>())?;
        }
    }
    Ok(Outcome::Done)
}

/// Prints one plugin of a kind, with the parameters of a scenario in both profiles.
fn one(all: &[Listed], kind: &str, name: &str, format: Format) -> anyhow::Result<Outcome> {
    let Some(plugin) = all.iter().find(|plugin| plugin.name == name) else {
        let hint = registry::did_you_mean(name, all.iter().map(|plugin| plugin.name));
        let kind = all.first().map_or("plugin", |plugin| plugin.kind);
        return Err(crate::Error::from(RegistryError::Unknown { kind, name: name.to_owned(), hint }).into());
    };
    let (said, parameters) = match kind {
        "scenario" => (String::new(), parameters(name)?),
        "link" => {
            let (link, parameters) = link_parameters(name);
            (format!("parameters of {link}:"), parameters)
        }
        "algorithm" => ("what it stands for:".to_owned(), algorithm_parameters(name)?),
        _ => (String::new(), Map::new()),
    };
    if format == Format::Json {
        ui::print_json(&json!({ "plugin": plugin, "parameters": parameters }))?;
        return Ok(Outcome::Done);
    }
    ui::print(&format!("{kind} {}: {}\nreference: {}", plugin.syntax, plugin.summary, plugin.reference))?;
    if !parameters.is_empty() && kind != "scenario" {
        ui::print(&format!("\n{said}\n"))?;
        let rows: Vec<Vec<String>> = parameters.iter().map(|(key, value)| vec![key.clone(), text(value)]).collect();
        return ui::print_table(&["key", "value"], &rows).map(|()| Outcome::Done);
    }
    if !parameters.is_empty() {
        let [first, second] = PROFILES;
        let cell = |value: &Value, profile: &str| text(&value[profile]);
        let rows = parameters.iter().map(|(key, value)| vec![key.clone(), cell(value, first), cell(value, second)]);
        ui::print("\ndefaults, each changed by --set key=value:\n")?;
        ui::print_table(&["key", "profile paper", "profile mpe2"], &rows.collect::<Vec<_>>())?;
    }
    Ok(Outcome::Done)
}

/// Values for the links that have no default for what stands behind the colon.
const LINK_VALUES: [&str; 4] = ["dropout:0.2", "markov:medium", "distance:3", "mixture:perfect,dropout:0.5"];

/// A link as it may stand on the command line, and its parameters; none of one that cannot do without a file.
fn link_parameters(name: &str) -> (String, Map<String, Value>) {
    let valued = LINK_VALUES.iter().find(|text| text.split(':').next() == Some(name)).unwrap_or(&name).to_string();
    let task = scenario::build(&Spec::new(scenario::SCENARIOS[0].name)).ok();
    let link = task.zip(Spec::parse("link", link::LINKS, &valued).ok());
    let link = link.and_then(|(task, spec)| link::build(&spec, &crate::record::link_setting(&*task)).ok());
    let all = link.map(|link| link.parameters()).unwrap_or_default();
    (valued, all.into_iter().filter(|(key, _)| key != "name").collect())
}

/// The prior of an algorithm, and whether it shapes rewards.
fn algorithm_parameters(name: &str) -> anyhow::Result<Map<String, Value>> {
    let entry = registry::find("algorithm", algo::ALGORITHMS, name).map_err(crate::Error::from)?;
    let preset = (entry.build)();
    let all = json!({ "prior": preset.prior.to_string(), "shaping": preset.shaped });
    Ok(all.as_object().cloned().unwrap_or_default())
}

/// The parameters of a scenario: key → profile → default.
fn parameters(name: &str) -> anyhow::Result<Map<String, Value>> {
    let mut table: Map<String, Value> = Map::new();
    for profile in PROFILES {
        let scenario = scenario::build(&Spec::new(name).with("profile", profile)).map_err(crate::Error::from)?;
        for (key, value) in scenario.parameters().into_iter().filter(|(key, _)| key != "name" && key != "profile") {
            table.entry(key).or_insert_with(|| json!({}))[profile] = value;
        }
    }
    Ok(table)
}

/// A value as `--set` takes it.
fn text(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Null => "none".to_owned(),
        other => other.to_string(),
    }
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
    fn a_scenarios_parameters_show_both_profiles_as_set_takes_them() {
        let table = parameters("simple_tag").unwrap();
        assert_eq!(text(&table["view_radius"]["paper"]), "0.25");
        assert_eq!(text(&table["view_radius"]["mpe2"]), "none");
        assert!(table.values().all(|defaults| PROFILES.iter().all(|p| !defaults[p].is_null())), "{table:?}");
    }

    #[test]
    fn an_entry_shows_how_it_is_written() {
        let entry = |name, value| Entry { name, summary: "loses messages", reference: "Eq. 1", value, build: () };
        let plugins = listed("link", &[entry("dropout", Some("p")), entry("perfect", None)]);
        assert_eq!(plugins[0].syntax, "dropout:p");
        assert_eq!(plugins[1].syntax, "perfect");
    }
}
