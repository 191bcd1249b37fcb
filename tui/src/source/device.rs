//! A device as the source: one session after another, whenever it is there.

use std::collections::VecDeque;
use std::sync::mpsc::TryRecvError;
use std::time::Instant;

use cantap::device::{Happening, Return, UtcClock, channel_number};
use cantap::wire::message::{ChannelConfig, Periodic, TxFrame};
use cantap::wire::record::ErrorState;
use cantap::{Channel, TraceEvent, TraceRecord};

use super::super::model::{DeviceFigures, SourceState};
use super::super::order::{Order, Repeated};
use super::super::plan::Plan;
use super::session_scripts::BOARD;
use super::timed::{Ended, Timed};
use super::{FIGURES_EVERY, SCRIPTS_WAIT, Source, Then, WAIT, lock};
use cantap_work::advice;
use cantap_work::bus_hints::BusHint;
use cantap_work::channels::place_of;
use cantap_work::live::{Line, Lines, lines};
use cantap_work::reception::Reception;
use cantap_work::report::Reporter;

/// How long after its end a window is closed if nothing arrives, so that a late frame still finds it open.
const LATENESS_NS: i64 = 1_000_000_000;

impl Source<'_> {
    pub(super) fn run_device(&mut self, mut plan: Plan) {
        let mut reconnects = vec![0; plan.addresses.len()];
        let mut is_new = true;
        loop {
            let first = std::mem::take(&mut is_new);
            let found = if plan.open.timing.has_auto() {
                Some(self.find_requested(&mut plan))
            } else if first && Self::lacks_bit_rates(&plan) {
                Some(self.find_bit_rates(&mut plan))
            } else {
                None
            };
            if let Some(found) = found {
                match found {
                    Then::GoOn | Then::Autobaud => {}
                    Then::Reopen(other) => {
                        (plan, is_new) = (other, true);
                        continue;
                    }
                    Then::Quit => return,
                }
            }
            let mut lines = open_as(&plan);
            reconnects.resize(plan.addresses.len(), 0);
            lock(self.model).reception = Reception::default();
            let then = self.listen(&plan, &mut lines, &reconnects);
            for (count, line) in reconnects.iter_mut().zip(lines.lines()) {
                *count += line.gaps().count;
            }
            let board = lines.lines().nth(BOARD).and_then(Line::device);
            self.forget_scripts(board, "its session with the device is over");
            self.forget_asking("the session with the device is over");
            if lines.devices().next().is_some() {
                self.end(&mut lines);
                if !matches!(then, Then::Quit) {
                    self.note_gap(&plan.channels);
                }
            }
            drop(lines);
            match then {
                Then::GoOn => {}
                Then::Autobaud => match self.autobaud(&mut plan) {
                    Then::Quit => return,
                    Then::Reopen(other) => (plan, is_new) = (other, true),
                    Then::GoOn | Then::Autobaud => {}
                },
                Then::Reopen(other) => {
                    if other.addresses != plan.addresses {
                        reconnects.clear();
                        let mut model = lock(self.model);
                        model.begin_statistics();
                        model.seen.devices.clear();
                        is_new = true;
                    }
                    plan = other;
                }
                Then::Quit => return,
            }
        }
    }

    /// Takes what arrives while the devices are there, and when they are back, and follows orders until one ends
    /// it.
    fn listen(&mut self, plan: &Plan, lines: &mut Lines, reconnects: &[u32]) -> Then {
        let clock = UtcClock::start();
        let mut next_figures = Instant::now();
        let mut paces = vec![None; plan.addresses.len()];
        // Devices of which nothing is known yet, and orders that came meanwhile.
        let mut unknown = vec![true; plan.addresses.len()];
        let mut early = VecDeque::new();
        let mut recoveries: Vec<_> = plan.addresses.iter().map(|_| plan.open.recovery()).collect();
        self.timed = Timed::default();
        lock(self.model).source = SourceState::Starting;
        loop {
            let is_awaited = self.scripts.are_running() || self.awaits_an_answer();
            let wait = if is_awaited { SCRIPTS_WAIT } else { WAIT };
            match lines.next(wait) {
                (_, Happening::Records(batch)) => self.hand_over(batch, lines),
                (board, Happening::Gone(error)) => {
                    unknown[board] = false;
                    self.timed.forget(board);
                    let reason = advice::sentence(&error);
                    if board == BOARD {
                        self.forget_scripts(None, &reason);
                        self.forget_asking("the device is gone");
                    }
                    let mut model = lock(self.model);
                    if lines.devices().next().is_none() {
                        model.source = SourceState::Gone(reason);
                    } else {
                        model.notice = format!("{reason}; the other devices go on");
                    }
                    model.interrupt();
                }
                (board, Happening::Back(back)) => {
                    let reconnects = reconnects.get(board).copied().unwrap_or_default();
                    paces[board] = None;
                    unknown[board] = false;
                    self.timed.forget(board);
                    self.greet(board, lines, plan, &back, reconnects);
                }
                // Nobody has stopped it.
                (_, Happening::Ended) => return Then::GoOn,
            }
            for (board, device) in lines.devices() {
                // If it does not answer, the stream reports that.
                let back = recoveries[board].as_mut().and_then(|recovery| recovery.look(device).ok());
                for channel in back.into_iter().flatten() {
                    let number = channel_number(board, channel);
                    self.notice(format!("channel {number} was bus-off and joins the bus again"));
                }
            }
            for (board, device) in lines.devices() {
                for Ended { number, slot, reason } in self.timed.go_on(board, device) {
                    let mut model = lock(self.model);
                    model.notice = reason;
                    model.refused.push((number, slot));
                }
            }
            let scripts_on = lines.lines().nth(BOARD).and_then(Line::device);
            if let Some(device) = scripts_on {
                self.serve_scripts(device);
                self.go_on_asking(device);
            }
            if Instant::now() >= next_figures {
                next_figures = Instant::now() + FIGURES_EVERY;
                if let Some(device) = scripts_on {
                    self.show_gateway(device);
                }
                self.show_figures(lines, &clock, &mut paces);
                self.show_recording();
            }
            loop {
                let is_known = !unknown.contains(&true);
                let waited = if is_known { early.pop_front() } else { None };
                let followed = match waited.map_or_else(|| self.orders.try_recv(), Ok) {
                    Ok(
                        order @ (Order::Send(..)
                        | Order::SetPeriodic(..)
                        | Order::StartScript(_)
                        | Order::StopScript(_)
                        | Order::Ask(_)),
                    ) if !is_known => {
                        early.push_back(order);
                        Then::GoOn
                    }
                    Ok(order) => self.follow_with(lines, order),
                    Err(TryRecvError::Empty) => break,
                    Err(TryRecvError::Disconnected) => Then::Quit,
                };
                if !matches!(followed, Then::GoOn) {
                    return followed;
                }
            }
        }
    }

    /// Ends the session; what was captured up to then is shown and recorded.
    fn end(&mut self, lines: &mut Lines) {
        // If that fails, a device has just gone, and the order still applies.
        let _ = lines.stop();
        loop {
            match lines.next(WAIT).1 {
                Happening::Records(batch) => self.hand_over(batch, lines),
                Happening::Gone(_) | Happening::Back(_) => {}
                Happening::Ended => return,
            }
        }
    }

    fn show_figures(&self, lines: &Lines, clock: &UtcClock, paces: &mut [Option<Pace>]) {
        let mut earliest_ns: Option<i64> = None;
        for (board, device) in lines.devices() {
            // If it does not answer, the stream reports that.
            let Ok(status) = device.status() else { continue };
            let now_ns = clock.at(Instant::now()).0;
            let pace =
                paces[board].get_or_insert_with(|| Pace::new(now_ns, status.ticks, device.hello().tick_hz));
            let now_ns = pace.now_ns(now_ns, status.ticks);
            earliest_ns = Some(earliest_ns.map_or(now_ns, |earliest_ns| earliest_ns.min(now_ns)));
            if let Some(figures) = lock(self.model).seen.devices.get_mut(board) {
                figures.status = Some(status);
                figures.counters = device.counters();
                figures.clock = Some(device.clock());
            }
        }
        if let Some(now_ns) = earliest_ns {
            // Records still on the way must not find their window closed.
            lock(self.model).advance(now_ns.saturating_sub(LATENESS_NS));
        }
    }

    /// The device is there: reports whether it is the same as before, and takes over its bit rates.
    fn greet(&self, board: usize, lines: &Lines, plan: &Plan, back: &Return, reconnects: u32) {
        let Some((line, device)) = lines.lines().nth(board).and_then(|line| Some((line, line.device()?)))
        else {
            return;
        };
        let (hello, address) = (device.hello(), &plan.addresses[board]);
        let name = format!("{} {}", hello.board, hello.serial);
        // All that are there: bit rates are set for all of them.
        let opened: Vec<(u8, ChannelConfig, u32)> = lines
            .devices()
            .flat_map(|(board, device)| {
                let clock_hz = device.hello().can_clock_hz;
                let opened = device.open_channels().into_iter();
                opened.map(move |(channel, config)| (channel_number(board, channel), config, clock_hz))
            })
            .collect();
        let data_rates: Vec<(u8, u32)> = lines
            .devices()
            .flat_map(|(board, device)| {
                let known = |channel| Some((channel_number(board, channel), device.data_bitrate(channel)?));
                Channel::ALL.into_iter().filter_map(known).collect::<Vec<_>>()
            })
            .collect();
        let mut model = lock(self.model);
        if let Some(other) = &back.other_board {
            model.notice = format!("another board is at {address} now: {other}");
            if !back.only_listening.is_empty() {
                model.notice.push_str(", and its channels only listen");
            }
        } else if let Some(after) = back.after {
            model.notice = format!("{address} is back after {:.1} s", after.as_secs_f64());
        }
        if model.seen.devices.len() <= board {
            model.seen.devices.resize_with(board + 1, DeviceFigures::default);
        }
        if model.sessions.len() <= board {
            model.sessions.resize(board + 1, 0);
        }
        model.seen.devices[board] = DeviceFigures {
            queue_bytes: hello.queue_bytes,
            name,
            reconnects: reconnects + line.gaps().count,
            can_clock_hz: Some(hello.can_clock_hz),
            ..DeviceFigures::default()
        };
        model.source = SourceState::Running;
        model.sessions[board] += 1;
        let is_car = hello.board == cantap_virtual::car::BOARD;
        model.met_car |= is_car;
        model.vehicle.is_there |= is_car;
        let rates = opened.iter().filter_map(|(number, config, clock_hz)| {
            Some((*number, config.timing.known_bitrate_bps(*clock_hz)?))
        });
        let rates: Vec<_> = rates.collect();
        let lacks =
            |lacks: fn(&ChannelConfig) -> bool| opened.iter().filter(move |(_, config, _)| lacks(config));
        let without_load: Vec<u8> =
            lacks(|config| config.omit_data || config.omit_stamps).map(|(number, ..)| *number).collect();
        if lacks(|config| config.omit_data).next().is_some() && model.notice.is_empty() {
            "the device leaves data out: there are zeros in its place, and the load is unknown"
                .clone_into(&mut model.notice);
        }
        if without_load != model.options().without_load
            || data_rates != model.options().channel_data_bitrate_bps
            || rates.iter().any(|(channel, rate)| model.options().bitrate_of(*channel) != Some(*rate))
        {
            let options = cantap_analysis::stats::Options {
                bitrate_bps: None,
                channel_bitrate_bps: rates,
                channel_data_bitrate_bps: data_rates,
                without_load,
                ..model.options().clone()
            };
            if let Err(error) = model.set_options(options) {
                model.notice = error.to_string();
            }
        }
    }

    /// Follows an order when there is a device to send with.
    fn follow_with(&mut self, lines: &Lines, order: Order) -> Then {
        if matches!(order, Order::Recover) && lines.devices().next().is_some() {
            self.recover(lines);
            return Then::GoOn;
        }
        let scripts_on = lines.lines().nth(BOARD).and_then(Line::device);
        let order = match (order, scripts_on) {
            (Order::StartScript(script), Some(device)) => {
                self.start_script(device, script);
                return Then::GoOn;
            }
            (Order::StartScript(script), None) => {
                let reason = "its device is gone; start it when it is back";
                lock(self.model).scripts.fail(&script.name, reason);
                return Then::GoOn;
            }
            (Order::Ask(on), device) => {
                self.ask(device, on);
                return Then::GoOn;
            }
            (Order::StopScript(name), _) => {
                self.stop_script(&name);
                return Then::GoOn;
            }
            (Order::ScriptKey(key), _) => {
                self.scripts.key(key);
                return Then::GoOn;
            }
            (order, _) => order,
        };
        let (Order::Send(number, _) | Order::SetPeriodic(number, ..)) = order else {
            return self.follow(order);
        };
        let (board, channel) = place_of(number);
        let Some(device) = lines.lines().nth(board).and_then(Line::device) else { return self.follow(order) };
        match order {
            Order::Send(_, frame) => {
                // The scripts' tags begin above this one.
                let frame = TxFrame { tag: 0, frame, at_ticks: None };
                if let Err(error) = device.send(channel, &[frame]) {
                    self.notice(advice::explained(&error));
                }
                Then::GoOn
            }
            Order::SetPeriodic(_, slot, repeated) => {
                if self.timed.set(number, slot, repeated.as_ref()) {
                    return Then::GoOn;
                }
                if board == BOARD && repeated.is_none() {
                    self.scripts.release(channel, slot);
                } else if board == BOARD && !self.scripts.claim(channel, slot) {
                    let mut model = lock(self.model);
                    "the scripts have the device's remaining entries; stop one of them, or of the list"
                        .clone_into(&mut model.notice);
                    model.refused.push((number, slot));
                    return Then::GoOn;
                }
                let entry = repeated.map(|repeated| periodic(device.hello().tick_hz, repeated));
                if let Err(error) = device.set_periodic(channel, slot, entry) {
                    if board == BOARD {
                        self.scripts.release(channel, slot);
                    }
                    let mut model = lock(self.model);
                    model.notice = advice::explained(&error);
                    model.refused.push((number, slot));
                }
                Then::GoOn
            }
            order => self.follow(order),
        }
    }

    /// Brings the channels that are bus-off back onto their buses.
    fn recover(&self, lines: &Lines) {
        let mut said = Vec::new();
        for (board, device) in lines.devices() {
            let status = match device.status() {
                Ok(status) => status,
                Err(error) => {
                    said.push(advice::explained(&error));
                    continue;
                }
            };
            for (channel, state) in Channel::ALL.into_iter().zip(&status.channels) {
                if state.open.is_none() || state.state != ErrorState::BusOff {
                    continue;
                }
                let number = channel_number(board, channel);
                said.push(match device.recover(channel) {
                    Ok(()) => format!("channel {number} comes back onto its bus"),
                    Err(error) => format!("channel {number}: {}", advice::explained(&error)),
                });
            }
        }
        if said.is_empty() {
            said.push("no channel is bus-off".to_owned());
        }
        self.notice(said.join("; "));
    }

    /// From now on nothing is known about the buses: the trace and the recording mark the gap, and no figure
    /// spans it.
    fn note_gap(&mut self, channels: &[u8]) {
        let time_ns = UtcClock::start().at(Instant::now()).0;
        let gap = |channel: &u8| TraceRecord {
            time_ns,
            device_ns: None,
            channel: *channel,
            event: TraceEvent::GAP,
        };
        let mut gap: Vec<_> = channels.iter().map(gap).collect();
        self.keep_up(&mut gap);
        self.take(&gap);
        lock(self.model).interrupt();
    }

    /// The windows before a gap may already be closed.
    fn keep_up(&self, records: &mut [TraceRecord]) {
        let now_ns = lock(self.model).seen.now_ns;
        for gap in records.iter_mut().filter(|record| record.event == TraceEvent::GAP) {
            gap.time_ns = gap.time_ns.max(now_ns);
        }
    }

    fn hand_over(&mut self, mut batch: Vec<TraceRecord>, lines: &Lines) {
        if !batch.is_empty() {
            self.keep_up(&mut batch);
            self.take(&batch);
        }
        self.scripts.take(&batch);
        self.show_to_asking(&batch);
        let mut model = lock(self.model);
        let now = Instant::now();
        model.reception.take(&batch, now);
        for number in model.reception.news(now) {
            let hint = model.reception.hint(number, false).unwrap_or(BusHint::WrongBitRate);
            let step = match hint {
                BusHint::WrongBitRate => "A looks for the bit rate",
                _ => "Statistics says what to do",
            };
            model.notice = format!("channel {number}: {}; {step}", hint.meaning());
        }
        drop(model);
        lines.recycle(batch);
    }
}

/// Devices opened according to the plan.
fn open_as(plan: &Plan) -> Lines {
    let for_setup = plan.clone();
    lines(&plan.addresses, move |board, device| {
        let open = for_setup.open.on_board(board);
        // No filters, not even saved ones: what is not shown is still recorded.
        open.open(device, for_setup.channels_of(board), for_setup.mode(), None, &Reporter::silent())
            .map(|_| ())
    })
}

/// How a device's time passes: with the computer's or, if it does not run in real time (an emulated board), behind it.
#[derive(Clone)]
struct Pace {
    start_ns: i64,
    start_ticks: u64,
    tick_hz: u32,
}

impl Pace {
    /// A request's round trip, plus the delays of a busy computer.
    const JITTER_NS: i64 = 500_000_000;

    fn new(start_ns: i64, start_ticks: u64, tick_hz: u32) -> Self {
        Self { start_ns, start_ticks, tick_hz: tick_hz.max(1) }
    }

    /// The time on the device, which reported `ticks` at `utc_ns`: the computer's, unless the device is farther behind
    /// than a crystal can be.
    fn now_ns(&self, utc_ns: i64, ticks: u64) -> i64 {
        let ticks = u128::from(ticks.saturating_sub(self.start_ticks));
        let passed_ns = (ticks * 1_000_000_000 / u128::from(self.tick_hz)) as i64;
        let expected_ns = utc_ns.saturating_sub(self.start_ns);
        let is_behind = passed_ns < expected_ns - expected_ns / 100 - Self::JITTER_NS;
        if is_behind { self.start_ns.saturating_add(passed_ns) } else { utc_ns }
    }
}

fn periodic(tick_hz: u32, repeated: Repeated) -> Periodic {
    let Repeated { frame, period, modifiers, .. } = repeated;
    let ticks = period.as_nanos() * u128::from(tick_hz) / 1_000_000_000;
    Periodic { frame, period_ticks: u32::try_from(ticks).unwrap_or(u32::MAX), count: 0, modifiers }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    #[test]
    fn a_device_that_lags_behind_tells_the_time_itself() {
        let pace = Pace::new(1000 * S, 12_000_000, 12_000_000);
        let at = |utc_s: i64, device_s: u64| pace.now_ns(utc_s * S, 12_000_000 * (1 + device_s)) / S;
        // A real one: drift and round trips do not matter, even after days.
        assert_eq!(at(1000, 0), 1000);
        assert_eq!(at(1000 + 100_000, 99_990), 101_000);
        assert_eq!(at(1000 + 100_000, 100_010), 101_000);
        // An emulated one at half speed.
        assert_eq!(at(1010, 5), 1005);
        assert_eq!(at(1100, 50), 1050);
    }
}
