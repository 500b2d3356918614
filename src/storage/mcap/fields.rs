//! The fields of protobuf messages whose descriptors are in the file.

use std::collections::BTreeMap;

use prost::Message as _;

use super::topics::{Cell, Emit};

/// Deepest message in a message.
const DEPTH: usize = 32;
/// Most elements of a repeated field that become columns.
const ELEMENTS: usize = 10_000;

/// google/protobuf/descriptor.proto, as far as it is needed.
#[derive(Clone, PartialEq, prost::Message)]
struct FileSet {
    #[prost(message, repeated, tag = "1")]
    file: Vec<FileOf>,
}

#[derive(Clone, PartialEq, prost::Message)]
struct FileOf {
    #[prost(string, tag = "2")]
    package: String,
    #[prost(message, repeated, tag = "4")]
    message: Vec<MessageOf>,
    #[prost(string, tag = "12")]
    syntax: String,
}

#[derive(Clone, PartialEq, prost::Message)]
struct MessageOf {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(message, repeated, tag = "2")]
    field: Vec<FieldOf>,
    #[prost(message, repeated, tag = "3")]
    nested: Vec<Self>,
}

#[derive(Clone, PartialEq, prost::Message)]
struct FieldOf {
    #[prost(string, tag = "1")]
    name: String,
    #[prost(uint32, tag = "3")]
    number: u32,
    #[prost(int32, tag = "4")]
    label: i32,
    #[prost(int32, tag = "5")]
    kind: i32,
    #[prost(string, tag = "6")]
    type_name: String,
    #[prost(int32, optional, tag = "9")]
    one_of: Option<i32>,
    #[prost(bool, tag = "17")]
    optional: bool,
}

/// One field of a message.
#[derive(Clone, Debug)]
struct Field {
    name: String,
    kind: i32,
    repeated: bool,
    /// Whether a message without it has its zero: a plain field of proto3.
    has_zero: bool,
    /// The type of a message.
    message: String,
}

/// A message type, and all types of its file.
#[derive(Clone, Debug)]
pub(super) struct Messages {
    types: BTreeMap<String, BTreeMap<u32, Field>>,
    root: String,
}

/// What is on the wire.
enum Wire<'a> {
    Number(u64),
    Bytes(&'a [u8]),
}

impl Messages {
    pub(super) fn new(descriptors: &[u8], name: &str) -> Result<Self, String> {
        let set = FileSet::decode(descriptors).map_err(|e| format!("no protobuf descriptors: {e}"))?;
        let mut types = BTreeMap::new();
        for file in &set.file {
            let package = if file.package.is_empty() { String::new() } else { format!(".{}", file.package) };
            file.message.iter().for_each(|message| add(message, &package, file.syntax == "proto3", &mut types));
        }
        let root = format!(".{name}");
        if types.contains_key(&root) { Ok(Self { types, root }) } else { Err(format!("its descriptors lack {name}")) }
    }

    /// Gives the values of a message, by the path of their field behind `name`.
    pub(super) fn values(&self, data: &[u8], name: &mut String, emit: &mut Emit<'_>) -> Result<(), String> {
        self.message(&self.root, data, name, emit, 0)
    }

    fn message(
        &self,
        kind: &str,
        mut data: &[u8],
        name: &mut String,
        emit: &mut Emit<'_>,
        depth: usize,
    ) -> Result<(), String> {
        if depth > DEPTH {
            return Err(format!("messages nested deeper than {DEPTH}"));
        }
        let Some(fields) = self.types.get(kind) else { return Ok(()) };
        let mut counts: BTreeMap<u32, usize> = BTreeMap::new();
        let length = name.len();
        while !data.is_empty() {
            let key = varint(&mut data)?;
            let wire = wire(key & 7, &mut data)?;
            let number = u32::try_from(key >> 3).map_err(|_e| "a field number that is none".to_owned())?;
            let Some(field) = fields.get(&number) else { continue };
            let count = counts.entry(number).or_default();
            name.push('.');
            name.push_str(&field.name);
            match wire {
                Wire::Bytes(bytes) if field.repeated && is_scalar(field.kind) => {
                    let mut packed = bytes;
                    while !packed.is_empty() {
                        let value = match width(field.kind) {
                            0 => varint(&mut packed)?,
                            bytes => fixed(&mut packed, bytes)?,
                        };
                        self.element(field, &Wire::Number(value), count, name, emit, depth)?;
                    }
                }
                wire => self.element(field, &wire, count, name, emit, depth)?,
            }
            name.truncate(length);
        }
        let absent = fields.iter().filter(|(number, field)| field.has_zero && !counts.contains_key(number));
        for (_, field) in absent {
            name.push('.');
            name.push_str(&field.name);
            let zero = if field.kind == 9 { Wire::Bytes(&[]) } else { Wire::Number(0) };
            self.value(field, &zero, name, emit, depth)?;
            name.truncate(length);
        }
        Ok(())
    }

    /// One value of a field; of a repeated one with its place.
    fn element(
        &self,
        field: &Field,
        wire: &Wire<'_>,
        count: &mut usize,
        name: &mut String,
        emit: &mut Emit<'_>,
        depth: usize,
    ) -> Result<(), String> {
        let (place, length) = (*count, name.len());
        *count += 1;
        if place >= ELEMENTS {
            return Ok(());
        }
        if field.repeated {
            name.extend(["[", &place.to_string(), "]"]);
        }
        self.value(field, wire, name, emit, depth)?;
        name.truncate(length);
        Ok(())
    }

    fn value(
        &self,
        field: &Field,
        wire: &Wire<'_>,
        name: &mut String,
        emit: &mut Emit<'_>,
        depth: usize,
    ) -> Result<(), String> {
        let cell = match (field.kind, wire) {
            (11, Wire::Bytes(bytes)) => return self.message(&field.message, bytes, name, emit, depth + 1),
            (9, Wire::Bytes(bytes)) => {
                let text = std::str::from_utf8(bytes).map_err(|_e| format!("{name}: expected UTF-8 text"))?;
                Cell::Text(text.to_owned())
            }
            (1, Wire::Number(bits)) => Cell::Float(f64::from_bits(*bits)),
            (2, Wire::Number(bits)) => Cell::Float(f64::from(f32::from_bits(*bits as u32))),
            (8, Wire::Number(bits)) => Cell::Truth(*bits != 0),
            (17 | 18, Wire::Number(bits)) => Cell::Integer((*bits >> 1) as i64 ^ -((*bits & 1) as i64)),
            (15, Wire::Number(bits)) => Cell::Integer(i64::from(*bits as i32)),
            (4 | 6, Wire::Number(bits)) => i64::try_from(*bits).map_or(Cell::Float(*bits as f64), Cell::Integer),
            (3 | 5 | 7 | 13 | 14 | 16, Wire::Number(bits)) => Cell::Integer(*bits as i64),
            // bytes and groups are no columns
            _ => return Ok(()),
        };
        emit(name, cell)
    }
}

fn add(message: &MessageOf, outer: &str, proto3: bool, types: &mut BTreeMap<String, BTreeMap<u32, Field>>) {
    let name = format!("{outer}.{}", message.name);
    let field = |field: &FieldOf| {
        let repeated = field.label == 3;
        let has_zero = proto3
            && !repeated
            && !field.optional
            && field.one_of.is_none()
            && (is_scalar(field.kind) || field.kind == 9);
        let (name, message) = (field.name.clone(), field.type_name.clone());
        (field.number, Field { name, kind: field.kind, repeated, has_zero, message })
    };
    message.nested.iter().for_each(|nested| add(nested, &name, proto3, types));
    types.insert(name, message.field.iter().map(field).collect());
}

/// Whether a type is a number or a truth value: neither text, bytes, group nor message.
fn is_scalar(kind: i32) -> bool {
    matches!(kind, 1..=8 | 13..=18)
}

/// Bytes of a scalar of fixed width; 0: a varint.
fn width(kind: i32) -> usize {
    match kind {
        1 | 6 | 16 => 8,
        2 | 7 | 15 => 4,
        _ => 0,
    }
}

fn wire<'a>(kind: u64, data: &mut &'a [u8]) -> Result<Wire<'a>, String> {
    match kind {
        0 => varint(data).map(Wire::Number),
        1 => fixed(data, 8).map(Wire::Number),
        2 => {
            let length = usize::try_from(varint(data)?).map_err(|_e| short())?;
            let (bytes, rest) = data.split_at_checked(length).ok_or_else(short)?;
            *data = rest;
            Ok(Wire::Bytes(bytes))
        }
        5 => fixed(data, 4).map(Wire::Number),
        other => Err(format!("a wire type {other} in a protobuf message")),
    }
}

fn short() -> String {
    "a protobuf message ends within a field".to_owned()
}

fn fixed(data: &mut &[u8], width: usize) -> Result<u64, String> {
    let (bytes, rest) = data.split_at_checked(width).ok_or_else(short)?;
    *data = rest;
    Ok(bytes.iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte)))
}

fn varint(data: &mut &[u8]) -> Result<u64, String> {
    prost::encoding::decode_varint(data).map_err(|e| e.to_string())
}
