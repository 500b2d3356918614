//! One column of one row group: its pages, straight into the arrays that hold its rows.
//!
//! The Parquet crate takes the pages off the disk and decompresses them. It puts lists together from levels, element by
//! element, which costs more than all else in reading; ours have a fixed width, so here the levels are only checked.

use std::collections::VecDeque;
use std::sync::Arc;

use arrow::array::{ArrayRef, BooleanArray, BooleanBufferBuilder, FixedSizeListArray, Float32Array, Float64Array};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{DataType, Field};
use arrow::error::ArrowError;
use bytes::Bytes;
use parquet::basic::Encoding;
use parquet::column::page::{Page, PageReader as _};
use parquet::errors::ParquetError;
use parquet::file::metadata::{ColumnChunkMetaData, ParquetMetaData};
use parquet::file::serialized_reader::SerializedPageReader;

use super::levels::{self, Run, Shape};
use super::shared::Shared;

/// What is read from a column of a file: where it is, and what its values are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Plan {
    /// Number among the leaf columns.
    pub(super) column: usize,
    kind: Kind,
    shape: Shape,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    F32,
    F64,
    Bit,
}

impl Plan {
    /// How the field that is column `root` of the file is read here; `None` where it is of a type or encoding that ours
    /// do not have, so that the crate reads it.
    pub(super) fn new(metadata: &ParquetMetaData, root: usize, field: &Field) -> Option<Self> {
        let schema = metadata.file_metadata().schema_descr();
        let mut leaves = (0..schema.num_columns()).filter(|&leaf| schema.get_column_root_idx(leaf) == root);
        let (column, None) = (leaves.next()?, leaves.next()) else { return None };
        let (element, width) = match field.data_type() {
            DataType::FixedSizeList(element, width) => (element.data_type(), usize::try_from(*width).ok()?),
            plain => (plain, 1),
        };
        let kind = match element {
            DataType::Float32 => Kind::F32,
            DataType::Float64 => Kind::F64,
            DataType::Boolean => Kind::Bit,
            _ => return None,
        };
        let leaf = schema.column(column);
        let list = matches!(field.data_type(), DataType::FixedSizeList(..));
        let present = u8::try_from(leaf.max_def_level()).ok()?;
        let shape = Shape { width, list, nullable: field.is_nullable(), present };
        // a level for the row if it may be null, one for the list, one for an element that may be
        let expected = u8::from(shape.nullable) + u8::from(list);
        let fits = leaf.max_rep_level() == i16::from(list)
            && (present == expected || list && present == expected + 1)
            && width > 0;
        let plain = |group: &ColumnChunkMetaData| {
            let known = [Encoding::PLAIN, Encoding::BYTE_STREAM_SPLIT, Encoding::RLE];
            group.dictionary_page_offset().is_none()
                && group.encodings().all(|e| known.contains(&e))
                && group.encodings().any(|e| e != Encoding::RLE)
        };
        let fits = fits && metadata.row_groups().iter().all(|group| plain(group.column(column)));
        fits.then_some(Self { column, kind, shape })
    }

    /// Whether row group `group` holds the same pages for this column as for `other`.
    pub(super) fn same(&self, other: &Self, file: &Shared, metadata: &ParquetMetaData, group: usize) -> bool {
        let chunk = |plan: &Self| metadata.row_group(group).column(plan.column);
        let (a, b) = (chunk(self), chunk(other));
        let ((from, length), (other_from, other_length)) = (a.byte_range(), b.byte_range());
        (self.kind, self.shape) == (other.kind, other.shape)
            && (a.compression(), a.num_values(), length) == (b.compression(), b.num_values(), other_length)
            && file.same(from, other_from, length).unwrap_or(false)
    }
}

/// Reads the rows of a column of a row group, in order.
pub(super) struct Leaf {
    plan: Plan,
    pages: SerializedPageReader<Shared>,
    page: Opened,
    /// Values of the row that the pages so far have begun and not ended.
    begun: usize,
    /// Room for levels.
    levels: [Vec<u8>; 2],
    /// The levels of the page before: most pages repeat them, and comparing bytes is ten times cheaper than reading them.
    seen: Seen,
}

/// What levels were found to say.
#[derive(Default)]
struct Seen {
    begun: usize,
    count: usize,
    /// Repetition and definition levels as they stand in the page.
    levels: [Vec<u8>; 2],
    rows: Option<levels::Rows>,
}

/// Runs that are kept for the next page at most; ours have two per episode.
const SEEN_RUNS: usize = 1 << 14;

/// What is left of a page.
#[derive(Default)]
struct Opened {
    values: Bytes,
    encoding: Values,
    /// Values in it, and the next one.
    count: usize,
    at: usize,
    runs: VecDeque<Run>,
}

/// How the values of a page are laid out.
#[derive(Clone, Copy, Debug, Default)]
enum Values {
    /// One after the other.
    #[default]
    Plain,
    /// All first bytes, all second bytes, ….
    Split,
}

/// Values on their way into an array.
enum Out {
    F32(Vec<f32>),
    F64(Vec<f64>),
    Bit(BooleanBufferBuilder),
}

impl Leaf {
    /// At the first row of row group `group`.
    pub(super) fn open(
        plan: Plan,
        file: &Shared,
        metadata: &ParquetMetaData,
        group: usize,
    ) -> Result<Self, ParquetError> {
        let (chunk, file) = (metadata.row_group(group).column(plan.column), Arc::new(file.clone()));
        let pages = SerializedPageReader::new(file, chunk, 0, None)?;
        Ok(Self { plan, pages, page: Opened::default(), begun: 0, levels: Default::default(), seen: Seen::default() })
    }

    /// The next `rows` rows, as an array of the field's type.
    pub(super) fn read(&mut self, field: &Field, rows: usize) -> Result<ArrayRef, String> {
        let width = self.plan.shape.width;
        let slots = rows.checked_mul(width).ok_or("its rows are too many")?;
        let mut out = match self.plan.kind {
            Kind::F32 => Out::F32(Vec::with_capacity(slots)),
            Kind::F64 => Out::F64(Vec::with_capacity(slots)),
            Kind::Bit => Out::Bit(BooleanBufferBuilder::new(slots)),
        };
        let mut valid = vec![true; if self.plan.shape.nullable { rows } else { 0 }];
        let mut filled = 0;
        while filled < slots {
            let Some(mut run) = self.page.runs.pop_front() else {
                if self.next_page()? {
                    continue;
                }
                return Err(format!("{rows} rows were expected, {} are there", filled / width));
            };
            let n = run.slots.min(slots - filled);
            run.slots -= n;
            if run.null {
                valid[filled / width..(filled + n) / width].fill(false);
                out.skip(n);
            } else {
                out.take(&self.page, n);
                self.page.at += n;
            }
            if run.slots > 0 {
                self.page.runs.push_front(run);
            }
            filled += n;
        }
        let nulls = self.plan.shape.nullable.then(|| NullBuffer::from(valid));
        out.array(field, nulls.filter(|nulls| nulls.null_count() > 0)).map_err(|e| e.to_string())
    }

    /// Fails when there is more than was read.
    pub(super) fn end(mut self) -> Result<(), String> {
        while self.page.runs.is_empty() {
            if !self.next_page()? {
                return if self.begun == 0 { Ok(()) } else { Err("its last list is cut short".to_owned()) };
            }
        }
        Err("it has more rows than its row group".to_owned())
    }

    /// Opens the next page and checks its levels; false when there is none.
    fn next_page(&mut self) -> Result<bool, String> {
        let Some(page) = self.pages.get_next_page().map_err(|e| e.to_string())? else { return Ok(false) };
        let Plan { kind, shape, .. } = self.plan;
        let (mut rest, count, lengths) = match &page {
            Page::DataPage { buf, num_values, def_level_encoding, rep_level_encoding, .. } => {
                let levels = [(rep_level_encoding, shape.list), (def_level_encoding, shape.present > 0)];
                if let Some((other, _)) = levels.iter().find(|(e, there)| *there && **e != Encoding::RLE) {
                    return Err(format!("levels encoded as {other}"));
                }
                (buf.clone(), *num_values as usize, None)
            }
            Page::DataPageV2 { buf, num_values, rep_levels_byte_len, def_levels_byte_len, .. } => {
                (buf.clone(), *num_values as usize, Some([*rep_levels_byte_len, *def_levels_byte_len]))
            }
            Page::DictionaryPage { .. } => return Err("a dictionary where none was announced".to_owned()),
        };
        let mut inputs = [Bytes::new(), Bytes::new()];
        for ((i, input), there) in inputs.iter_mut().enumerate().zip([shape.list, shape.present > 0]) {
            if there {
                let length = match lengths {
                    Some(lengths) => lengths[i] as usize,
                    None => prefix(&mut rest)?,
                };
                *input = take(&mut rest, length)?;
            }
        }
        // every value has its bytes, so a page without nulls cannot describe more than it holds
        if !shape.nullable && count > kind.most(rest.len()) {
            return Err(format!("{count} values in {} bytes", rest.len()));
        }
        let (runs, values) = self.rows(&inputs, count)?;
        let (mut encoding, mut length) = (Values::Plain, values * kind.bits() / 8);
        match (page.encoding(), kind) {
            (Encoding::PLAIN, Kind::Bit) => length = values.div_ceil(8),
            (Encoding::PLAIN, _) => {}
            (Encoding::BYTE_STREAM_SPLIT, Kind::F32 | Kind::F64) => encoding = Values::Split,
            (other, _) => return Err(format!("values encoded as {other}")),
        }
        if rest.len() != length {
            return Err(format!("{values} values in {} bytes", rest.len()));
        }
        self.page = Opened { values: rest, encoding, count: values, at: 0, runs: runs.into() };
        Ok(true)
    }

    /// The rows of a page of `count` levels.
    fn rows(&mut self, inputs: &[Bytes; 2], count: usize) -> Result<(Vec<Run>, usize), String> {
        let seen = &self.seen;
        if let Some(rows) = &seen.rows
            && (seen.begun, seen.count) == (self.begun, count)
            && seen.levels.iter().zip(inputs).all(|(seen, input)| seen == input)
        {
            self.begun = rows.begun;
            return Ok((rows.runs.clone(), rows.values));
        }
        let shape = self.plan.shape;
        let most = [u8::from(shape.list), shape.present];
        for ((input, levels), most) in inputs.iter().zip(&mut self.levels).zip(most) {
            levels.clear();
            if most > 0 {
                levels::expand(input, most, count, levels)?;
            }
        }
        let rows = levels::rows(shape, [&self.levels[0], &self.levels[1]], count, self.begun)?;
        let begun = std::mem::replace(&mut self.begun, rows.begun);
        if rows.runs.len() <= SEEN_RUNS {
            let levels = [inputs[0].to_vec(), inputs[1].to_vec()];
            self.seen = Seen { begun, count, levels, rows: Some(rows.clone()) };
        }
        Ok((rows.runs, rows.values))
    }
}

impl Kind {
    fn bits(self) -> usize {
        match self {
            Self::F32 => 32,
            Self::F64 => 64,
            Self::Bit => 1,
        }
    }

    /// Values that fit in `bytes` bytes at most.
    fn most(self, bytes: usize) -> usize {
        bytes.saturating_mul(8) / self.bits()
    }
}

/// The length that stands before levels.
fn prefix(rest: &mut Bytes) -> Result<usize, String> {
    let bytes = take(rest, 4)?;
    bytes
        .first_chunk()
        .map(|&bytes| u32::from_le_bytes(bytes) as usize)
        .ok_or_else(|| "its levels end early".to_owned())
}

fn take(rest: &mut Bytes, length: usize) -> Result<Bytes, String> {
    if length > rest.len() {
        return Err("its levels end early".to_owned());
    }
    Ok(rest.split_to(length))
}

impl Opened {
    /// The next `n` values as they stand, each of `N` bytes.
    fn plain<const N: usize>(&self, n: usize) -> &[[u8; N]] {
        self.values[self.at * N..(self.at + n) * N].as_chunks().0
    }

    /// The bytes of the next `n` values: all their first bytes, all their second, ….
    fn split<const N: usize>(&self, n: usize) -> [&[u8]; N] {
        std::array::from_fn(|i| &self.values[i * self.count + self.at..][..n])
    }
}

/// Four streams of bytes side by side; written so that the compiler makes vectors of it, which is four times faster.
fn quads([a, b, c, d]: [&[u8]; 4]) -> impl Iterator<Item = [u8; 4]> {
    a.iter().zip(b).zip(c.iter().zip(d)).map(|((&a, &b), (&c, &d))| [a, b, c, d])
}

impl Out {
    /// Appends `n` values of a page.
    fn take(&mut self, page: &Opened, n: usize) {
        match (self, page.encoding) {
            (Self::F32(out), Values::Plain) => out.extend(page.plain(n).iter().map(|&bytes| f32::from_le_bytes(bytes))),
            (Self::F64(out), Values::Plain) => out.extend(page.plain(n).iter().map(|&bytes| f64::from_le_bytes(bytes))),
            (Self::F32(out), Values::Split) => out.extend(quads(page.split(n)).map(f32::from_le_bytes)),
            (Self::F64(out), Values::Split) => {
                let [a, b, c, d, e, f, g, h] = page.split(n);
                let halves = quads([a, b, c, d]).zip(quads([e, f, g, h]));
                let whole =
                    |(low, high)| u64::from(u32::from_le_bytes(low)) | u64::from(u32::from_le_bytes(high)) << 32;
                out.extend(halves.map(|halves| f64::from_bits(whole(halves))));
            }
            (Self::Bit(out), _) => out.append_packed_range(page.at..page.at + n, &page.values),
        }
    }

    /// Leaves `n` places empty.
    fn skip(&mut self, n: usize) {
        match self {
            Self::F32(out) => out.resize(out.len() + n, 0.0),
            Self::F64(out) => out.resize(out.len() + n, 0.0),
            Self::Bit(out) => out.append_n(n, false),
        }
    }

    /// The values as an array of the field's type.
    fn array(self, field: &Field, nulls: Option<NullBuffer>) -> Result<ArrayRef, ArrowError> {
        let list = match field.data_type() {
            DataType::FixedSizeList(element, width) => Some((Arc::clone(element), *width)),
            _ => None,
        };
        let own = if list.is_some() { None } else { nulls.clone() };
        let values: ArrayRef = match self {
            Self::F32(values) => Arc::new(Float32Array::new(values.into(), own)),
            Self::F64(values) => Arc::new(Float64Array::new(values.into(), own)),
            Self::Bit(mut values) => Arc::new(BooleanArray::new(values.finish(), own)),
        };
        let Some((element, width)) = list else { return Ok(values) };
        Ok(Arc::new(FixedSizeListArray::try_new(element, width, values, nulls)?))
    }
}
