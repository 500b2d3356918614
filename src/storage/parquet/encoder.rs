//! The encoder: encodes blocks of rows on the caller's threads, and puts the row groups into Parquet files, which takes
//! digests and system calls, on a thread of its own.
//!
//! Its output depends only on the sequence of calls, never on timing.

use std::fs::File;
use std::io::{BufWriter, Read as _, Seek as _, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use arrow::array::RecordBatch;
use arrow::datatypes::SchemaRef;
use parquet::arrow::ArrowWriter;
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::writer::SerializedFileWriter;
use sha2::{Digest as _, Sha256};

use super::columns::properties;
use super::group::{Chunk, Group};
use super::twins::renamed;
use super::{FILE_SHA256_KEY, find_file_digest};
use crate::io::IoError;
use crate::schema::{SELF_SHA256_PLACEHOLDER, hex};
use crate::storage::StorageError;

/// What the thread is told to do, in order.
enum Job {
    /// A row group.
    Group(Vec<Chunk>),
    /// The file ends here; its metadata, and the journal that it makes superfluous.
    EndFile(Vec<KeyValue>, Option<PathBuf>),
}

/// A finished file.
pub(super) struct Sealed {
    /// Size in bytes.
    pub(super) bytes: u64,
    /// SHA-256, 64 hex digits.
    pub(super) sha256: String,
}

/// The sink's end of the encoder.
pub(super) struct Encoder {
    group: Group,
    /// Where its files are.
    pub(super) directory: PathBuf,
    jobs: Option<SyncSender<Job>>,
    thread: Option<JoinHandle<Result<Vec<Sealed>, StorageError>>>,
}

impl Encoder {
    /// Starts the thread; the k-th file is `name(k)` in `directory`, written as `<name>.tmp` until it is whole.
    pub(super) fn start(schema: SchemaRef, directory: &Path, name: fn(usize) -> String) -> Result<Self, StorageError> {
        let group = Group::new(SchemaRef::clone(&schema)).map_err(|e| refused(e, directory))?;
        // one row group waits at most: each is a good part of what a recording takes in memory
        let (jobs, inbox) = sync_channel(1);
        let place = directory.to_owned();
        let thread = std::thread::spawn(move || assemble(&inbox, &schema, |k| place.join(name(k))));
        Ok(Self { group, directory: directory.to_owned(), jobs: Some(jobs), thread: Some(thread) })
    }

    /// Encodes rows of whole episodes.
    pub(super) fn write(&mut self, batch: &RecordBatch) -> Result<(), StorageError> {
        self.group.write(batch).map_err(|e| refused(e, &self.directory))
    }

    /// Ends the row group, if it has rows.
    pub(super) fn end_group(&mut self) -> Result<(), StorageError> {
        match self.group.end().map_err(|e| refused(e, &self.directory))? {
            Some(chunks) => self.send(Job::Group(chunks)),
            None => Ok(()),
        }
    }

    /// Ends the file with this metadata; `journal` is removed once the file is in place.
    pub(super) fn end_file(&mut self, metadata: Vec<KeyValue>, journal: Option<PathBuf>) -> Result<(), StorageError> {
        self.end_group()?;
        self.send(Job::EndFile(metadata, journal))
    }

    /// Hands over a job; waits while the thread is behind.
    fn send(&mut self, job: Job) -> Result<(), StorageError> {
        match &self.jobs {
            Some(jobs) if jobs.send(job).is_ok() => Ok(()),
            _ => self.join().map(drop).and(Err(gone())),
        }
    }

    /// Waits for all jobs; the finished files in order.
    pub(super) fn join(&mut self) -> Result<Vec<Sealed>, StorageError> {
        self.jobs = None;
        self.thread.take().and_then(|t| t.join().ok()).unwrap_or_else(|| Err(gone()))
    }
}

fn gone() -> StorageError {
    let message = "the Parquet encoder stopped early: record again".to_owned();
    StorageError::Damaged { message, path: PathBuf::new() }
}

/// Puts row groups into files.
fn assemble(
    inbox: &Receiver<Job>,
    schema: &SchemaRef,
    name: impl Fn(usize) -> PathBuf,
) -> Result<Vec<Sealed>, StorageError> {
    let mut sealed = Vec::new();
    let mut open: Option<(SerializedFileWriter<HashingFile>, PathBuf)> = None;
    for job in inbox {
        let (writer, path) = match &mut open {
            Some((writer, path)) => (writer, path),
            none => {
                let path = name(sealed.len());
                let temporary = temporary(&path);
                let file = File::create(&temporary).map_err(IoError::os("create", &temporary))?;
                let file = HashingFile { file: BufWriter::with_capacity(1 << 18, file), hash: Sha256::new(), bytes: 0 };
                let writer = ArrowWriter::try_new(file, SchemaRef::clone(schema), Some(properties(schema)))
                    .and_then(ArrowWriter::into_serialized_writer)
                    .map_err(|e| refused(e, &temporary))?
                    .0;
                let (writer, path) = none.insert((writer, path));
                (writer, path)
            }
        };
        match job {
            Job::Group(chunks) => append(writer, chunks).map_err(|e| refused(e, path))?,
            Job::EndFile(metadata, journal) => {
                for entry in metadata {
                    writer.append_key_value_metadata(entry);
                }
                let Some((writer, path)) = open.take() else { continue };
                sealed.push(seal(writer, &path)?);
                if let Some(journal) = journal {
                    std::fs::remove_file(&journal).map_err(IoError::os("remove the journal", &journal))?;
                }
            }
        }
    }
    Ok(sealed)
}

fn append(writer: &mut SerializedFileWriter<HashingFile>, chunks: Vec<Chunk>) -> Result<(), ParquetError> {
    let columns = writer.schema_descr().columns().to_vec();
    let mut group = writer.next_row_group()?;
    for (chunk, column) in chunks.into_iter().zip(columns) {
        match chunk {
            Chunk::Own(chunk) => chunk.append_to_row_group(&mut group)?,
            Chunk::Twin(pages, known) => group.append_column(&pages, renamed(&known, column)?)?,
        }
    }
    group.close().map(drop)
}

/// Puts a finished file on disk under its name, and its own digest into it where it asks for that.
fn seal(writer: SerializedFileWriter<HashingFile>, path: &Path) -> Result<Sealed, StorageError> {
    let temporary = temporary(path);
    let os = |action| IoError::os(action, &temporary);
    let out = writer.into_inner().map_err(|e| refused(e, &temporary))?;
    let (sha256, bytes) = (hex(&out.hash.finalize()), out.bytes);
    let file = out.file.into_inner().map_err(|e| os("write")(e.into_error()))?;
    drop(file);
    let mut file = File::options().read(true).write(true).open(&temporary).map_err(os("open"))?;
    let tail = bytes.min(1 << 20);
    file.seek(SeekFrom::Start(bytes - tail)).map_err(os("read"))?;
    let mut footer = Vec::new();
    (&file).take(tail).read_to_end(&mut footer).map_err(os("read"))?;
    if let Some(at) = find_file_digest(&footer)
        && footer[at..].starts_with(SELF_SHA256_PLACEHOLDER.as_bytes())
    {
        file.seek(SeekFrom::Start(bytes - tail + at as u64)).map_err(os("write"))?;
        file.write_all(sha256.as_bytes()).map_err(os("write"))?;
    }
    file.sync_all().map_err(os("sync"))?;
    std::fs::rename(&temporary, path).map_err(IoError::os("put in place", path))?;
    Ok(Sealed { bytes, sha256 })
}

/// The metadata entry that asks for the file's own digest.
pub(super) fn file_digest_entry() -> KeyValue {
    KeyValue::new(FILE_SHA256_KEY.to_owned(), SELF_SHA256_PLACEHOLDER.to_owned())
}

fn temporary(path: &Path) -> PathBuf {
    path.with_extension("parquet.tmp")
}

/// A Parquet error as one of the store; `path` is where it happened.
pub(super) fn refused(error: ParquetError, path: &Path) -> StorageError {
    match error {
        ParquetError::External(source) => match source.downcast::<std::io::Error>() {
            Ok(source) => IoError::os("write", path)(*source).into(),
            Err(other) => {
                StorageError::Damaged { message: format!("could not be encoded: {other}"), path: path.to_owned() }
            }
        },
        other => IoError::os("write", path)(std::io::Error::other(other.to_string())).into(),
    }
}

/// A file whose digest is taken while it is written, so that it need not be read again.
struct HashingFile {
    file: BufWriter<File>,
    hash: Sha256,
    bytes: u64,
}

impl Write for HashingFile {
    fn write(&mut self, buf: &[u8]) -> std::io::Result<usize> {
        self.write_all(buf).map(|()| buf.len())
    }

    fn write_all(&mut self, buf: &[u8]) -> std::io::Result<()> {
        self.hash.update(buf);
        self.bytes += buf.len() as u64;
        self.file.write_all(buf)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.file.flush()
    }
}
