//! Training: equal presets, resuming, warm start, what a run directory holds, and what users are told.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use ccmarl::registry::Spec;
use ccmarl::train::{EvaluationConfig, Given, Options, Protocol, Report, TrainConfig, Trainer, train};
use polars::prelude::{DataFrame, ParquetReader, SerReader as _};

pub(crate) fn config(algorithm: &str, steps: u64) -> TrainConfig {
    let mut config = TrainConfig::new(Spec::new("simple_spread"), algorithm);
    config.steps = steps;
    config.log_every = 5;
    config.maddpg.batch = Some(64);
    config.dumie.batch = 64;
    config
}

pub(crate) fn run(config: TrainConfig, dir: &Path, options: &Options<'_>) -> Report {
    train(config, dir, options, &mut |_| {}, &AtomicBool::new(false)).unwrap()
}

pub(crate) fn bytes(dir: &Path, file: &str) -> Vec<u8> {
    std::fs::read(dir.join(file)).unwrap_or_else(|e| panic!("{file}: {e}"))
}

/// Files below a directory, by their paths from there.
fn walk(dir: &Path) -> Vec<String> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        if path.is_dir() {
            found.extend(walk(&path).into_iter().map(|below| format!("{name}/{below}")));
        } else {
            found.push(name);
        }
    }
    found
}

pub(crate) fn frame(path: &Path) -> DataFrame {
    ParquetReader::new(std::fs::File::open(path).unwrap()).finish().unwrap()
}

pub(crate) fn ints(frame: &DataFrame, column: &str) -> Vec<i64> {
    frame.column(column).unwrap().i64().unwrap().iter().map(|v| v.unwrap()).collect()
}

fn texts(frame: &DataFrame, column: &str) -> Vec<String> {
    frame.column(column).unwrap().str().unwrap().iter().map(|v| v.unwrap().to_owned()).collect()
}

pub(crate) const LEARNED: [&str; 3] =
    ["checkpoint/actors.safetensors", "metrics.parquet", "events.out.tfevents.ccmarl"];

#[test]
fn cc_maddpg_without_weights_is_dropout_maddpg_byte_for_byte_and_with_weights_it_is_not() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b, c] = ["a", "b", "c"].map(|name| dir.path().join(name));
    let mut unshaped = config("cc-maddpg", 4000);
    (unshaped.dumie.alpha, unshaped.dumie.beta) = (Some(0.0), Some(0.0));
    run(unshaped, &a, &Options::default());
    run(config("dropout-maddpg-0.2", 4000), &b, &Options::default());
    run(config("cc-maddpg", 4000), &c, &Options::default());
    for file in LEARNED {
        assert_eq!(bytes(&a, file), bytes(&b, file), "{file}");
        assert_ne!(bytes(&a, file), bytes(&c, file), "{file}");
    }
}

#[test]
fn an_interrupted_run_that_is_resumed_ends_with_the_bytes_of_an_uninterrupted_one() {
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole");
    run(config("cc-maddpg", 5000), &whole, &Options::default());
    for stop_at in [500, 1125, 1425, 3300] {
        let parts = dir.path().join(format!("parts-{stop_at}"));
        let stop = AtomicBool::new(false);
        let mut progress = |p: ccmarl::train::Progress| {
            if p.step >= stop_at {
                stop.store(true, Ordering::Relaxed);
            }
        };
        let first = train(config("cc-maddpg", 5000), &parts, &Options::default(), &mut progress, &stop).unwrap();
        assert!(first.interrupted && first.steps < 5000);
        let resumed = run(config("cc-maddpg", 5000), &parts, &Options { resume: true, ..Options::default() });
        assert!(!resumed.interrupted);
        for file in LEARNED.into_iter().chain(["checkpoint/state.safetensors", "config.toml"]) {
            assert!(bytes(&whole, file) == bytes(&parts, file), "{file} differs after a stop at {stop_at}");
        }
    }
}

/// A change of a configuration.
pub(crate) type Set = fn(&mut TrainConfig);

/// Trains `base` with each change, whole and stopped in between: the same bytes, and other actors than with any other.
pub(crate) fn each_resumes_and_differs(base: &TrainConfig, options: &[(&str, Set)]) {
    let dir = tempfile::tempdir().unwrap();
    let mut seen = Vec::new();
    for (name, set) in options {
        let mut wanted = base.clone();
        set(&mut wanted);
        let [whole, parts] = ["whole", "parts"].map(|part| dir.path().join(name).join(part));
        run(wanted.clone(), &whole, &Options::default());
        let stop = AtomicBool::new(false);
        let mut progress = |p: ccmarl::train::Progress| stop.store(p.step >= 2000, Ordering::Relaxed);
        train(wanted.clone(), &parts, &Options::default(), &mut progress, &stop).unwrap();
        run(wanted, &parts, &Options { resume: true, ..Options::default() });
        for file in LEARNED.into_iter().chain(["checkpoint/state.safetensors", "config.toml"]) {
            assert!(bytes(&whole, file) == bytes(&parts, file), "{name}: {file} differs after a stop");
        }
        let actors = bytes(&whole, LEARNED[0]);
        assert!(!seen.contains(&actors), "{name} changed nothing");
        seen.push(actors);
    }
}

#[test]
fn every_option_of_learner_and_estimators_trains_differently_and_resumes_to_the_same_bytes() {
    use ccmarl::algo::{ActorStep, Masks, Messages};
    use ccmarl::train::config::{Estimators, LostMessage, Negatives, PairSource, Shaping};

    let options: [(&str, Set); 11] = [
        ("defaults", |_| ()),
        ("messages off", |c| c.maddpg.messages = Messages::Off),
        ("actor step per agent", |c| c.maddpg.actor_step = ActorStep::PerAgent),
        ("masks redrawn", |c| c.maddpg.masks = Masks::Redrawn),
        ("all negatives", |c| c.dumie.negatives = Negatives::All),
        ("an estimator per link", |c| (c.dumie.estimators, c.dumie.start) = (Estimators::PerLink, 60)),
        ("pairs from replay", |c| c.dumie.pairs = PairSource::Replay),
        ("lost messages as zeros", |c| c.dumie.lost_message = LostMessage::Zero),
        ("shaping at rollout", |c| c.dumie.shaping = Shaping::AtRollout),
        ("unshifted", |c| c.dumie.jsd_shift = false),
        ("two estimator steps", |c| c.dumie.k = 2),
    ];
    each_resumes_and_differs(&config("cc-maddpg", 3000), &options);
}

#[test]
fn a_resumed_run_refuses_a_changed_configuration_and_names_every_difference() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    run(config("maddpg", 500), &path, &Options::default());
    let before = bytes(&path, "config.toml");
    let resumed = |config: TrainConfig| {
        let options = Options { resume: true, ..Options::default() };
        train(config, &path, &options, &mut |_| {}, &AtomicBool::new(false)).map_err(|e| e.to_string())
    };
    let mut changed = config("maddpg", 500);
    changed.maddpg.gamma = 0.9;
    changed.scenario = changed.scenario.with("view_radius", 0.5);
    let error = resumed(changed).unwrap_err();
    let fault = "the configuration changed: maddpg.gamma was 0.95, is 0.9; scenario.view_radius was 0.25, is 0.5";
    assert!(error.starts_with(&format!("cannot resume: {fault}; give the old values")), "{error}");
    let error = resumed(config("maddpg", 400)).unwrap_err();
    assert!(error.contains("the run has taken 500 steps, --steps 400 lie behind it: give at least 500"), "{error}");
    assert_eq!(bytes(&path, "config.toml"), before, "a refused command changed the configuration");
}

#[test]
fn a_run_that_goes_on_for_longer_is_the_run_of_that_length() {
    let dir = tempfile::tempdir().unwrap();
    let [long, grown] = ["long", "grown"].map(|name| dir.path().join(name));
    let standard = |steps: u64| {
        let mut config = config("cc-maddpg", steps);
        config.evaluation = EvaluationConfig { protocol: Protocol::Standard, every: 700, episodes: Some(2) };
        config
    };
    run(standard(4000), &long, &Options::default());
    run(standard(2510), &grown, &Options::default());
    run(standard(4000), &grown, &Options { resume: true, ..Options::default() });
    for file in
        LEARNED.into_iter().chain(["checkpoint/state.safetensors", "config.toml", "evaluation_standard.parquet"])
    {
        assert!(bytes(&long, file) == bytes(&grown, file), "{file}");
    }
}

#[test]
fn worlds_stepped_together_are_the_papers_order_as_long_as_no_update_lies_between_them() {
    let dir = tempfile::tempdir().unwrap();
    let updates: Vec<u64> = [1, 2, 3, 4, 16]
        .map(|envs| {
            let mut config = config("cc-maddpg", 4000);
            config.envs = Some(envs);
            run(config, &dir.path().join(envs.to_string()), &Options::default()).updates
        })
        .to_vec();
    assert_eq!(updates, [30; 5], "one update per 100 steps after the first 1024, however many worlds");
    for file in LEARNED {
        for envs in ["2", "3", "4"] {
            assert!(
                bytes(&dir.path().join("1"), file) == bytes(&dir.path().join(envs), file),
                "{file} of {envs} worlds"
            );
        }
        assert!(bytes(&dir.path().join("1"), file) != bytes(&dir.path().join("16"), file));
    }
    assert_eq!(config("maddpg", 100).resolve().unwrap().envs, Some(4), "four episodes of 25 steps per 100");
}

#[test]
fn the_standard_protocol_tests_at_intervals_and_the_best_again_and_disturbs_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let [plain, tested, parts] = ["plain", "tested", "parts"].map(|name| dir.path().join(name));
    let standard = || {
        let mut config = config("fc-maddpg", 3000);
        config.evaluation = EvaluationConfig { protocol: Protocol::Standard, every: 1000, episodes: Some(3) };
        config
    };
    run(config("fc-maddpg", 3000), &plain, &Options::default());
    run(standard(), &tested, &Options::default());
    assert!(bytes(&plain, LEARNED[0]) == bytes(&tested, LEARNED[0]), "tests changed what was learned");
    let table = frame(&tested.join("evaluation_standard.parquet"));
    let (step, channel) = (ints(&table, "step"), texts(&table, "channel"));
    let best: Vec<bool> = table.column("best").unwrap().bool().unwrap().iter().map(|b| b.unwrap()).collect();
    assert_eq!(step[..9], [1000, 1000, 1000, 2000, 2000, 2000, 3000, 3000, 3000]);
    assert_eq!((step.len(), best.iter().filter(|b| **b).count()), (9 + 9 * 30, 9 * 30));
    assert!(channel[..39].iter().all(|c| c == "prior") && channel[39] == "unrestricted");
    let returns = table.column("return").unwrap().f64().unwrap().clone();
    let mean = |at: usize| (at..at + 3).map(|i| returns.get(i).unwrap()).sum::<f64>() / 3.0;
    let highest = [0, 3, 6].into_iter().max_by(|&a, &b| mean(a).total_cmp(&mean(b))).unwrap();
    assert_eq!(step[9], step[highest], "the best is the one with the highest mean");
    // the file of the best is a policy like any other
    let scenario = ccmarl::scenario::build(&Spec::new("simple_spread")).unwrap();
    let file = tested.join("checkpoint/best.safetensors");
    let team = ccmarl::record::Trained::load(&file, scenario.as_ref(), ccmarl::record::ActionNoise::None).unwrap();
    assert_eq!(team.actors.steps as i64, step[9]);
    // stopped between two tests
    let stop = AtomicBool::new(false);
    let mut progress = |p: ccmarl::train::Progress| stop.store(p.step >= 1500, Ordering::Relaxed);
    assert!(train(standard(), &parts, &Options::default(), &mut progress, &stop).unwrap().interrupted);
    assert!(!parts.join("evaluation_standard.parquet").exists());
    run(standard(), &parts, &Options { resume: true, ..Options::default() });
    for file in LEARNED.into_iter().chain(["checkpoint/best.safetensors", "evaluation_standard.parquet"]) {
        assert!(bytes(&tested, file) == bytes(&parts, file), "{file}");
    }
}

#[test]
fn the_paper_protocol_writes_what_the_command_would() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    let mut config = config("maddpg", 500);
    config.evaluation = EvaluationConfig { protocol: Protocol::Paper, episodes: Some(4), ..Default::default() };
    run(config, &path, &Options::default());
    let own = bytes(&path, "evaluation.parquet");
    std::fs::remove_file(path.join("evaluation.parquet")).unwrap();
    let words = ["evaluate", path.to_str().unwrap(), "--episodes", "4"];
    assert_eq!(
        assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl")).args(words).output().unwrap().status.code(),
        Some(0)
    );
    assert!(own == bytes(&path, "evaluation.parquet"));
}

#[test]
fn a_kill_before_the_first_checkpoint_leaves_no_run_and_one_amid_a_write_leaves_nothing_for_good() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    let resume = Options { resume: true, ..Options::default() };
    let error = train(config("maddpg", 500), &path, &resume, &mut |_| {}, &AtomicBool::new(false)).unwrap_err();
    assert!(error.to_string().starts_with("cannot resume: there is no checkpoint; start without --resume"), "{error}");
    // what a killed recording of this name leaves is not ours to remove
    let journal = dir.path().join(".run.partial/journal.arrows");
    ccmarl::io::write_atomic(&journal, b"episodes").unwrap();
    let error = train(config("maddpg", 500), &path, &Options::default(), &mut |_| {}, &AtomicBool::new(false));
    assert!(
        error.unwrap_err().to_string().starts_with("refusing to replace what ccmarl did not make") && journal.exists()
    );
    std::fs::remove_file(&journal).unwrap();
    // what such a kill leaves
    ccmarl::io::write_atomic(&dir.path().join(".run.partial/config.toml"), b"half").unwrap();
    run(config("maddpg", 500), &path, &Options::default());
    assert!(!dir.path().join(".run.partial").exists());
    for leftover in [".metrics.parquet.a1B2c3", "checkpoint/.state.safetensors.XyZ123"] {
        ccmarl::io::write_atomic(&path.join(leftover), b"half").unwrap();
    }
    run(config("maddpg", 1000), &path, &resume);
    let words = ["train", "--resume", "--out", dir.path().join("nosuch").to_str().unwrap()].map(ToOwned::to_owned);
    let output = assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl")).args(words).output().unwrap();
    let err = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(
        err.starts_with("error: cannot resume: there is no run to go on with; start it without --resume: "),
        "{err}"
    );
    let mut names: Vec<_> = walk(&path);
    names.sort();
    let expected = [
        "checkpoint/actors.safetensors",
        "checkpoint/state.safetensors",
        "config.toml",
        "events.out.tfevents.ccmarl",
        "metrics.parquet",
        "timings.parquet",
    ];
    assert_eq!(names, expected);
    ccmarl::io::write_atomic(&path.join(".metrics.parquet.a1B2c3"), b"half").unwrap();
    run(config("maddpg", 500), &path, &Options { force: true, ..Options::default() });
}

#[test]
fn a_run_that_somebody_is_training_is_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    run(config("maddpg", 500), &path, &Options::default());
    let other = std::fs::File::open(&path).unwrap();
    other.lock().unwrap();
    for options in [Options { resume: true, ..Options::default() }, Options { force: true, ..Options::default() }] {
        let error = train(config("maddpg", 900), &path, &options, &mut |_| {}, &AtomicBool::new(false)).unwrap_err();
        assert!(error.to_string().starts_with("another process is training into this directory: wait"), "{error}");
    }
    drop(other);
    run(config("maddpg", 900), &path, &Options { resume: true, ..Options::default() });
}

#[test]
fn a_damaged_checkpoint_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    run(config("maddpg", 500), &path, &Options::default());
    let mut state = bytes(&path, "checkpoint/state.safetensors");
    let last = state.len() - 5;
    state[last] ^= 16;
    ccmarl::io::write_atomic(&path.join("checkpoint/state.safetensors"), &state).unwrap();
    let resume = Options { resume: true, ..Options::default() };
    let error = train(config("maddpg", 900), &path, &resume, &mut |_| {}, &AtomicBool::new(false)).unwrap_err();
    assert!(error.to_string().contains("its content does not match its digest"), "{error}");
}

#[cfg(unix)]
#[test]
fn a_terminated_run_saves_itself_exits_4_and_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    let out = path.to_str().unwrap();
    let words = ["train", "--scenario", "simple_spread", "--algorithm", "maddpg", "--steps", "100000000", "--out", out];
    for signal in ["-TERM", "-INT"] {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_ccmarl"));
        let resumed = ["train", "--out", out, "--resume"];
        command.args(if signal == "-TERM" { &words[..] } else { &resumed[..] });
        let child = command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped()).spawn().unwrap();
        // the signal handler stands before the run directory does
        for _ in 0..600 {
            if path.join("checkpoint/state.safetensors").exists() {
                break;
            }
            std::thread::sleep(std::time::Duration::from_millis(50));
        }
        std::thread::sleep(std::time::Duration::from_millis(300));
        let id = child.id().to_string();
        assert!(std::process::Command::new("kill").args([signal, &id]).status().unwrap().success());
        let output = child.wait_with_output().unwrap();
        let err = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(4), "{signal}: {err}");
        assert!(err.contains("interrupted and saved; go on with: ccmarl train --out"), "{err}");
    }
}

#[test]
fn a_store_of_the_runs_own_rollouts_gives_the_next_critic_loss_of_the_replay_in_memory() {
    let dir = tempfile::tempdir().unwrap();
    for (form, algorithm, steps) in
        [("s", "cc-maddpg", 2000), ("s.parquet", "maddpg", 900), ("s.mcap", "cc-maddpg", 2000)]
    {
        let (path, store) = (dir.path().join(format!("run-{form}")), dir.path().join(form));
        let report = run(config(algorithm, steps), &path, &Options { record: Some(&store), ..Options::default() });
        // the same networks, but a replay filled from the store
        let resolved = config(algorithm, steps).resolve().unwrap();
        let mut trained = Trainer::new(resolved.clone(), &path).unwrap();
        trained.resume().unwrap();
        let mut warm = Trainer::new(resolved, &path).unwrap();
        warm.resume().unwrap();
        warm.replay = ccmarl::train::replay::Replay::new(
            &ccmarl::scenario::build(&Spec::new("simple_spread")).unwrap().layout(),
            25,
            100_000,
            false,
        )
        .unwrap();
        let episodes = warm.warm_start(ccmarl::storage::open(&store).unwrap().as_mut()).unwrap();
        assert_eq!(episodes, steps / 25);
        assert_eq!(warm.rings().is_some(), algorithm == "cc-maddpg");
        let loss = warm.next_critic_loss().unwrap();
        assert_eq!(loss.to_bits(), trained.next_critic_loss().unwrap().to_bits());
        assert_eq!(loss.to_bits(), report.next_critic_loss.unwrap().to_bits());
    }
}

#[test]
fn a_warm_start_fills_the_rings_as_the_rollouts_did() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("s");
    run(config("cc-maddpg", 900), &dir.path().join("a"), &Options { record: Some(&store), ..Options::default() });
    let resolved = config("cc-maddpg", 900).resolve().unwrap();
    let [mut rolled, mut warm] = [(); 2].map(|()| Trainer::new(resolved.clone(), dir.path()).unwrap());
    while rolled.step() < 900 {
        rolled.advance(None).unwrap();
    }
    warm.warm_start(ccmarl::storage::open(&store).unwrap().as_mut()).unwrap();
    let rings = warm.rings().unwrap();
    assert_eq!(warm.rings(), rolled.rings());
    let (delivered, lost) = (rings[0], rings[1]);
    assert!(delivered.len() == 1000 && lost.len() > 500, "{} and {}", delivered.len(), lost.len());
}

#[test]
fn logging_more_often_changes_no_network() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b] = ["a", "b"].map(|name| dir.path().join(name));
    run(config("cc-maddpg", 4000), &a, &Options::default());
    let mut often = config("cc-maddpg", 4000);
    often.log_every = 1;
    run(often, &b, &Options::default());
    assert!(bytes(&a, LEARNED[0]) == bytes(&b, LEARNED[0]));
}

#[test]
fn force_replaces_a_run_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    run(config("maddpg", 500), &path, &Options::default());
    let force = Options { force: true, ..Options::default() };
    let again =
        |options: &Options<'_>| train(config("maddpg", 500), &path, options, &mut |_| {}, &AtomicBool::new(false));
    assert!(again(&Options::default()).unwrap_err().to_string().starts_with("output exists"));
    let missing = dir.path().join("nosuch");
    let refused = again(&Options { warm_start: Some(&missing), ..Options { force: true, ..Options::default() } });
    assert!(refused.unwrap_err().to_string().contains("no such file"));
    assert!(path.join("metrics.parquet").exists(), "a refused command removed the run");
    again(&force).unwrap();
    ccmarl::io::write_atomic(&path.join("thesis.tex"), b"mine").unwrap();
    assert!(again(&force).unwrap_err().to_string().contains("ccmarl did not put there: thesis.tex"));
    assert_eq!(bytes(&path, "thesis.tex"), b"mine");
}

#[test]
fn six_predators_train_with_the_papers_smaller_batch() {
    let batch = |scenario: &str, agents: u32| {
        let spec = Spec::new(scenario).with("agents", agents);
        TrainConfig::new(spec, "cc-maddpg").resolve().unwrap().maddpg.batch
    };
    assert_eq!(
        [batch("simple_tag", 3), batch("simple_tag", 6), batch("simple_spread", 6)],
        [Some(1024), Some(512), Some(1024)]
    );
}

#[test]
fn a_store_of_other_agents_is_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("s");
    run(config("maddpg", 500), &dir.path().join("a"), &Options { record: Some(&store), ..Options::default() });
    let mut other = config("maddpg", 500);
    other.scenario = other.scenario.with("agents", 2);
    let options = Options { warm_start: Some(&store), ..Options::default() };
    let error = train(other, &dir.path().join("b"), &options, &mut |_| {}, &AtomicBool::new(false)).unwrap_err();
    assert!(error.to_string().contains("agent 0 is agent_0 (observation 12"), "{error}");
}

#[test]
fn a_run_that_diverges_stops_names_step_and_tensor_and_keeps_the_last_good_checkpoint() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a");
    let mut wild = config("maddpg", 5000);
    wild.maddpg.critic_learning_rate = 1e30;
    wild.checkpoint_every = 1;
    let error = train(wild.clone(), &path, &Options::default(), &mut |_| {}, &AtomicBool::new(false)).unwrap_err();
    let error = error.to_string();
    assert!(
        error.starts_with("the run diverged at step 1") && error.contains(".weight is no longer finite; "),
        "{error}"
    );
    assert!(error.contains("the last good checkpoint is kept"), "{error}");
    let mut kept = Trainer::new(wild.resolve().unwrap(), &path).unwrap();
    kept.resume().unwrap();
    assert!(kept.learner.params.critic.read().iter().all(|p| p.is_finite()));
}

#[test]
fn shaping_a_preset_that_has_none_is_refused_with_the_one_that_has() {
    for (algorithm, prior) in [("maddpg", "none"), ("fc-maddpg", "perfect"), ("dropout-maddpg-0.5", "dropout:0.5")] {
        let mut shaped = config(algorithm, 500);
        shaped.dumie.alpha = Some(0.01);
        let error = shaped.resolve().unwrap_err().to_string();
        let expected =
            format!("dumie.alpha: {algorithm} is not shaped, found 0.01: take cc-maddpg with --prior {prior}, ");
        assert!(error.starts_with(&expected), "{error}");
    }
    let mut unshaped = config("maddpg", 500);
    unshaped.dumie.beta = Some(0.0);
    unshaped.resolve().unwrap();
}

#[test]
fn a_team_is_refused_in_a_world_with_other_constants_and_each_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    run(config("maddpg", 500), &path, &Options::default());
    let policy = Spec::new("run").with("path", path.to_str().unwrap());
    let play = |scenario: Spec| {
        let scenario = ccmarl::scenario::build(&scenario).unwrap();
        ccmarl::record::build_policy(&policy, scenario.as_ref()).map(|_| ()).map_err(|e| e.to_string())
    };
    let spread = || Spec::new("simple_spread");
    assert_eq!(play(spread()), Ok(()));
    let error = play(spread().with("view_radius", 0.5).with("steps", 50)).unwrap_err();
    let expected = "the run does not fit this scenario: steps was 25 in training and is 50 here, view_radius was 0.25 in \
                    training and is 0.5 here: ";
    assert!(error.starts_with(expected), "{error}");
    let error = play(spread().with("agents", 4)).unwrap_err();
    assert!(error.contains("agents was 3 in training and is 4 here"), "{error}");
    let error = play(spread().with("profile", "mpe2")).unwrap_err();
    assert!(error.contains("profile was \"paper\" in training") && error.contains("decoder was"), "{error}");
    let error = play(Spec::new("simple_tag")).unwrap_err();
    assert!(error.contains("name was \"simple_spread\" in training and is \"simple_tag\" here"), "{error}");
}

#[test]
fn configurations_are_refused_with_their_line_or_their_name() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("run.toml");
    let read = |text: &str| {
        ccmarl::io::write_atomic(&file, text.as_bytes()).unwrap();
        let resolved = |read: TrainConfig| read.check_plugins(&file, &read).and_then(|()| read.resolve());
        TrainConfig::read(&file, Given::default()).and_then(resolved).map(|_| ()).map_err(|e| e.to_string())
    };
    let start = "algorithm = \"maddpg\"\nscenario = { name = \"simple_spread\" }\n";
    assert_eq!(read(start), Ok(()));
    let typo = read(&format!("{start}[maddpg]\ngama = 0.9\n")).unwrap_err();
    assert!(typo.contains("line 4") && typo.contains("unknown field `gama`"), "{typo}");
    let range = read(&format!("{start}[maddpg]\ngamma = 1.5\n")).unwrap_err();
    assert_eq!(range, "maddpg.gamma: expected a value in [0, 1], found 1.5");
    let negatives = |value: &str| read(&format!("{start}[dumie]\nnegatives = {value}\n"));
    assert_eq!((negatives("\"all\""), negatives("3")), (Ok(()), Ok(())));
    assert_eq!(negatives("0").unwrap_err(), "dumie.negatives: expected at least 1, found 0");
    let word = negatives("\"al\"").unwrap_err();
    assert!(word.contains("line 4") && word.contains("expected a number or \"all\", found \"al\""), "{word}");
    let step = read(&format!("{start}[maddpg]\nactor_step = \"jont\"\n")).unwrap_err();
    assert!(step.contains("expected `joint` or `per-agent`"), "{step}");
    let name = read("algorithm = \"madpg\"\nscenario = { name = \"simple_spread\" }\n").unwrap_err();
    assert!(name.contains("unknown algorithm \"madpg\": did you mean maddpg"), "{name}");
    let sees_all = "algorithm = \"maddpg\"\nscenario = { name = \"simple_spread\", view_radius = \"none\" }\n";
    assert_eq!(read(sees_all), Ok(()));
    let mut choosing = config("maddpg", 500);
    choosing.scenario = choosing.scenario.with("discrete", true).with("decoder", "mpe2");
    let discrete = choosing.resolve().unwrap_err().to_string();
    assert_eq!(discrete, "scenario.discrete: this learner's actions are continuous: set it to false");
    let scenario = read("algorithm = \"maddpg\"\nscenario = { name = \"simple_spread\", agnets = 3 }\n").unwrap_err();
    assert!(scenario.contains("line 2") && scenario.contains("unknown field `agnets`"), "{scenario}");
    let prior = read(&format!("# dropout\n{start}[prior]\nname = \"dropout\"\np = 2\n")).unwrap_err();
    assert!(prior.contains("line 5: dropout: p must be in [0, 1], found 2"), "{prior}");
    let link = read(&format!("{start}prior = \"dropuot\"\n")).unwrap_err();
    assert!(link.contains("line 3: unknown link \"dropuot\": did you mean dropout"), "{link}");
    let envs = read(&format!("envs = 0\n{start}")).unwrap_err();
    assert_eq!(envs, "envs: expected 1 to 4096, found 0");
}

#[test]
fn the_resolved_configuration_reads_back_as_itself() {
    for algorithm in ccmarl::algo::ALGORITHMS {
        let resolved = config(algorithm.name, 500).resolve().unwrap();
        let again: TrainConfig = toml::from_str(&resolved.to_toml().unwrap()).unwrap();
        assert_eq!(again, resolved);
        assert_eq!(again.clone().resolve().unwrap(), again);
    }
}
