//! What the shaping does to what it shapes: held-out JSD with and without α, held-out CLUB with and without β, over five
//! seeds. An experiment, not a test: minutes. `reports/shaping` holds what it wrote.
//!
//! `cargo test --release --test it -- --ignored shaping::`

use std::fmt::Write as _;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use ccmarl::io::write_atomic;
use ccmarl::registry::Spec;
use ccmarl::stats::{mean, t_interval};
use ccmarl::train::{METRIC_COLUMNS, Options, TrainConfig, Trainer, train};
use rayon::prelude::*;

const SEEDS: u64 = 5;
const STEPS: u64 = 200_000;

/// α and β of each arm. Both estimators run in every arm, since one weight is always positive.
const ARMS: [[f64; 2]; 6] = [[0.0, 0.01], [0.01, 0.01], [10.0, 0.01], [0.01, 0.0], [0.01, 1.0], [0.01, 10.0]];

/// Which arm is compared with which, in which column.
const CONTRASTS: [(usize, usize, &str); 5] = [
    (1, 0, "jsd_heldout"),
    (2, 0, "jsd_heldout"),
    (1, 3, "club_heldout"),
    (4, 3, "club_heldout"),
    (5, 3, "club_heldout"),
];

const COLUMNS: [&str; 3] = ["jsd_heldout", "club_heldout", "return_mean"];

/// Means over the last 30 % of the run, in the order of [`COLUMNS`].
fn run([alpha, beta]: [f64; 2], seed: u64) -> [f64; 3] {
    let dir = tempfile::tempdir().unwrap();
    let mut config = TrainConfig::new(Spec::new("simple_spread"), "cc-maddpg");
    (config.seed, config.steps, config.log_every) = (seed, STEPS, 20);
    (config.dumie.alpha, config.dumie.beta) = (Some(alpha), Some(beta));
    // ten times the paper's rates and a quarter of its batch: a run of a twentieth of its length that has learned
    (config.maddpg.batch, config.dumie.batch) = (Some(256), 256);
    (config.maddpg.actor_learning_rate, config.dumie.learning_rate) = (1e-3, 1e-3);
    config.noise.episodes = 2000;
    let path = dir.path().join("run");
    train(config.clone(), &path, &Options::default(), &mut |_| {}, &AtomicBool::new(false)).unwrap();
    let mut trainer = Trainer::new(config.resolve().unwrap(), &path).unwrap();
    trainer.resume().unwrap();
    let rows = trainer.metrics();
    COLUMNS.map(|name| {
        let column = METRIC_COLUMNS.iter().position(|(n, _)| *n == name).unwrap();
        let late: Vec<f64> = rows[rows.len() * 7 / 10..].iter().filter_map(|row| row.values[column]).collect();
        mean(&late)
    })
}

#[test]
#[ignore = "an experiment of minutes, whose result is committed"]
fn held_out_values_with_and_without_their_weight() {
    let cells: Vec<(usize, u64)> = (0..ARMS.len()).flat_map(|arm| (1..=SEEDS).map(move |seed| (arm, seed))).collect();
    let found: Vec<[f64; 3]> = cells.par_iter().map(|&(arm, seed)| run(ARMS[arm], seed)).collect();
    let mut runs = format!("alpha,beta,seed,{}\n", COLUMNS.join(","));
    for (&(arm, seed), [jsd, club, earned]) in cells.iter().zip(&found) {
        writeln!(runs, "{},{},{seed},{jsd:.5},{club:.5},{earned:.2}", ARMS[arm][0], ARMS[arm][1]).unwrap();
    }
    let mut contrasts = "column,alpha,beta,against_alpha,against_beta,mean_difference,low_95,high_95\n".to_owned();
    for (arm, other, name) in CONTRASTS {
        let column = COLUMNS.iter().position(|c| *c == name).unwrap();
        let values = |arm: usize| found.iter().skip(arm * SEEDS as usize).take(SEEDS as usize).map(move |v| v[column]);
        let differences: Vec<f64> = values(arm).zip(values(other)).map(|(a, b)| a - b).collect();
        let interval = t_interval(&differences, 0.95).unwrap();
        let ([a, b], [c, d], middle) = (ARMS[arm], ARMS[other], mean(&differences));
        writeln!(contrasts, "{name},{a},{b},{c},{d},{middle:.5},{:.5},{:.5}", interval.low, interval.high).unwrap();
    }
    println!("{runs}\n{contrasts}");
    let out = Path::new(env!("CARGO_MANIFEST_DIR")).join("reports/shaping");
    write_atomic(&out.join("runs.csv"), runs.as_bytes()).unwrap();
    write_atomic(&out.join("contrasts.csv"), contrasts.as_bytes()).unwrap();
}
