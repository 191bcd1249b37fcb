//! Records as bytes, for a stream between two programs of one version, such as a server and its page. It is no file format: nothing in it
//! says which version wrote it.
//!
//! A frame of eight bytes takes about sixteen. Each record is its kind and flags (1 byte), its channel (1 byte), the nanoseconds since the
//! record before (the first one's since 0; zigzag, seven bits in each byte), by how much more the device's clock has advanced than UTC
//! if the record has the device's time (likewise: one byte, most often), and what is particular to its kind.

use cantap_can::{BusErrorKind, ErrorState, Frame, Id, LossStage, TransmitFailure};

use crate::device_time::DeviceNs;
use crate::fd::FD_LENGTHS;
use crate::{Direction, FdFrame, LinFault, LinFrame, TraceEvent, TraceFrame, TraceRecord};

/// Kinds, in the lower four bits.
const DATA: u8 = 0;
const REMOTE: u8 = 1;
const BUS_ERROR: u8 = 2;
const SUPPRESSED: u8 = 3;
const STATE: u8 = 4;
const LOST: u8 = 5;
const TRANSMIT_FAILED: u8 = 6;
const DISTURBED: u8 = 7;
/// And the three after it: bit rate switched, sender passive.
const FD: u8 = 8;
const LIN: u8 = 12;
const FD_BRS: u8 = 1;
const FD_ESI: u8 = 2;
const KIND: u8 = 15;

/// Flags of frames, in the upper bits.
const EXTENDED: u8 = 1 << 4;
const SENT: u8 = 1 << 5;
const LATE: u8 = 1 << 6;
/// The checksum of a LIN frame is known.
const CHECKSUM: u8 = 1 << 4;
/// Error counters are known.
const COUNTERS: u8 = 1 << 4;
/// There may have been more losses.
const AT_LEAST: u8 = 1 << 4;
/// Of every kind: the device's time is known.
const DEVICE: u8 = 1 << 7;

/// The record before, as far as the next one is a difference to it.
#[derive(Clone, Copy, Default)]
struct Before {
    time_ns: i64,
    /// The device's time less UTC, of the last record that has both; wraps.
    ahead_ns: i64,
}

/// What was read is no record.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the records are damaged at byte {at} of {len}")]
pub struct Damaged {
    /// Where the record begins, counted from 0.
    pub at: usize,
    /// The number of bytes.
    pub len: usize,
}

/// Appends records to `out`.
pub fn write(records: &[TraceRecord], out: &mut Vec<u8>) {
    let mut before = Before::default();
    for record in records {
        write_one(record, &mut before, out);
    }
}

fn write_one(record: &TraceRecord, before: &mut Before, out: &mut Vec<u8>) {
    let mut begin = |out: &mut Vec<u8>, kind: u8| {
        out.extend([kind | flag(record.device_ns.is_some(), DEVICE), record.channel]);
        varint(zigzag(record.time_ns.wrapping_sub(before.time_ns)), out);
        before.time_ns = record.time_ns;
        if let Some(device_ns) = record.device_ns {
            let ahead_ns = device_ns.get().cast_signed().wrapping_sub(record.time_ns);
            varint(zigzag(ahead_ns.wrapping_sub(before.ahead_ns)), out);
            before.ahead_ns = ahead_ns;
        }
    };
    let counters = |at: Option<(u8, u8)>, out: &mut Vec<u8>| {
        out.extend(at.map(|(tec, rec)| [tec, rec]).into_iter().flatten());
    };
    match record.event {
        TraceEvent::Frame { frame, direction, late } => {
            let kind = match &frame {
                TraceFrame::Classic(frame) if frame.is_remote() => REMOTE,
                TraceFrame::Classic(_) => DATA,
                TraceFrame::Fd(frame) => FD | flag(frame.brs(), FD_BRS) | flag(frame.esi(), FD_ESI),
            };
            let id = frame.id();
            let flags =
                flag(id.is_extended(), EXTENDED) | flag(direction == Direction::Tx, SENT) | flag(late, LATE);
            begin(out, kind | flags);
            varint(id.raw().into(), out);
            out.push(frame.dlc());
            out.extend_from_slice(frame.data());
        }
        TraceEvent::BusError { kind, counters: at } => {
            begin(out, BUS_ERROR | flag(at.is_some(), COUNTERS));
            out.push(place(&BusErrorKind::ALL, kind));
            counters(at, out);
        }
        TraceEvent::ErrorsSuppressed { count } => {
            begin(out, SUPPRESSED);
            varint(count.into(), out);
        }
        TraceEvent::State { state, counters: at } => {
            begin(out, STATE | flag(at.is_some(), COUNTERS));
            out.push(place(&ErrorState::ALL, Some(state)));
            counters(at, out);
        }
        TraceEvent::Lost { stage, count, at_least } => {
            begin(out, LOST | flag(at_least, AT_LEAST));
            out.push(place(&LossStage::ALL, stage));
            varint(count.into(), out);
        }
        TraceEvent::TransmitFailed { tag, reason } => {
            begin(out, TRANSMIT_FAILED);
            varint(tag.into(), out);
            let (kind, periods) = match reason {
                TransmitFailure::Overtaken { periods } => {
                    (TransmitFailure::Overtaken { periods: 1 }, periods)
                }
                reason => (reason, 0),
            };
            out.push(place(&TransmitFailure::ALL, Some(kind)));
            varint(periods.into(), out);
        }
        TraceEvent::Disturbed { length_ns } => {
            begin(out, DISTURBED);
            varint(length_ns.into(), out);
        }
        TraceEvent::Lin { frame, direction } => {
            let sent = flag(direction == Direction::Tx, SENT);
            begin(out, LIN | sent | flag(frame.checksum.is_some(), CHECKSUM));
            out.extend([frame.id(), place(&LinFault::ALL, frame.fault), frame.data().len() as u8]);
            out.extend_from_slice(frame.data());
            out.extend(frame.checksum);
        }
    }
}

const fn flag(is: bool, bit: u8) -> u8 {
    if is { bit } else { 0 }
}

/// 0 for none, otherwise one more than where it stands.
fn place<T: PartialEq>(all: &[T], one: Option<T>) -> u8 {
    one.and_then(|one| all.iter().position(|of| *of == one)).map_or(0, |at| at as u8 + 1)
}

const fn zigzag(value: i64) -> u64 {
    ((value << 1) ^ (value >> 63)) as u64
}

fn varint(mut value: u64, out: &mut Vec<u8>) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// Hands the records of [`write()`] to `take`, those before a fault too.
///
/// # Errors
///
/// If the bytes are anything else.
pub fn read(bytes: &[u8], mut take: impl FnMut(&TraceRecord)) -> Result<(), Damaged> {
    let mut rest = Rest(bytes);
    let mut before = Before::default();
    while !rest.0.is_empty() {
        let at = bytes.len() - rest.0.len();
        let record = rest.record(&mut before).ok_or(Damaged { at, len: bytes.len() })?;
        take(&record);
    }
    Ok(())
}

/// What has not been read.
struct Rest<'a>(&'a [u8]);

impl<'a> Rest<'a> {
    fn byte(&mut self) -> Option<u8> {
        let (first, rest) = self.0.split_first()?;
        self.0 = rest;
        Some(*first)
    }

    fn bytes(&mut self, len: usize) -> Option<&'a [u8]> {
        let (bytes, rest) = self.0.split_at_checked(len)?;
        self.0 = rest;
        Some(bytes)
    }

    fn varint(&mut self) -> Option<u64> {
        let mut value = 0_u64;
        for shift in (0..64).step_by(7) {
            let byte = self.byte()?;
            let part = u64::from(byte & 0x7F);
            // The tenth byte has one bit.
            if shift == 63 && part > 1 {
                return None;
            }
            value |= part << shift;
            if byte & 0x80 == 0 {
                return Some(value);
            }
        }
        None
    }

    fn u32(&mut self) -> Option<u32> {
        u32::try_from(self.varint()?).ok()
    }

    /// One of these, or none.
    #[expect(clippy::option_option, reason = "bytes that are cut are not a value that is absent")]
    fn of<T: Copy>(&mut self, all: &[T]) -> Option<Option<T>> {
        match self.byte()? {
            0 => Some(None),
            at => all.get(usize::from(at) - 1).map(|one| Some(*one)),
        }
    }

    #[expect(clippy::option_option, reason = "bytes that are cut are not a value that is absent")]
    fn counters(&mut self, flags: u8) -> Option<Option<(u8, u8)>> {
        if flags & COUNTERS == 0 {
            return Some(None);
        }
        Some(Some((self.byte()?, self.byte()?)))
    }

    fn difference(&mut self) -> Option<i64> {
        let zigzag = self.varint()?;
        Some((zigzag >> 1) as i64 ^ -((zigzag & 1) as i64))
    }

    fn record(&mut self, before: &mut Before) -> Option<TraceRecord> {
        let first = self.byte()?;
        let channel = self.byte()?;
        let time_ns = before.time_ns.wrapping_add(self.difference()?);
        before.time_ns = time_ns;
        let device_ns = if first & DEVICE == 0 {
            None
        } else {
            before.ahead_ns = before.ahead_ns.wrapping_add(self.difference()?);
            Some(DeviceNs::new(time_ns.wrapping_add(before.ahead_ns).cast_unsigned())?)
        };
        let event = match first & KIND {
            LIN => self.lin(first)?,
            kind @ (DATA | REMOTE | FD..) => self.frame(kind, first)?,
            BUS_ERROR => {
                TraceEvent::BusError { kind: self.of(&BusErrorKind::ALL)?, counters: self.counters(first)? }
            }
            SUPPRESSED => TraceEvent::ErrorsSuppressed { count: self.u32()? },
            STATE => {
                TraceEvent::State { state: self.of(&ErrorState::ALL)??, counters: self.counters(first)? }
            }
            LOST => TraceEvent::Lost {
                stage: self.of(&LossStage::ALL)?,
                count: self.u32()?,
                at_least: first & AT_LEAST != 0,
            },
            TRANSMIT_FAILED => {
                let tag = self.u32()?;
                let reason = self.of(&TransmitFailure::ALL)??;
                let periods = self.u32()?;
                let reason = match reason {
                    TransmitFailure::Overtaken { .. } => TransmitFailure::Overtaken { periods },
                    reason => reason,
                };
                TraceEvent::TransmitFailed { tag, reason }
            }
            DISTURBED => TraceEvent::Disturbed { length_ns: self.u32()? },
        };
        Some(TraceRecord { time_ns, device_ns, channel, event })
    }

    fn lin(&mut self, flags: u8) -> Option<TraceEvent> {
        let (id, fault, len) = (self.byte()?, self.of(&LinFault::ALL)?, self.byte()?);
        let frame = LinFrame::new(id, self.bytes(len.into())?)?;
        let checksum = if flags & CHECKSUM == 0 { None } else { Some(self.byte()?) };
        let direction = if flags & SENT == 0 { Direction::Rx } else { Direction::Tx };
        Some(TraceEvent::Lin { frame: frame.with(checksum, fault), direction })
    }

    fn frame(&mut self, kind: u8, flags: u8) -> Option<TraceEvent> {
        let raw = self.u32()?;
        let id = if flags & EXTENDED == 0 { Id::standard(raw)? } else { Id::extended(raw)? };
        let dlc = self.byte().filter(|dlc| *dlc < 16)?;
        let frame: TraceFrame = if kind & FD == 0 {
            let len = if kind == REMOTE { 0 } else { usize::from(dlc).min(8) };
            let mut data = [0; 8];
            data[..len].copy_from_slice(self.bytes(len)?);
            Frame::from_bus(id, kind == REMOTE, dlc, data).into()
        } else {
            if kind & !(FD | FD_BRS | FD_ESI) != 0 {
                return None;
            }
            let data = self.bytes(usize::from(FD_LENGTHS[usize::from(dlc)]))?;
            FdFrame::new(id, kind & FD_BRS != 0, kind & FD_ESI != 0, data)?.into()
        };
        let direction = if flags & SENT == 0 { Direction::Rx } else { Direction::Tx };
        Some(TraceEvent::Frame { frame, direction, late: flags & LATE != 0 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{data_record, record_lin_or_can, with_device_time};
    use proptest::prelude::*;

    fn read_all(bytes: &[u8]) -> (Vec<TraceRecord>, Result<(), Damaged>) {
        let mut records = Vec::new();
        let outcome = read(bytes, |record| records.push(*record));
        (records, outcome)
    }

    proptest! {
        #[test]
        fn records_come_out_as_they_went_in(records in prop::collection::vec(with_device_time(record_lin_or_can(1)), 0..40)) {
            let mut bytes = Vec::new();
            write(&records, &mut bytes);
            prop_assert_eq!(read_all(&bytes), (records, Ok(())));
        }

        #[test]
        fn what_is_before_a_cut_is_read_and_the_cut_is_reported(
            records in prop::collection::vec(with_device_time(record_lin_or_can(1)), 1..10),
            cut in any::<prop::sample::Index>(),
        ) {
            let mut bytes = Vec::new();
            write(&records, &mut bytes);
            bytes.truncate(cut.index(bytes.len()));
            let (found, outcome) = read_all(&bytes);
            prop_assert_eq!(&found[..], &records[..found.len()]);
            let mut whole = Vec::new();
            write(&found, &mut whole);
            prop_assert_eq!(outcome.is_ok(), whole.len() == bytes.len());
        }

        #[test]
        fn any_bytes_are_records_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let (records, _) = read_all(&bytes);
            prop_assert!(records.len() <= bytes.len());
        }
    }

    #[test]
    fn a_frame_of_eight_bytes_takes_about_sixteen() {
        let records: Vec<_> =
            (0..100).map(|n| data_record(1_800_000_000_000_000_000 + n * 250_000)).collect();
        let mut bytes = Vec::new();
        write(&records, &mut bytes);
        // Of four data bytes: kind, channel, three of time, two of the identifier, the length.
        assert_eq!(bytes.len(), 12 * 100 + 6);
        // And one for a device's clock that is 400 ppm fast.
        let with_device: Vec<_> = (1..)
            .zip(&records)
            .map(|(n, record)| TraceRecord { device_ns: DeviceNs::new(n * 250_100), ..*record })
            .collect();
        bytes.clear();
        write(&with_device, &mut bytes);
        assert!((13 * 100..=15 * 100).contains(&bytes.len()), "{}", bytes.len());
        assert_eq!(read_all(&bytes), (with_device, Ok(())));
    }

    #[test]
    fn damage_is_reported_where_its_record_begins() {
        let records = [data_record(0), data_record(1_000)];
        let mut bytes = Vec::new();
        write(&records, &mut bytes);
        let mut first = Vec::new();
        write(&records[..1], &mut first);
        let cut = &bytes[..bytes.len() - 1];
        assert_eq!(read_all(cut), (records[..1].to_vec(), Err(Damaged { at: first.len(), len: cut.len() })));
    }

    #[test]
    fn a_number_of_more_than_64_bits_and_a_dlc_of_more_than_four_are_refused() {
        // Kind, channel, the time in ten bytes, the identifier, the DLC.
        let frame = |tenth, dlc| read_all(&[&[DATA, 1], &[0xFF; 9][..], &[tenth], &[0x23, dlc]].concat());
        assert!(frame(1, 0).1.is_ok() && frame(2, 0).1.is_err());
        let times = |tenth| frame(tenth, 0).0.iter().map(|record| record.time_ns).collect::<Vec<_>>();
        assert_eq!((times(1), times(0)), (vec![i64::MIN], vec![-(1 << 62)]));
        let eight = |dlc| read_all(&[&[DATA, 1, 0, 0x23, dlc], &[7; 8][..]].concat());
        assert!(eight(15).1.is_ok() && eight(16).1.is_err());
    }
}
