//! `ccmarl list`: every registered plugin.

use clap::Args as ClapArgs;
use clap::builder::PossibleValuesParser;
use serde::Serialize;

use super::Outcome;
use super::ui::{self, Format};
use crate::registry::Entry;

/// The registries: a kind's name and its entries. A new registry is one line here.
const KINDS: &[(&str, fn(&'static str) -> Vec<Listed>)] = &[
    ("scenario", |kind| listed(kind, crate::scenario::SCENARIOS)),
    ("link", |kind| listed(kind, crate::link::LINKS)),
    ("policy", |kind| listed(kind, crate::record::POLICIES)),
    ("format", |kind| listed(kind, crate::storage::FORMATS)),
];

/// One plugin as `list` prints it.
#[derive(Debug, Serialize)]
struct Listed {
    kind: &'static str,
    name: &'static str,
    /// What stands on the command line: `name` or `name:value`.
    syntax: String,
    summary: &'static str,
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
            let cells = |p: &Listed| [p.kind, &p.syntax, p.summary, p.reference].map(ToOwned::to_owned).to_vec();
            ui::print_table(&["kind", "name", "what it is", "reference"], &all.iter().map(cells).collect::<Vec<_>>())?;
        }
    }
    Ok(Outcome::Done)
}

/// The entries of one registry.
fn listed<B>(kind: &'static str, entries: &[Entry<B>]) -> Vec<Listed> {
    let syntax = |e: &Entry<B>| e.value.map_or_else(|| e.name.to_owned(), |value| format!("{}:{value}", e.name));
    let list =
        |e: &Entry<B>| Listed { kind, name: e.name, syntax: syntax(e), summary: e.summary, reference: e.reference };
    entries.iter().map(list).collect()
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
