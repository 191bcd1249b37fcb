//! How a request and its answer cross between the page's worker and the engine.
//!
//! Both are one run of bytes:
//!
//! | Part | Content |
//! |---|---|
//! | 4 bytes | the length of the head in bytes, little-endian |
//! | head | JSON in UTF-8: `{"request": NAME, "parameters": {…}}` one way, `{"ok": ANSWER}` or `{"error": TEXT}` the other |
//! | 0 to 7 zeros | so that the sections begin at a multiple of 8 from the message's start |
//! | sections | the content of typed arrays, each beginning at a multiple of 8, little-endian |
//!
//! In the head, a typed array stands as an object with one member, whose name is the type and whose value is `[OFFSET, LENGTH]`: `$u8`
//! (`Uint8Array`), `$u32` (`Uint32Array`) or `$f64` (`Float64Array`). The offset is in bytes from the first section, the length in elements.
//! JSON has neither infinities nor not-a-number: they are `null` in a head. `web/page/src/engine.ts` is the other side.

use serde::{Deserialize, Serialize};

use crate::error::EngineError;

/// Sections begin at multiples of this.
const ALIGNMENT: usize = 8;

/// A `Uint8Array` in a head.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Bytes {
    #[serde(rename = "$u8")]
    place: [usize; 2],
}

/// A `Uint32Array` in a head.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Integers {
    #[serde(rename = "$u32")]
    place: [usize; 2],
}

/// A `Float64Array` in a head.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Floats {
    #[serde(rename = "$f64")]
    place: [usize; 2],
}

/// The sections of a request.
#[derive(Clone, Copy)]
pub struct Received<'a>(&'a [u8]);

impl<'a> Received<'a> {
    /// The content of an array.
    pub fn bytes(self, bytes: Bytes) -> Result<&'a [u8], EngineError> {
        let [offset, length] = bytes.place;
        let end = offset.checked_add(length).ok_or(EngineError::BadMessage)?;
        self.0.get(offset..end).ok_or(EngineError::BadMessage)
    }
}

/// Splits a request into its head and its sections.
pub fn split(message: &[u8]) -> Result<(&[u8], Received<'_>), EngineError> {
    let (length, rest) = message.split_first_chunk::<4>().ok_or(EngineError::BadMessage)?;
    let length = u32::from_le_bytes(*length) as usize;
    let head = rest.get(..length).ok_or(EngineError::BadMessage)?;
    // Without sections, nothing needs to follow the head.
    let sections = message.get((4 + length).next_multiple_of(ALIGNMENT)..).unwrap_or_default();
    Ok((head, Received(sections)))
}

/// Collects the sections of an answer.
#[derive(Default)]
pub struct Sections(Vec<u8>);

impl Sections {
    fn add(&mut self, length: usize, content: impl Iterator<Item = u8>) -> [usize; 2] {
        let offset = self.0.len().next_multiple_of(ALIGNMENT);
        self.0.resize(offset, 0);
        self.0.extend(content);
        [offset, length]
    }

    /// Adds a `Float64Array`.
    pub fn floats(&mut self, values: &[f64]) -> Floats {
        Floats { place: self.add(values.len(), values.iter().flat_map(|value| value.to_le_bytes())) }
    }

    /// Adds a `Uint32Array`.
    pub fn integers(&mut self, values: &[u32]) -> Integers {
        Integers { place: self.add(values.len(), values.iter().flat_map(|value| value.to_le_bytes())) }
    }

    /// Adds a `Uint8Array`.
    pub fn bytes(&mut self, bytes: &[u8]) -> Bytes {
        let offset = self.0.len().next_multiple_of(ALIGNMENT);
        self.0.resize(offset, 0);
        self.0.extend_from_slice(bytes);
        Bytes { place: [offset, bytes.len()] }
    }
}

/// The head of a message.
#[derive(Serialize)]
#[serde(rename_all = "lowercase")]
enum Head<'a> {
    Ok(&'a serde_json::Value),
    Error(&'a str),
}

/// Puts an answer together.
pub fn answer(result: Result<serde_json::Value, EngineError>, sections: &Sections) -> Vec<u8> {
    match result {
        Ok(value) => join(&Head::Ok(&value), &sections.0),
        Err(error) => join(&Head::Error(&error.to_string()), &[]),
    }
}

/// Puts a request together, for programs in Rust.
pub fn request(name: &str, mut parameters: serde_json::Value, bytes: Option<&[u8]>) -> Vec<u8> {
    let mut sections = Sections::default();
    if let Some(bytes) = bytes {
        parameters["bytes"] = serde_json::json!({ "$u8": sections.bytes(bytes).place });
    }
    join(&serde_json::json!({ "request": name, "parameters": parameters }), &sections.0)
}

fn join(head: &impl Serialize, sections: &[u8]) -> Vec<u8> {
    let mut message = vec![0; 4];
    // Keys are texts and numbers are finite or null, so this cannot fail.
    if serde_json::to_writer(&mut message, head).is_err() {
        message.truncate(4);
    }
    let length = (message.len() - 4) as u32;
    message[..4].copy_from_slice(&length.to_le_bytes());
    if !sections.is_empty() {
        message.resize(message.len().next_multiple_of(ALIGNMENT), 0);
        message.extend_from_slice(sections);
    }
    message
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_is_split_as_it_was_joined() {
        let message = request("open", serde_json::json!({ "name": "a.log" }), Some(b"123"));
        let (head, received) = split(&message).unwrap();
        let head: serde_json::Value = serde_json::from_slice(head).unwrap();
        assert_eq!(head["parameters"]["name"], "a.log");
        let bytes: Bytes = serde_json::from_value(head["parameters"]["bytes"].clone()).unwrap();
        assert_eq!(received.bytes(bytes).unwrap(), b"123");
    }

    #[test]
    fn places_outside_the_message_are_refused() {
        let message = request("append", serde_json::json!({}), Some(b"123"));
        let (_, received) = split(&message).unwrap();
        for place in [[0, 4], [4, 1], [usize::MAX, 2]] {
            assert!(received.bytes(Bytes { place }).is_err(), "{place:?}");
        }
        for message in [&[][..], &[1, 0], &[9, 0, 0, 0, b'{']] {
            assert!(split(message).is_err());
        }
    }

    #[test]
    fn sections_are_aligned() {
        let mut sections = Sections::default();
        assert_eq!(sections.bytes(b"abc").place, [0, 3]);
        assert_eq!(sections.floats(&[1.5]).place, [8, 1]);
        assert_eq!(sections.integers(&[7, 8, 9]).place, [16, 3]);
    }
}
