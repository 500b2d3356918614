//! Recording: contract over the policies, determinism, the command's refusals.

use std::io::{BufRead as _, BufReader};
use std::sync::atomic::{AtomicBool, Ordering};

use assert_cmd::Command;
use ccmarl::algo::{Actors, EncoderScratch, MaddpgConfig, Messages, Sight, Team, TeamScratch};
use ccmarl::link::{LINKS, Link};
use ccmarl::nn::{Activation, Tape};
use ccmarl::record::{
    ActionNoise, Options, POLICIES, Policy, RecordError, Recording, Trained, build_link, build_policy,
};
use ccmarl::registry::Spec;
use ccmarl::rng::Seeds;
use ccmarl::scenario::{self, SCENARIOS, Scenario, Scratch};
use ccmarl::schema::{Episode, Manifest};
use ccmarl::storage::{EpisodeSink, StorageError};
use serde_json::Value;

#[derive(Default)]
struct Memory {
    episodes: Vec<Episode>,
    fail_at: Option<usize>,
}

impl EpisodeSink for Memory {
    fn append(&mut self, episode: &Episode) -> Result<(), StorageError> {
        if self.fail_at == Some(self.episodes.len()) {
            return Err(StorageError::Damaged { message: "disk full".to_owned(), path: "x".into() });
        }
        self.episodes.push(episode.clone());
        Ok(())
    }

    fn commit(&mut self) -> Result<u64, StorageError> {
        Ok(self.episodes.len() as u64)
    }

    fn finish(self: Box<Self>) -> Result<Manifest, StorageError> {
        Err(StorageError::Damaged { message: "only in memory".to_owned(), path: "x".into() })
    }
}

struct Parts(Box<dyn Scenario>, Box<dyn Link>, Box<dyn Policy>);

impl Parts {
    fn new(scenario: &str, agents: usize, link: &str, policy: &str) -> Self {
        let scenario = scenario::build(&Spec::new(scenario).with("agents", agents)).unwrap();
        let link = build_link(&Spec::parse("link", LINKS, link).unwrap(), &*scenario).unwrap();
        let policy = build_policy(&Spec::parse("policy", POLICIES, policy).unwrap(), &*scenario).unwrap();
        Self(scenario, link, policy)
    }

    fn recording(&self, seed: u64, episodes: u64) -> Recording<'_> {
        Recording { scenario: &*self.0, link: &*self.1, policy: &*self.2, seed, episodes }
    }
}

/// A valid use of every policy but `run`, which needs a trained run: extend this when a new one needs a parameter.
fn examples() -> impl Iterator<Item = &'static str> {
    let known = POLICIES.iter().map(|entry| if entry.name == "probe" { "probe:0.75" } else { entry.name });
    known.filter(|&name| name != "run")
}

fn record(recording: &Recording<'_>, threads: usize, block: usize) -> Vec<Episode> {
    let mut sink = Memory::default();
    let mut told = 0;
    let mut count = |episode: &Episode| {
        assert_eq!(episode.index, told);
        told += 1;
    };
    let done = recording.record(&mut sink, Options { threads, block }, &mut count, &AtomicBool::new(false)).unwrap();
    assert_eq!((done.episodes, done.interrupted, told), (recording.episodes, false, recording.episodes));
    sink.episodes
}

#[test]
fn every_policy_fills_every_scenario_and_its_parameters_build_it_again() {
    for (scenario, policy) in SCENARIOS.iter().flat_map(|s| examples().map(move |p| (s, p))) {
        // not every scenario takes every number; all take two
        let taken = |n: &usize| *n == 2 || scenario::build(&Spec::new(scenario.name).with("agents", *n)).is_ok();
        for agents in [1, 2, 4].into_iter().filter(taken) {
            let parts = Parts::new(scenario.name, agents, "dropout:0.5", policy);
            let recording = parts.recording(1, 3);
            let episode = recording.episode(2);
            episode.check(&recording.layout()).unwrap();
            let columns = episode.observations.iter().chain(&episode.messages).chain(&episode.actions);
            assert!(columns.flat_map(|m| &m.data).all(|v| v.is_finite()));
            assert!(episode.reward.iter().all(|v| v.is_finite()) && episode.state.iter().all(|v| v.is_finite()));
            assert_eq!(episode, recording.episode(2));
            assert_ne!(episode.state, recording.episode(1).state);
            assert_ne!(episode.state, parts.recording(2, 3).episode(2).state);

            let spec: Spec = serde_json::from_value(Value::Object(parts.2.parameters())).unwrap();
            let again = build_policy(&spec, &*parts.0).unwrap();
            assert_eq!(again.parameters(), parts.2.parameters());
            let error = build_policy(&spec.with("nonsense", 1), &*parts.0).err().unwrap().to_string();
            assert!(error.contains("unknown field `nonsense`"), "{error}");
        }
    }
}

/// A team with fresh networks for a scenario.
fn team(scenario: &dyn Scenario, messages: Messages, noise: ActionNoise) -> (Trained, Vec<f32>) {
    let config = MaddpgConfig { hidden: vec![32, 32], messages, message_width: Some(5), ..MaddpgConfig::default() };
    let learners: Vec<_> = scenario.agents().iter().filter(|a| a.learner).collect();
    let actors = Actors::new(&learners, Activation::Tanh, &config);
    let params = actors.init(&mut Seeds::new(5).stream("team"));
    (Trained::new(actors, &params, noise, serde_json::Map::new()), params)
}

#[test]
fn worlds_that_move_together_play_the_episodes_that_they_play_alone() {
    let noise = ActionNoise::OrnsteinUhlenbeck { theta: 0.15, sigma: 0.2, scale: 0.3, episodes: 20 };
    for scenario in SCENARIOS {
        let mut parts = Parts::new(scenario.name, 2, "markov:heavy", "random");
        let trained = [Messages::Observation, Messages::Encoder].map(|messages| team(&*parts.0, messages, noise).0);
        let policies: Vec<Box<dyn Policy>> = examples()
            .map(|p| build_policy(&Spec::parse("policy", POLICIES, p).unwrap(), &*parts.0).unwrap())
            .chain(trained.map(|trained| Box::new(trained) as Box<dyn Policy>))
            .collect();
        for policy in policies {
            parts.2 = policy;
            let recording = parts.recording(1, 0);
            let together = recording.together(&recording.layout(), 13, 11);
            for (episode, index) in together.iter().zip(13..) {
                assert!(*episode == recording.episode(index), "{} {:?}", scenario.name, parts.2.parameters());
            }
        }
    }
}

#[test]
fn a_team_acts_on_its_observation_and_the_messages_that_arrived_and_its_noise_falls_to_zero() {
    let mut parts = Parts::new("simple_adversary", 3, "dropout:0.5", "random");
    let mut tape = Tape::default();
    let mut play = |messages: Messages| {
        let (trained, params) = team(&*parts.0, messages, ActionNoise::None);
        let actors = trained.actors.clone();
        parts.2 = Box::new(trained);
        let layout = parts.recording(1, 0).layout();
        let calm = parts.recording(1, 0).together(&layout, 4, 1).remove(0);
        calm.check(&layout).unwrap();
        for row in 0..calm.steps {
            let observations: Vec<f32> = calm.observations.iter().flat_map(|o| o.row(row).to_vec()).collect();
            let messages: Vec<f32> = calm.messages.iter().flat_map(|m| m.row(row).to_vec()).collect();
            // what is recorded is what was sent, before the channel
            for j in 0..3 {
                let seen = calm.observations[j].row(row);
                let sent = match actors.encoders.get(j) {
                    Some(encoder) => encoder.forward(&params[actors.encoder_range(j)], seen, 1, &mut tape),
                    None => seen,
                };
                let pairs = sent.iter().zip(calm.messages[j].row(row));
                assert!(sent.len() == calm.messages[j].width && pairs.into_iter().all(|(a, b)| (a - b).abs() < 1e-6));
            }
            for i in 0..3 {
                let mut input = Vec::new();
                actors.push_input(i, &observations, &messages, &calm.link[row * 9..row * 9 + 9], &mut input);
                let expected = actors.act(&params, i, &input, 1, &mut tape);
                let pairs = expected.iter().zip(calm.actions[i].row(row));
                let error = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(error < 1e-6, "{error}");
            }
        }
        calm
    };
    let encoded = play(Messages::Encoder);
    assert!(encoded.messages.iter().all(|m| m.width == 5 && m.data.iter().all(|v| v.abs() < 1.0)));
    let calm = play(Messages::Observation);
    let noise = ActionNoise::OrnsteinUhlenbeck { theta: 0.15, sigma: 0.2, scale: 0.3, episodes: 4 };
    assert_eq!([0, 1, 2, 4, 9].map(|episode| noise.scale(episode)), [0.3, 0.3 * 3.0 / 4.0, 0.15, 0.0, 0.0]);
    parts.2 = Box::new(team(&*parts.0, Messages::Observation, noise).0);
    let layout = parts.recording(1, 0).layout();
    let noisy = parts.recording(1, 0).together(&layout, 3, 2);
    assert_ne!(noisy[0].actions, parts.recording(1, 0).episode(4).actions);
    assert_eq!(noisy[1].actions, calm.actions, "no noise is left in episode 4");
}

#[test]
fn acting_allocates_nothing_once_it_is_warm() {
    let parts = Parts::new("simple_spread", 3, "dropout:0.5", "random");
    for messages in [Messages::Observation, Messages::Encoder] {
        let (trained, params) = team(&*parts.0, messages, ActionNoise::None);
        let (mut acting, mut scratch) = (Team::default(), TeamScratch::default());
        let (mut sending, mut sent) = (EncoderScratch::default(), Vec::new());
        acting.load_forward(&trained.actors, &params);
        let (observations, link) = (vec![0.5; 5 * 54], [false; 45]);
        let mut act = || {
            acting.encode(&trained.actors, (&observations, 5), &mut sending, &mut sent);
            let sight = Sight { observations: &observations, messages: &sent, link: &link };
            acting.act(&trained.actors, sight, 5, &mut scratch);
        };
        act();
        assert_eq!(crate::allocations::allocations(act), 0, "{messages:?}");
    }
}

#[test]
fn the_same_episodes_for_any_threads_and_blocks() {
    let parts = Parts::new("simple_tag", 3, "markov:heavy", "random");
    let recording = parts.recording(7, 23);
    let one = record(&recording, 1, 1);
    for (threads, block) in [(8, 0), (8, 5), (2, 100), (3, 23)] {
        assert_eq!(record(&recording, threads, block), one, "{threads} threads, blocks of {block}");
    }
    assert_eq!(one[22], recording.episode(22));
    assert_eq!(record(&parts.recording(7, 5), 2, 2), one[..5], "a longer recording begins with the shorter one");
}

#[test]
fn messages_are_what_was_sent_and_rows_replay_through_the_scenario() {
    let parts = Parts::new("simple_tag", 3, "none", "random");
    let episode = parts.recording(1, 1).episode(0);
    for agent in 0..3 {
        assert_eq!(episode.messages[agent], episode.observations[agent], "sent before the channel");
    }
    assert_eq!(episode.messages[3].width, 0, "the prey is silent");
    let width = parts.0.shape().width();
    let (mut state, mut rewards) = (episode.state[..width].to_vec(), vec![0.0; 4]);
    for t in 0..episode.steps {
        let actions: Vec<f32> = episode.actions.iter().flat_map(|m| m.row(t).to_vec()).collect();
        parts.0.step(&mut state, &actions, &mut rewards, &mut Scratch::default());
        assert_eq!(parts.0.team_reward(&rewards), episode.reward[t]);
        assert_eq!(state, episode.state[(t + 1) * width..(t + 2) * width]);
    }
}

/// Correlation of the sender's message and the receiver's first action, over delivered and over lost rows.
fn correlations(agents: usize, link: &str) -> [f64; 2] {
    let parts = Parts::new("simple_spread", agents, link, "probe:0.75");
    let recording = parts.recording(1, 1000);
    let mut sums = [[0.0_f64; 6]; 2];
    for index in 0..recording.episodes {
        let e = recording.episode(index);
        for t in 0..e.steps {
            let (m, a) = (f64::from(e.messages[0].row(t)[0]), f64::from(e.actions[1].row(t)[0]));
            let class = &mut sums[usize::from(!e.delivered(agents, t, 0, 1))];
            for (sum, term) in class.iter_mut().zip([1.0, m, a, m * m, a * a, m * a]) {
                *sum += term;
            }
        }
    }
    sums.map(|[n, m, a, mm, aa, ma]| {
        (ma / n - m / n * a / n) / ((mm / n - (m / n).powi(2)) * (aa / n - (a / n).powi(2))).sqrt()
    })
}

#[test]
fn the_probe_has_its_correlation_on_delivered_rows_and_none_on_lost_ones() {
    for link in ["dropout:0.2", "markov:heavy"] {
        let [delivered, lost] = correlations(2, link);
        assert!((delivered - 0.75).abs() < 0.015, "{link}: {delivered}");
        assert!(lost.abs() < 0.08, "{link}: {lost}");
    }
    let [delivered, _] = correlations(4, "perfect");
    assert!((delivered - 0.75 / 3.0_f64.sqrt()).abs() < 0.03, "three senders share: {delivered}");
}

#[test]
fn a_failing_sink_and_a_stop_end_in_good_order() {
    let parts = Parts::new("simple_spread", 2, "perfect", "random");
    let recording = parts.recording(1, 50);
    let mut sink = Memory { fail_at: Some(7), ..Memory::default() };
    let error = recording.record(&mut sink, Options { threads: 2, block: 3 }, &mut |_| {}, &AtomicBool::new(false));
    assert!(matches!(error, Err(RecordError::Storage(_))));
    assert_eq!(sink.episodes.len(), 7);

    let (mut sink, stop) = (Memory::default(), AtomicBool::new(false));
    let mut halt = |e: &Episode| stop.store(e.index >= 9, Ordering::Relaxed);
    let done = recording.record(&mut sink, Options { threads: 2, block: 4 }, &mut halt, &stop).unwrap();
    assert!(done.interrupted && done.episodes == 12 && sink.episodes.len() == 12, "ends after the block at hand");
    let none = parts.recording(1, 0).record(&mut sink, Options::default(), &mut |_| {}, &stop).unwrap_err();
    assert_eq!(none.to_string(), "expected at least 1 episode, found 0: give --episodes");
}

/// Exit code and stderr of `ccmarl record` with these arguments.
fn refused(arguments: &[&str]) -> (i32, String) {
    let dir = tempfile::tempdir().unwrap();
    let mut command = Command::cargo_bin("ccmarl").unwrap();
    let output = command.arg("record").args(arguments).arg("--out").arg(dir.path().join("store")).output().unwrap();
    assert!(output.stdout.is_empty());
    assert!(dir.path().read_dir().unwrap().next().is_none(), "something was left behind");
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn the_command_refuses_wrong_words_with_exit_code_2() {
    for (arguments, message) in [
        (&["--scenario", "simple_tga"][..], "unknown scenario \"simple_tga\": did you mean simple_tag"),
        (&["--scenario", "simple_tag", "--policy", "randm"], "unknown policy \"randm\": did you mean random?"),
        (&["--scenario", "simple_tag", "--link", "dropuot:0.2"], "unknown link \"dropuot\": did you mean dropout?"),
        (&["--scenario", "simple_tag", "--link", "dropout:2"], "dropout: p must be in [0, 1], found 2"),
        (&["--scenario", "simple_tag", "--agents", "0"], "simple_tag: agents must be in [1, 1000], found 0"),
        (&["--scenario", "simple_tag", "--set", "radius"], "--set takes key=value, found \"radius\""),
        (
            &["--scenario", "simple_tag", "--set", "dt=nan"],
            "simple_tag: dt: invalid type: string \"nan\", expected f64",
        ),
        (&["--scenario", "simple_tag", "--episodes", "0"], "expected at least 1 episode, found 0"),
        (&["--scenario", "simple_tag", "--policy", "probe:1.5"], "probe: rho must be in [-1, 1], found 1.5"),
    ] {
        let (code, stderr) = refused(arguments);
        assert_eq!(code, 2, "{stderr}");
        assert!(stderr.contains(message) && stderr.lines().count() == 1, "{stderr}");
    }
}

fn ccmarl(arguments: &[&str], out: &std::path::Path) -> std::process::Output {
    Command::cargo_bin("ccmarl").unwrap().arg("record").args(arguments).arg("--out").arg(out).output().unwrap()
}

/// All files of a store with their bytes.
fn bytes(store: &std::path::Path) -> Vec<(String, Vec<u8>)> {
    let mut files: Vec<_> = store.read_dir().unwrap().map(|f| f.unwrap().path()).collect();
    files.sort();
    files.into_iter().map(|f| (f.file_name().unwrap().to_string_lossy().into(), std::fs::read(f).unwrap())).collect()
}

#[test]
fn the_command_writes_the_same_store_for_any_threads_and_refuses_to_replace_it() {
    let dir = tempfile::tempdir().unwrap();
    let (one, eight) = (dir.path().join("one"), dir.path().join("eight"));
    let arguments = ["--scenario", "simple_tag", "--link", "markov:heavy", "--episodes", "40", "--format", "json"];
    let output = ccmarl(&[&arguments[..], &["--threads", "1"]].concat(), &one);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && stderr.contains("committed 40 episodes"), "{stderr}");
    let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&summary["episodes"], &summary["steps"]), (&Value::from(40), &Value::from(1000)));
    assert_eq!(summary["link"]["matrix"][0][0], 0.9);
    assert!(ccmarl(&[&arguments[..], &["--threads", "8"]].concat(), &eight).status.success());
    assert_eq!(bytes(&one), bytes(&eight));

    let again = ccmarl(&arguments, &one);
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8(again.stderr).unwrap().starts_with("error: output exists: give --force"));
    assert!(ccmarl(&[&arguments[..], &["--force", "--seed", "2"]].concat(), &one).status.success());
    assert_ne!(bytes(&one), bytes(&eight));
}

#[test]
fn an_interrupted_recording_is_sealed_and_exits_4() {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("store");
    let mut child = std::process::Command::new(assert_cmd::cargo::cargo_bin("ccmarl"))
        .args(["record", "--scenario", "simple_spread", "--episodes", "100000000", "--out"])
        .arg(&store)
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let first = lines.next().unwrap().unwrap();
    assert!(first.starts_with("committed "), "{first}");
    assert!(std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    let rest: Vec<String> = lines.map(Result::unwrap).collect();
    assert_eq!(child.wait().unwrap().code(), Some(4), "{rest:?}");
    assert!(rest.last().unwrap().starts_with("interrupted: sealed "), "{rest:?}");
    let committed: u64 = rest[rest.len() - 2].split(' ').nth(1).unwrap().parse().unwrap();
    let mut source = ccmarl::storage::open(&store).unwrap();
    assert_eq!(source.manifest().episodes, committed);
    assert_eq!(source.next_episode().unwrap().unwrap().index, 0);
}
