//! Intervals: a device measures them where it stamped both ends.

use cantap_trace::{Interval, Moment};
use serde::Serialize;

use crate::store::Store;

/// `Interval` in `api.ts`.
#[derive(Clone, Copy, Serialize)]
#[serde(rename_all = "camelCase")]
pub struct IntervalAnswer {
    seconds: f64,
    by_device: bool,
}

impl From<Interval> for IntervalAnswer {
    fn from(interval: Interval) -> Self {
        Self { seconds: interval.ns as f64 / 1e9, by_device: interval.by_device }
    }
}

/// From one time to another, which need not be those of records.
pub fn between(from_ns: i64, to_ns: i64, store: &Store) -> Interval {
    moment_at(to_ns, store).interval_since(moment_at(from_ns, store))
}

/// A time by both clocks.
fn moment_at(time_ns: i64, store: &Store) -> Moment {
    if store.is_unordered() {
        return Moment { time_ns, device_ns: None };
    }
    let row = store.row_at(time_ns);
    let moment = |row| store.moment(row);
    Moment::at(time_ns, (0..row).rev().map(moment), (row..store.len()).map(moment))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::{DeviceNs, TraceEvent, TraceRecord};

    /// Every 10 ms, by a device that is 400 ppm fast; the losses between have no time of its own.
    fn store() -> Store {
        let mut store = Store::default();
        for n in 0..100 {
            let device_ns = (n % 3 > 0).then(|| DeviceNs::new(7_000_000_000 + n * 10_004_000)).flatten();
            store.push(&TraceRecord {
                time_ns: n.cast_signed() * 10_000_000,
                device_ns,
                channel: 1,
                event: TraceEvent::GAP,
            });
        }
        store
    }

    #[test]
    fn a_stretch_is_as_long_as_the_device_measured_it_whatever_its_ends() {
        let store = store();
        for (from, to) in [(10, 20), (10, 110), (13, 113), (15, 615)] {
            let expected = Interval { ns: (to - from) * 1_000_400, by_device: true };
            assert_eq!(between(from * 1_000_000, to * 1_000_000, &store), expected, "{from} to {to}");
            assert_eq!(between(to * 1_000_000, from * 1_000_000, &store).ns, -expected.ns);
        }
    }

    #[test]
    fn outside_of_the_trace_it_is_utc() {
        let store = store();
        let by_utc = |ns| Interval { ns, by_device: false };
        assert_eq!(between(-5_000_000, 100_000_000, &store), by_utc(105_000_000));
        assert_eq!(between(100_000_000, 2_000_000_000, &store), by_utc(1_900_000_000));
        assert_eq!(between(0, 10, &Store::default()), by_utc(10));
    }
}
