//! A file of named arrays: safetensors, one axis each, with a digest over all of them and one line of JSON.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, View};
use sha2::{Digest as _, Sha256};

use crate::schema::hex;

/// Metadata key of the JSON line, whose first 64 characters are the digest of arrays and JSON. One key only: the crate
/// keeps metadata in a hash map, whose order would change the bytes.
const KEY: &str = "ccmarl.state";

/// An array's elements as bytes, little-endian.
#[derive(Debug, PartialEq)]
struct Array {
    dtype: Dtype,
    shape: [usize; 1],
    bytes: Vec<u8>,
}

impl View for &Array {
    fn dtype(&self) -> Dtype {
        self.dtype
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&self.bytes)
    }

    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}

/// Named arrays, to be written or just read.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Arrays(BTreeMap<String, Array>);

/// Elements that arrays hold.
pub(super) trait Element: Copy {
    const DTYPE: Dtype;
    const BYTES: usize;
    fn put(self, bytes: &mut [u8]);
    fn get(bytes: &[u8]) -> Self;
}

macro_rules! number {
    ($type:ty, $dtype:expr, $bytes:literal) => {
        impl Element for $type {
            const DTYPE: Dtype = $dtype;
            const BYTES: usize = $bytes;

            fn put(self, bytes: &mut [u8]) {
                bytes.copy_from_slice(&self.to_le_bytes());
            }

            fn get(bytes: &[u8]) -> Self {
                let mut own = [0; $bytes];
                own.copy_from_slice(bytes);
                Self::from_le_bytes(own)
            }
        }
    };
}

number!(f32, Dtype::F32, 4);
number!(f64, Dtype::F64, 8);
number!(u64, Dtype::U64, 8);

impl Element for bool {
    const DTYPE: Dtype = Dtype::U8;
    const BYTES: usize = 1;

    fn put(self, bytes: &mut [u8]) {
        bytes[0] = u8::from(self);
    }

    fn get(bytes: &[u8]) -> Self {
        bytes[0] != 0
    }
}

impl Arrays {
    /// Adds an array.
    pub(super) fn put<T: Element>(&mut self, name: &str, values: &[T]) {
        let mut bytes = vec![0; values.len() * T::BYTES];
        bytes.chunks_exact_mut(T::BYTES).zip(values).for_each(|(bytes, value)| value.put(bytes));
        self.0.insert(name.to_owned(), Array { dtype: T::DTYPE, shape: [values.len()], bytes });
    }

    /// An array's elements.
    ///
    /// # Errors
    /// What is missing or of another type, as text.
    pub(super) fn get<T: Element>(&self, name: &str) -> Result<Vec<T>, String> {
        let array = self.0.get(name).ok_or_else(|| format!("{name} is missing"))?;
        if array.dtype != T::DTYPE {
            return Err(format!("{name}: expected elements {:?}, found {:?}", T::DTYPE, array.dtype));
        }
        Ok(array.bytes.chunks_exact(T::BYTES).map(T::get).collect())
    }

    fn digest(&self, json: &str) -> String {
        let mut hash = Sha256::new();
        for (name, array) in &self.0 {
            hash.update(format!("{name}\n{:?}\n{}\n", array.dtype, array.bytes.len()));
            hash.update(&array.bytes);
        }
        hash.update(json);
        hex(&hash.finalize())
    }

    /// The file's bytes.
    ///
    /// # Errors
    /// What the format refuses.
    pub(super) fn to_bytes(&self, json: &str) -> Result<Vec<u8>, safetensors::SafeTensorError> {
        let metadata = [(KEY.to_owned(), format!("{}{json}", self.digest(json)))];
        safetensors::serialize(&self.0, Some(metadata.into_iter().collect()))
    }

    /// Reads a file: its arrays and its JSON.
    ///
    /// # Errors
    /// What is wrong with it, as text; any changed bit is.
    pub(super) fn read(path: &Path) -> Result<(Self, String), String> {
        Self::parse(&std::fs::read(path).map_err(|e| e.to_string())?)
    }

    fn parse(bytes: &[u8]) -> Result<(Self, String), String> {
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| e.to_string())?;
        let line = header.metadata().as_ref().and_then(|m| m.get(KEY)).cloned().unwrap_or_default();
        let (digest, json) = line.split_at_checked(64).ok_or_else(|| format!("the metadata key {KEY:?} is missing"))?;
        let file = SafeTensors::deserialize(bytes).map_err(|e| e.to_string())?;
        let array = |(name, view): (String, safetensors::tensor::TensorView<'_>)| {
            let shape = [view.shape().iter().product()];
            (name, Array { dtype: view.dtype(), shape, bytes: view.data().to_vec() })
        };
        let arrays = Self(file.tensors().into_iter().map(array).collect());
        if arrays.digest(json) != digest {
            return Err("its content does not match its digest: the file was changed or damaged".to_owned());
        }
        Ok((arrays, json.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arrays_come_back_and_every_flipped_bit_is_an_error() {
        let mut arrays = Arrays::default();
        arrays.put("f", &[1.5_f32, f32::MIN_POSITIVE, -0.0]);
        arrays.put("d", &[f64::NAN, 1e300]);
        arrays.put("n", &[u64::MAX]);
        arrays.put("b", &[true, false]);
        arrays.put::<f32>("none", &[]);
        let bytes = arrays.to_bytes(r#"{"a":1}"#).unwrap();
        assert_eq!(bytes, arrays.to_bytes(r#"{"a":1}"#).unwrap());
        let (again, json) = Arrays::parse(&bytes).unwrap();
        assert_eq!((&again, json.as_str()), (&arrays, r#"{"a":1}"#));
        assert_eq!(again.get::<bool>("b"), Ok(vec![true, false]));
        assert_eq!(again.get::<f32>("d"), Err("d: expected elements F32, found F64".to_owned()));
        assert_eq!(again.get::<f32>("x"), Err("x is missing".to_owned()));
        for bit in 0..bytes.len() * 8 {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            // padding of the header may be any white space; all else counts
            let read = Arrays::parse(&flipped);
            assert!(read.is_err() || read.is_ok_and(|r| r.0 == arrays), "bit {bit}");
        }
        for cut in 0..bytes.len() {
            assert!(Arrays::parse(&bytes[..cut]).is_err(), "{cut}");
        }
    }
}
