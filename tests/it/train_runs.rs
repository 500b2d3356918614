//! Runs that are replaced, resumed, tested, recorded, or started from a store: what each may take for its own.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use ccmarl::algo::Masks;
use ccmarl::io::write_atomic;
use ccmarl::registry::Spec;
use ccmarl::train::{EvaluationConfig, METRIC_COLUMNS, Options, Protocol, TrainConfig, Trainer, train};
use sha2::{Digest as _, Sha256};

use super::train::{LEARNED, bytes, config, frame, ints, run};

const RESUME: Options<'_> = Options { warm_start: None, record: None, resume: true, force: false };
const FORCE: Options<'_> = Options { warm_start: None, record: None, resume: false, force: true };

fn refused(config: TrainConfig, path: &Path, options: &Options<'_>) -> String {
    train(config, path, options, &mut |_| {}, &AtomicBool::new(false)).unwrap_err().to_string()
}

fn standard(steps: u64, every: u64) -> TrainConfig {
    let mut config = config("dropout-maddpg-0.2", steps);
    config.evaluation = EvaluationConfig { protocol: Protocol::Standard, every, episodes: Some(2) };
    config
}

/// Exit code and stderr of the program.
fn ccmarl(words: &[&str]) -> (Option<i32>, String) {
    let output = assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl")).args(words).output().unwrap();
    (output.status.code(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn a_narrow_layer_within_a_network_trains() {
    let dir = tempfile::tempdir().unwrap();
    let mut narrow = config("maddpg", 1500);
    narrow.maddpg.hidden = vec![64, 8];
    assert!(run(narrow, &dir.path().join("run"), &Options::default()).updates > 0);
}

#[test]
fn redrawn_masks_are_the_learners_alone() {
    let first = |masks: Masks| {
        let mut config = config("cc-maddpg", 2000);
        (config.maddpg.masks, config.log_every) = (masks, 1);
        let mut trainer = Trainer::new(config.resolve().unwrap(), Path::new("unused")).unwrap();
        while trainer.metrics().is_empty() {
            trainer.advance(None).unwrap();
        }
        let row = &trainer.metrics()[0];
        ["shaping_mean", "shaping_std", "td_loss"].map(|name| {
            let column = METRIC_COLUMNS.iter().position(|(n, _)| *n == name).unwrap();
            row.values[column].unwrap().to_bits()
        })
    };
    let ([mean, std, loss], redrawn) = (first(Masks::Kept), first(Masks::Redrawn));
    assert!(f64::from_bits(std) > 0.0);
    assert_eq!([mean, std], redrawn[..2]);
    assert_ne!(loss, redrawn[2], "the critic sees other bits");
}

#[test]
fn force_keeps_what_somebody_put_beside_the_checkpoint() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    run(config("maddpg", 500), &path, &Options::default());
    write_atomic(&path.join("checkpoint/.state.safetensors.XyZ123"), b"half").unwrap();
    write_atomic(&path.join("checkpoint/thesis.tex"), b"mine").unwrap();
    let error = refused(config("maddpg", 500), &path, &FORCE);
    assert!(error.contains("did not put there: thesis.tex; move it") && error.ends_with("checkpoint"), "{error}");
    assert_eq!(bytes(&path, "checkpoint/thesis.tex"), b"mine");
    std::fs::remove_file(path.join("checkpoint/thesis.tex")).unwrap();
    run(config("maddpg", 500), &path, &FORCE);
}

#[test]
fn a_run_that_goes_on_loses_the_tests_of_the_team_before() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    let out = path.to_str().unwrap();
    run(config("maddpg", 500), &path, &Options::default());
    assert_eq!(ccmarl(&["evaluate", out, "--episodes", "1"]).0, Some(0));
    let again = run(config("maddpg", 500), &path, &RESUME);
    assert!(again.removed.is_empty() && path.join("evaluation.parquet").exists(), "no step, the same team");
    let (code, err) = ccmarl(&["train", "--out", out, "--resume", "--steps", "600"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("removed evaluation.parquet: it was of the team before this run went on"), "{err}");
    assert!(!path.join("evaluation.parquet").exists());
}

#[test]
fn the_standard_protocol_tests_the_last_team_wherever_a_run_ends() {
    let dir = tempfile::tempdir().unwrap();
    let [short, between, long] = ["short", "between", "long"].map(|name| dir.path().join(name));
    let steps = |path: &Path| {
        let mut steps = ints(&frame(&path.join("evaluation_standard.parquet")), "step");
        steps.truncate(steps.len() - 9 * 20);
        steps.dedup();
        steps
    };
    run(standard(300, 1000), &short, &Options::default());
    assert_eq!(steps(&short), [300]);
    assert!(short.join("checkpoint/best.safetensors").exists());
    run(standard(1300, 1000), &between, &Options::default());
    assert_eq!(steps(&between), [1000, 1300]);
    // what it tested at its end is not of a run that goes on
    run(standard(1700, 1000), &long, &Options::default());
    for path in [&short, &between] {
        run(standard(1700, 1000), path, &RESUME);
        assert_eq!(steps(path), [1000, 1700]);
        for file in ["evaluation_standard.parquet", "checkpoint/best.safetensors", "checkpoint/state.safetensors"] {
            assert!(bytes(path, file) == bytes(&long, file), "{file}");
        }
    }
}

#[test]
fn tests_between_two_updates_come_at_the_same_steps_for_any_worlds_within_an_update() {
    let dir = tempfile::tempdir().unwrap();
    let [one, four] = [1, 4].map(|envs| {
        let (path, mut config) = (dir.path().join(envs.to_string()), standard(1600, 325));
        config.envs = Some(envs);
        run(config, &path, &Options::default());
        path
    });
    for file in LEARNED.into_iter().chain(["evaluation_standard.parquet"]) {
        assert!(bytes(&one, file) == bytes(&four, file), "{file}");
    }
}

#[test]
fn a_store_of_another_world_is_refused_with_each_constant() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("s");
    run(config("maddpg", 500), &dir.path().join("a"), &Options { record: Some(&store), ..Options::default() });
    let warm = Options { warm_start: Some(&store), ..Options::default() };
    let mut other = config("maddpg", 500);
    other.scenario = other.scenario.with("view_radius", 0.5);
    let error = refused(other, &dir.path().join("b"), &warm);
    let expected = "cannot train on this: another world: view_radius was 0.25 in the store and is 0.5 here";
    assert_eq!(error, expected);
    run(config("maddpg", 500), &dir.path().join("c"), &warm);
}

#[test]
fn a_recorded_run_says_how_many_episodes_it_was_to_have() {
    let dir = tempfile::tempdir().unwrap();
    let stop = AtomicBool::new(false);
    let mut progress = |p: ccmarl::train::Progress| stop.store(p.step >= 200, Ordering::Relaxed);
    let store = dir.path().join("s");
    let options = Options { record: Some(&store), ..Options::default() };
    train(config("maddpg", 510), &dir.path().join("a"), &options, &mut progress, &stop).unwrap();
    let manifest = ccmarl::storage::open(&store).unwrap().manifest().clone();
    assert_eq!((manifest.episodes, manifest.planned), (8, 21));
}

#[test]
fn a_trace_must_last_for_training_and_tests_and_is_not_asked_for_afterwards() {
    let dir = tempfile::tempdir().unwrap();
    let [first, path, trace] = ["first", "run", "trace"].map(|name| dir.path().join(name));
    run(config("maddpg", 500), &first, &Options { record: Some(&trace), ..Options::default() });
    let over = |mut config: TrainConfig| {
        config.prior = Some(Spec::new("trace").with("path", trace.to_str().unwrap()));
        config
    };
    let mut long = standard(500, 100);
    long.evaluation.episodes = Some(3);
    let error = refused(over(long), &path, &Options::default());
    assert!(error.contains("20 episodes") && error.contains("30"), "{error}");
    assert!(!path.exists());
    run(over(standard(500, 100)), &path, &Options::default());
    std::fs::rename(&trace, dir.path().join("moved")).unwrap();
    let (code, err) = ccmarl(&["evaluate", path.to_str().unwrap(), "--episodes", "1"]);
    assert_eq!(code, Some(0), "{err}");
    run(config("maddpg", 500), &path, &FORCE);
}

#[test]
fn an_interval_without_tests_at_intervals_is_a_usage_fault() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    for protocol in [&["--evaluate", "paper"][..], &[]] {
        let words = ["train", "--steps", "100", "--evaluate-every", "50", "--out", out.to_str().unwrap()];
        let (code, err) = ccmarl(&[&words, protocol].concat());
        assert_eq!(code, Some(2), "{err}");
        assert!(err.contains("--evaluate-every needs --evaluate standard"), "{err}");
    }
    assert!(!out.exists());
}

#[test]
fn a_negative_weight_is_a_number_out_of_range_and_no_flag() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    for (flag, value) in [("--alpha", "-1"), ("--beta", "-0.5")] {
        let (code, err) = ccmarl(&["train", "--steps", "100", flag, value, "--out", out.to_str().unwrap()]);
        let expected = format!("dumie.{}: expected a number ≥ 0, found {value}", flag.trim_start_matches('-'));
        assert!(code == Some(2) && err.contains(&expected), "{code:?} {err}");
    }
}

#[test]
fn a_file_may_leave_out_what_a_flag_says_and_a_typo_in_it_is_shown_below_the_message() {
    let dir = tempfile::tempdir().unwrap();
    let [file, out] = ["part.toml", "run"].map(|name| dir.path().join(name).to_str().unwrap().to_owned());
    let train = |text: &str, flags: &[&str]| {
        write_atomic(Path::new(&file), text.as_bytes()).unwrap();
        ccmarl(&[&["train", "--config", &file, "--steps", "100", "--out", &out, "--force"], flags].concat())
    };
    let part = "# of any algorithm\nseed = 4\n[maddpg]\ngamma = 0.9\n";
    let (code, err) = train(part, &[]);
    assert!(code == Some(2) && err.contains("missing field `algorithm`"), "{err}");
    assert_eq!(err.lines().count(), 1, "a line that is sound is not shown: {err}");
    let (code, err) = train(part, &["--algorithm", "maddpg"]);
    assert!(code == Some(2) && err.contains("missing field `scenario`"), "{err}");
    let (code, err) = train(part, &["--algorithm", "maddpg", "--scenario", "simple_spread:2"]);
    assert_eq!(code, Some(0), "{err}");
    let config = std::fs::read_to_string(Path::new(&out).join("config.toml")).unwrap();
    for line in ["algorithm = \"maddpg\"", "name = \"simple_spread\"", "agents = 2", "seed = 4", "gamma = 0.9"] {
        assert!(config.lines().any(|l| l.starts_with(line)), "{line}: {config}");
    }
    // what the file says stands where no flag says otherwise, and its lines are counted without what flags add
    let whole = "algorithm = \"fc-maddpg\"\nscenario = { name = \"simple_spread\", agents = 2 }\n";
    let (code, err) = train(whole, &["--algorithm", "maddpg"]);
    assert_eq!(code, Some(0), "{err}");
    let config = std::fs::read_to_string(Path::new(&out).join("config.toml")).unwrap();
    assert!(config.contains("algorithm = \"maddpg\"") && config.contains("agents = 2"), "{config}");
    let typo = part.replace("gamma", "gama");
    for (text, flags, line) in [
        (format!("{whole}[maddpg]\ngama = 0.9\n"), &[][..], 4),
        (typo, &["--algorithm", "maddpg", "--scenario", "simple_spread"][..], 4),
    ] {
        let (code, err) = train(&text, flags);
        let lines: Vec<&str> = err.lines().collect();
        assert_eq!(code, Some(2), "{err}");
        let start =
            format!("error: configuration: line {line}, column 1: unknown field `gama`, expected one of `hidden`");
        assert!(lines[0].starts_with(&start) && lines[0].ends_with(&format!(": {file}")), "{err}");
        assert_eq!(lines[1..], [format!("  {line} | gama = 0.9").as_str(), "    | ^"], "{err}");
    }
    let (_, err) = train("algorithm = \"maddpg\"\nscenario = \"\u{1b}[2J\nseed = 1\n", &[]);
    assert!(err.contains("line 2, column") && !err.contains('\u{1b}') && err.contains("\\u{1b}[2J"), "{err:?}");
    // the mark stands below its place behind a tab
    let (_, err) = train(&format!("{whole}maddpg =\t{{ gama = 1 }}\n"), &[]);
    let lines: Vec<&str> = err.lines().collect();
    assert_eq!(lines[1..], ["  3 | maddpg = { gama = 1 }", "    |            ^"], "{err}");
    // an editor's mark before a file that leaves something out
    let (code, err) = train(&format!("\u{feff}{part}"), &["--algorithm", "maddpg", "--scenario", "simple_spread:2"]);
    assert_eq!(code, Some(0), "{err}");
}

#[test]
fn what_a_file_names_is_built_for_the_scenario_that_the_flags_leave() {
    let dir = tempfile::tempdir().unwrap();
    let [trace, file, out] =
        ["two.csv", "part.toml", "run"].map(|name| dir.path().join(name).to_str().unwrap().to_owned());
    let rows: Vec<String> = (0..5 * 26).map(|at| format!("{0},{1},0,1,1\n{0},{1},1,0,1\n", at / 26, at % 26)).collect();
    write_atomic(Path::new(&trace), format!("episode,step,sender,receiver,delivered\n{}", rows.concat()).as_bytes())
        .unwrap();
    let text = format!("# of two\nprior = {{ name = \"trace\", path = \"{trace}\" }}\n");
    let train = |text: &str, flags: &[&str]| {
        write_atomic(Path::new(&file), text.as_bytes()).unwrap();
        ccmarl(&[&["train", "--config", &file, "--steps", "100", "--out", &out, "--force"], flags].concat())
    };
    let spread = "scenario = { name = \"simple_spread\" }\n";
    for (text, flags) in [
        (text.clone(), &["--algorithm", "maddpg", "--scenario", "simple_spread:2"][..]),
        (format!("{text}{spread}"), &["--algorithm", "maddpg", "--agents", "2"][..]),
    ] {
        let (code, err) = train(&text, flags);
        assert_eq!(code, Some(0), "{err}");
    }
    // refused for three, with the line of the file that says so; a flag's value has none
    let (code, err) = train(&text, &["--algorithm", "maddpg", "--scenario", "simple_spread:3"]);
    assert!(code != Some(0) && err.contains("configuration: line 2: "), "{err}");
    let (code, err) = train(&format!("algorithm = \"maddpg\"\n{spread}"), &["--prior", "dropout:2"]);
    assert!(code == Some(2) && err.starts_with("error: dropout: p must be in [0, 1]"), "{err}");
}

#[test]
fn a_checkpoint_of_another_version_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    run(config("maddpg", 200), &path, &Options::default());
    let state = path.join("checkpoint/state.safetensors");
    let bytes = std::fs::read(&state).unwrap();
    let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let (_, head) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
    let json = head.metadata().clone().unwrap()["ccmarl.state"][64..].to_owned();
    for (layout, found) in [(None, "none"), (Some(9_u64.to_le_bytes()), "9")] {
        let mut arrays: std::collections::BTreeMap<String, _> = file.tensors().into_iter().collect();
        arrays.remove("layout");
        if let Some(layout) = &layout {
            let view = safetensors::tensor::TensorView::new(safetensors::Dtype::U64, vec![1], layout).unwrap();
            arrays.insert("layout".to_owned(), view);
        }
        // the digest is over all of it, as the program computes it
        let mut hash = Sha256::new();
        for (name, array) in &arrays {
            hash.update(format!("{name}\n{:?}\n{}\n", array.dtype(), array.data().len()));
            hash.update(array.data());
        }
        hash.update(&json);
        let line = format!("{}{json}", ccmarl::schema::hex(&hash.finalize()));
        let meta = Some([("ccmarl.state".to_owned(), line)].into_iter().collect());
        write_atomic(&state, &safetensors::serialize(&arrays, meta).unwrap()).unwrap();
        let error = refused(config("maddpg", 200), &path, &Options { resume: true, ..Options::default() });
        let expected = format!(
            "cannot resume: the checkpoint was written by another version of the program (expected layout 1, found {found}): go \
             on with that version, or start a new run: "
        );
        assert!(error.starts_with(&expected), "{error}");
    }
}

#[test]
fn a_finished_run_says_so_and_how_to_go_on_and_one_that_goes_on_keeps_no_estimates_of_the_team_before() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    let out = path.to_str().unwrap();
    run(config("maddpg", 500), &path, &Options::default());
    write_atomic(&path.join("mi.parquet"), b"of the team before").unwrap();
    let before = bytes(&path, "checkpoint/state.safetensors");
    let (code, err) = ccmarl(&["train", "--out", out, "--resume"]);
    let expected = format!(
        "the run was finished, at 500 steps; to go on for longer: ccmarl train --out {out} --resume --steps 1000"
    );
    assert!(code == Some(0) && err.contains(&expected), "{code:?} {err}");
    assert!(before == bytes(&path, "checkpoint/state.safetensors") && path.join("mi.parquet").exists());
    let (code, err) = ccmarl(&["train", "--out", out, "--resume", "--steps", "600"]);
    assert!(code == Some(0) && !err.contains("was finished"), "{code:?} {err}");
    assert!(err.contains("removed mi.parquet: it was of the team before this run went on"), "{err}");
    assert!(!path.join("mi.parquet").exists());
}

#[test]
fn tests_that_end_a_run_are_printed_and_the_best_team_stands_in_a_table_of_its_own() {
    let dir = tempfile::tempdir().unwrap();
    let [path, page] = ["run", "page"].map(|name| dir.path().join(name));
    let words = |protocol: &'static str| {
        let out = path.to_str().unwrap();
        ["train", "--scenario", "simple_spread:2", "--steps", "50", "--evaluate", protocol, "--force", "--out", out]
    };
    let train = |words: &[&str]| {
        let output = assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl")).args(words).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let out = train(&words("none"));
    assert!(out.contains("training return, last logged 100 updates") && !out.contains("mbc-light"), "{out}");
    let out = train(&words("paper"));
    assert!(out.contains("test of the last team, that of step 50\n") && out.contains("dbc-heavy"), "{out}");
    let out = train(&words("standard"));
    assert!(out.contains("test of the best team, that of step 50\n") && out.contains("prior "), "{out}");
    let out = train(&[&words("standard")[..], &["--format", "json"]].concat());
    let json: serde_json::Value = serde_json::from_str(&out).unwrap();
    let channels = json["report"]["test"]["channels"].as_array().unwrap();
    assert_eq!(channels.len(), 9);
    assert_eq!((&channels[0]["channel"], &channels[0]["episodes"]), (&"prior".into(), &320.into()));
    let (code, err) = ccmarl(&["report", path.to_str().unwrap(), "--out", page.to_str().unwrap()]);
    assert_eq!(code, Some(0), "{err}");
    let table = std::fs::read_to_string(page.join("tables/simple_spread-2-paper-best-returns.csv")).unwrap();
    let mean = channels[0]["return_mean"].as_f64().unwrap();
    let line = table.lines().find(|line| line.contains(",prior,")).unwrap();
    assert!(line.contains(&format!(",1,320,{mean:.6},")), "{line} and {mean}");
    let html = std::fs::read_to_string(page.join("index.html")).unwrap();
    assert!(html.contains("simple_spread, 2 agents, profile paper: best teams"), "no table of best teams");
}
