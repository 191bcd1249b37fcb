//! ReadDTCInformation: the content of its requests and responses, by sub-function (ISO 14229-1:2020, 12.3).

use super::dtc::{self, Dtc};
use crate::Field;

/// Bytes of a code, and of a code with its status.
const CODE: usize = 3;
const CODE_AND_STATUS: usize = CODE + 1;

/// `P1234-56`, of at least three bytes.
pub fn code(bytes: &[u8]) -> String {
    format!("{}-{:02X}", Dtc(u16::from_be_bytes([bytes[0], bytes[1]])), bytes[2])
}

fn rest(name: &'static str, bytes: &[u8], fields: &mut Vec<Field>) {
    if !bytes.is_empty() {
        fields.push(Field::bytes(name, bytes));
    }
}

/// The format of the codes (ISO 14229-1:2020, table 328).
fn format(byte: u8) -> Field {
    let text =
        ["SAE J2012-DA, format 00", "ISO 14229-1", "SAE J1939-73", "ISO 11992-4", "SAE J2012-DA, format 04"];
    Field::hex("format", byte, 2).meaning(text.get(usize::from(byte)).copied())
}

/// Groups of WWH-OBD (ISO 14229-1:2020, table D.15).
fn functional_group(byte: u8) -> Field {
    let text = match byte {
        0x33 => Some("emissions"),
        0xD0 => Some("safety"),
        0xFE => Some("VOBD"),
        _ => None,
    };
    Field::hex("functional_group", byte, 2).meaning(text)
}

fn record_number(byte: u8, all: u8) -> Field {
    Field::hex("record_number", byte, 2).meaning((byte == all).then_some("all"))
}

/// The content of a request after the sub-function, which does not include the bit that suppresses the
/// response.
pub fn request(sub: u8, data: &[u8], fields: &mut Vec<Field>) {
    let left: &[u8] = match (sub, data) {
        (0x01 | 0x02 | 0x0F | 0x11..=0x13, [mask, left @ ..]) => {
            fields.push(Field::hex("status_mask", *mask, 2));
            left
        }
        (0x04 | 0x06 | 0x10, [a, b, c, of, left @ ..]) => {
            fields.extend([Field::text("code", code(&[*a, *b, *c])), record_number(*of, 0xFF)]);
            left
        }
        (0x03 | 0x04 | 0x06 | 0x09 | 0x10, [a, b, c, left @ ..]) => {
            fields.push(Field::text("code", code(&[*a, *b, *c])));
            left
        }
        (0x05 | 0x16 | 0x1A, [of, left @ ..]) => {
            fields.push(record_number(*of, 0xFF));
            left
        }
        (0x07 | 0x08, [severity, mask, left @ ..]) => {
            fields.extend([severity_mask(*severity), Field::hex("status_mask", *mask, 2)]);
            left
        }
        (0x17, [mask, memory, left @ ..]) => {
            fields.extend([Field::hex("status_mask", *mask, 2), Field::hex("memory", *memory, 2)]);
            left
        }
        (0x18 | 0x19, [a, b, c, of, memory, left @ ..]) => {
            fields.extend([Field::text("code", code(&[*a, *b, *c])), record_number(*of, 0xFF)]);
            fields.push(Field::hex("memory", *memory, 2));
            left
        }
        (0x42, [group, mask, severity, left @ ..]) => {
            fields.extend([
                functional_group(*group),
                Field::hex("status_mask", *mask, 2),
                severity_mask(*severity),
            ]);
            left
        }
        (0x55, [group, left @ ..]) => {
            fields.push(functional_group(*group));
            left
        }
        (0x56, [group, readiness, left @ ..]) => {
            fields.extend([functional_group(*group), Field::hex("readiness_group", *readiness, 2)]);
            left
        }
        _ => data,
    };
    rest("parameters", left, fields);
}

fn severity_mask(byte: u8) -> Field {
    Field::hex("severity_mask", byte, 2).meaning(severity(byte))
}

/// The three highest bits; the lower ones are WWH-OBD classes (ISO 14229-1:2020, D.3).
fn severity(byte: u8) -> Option<String> {
    const BITS: [(u8, &str); 8] = [
        (0x80, "check immediately"),
        (0x40, "check at next halt"),
        (0x20, "maintenance only"),
        (0x10, "class C"),
        (0x08, "class B2"),
        (0x04, "class B1"),
        (0x02, "class A"),
        (0x01, "no class"),
    ];
    let set: Vec<_> = BITS.iter().filter(|(bit, _)| byte & bit != 0).map(|(_, name)| *name).collect();
    (!set.is_empty()).then(|| set.join(" + "))
}

/// Codes of four bytes, `P1234-56 (confirmed)`, and their number.
fn with_status(codes: &[u8], fields: &mut Vec<Field>) {
    fields.push(Field::number("trouble_codes", (codes.len() / CODE_AND_STATUS) as i64));
    fields.push(Field::text("codes", dtc::list_with_status(codes)));
}

/// Codes after some other bytes, each in words.
fn each(codes: &[u8], length: usize, words: impl Fn(&[u8]) -> String, fields: &mut Vec<Field>) {
    let listed: Vec<_> = codes.chunks_exact(length).map(words).collect();
    fields.push(Field::number("trouble_codes", listed.len() as i64));
    fields.push(Field::text("codes", listed.join(", ")));
}

/// A severity, in some reports a functional unit, a code and its status.
fn with_severity(bytes: &[u8]) -> String {
    let (front, code) = bytes.split_at(bytes.len() - CODE_AND_STATUS);
    let unit = front.get(1).map_or_else(String::new, |unit| format!(", functional unit {unit:02X}"));
    let words = severity(front[0]).unwrap_or_else(|| "no severity".to_owned());
    format!("{} [{words}{unit}]", dtc::list_with_status(code))
}

/// The content of a positive response after the sub-function. Anything repeated from a request that was `heard` is
/// left out.
pub fn response(heard: bool, sub: u8, data: &[u8], fields: &mut Vec<Field>) {
    let again = |field: Field| (!heard).then_some(field);
    let mask = |mask: u8| Field::hex("available_mask", mask, 2);
    match (sub, data) {
        (0x01 | 0x07 | 0x11 | 0x12, [available, as_what, high, low]) => {
            fields.extend([mask(*available), format(*as_what)]);
            fields.push(Field::number("trouble_codes", u16::from_be_bytes([*high, *low])));
        }
        (0x02 | 0x0A..=0x0F | 0x13 | 0x15, [available, codes @ ..]) if codes.len() % CODE_AND_STATUS == 0 => {
            fields.push(mask(*available));
            with_status(codes, fields);
        }
        (0x03, codes) if codes.len() % 4 == 0 => {
            each(codes, 4, |one| format!("{} (record {:02X})", code(one), one[3]), fields);
        }
        (0x04 | 0x06 | 0x10, codes) if codes.len() >= CODE_AND_STATUS => {
            let (one, record) = codes.split_at(CODE_AND_STATUS);
            fields.push(Field::text("codes", dtc::list_with_status(one)));
            rest("record", record, fields);
        }
        (0x05 | 0x16, [of, codes @ ..]) if codes.len() >= CODE_AND_STATUS => {
            let (one, record) = codes.split_at(CODE_AND_STATUS);
            fields.extend(again(record_number(*of, 0xFF)));
            fields.push(Field::text("codes", dtc::list_with_status(one)));
            rest("record", record, fields);
        }
        (0x08 | 0x09, [available, codes @ ..]) if codes.len() % 6 == 0 => {
            fields.push(mask(*available));
            each(codes, 6, with_severity, fields);
        }
        (0x14, codes) if codes.len() % 4 == 0 => {
            // The counter is signed: it goes down while the test passes.
            each(codes, 4, |one| format!("{} (counter {})", code(one), one[3] as i8), fields);
        }
        (0x17, [memory, available, codes @ ..]) if codes.len() % CODE_AND_STATUS == 0 => {
            fields.extend(again(Field::hex("memory", *memory, 2)));
            fields.push(mask(*available));
            with_status(codes, fields);
        }
        (0x18 | 0x19, [memory, codes @ ..]) if codes.len() >= CODE_AND_STATUS => {
            let (one, record) = codes.split_at(CODE_AND_STATUS);
            fields.extend(again(Field::hex("memory", *memory, 2)));
            fields.push(Field::text("codes", dtc::list_with_status(one)));
            rest("record", record, fields);
        }
        (0x1A, [available, of, codes @ ..]) if codes.len() % CODE_AND_STATUS == 0 => {
            fields.push(mask(*available));
            fields.extend(again(record_number(*of, 0xFF)));
            with_status(codes, fields);
        }
        (0x42, [group, available, severity, as_what, codes @ ..]) if codes.len() % 5 == 0 => {
            fields.extend(again(functional_group(*group)));
            fields.push(mask(*available));
            fields.extend([Field::hex("available_severity", *severity, 2), format(*as_what)]);
            each(codes, 5, with_severity, fields);
        }
        (0x55, [group, available, as_what, codes @ ..]) if codes.len() % CODE_AND_STATUS == 0 => {
            fields.extend(again(functional_group(*group)));
            fields.extend([mask(*available), format(*as_what)]);
            with_status(codes, fields);
        }
        (0x56, [group, available, as_what, readiness, codes @ ..]) if codes.len() % CODE_AND_STATUS == 0 => {
            fields.extend(again(functional_group(*group)));
            fields.extend([mask(*available), format(*as_what)]);
            fields.extend(again(Field::hex("readiness_group", *readiness, 2)));
            with_status(codes, fields);
        }
        _ => rest("value", data, fields),
    }
}

/// The trouble codes of a positive response, which begins with 59: those that [`response`] lists.
pub fn codes(response: &[u8]) -> Vec<[u8; CODE]> {
    let [0x59, sub, data @ ..] = response else { return Vec::new() };
    // How many bytes are in front of the list, and how many an entry has, with the place of its code.
    let (front, entry, at) = match sub {
        0x02 | 0x0A..=0x0F | 0x13 | 0x15 => (1, CODE_AND_STATUS, 0),
        0x03 | 0x14 => (0, CODE_AND_STATUS, 0),
        0x17 | 0x1A => (2, CODE_AND_STATUS, 0),
        0x08 | 0x09 => (1, 6, 2),
        0x42 => (4, 5, 1),
        0x55 => (3, CODE_AND_STATUS, 0),
        0x56 => (4, CODE_AND_STATUS, 0),
        _ => return Vec::new(),
    };
    let list = data.get(front..).filter(|list| list.len().is_multiple_of(entry)).unwrap_or_default();
    list.chunks_exact(entry).map(|entry| [entry[at], entry[at + 1], entry[at + 2]]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Value;

    fn shown(decode: fn(u8, &[u8], &mut Vec<Field>), sub: u8, bytes: &[u8]) -> String {
        let mut fields = Vec::new();
        decode(sub, bytes, &mut fields);
        fields.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
    }

    #[test]
    fn every_report_has_its_fields() {
        const CODE: [u8; 4] = [0x12, 0x34, 0x56, 0x08];
        let listed = "trouble_codes 1, codes \"P1234-56 (confirmed)\"";
        let behind = |front: &[u8]| [front, &CODE[..]].concat();
        for (sub, bytes, expected) in [
            (0x02, behind(&[0xFF]), format!("available_mask 0xFF, {listed}")),
            (0x03, vec![0x12, 0x34, 0x56, 1], "trouble_codes 1, codes \"P1234-56 (record 01)\"".to_owned()),
            (0x06, [&CODE[..], &[1, 0xAA]].concat(), "codes \"P1234-56 (confirmed)\", record 01 AA".to_owned()),
            (0x05, behind(&[1]), "record_number 0x01, codes \"P1234-56 (confirmed)\"".to_owned()),
            (
                0x08,
                behind(&[0xFF, 0x20, 0x10]),
                "available_mask 0xFF, trouble_codes 1, codes \"P1234-56 (confirmed) [maintenance only, functional unit 10]\""
                    .to_owned(),
            ),
            (0x14, vec![0x12, 0x34, 0x56, 0xFE], "trouble_codes 1, codes \"P1234-56 (counter -2)\"".to_owned()),
            (0x17, behind(&[1, 0xFF]), format!("memory 0x01, available_mask 0xFF, {listed}")),
            (0x1A, behind(&[0xFF, 1]), format!("available_mask 0xFF, record_number 0x01, {listed}")),
            (
                0x42,
                behind(&[0x33, 0xFF, 0x1F, 4, 0x02]),
                "functional_group 0x33 (emissions), available_mask 0xFF, available_severity 0x1F, \
                 format 0x04 (SAE J2012-DA, format 04), trouble_codes 1, codes \"P1234-56 (confirmed) [class A]\""
                    .to_owned(),
            ),
            (
                0x55,
                behind(&[0x33, 0xFF, 4]),
                format!("functional_group 0x33 (emissions), available_mask 0xFF, format 0x04 (SAE J2012-DA, format 04), {listed}"),
            ),
            // What does not fit stays unchanged.
            (0x02, vec![0xFF, 1, 2], "value FF 01 02".to_owned()),
        ] {
            assert_eq!(shown(|sub, data, fields| response(false, sub, data, fields), sub, &bytes), expected, "{sub:02X}");
        }
        for (sub, bytes, expected) in [
            (
                0x42,
                &[0x33, 0xFF, 0x20][..],
                "functional_group 0x33 (emissions), status_mask 0xFF, severity_mask 0x20 (maintenance only)",
            ),
            (0x06, &[0x12, 0x34, 0x56, 0xFF], "code \"P1234-56\", record_number 0xFF (all)"),
            (0x17, &[8, 1], "status_mask 0x08, memory 0x01"),
            (0x0A, &[], ""),
        ] {
            assert_eq!(shown(request, sub, bytes), expected, "{sub:02X}");
        }
    }

    /// What a description of the ECU gives texts to is what the report is shown to have.
    #[test]
    fn the_codes_of_a_report_are_those_that_it_is_shown_with() {
        for sub in 0..=0xFF {
            for length in 0..40 {
                let data: Vec<u8> = (1..=length).collect();
                let mut fields = Vec::new();
                response(true, sub, &data, &mut fields);
                let value =
                    |name: &str| fields.iter().find(|field| field.name == name).map(|field| &field.value);
                let (count, list) = (value("trouble_codes"), value("codes"));
                let codes = codes(&[&[0x59, sub], &data[..]].concat());
                if let (Some(Value::Number(count)), Some(Value::Text(list))) = (count, list) {
                    assert_eq!(codes.len() as i64, *count, "{sub:02X}, {length} bytes");
                    assert!(codes.iter().all(|one| list.contains(&code(one))), "{sub:02X}: {list}");
                } else {
                    assert!(codes.is_empty(), "{sub:02X}, {length} bytes: {codes:?}");
                }
            }
        }
    }

    #[test]
    fn a_report_of_any_length_is_taken() {
        for sub in 0..=0xFF {
            for length in 0..24 {
                let bytes = vec![sub; length];
                let _ = (
                    shown(request, sub, &bytes),
                    shown(|sub, data, fields| response(false, sub, data, fields), sub, &bytes),
                );
            }
        }
    }
}
