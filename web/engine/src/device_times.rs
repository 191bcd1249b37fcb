//! The device's times of a block of records: four bytes each, as differences of the device's clock to UTC, and none if no record has one.

use cantap_trace::{DeviceNs, Moment};

/// A row without the device's time.
const UNKNOWN: i32 = i32::MIN;

/// See the module's description.
#[derive(Default)]
pub struct DeviceTimes {
    /// By how much each row's difference is more than its anchor's. Empty until the first time, and shorter than the block if the last rows
    /// have none.
    more: Vec<i32>,
    anchors: Vec<Anchor>,
}

/// From this row on, differences are relative to this one. Another anchor is needed where the device was restarted or replaced, and after an
/// hour of a clock that is much too fast.
struct Anchor {
    row: usize,
    /// The device's time less UTC; wraps.
    ahead_ns: i64,
}

fn ahead_ns(device_ns: DeviceNs, time_ns: i64) -> i64 {
    device_ns.get().cast_signed().wrapping_sub(time_ns)
}

impl DeviceTimes {
    /// Adds the time of a row; rows come in order.
    pub fn push(&mut self, row: usize, moment: Moment) {
        let Some(device_ns) = moment.device_ns else { return };
        let ahead_ns = ahead_ns(device_ns, moment.time_ns);
        self.more.resize(row, UNKNOWN);
        let more = self.anchors.last().map(|anchor| i32::try_from(ahead_ns.wrapping_sub(anchor.ahead_ns)));
        let more = match more {
            Some(Ok(more)) if more != UNKNOWN => more,
            _ => {
                self.anchors.push(Anchor { row, ahead_ns });
                0
            }
        };
        self.more.push(more);
    }

    /// The device's time of a row whose UTC this is.
    #[inline]
    pub fn get(&self, row: usize, time_ns: i64) -> Option<DeviceNs> {
        let more = self.more.get(row).copied().filter(|more| *more != UNKNOWN)?;
        let anchor = match &self.anchors[..] {
            [only] => only,
            all => all.get(all.partition_point(|anchor| anchor.row <= row).checked_sub(1)?)?,
        };
        let ahead_ns = anchor.ahead_ns.wrapping_add(i64::from(more));
        DeviceNs::new(time_ns.wrapping_add(ahead_ns).cast_unsigned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_steady_clock_has_one_anchor_and_a_trace_without_it_takes_nothing() {
        let mut times = DeviceTimes::default();
        let moment = |n: u64| Moment {
            time_ns: 1_800_000_000_000_000_000 + n.cast_signed() * 1_000_000,
            device_ns: DeviceNs::new(5 + n * 1_000_400),
        };
        for n in (0..60_000).filter(|n| n % 3 > 0) {
            times.push(n, moment(n as u64));
        }
        for n in 0..60_010 {
            let moment = moment(n as u64);
            let is_there = n % 3 > 0 && n < 60_000;
            assert_eq!(times.get(n, moment.time_ns), moment.device_ns.filter(|_| is_there), "{n}");
        }
        assert_eq!(times.anchors.len(), 1);
        let mut none = DeviceTimes::default();
        none.push(0, Moment { time_ns: 5, device_ns: None });
        assert_eq!((none.more.capacity(), none.get(0, 5)), (0, None));
    }

    #[test]
    fn a_restarted_device_has_another_anchor() {
        let mut times = DeviceTimes::default();
        let moments = [(0, 1), (1, i64::MAX as u64), (2, 3), (3, 1 << 31), (4, u64::MAX)]
            .map(|(time_ns, ns)| Moment { time_ns, device_ns: DeviceNs::new(ns) });
        for (row, moment) in moments.into_iter().enumerate() {
            times.push(row, moment);
        }
        for (row, moment) in moments.into_iter().enumerate() {
            assert_eq!(times.get(row, moment.time_ns), moment.device_ns);
        }
    }
}
