//! Statistics of a trace as it passes: exact bus load, rates, periods, losses and errors, per channel and per
//! identifier.
//!
//! Memory is bounded whatever the trace: nothing is kept per frame. Times must be the frames' ends, as
//! every source of [`TraceRecord`] gives them. Nothing here is printed; `cantap stats` does that.

mod channel;
mod ids;
mod summary;
mod windows;
mod work_load;

use std::time::Duration;

use cantap_trace::TraceRecord;

pub use channel::{ChannelStatistics, Errors, Losses};
pub use ids::{IdStatistics, MOST_IDS, Period};
pub use summary::{
    ChannelSummary, ErrorSummary, IdSummary, LoadSummary, LossSummary, PeakSummary, Summary, is_of_a_part,
};
pub use windows::{ERROR_FRAME_BITS, Window, shortest_window_ns};
pub use work_load::WorkLoad;

/// The parameters of measurement.
#[derive(Clone, Debug)]
pub struct Options {
    /// Bit rate of the channels not listed in [`Self::channel_bitrate_bps`]; without one there is no load.
    pub bitrate_bps: Option<u32>,
    /// Bit rates of individual channels: channel from 1, bit/s.
    pub channel_bitrate_bps: Vec<(u8, u32)>,
    /// Bit rate of the data phases of CAN FD frames, for the channels not listed in [`Self::channel_data_bitrate_bps`].
    pub data_bitrate_bps: Option<u32>,
    /// The same for individual channels: channel from 1, bit/s.
    pub channel_data_bitrate_bps: Vec<(u8, u32)>,
    /// Channels, from 1, whose frames came without data or times: they have no load, whatever their bit rate.
    pub without_load: Vec<u8>,
    /// Channels, from 1, of which only some frames came, because a filter in the device kept the others back: they have no load either.
    pub filtered: Vec<u8>,
    /// Length of a window.
    pub window: Duration,
    /// How many of the busiest windows are kept.
    pub peaks: usize,
}

impl Default for Options {
    /// No bit rate, windows of a second, five peaks.
    fn default() -> Self {
        Self {
            bitrate_bps: None,
            channel_bitrate_bps: Vec::new(),
            data_bitrate_bps: None,
            channel_data_bitrate_bps: Vec::new(),
            without_load: Vec::new(),
            filtered: Vec::new(),
            window: SECOND,
            peaks: 5,
        }
    }
}

impl Options {
    /// The bit rate of a channel, if known.
    pub fn bitrate_of(&self, channel: u8) -> Option<u32> {
        of_channel(&self.channel_bitrate_bps, channel).or(self.bitrate_bps)
    }

    /// Why a channel has no load whatever its bit rate, if so.
    pub(super) fn why_without_load(&self, channel: u8) -> Option<&'static str> {
        if self.filtered.contains(&channel) {
            return Some("a filter kept frames back");
        }
        self.without_load.contains(&channel).then_some("frames came without data or without times")
    }

    /// The bit rate of a channel's data phases, if known.
    pub fn data_bitrate_of(&self, channel: u8) -> Option<u32> {
        of_channel(&self.channel_data_bitrate_bps, channel).or(self.data_bitrate_bps)
    }
}

/// A channel's own bit rate.
fn of_channel(rates: &[(u8, u32)], channel: u8) -> Option<u32> {
    rates.iter().find(|(number, _)| *number == channel).map(|(_, bitrate)| *bitrate)
}

/// Why these options cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BadOptions {
    /// A bit rate of zero.
    #[error("a bit rate of 0 bit/s is impossible; give one such as 500k")]
    ZeroBitrate,
    /// A window that is shorter than a frame.
    #[error(
        "a window must be longer than the longest frame, at {bitrate_bps} bit/s {shortest_us} µs; give a longer one"
    )]
    WindowTooShort {
        /// The slowest channel's bit rate.
        bitrate_bps: u32,
        /// The shortest window there, in µs.
        shortest_us: u64,
    },
    /// A window of more than a year.
    #[error("a window can be a year long at most")]
    WindowTooLong,
}

const SECOND: Duration = Duration::from_secs(1);
const YEAR: Duration = Duration::from_hours(365 * 24);

/// Statistics of all channels of a trace.
#[derive(Clone, Debug)]
pub struct Statistics {
    options: Options,
    window_ns: u64,
    first_ns: Option<i64>,
    last_ns: i64,
    /// In order of appearance; a trace has one or two.
    channels: Vec<ChannelStatistics>,
    /// Index in `channels` for the previous record, nearly always that of the current one or of the other
    /// channel.
    latest: usize,
    /// Channels, from 1, whose bit rate the trace has said.
    learned: Vec<u8>,
    lin_frames: u64,
}

impl Statistics {
    /// Nothing has been seen yet.
    pub fn new(options: Options) -> Result<Self, BadOptions> {
        let rates =
            options.channel_bitrate_bps.iter().map(|(_, bitrate)| *bitrate).chain(options.bitrate_bps);
        let slowest = rates.min();
        let mut data_rates = options
            .channel_data_bitrate_bps
            .iter()
            .map(|(_, bitrate)| *bitrate)
            .chain(options.data_bitrate_bps);
        let fastest_data = data_rates.clone().max();
        let window_ns = match u64::try_from(options.window.as_nanos()) {
            Ok(window_ns) if options.window <= YEAR => window_ns,
            _ => return Err(BadOptions::WindowTooLong),
        };
        if slowest == Some(0) || data_rates.any(|bitrate| bitrate == 0) {
            return Err(BadOptions::ZeroBitrate);
        }
        // Without any bit rate, the minimum window is that of the fastest bus.
        let bitrate_bps = slowest.unwrap_or(cantap_can::timing::MAX_BITRATE_BPS);
        let shortest_ns = match fastest_data {
            Some(_) => windows::shortest_fd_window_ns(bitrate_bps),
            None => shortest_window_ns(bitrate_bps),
        };
        if window_ns < shortest_ns {
            return Err(BadOptions::WindowTooShort { bitrate_bps, shortest_us: shortest_ns.div_ceil(1000) });
        }
        Ok(Self {
            options,
            window_ns,
            first_ns: None,
            last_ns: i64::MIN,
            channels: Vec::new(),
            latest: 0,
            learned: Vec::new(),
            lin_frames: 0,
        })
    }

    /// Takes the next record of the trace.
    #[inline]
    pub fn push(&mut self, record: &TraceRecord) {
        self.push_with(record, |_| {});
    }

    /// Like [`Self::push`], but also passes every window to `closed` when it is finished. A finished window
    /// is reported when the next frame of its channel comes, or by [`Self::advance_with`].
    #[inline]
    pub fn push_with(&mut self, record: &TraceRecord, mut closed: impl FnMut(&Window)) {
        if record.lin().is_some() {
            // Another bus, whatever its number.
            self.lin_frames += 1;
            return;
        }
        let place = match self.channels.get(self.latest) {
            Some(channel) if channel.number == record.channel => self.latest,
            _ => self.find_channel(record),
        };
        self.latest = place;
        self.last_ns = self.last_ns.max(record.time_ns);
        self.channels[place].push(record, &mut closed);
    }

    /// Frames of LIN buses, which are in no channel's figures.
    pub const fn lin_frames(&self) -> u64 {
        self.lin_frames
    }

    /// A trace has said a channel's bit rate. It is used from the channel's first record on, unless the options have one or the window is too
    /// short for it.
    pub fn learn_bitrate(&mut self, channel: u8, bitrate_bps: u32) {
        let is_possible = bitrate_bps > 0 && self.window_ns >= shortest_window_ns(bitrate_bps);
        if is_possible && self.options.bitrate_of(channel).is_none() {
            self.options.channel_bitrate_bps.push((channel, bitrate_bps));
            self.learned.push(channel);
        }
    }

    /// The bit rates of individual channels, those that the trace has said included: channel from 1, bit/s.
    pub fn channel_bitrates_bps(&self) -> &[(u8, u32)] {
        &self.options.channel_bitrate_bps
    }

    /// Whether a channel's bit rate is one that the trace has said ([`Self::learn_bitrate`]).
    pub fn is_learned(&self, channel: u8) -> bool {
        self.learned.contains(&channel)
    }

    /// The channel's index; it is added if necessary.
    #[cold]
    fn find_channel(&mut self, record: &TraceRecord) -> usize {
        if let Some(place) = self.channels.iter().position(|channel| channel.number == record.channel) {
            return place;
        }
        let bitrate = self.options.bitrate_of(record.channel);
        // Windows begin at the trace's first frame, on all channels alike.
        let origin_ns = *self.first_ns.get_or_insert_with(|| match (record.frame(), bitrate) {
            (Some(frame), Some(bitrate)) => {
                let bits = frame.bus_bits();
                let nominal = u64::from(bits.nominal - cantap_trace::bits::INTERMISSION_BITS);
                let data = self.options.data_bitrate_of(record.channel).unwrap_or(bitrate);
                let ns =
                    windows::bits_to_ns(nominal, bitrate) + windows::bits_to_ns(u64::from(bits.data), data);
                record.time_ns.saturating_sub(ns as i64)
            }
            _ => record.time_ns,
        });
        self.channels.push(ChannelStatistics::new(
            record.channel,
            bitrate,
            self.options.data_bitrate_of(record.channel),
            self.options.why_without_load(record.channel).is_none(),
            origin_ns,
            self.window_ns,
            self.options.peaks,
        ));
        self.channels.len() - 1
    }

    /// Nothing is known about the time from here to a channel's next record, for example because a device was gone:
    /// no interval or window that spans it counts for load, rate or period.
    pub fn interrupt(&mut self) {
        self.channels.iter_mut().for_each(ChannelStatistics::suspend);
    }

    /// The time is now `now_ns`, without a record: closes windows that have finished.
    pub fn advance_with(&mut self, now_ns: i64, mut closed: impl FnMut(&Window)) {
        self.last_ns = if self.channels.is_empty() { self.last_ns } else { self.last_ns.max(now_ns) };
        for channel in &mut self.channels {
            channel.advance(now_ns, &mut closed);
        }
    }

    /// The trace has ended: closes the last windows, truncated at its end.
    pub fn finish_with(&mut self, mut closed: impl FnMut(&Window)) {
        let end = self.last_ns;
        for channel in &mut self.channels {
            channel.finish(end, &mut closed);
        }
    }

    /// Like [`Self::finish_with`], ignoring windows.
    pub fn finish(&mut self) {
        self.finish_with(|_| {});
    }

    /// The channels seen, in order of appearance.
    pub fn channels(&self) -> &[ChannelStatistics] {
        &self.channels
    }

    /// One channel, if it had any record.
    pub fn channel(&self, number: u8) -> Option<&ChannelStatistics> {
        self.channels.iter().find(|channel| channel.number == number)
    }

    /// How long was watched, in nanoseconds: from where the windows begin to the latest record or [`Self::advance_with`].
    pub fn observed_ns(&self) -> u64 {
        let since = self.first_ns.map_or(0, |first| self.last_ns.saturating_sub(first));
        u64::try_from(since).unwrap_or(0)
    }

    /// Time of the latest record, in nanoseconds as in [`TraceRecord::time_ns`]; `None` before the first.
    pub fn last_ns(&self) -> Option<i64> {
        (!self.channels.is_empty()).then_some(self.last_ns)
    }
}

#[cfg(test)]
mod tests;
