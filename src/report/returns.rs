//! Returns by test channel and algorithm: the table behind bars, Markdown, CSV and page.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::algo::MaddpgConfig;
use crate::io::printable;
use crate::report::published::{coefficients, misprints};
use crate::report::{Published, ReportError, Run, Tables, Task};
use crate::stats::{Interval, mean, sd, t_interval};

/// Test channels in the order of columns; others follow by name.
pub const CHANNELS: [&str; 8] =
    ["unrestricted", "mbc-light", "mbc-medium", "mbc-heavy", "dbc-light", "dbc-medium", "dbc-heavy", "none"];

/// Algorithms in the order of rows; others follow by name.
const ALGORITHMS: [&str; 9] = [
    "maddpg",
    "fc-maddpg",
    "dropout-maddpg-0.2",
    "dropout-maddpg-0.5",
    "dropout-maddpg-0.8",
    "cc-maddpg",
    "qmix",
    "cc-qmix",
    "maic",
];

/// Fewest seeds that give an interval over seeds.
const SEEDS_FOR_INTERVAL: usize = 3;

/// The channel that is the link each run trained over: not the same for all rows.
const OWN_LINK: &str = "prior";

/// Environment steps of the paper's trainings.
const PUBLISHED_STEPS: u64 = 4_000_000;

/// Returns of the policies that bracket a task; they hear no messages, so channels do not matter to them.
#[derive(Clone, Debug)]
pub struct Reference {
    /// The task.
    pub task: Task,
    /// Episode returns of the random policy.
    pub random: Vec<f64>,
    /// Episode returns of the oracle (a hand-written rule that sees everything).
    pub oracle: Vec<f64>,
}

/// One algorithm under one channel.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// Seeds with episodes under this channel; fewer than the row's where a run was not evaluated on it.
    pub seeds: usize,
    /// Test episodes, all seeds.
    pub episodes: usize,
    /// Mean over seeds of the mean over episodes.
    pub mean: f64,
    /// Standard deviation over episodes.
    pub sd: f64,
    /// 95 % Student interval over seeds, of three or more.
    pub interval: Option<Interval>,
    /// Realised share of lost messages.
    pub loss_rate: f64,
    /// The published cell.
    pub published: Option<Published>,
    /// Whether no other row of the column is better beyond the intervals; never with fewer than three seeds.
    pub best: bool,
}

impl Cell {
    /// Half-width of what stands behind the ±: the interval over seeds, else one deviation over episodes.
    pub fn spread(&self) -> f64 {
        self.interval.map_or(self.sd, |i| (i.high - i.low) / 2.0)
    }

    /// Its number of seeds in brackets, where the row's says another.
    pub fn seeds_label(&self, row: &Row) -> String {
        match self.seeds {
            n if n == row.seeds.len() => String::new(),
            1 => " (1 seed)".to_owned(),
            n => format!(" ({n} seeds)"),
        }
    }
}

/// One algorithm.
#[derive(Clone, Debug)]
pub struct Row {
    /// Its name, with the settings that tell it from others of the same name.
    pub series: String,
    /// Seeds, ascending.
    pub seeds: Vec<u64>,
    /// One per channel of the table; `None` where it was not evaluated.
    pub cells: Vec<Option<Cell>>,
}

/// The table of one task.
#[derive(Clone, Debug)]
pub struct Returns {
    /// The task.
    pub task: Task,
    /// What a reward counts, in one line.
    pub convention: String,
    /// Columns.
    pub channels: Vec<String>,
    /// The column whose rows are of different links, where there is one: nothing in it is compared.
    pub mixed: Option<usize>,
    /// Rows.
    pub rows: Vec<Row>,
    /// Reference policies: name, mean, standard deviation over episodes, episodes.
    pub references: Vec<(&'static str, f64, f64, usize)>,
    /// What a reader must know, misprints of the paper included.
    pub notes: Vec<String>,
}

/// One line of the tidy CSV.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[expect(missing_docs, reason = "the fields are the columns, named like those of the table")]
pub struct Tidy {
    pub scenario: String,
    pub profile: String,
    pub agents: i64,
    pub channel: String,
    pub algorithm: String,
    pub seeds: usize,
    pub episodes: usize,
    pub mean: f64,
    pub sd_over_episodes: f64,
    pub interval_low: Option<f64>,
    pub interval_high: Option<f64>,
    pub loss_rate: Option<f64>,
    pub published_mean: Option<f64>,
    pub published_sd: Option<f64>,
    pub published_table: Option<&'static str>,
    pub difference: Option<f64>,
    pub best: bool,
}

/// Runs of equal settings, in row order, each with its name.
///
/// # Errors
/// [`ReportError::Duplicate`]: two runs of one series with one seed.
pub(super) fn series<'a>(runs: &[&'a Run]) -> Result<Vec<(String, Vec<&'a Run>)>, ReportError> {
    type Settings = BTreeMap<String, String>;
    let mut groups: BTreeMap<(usize, &str, &Settings), Vec<&'a Run>> = BTreeMap::new();
    for run in runs {
        let rank = ALGORITHMS.iter().position(|a| *a == run.algorithm).unwrap_or(ALGORITHMS.len());
        let group = groups.entry((rank, &run.algorithm, &run.settings)).or_default();
        if let Some(twin) = group.iter().find(|other| other.seed == run.seed) {
            return Err(ReportError::Duplicate {
                series: run.algorithm.clone(),
                seed: run.seed,
                first: twin.path.clone(),
                path: run.path.clone(),
            });
        }
        group.push(run);
    }
    let same_name = |name: &str| groups.keys().filter(|(_, n, _)| *n == name).map(|(_, _, s)| *s).collect::<Vec<_>>();
    let named = groups.iter().map(|((_, name, settings), group)| {
        let mut group = group.clone();
        group.sort_by_key(|r| r.seed);
        (label(name, settings, &same_name(name), group[0]), group)
    });
    Ok(named.collect())
}

/// The algorithm's name, and in brackets what tells it from its namesakes or from its preset.
fn label(
    name: &str,
    settings: &BTreeMap<String, String>,
    namesakes: &[&BTreeMap<String, String>],
    run: &Run,
) -> String {
    let mut differing: BTreeMap<&str, &str> = BTreeMap::new();
    for other in namesakes {
        for key in settings.keys().chain(other.keys()).filter(|k| settings.get(*k) != other.get(*k)) {
            differing.insert(key, settings.get(key).map_or("default", |v| v.trim_matches('"')));
        }
    }
    if name == "cc-maddpg" {
        let (beta, alpha) = coefficients(run);
        for (key, value) in [("dumie.alpha", alpha), ("dumie.beta", beta)] {
            if value == Some(0.0) {
                differing.insert(key, "0");
            }
        }
    }
    let prior = run.prior.to_string();
    let own = crate::algo::preset(name).is_ok_and(|preset| preset.prior == run.prior);
    differing.retain(|key, _| !key.starts_with("prior."));
    if !own {
        differing.insert("prior", &prior);
    }
    let name = printable(name);
    if differing.is_empty() {
        return name;
    }
    let words: Vec<String> =
        differing.iter().map(|(key, value)| format!("{}={value}", key.strip_prefix("dumie.").unwrap_or(key))).collect();
    format!("{name} ({})", printable(&words.join(", ")))
}

/// The table of one task's runs; `None` when none was evaluated.
///
/// # Errors
/// [`ReportError::Duplicate`], [`ReportError::Internal`].
pub(super) fn table(
    task: &Task,
    convention: &str,
    runs: &[&Run],
    reference: Option<&Reference>,
    tables: &Tables,
) -> Result<Option<Returns>, ReportError> {
    let evaluated: Vec<&Run> = runs.iter().copied().filter(|r| !r.episodes.is_empty()).collect();
    if evaluated.is_empty() {
        return Ok(None);
    }
    let mut channels: Vec<String> = Vec::new();
    for channel in evaluated.iter().flat_map(|r| &r.episodes).map(|e| &e.channel) {
        if !channels.contains(channel) {
            channels.push(channel.clone());
        }
    }
    let rank = |c: &String| CHANNELS.iter().position(|k| k == c).unwrap_or(CHANNELS.len());
    channels.sort_by(|a, b| rank(a).cmp(&rank(b)).then(a.cmp(b)));
    let mut rows = Vec::new();
    let mut shown = Vec::new();
    let mut short: BTreeMap<u64, Vec<String>> = BTreeMap::new();
    let mut priors: Vec<(String, &Run)> = Vec::new();
    let mut changed = Vec::new();
    for (name, group) in series(&evaluated)? {
        let cells = channels.iter().map(|channel| cell(&group, channel, tables)).collect::<Vec<_>>();
        for (channel, cell) in channels.iter().zip(&cells) {
            if let Some(published) = cell.as_ref().and_then(|c| c.published) {
                shown.push((group[0].algorithm.clone(), channel.clone(), published));
            }
        }
        if group[0].steps < PUBLISHED_STEPS && cells.iter().flatten().any(|c| c.published.is_some()) {
            short.entry(group[0].steps).or_default().push(name.clone());
        }
        if cells.iter().flatten().any(|c| c.published.is_some()) {
            changed.extend(changed_learner(&name, group[0]));
        }
        if group.iter().flat_map(|run| &run.episodes).any(|e| e.channel == OWN_LINK) {
            priors.push((name.clone(), group[0]));
        }
        rows.push(Row { series: name, seeds: group.iter().map(|r| r.seed).collect(), cells });
    }
    let differ = priors.iter().any(|(_, run)| run.prior != priors[0].1.prior);
    let mixed = channels.iter().position(|channel| differ && channel == OWN_LINK);
    mark_best(&mut rows, (0..channels.len()).filter(|column| Some(*column) != mixed));
    let mut references = Vec::new();
    if let Some(reference) = reference {
        for (name, values) in [("random", &reference.random), ("oracle", &reference.oracle)] {
            if !values.is_empty() {
                references.push((name, mean(values), sd(values), values.len()));
            }
        }
    }
    let mut notes = spread_notes(&rows);
    if !shown.is_empty() {
        notes.push(
            "Published: mean ± standard deviation over 100 test episodes of one seed, as printed. The paper has no \
             value for the channel none. The difference is ours minus published; with one published seed it has no \
             test."
                .to_owned(),
        );
    }
    for (steps, names) in short {
        let (steps, published) = (thousands(steps), thousands(PUBLISHED_STEPS));
        notes.push(format!("{}: trained for {steps} steps; the paper for {published}.", names.join(", ")));
    }
    notes.extend(changed);
    if mixed.is_some() {
        let of = priors.iter().map(|(name, run)| format!("{name}: {}", printable(&run.prior.to_string())));
        notes.push(format!(
            "Channel {OWN_LINK} is another link in each row ({}): its column is no comparison, nothing in it is in bold.",
            of.collect::<Vec<_>>().join("; ")
        ));
    }
    if !references.is_empty() {
        notes.push(
            "random and oracle hear no messages: one value stands for all channels, ± standard deviation over episodes."
                .to_owned(),
        );
    }
    notes.extend(misprints(task, &shown));
    let (task, convention) = (task.clone(), convention.to_owned());
    Ok(Some(Returns { task, convention, channels, mixed, rows, references, notes }))
}

fn cell(group: &[&Run], channel: &str, tables: &Tables) -> Option<Cell> {
    let of = |run: &Run| run.episodes.iter().filter(|e| e.channel == channel).cloned().collect::<Vec<_>>();
    let by_seed: Vec<_> = group.iter().map(|run| of(run)).filter(|e| !e.is_empty()).collect();
    if by_seed.is_empty() {
        return None;
    }
    let means: Vec<f64> = by_seed.iter().map(|es| mean(&es.iter().map(|e| e.value).collect::<Vec<_>>())).collect();
    let all: Vec<f64> = by_seed.iter().flatten().map(|e| e.value).collect();
    let losses: Vec<f64> = by_seed.iter().flatten().map(|e| e.loss_rate).collect();
    let enough = means.len() >= SEEDS_FOR_INTERVAL;
    Some(Cell {
        seeds: means.len(),
        episodes: all.len(),
        mean: mean(&means),
        sd: if all.len() < 2 { 0.0 } else { sd(&all) },
        interval: if enough { t_interval(&means, 0.95) } else { None },
        loss_rate: mean(&losses),
        published: tables.of(group[0], channel),
        best: false,
    })
}

/// What a run beside published values changed of the learner, whose defaults are the paper's; settings that its
/// configuration does not name are those.
fn changed_learner(name: &str, run: &Run) -> Option<String> {
    let learners = crate::scenario::build(&run.scenario)
        .map_or(run.task.agents as usize, |scenario| scenario.agents().iter().filter(|a| a.learner).count());
    let batch = Some(MaddpgConfig::batch_of(&run.scenario.name, learners));
    let text = toml::to_string(&MaddpgConfig { batch, ..MaddpgConfig::default() }).ok()?;
    let plain = crate::registry::dotted(&toml::from_str(&format!("[maddpg]\n{text}")).ok()?);
    let changed =
        run.settings.iter().filter(|(key, value)| key.starts_with("maddpg.") && plain.get(*key) != Some(value));
    let changed: Vec<String> = changed.map(|(key, value)| format!("{key} = {value}")).collect();
    (!changed.is_empty()).then(|| {
        let changed = printable(&changed.join(", "));
        format!("{name}: trained with {changed}; the published row is of the default learner.")
    })
}

/// A whole number with a no-break space between thousands.
fn thousands(number: u64) -> String {
    let digits = number.to_string();
    let groups = digits.as_bytes().rchunks(3).rev().map(|g| g.iter().map(|b| char::from(*b)).collect::<String>());
    groups.collect::<Vec<_>>().join("\u{a0}")
}

/// Marks, per column, the highest mean and every row whose interval reaches into the best one's; only where all rows
/// have intervals over seeds and there are at least two.
fn mark_best(rows: &mut [Row], columns: impl Iterator<Item = usize>) {
    for column in columns {
        let cells: Vec<&Cell> = rows.iter().filter_map(|r| r.cells[column].as_ref()).collect();
        if cells.len() < 2 || cells.iter().any(|c| c.interval.is_none()) {
            continue;
        }
        let best = cells.iter().copied().max_by(|a, b| a.mean.total_cmp(&b.mean)).and_then(|c| c.interval);
        let Some(best) = best else { continue };
        for cell in rows.iter_mut().filter_map(|r| r.cells[column].as_mut()) {
            cell.best = cell.interval.is_some_and(|i| i.high >= best.low);
        }
    }
}

fn spread_notes(rows: &[Row]) -> Vec<String> {
    let cells = || rows.iter().flat_map(|r| r.cells.iter().flatten());
    let few = cells().filter(|c| c.interval.is_none()).count();
    let mut notes = Vec::new();
    if few < cells().count() {
        notes.push("± with three or more seeds: half of the 95 % Student interval for the mean over seeds.".to_owned());
    }
    if few > 0 {
        notes.push(
            "± with fewer than three seeds: one standard deviation over episodes. It says how much episodes vary, not \
             how sure the mean is over trainings: not a comparison of algorithms."
                .to_owned(),
        );
    }
    if few > 0 && !cells().any(|c| c.best) {
        notes.push(
            "No value is set in bold: a best algorithm is named only when every row has at least three seeds."
                .to_owned(),
        );
    } else if few > 0 {
        notes.push(
            "Bold, only in columns where every row has at least three seeds: the highest mean, and every mean whose \
             interval reaches into its interval."
                .to_owned(),
        );
    } else if rows.len() > 1 {
        notes.push(
            "Bold: the highest mean of a column, and every mean whose interval reaches into its interval.".to_owned(),
        );
    }
    notes
}

impl Returns {
    /// One line per algorithm and channel, then the reference policies.
    pub fn tidy(&self) -> Vec<Tidy> {
        let base = |algorithm: &str, channel: &str, mean: f64, sd: f64, episodes: usize| Tidy {
            scenario: self.task.scenario.clone(),
            profile: self.task.profile.clone(),
            agents: self.task.agents,
            channel: channel.to_owned(),
            algorithm: algorithm.to_owned(),
            seeds: 0,
            episodes,
            mean,
            sd_over_episodes: sd,
            interval_low: None,
            interval_high: None,
            loss_rate: None,
            published_mean: None,
            published_sd: None,
            published_table: None,
            difference: None,
            best: false,
        };
        let mut lines = Vec::new();
        for row in &self.rows {
            for (channel, cell) in self.channels.iter().zip(&row.cells) {
                let Some(cell) = cell else { continue };
                lines.push(Tidy {
                    seeds: cell.seeds,
                    interval_low: cell.interval.map(|i| i.low),
                    interval_high: cell.interval.map(|i| i.high),
                    loss_rate: Some(cell.loss_rate),
                    published_mean: cell.published.map(|p| p.mean),
                    published_sd: cell.published.map(|p| p.sd),
                    published_table: cell.published.map(|p| p.table),
                    difference: cell.published.map(|p| cell.mean - p.mean),
                    best: cell.best,
                    ..base(&row.series, channel, cell.mean, cell.sd, cell.episodes)
                });
            }
        }
        for &(name, mean, sd, episodes) in &self.references {
            lines.push(base(name, "all", mean, sd, episodes));
        }
        lines
    }
}
