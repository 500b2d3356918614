//! The command line from outside: exit codes, stdout and stderr, help texts, `list`, `generate`, and the README's words.

use std::process::{Command as Process, Stdio};

use assert_cmd::Command;
use ccmarl::cli::Cli;
use clap::{CommandFactory as _, Parser as _};
use serde_json::Value;

/// The program, with nothing of this terminal.
fn ccmarl(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    command.env_remove("COLUMNS").write_stdin("").args(args);
    command
}

/// Exit code, stdout, stderr.
fn run(args: &[&str]) -> (i32, String, String) {
    let output = ccmarl(args).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

#[test]
fn version_and_help_go_to_stdout_with_exit_code_0() {
    let version = format!("ccmarl {}\n", env!("CARGO_PKG_VERSION"));
    assert_eq!(run(&["--version"]), (0, version, String::new()));
    let (code, out, err) = run(&["--help"]);
    assert_eq!((code, err.as_str()), (0, ""));
    assert!(out.contains("Usage: ccmarl <COMMAND>"), "{out}");
}

#[test]
fn usage_faults_exit_2_and_name_the_nearest() {
    for (args, hint) in [
        (&["lisst"][..], "'list'"),
        (&["list", "scenaro"], "'scenario'"),
        (&["list", "--fromat", "json"], "'--format'"),
        (&["list", "scenario", "simple_tga"], "unknown scenario \"simple_tga\": did you mean simple_tag"),
        (&[], "Usage: ccmarl <COMMAND>"),
    ] {
        let (code, out, err) = run(args);
        assert_eq!((code, out.as_str()), (2, ""), "{args:?}: {err}");
        assert!(err.contains(hint), "{args:?}: {err}");
    }
}

#[test]
fn unknown_plugins_exit_2_and_name_the_nearest_wherever_they_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    for (words, fault) in [
        ("record --scenario simple_tga", "unknown scenario \"simple_tga\": did you mean simple_tag"),
        ("record --scenario simple_tag --link dropuot:0.2", "unknown link \"dropuot\": did you mean dropout?"),
        ("record --scenario simple_tag --policy prob:0.5", "unknown policy \"prob\": did you mean probe?"),
        (
            "train --scenario simple_spread --algorithm cc-madpg",
            "unknown algorithm \"cc-madpg\": did you mean cc-maddpg",
        ),
        (
            "estimate-mi datasets/tables/iris.csv --x a --y b --estimator gausian",
            "unknown estimator \"gausian\": did you mean",
        ),
    ] {
        let mut args: Vec<&str> = words.split(' ').collect();
        args.extend(["--out", out.to_str().unwrap()]);
        let (code, stdout, err) = run(&args);
        assert_eq!((code, stdout.as_str()), (2, ""), "{words}: {err}");
        assert!(err.starts_with(&format!("error: {fault}")) && err.lines().count() == 1, "{words}: {err}");
        assert!(!out.exists(), "{words} left something behind");
    }
}

#[test]
fn a_reader_that_leaves_is_no_error() {
    for args in [&["--help"][..], &["list"], &["list", "--format", "json"], &["generate", "completions", "bash"]] {
        let mut process = Process::new(env!("CARGO_BIN_EXE_ccmarl"));
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = process.args(args).stdin(Stdio::null()).stdout(writer).stderr(Stdio::piped()).output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{args:?}");
        assert_eq!(String::from_utf8(output.stderr).unwrap(), "", "{args:?}");
    }
}

#[test]
fn list_is_sorted_complete_json() {
    let (code, out, err) = run(&["list", "--format", "json"]);
    assert_eq!((code, err.as_str()), (0, ""));
    let plugins: Vec<Value> = serde_json::from_str(&out).unwrap();
    let text = |plugin: &Value, key: &str| plugin[key].as_str().unwrap().to_owned();
    let names: Vec<(String, String)> = plugins.iter().map(|p| (text(p, "kind"), text(p, "name"))).collect();
    let mut sorted = names.clone();
    sorted.sort();
    sorted.dedup();
    assert_eq!(names, sorted, "sorted by kind and name, no name twice");
    for plugin in &plugins {
        let name = text(plugin, "name");
        let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "-_.".contains(c);
        assert!(!name.is_empty() && name.chars().all(plain), "{plugin}");
        assert!(text(plugin, "syntax").starts_with(&name), "{plugin}");
        assert!(!text(plugin, "summary").is_empty() && !text(plugin, "reference").is_empty(), "{plugin}");
    }
    let links: Vec<Value> = serde_json::from_str(&run(&["list", "link", "--format", "json"]).1).unwrap();
    assert_eq!(links.len(), names.iter().filter(|(kind, _)| kind == "link").count());
}

#[test]
fn one_link_shows_its_parameters_and_one_algorithm_its_prior() {
    let json = |kind: &str, name: &str| -> Value {
        serde_json::from_str(&run(&["list", kind, name, "--format", "json"]).1).unwrap()
    };
    assert_eq!(json("link", "distance")["parameters"]["threshold"], 3.0);
    assert_eq!(json("link", "markov")["parameters"]["level"], "medium");
    assert!(json("link", "trace")["parameters"].as_object().unwrap().is_empty(), "it has none without a file");
    let cc = json("algorithm", "cc-maddpg");
    assert_eq!((&cc["parameters"]["prior"], &cc["parameters"]["shaping"]), (&"dropout:0.2".into(), &true.into()));
    let (code, out, err) = run(&["list", "link", "dropout"]);
    assert!(code == 0 && out.contains("parameters of dropout:0.2:") && out.contains("0.2"), "{out}{err}");
}

#[test]
fn force_replaces_manual_pages_and_tables_of_ours_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    assert_eq!(run(&["generate", "man", "--out", &at("man")]).0, 0);
    assert_eq!(run(&["generate", "man", "--out", &at("man")]).0, 2);
    assert_eq!(run(&["generate", "man", "--out", &at("man"), "--force"]).0, 0);
    ccmarl::io::write_atomic(at("man/ccmarl-list.1").as_ref(), b"my notes").unwrap();
    let (code, _, err) = run(&["generate", "man", "--out", &at("man"), "--force"]);
    assert!(code == 1 && err.contains("refusing to replace what ccmarl did not make"), "{err}");
    let table = ["generate", "table", "--rows", "1000", "--rho", "-0.5", "--out"];
    let (code, out, err) = run(&[&table[..], &[&at("t.parquet")]].concat());
    assert_eq!((code, out.as_str()), (0, ""), "{err}");
    assert!(err.contains("information: x and y 0.143841 nats, a and b 0.445846 nats"), "{err}");
    let first = std::fs::read(at("t.parquet")).unwrap();
    assert_eq!(run(&[&table[..], &[&at("t.parquet")]].concat()).0, 2);
    assert_eq!(run(&[&table[..], &[&at("t.parquet"), "--force"]].concat()).0, 0);
    assert_eq!(std::fs::read(at("t.parquet")).unwrap(), first);
    ccmarl::io::write_atomic(at("mine.parquet").as_ref(), b"mine").unwrap();
    let (code, _, err) = run(&[&table[..], &[&at("mine.parquet"), "--force"]].concat());
    assert!(code == 1 && err.contains("refusing to replace what ccmarl did not make"), "{err}");
    for (words, message) in [
        (vec!["--out", "t.csv"], "--out: expected a name that ends in .parquet, found t.csv"),
        (vec!["--out", "t.parquet", "--rho", "1"], "expected a number between -1 and 1, without the two"),
    ] {
        let (code, _, err) = run(&[&["generate", "table"], &words[..]].concat());
        assert!(code == 2 && err.contains(message), "{err}");
    }
}

#[test]
fn list_prints_a_table_of_every_kind() {
    let (code, out, err) = run(&["list"]);
    assert_eq!((code, err.as_str()), (0, ""));
    let json: Vec<Value> = serde_json::from_str(&run(&["list", "--format", "json"]).1).unwrap();
    assert_eq!(out.lines().count(), json.len() + 1, "a header and one line per plugin:\n{out}");
}

#[test]
fn completions_and_manual_pages_name_every_subcommand() {
    let (code, script, _) = run(&["generate", "completions", "bash"]);
    assert_eq!(code, 0);
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("man");
    let man = ["generate", "man", "--out", out.to_str().unwrap()];
    assert_eq!(run(&man).0, 0);
    for command in Cli::command().get_subcommands() {
        let case = format!("ccmarl,{})", command.get_name());
        assert!(script.contains(&case), "no {case} in the script");
        let page = std::fs::read_to_string(out.join(format!("ccmarl-{}.1", command.get_name()))).unwrap();
        assert!(page.contains(".SH SYNOPSIS"), "{page}");
    }
    let (code, _, err) = run(&man);
    assert_eq!(code, 2, "pages are not replaced without --force");
    assert!(err.starts_with("error: output exists: give --force to replace it"), "{err}");
    assert_eq!(run(&["generate", "man", "--force", "--out", out.to_str().unwrap()]).0, 0);
}

#[test]
fn help_texts_are_as_agreed() {
    insta::assert_snapshot!("help", run(&["--help"]).1);
    for command in Cli::command().get_subcommands() {
        let name = command.get_name();
        insta::assert_snapshot!(format!("help-{name}"), run(&[name, "--help"]).1);
    }
}

fn readme() -> String {
    std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/README.md")).unwrap()
}

#[test]
fn the_readme_names_every_subcommand_and_no_other() {
    let readme = readme();
    let row = |line: &str| line.strip_prefix("| `")?.split_once('`').map(|(name, _)| name.to_owned());
    let table = readme.split("## Commands").nth(1).unwrap().split("\n## ").next().unwrap();
    let mut named: Vec<String> = table.lines().filter_map(row).collect();
    let mut known: Vec<String> = Cli::command().get_subcommands().map(|c| c.get_name().to_owned()).collect();
    named.sort();
    known.sort();
    assert_eq!(named, known);
}

#[test]
fn every_command_of_the_readme_parses() {
    let readme = readme();
    let lines: Vec<&str> = readme.lines().filter(|line| line.starts_with("ccmarl ")).collect();
    assert!(lines.len() >= 8, "the tour has gone: {lines:?}");
    for line in lines {
        let words = line.split(" #").next().unwrap().split_whitespace();
        Cli::try_parse_from(words).map_err(|error| format!("{line}\n{error}")).unwrap();
    }
}

#[test]
fn train_lays_scenario_flags_over_its_default_and_refuses_places_that_overlap() {
    let dir = tempfile::tempdir().unwrap();
    let run_dir = dir.path().join("run");
    let out = run_dir.to_str().unwrap();
    let (code, _, err) = run(&["train", "--agents", "4", "--steps", "25", "--out", out]);
    assert_eq!(code, 0, "{err}");
    let config = std::fs::read_to_string(run_dir.join("config.toml")).unwrap();
    assert!(config.contains("name = \"simple_spread\"") && config.contains("agents = 4"), "{config}");

    let other = dir.path().join("other");
    let other = other.to_str().unwrap();
    for (words, expected) in [
        (vec!["--set", "nonsense=1"], "simple_spread: unknown field `nonsense`"),
        (vec!["--record", "STORE"], "--record and --out need places of their own"),
        (vec!["--record", other], "--record and --out need places of their own"),
    ] {
        let inside = format!("{other}/store");
        let words = words.iter().map(|&word| if word == "STORE" { inside.as_str() } else { word });
        let args: Vec<&str> = ["train", "--steps", "25", "--out", other].into_iter().chain(words).collect();
        let (code, _, err) = run(&args);
        assert!(code == 2 && err.contains(expected), "{code} {err}");
        assert!(!std::path::Path::new(other).exists(), "{args:?} left something");
    }
}

#[test]
fn a_runs_force_does_not_replace_a_store() {
    let dir = tempfile::tempdir().unwrap();
    let [store, run_dir] = ["store", "run"].map(|name| dir.path().join(name).to_str().unwrap().to_owned());
    assert_eq!(run(&["record", "--scenario", "simple_spread", "--episodes", "2", "--out", &store]).0, 0);
    let (code, _, err) = run(&["train", "--steps", "25", "--out", &run_dir, "--record", &store, "--force"]);
    assert!(code == 2 && err.contains("output exists"), "{code} {err}");
    let (code, out, _) = run(&["inspect", &store, "--format", "json"]);
    assert!(code == 0 && out.contains("\"episodes\": 2"), "{out}");
    assert!(!std::path::Path::new(&run_dir).exists());
}

#[test]
fn tables_of_pairs_and_networks_have_their_bounds() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let (code, _, err) = run(&["pairs", &path("store"), "--out", &path("pairs.csv")]);
    assert!(code == 2 && err.contains("a table of pairs is a .parquet file"), "{err}");
    let config = "algorithm = \"maddpg\"\nscenario = { name = \"simple_spread\" }\n[maddpg]\nhidden = [20000000, 64]\n";
    std::fs::File::create(path("c.toml"))
        .and_then(|mut f| std::io::Write::write_all(&mut f, config.as_bytes()))
        .unwrap();
    let (code, _, err) = run(&["train", "--config", &path("c.toml"), "--out", &path("run")]);
    assert!(code == 2 && err.contains("maddpg.hidden: expected at most 16 layers of 1 to 4096 units"), "{err}");
}
