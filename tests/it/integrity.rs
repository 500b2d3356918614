//! verify, recover, convert: what is wrong is said, what was committed comes back, nothing is overwritten.
#![expect(clippy::disallowed_methods, reason = "damaged files are written in place on purpose")]

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use ccmarl::io::{IoError, partial_path};
use ccmarl::schema::{Episode, Layout, Manifest};
use ccmarl::storage::{self, Recovered, Report, StorageError};
use proptest::prelude::*;
use serde_json::{Value, json};

use super::stores::{
    FORMS, data_file, episode, golden, golden_folder, layout, manifest, message, read, small, some, write,
};

pub(crate) fn verify(path: &Path) -> Report {
    storage::verify(path, &mut |_, _| None).unwrap()
}

pub(crate) fn recover(path: &Path, force: bool) -> Result<Recovered, StorageError> {
    storage::recover(path, force, &mut |_, _| {}, &AtomicBool::new(false)).map(Option::unwrap)
}

pub(crate) fn convert(from: &Path, to: &Path, force: bool) -> Result<Option<Manifest>, StorageError> {
    let options = storage::Options { force, viewer: true };
    storage::convert(from, to, options, &mut |_, _| {}, &AtomicBool::new(false))
}

/// (check, place, lost) of every problem.
pub(crate) fn problems(report: &Report) -> Vec<(&str, &str, bool)> {
    report.problems.iter().map(|p| (p.check, p.place.as_str(), p.lost)).collect()
}

/// A recording of `planned` episodes that was killed after these.
pub(crate) fn killed(path: &Path, layout: &Layout, episodes: &[Episode], planned: u64) -> PathBuf {
    let manifest = Manifest { planned, ..manifest(layout) };
    let mut sink = storage::create(path, &manifest, false).unwrap();
    sink.append_all(episodes).unwrap();
    sink.commit().unwrap();
    drop(sink);
    settle(path);
    partial_path(path)
}

/// Waits until the lock of a writer is gone: a process that another test starts may hold it until it is itself.
pub(crate) fn settle(path: &Path) {
    while matches!(storage::open(path), Err(StorageError::Busy { .. })) {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
}

pub(crate) fn names(directory: &Path) -> Vec<String> {
    let mut names: Vec<String> = fs::read_dir(directory)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

#[test]
fn a_good_store_of_each_form_is_clean() {
    for form in FORMS {
        let report = verify(&golden_folder().join(form));
        assert_eq!((report.problems, report.episodes, report.steps), (vec![], 3, 6), "{form}");
    }
}

#[test]
fn every_bad_part_of_a_directory_is_reported() {
    let layout = layout(&[(true, [1, 1, 1])], 1);
    let episodes: Vec<Episode> = (0..16_500).map(|i| episode(&layout, i, 1, false)).collect();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store");
    write(&path, &layout, &episodes, false).unwrap();
    let part = |k: usize| path.join(format!("part-0000{k}.parquet"));
    let mut flipped = fs::read(part(0)).unwrap();
    flipped[60] ^= 4;
    fs::write(part(0), flipped).unwrap();
    fs::remove_file(part(1)).unwrap();
    let length = part(3).metadata().unwrap().len();
    fs::File::options().write(true).open(part(3)).unwrap().set_len(length / 2).unwrap();
    fs::copy(part(2), path.join("part-copy.parquet")).unwrap();
    let report = verify(&path);
    let found = problems(&report);
    assert!(found.contains(&("digest", "part-00000.parquet", false)), "{found:?}");
    assert!(found.contains(&("parts", "part-00001.parquet", true)), "{found:?}");
    assert!(found.contains(&("length", "part-00003.parquet", true)), "{found:?}");
    assert!(found.contains(&("parts", "part-copy.parquet", false)), "{found:?}");
    assert!(!found.iter().any(|p| p.1 == "part-00002.parquet" || p.1 == "part-00004.parquet"), "{found:?}");
    let missing = report.problems.iter().find(|p| p.place == "part-00001.parquet").unwrap();
    assert_eq!(missing.message, "it is missing, and with it episodes 4000 to 7999");
    assert!(report.episodes >= 4500 && report.is_wrong());
}

#[test]
fn a_missing_part_is_a_loss_and_nothing_more() {
    let layout = layout(&[(true, [1, 1, 1])], 0);
    let episodes: Vec<Episode> = (0..8500).map(|i| episode(&layout, i, 1, false)).collect();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store");
    write(&path, &layout, &episodes, false).unwrap();
    fs::remove_file(path.join("part-00001.parquet")).unwrap();
    let report = verify(&path);
    assert_eq!(problems(&report), [("parts", "part-00001.parquet", true)]);
    assert_eq!(report.episodes, 4500);
    assert!(!report.is_wrong());
}

#[test]
fn every_bad_chunk_of_an_mcap_file_is_reported() {
    use mcap::records::op;
    let layout = small();
    let episodes: Vec<Episode> = (0..6).map(|i| episode(&layout, i, 3, false)).collect();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store.mcap");
    write(&path, &layout, &episodes, false).unwrap();
    let mut bytes = fs::read(&path).unwrap();
    let (mut at, mut chunks) = (8, Vec::new());
    while at + 9 < bytes.len() {
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
        if bytes[at] == op::CHUNK {
            chunks.push((at, at + 9 + length / 2));
        }
        at += 9 + length;
    }
    assert_eq!(chunks.len(), 6, "a chunk per episode");
    for chunk in [1, 4] {
        bytes[chunks[chunk].1] ^= 1;
    }
    fs::write(&path, bytes).unwrap();
    let report = verify(&path);
    let places: Vec<&str> = report.problems.iter().map(|p| p.place.as_str()).collect();
    let expected = [1, 4].map(|k: usize| format!("chunk at byte {}", chunks[k].0));
    assert_eq!(places, ["file", &expected[0], &expected[1]], "{:?}", report.problems);
    assert_eq!(report.episodes, 4, "the other episodes are sound");
}

#[test]
fn rewards_that_do_not_add_up_are_reported_by_the_command() {
    let layout = layout(&[(true, [1, 1, 1]), (true, [1, 1, 1])], 0);
    let mut one = episode(&layout, 0, 2, false);
    for step in 0..2 {
        one.reward[step] = one.rewards[0][step] + one.rewards[1][step];
    }
    let mut two = Episode { index: 1, ..one.clone() };
    two.reward[1] += 1.0;
    let directory = tempfile::tempdir().unwrap();
    for form in FORMS {
        let path = directory.path().join(form);
        let described = Manifest { scenario: json!({"name": "simple_spread", "agents": 2}), ..manifest(&layout) };
        let mut sink = storage::create(&path, &described, false).unwrap();
        sink.append(&one).unwrap();
        sink.append(&two).unwrap();
        sink.finish().unwrap();
        let (code, out, _) = ccmarl(&["verify", path.to_str().unwrap(), "--format", "json"]);
        let json: Value = serde_json::from_str(&out).unwrap();
        assert_eq!((code, &json["verdict"]), (1, &json!("wrong")), "{form}");
        assert_eq!(json["problems"].as_array().unwrap().len(), 1);
        assert_eq!(json["problems"][0]["place"], "episode 1");
        assert!(
            json["problems"][0]["message"].as_str().unwrap().starts_with("step 1: the agents' rewards give the team")
        );
    }
}

/// Exit code, stdout and stderr of the program.
pub(crate) fn ccmarl(arguments: &[&str]) -> (i32, String, String) {
    let output = assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl")).args(arguments).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

#[test]
fn the_commands_say_what_was_lost_and_exit_accordingly() {
    let layout = small();
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        let name = path.to_str().unwrap();
        let leftover = killed(&path, &layout, &some(&layout, 5), 9);
        let (code, out, _) = ccmarl(&["verify", name, "--format", "json"]);
        let json: Value = serde_json::from_str(&out).unwrap();
        assert_eq!((code, &json["verdict"], &json["episodes"]), (3, &json!("lost"), &json!(5)), "{form}: {out}");
        assert!(out.contains("5 of 9 planned episodes are whole"), "{out}");
        let (code, _, err) = ccmarl(&["inspect", name]);
        assert_eq!(code, 1);
        assert!(err.contains(&format!("its recording did not finish; `ccmarl recover {name}`")), "{err}");
        let (code, out, err) = ccmarl(&["recover", if form == "store" { leftover.to_str().unwrap() } else { name }]);
        assert_eq!((code, out.as_str()), (3, &*format!("recovered 5 episodes: {name}\n")), "{err}");
        assert!(err.contains("lost: 4 of 9 planned episodes"), "{err}");
        let (code, out, err) = ccmarl(&["verify", name]);
        assert_eq!(code, 0, "{out}{err}");
        assert!(out.contains("5 of 9 planned episodes: the recording was stopped"), "{out}");
        let (code, _, err) = ccmarl(&["recover", name]);
        assert_eq!(code, 1);
        assert!(err.contains("nothing to recover"), "{err}");
    }
    assert_eq!(ccmarl(&["verify", "no/such"]).0, 1);
    assert_eq!(ccmarl(&["recover", "no/such"]).0, 1);
}

#[test]
fn all_committed_episodes_come_back_and_a_complete_leftover_is_no_loss() {
    let layout = small();
    let episodes = some(&layout, 5);
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        killed(&path, &layout, &episodes, 5);
        let recovered = recover(&path, false).unwrap();
        assert_eq!((recovered.episodes, recovered.planned, recovered.is_loss()), (5, 5, false), "{form}");
        assert_eq!(read(&path).unwrap(), episodes);
        assert_eq!(names(directory.path()), [form], "nothing is left");
        let fresh = directory.path().join(format!("fresh-{form}"));
        let described = Manifest { planned: 5, ..manifest(&layout) };
        let mut sink = storage::create(&fresh, &described, false).unwrap();
        sink.append_all(&episodes).unwrap();
        sink.finish().unwrap();
        assert!(fs::read(data_file(&fresh)).unwrap() == fs::read(data_file(&path)).unwrap(), "as if never killed");
    }
}

#[test]
fn sealed_parts_and_the_journal_are_put_together() {
    let layout = layout(&[(true, [1, 1, 1])], 1);
    let episodes: Vec<Episode> = (0..9000).map(|i| episode(&layout, i, 1, false)).collect();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store");
    let leftover = killed(&path, &layout, &episodes, 10_000);
    let found = names(&leftover);
    assert!(found.contains(&"part-00001.parquet".to_owned()), "{found:?}");
    assert!(found.contains(&"journal-00002.arrows".to_owned()), "{found:?}");
    assert_eq!(recover(&path, false).unwrap().episodes, 9000);
    assert!(read(&path).unwrap() == episodes);
    assert_eq!(verify(&path).problems, []);
}

#[test]
fn a_leftover_cut_anywhere_gives_a_clean_prefix_or_an_error() {
    let layout = layout(&[(true, [2, 1, 1]), (true, [0, 2, 0])], 1);
    let episodes: Vec<Episode> = (0..3).map(|i| episode(&layout, i, 2, false)).collect();
    for form in ["store", "store.mcap"] {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        let leftover = {
            let mut sink = storage::create(&path, &manifest(&layout), false).unwrap();
            for e in &episodes {
                sink.append(e).unwrap();
                sink.commit().unwrap();
            }
            drop(sink);
            settle(&path);
            partial_path(&path)
        };
        let file = if leftover.is_dir() { leftover.join("journal-00000.arrows") } else { leftover.clone() };
        let whole = fs::read(&file).unwrap();
        let mut counts = std::collections::BTreeSet::new();
        for length in 0..=whole.len() {
            fs::write(&file, &whole[..length]).unwrap();
            let report = verify(&path);
            assert!(!report.is_clean() && !report.is_wrong(), "{form} cut to {length}: {:?}", report.problems);
            counts.insert(report.episodes);
            if length % 61 == 0 {
                // what verify counts is what recover brings back
                let copy = directory.path().join(format!("copy-{form}"));
                let copied = partial_path(&copy);
                if leftover.is_dir() {
                    fs::create_dir(&copied).unwrap();
                    fs::copy(&file, copied.join("journal-00000.arrows")).unwrap();
                } else {
                    fs::copy(&file, &copied).unwrap();
                }
                let back = recover(&copy, false).map_or(0, |r| r.episodes);
                assert_eq!(back, report.episodes);
                if back > 0 {
                    assert_eq!(read(&copy).unwrap(), episodes[..back as usize]);
                    storage::verify(&copy, &mut |_, _| None).unwrap();
                }
                drop((fs::remove_dir_all(&copy), fs::remove_file(&copy)));
                drop((fs::remove_dir_all(&copied), fs::remove_file(&copied)));
            }
        }
        assert_eq!(counts.into_iter().collect::<Vec<_>>(), [0, 1, 2, 3], "{form}");
    }
}

#[test]
fn a_finished_file_that_was_cut_keeps_its_whole_episodes_but_only_with_force() {
    let layout = small();
    let episodes: Vec<Episode> = (0..4).map(|i| episode(&layout, i, 3, false)).collect();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store.mcap");
    write(&path, &layout, &episodes, false).unwrap();
    let length = path.metadata().unwrap().len();
    fs::File::options().write(true).open(&path).unwrap().set_len(length / 2).unwrap();
    let report = verify(&path);
    assert!(!report.is_clean() && !report.is_wrong(), "{:?}", report.problems);
    assert!(matches!(recover(&path, false), Err(StorageError::Io(IoError::Exists(_)))));
    let recovered = recover(&path, true).unwrap();
    assert!(recovered.is_loss() && recovered.episodes == report.episodes && recovered.episodes > 0);
    assert_eq!(read(&path).unwrap(), episodes[..recovered.episodes as usize]);
}

#[test]
fn recover_does_not_replace_a_store_without_force() {
    let layout = small();
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let (path, other) = (directory.path().join(form), directory.path().join(format!("other-{form}")));
        let leftover = killed(&other, &layout, &some(&layout, 5), 5);
        write(&path, &layout, &some(&layout, 2), false).unwrap();
        fs::rename(&leftover, partial_path(&path)).unwrap(); // as a killed `record --force` leaves it
        assert!(matches!(recover(&path, false), Err(StorageError::Beside { .. })), "{form}");
        assert_eq!(read(&path).unwrap().len(), 2);
        assert_eq!(recover(&path, true).unwrap().episodes, 5);
        assert_eq!((read(&path).unwrap().len(), names(directory.path())), (5, vec![form.to_owned()]));
    }
}

#[test]
fn two_writers_of_one_name_are_told_of_each_other() {
    let layout = small();
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        let mut sink = storage::create(&path, &manifest(&layout), false).unwrap();
        sink.append(&episode(&layout, 0, 2, false)).unwrap();
        sink.commit().unwrap();
        for force in [false, true] {
            let error = message(storage::create(&path, &manifest(&layout), force).map(drop));
            let owner = if form == "store.mcap" {
                "another process".to_owned()
            } else {
                format!("process {}", std::process::id())
            };
            assert!(error.starts_with(&format!("{owner} is writing it right now: wait")), "{error}");
        }
        let error = message(recover(&path, true).map(drop));
        assert!(error.contains("is writing it right now"), "{error}");
        drop(sink); // its lock goes with it, so nothing is ever stale
        settle(&path);
        let error = message(storage::create(&path, &manifest(&layout), false).map(drop));
        assert!(error.starts_with("its recording did not finish"), "{error}");
        assert_eq!(recover(&path, false).unwrap().episodes, 1);
    }
}

#[test]
fn every_form_converts_into_every_other_and_back_to_the_same_bytes() {
    let directory = tempfile::tempdir().unwrap();
    let (_, episodes) = golden();
    for from in FORMS {
        for to in FORMS {
            let at = |step: usize, form: &str| directory.path().join(format!("{from}-{to}-{step}")).join(form);
            let (there, back, again) = (at(0, to), at(1, from), at(3, from));
            let source = golden_folder().join(from);
            let manifest = convert(&source, &there, false).unwrap().unwrap();
            assert_eq!(read(&there).unwrap(), episodes, "{from} to {to}");
            assert_eq!(manifest.planned, 0);
            convert(&there, &back, false).unwrap();
            convert(&back, &at(2, to), false).unwrap();
            convert(&at(2, to), &again, false).unwrap();
            assert!(fs::read(data_file(&again)).unwrap() == fs::read(data_file(&back)).unwrap(), "{from} via {to}");
            let error = convert(&source, &there, false).unwrap_err();
            assert!(matches!(error, StorageError::Io(IoError::Exists(_))), "{error}");
            convert(&source, &there, true).unwrap();
            let error = convert(&there, &there, true).unwrap_err();
            assert!(matches!(error, StorageError::Same(_)), "onto itself, even with force: {error}");
        }
    }
}

#[test]
fn a_conversion_that_fails_or_is_stopped_leaves_nothing() {
    let layout = small();
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("source.mcap");
        write(&path, &layout, &some(&layout, 5), false).unwrap();
        let to = directory.path().join(form);
        let options = storage::Options { force: false, viewer: true };
        let stopped = storage::convert(&path, &to, options, &mut |_, _| {}, &AtomicBool::new(true)).unwrap();
        assert!(stopped.is_none());
        let mut bytes = fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::write(&path, bytes).unwrap();
        assert!(convert(&path, &to, false).is_err());
        assert_eq!(names(directory.path()), ["source.mcap"], "{form}");
    }
    let (code, out, err) = ccmarl(&["convert", "datasets/golden/v1/store", "datasets/golden/v1/store.mcap"]);
    assert_eq!((code, out.as_str()), (2, ""), "{err}");
    assert!(err.starts_with("error: output exists: give --force"), "{err}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn mcap_to_parquet_to_mcap_keeps_every_episode(
        agents in prop::collection::vec((any::<bool>(), [0..5_usize, 0..4, 0..4]), 1..5),
        state in 0..6_usize,
        count in 1..7_u64,
        single in any::<bool>(),
    ) {
        let layout = layout(&agents, state);
        let episodes = some(&layout, count);
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        let first = write(&at("a.mcap"), &layout, &episodes, false).unwrap();
        let parquet = at(if single { "b.parquet" } else { "b" });
        convert(&at("a.mcap"), &parquet, false).unwrap();
        let last = convert(&parquet, &at("c.mcap"), false).unwrap().unwrap();
        let hashes = |path: &Path| read(path).unwrap().iter().map(Episode::content_hash).collect::<Vec<_>>();
        prop_assert_eq!(hashes(&at("a.mcap")), hashes(&at("c.mcap")));
        prop_assert_eq!(&first.content, &last.content);
        prop_assert_eq!(verify(&at("c.mcap")).problems, vec![]);
    }
}

#[test]
fn a_newer_version_is_refused_in_every_form_and_names_the_remedy() {
    let layout = small();
    let newer = || Manifest { schema_version: 2, ccmarl: "9.0.0".to_owned(), ..manifest(&layout) };
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        let mut sink = storage::create(&path, &newer(), false).unwrap();
        sink.append(&episode(&layout, 0, 2, false)).unwrap();
        sink.commit().unwrap();
        drop(sink);
        settle(&path);
        let remedy = "schema version 2 is newer than the 1 this program reads: install the ccmarl release";
        assert!(message(recover(&path, false)).contains(remedy), "{form}: a leftover");
        fs::remove_dir_all(partial_path(&path)).or_else(|_| fs::remove_file(partial_path(&path))).unwrap();
        let mut sink = storage::create(&path, &newer(), false).unwrap();
        sink.append(&episode(&layout, 0, 2, false)).unwrap();
        drop(sink.finish());
        assert!(message(read(&path)).contains(remedy), "{form}");
        let report = verify(&path);
        assert!(report.is_wrong() && report.problems[0].message.contains(remedy), "{:?}", report.problems);
    }
}

#[test]
fn an_unknown_ending_does_not_become_a_directory() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    for name in ["x.csv", "x.json", "x.MCAPS", "x.parquet.gz"] {
        let path = directory.path().join(name);
        let error = message(storage::create(&path, &manifest(&layout), true).map(drop));
        assert!(error.starts_with("no store ends in .") && error.contains("ends in / for a directory"), "{error}");
    }
    assert_eq!(names(directory.path()), [""; 0]);
    for name in ["dropout-0.2", "x.csv/", "X.PARQUET", "x.Mcap"] {
        let path = directory.path().join(name);
        write(&path, &layout, &some(&layout, 2), false).unwrap();
        assert_eq!(read(&path).unwrap().len(), 2);
    }
    let (code, _, err) = ccmarl(&["convert", "datasets/golden/v1/store", "x.csv"]);
    assert_eq!(code, 2, "{err}");
}

#[test]
fn names_that_are_no_text_or_hold_escapes_do_no_harm() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    for form in FORMS {
        for (a, b) in [(&b"a\xff"[..], &b"a\xfe"[..]), (b"<b>\x1b[31m", b"<i>\x1b]0;x\x07")] {
            let path = |name: &[u8]| {
                let ending = form.strip_prefix("store").unwrap().as_bytes();
                directory.path().join(OsStr::from_bytes(&[name, ending].concat()))
            };
            // two such names must not share a hidden .partial
            let (mut one, mut two) = (
                storage::create(&path(a), &manifest(&layout), false).unwrap(),
                storage::create(&path(b), &manifest(&layout), false).unwrap(),
            );
            one.append(&episode(&layout, 0, 1, false)).unwrap();
            two.append(&episode(&layout, 0, 2, false)).unwrap();
            one.finish().unwrap();
            drop(two);
            settle(&path(b));
            assert_eq!(recover(&path(b), false).unwrap().episodes, 1);
            assert_eq!((read(&path(a)).unwrap()[0].steps, read(&path(b)).unwrap()[0].steps), (1, 2));
            fs::remove_dir_all(path(b)).or_else(|_| fs::remove_file(path(b))).unwrap();
            let output =
                assert_cmd::Command::new(env!("CARGO_BIN_EXE_ccmarl")).arg("verify").arg(path(b)).output().unwrap();
            assert!(!output.stderr.contains(&0x1b) && !output.stderr.contains(&7), "escapes reach the terminal");
        }
    }
}

#[test]
fn a_record_of_ten_gigabytes_in_a_small_file_is_an_error() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store.mcap");
    write(&path, &layout, &some(&layout, 1), false).unwrap();
    let good = fs::read(&path).unwrap();
    for at in [9, 9 + 8] {
        let mut bytes = good[..1000].to_vec();
        bytes[at..at + 8].copy_from_slice(&(10_u64 << 30).to_le_bytes());
        fs::write(&path, bytes).unwrap();
        let error = message(read(&path));
        assert!(
            error.starts_with("damaged: ") || error.starts_with("cut short, and no episode of it is whole: "),
            "{error}"
        );
        let report = storage::verify(&path, &mut |_, _| None);
        assert!(!report.is_ok_and(|r| r.is_clean()));
    }
}

/// Asks for two gigabytes in the first page header of a Parquet file.
fn greedy(bytes: &mut [u8]) {
    assert_eq!((bytes[4], bytes[5], bytes[6]), (0x15, 0, 0x15), "field 1 is the type, field 2 the size in memory");
    // 2^31 - 1 in zigzag, then field 3, the size in the file, and no further field
    bytes[7..15].copy_from_slice(&[0xfe, 0xff, 0xff, 0xff, 0x0f, 0x15, 0x20, 0]);
}

#[test]
fn a_page_that_asks_for_two_gigabytes_is_refused_before_it_gets_them() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store");
    write(&path, &layout, &some(&layout, 40), false).unwrap();
    let part = data_file(&path);
    let mut bytes = fs::read(&part).unwrap();
    greedy(&mut bytes);
    fs::write(&part, bytes).unwrap();
    let (sha256, _) = ccmarl::io::sha256_file(&part).unwrap();
    let text = fs::read_to_string(path.join("manifest.json")).unwrap();
    let mut manifest = Manifest::parse(&text).unwrap();
    manifest.parts[0].sha256 = sha256;
    fs::write(path.join("manifest.json"), manifest.sealed_json().unwrap()).unwrap();
    let error = message(read(&path));
    assert!(error.contains("a page asks for 2147483647 bytes or values, over the limit 67108864"), "{error}");
}

#[test]
fn columns_of_a_damaged_store_are_not_taken_as_a_table() {
    let directory = tempfile::tempdir().unwrap();
    let copy = |name: &str| {
        let to = directory.path().join(name);
        fs::copy(golden_folder().join("store.parquet"), &to).unwrap();
        to
    };
    let (good, bad) = (copy("good.parquet"), copy("bad.parquet"));
    let mut bytes = fs::read(&bad).unwrap();
    bytes[100] ^= 1;
    fs::write(&bad, bytes).unwrap();
    let estimate = |path: &Path| {
        let words = ["estimate-mi", path.to_str().unwrap(), "--x", "reward", "--y", "reward.agent_0"];
        ccmarl(&[&words[..], &["--estimator", "gaussian"]].concat())
    };
    let (_, _, err) = estimate(&good);
    assert!(!err.contains("digest"), "{err}");
    let (code, out, err) = estimate(&bad);
    assert_eq!((code, out.as_str()), (1, ""));
    assert!(err.contains("its bytes do not have the digest"), "{err}");
    let part = directory.path().join("store");
    fs::create_dir(&part).unwrap();
    for file in ["manifest.json", "part-00000.parquet"] {
        fs::copy(golden_folder().join("store").join(file), part.join(file)).unwrap();
    }
    let mut bytes = fs::read(part.join("part-00000.parquet")).unwrap();
    bytes[100] ^= 1;
    fs::write(part.join("part-00000.parquet"), bytes).unwrap();
    let (code, _, err) = estimate(&part.join("part-00000.parquet"));
    assert_eq!(code, 1);
    assert!(err.contains("the bytes changed since it was written"), "{err}");
}

#[test]
fn a_row_too_wide_for_any_reader_is_refused() {
    let wide = layout(&[(true, [1 << 20, 1 << 20, 1 << 20]); 5], 0);
    let error = wide.check().unwrap_err().to_string();
    assert!(error.contains("a row of") && error.contains("over the limit of 50331648"), "{error}");
}

#[test]
fn a_leftover_with_data_beside_a_whole_store_is_not_removed() {
    let directory = tempfile::tempdir().unwrap();
    let store = directory.path().join("m");
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("datasets/golden/v1/store.parquet");
    convert(&golden, &store, false).unwrap();
    let part = directory.path().join(".m.partial/part-00001.parquet");
    ccmarl::io::write_atomic(&part, b"episodes of another recording").unwrap();
    assert!(recover(&store, false).is_err());
    assert!(part.exists());
}
