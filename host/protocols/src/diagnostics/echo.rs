//! Whether a response is to a certain request: what it has to repeat of it.

use super::names;

/// Whether a positive response repeats the parts of the request that it must: sub-function, identifiers, block number. Both have the
/// same service. A part that one of them does not have does not count.
pub fn is_answer(is_kwp: bool, request: &[u8], response: &[u8]) -> bool {
    let (Some((&sid, asked)), Some((_, answer))) = (request.split_first(), response.split_first()) else {
        return true;
    };
    let same = |count: usize| match (asked.get(..count), answer.get(..count)) {
        (Some(asked), Some(answer)) => asked == answer,
        _ => true,
    };
    let is_same_sub = || match (asked, answer) {
        // The bit that suppresses the response is not repeated; in KWP2000's sessions it is part of the number.
        ([asked, ..], [answer, ..]) => asked & 0x7F == answer & 0x7F,
        _ => true,
    };
    // One of several that were asked for; a server answers with those that it has.
    let is_one_of = |width: usize, step: usize| match answer.get(..width) {
        Some(first) => asked.len() < width || asked.chunks(step).any(|one| one.get(..width) == Some(first)),
        None => true,
    };
    match sid {
        // OBD-II.
        0x01 | 0x06 | 0x09 => is_one_of(1, 1),
        0x02 => is_one_of(1, 2),
        0x05 | 0x08 => same(1),
        _ if is_kwp => match sid {
            0x10 => is_same_sub(),
            0x1A | 0x21 | 0x27 | 0x30..=0x33 | 0x3B => same(1),
            0x22 | 0x2E => same(2),
            _ => true,
        },
        0x22 => is_one_of(2, 2),
        0x24 | 0x2E | 0x2F => same(2),
        0x2C | 0x31 => is_same_sub() && (asked.len() < 3 || answer.len() < 3 || asked[1..3] == answer[1..3]),
        0x36 | 0x38 => same(1),
        _ if names::has_sub_function(sid) => is_same_sub(),
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_response_repeats_what_was_asked() {
        for (request, response, expected) in [
            (&[0x22, 0xF1, 0x90][..], &[0x62, 0xF1, 0x90, 1][..], true),
            (&[0x22, 0xF1, 0x90], &[0x62, 0xF1, 0x91, 1], false),
            (&[0x22, 0xF1, 0x90, 0xF1, 0x91], &[0x62, 0xF1, 0x91, 1], true),
            (&[0x22, 0xF1, 0x90], &[0x62], true),
            (&[0x10, 0x83], &[0x50, 0x03, 0, 50, 1, 0xF4], true),
            (&[0x10, 0x03], &[0x50, 0x01, 0, 50, 1, 0xF4], false),
            (&[0x31, 1, 2, 3], &[0x71, 1, 2, 4], false),
            (&[0x31, 1, 2, 3], &[0x71, 3, 2, 3], false),
            (&[0x31, 1, 2, 3], &[0x71, 1], true),
            (&[0x36, 7, 1, 2], &[0x76, 6], false),
            (&[0x01, 0x0C, 0x0D], &[0x41, 0x0D, 1], true),
            (&[0x01, 0x0C], &[0x41, 0x0D, 1], false),
            (&[0x02, 0x0C, 0], &[0x42, 0x0C, 0, 1, 2], true),
            (&[0x02, 0x0C, 0x0D], &[0x42, 0x0D, 0, 1, 2], false),
            (&[0x03], &[0x43, 0], true),
            (&[0x3E, 0], &[0x7E], true),
            (&[0x34, 0, 0x11, 1, 2], &[0x74, 0x20, 1, 2], true),
        ] {
            assert_eq!(is_answer(false, request, response), expected, "{request:02X?} {response:02X?}");
        }
        for (request, response, expected) in [
            (&[0x10, 0x89][..], &[0x50, 0x89][..], true),
            (&[0x21, 1], &[0x61, 2, 3], false),
            (&[0x31, 0x10, 1, 2], &[0x71, 0x10, 3, 4], true),
            (&[0x3E], &[0x7E], true),
        ] {
            assert_eq!(is_answer(true, request, response), expected, "{request:02X?} {response:02X?}");
        }
    }
}
