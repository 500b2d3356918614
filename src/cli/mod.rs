//! The command line: one file per subcommand. The only place for anyhow, printing, progress bars and tables.
#![expect(clippy::print_stderr, reason = "the face of the program prints")]

mod args;
mod calibrate;
mod convert;
mod estimate_mi;
mod estimates;
mod evaluate;
mod fit_link;
mod generate;
mod inspect;
mod jobs;
mod large;
mod link;
mod list;
mod outputs;
mod pairs;
mod plot;
mod quickstart;
mod record;
mod recover;
mod report;
mod train;
mod ui;
mod verify;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Record, measure, train and compare agents that talk over unreliable links.
#[derive(Debug, Parser)]
#[command(
    name = "ccmarl",
    version,
    about,
    propagate_version = true,
    arg_required_else_help = true,
    max_term_width = 100
)]
pub struct Cli {
    /// What to do
    #[command(subcommand)]
    command: Command,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
enum Command {
    /// Run the whole line once: train, record, estimate, test, report
    Quickstart(quickstart::Args),
    /// Record episodes of a scenario under a policy and a link
    Record(record::Args),
    /// Show what a recorded store holds
    Inspect(inspect::Args),
    /// Check everything about a store, and report every fault
    Verify(verify::Args),
    /// Put what a killed recording left under its name
    Recover(recover::Args),
    /// Write a store in another form: directory, .parquet, .mcap
    Convert(convert::Args),
    /// Turn a store into a table with one row per episode, step, sender and receiver
    Pairs(pairs::Args),
    /// Estimate how much messages and actions, or any columns, tell about each other
    EstimateMi(estimate_mi::Args),
    /// Fit a link to recorded link bits: which model explains them, with intervals
    FitLink(fit_link::Args),
    /// Show what a link does
    Link(link::Args),
    /// Test estimators on forty distributions of known information
    Calibrate(calibrate::Args),
    /// Train a team over a link prior
    Train(train::Args),
    /// Test a trained team on every channel of a suite
    Evaluate(evaluate::Args),
    /// Render runs as figures, tables and one page
    Report(report::ReportArgs),
    /// List what can be named on the command line: scenarios, links, policies, estimators, algorithms, …
    List(list::Args),
    /// Generate shell completions, manual pages, or a table of known information
    Generate(generate::Args),
}

/// How a command ended, when it did not fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All done (exit code 0).
    Done,
    /// Done, and data was lost, which was reported (exit code 3).
    DataLost,
    /// Done, and the answer is that something is wrong (exit code 1).
    Wrong,
    /// Interrupted in good order; can be resumed (exit code 4).
    Interrupted,
}

/// Parses the arguments, runs the command, and turns the outcome into the process's exit code:
/// 0 done, 1 error, 2 usage, 3 finished with data loss reported, 4 interrupted and resumable.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            let code = u8::try_from(error.exit_code()).unwrap_or(2);
            return if error.print().is_ok() { ExitCode::from(code) } else { ExitCode::SUCCESS };
        }
    };
    match dispatch(cli.command) {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::Wrong) => ExitCode::FAILURE,
        Ok(Outcome::DataLost) => ExitCode::from(3),
        Ok(Outcome::Interrupted) => ExitCode::from(4),
        Err(error) => ui::report_error(&error),
    }
}

fn dispatch(command: Command) -> anyhow::Result<Outcome> {
    match command {
        Command::Quickstart(args) => quickstart::run(&args),
        Command::Record(args) => record::run(&args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Verify(args) => verify::run(&args),
        Command::Recover(args) => recover::run(&args),
        Command::Convert(args) => convert::run(&args),
        Command::Pairs(args) => pairs::run(&args),
        Command::EstimateMi(args) => estimate_mi::run(&args),
        Command::FitLink(args) => fit_link::run(&args),
        Command::Link(args) => link::run(&args),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Train(args) => train::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Report(args) => report::run(&args),
        Command::List(args) => list::run(&args),
        Command::Generate(args) => generate::run(&args),
    }
}
