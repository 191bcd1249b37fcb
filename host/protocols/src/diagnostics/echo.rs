//! Whether a response is to a certain request: what it has to repeat of it.

use super::names;

/// Whether a positive response repeats the parts of the request that it must: sub-function, identifiers, block number. Both have the
/// same service. `None` if the response ends before them.
pub fn repeats_its_request(is_kwp: bool, request: &[u8], response: &[u8]) -> Option<bool> {
    let (&sid, asked) = request.split_first()?;
    let (_, answer) = response.split_first()?;
    // A request without such a part is invalid, and its answer need not have it.
    let same = |from: usize, to: usize| {
        asked.get(from..to).map_or(Some(true), |asked| Some(answer.get(from..to)? == asked))
    };
    // The bit that suppresses the response is not repeated; in KWP2000's sessions it is part of the number.
    let same_sub =
        || asked.first().map_or(Some(true), |asked| answer.first().map(|answer| (asked ^ answer) << 1 == 0));
    // One of several that were asked for; a server answers with those that it has.
    let one_of = |width: usize, step: usize| {
        if asked.len() < width {
            return Some(true);
        }
        let first = answer.get(..width)?;
        Some(asked.chunks(step).any(|one| one.get(..width) == Some(first)))
    };
    match sid {
        0x01 | 0x06 | 0x09 => one_of(1, 1),
        0x02 => one_of(1, 2),
        // OBD-II, and what KWP2000 alone has.
        0x05 | 0x08 | 0x1A | 0x21 | 0x30 | 0x32 | 0x33 | 0x3B => same(0, 1),
        // Its other services repeat less than those of UDS.
        _ if is_kwp => match sid {
            0x10 => same_sub(),
            0x27 | 0x31 => same(0, 1),
            0x22 | 0x2E => same(0, 2),
            _ => Some(true),
        },
        0x22 => one_of(2, 2),
        0x24 | 0x2E | 0x2F => same(0, 2),
        0x2C | 0x31 => match same_sub() {
            Some(true) => same(1, 3),
            other => other,
        },
        0x36 | 0x38 => same(0, 1),
        _ if names::has_sub_function(sid) => same_sub(),
        _ => Some(true),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_response_repeats_what_was_asked() {
        for (request, response, expected) in [
            (&[0x22, 0xF1, 0x90][..], &[0x62, 0xF1, 0x90, 1][..], Some(true)),
            (&[0x22, 0xF1, 0x90], &[0x62, 0xF1, 0x91, 1], Some(false)),
            (&[0x22, 0xF1, 0x90, 0xF1, 0x91], &[0x62, 0xF1, 0x91, 1], Some(true)),
            (&[0x22, 0xF1, 0x90], &[0x62], None),
            (&[0x10, 0x83], &[0x50, 0x03, 0, 50, 1, 0xF4], Some(true)),
            (&[0x10, 0x03], &[0x50, 0x01, 0, 50, 1, 0xF4], Some(false)),
            (&[0x31, 1, 2, 3], &[0x71, 1, 2, 4], Some(false)),
            (&[0x31, 1, 2, 3], &[0x71, 3, 2, 3], Some(false)),
            (&[0x31, 1, 2, 3], &[0x71, 1], None),
            (&[0x36, 7, 1, 2], &[0x76, 6], Some(false)),
            (&[0x01, 0x0C, 0x0D], &[0x41, 0x0D, 1], Some(true)),
            (&[0x01, 0x0C], &[0x41, 0x0D, 1], Some(false)),
            (&[0x02, 0x0C, 0], &[0x42, 0x0C, 0, 1, 2], Some(true)),
            (&[0x02, 0x0C, 0x0D], &[0x42, 0x0D, 0, 1, 2], Some(false)),
            (&[0x03], &[0x43, 0], Some(true)),
            (&[0x3E, 0], &[0x7E], None),
            (&[0x34, 0, 0x11, 1, 2], &[0x74, 0x20, 1, 2], Some(true)),
        ] {
            assert_eq!(
                repeats_its_request(false, request, response),
                expected,
                "{request:02X?} {response:02X?}"
            );
        }
        for (request, response, expected) in [
            (&[0x10, 0x89][..], &[0x50, 0x89][..], Some(true)),
            (&[0x21, 1], &[0x61, 2, 3], Some(false)),
            (&[0x31, 0x10, 1, 2], &[0x71, 0x10, 3, 4], Some(true)),
            (&[0x3E], &[0x7E], Some(true)),
        ] {
            assert_eq!(
                repeats_its_request(true, request, response),
                expected,
                "{request:02X?} {response:02X?}"
            );
        }
    }
}
