//! `fit-link` and `link` from outside, and traces and fitted links inside training.

use std::path::Path;

use assert_cmd::Command;
use ccmarl::io::write_atomic;
use ccmarl::storage;
use serde_json::Value;

/// Runs the program in `dir`: exit code, stdout, stderr.
fn run(dir: &Path, words: &str) -> (i32, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    let output = command.env_remove("COLUMNS").current_dir(dir).args(words.split_whitespace()).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

fn done(dir: &Path, words: &str) -> (String, String) {
    let (code, out, err) = run(dir, words);
    assert_eq!(code, 0, "{words}: {err}");
    (out, err)
}

fn record(dir: &Path, link: &str, episodes: u32, out: &str) {
    done(dir, &format!("record --scenario simple_spread --link {link} --episodes {episodes} --out {out}"));
}

fn bits(store: &Path) -> Vec<Vec<bool>> {
    let mut source = storage::open(store).unwrap();
    std::iter::from_fn(|| source.next_episode().unwrap()).map(|episode| episode.link).collect()
}

#[test]
fn a_fitted_link_is_printed_written_drawn_and_used() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    record(dir, "dropout:0.3", 100, "store");
    let (out, err) = done(dir, "fit-link store --out fits/link.json");
    for words in
        ["probability of loss", "95 %, all together", "log-likelihood", "Brier", "balanced accuracy", "dropout *"]
    {
        assert!(out.contains(words), "lacks {words:?}:\n{out}");
    }
    assert!(err.contains("note: no markov: no burst chain is earned"), "{err}");
    assert!(err.contains("use it with --link file:fits/link.json"), "{err}");
    let svg = std::fs::read_to_string(dir.join("fits/link.reliability.svg")).unwrap();
    assert!(svg.starts_with("<svg") && svg.contains("Reliability of the fitted link: dropout"));
    let (json, _) = done(dir, "fit-link store --out other.json --format json");
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!((&json["link"]["name"], &json["fit"]["model"]), (&Value::from("dropout"), &Value::from("dropout")));
    record(dir, "file:fits/link.json", 20, "again");
    let manifest = storage::open(&dir.join("again")).unwrap().manifest().clone();
    assert_eq!(
        (&manifest.link["name"], &manifest.link["link"]["name"]),
        (&Value::from("file"), &Value::from("dropout"))
    );
}

#[test]
fn fit_link_refuses_what_it_cannot_use_and_replaces_only_its_own() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    record(dir, "dropout:0.3", 20, "store");
    record(dir, "perfect", 20, "lossless");
    write_atomic(&dir.join("thesis.json"), b"{}").unwrap();
    write_atomic(&dir.join("bad.csv"), b"episode,step,sender,receiver,delivered\n0,0,a,b,2\n").unwrap();
    write_atomic(&dir.join("bad.json"), br#"{"kind":"ccmarl link","link":{"name":"dropout","p":7}}"#).unwrap();
    done(dir, "fit-link store --out link.json");
    for (words, code, fault) in [
        ("fit-link store --out link.json", 2, "output exists: give --force"),
        ("fit-link store --out thesis.json --force", 1, "refusing to replace what ccmarl did not make"),
        ("fit-link nowhere --out x.json", 1, "no such file or directory: nowhere"),
        ("fit-link lossless --out x.json", 1, "all 3120 messages were delivered: a fit needs delivered and lost ones"),
        ("fit-link store --model markov --out x.json", 1, "no burst chain is earned"),
        (
            "fit-link bad.csv --out x.json",
            1,
            "trace: column delivered, row 1: expected true, false, 1 or 0, found \"2\"",
        ),
        ("link simulate file:bad.json", 1, "link file: dropout: p must be in [0, 1], found 7: bad.json"),
        ("link simulate trace:store --episodes 21", 2, "the trace behind the link holds 20 episodes"),
        (
            "link simulate trace:store --scenario simple_tag --episodes 5",
            1,
            "trace: its agents are agent_0, agent_1, agent_2",
        ),
        ("link simulate dropuot:0.1", 2, "unknown link \"dropuot\": did you mean dropout?"),
    ] {
        let (found, out, err) = run(dir, words);
        assert_eq!((found, out.as_str()), (code, ""), "{words}: {err}");
        assert!(err.starts_with(&format!("error: {fault}")) && err.lines().count() == 1, "{words}: {err}");
        assert!(!dir.join("x.json").exists(), "{words} left something behind");
    }
    let (code, _, err) = run(dir, "fit-link store --model learnt --out x.json");
    assert!(code == 2 && err.contains("[possible values: dropout, distance, markov, learned, auto]"), "{err}");
    done(dir, "fit-link store --out link.json --force");
}

#[test]
fn link_simulate_prints_and_draws_what_a_link_does() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let (out, err) = done(dir, "link simulate markov:heavy --episodes 200 --out drawn");
    for words in ["sender → receiver", "agent_0 → agent_1", "losses in a row", "distance, world units", "step"] {
        assert!(out.contains(words), "lacks {words:?}:\n{out}");
    }
    assert!(err.contains("wrote statistics.csv and 3 figures: drawn"), "{err}");
    for (file, words) in [
        ("loss-by-step", "step of the episode"),
        ("burst-lengths", "losses in a row"),
        ("loss-by-distance", "world units"),
    ] {
        let svg = std::fs::read_to_string(dir.join(format!("drawn/{file}.svg"))).unwrap();
        assert!(svg.contains(words) && svg.contains("agent_2 to agent_1"), "{file}");
    }
    let csv = std::fs::read_to_string(dir.join("drawn/statistics.csv")).unwrap();
    assert!(csv.contains("\nagent_0,agent_1,step,0,200,0\n"), "the first message always arrives");
    assert_eq!(run(dir, "link simulate markov:heavy --episodes 200 --out drawn").0, 2, "nothing is replaced unasked");
    let (json, _) = done(dir, "link simulate markov:heavy --episodes 200 --format json");
    let json: Value = serde_json::from_str(&json).unwrap();
    let steps = json["total"]["steps"].as_array().unwrap();
    assert_eq!((steps.len(), &steps[0]), (25, &serde_json::json!([1200, 0])));
    // the same numbers for any number of threads
    let one = Command::new(env!("CARGO_BIN_EXE_ccmarl"))
        .env("RAYON_NUM_THREADS", "1")
        .args(["link", "simulate", "markov:heavy", "--episodes", "200", "--format", "json"])
        .output()
        .unwrap();
    assert_eq!(serde_json::from_slice::<Value>(&one.stdout).unwrap(), json);
    let (_, note) = done(dir, "link simulate perfect --episodes 3 --out whole");
    assert!(note.contains("note: no burst-lengths.svg: there is no burst"), "{note}");
}

#[test]
fn a_trace_is_replayed_in_training_and_in_evaluation_and_refused_when_it_ends_too_early() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    record(dir, "markov:heavy", 10, "heavy");
    let train = "train --scenario simple_spread --algorithm cc-maddpg --prior trace:heavy";
    done(dir, &format!("{train} --steps 250 --out run --record rollouts"));
    assert_eq!(bits(&dir.join("rollouts")), bits(&dir.join("heavy")), "training met the recorded bits");
    done(dir, "evaluate run --episodes 2");
    let (code, _, err) = run(dir, &format!("{train} --steps 275 --out longer"));
    assert!(code == 2 && err.contains("holds 10 episodes, and 11 are asked for"), "{code}: {err}");
    assert!(!dir.join("longer").exists());
    // a fitted classifier as prior: its weights are in the run's configuration
    record(dir, "distance:4", 60, "range");
    done(dir, "fit-link range --model learned --out link.json");
    done(dir, "train --scenario simple_spread --algorithm cc-maddpg --prior file:link.json --steps 100 --out fitted");
    std::fs::remove_file(dir.join("link.json")).unwrap();
    done(dir, "evaluate fitted --episodes 2");
}

#[test]
fn a_path_that_is_not_utf_8_is_fitted_and_shown() {
    use std::os::unix::ffi::OsStrExt as _;
    let dir = tempfile::tempdir().unwrap();
    record(dir.path(), "dropout:0.3", 20, "store");
    let name = |bytes: &'static [u8]| std::ffi::OsStr::from_bytes(bytes);
    std::fs::rename(dir.path().join("store"), dir.path().join(name(b"st\xffre"))).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_ccmarl"))
        .current_dir(dir.path())
        .arg("fit-link")
        .args([name(b"st\xffre"), "--out".as_ref(), name(b"l\xffnk.json"), "--format".as_ref(), "json".as_ref()])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let json: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&json["out"], &json["fit"]["data"]["path"]), (&"l\u{fffd}nk.json".into(), &"st\u{fffd}re".into()));
    assert!(dir.path().join(name(b"l\xffnk.reliability.svg")).exists());
}

#[test]
fn files_beside_results_replace_only_their_own_and_lie_in_no_store() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    record(dir, "dropout:0.3", 20, "store");
    let foreign = |file: &str| match file {
        "mi.svg" | "mi.png" => "refusing to replace what is no picture of ccmarl",
        _ => "refusing to replace what ccmarl did not make",
    };
    for (words, file) in [
        ("fit-link store --out link.json --force", "link.reliability.svg"),
        ("link simulate perfect --episodes 3 --out drawn --force", "drawn/statistics.csv"),
        ("link simulate perfect --episodes 3 --out drawn --force", "drawn/burst-lengths.svg"),
        ("estimate-mi store --estimator gaussian --permutations 0 --plot mi.svg --force", "mi.svg"),
        ("estimate-mi store --estimator gaussian --permutations 0 --plot mi.png --force", "mi.png"),
    ] {
        write_atomic(&dir.join(file), b"<svg>mine</svg>").unwrap();
        let (code, _, err) = run(dir, words);
        assert!(code == 1 && err.contains(foreign(file)) && err.contains(file), "{words}: {code}: {err}");
        assert_eq!(std::fs::read(dir.join(file)).unwrap(), b"<svg>mine</svg>", "{words}");
        std::fs::remove_file(dir.join(file)).unwrap();
        done(dir, words);
        done(dir, words);
    }
    image_is_whole(&std::fs::read(dir.join("mi.png")).unwrap());
    let before = super::integrity::names(&dir.join("store"));
    for words in [
        "fit-link store --out store/link.json",
        "link simulate perfect --episodes 3 --out store",
        "link simulate perfect --episodes 3 --out store/drawn",
        "estimate-mi store --plot store/mi.svg",
        "train --scenario simple_spread --algorithm cc-maddpg --steps 25 --out store/run",
        "report run --out store/report",
    ] {
        let (code, _, err) = run(dir, words);
        assert!(code == 2 && err.contains("inside"), "{words}: {code}: {err}");
        assert_eq!(super::integrity::names(&dir.join("store")), before, "{words}");
    }
}

/// Every chunk of a PNG file has its length, and the last one is the end.
fn image_is_whole(png: &[u8]) {
    let (mut at, mut kinds) = (8, Vec::new());
    while at < png.len() {
        let length = u32::from_be_bytes(png[at..at + 4].try_into().unwrap()) as usize;
        kinds.push(png[at + 4..at + 8].to_vec());
        at += 12 + length;
    }
    assert_eq!((at, kinds[0].as_slice(), kinds[1].as_slice()), (png.len(), &b"IHDR"[..], &b"tEXt"[..]));
    assert_eq!(kinds.last().unwrap(), b"IEND");
}

#[test]
fn a_figure_of_an_earlier_link_goes_when_there_is_nothing_to_draw() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    done(dir, "link simulate dropout:0.5 --episodes 3 --out drawn");
    assert!(dir.join("drawn/burst-lengths.svg").exists());
    let (_, err) = done(dir, "link simulate perfect --episodes 3 --out drawn --force");
    assert!(!dir.join("drawn/burst-lengths.svg").exists(), "it shows another link");
    assert!(err.contains("wrote statistics.csv and 2 figures: drawn"), "{err}");
}
