//! Strings and sequences with an upper bound: longer ones are refused in both directions.

use serde::{Deserialize, Deserializer, Serialize, Serializer, de, ser};

/// Something that has a length.
pub trait Length {
    /// Number of elements, or bytes of a string.
    fn length(&self) -> usize;
}

impl Length for String {
    fn length(&self) -> usize {
        self.len()
    }
}

impl<T> Length for Vec<T> {
    fn length(&self) -> usize {
        self.len()
    }
}

impl Length for serde_bytes::ByteBuf {
    fn length(&self) -> usize {
        self.len()
    }
}

/// Writes a value that is not too long.
pub fn serialize<T: Length + Serialize, S: Serializer, const BOUND: usize>(
    value: &T,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    match value.length() {
        length if length > BOUND => Err(ser::Error::custom(format!(
            "{length} elements, expected at most {BOUND}"
        ))),
        _ => value.serialize(serializer),
    }
}

/// Reads a value that is not too long.
pub fn deserialize<'de, T: Length + Deserialize<'de>, D: Deserializer<'de>, const BOUND: usize>(
    deserializer: D,
) -> Result<T, D::Error> {
    let value = T::deserialize(deserializer)?;
    match value.length() {
        length if length > BOUND => Err(de::Error::custom(format!(
            "{length} elements, expected at most {BOUND}"
        ))),
        _ => Ok(value),
    }
}
