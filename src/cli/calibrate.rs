//! `ccmarl calibrate`: estimators on forty tasks of known information, and checks of their intervals and p-values.

use std::path::PathBuf;

use clap::ValueHint;
use serde::Serialize;

use super::args::end_on_signals;
use super::estimate_mi::named;
use super::estimates::decimals;
use super::jobs::{Gathered, gather};
use super::outputs::{self, Picture};
use super::ui::{self, Format};
use super::{Outcome, estimate_mi};
use crate::figure::{Bar, Data};
use crate::mi::{Calibrated, Kind, NORMALS, Plan, Protocol, SERIES, Source, TASKS, Task, calibrate, calibrated};
use crate::{Error, io};

const EXAMPLES: &str = "\
Examples:
  ccmarl calibrate --estimator auto
  ccmarl calibrate --estimator ksg,gcmi,infonce --n 2000 --seeds 3 --task student,spiral
  ccmarl calibrate --estimator gaussian,ksg,gcmi --plot errors.svg --out calibration.csv
  ccmarl calibrate --estimator gaussian,ksg --task none --checks 1000
  ccmarl calibrate --format json

Interrupted (Ctrl-C), it shows what the finished draws say and exits 4.
The tasks are those of Czyz et al. 2023 (arXiv 2306.11078). error: mean over the seeds of |value - truth|, nats.
covers: share of the 95 % intervals that hold the truth (a bound's interval is about its own expectation; the total
leaves bounds out).
right: tasks whose mean is within a tenth of the truth, or 0.03 nats.
The checks are draws of two small kinds, the same for every --n. normal-W-W-RHO: 500 samples of W normal columns on
either side, the first pair correlated by RHO; covers should be 95 %. series-PHI-C: 1000 rows of two AR(1) series with
coefficient PHI, y following x by C, 99 shifts; p <= 0.05 should be 5 % or less at C = 0 (false positives), and is the power at C > 0.";

/// Permutations behind the p-values of the checks: the fewest that can reach 0.05 with some room.
const PERMUTATIONS: usize = 99;
/// Draws per check when all tasks are run.
const CHECKS: u32 = 100;
/// `--task` that leaves all tasks out.
const NONE: &str = "none";

/// Arguments of `ccmarl calibrate`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_value = "auto", help = estimate_mi::estimators())]
    estimator: Vec<String>,
    /// Samples per draw
    #[arg(long, value_name = "N", default_value_t = 5000, value_parser = clap::value_parser!(u32).range(10..=10_000_000))]
    n: u32,
    /// Draws per task
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    seeds: u32,
    /// Only tasks whose id contains one of these, comma-separated; none for checks alone
    #[arg(long, value_name = "WORDS", value_delimiter = ',')]
    task: Vec<String>,
    /// Draws per check of intervals and p-values; 100 by default, 0 with --task
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=100_000))]
    checks: Option<u32>,
    /// Root of all randomness
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Threads; 0 for one per core (the result does not depend on it)
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u16).range(0..=1024))]
    threads: u16,
    /// Also write the rows, tasks and checks, to a .json, .csv or .parquet file
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    out: Option<PathBuf>,
    /// Draw the error per task, estimators side by side: a .svg or .png file
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    plot: Option<PathBuf>,
    /// Replace --out and --plot if they exist
    #[arg(long)]
    force: bool,
    /// How the result is printed
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// One estimator over all tasks.
#[derive(Debug, Serialize)]
struct Total {
    estimator: String,
    tasks: usize,
    /// Mean absolute error, nats.
    error: f64,
    /// Tasks whose mean is right.
    right: usize,
    /// Mean share of intervals that hold the truth; bounds have none.
    covered: Option<f64>,
}

#[derive(Debug, Serialize)]
struct Result {
    tasks: Vec<Calibrated>,
    total: Vec<Total>,
    checks: Vec<Calibrated>,
}

pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    end_on_signals()?;
    let tasks = tasks(&args.task)?;
    let checks = args.checks.unwrap_or(if args.task.is_empty() { CHECKS } else { 0 });
    if tasks.is_empty() && checks == 0 {
        return Err(Error::Usage("--task none leaves only checks: give --checks a number".to_owned()).into());
    }
    named(&args.estimator)?;
    let write = args.out.as_deref().map(|path| outputs::table(path, args.force)).transpose()?;
    let plot = args.plot.as_deref().map(|path| Picture::at(path, args.force)).transpose()?;
    if plot.is_some() && tasks.is_empty() {
        return Err(Error::Usage("--plot draws tasks: leave out --task none".to_owned()).into());
    }
    let (found, interrupted) = drawn(args, &tasks, args.seeds, 0)?;
    let mut result = Result { total: totals(&found), tasks: found, checks: Vec::new() };
    let mut interrupted = interrupted;
    for (sources, permutations) in [(NORMALS, 0), (SERIES, PERMUTATIONS)] {
        if checks > 0 && !interrupted {
            let (found, stopped) = drawn(args, &sources, checks, permutations)?;
            result.checks.extend(found);
            interrupted = stopped;
        }
    }
    let empty = result.tasks.is_empty() && result.checks.is_empty();
    if empty && interrupted {
        return Ok(Outcome::Interrupted);
    }
    anyhow::ensure!(!empty, "no estimator gave a value in nats: give --n more samples");
    if let (Some(path), Some(write)) = (&args.out, write) {
        let rows: Vec<Calibrated> = result.tasks.iter().chain(&result.checks).cloned().collect();
        io::write_atomic(path, &write(&rows).map_err(anyhow::Error::msg)?).map_err(Error::from)?;
        ui::say(&format!("wrote {} rows: {}", rows.len(), path.display()));
    }
    let printed = match args.format {
        Format::Json => ui::print_json(&result),
        Format::Table => print(&result),
    };
    let drawn = plot.map_or(Ok(()), |picture| draw(&picture, &result, args));
    printed?;
    drawn?;
    Ok(if interrupted { Outcome::Interrupted } else { Outcome::Done })
}

/// The tasks that a user wants.
fn tasks(words: &[String]) -> std::result::Result<Vec<Task>, Error> {
    if words == [NONE] {
        return Ok(Vec::new());
    }
    let wanted = |task: &&Task| words.is_empty() || words.iter().any(|word| task.id.contains(word.as_str()));
    let tasks: Vec<Task> = TASKS.iter().filter(wanted).copied().collect();
    if tasks.is_empty() {
        let ids = TASKS.iter().map(|task| task.id).collect::<Vec<_>>().join(", ");
        return Err(Error::Usage(format!("no task contains {}; the tasks are {ids}", words.join(" or "))));
    }
    Ok(tasks)
}

/// What `seeds` draws of each source say, and whether a signal came before all were there.
fn drawn<S: Source + Copy + 'static>(
    args: &Args,
    sources: &[S],
    seeds: u32,
    permutations: usize,
) -> anyhow::Result<(Vec<Calibrated>, bool)> {
    let protocol = Protocol { permutations };
    let plan = Plan { estimators: named(&args.estimator)?, protocol, seed: args.seed };
    let (n, total, own) = (args.n as usize, sources.len() * seeds as usize, sources.to_vec());
    let Gathered { told, interrupted } = gather(args.threads, total, "drawing and estimating", move |stop, tell| {
        calibrate(&own, &plan, n, u64::from(seeds), stop, tell);
    })?;
    if interrupted {
        ui::say(&format!("interrupted: {} of {total} draws are finished, and only these count", told.len()));
    }
    Ok((calibrated(sources, told), interrupted))
}

/// Draws the tasks, if any has a value.
fn draw(picture: &Picture, result: &Result, args: &Args) -> anyhow::Result<()> {
    let place = picture.path().display();
    if result.tasks.is_empty() {
        ui::say(&format!("note: no value of a task to draw: {place}"));
        return Ok(());
    }
    picture.draw("calibration", &figure(result, args))?;
    ui::say(&format!("drew {} values: {place}", result.tasks.len()));
    Ok(())
}

/// The mean error per task, with one standard deviation over draws.
fn figure(result: &Result, args: &Args) -> Data {
    let bar = |row: &Calibrated| {
        let (value, deviation) = (row.mean - row.truth, row.deviation.unwrap_or(0.0));
        Bar {
            group: row.task.clone(),
            series: row.estimator.clone(),
            value,
            low: value - deviation,
            high: value + deviation,
        }
    };
    Data {
        title: "Estimators where the information is known".to_owned(),
        subtitle: format!(
            "mean and one standard deviation over {} draws of n = {}; hollow: beyond the edge",
            args.seeds, args.n
        ),
        unit: "value less truth, nats".to_owned(),
        series: result.total.iter().map(|total| total.estimator.clone()).collect(),
        bars: result.tasks.iter().map(bar).collect(),
        ..Data::default()
    }
}

fn totals(rows: &[Calibrated]) -> Vec<Total> {
    let mut names: Vec<&str> = Vec::new();
    for row in rows {
        if !names.contains(&row.estimator.as_str()) {
            names.push(&row.estimator);
        }
    }
    let of = |name: &str| {
        let own: Vec<&Calibrated> = rows.iter().filter(|r| r.estimator == name).collect();
        let covered: Vec<f64> = own.iter().filter(|r| r.kind == Kind::Estimate).filter_map(|r| r.covered).collect();
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        Total {
            estimator: name.to_owned(),
            tasks: own.len(),
            error: mean(&own.iter().map(|r| r.error).collect::<Vec<_>>()),
            right: own.iter().filter(|r| r.is_right()).count(),
            covered: (!covered.is_empty()).then(|| mean(&covered)),
        }
    };
    names.into_iter().map(of).collect()
}

/// Lines of a table, task and truth named once each; `cells` gives the others.
fn lines(rows: &[Calibrated], cells: impl Fn(&Calibrated) -> Vec<String>) -> Vec<Vec<String>> {
    let mut before = "";
    let mut out = Vec::new();
    for row in rows {
        let again = row.task == before;
        before = &row.task;
        let named = [row.task.clone(), decimals(row.truth)].map(|cell| if again { String::new() } else { cell });
        out.push(named.into_iter().chain([row.estimator.clone()]).chain(cells(row)).collect());
    }
    out
}

fn print(result: &Result) -> anyhow::Result<()> {
    let share = |share: Option<f64>, digits: usize| {
        share.map_or_else(String::new, |share| format!("{:.digits$} %", 100.0 * share))
    };
    let deviation = |row: &Calibrated| row.deviation.map_or_else(String::new, decimals);
    if !result.tasks.is_empty() {
        let cells = |row: &Calibrated| {
            let right = if row.is_right() { "right" } else { "" };
            vec![decimals(row.mean), deviation(row), decimals(row.error), share(row.covered, 0), right.to_owned()]
        };
        let header = ["task", "truth", "estimator", "mean", "sd", "error", "covers", ""];
        ui::print_table(&header, &lines(&result.tasks, cells))?;
        ui::print("")?;
        let line = |t: &Total| {
            let right = format!("{} of {}", t.right, t.tasks);
            vec![t.estimator.clone(), decimals(t.error), right, share(t.covered, 0)]
        };
        let header = ["over all tasks", "error", "right", "covers"];
        ui::print_table(&header, &result.total.iter().map(line).collect::<Vec<_>>())?;
    }
    if !result.checks.is_empty() {
        if !result.tasks.is_empty() {
            ui::print("")?;
        }
        let cells = |row: &Calibrated| {
            let (covers, small) = (share(row.covered, 1), share(row.rejected, 1));
            vec![decimals(row.mean), deviation(row), covers, small, row.seeds.to_string()]
        };
        let header = ["check", "truth", "estimator", "mean", "sd", "covers", "p ≤ 0.05", "draws"];
        ui::print_table(&header, &lines(&result.checks, cells))?;
    }
    Ok(())
}
