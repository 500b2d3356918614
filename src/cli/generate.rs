//! `ccmarl generate`: shell completions and manual pages, from the same definitions as `--help`; tables of known information.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use clap::{Args as ClapArgs, CommandFactory as _, Subcommand};
use clap_complete::Shell;

use super::args::stop_flag;
use super::{Cli, Outcome, outputs, ui};
use crate::Error;
use crate::pairs::{self, Known};
use crate::{io, storage};

/// Arguments of `generate`.
#[derive(Debug, ClapArgs)]
pub(super) struct Args {
    /// What to generate
    #[command(subcommand)]
    what: What,
}

/// What can be generated.
#[derive(Debug, Subcommand)]
enum What {
    /// Print a completion script for a shell
    Completions {
        /// The shell
        shell: Shell,
    },
    /// Write one manual page per subcommand
    Man {
        /// Directory for the pages
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// Replace pages that exist
        #[arg(long)]
        force: bool,
    },
    /// Write a Parquet table of known information: normal columns x and y, discrete ones a and b
    #[command(after_help = TABLE_EXAMPLES)]
    Table {
        /// Rows
        #[arg(long, value_name = "N", default_value_t = 100_000_000, value_parser = clap::value_parser!(u64).range(1..=4_000_000_000))]
        rows: u64,
        /// Correlation of x and y, between -1 and 1
        #[arg(long, default_value_t = 0.75, allow_negative_numbers = true, value_parser = correlation)]
        rho: f64,
        /// Seed
        #[arg(long, value_name = "N", default_value_t = 1)]
        seed: u64,
        /// File, ending in .parquet
        #[arg(long, value_name = "FILE")]
        out: PathBuf,
        /// Replace such a table if it exists
        #[arg(long)]
        force: bool,
    },
}

const TABLE_EXAMPLES: &str = "\
Examples:
  ccmarl generate table --rows 100000000 --out big.parquet
  ccmarl estimate-mi big.parquet --x x --y y --estimator gaussian,infonce

The same seed gives the same bytes. The information of x and y, and of a and b, is said on stderr.";

/// Reads a number between -1 and 1.
fn correlation(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|rho| rho.abs() < 1.0);
    number.ok_or_else(|| "expected a number between -1 and 1, without the two".to_owned())
}

/// Writes the table; a signal removes what is there of it.
fn table(known: Known, out: &Path, force: bool) -> anyhow::Result<Outcome> {
    if out.extension().is_none_or(|e| e != "parquet") {
        let message = format!("--out: expected a name that ends in .parquet, found {}", out.display());
        return Err(Error::Usage(message).into());
    }
    io::refuse_existing(out, force).map_err(Error::from)?;
    storage::refuse_within_store(out).map_err(Error::from)?;
    if out.symlink_metadata().is_ok() && !pairs::is_known(out) {
        return Err(Error::from(io::IoError::Foreign(out.to_owned())).into());
    }
    let stop = stop_flag()?;
    let bar = ui::progress(known.rows, "rows");
    let written = known.write(out, &mut |rows| {
        bar.set_position(rows);
        !stop.load(Ordering::SeqCst)
    });
    bar.finish_and_clear();
    if !written.map_err(Error::from)? {
        ui::say("interrupted: nothing was written");
        return Ok(Outcome::Interrupted);
    }
    let (normal, discrete) = (known.normal(), Known::discrete());
    ui::say(&format!("information: x and y {normal:.6} nats, a and b {discrete:.6} nats"));
    ui::say(&format!("wrote {} rows: {}", known.rows, out.display()));
    Ok(Outcome::Done)
}

/// Generates completions, manual pages or a table.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    match &args.what {
        &What::Table { rows, rho, seed, ref out, force } => return table(Known { rows, rho, seed }, out, force),
        What::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(*shell, &mut Cli::command(), "ccmarl", &mut script);
            ui::print(String::from_utf8(script)?.trim_end())?;
        }
        What::Man { out, force } => {
            let mut command = Cli::command().disable_help_subcommand(true);
            command.build();
            let pages = pages(&command, out)?;
            for (path, _) in &pages {
                outputs::check(path, *force, is_page)?;
            }
            for (path, page) in &pages {
                io::write_atomic(path, page).map_err(Error::from)?;
            }
            ui::say(&format!("wrote {} manual pages: {}", pages.len(), out.display()));
        }
    }
    Ok(Outcome::Done)
}

/// Whether a file is a manual page of ours, by its title.
fn is_page(bytes: &[u8]) -> bool {
    let text = String::from_utf8_lossy(bytes);
    text.lines().find(|line| line.starts_with(".TH ")).is_some_and(|line| line.starts_with(".TH ccmarl"))
}

/// The pages of a command and its subcommands, each with its path.
fn pages(command: &clap::Command, out: &Path) -> anyhow::Result<Vec<(PathBuf, Vec<u8>)>> {
    let man = clap_mangen::Man::new(command.clone());
    let mut page = Vec::new();
    man.render(&mut page)?;
    let mut all = vec![(out.join(man.get_filename()), page)];
    for subcommand in command.get_subcommands() {
        all.extend(pages(subcommand, out)?);
    }
    Ok(all)
}
