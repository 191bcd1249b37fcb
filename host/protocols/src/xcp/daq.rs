//! What data packets (DTOs) contain, by the lists that a master has set up.

use crate::Field;
use crate::calibration::lists::{List, ListEntry, Lists};
use crate::calibration::parts::ByteOrder;

/// Bits of a list's mode.
const STIM: u8 = 0x02;
const TIME_STAMP: u8 = 0x10;
const NO_PID: u8 = 0x20;

/// How the packets of a slave are made, as far as it was heard.
#[derive(Clone, Debug, Default)]
pub struct PacketLayout {
    /// The identification field's type (bits 6 and 7 of DAQ_KEY_BYTE).
    identification: Option<u8>,
    /// The highest bit of a packet identifier says that data were lost.
    has_overload_bit: bool,
    clock: Option<Clock>,
}

/// The slave's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Clock {
    /// Bytes of a stamp: 0, 1, 2 or 4.
    pub size: usize,
    /// Every list has stamps, whatever its mode.
    pub is_fixed: bool,
    /// Nanoseconds of a tick.
    pub tick_ns: f64,
}

impl Clock {
    /// By TIMESTAMP_MODE and TIMESTAMP_TICKS of GET_DAQ_RESOLUTION_INFO.
    pub fn new(mode: u8, ticks: u16) -> Option<Self> {
        let unit_ns = match mode >> 4 {
            exponent @ 0..=9 => 10_f64.powi(exponent.into()),
            exponent @ 10..=12 => 10_f64.powi(i32::from(exponent) - 13),
            _ => return None,
        };
        let size = match mode & 7 {
            size @ (0 | 1 | 2 | 4) => usize::from(size),
            _ => return None,
        };
        Some(Self { size, is_fixed: mode & 8 != 0, tick_ns: unit_ns * f64::from(ticks) })
    }
}

/// A packet, taken apart.
#[derive(Debug, PartialEq)]
pub struct Packet<'a> {
    /// The list, and which of its packets it is.
    pub daq: u16,
    /// See [`Self::daq`].
    pub odt: u8,
    /// The slave has lost data before it.
    pub has_overload: bool,
    /// The stamp's bytes.
    pub stamp: Option<&'a [u8]>,
    /// What it contains.
    pub entries: Vec<(ListEntry, &'a [u8])>,
}

impl PacketLayout {
    /// From the response to GET_DAQ_PROCESSOR_INFO, without its first byte.
    pub fn take_processor_info(&mut self, info: &[u8]) {
        if let &[properties, _, _, _, _, _, key, ..] = info {
            self.identification = Some(key >> 6);
            self.has_overload_bit = properties >> 6 == 1;
        }
    }

    /// From the response to GET_DAQ_RESOLUTION_INFO, without its first byte.
    pub fn take_resolution_info(&mut self, info: &[u8], order: ByteOrder) {
        if let [_, _, _, _, mode, ticks @ ..] = info
            && ticks.len() >= 2
        {
            self.clock = Clock::new(*mode, order.number(&ticks[..2]) as u16);
        }
    }

    /// The field for a stamp.
    pub fn stamp_field(&self, stamp: &[u8], order: ByteOrder) -> Field {
        let ticks = order.number(stamp);
        match self.clock {
            Some(clock) => Field::real("stamp", ticks as f64 * clock.tick_ns / 1e3, "us"),
            None => Field::number("stamp_ticks", ticks as i64),
        }
    }

    /// Takes a packet apart, if it is one of a list that is known whole.
    ///
    /// # Errors
    ///
    /// Why it stays bytes.
    pub fn read<'a>(
        &self,
        data: &'a [u8],
        lists: &Lists,
        order: ByteOrder,
    ) -> Result<Packet<'a>, &'static str> {
        const UNKNOWN: &str = "not heard set up";
        let mut pid = *data.first().ok_or("empty")?;
        let has_overload = self.has_overload_bit && pid & 0x80 != 0;
        if self.has_overload_bit {
            pid &= 0x7F;
        }
        // Nearly all slaves on CAN identify by one byte; where it was not heard, lengths must prove it.
        let (daq, odt, list, head): (u16, u8, &List, usize) = match self.identification.unwrap_or(0) {
            0 => lists.of_pid(pid).map(|(daq, odt, list)| (daq, odt, list, 1)).ok_or(UNKNOWN)?,
            kind => {
                let (at, size) = [(1, 1), (1, 2), (2, 2)][usize::from(kind) - 1];
                let bytes = data.get(at..at + size).ok_or("too short for its list's number")?;
                let daq = order.number(bytes) as u16;
                (daq, pid, lists.get(daq).ok_or(UNKNOWN)?, at + size)
            }
        };
        let mode = list.mode.ok_or(UNKNOWN)?;
        if mode & NO_PID != 0 {
            return Err("its list has no packet identifiers");
        }
        if mode & STIM != 0 {
            return Err("its list is for stimulation");
        }
        let packet = list.packet(odt).ok_or(UNKNOWN)?;
        let used: usize = packet.iter().flatten().map(|entry| entry.size).sum();
        let has_stamp =
            odt == 0 && (mode & TIME_STAMP != 0 || self.clock.is_some_and(|clock| clock.is_fixed));
        let stamp_size = match (has_stamp, self.clock) {
            (false, _) => 0,
            (true, Some(clock)) => clock.size,
            (true, None) => match data.len().checked_sub(head + used) {
                Some(size @ (1 | 2 | 4)) => size,
                _ => return Err("the size of its stamp was not heard"),
            },
        };
        let length = head + stamp_size + used;
        // A slave may fill its frames up.
        if data.len() != length && (data.len() < length || data.len() < 8) {
            return Err("not as long as its list");
        }
        let (stamp, mut rest) = data[head..].split_at(stamp_size);
        let entries = packet.iter().flatten().map(|entry| {
            let (bytes, after) = rest.split_at(entry.size);
            rest = after;
            (*entry, bytes)
        });
        let entries = entries.collect();
        Ok(Packet { daq, odt, has_overload, stamp: has_stamp.then_some(stamp), entries })
    }
}
