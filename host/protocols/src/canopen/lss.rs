//! Layer setting services (CiA 305): node numbers and bit rates of nodes that have none yet.

use cantap_trace::TraceRecord;

use crate::{Event, Field, Protocol};

/// A service of the master that a slave may answer.
#[derive(Default)]
pub struct Lss {
    asked: Option<(i64, u8)>,
    frames_lost: bool,
}

const fn title(service: u8) -> Option<&'static str> {
    Some(match service {
        0x04 => "LSS switch state global",
        0x11 => "LSS configure node number",
        0x13 => "LSS configure bit timing",
        0x15 => "LSS activate bit timing",
        0x17 => "LSS store configuration",
        0x40 => "LSS switch state selective: vendor",
        0x41 => "LSS switch state selective: product",
        0x42 => "LSS switch state selective: revision",
        0x43 => "LSS switch state selective: serial number",
        0x44 => "LSS switched",
        0x46 => "LSS identify: vendor",
        0x47 => "LSS identify: product",
        0x48 => "LSS identify: revision, lowest",
        0x49 => "LSS identify: revision, highest",
        0x4A => "LSS identify: serial number, lowest",
        0x4B => "LSS identify: serial number, highest",
        0x4C => "LSS identify slaves without a number",
        0x4F => "LSS identified",
        0x50 => "LSS a slave without a number",
        0x51 => "LSS fast scan",
        0x5A => "LSS inquire vendor",
        0x5B => "LSS inquire product",
        0x5C => "LSS inquire revision",
        0x5D => "LSS inquire serial number",
        0x5E => "LSS inquire node number",
        _ => return None,
    })
}

impl Lss {
    /// Frames on the channel are missing.
    pub const fn interrupt(&mut self) {
        self.frames_lost = true;
    }

    /// Takes a frame from the master (7E5) or a slave (7E4).
    pub fn take(&mut self, record: &TraceRecord, from_master: bool, data: &[u8]) -> Option<Event> {
        let (&service, rest) = data.split_first()?;
        let kind = if from_master { "lss" } else { "lss_answer" };
        let known = title(service);
        let mut event = Event::new(Protocol::CanOpen, record, kind, known.unwrap_or("LSS, unknown service"));
        if known.is_none() {
            event.fields.push(Field::hex("service", service, 2));
            event.fields.push(Field::bytes("data", rest));
            return Some(event);
        }
        let word =
            |bytes: &[u8]| bytes.iter().take(4).rev().fold(0_u64, |word, byte| word << 8 | u64::from(*byte));
        let fields = &mut event.fields;
        match (service, rest) {
            (0x04, [mode, ..]) => {
                let text = ["waiting", "configuration"].get(usize::from(*mode)).copied();
                fields.push(Field::number("mode", *mode).meaning(text));
            }
            (0x11, [node, ..]) if from_master => fields.push(Field::number("node", *node)),
            (0x13, [table, index, ..]) if from_master => {
                const RATES: [&str; 10] = [
                    "1 Mbit/s",
                    "800 kbit/s",
                    "500 kbit/s",
                    "250 kbit/s",
                    "125 kbit/s",
                    "reserved",
                    "50 kbit/s",
                    "20 kbit/s",
                    "10 kbit/s",
                    "automatic",
                ];
                let text = RATES.get(usize::from(*index)).copied().filter(|_| *table == 0);
                fields.push(Field::number("table", *table));
                fields.push(Field::number("index", *index).meaning(text));
            }
            (0x15, [low, high, ..]) => {
                fields.push(Field::number("switch_delay_ms", u16::from_le_bytes([*low, *high])));
            }
            (0x11 | 0x13 | 0x17, [error, own, ..]) => {
                let text = match error {
                    0 => "success",
                    1 => "out of range, or not supported",
                    2 => "no access to the storage",
                    0xFF => "a reason of the device",
                    _ => "reserved",
                };
                fields.push(Field::number("error", *error).meaning(Some(text)));
                fields.push(Field::number("device_error", *own));
            }
            (0x40..=0x43 | 0x46..=0x4B, rest) => fields.push(Field::hex("value", word(rest), 8)),
            (0x5A..=0x5D, rest) if !from_master => fields.push(Field::hex("value", word(rest), 8)),
            (0x5E, [node, ..]) if !from_master => fields.push(Field::number("node", *node)),
            (0x51, [a, b, c, d, bit, sub, next]) => {
                fields.push(Field::hex("value", word(&[*a, *b, *c, *d]), 8));
                fields.push(Field::number("bits_not_checked", *bit));
                fields.push(Field::number("part", *sub));
                fields.push(Field::number("next_part", *next));
            }
            _ => {}
        }
        if from_master {
            self.asked = Some((record.time_ns, service));
            self.frames_lost = false;
        } else if let Some((asked_ns, asked)) = self.asked {
            let answers = match service {
                0x44 => asked == 0x43,
                0x4F => matches!(asked, 0x4B | 0x51 | 0x4C),
                0x50 => asked == 0x4C,
                service => asked == service,
            };
            if answers {
                event.response_ns = Some(record.time_ns.saturating_sub(asked_ns));
                event.frames_lost = self.frames_lost;
            }
        }
        Some(event)
    }
}
