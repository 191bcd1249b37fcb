//! UDS and KWP2000: what requests and responses carry.

use std::fmt::Write as _;

use super::{dtc, names, obd};
use crate::Field;

/// The bit of a sub-function that suppresses the positive response.
const SUPPRESS: u8 = 0x80;

/// Whether the request asks for no positive response.
pub fn is_response_suppressed(request: &[u8]) -> bool {
    matches!(request, [sid, sub, ..] if names::has_sub_function(*sid) && sub & SUPPRESS != 0)
}

fn did(bytes: &[u8]) -> Field {
    let did = u16::from_be_bytes([bytes[0], bytes[1]]);
    Field::hex("did", did, 4).meaning(names::data_identifier(did))
}

fn sub_function(sid: u8, sub: u8) -> Field {
    Field::hex("sub_function", sub & !SUPPRESS, 2).meaning(names::sub_function(sid, sub & !SUPPRESS))
}

fn rest(name: &'static str, bytes: &[u8], fields: &mut Vec<Field>) {
    if !bytes.is_empty() {
        fields.push(Field::bytes(name, bytes));
    }
}

fn value(bytes: &[u8], fields: &mut Vec<Field>) {
    if !bytes.is_empty() {
        fields.push(Field {
            name: "value".into(),
            value: obd::text_or_bytes(bytes),
            unit: "".into(),
            text: None,
        });
    }
}

/// What a UDS request says.
pub fn request(bytes: &[u8], fields: &mut Vec<Field>) {
    let Some((&sid, after)) = bytes.split_first() else { return };
    match (sid, after) {
        (0x22, [_, _, ..]) => {
            for pair in after.chunks_exact(2) {
                fields.push(did(pair));
            }
            rest("rest", after.chunks_exact(2).remainder(), fields);
        }
        (0x24, [_, _]) => fields.push(did(after)),
        (0x2E, [_, _, data @ ..]) => {
            fields.push(did(after));
            value(data, fields);
        }
        (0x2F, [_, _, control, data @ ..]) => {
            fields.push(did(after));
            let what = [
                "return control to ECU",
                "reset to default",
                "freeze current state",
                "short term adjustment",
            ];
            fields.push(Field::hex("control", *control, 2).meaning(what.get(usize::from(*control)).copied()));
            rest("parameters", data, fields);
        }
        (0x31, [sub, high, low, data @ ..]) => {
            fields.push(sub_function(sid, *sub));
            fields.push(Field::hex("routine", u16::from_be_bytes([*high, *low]), 4));
            rest("parameters", data, fields);
        }
        (0x14, [a, b, c, data @ ..]) => {
            let group = u32::from_be_bytes([0, *a, *b, *c]);
            fields.push(Field::hex("group", group, 6).meaning((group == 0xFF_FFFF).then_some("all")));
            rest("parameters", data, fields);
        }
        (0x34 | 0x35, [format, lengths, data @ ..]) => {
            fields.push(Field::hex("data_format", *format, 2));
            memory(*lengths, data, fields);
        }
        (0x23 | 0x3D, [lengths, data @ ..]) => memory(*lengths, data, fields),
        (0x36, [block, data @ ..]) => {
            fields.push(Field::number("block", *block));
            fields.push(Field::number("length", data.len() as i64).unit("bytes"));
        }
        (0x38, [operation, ..]) => {
            fields.push(sub_function(sid, *operation));
            rest("parameters", &after[1..], fields);
        }
        (0x19, [sub, data @ ..]) => {
            fields.push(sub_function(sid, *sub));
            match (sub & !SUPPRESS, data) {
                (0x01 | 0x02 | 0x0F | 0x11 | 0x12 | 0x13, [mask, ..]) => {
                    fields.push(Field::hex("status_mask", *mask, 2));
                }
                (0x03 | 0x04 | 0x06 | 0x09 | 0x10, [a, b, c, data @ ..]) => {
                    let name = format!("{}-{c:02X}", dtc::Dtc(u16::from_be_bytes([*a, *b])));
                    fields.push(Field::text("code", name));
                    rest("record", data, fields);
                }
                _ => rest("parameters", data, fields),
            }
        }
        (_, [sub, data @ ..]) if names::has_sub_function(sid) => {
            fields.push(sub_function(sid, *sub));
            rest("parameters", data, fields);
        }
        _ => rest("parameters", after, fields),
    }
}

/// Address and size behind a byte with their lengths (ISO 14229-1:2020, H.1).
fn memory(lengths: u8, data: &[u8], fields: &mut Vec<Field>) {
    let (address, size) = (usize::from(lengths & 15), usize::from(lengths >> 4));
    let number = |bytes: &[u8]| bytes.iter().fold(0_u64, |number, byte| number << 8 | u64::from(*byte));
    if address == 0 || address > 8 || size > 8 || data.len() < address + size {
        rest("parameters", data, fields);
        return;
    }
    fields.push(Field::hex("address", number(&data[..address]), (2 * lengths) & 15));
    fields.push(Field::number("size", number(&data[address..address + size]) as i64).unit("bytes"));
    rest("parameters", &data[address + size..], fields);
}

/// What a positive UDS response says. `request` is what it answers, where that was heard; its fields stand in front already.
pub fn response(request: Option<&[u8]>, bytes: &[u8], fields: &mut Vec<Field>) {
    let Some((&first, after)) = bytes.split_first() else { return };
    let sid = first & !0x40;
    let heard = request.is_some();
    match (sid, after) {
        (0x22, [_, _, data @ ..]) => {
            let asked = request.map_or(&after[..2], |request| &request[1..]);
            if asked.len() == 2 {
                if !heard {
                    fields.push(did(after));
                }
                value(data, fields);
            } else {
                several(asked, after, fields);
            }
        }
        (0x10, [sub, data @ ..]) => {
            if !heard {
                fields.push(sub_function(sid, *sub));
            }
            if let [a, b, c, d] = data {
                fields.push(Field::number("p2_ms", u16::from_be_bytes([*a, *b])));
                fields.push(Field::number("p2_star_ms", i64::from(u16::from_be_bytes([*c, *d])) * 10));
            } else {
                rest("parameters", data, fields);
            }
        }
        (0x19, [sub, data @ ..]) => {
            if !heard {
                fields.push(sub_function(sid, *sub));
            }
            match (sub, data) {
                (0x01 | 0x07 | 0x11 | 0x12, [mask, format, high, low]) => {
                    fields.push(Field::hex("available_mask", *mask, 2));
                    fields.push(Field::hex("format", *format, 2));
                    fields.push(Field::number("trouble_codes", u16::from_be_bytes([*high, *low])));
                }
                (0x02 | 0x0A..=0x0F | 0x13 | 0x15, [mask, codes @ ..]) if codes.len() % 4 == 0 => {
                    fields.push(Field::hex("available_mask", *mask, 2));
                    fields.push(Field::number("trouble_codes", (codes.len() / 4) as i64));
                    fields.push(Field::text("codes", dtc::list_with_status(codes)));
                }
                (0x04 | 0x06 | 0x10, [a, b, c, status, data @ ..]) => {
                    fields.push(Field::text("codes", dtc::list_with_status(&[*a, *b, *c, *status])));
                    rest("record", data, fields);
                }
                _ => rest("value", data, fields),
            }
        }
        (0x27, [sub, data @ ..]) => {
            if !heard {
                fields.push(sub_function(sid, *sub));
            }
            rest("seed", data, fields);
        }
        (0x2E, [_, _]) if !heard => fields.push(did(after)),
        (0x2F, [_, _, _, data @ ..]) => rest("status", data, fields),
        (0x31, [sub, high, low, data @ ..]) => {
            if !heard {
                fields.push(sub_function(sid, *sub));
                fields.push(Field::hex("routine", u16::from_be_bytes([*high, *low]), 4));
            }
            rest("status", data, fields);
        }
        (0x34 | 0x35, [format, data @ ..]) if data.len() >= usize::from(format >> 4) => {
            let most = data[..usize::from(format >> 4)]
                .iter()
                .fold(0_i64, |number, byte| number << 8 | i64::from(*byte));
            fields.push(Field::number("block_length", most).unit("bytes"));
        }
        (0x36, [block, data @ ..]) => {
            if !heard {
                fields.push(Field::number("block", *block));
            }
            rest("parameters", data, fields);
        }
        (_, [sub, data @ ..]) if names::has_sub_function(sid) => {
            if !heard {
                fields.push(sub_function(sid, *sub));
            }
            rest("value", data, fields);
        }
        (0x2E | 0x14, _) if heard => {}
        _ => rest("value", after, fields),
    }
}

/// Values of several identifiers, whose lengths nobody says: each ends where the next identifier that was asked for stands, if that
/// is at one place only.
fn several(asked: &[u8], answer: &[u8], fields: &mut Vec<Field>) {
    let dids: Vec<&[u8]> = asked.chunks_exact(2).collect();
    let mut at = 2;
    let mut parts = Vec::new();
    for next in dids.iter().skip(1) {
        let mut places =
            answer.windows(2).enumerate().skip(at).filter(|(_, two)| two == next).map(|(at, _)| at);
        let (Some(place), None) = (places.next(), places.next()) else {
            rest("value", answer, fields);
            return;
        };
        parts.push(&answer[at..place]);
        at = place + 2;
    }
    parts.push(answer.get(at..).unwrap_or_default());
    for (did, part) in dids.iter().zip(parts) {
        let mut name = String::from("value_");
        // Writing to a String cannot fail.
        let _ = write!(name, "{:02X}{:02X}", did[0], did[1]);
        fields.push(Field {
            name: name.into(),
            value: obd::text_or_bytes(part),
            unit: "".into(),
            text: None,
        });
    }
}

/// What a KWP2000 request says.
pub fn kwp_request(bytes: &[u8], fields: &mut Vec<Field>) {
    match bytes {
        [0x1A | 0x21 | 0x30 | 0x31 | 0x32 | 0x33 | 0x3B, local, data @ ..] => {
            fields.push(Field::hex("local_identifier", *local, 2));
            rest("parameters", data, fields);
        }
        [0x10, mode, data @ ..] => {
            fields.push(Field::hex("mode", *mode, 2));
            rest("parameters", data, fields);
        }
        [0x22 | 0x2E, ..] => request(bytes, fields),
        [_, data @ ..] => rest("parameters", data, fields),
        [] => {}
    }
}

/// What a positive KWP2000 response says.
pub fn kwp_response(heard: bool, bytes: &[u8], fields: &mut Vec<Field>) {
    match bytes {
        [0x5A | 0x61, local, data @ ..] => {
            if !heard {
                fields.push(Field::hex("local_identifier", *local, 2));
            }
            value(data, fields);
        }
        [0x57 | 0x58, count, codes @ ..] if codes.len() % 3 == 0 => {
            fields.push(Field::number("trouble_codes", *count));
            let codes = codes.chunks_exact(3).map(|code| {
                format!("{} ({:02X})", dtc::Dtc(u16::from_be_bytes([code[0], code[1]])), code[2])
            });
            fields.push(Field::text("codes", codes.collect::<Vec<_>>().join(", ")));
        }
        [_, data @ ..] => rest("value", data, fields),
        [] => {}
    }
}
