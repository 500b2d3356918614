//! NPY: one array of `NumPy`. A vector is the column `c0`, a matrix the columns `c0`, `c1`, …; a structured vector has the
//! names of its fields (`pose.x` within one, `v[0]` of an array).

use std::fs::File;
use std::io::{BufReader, Read, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};

use npyz::{DType, Endianness, NpyHeader, Order, TimeUnits, TypeChar, TypeStr};
use polars::prelude::{Column, DataFrame, DataType, NamedFrom as _, Series, TimeUnit};

use super::form::{TableFile, open};
use crate::io::IoError;
use crate::pairs::PairsError;

/// Longest header, bytes: a thousand named fields take 30 kB.
const HEADER_LIMIT: u64 = 1 << 20;
/// Deepest brackets in a header: the parser calls itself.
const DEPTH_LIMIT: usize = 12;
/// Most columns.
const COLUMN_LIMIT: u64 = 1 << 20;

/// An array whose header fits its length.
pub(super) struct Npy {
    path: PathBuf,
    rows: usize,
    columns: Vec<Slot>,
}

/// One column: where its first value stands, how far the next one is, and what it is.
struct Slot {
    name: String,
    start: u64,
    stride: u64,
    kind: TypeStr,
}

impl Npy {
    pub(super) fn new(path: &Path) -> Result<Self, PairsError> {
        let mut file = open(path)?;
        let size = file.metadata().map_err(IoError::os("read", path))?.len();
        let header = header(&mut file).map_err(|message| unreadable(message, path))?;
        let data = file.stream_position().map_err(IoError::os("read", path))?;
        let (rows, columns) = slots(&header, data, size).map_err(|message| unreadable(message, path))?;
        Ok(Self { path: path.to_owned(), rows, columns })
    }
}

impl TableFile for Npy {
    fn names(&self) -> Result<Vec<String>, PairsError> {
        Ok(self.columns.iter().map(|slot| slot.name.clone()).collect())
    }

    fn read(&self, columns: &[&str]) -> Result<DataFrame, PairsError> {
        let slots = self.columns.iter().filter(|slot| columns.contains(&slot.name.as_str()));
        let read = slots.map(|slot| {
            let values = slot.read(open(&self.path)?, self.rows).map_err(IoError::os("read", &self.path))?;
            Ok(values.map_err(|message| unreadable(message, &self.path))?.into())
        });
        let columns = read.collect::<Result<Vec<Column>, PairsError>>()?;
        DataFrame::new(self.rows, columns).map_err(super::form::unreadable("NPY", &self.path))
    }
}

fn unreadable(message: String, path: &Path) -> PairsError {
    PairsError::Unreadable { form: "NPY", message, path: path.to_owned() }
}

/// Reads the header; the file then stands at the data. Its length and depth are limited before it is parsed.
fn header(file: &mut File) -> Result<NpyHeader, String> {
    let mut bytes = Vec::new();
    let mut more = |bytes: &mut Vec<u8>, count: u64| match file.take(count).read_to_end(bytes) {
        Ok(read) if read as u64 == count => Ok(()),
        Ok(_) => Err("it ends within its header: cut short?".to_owned()),
        Err(error) => Err(error.to_string()),
    };
    more(&mut bytes, 8)?;
    let width = if bytes[6] == 1 { 2 } else { 4 };
    more(&mut bytes, width)?;
    let length = bytes[8..].iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte));
    if length > HEADER_LIMIT {
        return Err(format!("a header of {length} bytes, expected at most {HEADER_LIMIT}"));
    }
    more(&mut bytes, length)?;
    let (mut depth, mut deepest) = (0_usize, 0);
    for byte in &bytes[8..] {
        match byte {
            b'(' | b'[' | b'{' => depth += 1,
            b')' | b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
        deepest = deepest.max(depth);
    }
    if deepest > DEPTH_LIMIT {
        return Err(format!("a header with brackets {deepest} deep, expected at most {DEPTH_LIMIT}"));
    }
    if bytes.windows(3).any(|w| matches!(w, b"|O'" | b"|O\"")) {
        return Err("it holds Python objects, expected numbers, booleans, dates or words".to_owned());
    }
    NpyHeader::from_reader(&bytes[..]).map_err(|error| error.to_string())
}

/// Rows and columns of an array that begins at byte `data` of a file of `size` bytes.
fn slots(header: &NpyHeader, data: u64, size: u64) -> Result<(usize, Vec<Slot>), String> {
    let shape = header.shape();
    let text = || format!("({})", shape.iter().map(u64::to_string).collect::<Vec<_>>().join(", "));
    let (rows, width) = match *shape {
        [rows] => (rows, 1),
        [rows, width] => (rows, width),
        _ => return Err(format!("expected one or two dimensions, found the shape {}: reshape it", text())),
    };
    let item = header.dtype().num_bytes().map_or(0, |bytes| bytes as u64);
    if item == 0 {
        return Err("its elements have no bytes".to_owned());
    }
    let bytes = rows.checked_mul(width).and_then(|count| count.checked_mul(item));
    let found = size.saturating_sub(data);
    if bytes != Some(found) {
        return Err(format!(
            "the shape {} of {item} bytes each does not fit the {found} bytes behind the header: cut short?",
            text()
        ));
    }
    let mut columns = Vec::new();
    if matches!(header.dtype(), DType::Record(_)) {
        if shape.len() != 1 {
            return Err(format!("expected one dimension of a structured array, found the shape {}", text()));
        }
        fields("", &header.dtype(), data, item, &mut columns)?;
    } else {
        for c in 0..width.min(COLUMN_LIMIT + 1) {
            let (start, stride) = if header.order() == Order::Fortran {
                (c * rows * item, item)
            } else {
                (c * item, width.saturating_mul(item))
            };
            push(format!("c{c}"), &header.dtype(), data + start, stride, &mut columns)?;
        }
    }
    Ok((rows as usize, columns))
}

/// The columns of one field, and of what is in it. Its depth is that of the header's brackets.
fn fields(name: &str, kind: &DType, start: u64, stride: u64, out: &mut Vec<Slot>) -> Result<(), String> {
    match kind {
        DType::Record(inner) => {
            let mut start = start;
            for field in inner {
                let name = if name.is_empty() { field.name.clone() } else { format!("{name}.{}", field.name) };
                fields(&name, &field.dtype, start, stride, out)?;
                start += field.dtype.num_bytes().unwrap_or(0) as u64;
            }
            Ok(())
        }
        DType::Array(count, inner) => {
            let step = inner.num_bytes().unwrap_or(0) as u64;
            (0..*count).try_for_each(|i| fields(&format!("{name}[{i}]"), inner, start + i * step, stride, out))
        }
        DType::Plain(_) => push(name.to_owned(), kind, start, stride, out),
    }
}

fn push(name: String, kind: &DType, start: u64, stride: u64, out: &mut Vec<Slot>) -> Result<(), String> {
    let DType::Plain(kind) = kind else { return Err("an array of arrays".to_owned()) };
    if out.len() as u64 == COLUMN_LIMIT {
        return Err(format!("more than {COLUMN_LIMIT} columns: transpose it?"));
    }
    let known = match kind.type_char() {
        TypeChar::Float => kind.size_field() <= 8,
        TypeChar::Complex | TypeChar::RawData => false,
        TypeChar::DateTime | TypeChar::TimeDelta => kind.time_units().and_then(unit).is_some(),
        _ => kind.size_field() > 0,
    };
    if !known {
        return Err(format!("column {name} holds {kind}, expected numbers, booleans, dates or words"));
    }
    // fields without a name are padding
    if !name.is_empty() {
        out.push(Slot { name, start, stride, kind: kind.clone() });
    }
    Ok(())
}

/// What times of this unit become, and the factor.
fn unit(unit: TimeUnits) -> Option<(TimeUnit, i64)> {
    Some(match unit {
        TimeUnits::Week => (TimeUnit::Milliseconds, 7 * 86_400_000),
        TimeUnits::Day => (TimeUnit::Milliseconds, 86_400_000),
        TimeUnits::Hour => (TimeUnit::Milliseconds, 3_600_000),
        TimeUnits::Minute => (TimeUnit::Milliseconds, 60_000),
        TimeUnits::Second => (TimeUnit::Milliseconds, 1000),
        TimeUnits::Millisecond => (TimeUnit::Milliseconds, 1),
        TimeUnits::Microsecond => (TimeUnit::Microseconds, 1),
        TimeUnits::Nanosecond => (TimeUnit::Nanoseconds, 1),
        _ => return None,
    })
}

impl Slot {
    /// The column's values; `Err` inside when they are no values of its type.
    fn read(&self, file: File, rows: usize) -> std::io::Result<Result<Series, String>> {
        let width = self.kind.num_bytes().unwrap_or(0);
        let mut input = BufReader::with_capacity(1 << 18, file);
        input.seek(SeekFrom::Start(self.start))?;
        let mut item = vec![0; width];
        let skip = self.stride as i64 - width as i64;
        let swap = self.kind.endianness() == Endianness::Big;
        let mut each = |take: &mut dyn FnMut(&[u8])| -> std::io::Result<()> {
            for row in 0..rows {
                input.read_exact(&mut item)?;
                if swap {
                    item.reverse();
                }
                take(&item);
                if skip > 0 && row + 1 < rows {
                    input.seek_relative(skip)?;
                }
            }
            Ok(())
        };
        let name = self.name.as_str().into();
        // the rows' bytes are in the file: `rows` is no more than its length
        Ok(Ok(match self.kind.type_char() {
            TypeChar::Bool => {
                let mut values = Vec::with_capacity(rows);
                each(&mut |item| values.push(item[0] != 0))?;
                Series::new(name, values)
            }
            TypeChar::Int => {
                let mut values = Vec::with_capacity(rows);
                each(&mut |item| values.push(signed(item)))?;
                Series::new(name, values)
            }
            TypeChar::Uint => {
                let mut values = Vec::with_capacity(rows);
                each(&mut |item| values.push(unsigned(item)))?;
                if values.iter().all(|&value| i64::try_from(value).is_ok()) {
                    Series::new(name, values.into_iter().map(|value| value as i64).collect::<Vec<_>>())
                } else {
                    Series::new(name, values)
                }
            }
            TypeChar::Float => {
                let mut values = Vec::with_capacity(rows);
                each(&mut |item| values.push(float(item)))?;
                Series::new(name, values)
            }
            TypeChar::DateTime | TypeChar::TimeDelta => {
                let Some((unit, factor)) = self.kind.time_units().and_then(unit) else {
                    return Ok(Err("a unit of time that is none".to_owned()));
                };
                let mut values = Vec::with_capacity(rows);
                each(&mut |item| values.push(signed(item)))?;
                let not_a_time = |&value: &i64| value != i64::MIN;
                let scaled: Option<Vec<Option<i64>>> = values
                    .iter()
                    .map(|value| match Some(value).filter(|v| not_a_time(v)) {
                        Some(value) => value.checked_mul(factor).map(Some),
                        None => Some(None),
                    })
                    .collect();
                let Some(scaled) = scaled else {
                    return Ok(Err(format!("column {} holds a time that is too large", self.name)));
                };
                let kind = if self.kind.type_char() == TypeChar::DateTime {
                    DataType::Datetime(unit, None)
                } else {
                    DataType::Duration(unit)
                };
                return Ok(Series::new(name, scaled).cast(&kind).map_err(|e| e.to_string()));
            }
            TypeChar::ByteStr | TypeChar::UnicodeStr => {
                let unicode = self.kind.type_char() == TypeChar::UnicodeStr;
                let mut values: Vec<Option<String>> = Vec::with_capacity(rows);
                each(&mut |item| values.push(if unicode { wide(item, swap) } else { narrow(item) }))?;
                if let Some(row) = values.iter().position(Option::is_none) {
                    return Ok(Err(format!("column {}, row {}: expected UTF-8 text", self.name, row + 1)));
                }
                Series::new(name, values)
            }
            _ => return Ok(Err(format!("column {} holds {}", self.name, self.kind))),
        }))
    }
}

/// Little-endian bytes, at most eight, as a number.
fn unsigned(item: &[u8]) -> u64 {
    item.iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte))
}

fn signed(item: &[u8]) -> i64 {
    let unused = 64 - 8 * item.len();
    (unsigned(item) << unused) as i64 >> unused
}

/// A float of two, four or eight bytes.
fn float(item: &[u8]) -> f64 {
    let bits = unsigned(item);
    match item.len() {
        2 => half(bits as u16),
        4 => f64::from(f32::from_bits(bits as u32)),
        _ => f64::from_bits(bits),
    }
}

/// IEEE 754 binary16.
fn half(bits: u16) -> f64 {
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f64::from(bits & 1023) / 1024.0);
    let size = match exponent {
        31 if fraction == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        0 => fraction * 2_f64.powi(-14),
        _ => (1.0 + fraction) * 2_f64.powi(exponent - 15),
    };
    if bits >> 15 == 1 { -size } else { size }
}

/// Bytes up to the zeros at their end.
fn narrow(item: &[u8]) -> Option<String> {
    let end = item.iter().rposition(|&byte| byte != 0).map_or(0, |at| at + 1);
    String::from_utf8(item[..end].to_vec()).ok()
}

/// Code points of four bytes up to the zeros at their end; `swapped`: the whole item was reversed.
fn wide(item: &[u8], swapped: bool) -> Option<String> {
    let mut points: Vec<u32> = item.chunks_exact(4).map(|four| unsigned(four) as u32).collect();
    if swapped {
        points.reverse();
    }
    let end = points.iter().rposition(|&point| point != 0).map_or(0, |at| at + 1);
    points[..end].iter().map(|&point| char::from_u32(point)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_are_those_of_ieee() {
        let cases = [(0x3c00, 1.0), (0xc000, -2.0), (0x3555, 0.333251953125), (1, 2_f64.powi(-24)), (0x7bff, 65504.0)];
        for (bits, value) in cases {
            assert_eq!(half(bits), value, "{bits:x}");
        }
        assert!(half(0x7e00).is_nan() && half(0xfc00) == f64::NEG_INFINITY);
        assert_eq!((signed(&[0xfe]), signed(&[0, 0x80]), signed(&[1, 0, 0, 0])), (-2, -32768, 1));
    }
}
