//! Tightens late stamps.
//!
//! A device's stamp is never early, only late: by the interrupt's latency, or, for a frame found queued
//! behind another, by up to a whole frame, in which case it is flagged. But two frames never overlap: frame k
//! ended no later than the end of frame k+1 on the same channel minus the exact length of frame k+1.

use cantap_wire::CHANNELS;

use super::clock::Ticks;
use crate::TraceEvent;

/// A record as it came from the device, by the device's own clock.
#[derive(Clone, Debug, PartialEq)]
pub struct Stamped {
    /// The time.
    pub at: Ticks,
    /// The channel: 1 or 2.
    pub channel: u8,
    /// What happened.
    pub event: TraceEvent,
}

/// A bit's length on each channel, while it is open.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BitLengths {
    /// In ticks, as a fixed-point number with [`FRACTION_BITS`] fractional bits; 0 while closed.
    fixed: [u64; CHANNELS],
}

/// Fractional bits of a bit's length in ticks.
const FRACTION_BITS: u32 = 20;

impl BitLengths {
    /// Sets a channel's bit rate: `clock_hz` of the controller over `clocks_per_bit`, in ticks of `tick_hz`.
    pub fn set(&mut self, channel: usize, clocks_per_bit: u32, clock_hz: u32, tick_hz: u32) {
        let scaled = (u128::from(clocks_per_bit) * u128::from(tick_hz)) << FRACTION_BITS;
        self.fixed[channel] = (scaled / u128::from(clock_hz.max(1))) as u64;
    }

    /// Forgets a channel's bit rate: its stamps stay as they are.
    pub fn clear(&mut self, channel: usize) {
        self.fixed[channel] = 0;
    }

    #[inline]
    fn ticks(&self, channel: usize, bits: u32) -> i64 {
        ((self.fixed[channel] * u64::from(bits)) >> FRACTION_BITS) as i64
    }
}

/// Tightens records in stream order. A record after a loss still bounds the one before it, since even more
/// lay between them.
pub fn tighten(records: &mut [Stamped], lengths: &BitLengths) {
    let mut limits = [None; CHANNELS];
    for record in records.iter_mut().rev() {
        let TraceEvent::Frame { frame, .. } = &record.event else { continue };
        let channel = usize::from(record.channel == 2);
        if lengths.fixed[channel] == 0 {
            continue;
        }
        let limit = limits[channel].filter(|limit| record.at.since(*limit) > 0);
        record.at = limit.unwrap_or(record.at);
        limits[channel] = Some(record.at.plus(-lengths.ticks(channel, frame.bus_bits().total())));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Direction;

    fn record(channel: u8, ticks: u64, late: bool) -> Stamped {
        let frame = "000#55".parse().unwrap();
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late };
        Stamped { at: Ticks(ticks), channel, event }
    }

    #[test]
    fn frames_that_waited_in_the_fifo_move_back_by_exact_lengths() {
        let mut lengths = BitLengths::default();
        // 36 clocks of 36 MHz: 1 Mbit/s, 12 ticks of 12 MHz per bit; a frame is 58 bits, 696 ticks.
        lengths.set(0, 36, 36_000_000, 12_000_000);
        let mut records = vec![
            record(1, 10_000, true),
            record(2, 10_001, true),
            record(1, 10_000, true),
            record(1, 10_000, true),
            record(1, 10_600, false),
        ];
        tighten(&mut records, &lengths);
        let times: Vec<u64> = records.iter().map(|record| record.at.0).collect();
        // Channel 2 has no known bit rate and stays unchanged.
        assert_eq!(times, [8512, 10_001, 9208, 9904, 10_600]);
    }

    #[test]
    fn a_stamp_that_is_early_enough_stays() {
        let mut lengths = BitLengths::default();
        lengths.set(0, 36, 36_000_000, 12_000_000);
        let mut records = vec![record(1, 1000, true), record(1, 9000, false)];
        tighten(&mut records, &lengths);
        assert_eq!(records[0].at, Ticks(1000));
    }
}
