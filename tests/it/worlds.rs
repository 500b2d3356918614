//! Scenarios: contract over the registry, parity with mpe2, symmetries, reference returns.

use std::path::Path;

use ccmarl::record::{
    Difference, EpisodeReturn, RecordError, Recording, Resimulation, build_link, build_policy, returns,
};
use ccmarl::registry::Spec;
use ccmarl::rng::{Seeds, Stream, uniform};
use ccmarl::scenario::{SCENARIOS, Scenario, Scratch, Worlds, build};
use ccmarl::schema::{Episode, Manifest};
use ccmarl::storage::{EpisodeSource, StorageError};
use serde_json::Value;

use crate::allocations::allocations;

/// Every scenario in every profile, decoder and kind of action; `agents` where the scenario lets one choose.
fn every_kind(agents: usize) -> Vec<Spec> {
    let mut all = Vec::new();
    for entry in SCENARIOS {
        for (decoder, discrete) in [("force2", false), ("mpe5", false), ("mpe5", true), ("mpe2", false), ("mpe2", true)]
        {
            for profile in ["paper", "mpe2"] {
                let spec = Spec::new(entry.name).with("profile", profile).with("decoder", decoder);
                let spec = spec.with("discrete", discrete);
                all.push(if entry.value.is_some() { spec.with("agents", agents) } else { spec });
            }
        }
    }
    all
}

/// The spec that `parameters()` describes.
fn resolved(scenario: &dyn Scenario) -> Spec {
    serde_json::from_value(Value::Object(scenario.parameters())).unwrap()
}

fn total(s: &dyn Scenario, width: fn(&ccmarl::schema::AgentSpec) -> usize) -> usize {
    s.agents().iter().map(width).sum()
}

/// Random actions of everyone under policy control, the rule's of the others.
fn act(s: &dyn Scenario, state: &[f64], rng: &mut Stream, actions: &mut [f32]) {
    for action in actions.chunks_exact_mut(s.space().width()) {
        s.space().sample(rng, action);
    }
    s.scripted(state, rng, actions);
}

/// A world after `steps` random steps, with its observations and rewards.
fn walk(s: &dyn Scenario, seed: u64, steps: usize) -> (Vec<f64>, Vec<f32>, Vec<f32>) {
    let mut observations = vec![f32::NAN; total(s, |a| a.observation)];
    let mut rewards = vec![f32::NAN; s.agents().len()];
    let mut actions = vec![f32::NAN; total(s, |a| a.action)];
    let mut state = vec![f64::NAN; s.shape().width()];
    let mut rng = Seeds::new(seed).stream("walk");
    s.reset(&mut state, &mut rng);
    for _ in 0..steps {
        act(s, &state, &mut rng, &mut actions);
        s.step(&mut state, &actions, &mut rewards, &mut Scratch::default());
    }
    s.observe(&state, &mut observations);
    (state, observations, rewards)
}

#[test]
fn every_scenario_keeps_its_contract() {
    for spec in [1, 2, 3, 7].into_iter().flat_map(every_kind) {
        if spec.name == "simple_adversary" && spec.params["agents"] == 1 {
            continue;
        }
        let s = build(&spec).unwrap();
        s.layout().check().unwrap();
        let (state, observations, rewards) = walk(&*s, 1, 30);
        assert_eq!((state.len(), s.check_state(&state)), (s.state_fields().len(), Ok(())));
        assert!(observations.iter().chain(&rewards).all(|v| v.is_finite()), "{spec}: not all written");
        let mut oracle = vec![f32::NAN; total(&*s, |a| a.action)];
        s.oracle(&state, &mut oracle);
        s.scripted(&state, &mut Seeds::new(1).stream("x"), &mut oracle);
        for action in oracle.chunks_exact(s.space().width()) {
            assert_eq!(s.space().check(action), Ok(()), "{spec}");
            assert!(action.iter().all(|a| (s.space().decoder.low()..=1.0).contains(a)), "{spec}: {action:?}");
        }
        let (_, again, _) = walk(&*s, 1, 30);
        assert_eq!(again, observations, "same seed, same world");
        assert_ne!(walk(&*s, 2, 30).1, observations);
    }
}

#[test]
fn resolved_parameters_build_the_same_scenario_and_wrong_ones_are_refused() {
    for spec in every_kind(2) {
        let s = build(&spec.clone().with("dt", 0.05)).unwrap();
        let again = build(&resolved(&*s)).unwrap();
        assert_eq!(again.parameters(), s.parameters());
        assert_eq!(s.parameters()["profile"], spec.params["profile"]);
        assert_eq!(walk(&*again, 3, 20), walk(&*s, 3, 20));
    }
    for entry in SCENARIOS {
        let error = |key: &str, value: Value| build(&Spec::new(entry.name).with(key, value)).err().unwrap().to_string();
        for (key, value) in resolved(&*build(&Spec::new(entry.name)).unwrap()).params {
            if value.is_number() {
                let text = error(&key, (-1e9).into());
                assert!(text.contains(&key), "{key}: {text}");
            }
        }
        assert_eq!(
            error("profile", "mpe3".into()),
            format!("{}: profile must be \"paper\" or \"mpe2\", found \"mpe3\"", entry.name)
        );
        assert!(error("discrete", true.into()).contains("discrete actions are moves of decoder mpe5 or mpe2"));
    }
    let error =
        |name: &str, key: &str, value: Value| build(&Spec::new(name).with(key, value)).err().unwrap().to_string();
    for (name, key, value, expected) in [
        ("simple_spread", "agents", 0.into(), "agents must be in [1, 1000], found 0"),
        ("simple_tag", "agents", 1001.into(), "agents must be in [1, 1000], found 1001"),
        ("simple_adversary", "agents", 1.into(), "agents must be in [2, 1000], found 1"),
        ("simple_reference", "agents", 3.into(), "agents must be in [2, 2], found 3"),
        ("simple_spread", "agent_size", (-0.1).into(), "agent_size must be in [0, 1], found -0.1"),
        ("simple_tag", "view_radius", (-1).into(), "view_radius must be in [0, 1000] or none, found -1"),
        ("simple_tag", "view_radius", "far".into(), "view_radius: expected a number or none, found \"far\""),
        (
            "simple_spread",
            "view_raduis",
            1.into(),
            "unknown field `view_raduis`: did you mean view_radius, cover_radius?",
        ),
    ] {
        assert_eq!(error(name, key, value), format!("{name}: {expected}"));
    }
    let absent =
        [Value::Null, "none".into()].map(|none| build(&Spec::new("simple_tag").with("view_radius", none)).unwrap());
    assert!(absent.iter().all(|s| s.parameters()["view_radius"] == "none"));
}

/// Plays a store again.
fn resimulate(source: &mut dyn EpisodeSource) -> Result<Vec<Difference>, RecordError> {
    let mut again = Resimulation::of(source.manifest())?;
    while let Some(episode) = source.next_episode()? {
        again.play(&episode)?;
    }
    Ok(again.differences())
}

/// The stores of `datasets/golden/mpe2`, sorted.
fn golden() -> Vec<std::path::PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("datasets/golden/mpe2");
    let mut stores: Vec<_> =
        std::fs::read_dir(root).unwrap().map(|e| e.unwrap().path()).filter(|p| p.is_dir()).collect();
    stores.sort();
    stores
}

#[test]
fn profile_mpe2_equals_mpe2() {
    let stores = golden();
    assert_eq!(stores.len(), 36);
    for path in stores {
        let mut source = ccmarl::storage::open(&path).unwrap();
        assert!(source.manifest().steps >= 50);
        for column in resimulate(source.as_mut()).unwrap() {
            assert!(column.holds(), "{}: {column:?}", path.display());
        }
    }
}

/// Episodes and a manifest in memory.
struct Held(Manifest, Vec<Episode>);

impl EpisodeSource for Held {
    fn manifest(&self) -> &Manifest {
        &self.0
    }

    fn next_episode(&mut self) -> Result<Option<Episode>, StorageError> {
        Ok(self.1.pop())
    }
}

/// One recorded episode under a random policy.
fn held(spec: &Spec) -> Held {
    let scenario = build(spec).unwrap();
    let link = build_link(&Spec::new("dropout").with("p", 0.3), &*scenario).unwrap();
    let policy = build_policy(&Spec::new("random"), &*scenario).unwrap();
    let recording = Recording { scenario: &*scenario, link: &*link, policy: &*policy, seed: 1, episodes: 1 };
    Held(recording.manifest(), vec![recording.episode(0)])
}

#[test]
fn recorded_episodes_resimulate_exactly() {
    for spec in every_kind(4) {
        let differences = resimulate(&mut held(&spec)).unwrap();
        assert!(differences.iter().all(|d| d.largest == 0.0), "{spec}: {differences:?}");
    }
}

#[test]
fn a_changed_value_shows_in_its_column_and_place() {
    let spec = Spec::new("simple_tag");
    let changed = |change: &dyn Fn(&mut Episode)| {
        let mut store = held(&spec);
        change(&mut store.1[0]);
        let all = resimulate(&mut store).unwrap();
        let wrong: Vec<_> = all.into_iter().filter(|d| !d.holds()).map(|d| (d.column, d.step)).collect();
        wrong
    };
    let at = |column: &str, step| vec![(column.to_owned(), step)];
    assert_eq!(changed(&|e| e.reward[7] += 1e-5), at("reward", 7));
    assert_eq!(changed(&|e| e.rewards[1][24] -= 10.0), at("reward.adversary_1", 24));
    assert_eq!(changed(&|e| e.observations[3].data[25 * 14] += 1e-5), at("observation.agent_0", 25));
    let width = build(&spec).unwrap().shape().width();
    assert_eq!(changed(&|e| e.state[25 * width] += 1e-8), at("state", 25), "the last row follows from the one before");
    assert_eq!(changed(&|_| ()), []);
}

#[test]
fn a_store_of_another_scenario_is_refused_with_its_reason() {
    let error = |change: &dyn Fn(&mut Held)| {
        let mut store = held(&Spec::new("simple_reference").with("profile", "mpe2").with("discrete", true));
        change(&mut store);
        resimulate(&mut store).unwrap_err()
    };
    let text = |change: &dyn Fn(&mut Held)| match error(change) {
        RecordError::Mismatch(message) => message,
        other => other.to_string(),
    };
    assert_eq!(
        text(&|s| s.0.scenario = serde_json::json!({"name": "simple_reference"})),
        "state_fields: the scenario has 20, the store 36, and agent_0.c2 stands where agent_1.x should"
    );
    assert_eq!(
        text(&|s| s.0.agents[1].observation = 20),
        "agents: the scenario has agent_1 (observation 21, action 15), the store agent_1 (observation 20, action 15): \
         another profile?"
    );
    assert!(text(&|s| s.0.scenario = "made-up".into()).starts_with("unknown scenario \"made-up\""));
    assert!(text(&|s| s.0.scenario = 7.into()).starts_with("scenario: expected a name or"));
    assert_eq!(
        text(&|s| s.1[0].state[35] = 3.0),
        "episode 0 step 0: state field goal.agent_1 must be a landmark's number in [0, 2], found 3"
    );
    assert_eq!(
        text(&|s| s.1[0].actions[1].data[15..20].fill(1.0)),
        "episode 0 step 1: action.agent_1: a discrete action must be one-hot (one 1, else 0) over its 5 moves, found \
         [1.0, 1.0, 1.0, 1.0, 1.0]"
    );
    let s = build(&Spec::new("simple_spread")).unwrap();
    assert_eq!(s.check_state(&[0.0; 17]), Err("state must have 18 elements, found 17".to_owned()));
    let mut state = [0.0; 18];
    state[6] = f64::NAN;
    assert_eq!(s.check_state(&state), Err("state field agent_1.vx must be finite, found NaN".to_owned()));
}

#[test]
fn many_worlds_step_as_one_by_one() {
    for spec in every_kind(3) {
        let s = build(&spec).unwrap();
        let (count, agents, wide) = (5, s.agents().len(), total(&*s, |a| a.action));
        let mut worlds = Worlds::new(&*s, count);
        let mut rngs: Vec<Stream> = (0..count as u64).map(|w| Seeds::new(w).stream("walk")).collect();
        for (w, rng) in rngs.iter_mut().enumerate() {
            worlds.reset(w, rng);
        }
        let (mut actions, mut rewards) = (vec![0.0; count * wide], vec![0.0; count * agents]);
        let mut team = vec![0.0; count];
        let mut observations = vec![f32::NAN; count * total(&*s, |a| a.observation)];
        for step in 0..30 {
            let allocated = allocations(|| {
                for (action, rng) in actions.chunks_exact_mut(wide).zip(&mut rngs) {
                    for action in action.chunks_exact_mut(s.space().width()) {
                        s.space().sample(rng, action);
                    }
                }
                worlds.scripted(&mut rngs, &mut actions);
                worlds.step(&actions, &mut rewards, &mut team);
                worlds.observe(&mut observations);
            });
            assert!(step == 0 || allocated == 0, "{spec}: {allocated} allocations in step {step}");
        }
        assert_eq!(worlds.len(), count);
        for (w, (seen, earned)) in
            observations.chunks_exact(observations.len() / count).zip(rewards.chunks_exact(agents)).enumerate()
        {
            let alone = walk(&*s, w as u64, 30);
            assert_eq!((worlds.state(w), seen, earned), (&alone.0[..], &alone.1[..], &alone.2[..]), "{spec}");
        }
    }
}

/// A crowded row, so that bodies touch: everything within 0.4 of the centre and moving; goals 0.
fn crowded(s: &dyn Scenario, name: &str) -> Vec<f64> {
    let (shape, mut state, mut rng) = (s.shape(), vec![0.0; s.shape().width()], Seeds::new(4).stream(name));
    let mut pair = |low| [uniform(&mut rng, low, -low), uniform(&mut rng, low, -low)];
    (0..shape.agents + shape.landmarks).for_each(|body| shape.place(&mut state, body, pair(-0.4)));
    (0..shape.agents).for_each(|agent| shape.push(&mut state, agent, pair(-1.0)));
    state
}

/// The five-part moves of decoders `mpe5` and `mpe2` with left and right exchanged, or the first component negated.
fn mirrored(s: &dyn Scenario, actions: &[f32]) -> Vec<f32> {
    let mut mirrored = actions.to_vec();
    for action in mirrored.chunks_exact_mut(s.space().width()) {
        if s.space().decoder.width() == 5 {
            action.swap(1, 2);
        } else {
            action[0] = -action[0];
        }
    }
    mirrored
}

#[test]
fn a_mirrored_world_moves_as_the_mirror_image() {
    for spec in every_kind(3) {
        let s = build(&spec).unwrap();
        let (shape, agents) = (s.shape(), s.agents().len());
        let flip = |row: &[f64]| {
            let (world, mut flipped) = (shape.world(row), row.to_vec());
            for body in 0..shape.agents + shape.landmarks {
                let [x, y] = world.position(body);
                shape.place(&mut flipped, body, [-x, y]);
            }
            for agent in 0..agents {
                let [x, y] = world.velocity(agent);
                shape.push(&mut flipped, agent, [-x, y]);
            }
            flipped
        };
        let mut state = crowded(&*s, "mirror");
        let mut mirror = flip(&state);
        let mut rng = Seeds::new(5).stream("actions");
        let (mut a, mut b) = (vec![0.0; agents], vec![0.0; agents]);
        let mut actions = vec![0.0; agents * s.space().width()];
        let mut scratch = Scratch::default();
        for _ in 0..25 {
            actions.chunks_exact_mut(s.space().width()).for_each(|action| s.space().sample(&mut rng, action));
            s.step(&mut state, &actions, &mut a, &mut scratch);
            s.step(&mut mirror, &mirrored(&*s, &actions), &mut b, &mut scratch);
            assert_eq!(a, b, "{spec}");
        }
        assert_eq!(flip(&state), mirror, "{spec}");
    }
}

#[test]
fn renumbered_agents_move_see_and_earn_alike() {
    for spec in every_kind(3) {
        let s = build(&spec).unwrap();
        // agents of one kind may change places: all of spread and reference, the predators, the good agents
        let order: &[usize] = match &*spec.name {
            "simple_spread" => &[2, 0, 1],
            "simple_tag" => &[2, 0, 1, 3],
            "simple_adversary" => &[0, 2, 1],
            _ => &[1, 0],
        };
        let (shape, agents, width) = (s.shape(), s.agents().len(), s.space().width());
        let mut state = crowded(&*s, "permute");
        let mut other = state.clone();
        for (to, &from) in order.iter().enumerate() {
            shape.place(&mut other, to, shape.world(&state).position(from));
            shape.push(&mut other, to, shape.world(&state).velocity(from));
        }
        let mut rng = Seeds::new(6).stream("actions");
        let (mut a, mut b) = (vec![0.0_f32; agents], vec![0.0_f32; agents]);
        let mut actions = vec![0.0; agents * width];
        let mut scratch = Scratch::default();
        for _ in 0..10 {
            actions.chunks_exact_mut(width).for_each(|action| s.space().sample(&mut rng, action));
            let moved: Vec<f32> = order.iter().flat_map(|&from| actions[from * width..][..width].to_vec()).collect();
            s.step(&mut state, &actions, &mut a, &mut scratch);
            s.step(&mut other, &moved, &mut b, &mut scratch);
        }
        let own_part = |row: &[f64]| {
            let mut seen = vec![0.0; total(&*s, |a| a.observation)];
            s.observe(row, &mut seen);
            ccmarl::scenario::offsets(s.agents(), |a| a.observation)
                .windows(2)
                .map(|w| seen[w[0]..w[0] + 2].to_vec())
                .collect::<Vec<_>>()
        };
        let (seen, seen_other) = (own_part(&state), own_part(&other));
        for (to, &from) in order.iter().enumerate() {
            assert!((a[from] - b[to]).abs() < 1e-5, "{spec}");
            for c in 0..2 {
                let [p, q] = [shape.world(&state).position(from)[c], shape.world(&other).position(to)[c]];
                assert!((p - q).abs() < 1e-9, "{spec}");
                assert!((seen[from][c] - seen_other[to][c]).abs() < 1e-6, "{spec}");
            }
        }
    }
}

/// Mean and standard error of the return over `episodes`.
fn mean_return(scenario: &Spec, policy: &str, episodes: u64) -> (f64, f64) {
    let scenario = build(scenario).unwrap();
    let link = build_link(&Spec::new("perfect"), &*scenario).unwrap();
    let policy = build_policy(&Spec::new(policy), &*scenario).unwrap();
    let recording = Recording { scenario: &*scenario, link: &*link, policy: &*policy, seed: 1, episodes };
    let all: Vec<EpisodeReturn> = returns(&recording, 0, episodes);
    let n = all.len() as f64;
    let mean = all.iter().map(|e| e.episode_return).sum::<f64>() / n;
    let variance = all.iter().map(|e| (e.episode_return - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, (variance / n).sqrt())
}

/// Scenario, parameters, policy, mean return, its standard error.
type Row = (&'static str, &'static [(&'static str, f64)], &'static str, f64, f64);

/// Returns of random and oracle policies that `tests/reference/paper_worlds.py` (numpy, 4000 episodes, seed 1) found.
const REFERENCE: &[Row] = &[
    ("simple_spread", &[], "random", -229.198, 0.721),
    ("simple_spread", &[], "scripted", -52.640, 0.368),
    ("simple_spread", &[("cover_bonus", 0.0)], "scripted", -103.899, 0.266),
    ("simple_tag", &[], "random", 0.963, 0.083),
    ("simple_tag", &[], "scripted", 137.330, 0.978),
    ("simple_tag", &[("agents", 6.0)], "random", 2.205, 0.120),
    ("simple_tag", &[("agents", 6.0)], "scripted", 187.702, 0.967),
    ("simple_tag", &[("agents", 9.0)], "scripted", 217.805, 0.970),
    ("simple_tag", &[("prey_accel", 4.0)], "scripted", 1.145, 0.073),
    ("simple_reference", &[], "random", 1.945, 0.122),
    ("simple_reference", &[], "scripted", 366.495, 0.665),
    ("simple_adversary", &[], "random", -39.420, 0.509),
    ("simple_adversary", &[], "scripted", -4.370, 0.075),
];

#[test]
fn profile_paper_earns_what_an_independent_simulation_earns() {
    for &(name, parameters, policy, expected, its_error) in REFERENCE {
        let mut spec = Spec::new(name);
        for &(key, value) in parameters {
            spec = if key == "agents" { spec.with(key, value as u64) } else { spec.with(key, value) };
        }
        let (mean, error) = mean_return(&spec, policy, 2000);
        // one comparison in 16,000 fails by chance at four standard errors
        assert!((mean - expected).abs() < 4.0 * error.hypot(its_error), "{spec} {policy}: {mean} ± {error}");
    }
}

/// Exit code and stdout of `ccmarl verify STORE --resimulate`.
fn verify(store: &Path) -> (i32, String) {
    let mut command = assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    let output = command.arg("verify").arg(store).arg("--resimulate").output().unwrap();
    (output.status.code().unwrap(), String::from_utf8(output.stdout).unwrap())
}

#[test]
fn the_command_resimulates_stores_of_other_programs_and_tells_a_wrong_constant() {
    let golden = golden().into_iter().find(|p| p.ends_with("reference-discrete")).unwrap();
    let (code, text) = verify(&golden);
    assert_eq!(code, 0, "{text}");
    assert!(text.contains("reward.agent_1") && text.contains("1e-9"), "{text}");

    let dir = tempfile::tempdir().unwrap();
    let store = held(&Spec::new("simple_spread"));
    let wrong = |name: &str, scenario: Value| {
        let path = dir.path().join(name);
        let manifest = Manifest { scenario, ..store.0.clone() };
        let mut sink = ccmarl::storage::create(&path, &manifest, false).unwrap();
        sink.append(&store.1[0]).unwrap();
        sink.finish().unwrap();
        let (code, text) = verify(&path);
        assert_eq!(code, 1, "{text}");
        text
    };
    let slow = wrong("slow", serde_json::json!({"name": "simple_spread", "dt": 0.05}));
    assert!(slow.contains("resimulation") && slow.contains("allowed is 1e-9"), "{slow}");
    let unknown = wrong("unknown", serde_json::json!({"name": "simple_tga"}));
    assert!(unknown.contains("unknown scenario \"simple_tga\": did you mean simple_tag"), "{unknown}");
    let other = wrong("other", serde_json::json!({"name": "simple_tag"}));
    assert!(other.contains("the store does not fit the scenario that its manifest names"), "{other}");
}
