//! Everything that is wrong with a damaged file, chunk by chunk.

use std::path::Path;

use mcap::records::op;
use mcap::sans_io::linear_reader::LinearReaderOptions;

use super::assembler::Assembler;
use super::source::{Records, Stop, scan};
use crate::schema::Manifest;
use crate::storage::verify::Findings;
use crate::storage::{StorageError, Tally};

/// Reports the checksums, the manifests and each chunk and episode that does not hold.
pub(super) fn diagnose(path: &Path, findings: &mut Findings<'_>) -> Result<(), StorageError> {
    let plain = || LinearReaderOptions::default().with_check_finishes_after_end_magic(true);
    let (mut recording, mut sealed, mut short) = (None, None, false);
    for options in [plain().with_validate_data_section_crc(true), plain().with_validate_summary_section_crc(true)] {
        match scan(path, options, &mut |_, _, _| {}) {
            Ok(found) => (recording, sealed) = (found.recording, found.manifest),
            Err(Stop::Short) => short = true,
            Err(Stop::Error(StorageError::Damaged { message, .. })) => findings.wrong("checksum", "file", message),
            Err(Stop::Error(error)) => return Err(error),
        }
    }
    if recording.is_none() && sealed.is_none() {
        // no pass came to the end: take what stands before the fault
        let torn = LinearReaderOptions::default().with_skip_end_magic(true);
        let mut early = |_: u64, opcode: u8, body: &[u8]| {
            if let Ok(Some(text)) = super::source::metadata(opcode, body, super::RECORDING_RECORD) {
                recording = Some(text);
            }
        };
        scan(path, torn, &mut early).ok();
    }
    if short {
        let message = "it is cut short: copy it again, or keep its whole episodes with `ccmarl recover --force`";
        findings.lost("length", "file", message.to_owned());
    }
    // the sealed manifest stands at the end, so a file that was cut has none
    let sealed = if short { None } else { findings.manifest("metadata record ccmarl.manifest", sealed.as_deref()) };
    let before = || recording.as_deref().and_then(|text| Manifest::parse_damaged(text).ok());
    let Some(manifest) = sealed.or_else(before) else {
        return Ok(());
    };
    if let Some(Ok(recording)) = recording.as_deref().map(Manifest::parse) {
        findings.trust(&recording);
    }
    findings.describe(&manifest);
    let mut total = Tally::default();
    episodes(path, &manifest, &mut total, findings)?;
    if findings.is_clean()
        && let Err(error) = total.compare(&manifest, path)
    {
        findings.error("counters", "manifest", &error);
    }
    Ok(())
}

/// Decodes chunk by chunk; a bad chunk or episode is reported, and the next one read.
fn episodes(
    path: &Path,
    manifest: &Manifest,
    total: &mut Tally,
    findings: &mut Findings<'_>,
) -> Result<(), StorageError> {
    let mut assembler = Assembler::new(manifest.layout());
    let mut each = |at: u64, opcode: u8, body: &[u8]| {
        if opcode != op::CHUNK {
            record(&mut assembler, opcode, body, total, findings);
            return;
        }
        let whole = [&[op::CHUNK][..], &(body.len() as u64).to_le_bytes(), body].concat();
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true);
        let read = Records::new(&whole[..], path, options).each(|opcode, body| {
            record(&mut assembler, opcode, body, total, findings);
            Ok(false)
        });
        let message = match read {
            Ok(_) => return,
            Err(Stop::Short) => "it ends within a record".to_owned(),
            Err(Stop::Error(StorageError::Damaged { message, .. })) => message,
            Err(Stop::Error(error)) => error.to_string(),
        };
        findings.wrong("checksum", &format!("chunk at byte {at}"), message);
        assembler.skip();
    };
    let options = LinearReaderOptions::default().with_skip_end_magic(true);
    match scan(path, options, &mut each) {
        Ok(_) | Err(Stop::Short | Stop::Error(StorageError::Damaged { .. })) => {} // said before
        Err(Stop::Error(error)) => return Err(error),
    }
    if assembler.rows() > 0 {
        let rows = assembler.rows();
        findings.lost("length", "last episode", format!("it has {rows} rows and no end"));
    }
    Ok(())
}

/// Gives a record to the assembler. After a fault the same record may begin the next episode.
fn record(assembler: &mut Assembler, opcode: u8, body: &[u8], total: &mut Tally, findings: &mut Findings<'_>) {
    for _ in 0..2 {
        match assembler.take(opcode, body) {
            Ok(None) => return,
            Ok(Some((episode, hash))) => {
                total.add(&episode, &hash);
                findings.episode(&episode);
                return;
            }
            Err(message) => {
                findings.wrong("rows", "topic /rollout", message);
                assembler.skip();
            }
        }
    }
}
