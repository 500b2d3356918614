//! Estimators on data of known information, through the library.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use ccmarl::mi::{Check, ESTIMATORS, Estimate, Kind, NORMALS, Plan, Protocol, SERIES, calibrate, calibrated, run};
use ccmarl::registry::{Spec, find};
use ccmarl::rng::{Seeds, normal, uniform};
use ccmarl::schema::{Columns, Exchange, SampleLabels, Samples};

/// Probe-like episodes of 25 steps: m ~ N(0,1), a = (ρ m + √(1−ρ²) ε, noise).
fn probe(rho: f64, episodes: usize, seed: u64) -> Samples {
    let mut rng = Seeds::new(seed).stream("probe");
    let (mut x, mut y) = (Vec::new(), Vec::new());
    let n = episodes * 25;
    for _ in 0..n {
        let m = normal(&mut rng);
        x.push(m);
        y.extend([rho * m + (1.0 - rho * rho).sqrt() * normal(&mut rng), normal(&mut rng)]);
    }
    let columns =
        |data: Vec<f64>, names: &[&str]| Arc::new(Columns::new(data, names.iter().map(|&n| n.to_owned()).collect()));
    Samples {
        x: columns(x, &["m"]),
        y: columns(y, &["a0", "a1"]),
        z: None,
        starts: (0..=episodes).map(|e| e * 25).collect::<Vec<_>>().into(),
        rows: (0..n as u32).collect(),
        exchange: Exchange::Episodes,
        labels: SampleLabels {
            x: "m".to_owned(),
            y: "a".to_owned(),
            group: "episode".to_owned(),
            ..Default::default()
        },
        notes: Vec::new(),
    }
}

fn plan(names: &[&str], permutations: usize, seed: u64) -> Plan {
    let build = |name: &&str| {
        let spec = Spec::parse("estimator", ESTIMATORS, name).unwrap();
        let entry = find("estimator", ESTIMATORS, &spec.name).unwrap();
        ((*name).to_owned(), (entry.build)(&spec).unwrap())
    };
    Plan { estimators: names.iter().map(build).collect(), protocol: Protocol { permutations }, seed }
}

fn rows(sets: &[Samples], plan: &Plan) -> Vec<Estimate> {
    run(sets, plan, &|| ()).into_iter().flat_map(|r| r.rows.unwrap()).collect()
}

fn mean(rows: &[Estimate], name: &str) -> f64 {
    let values: Vec<f64> = rows.iter().filter(|r| r.estimator == name).map(|r| r.value).collect();
    values.iter().sum::<f64>() / values.len() as f64
}

#[test]
fn the_probe_is_recovered_on_ten_seeds_with_3000_held_out_samples() {
    let sets: Vec<Samples> = (0..10).map(|seed| probe(0.75, 420, seed)).collect();
    let rows = rows(&sets, &plan(&["gaussian", "jsd", "club"], 0, 1));
    assert!(rows.iter().all(|r| r.n >= 3000), "{}", rows[1].n);
    for name in ["gaussian", "jsd-plugin"] {
        let found = mean(&rows, name);
        assert!((found / 0.4133 - 1.0).abs() < 0.1, "{name}: {found}");
    }
    // exact values: 2·JSD, and ρ²/(1 − ρ²)
    assert!((mean(&rows, "jsd") - 0.2158).abs() < 0.02, "{}", mean(&rows, "jsd"));
    assert!((mean(&rows, "club") - 1.2857).abs() < 0.15, "{}", mean(&rows, "club"));
    for name in ["jsd-nwj", "jsd-dv", "jsd-certified"] {
        let found = mean(&rows, name);
        assert!(found < 0.4133 + 0.01 && found > 0.2, "{name}: {found}");
    }
    assert!(mean(&rows, "club-l1out") > 0.38 && mean(&rows, "club-fit") > 0.3);
}

/// All that train: with the separable critic, and with the concatenated one.
const TRAINED: [&str; 8] = ["jsd", "club", "infonce", "nwj", "mine", "smile", "l1out", "club-sample"];
const CONCATENATED: [&str; 4] = ["infonce:concatenated", "nwj:concatenated", "mine:concatenated", "smile:concatenated"];

#[test]
fn every_neural_bound_finds_the_probe() {
    let sets: Vec<Samples> = (0..2).map(|seed| probe(0.75, 420, 20 + seed)).collect();
    let names = [&TRAINED[2..], &CONCATENATED].concat();
    let rows = rows(&sets, &plan(&names, 19, 1));
    // two means of 3150 held-out samples scatter by 0.01; a fitted critic is a little under the truth of 0.4133
    for name in ["infonce", "nwj", "mine", "smile", "l1out"].iter().chain(&CONCATENATED) {
        let found = mean(&rows, name);
        assert!((0.36..0.45).contains(&found), "{name}: {found}");
    }
    assert!((mean(&rows, "club-sample") - 1.2857).abs() < 0.25, "{}", mean(&rows, "club-sample"));
    for row in &rows {
        assert_eq!(row.p_value, Some(0.05), "{}", row.estimator);
        let (low, high) = (row.interval_low.unwrap(), row.interval_high.unwrap());
        assert!(low < row.value && row.value < high && high - low < 0.4, "{row:?}");
    }
}

#[test]
fn independent_wide_data_give_no_neural_bound_anything() {
    let mut samples = probe(0.0, 40, 7);
    let mut rng = Seeds::new(8).stream("wide");
    let mut wide = |name: &str| {
        let names = (0..10).map(|i| format!("{name}{i}")).collect();
        Arc::new(Columns::new((0..10_000).map(|_| normal(&mut rng)).collect(), names))
    };
    (samples.x, samples.y) = (wide("x"), wide("y"));
    for row in rows(&[samples], &plan(&[&TRAINED[..], &CONCATENATED].concat(), 39, 1)) {
        assert!(row.value <= 0.02, "{}: {}", row.estimator, row.value);
        // an upper bound of about nothing is no proof of independence, and must not read as one
        let warned = row.warnings.iter().any(|w| w.starts_with("q ") || w.starts_with("poor q"));
        assert!(warned || row.kind != Kind::UpperBound, "{row:?}");
        assert!(row.p_value.unwrap() > 0.02, "{}: {:?}", row.estimator, row.p_value);
    }
}

#[test]
fn tails_without_variance_leave_every_bound_sane() {
    // Student's t with one degree of freedom: 0.224 nats
    let task = ccmarl::mi::TASKS.iter().find(|t| t.id == "student-identity-1-1-1").unwrap();
    let samples = task.samples(3000, &mut Seeds::new(1).stream("tails"));
    // smile is no bound: clipping lets it exceed the truth
    let names = [&["infonce", "nwj", "mine"], &CONCATENATED[..3]].concat();
    // raw columns without variance are a bad start, and these bounds may be loose; they were once at −1e18
    for result in run(&[samples], &plan(&names, 0, 1), &|| ()) {
        for row in result.rows.unwrap_or_default() {
            assert!((-1e3..0.4).contains(&row.value), "{}: {}", row.estimator, row.value);
        }
    }
}

#[test]
fn independent_data_give_zero() {
    let sets: Vec<Samples> = (0..4).map(|seed| probe(0.0, 420, 50 + seed)).collect();
    let rows = rows(&sets, &plan(&["gaussian", "jsd", "club"], 0, 1));
    for row in rows {
        assert!(row.value.abs() < 0.02, "{}: {}", row.estimator, row.value);
    }
}

#[test]
fn p_values_separate_dependence_from_independence_and_reject_no_more_than_they_should() {
    let dependent = rows(&[probe(0.3, 100, 1)], &plan(&["gaussian", "jsd", "club"], 99, 1));
    assert!(dependent.iter().all(|r| r.p_value.unwrap() <= 0.05), "{dependent:?}");
    let sets: Vec<Samples> = (0..40).map(|seed| probe(0.0, 20, 100 + seed)).collect();
    let p: Vec<f64> = rows(&sets, &plan(&["gaussian"], 19, 1)).into_iter().map(|r| r.p_value.unwrap()).collect();
    // 40 draws at 5 %: 7 or more have probability 0.003
    assert!(p.iter().filter(|&&p| p <= 0.05).count() < 7, "{p:?}");
}

#[test]
fn a_trend_that_all_episodes_share_is_no_dependence_for_the_permutation() {
    // x and y both follow the step, and share nothing else: the value is large, the p-value is not small
    let mut samples = probe(0.0, 60, 3);
    let trend = |columns: &Columns| {
        let width = columns.width();
        let data = columns.data.iter().enumerate().map(|(i, v)| v + (i / width % 25) as f64).collect();
        Arc::new(Columns::new(data, columns.names.clone()))
    };
    samples.x = trend(&samples.x);
    samples.y = trend(&samples.y);
    let found = rows(&[samples], &plan(&["gaussian"], 99, 1));
    assert!(found[0].value > 1.0 && found[0].p_value.unwrap() > 0.02, "{found:?}");
}

#[test]
fn every_estimator_states_its_words_and_refuses_parameters_it_does_not_have() {
    for entry in ESTIMATORS {
        assert!(!entry.summary.is_empty() && !entry.reference.is_empty());
        let error = (entry.build)(&Spec::new(entry.name).with("wrong", 1)).err().unwrap().to_string();
        assert!(error.starts_with(entry.name) && error.contains("wrong"), "{error}");
    }
}

#[test]
fn too_few_episodes_and_constant_columns_are_errors_of_every_trained_estimator() {
    let few = probe(0.5, 9, 1);
    let mut constant = probe(0.5, 20, 1);
    constant.x = Arc::new(Columns::new(vec![2.5; 500], vec!["m".to_owned()]));
    for result in run(&[few, constant], &plan(&[&TRAINED[..], &CONCATENATED].concat(), 0, 1), &|| ()) {
        let error = result.rows.unwrap_err().to_string();
        let expected = ["needs at least 10 episodes to split by episode", "m is constant, so it can tell nothing"];
        assert!(expected.iter().any(|e| error.starts_with(e)), "{error}");
    }
}

#[test]
#[ignore = "minutes: coverage of intervals over 1000 replicates, and false positives and power on autocorrelated series"]
fn coverage_and_false_positives_in_figures() {
    let report = |checks: &[Check], names: &[&str], permutations: usize, draws: u64| {
        let told = std::sync::Mutex::new(Vec::new());
        let plan = plan(names, permutations, 1);
        calibrate(checks, &plan, 0, draws, &AtomicBool::new(false), &|draw| told.lock().unwrap().push(draw));
        for row in calibrated(checks, told.into_inner().unwrap()) {
            let share = |share: Option<f64>| share.map_or("-".to_owned(), |s| format!("{:.1} %", 100.0 * s));
            let (covers, small) = (share(row.covered), share(row.rejected));
            println!("{:18} {:14} mean {:7.4} covers {covers:8} p <= 0.05 {small}", row.task, row.estimator, row.mean);
        }
    };
    report(&NORMALS, &["gaussian", "gcmi", "ksg1", "ksg2", "ksg-mixed"], 0, 1000);
    report(&SERIES, &["gaussian", "ksg1"], 39, 200);
}

/// n pairs of categories drawn from a table of probabilities.
fn drawn(table: &[Vec<f64>], n: usize, seed: u64) -> Samples {
    let (mut rng, total) = (Seeds::new(seed).stream("table"), table.iter().flatten().sum::<f64>());
    let (mut x, mut y) = (Vec::new(), Vec::new());
    for _ in 0..n {
        let mut left = uniform(&mut rng, 0.0, total);
        let cells = table.iter().enumerate().flat_map(|(a, row)| row.iter().enumerate().map(move |(b, p)| (a, b, p)));
        let (mut a, mut b) = (0, 0);
        for (row, column, p) in cells.filter(|(_, _, p)| **p > 0.0) {
            (a, b) = (row, column);
            left -= p;
            if left < 0.0 {
                break;
            }
        }
        x.push(a as f64);
        y.push(b as f64);
    }
    let columns = |data: Vec<f64>, name: &str| Arc::new(Columns::new(data, vec![name.to_owned()]));
    let mut samples = probe(0.0, 1, 0);
    (samples.x, samples.y) = (columns(x, "x"), columns(y, "y"));
    samples.starts = (0..=n).collect::<Vec<_>>().into();
    samples.rows = (0..n as u32).collect();
    samples
}

/// Tables with their names: channels with few and many errors, copies, functions, nothing in common; even and skewed.
fn tables() -> Vec<(&'static str, Vec<Vec<f64>>)> {
    let square = |k: usize, of: &dyn Fn(usize, usize) -> f64| -> Vec<Vec<f64>> {
        (0..k).map(|a| (0..k).map(|b| of(a, b)).collect()).collect()
    };
    let channel = |flip: f64| square(2, &|a, b| if a == b { 1.0 - flip } else { flip });
    let copy = |shares: &'static [f64]| square(shares.len(), &|a, b| if a == b { shares[a] } else { 0.0 });
    let skewed = [8.0, 4.0, 2.0, 1.0];
    vec![
        ("flips 2 %", channel(0.02)),
        ("flips 10 %", channel(0.1)),
        ("flips 30 %", channel(0.3)),
        ("two coins", channel(0.5)),
        ("copied coin", copy(&[1.0, 1.0])),
        ("copied 9:1", copy(&[9.0, 1.0])),
        ("copied die", copy(&[6.0, 5.0, 4.0, 3.0, 2.0, 1.0])),
        ("die, parity", (0..6).map(|a| vec![f64::from(a % 2), f64::from(1 - a % 2)]).collect()),
        ("3x3 nothing", square(3, &|_, _| 1.0)),
        ("5x5 nothing", square(5, &|_, _| 1.0)),
        ("4x4 skewed nothing", square(4, &|a, b| skewed[a] * skewed[b])),
        ("4x4 noisy", square(4, &|a, b| if a == b { 4.5 } else { 0.5 })),
        ("10x10 noisy", square(10, &|a, b| if a == b { 6.0 } else { 1.0 })),
    ]
}

fn information(table: &[Vec<f64>]) -> f64 {
    let total: f64 = table.iter().flatten().sum();
    let row = |a: usize| table[a].iter().sum::<f64>();
    let column = |b: usize| table.iter().map(|row| row[b]).sum::<f64>();
    let cells = (0..table.len()).flat_map(|a| (0..table[a].len()).map(move |b| (a, b)));
    let term = |(a, b): (usize, usize)| {
        let p = table[a][b];
        if p > 0.0 { p / total * (p * total / (row(a) * column(b))).ln() } else { 0.0 }
    };
    cells.map(term).sum()
}

/// Shares of intervals of `discrete` and of `discrete-mm` that hold the truth, their mean width, mean of `discrete-mm`, and
/// how many draws gave none.
fn coverage(table: &[Vec<f64>], n: usize, draws: u64) -> ([f64; 2], f64, f64, usize) {
    let truth = information(table);
    let sets: Vec<Samples> = (0..draws).map(|seed| drawn(table, n, seed)).collect();
    let results = run(&sets, &plan(&["discrete"], 39, 1), &|| ());
    let (mut holding, mut width, mut mean, mut with) = ([0.0; 2], 0.0, 0.0, 0.0);
    for rows in results.into_iter().filter_map(|r| r.rows.ok()) {
        mean += rows[1].value / draws as f64;
        for (row, holding) in rows.iter().zip(&mut holding) {
            if let Some((low, high)) = row.interval_low.zip(row.interval_high) {
                assert!(low <= row.value && row.value <= high && high > low, "{row:?}");
                *holding += f64::from(u8::from(low - 1e-9 <= truth && truth <= high + 1e-9));
                (width, with) = (width + 0.5 * (high - low), with + 0.5);
            }
        }
    }
    (holding.map(|h| h / with), width / with, mean, draws as usize - with as usize)
}

#[test]
fn intervals_of_categories_hold_the_truth_of_channels_copies_and_nothing() {
    for (name, table) in tables() {
        let (holding, _, _, without) = coverage(&table, 150, 60);
        // 95 % of 60 is 57; 50 or fewer has probability 0.001
        let enough = holding.iter().all(|h| *h > 0.84);
        assert!(enough || without > 30, "{name}: {holding:?}, {without} without an interval");
        assert_eq!(without > 30, name == "10x10 noisy", "{name}: {without}");
    }
}

#[test]
#[ignore = "a minute: coverage of the intervals of categories over 1000 replicates"]
fn coverage_of_categories_in_figures() {
    for n in [50, 100, 300, 1000] {
        for (name, table) in tables() {
            let ([plug_in, corrected], width, mean, without) = coverage(&table, n, 1000);
            let truth = information(&table);
            println!(
                "n {n:4} {name:18} truth {truth:.4} discrete-mm {mean:.4} covers {:5.1} % (discrete {:5.1} %) width {width:.3}, \
                 none in {without} of 1000",
                100.0 * corrected,
                100.0 * plug_in
            );
        }
    }
}
