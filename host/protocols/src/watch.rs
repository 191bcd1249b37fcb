//! What the first records of a bus could not show: channels that were silent, and protocols that begin later, alone or beside others.

use std::collections::VecDeque;

use cantap_trace::TraceRecord;

use crate::signs::{FAMILY, Signs};
use crate::survey::Survey;
use crate::{Evidence, Protocol, is_gap};

/// How often to look whether a protocol shows by now, in nanoseconds.
const LOOK_EVERY_NS: i64 = 100_000_000;
/// After so long without enough signs, counting begins anew, in nanoseconds.
const WINDOW_NS: i64 = 3_000_000_000;
/// So many messages show a protocol before [`WINDOW_NS`] are over.
const CONVINCING: u32 = 5;
/// How many records of a channel are kept, so that what showed the protocol is read by it as well.
const MOST_HELD: usize = 1024;

/// The protocols that are looked for here. [`crate::conversations::Conversations`] finds those of diagnostics by itself.
const WATCHED: u16 = FAMILY
    | Protocol::CanOpen.bit()
    | Protocol::DeviceNet.bit()
    | Protocol::CALIBRATION
    | Protocol::DroneCan.bit()
    | Protocol::Cyphal.bit();

/// Looks for protocols that a survey has not found, on every channel, for as long as records come.
pub struct Watch {
    channels: Vec<Watched>,
}

/// A channel.
struct Watched {
    /// Protocols that are read already.
    known: u16,
    /// Since when signs are counted, and when to look next.
    window: Option<(i64, i64)>,
    /// Nothing has been heard yet, or its first window is not over.
    is_new: bool,
    /// There was more than what is held.
    has_dropped: bool,
    signs: Option<Box<Signs>>,
    held: VecDeque<TraceRecord>,
}

/// A protocol that has begun on a channel.
#[derive(Clone, Debug, PartialEq)]
pub struct Begun {
    /// What it is.
    pub evidence: Evidence,
    /// The stamp of its first frame that is still there.
    pub from_ns: i64,
    /// Nothing of this channel came before.
    pub is_whole: bool,
    /// The records that showed it, to be read by it, without the last one.
    pub held: Vec<TraceRecord>,
}

impl Watch {
    /// After the survey of the first records.
    pub fn new(survey: &Survey) -> Self {
        let watched = |channel| Watched {
            known: 0,
            window: None,
            is_new: !survey.has_channel(channel),
            has_dropped: false,
            signs: None,
            held: VecDeque::new(),
        };
        let mut channels: Vec<_> = (0..=u8::MAX).map(watched).collect();
        for Evidence { channel, protocol, .. } in survey.found() {
            channels[usize::from(channel)].known |= protocol.bit();
        }
        Self { channels }
    }

    /// Takes the next record, and returns what has shown by now.
    pub fn take(&mut self, record: &TraceRecord) -> Vec<Begun> {
        self.channels[usize::from(record.channel)].take(record)
    }

    /// The records have ended: returns what has shown in the last of them.
    pub fn finish(&mut self) -> Vec<Begun> {
        let counting = (0..=u8::MAX).zip(&mut self.channels).filter(|(_, channel)| channel.window.is_some());
        counting.flat_map(|(number, channel)| channel.begun(number, None)).collect()
    }
}

impl Watched {
    fn take(&mut self, record: &TraceRecord) -> Vec<Begun> {
        let wanted = WATCHED & !self.known;
        if record.frame().is_none() {
            if is_gap(&record.event) && !self.held.is_empty() {
                self.hold(record);
            }
            return Vec::new();
        }
        if wanted == 0 {
            return Vec::new();
        }
        let of = self.signs.get_or_insert_default().take(record, wanted);
        let now_ns = record.time_ns;
        match self.window {
            None if of == 0 && !self.is_new => return Vec::new(),
            None => self.window = Some((now_ns, now_ns.saturating_add(LOOK_EVERY_NS))),
            Some((since_ns, look_ns)) if now_ns >= look_ns => {
                let begun = self.look(record, now_ns.saturating_sub(since_ns) >= WINDOW_NS);
                if !begun.is_empty() {
                    return begun;
                }
            }
            Some(_) => {}
        }
        if of != 0 || self.is_new {
            self.hold(record);
        }
        Vec::new()
    }

    fn hold(&mut self, record: &TraceRecord) {
        if self.held.len() == MOST_HELD {
            self.held.pop_front();
            self.has_dropped = true;
        }
        self.held.push_back(*record);
    }

    /// Whether something has begun.
    fn look(&mut self, record: &TraceRecord, is_over: bool) -> Vec<Begun> {
        let Some(signs) = &mut self.signs else { return Vec::new() };
        let is_clear = is_over || signs.found(self.known).any(|(_, messages)| messages >= CONVINCING);
        let begun = if is_clear { self.begun(record.channel, Some(record)) } else { Vec::new() };
        if !begun.is_empty() {
            return begun;
        }
        if is_over {
            // Messages that are rarer than a window go on being counted, unless other traffic contradicts them.
            self.is_new = false;
            if self.signs.as_mut().is_some_and(|signs| !signs.keep_plausible()) {
                self.window = None;
                self.held.clear();
                self.has_dropped = false;
            }
        }
        if let Some((_, look_ns)) = &mut self.window {
            *look_ns = record.time_ns.saturating_add(LOOK_EVERY_NS);
        }
        Vec::new()
    }

    /// What the signs show, and counting begins anew.
    fn begun(&mut self, channel: u8, now: Option<&TraceRecord>) -> Vec<Begun> {
        let Some(signs) = &self.signs else { return Vec::new() };
        // A single message is enough where there is nothing else.
        let least = if self.is_new { 1 } else { 2 };
        let found: Vec<_> = signs.found(self.known).filter(|(_, messages)| *messages >= least).collect();
        if found.is_empty() {
            return Vec::new();
        }
        let held = Vec::from(std::mem::take(&mut self.held));
        let first_ns = held.first().or(now).map_or(0, |record| record.time_ns);
        let is_whole = self.is_new && !self.has_dropped && self.known == 0;
        let begun = found.into_iter().map(|(protocol, messages)| {
            // The frames of the one are those of the other: they have been read.
            let is_beside = protocol.bit() & FAMILY != 0 && self.known & FAMILY != 0;
            let now_ns = now.map_or(first_ns, |record| record.time_ns);
            Begun {
                evidence: Evidence { channel, protocol, messages },
                from_ns: if is_beside { now_ns } else { first_ns },
                is_whole,
                held: if is_beside { Vec::new() } else { held.clone() },
            }
        });
        let begun: Vec<_> = begun.collect();
        self.known = begun.iter().fold(self.known, |known, begun| known | begun.evidence.protocol.bit());
        (self.window, self.signs, self.is_new, self.has_dropped) = (None, None, false, false);
        begun
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{at, lost};
    use crate::{Announcement, Options, ReadItem, Reader};

    /// What the records say; and what began later, except for diagnostics, with the second of its first frame.
    fn event_lines(records: &[TraceRecord]) -> (Vec<String>, Vec<(Protocol, i64)>) {
        let (mut lines, mut all_begun) = (Vec::new(), Vec::new());
        let mut reader = Reader::new(Options::default());
        let Ok(()) = reader.take(records, false, |read| {
            match read {
                ReadItem::Event(event) => lines.push(event.to_string()),
                ReadItem::Announcement(Announcement::Begun { protocol, from_ns, .. })
                    if !protocol.is_diagnostics() =>
                {
                    all_begun.push((protocol, from_ns / 1_000_000_000));
                }
                _ => {}
            }
            Ok::<_, std::convert::Infallible>(())
        });
        (lines, all_begun)
    }

    const TRUCK: &str = "0CF00400#FFFFFF0000FFFFFF";
    const BOAT: &str = "09F80102#36729A16021AB80D";
    const BEAT: &str = "705#05";

    /// One bus at first, another one from `second` on.
    fn then(first: &[&str], second: i32, others: &[&str]) -> Vec<TraceRecord> {
        let frames = |from: i32, to: i32, of: &[&str]| {
            let lines = |tenth: i32| (0..).zip(of).map(move |(ms, frame)| (tenth * 100 + ms, *frame));
            (from * 10..to * 10).flat_map(lines).map(|(ms, frame)| at(ms.into(), frame)).collect::<Vec<_>>()
        };
        let mut records = frames(0, 60, first);
        records.extend(frames(second, second + 10, others));
        records.sort_by_key(|record| record.time_ns);
        records
    }

    #[test]
    fn a_protocol_that_begins_on_a_channel_with_another_is_read_from_its_first_sign_on() {
        let duplicate = ["40F#00340278563412"];
        let (lines, begun) = event_lines(&then(&[TRUCK], 20, &[BEAT]));
        assert_eq!(begun, [(Protocol::CanOpen, 20)]);
        assert!(
            lines.iter().any(|line| *line == "canopen 5 operational"),
            "{:?}",
            lines.iter().find(|line| line.contains("canopen"))
        );
        assert_eq!(event_lines(&then(&[BEAT], 20, &[TRUCK])).1, [(Protocol::J1939, 20)]);
        assert_eq!(event_lines(&then(&[BEAT], 20, &[BOAT])).1, [(Protocol::Nmea2000, 20)]);
        assert_eq!(event_lines(&then(&["123#00"], 20, &[BEAT, TRUCK])).1.len(), 2);
        // Its node checks twice, a second apart.
        let mut checks = then(&[TRUCK], 20, &[]);
        checks.extend([at(70_000.0, duplicate[0]), at(71_000.0, duplicate[0]), at(72_000.0, TRUCK)]);
        let (lines, begun) = event_lines(&checks);
        assert_eq!(begun, [(Protocol::DeviceNet, 70)]);
        assert_eq!(
            lines.iter().filter(|line| line.contains("duplicate MAC ID check")).count(),
            2,
            "{lines:?}"
        );
    }

    /// Their frames are the same: what is under way goes on, and groups that only one of them has belong to it.
    #[test]
    fn nmea_2000_beside_j1939_is_told_apart_from_then_on() {
        for (first, other, protocol) in [(TRUCK, BOAT, Protocol::Nmea2000), (BOAT, TRUCK, Protocol::J1939)] {
            let (lines, begun) = event_lines(&then(&[first], 20, &[other]));
            assert_eq!(begun, [(protocol, 20)], "{first} {other}");
            assert!(lines.iter().any(|line| line.starts_with("nmea2000 2 > all Position")), "{lines:?}");
            assert!(lines.iter().any(|line| line.starts_with("j1939 0 > all EEC1")), "{lines:?}");
        }
        // Both from the beginning.
        let (lines, begun) = event_lines(&then(&[TRUCK, BOAT], 0, &[]));
        assert_eq!(begun, []);
        assert!(lines.iter().any(|line| line.starts_with("nmea2000 2 > all Position")), "{lines:?}");
        assert!(lines.iter().any(|line| line.starts_with("j1939 0 > all EEC1")), "{lines:?}");
        // A few positions beside a busy truck.
        let mut busy = then(&[TRUCK; 50], 0, &[]);
        busy.extend((0..8).map(|ms| at(6000.0 + f64::from(ms), BOAT)));
        busy.push(at(6500.0, TRUCK));
        assert_eq!(event_lines(&busy).1, [(Protocol::Nmea2000, 6)]);
    }

    #[test]
    fn rare_messages_are_counted_for_as_long_as_nothing_contradicts_them() {
        let mut rare = then(&["123#00"], 0, &[]);
        rare.extend((1..5).map(|time| at(f64::from(time) * 10_000.0, BEAT)));
        assert_eq!(event_lines(&rare).1, [(Protocol::CanOpen, 10)]);
        // At the end of the records, and with a loss in what is held.
        let mut end = then(&["123#00"], 0, &[]);
        end.extend([at(9000.0, "605#4018100100000000"), lost(9001.0), at(9002.0, "585#4318100178563412")]);
        end.push(at(9003.0, BEAT));
        let (lines, begun) = event_lines(&end);
        assert_eq!(begun, [(Protocol::CanOpen, 9)]);
        assert!(
            lines.iter().any(|line| line.contains("SDO read") && line.contains("frames were lost")),
            "{lines:?}"
        );
    }

    /// A byte that stays zero, one that counts, and what a car sends with identifiers that a machine has.
    #[test]
    fn other_traffic_is_not_taken_for_a_protocol() {
        for frames in [
            &["710#00"][..],
            &["714#0322F190AAAAAAAA", "77E#0562F19041AAAAAA", "705#05"],
            &["605#0000000000000000", "585#0000000000000000"],
            &["605#4000000000000000", "585#4000000000000000"],
            &["629#4040404040404040", "5A9#4040404040404040"],
            &["40F#00340278563412", "123#00"],
            &["40F#FF340278563412", "123#00"],
            &["404#0000000000000000", "403#0000000000000000"],
            &["12F00400#0000000000000000", "1EF00400#0000000000000000", "0CF00400#0000000000000000"],
            &["10240040#00", "1001A097#0000000000000000", "10004040#0000000000000000", "13FFE040#00"],
        ] {
            let mut records = then(&["123#00"], 20, frames);
            assert_eq!(event_lines(&records).1, [], "{frames:?}");
            records.retain(|record| record.time_ns >= 20_000_000_000);
            for record in &mut records {
                record.time_ns -= 20_000_000_000;
            }
            assert_eq!(event_lines(&records).1, [], "{frames:?} from the beginning");
        }
    }

    /// Traffic of every shape that is nobody's protocol, from the beginning and later: identifiers of 11 bits, of 29, and of both, with
    /// contents that are random, constant, zero, or count.
    #[test]
    fn random_traffic_is_not_taken_for_a_protocol() {
        let mut random = fastrand::Rng::with_seed(16);
        for round in 0..48_u32 {
            let (size, kind) = ([20, 100, 500][random.usize(0..3)], round % 4);
            let ids: Vec<_> = (0..size)
                .map(|_| {
                    let is_extended = round % 3 == 1 || round % 3 == 2 && random.bool();
                    // None of diagnostics, which servers that never answer may have.
                    let id = if is_extended {
                        format!("{:08X}", random.u32(..1 << 29))
                    } else {
                        format!("{:03X}", random.u32(..0x7C0))
                    };
                    (id, random.usize(0..9), random.u8(..))
                })
                .collect();
            let from_ms = if round % 8 < 4 { 0.0 } else { 20_000.0 };
            let mut records = if from_ms > 0.0 { then(&["123#00"], 0, &[]) } else { Vec::new() };
            for number in 0..8000_u32 {
                let (id, length, own) = &ids[random.usize(0..size)];
                let data: Vec<u8> = match kind {
                    0 => (0..*length).map(|_| random.u8(..)).collect(),
                    1 => vec![*own; *length],
                    2 => vec![0; *length],
                    _ => vec![number as u8; *length],
                };
                let frame = format!("{id}#{}", crate::testing::hex(&data));
                records.push(at(from_ms + f64::from(number), &frame));
            }
            let (_, begun) = event_lines(&records);
            let found: Vec<_> = {
                let mut survey = Survey::new(&[], None);
                records
                    .iter()
                    .filter(|record| record.time_ns < WINDOW_NS)
                    .for_each(|record| survey.take(record));
                let found = survey.found().into_iter();
                found.filter(|found| WATCHED & found.protocol.bit() != 0).collect()
            };
            assert!(
                begun.is_empty() && found.is_empty(),
                "round {round}, {size}, {kind}: {begun:?} {found:?}"
            );
        }
    }
}
