//! One row per identifier: its last frame, how often it comes, and which of its bits change.

use std::collections::HashMap;

use cantap::{Direction, Frame, Id, TraceEvent, TraceRecord};

/// Rows there may be; the frames of further identifiers are counted together.
const MOST_ROWS: usize = 8192;
/// Share of a new interval in the smoothed period and jitter: one in so many.
const SMOOTHING: f64 = 8.0;

/// One identifier on one channel.
#[derive(Clone, Debug)]
pub struct Row {
    /// The channel, from 1.
    pub channel: u8,
    /// Its last frame.
    pub frame: Frame,
    /// Whether that was sent by us.
    pub direction: Direction,
    /// Frames so far.
    pub count: u64,
    /// When the last one ended.
    pub last_ns: i64,
    /// The last intervals, smoothed, in nanoseconds.
    pub period_ns: Option<f64>,
    /// How far intervals are from that, smoothed, in nanoseconds.
    pub jitter_ns: f64,
    /// Bits in which the last frame differs from the one before; the first byte is on top.
    pub changed: u64,
    /// When each hexadecimal digit last changed; the first byte's upper one is the first.
    pub changed_ns: [i64; 16],
    /// How often each bit changed; the first byte's highest bit is the first.
    pub heat: Box<[u32; 64]>,
    /// Bits whose changes are not shown.
    pub notched: u64,
    /// Not to be shown.
    pub hidden: bool,
    /// Number of the colour it is marked with; 0 is none.
    pub mark: u8,
    /// Frames were lost since the one before: the interval says nothing.
    gap: bool,
}

impl Row {
    fn new(record: &TraceRecord, frame: Frame, direction: Direction) -> Self {
        Self {
            channel: record.channel,
            frame,
            direction,
            count: 0,
            last_ns: record.time_ns,
            period_ns: None,
            jitter_ns: 0.0,
            changed: 0,
            changed_ns: [i64::MIN; 16],
            heat: Box::new([0; 64]),
            notched: 0,
            hidden: false,
            mark: 0,
            gap: false,
        }
    }

    fn take(&mut self, time_ns: i64, frame: Frame, direction: Direction) {
        // A clock that was set back, as where a file begins anew, says nothing either.
        if self.count > 0 && !self.gap && time_ns >= self.last_ns {
            let interval = time_ns.saturating_sub(self.last_ns) as f64;
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
            self.changed =
                u64::from_be_bytes(self.frame.padded_data()) ^ u64::from_be_bytes(frame.padded_data());
            let mut bits = self.changed;
            while bits != 0 {
                let bit = bits.leading_zeros() as usize;
                self.heat[bit] = self.heat[bit].saturating_add(1);
                // What is notched is not worth a glance.
                if self.notched >> (63 - bit) & 1 == 0 {
                    self.changed_ns[bit / 4] = time_ns;
                }
                bits &= !(1 << (63 - bit));
            }
        }
        self.count += 1;
        self.gap = false;
        self.last_ns = time_ns;
        self.frame = frame;
        self.direction = direction;
    }

    /// Its last frame as a record.
    pub fn last(&self) -> TraceRecord {
        let event = TraceEvent::Frame { frame: self.frame, direction: self.direction, late: false };
        TraceRecord { time_ns: self.last_ns, channel: self.channel, event }
    }

    /// Hides changes of all bits that changed so far.
    fn notch(&mut self) {
        self.changed_ns = [i64::MIN; 16];
        for (bit, count) in self.heat.iter().enumerate() {
            if *count > 0 {
                self.notched |= 1 << (63 - bit);
            }
        }
    }
}

/// All rows, in order of appearance.
#[derive(Clone, Debug, Default)]
pub struct FixedTable {
    rows: Vec<Row>,
    places: HashMap<(u8, Id), usize>,
    /// Frames of identifiers that found no room.
    pub unlisted: u64,
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
                        self.rows.push(Row::new(record, frame, direction));
                        self.places.insert(key, self.rows.len() - 1);
                        self.rows.len() - 1
                    }
                    None => {
                        self.unlisted += 1;
                        return;
                    }
                };
                self.rows[place].take(record.time_ns, frame, direction);
            }
            TraceEvent::Lost { .. } => {
                let of_channel = self.rows.iter_mut().filter(|row| row.channel == record.channel);
                of_channel.for_each(|row| row.gap = true);
            }
            _ => {}
        }
    }

    /// Nothing is known about the time from here to the next frames: the intervals say nothing.
    pub fn interrupt(&mut self) {
        self.rows.iter_mut().for_each(|row| row.gap = true);
    }

    /// The rows.
    pub fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// One row, to mark or hide it.
    pub fn row_mut(&mut self, channel: u8, id: Id) -> Option<&mut Row> {
        self.places.get(&(channel, id)).map(|place| &mut self.rows[*place])
    }

    /// Hides changes of all bits that changed so far: what changes anyway.
    pub fn notch(&mut self) {
        self.rows.iter_mut().for_each(Row::notch);
    }

    /// Shows all changes again.
    pub fn unnotch(&mut self) {
        self.rows.iter_mut().for_each(|row| row.notched = 0);
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
        table.take(&TraceRecord { time_ns: time_ms * 1_000_000, channel: 1, event });
    }

    #[test]
    fn changed_bits_are_found_counted_and_can_be_notched() {
        let mut table = FixedTable::default();
        for (time, text) in [(0, "123#0011"), (10, "123#0110"), (20, "123#0110")] {
            take(&mut table, time, text);
        }
        let row = &table.rows()[0];
        assert_eq!((row.count, row.changed), (3, 0));
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
    fn the_period_settles_and_leaves_out_what_spans_a_loss() {
        let mut table = FixedTable::default();
        for n in 0..50 {
            take(&mut table, n * 10, "123#");
        }
        table.take(&TraceRecord {
            time_ns: 0,
            channel: 1,
            event: TraceEvent::Lost { stage: None, count: 1, at_least: false },
        });
        take(&mut table, 5000, "123#");
        let row = &table.rows()[0];
        assert_eq!(row.period_ns, Some(10e6));
        assert!(row.jitter_ns < 1.0);
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
