//! Which runs there are, and what is in them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::io::{IoError, printable, read_text, sha256_file};
use crate::registry::Spec;
use crate::report::ReportError;
use crate::report::columns::{Columns, guarded};
use crate::report::mutual::{self, MutualFile};

/// How deep runs are looked for below a given directory.
const DEPTH: usize = 3;

/// Configuration keys that do not make two trainings different: where they go, and the seed.
const NOT_SETTINGS: [&str; 15] = [
    "ccmarl",
    "seed",
    "log_every",
    "checkpoint_every",
    "evaluation.protocol",
    "evaluation.every",
    "evaluation.episodes",
    "out",
    "force",
    "resume",
    "record",
    "threads",
    "name",
    "title",
    "warm_start",
];

/// What runs must share to stand in one table: returns of different tasks are not comparable.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Task {
    /// Scenario name.
    pub scenario: String,
    /// Scenario profile.
    pub profile: String,
    /// Number of agents, as the run counts them.
    pub agents: i64,
}

impl std::fmt::Display for Task {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}, {} agents, profile {}", self.scenario, self.agents, self.profile)
    }
}

/// One training run.
#[derive(Clone, Debug)]
pub struct Run {
    /// Its directory, as given or found.
    pub path: PathBuf,
    /// Version of this program that made it.
    pub ccmarl: String,
    /// Seed.
    pub seed: u64,
    /// Environment steps asked for.
    pub steps: u64,
    /// Preset name.
    pub algorithm: String,
    /// The task.
    pub task: Task,
    /// The scenario, resolved.
    pub scenario: Spec,
    /// Link prior in training.
    pub prior: Spec,
    /// SHA-256 of config.toml.
    pub config_sha256: String,
    /// Every setting except seed and places, flattened: runs with equal settings are seeds of one series.
    pub settings: BTreeMap<String, String>,
    /// Training: (environment steps, mean return of the log interval).
    pub training: Vec<(i64, f64)>,
    /// Test episodes.
    pub episodes: Vec<TestEpisode>,
    /// Test episodes of the best team, where the run chose one (protocol `standard`).
    pub best: Vec<TestEpisode>,
}

/// One test episode.
#[derive(Clone, Debug, PartialEq)]
pub struct TestEpisode {
    /// Test channel.
    pub channel: String,
    /// Sum of team rewards.
    pub value: f64,
    /// Share of messages lost.
    pub loss_rate: f64,
}

/// All that a report is made from.
#[derive(Clone, Debug, Default)]
pub struct Collected {
    /// Runs, in order of path.
    pub runs: Vec<Run>,
    /// MI tables: those inside runs first.
    pub(super) mutual: Vec<MutualFile>,
}

impl Collected {
    /// The distinct tasks, each with the scenario as its first run resolved it.
    pub fn tasks(&self) -> Vec<(Task, Spec)> {
        let mut tasks: BTreeMap<&Task, &Spec> = BTreeMap::new();
        for run in &self.runs {
            tasks.entry(&run.task).or_insert(&run.scenario);
        }
        tasks.into_iter().map(|(task, spec)| (task.clone(), spec.clone())).collect()
    }
}

#[derive(Deserialize)]
struct Config {
    ccmarl: String,
    seed: u64,
    steps: u64,
    algorithm: String,
    scenario: Spec,
    prior: Spec,
}

/// Reads every run at or below `inputs` (`*` in a path component stands for anything) and the given MI tables.
///
/// # Errors
/// [`ReportError`]: a path without runs, a broken configuration or table, nothing given.
pub fn collect(inputs: &[PathBuf], mi: &[PathBuf]) -> Result<Collected, ReportError> {
    if inputs.is_empty() && mi.is_empty() {
        return Err(ReportError::NoInput);
    }
    let mut paths: Vec<PathBuf> = Vec::new();
    for input in inputs {
        let mut found = Vec::new();
        for path in expand(input)? {
            find_runs(&path, DEPTH, &mut found)?;
        }
        if found.is_empty() {
            let missing = !input.exists() && !input.to_string_lossy().contains('*');
            return Err(if missing {
                IoError::Missing(input.clone()).into()
            } else {
                ReportError::NoRuns(input.clone())
            });
        }
        paths.extend(found);
    }
    // the same run by two ways (`runs` and `runs/a`) is one run
    let mut seen: BTreeMap<PathBuf, PathBuf> = BTreeMap::new();
    for path in paths {
        let real = path.canonicalize().map_err(IoError::os("resolve", &path))?;
        seen.entry(real).or_insert(path);
    }
    let mut paths: Vec<PathBuf> = seen.into_values().collect();
    paths.sort();
    let mut collected = Collected::default();
    for path in &paths {
        collected.runs.push(read_run(path)?);
        let table = path.join("mi.parquet");
        if table.exists() {
            collected.mutual.push(guarded(&table, || mutual::read(&table))?);
        }
    }
    for path in mi {
        collected.mutual.push(guarded(path, || mutual::read(path))?);
    }
    Ok(collected)
}

fn list(dir: &Path) -> Result<Vec<PathBuf>, IoError> {
    let entries = std::fs::read_dir(dir).map_err(IoError::os("list", dir))?;
    let paths: Result<Vec<_>, _> = entries.map(|e| e.map(|e| e.path())).collect();
    let mut paths = paths.map_err(IoError::os("list", dir))?;
    paths.sort();
    Ok(paths)
}

fn find_runs(path: &Path, depth: usize, found: &mut Vec<PathBuf>) -> Result<(), ReportError> {
    if path.join("config.toml").is_file() {
        found.push(path.to_owned());
    } else if depth > 0 && path.is_dir() {
        for child in list(path)? {
            let hidden = child.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
            if child.is_dir() && !hidden {
                find_runs(&child, depth - 1, found)?;
            }
        }
    }
    Ok(())
}

/// Paths that a pattern with `*` stands for; a path that exists, or has no `*`, stands for itself.
fn expand(pattern: &Path) -> Result<Vec<PathBuf>, ReportError> {
    if pattern.exists() || !pattern.to_string_lossy().contains('*') {
        return Ok(vec![pattern.to_owned()]);
    }
    let mut paths = vec![PathBuf::new()];
    for component in pattern.components() {
        let name = component.as_os_str().to_string_lossy();
        if !name.contains('*') {
            for path in &mut paths {
                path.push(component);
            }
            continue;
        }
        let mut next = Vec::new();
        for path in &paths {
            let dir = if path.as_os_str().is_empty() { Path::new(".") } else { path.as_path() };
            if !dir.is_dir() {
                continue;
            }
            for child in list(dir)? {
                let Some(file) = child.file_name().map(|f| f.to_string_lossy().into_owned()) else {
                    continue;
                };
                if !file.starts_with('.') && matches(&name, &file) {
                    next.push(path.join(file));
                }
            }
        }
        paths = next;
    }
    Ok(paths)
}

/// Whether `text` fits `pattern`, in which `*` stands for any characters.
fn matches(pattern: &str, text: &str) -> bool {
    let parts: Vec<&str> = pattern.split('*').collect();
    let Some((first, rest)) = parts.split_first() else {
        return false;
    };
    let Some(mut text) = text.strip_prefix(first) else {
        return false;
    };
    let Some((last, middle)) = rest.split_last() else {
        return text.is_empty();
    };
    for part in middle {
        let Some(at) = text.find(part) else {
            return false;
        };
        text = &text[at + part.len()..];
    }
    text.ends_with(last)
}

fn read_run(path: &Path) -> Result<Run, ReportError> {
    let config_path = path.join("config.toml");
    let text = read_text(&config_path, 1 << 20)?;
    let broken = |message: String| ReportError::Config {
        message: message.lines().collect::<Vec<_>>().join(" ").trim().to_owned(),
        path: config_path.clone(),
    };
    let config: Config = toml::from_str(&text).map_err(|e| broken(e.message().to_owned()))?;
    let raw: toml::Table = toml::from_str(&text).map_err(|e| broken(e.message().to_owned()))?;
    let mut settings = crate::registry::dotted(&toml::Value::Table(raw));
    settings.retain(|key, _| !NOT_SETTINGS.contains(&key.as_str()));
    let profile = config.scenario.params.get("profile").and_then(|v| v.as_str()).unwrap_or("paper").to_owned();
    let agents = config.scenario.params.get("agents").and_then(serde_json::Value::as_i64);
    let mut run = Run {
        path: path.to_owned(),
        ccmarl: config.ccmarl,
        seed: config.seed,
        steps: config.steps,
        algorithm: config.algorithm,
        task: Task { scenario: config.scenario.name.clone(), profile, agents: agents.unwrap_or(0) },
        scenario: config.scenario,
        prior: config.prior,
        config_sha256: sha256_file(&config_path)?.0,
        settings,
        training: Vec::new(),
        episodes: Vec::new(),
        best: Vec::new(),
    };
    let (metrics, evaluation) = (path.join("metrics.parquet"), path.join("evaluation.parquet"));
    if !metrics.exists() && !evaluation.exists() {
        return Err(ReportError::EmptyRun(path.to_owned()));
    }
    if metrics.exists() {
        guarded(&metrics, || read_training(&metrics, &mut run))?;
    }
    if evaluation.exists() {
        run.episodes = guarded(&evaluation, || Ok(read_tests(&evaluation, &mut run)?.1))?;
    }
    let standard = path.join("evaluation_standard.parquet");
    if standard.exists() {
        run.best = guarded(&standard, || {
            let (table, episodes) = read_tests(&standard, &mut run)?;
            let best = table.bits_or_null("best")?;
            Ok(episodes.into_iter().zip(best).filter(|(_, best)| *best == Some(true)).map(|(e, _)| e).collect())
        })?;
    }
    Ok(run)
}

fn read_training(path: &Path, run: &mut Run) -> Result<(), ReportError> {
    let table = Columns::open(path)?;
    let rows = table.whole("step")?.into_iter().zip(table.numbers_or_null("return_mean")?);
    // intervals in which no episode ended have no return
    run.training = rows.filter_map(|(step, value)| Some((step, value.filter(|v| v.is_finite())?))).collect();
    Ok(())
}

/// A table of tests, which must be this run's, and its episodes.
fn read_tests(path: &Path, run: &mut Run) -> Result<(Columns, Vec<TestEpisode>), ReportError> {
    let table = Columns::open_filled(path)?;
    let differs = |what, config: &str, evaluation: &str| ReportError::Mismatch {
        what,
        config: format!("{config:?}"),
        evaluation: format!("{evaluation:?}"),
        path: run.path.clone(),
    };
    let agents = table.whole("agents")?;
    for (what, column, config) in
        [("scenario", "scenario", &run.task.scenario), ("algorithm", "algorithm", &run.algorithm)]
    {
        if let Some(other) = table.text(column)?.iter().find(|v| **v != printable(config)) {
            return Err(differs(what, config, other));
        }
    }
    let seed = run.seed as i64;
    if let Some(other) = table.whole("seed")?.iter().find(|&&s| s != seed) {
        return Err(differs("seed", &seed.to_string(), &other.to_string()));
    }
    if let Some(other) = agents.iter().find(|&&n| n != agents[0]) {
        return Err(differs("agents", &agents[0].to_string(), &other.to_string()));
    }
    let (channels, values, losses) = (table.text("channel")?, table.finite("return")?, table.finite("loss_rate")?);
    run.task.agents = agents[0];
    let rows = channels.into_iter().zip(values).zip(losses);
    let rows = rows.map(|((channel, value), loss_rate)| TestEpisode { channel, value, loss_rate }).collect();
    Ok((table, rows))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stars_stand_for_any_characters() {
        assert!(matches("cc-*", "cc-maddpg-1") && matches("*", "x") && matches("a*b*c", "a1b2c"));
        assert!(!matches("cc-*", "fc-maddpg") && !matches("a*b*c", "acb") && !matches("ab*ba", "aba"));
    }

    #[test]
    fn settings_are_flat_and_leave_out_seed_and_places() {
        let flat = crate::registry::dotted(&toml::from_str("a = 1\n[dumie]\nalpha = 0.5").unwrap());
        assert_eq!(
            flat.into_iter().collect::<Vec<_>>(),
            [("a".into(), "1".into()), ("dumie.alpha".into(), "0.5".into())]
        );
    }

    #[test]
    fn a_directory_without_runs_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let error = collect(&[dir.path().to_owned()], &[]).unwrap_err().to_string();
        assert!(error.starts_with("expected a run directory (with config.toml)"), "{error}");
        let missing = collect(&[dir.path().join("x")], &[]).unwrap_err().to_string();
        assert!(missing.starts_with("no such file or directory: "), "{missing}");
        assert_eq!(collect(&[], &[]).unwrap_err().to_string(), "nothing to report: give run directories, or --mi FILE");
    }
}
