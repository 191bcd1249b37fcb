//! Statistics as plain values: what `cantap stats --json` prints.

use cantap_can::{BusErrorKind, ErrorState, LossStage};
use serde::{Deserialize, Serialize};

use super::{ChannelStatistics, IdStatistics, Statistics, Window};

/// Statistics of a trace.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Frames on all channels.
    pub frames: u64,
    /// Frames known to be missing on all channels.
    pub lost: u64,
    /// Whether there may be more on one of them.
    pub lost_at_least: bool,
    /// Errors on all channels.
    pub errors: u64,
    /// Frames of LIN buses, which are in no other figure.
    pub lin_frames: u64,
    /// End of the trace's first frame, in seconds since the Unix epoch, or since the trace's start.
    pub first_s: Option<f64>,
    /// End of its last frame.
    pub last_s: Option<f64>,
    /// Like [`Self::first_s`], to the nanosecond.
    pub first_ns: Option<i64>,
    /// Like [`Self::last_s`], to the nanosecond.
    pub last_ns: Option<i64>,
    /// Where the trace's windows begin: its first record, whether a frame or not.
    pub origin_s: Option<f64>,
    /// Between the first and the last frame, in seconds.
    pub duration_s: f64,
    /// From where the windows begin to the latest record, or as long as a device was listened to, in seconds.
    pub observed_s: f64,
    /// Length of a window, in seconds.
    pub window_s: f64,
    /// The channels, in ascending order.
    pub channels: Vec<ChannelSummary>,
}

/// Whether rates that are over the time from the first frame to the last leave much out of the time that was watched, as when a bus
/// stopped: then the time belongs beside them. Both times have the same unit.
pub fn is_of_a_part(frames_over: f64, observed: f64) -> bool {
    frames_over > 0.0 && frames_over < 0.9 * observed
}

/// Statistics of one channel.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChannelSummary {
    /// The channel, from 1.
    pub channel: u8,
    /// Its bit rate in bit/s, if given.
    #[serde(rename = "bitrate_bps")]
    pub bitrate: Option<u32>,
    /// Whether the trace itself has said it.
    pub bitrate_from_trace: bool,
    /// The bit rate of its data phases in bit/s, if given.
    #[serde(rename = "data_bitrate_bps")]
    pub data_bitrate: Option<u32>,
    /// Frames, sent and received.
    pub frames: u64,
    /// Frames sent by the device.
    pub sent: u64,
    /// Frames with an 11-bit identifier.
    pub standard: u64,
    /// Frames with a 29-bit identifier.
    pub extended: u64,
    /// Remote frames.
    pub remote: u64,
    /// CAN FD frames.
    pub fd: u64,
    /// CAN FD frames with a separate bit rate in the data phase.
    pub brs: u64,
    /// CAN FD frames from an error passive sender.
    pub esi: u64,
    /// Frames whose time is only an upper bound.
    pub late: u64,
    /// Records that are older than the previous record.
    pub out_of_order: u64,
    /// The resolution of all stamps, in seconds, if it is coarser than the frames: periods and windows below it are meaningless.
    pub stamp_step_s: Option<f64>,
    /// End of the first frame, in seconds.
    pub first_s: Option<f64>,
    /// End of the last frame, in seconds.
    pub last_s: Option<f64>,
    /// Between the two, in seconds; the sum of the parts if the clock was set back.
    pub duration_s: f64,
    /// Frames per second, from the first to the last.
    pub frames_per_s: f64,
    /// Bits of all frames, with stuff bits and intermission.
    pub bits: u64,
    /// Bits per second, from the first frame to the last.
    pub bits_per_s: f64,
    /// Mean work load in per cent.
    pub bus_load_pct: Option<f64>,
    /// If it is not known, the reason.
    pub no_bus_load_because: Option<&'static str>,
    /// More about the load; `None` without a bit rate.
    pub load: Option<LoadSummary>,
    /// The busiest windows, the busiest first.
    pub peaks: Vec<PeakSummary>,
    /// Errors on the bus.
    pub errors: ErrorSummary,
    /// Frames that are missing.
    pub lost: LossSummary,
    /// The controller's last reported state.
    pub state: Option<&'static str>,
    /// Its transmit and receive error counters.
    pub error_counters: Option<(u8, u8)>,
    /// Frames that should have been sent but were not.
    pub transmit_failures: u64,
    /// Statistics of each identifier, in ascending order.
    pub ids: Vec<IdSummary>,
    /// Frames of identifiers that are not listed because there were too many.
    pub unlisted_frames: u64,
}

/// Bus load in per cent.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LoadSummary {
    /// Work load of the last frame over the interval before it.
    pub instant_pct: Option<f64>,
    /// The largest instantaneous work load.
    pub instant_max_pct: Option<f64>,
    /// Work load over all intervals.
    pub mean_pct: Option<f64>,
    /// Load of the least busy window from which no frame is missing.
    pub window_min_pct: Option<f64>,
    /// Mean over the windows from which no frame is missing, including error frames.
    pub window_mean_pct: Option<f64>,
    /// Load of the busiest window; a lower bound if frames are missing from it.
    pub window_max_pct: Option<f64>,
}

/// A window of time, as printed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PeakSummary {
    /// The channel, from 1.
    pub channel: u8,
    /// Its start in seconds.
    pub start_s: f64,
    /// Its length in seconds.
    pub length_s: f64,
    /// Load in per cent, if a bit rate was given.
    pub load_pct: Option<f64>,
    /// Frames that ended in it.
    pub frames: u64,
    /// Frames per second.
    pub frames_per_s: f64,
    /// Bits per second.
    pub bits_per_s: f64,
    /// Error frames.
    pub errors: u64,
    /// Lost frames whose record is in it.
    pub lost: u64,
    /// Whether frames are missing from it, or may be: its figures are lower bounds.
    pub incomplete: bool,
}

/// Errors by kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[allow(missing_docs, reason = "the names are the kinds")]
pub struct ErrorSummary {
    pub total: u64,
    pub stuff: u64,
    pub form: u64,
    pub acknowledgment: u64,
    pub bit_recessive: u64,
    pub bit_dominant: u64,
    pub crc: u64,
    pub unknown: u64,
    pub suppressed: u64,
}

/// Losses by stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[allow(missing_docs, reason = "the names are the stages")]
pub struct LossSummary {
    pub total: u64,
    pub controller: u64,
    pub queue: u64,
    pub link: u64,
    pub host: u64,
    pub gateway: u64,
    pub unknown: u64,
    /// Places in the trace where frames are missing.
    pub gaps: u64,
    /// Those of them at which it is unknown how many: the device was not on the bus, or not there.
    pub uncounted: u64,
    /// Whether there may be more.
    pub at_least: bool,
}

/// One identifier.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct IdSummary {
    /// Three hexadecimal digits, eight if extended.
    pub id: String,
    /// Whether it has 29 bits.
    pub extended: bool,
    /// Its frames.
    pub count: u64,
    /// Its remote frames.
    pub remote: u64,
    /// Its frames sent by the device.
    pub sent: u64,
    /// End of its first frame, in seconds.
    pub first_s: f64,
    /// End of its last frame, in seconds.
    pub last_s: f64,
    /// Shortest interval between two frames, in milliseconds.
    pub period_min_ms: Option<f64>,
    /// Mean interval, in milliseconds.
    pub period_mean_ms: Option<f64>,
    /// Longest interval, in milliseconds.
    pub period_max_ms: Option<f64>,
    /// Standard deviation of the intervals, in milliseconds.
    pub jitter_ms: Option<f64>,
    /// The last DLC.
    pub dlc: u8,
    /// All DLCs seen, ascending.
    pub dlcs: Vec<u8>,
    /// How often the DLC changed from one frame to the next.
    pub dlc_changes: u64,
    /// Bits of its frames, with stuff bits and intermission.
    pub bits: u64,
    /// Its share of the channel's bits, in per cent.
    pub share_pct: f64,
}

/// Nanoseconds as seconds, rounded once: a float cannot hold the nanoseconds since 1970.
fn seconds(ns: i64) -> f64 {
    (ns / 1_000_000_000) as f64 + (ns % 1_000_000_000) as f64 / 1e9
}

impl Statistics {
    /// Everything as plain values, ready to be printed or serialised. If the trace has ended, call
    /// [`Self::finish`] first.
    pub fn summary(&self) -> Summary {
        Summary::of(self)
    }
}

impl Summary {
    fn of(statistics: &Statistics) -> Self {
        let mut channels: Vec<_> = statistics
            .channels()
            .iter()
            .map(|channel| {
                let why_without_load = statistics.options.why_without_load(channel.number);
                let summary = ChannelSummary::of(channel, statistics.window_ns, why_without_load);
                ChannelSummary { bitrate_from_trace: statistics.is_learned(channel.number), ..summary }
            })
            .collect();
        channels.sort_by_key(|channel| channel.channel);
        let spans = || statistics.channels().iter().filter_map(|channel| channel.span_ns);
        let first = spans().map(|(first, _)| first).min();
        let last = spans().map(|(_, last)| last).max();
        let together = first.zip(last).map_or(0.0, |(first, last)| seconds(last.saturating_sub(first)));
        let longest = channels.iter().map(|channel| channel.duration_s).fold(together, f64::max);
        Self {
            frames: channels.iter().map(|channel| channel.frames).sum(),
            lost: channels.iter().map(|channel| channel.lost.total).sum(),
            lost_at_least: channels.iter().any(|channel| channel.lost.at_least),
            errors: channels.iter().map(|channel| channel.errors.total).sum(),
            lin_frames: statistics.lin_frames(),
            first_s: first.map(seconds),
            last_s: last.map(seconds),
            first_ns: first,
            last_ns: last,
            origin_s: statistics.first_ns.map(seconds),
            duration_s: longest,
            observed_s: statistics.observed_ns() as f64 / 1e9,
            window_s: statistics.window_ns as f64 / 1e9,
            channels,
        }
    }
}

impl ChannelSummary {
    fn of(channel: &ChannelStatistics, window_ns: u64, why_without_load: Option<&'static str>) -> Self {
        let mut ids: Vec<_> = channel.ids().collect();
        ids.sort_by_key(|id| (id.id.is_extended(), id.id.raw()));
        let step_ns = channel.coarse_step_ns();
        // A window as short as the resolution of stamps has all frames of a step, or none.
        let says_nothing = step_ns.is_some_and(|step| window_ns < step * 2);
        let windows = channel.window_least_and_mean_pct().filter(|_| !says_nothing);
        let load = channel.load.as_ref().map(|load| LoadSummary {
            instant_pct: load.instant_pct(),
            instant_max_pct: load.instant_max_pct(),
            mean_pct: load.mean_pct(),
            window_min_pct: windows.map(|(least, _)| least),
            window_mean_pct: windows.map(|(_, mean)| mean),
            window_max_pct: channel.window_largest_pct().filter(|_| !says_nothing),
        });
        // As for frames: the first frame's bits lie before the span.
        let span = channel.covered_ns();
        let bits_per_s = super::windows::per_second(channel.bits - channel.first_bits(), span);
        Self {
            channel: channel.number,
            bitrate: channel.bitrate_bps,
            bitrate_from_trace: false,
            data_bitrate: channel.data_bitrate_bps,
            frames: channel.frames,
            sent: channel.sent,
            standard: channel.frames - channel.extended,
            extended: channel.extended,
            remote: channel.remote,
            fd: channel.fd,
            brs: channel.brs,
            esi: channel.esi,
            late: channel.late,
            out_of_order: channel.out_of_order,
            stamp_step_s: step_ns.map(|step| step as f64 / 1e9),
            first_s: channel.span_ns.map(|(first, _)| seconds(first)),
            last_s: channel.span_ns.map(|(_, last)| seconds(last)),
            duration_s: span as f64 / 1e9,
            frames_per_s: channel.frames_per_s(),
            bits: channel.bits,
            bits_per_s,
            bus_load_pct: load.and_then(|load| load.mean_pct),
            no_bus_load_because: why_without_load.or_else(|| match (channel.bitrate_bps, load) {
                (None, _) => Some("the bit rate is not known"),
                (Some(_), None) => Some("frames switch to a data bit rate that is not known"),
                (Some(_), Some(load)) => load
                    .mean_pct
                    .is_none()
                    .then_some("there are no two frames between which nothing is missing"),
            }),
            load,
            peaks: channel.peaks().map(PeakSummary::of).collect(),
            errors: ErrorSummary::of(&channel.errors),
            lost: LossSummary::of(&channel.losses),
            state: channel.state.map(ErrorState::name),
            error_counters: channel.counters,
            transmit_failures: channel.transmit_failures,
            ids: ids.into_iter().map(|id| IdSummary::of(id, channel.bits)).collect(),
            unlisted_frames: channel.unlisted_frames(),
        }
    }
}

impl PeakSummary {
    /// A window's values in seconds.
    pub fn of(window: &Window) -> Self {
        Self {
            channel: window.channel,
            start_s: seconds(window.start_ns),
            length_s: window.length_ns as f64 / 1e9,
            load_pct: window.load_pct,
            frames: window.frames,
            frames_per_s: window.frames_per_s(),
            bits_per_s: window.bits_per_s(),
            errors: window.errors,
            lost: window.lost,
            incomplete: window.incomplete,
        }
    }
}

impl ErrorSummary {
    fn of(errors: &super::Errors) -> Self {
        Self {
            total: errors.total(),
            stuff: errors.of(BusErrorKind::Stuff),
            form: errors.of(BusErrorKind::Form),
            acknowledgment: errors.of(BusErrorKind::Acknowledgment),
            bit_recessive: errors.of(BusErrorKind::BitRecessive),
            bit_dominant: errors.of(BusErrorKind::BitDominant),
            crc: errors.of(BusErrorKind::Crc),
            unknown: errors.unknown,
            suppressed: errors.suppressed,
        }
    }
}

impl LossSummary {
    fn of(losses: &super::Losses) -> Self {
        Self {
            total: losses.total(),
            controller: losses.of(LossStage::Controller),
            queue: losses.of(LossStage::Queue),
            link: losses.of(LossStage::Link),
            host: losses.of(LossStage::Host),
            gateway: losses.of(LossStage::Gateway),
            unknown: losses.unknown,
            gaps: losses.gaps,
            uncounted: losses.uncounted,
            at_least: losses.at_least,
        }
    }
}

impl IdSummary {
    fn of(id: &IdStatistics, channel_bits: u64) -> Self {
        let ms = |ns: f64| ns / 1e6;
        Self {
            id: id.id.to_string(),
            extended: id.id.is_extended(),
            count: id.frames,
            remote: id.remote,
            sent: id.sent,
            first_s: seconds(id.first_ns),
            last_s: seconds(id.last_ns),
            period_min_ms: id.period.min_ns().map(|ns| ms(ns as f64)),
            period_mean_ms: id.period.mean_ns().map(ms),
            period_max_ms: id.period.max_ns().map(|ns| ms(ns as f64)),
            jitter_ms: id.period.jitter_ns().map(ms),
            dlc: id.dlc,
            dlcs: id.dlcs().collect(),
            dlc_changes: id.dlc_changes,
            bits: id.bits,
            share_pct: id.bits as f64 * 100.0 / channel_bits.max(1) as f64,
        }
    }
}
