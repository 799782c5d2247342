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
    let Some((header, body)) = bytes.split_first_chunk::<4>() else {
        return Err(CdrError::NoHeader(bytes.len()));
    };
    let read = match u16::from_be_bytes([header[0], header[1]]) {
        0 => cdr_encoding::from_bytes::<T, BigEndian>(body),
        1 => cdr_encoding::from_bytes::<T, LittleEndian>(body),
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
