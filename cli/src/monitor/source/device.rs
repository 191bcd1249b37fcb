//! A device as the source: session after session, whenever it is there.

use std::sync::mpsc::TryRecvError;
use std::time::{Duration, Instant};

use cantap::device::{Happening, Return, UtcClock};
use cantap::wire::message::{ChannelConfig, Periodic, TxFrame};
use cantap::{Channel, Device, Frame, TraceEvent, TraceRecord};

use super::super::model::{DeviceFigures, SourceState};
use super::{FIGURES_EVERY, Order, Plan, Source, Then, WAIT, lock};
use crate::advice;
use crate::live::{Line, line};

/// How long after its end a window is closed when nothing comes, so that a late frame still finds it open.
const LATENESS_NS: i64 = 1_000_000_000;

impl Source<'_> {
    pub(super) fn run_device(&mut self, mut plan: Plan) {
        let mut reconnects = 0;
        loop {
            let mut line = open_as(&plan);
            let then = self.listen(&plan, &mut line, reconnects);
            reconnects += line.gaps().count;
            if line.device().is_some() {
                self.end(&mut line);
                if !matches!(then, Then::Quit) {
                    self.note_gap(&plan.channels);
                }
            }
            drop(line);
            match then {
                Then::GoOn => {}
                Then::Autobaud => match self.autobaud(&mut plan) {
                    Then::Quit => return,
                    Then::Reopen(other) => plan = other,
                    Then::GoOn | Then::Autobaud => {}
                },
                Then::Reopen(other) => {
                    if other.address != plan.address {
                        reconnects = 0;
                        lock(self.model).begin_statistics();
                    }
                    plan = other;
                }
                Then::Quit => return,
            }
        }
    }

    /// Takes what comes, while the device is there and when it is back, and follows orders, until one ends it.
    fn listen(&mut self, plan: &Plan, line: &mut Line, reconnects: u32) -> Then {
        let clock = UtcClock::start();
        let mut next_figures = Instant::now();
        let mut pace = None;
        loop {
            match line.next(WAIT) {
                Happening::Records(batch) => self.hand_over(batch, line),
                Happening::Gone(error) => {
                    let mut model = lock(self.model);
                    model.source = SourceState::Gone(advice::sentence(&error));
                    model.interrupt();
                }
                Happening::Back(back) => {
                    let reconnects = reconnects + line.gaps().count;
                    pace = None;
                    if let Some(device) = line.device() {
                        self.greet(device, plan, &back, reconnects);
                    }
                }
                // Nobody has stopped it.
                Happening::Ended => return Then::GoOn,
            }
            if Instant::now() >= next_figures {
                next_figures = Instant::now() + FIGURES_EVERY;
                self.show_figures(line, &clock, &mut pace);
                self.show_recording();
            }
            loop {
                let followed = match self.orders.try_recv() {
                    Ok(order) => self.follow_with(line.device(), order),
                    Err(TryRecvError::Empty) => break,
                    Err(TryRecvError::Disconnected) => Then::Quit,
                };
                if !matches!(followed, Then::GoOn) {
                    return followed;
                }
            }
        }
    }

    /// Ends the session; what was captured until then is shown and recorded.
    fn end(&mut self, line: &mut Line) {
        // If that fails the device has just gone, and what was ordered still counts.
        let _ = line.stop();
        loop {
            match line.next(WAIT) {
                Happening::Records(batch) => self.hand_over(batch, line),
                Happening::Gone(_) | Happening::Back(_) => {}
                Happening::Ended => return,
            }
        }
    }

    fn show_figures(&self, line: &Line, clock: &UtcClock, pace: &mut Option<Pace>) {
        let Some(device) = line.device() else { return };
        // If it does not answer, the stream says so.
        let Ok(status) = device.status() else { return };
        let now_ns = clock.at(Instant::now()).0;
        let pace = pace.get_or_insert_with(|| Pace::new(now_ns, status.ticks, device.hello().tick_hz));
        let now_ns = pace.now_ns(now_ns, status.ticks);
        let mut model = lock(self.model);
        if let Some(figures) = &mut model.seen.device {
            figures.status = Some(status);
            figures.counters = device.counters();
            figures.clock = Some(device.clock());
        }
        // What is still on the way must not find its window closed.
        model.advance(now_ns.saturating_sub(LATENESS_NS));
    }

    /// The device is there: says whether it is the one from before, and takes over its bit rates.
    fn greet(&self, device: &Device, plan: &Plan, back: &Return, reconnects: u32) {
        let hello = device.hello();
        let name = format!("{} {}", hello.board, hello.serial);
        let opened = device.open_channels();
        let mut model = lock(self.model);
        if let Some(other) = &back.other_board {
            model.notice = format!("another board is at {} now: {other}", plan.address);
            if !back.only_listening.is_empty() {
                model.notice.push_str(", and its channels only listen");
            }
        } else if let Some(after) = back.after {
            model.notice = format!("{} is back after {:.1} s", plan.address, after.as_secs_f64());
        }
        model.seen.device = Some(DeviceFigures {
            queue_bytes: hello.queue_bytes,
            name,
            reconnects,
            ..DeviceFigures::default()
        });
        model.source = SourceState::Running;
        model.sessions += 1;
        let rates = opened
            .iter()
            .map(|(channel, config)| (channel.number(), config.timing.bitrate_bps(hello.can_clock_hz)));
        let rates: Vec<_> = rates.collect();
        let lacks =
            |lacks: fn(&ChannelConfig) -> bool| opened.iter().filter(move |(_, config)| lacks(config));
        let without_load: Vec<u8> = lacks(|config| config.omit_data || config.omit_stamps)
            .map(|(channel, _)| channel.number())
            .collect();
        if lacks(|config| config.omit_data).next().is_some() && model.notice.is_empty() {
            "the device leaves data out: zeros stand in its place, and the load is not known"
                .clone_into(&mut model.notice);
        }
        if without_load != model.options().without_load
            || rates.iter().any(|(channel, rate)| model.options().bitrate_of(*channel) != Some(*rate))
        {
            let options = cantap_analysis::stats::Options {
                bitrate_bps: None,
                channel_bitrate_bps: rates,
                without_load,
                ..model.options().clone()
            };
            if let Err(error) = model.set_options(options) {
                model.notice = error.to_string();
            }
        }
    }

    /// An order, where there is a device to send with.
    fn follow_with(&mut self, device: Option<&Device>, order: Order) -> Then {
        let Some(device) = device else { return self.follow(order) };
        match order {
            Order::Send(channel, frame) => {
                let frame = TxFrame { tag: 0, frame, at_ticks: None };
                if let Err(error) = device.send(channel, &[frame]) {
                    self.notice(advice::told(&error));
                }
                Then::GoOn
            }
            Order::SetPeriodic(channel, slot, entry) => {
                let entry = entry.map(|(frame, period)| periodic(device.hello().tick_hz, frame, period));
                if let Err(error) = device.set_periodic(channel, slot, entry) {
                    let mut model = lock(self.model);
                    model.notice = advice::told(&error);
                    model.refused.push((channel, slot));
                }
                Then::GoOn
            }
            order => self.follow(order),
        }
    }

    /// From now on nothing is known about the buses: the trace and the recording say so in place, and no figure
    /// spans it.
    fn note_gap(&mut self, channels: &[Channel]) {
        let time_ns = UtcClock::start().at(Instant::now()).0;
        let gap =
            |channel: &Channel| TraceRecord { time_ns, channel: channel.number(), event: TraceEvent::GAP };
        let mut gap: Vec<_> = channels.iter().map(gap).collect();
        self.keep_up(&mut gap);
        self.take(&gap);
        lock(self.model).interrupt();
    }

    /// The windows of the time before a gap may be closed already.
    fn keep_up(&self, records: &mut [TraceRecord]) {
        let now_ns = lock(self.model).seen.now_ns;
        for gap in records.iter_mut().filter(|record| record.event == TraceEvent::GAP) {
            gap.time_ns = gap.time_ns.max(now_ns);
        }
    }

    fn hand_over(&mut self, mut batch: Vec<TraceRecord>, line: &Line) {
        if !batch.is_empty() {
            self.keep_up(&mut batch);
            self.take(&batch);
            line.recycle(batch);
        }
    }
}

/// A device that is opened as the plan says.
fn open_as(plan: &Plan) -> Line {
    let Plan { address, channels, open } = plan.clone();
    let mode = plan.mode();
    line(&address, move |device| {
        // No filters, not even saved ones: what is not shown is still recorded.
        open.open(device, channels.iter().copied(), mode, None).map(|_| ())
    })
}

/// How a device's time passes: with the computer's, or, where it does not run in real time (an emulated board), behind it.
struct Pace {
    start_ns: i64,
    start_ticks: u64,
    tick_hz: u32,
}

impl Pace {
    /// A request's round trip, and what a busy computer adds.
    const JITTER_NS: i64 = 500_000_000;

    fn new(start_ns: i64, start_ticks: u64, tick_hz: u32) -> Self {
        Self { start_ns, start_ticks, tick_hz: tick_hz.max(1) }
    }

    /// The time on the device, which told `ticks` at `utc_ns`: the computer's, unless the device is more behind than a
    /// crystal can be.
    fn now_ns(&self, utc_ns: i64, ticks: u64) -> i64 {
        let ticks = u128::from(ticks.saturating_sub(self.start_ticks));
        let passed_ns = (ticks * 1_000_000_000 / u128::from(self.tick_hz)) as i64;
        let expected_ns = utc_ns.saturating_sub(self.start_ns);
        let is_behind = passed_ns < expected_ns - expected_ns / 100 - Self::JITTER_NS;
        if is_behind { self.start_ns.saturating_add(passed_ns) } else { utc_ns }
    }
}

fn periodic(tick_hz: u32, frame: Frame, period: Duration) -> Periodic {
    let ticks = period.as_nanos() * u128::from(tick_hz) / 1_000_000_000;
    Periodic {
        frame,
        period_ticks: u32::try_from(ticks).unwrap_or(u32::MAX),
        count: 0,
        modifiers: heapless::Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    #[test]
    fn a_device_that_lags_behind_tells_the_time_itself() {
        let pace = Pace::new(1000 * S, 12_000_000, 12_000_000);
        let at = |utc_s: i64, device_s: u64| pace.now_ns(utc_s * S, 12_000_000 * (1 + device_s)) / S;
        // A real one: drift and round trips do not matter, not for days.
        assert_eq!(at(1000, 0), 1000);
        assert_eq!(at(1000 + 100_000, 99_990), 101_000);
        assert_eq!(at(1000 + 100_000, 100_010), 101_000);
        // An emulated one at half the speed.
        assert_eq!(at(1010, 5), 1005);
        assert_eq!(at(1100, 50), 1050);
    }
}
