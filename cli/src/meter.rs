//! What a capture's summary says of a channel.

use cantap::stats::WorkLoad;
use cantap::{TraceEvent, TraceRecord, bits_on_bus};

/// Counts one channel's frames as they are delivered.
pub struct Meter {
    frames: u64,
    lost: u64,
    span_ns: Option<(i64, i64)>,
    load: WorkLoad,
}

impl Meter {
    /// Nothing delivered yet.
    pub fn new(bitrate_bps: u32) -> Self {
        Self { frames: 0, lost: 0, span_ns: None, load: WorkLoad::new(bitrate_bps) }
    }

    /// Takes the channel's next record.
    pub fn push(&mut self, record: &TraceRecord) {
        match &record.event {
            TraceEvent::Frame { frame, .. } => {
                self.frames += 1;
                let first = self.span_ns.map_or(record.time_ns, |(first, _)| first);
                self.span_ns = Some((first, record.time_ns));
                self.load.frame(record.time_ns, bits_on_bus(frame));
            }
            TraceEvent::Lost { count, .. } => {
                self.lost += u64::from(*count);
                self.load.gap();
            }
            _ => {}
        }
    }

    /// Frames delivered.
    pub const fn frames(&self) -> u64 {
        self.frames
    }

    /// Frames lost.
    pub const fn lost(&self) -> u64 {
        self.lost
    }

    /// From the first frame to the last, in seconds.
    pub fn seconds(&self) -> f64 {
        self.span_ns.map_or(0.0, |(first, last)| (last - first) as f64 / 1e9)
    }

    /// Delivered frames per second, between the first and the last.
    pub fn frames_per_s(&self) -> f64 {
        let seconds = self.seconds();
        if seconds > 0.0 { (self.frames - 1) as f64 / seconds } else { 0.0 }
    }

    /// Bus load in per cent, from exact lengths, over the intervals without a loss.
    pub fn bus_load_pct(&self) -> f64 {
        self.load.mean_pct().unwrap_or(0.0)
    }
}

/// For people: as many decimals as say something.
pub fn rounded(value: f64, decimals: i32) -> f64 {
    let factor = 10_f64.powi(decimals);
    (value * factor).round() / factor
}
