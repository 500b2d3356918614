//! The output directory: figures, tables, page and provenance, published whole or not at all.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use serde_json::json;

use crate::figure::{self, Bar, Data, FIGURES};
use crate::io::IoError;
use crate::io::{create_parent, publish, read_text, refuse_existing, write_atomic};
use crate::registry::find;
use crate::report::collect::{Collected, Task};
use crate::report::markdown::{Grid, Line, caption, csv, document, escape, grid, table, tidy_csv};
use crate::report::mutual::{MutualFile, map, number};
use crate::report::page::{Picture, Section, html};
use crate::report::returns::{Reference, Returns, Tidy};
use crate::report::{ReportError, Run, Tables, curves, returns};

/// The file that says that a directory is a report, by its key `ccmarl`.
const MARKER: &str = "provenance.json";

/// Most lines of estimates on the page; the CSV has all.
const LINES_ON_PAGE: usize = 200;

/// What is asked for.
#[derive(Clone, Debug)]
pub struct Request<'a> {
    /// Output directory.
    pub out: &'a Path,
    /// Replace an output that is there.
    pub force: bool,
    /// Title of the page.
    pub title: &'a str,
    /// The command line, for the provenance.
    pub command: &'a str,
    /// Returns of random policy and oracle, where the caller has them.
    pub references: &'a [Reference],
    /// Once it is true, nothing is written.
    pub stop: &'a AtomicBool,
}

/// What was made.
#[derive(Clone, Debug)]
pub struct Summary {
    /// The page.
    pub page: PathBuf,
    /// Number of figures.
    pub figures: usize,
    /// One table per task that has test episodes.
    pub tables: Vec<Returns>,
}

impl Summary {
    /// All tables as tidy lines.
    pub fn tidy(&self) -> Vec<Tidy> {
        self.tables.iter().flat_map(Returns::tidy).collect()
    }
}

/// Writes the report's directory.
///
/// With `force`, a directory is replaced only if it is an earlier report and nothing else is in it.
///
/// # Errors
/// [`ReportError`]; nothing stays under `request.out` then, but what was there.
pub fn write(collected: &Collected, request: &Request<'_>) -> Result<Summary, ReportError> {
    refuse_existing(request.out, request.force)?;
    refuse_foreign(request.out)?;
    create_parent(request.out)?;
    // a name that nobody else has: `.NAME.partial` may be a recording that `recover` can still put in place
    let folder = request.out.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut options = tempfile::Builder::new();
    options.prefix(".report.").suffix(".new");
    #[cfg(unix)]
    options.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o777)); // less the umask, as of any directory
    let built = options.tempdir_in(folder).map_err(IoError::os("create the directory", request.out))?;
    let summary = fill(Output::start(built.path(), request.stop)?, collected, request)?;
    refuse_foreign(request.out)?;
    publish(built.path(), request.out, request.force, MARKER)?;
    Ok(summary)
}

/// Refuses to replace anything but an earlier report with only its own files, or an empty directory.
fn refuse_foreign(out: &Path) -> Result<(), IoError> {
    if out.symlink_metadata().is_err() {
        return Ok(());
    }
    let foreign = || IoError::Foreign(out.to_owned());
    if !out.is_dir() {
        return Err(foreign());
    }
    let made = |dir: &Path, own: &dyn Fn(&str) -> bool| -> Result<bool, IoError> {
        for entry in std::fs::read_dir(dir).map_err(IoError::os("list", dir))? {
            let name = entry.map_err(IoError::os("list", dir))?.file_name();
            if !own(&name.to_string_lossy()) {
                return Ok(false);
            }
        }
        Ok(true)
    };
    if made(out, &|_| false)? {
        return Ok(()); // empty
    }
    let record = read_text(&out.join(MARKER), 64 << 20).ok();
    let record = record.and_then(|text| serde_json::from_str::<serde_json::Value>(&text).ok());
    if record.is_none_or(|record| record.get("ccmarl").is_none()) {
        return Err(foreign());
    }
    let ends = |name: &str, endings: [&str; 2]| endings.iter().any(|e| name.ends_with(e));
    let ours = made(out, &|name| ["index.html", "command.txt", MARKER, "figures", "tables"].contains(&name))?
        && (!out.join("figures").is_dir() || made(&out.join("figures"), &|name| ends(name, [".svg", ".png"]))?)
        && (!out.join("tables").is_dir() || made(&out.join("tables"), &|name| ends(name, [".md", ".csv"]))?);
    if ours { Ok(()) } else { Err(foreign()) }
}

/// The directory under work.
struct Output<'a> {
    dir: PathBuf,
    figures: usize,
    stop: &'a AtomicBool,
}

impl<'a> Output<'a> {
    fn start(dir: &Path, stop: &'a AtomicBool) -> Result<Self, ReportError> {
        for sub in ["figures", "tables"] {
            std::fs::create_dir_all(dir.join(sub)).map_err(IoError::os("create the directory", dir))?;
        }
        Ok(Self { dir: dir.to_owned(), figures: 0, stop })
    }

    fn text(&self, name: &str, text: &str) -> Result<(), ReportError> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(ReportError::Stopped);
        }
        Ok(write_atomic(&self.dir.join(name), text.as_bytes())?)
    }

    fn picture(&mut self, name: &str, data: &Data, file: &str, seen: String) -> Result<Picture, ReportError> {
        let entry = find("figure", FIGURES, name).map_err(|e| ReportError::Internal(e.to_string()))?;
        let svg = figure::svg(entry, data)?;
        self.text(&format!("figures/{file}.svg"), &svg)?;
        figure::png(entry, data, &self.dir.join(format!("figures/{file}.png")))?;
        self.figures += 1;
        let caption = format!("{}: {}", data.title, data.subtitle);
        Ok(Picture { file: file.to_owned(), svg, caption, seen })
    }
}

fn fill(mut output: Output<'_>, collected: &Collected, request: &Request<'_>) -> Result<Summary, ReportError> {
    let published = Tables::load()?;
    let mut sections = Vec::new();
    let mut tables = Vec::new();
    for (task, spec) in collected.tasks() {
        let runs: Vec<&Run> = collected.runs.iter().filter(|r| r.task == task).collect();
        let reference = request.references.iter().find(|r| r.task == task);
        // a scenario that this build does not know is still reported
        let convention = crate::scenario::build(&spec)
            .map_or_else(|_| "team reward as the run recorded it".to_owned(), |s| s.reward_convention().to_owned());
        let returns = returns::table(&task, &convention, &runs, reference, &published)?;
        sections.push(task_section(&mut output, &task, &runs, returns.as_ref(), reference)?);
        sections.extend(best_section(&output, &task, &convention, &runs)?);
        tables.extend(returns);
    }
    for (index, file) in collected.mutual.iter().enumerate() {
        sections.push(mutual_section(&mut output, index, file)?);
    }
    let digests: Vec<(String, String)> =
        collected.mutual.iter().map(|m| (m.path.display().to_string(), m.sha256.clone())).collect();
    let lead = lead(collected, &tables);
    let page = html(request.title, &lead, &sections, &collected.runs, &digests, request.command)?;
    output.text("index.html", &page)?;
    output.text("command.txt", &format!("{}\n", request.command))?;
    let runs: Vec<_> = collected.runs.iter().map(provenance).collect();
    let estimates: Vec<_> = digests.iter().map(|(path, sha256)| json!({ "path": path, "sha256": sha256 })).collect();
    let record = json!({
        "ccmarl": env!("CARGO_PKG_VERSION"), "title": request.title, "command": request.command,
        "runs": runs, "estimates": estimates, "published": "arXiv 2512.03528 (datasets/paper)",
    });
    output.text("provenance.json", &format!("{record:#}\n"))?;
    Ok(Summary { page: request.out.join("index.html"), figures: output.figures, tables })
}

fn provenance(run: &Run) -> serde_json::Value {
    json!({
        "path": run.path.display().to_string(), "scenario": run.scenario, "algorithm": run.algorithm, "prior": run.prior,
        "seed": run.seed, "steps": run.steps, "ccmarl": run.ccmarl, "config_sha256": run.config_sha256,
        "test_episodes": run.episodes.len(),
    })
}

fn lead(collected: &Collected, tables: &[Returns]) -> String {
    let runs = collected.runs.len();
    let mut parts = Vec::new();
    if runs > 0 {
        parts.push(format!(
            "{runs} training {} on {} {}",
            plural(runs, "run"),
            collected.tasks().len(),
            plural(collected.tasks().len(), "task")
        ));
    }
    let episodes: usize = collected.runs.iter().map(|r| r.episodes.len()).sum();
    if episodes > 0 {
        parts.push(format!("{episodes} test episodes"));
    }
    if !collected.mutual.is_empty() {
        parts.push(format!(
            "{} {} of mutual-information estimates",
            collected.mutual.len(),
            plural(collected.mutual.len(), "table")
        ));
    }
    let single = tables.iter().any(|t| t.rows.iter().any(|r| r.cells.iter().flatten().any(|c| c.seeds < 3)));
    let caution =
        if single { " Some rows have fewer than three seeds: read them as examples, not as a comparison." } else { "" };
    format!("{}.{caution}", parts.join(", "))
}

fn plural(n: usize, word: &str) -> String {
    if n == 1 { word.to_owned() } else { format!("{word}s") }
}

/// Letters, digits and dashes of a name, for files and anchors.
fn slug(text: &str) -> String {
    let mapped: String = text
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() || c == '_' { c.to_ascii_lowercase() } else { '-' })
        .collect();
    mapped.split('-').filter(|p| !p.is_empty()).collect::<Vec<_>>().join("-").chars().take(80).collect()
}

fn task_section(
    output: &mut Output<'_>,
    task: &Task,
    runs: &[&Run],
    returns: Option<&Returns>,
    reference: Option<&Reference>,
) -> Result<Section, ReportError> {
    let id = slug(&format!("{}-{}-{}", task.scenario, task.agents, task.profile));
    let names = returns::series(runs)?.into_iter().map(|(name, _)| name).collect::<Vec<_>>();
    let lines = reference.map_or_else(Vec::new, |r| {
        let line = |name: &str, values: &[f64]| {
            let value = crate::stats::mean(values);
            let label = format!("{name} policy {value:.1}").replace('-', "−");
            (!values.is_empty()).then_some(figure::Reference { label, value })
        };
        line("random", &r.random).into_iter().chain(line("oracle", &r.oracle)).collect()
    });
    let base = Data { series: names, references: lines, unit: "return per episode".to_owned(), ..Data::default() };
    let mut pictures = Vec::new();
    if let Some(found) = curves::curves(runs)? {
        let spread = if found.bands {
            "means over seeds with 95 % intervals; thin lines: runs of fewer than 3 seeds"
        } else {
            "one thin line per run (no series has 3 seeds)"
        };
        let data = Data {
            title: format!("Training on {}, {} agents", task.scenario, task.agents),
            subtitle: format!("{spread}; windows of {:.0} steps", found.window),
            curves: found.lines,
            ..base.clone()
        };
        pictures.push(output.picture("learning-curves", &data, &format!("{id}-learning-curves"), found.seen)?);
    }
    let mut section = Section {
        id: id.clone(),
        title: task.to_string(),
        pictures,
        caption: String::new(),
        table: None,
        files: Vec::new(),
        notes: Vec::new(),
    };
    let Some(returns) = returns else {
        if runs.iter().all(|r| r.best.is_empty()) {
            section.notes.push("No run of this task has been evaluated: run `ccmarl evaluate`.".to_owned());
        }
        return Ok(section);
    };
    let data = Data {
        title: format!("Return by test channel on {}, {} agents", task.scenario, task.agents),
        subtitle: whiskers(returns),
        bars: bars(returns),
        ..base
    };
    section.pictures.push(output.picture("channel-returns", &data, &format!("{id}-channel-returns"), seen(returns))?);
    section.caption = caption(returns);
    section.table = Some(grid(returns));
    section.notes.clone_from(&returns.notes);
    section.files = vec![format!("tables/{id}-returns.md"), format!("tables/{id}-returns.csv")];
    output.text(&section.files[0], &document(returns))?;
    output.text(&section.files[1], &tidy_csv(&returns.tidy()))?;
    Ok(section)
}

/// The best teams of runs that chose one, in a table of their own: chosen teams stand beside no last ones.
fn best_section(
    output: &Output<'_>,
    task: &Task,
    convention: &str,
    runs: &[&Run],
) -> Result<Option<Section>, ReportError> {
    let chosen = runs.iter().filter(|r| !r.best.is_empty());
    let best: Vec<Run> = chosen.map(|r| Run { episodes: r.best.clone(), ..(*r).clone() }).collect();
    let best: Vec<&Run> = best.iter().collect();
    let Some(mut returns) = returns::table(task, convention, &best, None, &Tables::default())? else { return Ok(None) };
    returns.notes.insert(
        0,
        "Of each run the best team, by its tests over the link that it trained over (channel prior), tested again on other \
         episodes. The table of last teams is another."
            .to_owned(),
    );
    let id = slug(&format!("{}-{}-{}-best", task.scenario, task.agents, task.profile));
    let files = vec![format!("tables/{id}-returns.md"), format!("tables/{id}-returns.csv")];
    output.text(&files[0], &document(&returns))?;
    output.text(&files[1], &tidy_csv(&returns.tidy()))?;
    let (caption, table) = (caption(&returns), Some(grid(&returns)));
    let title = format!("{task}: best teams");
    Ok(Some(Section { id, title, pictures: Vec::new(), caption, table, files, notes: returns.notes }))
}

/// What the whiskers are; a comparison is promised only over seeds.
fn whiskers(returns: &Returns) -> String {
    let cells = || returns.rows.iter().flat_map(|r| r.cells.iter().flatten());
    let few = cells().filter(|c| c.interval.is_none()).count();
    match (few, cells().all(|c| c.seeds == 1)) {
        (0, _) => "whiskers: 95 % Student interval over seeds".to_owned(),
        (_, true) => "one seed: ± one standard deviation over episodes, not a comparison".to_owned(),
        (n, _) if n == cells().count() => {
            "fewer than 3 seeds: ± one standard deviation over episodes, not a comparison".to_owned()
        }
        _ => "whiskers: 95 % interval over seeds where there are 3, else ± one deviation over episodes".to_owned(),
    }
}

fn bars(returns: &Returns) -> Vec<Bar> {
    let mut bars = Vec::new();
    for (column, channel) in returns.channels.iter().enumerate() {
        let cells: Vec<_> = returns.rows.iter().filter_map(|r| Some((r, r.cells[column].as_ref()?))).collect();
        let lost = 100.0 * crate::stats::mean(&cells.iter().map(|(_, c)| c.loss_rate).collect::<Vec<_>>());
        for (row, cell) in cells {
            let (value, half) = (cell.mean, cell.spread());
            let group = format!("{channel}\n{lost:.1} % lost");
            bars.push(Bar { group, series: row.series.clone(), value, low: value - half, high: value + half });
        }
    }
    bars
}

/// One sentence per series: from its best to its worst channel.
fn seen(returns: &Returns) -> String {
    let mut words = Vec::new();
    for row in &returns.rows {
        let cells: Vec<_> =
            returns.channels.iter().zip(&row.cells).filter_map(|(c, cell)| Some((c, cell.as_ref()?.mean))).collect();
        let Some(&(first, start)) = cells.first() else {
            continue;
        };
        let Some(&(worst, least)) = cells.iter().min_by(|a, b| a.1.total_cmp(&b.1)) else {
            continue;
        };
        words.push(if worst == first {
            format!("{} is lowest on {first} itself ({start:.1})", row.series)
        } else {
            format!("{} goes from {start:.1} on {first} to {least:.1} on {worst}, its lowest", row.series)
        });
    }
    format!("{}.", words.join("; "))
}

fn mutual_section(output: &mut Output<'_>, index: usize, file: &MutualFile) -> Result<Section, ReportError> {
    let id = format!("mi-{}", index + 1);
    let mut pictures = Vec::new();
    let mut notes = Vec::new();
    if let Some(map) = map(file) {
        let kind = if map.kind == "estimate" {
            "an estimate".to_owned()
        } else {
            format!("a {}", map.kind).replace("a upper", "an upper")
        };
        let data = Data {
            title: "Mutual information of messages and actions, per link".to_owned(),
            subtitle: format!("{}: {kind}, {}", map.estimator, map.unit),
            unit: format!("mutual information, {}", map.unit),
            cells: map.cells,
            ..Data::default()
        };
        pictures.push(output.picture("mi-heatmap", &data, &format!("{id}-heatmap"), map.seen)?);
    } else {
        notes.push("No row names sender and receiver with a finite value: no heat map.".to_owned());
    }
    let words = [
        "estimator",
        "x",
        "y",
        "sender",
        "receiver",
        "messages",
        "value",
        "unit",
        "kind",
        "interval",
        "p",
        "n",
        "warnings",
    ];
    let line = |e: &crate::report::mutual::Estimate| {
        let agent = |a: &Option<String>| a.clone().unwrap_or_default();
        let interval = e.interval.map_or(String::new(), |(l, h)| format!("[{}, {}]", number(Some(l)), number(Some(h))));
        let p = e.p_value.map_or_else(String::new, crate::mi::p_text);
        vec![
            e.estimator.clone(),
            e.x.clone(),
            e.y.clone(),
            agent(&e.sender),
            agent(&e.receiver),
            e.class().to_owned(),
            number(e.value),
            e.unit.clone(),
            e.kind.clone(),
            interval,
            p,
            e.n.to_string(),
            e.warnings.clone(),
        ]
    };
    let all: Vec<Vec<String>> = file.rows.iter().map(line).collect();
    let cells = |row: &Vec<String>| Line { kind: "ours", cells: row.iter().map(|c| (c.clone(), false)).collect() };
    let shown = Grid {
        header: words.iter().map(|w| (*w).to_owned()).collect(),
        lines: all.iter().take(LINES_ON_PAGE).map(cells).collect(),
    };
    if all.len() > LINES_ON_PAGE {
        notes.push(format!("The first {LINES_ON_PAGE} of {} rows; the CSV has all.", all.len()));
    }
    let title = format!("Mutual information: {}", file.path.display());
    let files = vec![format!("tables/{id}.md"), format!("tables/{id}.csv")];
    output.text(&files[0], &format!("{}\n\n{}", escape(&title), table(&shown)))?;
    output.text(&files[1], &csv(&words, all.into_iter()))?;
    let caption = "Estimates per link; units are never mixed: read the unit beside each value.".to_owned();
    Ok(Section { id, title, pictures, caption, table: Some(shown), files, notes })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slugs_are_safe_file_names() {
        assert_eq!(slug("simple_tag-3-paper"), "simple_tag-3-paper");
        assert_eq!(slug("../../<x> A"), "x-a");
    }
}
