//! Runs that are replaced, resumed, tested, recorded, or started from a store: what each may take for its own.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use ccmarl::algo::Masks;
use ccmarl::io::write_atomic;
use ccmarl::registry::Spec;
use ccmarl::train::{EvaluationConfig, METRIC_COLUMNS, Options, Protocol, TrainConfig, Trainer, train};

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
