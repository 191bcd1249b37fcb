//! Whether a diagnostic message answers a request.

use crate::diagnostics::repeats_its_request;

/// The first byte of a negative response.
pub(super) const NEGATIVE: u8 = 0x7F;

/// Whether a message answers this request rather than an earlier one.
pub(super) fn is_answer(request: &[u8], data: &[u8]) -> bool {
    let (Some(&sid), Some(&first)) = (request.first(), data.first()) else { return false };
    if first == NEGATIVE {
        return data.get(1) == Some(&sid) && data.len() >= 3;
    }
    first == sid | 0x40 && repeats_its_request(false, request, data) == Some(true)
}
