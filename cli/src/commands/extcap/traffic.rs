//! What the toolbar shows of the traffic: each channel's load and losses.

use std::collections::BTreeMap;
use std::time::Duration;

use cantap::{TraceEvent, TraceRecord};
use cantap_trace::LossStage;

use super::toolbar::{Control, Screen};
use cantap_work::lost_frames;

/// The traffic, by channel number.
#[derive(Default)]
pub struct Traffic {
    channels: BTreeMap<u8, OfChannel>,
    since_start: Duration,
}

#[derive(Default)]
struct OfChannel {
    bitrate_bps: u32,
    /// Since the last update.
    bits: u64,
    /// CAN FD frames switched to a bit rate of their own: the bits of those phases are not among these.
    is_bound: bool,
    lost: u64,
    is_at_least: bool,
    /// Descriptions since the last update.
    losses: Vec<String>,
    unlisted: u64,
}

/// How many losses are listed individually between two updates of the toolbar; the rest is shown as a number.
const MOST_LISTED: usize = 8;

impl Traffic {
    /// Sets the bit rate of a channel's bus, in bit/s.
    pub fn set_bit_rate(&mut self, channel: u8, bitrate_bps: u32) {
        self.channels.entry(channel).or_default().bitrate_bps = bitrate_bps;
    }

    /// Takes the next record.
    pub fn push(&mut self, record: &TraceRecord) {
        let channel = self.channels.entry(record.channel).or_default();
        match record.event {
            TraceEvent::Frame { ref frame, .. } => {
                let bits = frame.bus_bits();
                channel.bits += u64::from(bits.nominal);
                channel.is_bound |= bits.data > 0;
            }
            TraceEvent::Lost { stage, count, at_least } => {
                channel.lost += u64::from(count);
                channel.is_at_least |= at_least;
                if channel.losses.len() < MOST_LISTED {
                    let place = stage.map_or("", LossStage::name);
                    let count = lost_frames(u64::from(count), at_least);
                    channel.losses.push(format!("{count} lost ({place})"));
                } else {
                    channel.unlisted += u64::from(count);
                }
            }
            _ => {}
        }
    }

    /// Shows the traffic in the time since the last update.
    pub fn show(&mut self, screen: &Screen, passed: Duration) {
        self.since_start += passed;
        if screen.is_there() {
            screen.set(Control::Load, &self.load(passed));
            screen.set(Control::Lost, &self.lost());
        }
        let seconds = self.since_start.as_secs_f64();
        for (number, channel) in &mut self.channels {
            for loss in channel.losses.drain(..) {
                screen.log(&format!("{seconds:.0} s, channel {number}: {loss}"));
            }
            if channel.unlisted > 0 {
                screen.log(&format!("{seconds:.0} s, channel {number}: {} more lost", channel.unlisted));
            }
            (channel.bits, channel.unlisted, channel.is_bound) = (0, 0, false);
        }
    }

    fn load(&self, passed: Duration) -> String {
        let share = |(number, channel): (&u8, &OfChannel)| {
            let most = f64::from(channel.bitrate_bps) * passed.as_secs_f64();
            let load = if most > 0.0 { (channel.bits as f64 / most * 100.0).min(100.0) } else { 0.0 };
            format!("{number}: {}{load:.0} %", if channel.is_bound { "at least " } else { "" })
        };
        self.channels.iter().map(share).collect::<Vec<_>>().join("  ")
    }

    fn lost(&self) -> String {
        let lost = |(number, channel): (&u8, &OfChannel)| {
            format!("{number}: {}", lost_frames(channel.lost, channel.is_at_least))
        };
        self.channels.iter().map(lost).collect::<Vec<_>>().join("  ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::Direction;
    use cantap::wire::record::LossStage;

    #[test]
    fn load_is_of_the_time_since_and_losses_of_the_whole_capture() {
        let mut traffic = Traffic::default();
        traffic.set_bit_rate(1, 500_000);
        traffic.set_bit_rate(2, 250_000);
        let record = |event| TraceRecord { time_ns: 0, device_ns: None, channel: 1, event };
        let frame =
            TraceEvent::Frame { frame: "123#".parse().unwrap(), direction: Direction::Rx, late: false };
        let bits = u64::from(frame_bits(&frame));
        for _ in 0..(250_000 / bits) {
            traffic.push(&record(frame));
        }
        traffic.push(&record(TraceEvent::Lost { stage: Some(LossStage::Queue), count: 5, at_least: false }));
        assert_eq!(traffic.load(Duration::from_secs(1)), "1: 50 %  2: 0 %");
        assert_eq!(traffic.lost(), "1: 5  2: 0");
        let (screen, _) = Screen::of_test();
        traffic.show(&screen, Duration::from_secs(1));
        traffic.push(&record(TraceEvent::GAP));
        assert_eq!(traffic.load(Duration::from_secs(1)), "1: 0 %  2: 0 %");
        assert_eq!(traffic.lost(), "1: at least 5  2: 0");
        let mut gap = Traffic::default();
        gap.push(&record(TraceEvent::GAP));
        assert_eq!(gap.lost(), "1: an unknown number");
    }

    fn frame_bits(event: &TraceEvent) -> u32 {
        match event {
            TraceEvent::Frame { frame, .. } => frame.bus_bits().total(),
            _ => 0,
        }
    }
}
