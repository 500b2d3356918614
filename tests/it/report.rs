//! Reports: the committed fixture, hostile and broken input, seeds and intervals.

use std::path::{Path, PathBuf};

use ccmarl::Error;
use ccmarl::report::{CHANNELS, Reference, Request, Summary, Task, collect, write};
use ccmarl::rng::{Seeds, normal};
use polars::prelude::{Column, DataFrame, ParquetReader, ParquetWriter, SerReader as _};

const FIXTURE: &str = "datasets/fixtures/two-runs";
const REGENERATE: &str = "cargo test --release -- --ignored make_the_two_runs";

fn parquet(path: &Path, columns: Vec<Column>) {
    let mut frame = DataFrame::new(columns[0].len(), columns).unwrap();
    ParquetWriter::new(std::fs::File::create(path).unwrap()).finish(&mut frame).unwrap();
}

/// The columns of `frame` with one exchanged.
fn with(frame: &DataFrame, new: &Column) -> Vec<Column> {
    frame.columns().iter().map(|c| if c.name() == new.name() { new.clone() } else { c.clone() }).collect()
}

/// A made-up run: returns near `level`, worse on lossy channels.
fn make_run(dir: &Path, algorithm: &str, prior: &str, seed: u64, level: f64) {
    std::fs::create_dir_all(dir).unwrap();
    let name = toml::Value::from(algorithm);
    let text = format!(
        "ccmarl = \"0.1.0\"\nseed = {seed}\nsteps = 1200\nalgorithm = {name}\n\n[scenario]\nname = \"simple_spread\"\n\
         profile = \"paper\"\nagents = 3\n\n[prior]\n{prior}\n"
    );
    io_write(&dir.join("config.toml"), &text);
    let mut stream = Seeds::new(seed).child(algorithm).stream("made up");
    let steps: Vec<i64> = (1..=12).map(|k| 100 * k).collect();
    let returns: Vec<Option<f64>> = steps
        .iter()
        .map(|&s| (s > 100).then(|| -220.0 + (level + 220.0) * s as f64 / 1200.0 + 4.0 * normal(&mut stream)))
        .collect();
    parquet(
        &dir.join("metrics.parquet"),
        vec![Column::new("step".into(), steps), Column::new("return_mean".into(), returns)],
    );
    let (mut channels, mut episodes, mut values, mut losses) = (vec![], vec![], vec![], vec![]);
    for (k, channel) in CHANNELS.iter().enumerate() {
        for episode in 0..4_i64 {
            channels.push(*channel);
            episodes.push(episode);
            values.push(level - 4.0 * k as f64 + 6.0 * normal(&mut stream));
            losses.push([0.0, 0.011, 0.08, 0.114, 0.3, 0.5, 0.9, 1.0][k]);
        }
    }
    let n = channels.len();
    parquet(
        &dir.join("evaluation.parquet"),
        vec![
            Column::new("scenario".into(), vec!["simple_spread"; n]),
            Column::new("agents".into(), vec![3_i64; n]),
            Column::new("algorithm".into(), vec![algorithm; n]),
            Column::new("prior".into(), vec!["as trained"; n]),
            Column::new("seed".into(), vec![seed as i64; n]),
            Column::new("channel".into(), channels),
            Column::new("episode".into(), episodes),
            Column::new("return".into(), values),
            Column::new("loss_rate".into(), losses),
        ],
    );
}

fn io_write(path: &Path, text: &str) {
    ccmarl::io::write_atomic(path, text.as_bytes()).unwrap();
}

fn two_runs(dir: &Path) {
    make_run(&dir.join("cc-maddpg-1"), "cc-maddpg", "name = \"dropout\"\np = 0.2", 1, -130.0);
    make_run(&dir.join("dropout-maddpg-0.2-1"), "dropout-maddpg-0.2", "name = \"dropout\"\np = 0.2", 1, -145.0);
}

fn report(inputs: &[PathBuf], mi: &[PathBuf], out: &Path) -> Result<Summary, Error> {
    let collected = collect(inputs, mi)?;
    let task = Task { scenario: "simple_spread".to_owned(), profile: "paper".to_owned(), agents: 3 };
    let references = [Reference { task, random: vec![-200.0, -248.0], oracle: vec![-60.0, -80.0] }];
    let stop = std::sync::atomic::AtomicBool::new(false);
    let request = Request {
        out,
        force: false,
        title: "Two runs",
        command: "ccmarl report",
        references: &references,
        stop: &stop,
    };
    Ok(write(&collected, &request)?)
}

#[test]
fn a_signal_leaves_nothing_and_a_recording_of_the_same_name_stays() {
    let dir = tempfile::tempdir().unwrap();
    two_runs(&dir.path().join("runs"));
    let collected = collect(&[dir.path().join("runs")], &[]).unwrap();
    let out = dir.path().join("r");
    std::fs::create_dir(dir.path().join(".r.partial")).unwrap();
    let names = || {
        let mut names: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        names
    };
    for stopped in [true, false] {
        let stop = std::sync::atomic::AtomicBool::new(stopped);
        let request =
            Request { out: &out, force: false, title: "x", command: "ccmarl report", references: &[], stop: &stop };
        let written = write(&collected, &request).map_err(|e| e.to_string());
        if stopped {
            assert_eq!(written.unwrap_err(), "interrupted: nothing was written");
            assert_eq!(names(), [".r.partial", "runs"]);
        } else {
            written.unwrap();
            assert_eq!(names(), [".r.partial", "r", "runs"]);
        }
    }
}

fn read(path: impl AsRef<Path>) -> String {
    let path = path.as_ref();
    std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{e}: {} (made by: {REGENERATE})", path.display()))
}

const MADE: [&str; 4] = [
    "figures/simple_spread-3-paper-learning-curves.svg",
    "figures/simple_spread-3-paper-channel-returns.svg",
    "tables/simple_spread-3-paper-returns.md",
    "tables/simple_spread-3-paper-returns.csv",
];

/// Makes the committed fixture anew: runs and what must come out of them. Look at the difference before committing.
#[test]
#[ignore = "writes into datasets/"]
fn make_the_two_runs() {
    let fixture = Path::new(FIXTURE);
    two_runs(&fixture.join("runs"));
    let dir = tempfile::tempdir().unwrap();
    report(&[fixture.join("runs")], &[], &dir.path().join("r")).unwrap();
    for name in MADE {
        io_write(
            &fixture.join("expected").join(Path::new(name).file_name().unwrap()),
            &read(dir.path().join("r").join(name)),
        );
    }
}

#[test]
fn the_fixture_regenerates_its_figures_and_tables() {
    let dir = tempfile::tempdir().unwrap();
    let summary = report(&[Path::new(FIXTURE).join("runs")], &[], &dir.path().join("r")).unwrap();
    assert_eq!((summary.figures, summary.tables.len()), (2, 1));
    for name in MADE {
        let file = Path::new(name).file_name().unwrap();
        let expected = read(Path::new(FIXTURE).join("expected").join(file));
        assert!(read(dir.path().join("r").join(name)) == expected, "{name} differs from the committed one");
    }
    for name in ["index.html", "command.txt", "provenance.json", "figures/simple_spread-3-paper-channel-returns.png"] {
        assert!(dir.path().join("r").join(name).exists(), "{name}");
    }
}

#[test]
fn changing_one_return_changes_figure_and_table() {
    let dir = tempfile::tempdir().unwrap();
    let runs = dir.path().join("runs");
    for run in ["cc-maddpg-1", "dropout-maddpg-0.2-1"] {
        std::fs::create_dir_all(runs.join(run)).unwrap();
        for file in ["config.toml", "metrics.parquet", "evaluation.parquet"] {
            std::fs::copy(Path::new(FIXTURE).join("runs").join(run).join(file), runs.join(run).join(file)).unwrap();
        }
    }
    let path = runs.join("cc-maddpg-1/evaluation.parquet");
    let frame = ParquetReader::new(std::fs::File::open(&path).unwrap()).finish().unwrap();
    let mut returns: Vec<f64> = frame.column("return").unwrap().f64().unwrap().iter().flatten().collect();
    returns[4 * 5 + 2] += 10.0; // dbc-medium, episode 2
    parquet(&path, with(&frame, &Column::new("return".into(), returns)));
    report(&[runs], &[], &dir.path().join("r")).unwrap();
    let same = |name: &str| {
        let file = Path::new(name).file_name().unwrap();
        read(dir.path().join("r").join(name)) == read(Path::new(FIXTURE).join("expected").join(file))
    };
    assert_eq!(MADE.map(same), [true, false, false, false], "training curves stay, returns change");
}

#[test]
fn the_table_joins_published_cells_and_says_what_is_wrong_with_them() {
    let text = read(Path::new(FIXTURE).join("expected/simple_spread-3-paper-returns.md"));
    assert!(text.contains("|  | published | 1 | -129.4 ± 20.1 |"), "{text}");
    assert!(text.contains("dropout-maddpg-0.5 look swapped"), "{text}");
    assert!(text.contains("No value is set in bold"), "{text}");
    assert!(!text.contains("**"), "nothing is best with one seed: {text}");
    assert!(text.contains("| random | reference |  | -224.0 ± 33.9 |"), "{text}");
    let csv = read(Path::new(FIXTURE).join("expected/simple_spread-3-paper-returns.csv"));
    let none = csv.lines().find(|l| l.contains(",none,cc-maddpg,")).unwrap();
    assert!(none.ends_with(",,,,,false"), "the paper has no value without messages: {none}");
}

#[test]
fn three_seeds_give_intervals_and_a_best_row() {
    let dir = tempfile::tempdir().unwrap();
    for seed in 1..=3 {
        let runs = dir.path().join("runs");
        make_run(&runs.join(format!("a{seed}")), "cc-maddpg", "name = \"dropout\"\np = 0.2", seed, -100.0);
        make_run(&runs.join(format!("b{seed}")), "fc-maddpg", "name = \"perfect\"", seed, -180.0);
    }
    report(&[dir.path().join("runs/a*"), dir.path().join("runs/b*")], &[], &dir.path().join("r")).unwrap();
    let text = read(dir.path().join("r/tables/simple_spread-3-paper-returns.md"));
    let row = |name: &str| text.lines().find(|l| l.starts_with(&format!("| {name} |"))).unwrap().to_owned();
    assert_eq!(row("cc-maddpg").matches("**").count(), 16, "bold in all eight columns: {text}");
    assert!(!row("fc-maddpg").contains("**"));
    assert!(text.contains("95 % Student interval"), "{text}");
    let page = read(dir.path().join("r/index.html"));
    assert!(page.contains("means over seeds with 95 % intervals") && !page.contains("fewer than three seeds: read"));
}

#[test]
fn a_hostile_name_stays_text_everywhere() {
    let dir = tempfile::tempdir().unwrap();
    let name = "<script>alert(1)</script>|\"x\", \u{1b}[31m";
    make_run(&dir.path().join("runs/x"), name, "name = \"perfect\"", 1, -100.0);
    report(&[dir.path().join("runs")], &[], &dir.path().join("r")).unwrap();
    let page = read(dir.path().join("r/index.html"));
    assert!(!page.contains("<script") && !page.contains('\u{1b}'), "markup from data");
    assert!(page.contains("&#60;script&#62;") && page.contains("&lt;script&gt;"), "shown in table and figure");
    for absent in ["src=", "<link", "@import", "url("] {
        assert!(!page.contains(absent), "the page needs nothing else: {absent}");
    }
    let table = read(dir.path().join("r/tables/simple_spread-3-paper-returns.md"));
    assert!(table.contains("| &lt;script&gt;alert(1)&lt;/script&gt;\\|"), "{table}");
    let csv = read(dir.path().join("r/tables/simple_spread-3-paper-returns.csv"));
    assert!(csv.contains("\"<script>alert(1)</script>|\"\"x\"\", "), "{csv}");
}

#[test]
fn broken_tables_name_column_and_file() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("x");
    make_run(&run, "fc-maddpg", "name = \"perfect\"", 1, -100.0);
    let path = run.join("evaluation.parquet");
    let good = ParquetReader::new(std::fs::File::open(&path).unwrap()).finish().unwrap();
    let error = |columns: Vec<Column>| {
        parquet(&path, columns);
        let text = report(std::slice::from_ref(&run), &[], &dir.path().join("r")).unwrap_err().to_string();
        assert!(text.ends_with(&format!(": {}", path.display())), "{text}");
        assert!(!dir.path().join("r").exists() && !dir.path().join(".r.partial").exists());
        text.replace(&format!(": {}", path.display()), "")
    };
    assert_eq!(
        error(good.drop("return").unwrap().columns().to_vec()),
        "expected a column \"return\" (numbers), found only scenario, agents, algorithm, prior, seed, channel, episode, \
         loss_rate"
    );
    let n = good.height();
    let text = Column::new("return".into(), vec!["much"; n]);
    assert_eq!(error(with(&good, &text)), "column \"return\": expected numbers, found str");
    let nan = Column::new("return".into(), vec![f64::NAN; n]);
    assert_eq!(error(with(&good, &nan)), "column \"return\", row 0: expected a finite number, found NaN");
    assert_eq!(error(good.head(Some(0)).columns().to_vec()), "expected at least one row, found none");
    parquet(&path, with(&good, &Column::new("algorithm".into(), vec!["maddpg"; n])));
    let mismatch = report(std::slice::from_ref(&run), &[], &dir.path().join("r")).unwrap_err().to_string();
    assert!(mismatch.starts_with("algorithm: config.toml says \"fc-maddpg\", evaluation.parquet says \"maddpg\""));

    parquet(&path, good.columns().to_vec());
    let bytes = std::fs::read(&path).unwrap();
    for length in [0, 3, bytes.len() / 2, bytes.len() - 1] {
        ccmarl::io::write_atomic(&path, &bytes[..length]).unwrap();
        let text = report(std::slice::from_ref(&run), &[], &dir.path().join("r")).unwrap_err().to_string();
        assert!(text.starts_with("expected a Parquet file, found one that cannot be read"), "{length}: {text}");
    }
}

#[test]
fn the_same_training_twice_is_not_two_seeds() {
    let dir = tempfile::tempdir().unwrap();
    make_run(&dir.path().join("a"), "fc-maddpg", "name = \"perfect\"", 1, -100.0);
    make_run(&dir.path().join("b"), "fc-maddpg", "name = \"perfect\"", 1, -110.0);
    let error = report(&[dir.path().join("a"), dir.path().join("b")], &[], &dir.path().join("r")).unwrap_err();
    assert!(error.to_string().starts_with("two runs of fc-maddpg with seed 1 count as one seed: drop one of "));
    // the same directory named twice is one run
    report(&[dir.path().join("a"), dir.path().join("a")], &[], &dir.path().join("r")).unwrap();
}

#[test]
fn runs_that_differ_in_a_setting_are_two_rows_with_the_setting_in_their_names() {
    let dir = tempfile::tempdir().unwrap();
    make_run(&dir.path().join("a"), "cc-maddpg", "name = \"dropout\"\np = 0.2", 1, -100.0);
    make_run(&dir.path().join("b"), "cc-maddpg", "name = \"dropout\"\np = 0.5", 1, -110.0);
    let summary = report(&[dir.path().to_owned()], &[], &dir.path().join("r")).unwrap();
    let names: Vec<&str> = summary.tables[0].rows.iter().map(|r| r.series.as_str()).collect();
    assert_eq!(names, ["cc-maddpg", "cc-maddpg (prior=dropout:0.5)"]);
    let published = |row: usize| summary.tables[0].rows[row].cells[0].as_ref().unwrap().published.is_some();
    assert!(published(0) && !published(1), "the paper has no cc-maddpg trained at dropout 0.5");
}

#[test]
fn a_learner_that_is_not_the_papers_is_named_beside_published_values() {
    let dir = tempfile::tempdir().unwrap();
    for (name, prior, maddpg) in [
        ("plain", "name = \"dropout\"\np = 0.2", "batch = 1024\ngamma = 0.95\nmessages = \"observation\"\ntau = 0.01"),
        ("ours", "name = \"dropout\"\np = 0.2", "gamma = 0.9\nmessages = \"encoder\"\nmessage_width = 8"),
        ("apart", "name = \"dropout\"\np = 0.4", "gamma = 0.8"),
    ] {
        let path = dir.path().join(name);
        make_run(&path, "cc-maddpg", prior, 1, -100.0);
        let text = read(path.join("config.toml"));
        io_write(&path.join("config.toml"), &format!("{text}\n[maddpg]\n{maddpg}\n"));
    }
    let summary = report(&[dir.path().to_owned()], &[], &dir.path().join("r")).unwrap();
    let named: Vec<&String> = summary.tables[0].notes.iter().filter(|note| note.contains("default learner")).collect();
    assert_eq!(named.len(), 1, "{named:?}");
    let told = ": trained with maddpg.gamma = 0.9, maddpg.message_width = 8, maddpg.messages = \"encoder\"; the published row \
                is of the default learner.";
    assert!(named[0].starts_with("cc-maddpg (maddpg.") && named[0].ends_with(told), "{named:?}");
}

#[test]
fn rows_of_different_links_are_not_compared_in_the_column_of_their_own_link() {
    let dir = tempfile::tempdir().unwrap();
    let standard = |path: &Path, loss: f64| {
        let frame = ParquetReader::new(std::fs::File::open(path.join("evaluation.parquet")).unwrap()).finish().unwrap();
        let n = frame.height();
        let channels: Vec<&str> = (0..n).map(|row| if row < 4 { "prior" } else { "unrestricted" }).collect();
        let mut columns = with(&frame, &Column::new("channel".into(), channels));
        columns = with(&DataFrame::new(n, columns).unwrap(), &Column::new("loss_rate".into(), vec![loss; n]));
        columns.push(Column::new("best".into(), vec![true; n]));
        parquet(&path.join("evaluation_standard.parquet"), columns);
    };
    for (tables, other, differ) in
        [("mixed", "name = \"perfect\"", true), ("same", "name = \"dropout\"\np = 0.2", false)]
    {
        for seed in 1..=3 {
            for (name, algorithm, prior, loss) in
                [("a", "cc-maddpg", "name = \"dropout\"\np = 0.2", 0.2), ("b", "fc-maddpg", other, 0.0)]
            {
                let path = dir.path().join(tables).join(format!("{name}{seed}"));
                make_run(&path, algorithm, prior, seed, -100.0);
                standard(&path, loss);
            }
        }
        let out = dir.path().join(format!("report-{tables}"));
        report(&[dir.path().join(tables)], &[], &out).unwrap();
        let text = read(out.join("tables/simple_spread-3-paper-best-returns.md"));
        let cells = |name: &str| -> Vec<String> {
            let line = text.lines().find(|l| l.starts_with(&format!("| {name}"))).unwrap();
            line.split(" | ").map(str::to_owned).collect()
        };
        assert_eq!(cells("algorithm")[3..], ["unrestricted", "prior |"], "{text}");
        let [ours, losses] = [cells("cc-maddpg"), cells("messages lost")];
        assert!(ours[3].contains("**") && ours[4].contains("**") != differ, "{text}");
        assert_eq!((&*losses[3], &*losses[4]), ("10.0 %", if differ { "by row |" } else { "10.0 % |" }), "{text}");
        let note = "- Channel prior is another link in each row (fc-maddpg: perfect; cc-maddpg: dropout:0.2): its column is no \
                    comparison, nothing in it is in bold.";
        assert_eq!(text.contains(note), differ, "{text}");
    }
}

/// Estimates as `estimate-mi` writes them, for two agents.
fn estimates(path: &Path) {
    let text = |name: &str, values: [&str; 4]| Column::new(name.into(), values.to_vec());
    parquet(
        path,
        vec![
            text("estimator", ["jsd", "jsd-plugin", "jsd-plugin", "jsd-plugin"]),
            text("x", ["message"; 4]),
            text("y", ["action"; 4]),
            text("sender", ["agent_0", "agent_0", "agent_1", "agent_0"]),
            text("receiver", ["agent_1", "agent_1", "agent_0", "agent_1"]),
            Column::new("delivered".into(), vec![true, true, true, false]),
            Column::new("value".into(), vec![0.3, 0.41, 0.42, 0.003]),
            text("unit", ["jsd", "nats", "nats", "nats"]),
            text("kind", ["lower bound", "estimate", "estimate", "estimate"]),
            Column::new("interval_low".into(), vec![Some(0.2), Some(0.4), None, None]),
            Column::new("interval_high".into(), vec![Some(0.4), Some(0.42), None, None]),
            Column::new("p_value".into(), vec![None::<f64>, Some(0.01), None, None]),
            Column::new("n".into(), vec![4000_i64; 4]),
            Column::new("warnings".into(), vec![None, None, None, Some("<few> blocks")]),
        ],
    );
}

#[test]
fn estimates_become_a_heat_map_and_a_table() {
    let dir = tempfile::tempdir().unwrap();
    estimates(&dir.path().join("mi.parquet"));
    let summary = report(&[], &[dir.path().join("mi.parquet")], &dir.path().join("r")).unwrap();
    assert_eq!((summary.figures, summary.tables.len()), (1, 0));
    let svg = read(dir.path().join("r/figures/mi-1-heatmap.svg"));
    assert!(svg.contains("\n0.410\n") && svg.contains("\n0.003\n") && !svg.contains("0.300"), "{svg}");
    let page = read(dir.path().join("r/index.html"));
    assert!(page.contains("delivered 0.415 nats on average over 2 links") && page.contains("&#60;few&#62; blocks"));
}

#[test]
fn the_command_prints_a_summary_refuses_what_exists_and_replaces_only_reports() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("r");
    let run = |extra: &[&str]| {
        let mut command = assert_cmd::Command::cargo_bin("ccmarl").unwrap();
        command.args(["report", &format!("{FIXTURE}/runs"), "--out"]).arg(&out).args(extra).output().unwrap()
    };
    let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
    let first = run(&[]);
    assert_eq!(first.status.code(), Some(0), "{}", text(&first.stderr));
    assert!(text(&first.stdout).starts_with("simple_spread, 3 agents, profile paper: mean return per episode"));
    assert!(text(&first.stderr).contains("index.html"));
    let again = run(&[]);
    assert_eq!(again.status.code(), Some(2));
    assert!(text(&again.stderr).starts_with("error: output exists: give --force to replace it"));
    let forced = run(&["--force", "--format", "json"]);
    assert_eq!(forced.status.code(), Some(0), "{}", text(&forced.stderr));
    let json: serde_json::Value = serde_json::from_slice(&forced.stdout).unwrap();
    assert_eq!(json[0]["algorithm"], "dropout-maddpg-0.2");
    let refused = |why: &str| {
        let foreign = run(&["--force"]);
        assert_eq!(foreign.status.code(), Some(1), "{why}");
        assert!(text(&foreign.stderr).contains("did not make"), "{why}: {}", text(&foreign.stderr));
        assert!(out.join("tables").exists() && !dir.path().join(".r.partial").exists(), "{why}: as it was");
    };
    for (name, why) in [("thesis.tex", "beside the page"), ("runs/a", "runs"), ("figures/a.tex", "beside the figures")]
    {
        io_write(&out.join(name), "mine");
        refused(why);
        assert_eq!(read(out.join(name)), "mine");
        std::fs::remove_file(out.join(name)).unwrap();
    }
    std::fs::remove_dir(out.join("runs")).unwrap();
    let provenance = read(out.join("provenance.json"));
    io_write(&out.join("provenance.json"), "{}");
    refused("another program's provenance");
    std::fs::remove_file(out.join("provenance.json")).unwrap();
    refused("any directory with an index.html");
    io_write(&out.join("provenance.json"), &provenance);
    assert_eq!(run(&["--force"]).status.code(), Some(0), "a report and nothing else");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "nothing is left beside it");
    let nothing = assert_cmd::Command::cargo_bin("ccmarl").unwrap().args(["report", "--out", "x"]).output().unwrap();
    assert_eq!((nothing.status.code(), Path::new("x").exists()), (Some(2), false));
}

#[test]
fn a_damaged_table_is_an_error_and_never_a_panic() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("x");
    make_run(&run, "fc-maddpg", "name = \"perfect\"", 1, -100.0);
    estimates(&run.join("mi.parquet"));
    for name in ["evaluation.parquet", "metrics.parquet", "mi.parquet"] {
        let path = run.join(name);
        let bytes = std::fs::read(&path).unwrap();
        let footer = u32::from_le_bytes(bytes[bytes.len() - 8..bytes.len() - 4].try_into().unwrap()) as usize;
        let footer = bytes.len() - 8 - footer;
        for at in (0..footer).step_by(29).chain((footer..bytes.len()).step_by(5)) {
            let mut changed = bytes.clone();
            changed[at] ^= 0x55;
            ccmarl::io::write_atomic(&path, &changed).unwrap();
            // some flips change a value or a statistic that nobody checks; whatever comes back, it comes back
            drop(collect(std::slice::from_ref(&run), &[]));
        }
        ccmarl::io::write_atomic(&path, &bytes).unwrap();
    }
    collect(&[run], &[]).unwrap();
}

#[test]
fn a_channel_of_fewer_seeds_says_so_in_its_cell() {
    let dir = tempfile::tempdir().unwrap();
    for seed in 1..=3 {
        make_run(&dir.path().join(format!("runs/{seed}")), "fc-maddpg", "name = \"perfect\"", seed, -100.0);
    }
    let path = dir.path().join("runs/3/evaluation.parquet");
    let frame = ParquetReader::new(std::fs::File::open(&path).unwrap()).finish().unwrap();
    parquet(&path, frame.head(Some(28)).columns().to_vec()); // seven channels of four episodes: none was not tested
    let summary = report(&[dir.path().join("runs")], &[], &dir.path().join("r")).unwrap();
    let cells: Vec<_> = summary.tables[0].rows[0].cells.iter().flatten().collect();
    assert_eq!(cells.iter().map(|c| c.seeds).collect::<Vec<_>>(), [3, 3, 3, 3, 3, 3, 3, 2]);
    assert!(cells[6].interval.is_some() && cells[7].interval.is_none());
    assert_eq!((summary.tidy()[0].seeds, summary.tidy()[7].seeds), (3, 2));
    let text = read(dir.path().join("r/tables/simple_spread-3-paper-returns.md"));
    assert_eq!(text.matches(" (2 seeds) |").count(), 1, "{text}");
    assert!(text.contains("three or more seeds") && text.contains("fewer than three seeds"), "{text}");
    assert!(text.contains("- fc-maddpg: trained for 1\u{a0}200 steps; the paper for 4\u{a0}000\u{a0}000."), "{text}");
}

#[test]
fn a_foreign_run_cannot_steer_the_terminal() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("x");
    make_run(&run, "fc-maddpg", "name = \"perfect\"", 1, -100.0);
    let config = read(run.join("config.toml"));
    io_write(&run.join("config.toml"), &config.replace("\"paper\"", "\"\\u001b[31mred\""));
    let mut command = assert_cmd::Command::cargo_bin("ccmarl").unwrap();
    let done = command.arg("report").arg(&run).arg("--out").arg(dir.path().join("r")).output().unwrap();
    let (out, err) = (String::from_utf8(done.stdout).unwrap(), String::from_utf8(done.stderr).unwrap());
    assert!(err.contains("no reference rows for") && err.contains("[31mred"), "{err}");
    assert!(!err.contains('\u{1b}') && !out.contains('\u{1b}'), "{err}{out}");
}
