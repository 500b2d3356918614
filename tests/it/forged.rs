//! Stores that follow their container and break ours: what is wrong with each is named.
#![expect(clippy::disallowed_methods, reason = "damaged files are written in place on purpose")]

use std::collections::BTreeMap;
use std::fs;
use std::io::Cursor;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;

use ccmarl::schema::{Episode, Layout, Manifest};
use ccmarl::storage;
use mcap::WriteOptions;
use mcap::records::{MessageHeader, Metadata};
use parquet::file::metadata::{ColumnChunkMetaData, ParquetMetaDataReader};

use super::integrity::{killed, verify};
use super::stores::{data_file, episode, layout, message, read, reseal, small, some, write};

/// Writes an MCAP store again, with other options and without some records.
fn rewritten(
    bytes: &[u8],
    options: WriteOptions,
    encoding: &str,
    keep: &dyn Fn(&str, u64) -> bool,
    manifests: bool,
) -> Vec<u8> {
    let mut writer = options.disable_seeking(true).create(Cursor::new(Vec::new())).unwrap();
    if manifests {
        for record in metadata(bytes) {
            writer.write_metadata(&record).unwrap();
        }
    }
    let mut channels = BTreeMap::new();
    for (count, message) in mcap::MessageStream::new(bytes).unwrap().enumerate() {
        let message = message.unwrap();
        let channel = &message.channel;
        if !keep(&channel.topic, count as u64) {
            continue;
        }
        let id = *channels.entry(channel.id).or_insert_with(|| {
            let schema = channel.schema.as_ref().unwrap();
            let schema = writer.add_schema(&schema.name, &schema.encoding, &schema.data).unwrap();
            writer.add_channel(schema, &channel.topic, encoding, &channel.metadata).unwrap()
        });
        let (sequence, log_time, publish_time) = (message.sequence, message.log_time, message.publish_time);
        let header = MessageHeader { channel_id: id, sequence, log_time, publish_time };
        writer.write_to_known_channel(&header, &message.data).unwrap();
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}

fn metadata(bytes: &[u8]) -> Vec<Metadata> {
    let records = mcap::read::LinearReader::new(bytes).unwrap();
    let found = records.filter_map(|record| match record.unwrap() {
        mcap::records::Record::Metadata(metadata) => Some(metadata),
        _ => None,
    });
    found.collect()
}

#[test]
fn an_mcap_file_that_is_none_of_ours_says_what_it_lacks() {
    let layout = small();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store.mcap");
    write(&path, &layout, &(0..3).map(|i| episode(&layout, i, 2, false)).collect::<Vec<_>>(), false).unwrap();
    let good = fs::read(&path).unwrap();
    let all = |_: &str, _: u64| true;
    let plain = || WriteOptions::new();
    let without_end = |topic: &str, count: u64| topic != "/rollout/episode" || count < 8;
    // an episode is three rows and an end
    let cases: [(Vec<u8>, &str); 6] = [
        (
            rewritten(&good, plain(), "protobuf", &all, false),
            "not a rollout store: an MCAP file without a metadata record ccmarl.manifest",
        ),
        (rewritten(&good, plain(), "json", &all, true), "damaged: topic /rollout/step: expected protobuf, found json"),
        (
            rewritten(&good, plain().calculate_data_section_crc(false), "protobuf", &all, true),
            "damaged: no checksum of the data",
        ),
        (
            rewritten(&good, plain().calculate_summary_section_crc(false), "protobuf", &all, true),
            "damaged: no checksum of the summary",
        ),
        (rewritten(&good, plain(), "protobuf", &without_end, true), "damaged: episode 2 has 3 rows and no end"),
        (rewritten(&good, plain(), "protobuf", &|_, count| count < 8, true), "damaged: expected 3 episodes, found 2"),
    ];
    for (bytes, expected) in cases {
        fs::write(&path, bytes).unwrap();
        let error = message(read(&path));
        assert!(error.starts_with(expected), "{expected}: {error}");
        let verified = storage::verify(&path, &mut |_, _| None);
        assert!(verified.is_err() || verified.is_ok_and(|report| !report.is_clean()), "{expected}");
    }
    fs::write(&path, rewritten(&good, plain(), "protobuf", &all, true)).unwrap();
    assert_eq!(read(&path).unwrap().len(), 3, "written again as it was, it is read");
}

#[test]
fn verify_names_what_a_manifest_and_its_parts_disagree_on() {
    type Change = fn(&mut Manifest);
    let layout = small();
    let cases: [(Change, &str, &str); 4] = [
        (|m| m.episodes = 9, "manifest.json", "the parts hold 4 episodes, the manifest says 9"),
        (|m| m.parts[0].episodes = [1, 4], "part-00000.parquet", "expected episodes from 0 on, found 1 to 4"),
        (|m| m.parts[0].episodes[1] = 3, "part-00000.parquet", "the manifest says episodes 0 to 3, found 4"),
        (|m| m.parts[0].bytes += 1, "part-00000.parquet", "cut short, "),
    ];
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store");
    for (change, place, expected) in cases {
        write(&path, &layout, &some(&layout, 4), true).unwrap();
        reseal(&path, change);
        let report = verify(&path);
        let found = report.problems.iter().any(|p| p.place == place && p.message.starts_with(expected));
        assert!(found, "{expected}: {report:?}");
    }
    fs::write(path.join("manifest.json"), "{").unwrap();
    assert!(verify(&path).problems[0].message.starts_with("manifest: EOF while parsing"));
    let single = directory.path().join("store.parquet");
    write(&single, &layout, &some(&layout, 4), false).unwrap();
    let length = single.metadata().unwrap().len();
    fs::File::options().write(true).open(&single).unwrap().set_len(length - 9).unwrap();
    let report = verify(&single);
    assert_eq!(report.problems[0].message, "it is cut short: the footer, and with it all rows, is gone");
}

#[test]
fn a_leftover_with_a_gap_or_without_hashes_is_damaged() {
    use arrow::ipc::{reader::StreamReader, writer::StreamWriter};
    let layout = layout(&[(true, [1, 1, 1])], 1);
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("gap");
    let episodes: Vec<Episode> = (0..8100).map(|i| episode(&layout, i, 1, false)).collect();
    let leftover = killed(&path, &layout, &episodes, 9000);
    fs::remove_file(leftover.join("part-00000.parquet")).unwrap();
    let report = verify(&path);
    assert_eq!(report.problems[0].message, "journal-00000.arrows is missing, but part-00001.parquet is there");
    assert_eq!(report.episodes, 0);
    // as a program wrote it that knew no hashes
    let path = directory.path().join("old");
    let journal = killed(&path, &layout, &some(&layout, 2), 2).join("journal-00000.arrows");
    let mut reader = StreamReader::try_new(fs::File::open(&journal).unwrap(), None).unwrap();
    let columns: Vec<usize> = (0..reader.schema().fields().len() - 1).collect();
    let batch = reader.next().unwrap().unwrap().project(&columns).unwrap();
    let mut writer = StreamWriter::try_new(fs::File::create(&journal).unwrap(), &batch.schema()).unwrap();
    writer.write(&batch).unwrap();
    let report = verify(&path);
    assert!(report.problems[0].message.starts_with("it has no column content_hash"), "{report:?}");
}

/// The compressed bytes of a column of each row group, and what the footer says of them but for places in the file.
fn chunks(file: &Path, column: &str) -> Vec<(Vec<u8>, String)> {
    let bytes = fs::read(file).unwrap();
    let metadata = ParquetMetaDataReader::new().parse_and_finish(&fs::File::open(file).unwrap()).unwrap();
    let chunk = |chunk: &ColumnChunkMetaData| {
        let (start, length) = chunk.byte_range();
        let facts = format!(
            "{:?} {:?} {} {} {} {:?} {:?} {:?} {:?}",
            chunk.compression_codec(),
            chunk.encodings().collect::<Vec<_>>(),
            chunk.num_values(),
            chunk.compressed_size(),
            chunk.uncompressed_size(),
            chunk.statistics(),
            chunk.page_encoding_stats(),
            chunk.repetition_level_histogram(),
            chunk.definition_level_histogram()
        );
        (bytes[start as usize..(start + length) as usize].to_vec(), facts)
    };
    let groups = metadata.row_groups().iter();
    let found =
        groups.flat_map(|group| group.columns().iter().filter(|c| c.column_path().parts()[0] == column).map(chunk));
    found.collect()
}

#[test]
fn a_column_written_as_the_twin_of_another_is_the_column_that_would_have_been_encoded() {
    let layout: Layout = layout(&[(true, [2, 2, 1]), (true, [2, 2, 1])], 1);
    let twins: Vec<Episode> = (0..6000)
        .map(|i| {
            let e = episode(&layout, i, 25, false);
            Episode { messages: e.observations.clone(), ..e }
        })
        .collect();
    // the same messages, but beside observations that differ in every block, so that each is encoded on its own
    let apart: Vec<Episode> = twins
        .iter()
        .map(|e| {
            let mut e = e.clone();
            e.observations.iter_mut().for_each(|o| o.data[0] += 1.0);
            e
        })
        .collect();
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    write(&at("twins.parquet"), &layout, &twins, false).unwrap();
    write(&at("apart.parquet"), &layout, &apart, false).unwrap();
    for agent in 0..2 {
        let message = format!("message.agent_{agent}");
        let (found, expected) = (chunks(&at("twins.parquet"), &message), chunks(&at("apart.parquet"), &message));
        assert!(found.len() > 1, "more than one row group");
        assert_eq!(found.iter().map(|c| &c.1).collect::<Vec<_>>(), expected.iter().map(|c| &c.1).collect::<Vec<_>>());
        assert!(found == expected, "{message}");
        let observation = chunks(&at("twins.parquet"), &format!("observation.agent_{agent}"));
        assert!(found.iter().map(|c| &c.0).eq(observation.iter().map(|c| &c.0)));
    }
}

/// Bytes that a run of the program read, from the kernel's count at its end (Linux).
fn bytes_read(words: &[&str]) -> u64 {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ccmarl"));
    let mut child =
        command.args(words).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let proc = Path::new("/proc").join(child.id().to_string());
    // it has ended and was not waited for: its counts are still there
    while !fs::read_to_string(proc.join("stat")).unwrap().rsplit(')').next().unwrap().starts_with(" Z") {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let counts = fs::read_to_string(proc.join("io")).unwrap();
    let read = counts.lines().find_map(|line| line.strip_prefix("rchar: ")).unwrap().parse().unwrap();
    assert!(child.wait().unwrap().success());
    read
}

#[test]
fn a_part_is_hashed_once_and_decoded_once() {
    let layout = Arc::new(small());
    let episodes: Vec<Episode> = (0..9000).map(|i| episode(&layout, i, 8, false)).collect();
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("store");
    write(&path, &layout, &episodes, false).unwrap();
    let parts = fs::read_dir(&path).unwrap().map(|e| e.unwrap().path()).filter(|p| p.extension().unwrap() == "parquet");
    let size: u64 = parts.map(|p| p.metadata().unwrap().size()).sum();
    assert!(size > 4 << 20 && data_file(&path).exists());
    let store = path.to_str().unwrap();
    // once for the digest and once to decode; headers of pages and the program's own files are little
    for words in [&["inspect", store][..], &["verify", store]] {
        let read = bytes_read(words);
        assert!(read > 2 * size && read < size * 5 / 2, "{words:?} read {read} bytes of parts of {size}");
    }
    let shard =
        bytes_read(&["inspect", store, "--shard", "2/3", "--out", directory.path().join("2.json").to_str().unwrap()]);
    assert!(shard < size * 3 / 2, "a shard passes over whole parts: {shard} of {size}");
}
