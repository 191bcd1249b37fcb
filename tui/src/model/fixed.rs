//! One row per identifier: its last frame, its period, and which of its bits change.

use std::collections::HashMap;

use cantap_trace::fd::FD_MAX_BYTES;
use cantap_trace::{DeviceNs, Moment};

use cantap::{Direction, Id, TraceEvent, TraceFrame, TraceRecord};

/// Limit for rows; the frames of further identifiers are counted together.
const MOST_ROWS: usize = 8192;
/// The weight of a new interval in the smoothed period and jitter is one divided by this.
const SMOOTHING: f64 = 8.0;

/// One identifier on one channel.
#[derive(Clone, Debug)]
pub struct Row {
    /// The channel, from 1.
    pub channel: u8,
    /// Its last frame.
    pub frame: TraceFrame,
    /// Whether we sent it.
    pub direction: Direction,
    /// Frames so far.
    pub count: u64,
    /// When the last one ended.
    pub last_ns: i64,
    /// The same by the device's clock.
    last_device_ns: Option<DeviceNs>,
    /// The smoothed interval, in nanoseconds.
    pub period_ns: Option<f64>,
    /// The smoothed deviation of intervals from that, in nanoseconds.
    pub jitter_ns: f64,
    /// When each hexadecimal digit last changed, starting with the upper digit of the first byte.
    pub changed_ns: Box<[i64; 2 * FD_MAX_BYTES]>,
    /// How often each bit changed, starting with the highest bit of the first byte.
    pub heat: Box<[u32; 8 * FD_MAX_BYTES]>,
    /// Bits whose changes are suppressed, by byte.
    pub notched: [u8; FD_MAX_BYTES],
    /// Bits that have changed since the comparison began, without those suppressed, by byte.
    pub changed_since: [u8; FD_MAX_BYTES],
    /// Its first frame came after the comparison began.
    pub is_new: bool,
    /// Its length has changed, or whether it is remote, since the comparison began.
    pub length_changed: bool,
    /// Whether it is hidden.
    pub hidden: bool,
    /// Number of its marking colour; 0 for none.
    pub mark: u8,
    /// Frames were lost since the previous one: the interval is meaningless.
    gap: bool,
}

impl Row {
    fn new(record: &TraceRecord, frame: TraceFrame, direction: Direction) -> Self {
        Self {
            channel: record.channel,
            frame,
            direction,
            count: 0,
            last_ns: record.time_ns,
            last_device_ns: record.device_ns,
            period_ns: None,
            jitter_ns: 0.0,
            changed_ns: Box::new([i64::MIN; 2 * FD_MAX_BYTES]),
            heat: Box::new([0; 8 * FD_MAX_BYTES]),
            notched: [0; FD_MAX_BYTES],
            changed_since: [0; FD_MAX_BYTES],
            is_new: false,
            length_changed: false,
            hidden: false,
            mark: 0,
            gap: false,
        }
    }

    fn take(&mut self, at: Moment, frame: TraceFrame, direction: Direction) {
        let time_ns = at.time_ns;
        // If the clock was set back, as where a file starts again, the interval is meaningless, too.
        if self.count > 0 && !self.gap && time_ns >= self.last_ns {
            let last = Moment { time_ns: self.last_ns, device_ns: self.last_device_ns };
            let interval = at.since_ns(last) as f64;
            match &mut self.period_ns {
                Some(period) => {
                    let deviation = (interval - *period).abs();
                    self.jitter_ns += (deviation - self.jitter_ns) / SMOOTHING;
                    *period += (interval - *period) / SMOOTHING;
                }
                period => *period = Some(interval),
            }
        }
        if self.count > 0 {
            let length = |frame: &TraceFrame| (frame.dlc(), frame.is_remote());
            self.length_changed |= length(&self.frame) != length(&frame);
            for at in 0..self.frame.data_len().max(frame.data_len()) {
                let byte = |frame: &TraceFrame| frame.data().get(at).copied().unwrap_or(0);
                self.byte_changed(at, byte(&self.frame) ^ byte(&frame), time_ns);
            }
        }
        self.count += 1;
        self.gap = false;
        self.last_ns = time_ns;
        self.last_device_ns = at.device_ns;
        self.frame = frame;
        self.direction = direction;
    }

    /// These bits of the byte at `at` have changed.
    fn byte_changed(&mut self, at: usize, mut bits: u8, time_ns: i64) {
        while bits != 0 {
            let bit = bits.leading_zeros() as usize;
            let place = 8 * at + bit;
            self.heat[place] = self.heat[place].saturating_add(1);
            // Suppressed changes do not deserve attention.
            if self.notched[at] >> (7 - bit) & 1 == 0 {
                self.changed_ns[place / 4] = time_ns;
                self.changed_since[at] |= 1 << (7 - bit);
            }
            bits &= !(1 << (7 - bit));
        }
    }

    /// Its last frame as a record.
    pub fn last(&self) -> TraceRecord {
        let event = TraceEvent::Frame { frame: self.frame, direction: self.direction, late: false };
        let (time_ns, device_ns) = (self.last_ns, self.last_device_ns);
        TraceRecord { time_ns, device_ns, channel: self.channel, event }
    }

    /// Suppresses changes of all bits that have changed so far.
    fn notch(&mut self) {
        self.changed_ns.fill(i64::MIN);
        for (bit, count) in self.heat.iter().enumerate() {
            if *count > 0 {
                self.notched[bit / 8] |= 1 << (7 - bit % 8);
            }
        }
        for (changed, notched) in self.changed_since.iter_mut().zip(&self.notched) {
            *changed &= !notched;
        }
    }

    /// Whether it is new, or its length or any of its bits has changed, since the comparison began.
    pub fn has_changed(&self) -> bool {
        self.is_new || self.length_changed || self.changed_since.iter().any(|bits| *bits != 0)
    }

    /// Whether a hexadecimal digit has changed since the comparison began, counted as in [`Self::changed_ns`].
    pub const fn has_digit_changed(&self, digit: usize) -> bool {
        let bits = if digit.is_multiple_of(2) { 0xF0 } else { 0x0F };
        self.is_new || self.changed_since[digit / 2] & bits != 0
    }
}

/// All rows, in order of appearance.
#[derive(Clone, Debug, Default)]
pub struct FixedTable {
    rows: Vec<Row>,
    places: HashMap<(u8, Id), usize>,
    /// Frames of identifiers for which there was no room.
    pub unlisted: u64,
    /// When the comparison began, if there is one: only what has changed since then is shown.
    pub compared_since_ns: Option<i64>,
}

impl FixedTable {
    /// Takes a record.
    pub fn take(&mut self, record: &TraceRecord) {
        match record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                let key = (record.channel, frame.id());
                let place = match self.places.get(&key) {
                    Some(place) => *place,
                    None if self.rows.len() < MOST_ROWS => {
                        let is_new = self.compared_since_ns.is_some();
                        self.rows.push(Row { is_new, ..Row::new(record, frame, direction) });
                        self.places.insert(key, self.rows.len() - 1);
                        self.rows.len() - 1
                    }
                    None => {
                        self.unlisted += 1;
                        return;
                    }
                };
                self.rows[place].take(record.moment(), frame, direction);
            }
            TraceEvent::Lost { .. } => {
                let of_channel = self.rows.iter_mut().filter(|row| row.channel == record.channel);
                of_channel.for_each(|row| row.gap = true);
            }
            _ => {}
        }
    }

    /// Nothing is known about the time until the next frames: the intervals are meaningless.
    pub fn interrupt(&mut self) {
        self.rows.iter_mut().for_each(|row| row.gap = true);
    }

    /// The rows.
    pub fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// One row.
    pub fn row(&self, channel: u8, id: Id) -> Option<&Row> {
        self.places.get(&(channel, id)).map(|place| &self.rows[*place])
    }

    /// One row, to mark or hide it.
    pub fn row_mut(&mut self, channel: u8, id: Id) -> Option<&mut Row> {
        self.places.get(&(channel, id)).map(|place| &mut self.rows[*place])
    }

    /// Begins to compare with the frames as they are now, at this time, or stops comparing.
    pub fn compare_since(&mut self, since_ns: Option<i64>) {
        self.compared_since_ns = since_ns;
        for row in &mut self.rows {
            row.changed_since = [0; FD_MAX_BYTES];
            (row.is_new, row.length_changed) = (false, false);
        }
    }

    /// The number of bits whose changes are suppressed.
    pub fn notched_bits(&self) -> u32 {
        self.rows.iter().flat_map(|row| row.notched).map(u8::count_ones).sum()
    }

    /// Suppresses changes of all bits that have changed so far: those that change anyway.
    pub fn notch(&mut self) {
        self.rows.iter_mut().for_each(Row::notch);
    }

    /// Shows all changes again.
    pub fn unnotch(&mut self) {
        self.rows.iter_mut().for_each(|row| row.notched = [0; FD_MAX_BYTES]);
    }

    /// Shows all rows again.
    pub fn unhide(&mut self) {
        self.rows.iter_mut().for_each(|row| row.hidden = false);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn take(table: &mut FixedTable, time_ms: i64, text: &str) {
        let frame = text.parse().unwrap();
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        table.take(&TraceRecord { time_ns: time_ms * 1_000_000, device_ns: None, channel: 1, event });
    }

    #[test]
    fn the_last_byte_of_an_fd_frame_is_watched_too() {
        let mut table = FixedTable::default();
        for (time, last) in [(0, "10"), (10, "11")] {
            take(&mut table, time, &format!("123##1{}{last}", "00".repeat(63)));
        }
        assert_eq!(table.rows()[0].heat[511], 1);
        assert_eq!(table.rows()[0].changed_ns[127], 10_000_000);
    }

    #[test]
    fn changed_bits_are_found_counted_and_can_be_notched() {
        let mut table = FixedTable::default();
        for (time, text) in [(0, "123#0011"), (10, "123#0110"), (20, "123#0110")] {
            take(&mut table, time, text);
        }
        let row = &table.rows()[0];
        assert_eq!(row.count, 3);
        assert_eq!((row.heat[7], row.heat[15]), (1, 1));
        let ns = |ms: i64| if ms < 0 { i64::MIN } else { ms * 1_000_000 };
        // Digit by digit: 00 11, then 01 10.
        assert_eq!(row.changed_ns[..5], [-1, 10, -1, 10, -1].map(ns));
        table.notch();
        assert_eq!(table.rows()[0].changed_ns[1], ns(-1));
        take(&mut table, 30, "123#8011");
        assert_eq!(table.rows()[0].changed_ns[..4], [30, -1, -1, -1].map(ns));
        table.unnotch();
        take(&mut table, 40, "123#8110");
        assert_eq!(table.rows()[0].changed_ns[..4], [30, 40, -1, 40].map(ns));
    }

    #[test]
    fn a_comparison_has_what_changed_since_it_began_and_nothing_of_before() {
        let mut table = FixedTable::default();
        for (time, text) in [(0, "123#0011"), (10, "123#0110"), (10, "124#00")] {
            take(&mut table, time, text);
        }
        table.compare_since(Some(10_000_000));
        assert!(table.rows().iter().all(|row| !row.has_changed()));
        // Also what is as before again has changed.
        for text in ["123#0210", "123#0110", "125#00"] {
            take(&mut table, 20, text);
        }
        let different = |table: &FixedTable| table.rows().iter().map(Row::has_changed).collect::<Vec<_>>();
        assert_eq!(different(&table), [true, false, true]);
        let row = &table.rows()[0];
        assert_eq!(
            (0..4).map(|digit| row.has_digit_changed(digit)).collect::<Vec<_>>(),
            [false, true, false, false]
        );
        assert!(table.rows()[2].is_new);
        // What is suppressed is no difference, and does not become one.
        table.notch();
        take(&mut table, 30, "123#0210");
        assert_eq!(different(&table), [false, false, true]);
        assert_eq!(table.notched_bits(), 3);
        take(&mut table, 40, "123#8210");
        assert_eq!(different(&table), [true, false, true]);
        table.compare_since(None);
        assert_eq!((table.compared_since_ns, different(&table)), (None, vec![false; 3]));
        // A byte more is a difference, even if it is zero.
        table.compare_since(Some(50_000_000));
        take(&mut table, 60, "124#0000");
        assert_eq!(different(&table), [false, true, false]);
    }

    #[test]
    fn the_period_settles_and_leaves_out_what_spans_a_loss() {
        let mut table = FixedTable::default();
        for n in 0..50 {
            take(&mut table, n * 10, "123#");
        }
        table.take(&TraceRecord {
            time_ns: 0,
            device_ns: None,
            channel: 1,
            event: TraceEvent::Lost { stage: None, count: 1, at_least: false },
        });
        take(&mut table, 5000, "123#");
        let row = &table.rows()[0];
        assert_eq!(row.period_ns, Some(10e6));
        assert!(row.jitter_ns < 1.0);
    }

    /// UTC is corrected while a trace is recorded; a crystal that is 400 ppm fast is not.
    #[test]
    fn the_period_is_the_devices() {
        let mut table = FixedTable::default();
        for n in 0..50_i64 {
            let corrected = if n % 2 == 0 { 0 } else { 10_000 };
            let event =
                TraceEvent::Frame { frame: "123#".parse().unwrap(), direction: Direction::Rx, late: false };
            table.take(&TraceRecord {
                time_ns: n * 100_000_000 + corrected,
                device_ns: DeviceNs::new(7 + n as u64 * 100_040_000),
                channel: 1,
                event,
            });
        }
        let row = &table.rows()[0];
        assert_eq!((row.period_ns, row.jitter_ns), (Some(100_040_000.0), 0.0));
    }

    #[test]
    fn identifiers_without_room_are_counted() {
        let mut table = FixedTable::default();
        for raw in 0..MOST_ROWS + 5 {
            take(&mut table, 0, &format!("{raw:08X}#"));
        }
        assert_eq!((table.rows().len(), table.unlisted), (MOST_ROWS, 5));
    }
}
