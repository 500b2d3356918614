//! Training: equal presets, resuming, warm start, what a run directory holds, and what users are told.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use ccmarl::registry::Spec;
use ccmarl::train::{Options, Report, TrainConfig, Trainer, train};

fn config(algorithm: &str, steps: u64) -> TrainConfig {
    let mut config = TrainConfig::new(Spec::new("simple_spread"), algorithm);
    config.steps = steps;
    config.log_every = 5;
    config.maddpg.batch = Some(64);
    config.dumie.batch = 64;
    config
}

fn run(config: TrainConfig, dir: &Path, options: &Options<'_>) -> Report {
    train(config, dir, options, &mut |_| {}, &AtomicBool::new(false)).unwrap()
}

fn bytes(dir: &Path, file: &str) -> Vec<u8> {
    std::fs::read(dir.join(file)).unwrap_or_else(|e| panic!("{file}: {e}"))
}

const LEARNED: [&str; 3] = ["checkpoint/actors.safetensors", "metrics.parquet", "events.out.tfevents.ccmarl"];

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

#[test]
fn every_option_of_learner_and_estimators_trains_differently_and_resumes_to_the_same_bytes() {
    use ccmarl::algo::{ActorStep, Masks, Messages};
    use ccmarl::train::config::{Estimators, LostMessage, Negatives, PairSource, Shaping};

    type Set = fn(&mut TrainConfig);
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
    let dir = tempfile::tempdir().unwrap();
    let mut seen = Vec::new();
    for (name, set) in options {
        let mut wanted = config("cc-maddpg", 3000);
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
fn a_resumed_run_refuses_a_changed_configuration_and_names_the_difference() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("run");
    run(config("maddpg", 500), &path, &Options::default());
    let mut changed = config("maddpg", 500);
    changed.maddpg.gamma = 0.9;
    let error =
        train(changed, &path, &Options { resume: true, ..Options::default() }, &mut |_| {}, &AtomicBool::new(false));
    let error = error.unwrap_err().to_string();
    assert!(error.contains("the configuration changed") && error.contains("gamma = 0.9"), "{error}");
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
    for _ in 0..36 {
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
    assert!(again(&force).unwrap_err().to_string().contains("ccmarl did not make"));
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
fn a_run_that_diverges_stops_and_names_the_step() {
    let dir = tempfile::tempdir().unwrap();
    let mut wild = config("maddpg", 5000);
    wild.maddpg.critic_learning_rate = 1e30;
    let error =
        train(wild, &dir.path().join("a"), &Options::default(), &mut |_| {}, &AtomicBool::new(false)).unwrap_err();
    assert!(error.to_string().contains("diverged at step 1"), "{error}");
}

#[test]
fn configurations_are_refused_with_their_line_or_their_name() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("run.toml");
    let read = |text: &str| {
        ccmarl::io::write_atomic(&file, text.as_bytes()).unwrap();
        TrainConfig::read(&file).and_then(TrainConfig::resolve).map(|_| ()).map_err(|e| e.to_string())
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
    assert!(scenario.contains("unknown field `agnets`"), "{scenario}");
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
