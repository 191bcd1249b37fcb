//! Finds bit rates by listening, showing progress; it can be stopped at any time.

use std::sync::mpsc::{RecvTimeoutError, TryRecvError};
use std::time::Duration;

use cantap::autobaud::{Limits, Outcome, Progress};

use cantap::device::channel_number;
use cantap::wire::message::{Mode, capability};

use super::super::model::SourceState;
use super::super::plan::Plan;
use super::{Source, Then, lock};
use cantap_work::advice;
use cantap_work::bit_rate_search::{self, Search};
use cantap_work::channel_bitrate::ChannelBitrate;
use cantap_work::requested_rate::RequestedRate;

/// How long after a search that found nothing the next one begins.
const AGAIN_AFTER: Duration = Duration::from_millis(200);

impl Source<'_> {
    /// Adds the bit rates that are found to the plan; those not found stay as they were. Returns what to do next:
    /// an order may have come meanwhile.
    pub(super) fn autobaud(&mut self, plan: &mut Plan) -> Then {
        self.find(plan, |_| true)
    }

    /// As [`Self::autobaud`], for the channels with the numbers for which `is_wanted`.
    fn find(&mut self, plan: &mut Plan, is_wanted: impl Fn(u8) -> bool) -> Then {
        lock(self.model).source = SourceState::Searching;
        let mut said = Vec::new();
        let mut rates = Vec::new();
        let mut then = Then::GoOn;
        for (board, address) in plan.addresses.iter().enumerate() {
            let device = match address.open() {
                Ok(device) => device,
                Err(error) => {
                    said.push(advice::sentence(&error.into()));
                    continue;
                }
            };
            for channel in plan.channels_of(board) {
                let number = channel_number(board, channel);
                if !is_wanted(number) {
                    continue;
                }
                if !bit_rate_search::is_possible(&device) {
                    said.push(format!(
                        "channel {number}: this device cannot find a bit rate; give it with b"
                    ));
                    continue;
                }
                let mut progress = |progress: Progress| {
                    self.notice(format!("channel {number}: {}; A stops", describe(progress)));
                    then = self.order_meanwhile();
                    matches!(then, Then::GoOn)
                };
                said.push(match bit_rate_search::search(&device, channel, &Limits::default(), &mut progress) {
                    Ok(
                        Search::Confirmed { bitrate_bps }
                        | Search::Measured(Outcome::Found { bitrate_bps, .. }),
                    ) => {
                        rates.push(RequestedRate { channel: Some(number), bitrate_bps: Some(bitrate_bps) });
                        format!("channel {number}: {bitrate_bps} bit/s")
                    }
                    Ok(Search::Measured(Outcome::NoTraffic)) => format!("channel {number}: no traffic"),
                    Ok(Search::Measured(Outcome::Stuck)) => format!("channel {number}: the bus is dominant all the time"),
                    Ok(Search::Measured(Outcome::Unreadable { .. })) => format!("channel {number}: traffic, but not one whole frame"),
                    Ok(Search::Measured(Outcome::Unreachable { measured_bps, .. })) => {
                        format!("channel {number}: {measured_bps:.0} bit/s, which the device's clock does not reach")
                    }
                    Ok(Search::Measured(Outcome::Unconfirmed { bitrate_bps, .. })) => {
                        format!("channel {number}: bits of {bitrate_bps} bit/s, but no good frame")
                    }
                    Ok(Search::Measured(Outcome::Stopped)) => format!("channel {number}: stopped"),
                    Err(error) => format!("channel {number}: {}", advice::explained(&error)),
                });
                if !matches!(then, Then::GoOn) {
                    break;
                }
            }
            if !matches!(then, Then::GoOn) {
                break;
            }
        }
        if !rates.is_empty() {
            // After the others: the last one counts.
            rates.splice(0..0, plan.open.timing.bitrates.clone());
            plan.open.timing.set_bit_rates(rates);
            if plan.mode() != Mode::ListenOnly {
                // The user agreed to it at another bit rate.
                plan.open.mode = Some(Mode::ListenOnly);
                said.push("listen-only now".to_owned());
            }
            lock(self.model).found = Some(plan.clone());
        }
        self.notice(said.join("; "));
        then
    }

    /// Whether a channel to be opened has no bit rate from anywhere: not given, and not saved on its device. An absent device shows
    /// this when it is opened.
    pub(super) fn lacks_bit_rates(plan: &Plan) -> bool {
        if plan.open.timing.is_given() {
            return false;
        }
        plan.addresses.iter().enumerate().any(|(board, address)| {
            // What a pipe has for who opens it first is for the session.
            if address.has_bit_rate() {
                return false;
            }
            let Ok(device) = address.open() else { return false };
            if device.hello().capabilities & capability::NO_BIT_RATE != 0 {
                return false;
            }
            let lacks = |channel| {
                device.bitrate_of_bus(channel).is_none()
                    && device.defaults(channel).is_ok_and(|saved| saved.is_none())
            };
            plan.channels_of(board).any(lacks)
        })
    }

    /// Finds the bit rates for a plan without any, until at least one is found. Channels without a bit rate are then
    /// not opened.
    pub(super) fn find_bit_rates(&mut self, plan: &mut Plan) -> Then {
        loop {
            let then = self.autobaud(plan);
            if plan.open.timing.is_given() {
                plan.choose_channels();
                lock(self.model).found = Some(plan.clone());
                return then;
            }
            let then = if matches!(then, Then::GoOn) { self.wait_for_order() } else { then };
            if !matches!(then, Then::GoOn) {
                return then;
            }
        }
    }

    /// Finds the bit rates that were requested to be found, until there is a channel to open or an order ends it. Channels without
    /// one are then not opened.
    pub(super) fn find_requested(&mut self, plan: &mut Plan) -> Then {
        loop {
            let requested = plan.open.timing.clone();
            let then = self.find(plan, |number| requested.is_auto(number));
            let known = plan.open.timing.known();
            if matches!(then, Then::Reopen(_) | Then::Quit) {
                return then;
            }
            if matches!(then, Then::Autobaud) {
                // The search was stopped: without a bit rate, opening says what is missing.
                plan.open.timing.set_bit_rates(known);
                return then;
            }
            if plan.channels.iter().any(|number| ChannelBitrate::of(&known, *number).is_some()) {
                plan.open.timing.set_bit_rates(known.iter().copied());
                plan.channels.retain(|number| ChannelBitrate::of(&known, *number).is_some());
                lock(self.model).found = Some(plan.clone());
                return Then::GoOn;
            }
            match self.wait_for_order() {
                // The search begins anew in any case.
                Then::GoOn | Then::Autobaud => {}
                then => return then,
            }
        }
    }

    /// Waits before the next search: one that cannot begin ends at once, and orders are followed all the same.
    fn wait_for_order(&mut self) -> Then {
        match self.orders.recv_timeout(AGAIN_AFTER) {
            Ok(order) => self.follow(order),
            Err(RecvTimeoutError::Timeout) => Then::GoOn,
            Err(RecvTimeoutError::Disconnected) => Then::Quit,
        }
    }

    /// Handles orders during the search; any that concerns the device ends it.
    fn order_meanwhile(&mut self) -> Then {
        loop {
            match self.orders.try_recv() {
                Ok(order) => match self.follow(order) {
                    Then::GoOn => {}
                    then => return then,
                },
                Err(TryRecvError::Empty) => return Then::GoOn,
                Err(TryRecvError::Disconnected) => return Then::Quit,
            }
        }
    }
}

fn describe(progress: Progress) -> String {
    match progress {
        Progress::Measuring { edges: 0 } => "waiting for traffic to measure".to_owned(),
        Progress::Measuring { edges } => format!("measuring bits, {edges} edges"),
        Progress::Confirming { bitrate_bps, frames } => {
            format!("{bitrate_bps} bit/s measured, {frames} good frames at it")
        }
    }
}
