//! Stores of the policy `probe:ρ` in a two-agent world, from end to end: −½ ln(1 − ρ²) nats where the message arrived, nothing
//! where it was lost, whatever the link and the estimator.

use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

use ccmarl::link::LINKS;
use ccmarl::mi::ESTIMATORS;
use serde_json::Value;

use crate::links::{example, files};

/// Records over a link, and the rows of these estimators.
fn rows(link: &str, rho: f64, episodes: usize, estimators: &str) -> Vec<Value> {
    let dir = tempfile::tempdir().unwrap();
    let store = dir.path().join("probe");
    let (store, episodes, policy) = (store.to_str().unwrap(), episodes.to_string(), format!("probe:{rho}"));
    let run = |args: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_ccmarl")).args(args).output().unwrap();
        assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
        output.stdout
    };
    let world = ["record", "--scenario", "simple_spread", "--agents", "2", "--seed", "1", "--out", store];
    run(&[&world[..], &["--policy", &policy, "--link", link, "--episodes", &episodes]].concat());
    let estimate = ["estimate-mi", store, "--permutations", "0", "--format", "json", "--estimator", estimators];
    serde_json::from_slice(&run(&estimate)).unwrap()
}

/// Whether a row is what theory says of its kind; `None` of values that are no information, or not of such data.
fn holds(row: &Value, truth: f64) -> Option<bool> {
    let (name, value) = (row["estimator"].as_str()?, row["value"].as_f64()?);
    let slack = 0.05 + 0.1 * truth;
    match row["kind"].as_str()? {
        // numbers with a continuous law are all different: ln n, as its warning says
        _ if name.starts_with("discrete") => None,
        _ if row["unit"] == "jsd" => (truth == 0.0).then_some(value.abs() < slack),
        "lower bound" => Some(value < truth + slack && value > if truth > 0.0 { 0.0 } else { -slack }),
        "upper bound" => Some(value > truth - slack),
        _ => Some((value - truth).abs() < slack),
    }
}

fn truth(row: &Value, rho: f64) -> f64 {
    if row["delivered"] == true { -0.5 * (1.0 - rho * rho).ln() } else { 0.0 }
}

#[test]
fn messages_that_arrive_tell_what_the_probe_says_and_lost_ones_nothing() {
    let rows = rows("dropout:0.4", 0.75, 160, "gaussian,ksg,infonce,club");
    let (mut seen, mut classes) = (0, std::collections::BTreeSet::new());
    for row in &rows {
        if let Some(right) = holds(row, truth(row, 0.75)) {
            assert!(right, "{row}");
            seen += 1;
        }
        classes.insert((row["sender"].as_str().unwrap(), row["delivered"].as_bool().unwrap()));
    }
    // two directions, delivered and lost; club has three rows
    assert_eq!((classes.len(), seen), (4, 24));
}

#[test]
#[ignore = "minutes: every link, four strengths, every estimator; writes reports/calibration/probe.csv"]
fn every_link_and_estimator_in_figures() {
    let dir = files();
    let mut bits = "episode,step,sender,receiver,delivered\n".to_owned();
    for (episode, step, sender) in (0..160).flat_map(|e| (0..26).flat_map(move |t| [(e, t, 0), (e, t, 1)])) {
        let bit = u8::from((7 * episode + 3 * step + 5 * sender) % 4 > 0);
        writeln!(bits, "{episode},{step},agent_{sender},agent_{},{bit}", 1 - sender).unwrap();
    }
    ccmarl::io::write_atomic(&dir.path().join("trace.csv"), bits.as_bytes()).unwrap();
    let names: Vec<&str> = ESTIMATORS.iter().map(|e| e.name).filter(|&name| name != "ksg").collect();
    let keys =
        ["sender", "receiver", "delivered", "estimator", "kind", "unit", "n", "value", "interval_low", "interval_high"];
    let mut out = format!("link,rho,{},truth,holds\n", keys.join(","));
    let (mut kept, mut broken) = (0, Vec::new());
    for entry in LINKS {
        let link = example(entry.name, dir.path());
        let shown = if entry.name == "learned" { "learned".to_owned() } else { link.to_string() };
        let text = if entry.name == "learned" { crate::links::classifier().to_string() } else { link.to_string() };
        for rho in [0.0, 0.3, 0.75, 0.95] {
            for row in rows(&text, rho, 160, &names.join(",")) {
                let truth = truth(&row, rho);
                let right = holds(&row, truth);
                match right {
                    Some(true) => kept += 1,
                    Some(false) => broken.push(format!("{shown} {rho} {row}")),
                    None => {}
                }
                let cells = keys.map(|key| match &row[key] {
                    Value::String(text) => text.clone(),
                    Value::Null => String::new(),
                    other => other.to_string(),
                });
                let right = right.map_or(String::new(), |right| right.to_string());
                let shown = Path::new(&shown).file_name().unwrap().to_str().unwrap().replace(',', " ");
                writeln!(out, "{shown},{rho},{},{truth:.6},{right}", cells.join(",")).unwrap();
            }
        }
    }
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/reports/calibration/probe.csv");
    ccmarl::io::write_atomic(Path::new(path), out.as_bytes()).unwrap();
    println!("{kept} rows hold, {} do not", broken.len());
    for row in &broken {
        println!("{row}");
    }
    assert!(broken.len() * 100 < kept, "{} of {kept}", broken.len());
}
