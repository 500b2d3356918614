//! Reading the columns of a file side by side, on all threads of the caller's pool.

use std::fs::File;
use std::sync::Arc;

use arrow::array::{ArrayRef, RecordBatch};
use arrow::datatypes::{FieldRef, Schema, SchemaRef};
use arrow::error::ArrowError;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{ArrowReaderMetadata, ParquetRecordBatchReader, ParquetRecordBatchReaderBuilder};
use rayon::prelude::*;

use super::leaf::{Leaf, Plan};
use super::shared::Shared;
use super::twins::candidates;
use crate::io::caught;

/// Batches of rows, put together from readers of a column each; no batch has rows of two row groups.
pub(super) struct SideBySide {
    file: Shared,
    metadata: ArrowReaderMetadata,
    schema: SchemaRef,
    columns: Vec<Column>,
    /// Rows of a batch at most.
    rows: usize,
    /// The next row group, and what is left of the one at hand.
    group: usize,
    left: usize,
}

/// A column of the file.
struct Column {
    root: usize,
    field: FieldRef,
    /// How it is read here; the Parquet crate reads it where there is none.
    plan: Option<Plan>,
    /// The earlier column, by position among these, that may hold the same.
    twin: Option<usize>,
    reader: Reader,
}

enum Reader {
    /// Between row groups.
    None,
    Own(Box<Leaf>),
    Crate(ParquetRecordBatchReader),
    /// The column `twin` has the same pages in this row group.
    Twin,
}

impl SideBySide {
    /// Reads the columns `roots`, at most `rows` rows at once.
    pub(super) fn open(file: File, metadata: &ArrowReaderMetadata, roots: &[usize], rows: usize) -> Self {
        let fields: Vec<FieldRef> = roots.iter().map(|&root| Arc::clone(&metadata.schema().fields()[root])).collect();
        let schema = Arc::new(Schema::new(fields.clone()));
        let column = |((&root, field), twin): ((&usize, FieldRef), Option<usize>)| {
            let plan = Plan::new(metadata.metadata(), root, &field);
            Column { root, field, plan, twin, reader: Reader::None }
        };
        let columns = roots.iter().zip(fields).zip(candidates(&schema)).map(column).collect();
        Self { file: Shared::new(file), metadata: metadata.clone(), schema, columns, rows, group: 0, left: 0 }
    }

    /// Goes on to the next row group that has rows; false when there is none.
    fn next_group(&mut self) -> Result<bool, ArrowError> {
        while self.left == 0 {
            for column in &mut self.columns {
                column.end()?;
            }
            let groups = self.metadata.metadata().row_groups();
            let Some(group) = groups.get(self.group) else { return Ok(false) };
            self.left = usize::try_from(group.num_rows()).map_err(|e| fault(format!("rows of a row group: {e}")))?;
            let plans: Vec<Option<Plan>> = self.columns.iter().map(|column| column.plan).collect();
            let open = |column: &mut Column| {
                let of = column.twin.and_then(|twin| plans[twin]);
                column.open(&self.file, &self.metadata, self.group, of, self.rows.min(self.left))
            };
            self.columns.par_iter_mut().try_for_each(open)?;
            self.group += 1;
        }
        Ok(true)
    }

    fn next_batch(&mut self) -> Result<Option<RecordBatch>, ArrowError> {
        if !self.next_group()? {
            return Ok(None);
        }
        let rows = self.rows.min(self.left);
        self.left -= rows;
        let read: Vec<_> = self.columns.par_iter_mut().map(|column| column.read(rows)).collect();
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(read.len());
        for (array, column) in read.into_iter().zip(&self.columns) {
            let twin = || column.twin.and_then(|twin| arrays.get(twin)).map(Arc::clone);
            arrays.push(array?.or_else(twin).ok_or_else(|| fault("a column without its twin"))?);
        }
        RecordBatch::try_new(Arc::clone(&self.schema), arrays).map(Some)
    }
}

impl Iterator for SideBySide {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        self.next_batch().transpose()
    }
}

fn fault(message: impl Into<String>) -> ArrowError {
    ArrowError::ParquetError(message.into())
}

impl Column {
    /// A fault of this column; one made to harm can also make the decoder panic.
    fn guard<T>(name: &str, call: impl FnOnce() -> Result<T, String>) -> Result<T, ArrowError> {
        let result = caught(call).unwrap_or_else(|| Err("the decoder gave up on it".to_owned()));
        result.map_err(|message| fault(format!("column {name}: {message}")))
    }

    /// Begins row group `group`; `of` is the plan of the column that may hold the same.
    fn open(
        &mut self,
        file: &Shared,
        metadata: &ArrowReaderMetadata,
        group: usize,
        of: Option<Plan>,
        rows: usize,
    ) -> Result<(), ArrowError> {
        let parquet = metadata.metadata();
        self.reader = Self::guard(self.field.name(), || match (self.plan, of) {
            (Some(plan), Some(of)) if plan.same(&of, file, parquet, group) => Ok(Reader::Twin),
            (Some(plan), _) => Leaf::open(plan, file, parquet, group)
                .map(|leaf| Reader::Own(Box::new(leaf)))
                .map_err(|e| e.to_string()),
            (None, _) => {
                let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(file.clone(), metadata.clone());
                let mask = ProjectionMask::roots(builder.parquet_schema(), [self.root]);
                let builder = builder.with_projection(mask).with_row_groups(vec![group]).with_batch_size(rows);
                builder.build().map(Reader::Crate).map_err(|e| e.to_string())
            }
        })?;
        Ok(())
    }

    /// The next `rows` rows; `None` where they are the twin's.
    fn read(&mut self, rows: usize) -> Result<Option<ArrayRef>, ArrowError> {
        let (reader, field) = (&mut self.reader, &self.field);
        Self::guard(field.name(), || match reader {
            Reader::Own(leaf) => leaf.read(field, rows).map(Some),
            Reader::Crate(reader) => {
                let batch = reader.next().transpose().map_err(|e| e.to_string())?;
                let array = batch.map(|batch| Arc::clone(batch.column(0))).filter(|array| array.len() == rows);
                array.map(Some).ok_or_else(|| format!("{rows} rows were expected, fewer are there"))
            }
            Reader::Twin | Reader::None => Ok(None),
        })
    }

    /// Ends the row group; all its rows must have been read.
    fn end(&mut self) -> Result<(), ArrowError> {
        match std::mem::replace(&mut self.reader, Reader::None) {
            Reader::Own(leaf) => Self::guard(self.field.name(), || leaf.end()),
            Reader::Crate(_) | Reader::Twin | Reader::None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use arrow::array::Array as _;
    use parquet::arrow::ArrowWriter;
    use parquet::arrow::arrow_reader::ArrowReaderOptions;
    use parquet::basic::{Compression, Encoding};
    use parquet::data_type::{BoolType, FloatType, Int32Type, Int64Type};
    use parquet::file::properties::{WriterProperties, WriterVersion};
    use proptest::prelude::*;

    use super::*;
    use crate::schema::{AgentSpec, Controller, Episode, Layout};
    use crate::storage::parquet::columns::{Block, properties, schema};

    fn layout(widths: [usize; 3], state: usize) -> Layout {
        let [observation, message, action] = widths;
        let agent = |name: &str| AgentSpec {
            name: name.to_owned(),
            team: "t".to_owned(),
            controller: Controller::Policy,
            learner: true,
            communicator: true,
            observation,
            message,
            action,
        };
        Layout { agents: vec![agent("a"), agent("b")], state_fields: (0..state).map(|i| i.to_string()).collect() }
    }

    /// Episodes of these lengths whose numbers differ; messages equal observations where the widths do.
    fn block(layout: &Layout, steps: &[usize]) -> RecordBatch {
        let mut next = 0.0_f32;
        let mut draw = |count: usize| -> Vec<f32> {
            let draw = |_| {
                next = (next * 1.37 + 0.71) % 1000.0;
                next
            };
            (0..count).map(draw).collect()
        };
        let mut block = Block::new(layout, 0);
        for (index, &t) in steps.iter().enumerate() {
            let mut e = Episode { steps: t, ..Episode::with_capacity(layout, index as u64, t) };
            e.state = draw((t + 1) * layout.state_fields.len()).into_iter().map(f64::from).collect();
            for (i, a) in layout.agents.iter().enumerate() {
                e.observations[i].data = draw((t + 1) * a.observation);
                e.messages[i].data =
                    if a.message == a.observation { e.observations[i].data.clone() } else { draw((t + 1) * a.message) };
                (e.actions[i].data, e.rewards[i]) = (draw(t * a.action), draw(t));
            }
            (e.reward, e.link) = (
                draw(t),
                draw((t + 1) * layout.communicators().len().pow(2)).iter().map(|&v| v as i64 % 3 > 0).collect(),
            );
            block.push(layout, &e);
        }
        block.into_batch(&schema(layout)).unwrap()
    }

    fn write(batches: &[RecordBatch], properties: WriterProperties, groups: bool) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        let mut writer = ArrowWriter::try_new(file.reopen().unwrap(), batches[0].schema(), Some(properties)).unwrap();
        for batch in batches {
            writer.write(batch).unwrap();
            if groups {
                writer.flush().unwrap();
            }
        }
        writer.close().unwrap();
        file
    }

    fn open(path: &Path, rows: usize) -> SideBySide {
        let file = File::open(path).unwrap();
        let metadata = ArrowReaderMetadata::load(&file, ArrowReaderOptions::new()).unwrap();
        let roots: Vec<usize> = (0..metadata.schema().fields().len()).collect();
        SideBySide::open(file, &metadata, &roots, rows)
    }

    /// The same batches as the Parquet crate reads; how many columns are read here, and how many are their twins'.
    fn same_as_the_crate(path: &Path, rows: usize) -> [usize; 2] {
        let builder = ParquetRecordBatchReaderBuilder::try_new(File::open(path).unwrap()).unwrap();
        let expected: Vec<RecordBatch> = builder.build().unwrap().map(Result::unwrap).collect();
        let mut ours = open(path, rows);
        let (mut found, mut kinds) = (Vec::new(), [0, 0]);
        while let Some(batch) = ours.next() {
            found.push(batch.unwrap());
            let count = |kind: fn(&Reader) -> bool| ours.columns.iter().filter(|c| kind(&c.reader)).count();
            kinds = [count(|r| matches!(r, Reader::Own(_))), count(|r| matches!(r, Reader::Twin))];
        }
        assert!(found.iter().all(|batch| batch.num_rows() <= rows));
        assert_eq!(texts(&found), texts(&expected), "{}", path.display());
        kinds
    }

    /// Every value of every row, as text: also where two arrays keep the same rows in other buffers.
    fn texts(batches: &[RecordBatch]) -> Vec<String> {
        let mut text = Vec::new();
        for batch in batches {
            for row in 0..batch.num_rows() {
                for column in batch.columns() {
                    let value =
                        if column.is_null(row) { "null".to_owned() } else { format!("{:?}", column.slice(row, 1)) };
                    text.push(value);
                }
            }
        }
        text
    }

    #[test]
    fn golden_stores_are_read_as_the_crate_reads_them() {
        fn parts(directory: &Path, found: &mut Vec<PathBuf>) {
            for entry in std::fs::read_dir(directory).unwrap().map(|e| e.unwrap().path()) {
                if entry.is_dir() {
                    parts(&entry, found);
                } else if entry.extension().is_some_and(|e| e == "parquet") {
                    found.push(entry);
                }
            }
        }
        let mut found = Vec::new();
        parts(&Path::new(env!("CARGO_MANIFEST_DIR")).join("datasets/golden"), &mut found);
        assert!(found.len() > 30);
        for path in found {
            let [own, twins] = same_as_the_crate(&path, 100);
            assert!(own + twins > 5, "{}: {own} columns and {twins} twins", path.display());
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 40, failure_persistence: None, ..ProptestConfig::default() })]
        #[test]
        fn made_up_stores_are_read_as_the_crate_reads_them(
            widths in [1..20_usize, 0..3_usize, 0..3_usize], alike: bool, state in 0..3_usize,
            steps in prop::collection::vec(prop::collection::vec(0..40_usize, 1..6), 1..4),
            rows in 1..60_usize, groups: bool, second: bool, plain: bool, page in 16..400_usize,
        ) {
            let [o, m, a] = widths;
            let layout = layout([o, if alike { o } else { m }, a], state);
            let batches: Vec<RecordBatch> = steps.iter().map(|steps| block(&layout, steps)).collect();
            let mut properties = properties(&batches[0].schema()).into_builder().set_data_page_size_limit(page)
                .set_write_batch_size(7);
            if second {
                properties = properties.set_writer_version(WriterVersion::PARQUET_2_0);
            }
            if plain {
                properties = properties.set_compression(Compression::UNCOMPRESSED);
                for field in batches[0].schema().fields() {
                    let path = vec![field.name().clone(), "list".to_owned(), "element".to_owned()];
                    properties = properties.set_column_encoding(path.into(), Encoding::PLAIN);
                }
            }
            let file = write(&batches, properties.build(), groups);
            let [own, twins] = same_as_the_crate(file.path(), rows);
            prop_assert!(own >= 3, "{own} columns are read here");
            prop_assert_eq!(twins, if alike || o == m { 2 } else { 0 });
        }
    }

    #[test]
    fn a_dictionary_and_a_type_of_another_are_left_to_the_crate() {
        let layout = layout([2, 2, 1], 1);
        let file = write(&[block(&layout, &[3, 4])], WriterProperties::builder().build(), false);
        let [own, twins] = same_as_the_crate(file.path(), 3);
        assert_eq!([own, twins], [4, 0], "only truth values have no dictionary");
    }

    /// What is said of a file whose column `message.a` (lists of 2) and `action.a` (lists of 2, or null) have these levels.
    fn fault(message: [&[i16]; 2], action: [&[i16]; 2], rows: Option<i64>) -> String {
        let layout = Layout { agents: layout([1, 2, 2], 0).agents[..1].to_vec(), state_fields: vec![] };
        let good = block(&layout, &[1]);
        let file = tempfile::NamedTempFile::new().unwrap();
        let writer =
            ArrowWriter::try_new(file.reopen().unwrap(), good.schema(), Some(properties(&good.schema()))).unwrap();
        let (mut writer, _) = writer.into_serialized_writer().unwrap();
        let names: Vec<String> = good.schema().fields().iter().map(|f| f.name().clone()).collect();
        let mut group = writer.next_row_group().unwrap();
        for name in names {
            let mut column = group.next_column().unwrap().unwrap();
            let floats =
                |column: &mut parquet::file::writer::SerializedColumnWriter<'_>, [reps, defs]: [&[i16]; 2], most| {
                    let values = vec![0.5; defs.iter().filter(|&&d| d == most).count()];
                    column.typed::<FloatType>().write_batch(&values, Some(defs), Some(reps)).unwrap();
                };
            match name.as_str() {
                "episode" => {
                    column.typed::<Int64Type>().write_batch(&[0, 0], None, None).unwrap();
                }
                "step" => {
                    column.typed::<Int32Type>().write_batch(&[0, 1], None, None).unwrap();
                }
                "observation.a" => floats(&mut column, [&[0, 0], &[1, 1]], 1),
                "message.a" => floats(&mut column, message, 1),
                "action.a" => floats(&mut column, action, 2),
                "link" => {
                    let column = column.typed::<BoolType>();
                    column.write_batch(&[true, true], Some(&[1, 1]), Some(&[0, 0])).unwrap();
                }
                name if name.starts_with("reward") => {
                    column.typed::<FloatType>().write_batch(&[0.5], Some(&[1, 0]), None).unwrap();
                }
                _ => {
                    column.typed::<BoolType>().write_batch(&[true, false], None, None).unwrap();
                }
            }
            column.close().unwrap();
        }
        group.close().unwrap();
        writer.close().unwrap();
        let mut ours = open(file.path(), 10);
        if let Some(rows) = rows {
            let metadata = ours.metadata.metadata().as_ref().clone().into_builder();
            let groups = ours.metadata.metadata().row_groups().iter();
            let groups = groups.map(|g| g.clone().into_builder().set_num_rows(rows).build().unwrap()).collect();
            let metadata = metadata.set_row_groups(groups).build();
            ours.metadata = ArrowReaderMetadata::try_new(Arc::new(metadata), ArrowReaderOptions::new()).unwrap();
        }
        let read: Result<Vec<RecordBatch>, ArrowError> = ours.collect();
        read.map_or_else(|e| e.to_string(), |batches| format!("{} rows", batches[0].num_rows()))
    }

    #[test]
    fn levels_and_lengths_that_are_not_ours_are_errors_that_name_the_column() {
        let (lists, nulls): ([&[i16]; 2], [&[i16]; 2]) = ([&[0, 1, 0, 1], &[1; 4]], [&[0, 1, 0], &[2, 2, 0]]);
        assert_eq!(fault(lists, nulls, None), "2 rows");
        let (message, action) =
            ("Parquet argument error: column message.a: ", "Parquet argument error: column action.a: ");
        let width = "a list that does not have 2 elements";
        for (bad, expected) in [
            ([&[0, 1, 1, 0, 1][..], &[1; 5][..]], width),
            ([&[0, 0, 1], &[1; 3]], width),
            ([&[0, 1, 0], &[1; 3]], "2 rows were expected, 1 are there"),
            ([&[0, 1, 0, 1], &[1, 0, 1, 1]], "4 values in 12 bytes"),
        ] {
            assert_eq!(fault(bad, nulls, None), format!("{message}{expected}"), "{bad:?}");
        }
        for (bad, expected) in [
            ([&[0, 1, 1, 0][..], &[2, 2, 2, 0][..]], width),
            ([&[0, 0], &[2, 0]], width),
            ([&[0, 0], &[1, 0]], "a null or empty list where only a null row may be"),
            ([&[0, 1, 0], &[2, 1, 0]], "a null or empty list where only a null row may be"),
        ] {
            assert_eq!(fault(lists, bad, None), format!("{action}{expected}"), "{bad:?}");
        }
        assert_eq!(
            fault(lists, nulls, Some(1)),
            "Parquet argument error: column is_first: it has more rows than its row group"
        );
        assert!(fault(lists, nulls, Some(3)).contains("3 rows were expected"), "{}", fault(lists, nulls, Some(3)));
        assert!(fault(lists, nulls, Some(i64::MAX)).contains("rows were expected"));
    }
}
