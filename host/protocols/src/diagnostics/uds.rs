//! UDS and KWP2000: the content of requests and responses.

use std::fmt::Write as _;

use super::cursor::Cursor;
use super::values::{number, unsigned};
use super::{authentication, dtc, events, files, names, obd_identifiers, reports, scaling, values};
use crate::Field;

/// The bit of a sub-function that suppresses the positive response.
const SUPPRESS: u8 = 0x80;

/// Whether the request asks for no positive response.
pub fn is_response_suppressed(request: &[u8]) -> bool {
    matches!(request, [sid, sub, ..] if names::has_sub_function(*sid) && sub & SUPPRESS != 0)
}

fn did(bytes: &[u8]) -> Field {
    let did = u16::from_be_bytes([bytes[0], bytes[1]]);
    Field::hex("did", did, 4).meaning(obd_identifiers::data_identifier(did))
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
            value: values::text_or_bytes(bytes),
            unit: "".into(),
            text: None,
        });
    }
}

/// The content of a UDS request.
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
            fields.extend([did(after), io_control(*control)]);
            rest("parameters", data, fields);
        }
        (0x31, [sub, high, low, data @ ..]) => {
            fields.push(sub_function(sid, *sub));
            fields.push(routine(*high, *low));
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
        (0x38, [operation, data @ ..]) => {
            fields.push(sub_function(sid, *operation));
            read(data, "parameters", fields, |cursor| files::request(*operation, cursor));
        }
        (0x28, [sub, kind, data @ ..]) => {
            fields.push(sub_function(sid, *sub));
            fields.push(Field::hex("communication_type", *kind, 2).meaning(communication(*kind)));
            read(data, "parameters", fields, |cursor| match sub & !SUPPRESS {
                4 | 5 => cursor.hex("node", 2).map(drop),
                _ => None,
            });
        }
        (0x2A, [mode, data @ ..]) => {
            let text = ["", "slow", "medium", "fast", "stop"];
            let text = text.get(usize::from(*mode)).copied().filter(|text| !text.is_empty());
            fields.push(Field::hex("mode", *mode, 2).meaning(text));
            fields.extend(data.iter().map(|low| did(&[0xF2, *low])));
        }
        (0x2C, [sub, a, b, data @ ..]) => {
            fields.push(sub_function(sid, *sub));
            fields.push(did(&[*a, *b]));
            if sub & !SUPPRESS == 1 && data.len() % 4 == 0 {
                for source in data.chunks_exact(4) {
                    let from = u16::from_be_bytes([source[0], source[1]]);
                    fields
                        .push(Field::hex("source", from, 4).meaning(obd_identifiers::data_identifier(from)));
                    fields.push(Field::number("position", source[2]));
                    fields.push(Field::number("size", source[3]).unit("bytes"));
                }
            } else if let (2, Some((lengths, data))) = (sub & !SUPPRESS, data.split_first()) {
                memories(*lengths, data, fields);
            } else {
                rest("parameters", data, fields);
            }
        }
        (0x27, [sub, key @ ..]) if sub & 1 == 0 => {
            fields.push(sub_function(sid, *sub));
            rest("key", key, fields);
        }
        (0x29, [sub, data @ ..]) => {
            fields.push(sub_function(sid, *sub));
            read(data, "parameters", fields, |cursor| authentication::request(sub & !SUPPRESS, cursor));
        }
        (0x84, data) => read(data, "parameters", fields, secured),
        (0x86, [sub, data @ ..]) => {
            fields.push(sub_function(sid, *sub));
            read(data, "parameters", fields, |cursor| events::request(sub & !SUPPRESS, cursor));
        }
        (0x87, [sub, data @ ..]) => {
            fields.push(sub_function(sid, *sub));
            read(data, "parameters", fields, |cursor| match sub & !SUPPRESS {
                1 => cursor.byte("link_mode", link_mode).map(drop),
                2 => cursor.number("bit_rate", 3, "bit/s"),
                _ => None,
            });
        }
        (0x19, [sub, data @ ..]) => {
            fields.push(sub_function(sid, *sub));
            reports::request(sub & !SUPPRESS, data, fields);
        }
        (_, [sub, data @ ..]) if names::has_sub_function(sid) => {
            fields.push(sub_function(sid, *sub));
            rest("parameters", data, fields);
        }
        _ => rest("parameters", after, fields),
    }
}

/// What becomes of an input or output.
fn io_control(control: u8) -> Field {
    let what = ["return control to ECU", "reset to default", "freeze current state", "short term adjustment"];
    Field::hex("control", control, 2).meaning(what.get(usize::from(control)).copied())
}

/// Routines defined in ISO 14229-1:2020 (table F.1).
fn routine(high: u8, low: u8) -> Field {
    let routine = u16::from_be_bytes([high, low]);
    let text = match routine {
        0xE200 => Some("deploy loop"),
        0xFF00 => Some("erase memory"),
        0xFF01 => Some("check programming dependencies"),
        0xFF02 => Some("erase mirror memory trouble codes"),
        _ => None,
    };
    Field::hex("routine", routine, 4).meaning(text)
}

/// Fields by a service's own rules; what these do not cover is named `left`.
fn read(
    data: &[u8],
    left: &'static str,
    fields: &mut Vec<Field>,
    rules: impl FnOnce(&mut Cursor<'_, '_>) -> Option<()>,
) {
    let mut cursor = Cursor::new(data, fields);
    // Bytes that do not suffice for a field are shown as they are.
    let _ = rules(&mut cursor);
    cursor.finish(left);
}

/// What a communication control is for: messages, in the low bits, and networks, in the high ones.
fn communication(kind: u8) -> Option<String> {
    let messages = match kind & 3 {
        1 => "normal",
        2 => "network management",
        3 => "normal and network management",
        _ => return None,
    };
    Some(match kind >> 4 {
        0 => messages.to_owned(),
        15 => format!("{messages}, on the network of the request"),
        subnet => format!("{messages}, on subnet {subnet}"),
    })
}

/// Modes of a link, as py-uds and udsoncan have them.
fn link_mode(mode: u8) -> Option<&'static str> {
    Some(match mode {
        0x01 => "9600 baud",
        0x02 => "19200 baud",
        0x03 => "38400 baud",
        0x04 => "57600 baud",
        0x05 => "115200 baud",
        0x10 => "125 kbit/s",
        0x11 => "250 kbit/s",
        0x12 => "500 kbit/s",
        0x13 => "1 Mbit/s",
        0x20 => "programming",
        _ => return None,
    })
}

/// A secured message, as py-uds and scapy read it: a service in an envelope.
fn secured(cursor: &mut Cursor<'_, '_>) -> Option<()> {
    const ENCRYPTED: u64 = 1 << 4;
    let how = cursor.hex("administrative", 2)?;
    cursor.hex("signature_encryption", 1)?;
    let signature = usize::try_from(cursor.hex("signature_length", 2)?).ok()?;
    cursor.hex("anti_replay_counter", 2)?;
    if how & ENCRYPTED != 0 {
        return None;
    }
    cursor.byte("service", |sid| names::uds_service(sid & !0x40))?;
    cursor.bytes("parameters", cursor.left().checked_sub(signature)?)?;
    cursor.bytes("signature", signature)
}

/// Several addresses and sizes after a byte with their lengths.
fn memories(lengths: u8, data: &[u8], fields: &mut Vec<Field>) {
    let each = usize::from(lengths & 15) + usize::from(lengths >> 4);
    if each == 0 || data.is_empty() || !data.len().is_multiple_of(each) {
        fields.push(Field::hex("lengths", lengths, 2));
        rest("parameters", data, fields);
        return;
    }
    data.chunks_exact(each).for_each(|one| memory(lengths, one, fields));
}

/// Address and size after a byte with their lengths (ISO 14229-1:2020, H.1).
fn memory(lengths: u8, data: &[u8], fields: &mut Vec<Field>) {
    let (address, size) = (usize::from(lengths & 15), usize::from(lengths >> 4));
    if address == 0 || address > 8 || size > 8 || data.len() < address + size {
        fields.push(Field::hex("lengths", lengths, 2));
        rest("parameters", data, fields);
        return;
    }
    fields.push(Field::hex("address", number(&data[..address]), 2 * address as u8));
    fields.push(unsigned("size", number(&data[address..address + size])).unit("bytes"));
    rest("parameters", &data[address + size..], fields);
}

/// The content of a positive UDS response. `request` is the one it answers, if it was observed; its fields have already been
/// added.
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
                if !obd_identifiers::value(u16::from_be_bytes([after[0], after[1]]), data, fields) {
                    value(data, fields);
                }
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
            reports::response(heard, *sub, data, fields);
        }
        (0x27, [sub, data @ ..]) => {
            if !heard {
                fields.push(sub_function(sid, *sub));
            }
            rest(if sub & 1 == 1 { "seed" } else { "value" }, data, fields);
        }
        (0x11, [sub @ 4, seconds]) => {
            if !heard {
                fields.push(sub_function(sid, *sub));
            }
            fields.push(match seconds {
                0xFF => Field::missing("power_down_time"),
                _ => Field::number("power_down_time", *seconds).unit("s"),
            });
        }
        (0x24, [_, _, data @ ..]) => {
            if !heard {
                fields.push(did(after));
            }
            read(data, "value", fields, scaling::response);
        }
        (0x29, [sub, data @ ..]) => {
            if !heard {
                fields.push(sub_function(sid, *sub));
            }
            read(data, "value", fields, |cursor| authentication::response(*sub, cursor));
        }
        (0x2E, [_, _]) if !heard => fields.push(did(after)),
        (0x2F, [_, _, control, data @ ..]) => {
            if !heard {
                fields.extend([did(after), io_control(*control)]);
            }
            rest("status", data, fields);
        }
        (0x38, [mode, data @ ..]) => {
            if !heard {
                fields.push(sub_function(sid, *mode));
            }
            read(data, "value", fields, |cursor| files::response(*mode, cursor));
        }
        (0x84, data) => read(data, "value", fields, secured),
        (0x86, [sub, data @ ..]) => {
            if !heard {
                fields.push(sub_function(sid, *sub));
            }
            read(data, "value", fields, |cursor| events::response(heard, *sub, cursor));
        }
        // The request already said this.
        (0x28, [_]) | (0x2C, [_, _, _]) if heard => {}
        (0x3D, _) if request.is_some_and(|request| request[1..].starts_with(after)) => {}
        (0x3D, [lengths, data @ ..]) => memory(*lengths, data, fields),
        (0x2C, [sub, high, low, data @ ..]) if !heard => {
            fields.extend([sub_function(sid, *sub), did(&[*high, *low])]);
            rest("value", data, fields);
        }
        (0x31, [sub, high, low, data @ ..]) => {
            if !heard {
                fields.push(sub_function(sid, *sub));
                fields.push(routine(*high, *low));
            }
            rest("status", data, fields);
        }
        (0x34 | 0x35, [format, data @ ..])
            if data.len() >= usize::from(format >> 4) && (1..=8).contains(&(format >> 4)) =>
        {
            let (most, left) = data.split_at(usize::from(format >> 4));
            fields.push(unsigned("block_length", number(most)).unit("bytes"));
            rest("value", left, fields);
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

/// Values of several identifiers, whose lengths are unknown: each ends where the next requested identifier appears, if that is in
/// only one place.
fn several(asked: &[u8], answer: &[u8], fields: &mut Vec<Field>) {
    // The server leaves out those that it does not have.
    let dids: Vec<&[u8]> = asked.chunks_exact(2).skip_while(|did| !answer.starts_with(did)).collect();
    let mut at = 2;
    let mut parts = Vec::new();
    for two in dids.windows(2) {
        let (did, next) = (u16::from_be_bytes([two[0][0], two[0][1]]), two[1]);
        let known = obd_identifiers::length(did).map(|length| at + length);
        let known = known.filter(|place| answer.get(*place..).is_some_and(|rest| rest.starts_with(next)));
        let mut places =
            answer.windows(2).enumerate().skip(at).filter(|(_, two)| *two == next).map(|(at, _)| at);
        let ((Some(place), ..) | (None, Some(place), None)) = (known, places.next(), places.next()) else {
            rest("value", answer, fields);
            return;
        };
        parts.push(&answer[at..place]);
        at = place + 2;
    }
    parts.push(answer.get(at..).unwrap_or_default());
    for (did, part) in dids.iter().zip(parts) {
        if obd_identifiers::value(u16::from_be_bytes([did[0], did[1]]), part, fields) {
            continue;
        }
        let mut name = String::from("value_");
        // Writing to a String cannot fail.
        let _ = write!(name, "{:02X}{:02X}", did[0], did[1]);
        fields.push(Field {
            name: name.into(),
            value: values::text_or_bytes(part),
            unit: "".into(),
            text: None,
        });
    }
}

/// The content of a KWP2000 request.
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

/// The content of a positive KWP2000 response.
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
