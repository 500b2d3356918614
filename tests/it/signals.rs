//! SIGINT and SIGTERM: every command on stores ends with exit code 4, and leaves nothing half done.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use super::integrity::names;

fn ccmarl(words: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    command.args(words).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Sends a signal, and waits for the end; exit code (`None` when the signal killed it) and stderr.
fn end(child: Child, signal: &str) -> (Option<i32>, String) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    (output.status.code(), String::from_utf8(output.stderr).unwrap())
}

/// Waits for something that a program does.
fn wait_until(what: &str, done: impl Fn() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < Duration::from_mins(1), "waited in vain for: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn commands_that_only_read_or_write_at_their_end_exit_4_at_once() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    // nobody writes into these pipes, so that reading them takes for ever
    std::fs::create_dir(at("run")).unwrap();
    for pipe in ["x.parquet", "run/config.toml"] {
        assert!(Command::new("mkfifo").arg(at(pipe)).status().unwrap().success());
    }
    let before = names(directory.path());
    for words in [
        vec!["verify", &at("x.parquet")],
        vec!["inspect", &at("x.parquet")],
        vec!["inspect", &at("x.parquet"), "--shard", "0/2", "--out", &at("0.json")],
        vec!["estimate-mi", &at("x.parquet"), "--out", &at("mi.json")],
        vec!["pairs", &at("x.parquet"), "--out", &at("pairs.parquet")],
        vec!["evaluate", &at("run")],
        vec!["report", "--mi", &at("x.parquet"), "--out", &at("page")],
        vec!["fit-link", &at("x.parquet"), "--out", &at("link.json")],
        vec!["link", "simulate", &format!("file:{}", at("run/config.toml")), "--out", &at("drawn")],
    ] {
        for signal in ["-INT", "-TERM"] {
            let child = ccmarl(&words);
            let state = format!("/proc/{}/status", child.id());
            // the handler has a thread of its own, which is there once it is set
            let ready = || {
                let status = std::fs::read_to_string(&state).unwrap_or_default();
                status.contains("SigCgt:") && status.lines().any(|line| line.starts_with("SigCgt:") && caught(line))
            };
            wait_until("the handler", ready);
            let (code, err) = end(child, signal);
            assert_eq!((code, err.as_str()), (Some(4), "interrupted: nothing was written\n"), "{words:?} {signal}");
            assert_eq!(names(directory.path()), before, "{words:?}");
        }
    }
}

/// Whether SIGINT and SIGTERM have handlers, in a line of /proc/PID/status.
fn caught(line: &str) -> bool {
    let mask = u64::from_str_radix(line.trim_start_matches("SigCgt:").trim(), 16).unwrap();
    [2, 15].iter().all(|signal| mask & 1 << (signal - 1) != 0)
}

#[test]
fn a_conversion_and_a_recovery_clean_up_and_exit_4() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let record = ["record", "--scenario", "simple_tag", "--agents", "6", "--episodes", "12000", "--out", &at("store")];
    assert!(Command::new(env!("CARGO_BIN_EXE_ccmarl")).args(record).output().unwrap().status.success());
    let partial = at(".to.mcap.partial");
    let child = ccmarl(&["convert", &at("store"), &at("to.mcap")]);
    wait_until("the partial", || Path::new(&partial).metadata().is_ok_and(|file| file.len() > 1 << 20));
    assert_eq!(end(child, "-TERM"), (Some(4), "interrupted: nothing was written\n".to_owned()));
    assert_eq!(names(directory.path()), ["store"]);
    // the rest of a conversion that was killed
    let child = ccmarl(&["convert", &at("store"), &at("to.mcap")]);
    wait_until("the partial", || Path::new(&partial).metadata().is_ok_and(|file| file.len() > 20 << 20));
    assert_eq!(end(child, "-KILL").0, None);
    let child = ccmarl(&["recover", &at("to.mcap")]);
    let built = at("..recovered.to.mcap.partial");
    wait_until("the partial", || Path::new(&built).metadata().is_ok_and(|file| file.len() > 0));
    assert_eq!(end(child, "-INT"), (Some(4), "interrupted: all is as it was\n".to_owned()));
    assert_eq!(names(directory.path()), [".to.mcap.partial", "store"]);
}

/// Starts a program whose results are read, and signals it once it has computed for `ticks` hundredths of a second;
/// exit code, stdout and stderr.
fn end_computing(words: &[&str], ticks: u64, signal: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    let child = command.args(words).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let stat = format!("/proc/{}/stat", child.id());
    let user = || {
        let text = std::fs::read_to_string(&stat).unwrap_or_default();
        text.split(' ').nth(13).and_then(|t| t.parse::<u64>().ok()).unwrap_or(u64::MAX)
    };
    wait_until("some computing", || user() >= ticks);
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[test]
fn estimates_that_are_finished_outlive_a_signal() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let line = |of: &dyn Fn(usize) -> String| (0..70).map(of).collect::<Vec<_>>().join(",") + "\n";
    let row = |r: usize| line(&|c: usize| ((r * (c + 7) * 7919 + c * 104_729) % 1009).to_string());
    let text = line(&|c| format!("c{c}")) + &(0..500).map(row).collect::<String>();
    ccmarl::io::write_atomic(at("wide.csv").as_ref(), text.as_bytes()).unwrap();
    let wide = at("wide.csv");
    let out = at("rows.json");
    let words = ["estimate-mi", &wide, "--all-pairs", "--estimator", "ksg", "--format", "json", "--out", &out];
    let (code, shown, err) = end_computing(&words, 100, "-INT");
    assert_eq!(code, Some(4), "{err}");
    let rows: Vec<serde_json::Value> = serde_json::from_str(&shown).unwrap();
    let (done, all) = (rows.len(), 70 * 69 / 2);
    assert!(0 < done && done < all, "{done}");
    let said = format!("interrupted: {done} of {all} estimates are finished, and only these are shown\n");
    assert!(err.starts_with(&said) && err.contains(&format!("wrote {done} rows: ")), "{err}");
    assert_eq!(std::fs::read_to_string(&out).unwrap(), shown);
    // nothing is finished while one job runs for minutes
    let one = [
        ["estimate-mi", &wide, "--x", "c1,c2,c3,c4", "--y", "c5,c6,c7,c8"],
        ["--estimator", "ksg", "--permutations", "100000", "--out", &out],
    ]
    .concat();
    let (code, shown, err) = end_computing(&[&one[..], &["--force"]].concat(), 30, "-TERM");
    let said = "interrupted: 0 of 1 estimates are finished, and only these are shown\n";
    assert_eq!((code, shown.as_str(), err.as_str()), (Some(4), "", said));
    assert!(std::fs::read_to_string(&out).unwrap().len() > 100, "the rows before are still there");
}

#[test]
fn draws_that_are_finished_outlive_a_signal() {
    let words = ["calibrate", "--estimator", "gaussian,ksg", "--n", "1000", "--seeds", "10000", "--task", "student"];
    let (code, shown, err) = end_computing(&[&words[..], &["--format", "json"]].concat(), 60, "-INT");
    assert_eq!(code, Some(4), "{err}");
    let said = err.strip_prefix("interrupted: ").and_then(|rest| rest.split(' ').next()).unwrap();
    let done: u64 = said.parse().unwrap();
    let result: serde_json::Value = serde_json::from_str(&shown).unwrap();
    let seeds = |row: &serde_json::Value| row["seeds"].as_u64().unwrap();
    let rows = result["tasks"].as_array().unwrap();
    let counted: u64 = rows.iter().filter(|row| row["estimator"] == "gaussian").map(seeds).sum();
    assert!(done > 0 && counted == done, "{counted} of {done}");
}
