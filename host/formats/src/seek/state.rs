//! What a decoder knows at a place, as bytes.

use serde::Serialize;
use serde::de::DeserializeOwned;

/// Appends it.
pub(crate) fn save(state: &impl Serialize, bytes: &mut Vec<u8>) -> bool {
    match postcard::to_extend(state, std::mem::take(bytes)) {
        Ok(all) => {
            *bytes = all;
            true
        }
        Err(_) => false,
    }
}

/// What these bytes say; `None` unless they are exactly that.
pub(crate) fn load<T: DeserializeOwned>(bytes: &[u8]) -> Option<T> {
    postcard::take_from_bytes(bytes).ok().filter(|(_, rest)| rest.is_empty()).map(|(state, _)| state)
}
