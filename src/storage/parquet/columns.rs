//! Episodes as columns: the Arrow schema of a layout, the writer's properties, and blocks of rows.

use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, BooleanArray, FixedSizeListArray, Float32Array, Float64Array, Int32Array, Int64Array, RecordBatch,
};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use arrow::error::ArrowError;
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::file::metadata::SortingColumn;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;

use crate::schema::{AgentSpec, Episode, Layout};

/// Name of the elements of a list, as pyarrow and the Parquet standard write it.
pub(super) const ELEMENT: &str = "element";

/// The columns that say which row of which episode a row is; the first of every schema.
pub(super) const KEYS: [&str; 5] = ["episode", "step", "is_first", "is_last", "is_terminal"];

/// Values that the encoder takes at once; the crate's 1024 costs more calls.
const WRITE_BATCH: usize = 1 << 16;

/// The Arrow schema of a layout. Columns of width 0 are left out: some readers cannot open them.
pub(super) fn schema(layout: &Layout) -> SchemaRef {
    let plain = |name: &str, kind: DataType| Field::new(name, kind, false);
    let mut fields = vec![
        plain("episode", DataType::Int64),
        plain("step", DataType::Int32),
        plain("is_first", DataType::Boolean),
        plain("is_last", DataType::Boolean),
        plain("is_terminal", DataType::Boolean),
    ];
    let mut list = |name: String, element: DataType, width: usize, nullable: bool| {
        if width > 0 {
            fields.push(Field::new(name, list_type(element, width), nullable));
        }
    };
    list("state".to_owned(), DataType::Float64, layout.state_fields.len(), false);
    for a in &layout.agents {
        list(format!("observation.{}", a.name), DataType::Float32, a.observation, false);
    }
    for a in &layout.agents {
        list(format!("message.{}", a.name), DataType::Float32, a.message, false);
    }
    let n = layout.communicators().len();
    list("link".to_owned(), DataType::Boolean, n * n, false);
    for a in &layout.agents {
        list(format!("action.{}", a.name), DataType::Float32, a.action, true);
    }
    fields.push(Field::new("reward", DataType::Float32, true));
    fields.extend(layout.agents.iter().map(|a| Field::new(format!("reward.{}", a.name), DataType::Float32, true)));
    Arc::new(Schema::new(fields))
}

/// The columns of a layout that [`Rows`](crate::storage::Rows) of these agents need.
pub(super) fn schema_of_agents(layout: &Layout, agents: &[usize]) -> Schema {
    let whole = schema(layout);
    let of_agents = |name: &str| {
        let mut kinds = ["observation.", "message.", "action."].iter();
        let agent = kinds.find_map(|kind| name.strip_prefix(kind));
        agent.is_some_and(|agent| agents.iter().any(|&a| layout.agents[a].name == agent))
    };
    let keys = KEYS.iter().chain(&["link", "reward"]);
    let wanted = |name: &str| keys.clone().any(|&key| key == name) || of_agents(name);
    Schema::new(whole.fields().iter().filter(|f| wanted(f.name())).map(Arc::clone).collect::<Vec<_>>())
}

fn list_type(element: DataType, width: usize) -> DataType {
    DataType::FixedSizeList(Arc::new(Field::new(ELEMENT, element, false)), width as i32)
}

/// Bytes of one row in memory, counted in whole elements; bounds batches, row groups and parts.
pub(super) fn row_bytes(layout: &Layout) -> u64 {
    let n = layout.communicators().len();
    let agents: usize = layout.agents.iter().map(|a| 4 * (a.observation + a.message + a.action + 1)).sum();
    (19 + 8 * layout.state_fields.len() + n * n + agents) as u64
}

/// Bytes of a batch of rows in memory, about.
const BATCH_BYTES: u64 = 16 << 20;

/// Rows that are decoded at once.
pub(super) fn batch_rows(layout: &Layout) -> usize {
    (BATCH_BYTES / row_bytes(layout)).clamp(1, 8192) as usize
}

/// Encodings: floats split into byte streams under zstd (measured 20 % under raw, where the crate's defaults are over
/// raw), keys as deltas, no dictionary. Options go by leaf path, and one on a wrong path is ignored in silence, so the
/// paths are taken from the schema and a test reads them back from a file.
pub(super) fn properties(schema: &Schema) -> WriterProperties {
    let mut builder = WriterProperties::builder()
        .set_coerce_types(true)
        .set_compression(Compression::ZSTD(ZstdLevel::default()))
        .set_dictionary_enabled(false)
        .set_statistics_enabled(EnabledStatistics::None)
        .set_max_row_group_row_count(None)
        .set_write_batch_size(WRITE_BATCH)
        .set_sorting_columns(Some(
            [0, 1].map(|column_idx| SortingColumn { column_idx, descending: false, nulls_first: false }).to_vec(),
        ));
    for field in schema.fields() {
        let (path, kind) = match field.data_type() {
            DataType::FixedSizeList(element, _) => {
                let parts = [field.name(), "list", ELEMENT].map(str::to_owned);
                (ColumnPath::new(parts.to_vec()), element.data_type())
            }
            kind => (ColumnPath::new(vec![field.name().clone()]), kind),
        };
        builder = match kind {
            DataType::Float32 | DataType::Float64 => builder.set_column_encoding(path, Encoding::BYTE_STREAM_SPLIT),
            DataType::Int32 | DataType::Int64 => builder
                .set_column_encoding(path.clone(), Encoding::DELTA_BINARY_PACKED)
                .set_column_statistics_enabled(path, EnabledStatistics::Chunk),
            DataType::Utf8 => builder.set_column_dictionary_enabled(path, true),
            _ => builder.set_column_encoding(path, Encoding::PLAIN),
        };
    }
    builder.build()
}

/// A block of whole episodes as columns.
#[derive(Debug)]
pub(super) struct Block {
    /// Rows held.
    pub(super) rows: usize,
    episode: Vec<i64>,
    step: Vec<i32>,
    first: Vec<bool>,
    last: Vec<bool>,
    terminal: Vec<bool>,
    state: Vec<f64>,
    observations: Vec<Vec<f32>>,
    messages: Vec<Vec<f32>>,
    link: Vec<bool>,
    actions: Vec<Vec<f32>>,
    reward: Vec<f32>,
    rewards: Vec<Vec<f32>>,
}

impl Block {
    /// An empty block for this layout with room for `rows`.
    pub(super) fn new(layout: &Layout, rows: usize) -> Self {
        let n = layout.communicators().len();
        let columns = |width: fn(&AgentSpec) -> usize| {
            layout.agents.iter().map(|a| Vec::with_capacity(rows * width(a))).collect()
        };
        Self {
            rows: 0,
            episode: Vec::with_capacity(rows),
            step: Vec::with_capacity(rows),
            first: Vec::with_capacity(rows),
            last: Vec::with_capacity(rows),
            terminal: Vec::with_capacity(rows),
            state: Vec::with_capacity(rows * layout.state_fields.len()),
            observations: columns(|a| a.observation),
            messages: columns(|a| a.message),
            link: Vec::with_capacity(rows * n * n),
            actions: columns(|a| a.action),
            reward: Vec::with_capacity(rows),
            rewards: columns(|_| 1),
        }
    }

    /// Appends an episode that was checked against the layout.
    pub(super) fn push(&mut self, layout: &Layout, e: &Episode) {
        let (t, rows) = (e.steps, e.rows());
        self.rows += rows;
        self.episode.extend(std::iter::repeat_n(e.index as i64, rows));
        self.step.extend((0..rows).map(|s| s as i32));
        self.first.extend((0..rows).map(|s| s == 0));
        self.last.extend((0..rows).map(|s| s == t));
        self.terminal.extend((0..rows).map(|s| s == t && e.terminal));
        self.state.extend_from_slice(&e.state);
        self.link.extend_from_slice(&e.link);
        for (i, agent) in layout.agents.iter().enumerate() {
            self.observations[i].extend_from_slice(&e.observations[i].data);
            self.messages[i].extend_from_slice(&e.messages[i].data);
            self.actions[i].extend_from_slice(&e.actions[i].data);
            self.actions[i].extend(std::iter::repeat_n(0.0, agent.action));
            self.rewards[i].extend_from_slice(&e.rewards[i]);
            self.rewards[i].push(0.0);
        }
        self.reward.extend_from_slice(&e.reward);
        self.reward.push(0.0);
    }

    /// The block as a record batch of `schema`, without copying its floats.
    pub(super) fn into_batch(self, schema: &SchemaRef) -> Result<RecordBatch, ArrowError> {
        let acted = NullBuffer::from(self.last.iter().map(|&last| !last).collect::<Vec<bool>>());
        let mut columns: Vec<ArrayRef> = vec![
            Arc::new(Int64Array::from(self.episode)),
            Arc::new(Int32Array::from(self.step)),
            Arc::new(BooleanArray::from(self.first)),
            Arc::new(BooleanArray::from(self.last)),
            Arc::new(BooleanArray::from(self.terminal)),
        ];
        let rows = self.rows;
        let mut list = |values: ArrayRef, nulls: Option<&NullBuffer>| -> Result<(), ArrowError> {
            if rows > 0 && !values.is_empty() {
                let element = Arc::new(Field::new(ELEMENT, values.data_type().clone(), false));
                let width = (values.len() / rows) as i32;
                columns.push(Arc::new(FixedSizeListArray::try_new(element, width, values, nulls.cloned())?));
            }
            Ok(())
        };
        list(Arc::new(Float64Array::from(self.state)), None)?;
        for values in self.observations.into_iter().chain(self.messages) {
            list(Arc::new(Float32Array::from(values)), None)?;
        }
        list(Arc::new(BooleanArray::from(self.link)), None)?;
        for values in self.actions {
            list(Arc::new(Float32Array::from(values)), Some(&acted))?;
        }
        for values in std::iter::once(self.reward).chain(self.rewards) {
            columns.push(Arc::new(Float32Array::new(values.into(), Some(acted.clone()))));
        }
        RecordBatch::try_new(Arc::clone(schema), columns)
    }
}
