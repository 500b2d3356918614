//! `ccmarl generate`: shell completions and manual pages, from the same definitions as `--help`.

use std::path::{Path, PathBuf};

use clap::{Args as ClapArgs, CommandFactory as _, Subcommand};
use clap_complete::Shell;

use super::{Cli, Outcome, ui};
use crate::io;

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
}

/// Generates completions or manual pages.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    match &args.what {
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
                io::refuse_existing(path, *force).map_err(crate::Error::from)?;
            }
            for (path, page) in &pages {
                io::write_atomic(path, page).map_err(crate::Error::from)?;
            }
            ui::say(&format!("wrote {} manual pages: {}", pages.len(), out.display()));
        }
    }
    Ok(Outcome::Done)
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
