//! `TensorBoard` event files: scalar summaries as length-delimited protobuf with masked CRC-32C.

use prost::Message as _;

#[derive(Clone, PartialEq, prost::Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
}

#[derive(Clone, PartialEq, prost::Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Scalar>,
}

#[derive(Clone, PartialEq, prost::Message)]
struct Scalar {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, tag = "2")]
    simple_value: f32,
}

/// `TFRecord`'s checksum: CRC-32C, rotated and offset.
fn masked_crc(bytes: &[u8]) -> [u8; 4] {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

fn record(event: &Event, out: &mut Vec<u8>) {
    let payload = event.encode_to_vec();
    let length = (payload.len() as u64).to_le_bytes();
    out.extend_from_slice(&length);
    out.extend_from_slice(&masked_crc(&length));
    out.extend_from_slice(&payload);
    out.extend_from_slice(&masked_crc(&payload));
}

/// A whole event file: the version record, then per row `(step, [(tag, value)])` one event.
///
/// The wall time is the step, so that equal runs write equal bytes.
pub(super) fn event_file(rows: &[(i64, Vec<(&str, f64)>)]) -> Vec<u8> {
    let mut out = Vec::new();
    let version = Event { file_version: Some("brain.Event:2".to_owned()), ..Event::default() };
    record(&version, &mut out);
    for (step, values) in rows {
        let value = values.iter().map(|&(tag, v)| Scalar { tag: tag.to_owned(), simple_value: v as f32 }).collect();
        let event =
            Event { wall_time: *step as f64, step: *step, file_version: None, summary: Some(Summary { value }) };
        record(&event, &mut out);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_version_record_has_the_bytes_that_tensorboard_writes() {
        // length 15, its masked CRC-32C, then 1a 0d "brain.Event:2": as every event file with a zero wall time begins
        let file = event_file(&[]);
        assert_eq!(file[..8], 15u64.to_le_bytes());
        assert_eq!(&file[12..14], &[0x1a, 0x0d]);
        assert_eq!(&file[14..27], b"brain.Event:2");
        // CRC-32C's check value, masked by hand
        assert_eq!(crc32c::crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(masked_crc(b"123456789"), 0xe306_9283u32.rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes());
    }
}
