//! Fitted links: what was simulated is found again, a classifier does what its data did, and bad data is named.
//!
//! What stands under reports/channels comes from
//! `cargo test --release --test it channel::report -- --ignored --nocapture --test-threads 1`.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use ccmarl::channel::{Fit, FitOutcome, LinkStatistics, MAX_LOSSES, Observations, Runs, fit};
use ccmarl::io::write_atomic;
use ccmarl::link::LINKS;
use ccmarl::record::{Recording, build_link, build_policy};
use ccmarl::registry::Spec;
use ccmarl::stats::{ChiSquare, homogeneity};
use ccmarl::{scenario, storage};
use serde_json::Value;

use crate::links::{classifier, record};

const MEDIUM: [f64; 6] = [0.94, 0.60, 0.71, 0.87, 0.97, 0.99];
const HEAVY: [f64; 8] = [0.90, 0.81, 0.45, 0.61, 0.37, 0.77, 0.89, 0.93];

fn store(dir: &Path, name: &str, link: &str, episodes: u64, seed: u64) -> PathBuf {
    let scenario = scenario::build(&Spec::new("simple_spread")).unwrap();
    let built = build_link(&Spec::parse("link", LINKS, link).unwrap(), &*scenario).unwrap();
    let out = dir.join(name);
    record(&*scenario, &*built, episodes, seed, &out);
    out
}

fn fitted(store: &Path, model: &str, seed: u64) -> (Observations, Fit) {
    let observations = Observations::read(store).unwrap();
    let fit = fit(&observations, model, seed, &|_, _| ()).unwrap();
    (observations, fit)
}

/// The probability of delivery that a parameter of a chain estimates, when state m of the truth delivers with `back[m]`.
fn truth(parameter: &str, observations: &Observations, back: &[f64]) -> f64 {
    let after = |m: usize| back[m.min(back.len() - 1)];
    let Some(rest) = parameter.strip_prefix("P(delivered) after ") else { return 1.0 }; // the first message
    let m: usize = rest.split(' ').next().unwrap().parse().unwrap();
    if !rest.contains("or more") {
        return after(m);
    }
    // what was pooled is expected to deliver as its states do, by how often each was there
    let mut runs = Runs::default();
    for episode in 0..observations.episodes() {
        observations.sequences(episode).for_each(|sequence| runs.add(&observations.lost[sequence]));
    }
    let visits = |k: usize| runs.after[k][0] as f64;
    (m..=MAX_LOSSES).map(|k| visits(k) * after(k)).sum::<f64>() / (m..=MAX_LOSSES).map(visits).sum::<f64>()
}

/// What a hundred stores of one link give.
#[derive(Debug, Default)]
struct Recovery {
    stores: u64,
    /// `auto` took the family that was simulated.
    right: u64,
    /// All intervals hold the truth at once.
    covered: u64,
    /// Largest error of an estimate, as a part of the truth; over thresholds and rates.
    worst: f64,
    /// Parameters in the smallest and the largest fit.
    parameters: [usize; 2],
}

/// Simulates, records, reads and fits `stores` stores.
fn recovery(link: &str, model: &str, stores: u64, episodes: u64) -> Recovery {
    let dir = tempfile::tempdir().unwrap();
    let mut found = Recovery { stores, parameters: [usize::MAX, 0], ..Recovery::default() };
    for seed in 0..stores {
        let path = store(dir.path(), &format!("{seed}"), link, episodes, 1000 + seed);
        let (observations, auto) = fitted(&path, "auto", seed);
        found.right += u64::from(auto.model == model);
        let fit = if auto.model == model { auto } else { fitted(&path, model, seed).1 };
        let number = |text: &str| text.split(':').nth(1).unwrap().parse::<f64>().unwrap();
        let mut covered = true;
        for parameter in fit.parameters.iter().filter(|p| p.name != "range, world units") {
            let truth = match link {
                "markov:medium" => truth(&parameter.name, &observations, &MEDIUM),
                "markov:heavy" => truth(&parameter.name, &observations, &HEAVY),
                _ => number(link),
            };
            covered &= parameter.low <= truth && truth <= parameter.high;
            found.worst = found.worst.max((parameter.value - truth).abs() / truth);
        }
        found.covered += u64::from(covered);
        let parameters = fit.parameters.len();
        found.parameters = [found.parameters[0].min(parameters), found.parameters[1].max(parameters)];
        std::fs::remove_dir_all(path).unwrap();
    }
    found
}

#[test]
fn what_was_simulated_is_found_again() {
    for (link, model) in [
        ("dropout:0.2", "dropout"),
        ("markov:medium", "markov"),
        ("markov:heavy", "markov"),
        ("distance:3", "distance"),
    ] {
        let found = recovery(link, model, 8, 120);
        assert_eq!((found.right, found.covered), (8, 8), "{link}: {found:?}");
        assert!(model != "distance" || found.worst < 0.02, "{link}: {found:?}");
        assert!(model != "markov" || found.parameters[0] >= 5, "{link}: {found:?}");
    }
}

/// Two-sample chi-square of burst lengths.
fn bursts(a: &LinkStatistics, b: &LinkStatistics) -> ChiSquare {
    let (mut a, mut b) = (a.total().bursts, b.total().bursts);
    let longest = a.len().max(b.len());
    a.resize(longest, 0);
    b.resize(longest, 0);
    homogeneity(&[&a, &b]).unwrap()
}

fn simulated(link: &Spec, episodes: u64, seed: u64) -> LinkStatistics {
    let scenario = scenario::build(&Spec::new("simple_spread")).unwrap();
    let link = build_link(link, &*scenario).unwrap();
    let policy = build_policy(&Spec::new("random"), &*scenario).unwrap();
    let recording = Recording { scenario: &*scenario, link: &*link, policy: &*policy, seed, episodes };
    let mut counted = LinkStatistics::new(&recording.layout());
    (0..episodes).for_each(|e| counted.add(&recording.episode(e)));
    counted
}

fn counted(store: &Path) -> LinkStatistics {
    let mut source = storage::open(store).unwrap();
    let mut counted = LinkStatistics::new(&source.manifest().layout());
    while let Some(episode) = source.next_episode().unwrap() {
        counted.add(&episode);
    }
    counted
}

fn link_of(fit: &Fit) -> Spec {
    serde_json::from_value(Value::Object(fit.link.clone())).unwrap()
}

/// p-values of burst lengths, one pair per fresh trace: its fit re-simulated, against the trace, and against the true link
/// simulated anew.
fn resimulated(link: &str, episodes: u64, traces: u64) -> Vec<[f64; 2]> {
    let dir = tempfile::tempdir().unwrap();
    let truth = Spec::parse("link", LINKS, link).unwrap();
    let pair = |seed: u64| {
        let path = store(dir.path(), &seed.to_string(), link, episodes, seed);
        let again = simulated(&link_of(&fitted(&path, "markov", seed).1), episodes, 500 + seed);
        let anew = simulated(&truth, episodes, 9000 + seed);
        [bursts(&counted(&path), &again).p_value, bursts(&anew, &again).p_value]
    };
    (0..traces).map(pair).collect()
}

#[test]
fn a_fitted_trace_re_simulated_has_the_same_bursts() {
    let p = resimulated("markov:heavy", 300, 10);
    // against the truth the fit's own sampling error comes on top of that of the two samples
    assert!(p.iter().all(|&[trace, truth]| trace > 0.01 && truth > 1e-4), "{p:?}");
    // and the test would see another link
    let other = simulated(&Spec::new("markov").with("level", "medium"), 300, 1);
    let heavy = simulated(&Spec::new("markov").with("level", "heavy"), 300, 1);
    assert!(bursts(&other, &heavy).p_value < 1e-6);
}

/// Largest difference of two loss curves over distance, where both have at least `least` messages.
fn curves_apart(a: &LinkStatistics, b: &LinkStatistics, least: u64) -> f64 {
    let (a, b) = (a.total().distances, b.total().distances);
    let rate = |[all, lost]: [u64; 2]| lost as f64 / all as f64;
    let both = a.iter().zip(&b).filter(|(a, b)| a[0].min(b[0]) >= least);
    both.map(|(&a, &b)| (rate(a) - rate(b)).abs()).fold(0.0, f64::max)
}

#[test]
fn a_classifier_does_what_its_data_did() {
    let dir = tempfile::tempdir().unwrap();
    let path = store(dir.path(), "range", "distance:3", 400, 1);
    let (_, fit) = fitted(&path, "learned", 1);
    let held = &fit.held_out;
    let balanced = held.balanced_accuracy.unwrap().value;
    assert!(balanced >= 0.99 && held.calibration_error.value <= 0.02, "{held:?}");
    // as a prior, on worlds that it has not seen, through its file
    let file = dir.path().join("link.json");
    write_atomic(&file, fit.to_json().unwrap().as_bytes()).unwrap();
    let link = Spec::new("file").with("path", file.to_str().unwrap());
    let truth = Spec::new("distance").with("threshold", 3);
    let apart = curves_apart(&simulated(&link, 200, 9), &simulated(&truth, 200, 9), 50);
    assert!(apart < 0.03, "loss against distance differs by {apart}");
    // the file says what it was fitted on
    let text: Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    let manifest = storage::open(&path).unwrap().manifest().clone();
    assert_eq!(text["fit"]["data"]["sha256"], manifest.content);
    assert_eq!(text["fit"]["data"]["state_fields"], serde_json::to_value(&manifest.state_fields).unwrap());
    assert_eq!(
        (&text["kind"], &text["ccmarl"]),
        (&Value::from("ccmarl link"), &Value::from(env!("CARGO_PKG_VERSION")))
    );
    // and is refused where agents have other states
    let other = scenario::build(&Spec::new("simple_reference")).unwrap();
    let error = build_link(&link, &*other).err().unwrap().to_string();
    assert!(
        error.contains("it was fitted on agents with the state x y vx vy, the scenario's have x y vx vy c0 c1"),
        "{error}"
    );
}

#[test]
fn auto_takes_a_classifier_where_the_state_decides_softly() {
    let dir = tempfile::tempdir().unwrap();
    let path = store(dir.path(), "soft", &classifier().to_string(), 300, 3);
    let (observations, fit) = fitted(&path, "auto", 1);
    let scored = fit.compared.iter().filter(|c| matches!(c.outcome, FitOutcome::Scored { .. })).count();
    assert_eq!((fit.model, scored), ("learned", 4), "{:?}", fit.compared);
    assert!(fit.held_out.calibration_error.value < 0.02, "{:?}", fit.held_out);
    let range = ccmarl::channel::fit(&observations, "distance", 1, &|_, _| ()).unwrap();
    assert!(range.notes.iter().any(|note| note.contains("contradict every threshold")), "{:?}", range.notes);
    assert!(
        range.parameters[0].low < range.parameters[0].value && range.parameters[0].value < range.parameters[0].high
    );
    let chain = ccmarl::channel::fit(
        &Observations::read(&store(dir.path(), "even", "dropout:0.3", 50, 1)).unwrap(),
        "markov",
        1,
        &|_, _| (),
    );
    let error = chain.unwrap_err().to_string();
    assert!(
        error.starts_with("no burst chain is earned: on held-out episodes it predicts ")
            && error.contains("fit dropout instead"),
        "{error}"
    );
    let bursts = fitted(&store(dir.path(), "bursts", "markov:heavy", 100, 1), "dropout", 1).1;
    assert!(bursts.notes.iter().any(|note| note.starts_with("losses come in bursts")), "{:?}", bursts.notes);
}

#[test]
fn fits_are_the_same_twice_and_tables_of_bits_do_as_well() {
    let dir = tempfile::tempdir().unwrap();
    let path = store(dir.path(), "store", "markov:heavy", 60, 4);
    let (_, first) = fitted(&path, "auto", 1);
    assert_eq!(first, fitted(&path, "auto", 1).1);
    // the same bits as a table, without the states: the last row of an episode included
    let mut rows = "episode,step,sender,receiver,delivered\n".to_owned();
    let mut source = storage::open(&path).unwrap();
    while let Some(episode) = source.next_episode().unwrap() {
        for (row, (s, r)) in (0..episode.rows()).flat_map(|row| (0..9).map(move |c| (row, (c / 3, c % 3)))) {
            if s != r {
                let bit = episode.delivered(3, row, s, r);
                writeln!(rows, "{},{row},agent_{s},agent_{r},{bit}", episode.index).unwrap();
            }
        }
    }
    let table = dir.path().join("bits.csv");
    write_atomic(&table, rows.as_bytes()).unwrap();
    let (_, other) = fitted(&table, "auto", 1);
    assert_eq!((other.link, other.parameters), (first.link, first.parameters));
    let refused = other.compared.iter().filter(
        |c| matches!(&c.outcome, FitOutcome::Refused { reason } if reason.contains("a table of link bits has none")),
    );
    assert_eq!(refused.count(), 2, "distance and learned need positions");
}

#[test]
fn a_link_that_loses_its_first_message_and_links_that_differ_are_noticed() {
    let dir = tempfile::tempdir().unwrap();
    let start = r#"{"name":"markov","matrix":[[0.9,0.1],[0.4,0.6]],"start":[0.7,0.3]}"#;
    let (_, fit) = fitted(&store(dir.path(), "start", start, 300, 5), "auto", 1);
    assert_eq!(fit.model, "markov");
    let first = fit.parameters.iter().find(|p| p.name.contains("first message")).unwrap();
    assert!(first.low < 0.7 && 0.7 < first.high && first.high - first.low < 0.12, "{first:?}");
    let start: Vec<f64> = serde_json::from_value(fit.link["start"].clone()).unwrap();
    assert!((start[1] - 0.3).abs() < 0.06, "{start:?}");
    assert!(fit.notes.iter().any(|note| note.contains("may start within a burst")), "{:?}", fit.notes);

    let mut rows = "episode,step,sender,receiver,delivered\n".to_owned();
    for (episode, step) in (0..40).flat_map(|e| (0..25).map(move |t| (e, t))) {
        let hash = (episode * 31 + step * 17) % 10;
        writeln!(rows, "{episode},{step},0,1,{}\n{episode},{step},1,0,{}", u8::from(hash > 4), u8::from(hash > 0))
            .unwrap();
    }
    let table = dir.path().join("differ.csv");
    write_atomic(&table, rows.as_bytes()).unwrap();
    let (_, fit) = fitted(&table, "dropout", 1);
    assert!(fit.notes.iter().any(|note| note.starts_with("the links differ (chi-square p = ")), "{:?}", fit.notes);
}

/// The table of recovery of reports/channels.
#[test]
#[ignore = "ten minutes: makes a table of reports/channels"]
fn report_of_recovery() {
    let mut out = "link,episodes,stores,auto_right,intervals_cover,largest_relative_error,parameters\n".to_owned();
    for episodes in [200, 1000] {
        for (link, model) in [
            ("dropout:0.05", "dropout"),
            ("dropout:0.2", "dropout"),
            ("dropout:0.5", "dropout"),
            ("markov:medium", "markov"),
            ("markov:heavy", "markov"),
            ("distance:1", "distance"),
            ("distance:3", "distance"),
            ("distance:5", "distance"),
        ] {
            let found = recovery(link, model, 100, episodes);
            let Recovery { stores, right, covered, worst, parameters: [fewest, most] } = found;
            writeln!(out, "{link},{episodes},{stores},{right},{covered},{worst:.5},{fewest}-{most}").unwrap();
            println!("{}", out.lines().last().unwrap());
        }
    }
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("reports/channels");
    std::fs::create_dir_all(&dir).unwrap();
    write_atomic(&dir.join("recovery.csv"), out.as_bytes()).unwrap();
}

/// The table of bursts of reports/channels.
#[test]
#[ignore = "a minute: makes a table of reports/channels"]
fn report_of_bursts() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("reports/channels");
    std::fs::create_dir_all(&dir).unwrap();
    let mut out = "link,episodes,traces,against,p_above_0.01,smallest_p\n".to_owned();
    for link in ["markov:medium", "markov:heavy"] {
        let p = resimulated(link, 1000, 100);
        for (against, place) in [("the trace", 0), ("the truth anew", 1)] {
            let above = p.iter().filter(|p| p[place] > 0.01).count();
            let smallest = p.iter().map(|p| p[place]).fold(1.0, f64::min);
            writeln!(out, "{link},1000,{},{against},{above},{smallest:.4}", p.len()).unwrap();
            println!("{}", out.lines().last().unwrap());
        }
    }
    write_atomic(&dir.join("bursts.csv"), out.as_bytes()).unwrap();
}

/// The table of classifiers and the figures of reports/channels.
#[test]
#[ignore = "a minute: makes a table and the figures of reports/channels"]
fn report_of_classifiers() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("reports/channels");
    std::fs::create_dir_all(&dir).unwrap();
    let temporary = tempfile::tempdir().unwrap();
    let mut out = "link,episodes,seed,lost,balanced_accuracy,calibration_error,curves_apart\n".to_owned();
    for (link, seed) in ["distance:3", "distance:5"].iter().flat_map(|link| (0..10).map(move |seed| (*link, seed))) {
        let path = store(temporary.path(), &format!("{link}-{seed}"), link, 1000, seed);
        let (_, fit) = fitted(&path, "learned", seed);
        let truth = Spec::parse("link", LINKS, link).unwrap();
        let apart = curves_apart(&simulated(&link_of(&fit), 1000, 99), &simulated(&truth, 1000, 99), 50);
        let (held, lost) = (&fit.held_out, fit.lost as f64 / fit.messages as f64);
        let [balanced, calibration] = [held.balanced_accuracy.unwrap().value, held.calibration_error.value];
        writeln!(out, "{link},1000,{seed},{lost:.4},{balanced:.4},{calibration:.4},{apart:.4}").unwrap();
        println!("{}", out.lines().last().unwrap());
        if link == "distance:3" && seed == 0 {
            draw(&dir.join("learned-reliability.svg"), "reliability", &fit.reliability());
        }
    }
    write_atomic(&dir.join("learned.csv"), out.as_bytes()).unwrap();

    let heavy = simulated(&Spec::new("markov").with("level", "heavy"), 1000, 1);
    let title = "markov:heavy on simple_spread, 1000 episodes";
    draw(&dir.join("heavy-loss-by-step.svg"), "loss-by-step", &heavy.figures(title, "share of lost messages"));
    draw(&dir.join("heavy-burst-lengths.svg"), "burst-lengths", &heavy.figures(title, "share of bursts"));
    let range = simulated(&Spec::new("distance").with("threshold", 3), 1000, 1);
    let data = range.figures("distance:3 on simple_spread, 1000 episodes", "share of lost messages");
    draw(&dir.join("range-loss-by-distance.svg"), "loss-by-distance", &data);
}

fn draw(path: &Path, name: &str, data: &ccmarl::figure::Data) {
    let entry = ccmarl::registry::find("figure", ccmarl::figure::FIGURES, name).unwrap();
    write_atomic(path, ccmarl::figure::svg(entry, data).unwrap().as_bytes()).unwrap();
}
