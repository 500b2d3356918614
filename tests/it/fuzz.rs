//! Hostile stores: mutations of small good ones go through every reader. Whatever comes in, a reader ends with episodes
//! or a typed error: no panic, no abort, and memory within bounds.
//!
//! Each target also gets its checksums put right after a mutation, so that what lies behind them is reached. A short run
//! is part of the tests; `CCMARL_FUZZ_SECONDS=600 cargo test --release -- --ignored fuzz::long` is a long one.
#![expect(clippy::disallowed_methods, reason = "damaged files are written in place on purpose")]

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ccmarl::rng::{Seeds, Stream, below};
use ccmarl::schema::hex;
use ccmarl::storage;
use sha2::{Digest as _, Sha256};

use super::stores::{episode, layout, manifest, write};

/// Most memory that this process may ever have had, KiB: the readers' limits together, many times over for the other
/// tests that run beside.
const MEMORY_KIB: u64 = 3 << 20;

/// Changes bytes: flips bits, cuts, splices, repeats, and writes numbers that lengths would be.
fn mutate(rng: &mut Stream, bytes: &mut Vec<u8>) {
    for _ in 0..=below(rng, 3) {
        if bytes.is_empty() {
            return;
        }
        let at = below(rng, bytes.len());
        match below(rng, 7) {
            0 | 1 => bytes[at] ^= 1 << below(rng, 8),
            2 => bytes[at] = below(rng, 256) as u8,
            3 => bytes.truncate(at),
            4 => {
                let numbers = [0, 1, 0x7f, 0xff, 0xffff, 0x7fff_ffff, 0xffff_ffff, 10 << 30, u64::MAX];
                let number = numbers[below(rng, numbers.len())].to_le_bytes();
                let width = [1, 2, 4, 8][below(rng, 4)];
                for (byte, new) in bytes[at..].iter_mut().zip(&number[..width]) {
                    *byte = *new;
                }
            }
            5 => {
                let (from, length) = (below(rng, bytes.len()), below(rng, 64));
                let piece = bytes[from..(from + length).min(bytes.len())].to_vec();
                let end = (at + if below(rng, 2) == 0 { 0 } else { piece.len() }).min(bytes.len());
                bytes.splice(at..end, piece);
            }
            _ => {
                let end = (at + below(rng, 32)).min(bytes.len());
                bytes.drain(at..end);
            }
        }
    }
}

/// CRC-32 as MCAP has it.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg()))
    })
}

/// Puts the checksums of an MCAP file right, as far as its records can be followed: uncompressed chunks, data, summary.
fn fix_mcap(bytes: &mut [u8]) {
    let (mut at, mut summary) = (8_usize, 0);
    while let Some(head) = bytes.get(at..at + 9) {
        let (opcode, length) = (head[0], u64::from_le_bytes(head[1..9].try_into().unwrap()) as usize);
        let Some(end) = (at + 9).checked_add(length).filter(|&end| end <= bytes.len()) else { return };
        match opcode {
            6 if length > 40 && bytes[at + 37..at + 41] == [0; 4] => {
                let crc = crc32(&bytes[at + 49..end]);
                bytes[at + 33..at + 37].copy_from_slice(&crc.to_le_bytes());
            }
            15 if length == 4 => {
                let crc = crc32(&bytes[..at]);
                bytes[at + 9..end].copy_from_slice(&crc.to_le_bytes());
                summary = end;
            }
            2 if length == 20 => {
                let crc = crc32(&bytes[summary..end - 4]);
                bytes[end - 4..end].copy_from_slice(&crc.to_le_bytes());
            }
            _ => {}
        }
        at = end;
    }
}

/// An MCAP store with the same records, but chunks without compression: mutations reach the records.
fn without_compression(bytes: &[u8]) -> Vec<u8> {
    use mcap::WriteOptions;
    use mcap::records::Record;
    let options = WriteOptions::new().compression(None).disable_seeking(true);
    let mut writer = options.create(std::io::Cursor::new(Vec::new())).unwrap();
    let mut channels = std::collections::BTreeMap::new();
    for message in mcap::MessageStream::new(bytes).unwrap() {
        let message = message.unwrap();
        let channel = &message.channel;
        let id = *channels.entry(channel.id).or_insert_with(|| {
            let schema = channel.schema.as_ref().unwrap();
            let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data).unwrap();
            writer.add_channel(schema, &channel.topic, &channel.message_encoding, &channel.metadata).unwrap()
        });
        let header = mcap::records::MessageHeader {
            channel_id: id,
            sequence: message.sequence,
            log_time: message.log_time,
            publish_time: message.publish_time,
        };
        writer.write_to_known_channel(&header, &message.data).unwrap();
    }
    for record in mcap::read::LinearReader::new(bytes).unwrap() {
        if let Record::Metadata(metadata) = record.unwrap() {
            writer.write_metadata(&metadata).unwrap();
        }
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}

/// Puts the digest of a single Parquet file right.
fn fix_parquet(bytes: &mut [u8]) {
    let key = b"ccmarl.file_sha256";
    let Some(at) = bytes.windows(key.len()).rposition(|w| w == key).map(|at| at + key.len() + 2) else { return };
    if at + 64 <= bytes.len() {
        bytes[at..at + 64].fill(b'0');
        let digest = hex(&Sha256::digest(&*bytes));
        bytes[at..at + 64].copy_from_slice(digest.as_bytes());
    }
}

/// Puts the digest of a manifest right.
fn fix_manifest(bytes: &mut [u8]) {
    let key = b"\"self_sha256\": \"";
    let Some(at) = bytes.windows(key.len()).rposition(|w| w == key).map(|at| at + key.len()) else { return };
    if at + 64 <= bytes.len() {
        bytes[at..at + 64].fill(b'0');
        let digest = hex(&Sha256::digest(&*bytes));
        bytes[at..at + 64].copy_from_slice(digest.as_bytes());
    }
}

/// A good file that is mutated, and how its checksums are put right.
struct Target {
    _folder: tempfile::TempDir,
    store: PathBuf,
    file: PathBuf,
    good: Vec<u8>,
    fix: fn(&mut [u8]),
}

impl Target {
    fn new(name: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let layout = layout(&[(true, [2, 1, 1]), (true, [1, 2, 0]), (false, [1, 0, 1])], 2);
        let episodes: Vec<_> = (0..3).map(|i| episode(&layout, i, 2, i == 1)).collect();
        let at = |name: &str| folder.path().join(name);
        let store = at(if name == "mcap" {
            "store.mcap"
        } else if name == "parquet" {
            "store.parquet"
        } else {
            "store"
        });
        let (mut file, mut fix): (PathBuf, fn(&mut [u8])) = (store.clone(), fix_parquet);
        if name == "journal" {
            let mut sink = storage::create(&store, &manifest(&layout), false).unwrap();
            sink.append_all(&episodes).unwrap();
            sink.commit().unwrap();
            drop(sink);
            super::integrity::settle(&store);
            (file, fix) = (at(".store.partial").join("journal-00000.arrows"), |_: &mut [u8]| {});
        } else {
            write(&store, &layout, &episodes, false).unwrap();
        }
        match name {
            "mcap" => {
                fs::write(&file, without_compression(&fs::read(&file).unwrap())).unwrap();
                fix = fix_mcap;
            }
            "manifest" => (file, fix) = (store.join("manifest.json"), fix_manifest),
            _ => {}
        }
        let good = fs::read(&file).unwrap();
        let target = Self { _folder: folder, store, file, good, fix };
        assert!(target.takes_the_good_one(), "{name}");
        target
    }

    fn takes_the_good_one(&self) -> bool {
        let mut fixed = self.good.clone();
        (self.fix)(&mut fixed);
        fs::write(&self.file, fixed).unwrap();
        let report = storage::verify(&self.store, &mut |_, _| None).unwrap();
        let whole = report.episodes == 3 && !report.is_wrong();
        let unfinished = self.file.starts_with(self.store.with_file_name(".store.partial"));
        whole && report.is_clean() != unfinished
    }

    /// One mutation through all readers.
    fn once(&self, rng: &mut Stream) {
        let mut bytes = self.good.clone();
        mutate(rng, &mut bytes);
        if below(rng, 4) > 0 {
            (self.fix)(&mut bytes);
        }
        fs::write(&self.file, &bytes).unwrap();
        let verdict = std::panic::catch_unwind(|| drop(storage::verify(&self.store, &mut |_, _| None)));
        if verdict.is_err() {
            keep(&bytes);
        }
        let kib = peak_kib();
        if kib > MEMORY_KIB {
            keep(&bytes);
        }
    }
}

/// Stops the run, and leaves the input where it can be looked at.
fn keep(bytes: &[u8]) {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fuzz-input");
    fs::write(&path, bytes).unwrap();
    panic!("a reader panicked or took {} KiB: see {}", peak_kib(), path.display());
}

/// Most memory that this process has had, KiB (Linux).
fn peak_kib() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap_or("0");
    line.trim().trim_end_matches(" kB").parse().unwrap()
}

fn run(name: &str, seed: u64, time: Duration, most: u64) -> u64 {
    let (target, start) = (Target::new(name), Instant::now());
    let mut rng = Seeds::new(seed).stream(name);
    let mut count = 0;
    while count < most && start.elapsed() < time {
        target.once(&mut rng);
        count += 1;
    }
    count
}

const TARGETS: [&str; 4] = ["manifest", "parquet", "mcap", "journal"];

#[test]
fn no_mutation_of_a_store_makes_a_reader_panic() {
    for name in TARGETS {
        run(name, 1, Duration::from_mins(1), 300);
    }
}

/// `CCMARL_FUZZ_SECONDS` per target; `CCMARL_FUZZ_TARGET` chooses one, `CCMARL_FUZZ_SEED` the mutations.
#[test]
#[ignore = "takes as long as CCMARL_FUZZ_SECONDS says"]
fn long() {
    let number = |name: &str, default: u64| std::env::var(name).map_or(default, |v| v.parse().unwrap());
    let (seconds, seed) = (number("CCMARL_FUZZ_SECONDS", 10), number("CCMARL_FUZZ_SEED", 2));
    let only = std::env::var("CCMARL_FUZZ_TARGET").ok();
    for name in TARGETS.iter().filter(|name| only.as_deref().is_none_or(|only| only == **name)) {
        let count = run(name, seed, Duration::from_secs(seconds), u64::MAX);
        println!("{name}: {count} inputs in {seconds} s, seed {seed}, peak {} MiB", peak_kib() >> 10);
    }
}
