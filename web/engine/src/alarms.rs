//! Values beyond the limits at which a signal file sets an alarm.

use cantap_signals::{Alarm, Decoder, Signal};

use crate::index::{Index, Place};
use crate::series::Series;
use crate::store::Store;

/// What a signal has beyond one of its limits.
#[derive(Clone, Debug, PartialEq)]
pub struct Beyond {
    /// Its identifier.
    pub place: Place,
    /// Its name, with that of its message.
    pub name: String,
    /// Its unit.
    pub unit: String,
    /// Whether it is above the upper limit, or below the lower one.
    pub is_above: bool,
    /// The limit.
    pub limit: f64,
    /// How many values.
    pub values: usize,
    /// The one that is farthest beyond.
    pub farthest: f64,
    /// The time of the first, in nanoseconds.
    pub first_ns: i64,
}

/// All of them, of all identifiers.
pub fn beyond(store: &Store, index: &Index, decoder: &Decoder) -> Vec<Beyond> {
    let mut found = Vec::new();
    for (place, rows) in index.all() {
        let Some(message) = decoder.find(place.channel, place.id).map(|found| decoder.message(found)) else {
            continue;
        };
        let watched = |signal: &Signal| signal.alarms.min.is_some() || signal.alarms.max.is_some();
        for (number, signal) in message.signals.iter().enumerate().filter(|(_, signal)| watched(signal)) {
            let Some(mut series) = Series::new(message.clone(), number) else { continue };
            series.extend(store, rows);
            let name = format!("{}.{}", message.name, signal.label());
            for (alarm, limit) in [(Alarm::Above, signal.alarms.max), (Alarm::Below, signal.alarms.min)] {
                let Some(limit) = limit else { continue };
                let is_above = alarm == Alarm::Above;
                let mut of = Beyond {
                    place,
                    name: name.clone(),
                    unit: signal.unit.clone(),
                    is_above,
                    limit,
                    values: 0,
                    farthest: limit,
                    first_ns: i64::MAX,
                };
                let is_beyond = |value: f64| signal.alarms.check(value) == Some(alarm);
                series.values_beyond(store, rows, is_beyond, |time_ns, value| {
                    of.values += 1;
                    of.first_ns = of.first_ns.min(time_ns);
                    of.farthest = if is_above { of.farthest.max(value) } else { of.farthest.min(value) };
                });
                if of.values > 0 {
                    found.push(of);
                }
            }
        }
    }
    found
}
