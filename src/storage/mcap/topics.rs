//! Topics of anybody's MCAP file as columns: `/imu.linear_acceleration.x`, an array's element `/joint.position[0]`.
//!
//! Messages in JSON and protobuf (whose descriptors are in the file) are read. The checksum of every chunk is checked, and a
//! record has at most 64 MiB.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use mcap::parse_record;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::LinearReaderOptions;

use super::fields::Messages;
use super::source::{Records, Stop};
use crate::storage::StorageError;

/// The column of each message's log time, nanoseconds.
const LOG_TIME: &str = "log_time";
/// Most columns of a file, and most elements of an array.
const COLUMN_LIMIT: usize = 10_000;

/// One value in a message.
#[derive(Clone, Debug, PartialEq)]
pub enum Cell {
    /// A whole number.
    Integer(i64),
    /// Any other number.
    Float(f64),
    /// True or false.
    Truth(bool),
    /// Text.
    Text(String),
}

/// One column: its name, and its value in each row.
pub type TopicColumn = (String, Vec<Option<Cell>>);

/// What takes the values of a message, by the path of their field.
pub(super) type Emit<'a> = dyn FnMut(&str, Cell) -> Result<(), String> + 'a;

/// The names of all columns, in the order of their first message; `log_time` is the first.
///
/// # Errors
/// [`StorageError::Damaged`], also when no topic can be read.
pub fn topic_names(path: &Path) -> Result<Vec<String>, StorageError> {
    let (mut names, mut known) = (vec![LOG_TIME.to_owned()], BTreeSet::new());
    let unread = each_message(path, &mut |channel, _, data| {
        channel.values(data, &mut |name, _| {
            if !known.contains(name) {
                if known.len() == COLUMN_LIMIT {
                    return Err(format!("more than {COLUMN_LIMIT} fields"));
                }
                known.insert(name.to_owned());
                names.push(name.to_owned());
            }
            Ok(())
        })
    })?;
    if known.is_empty() {
        let found = unread.into_iter().map(|(topic, kind)| format!("{topic} ({kind})")).collect::<Vec<_>>().join(", ");
        let found = if found.is_empty() { "no message".to_owned() } else { found };
        return Err(damaged(path, format!("expected topics in json or protobuf, found {found}")));
    }
    Ok(names)
}

/// The wanted columns. Those of one topic have a row per message, in the order of the file; those of several topics are
/// joined: a row per log time that a message of each topic has.
///
/// # Errors
/// [`StorageError::Damaged`], also when columns of several topics have no log time in common, or a topic has one twice.
pub fn topic_columns(path: &Path, wanted: &[&str]) -> Result<Vec<TopicColumn>, StorageError> {
    let mut found: BTreeMap<&str, Found> = BTreeMap::new();
    let mut times: BTreeMap<String, Vec<u64>> = BTreeMap::new();
    each_message(path, &mut |channel, time, data| {
        let rows = times.entry(channel.topic.clone()).or_default();
        let row = rows.len();
        rows.push(time);
        channel.values(data, &mut |name, cell| {
            let Some(&name) = wanted.iter().find(|wanted| **wanted == name) else { return Ok(()) };
            let of = found.entry(name).or_insert_with(|| Found { topic: channel.topic.clone(), cells: Vec::new() });
            if of.topic != channel.topic {
                return Err(format!("column {name} is a field of {} and of {}", of.topic, channel.topic));
            }
            of.cells.push((row, cell));
            Ok(())
        })
    })?;
    let topics: BTreeSet<&String> = found.values().map(|of| &of.topic).collect();
    let places = joined(&topics, &times).map_err(|message| damaged(path, message))?;
    let column = |name: &&str| {
        let mut cells = match found.get(name) {
            None => return ((*name).to_owned(), places.times.iter().map(|&time| Some(integer(time))).collect()),
            Some(of) => {
                let mut all = vec![None; times.get(&of.topic).map_or(0, Vec::len)];
                of.cells.iter().for_each(|(row, cell)| all[*row] = Some(cell.clone()));
                (all, &places.rows[&of.topic])
            }
        };
        ((*name).to_owned(), cells.1.iter().map(|&row| cells.0[row].take()).collect())
    };
    Ok(wanted.iter().map(column).collect())
}

/// The values of one column, by message of its topic.
struct Found {
    topic: String,
    cells: Vec<(usize, Cell)>,
}

/// Rows of a join: their log times, and per topic its messages.
struct Joined<'a> {
    times: Vec<u64>,
    rows: BTreeMap<&'a String, Vec<usize>>,
}

fn joined<'a>(topics: &BTreeSet<&'a String>, times: &BTreeMap<String, Vec<u64>>) -> Result<Joined<'a>, String> {
    let of = |topic: &String| times.get(topic).map_or(&[][..], Vec::as_slice);
    let Some(first) = topics.first() else {
        return Err(format!("{LOG_TIME} alone is no column of a topic: name one of its fields too"));
    };
    if topics.len() == 1 {
        let times = of(first).to_vec();
        let rows = (0..times.len()).collect();
        return Ok(Joined { times, rows: BTreeMap::from([(*first, rows)]) });
    }
    let mut places: BTreeMap<&String, BTreeMap<u64, usize>> = BTreeMap::new();
    for &topic in topics {
        let place = places.entry(topic).or_default();
        for (row, &time) in of(topic).iter().enumerate() {
            if place.insert(time, row).is_some() {
                return Err(format!(
                    "topics are joined by log time, and {topic} has two messages at {time}: take columns of one topic"
                ));
            }
        }
    }
    let common = |time: &u64| places.values().all(|place| place.contains_key(time));
    let times: Vec<u64> = places[first].keys().copied().filter(common).collect();
    if times.is_empty() {
        let names = topics.iter().map(|topic| topic.as_str()).collect::<Vec<_>>().join(", ");
        return Err(format!(
            "topics are joined by equal log times, and {names} have none in common: take columns of one topic"
        ));
    }
    let rows = places.iter().map(|(&topic, place)| (topic, times.iter().map(|time| place[time]).collect()));
    Ok(Joined { rows: rows.collect(), times })
}

fn integer(value: u64) -> Cell {
    i64::try_from(value).map_or(Cell::Float(value as f64), Cell::Integer)
}

fn damaged(path: &Path, message: String) -> StorageError {
    StorageError::Damaged { message, path: path.to_owned() }
}

/// A channel that can be read.
struct Channel {
    topic: String,
    kind: Kind,
}

enum Kind {
    Json,
    Protobuf(Messages),
}

impl Channel {
    /// Gives all values of a message, by `topic.field`.
    fn values(&self, data: &[u8], emit: &mut Emit<'_>) -> Result<(), String> {
        let said = |message: String| format!("topic {}: {message}", self.topic);
        let mut name = self.topic.clone();
        match &self.kind {
            Kind::Json => {
                let value = serde_json::from_slice(data).map_err(|e| said(format!("no JSON: {e}")))?;
                json(&value, &mut name, emit).map_err(said)
            }
            Kind::Protobuf(messages) => messages.values(data, &mut name, emit).map_err(said),
        }
    }
}

/// The values in a JSON value, whose depth its parser has limited.
fn json(value: &serde_json::Value, name: &mut String, emit: &mut Emit<'_>) -> Result<(), String> {
    use serde_json::Value;
    let length = name.len();
    match value {
        Value::Null => {}
        Value::Bool(truth) => emit(name, Cell::Truth(*truth))?,
        Value::String(text) => emit(name, Cell::Text(text.clone()))?,
        Value::Number(number) => match (number.as_i64(), number.as_f64()) {
            (Some(integer), _) => emit(name, Cell::Integer(integer))?,
            (None, float) => emit(name, Cell::Float(float.unwrap_or(f64::NAN)))?,
        },
        Value::Array(items) => {
            for (i, item) in items.iter().enumerate().take(COLUMN_LIMIT) {
                name.extend(["[", &i.to_string(), "]"]);
                json(item, name, emit)?;
                name.truncate(length);
            }
        }
        Value::Object(fields) => {
            for (field, inner) in fields {
                name.push('.');
                name.push_str(field);
                json(inner, name, emit)?;
                name.truncate(length);
            }
        }
    }
    Ok(())
}

/// What takes a message: its channel, log time and bytes.
type TakeMessage<'a> = dyn FnMut(&Channel, u64, &[u8]) -> Result<(), String> + 'a;

/// Calls `take` with every message of a readable channel, its log time and its bytes; returns the topics that are not
/// readable, with their encoding.
fn each_message(path: &Path, take: &mut TakeMessage<'_>) -> Result<BTreeMap<String, String>, StorageError> {
    check_chunks(path)?;
    let options = LinearReaderOptions::default().with_prevalidate_chunk_crcs(true);
    let mut schemas: BTreeMap<u16, (String, String, Vec<u8>)> = BTreeMap::new();
    let mut channels: BTreeMap<u16, Channel> = BTreeMap::new();
    let mut unread = BTreeMap::new();
    let read = Records::open(path, options)?.each(|opcode, body| {
        if opcode == op::DATA_END {
            return Ok(true); // what follows repeats what was there
        }
        let fits = match opcode {
            op::SCHEMA => strings(body, 2, 3).is_some(),
            op::CHANNEL => strings(body, 4, 2).is_some_and(|map| strings(map, 0, 1) == Some(&[]) && pairs(&map[4..])),
            op::MESSAGE => true,
            _ => return Ok(false),
        };
        if !fits {
            return Err("a schema or channel claims more than its record holds".to_owned());
        }
        match parse_record(opcode, body).map_err(|e| e.to_string())? {
            Record::Schema { header, data } => {
                schemas.insert(header.id, (header.name, header.encoding, data.into_owned()));
            }
            Record::Channel(channel) => {
                let kind = match (channel.message_encoding.as_str(), schemas.get(&channel.schema_id)) {
                    ("json", _) => Kind::Json,
                    ("protobuf", Some((name, encoding, data))) if encoding == "protobuf" => {
                        let messages = Messages::new(data, name);
                        Kind::Protobuf(messages.map_err(|message| format!("topic {}: {message}", channel.topic))?)
                    }
                    _ => {
                        unread.insert(channel.topic, channel.message_encoding);
                        return Ok(false);
                    }
                };
                channels.insert(channel.id, Channel { topic: channel.topic, kind });
            }
            Record::Message { header, data } => {
                if let Some(channel) = channels.get(&header.channel_id) {
                    take(channel, header.log_time, &data)?;
                }
            }
            _ => {}
        }
        Ok(false)
    });
    ended(read, path).map(|()| unread)
}

/// What is left of a record behind `count` texts with their lengths, the first at byte `from`: the parser would give memory
/// to any length.
fn strings(body: &[u8], from: usize, count: usize) -> Option<&[u8]> {
    let mut rest = body.get(from..)?;
    for _ in 0..count {
        let (length, behind) = rest.split_first_chunk()?;
        rest = behind.get(u32::from_le_bytes(*length) as usize..)?;
    }
    Some(rest)
}

/// Whether these bytes are texts with their lengths, to the end.
fn pairs(mut map: &[u8]) -> bool {
    while !map.is_empty() {
        let Some(rest) = strings(map, 0, 2) else { return false };
        map = rest;
    }
    true
}

/// What a chunk may become: this many bytes, or so many times its own length. Its reader believes what it claims.
const CHUNK_LIMIT: u64 = 64 << 20;
const RATIO_LIMIT: u64 = 256;

/// Refuses a chunk that claims to be absurdly long.
fn check_chunks(path: &Path) -> Result<(), StorageError> {
    let options = LinearReaderOptions::default().with_emit_chunks(true);
    let read = Records::open(path, options)?.each(|opcode, body| {
        if opcode == op::DATA_END {
            return Ok(true);
        }
        if opcode == op::CHUNK
            && strings(body, 28, 1).is_some()
            && let Record::Chunk { header, .. } = parse_record(opcode, body).map_err(|e| e.to_string())?
        {
            let (packed, plain) = (header.compressed_size, header.uncompressed_size);
            if plain > CHUNK_LIMIT.max(packed.min(body.len() as u64).saturating_mul(RATIO_LIMIT)) {
                return Err(format!("a chunk of {packed} bytes claims {plain}"));
            }
        }
        Ok(false)
    });
    ended(read, path)
}

fn ended(read: Result<bool, Stop>, path: &Path) -> Result<(), StorageError> {
    match read {
        Ok(_) => Ok(()),
        Err(Stop::Short) => Err(damaged(path, "cut short: copy it again".to_owned())),
        Err(Stop::Error(error)) => Err(error),
    }
}
