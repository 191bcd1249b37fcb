//! How busy a bus is in equal windows of time.
//!
//! Counts exact bits. A frame occupies the bus from its start of frame to the end of the intermission after it; its time
//! stamp is its end, before the intermission.

use std::collections::VecDeque;

use cantap_trace::BusBits;
use cantap_trace::bits::INTERMISSION_BITS;

/// The least number of bits of an error frame: a flag of six, a delimiter of eight, and the intermission. The
/// flags of several nodes may stretch it by six, and how much was sent of the destroyed frame is unknown, so
/// a load with errors is a lower bound.
pub const ERROR_FRAME_BITS: u32 = 6 + 8 + INTERMISSION_BITS;

/// Bits of the longest classical frame, with stuff bits and intermission.
const LONGEST_FRAME_BITS: u64 = 160;

/// Bits of the longest CAN FD frame, all at the nominal rate: 41 of its header, 64 bytes, a stuff bit after every four of these
/// bits, 4 of the stuff count, 21 of the CRC, 7 in fixed places, delimiter, end and intermission.
const LONGEST_FD_FRAME_BITS: u64 = (41 + 512) * 5 / 4 + 4 + 21 + 7 + 1 + 9 + 3;

/// The duration of `bits` in nanoseconds, rounded to the nearest.
pub(super) fn bits_to_ns(bits: u64, bitrate_bps: u32) -> u64 {
    let bitrate = u64::from(bitrate_bps);
    // A file may claim any number of suppressed errors.
    bits.saturating_mul(1_000_000_000).saturating_add(bitrate / 2) / bitrate
}

/// The shortest window at this bit rate that is longer than any frame, in nanoseconds.
pub fn shortest_window_ns(bitrate_bps: u32) -> u64 {
    bits_to_ns(LONGEST_FRAME_BITS, bitrate_bps.max(1))
}

/// Like [`shortest_window_ns`], if there may be CAN FD frames.
pub(super) fn shortest_fd_window_ns(bitrate_bps: u32) -> u64 {
    bits_to_ns(LONGEST_FD_FRAME_BITS, bitrate_bps.max(1))
}

/// One window of time on one channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    /// Channel, from 1.
    pub channel: u8,
    /// Where it begins, in nanoseconds as in [`cantap_trace::TraceRecord::time_ns`].
    pub start_ns: i64,
    /// Its length. The last window of a trace is truncated at the trace's end.
    pub length_ns: u64,
    /// Whether it is truncated.
    pub is_cut: bool,
    /// Frames that ended in it.
    pub frames: u64,
    /// Their bits, with stuff bits and intermission.
    pub bits: u64,
    /// Error frames in it.
    pub errors: u64,
    /// Lost frames whose record is in it.
    pub lost: u64,
    /// Whether frames are missing from it, or may be: its figures are lower bounds.
    pub incomplete: bool,
    /// Load in per cent, including the parts of frames across its borders, and error frames with their
    /// minimum length; `None` without a bit rate.
    pub load_pct: Option<f64>,
    busy_ns: u64,
}

impl Window {
    fn new(channel: u8, start_ns: i64, length_ns: u64) -> Self {
        Self {
            channel,
            start_ns,
            length_ns,
            is_cut: false,
            frames: 0,
            bits: 0,
            errors: 0,
            lost: 0,
            incomplete: false,
            load_pct: None,
            busy_ns: 0,
        }
    }

    fn is_empty(&self) -> bool {
        self.busy_ns == 0 && self.frames + self.errors + self.lost == 0
    }

    /// Frames per second.
    pub fn frames_per_s(&self) -> f64 {
        per_second(self.frames, self.length_ns)
    }

    /// Bits per second, with stuff bits and intermission, excluding error frames.
    pub fn bits_per_s(&self) -> f64 {
        per_second(self.bits, self.length_ns)
    }
}

/// `count` over `length_ns`, as a rate per second; zero over no time.
pub(super) fn per_second(count: u64, length_ns: u64) -> f64 {
    if length_ns == 0 { 0.0 } else { count as f64 * 1e9 / length_ns as f64 }
}

/// Divides one channel's time into equal windows and keeps the extremes of the whole ones.
#[derive(Clone, Debug)]
pub(super) struct Windows {
    length_ns: u64,
    bitrate_bps: Option<u32>,
    data_bitrate_bps: Option<u32>,
    current: Window,
    /// The part of a frame's intermission that extends into the next window.
    carry_ns: u64,
    /// A window that is held back for a frame that may have begun in it.
    pending: Option<Window>,
    peaks: Peaks,
    /// Frames are missing between here and the next one.
    in_gap: bool,
    /// Number of windows that are finished and complete.
    whole: u64,
    load_min: f64,
    load_sum: f64,
    /// Nothing is known from the last record to the next one: no window spans that time.
    suspended: bool,
}

impl Windows {
    pub(super) fn new(
        channel: u8,
        origin_ns: i64,
        length_ns: u64,
        bitrate_bps: Option<u32>,
        data_bitrate_bps: Option<u32>,
        peaks: usize,
    ) -> Self {
        Self {
            length_ns,
            bitrate_bps,
            data_bitrate_bps,
            current: Window::new(channel, origin_ns, length_ns),
            carry_ns: 0,
            pending: None,
            peaks: Peaks::new(peaks),
            in_gap: false,
            whole: 0,
            load_min: f64::INFINITY,
            load_sum: 0.0,
            suspended: false,
        }
    }

    /// The duration of frames turned out to be unknown: there is no load, neither for this window nor for earlier
    /// ones.
    pub(super) fn forget_load(&mut self) {
        self.bitrate_bps = None;
        let forget = |window: &mut Window| (window.load_pct, window.busy_ns) = (None, 0);
        self.pending.iter_mut().chain(&mut self.peaks.best).for_each(forget);
        self.current.busy_ns = 0;
        self.carry_ns = 0;
    }

    /// Nothing is known from here to the next record: the current window is meaningless, and there are none until then.
    pub(super) fn suspend(&mut self) {
        self.suspended = true;
    }

    /// Whether it is suspended and no record has come since.
    pub(super) fn is_suspended(&self) -> bool {
        self.suspended
    }

    /// The time is now `now_ns`: closes every window that ended before.
    #[inline]
    pub(super) fn advance(&mut self, now_ns: i64, closed: &mut impl FnMut(&Window)) {
        let ahead = now_ns.saturating_sub(self.current.start_ns);
        if self.suspended {
            self.resume(now_ns, closed);
        } else if ahead >= self.length_ns as i64 {
            self.advance_slowly(now_ns, closed);
        } else if ahead < -(self.length_ns as i64) {
            self.start_over(now_ns, closed);
        }
    }

    /// The trace's clock was set back, as where two logs were joined: the grid restarts at `now_ns`.
    #[cold]
    fn start_over(&mut self, now_ns: i64, closed: &mut impl FnMut(&Window)) {
        self.close_pending(closed);
        self.carry_ns = 0;
        let window = Window::new(self.current.channel, now_ns, self.length_ns);
        let mut cut = std::mem::replace(&mut self.current, window);
        self.finish_load(&mut cut);
        closed(&cut);
    }

    /// The first record after [`Self::suspend`]: the grid restarts at `now_ns`.
    #[cold]
    fn resume(&mut self, now_ns: i64, closed: &mut impl FnMut(&Window)) {
        self.close_pending(closed);
        self.suspended = false;
        self.carry_ns = 0;
        self.current = Window::new(self.current.channel, now_ns, self.length_ns);
    }

    #[cold]
    fn advance_slowly(&mut self, now_ns: i64, closed: &mut impl FnMut(&Window)) {
        let length = self.length_ns as i64;
        let mut steps = now_ns.saturating_sub(self.current.start_ns) / length;
        while steps > 0 {
            // Hours of silence are many equal empty windows: count them, but do not report each.
            if steps > MOST_SILENT_WINDOWS && self.current.is_empty() {
                let silent = steps - 1;
                if !self.in_gap {
                    self.whole += silent as u64;
                    self.load_min = 0.0;
                }
                self.current.start_ns = self.current.start_ns.saturating_add(silent * length);
                steps = 1;
            }
            self.close_pending(closed);
            let start = self.current.start_ns.saturating_add(length);
            let mut window = Window::new(self.current.channel, start, self.length_ns);
            window.busy_ns = std::mem::take(&mut self.carry_ns);
            window.incomplete = self.in_gap;
            self.pending = Some(std::mem::replace(&mut self.current, window));
            steps -= 1;
        }
    }

    /// A frame of `bits` that ended at `end_ns`. Call [`Self::advance`] with `end_ns` first.
    #[inline]
    pub(super) fn frame(&mut self, end_ns: i64, bits: BusBits, closed: &mut impl FnMut(&Window)) {
        self.in_gap = false;
        self.current.frames += 1;
        self.current.bits += u64::from(bits.total());
        let Some(bitrate) = self.bitrate_bps else {
            return self.close_pending(closed);
        };
        // Relative to the window's start, so that no file's times overflow.
        let end = end_ns.saturating_sub(self.current.start_ns).clamp(-1, self.length_ns as i64);
        let data_ns = match self.data_bitrate_bps {
            Some(data_bitrate) if bits.data > 0 => bits_to_ns(u64::from(bits.data), data_bitrate) as i64,
            _ => 0,
        };
        let start = end - bits_to_ns(u64::from(bits.nominal - INTERMISSION_BITS), bitrate) as i64 - data_ns;
        let stop = start + bits_to_ns(u64::from(bits.nominal), bitrate) as i64 + data_ns;
        // A stamp from the past (badly merged traces) is counted in full where it arrives.
        let before = if end < 0 { 0 } else { (-start).max(0) };
        let after = (stop - self.length_ns as i64).max(0);
        self.current.busy_ns += (stop - start - before - after) as u64;
        self.carry_ns += after as u64;
        if let Some(pending) = &mut self.pending {
            pending.busy_ns += before as u64;
        }
        self.close_pending(closed);
    }

    /// Counts error frames.
    pub(super) fn errors(&mut self, count: u64) {
        self.current.errors += count;
        if let Some(bitrate) = self.bitrate_bps {
            let busy_ns = bits_to_ns(count * u64::from(ERROR_FRAME_BITS), bitrate);
            self.current.busy_ns = self.current.busy_ns.saturating_add(busy_ns);
        }
    }

    /// Frames are missing between the last one and the next, at unknown times. Call [`Self::advance`] for the
    /// time at which this is known afterwards.
    pub(super) fn gap(&mut self) {
        self.in_gap = true;
        self.current.incomplete = true;
        if self.current.frames == 0
            && let Some(pending) = &mut self.pending
        {
            pending.incomplete = true;
        }
    }

    /// Counts lost frames.
    pub(super) fn lost(&mut self, count: u64) {
        self.current.lost += count;
    }

    fn close_pending(&mut self, closed: &mut impl FnMut(&Window)) {
        let Some(mut window) = self.pending.take() else {
            return;
        };
        self.finish_load(&mut window);
        self.count(&window);
        closed(&window);
    }

    /// Includes a window in the extremes. An incomplete one may be a peak, as a lower bound, but does not count for the least
    /// or the mean.
    fn count(&mut self, window: &Window) {
        self.peaks.offer(window);
        if window.incomplete {
            return;
        }
        self.whole += 1;
        if let Some(load) = window.load_pct {
            self.load_min = self.load_min.min(load);
            self.load_sum += load;
        }
    }

    fn finish_load(&self, window: &mut Window) {
        window.load_pct = self
            .bitrate_bps
            .filter(|_| window.length_ns > 0)
            .map(|_| (window.busy_ns as f64 * 100.0 / window.length_ns as f64).min(100.0));
    }

    /// The current window, up to `now_ns`.
    pub(super) fn running(&self, now_ns: i64) -> Window {
        let mut window = self.current;
        window.length_ns =
            u64::try_from(now_ns.saturating_sub(window.start_ns)).unwrap_or(0).min(self.length_ns);
        window.is_cut = window.length_ns < self.length_ns;
        self.finish_load(&mut window);
        window
    }

    /// The trace ends at `now_ns`: closes the whole windows and the truncated rest, which does not count for
    /// the extremes unless there is nothing else.
    pub(super) fn finish(&mut self, now_ns: i64, closed: &mut impl FnMut(&Window)) {
        if self.suspended {
            return self.close_pending(closed);
        }
        self.advance(now_ns, closed);
        self.close_pending(closed);
        let rest = self.running(now_ns);
        if rest.frames + rest.errors + rest.lost == 0 {
            return;
        }
        // With only a few frames, the load would be near 100 %, whatever the bus was doing.
        if self.whole == 0 && rest.length_ns >= self.length_ns / LEAST_PART {
            self.count(&rest);
        }
        closed(&rest);
    }

    /// Least and mean load of the whole windows from which no frame is missing, in per cent.
    pub(super) fn least_and_mean_pct(&self) -> Option<(f64, f64)> {
        (self.bitrate_bps.is_some() && self.whole > 0)
            .then(|| (self.load_min, self.load_sum / self.whole as f64))
    }

    /// Largest load of a whole window, in per cent: a lower bound if frames are missing from it.
    pub(super) fn largest_pct(&self) -> Option<f64> {
        self.peaks.best.front()?.load_pct
    }

    /// The busiest windows, the busiest first.
    pub(super) fn peaks(&self) -> impl Iterator<Item = &Window> {
        self.peaks.best.iter()
    }
}

/// A trace shorter than a window has none; its own length counts as one if it is at least this fraction of a
/// window.
const LEAST_PART: u64 = 10;

/// How many silent windows are reported one by one; those of a longer silence are only counted.
const MOST_SILENT_WINDOWS: i64 = 86_400;

/// The busiest windows: by load, or by frames if no bit rate is known.
#[derive(Clone, Debug)]
struct Peaks {
    most: usize,
    best: VecDeque<Window>,
}

impl Peaks {
    fn new(most: usize) -> Self {
        Self { most: most.max(1), best: VecDeque::new() }
    }

    fn offer(&mut self, window: &Window) {
        let busier = |other: &Window| (other.load_pct, other.frames) >= (window.load_pct, window.frames);
        let place = self.best.iter().position(|other| !busier(other)).unwrap_or(self.best.len());
        if place < self.most {
            self.best.insert(place, *window);
            self.best.truncate(self.most);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn classic(nominal: u32) -> BusBits {
        BusBits { nominal, data: 0 }
    }

    #[test]
    fn windows_between_the_last_frame_and_a_loss_record_are_incomplete_and_count_for_no_mean() {
        let mut windows = windows(1_000_000);
        let mut seen = Vec::new();
        for end in [500_000, 1_500_000, 2_500_000] {
            windows.advance(end, &mut |window| seen.push(*window));
            windows.frame(end, classic(100), &mut |window| seen.push(*window));
        }
        windows.gap();
        windows.advance(5_500_000, &mut |window| seen.push(*window));
        windows.lost(7);
        for end in [5_500_000, 6_500_000] {
            windows.advance(end, &mut |window| seen.push(*window));
            windows.frame(end, classic(100), &mut |window| seen.push(*window));
        }
        windows.finish(8_000_000, &mut |window| seen.push(*window));
        let incomplete: Vec<_> = seen.iter().map(|window| window.incomplete).collect();
        assert_eq!(incomplete, [false, false, true, true, true, true, false, false]);
        let lost: Vec<_> = seen.iter().map(|window| window.lost).collect();
        assert_eq!(lost, [0, 0, 0, 0, 0, 7, 0, 0]);
        let (min, mean) = windows.least_and_mean_pct().unwrap();
        assert!(min.abs() < 1e-9 && (mean - 7.5).abs() < 1e-9, "{min} {mean}");
    }

    fn windows(bitrate_bps: u32) -> Windows {
        Windows::new(1, 0, 1_000_000, Some(bitrate_bps), None, 3)
    }

    #[test]
    fn a_frame_across_a_border_counts_in_both_windows() {
        let mut windows = windows(1_000_000);
        let mut seen = Vec::new();
        // 103 bits: 30 µs of it before the border, 70 after it, and 3 of intermission.
        windows.advance(1_070_000, &mut |window| seen.push(*window));
        windows.frame(1_070_000, classic(103), &mut |window| seen.push(*window));
        windows.finish(2_000_000, &mut |window| seen.push(*window));
        let loads: Vec<_> = seen.iter().map(|window| window.load_pct.unwrap()).collect();
        assert_eq!(loads, [3.0, 7.3]);
        assert_eq!(seen[0].frames, 0);
        assert_eq!(seen[1].frames, 1);
    }

    /// A single frame once was 100 % in "windows of 1 s".
    #[test]
    fn a_trace_far_shorter_than_a_window_has_none() {
        for (end, whole) in [(58_000, 0), (99_000, 0), (100_000, 1), (900_000, 1)] {
            let mut windows = windows(1_000_000);
            windows.advance(end, &mut |_| {});
            windows.frame(end, classic(58), &mut |_| {});
            windows.finish(end, &mut |_| {});
            assert_eq!((windows.whole, windows.peaks().count() as u64), (whole, whole), "{end}");
        }
    }

    #[test]
    fn a_saturated_bus_fills_every_window() {
        let mut windows = windows(1_000_000);
        let mut loads = Vec::new();
        for n in 1..=1000 {
            let end = n * 58_000 - 3_000;
            windows.advance(end, &mut |window| loads.push(window.load_pct.unwrap()));
            windows.frame(end, classic(58), &mut |window| loads.push(window.load_pct.unwrap()));
        }
        assert_eq!(loads.len(), 57);
        assert!(loads.iter().all(|load| (load - 100.0).abs() < 1e-9), "{loads:?}");
    }

    #[test]
    fn error_frames_add_their_least_length() {
        let mut windows = windows(1_000_000);
        windows.errors(10);
        let mut loads = Vec::new();
        windows.finish(1_000_000, &mut |window| loads.push(window.load_pct.unwrap()));
        assert_eq!(loads, [17.0]);
    }

    #[test]
    fn a_year_of_silence_costs_no_time_and_keeps_the_windows_grid() {
        let mut windows = windows(1_000_000);
        let year = 365 * 86_400 * 1_000_000_000;
        let mut count = 0u64;
        windows.frame(500_000, classic(58), &mut |_| count += 1);
        windows.advance(year + 250_000, &mut |_| count += 1);
        windows.frame(year + 250_000, classic(58), &mut |_| count += 1);
        let running = windows.running(year + 300_000);
        assert_eq!((running.start_ns, running.frames), (year, 1));
        assert!(count < 200_000, "{count}");
        assert_eq!(windows.whole, year as u64 / 1_000_000);
        let (min, mean) = windows.least_and_mean_pct().unwrap();
        let max = windows.largest_pct().unwrap();
        assert!(min.abs() < 1e-12 && mean < 1e-6 && (max - 5.8).abs() < 1e-9);
    }

    #[test]
    fn a_clock_that_is_set_back_starts_a_new_grid() {
        let mut windows = windows(1_000_000);
        let mut seen = Vec::new();
        for end in [9_500_000, 2_250_000, 3_250_000, 4_300_000] {
            windows.advance(end, &mut |window| seen.push((window.start_ns, window.frames)));
            windows.frame(end, classic(58), &mut |window| seen.push((window.start_ns, window.frames)));
        }
        assert_eq!(seen[8..], [(8_000_000, 0), (9_000_000, 1), (2_250_000, 1), (3_250_000, 1)]);
    }

    #[test]
    fn peaks_are_the_busiest_windows_in_order() {
        let mut windows = windows(1_000_000);
        for (window, frames) in [(0, 3), (1, 9), (2, 1), (3, 5)] {
            for frame in 1..=frames {
                let end = window * 1_000_000 + frame * 100_000;
                windows.advance(end, &mut |_| {});
                windows.frame(end, classic(58), &mut |_| {});
            }
        }
        windows.finish(4_000_000, &mut |_| {});
        let peaks: Vec<_> = windows.peaks().map(|window| window.frames).collect();
        assert_eq!(peaks, [9, 5, 3]);
    }
}
