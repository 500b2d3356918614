//! `ccmarl report`: tables, figures and one page from run directories.

use std::path::PathBuf;

use clap::Args;

use crate::cli::Outcome;
use crate::cli::args::{end_on_signals, stop_flag};
use crate::cli::ui::{self, Format};
use crate::record::{Recording, build_link, build_policy, returns};
use crate::registry::Spec;
use crate::report::{Collected, Reference, ReportError, Request, Summary, collect, write};
use crate::scenario;

/// Episodes of each reference policy, and their seed: the same rows in every report.
const REFERENCE_EPISODES: u64 = 2_000;
const REFERENCE_SEED: u64 = 1;

/// Tables, figures and one self-contained page from run directories.
#[derive(Debug, Args)]
pub(super) struct ReportArgs {
    /// Run directories, directories that hold runs, or quoted patterns with `*`
    #[arg(value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// Directory to write: index.html, figures/, tables/
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// More estimates, as `estimate-mi --out x.parquet` writes them (those inside runs are found)
    #[arg(long, value_name = "FILE", num_args = 1..)]
    mi: Vec<PathBuf>,
    /// Title of the page
    #[arg(long, default_value = "Agents that talk over unreliable links")]
    title: String,
    /// Replace an earlier report under --out
    #[arg(long)]
    force: bool,
    /// How the summary is printed
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

pub(super) fn run(args: &ReportArgs) -> anyhow::Result<Outcome> {
    end_on_signals()?; // until there is something to clean up
    let Some(summary) = make(args)? else {
        ui::say("interrupted: nothing was written");
        return Ok(Outcome::Interrupted);
    };
    ui::say(&format!("{} figures and the tables are on {}", summary.figures, summary.page.display()));
    Ok(Outcome::Done)
}

/// Writes the report and prints the summary, but not where it lies; `None` when a signal came first.
pub(super) fn make(args: &ReportArgs) -> anyhow::Result<Option<Summary>> {
    crate::io::refuse_existing(&args.out, args.force).map_err(crate::Error::from)?;
    crate::storage::refuse_within_store(&args.out).map_err(crate::Error::from)?;
    let collected = collect(&args.runs, &args.mi).map_err(crate::Error::from)?;
    let command = command_line(std::env::args_os().map(|a| a.to_string_lossy().into_owned()));
    let references = references(&collected);
    let (out, title) = (args.out.as_path(), args.title.as_str());
    let stop = stop_flag()?;
    let request = Request { out, force: args.force, title, command: &command, references: &references, stop };
    let summary = match write(&collected, &request) {
        Err(ReportError::Stopped) => return Ok(None),
        other => other.map_err(crate::Error::from)?,
    };
    match args.format {
        Format::Json => ui::print_json(&summary.tidy())?,
        Format::Table => print_table(&summary)?,
    }
    Ok(Some(summary))
}

/// Returns of random policy and oracle on every task of the runs; a task that this build cannot play has none.
fn references(collected: &Collected) -> Vec<Reference> {
    let mut found = Vec::new();
    for (task, spec) in collected.tasks() {
        let play = |policy: &str| -> Result<Vec<f64>, crate::Error> {
            let scenario = scenario::build(&spec)?;
            let link = build_link(&Spec::new("none"), scenario.as_ref())?;
            let policy = build_policy(&Spec::new(policy), scenario.as_ref())?;
            let recording = Recording {
                scenario: scenario.as_ref(),
                link: link.as_ref(),
                policy: policy.as_ref(),
                seed: REFERENCE_SEED,
                episodes: REFERENCE_EPISODES,
            };
            Ok(returns(&recording, 0, REFERENCE_EPISODES).into_iter().map(|r| r.episode_return).collect())
        };
        match play("random").and_then(|random| Ok((random, play("scripted")?))) {
            Ok((random, oracle)) => found.push(Reference { task, random, oracle }),
            Err(error) => ui::say(&format!("no reference rows for {task}: {error}")),
        }
    }
    found
}

/// Mean return by algorithm and channel; the page has spreads and published values.
fn print_table(summary: &Summary) -> anyhow::Result<()> {
    for (index, table) in summary.tables.iter().enumerate() {
        if index > 0 {
            ui::print("")?;
        }
        ui::print(&format!("{}: mean return per episode", crate::io::printable(&table.task.to_string())))?;
        let mut header = vec!["algorithm", "seeds"];
        header.extend(table.channels.iter().map(String::as_str));
        let mut rows = Vec::new();
        for row in &table.rows {
            let mut line = vec![row.series.clone(), row.seeds.len().to_string()];
            line.extend(
                row.cells
                    .iter()
                    .map(|c| c.as_ref().map_or("-".to_owned(), |c| format!("{:.1}{}", c.mean, c.seeds_label(row)))),
            );
            rows.push(line);
        }
        for (name, mean, ..) in &table.references {
            let mut line = vec![(*name).to_owned(), String::new()];
            line.extend(table.channels.iter().map(|_| format!("{mean:.1}")));
            rows.push(line);
        }
        ui::print_table(&header, &rows)?;
    }
    Ok(())
}

/// The command as one would type it again; the program's own path is its name.
fn command_line(args: impl Iterator<Item = String>) -> String {
    let quote = |arg: String| {
        let plain = !arg.is_empty() && arg.chars().all(|c| c.is_ascii_alphanumeric() || "-_./=:,+@%".contains(c));
        if plain { arg } else { format!("'{}'", arg.replace('\'', r"'\''")) }
    };
    std::iter::once("ccmarl".to_owned()).chain(args.skip(1).map(quote)).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_can_be_pasted_into_a_shell() {
        let args = ["/x/ccmarl", "report", "a b", "it's", "--out", "r"].map(str::to_owned);
        assert_eq!(command_line(args.into_iter()), r"ccmarl report 'a b' 'it'\''s' --out r");
    }
}
