//! A channel's load over time, exact at any zoom.
//!
//! For a time, it is known how long the bus was busy up to then: from sums that are kept for every so many frames, and from the frames
//! after the last sum. The load of a column is the difference of two such figures.

use cantap_analysis::stats::ERROR_FRAME_BITS;
use cantap_trace::bits::INTERMISSION_BITS;
use cantap_trace::{TraceEvent, TraceRecord};

use crate::index;
use crate::store::Store;

/// Sums are kept for so many rows.
const STEP: usize = 64;

/// The bits of one channel's rows.
#[derive(Default)]
pub struct ChannelBits {
    /// Rows that occupy the bus, in the order of their times.
    rows: Vec<u32>,
    /// Bits of the rows before each [`STEP`]th one, at the nominal rate and at that of data phases.
    sums: Vec<(u64, u64)>,
    total: (u64, u64),
    scanned: usize,
    /// Whether there are bits at the rate of data phases.
    has_data_phase: bool,
}

/// The bits of a record with the intermission: nominal, data phase.
fn bits(record: &TraceRecord) -> (u64, u64) {
    match &record.event {
        TraceEvent::Frame { frame, .. } => {
            let bits = frame.bus_bits();
            (bits.nominal.into(), bits.data.into())
        }
        TraceEvent::BusError { .. } => (ERROR_FRAME_BITS.into(), 0),
        _ => (0, 0),
    }
}

/// Bit rates in bit/s.
#[derive(Clone, Copy)]
pub struct ChannelRates {
    /// Outside data phases.
    pub nominal: u32,
    /// In data phases, if known.
    pub data: Option<u32>,
}

impl ChannelRates {
    fn ns(self, bits: (u64, u64)) -> f64 {
        let of = |bits: u64, rate: u32| bits as f64 * 1e9 / f64::from(rate);
        of(bits.0, self.nominal) + self.data.map_or(0.0, |rate| of(bits.1, rate))
    }
}

impl ChannelBits {
    /// Takes the channel's rows that are new.
    pub fn extend(&mut self, channel: u8, store: &Store) {
        if store.is_unordered() && self.scanned < store.len() {
            *self = Self::default();
        }
        let mut new = Vec::new();
        store.each_key(self.scanned, |row, key| {
            if key.channel == channel {
                new.push(row as u32);
            }
        });
        if store.is_unordered() {
            new.sort_by_key(|row| store.time_ns(*row as usize));
        }
        for row in new {
            let Some(record) = store.record(row as usize) else { continue };
            let of = bits(&record);
            if of == (0, 0) {
                continue;
            }
            if self.rows.len().is_multiple_of(STEP) {
                self.sums.push(self.total);
            }
            self.rows.push(row);
            self.has_data_phase |= of.1 > 0;
            self.total = (self.total.0 + of.0, self.total.1 + of.1);
        }
        self.scanned = store.len();
    }

    /// How long the bus was busy up to a time, in nanoseconds.
    fn busy_ns(&self, store: &Store, time_ns: i64, rates: ChannelRates) -> f64 {
        let ended = index::first_after(&self.rows, store, time_ns);
        let summed = ended / STEP;
        let record = |row: &u32| store.record(*row as usize);
        let rest = self.rows[(summed * STEP).min(ended)..ended].iter().filter_map(record);
        let start = self.sums.get(summed).copied().unwrap_or(self.total);
        let sum = rest.map(|record| bits(&record)).fold(start, |sum, of| (sum.0 + of.0, sum.1 + of.1));
        let mut busy = rates.ns(sum);
        let intermission = rates.ns((INTERMISSION_BITS.into(), 0));
        // The last one's intermission may not be over,
        if let Some(last) = ended.checked_sub(1).map(|last| self.rows[last]) {
            let since = time_ns.saturating_sub(store.time_ns(last as usize)) as f64;
            busy -= (intermission - since).max(0.0);
        }
        // and the next one may be under way.
        if let Some(next) = self.rows.get(ended).and_then(record) {
            let length = rates.ns(bits(&next)) - intermission;
            let left = next.time_ns.saturating_sub(time_ns) as f64;
            busy += (length - left).max(0.0);
        }
        busy
    }

    /// The load in each of `columns` equal columns of a stretch of time, from 0 to 1; not-a-number if it cannot be known.
    pub fn columns(
        &self,
        store: &Store,
        from_ns: i64,
        to_ns: i64,
        columns: usize,
        rates: Option<ChannelRates>,
    ) -> Vec<(i64, f64)> {
        let span = to_ns.saturating_sub(from_ns).max(1) as f64;
        let edge = |column: usize| from_ns.saturating_add((span * column as f64 / columns as f64) as i64);
        let known = rates.filter(|rates| rates.data.is_some() || !self.has_data_phase);
        let Some(rates) = known else {
            return (0..columns).map(|column| (edge(column), f64::NAN)).collect();
        };
        let mut before = self.busy_ns(store, edge(0), rates);
        (0..columns)
            .map(|column| {
                let (from, to) = (edge(column), edge(column + 1));
                let busy = self.busy_ns(store, to, rates);
                let load = (busy - before) / to.saturating_sub(from).max(1) as f64;
                before = busy;
                // Stamps that are late bring more into a column than it can hold.
                (from, load.clamp(0.0, 1.0))
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::Direction;

    #[test]
    fn the_load_is_exact_at_any_zoom() {
        let mut store = Store::default();
        let frame: cantap_trace::TraceFrame = "000#55".parse().unwrap();
        let bits = i64::from(frame.bus_bits().total());
        // At 1 Mbit/s, half of the time.
        let period = bits * 2000;
        for n in 1..=1000 {
            let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
            store.push(&TraceRecord { time_ns: n * period, device_ns: None, channel: 1, event });
        }
        let mut channel = ChannelBits::default();
        channel.extend(1, &store);
        let rates = Some(ChannelRates { nominal: 1_000_000, data: None });
        for columns in [1, 7, 250] {
            for (_, load) in channel.columns(&store, period, 1000 * period, columns, rates) {
                assert!((load - 0.5).abs() < 0.15 / (1000.0 / columns as f64) + 0.01, "{columns}: {load}");
            }
        }
        // Columns that are shorter than a frame: busy or not.
        let columns = channel.columns(&store, 10 * period, 11 * period, (bits * 2) as usize, rates);
        let busy = columns.iter().filter(|(_, load)| *load > 0.99).count();
        let idle = columns.iter().filter(|(_, load)| *load < 0.01).count();
        assert_eq!((busy, idle), (bits as usize, bits as usize));
        let unknown = channel.columns(&store, 0, period, 3, None);
        assert!(unknown.iter().all(|(_, load)| load.is_nan()));
    }
}
