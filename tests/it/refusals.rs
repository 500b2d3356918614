//! What the commands on stores refuse, and the words they use: every error text of storage, files and schema.
#![expect(clippy::disallowed_methods, reason = "foreign and forged files are written in place on purpose")]

use std::fs;
use std::io::Error as OsError;
use std::path::{Path, PathBuf};

use ccmarl::io::IoError;
use ccmarl::pairs::PairsError;
use ccmarl::record::RecordError;
use ccmarl::schema::{SchemaError, hex};
use ccmarl::storage::{self, StorageError};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};

use super::integrity::{ccmarl, killed, names};
use super::stores::{FORMS, episode, golden_folder, layout, manifest, message, read, small, some, write};

#[test]
fn every_error_says_what_is_wrong_what_to_do_and_where() {
    let path = || PathBuf::from("data/x");
    let schema = |source| StorageError::Schema { source, path: path() };
    let manifest = |m: &str| SchemaError::Manifest(m.to_owned());
    let busy = {
        let directory = tempfile::tempdir().unwrap();
        let store = directory.path().join("x");
        let _sink = storage::create(&store, &self::manifest(&small()), false).unwrap();
        message(storage::create(&store, &self::manifest(&small()), true).map(drop))
    };
    assert!(busy.starts_with(&format!(
        "process {} is writing it right now: wait until it has ended, or take another name: /",
        std::process::id()
    )));
    let texts: [(String, &str); 22] = [
        (
            IoError::os("open", &path())(OsError::other("no such device")).to_string(),
            "could not open: no such device: data/x",
        ),
        (IoError::Exists(path()).to_string(), "output exists: give --force to replace it, or another --out: data/x"),
        (IoError::Missing(path()).to_string(), "no such file or directory: data/x"),
        (
            IoError::Foreign(path()).to_string(),
            "refusing to replace what ccmarl did not make; remove it by hand, or give another --out: data/x",
        ),
        (
            IoError::ForeignEntry { entry: "a\u{1b}.tex".into(), path: path() }.to_string(),
            "refusing to replace a directory that holds what ccmarl did not put there: a\\u{1b}.tex; move it, or give another --out: data/x",
        ),
        (StorageError::from(IoError::Missing(path())).to_string(), "no such file or directory: data/x"),
        (
            schema(SchemaError::Length { column: "reward".to_owned(), expected: 3, found: 2 }).to_string(),
            "column reward: expected 3 values, found 2: data/x",
        ),
        (
            schema(SchemaError::Value { column: "link".to_owned(), message: "step 0: …".to_owned() }).to_string(),
            "column link: step 0: …: data/x",
        ),
        (
            SchemaError::Version { found: 9 }.to_string(),
            "schema version 9 is newer than the 1 this program reads: install the ccmarl release that wrote it (the manifest's `ccmarl` field names it)",
        ),
        (schema(manifest("kind: …")).to_string(), "manifest: kind: …: data/x"),
        (
            StorageError::NotAStore { message: "it is text".to_owned(), path: path() }.to_string(),
            "not a rollout store: it is text: data/x",
        ),
        (
            StorageError::Truncated { episodes: 0, path: path() }.to_string(),
            "cut short, and no episode of it is whole: copy it again, or record again: data/x",
        ),
        (
            StorageError::Truncated { episodes: 7, path: path() }.to_string(),
            "cut short after 7 whole episodes: copy it again, or keep these with `ccmarl recover --force data/x`: data/x",
        ),
        (
            StorageError::Unfinished { what: "recording", target: path(), path: "data/.x.partial".into() }.to_string(),
            "its recording did not finish; `ccmarl recover data/x` puts its whole episodes in place, the same command with --force starts anew: data/.x.partial",
        ),
        (
            StorageError::Extension { extension: "csv".to_owned(), path: "x.csv".into() }.to_string(),
            "no store ends in .csv: give a name in .parquet or .mcap, one without an ending for a directory, or one that ends in / for a directory of just this name: x.csv",
        ),
        (
            StorageError::Slash { extension: "mcap".to_owned(), path: "x.mcap/".into() }.to_string(),
            "a name in .mcap is a file's, and / a directory's: leave out the one or the other: x.mcap/",
        ),
        (
            StorageError::Within { store: "data".into(), path: path() }.to_string(),
            "the output would lie inside the store data: give a place outside of it: data/x",
        ),
        (
            StorageError::Same(path()).to_string(),
            "this is the store itself, which cannot be made from itself, not even with --force; give another name: data/x",
        ),
        (
            StorageError::Whole { path: path() }.to_string(),
            "nothing to recover: it is whole; `ccmarl verify` checks it, `ccmarl convert` copies it: data/x",
        ),
        (
            StorageError::Finished { path: path() }.to_string(),
            "nothing to recover: it is no unfinished recording; where `ccmarl verify` finds damage, `ccmarl recover data/x --out NEW` saves what is sound: data/x",
        ),
        (
            StorageError::Empty { path: path() }.to_string(),
            "killed before its first episode was committed: there is nothing to recover; start again with --force: data/x",
        ),
        (StorageError::Damaged { message: "a bit".to_owned(), path: path() }.to_string(), "damaged: a bit: data/x"),
    ];
    for (found, expected) in texts {
        assert_eq!(found, expected);
    }
}

#[test]
fn every_error_of_recordings_and_samples_says_what_to_do() {
    let path = || PathBuf::from("data/x");
    let texts = [
        (RecordError::NoEpisodes.to_string(), "expected at least 1 episode, found 0: give --episodes"),
        (
            RecordError::Threads { threads: 9, reason: "no memory".to_owned() }.to_string(),
            "could not start 9 threads: no memory: give fewer with --threads",
        ),
        (
            RecordError::Mismatch("scenario: …".to_owned()).to_string(),
            "the store does not fit the scenario that its manifest names: scenario: …",
        ),
        (
            PairsError::NoLinks { found: 1 }.to_string(),
            "no links: expected two or more communicators that send messages and act, found 1; record with more --agents",
        ),
        (
            PairsError::NoSteps { episodes: 2 }.to_string(),
            "no samples: the store holds 2 episodes and no step; record with --episodes 1 or more",
        ),
        (
            PairsError::NoColumns(path()).to_string(),
            "not a rollout store, and as a table it needs --x and --y: name columns of it: data/x",
        ),
        (PairsError::TooManyRows.to_string(), "more than 4294967295 rows: take a part of the data"),
        (
            PairsError::Infinite { name: "a".to_owned(), row: 3, value: f64::INFINITY, path: path() }.to_string(),
            "column \"a\", row 3: infinite or over 1e150 (inf); leave it out with --where, or rescale the column: data/x",
        ),
        (
            PairsError::Unreadable { form: "CSV", message: "…".to_owned(), path: path() }.to_string(),
            "not a readable CSV table: …: data/x",
        ),
    ];
    for (found, expected) in texts {
        assert_eq!(found, expected);
    }
}

#[test]
fn force_keeps_what_somebody_else_put_into_a_store() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let store = directory.path().join("store");
    write(&store, &layout, &some(&layout, 2), false).unwrap();
    let before = read(&store).unwrap();
    for (name, is_file) in
        [("thesis.tex", true), ("part-copy.parquet", true), ("part-00000.parquet.bak", true), ("figures", false)]
    {
        let foreign = store.join(name);
        if is_file {
            fs::write(&foreign, "years of work").unwrap();
        } else {
            fs::create_dir(&foreign).unwrap();
        }
        let words = ["record", "--scenario", "simple_spread", "--episodes", "2", "--force", "--out"];
        for (command, source) in
            [(&words[..], None), (&["convert", "--force"], Some(golden_folder().join("store.mcap")))]
        {
            let mut words: Vec<String> = command.iter().map(|&word| word.to_owned()).collect();
            words.extend(source.iter().chain([&store]).map(|path| path.to_str().unwrap().to_owned()));
            let (code, out, err) = ccmarl(&words.iter().map(String::as_str).collect::<Vec<_>>());
            assert_eq!((code, out.as_str()), (1, ""), "{words:?}");
            assert!(err.contains(&format!("holds what ccmarl did not put there: {name}; move it")), "{err}");
        }
        assert!(foreign.exists() && read(&store).unwrap() == before);
        assert_eq!(names(directory.path()), ["store"]);
        fs::remove_dir(&foreign).or_else(|_| fs::remove_file(&foreign)).unwrap();
    }
    // it comes while the recording goes on
    let mut sink = storage::create(&store, &manifest(&layout), true).unwrap();
    sink.append(&episode(&layout, 0, 1, false)).unwrap();
    fs::write(store.join("notes.txt"), "today").unwrap();
    let error = message(sink.finish());
    assert!(error.contains("did not put there: notes.txt"), "{error}");
    assert_eq!((read(&store).unwrap(), names(&store).len()), (before, 3));
}

#[test]
fn an_estimate_replaces_only_estimates() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let table = golden_folder().join("../../tables/iris.csv");
    let words = ["estimate-mi", table.to_str().unwrap(), "--x", "petal_length", "--y", "petal_width"];
    let estimate = |out: &str| ccmarl(&[&words[..], &["--estimator", "gaussian", "--force", "--out", out]].concat());
    for form in ["a.json", "a.csv", "a.parquet"] {
        let out = at(form);
        for _ in 0..2 {
            let (code, _, err) = estimate(&out);
            assert_eq!(code, 0, "its own result, and an empty file: {err}");
        }
        for foreign in [
            fs::read(golden_folder().join("store/manifest.json")).unwrap(),
            b"a,b\n1,2\n".to_vec(),
            b"[{\"estimator\": 1}]".to_vec(),
            fs::read(golden_folder().join("store.parquet")).unwrap(),
        ] {
            fs::write(&out, &foreign).unwrap();
            let (code, stdout, err) = estimate(&out);
            assert_eq!((code, stdout.as_str()), (1, ""), "{form}");
            assert!(err.starts_with("error: refusing to replace what ccmarl did not make"), "{err}");
            assert!(fs::read(&out).unwrap() == foreign);
        }
        fs::write(&out, "").unwrap();
        assert_eq!(estimate(&out).0, 0);
    }
}

#[test]
fn no_output_lies_inside_a_store() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let layout = small();
    write(Path::new(&at("a")), &layout, &some(&layout, 3), false).unwrap();
    killed(Path::new(&at("k")), &layout, &some(&layout, 3), 5);
    let before = names(&directory.path().join("a"));
    let a = at("a");
    for words in [
        vec!["convert", &a, &at("a/inner")],
        vec!["convert", &a, &at("a/deep/inner.mcap")],
        vec!["convert", &a, &at("a/../a/inner.parquet")],
        vec!["convert", &a, &at(".k.partial/x.mcap")],
        vec!["pairs", &a, "--out", &at("a/pairs.parquet")],
        vec!["estimate-mi", &a, "--out", &at("a/mi.json")],
        vec!["inspect", &a, "--shard", "0/1", "--out", &at("a/0.json")],
        vec!["record", "--scenario", "simple_spread", "--out", &at("a/b")],
        vec!["recover", &a, "--out", &at("a/b")],
    ] {
        let (code, out, err) = ccmarl(&words);
        assert_eq!((code, out.as_str()), (2, ""), "{words:?}: {err}");
        assert!(err.starts_with("error: the output would lie inside the store /"), "{err}");
    }
    // through a link, and from within
    std::os::unix::fs::symlink(&a, at("link")).unwrap();
    assert_eq!(ccmarl(&["convert", &a, &at("link/b")]).0, 2);
    let mut command = assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    let output = command.current_dir(&a).args(["convert", ".", "inner"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    assert_eq!(names(&directory.path().join("a")), before);
}

#[test]
fn wrong_words_are_refused_before_anything_is_done() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let record = ["record", "--scenario", "simple_spread", "--episodes", "100000000", "--out"];
    for (words, fault) in [
        (vec![&at("x.parquet/")[..]], "a name in .parquet is a file's, and / a directory's"),
        (vec![&at("x.mcap/")], "a name in .mcap is a file's, and / a directory's"),
        (vec![&at("x"), "--threads", "100000"], "100000 is not in 0..=1024"),
    ] {
        let (code, out, err) = ccmarl(&[&record[..], &words].concat());
        assert_eq!((code, out.as_str()), (2, ""), "{err}");
        assert!(err.contains(fault), "{err}");
    }
    let (code, _, err) = ccmarl(&["convert", golden_folder().join("store").to_str().unwrap(), &at("y.parquet/")]);
    assert_eq!(code, 2, "{err}");
    assert_eq!(names(directory.path()), [""; 0]);
}

#[test]
fn a_glob_over_stores_is_no_store() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let (one, other) = (small(), layout(&[(true, [1, 1, 1])], 1));
    write(&at("a.parquet"), &one, &some(&one, 2), false).unwrap();
    write(&at("b.parquet"), &other, &some(&other, 2), false).unwrap();
    let bytes = |name: &str| fs::read(at(name)).unwrap();
    let before = (bytes("a.parquet"), bytes("b.parquet"));
    // as a shell writes *.parquet out: two stores where a command takes one
    let glob = [at("a.parquet"), at("b.parquet")].map(|path| path.to_str().unwrap().to_owned());
    for (words, code) in [
        (vec!["verify"], 2),
        (vec!["inspect"], 2),
        (vec!["recover"], 2),
        (vec!["convert"], 2),
        (vec!["convert", "--force"], 1),
    ] {
        let all = words.iter().copied().chain(glob.iter().map(String::as_str)).collect::<Vec<_>>();
        if words.last() == Some(&"--force") {
            continue; // that asks for it: b.parquet is a store of ours
        }
        let (found, out, err) = ccmarl(&all);
        assert_eq!((found, out.as_str()), (code, ""), "{all:?}: {err}");
    }
    assert!((bytes("a.parquet"), bytes("b.parquet")) == before, "nothing was overwritten");
    // a store of parts of two
    write(&at("mixed"), &one, &some(&one, 2), false).unwrap();
    write(&at("other"), &other, &some(&other, 2), false).unwrap();
    fs::copy(at("other/part-00000.parquet"), at("mixed/part-00001.parquet")).unwrap();
    let report = storage::verify(&at("mixed"), &mut |_, _| None).unwrap();
    assert_eq!(report.problems[0].message, "the manifest does not name it; other readers would take it in");
    fs::rename(at("mixed/part-00001.parquet"), at("mixed/part-00000.parquet")).unwrap();
    assert!(message(read(&at("mixed"))).starts_with("damaged: "));
    let report = storage::verify(&at("mixed"), &mut |_, _| None).unwrap();
    assert!(report.is_wrong() && report.episodes == 0, "{report:?}");
}

#[test]
fn names_with_html_and_escapes_are_shown_harmless_on_both_streams() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    for form in FORMS {
        let ending = form.strip_prefix("store").unwrap();
        let name = format!("<script>\u{1b}]0;x\u{7}\u{9b}31m{ending}");
        let path = directory.path().join(&name);
        write(&path, &layout, &some(&layout, 2), false).unwrap();
        let copy = directory.path().join(format!("{name}.copy.parquet"));
        for words in [
            vec!["verify".as_ref(), path.as_os_str()],
            vec!["inspect".as_ref(), path.as_os_str()],
            vec!["recover".as_ref(), path.as_os_str()],
            vec!["convert".as_ref(), path.as_os_str(), copy.as_os_str()],
            vec!["convert".as_ref(), path.as_os_str(), copy.as_os_str()],
            vec!["pairs".as_ref(), path.as_os_str(), "--out".as_ref(), copy.as_os_str()],
        ] {
            let output = assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl")).args(&words).output().unwrap();
            let text = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
            let harmful = |c: char| c.is_control() && c != '\n';
            assert!(!text.contains(harmful), "{words:?}: {text:?}");
        }
        fs::remove_file(&copy).unwrap();
    }
}

/// The text of a part with its digest made right again.
fn resealed(mut part: Value) -> String {
    part["self_sha256"] = json!("0".repeat(64));
    let text = part.to_string();
    text.replace(&"0".repeat(64), &hex(&Sha256::digest(text.as_bytes())))
}

#[test]
fn merge_takes_no_part_on_trust() {
    type Change = fn(&mut Value);
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let record = ["record", "--scenario", "simple_tag", "--set", "steps=3", "--link", "dropout:0.3", "--episodes", "9"];
    assert_eq!(ccmarl(&[&record[..], &["--out", &at("store")]].concat()).0, 0);
    for k in 0..2 {
        let shard = format!("{k}/2");
        assert_eq!(ccmarl(&["inspect", &at("store"), "--shard", &shard, "--out", &at(&shard.replace('/', "-"))]).0, 0);
    }
    let merge = |first: &str| ccmarl(&["inspect", "--merge", first, &at("1-2")]);
    let good = fs::read(at("0-2")).unwrap();
    assert_eq!(merge(&at("0-2")).0, 0);
    for bit in (0..good.len() * 8).step_by(61) {
        let mut bytes = good.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        fs::write(at("bad"), bytes).unwrap();
        let (code, out, err) = merge(&at("bad"));
        assert_eq!((code, out.as_str()), (1, ""), "bit {bit}: {err}");
    }
    let cases: [(Change, i32, &str); 13] = [
        (|_| {}, 0, ""),
        (|p| p["kind"] = json!("x"), 1, "expected kind \"inspect-part\", found \"x\""),
        (|p| p["shard"] = json!(2), 1, "there is no shard 2/2: they count from 0"),
        (|p| p["shards"] = json!(3), 1, "shard 0/3 of 9 episodes cannot be: 3 episodes have 4 returns"),
        (|p| p["counts"]["returns"] = json!([1]), 1, "4 episodes have 1 returns"),
        (|p| p["counts"]["returns"][0] = json!(f64::NAN.to_bits()), 1, "a return is NaN"),
        (|p| p["counts"]["terminal"] = json!(5), 1, "4 episodes have 5 terminal ones and 12 steps"),
        (|p| p["counts"]["steps"] = json!(28), 1, "4 episodes have 0 terminal ones and 28 steps"),
        (|p| p["counts"]["lost"][1] = json!(13), 1, "its lost messages do not fit 3 communicators and 12 steps"),
        (|p| p["counts"]["lost"][4] = json!(1), 1, "an agent lost messages to itself"),
        (|p| p["counts"]["sums"]["height"] = json!([]), 1, "the store has no column \"height\""),
        (|p| p["manifest"]["seed"] = json!(2), 2, "parts of different stores"),
        (|p| p["counts"]["steps"] = json!(13), 2, "all shards have 28 steps together, the store has 27"),
    ];
    for (change, expected, fault) in cases {
        let mut part: Value = serde_json::from_slice(&good).unwrap();
        change(&mut part);
        fs::write(at("bad"), resealed(part)).unwrap();
        let (code, _, err) = merge(&at("bad"));
        assert_eq!(code, expected, "{fault}: {err}");
        assert!(err.contains(fault), "{fault}: {err}");
    }
    let mut part: Value = serde_json::from_slice(&good).unwrap();
    part["counts"]["sums"].as_object_mut().unwrap().remove("reward");
    fs::write(at("bad"), resealed(part)).unwrap();
    assert!(merge(&at("bad")).2.contains("it lacks sums of columns"));
}
