//! Frames in the two layouts of groups.

use super::super::super::encode::Blocks;
use super::group::{BYTES, Channel, FLOAT, Group, UNSIGNED, VARIABLE, VIRTUAL, conversion, field};

/// A frame in the parts that a logger writes.
#[derive(Clone, Debug)]
pub struct Frame {
    pub time_us: u64,
    pub bus: u8,
    pub id: u32,
    pub is_extended: bool,
    pub is_sent: bool,
    pub is_remote: bool,
    pub flags: Option<u8>,
    pub code: u8,
    pub bytes: Vec<u8>,
}

impl Frame {
    pub fn of((time_us, bus, text): (u64, u8, &str)) -> Self {
        let (text, is_sent) = text.strip_suffix(" T").map_or((text, false), |text| (text, true));
        let (id, rest) = text.split_once('#').unwrap();
        let (flags, data) = match rest.strip_prefix('#') {
            Some(rest) => (rest[..1].parse().ok(), &rest[1..]),
            None => (None, rest),
        };
        let hex = |at: usize| u8::from_str_radix(&data[at..at + 2], 16).unwrap();
        let bytes: Vec<_> =
            if data.starts_with('R') { Vec::new() } else { (0..data.len()).step_by(2).map(hex).collect() };
        let code = match data.strip_prefix('R') {
            Some(code) => code.parse().unwrap(),
            None => {
                cantap_trace::fd::FD_LENGTHS.iter().position(|len| usize::from(*len) == bytes.len()).unwrap()
                    as u8
            }
        };
        let (is_extended, is_remote) = (id.len() == 8, data.starts_with('R'));
        let id = u32::from_str_radix(id, 16).unwrap();
        Self { time_us, bus, id, is_extended, is_sent, is_remote, flags, code, bytes }
    }
}

/// The first layout: all frames in one group, all parts in the record but the bytes, which are in another group; times are floating-point
/// numbers of nanoseconds.
pub fn first_layout(blocks: &mut Blocks, frames: &[Frame]) -> Vec<Group> {
    let ns = conversion(blocks, 1, &[0.0, 1e-9]);
    let bytes = |values| Channel {
        kind: VARIABLE,
        part: ("", 14, 0, 64, BYTES),
        values,
        ..field("DataBytes", 0, 0, 0)
    };
    let group = |number, name: &str, bytes, channels| {
        let (time, data) = ((("", 0, 0, 64, FLOAT), ns), Vec::new());
        Group { number, name: name.into(), bytes, time, channels, records: 0, data, values: Vec::new() }
    };
    let parts = || {
        vec![
            field("BusChannel", 8, 1, 2),
            field("ID", 8, 3, 29),
            field("IDE", 8, 0, 1),
            field("DLC", 13, 4, 4),
            field("DataLength", 12, 1, 7),
            field("Dir", 12, 0, 1),
        ]
    };
    let flags = [field("EDL", 13, 0, 1), field("ESI", 13, 2, 1), field("BRS", 13, 1, 1), bytes(2)];
    let mut data = group(1, "CAN_DataFrame", 22, parts().into_iter().chain(flags).collect());
    let mut remote = group(4, "CAN_RemoteFrame", 14, parts());
    let mut errors =
        group(3, "CAN_ErrorFrame", 9, vec![field("BusChannel", 8, 0, 2), field("ErrorType", 8, 2, 6)]);
    let lin_bytes = Channel { part: ("", 11, 0, 64, BYTES), ..field("DataBytes", 0, 0, 0) };
    let mut lin =
        group(6, "LIN_Frame", 19, vec![field("BusChannel", 8, 0, 2), field("ID", 8, 2, 6), lin_bytes]);
    for frame in frames {
        let group = if frame.is_remote { &mut remote } else { &mut data };
        group.records += 1;
        group.data.extend((frame.time_us as f64 * 1000.0).to_le_bytes());
        let word = frame.id << 3 | u32::from(frame.bus) << 1 | u32::from(frame.is_extended);
        group.data.extend(word.to_le_bytes());
        group.data.push((frame.bytes.len() as u8) << 1 | u8::from(frame.is_sent));
        let flags = frame.flags.map_or(0, |flags| 1 | (flags & 1) << 1 | (flags >> 1) << 2);
        group.data.push(frame.code << 4 | flags);
        if !frame.is_remote {
            group.data.extend((group.values.len() as u64).to_le_bytes());
            group.values.extend((frame.bytes.len() as u32).to_le_bytes());
            group.values.extend(&frame.bytes);
        }
    }
    errors.records = 1;
    errors.data = [&1_500_000_f64.to_le_bytes()[..], &[2 << 2 | 1]].concat();
    lin.records = 2;
    lin.data = [1_600_000_f64, 1_700_000_f64]
        .iter()
        .flat_map(|time| [&time.to_le_bytes()[..], &[0xFD; 11]].concat())
        .collect();
    vec![data, errors, remote, lin]
}

/// The second layout: a group for each bus, direction, kind of identifier and length; times are counters of microseconds. What is the same in
/// all records of a group is no field, and the length comes from the code by a table.
pub fn second_layout(blocks: &mut Blocks, frames: &[Frame]) -> Vec<Group> {
    let us = conversion(blocks, 1, &[0.0, 1e-6]);
    let lengths = cantap_trace::fd::FD_LENGTHS.iter().enumerate();
    let lengths: Vec<_> = lengths.flat_map(|(code, len)| [code as f64, f64::from(*len)]).collect();
    let lengths = conversion(blocks, 5, &lengths);
    let mut constants: Vec<_> = (0..3).map(|value| conversion(blocks, 1, &[f64::from(value), 0.0])).collect();
    let mut constant = move |name, value: u8| {
        let conversion = constants.get_mut(usize::from(value)).copied().unwrap();
        Channel { kind: VIRTUAL, conversion, ..field(name, 0, 0, 0) }
    };
    let mut groups: Vec<Group> = Vec::new();
    for frame in frames {
        let kind = match (frame.is_remote, frame.flags, frame.bytes.len() > 8) {
            (true, ..) => "RTR",
            (_, None, _) => "",
            (_, Some(_), false) => "FD_DLC_up_to_8",
            (_, Some(_), true) => "FD_DLC_over_8",
        };
        let name = format!("CAN{}_{}_{}_{kind}", frame.bus, frame.is_sent, frame.is_extended);
        let at = groups.iter().position(|group| group.name == name).unwrap_or_else(|| {
            let number = 2 * groups.len() as u8 + 64;
            let id_bytes = if frame.is_extended { 4 } else { 2 };
            let code = 6 + id_bytes;
            let mut channels = vec![
                constant("BusChannel", frame.bus),
                field("ID", 6, 0, if frame.is_extended { 29 } else { 11 }),
                constant("IDE", u8::from(frame.is_extended)),
                field("DLC", code, 0, 4),
                Channel { conversion: lengths, ..field("DataLength", code, 0, 4) },
                constant("Dir", u8::from(frame.is_sent)),
            ];
            if frame.flags.is_some() {
                channels.extend([constant("EDL", 1), field("ESI", code, 7, 1), field("BRS", code, 6, 1)]);
            }
            let bytes_at = code + 1;
            let bytes = match kind {
                "RTR" => bytes_at,
                "FD_DLC_over_8" => {
                    let part = ("", bytes_at, 0, 32, BYTES);
                    channels.push(Channel {
                        kind: VARIABLE,
                        part,
                        values: number + 1,
                        ..field("DataBytes", 0, 0, 0)
                    });
                    bytes_at + 4
                }
                _ => {
                    channels
                        .push(Channel { part: ("", bytes_at, 0, 64, BYTES), ..field("DataBytes", 0, 0, 0) });
                    bytes_at + 8
                }
            };
            let time = (("", 0, 0, 48, UNSIGNED), us);
            let (data, values) = (Vec::new(), Vec::new());
            groups.push(Group { number, name, bytes, time, channels, records: 0, data, values });
            groups.len() - 1
        });
        let group = &mut groups[at];
        group.records += 1;
        group.data.extend(&frame.time_us.to_le_bytes()[..6]);
        group.data.extend(&frame.id.to_le_bytes()[..if frame.is_extended { 4 } else { 2 }]);
        let flags = frame.flags.map_or(0, |flags| (flags & 1) << 6 | (flags >> 1) << 7);
        group.data.push(frame.code | flags);
        match kind {
            "RTR" => {}
            "FD_DLC_over_8" => {
                group.data.extend((group.values.len() as u32).to_le_bytes());
                group.values.extend((frame.bytes.len() as u32).to_le_bytes());
                group.values.extend(&frame.bytes);
            }
            _ => group.data.extend(frame.bytes.iter().copied().chain([0xFF; 8]).take(8)),
        }
    }
    groups
}
