//! Tightens late stamps.
//!
//! A device's stamp is never early, only late: by the interrupt's latency, or, for a frame found queued
//! behind another, by up to a whole frame, in which case it is flagged. But two frames never overlap: frame k
//! ended no later than the end of frame k+1 on the same channel minus the exact length of frame k+1.

use cantap_trace::BusBits;
use cantap_wire::CHANNELS;

use super::clock::Ticks;
use crate::{Direction, TraceEvent};

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
    /// The same for the bits of CAN FD's data phases; 0 if it is not known.
    fixed_data: [u64; CHANNELS],
    /// Sent frames are stamped when the device accepts them, which may be long before they are on the bus.
    sent_are_early: bool,
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

    /// Sets the bit rate of a channel's data phases, in bit/s; `None` if it is not known. `tick_hz`: of the stamps.
    pub fn set_data(&mut self, channel: usize, bitrate_bps: Option<u32>, tick_hz: u32) {
        let of = |bitrate_bps: u32| (u64::from(tick_hz) << FRACTION_BITS) / u64::from(bitrate_bps.max(1));
        self.fixed_data[channel] = bitrate_bps.map_or(0, of);
    }

    /// Leaves sent frames out: their stamps are not those of the bus, and bound no others.
    pub fn leave_out_sent(&mut self) {
        self.sent_are_early = true;
    }

    /// How long a frame takes, in ticks, if that is known.
    #[inline]
    fn ticks(&self, channel: usize, bits: BusBits) -> Option<i64> {
        if bits.data > 0 && self.fixed_data[channel] == 0 {
            return None;
        }
        let nominal = self.fixed[channel] * u64::from(bits.nominal);
        let data = self.fixed_data[channel] * u64::from(bits.data);
        Some(((nominal + data) >> FRACTION_BITS) as i64)
    }
}

/// Tightens records in stream order. A record after a loss still bounds the one before it, since even more
/// lay between them. Through an FD frame whose length is not known, because it switches to an unknown bit rate, nothing is tightened.
pub fn tighten(records: &mut [Stamped], lengths: &BitLengths) {
    let mut limits = [None; CHANNELS];
    for record in records.iter_mut().rev() {
        let TraceEvent::Frame { frame, direction, .. } = &record.event else { continue };
        let channel = usize::from(record.channel == 2);
        if lengths.fixed[channel] == 0 || lengths.sent_are_early && *direction == Direction::Tx {
            continue;
        }
        let limit = limits[channel].filter(|limit| record.at.since(*limit) > 0);
        record.at = limit.unwrap_or(record.at);
        limits[channel] = lengths.ticks(channel, frame.bus_bits()).map(|ticks| record.at.plus(-ticks));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn fd_frames_tighten_by_both_of_their_bit_rates_and_not_at_all_if_one_is_unknown() {
        let fd = |ticks, text: &str| {
            let event =
                TraceEvent::Frame { frame: text.parse().unwrap(), direction: Direction::Rx, late: true };
            Stamped { at: Ticks(ticks), channel: 1, event }
        };
        let mut lengths = BitLengths::default();
        lengths.set(0, 72, 36_000_000, 12_000_000);
        let times = |lengths: &BitLengths, text: &str| {
            let mut records = vec![record(1, 100_000, true), fd(100_000, text), record(1, 100_000, false)];
            tighten(&mut records, lengths);
            records.iter().map(|record| record.at.0).collect::<Vec<_>>()
        };
        // A classical frame is 58 bits of 24 ticks.
        let second = 100_000 - 58 * 24;
        let plain: crate::TraceFrame = "123##0112233445566778899AABBCC".parse().unwrap();
        let length = u64::from(plain.bus_bits().nominal) * 24;
        assert_eq!(times(&lengths, "123##0112233445566778899AABBCC"), [second - length, second, 100_000]);
        let switched = "123##1112233445566778899AABBCC";
        assert_eq!(times(&lengths, switched), [100_000, second, 100_000]);
        lengths.set_data(0, Some(2_000_000), 12_000_000);
        let bits = switched.parse::<crate::TraceFrame>().unwrap().bus_bits();
        let length = u64::from(bits.nominal) * 24 + u64::from(bits.data) * 6;
        assert_eq!(times(&lengths, switched), [second - length, second, 100_000]);
        lengths.set_data(0, None, 12_000_000);
        assert_eq!(times(&lengths, switched), [100_000, second, 100_000]);
    }

    /// Another maker's adapter says when it accepted a frame. What was received just before was not on the bus earlier for that.
    #[test]
    fn a_sent_frame_that_is_stamped_before_it_is_on_the_bus_bounds_nothing() {
        let mut lengths = BitLengths::default();
        lengths.set(0, 36, 36_000_000, 12_000_000);
        lengths.leave_out_sent();
        let mut sent = record(1, 10_100, false);
        let TraceEvent::Frame { direction, .. } = &mut sent.event else { panic!() };
        *direction = Direction::Tx;
        let mut records = vec![record(1, 10_000, false), sent, record(1, 10_650, false)];
        tighten(&mut records, &lengths);
        let times: Vec<u64> = records.iter().map(|record| record.at.0).collect();
        assert_eq!(times, [9954, 10_100, 10_650], "58 bits of 12 ticks before the next that was received");
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
