//! The summary at the end of a capture: one object for scripts, lines for people.

use std::io::{self, Write};
use std::path::Path;

use cantap::Device;
use cantap::device::{Gaps, channel_number};
use cantap_address::Address;
use cantap_analysis::stats::is_of_a_part;
use cantap_signals::trigger::{Trigger, TriggerCounts};

use cantap_trace::counted;
use cantap_work::boards::Boards;
use cantap_work::bus_hints::BusHint;
use cantap_work::live::{Line, LiveRecords};
use cantap_work::{Losses, Meter, lost_frames, rounded};

/// A channel in the JSON object.
#[derive(serde::Serialize)]
pub struct ChannelSummary {
    pub channel: u8,
    pub frames: u64,
    lost: u64,
    /// Whether there may be more, as where the device was not on the bus.
    lost_at_least: bool,
    /// Those reported and those suppressed, whatever the filters.
    pub bus_errors: u64,
    /// `null` if the device left out what is needed for it, like the next one.
    frames_per_s: Option<f64>,
    /// The time that rate and load are over.
    duration_s: f64,
    bus_load_pct: Option<f64>,
    /// If it is not known, the reason.
    no_bus_load_because: Option<&'static str>,
    /// What is probably the matter with its bus.
    hint: Option<&'static str>,
}

/// The JSON object.
#[derive(serde::Serialize)]
pub struct Summary {
    seconds: f64,
    pub channels: Vec<ChannelSummary>,
    lost: Losses,
    clock_drift_ppm: Option<f64>,
    /// What other makers' adapters say about losses before this program.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    not_known: Vec<String>,
    /// If there are several devices.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    devices: Vec<DeviceSummary>,
    /// If there were any gaps.
    #[serde(skip_serializing_if = "Option::is_none")]
    gaps: Option<GapSummary>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trigger: Option<TriggerSummary>,
    /// After a failure: the number of frames in the file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frames_in_file: Option<u64>,
    /// Whoever read the records from standard output has closed it, so that no object is read there either.
    #[serde(skip)]
    pub is_closed: bool,
}

/// One of several devices.
#[derive(serde::Serialize)]
struct DeviceSummary {
    device: String,
    channels: Vec<u8>,
    clock_drift_ppm: Option<f64>,
    /// Whether its times are on the first device's clock by USB frames.
    by_usb_frames: bool,
    /// If not, the reason.
    no_usb_frames_because: Option<String>,
    /// Since when, in seconds since the Unix epoch.
    by_usb_frames_since_s: Option<f64>,
    /// The error of the times from its own round trips that was corrected.
    moved_us: f64,
    /// The uncertainty of its times relative to the first device's, without USB frames.
    uncertainty_us: Option<f64>,
}

/// Times in which the device was not there. Frames of those times are not counted.
#[derive(serde::Serialize)]
struct GapSummary {
    count: u32,
    seconds: f64,
}

/// What a trigger has done.
#[derive(serde::Serialize)]
pub struct TriggerSummary {
    events: u64,
    kept: u64,
    forgotten: u64,
}

impl TriggerSummary {
    /// The counts so far.
    pub fn of(trigger: &Trigger) -> Self {
        let TriggerCounts { events, kept, forgotten } = trigger.counts();
        Self { events, kept, forgotten }
    }
}

impl Summary {
    /// For what these devices received in this many seconds, by channel; without a trigger or file so far.
    pub fn of(seconds: f64, channels: Vec<ChannelSummary>, live: &LiveRecords, boards: &Boards) -> Self {
        let gaps = live.lines().lines().map(Line::gaps);
        let gaps = gaps.fold(Gaps::default(), |sum, gaps| Gaps {
            count: sum.count + gaps.count,
            time: sum.time + gaps.time,
        });
        let counters = live.lines().lines().map(Line::counters);
        Self {
            seconds: rounded(seconds, 3),
            channels,
            lost: counters.map(|counters| Losses::of(&counters)).fold(Losses::default(), Losses::plus),
            clock_drift_ppm: live.lines().lines().next().and_then(drift_ppm),
            not_known: not_known(live),
            devices: devices(live, boards),
            gaps: (gaps.count > 0)
                .then(|| GapSummary { count: gaps.count, seconds: rounded(gaps.time.as_secs_f64(), 3) }),
            trigger: None,
            frames_in_file: None,
            is_closed: false,
        }
    }

    /// Prints it: the object, or lines on standard error. `output` is the file that was written.
    pub fn tell(&self, json: bool, output: Option<&Path>) -> anyhow::Result<()> {
        if json {
            writeln!(io::stdout().lock(), "{}", serde_json::to_string(self)?)?;
            return Ok(());
        }
        eprintln!("captured {} s", self.seconds);
        for channel in &self.channels {
            eprintln!("{}", channel.line(self.seconds));
        }
        if let Some(TriggerSummary { events, kept, forgotten }) = &self.trigger {
            eprintln!(
                "trigger: {events}, {kept} kept",
                events = counted(events, "event"),
                kept = counted(kept, "record")
            );
            if *forgotten > 0 {
                eprintln!(
                    "{forgotten} before events were too many to remember; use a shorter --pre",
                    forgotten = counted(forgotten, "record")
                );
            }
        }
        if self.is_closed {
            eprintln!(
                "standard output was closed before the end: how many of these frames its reader took is not known"
            );
        }
        let frames: u64 = self.channels.iter().map(|channel| channel.frames).sum();
        if let (Some(path), Some(in_file)) =
            (output, self.frames_in_file.filter(|in_file| *in_file != frames))
        {
            eprintln!("{in_file} of the {frames} frames are in '{}'", path.display());
        }
        eprintln!("lost: {}", self.lost.line());
        for note in &self.not_known {
            eprintln!("{note}");
        }
        if let Some(GapSummary { count, seconds }) = &self.gaps {
            eprintln!(
                "gaps: {count}, {seconds} s in which the device was not there: frames on the bus at that time were not counted"
            );
        }
        if let Some(ppm) = self.clock_drift_ppm {
            let how = if ppm < 0.0 { "slower" } else { "faster" };
            eprintln!("the device's clock runs {} ppm {how} than this computer's", ppm.abs());
        }
        for device in self.devices.iter().skip(1) {
            eprintln!("{}", device.line());
        }
        Ok(())
    }
}

/// What other makers' adapters do not report, in sentences.
fn not_known(live: &LiveRecords) -> Vec<String> {
    let row = |(board, device): (usize, &Device)| {
        let row = cantap_adapters::row(&device.hello().board)?;
        let address = live.addresses().get(board)?;
        let losses = format!("{address}: {}", row.losses_before());
        Some(std::iter::once(losses).chain(row.limits.map(|limits| format!("{address}: {limits}"))))
    };
    live.lines().devices().filter_map(row).flatten().collect()
}

fn drift_ppm(line: &Line) -> Option<f64> {
    line.clock().drift_ppm.map(|ppm| rounded(ppm, 2))
}

/// What is known of several devices' clocks; empty for a single one, which has the only clock.
fn devices(live: &LiveRecords, boards: &Boards) -> Vec<DeviceSummary> {
    if live.addresses().len() < 2 {
        return Vec::new();
    }
    let uncertainty_ns = |line: &Line| line.clock().uncertainty_ns;
    let first_ns = live.lines().lines().next().and_then(uncertainty_ns);
    let mut followers = live.lines().clocks();
    let summary = |(board, (line, address)): (usize, (&Line, &Address))| {
        let clock = if board == 0 { None } else { followers.next() };
        let common = clock.map_or(Ok(()), |clock| clock.common);
        let apart_ns = common.is_err().then(|| Some(first_ns? + uncertainty_ns(line)?)).flatten();
        DeviceSummary {
            device: address.to_string(),
            channels: boards.channels_of(board).map(|channel| channel_number(board, channel)).collect(),
            clock_drift_ppm: drift_ppm(line),
            by_usb_frames: common.is_ok(),
            no_usb_frames_because: common.err().map(|reason| reason.to_string()),
            by_usb_frames_since_s: clock.and_then(|clock| clock.since_ns).map(|ns| ns as f64 / 1e9),
            moved_us: clock.map_or(0.0, |clock| clock.moved_ns as f64 / 1e3),
            uncertainty_us: apart_ns.map(|ns| ns as f64 / 1e3),
        }
    };
    live.lines().lines().zip(live.addresses()).enumerate().map(summary).collect()
}

impl DeviceSummary {
    /// How well its times match the first device's clock, for people.
    fn line(&self) -> String {
        let Self { device, moved_us, uncertainty_us, .. } = self;
        let channels: Vec<String> = self.channels.iter().map(u8::to_string).collect();
        let clock = match (&self.no_usb_frames_because, self.by_usb_frames_since_s) {
            (None, Some(_)) => {
                format!(
                    "on the first device's clock by USB frames (its own round trips were {moved_us} us off)"
                )
            }
            (None, None) => "coming to the first device's clock by USB frames".to_owned(),
            (Some(reason), _) => {
                let known = uncertainty_us.map_or(String::new(), |us| format!(", to {us:.0} us or better"));
                format!("on the first device's clock by UTC alone{known}: {reason}")
            }
        };
        format!("channels {} of '{device}': {clock}", channels.join(" and "))
    }
}

impl ChannelSummary {
    /// For the channel with this number.
    pub fn of(channel: u8, meter: &Meter, hint: Option<BusHint>) -> Self {
        Self {
            channel,
            frames: meter.frames(),
            lost: meter.lost(),
            lost_at_least: meter.lost_at_least(),
            bus_errors: meter.bus_errors(),
            frames_per_s: meter.frames_per_s().map(|rate| rounded(rate, 1)),
            duration_s: rounded(meter.seconds(), 6),
            bus_load_pct: meter.bus_load_pct().map(|load| rounded(load, 2)),
            no_bus_load_because: meter.no_bus_load_because(),
            hint: hint.map(BusHint::name),
        }
    }

    /// One line; what is unknown has its reason. The capture lasted `seconds`.
    fn line(&self, seconds: f64) -> String {
        let Self { channel, frames, lost, bus_errors, frames_per_s, bus_load_pct, .. } = self;
        let lost = lost_frames(*lost, self.lost_at_least);
        let rate = frames_per_s.map_or_else(String::new, |rate| format!(", {rate} frames/s"));
        let load = match (bus_load_pct, self.no_bus_load_because) {
            (Some(load), _) => format!(", bus load {load} %"),
            (None, Some(reason)) => format!(", bus load – ({reason})"),
            (None, None) => String::new(),
        };
        // A bus that stopped was not as busy all the time.
        let over = if is_of_a_part(self.duration_s, seconds) && !(rate.is_empty() && load.is_empty()) {
            format!(" (over {:.1} s from the first frame to the last)", self.duration_s)
        } else {
            String::new()
        };
        format!(
            "channel {channel}: {frames}{rate}{load}{over}, {lost} lost, {bus_errors}",
            frames = counted(frames, "frame"),
            bus_errors = counted(bus_errors, "bus error")
        )
    }
}
