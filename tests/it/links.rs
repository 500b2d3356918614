//! Links: contract over the registry, purity, realised loss of recorded episodes.

use std::fmt::Write as _;
use std::path::Path;

use ccmarl::io::write_atomic;
use ccmarl::link::{Body, FEATURES, LINKS, Link, Setting, build};
use ccmarl::record::{Options, Recording, build_link, build_policy, read_trace, returns};
use ccmarl::registry::Spec;
use ccmarl::rng::{Seeds, normal, permutation};
use ccmarl::schema::Episode;
use ccmarl::{scenario, storage};
use proptest::prelude::*;
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};

/// Agents of the trace in the examples.
const AGENTS: usize = 5;

fn setting(distance_unit: f64) -> Setting {
    Setting::new(distance_unit, read_trace)
}

/// Files that examples name.
pub(crate) fn files() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let mut rows = "episode,step,sender,receiver,delivered\n".to_owned();
    for (episode, step) in (0..3).flat_map(|e| (0..26).map(move |t| (e, t))) {
        for (s, r) in (0..AGENTS * AGENTS).map(|c| (c / AGENTS, c % AGENTS)).filter(|(s, r)| s != r) {
            let bit = u8::from((7 * episode + 3 * step + 5 * s + r) % 4 > 0);
            writeln!(rows, "{episode},{step},{s},{r},{bit}").unwrap();
        }
    }
    write_atomic(&dir.path().join("trace.csv"), rows.as_bytes()).unwrap();
    let link = json!({"kind": "ccmarl link", "link": {"name": "dropout", "p": 0.4}});
    write_atomic(&dir.path().join("link.json"), link.to_string().as_bytes()).unwrap();
    dir
}

/// A classifier that loses more the farther apart and the faster a pair is.
pub(crate) fn classifier() -> Value {
    json!({"name": "learned", "features": FEATURES, "body_fields": ["x", "y", "vx", "vy"], "temperature": 1.5,
        "mean": [0.0, 0.0, 1.0, 0.0, 0.0], "scale": [1.0, 1.0, 0.8, 1.0, 1.0],
        "layers": [{"weight": [[0.1, -0.2, 2.0, 0.5, 0.5], [0.3, 0.1, -1.0, 0.2, 0.0]], "bias": [0.1, 0.2]},
                   {"weight": [[1.0, -1.5]], "bias": [-0.4]}]})
}

/// A valid use of every link: extend this when a new link needs a parameter.
pub(crate) fn example(name: &str, dir: &Path) -> Spec {
    let path = |file: &str| dir.join(file).display().to_string();
    let text = match name {
        "dropout" => "dropout:0.3".to_owned(),
        "markov" => "markov:medium".to_owned(),
        "distance" => "distance:3".to_owned(),
        "mixture" => "mixture:dropout:0.5,markov:heavy,none".to_owned(),
        "trace" => format!("trace:{}", path("trace.csv")),
        "file" => format!("file:{}", path("link.json")),
        "learned" => classifier().to_string(),
        other => other.to_owned(),
    };
    Spec::parse("link", LINKS, &text).unwrap()
}

fn emit(link: &dyn Link, n: usize, episode: u64, seeds: &Seeds, bodies: impl Fn(usize) -> Vec<Body>) -> Vec<bool> {
    let mut state = link.start(n, episode, seeds);
    let mut all = Vec::new();
    for row in 0..26 {
        let mut bits = vec![false; n * n];
        state.emit(&bodies(row), &mut bits);
        assert!((0..n).all(|i| bits[i * n + i]));
        all.extend(bits);
    }
    all
}

fn rows(link: &dyn Link, n: usize, seed: u64) -> Vec<bool> {
    let bodies = |_| (0..n).map(|i| [0.5 * i as f64, 0.1, 0.0, 0.2]).collect();
    emit(link, n, 1, &Seeds::new(seed), bodies)
}

#[test]
fn every_link_keeps_its_contract() {
    let dir = files();
    for entry in LINKS {
        let link = build(&example(entry.name, dir.path()), &setting(0.25)).unwrap();
        for n in [0, 1, 2, AGENTS] {
            assert_eq!(rows(&*link, n, 1), rows(&*link, n, 1), "same seed, same bits");
        }
        let spec: Spec = serde_json::from_value(Value::Object(link.parameters())).unwrap();
        assert_eq!(spec.name, entry.name);
        let again = build(&spec, &setting(7.0)).unwrap();
        assert_eq!(again.parameters(), link.parameters(), "resolved parameters stand on their own");
        assert_eq!(rows(&*again, 4, 2), rows(&*link, 4, 2));
        let text = serde_json::to_string(&link.parameters()).unwrap();
        let toml = toml::to_string(&serde_json::from_str::<Value>(&text).unwrap());
        assert!(toml.is_ok() || text.contains("null"), "a run's configuration can hold {}: {toml:?}", entry.name);
        let error = build(&example(entry.name, dir.path()).with("nonsense", 1), &setting(0.25)).err().unwrap();
        assert!(error.to_string().contains("unknown field `nonsense`"), "{error}");
    }
}

/// Random walks of five bodies over 26 rows.
fn walks(seed: u64) -> Vec<Vec<Body>> {
    let mut rng = Seeds::new(seed).stream("walks");
    (0..26).map(|_| (0..AGENTS).map(|_| std::array::from_fn(|_| 0.7 * normal(&mut rng))).collect()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// A link is a pure function of its own stream: who else is there, in which order episodes are played and on how
    /// many threads changes no bit of a pair.
    #[test]
    fn a_pairs_bits_depend_on_nothing_but_its_own_stream_and_state(seed in 0_u64..1 << 32, order in 0_u64..1 << 32) {
        let dir = files();
        for entry in LINKS {
            let link = build(&example(entry.name, dir.path()), &setting(0.25)).unwrap();
            let whole = &|episode: u64| {
                let walks = walks(seed + episode);
                let seeds = Seeds::new(seed).indexed("episode", episode);
                emit(&*link, AGENTS, episode, &seeds, |row| walks[row].clone())
            };
            let in_order: Vec<Vec<bool>> = (0..3).map(whole).collect();
            for e in permutation(&mut Seeds::new(order).stream("order"), 3) {
                prop_assert_eq!(&whole(e as u64), &in_order[e], "{}: order of episodes", entry.name);
            }
            let threads: Vec<Vec<bool>> = std::thread::scope(|scope| {
                let handles: Vec<_> = (0..3).map(|e| scope.spawn(move || whole(e))).collect();
                handles.into_iter().map(|handle| handle.join().unwrap()).collect()
            });
            prop_assert_eq!(&threads, &in_order, "{}: threads", entry.name);
            for n in 2..AGENTS {
                let walks = walks(seed);
                let seeds = Seeds::new(seed).indexed("episode", 0);
                let few = emit(&*link, n, 0, &seeds, |row| walks[row][..n].to_vec());
                for (row, (s, r)) in (0..26).flat_map(|row| (0..n * n).map(move |c| (row, (c / n, c % n)))) {
                    let all = in_order[0][(row * AGENTS + s) * AGENTS + r];
                    prop_assert_eq!(few[(row * n + s) * n + r], all, "{}: {} to {} among {}", entry.name, s, r, n);
                }
            }
        }
    }
}

#[test]
fn every_links_bits_are_the_same_on_every_machine() {
    // golden: a change here changes what a seed records
    let golden = [
        ("perfect", "13e6f6f3b613653c"),
        ("none", "7d210d94ed3384a0"),
        ("dropout", "3431ca342511adbe"),
        ("markov", "0ff4dbb80f003e54"),
        ("distance", "c340411c13c3c882"),
        ("mixture", "c46bad7871e9f2e8"),
        ("trace", "683c5a0120138600"),
        ("learned", "65d5332a0f9521df"),
        ("file", "50bf1222a704dd6e"),
    ];
    let dir = files();
    let found: Vec<(&str, String)> = LINKS
        .iter()
        .map(|entry| {
            let link = build(&example(entry.name, dir.path()), &setting(0.25)).unwrap();
            let mut bits = Vec::new();
            for episode in 0..8 {
                let walks = walks(episode);
                let seeds = Seeds::new(7).indexed("episode", episode);
                let all = emit(&*link, AGENTS, episode, &seeds, |row| walks[row].clone());
                bits.extend(all.into_iter().map(u8::from));
            }
            (entry.name, ccmarl::schema::hex(&Sha256::digest(&bits))[..16].to_owned())
        })
        .collect();
    assert_eq!(found, golden.map(|(name, digest)| (name, digest.to_owned())));
}

/// Records a random policy into a store.
pub(crate) fn record(scenario: &dyn scenario::Scenario, link: &dyn Link, episodes: u64, seed: u64, out: &Path) {
    let policy = build_policy(&Spec::new("random"), scenario).unwrap();
    let recording = Recording { scenario, link, policy: &*policy, seed, episodes };
    let mut sink = storage::create(out, &recording.manifest(), false).unwrap();
    let stop = std::sync::atomic::AtomicBool::new(false);
    recording.record(&mut *sink, Options::default(), &mut |_| (), &stop).unwrap();
    sink.finish().unwrap();
}

fn bits(store: &Path) -> Vec<Vec<bool>> {
    let mut source = storage::open(store).unwrap();
    let mut all = Vec::new();
    while let Some(Episode { link, .. }) = source.next_episode().unwrap() {
        all.push(link);
    }
    all
}

#[test]
fn a_recording_under_markov_heavy_replayed_gives_the_same_bits() {
    let dir = tempfile::tempdir().unwrap();
    let scenario = scenario::build(&Spec::new("simple_spread")).unwrap();
    let heavy = build_link(&Spec::new("markov").with("level", "heavy"), &*scenario).unwrap();
    for name in ["first", "first.parquet", "first.mcap"] {
        let (first, again) = (dir.path().join(name), dir.path().join(format!("again-{name}")));
        record(&*scenario, &*heavy, 60, 1, &first);
        let spec = Spec::new("trace").with("path", first.to_str().unwrap());
        let trace = build_link(&spec, &*scenario).unwrap();
        // another seed: nothing of the replay is drawn
        record(&*scenario, &*trace, 60, 2, &again);
        assert_eq!(bits(&first), bits(&again), "{name}");
        let manifest = storage::open(&again).unwrap().manifest().clone();
        assert_eq!(manifest.link["sha256"], storage::open(&first).unwrap().manifest().content, "the trace is named");
        let resolved: Spec = serde_json::from_value(manifest.link).unwrap();
        assert!(build_link(&resolved, &*scenario).is_ok(), "the recording can be made again");
    }
}

#[test]
fn a_trace_that_ends_is_refused_before_anything_is_written_unless_it_may_cycle() {
    let dir = tempfile::tempdir().unwrap();
    let scenario = scenario::build(&Spec::new("simple_spread")).unwrap();
    let heavy = build_link(&Spec::new("markov").with("level", "heavy"), &*scenario).unwrap();
    let store = dir.path().join("store");
    record(&*scenario, &*heavy, 10, 1, &store);
    let policy = build_policy(&Spec::new("random"), &*scenario).unwrap();
    let spec = Spec::new("trace").with("path", store.to_str().unwrap());
    let link = build_link(&spec, &*scenario).unwrap();
    let recording = Recording { scenario: &*scenario, link: &*link, policy: &*policy, seed: 1, episodes: 11 };
    let error = ccmarl::record::check_link(recording.link, 11).unwrap_err().to_string();
    assert_eq!(
        error,
        "the trace behind the link holds 10 episodes, and 11 are asked for: ask for 10 or fewer, or set its `cycle` to start again"
    );
    let cycle = build_link(&spec.clone().with("cycle", true), &*scenario).unwrap();
    let recording = Recording { link: &*cycle, ..recording };
    assert_eq!(recording.episode(13).link, recording.episode(3).link);

    let long = scenario::build(&Spec::new("simple_spread").with("steps", 40)).unwrap();
    let short = build_link(&spec, &*long).err().unwrap().to_string();
    assert!(short.contains("episode 0 has 26 steps, the scenario's have 40: set the scenario's steps"), "{short}");
    let other = scenario::build(&Spec::new("simple_tag")).unwrap();
    let unknown = build_link(&spec, &*other).err().unwrap().to_string();
    assert!(unknown.contains("its agents are agent_0, agent_1, agent_2, the scenario's communicators adversary_0"));
}

#[test]
fn realised_loss_of_recorded_episodes() {
    let scenario = scenario::build(&Spec::new("simple_spread")).unwrap();
    let policy = build_policy(&Spec::new("random"), &*scenario).unwrap();
    for (link, expected) in [
        ("perfect", 0.0),
        ("none", 1.0),
        ("dropout:0.2", 0.2),
        ("markov:light", 0.0110),
        ("markov:medium", 0.0797),
        ("markov:heavy", 0.1140),
        ("mixture:perfect,dropout:0.4", 0.2),
    ] {
        let built = build_link(&Spec::parse("link", LINKS, link).unwrap(), &*scenario).unwrap();
        let recording = Recording { scenario: &*scenario, link: &*built, policy: &*policy, seed: 1, episodes: 1000 };
        let losses: Vec<f64> = returns(&recording, 0, 1000).iter().map(|e| e.loss_rate).collect();
        let mean = losses.iter().sum::<f64>() / 1000.0;
        let se = (losses.iter().map(|l| (l - mean).powi(2)).sum::<f64>() / 999.0 / 1000.0).sqrt();
        assert!((mean - expected).abs() <= 4.0 * se + 1e-4, "{link}: {mean} ± {se}");
        let first = recording.episode(17);
        if link.starts_with("markov") {
            assert!(first.link[..9].iter().all(|&b| b), "the first message arrives");
        }
    }
}
