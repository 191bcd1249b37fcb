//! Losses by stage, as the JSON objects and summaries show them.

use cantap::device::Counters;
use cantap_trace::counted;

/// Frames lost at each stage, on both channels together.
#[derive(Clone, Copy, Default, serde::Serialize)]
pub struct Losses {
    /// In the controller's FIFO: at least this many.
    pub controller: u64,
    /// In the device's queue.
    pub queue: u64,
    /// Between device and host.
    pub link: u64,
    /// In the host.
    pub host: u64,
    /// In the device's gateway: received on the other channel, and not sent on this one.
    pub gateway: u64,
    /// How often an unknown number of frames was lost, or may have been: at the start of each channel of a device that does not count its
    /// losses, for example.
    pub unknown: u64,
    /// How often the device was off a bus, because another client of its server changed the mode: an unknown number of frames each time.
    pub off_bus: u64,
    /// For how long in total, in microseconds.
    pub off_bus_us: u64,
}

impl Losses {
    /// From the device's counters.
    pub fn of(counters: &Counters) -> Self {
        let mut losses = Self::default();
        for channel in &counters.channels {
            losses.controller += channel.lost_controller;
            losses.queue += channel.lost_queue;
            losses.link += channel.lost_link;
            losses.host += channel.lost_host;
            losses.gateway += channel.lost_gateway;
            losses.unknown += channel.unknown;
            losses.off_bus += channel.off_bus;
            losses.off_bus_us += channel.off_bus_ns / 1000;
        }
        losses
    }

    /// The sum of those of two devices.
    #[must_use]
    pub const fn plus(self, other: Self) -> Self {
        Self {
            controller: self.controller + other.controller,
            queue: self.queue + other.queue,
            link: self.link + other.link,
            host: self.host + other.host,
            gateway: self.gateway + other.gateway,
            unknown: self.unknown + other.unknown,
            off_bus: self.off_bus + other.off_bus,
            off_bus_us: self.off_bus_us + other.off_bus_us,
        }
    }

    /// The total of all stages that can count.
    pub const fn total(&self) -> u64 {
        self.controller + self.queue + self.link + self.host + self.gateway
    }

    /// Whether no frame is known to be missing, nor can be without being known.
    pub const fn is_none(&self) -> bool {
        self.total() == 0 && self.unknown == 0 && self.off_bus == 0
    }

    /// One line.
    pub fn line(&self) -> String {
        let Self { controller, queue, link, host, gateway, unknown, off_bus, off_bus_us } = self;
        let stages = format!("controller {controller}, queue {queue}, link {link}, host {host}");
        let stages = match gateway {
            0 => stages,
            gateway => format!("{stages}, gateway {gateway}"),
        };
        let stages = match unknown {
            0 => stages,
            1 => format!("{stages}, and an unknown number"),
            places => {
                format!("{stages}, and an unknown number at {places}", places = counted(places, "place"))
            }
        };
        if *off_bus == 0 {
            return stages;
        }
        let times = if *off_bus == 1 { "once".to_owned() } else { counted(off_bus, "time") };
        format!(
            "{stages}, off the bus an unknown number, {times}, {:.1} ms in total",
            *off_bus_us as f64 / 1e3
        )
    }
}

/// A number of lost frames, which may not be all of them.
pub fn lost_frames(count: u64, at_least: bool) -> String {
    match (count, at_least) {
        (0, true) => "an unknown number".to_owned(),
        (count, true) => format!("at least {count}"),
        (count, false) => count.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_off_the_bus_is_never_part_of_a_zero() {
        let none = Losses::default();
        assert_eq!(none.line(), "controller 0, queue 0, link 0, host 0");
        let some = Losses { off_bus: 30, off_bus_us: 4900, ..none };
        assert_eq!(
            some.plus(none).line(),
            "controller 0, queue 0, link 0, host 0, off the bus an unknown number, 30 times, 4.9 ms in total"
        );
        let uncounted = Losses { unknown: 1, ..none };
        assert_eq!(uncounted.line(), "controller 0, queue 0, link 0, host 0, and an unknown number");
        assert!(uncounted.plus(uncounted).line().ends_with("an unknown number at 2 places"));
        let gateway = Losses { gateway: 3, ..none };
        assert_eq!(
            (gateway.line().as_str(), gateway.total()),
            ("controller 0, queue 0, link 0, host 0, gateway 3", 3)
        );
        assert!(none.is_none() && !some.is_none() && !uncounted.is_none() && !gateway.is_none());
        assert_eq!(lost_frames(0, false), "0");
        assert_eq!(lost_frames(0, true), "an unknown number");
        assert_eq!(lost_frames(7, true), "at least 7");
    }
}
