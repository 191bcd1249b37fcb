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
        if rates.iter().any(|(channel, rate)| model.options().bitrate_of(*channel) != Some(*rate)) {
            let options = cantap::stats::Options {
                bitrate_bps: None,
                channel_bitrate_bps: rates,
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
        loop {
            match records.next_batch(WAIT)? {
                Some(batch) => self.hand_over(batch, records),
                None => anyhow::bail!("the device ended its stream; it is opened again"),
            }
            if Instant::now() >= next_figures {
                next_figures = Instant::now() + FIGURES_EVERY;
                let status = device.status()?;
                let mut model = lock(self.model);
                if let Some(figures) = &mut model.seen.device {
                    figures.status = Some(status);
                    figures.counters = device.counters();
                    figures.clock = Some(device.clock());
                }
                // What is still on the way must not find its window closed.
                model.advance(clock.at(Instant::now()).saturating_sub(LATENESS_NS));
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

fn periodic(tick_hz: u32, frame: Frame, period: Duration) -> Periodic {
    let ticks = period.as_nanos() * u128::from(tick_hz) / 1_000_000_000;
    Periodic {
        frame,
        period_ticks: u32::try_from(ticks).unwrap_or(u32::MAX),
        count: 0,
        modifiers: heapless::Vec::new(),
    }
}
