//! What is left of a killed or damaged store: a changed bit never becomes data, what is sound is saved, and what is said
//! is what happened.
#![expect(clippy::disallowed_methods, reason = "damaged files are written in place on purpose")]

use std::fs;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use ccmarl::io::partial_path;
use ccmarl::schema::{Episode, Layout, Manifest};
use ccmarl::storage::{self, Rescued, StorageError};

use super::integrity::{ccmarl, convert, killed, names, recover, settle, verify};
use super::stores::{FORMS, data_file, episode, layout, manifest, message, read, reseal, small, some, write};

/// The file with the episodes of a leftover without sealed parts.
fn journal(leftover: &Path) -> PathBuf {
    if leftover.is_dir() { leftover.join("journal-00000.arrows") } else { leftover.to_owned() }
}

fn flip(file: &Path, bit: u64) {
    let file = fs::File::options().read(true).write(true).open(file).unwrap();
    let mut byte = [0];
    file.read_exact_at(&mut byte, bit / 8).unwrap();
    file.write_all_at(&[byte[0] ^ 1 << (bit % 8)], bit / 8).unwrap();
}

/// Verifies what is left of `path`, and checks that every episode given out is the one that was recorded.
fn sound(path: &Path, expected: &[Episode], manifest: &Manifest, what: &str) -> (u64, bool) {
    let mut watch = |found: &Manifest, e: &Episode| {
        assert!(expected.get(e.index as usize) == Some(e), "{what}: episode {} changed", e.index);
        assert_eq!(Manifest { self_sha256: String::new(), ..found.unsealed() }, *manifest, "{what}");
        None
    };
    storage::verify(path, &mut watch).map_or((0, true), |report| {
        assert!(!report.is_clean(), "{what}: a leftover is never clean");
        (report.episodes, report.is_wrong())
    })
}

#[test]
fn a_flipped_bit_of_a_leftover_never_becomes_an_episode() {
    let layout = layout(&[(true, [1, 1, 1])], 1);
    let episodes: Vec<Episode> = (0..2).map(|i| episode(&layout, i, 2, i == 1)).collect();
    let directory = tempfile::tempdir().unwrap();
    for form in ["store", "store.mcap"] {
        let path = directory.path().join(form);
        let described = Manifest { planned: 2, ..manifest(&layout) };
        let mut sink = storage::create(&path, &described, false).unwrap();
        for e in &episodes {
            sink.append(e).unwrap();
            sink.commit().unwrap();
        }
        drop(sink);
        settle(&path);
        let file = journal(&partial_path(&path));
        let bits = file.metadata().unwrap().len() * 8;
        assert_eq!(sound(&path, &episodes, &described, "whole"), (2, false));
        let (mut whole, mut fewer) = (0, 0);
        for bit in 0..bits {
            let what = format!("{form}, bit {bit} of {bits}");
            flip(&file, bit);
            let (count, wrong) = sound(&path, &episodes, &described, &what);
            (whole, fewer) = (whole + u64::from(count == 2), fewer + u64::from(count < 2 && !wrong));
            if bit % 1499 == 0 && count > 0 {
                // recover takes what verify took, and calls it a loss when that is not all
                let copy = directory.path().join(format!("copy-{form}"));
                let copied = partial_path(&copy);
                if file == partial_path(&path) {
                    fs::copy(&file, &copied).unwrap();
                } else {
                    fs::create_dir(&copied).unwrap();
                    fs::copy(&file, journal(&copied)).unwrap();
                }
                let back = recover(&copy, false).unwrap();
                assert_eq!((back.episodes, back.is_loss()), (count, count < 2 || wrong), "{what}");
                assert_eq!(back.kept.is_some(), wrong, "{what}: what could not be read is kept");
                assert_eq!(read(&copy).unwrap(), episodes[..count as usize], "{what}");
                fs::remove_dir_all(&copy).or_else(|_| fs::remove_file(&copy)).unwrap();
                if let Some(kept) = back.kept {
                    fs::remove_dir_all(&kept).or_else(|_| fs::remove_file(&kept)).unwrap();
                }
            }
            flip(&file, bit);
        }
        println!(
            "{form}: {bits} bits; {whole} leave both episodes as they are, {fewer} look like an end that a kill left"
        );
        // padding and the times of chunks are nobody's data; a torn end is the length of the last message
        assert!(whole < bits * 2 / 3 && fewer < bits / 20, "{form}: {whole} {fewer} of {bits}");
    }
}

#[test]
fn a_flipped_bit_of_a_sealed_part_of_a_leftover_is_noticed() {
    let layout = layout(&[(true, [1, 1, 1])], 1);
    let episodes: Vec<Episode> = (0..4100).map(|i| episode(&layout, i, 1, false)).collect();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store");
    let leftover = killed(&path, &layout, &episodes, 5000);
    let described = Manifest { planned: 5000, ..manifest(&layout) };
    assert_eq!(names(&leftover), ["journal-00001.arrows", "lock", "part-00000.parquet"]);
    let part = leftover.join("part-00000.parquet");
    assert_eq!(sound(&path, &episodes, &described, "whole"), (4100, false));
    let bits = part.metadata().unwrap().len() * 8;
    for bit in (0..40).map(|k| k * (bits / 40) + 17 * k) {
        flip(&part, bit);
        let (count, wrong) = sound(&path, &episodes, &described, &format!("bit {bit}"));
        assert!(count == 4100 || (count == 0 && wrong), "bit {bit}: {count} episodes");
        flip(&part, bit);
    }
    // a journal that can no longer be read still vouches for the parts before it
    let journal = leftover.join("journal-00001.arrows");
    flip(&journal, 0);
    let (count, wrong) = sound(&path, &episodes, &described, "journal");
    assert_eq!((count, wrong), (4000, true));
    // without it nothing does
    fs::remove_file(journal).unwrap();
    let report = verify(&path);
    assert_eq!(report.episodes, 0);
    let unknown = "no journal and no manifest that is left has the digest of its episodes";
    assert!(report.problems[0].message.starts_with(unknown), "{report:?}");
}

#[test]
fn a_damaged_length_is_no_torn_end_and_what_follows_is_kept() {
    let layout = small();
    let episodes = some(&layout, 6);
    for form in ["store", "store.mcap"] {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        let mut sink = storage::create(&path, &Manifest { planned: 6, ..manifest(&layout) }, false).unwrap();
        for pair in episodes.chunks(2) {
            sink.append_all(pair).unwrap();
            sink.commit().unwrap();
        }
        drop(sink);
        settle(&path);
        let file = journal(&partial_path(&path));
        let bytes = fs::read(&file).unwrap();
        // the second batch of the journal, or the third chunk
        let at = if form == "store" {
            let messages: Vec<usize> =
                (0..bytes.len() - 8).step_by(8).filter(|&at| begins_a_message(&bytes[at..])).collect();
            assert_eq!(messages.len(), 4, "a schema and three batches");
            messages[2] + 7
        } else {
            let chunks = bytes.windows(8).enumerate().filter(|(_, w)| w == b"\x04\0\0\0zstd").map(|(at, _)| at - 37);
            chunks.collect::<Vec<_>>()[2] + 8
        };
        flip(&file, at as u64 * 8);
        let report = verify(&path);
        assert!(report.is_wrong() && report.episodes == 2, "{form}: {report:?}");
        let (code, _, err) = ccmarl(&["recover", path.to_str().unwrap()]);
        assert_eq!(code, 3, "{err}");
        assert!(
            err.contains("what could not be read is kept: ") && err.contains("lost: 4 of 6 planned episodes\n"),
            "{err}"
        );
        assert!(directory.path().join(format!(".{form}.unrecovered-1")).exists());
        assert_eq!(read(&path).unwrap(), episodes[..2]);
    }
}

/// Whether bytes begin as an Arrow IPC message of ours does: the marker, and a head of some hundred bytes.
fn begins_a_message(bytes: &[u8]) -> bool {
    let length = u32::from_le_bytes(bytes[4..8].try_into().unwrap());
    bytes[..4] == [0xff; 4] && length > 64 && length < 1 << 14 && length.is_multiple_of(8)
}

#[test]
fn a_kill_before_the_first_commit_is_said_plainly() {
    let layout = small();
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        let leftover = killed(&path, &layout, &some(&layout, 1), 5);
        for length in [5, 0] {
            fs::File::options().write(true).open(journal(&leftover)).unwrap().set_len(length).unwrap();
            let plain = "killed before its first episode was committed";
            let error = message(recover(&path, false));
            assert!(error.starts_with(&format!("{plain}: there is nothing to recover")), "{form}, {length}: {error}");
            let report = verify(&path);
            assert_eq!(report.problems.len(), 1);
            assert!(report.problems[0].lost && report.problems[0].message.contains(plain), "{report:?}");
        }
    }
}

#[test]
fn a_store_that_is_being_written_is_not_called_dead() {
    let layout = small();
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        let mut sink = storage::create(&path, &manifest(&layout), false).unwrap();
        sink.append_all(&some(&layout, 3)).unwrap();
        sink.commit().unwrap();
        let name = path.to_str().unwrap();
        for command in ["verify", "inspect"] {
            let (code, out, err) = ccmarl(&[command, name]);
            assert_eq!((code, out.as_str()), (1, ""), "{command} {form}");
            assert!(err.contains(" is writing it right now: wait until it has ended, or take another name"), "{err}");
        }
        sink.finish().unwrap();
        assert_eq!(ccmarl(&["verify", name]).0, 0);
    }
}

#[test]
fn nobody_takes_the_name_while_a_store_gets_it() {
    let layout = small();
    let episodes = some(&layout, 2);
    for form in FORMS {
        for _ in 0..10 {
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join(form);
            let mut sink = storage::create(&path, &manifest(&layout), true).unwrap();
            sink.append_all(&episodes).unwrap();
            let (stop, other) = (AtomicBool::new(false), path.clone());
            std::thread::scope(|scope| {
                let stop = &stop;
                scope.spawn(move || {
                    while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                        storage::create(&other, &manifest(&small()), true).map(drop).ok();
                    }
                });
                let finished = sink.finish();
                stop.store(true, std::sync::atomic::Ordering::Relaxed);
                finished.unwrap();
            });
            assert_eq!(read(&path).unwrap(), episodes, "{form}");
            assert!(!path.join("lock").exists());
        }
    }
}

#[test]
fn a_lock_that_a_kill_left_in_a_whole_store_harms_nobody() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store");
    write(&path, &layout, &some(&layout, 2), false).unwrap();
    fs::write(path.join("lock"), "1").unwrap();
    assert_eq!(verify(&path).problems, []);
    write(&path, &layout, &some(&layout, 3), true).unwrap();
    assert_eq!(names(&path), ["manifest.json", "part-00000.parquet"]);
}

#[test]
fn a_killed_conversion_is_called_one() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let source = directory.path().join("source.mcap");
    write(&source, &layout, &some(&layout, 5), false).unwrap();
    for form in FORMS {
        let (to, copy) = (directory.path().join(format!("to-{form}")), directory.path().join(format!("copy-{form}")));
        let (from, into) = (partial_path(&to), partial_path(&copy));
        // what a kill after two episodes leaves
        let mut watch = |_: &Manifest, e: &Episode| {
            if e.index == 1 && from.is_dir() {
                fs::create_dir(&into).unwrap();
                fs::copy(journal(&from), journal(&into)).unwrap();
            } else if e.index == 1 {
                fs::copy(&from, &into).unwrap();
            }
        };
        let options = storage::Options { force: false, viewer: true };
        storage::convert(&source, &to, options, &mut watch, &AtomicBool::new(false)).unwrap().unwrap();
        let error = message(storage::open(&copy).map(drop));
        assert!(error.starts_with("its conversion did not finish; `ccmarl recover"), "{error}");
        let report = verify(&copy);
        assert!(report.problems[0].message.starts_with("the conversion did not finish: "), "{report:?}");
        assert!(
            report.problems[0].message.ends_with(" puts them in place, and the same command with --force starts anew")
        );
        convert(&source, &copy, true).unwrap().unwrap();
        assert_eq!(read(&copy).unwrap().len(), 5);
        // the finished store does not say how it was made
        assert!(!fs::read_to_string(to.join("manifest.json")).is_ok_and(|text| text.contains("task")));
    }
}

#[test]
fn a_cut_mcap_file_names_the_remedy_and_is_no_stopped_recording() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store.mcap");
    write(&path, &layout, &(0..4).map(|i| episode(&layout, i, 3, false)).collect::<Vec<_>>(), false).unwrap();
    let length = path.metadata().unwrap().len();
    fs::File::options().write(true).open(&path).unwrap().set_len(length / 2).unwrap();
    let name = path.to_str().unwrap();
    let (code, out, _) = ccmarl(&["verify", name, "--format", "json"]);
    assert_eq!(code, 3);
    assert!(
        out.contains("cut short: copy it again, or keep its whole episodes with `ccmarl recover --force`"),
        "{out}"
    );
    assert!(!out.contains("the recording was stopped"), "{out}");
    let error = message(read(&path));
    let remedy = format!("whole episodes: copy it again, or keep these with `ccmarl recover --force {name}`");
    assert!(error.starts_with("cut short after ") && error.contains(&remedy), "{error}");
}

/// Saves what is sound of a damaged store, by the command; exit code and stderr.
fn rescue(from: &Path, to: &Path) -> (i32, String) {
    let (code, out, err) = ccmarl(&["recover", from.to_str().unwrap(), "--out", to.to_str().unwrap()]);
    assert_eq!(code == 3 && !err.contains("nothing was written"), out.starts_with("recovered "), "{out}{err}");
    (code, err)
}

/// Episodes with these numbers, counted from 0 anew.
fn renumbered(episodes: &[Episode], ranges: &[[usize; 2]]) -> Vec<Episode> {
    let kept = ranges.iter().flat_map(|&[from, to]| &episodes[from..to]);
    kept.enumerate().map(|(index, e)| Episode { index: index as u64, ..e.clone() }).collect()
}

#[test]
fn a_directory_with_one_bad_part_gives_its_other_episodes() {
    let layout = layout(&[(true, [1, 1, 1])], 0);
    let episodes: Vec<Episode> = (0..8500).map(|i| episode(&layout, i, 1, false)).collect();
    let directory = tempfile::tempdir().unwrap();
    let (path, saved) = (directory.path().join("store"), directory.path().join("saved.mcap"));
    write(&path, &layout, &episodes, false).unwrap();
    let part = path.join("part-00001.parquet");
    flip(&part, part.metadata().unwrap().len() * 2);
    let before = fs::read(&part).unwrap();
    let report = verify(&path);
    assert_eq!(report.episodes, 4500, "none of the bad part's are taken for sound");
    assert!(
        report
            .problems
            .iter()
            .any(|p| p.message.contains("episodes 4000 to 7999 are in it, and do not have their digest"))
    );
    let (_, out, _) = ccmarl(&["verify", path.to_str().unwrap(), "--format", "json"]);
    assert!(out.contains("\"content\": null"), "the manifest's digest is not that of 4500 episodes: {out}");
    let (_, _, hint) = ccmarl(&["recover", path.to_str().unwrap()]);
    assert!(hint.contains("--out NEW` saves what is sound"), "{hint}");
    let (code, err) = rescue(&path, &saved);
    assert_eq!((code, err.as_str()), (3, "lost: 4000 of 8500 episodes: 4000 to 7999\n"));
    assert!(read(&saved).unwrap() == renumbered(&episodes, &[[0, 4000], [8000, 8500]]));
    let source = storage::open(&saved).unwrap();
    assert_eq!((source.manifest().kept.clone(), source.manifest().planned), (vec![[0, 4000], [8000, 8500]], 8500));
    let (code, out, _) = ccmarl(&["verify", saved.to_str().unwrap()]);
    assert_eq!(code, 0);
    assert!(
        out.contains("saved from a damaged store, where its episodes were numbered 0 to 3999, 8000 to 8499"),
        "{out}"
    );
    assert!(fs::read(&part).unwrap() == before, "the damaged store is only read");
}

#[test]
fn an_mcap_file_with_bad_chunks_gives_its_other_episodes() {
    let layout = small();
    let episodes: Vec<Episode> = (0..6).map(|i| episode(&layout, i, 3, false)).collect();
    let directory = tempfile::tempdir().unwrap();
    let (path, saved) = (directory.path().join("store.mcap"), directory.path().join("saved"));
    write(&path, &layout, &episodes, false).unwrap();
    let bytes = fs::read(&path).unwrap();
    let chunks = || bytes.windows(8).enumerate().filter(|(_, w)| w == b"\x04\0\0\0zstd").map(|(at, _)| at);
    for chunk in [1, 4] {
        flip(&path, (chunks().nth(chunk).unwrap() as u64 + 60) * 8);
    }
    assert_eq!(rescue(&path, &saved), (3, "lost: 2 of 6 episodes: 1, 4\n".to_owned()));
    assert_eq!(read(&saved).unwrap(), renumbered(&episodes, &[[0, 1], [2, 4], [5, 6]]));
    // a chunk that is there twice: each episode once
    let doubled = directory.path().join("doubled.mcap");
    let [second, third] = [1, 2].map(|k| chunks().nth(k).unwrap() - 37);
    fs::write(&doubled, [&bytes[..third], &bytes[second..third], &bytes[third..]].concat()).unwrap();
    assert!(message(read(&doubled)).starts_with("damaged: "));
    let report = verify(&doubled);
    assert!(report.problems.iter().any(|p| p.message.contains("expected episode 2 step 0, found episode 1 step 0")));
    assert_eq!(report.episodes, 6);
    let saved = directory.path().join("once");
    assert_eq!(rescue(&doubled, &saved), (3, "no episode was lost: what is damaged is none of them\n".to_owned()));
    assert_eq!(read(&saved).unwrap(), episodes);
}

#[test]
fn episodes_that_were_planned_and_never_recorded_are_not_lost() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let (path, saved) = (directory.path().join("store.mcap"), directory.path().join("saved"));
    let mut sink = storage::create(&path, &Manifest { planned: 500_000, ..manifest(&layout) }, false).unwrap();
    for i in 0..6 {
        sink.append(&episode(&layout, i, 3, false)).unwrap();
        sink.commit().unwrap(); // each in a chunk of its own
    }
    sink.finish().unwrap();
    let bytes = fs::read(&path).unwrap();
    let second = bytes.windows(8).enumerate().filter(|(_, w)| w == b"\x04\0\0\0zstd").nth(1).unwrap().0;
    flip(&path, (second as u64 + 60) * 8);
    assert_eq!(rescue(&path, &saved), (3, "lost: 1 of 6 episodes: 1\n".to_owned()));
    assert_eq!(storage::open(&saved).unwrap().manifest().planned, 6);
}

#[test]
fn one_file_gives_all_or_nothing() {
    let layout = small();
    let episodes = some(&layout, 40);
    let directory = tempfile::tempdir().unwrap();
    let (path, saved) = (directory.path().join("store.parquet"), directory.path().join("saved"));
    write(&path, &layout, &episodes, false).unwrap();
    let good = fs::read(&path).unwrap();
    flip(&path, 100 * 8);
    assert_eq!(verify(&path).episodes, 0);
    let (code, err) = rescue(&path, &saved);
    assert_eq!((code, saved.exists()), (3, false), "{err}");
    assert!(
        err.contains("lost: 40 of 40 episodes: 0 to 39") && err.contains("no episode is sound: nothing was written")
    );
    // in the name of the program that wrote it nothing is lost
    let name = good.windows(10).rposition(|w| w == b"parquet-rs").unwrap();
    fs::write(&path, &good).unwrap();
    flip(&path, name as u64 * 8);
    assert_eq!(verify(&path).episodes, 40);
    assert_eq!(rescue(&path, &saved).0, 3);
    assert_eq!(read(&saved).unwrap(), episodes);
}

#[test]
fn a_damaged_manifest_is_not_believed_where_a_copy_can_be() {
    let layout = small();
    let episodes = some(&layout, 4);
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let (path, saved) = (directory.path().join(form), directory.path().join("saved"));
        write(&path, &layout, &episodes, false).unwrap();
        let file = if path.is_dir() { path.join("manifest.json") } else { path.clone() };
        let bytes = fs::read(&file).unwrap();
        let name = bytes.windows(7).rposition(|w| w == b"made-up").unwrap();
        flip(&file, name as u64 * 8);
        let (code, err) = rescue(&path, &saved);
        if form == "store.parquet" {
            assert_eq!((code, saved.exists()), (1, false), "its one manifest");
            assert!(err.contains("no manifest in it can be trusted"), "{err}");
            continue;
        }
        assert_eq!(code, 3, "{form}: {err}");
        assert_eq!(read(&saved).unwrap(), episodes);
        assert_eq!(storage::open(&saved).unwrap().manifest().scenario["name"], "made-up", "{form}");
    }
}

#[test]
fn what_was_to_replace_a_store_is_named_and_both_can_be_kept() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let episodes = some(&layout, 3);
    write(&at("tag"), &layout, &episodes[..1], false).unwrap();
    fs::rename(at("tag"), at("aside")).unwrap();
    killed(&at("tag"), &layout, &episodes, 5);
    fs::rename(at("aside"), at("tag")).unwrap();
    let path = at("tag").to_string_lossy().into_owned();
    let partial = at(".tag.partial").to_string_lossy().into_owned();
    for words in [
        &["recover", &path, "--out", at("new").to_str().unwrap()][..],
        &["recover", &partial, "--out", at("new").to_str().unwrap()],
        &["recover", &path],
    ] {
        let (code, _, err) = ccmarl(words);
        assert_eq!(code, 2, "{err}");
        let said =
            format!("beside this store lies what did not finish; `ccmarl recover --force {path}` puts its whole");
        assert!(
            err.contains(&said) && err.contains("give the store another name first and leave out --force"),
            "{err}"
        );
    }
    fs::rename(at("tag"), at("old")).unwrap();
    assert_eq!(recover(&at("tag"), false).unwrap().episodes, 3);
    assert_eq!((read(&at("tag")).unwrap().len(), read(&at("old")).unwrap().len()), (3, 1));
}

#[test]
fn saving_refuses_what_is_whole_unfinished_taken_or_missing() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    write(&at("whole"), &layout, &some(&layout, 2), false).unwrap();
    killed(&at("killed"), &layout, &some(&layout, 2), 5);
    let save = |from: &str, to: &str| {
        let stop = AtomicBool::new(false);
        message(storage::rescue(&at(from), &at(to), false, &mut |_, _| {}, &stop))
    };
    assert!(save("whole", "new").starts_with("nothing to recover: it is whole"));
    assert!(save("killed", "new").starts_with("its recording did not finish; `ccmarl recover"));
    assert!(save("missing", "new").starts_with("no such file or directory"));
    assert!(save("whole", "whole").starts_with("output exists"));
    assert!(save("whole", "whole/new").starts_with("the output would lie inside the store"));
    fs::write(at("text.parquet"), "text").unwrap();
    assert!(save("text.parquet", "new").starts_with("not a rollout store"));
    assert!(!at("new").exists());
    // stopped, it leaves nothing
    flip(&data_file(&at("whole")), 800);
    reseal(&at("whole"), |m| m.parts[0].content = "0".repeat(64));
    let stopped = storage::rescue(&at("whole"), &at("new"), false, &mut |_, _| {}, &AtomicBool::new(true));
    assert!(matches!(stopped, Ok(None | Some(Rescued { episodes: 0, .. }))), "{stopped:?}");
    assert_eq!(names(directory.path()), [".killed.partial", "text.parquet", "whole"]);
}

#[test]
fn lost_ranges_are_what_was_not_kept() {
    let rescued = |kept: &[[u64; 2]]| Rescued { episodes: 0, planned: 10, kept: kept.to_vec() };
    assert_eq!(rescued(&[]).lost(), [[0, 10]]);
    assert_eq!(rescued(&[[0, 10]]).lost(), [[0; 2]; 0]);
    assert_eq!(rescued(&[[1, 3], [4, 9]]).lost(), [[0, 1], [3, 4], [9, 10]]);
    assert_eq!(storage::ranges(&[[0, 1], [3, 7]]), "0, 3 to 6");
    let many: Vec<[u64; 2]> = (0..25).map(|i| [2 * i, 2 * i + 1]).collect();
    assert!(storage::ranges(&many).ends_with("36, 38 and 5 more ranges"));
}

/// Whether an MCAP file has the topics that viewers draw.
fn draws(path: &Path) -> bool {
    let bytes = fs::read(path).unwrap();
    ["/scene", "/poses"].iter().all(|topic| bytes.windows(6).any(|w| w == topic.as_bytes()))
}

#[test]
fn what_viewers_draw_stays_away_when_it_was_left_out() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let run = |words: &[&str]| assert_eq!(ccmarl(words).0, 0, "{words:?}");
    let record = ["record", "--scenario", "simple_spread", "--episodes", "3"];
    run(&[&record[..], &["--out", &at("with.mcap")]].concat());
    run(&[&record[..], &["--no-viewer", "--out", &at("without.mcap")]].concat());
    run(&["convert", &at("with.mcap"), &at("parquet")]);
    for (from, to, more, expected) in [
        ("with.mcap", "a.mcap", None, true),
        ("with.mcap", "b.mcap", Some("--no-viewer"), false),
        ("without.mcap", "c.mcap", None, false),
        ("parquet", "d.mcap", None, true),
        ("parquet", "e.mcap", Some("--no-viewer"), false),
    ] {
        run(&[&["convert", &at(from)[..], &at(to)], more.as_slice()].concat());
        assert_eq!(draws(Path::new(&at(to))), expected, "{from} to {to} {more:?}");
    }
    for (name, expected) in [("with.mcap", true), ("without.mcap", false)] {
        // as a kill leaves it: before the end
        let path = PathBuf::from(at(name));
        let bytes = fs::read(&path).unwrap();
        let summary = bytes.windows(15).position(|w| w == b"ccmarl.manifest").unwrap();
        fs::write(partial_path(&path), &bytes[..summary - 20]).unwrap();
        fs::remove_file(&path).unwrap();
        let back = recover(&path, false).unwrap();
        assert_eq!((back.episodes, draws(&path)), (3, expected), "{name}");
    }
}

#[test]
fn a_stopped_recovery_leaves_all_as_it_was() {
    let layout: Layout = small();
    for form in FORMS {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join(form);
        killed(&path, &layout, &some(&layout, 5), 5);
        let before = names(directory.path());
        let stopped = storage::recover(&path, false, &mut |_, _| {}, &AtomicBool::new(true)).unwrap();
        assert!(stopped.is_none());
        assert_eq!(names(directory.path()), before, "{form}");
        let error = message(read(&path));
        assert!(matches!(read(&path), Err(StorageError::Unfinished { .. })), "{error}");
        assert_eq!(recover(&path, false).unwrap().episodes, 5);
    }
}
