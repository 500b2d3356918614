//! `ccmarl calibrate`: estimators on forty tasks of known information.

use serde::Serialize;

use super::estimate_mi::named;
use super::estimates::decimals;
use super::jobs::{Gathered, gather};
use super::ui::{self, Format};
use super::{Outcome, estimate_mi};
use crate::Error;
use crate::mi::{Calibrated, Kind, Plan, Protocol, TASKS, Task, calibrate, calibrated};

const EXAMPLES: &str = "\
Examples:
  ccmarl calibrate --estimator auto
  ccmarl calibrate --estimator ksg,gcmi,infonce --n 2000 --seeds 3 --task student,spiral
  ccmarl calibrate --format json

Interrupted (Ctrl-C), it shows what the finished draws say and exits 4.
The tasks are those of Czyz et al. 2023 (arXiv 2306.11078). error: mean over the seeds of |value - truth|, nats.
covers: share of the 95 % intervals that hold the truth (a bound's interval is about its own expectation).
right: tasks whose mean is within a tenth of the truth, or 0.03 nats.";

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
    /// Only tasks whose id contains one of these, comma-separated
    #[arg(long, value_name = "WORDS", value_delimiter = ',')]
    task: Vec<String>,
    /// Root of all randomness
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Threads; 0 for one per core (the result does not depend on it)
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u16).range(0..=1024))]
    threads: u16,
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
}

pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let tasks: Vec<Task> = TASKS
        .iter()
        .filter(|task| args.task.is_empty() || args.task.iter().any(|word| task.id.contains(word.as_str())))
        .copied()
        .collect();
    if tasks.is_empty() {
        let ids = TASKS.iter().map(|task| task.id).collect::<Vec<_>>().join(", ");
        return Err(Error::Usage(format!("no task contains {}; the tasks are {ids}", args.task.join(" or "))).into());
    }
    let plan = Plan { estimators: named(&args.estimator)?, protocol: Protocol { permutations: 0 }, seed: args.seed };
    let (n, seeds, total) = (args.n as usize, u64::from(args.seeds), tasks.len() * args.seeds as usize);
    let own_tasks = tasks.clone();
    let Gathered { told, interrupted } = gather(args.threads, total, "drawing and estimating", move |stop, tell| {
        calibrate(&own_tasks, &plan, n, seeds, stop, tell);
    })?;
    if interrupted {
        ui::say(&format!("interrupted: {} of {total} draws are finished, and only these count", told.len()));
        if told.is_empty() {
            return Ok(Outcome::Interrupted);
        }
    }
    let rows = calibrated(&tasks, told);
    anyhow::ensure!(!rows.is_empty(), "no estimator gave a value in nats: give --n more samples");
    let total = totals(&rows);
    match args.format {
        Format::Json => ui::print_json(&Result { tasks: rows, total })?,
        Format::Table => print(&rows, &total)?,
    }
    Ok(if interrupted { Outcome::Interrupted } else { Outcome::Done })
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

fn print(rows: &[Calibrated], total: &[Total]) -> anyhow::Result<()> {
    let share = |covered: Option<f64>| covered.map_or_else(String::new, |c| format!("{:.0} %", 100.0 * c));
    let mut before = "";
    let mut lines = Vec::new();
    for row in rows {
        let again = row.task == before;
        before = &row.task;
        lines.push(vec![
            if again { String::new() } else { row.task.clone() },
            if again { String::new() } else { decimals(row.truth) },
            row.estimator.clone(),
            decimals(row.mean),
            row.deviation.map_or_else(String::new, decimals),
            decimals(row.error),
            share(row.covered),
            if row.is_right() { "right".to_owned() } else { String::new() },
        ]);
    }
    ui::print_table(&["task", "truth", "estimator", "mean", "sd", "error", "covers", ""], &lines)?;
    ui::print("")?;
    let line = |t: &Total| {
        vec![t.estimator.clone(), decimals(t.error), format!("{} of {}", t.right, t.tasks), share(t.covered)]
    };
    ui::print_table(&["over all tasks", "error", "right", "covers"], &total.iter().map(line).collect::<Vec<_>>())
}
