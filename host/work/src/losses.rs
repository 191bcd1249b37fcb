//! Losses by stage, as the JSON objects and summaries show them.

use cantap::device::Counters;

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
        }
    }

    /// The total of all stages.
    pub const fn total(&self) -> u64 {
        self.controller + self.queue + self.link + self.host
    }

    /// One line.
    pub fn line(&self) -> String {
        let Self { controller, queue, link, host } = self;
        format!("controller {controller}, queue {queue}, link {link}, host {host}")
    }
}
