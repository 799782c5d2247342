//! Messages as bytes: CDR with its encapsulation header, as on the wire and in bags.

use byteorder::{BigEndian, LittleEndian};
use serde::{Serialize, de::DeserializeOwned};

/// Bytes that are not a message of the type expected, or a message that cannot be written.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum CdrError {
    /// Shorter than the header.
    #[error("{0} bytes, expected at least the 4 of the CDR header")]
    NoHeader(usize),
    /// Not plain CDR.
    #[error("representation {0:#06x}, expected CDR_BE (0x0000) or CDR_LE (0x0001)")]
    Representation(u16),
    /// The bytes end early or hold impossible values.
    #[error("{0}")]
    Invalid(String),
    /// More bytes than the type has.
    #[error("{left_over} bytes left over after a message of {used}")]
    LeftOver { left_over: usize, used: usize },
}

const HEADER_LITTLE_ENDIAN: [u8; 4] = [0, 1, 0, 0];
/// Some writers round the length up to a multiple of four, XCDR ones up to eight.
const MAX_PADDING: usize = 7;

/// A message as little-endian CDR, with header.
pub fn to_cdr<T: Serialize>(message: &T) -> Result<Vec<u8>, CdrError> {
    let mut bytes = Vec::with_capacity(256);
    to_cdr_in(message, &mut bytes)?;
    Ok(bytes)
}

/// The same into a buffer that the caller keeps; what it held is dropped.
pub fn to_cdr_in<T: Serialize>(message: &T, bytes: &mut Vec<u8>) -> Result<(), CdrError> {
    bytes.clear();
    bytes.extend(HEADER_LITTLE_ENDIAN);
    cdr_encoding::to_writer::<T, LittleEndian, _>(bytes, message)
        .map_err(|error| CdrError::Invalid(error.to_string()))
}

/// A message from CDR of either byte order, with header.
pub fn from_cdr<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, CdrError> {
    read::<T>(
        bytes,
        |body| cdr_encoding::from_bytes::<T, BigEndian>(body),
        |body| cdr_encoding::from_bytes::<T, LittleEndian>(body),
    )
}

/// A recorded message, which may be from before fields were added at the end of its type: these get their default values.
/// Only whole fields may be missing, and only those that the type's file marks.
pub fn from_recorded_cdr<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, CdrError> {
    read::<T>(
        bytes,
        recorded::from_bytes::<T, BigEndian>,
        recorded::from_bytes::<T, LittleEndian>,
    )
}

type Read<T> = cdr_encoding::Result<(T, usize)>;

fn read<T>(
    bytes: &[u8],
    big_endian: impl FnOnce(&[u8]) -> Read<T>,
    little_endian: impl FnOnce(&[u8]) -> Read<T>,
) -> Result<T, CdrError> {
    let Some((header, body)) = bytes.split_first_chunk::<4>() else {
        return Err(CdrError::NoHeader(bytes.len()));
    };
    let read = match u16::from_be_bytes([header[0], header[1]]) {
        0 => big_endian(body),
        1 => little_endian(body),
        other => return Err(CdrError::Representation(other)),
    };
    let (message, used) = read.map_err(|error| CdrError::Invalid(error.to_string()))?;
    let left_over = body.len() - used;
    if left_over > MAX_PADDING {
        return Err(CdrError::LeftOver {
            left_over,
            used: used + 4,
        });
    }
    Ok(message)
}

/// Reads structures that may end before their last fields.
mod recorded {
    use super::{MAX_PADDING, Read};
    use byteorder::ByteOrder;
    use cdr_encoding::{CdrDeserializer, Error, Result};
    use serde::de::Error as _;
    use serde::de::{DeserializeOwned, DeserializeSeed, Deserializer, SeqAccess, Visitor};

    pub(super) fn from_bytes<T: DeserializeOwned, BO: ByteOrder>(bytes: &[u8]) -> Read<T> {
        let mut fields = Fields {
            inner: CdrDeserializer::<BO>::new(bytes),
            bytes,
        };
        let message = T::deserialize(&mut fields)?;
        Ok((message, fields.inner.bytes_consumed()))
    }

    struct Fields<'de, BO> {
        inner: CdrDeserializer<'de, BO>,
        bytes: &'de [u8],
    }

    impl<'de, BO: ByteOrder> Deserializer<'de> for &mut Fields<'de, BO> {
        type Error = Error;

        fn deserialize_struct<V: Visitor<'de>>(
            self,
            _: &'static str,
            _: &'static [&'static str],
            visitor: V,
        ) -> Result<V::Value> {
            visitor.visit_seq(self)
        }

        fn deserialize_any<V: Visitor<'de>>(self, _: V) -> Result<V::Value> {
            Err(Error::custom("expected a structure"))
        }

        serde::forward_to_deserialize_any! {
            bool i8 i16 i32 i64 u8 u16 u32 u64 f32 f64 char str string bytes byte_buf option unit
            unit_struct newtype_struct seq tuple tuple_struct map enum identifier ignored_any
        }
    }

    impl<'de, BO: ByteOrder> SeqAccess<'de> for Fields<'de, BO> {
        type Error = Error;

        /// None where the bytes end before the field: the structure takes a default, or says what is missing.
        fn next_element_seed<S: DeserializeSeed<'de>>(
            &mut self,
            seed: S,
        ) -> Result<Option<S::Value>> {
            let left = &self.bytes[self.inner.bytes_consumed().min(self.bytes.len())..];
            if left.is_empty() {
                return Ok(None);
            }
            let is_padding = left.len() <= MAX_PADDING && left.iter().all(|byte| *byte == 0);
            match seed.deserialize(&mut self.inner) {
                Err(_) if is_padding => Ok(None),
                read => read.map(Some),
            }
        }
    }
}
