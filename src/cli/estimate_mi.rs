//! `ccmarl estimate-mi`: mutual information per link of a store, or between columns of a table.

use std::path::PathBuf;
use std::sync::Arc;

use clap::ValueHint;

use super::args::end_on_signals;
use super::estimates::{class, place, print, split, writer};
use super::jobs::{Gathered, gather};
use super::large::{self, Input};
use super::outputs::Picture;
use super::plot::{self, View};
use super::{Outcome, ui};
use crate::Error;
use crate::mi::{self, ESTIMATORS, Estimate, Plan, Protocol};
use crate::pairs::{self, By, Lagging, PairsError, Predicate, TableOptions};
use crate::registry::{Spec, find};
use crate::rng::Seeds;
use crate::schema::Samples;
use crate::{io, storage};

const EXAMPLES: &str = "\
Examples:
  ccmarl estimate-mi data/tag
  ccmarl estimate-mi data/tag.mcap --estimator jsd,club,gaussian --delivered
  ccmarl estimate-mi table.csv --x a --y b --estimator auto
  ccmarl estimate-mi table.parquet --x a,b --y c --estimator gaussian,jsd --group subject
  ccmarl estimate-mi table.csv --x a --y b --estimator ksg,ksg:10,gcmi
  ccmarl estimate-mi table.csv --x a --y b --given c --estimator gaussian,ksg --unit bits
  ccmarl estimate-mi table.csv --x a --y b --estimator gaussian,ksg,infonce --plot pair.svg
  ccmarl estimate-mi table.csv --all-pairs --estimator gcmi --plot pairs.svg
  ccmarl estimate-mi table.csv --x 'regex:^obs_' --y action --time t --lag 0..10 --estimator ksg
  ccmarl estimate-mi table.csv --x a --y b --estimator auto --sample 10000
  ccmarl estimate-mi table.csv --x job --y city --estimator discrete --format csv
  ccmarl estimate-mi table.csv --x a --y b --time t --out result.json
  ccmarl estimate-mi 'data/*.csv' more.feather --x a --y b --group file --estimator gcmi
  ccmarl estimate-mi table.csv --x a --y b --where \"city <> 'Rome' AND c IS NOT NULL\" --by city
  ccmarl estimate-mi drive.mcap --x /imu.acceleration.x --y /wheel.speed --time log_time
  ccmarl estimate-mi data/tag --by sender,step:10 --where 'episode >= 100'

Interrupted (Ctrl-C), it shows and writes the rows that are finished and exits 4.
For a store: x is the message that the sender sent, y the action of the receiver at the same step, per ordered link,
delivered and lost apart. Values are in nats unless the unit says jsd. p: episodes permuted.
With --by sender, receiver or none, links are pooled: the rows of an episode stay one episode.

A table is CSV, TSV, Parquet, Arrow IPC (file, stream, Feather 2), NPY (columns c0, c1, …, or the
names of its fields) or MCAP (columns /topic.field.path of JSON and protobuf messages, and log_time;
columns of two topics are joined where their log times are equal).
Several files: their rows follow each other; the column file says which one a row is of.
Text: a column is numbers, true/false, dates or words. Missing are empty cells, NA, N/A, #N/A, <NA>,
n.a., NaN, NaT, null, and beside numbers or dates also none - . and ?. A stray cell among numbers is
an error: --words takes the column as words. Columns of words are categories: discrete and ksg-mixed
take them.
Dates (2024-01-31, 2024-01-31T12:00:00.5+01:00) are seconds since the first of them.
--where: = <> < <= > >=, AND, OR, NOT, BETWEEN, IN (…), IS [NOT] NULL, LIKE, + - * / %, 'text',
'2024-01-31' beside dates, \"columns with blanks\". A missing cell is NULL, and so is what is divided
by zero; / never rounds. Rows left out count in no column's type, but a lag counts them.
--by: the group of a row tells its part (row, city = Rome; episode, steps 0–9).
The rows mean:
  auto           one value: chosen by types, ties, width and size, and by what several estimators say
  jsd            2·JSD of the critic, 0 to 2 ln 2: a lower bound on its own scale, not nats
  jsd-plugin     the same critic's estimate of the information, nats
  jsd-nwj, -dv   lower bounds by the same critic, nats; jsd-certified: what the JSD alone proves
  club           upper bound, nats, often several times the truth; club-l1out: a tighter one
  infonce, nwj   lower bounds by a critic of their own, nats; infonce at most ln K; mine: Donsker-Varadhan;
  mine, smile    smile: clipped, an estimate; nwj:concatenated scores x and y side by side
  l1out          the tighter upper bound alone; club-sample: club with one negative
  club-fit       how much better club's density fits than the margin; near 0 it bounds nothing
  gaussian       exact for normal data, bias-corrected, nats; gcmi: the same after ranks made every column normal
  t-copula       gcmi for columns that share a heavy tail; says when it does not fit
  ksg1, ksg2     nearest neighbours, no model, nats; ksg-mixed: for ties and discrete beside continuous columns
  discrete       exact counts of categories, nats; discrete-mm: less the bias of few samples";

/// Arguments of `ccmarl estimate-mi`.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, group(clap::ArgGroup::new("table").args(["x", "all_pairs"]).multiple(true)))]
pub(super) struct Args {
    /// A rollout store (directory, .mcap or .parquet); or, with --x and --y, tables in CSV, TSV, Parquet, Arrow IPC, NPY or MCAP:
    /// one, several, or a quoted pattern ('data/*.csv'), whose rows follow each other
    #[arg(value_name = "PATH", required = true, value_hint = ValueHint::AnyPath)]
    paths: Vec<PathBuf>,
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_value = "jsd,club,gaussian", help = estimators())]
    estimator: Vec<String>,
    /// Table: columns of x, comma-separated, or --x again; regex:PATTERN, commas and all, is every column that it matches
    #[arg(long, value_name = "COLUMNS", value_parser = columns)]
    x: Vec<Names>,
    /// Table: columns of y, as --x
    #[arg(long, value_name = "COLUMNS", value_parser = columns, requires = "x")]
    y: Vec<Names>,
    /// Table: every pair of the columns --x, or of all columns
    #[arg(long, conflicts_with = "y")]
    all_pairs: bool,
    /// Rows from x to y, never across the edge of an episode: 3, or 0,1,5, or 0..10 (both ends included)
    #[arg(long, value_name = "LAGS", default_value = "0", value_parser = lags, allow_hyphen_values = true)]
    lag: Lags,
    /// Table: columns of z; x and y are compared given z (auto, gaussian, gcmi, ksg1, ksg-mixed, discrete, infonce)
    #[arg(long, value_name = "COLUMNS", value_parser = columns, requires = "table")]
    given: Vec<Names>,
    /// Table: rows with the same value in this column are one episode
    #[arg(long, value_name = "COLUMN", requires = "table")]
    group: Option<String>,
    /// Table: column that orders the rows; without --group all rows are one series, cut into blocks
    #[arg(long, value_name = "COLUMN", requires = "table")]
    time: Option<String>,
    /// Rows to use: an SQL condition over any columns, or over a store's episode, step, sender, receiver, delivered
    #[arg(long = "where", value_name = "CONDITION", allow_hyphen_values = true)]
    filter: Option<String>,
    /// Table: one estimate per value of these columns. Store: sender, receiver, both (the default), none: all others are
    /// pooled; step:N apart from that: N steps of the episode at a time
    #[arg(long, value_name = "COLUMNS", value_delimiter = ',')]
    by: Vec<String>,
    /// Table: columns whose values are words, even if they look like numbers
    #[arg(long, value_name = "COLUMNS", value_delimiter = ',', requires = "table")]
    words: Vec<String>,
    /// Table: estimate from so many rows, drawn at random. A table over --memory is sampled without it (1,000,000 rows),
    /// but for gaussian and discrete, which read all rows once
    #[arg(long, value_name = "N", requires = "table", value_parser = clap::value_parser!(u32).range(10..))]
    sample: Option<u32>,
    /// Table: the largest that is held in memory, MiB of numbers or of text; a larger one is read in pieces
    #[arg(long, value_name = "MIB", default_value_t = 256)]
    memory: u32,
    /// Store: delivered messages only
    #[arg(long, conflicts_with_all = ["lost", "table"])]
    delivered: bool,
    /// Store: lost messages only
    #[arg(long, conflicts_with = "table")]
    lost: bool,
    /// Permutations behind a p-value; 0 for none
    #[arg(long, value_name = "N", default_value_t = 199, value_parser = clap::value_parser!(u32).range(0..=100_000))]
    permutations: u32,
    /// Seed of splits, training and permutations
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Threads; 0 for one per core (the result does not depend on it)
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u16).range(0..=1024))]
    threads: u16,
    /// Unit of the values that are information
    #[arg(long, value_enum, default_value_t)]
    unit: InUnit,
    /// How results are printed
    #[arg(long, value_enum, default_value_t)]
    format: Form,
    /// Also write the rows to a .json, .csv or .parquet file
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    out: Option<PathBuf>,
    /// Draw a .svg or .png file: of one pair its points, estimates with intervals, the value on halves and quarters of the
    /// samples, training; of several lags the values over them; of links or --all-pairs a heat map of the first estimator
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    plot: Option<PathBuf>,
    /// Replace --out and --plot if they exist
    #[arg(long)]
    force: bool,
    /// End with exit code 1 if any row carries a warning
    #[arg(long)]
    strict: bool,
}

/// The help of `--estimator`.
pub(super) fn estimators() -> String {
    let names: Vec<&str> = ESTIMATORS.iter().map(|e| e.name).collect();
    format!(
        "Estimators, comma-separated, name or name:k: {} (`ccmarl list estimator` describes them)",
        names.join(", ")
    )
}

/// Names of columns that were given together.
type Names = Arc<[String]>;

/// Reads `a,b`, or a pattern, which may have commas in it.
#[expect(clippy::unnecessary_wraps, reason = "clap's signature")]
fn columns(text: &str) -> Result<Names, std::convert::Infallible> {
    if text.starts_with("regex:") {
        return Ok(Arc::from([text.to_owned()]));
    }
    Ok(text.split(',').map(str::to_owned).collect())
}

/// Rows from x to y.
type Lags = Arc<[usize]>;

/// Reads `3`, `0,1,5` or `0..10`.
fn lags(text: &str) -> Result<Lags, String> {
    let number = |text: &str| text.trim().parse::<usize>().ok().filter(|&lag| lag <= 1_000_000);
    let mut out = Vec::new();
    if text.trim_start().starts_with('-') {
        return Err("a lag moves y behind x: to move x behind y, swap --x and --y".to_owned());
    }
    for part in text.split(',') {
        let range = part.split_once("..").map_or((number(part), number(part)), |(a, b)| (number(a), number(b)));
        match range {
            (Some(first), Some(last)) if first <= last && last - first < 1000 => out.extend(first..=last),
            _ => return Err("expected 3, 0,1,5 or 0..10".to_owned()),
        }
    }
    out.sort_unstable();
    out.dedup();
    Ok(out.into())
}

/// The unit of values that are information.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
enum InUnit {
    /// Nats.
    #[default]
    Nats,
    /// Bits: nats over ln 2.
    Bits,
}

/// How results are printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
enum Form {
    /// For people.
    #[default]
    Table,
    /// One JSON array.
    Json,
    /// CSV with a header.
    Csv,
    /// A Parquet file.
    Parquet,
}

pub(super) fn run(args: &Args) -> anyhow::Result<Outcome> {
    end_on_signals()?;
    let plan = plan(args)?;
    let write = args.out.as_deref().map(|path| writer(path, &args.paths, args.force)).transpose()?;
    let plot = args.plot.as_deref().map(|path| Ok((view(args)?, Picture::at(path, args.force)?)));
    let plot = plot.transpose().map_err(|error: Error| error)?;
    let estimators = plan.estimators.len();
    let Input { samples, plan, places, results } = input(args, plan)?;
    let (samples, plan) = (Arc::new(samples), Arc::new(plan));
    let (own_samples, own_plan) = (Arc::clone(&samples), Arc::clone(&plan));
    let total = samples.len() * plan.estimators.len();
    let Gathered { told, interrupted } = gather(args.threads, total, "estimating", move |stop, tell| {
        mi::run_each(&own_samples, &own_plan, stop, &|place, result| tell((place, result)));
    })?;
    let placed = told.into_iter().map(|(place, result)| (places.as_ref().map_or(place, |of| of[place]), result));
    let told: Vec<(usize, mi::JobResult)> = results.into_iter().chain(placed).collect();
    if interrupted {
        let (done, all) = (told.len(), samples.len() * estimators);
        ui::say(&format!("interrupted: {done} of {all} estimates are finished, and only these are shown"));
        if told.iter().all(|(_, result)| result.rows.is_err()) {
            return Ok(Outcome::Interrupted);
        }
    }
    let (mut rows, failures) = split(mi::in_order(told, estimators))?;
    if args.unit == InUnit::Bits {
        rows = rows.into_iter().map(Estimate::in_bits).collect();
    }
    if let (Some(path), Some(write)) = (&args.out, write) {
        let bytes = write(&rows).map_err(anyhow::Error::msg)?;
        io::write_atomic(path, &bytes).map_err(Error::from)?;
        ui::say(&format!("wrote {} rows: {}", rows.len(), path.display()));
    }
    let printed = match args.format {
        Form::Table => print(&rows, &samples),
        Form::Json => ui::print_bytes(&mi::to_json(&rows).map_err(anyhow::Error::msg)?),
        Form::Csv => ui::print_bytes(&mi::to_csv(&rows).map_err(anyhow::Error::msg)?),
        Form::Parquet => ui::print_bytes(&mi::to_parquet(&rows).map_err(anyhow::Error::msg)?),
    };
    // after the results, which a picture that cannot be drawn must not take away, and even if nobody reads them
    let drawn = plot.filter(|_| !interrupted).map_or(Ok(true), |(view, target)| {
        let failed: Vec<&str> = failures.iter().map(|(job, _)| job.estimator.as_str()).collect();
        plot::draw(view, &rows, &failed, (&samples, &plan), args.threads, &target)
    });
    printed?;
    for (job, error) in &failures {
        ui::say(&format!("warning: no {} for {}: {error}", job.estimator, place(&job.labels)));
    }
    if !drawn? {
        ui::say("interrupted: all estimates are shown, and no picture was drawn");
        return Ok(Outcome::Interrupted);
    }
    if interrupted {
        return Ok(Outcome::Interrupted);
    }
    let warned = rows.iter().filter(|r| r.warnings.iter().any(|w| !w.starts_with(mi::NOTE))).count() + failures.len();
    anyhow::ensure!(!args.strict || warned == 0, "{warned} results carry warnings, and --strict was given");
    Ok(Outcome::Done)
}

/// What `--plot` shows. A heat map has one cell per pair: several lags would fall into one, and columns that are moved
/// in time are other columns on one axis only.
fn view(args: &Args) -> Result<View, Error> {
    if !args.by.is_empty() {
        return Err(Error::Usage("--plot draws one matrix: leave out --by".to_owned()));
    }
    let message = match (args.all_pairs, args.lag.len() > 1) {
        (false, true) => return Ok(View::Lags),
        (false, false) if !args.x.is_empty() => return Ok(View::Pair),
        (true, true) => "--plot of --all-pairs draws one lag: name one pair by --x and --y to see all",
        (true, false) if args.lag.iter().any(|&lag| lag > 0) => {
            "--plot of --all-pairs is for columns at the same time: leave out --lag"
        }
        _ => return Ok(View::Matrix),
    };
    Err(Error::Usage(message.to_owned()))
}

fn plan(args: &Args) -> Result<Plan, Error> {
    let protocol = Protocol { permutations: args.permutations as usize };
    Ok(Plan { estimators: named(&args.estimator)?, protocol, seed: args.seed })
}

/// The estimators of these names, each once.
pub(super) fn named(names: &[String]) -> Result<Vec<mi::Named>, Error> {
    let mut estimators: Vec<mi::Named> = Vec::new();
    for text in names {
        let spec = Spec::parse("estimator", ESTIMATORS, text)?;
        let entry = find("estimator", ESTIMATORS, &spec.name)?;
        if !estimators.iter().any(|(name, _)| *name == spec.to_string()) {
            estimators.push((spec.to_string(), (entry.build)(&spec)?));
        }
    }
    Ok(estimators)
}

/// Samples, or what one pass over a table makes of it that memory does not hold.
fn input(args: &Args, plan: Plan) -> anyhow::Result<Input> {
    let of_table_alone = args.all_pairs || (!args.x.is_empty() && !args.y.is_empty());
    if args.sample.is_none() && of_table_alone {
        let (paths, mut options) = (pairs::matching(&args.paths).map_err(Error::from)?, options(args)?);
        if pairs::size(&paths, &options).map_err(Error::from)? > u64::from(args.memory) << 20 {
            if args.lag.iter().any(|&lag| lag > 0) {
                let message =
                    "--lag needs the rows in memory, and the table is larger than --memory: take a part of it";
                return Err(Error::Usage(format!("{message}: {}", paths[0].display())).into());
            }
            options.sample = Some(pairs::Sample { rows: large::SAMPLE, seeds: sample_seeds(args) });
            let parts = args.all_pairs || args.group.is_some() || args.time.is_some() || !args.by.is_empty();
            if !parts {
                return large::read(&paths, options, plan, args.plot.is_some(), args.threads);
            }
            let samples = of_table(args, &paths, &options)?;
            return Ok(Input { samples, plan, places: None, results: Vec::new() });
        }
    }
    Ok(Input { samples: samples(args)?, plan, places: None, results: Vec::new() })
}

fn sample_seeds(args: &Args) -> Seeds {
    Seeds::new(args.seed).child("sample")
}

/// What the table is asked for.
fn options(args: &Args) -> Result<TableOptions, Error> {
    let names = |given: &[Names]| given.iter().flat_map(|names| names.iter().cloned()).collect();
    Ok(TableOptions {
        x: names(&args.x),
        y: names(&args.y),
        given: names(&args.given),
        group: args.group.clone(),
        time: args.time.clone(),
        words: args.words.clone(),
        filter: args.filter.as_deref().map(Predicate::parse).transpose()?,
        sample: args.sample.map(|rows| pairs::Sample { rows: rows as usize, seeds: sample_seeds(args) }),
        by: args.by.clone(),
        lags: args.lag.to_vec(),
    })
}

fn samples(args: &Args) -> Result<Vec<Samples>, Error> {
    if args.sample.is_some() && args.lag.iter().any(|&lag| lag > 0) {
        return Err(Error::Usage(
            "--lag needs neighbouring rows, which --sample takes apart: leave out one".to_owned(),
        ));
    }
    let paths = pairs::matching(&args.paths)?;
    if !args.x.is_empty() || args.all_pairs {
        return of_table(args, &paths, &options(args)?);
    }
    let (sets, by) = of_store(args, &paths)?;
    let (mut out, mut short, mut lagging) = (Vec::new(), Vec::new(), Lagging::default());
    let mut lagged = |set: &Samples, lag: usize| match lagging.lagged(set, lag) {
        Ok(samples) => Some(samples),
        Err(error) => {
            short.push((place(&set.labels), error));
            None
        }
    };
    // pooled links are put together lag by lag; else a link's lags stay together
    match by {
        Some(by) => {
            for &lag in args.lag.iter() {
                out.extend(by.regroup(sets.iter().filter_map(|set| lagged(set, lag)).collect())?);
            }
        }
        None => out.extend(
            sets.iter()
                .flat_map(|set| args.lag.iter().map(move |&lag| (set, lag)))
                .filter_map(|(set, lag)| lagged(set, lag)),
        ),
    }
    if out.is_empty()
        && let Some((_, error)) = short.pop()
    {
        return Err(error.into());
    }
    for (place, error) in short {
        ui::say(&format!("note: {place} left out: {error}"));
    }
    Ok(out)
}

fn of_table(args: &Args, paths: &[PathBuf], options: &TableOptions) -> Result<Vec<Samples>, Error> {
    if options.y.is_empty() && !args.all_pairs {
        return Err(Error::Usage("--x needs --y, or --all-pairs".to_owned()));
    }
    let read = if args.all_pairs { pairs::all_pairs } else { pairs::tables };
    let (sets, left_out) = read(paths, options)?;
    // what has the same reason is said once
    let mut reasons: std::collections::BTreeMap<&str, Vec<&str>> = std::collections::BTreeMap::new();
    for what in &left_out {
        let (place, reason) = what.split_once(": ").unwrap_or(("", what));
        reasons.entry(reason).or_default().push(place);
    }
    for (reason, places) in reasons {
        match places.as_slice() {
            [""] => ui::say(&format!("note: left out: {reason}")),
            [one] => ui::say(&format!("note: left out: {one}: {reason}")),
            [first, .., last] => {
                ui::say(&format!("note: left out: {first} … {last} ({} in all): {reason}", places.len()));
            }
            [] => {}
        }
    }
    Ok(sets)
}

/// The links of a store without a lag; and how they are to be pooled, if they are.
fn of_store(args: &Args, paths: &[PathBuf]) -> Result<(Vec<Samples>, Option<By>), Error> {
    let filter = args.filter.as_deref().map(Predicate::parse).transpose()?;
    let path = &paths[0];
    if paths.len() > 1 {
        let message = "several paths are read as tables, with --x and --y; a store is read alone";
        return Err(Error::Usage(format!("{message}: {}", path.display())));
    }
    if !pairs::is_store(path)? {
        return Err(PairsError::NoColumns(path.clone()).into());
    }
    let by = By::parse(&args.by)?;
    let mut source = storage::open(path)?;
    let mut links = pairs::links(source.as_mut())?;
    if let Some(predicate) = &filter {
        links.keep(predicate, path)?;
    }
    let mut sets = links.sets;
    for (delivered, unwanted) in [(true, args.lost), (false, args.delivered)] {
        sets.retain(|s| !unwanted || s.labels.delivered != Some(delivered));
        if !unwanted && !sets.iter().any(|s| s.labels.delivered == Some(delivered)) {
            let who = if filter.is_some() { "--where leaves" } else { "the store holds" };
            ui::say(&format!("note: {who} no {} message", class(delivered)));
        }
    }
    Ok((sets, Some(by).filter(|by| !by.is_links())))
}
