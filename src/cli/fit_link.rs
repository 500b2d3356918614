//! `ccmarl fit-link`: which link explains recorded link bits, as a file that `--link file:PATH` takes.

use std::path::{Path, PathBuf};

use clap::ValueHint;
use clap::builder::PossibleValuesParser;
use serde_json::json;

use super::args::end_on_signals;
use super::ui::{self, Format};
use super::{Outcome, outputs};
use crate::Error;
use crate::channel::{self, Compared, Estimate, Fit, FitOutcome, MODELS, Observations, Score};
use crate::figure::{self, FIGURES};
use crate::io;
use crate::link::FITTED_KIND;
use crate::registry::find;

const EXAMPLES: &str = "\
Examples:
  ccmarl fit-link data/tag --out link.json
  ccmarl fit-link measured.csv --model markov --out wifi.json
  ccmarl train --scenario simple_spread --prior file:wifi.json --out runs/matched

STORE is what `ccmarl record` wrote, or a CSV, TSV or Parquet table with the columns episode, step,
sender, receiver, delivered. Models are compared by their likelihood on 30 % of the episodes, which
they were not fitted on: auto takes the simplest one that none beats by three standard errors, and
fits it to all episodes (a classifier stays as it was scored). All intervals of a fit hold together
at 95 %: exact for shares of messages and for a threshold that nothing contradicts; episodes
resampled for the held-out figures. A reliability figure is written beside FILE (.reliability.svg).";

/// Arguments of `fit-link`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// A rollout store, or a table of link bits
    #[arg(value_name = "STORE", value_hint = ValueHint::AnyPath)]
    store: PathBuf,
    /// What to fit
    #[arg(long, default_value = "auto", value_parser = PossibleValuesParser::new(MODELS.iter().map(|(name, _)| *name)))]
    model: String,
    /// File to write, for `--link file:FILE`
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    out: PathBuf,
    /// Seed of the held-out episodes and of training
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Replace FILE if it is a fitted link
    #[arg(long)]
    force: bool,
    /// How results are printed
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Runs the command.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    end_on_signals()?;
    let figure = figure_beside(&args.out);
    outputs::check(&args.out, args.force, is_fitted)?;
    outputs::check(&figure, args.force, outputs::is_picture)?;
    let observations = Observations::read(&args.store).map_err(Error::from)?;
    let bar = ui::progress(100, "fitting");
    let progress = |model: &'static str, share: f64| {
        bar.set_message(model);
        bar.set_position((100.0 * share) as u64);
    };
    let fit = channel::fit(&observations, &args.model, args.seed, &progress).map_err(Error::from)?;
    bar.finish_and_clear();
    let svg = figure::svg(find("figure", FIGURES, "reliability").map_err(Error::from)?, &fit.reliability())?;
    io::write_atomic(&args.out, fit.to_json()?.as_bytes()).map_err(Error::from)?;
    outputs::write_svg(&figure, svg)?;
    let [out, figure] = [&args.out, &figure].map(|path| path.display().to_string()); // JSON is UTF-8, a path need not be
    match args.format {
        Format::Json => ui::print_json(&json!({"out": out, "figure": figure, "link": fit.link, "fit": fit}))?,
        Format::Table => print(&fit)?,
    }
    fit.notes.iter().for_each(|note| ui::say(&format!("note: {note}")));
    ui::say(&format!("wrote {out} and {figure}; use it with --link file:{out}"));
    Ok(Outcome::Done)
}

/// `FILE.reliability.svg`, without the `.json` of FILE.
fn figure_beside(out: &Path) -> PathBuf {
    let is_json = out.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("json"));
    let mut name = if is_json { out.with_extension("") } else { out.to_owned() }.into_os_string();
    name.push(".reliability.svg");
    name.into()
}

/// Whether a file is a fitted link.
fn is_fitted(bytes: &[u8]) -> bool {
    let json: serde_json::Value = serde_json::from_slice(bytes).unwrap_or_default();
    json["kind"] == FITTED_KIND
}

fn print(fit: &Fit) -> anyhow::Result<()> {
    let facts = [
        ("model", fit.model.to_owned()),
        ("episodes", fit.data.used.to_string()),
        ("messages, final rows too", fit.messages.to_string()),
        ("lost", format!("{} ({:.2} %)", fit.lost, 100.0 * fit.lost as f64 / fit.messages as f64)),
        ("data sha256", fit.data.sha256.clone()),
    ];
    ui::print_table(&["fitted", ""], &facts.map(|(k, v)| vec![k.to_owned(), v]))?;
    if !fit.parameters.is_empty() {
        ui::print("")?;
        let rows: Vec<Vec<String>> = fit
            .parameters
            .iter()
            .map(|p| {
                let messages = p.messages.map_or_else(String::new, |n| n.to_string());
                vec![p.name.clone(), format!("{:.5}", p.value), format!("{:.5} to {:.5}", p.low, p.high), messages]
            })
            .collect();
        ui::print_table(&["parameter", "estimate", "95 %, all together", "messages"], &rows)?;
    }
    ui::print("")?;
    let held = &fit.held_out;
    ui::print(&format!("on {} messages of {} held-out episodes:", held.messages, held.episodes))?;
    let mut rows: Vec<Vec<String>> = fit.compared.iter().map(|model| compared(model, fit.model)).collect();
    rows.sort_by_key(|row| row[0].clone());
    let header = ["model", "log-likelihood", "behind the best", "Brier", "balanced accuracy", "calibration error"];
    ui::print_table(&header, &rows)?;
    ui::print("")?;
    ui::print_table(&["held out", "", "95 %"], &figures(held))?;
    for model in &fit.compared {
        if let FitOutcome::Refused { reason } = &model.outcome {
            ui::say(&format!("note: no {}: {reason}", model.model));
        }
    }
    Ok(())
}

/// The figures of the chosen model with their intervals.
fn figures(score: &Score) -> Vec<Vec<String>> {
    let row = |name: &str, e: &Estimate| {
        vec![name.to_owned(), format!("{:.5}", e.value), format!("{:.5} to {:.5}", e.low, e.high)]
    };
    let mut rows =
        vec![row("log-likelihood, nats per message", &score.log_likelihood), row("Brier score", &score.brier)];
    rows.extend(score.balanced_accuracy.iter().map(|e| row("balanced accuracy", e)));
    rows.push(row("calibration error", &score.calibration_error));
    rows
}

/// A line of the comparison; a star marks the model that was taken.
fn compared(model: &Compared, chosen: &str) -> Vec<String> {
    let name = format!("{}{}", model.model, if model.model == chosen { " *" } else { "" });
    match &model.outcome {
        FitOutcome::Refused { .. } => vec![name, "not fitted".to_owned()],
        FitOutcome::Scored { score, behind, error } => vec![
            name,
            format!("{:.5}", score.log_likelihood.value),
            format!("{behind:.5} ± {error:.5}"),
            format!("{:.5}", score.brier.value),
            score.balanced_accuracy.map_or_else(|| "-".to_owned(), |e| format!("{:.4}", e.value)),
            format!("{:.4}", score.calibration_error.value),
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_json_is_taken_off_the_name_of_the_figure() {
        for (out, figure) in [
            ("a/link.json", "a/link.reliability.svg"),
            ("link.JSON", "link.reliability.svg"),
            ("wifi.v1", "wifi.v1.reliability.svg"),
            ("wifi", "wifi.reliability.svg"),
        ] {
            assert_eq!(figure_beside(Path::new(out)), Path::new(figure));
        }
    }
}
