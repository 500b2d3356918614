//! A store as a table of pairs: one row per (episode, step, sender, receiver), for engines that group by plain columns.
//!
//! Not a store: it is written here because only this room writes Parquet.

use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{
    ArrayRef, BooleanArray, FixedSizeListArray, Float32Array, Int32Array, Int64Array, RecordBatch, StringArray,
};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use arrow::error::ArrowError;
use atomic_write_file::AtomicWriteFile;
use parquet::arrow::ArrowWriter;
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;

use super::columns::{ELEMENT, properties};
use super::encoder::refused;
use crate::io::{self, IoError};
use crate::schema::{Episode, Layout, Manifest, Matrix};
use crate::storage::{PAIRS_KEY, StorageError, carries};

/// Rows that are encoded at once.
const BLOCK_ROWS: usize = 8192;
/// Rows of a row group.
const GROUP_ROWS: usize = 1 << 17;

/// Writes the pairs of a store, episode by episode.
///
/// Columns: `episode` int64, `step` int32, `sender`, `receiver` utf8, `delivered` bool, `message` (what was sent) and
/// `action` (the receiver's) f32 lists of fixed size. Rows are the steps with an action, links sender-major. Where
/// agents differ in width, the elements that an agent does not have are null.
pub struct PairsWriter {
    path: PathBuf,
    layout: Layout,
    schema: SchemaRef,
    /// `None` once it is closed.
    writer: Option<ArrowWriter<BufWriter<AtomicWriteFile>>>,
    block: Block,
    rows: u64,
}

impl PairsWriter {
    /// Starts the table of the store with this manifest; nothing appears under `path` before [`PairsWriter::finish`].
    ///
    /// # Errors
    /// [`StorageError`] when the file exists and `force` is false, is not ours, or the disk refuses.
    pub fn create(path: &Path, manifest: &Manifest, force: bool) -> Result<Self, StorageError> {
        let layout = manifest.layout();
        let block = Block::new(&layout);
        let mut fields = vec![
            Field::new("episode", DataType::Int64, false),
            Field::new("step", DataType::Int32, false),
            Field::new("sender", DataType::Utf8, false),
            Field::new("receiver", DataType::Utf8, false),
            Field::new("delivered", DataType::Boolean, false),
        ];
        let lists = [("message", &block.message), ("action", &block.action)];
        fields.extend(lists.iter().filter(|(_, list)| list.width > 0).map(|(name, list)| {
            let kind = DataType::FixedSizeList(list.element(), list.width as i32);
            Field::new(*name, kind, false)
        }));
        let schema = Arc::new(Schema::new(fields));
        let json = Manifest { parts: Vec::new(), ..manifest.clone() }.sealed_json();
        let json = json.map_err(|source| StorageError::Schema { source, path: path.to_owned() })?;
        io::refuse_existing(path, force)?;
        if path.symlink_metadata().is_ok() && (path.is_dir() || !carries(path, PAIRS_KEY)?) {
            return Err(IoError::Foreign(path.to_owned()).into());
        }
        io::create_parent(path)?;
        let file = AtomicWriteFile::open(path).map_err(IoError::os("create", path))?;
        let file = BufWriter::with_capacity(1 << 18, file);
        let mut writer = ArrowWriter::try_new(file, SchemaRef::clone(&schema), Some(properties(&schema)))
            .map_err(|e| refused(e, path))?;
        writer.append_key_value_metadata(KeyValue::new(PAIRS_KEY.to_owned(), json));
        Ok(Self { path: path.to_owned(), layout, schema, writer: Some(writer), block, rows: 0 })
    }

    /// Appends the pairs of an episode.
    ///
    /// # Errors
    /// [`StorageError`] when the disk refuses.
    pub fn append(&mut self, episode: &Episode) -> Result<(), StorageError> {
        let communicators = self.layout.communicators();
        let n = communicators.len();
        for step in 0..episode.steps {
            for (s, &sender) in communicators.iter().enumerate() {
                for (r, &receiver) in communicators.iter().enumerate().filter(|&(r, _)| r != s) {
                    let block = &mut self.block;
                    block.episode.push(episode.index as i64);
                    block.step.push(step as i32);
                    block.sender.push(sender);
                    block.receiver.push(receiver);
                    block.delivered.push(episode.delivered(n, step, s, r));
                    block.message.push(&episode.messages[sender], step);
                    block.action.push(&episode.actions[receiver], step);
                }
            }
            if self.block.episode.len() >= BLOCK_ROWS {
                self.write_block()?;
            }
        }
        Ok(())
    }

    fn write_block(&mut self) -> Result<(), StorageError> {
        let rows = self.block.episode.len() as u64;
        if rows == 0 {
            return Ok(());
        }
        let block = std::mem::replace(&mut self.block, Block::new(&self.layout));
        let batch = block.into_batch(&self.layout, &self.schema).map_err(ParquetError::from);
        let Some(writer) = &mut self.writer else { return Ok(()) };
        let written = batch.and_then(|batch| writer.write(&batch));
        self.rows += rows;
        let ended = if writer.in_progress_rows() >= GROUP_ROWS { writer.flush() } else { Ok(()) };
        written.and(ended).map_err(|e| refused(e, &self.path))
    }

    /// Puts the table under its name; returns its rows.
    ///
    /// # Errors
    /// [`StorageError`] when the disk refuses.
    pub fn finish(mut self) -> Result<u64, StorageError> {
        self.write_block()?;
        let Some(writer) = self.writer.take() else { return Ok(self.rows) };
        let file = writer.into_inner().map_err(|e| refused(e, &self.path))?;
        let file = file.into_inner().map_err(|e| IoError::os("write", &self.path)(e.into_error()))?;
        file.commit().map_err(IoError::os("put in place", &self.path))?;
        Ok(self.rows)
    }
}

/// Rows in the making.
struct Block {
    episode: Vec<i64>,
    step: Vec<i32>,
    /// Agents.
    sender: Vec<usize>,
    receiver: Vec<usize>,
    delivered: Vec<bool>,
    message: Lists,
    action: Lists,
}

impl Block {
    fn new(layout: &Layout) -> Self {
        let communicators = layout.communicators();
        let widths = |width: fn(&crate::schema::AgentSpec) -> usize| {
            Lists::new(&communicators.iter().map(|&a| width(&layout.agents[a])).collect::<Vec<_>>())
        };
        Self {
            episode: Vec::new(),
            step: Vec::new(),
            sender: Vec::new(),
            receiver: Vec::new(),
            delivered: Vec::new(),
            message: widths(|a| a.message),
            action: widths(|a| a.action),
        }
    }

    fn into_batch(self, layout: &Layout, schema: &SchemaRef) -> Result<RecordBatch, ArrowError> {
        let names = |agents: &[usize]| -> ArrayRef {
            Arc::new(StringArray::from_iter_values(agents.iter().map(|&a| layout.agents[a].name.as_str())))
        };
        let mut columns: Vec<ArrayRef> = vec![
            Arc::new(Int64Array::from(self.episode)),
            Arc::new(Int32Array::from(self.step)),
            names(&self.sender),
            names(&self.receiver),
            Arc::new(BooleanArray::from(self.delivered)),
        ];
        for list in [self.message, self.action] {
            if list.width > 0 {
                columns.push(Arc::new(list.into_array()?));
            }
        }
        RecordBatch::try_new(SchemaRef::clone(schema), columns)
    }
}

/// A column of lists as wide as the widest.
struct Lists {
    width: usize,
    /// Whether some lists are narrower.
    ragged: bool,
    values: Vec<f32>,
    /// Which values are there, of ragged lists.
    there: Vec<bool>,
}

impl Lists {
    fn new(widths: &[usize]) -> Self {
        let width = widths.iter().copied().max().unwrap_or(0);
        let ragged = widths.iter().any(|&w| w != width);
        Self { width, ragged, values: Vec::new(), there: Vec::new() }
    }

    fn element(&self) -> Arc<Field> {
        Arc::new(Field::new(ELEMENT, DataType::Float32, self.ragged))
    }

    fn push(&mut self, matrix: &Matrix, row: usize) {
        let missing = self.width - matrix.width;
        self.values.extend_from_slice(matrix.row(row));
        self.values.extend(std::iter::repeat_n(0.0, missing));
        if self.ragged {
            self.there.extend(std::iter::repeat_n(true, matrix.width));
            self.there.extend(std::iter::repeat_n(false, missing));
        }
    }

    fn into_array(self) -> Result<FixedSizeListArray, ArrowError> {
        let (element, width) = (self.element(), self.width as i32);
        let nulls = self.ragged.then(|| NullBuffer::from(self.there));
        FixedSizeListArray::try_new(element, width, Arc::new(Float32Array::new(self.values.into(), nulls)), None)
    }
}
