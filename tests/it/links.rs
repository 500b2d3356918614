//! Links: contract over the registry, realised loss of recorded episodes.

use ccmarl::link::{LINKS, Link, Setting, build};
use ccmarl::record::{Recording, build_policy, returns};
use ccmarl::registry::Spec;
use ccmarl::rng::Seeds;
use ccmarl::scenario;
use serde_json::Value;

const SETTING: Setting = Setting { distance_unit: 0.25 };

/// A valid use of every link: extend this when a new link needs a parameter.
fn example(name: &str) -> Spec {
    let text = match name {
        "dropout" => "dropout:0.3",
        "markov" => "markov:medium",
        "distance" => "distance:3",
        other => other,
    };
    Spec::parse("link", LINKS, text).unwrap()
}

fn rows(link: &dyn Link, n: usize, seed: u64) -> Vec<bool> {
    let mut episode = link.start(n, &Seeds::new(seed));
    let positions: Vec<[f64; 2]> = (0..n).map(|i| [0.5 * i as f64, 0.1]).collect();
    let mut all = Vec::new();
    for _ in 0..26 {
        let mut bits = vec![false; n * n];
        episode.emit(&positions, &mut bits);
        assert!((0..n).all(|i| bits[i * n + i]));
        all.extend(bits);
    }
    all
}

#[test]
fn every_link_keeps_its_contract() {
    for entry in LINKS {
        let link = build(&example(entry.name), &SETTING).unwrap();
        for n in [0, 1, 2, 5] {
            assert_eq!(rows(&*link, n, 1), rows(&*link, n, 1), "same seed, same bits");
        }
        let spec: Spec = serde_json::from_value(Value::Object(link.parameters())).unwrap();
        assert_eq!(spec.name, entry.name);
        let again = build(&spec, &Setting { distance_unit: 7.0 }).unwrap();
        assert_eq!(again.parameters(), link.parameters(), "resolved parameters stand on their own");
        assert_eq!(rows(&*again, 4, 2), rows(&*link, 4, 2));
        let error = build(&example(entry.name).with("nonsense", 1), &SETTING).err().unwrap().to_string();
        assert!(error.contains("unknown field `nonsense`"), "{error}");
    }
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
    ] {
        let built = build(&Spec::parse("link", LINKS, link).unwrap(), &SETTING).unwrap();
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
