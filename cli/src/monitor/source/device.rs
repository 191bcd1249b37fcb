//! A device as the source: session after session, whenever it is there.

use std::sync::mpsc::{RecvTimeoutError, TryRecvError};
use std::time::{Duration, Instant};

use cantap::device::{Records, UtcClock};
use cantap::wire::message::{ChannelConfig, Periodic, TxFrame};
use cantap::wire::record::LossStage;
use cantap::{Channel, Device, Frame, TraceEvent, TraceRecord};

use super::super::model::{DeviceFigures, SourceState};
use super::{FIGURES_EVERY, Order, Plan, Source, Then, WAIT, lock};

/// How long after it was gone a device is tried again.
const RETRY_AFTER: Duration = Duration::from_secs(1);
/// A window is closed so long after its end although nothing came, so that a late frame finds it open.
const LATENESS_NS: i64 = 1_000_000_000;

/// The board that was at the address, to tell whether it is the same that comes back.
struct Known {
    name: String,
    reconnects: u32,
    gone_at: Option<Instant>,
}

impl Source<'_> {
    pub(super) fn run_device(&mut self, mut plan: Plan) {
        let mut known = None;
        loop {
            let then = self.session(&plan, &mut known).unwrap_or_else(|error| {
                lock(self.model).source = SourceState::Gone(format!("{error:#}"));
                self.wait_for_it()
            });
            match then {
                Then::GoOn => {}
                Then::Autobaud => match self.autobaud(&mut plan) {
                    Then::Quit => return,
                    Then::Reopen(other) => plan = other,
                    Then::GoOn | Then::Autobaud => {}
                },
                Then::Reopen(other) => {
                    if other.address != plan.address {
                        known = None;
                        lock(self.model).begin_statistics();
                    }
                    plan = other;
                }
                Then::Quit => return,
            }
        }
    }

    /// The device may come back, and the user may choose another one meanwhile.
    fn wait_for_it(&mut self) -> Then {
        let retry_at = Instant::now() + RETRY_AFTER;
        loop {
            match self.orders.recv_timeout(retry_at.saturating_duration_since(Instant::now())) {
                Ok(order) => match self.follow(order) {
                    Then::GoOn => {}
                    then => return then,
                },
                Err(RecvTimeoutError::Timeout) => break,
                Err(RecvTimeoutError::Disconnected) => return Then::Quit,
            }
        }
        self.show_recording();
        Then::GoOn
    }

    /// One session with the device, until it is gone or an order ends it.
    fn session(&mut self, plan: &Plan, known: &mut Option<Known>) -> anyhow::Result<Then> {
        let device = Device::open(&plan.address)?;
        let mut records = device.records();
        // No filters, saved ones neither: what is not shown is recorded all the same.
        let opened = plan.open.open(&device, plan.channels.iter().copied(), plan.mode(), None)?;
        let clock = UtcClock::start();
        self.greet(&device, plan, &opened, known);
        let ended = self.listen(&device, &mut records, &clock);
        if ended.is_ok() {
            // If that fails the device has just gone, and the order counts all the same.
            let _ = device.stop();
        }
        // What was captured until then is shown and recorded, whatever ended it.
        while let Ok(Some(batch)) = records.next_batch(WAIT)
            && !batch.is_empty()
        {
            self.hand_over(batch, &records);
        }
        if !matches!(ended, Ok(Then::Quit)) {
            self.note_gap(&plan.channels, clock.at(Instant::now()));
        }
        if let Some(known) = known {
            known.gone_at = Some(Instant::now());
        }
        ended
    }

    /// The device is there: says whether it is the one from before, and takes over its bit rates.
    fn greet(
        &mut self,
        device: &Device,
        plan: &Plan,
        opened: &[(Channel, ChannelConfig)],
        known: &mut Option<Known>,
    ) {
        let hello = device.hello();
        let name = format!("{} {}", hello.board, hello.serial);
        let was_gone = matches!(lock(self.model).source, SourceState::Gone(_));
        let mut model = lock(self.model);
        let reconnects = match known {
            Some(known) if known.name != name => {
                model.notice =
                    format!("another board is at {} now: {name} in place of {}", plan.address, known.name);
                known.reconnects + 1
            }
            Some(known) if was_gone => {
                let seconds = known.gone_at.map_or(0.0, |gone_at| gone_at.elapsed().as_secs_f64());
                model.notice = format!("{} is back after {seconds:.1} s", plan.address);
                known.reconnects + 1
            }
            Some(known) => known.reconnects,
            None => 0,
        };
        *known = Some(Known { name: name.clone(), reconnects, gone_at: None });
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
            let options = cantap::stats::Options {
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

    /// Takes what comes and follows orders, until one ends the session.
    fn listen(&mut self, device: &Device, records: &mut Records, clock: &UtcClock) -> anyhow::Result<Then> {
        let mut next_figures = Instant::now();
        let mut pace = None;
        loop {
            match records.next_batch(WAIT)? {
                Some(batch) => self.hand_over(batch, records),
                None => anyhow::bail!("the device ended its stream; it is opened again"),
            }
            if Instant::now() >= next_figures {
                next_figures = Instant::now() + FIGURES_EVERY;
                let status = device.status()?;
                let now_ns = clock.at(Instant::now());
                let pace =
                    pace.get_or_insert_with(|| Pace::new(now_ns, status.ticks, device.hello().tick_hz));
                let now_ns = pace.now_ns(now_ns, status.ticks);
                let mut model = lock(self.model);
                if let Some(figures) = &mut model.seen.device {
                    figures.status = Some(status);
                    figures.counters = device.counters();
                    figures.clock = Some(device.clock());
                }
                // What is still on the way must not find its window closed.
                model.advance(now_ns.saturating_sub(LATENESS_NS));
                drop(model);
                self.show_recording();
            }
            loop {
                match self.orders.try_recv() {
                    Ok(order) => match self.follow_with(device, order) {
                        Then::GoOn => {}
                        then => return Ok(then),
                    },
                    Err(TryRecvError::Empty) => break,
                    Err(TryRecvError::Disconnected) => return Ok(Then::Quit),
                }
            }
        }
    }

    /// An order, where there is a device to send with.
    fn follow_with(&mut self, device: &Device, order: Order) -> Then {
        match order {
            Order::Send(channel, frame) => {
                let frame = TxFrame { tag: 0, frame, at_ticks: None };
                if let Err(error) = device.send(channel, &[frame]) {
                    self.notice(error.to_string());
                }
                Then::GoOn
            }
            Order::SetPeriodic(channel, slot, entry) => {
                let entry = entry.map(|(frame, period)| periodic(device.hello().tick_hz, frame, period));
                if let Err(error) = device.set_periodic(channel, slot, entry) {
                    let mut model = lock(self.model);
                    model.notice = error.to_string();
                    model.refused.push((channel, slot));
                }
                Then::GoOn
            }
            order => self.follow(order),
        }
    }

    /// From now on nothing is known about the buses: the trace and the recording say so in place, and no figure
    /// spans it. How many frames are missing nobody knows: at least none.
    fn note_gap(&mut self, channels: &[Channel], now_ns: i64) {
        let time_ns = lock(self.model).seen.now_ns.max(now_ns);
        let event = TraceEvent::Lost { stage: Some(LossStage::Link), count: 0, at_least: true };
        let gap = channels.iter().map(|channel| TraceRecord { time_ns, channel: channel.number(), event });
        let gap: Vec<_> = gap.collect();
        self.take(&gap);
        lock(self.model).interrupt();
    }

    fn hand_over(&mut self, batch: Vec<TraceRecord>, records: &Records) {
        if !batch.is_empty() {
            self.take(&batch);
            records.recycle(batch);
        }
    }
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
