//! `ccmarl link`: what a link does, without a store.

use std::path::{Path, PathBuf};

use rayon::iter::{IntoParallelIterator as _, ParallelIterator as _};
use serde_json::json;

use super::args::{ScenarioArgs, end_on_signals};
use super::ui::{self, Format};
use super::{Outcome, outputs};
use crate::channel::{BIN_WIDTH, LinkStatistics, Observed};
use crate::figure::{self, FIGURES};
use crate::link::LINKS;
use crate::record::{POLICIES, Recording, build_link, build_policy, check_link};
use crate::registry::{Spec, find};
use crate::{Error, io, scenario};

const EXAMPLES: &str = "\
Examples:
  ccmarl link simulate markov:heavy --episodes 1000
  ccmarl link simulate file:link.json --scenario simple_tag --out reports/link
  ccmarl link simulate '{\"name\": \"markov\", \"matrix\": [[0.9, 0.1], [0.6, 0.4]]}'

LINK is written as for --link of `ccmarl record`: name, name:value, or a JSON table. Agents move as
the policy says, which matters for links that depend on distance. --out takes the counts of every
directed link and step (statistics.csv) and the figures.";

/// Arguments of `link`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// Count what a link does: loss per step, burst lengths, loss against distance
    Simulate(SimulateArgs),
}

/// Arguments of `link simulate`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
struct SimulateArgs {
    /// Link: name, name:value or a JSON table
    link: String,
    #[command(flatten)]
    scenario: ScenarioArgs,
    /// Policy: name or name:value
    #[arg(long, default_value = "random")]
    policy: String,
    /// Episodes
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Seed of everything random
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Directory for the figures and statistics.csv
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Replace these files if they exist
    #[arg(long, requires = "out")]
    force: bool,
    /// How results are printed
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// What `--out` takes: a file, its figure, and what that shows.
const PICTURES: [(&str, &str, &str); 3] = [
    ("loss-by-step.svg", "loss-by-step", "share of lost messages"),
    ("burst-lengths.svg", "burst-lengths", "share of bursts"),
    ("loss-by-distance.svg", "loss-by-distance", "share of lost messages"),
];
const TABLE: &str = "statistics.csv";

/// Runs the command.
pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let Command::Simulate(args) = &args.command;
    simulate(args)
}

fn simulate(args: &SimulateArgs) -> anyhow::Result<Outcome> {
    end_on_signals()?;
    if let Some(out) = &args.out {
        for (name, ..) in PICTURES {
            outputs::check(&out.join(name), args.force, outputs::is_picture)?;
        }
        outputs::check(&out.join(TABLE), args.force, LinkStatistics::is_csv)?;
    }
    let spec = args.scenario.spec(Some(Spec::new("simple_spread")))?.unwrap_or_else(|| Spec::new("simple_spread"));
    let scenario = scenario::build(&spec).map_err(Error::from)?;
    let link_spec = Spec::parse("link", LINKS, &args.link).map_err(Error::from)?;
    let link = build_link(&link_spec, &*scenario).map_err(Error::from)?;
    let policy = Spec::parse("policy", POLICIES, &args.policy).and_then(|spec| build_policy(&spec, &*scenario));
    let policy = policy.map_err(Error::from)?;
    check_link(&*link, args.episodes).map_err(Error::from)?;
    let recording =
        Recording { scenario: &*scenario, link: &*link, policy: &*policy, seed: args.seed, episodes: args.episodes };
    let layout = recording.layout();
    let bar = ui::progress(args.episodes, "episodes");
    let empty = || LinkStatistics::new(&layout);
    let count = |mut statistics: LinkStatistics, episode: u64| {
        statistics.add(&recording.episode(episode));
        bar.inc(1);
        statistics
    };
    // sums of counts: their order changes nothing
    let counted = (0..args.episodes).into_par_iter().fold(empty, count).reduce(empty, |a, b| a.merge(&b));
    bar.finish_and_clear();
    let title = format!("{link_spec} on {}, {} episodes", spec.name, args.episodes);
    let drawn = args.out.as_ref().map(|out| write(&counted, &title, out)).transpose()?.unwrap_or(0);
    match args.format {
        Format::Json => ui::print_json(&json!({
            "link": link.parameters(), "scenario": scenario.parameters(), "policy": policy.parameters(),
            "episodes": args.episodes, "seed": args.seed, "statistics": counted, "total": counted.total(),
        }))?,
        Format::Table => print(&counted)?,
    }
    match &args.out {
        Some(out) => ui::say(&format!("wrote {TABLE} and {drawn} figures: {}", out.display())),
        None => ui::say("figures: give --out DIR"),
    }
    Ok(Outcome::Done)
}

/// Writes the table and the figures; how many these are. A figure of an earlier run that has nothing to show now goes.
fn write(counted: &LinkStatistics, title: &str, out: &Path) -> anyhow::Result<usize> {
    let mut count = 0;
    for (name, figure, unit) in PICTURES {
        let data = counted.figures(title, unit);
        let drawn = figure::svg(find("figure", FIGURES, figure).map_err(Error::from)?, &data);
        match drawn {
            Ok(svg) => {
                outputs::write_svg(&out.join(name), svg)?;
                count += 1;
            }
            // a link that never loses has no bursts to draw
            Err(figure::FigureError::Empty { needs, .. }) => {
                io::remove(&out.join(name)).map_err(Error::from)?;
                ui::say(&format!("note: no {name}: there is no {needs}"));
            }
            Err(error) => return Err(error.into()),
        }
    }
    io::write_atomic(&out.join(TABLE), counted.csv().as_bytes()).map_err(Error::from)?;
    Ok(count)
}

fn print(counted: &LinkStatistics) -> anyhow::Result<()> {
    let total = counted.total();
    let mut rows: Vec<Vec<String>> = counted
        .links
        .iter()
        .zip(&counted.observed)
        .map(|((sender, receiver), observed)| summary(&format!("{sender} → {receiver}"), observed))
        .collect();
    rows.push(summary("all", &total));
    ui::print_table(&["sender → receiver", "messages", "lost", "loss rate", "bursts", "mean", "longest"], &rows)?;
    ui::print("")?;
    let steps = total.steps.iter().enumerate().map(|(step, &count)| shares(step.to_string(), count));
    ui::print_table(&["step", "messages", "lost", "loss rate", ""], &steps.collect::<Vec<_>>())?;
    let bursts: u64 = total.bursts.iter().sum();
    if bursts > 0 {
        ui::print("")?;
        let row = |(k, &count): (usize, &u64)| {
            let share = count as f64 / bursts as f64;
            vec![(k + 1).to_string(), count.to_string(), percent(share), bar(share)]
        };
        let rows: Vec<_> = total.bursts.iter().enumerate().map(row).collect();
        ui::print_table(&["losses in a row", "bursts", "share", ""], &rows)?;
    }
    if !total.distances.is_empty() {
        ui::print("")?;
        let place = |bin: usize| format!("{:.1} to {:.1}", bin as f64 * BIN_WIDTH, (bin + 1) as f64 * BIN_WIDTH);
        let bins = total.distances.iter().enumerate().filter(|(_, count)| count[0] > 0);
        let rows: Vec<_> = bins.map(|(bin, &count)| shares(place(bin), count)).collect();
        ui::print_table(&["distance, world units", "messages", "lost", "loss rate", ""], &rows)?;
    }
    Ok(())
}

fn summary(name: &str, observed: &Observed) -> Vec<String> {
    let [messages, lost] = observed.total();
    let rate = if messages == 0 { "-".to_owned() } else { percent(lost as f64 / messages as f64) };
    let mean = observed.mean_burst().map_or_else(|| "-".to_owned(), |mean| format!("{mean:.2}"));
    let bursts = observed.bursts.iter().sum::<u64>().to_string();
    vec![name.to_owned(), messages.to_string(), lost.to_string(), rate, bursts, mean, observed.bursts.len().to_string()]
}

fn shares(place: String, [messages, lost]: [u64; 2]) -> Vec<String> {
    let share = lost as f64 / messages.max(1) as f64;
    vec![place, messages.to_string(), lost.to_string(), percent(share), bar(share)]
}

fn percent(share: f64) -> String {
    format!("{:.2} %", 100.0 * share)
}

/// A bar of at most 30 characters.
fn bar(share: f64) -> String {
    "█".repeat((30.0 * share).round() as usize)
}
