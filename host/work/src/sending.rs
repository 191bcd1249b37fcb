//! What sending commands have in common: the fate of each frame, how long to wait, and why frames were not sent.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io;
use std::time::{Duration, Instant};

use anyhow::bail;
use cantap::DeviceError;
use cantap::device::Transmission;
use cantap::replay::Replay;
use cantap::transmit::Stream;
use cantap::unsent::{Cause, PATIENCE, Watch};
use cantap::wire::record::TransmitFailure;
use cantap::wire::{CHANNELS, Channel};
use cantap::{Device, TraceFrame, TraceRecord};
use cantap_trace::counted;

use crate::advice::sentence;
use crate::bus_off::BusOffRecovery;
use crate::interrupt;
use crate::terms::failure_text;

/// A kind of frames that were not sent.
const NEVER_LEFT: &str = "never left the device";
/// The same if the device cannot be asked any more.
const UNKNOWN: &str = "unknown, since the device is gone";
/// How often to check whether to continue.
pub const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Takes each frame that was sent, and how its transmission ended.
pub type OnSent<'d> = Box<dyn FnMut(&Transmission, TraceFrame) -> io::Result<()> + 'd>;

/// Frames being sent: counts their ends, passes on what was sent, and notices when no more can be sent.
pub struct Sending<'d> {
    device: &'d Device,
    recovery: BusOffRecovery,
    watch: Watch<'d>,
    on_sent: Option<OnSent<'d>>,
    sent: u64,
    failed: u64,
    /// Failed frames, by the device's reason.
    failures: BTreeMap<Cow<'static, str>, u64>,
    /// Number of periods that passed before their frame could be sent.
    overtaken: u64,
    /// What is taken back ends as aborted, and that is no failure.
    withdraws: bool,
    withdrawn: u64,
    stands_still: bool,
    /// What is sent now is sent because of Ctrl-C.
    is_farewell: bool,
    /// The error that ended it, where only yes or no could be returned.
    error: Option<anyhow::Error>,
}

impl<'d> Sending<'d> {
    /// Nothing has been sent yet. Each frame that was sent is passed to `on_sent`.
    pub fn new(device: &'d Device, recovery: BusOffRecovery, on_sent: Option<OnSent<'d>>) -> Self {
        Self::over(device, Watch::new(device, recovery.is_wanted()), recovery, on_sent)
    }

    fn over(
        device: &'d Device,
        watch: Watch<'d>,
        recovery: BusOffRecovery,
        on_sent: Option<OnSent<'d>>,
    ) -> Self {
        Self {
            device,
            watch,
            recovery,
            on_sent,
            sent: 0,
            failed: 0,
            failures: BTreeMap::new(),
            overtaken: 0,
            withdraws: false,
            withdrawn: 0,
            stands_still: false,
            is_farewell: false,
            error: None,
        }
    }

    /// The same for a command that uses the device's records itself, and passes each of them to [`Self::take`].
    pub fn fed(device: &'d Device, recovery: BusOffRecovery, on_sent: Option<OnSent<'d>>) -> Self {
        Self::over(device, Watch::fed(device, recovery.is_wanted()), recovery, on_sent)
    }

    /// From now on, Ctrl-C ends nothing: what is sent is what has to be sent because of it, or at the end in any case.
    pub const fn begin_farewell(&mut self) {
        self.is_farewell = true;
    }

    /// Whether Ctrl-C ends it.
    pub fn is_interrupted(&self) -> bool {
        !self.is_farewell && interrupt::requested()
    }

    /// Notes what was on the bus.
    pub fn take(&mut self, records: &[TraceRecord]) {
        self.watch.take(records);
    }

    /// The number of frames sent.
    pub const fn sent(&self) -> u64 {
        self.sent
    }

    /// The number of frames that ended, sent or not.
    pub const fn ended(&self) -> u64 {
        self.sent + self.failed
    }

    /// Whether it was given up because no more frames could be sent.
    pub const fn stands_still(&self) -> bool {
        self.stands_still
    }

    /// Whether nothing more will be sent: frames are stuck, an error came, or Ctrl-C.
    pub fn has_stopped(&self) -> bool {
        self.stands_still || self.error.is_some() || self.is_interrupted()
    }

    fn add(&mut self, ends: &[Transmission]) -> anyhow::Result<()> {
        let is_withdrawn = |end: &Transmission| end.result == Err(TransmitFailure::Aborted);
        let kept: Vec<Transmission>;
        let ends = if self.withdraws && ends.iter().any(is_withdrawn) {
            self.withdrawn += ends.iter().filter(|end| is_withdrawn(end)).count() as u64;
            kept = ends.iter().filter(|end| !is_withdrawn(end)).copied().collect();
            &kept
        } else {
            ends
        };
        self.watch.note(ends);
        self.recovery.note(ends);
        for end in ends {
            match end.result {
                Ok(frame) => {
                    self.sent += 1;
                    if let Some(on_sent) = &mut self.on_sent {
                        on_sent(end, frame)?;
                    }
                }
                // The frame is still waiting, and will end once.
                Err(TransmitFailure::Overtaken { periods }) => self.overtaken += u64::from(periods),
                Err(reason) => {
                    self.failed += 1;
                    *self.failures.entry(failure_text(reason)).or_default() += 1;
                }
            }
        }
        Ok(())
    }

    /// The error that ended it, if one did.
    pub fn check(&mut self) -> anyhow::Result<()> {
        self.error.take().map_or(Ok(()), Err)
    }

    /// Takes ends of transmissions; false after Ctrl-C, an error, or when frames that are due (see
    /// [`Stream::oldest_due`]) are stuck. Waits while a channel is to come back from bus-off: frames sent meanwhile would
    /// only fail.
    pub fn goes_on(&mut self, ends: &[Transmission], due: [Option<u64>; CHANNELS]) -> bool {
        let goes_on = self.add(ends).and_then(|()| {
            if self.recovery.wait(self.device) {
                self.watch.excuse();
            }
            self.stands_still |= self.watch.stands_still(|channel, _| due[channel.index()])?;
            Ok(!self.stands_still && !self.is_interrupted())
        });
        self.or_stop(goes_on)
    }

    /// Like [`Self::goes_on`], for what the device sends on its own, and without waiting.
    pub fn device_goes_on(&mut self, ends: &[Transmission]) -> bool {
        let goes_on = self.add(ends).and_then(|()| {
            self.recovery.look(self.device)?;
            if self.recovery.is_waiting() {
                self.watch.excuse();
            }
            self.stands_still |= self.watch.stands_still(|_, status| (status.tx_pending > 0).then_some(0))?;
            Ok(!self.stands_still && !self.is_interrupted())
        });
        self.or_stop(goes_on)
    }

    /// Whether an error has ended it.
    pub const fn has_failed(&self) -> bool {
        self.error.is_some()
    }

    /// Notes an error that ends it; the first one counts.
    pub fn fail(&mut self, error: impl Into<anyhow::Error>) {
        let error = error.into();
        self.error.get_or_insert(error);
    }

    fn or_stop(&mut self, goes_on: anyhow::Result<bool>) -> bool {
        goes_on.unwrap_or_else(|error| {
            self.error = Some(error);
            false
        })
    }

    /// Closes the books on what the device sends on its own, once its entries are cleared: waits until everything on the way has ended
    /// and its confirmation is here, or nothing has moved for [`PATIENCE`], and takes the rest back. `next` waits a moment and returns
    /// how transmissions ended. Returns the number of periods and frames that were due and never left.
    pub fn settle(
        &mut self,
        channel: Channel,
        mut next: impl FnMut(&mut Self) -> anyhow::Result<Vec<Transmission>>,
    ) -> anyhow::Result<u64> {
        if !self.wait_for_ends(channel, &mut next)? {
            self.withdraws = true;
            self.device.abort(channel)?;
            self.wait_for_ends(channel, &mut next)?;
        }
        let status = self.device.status()?.channels[channel.index()];
        let known = self.failed + self.withdrawn;
        self.overtaken = u64::from(status.transmit_failures).saturating_sub(known);
        Ok(self.overtaken + self.withdrawn)
    }

    /// Whether everything has ended and is confirmed; false if nothing moved for [`PATIENCE`], by the device's clock, too.
    fn wait_for_ends(
        &mut self,
        channel: Channel,
        mut next: impl FnMut(&mut Self) -> anyhow::Result<Vec<Transmission>>,
    ) -> anyhow::Result<bool> {
        let patience_ticks = PATIENCE.as_secs() * u64::from(self.device.hello().tick_hz);
        let mut moved: Option<(Instant, u64)> = None;
        loop {
            let ends = next(self)?;
            self.add(&ends)?;
            let status = self.device.status()?;
            let state = status.channels[channel.index()];
            let failed = self.failed + self.withdrawn + self.overtaken;
            if state.tx_pending == 0
                && state.transmitted == self.sent as u32
                && state.transmit_failures == failed as u32
            {
                return Ok(true);
            }
            let (since, ticks) = *moved.get_or_insert((Instant::now(), status.ticks));
            if !ends.is_empty() {
                moved = None;
            } else if since.elapsed() >= PATIENCE && status.ticks.saturating_sub(ticks) >= patience_ticks {
                // What is confirmed only in the counters may have gone to another program's stream.
                return Ok(state.tx_pending == 0);
            }
        }
    }

    /// The number of a channel's periods that passed without a frame, and of frames still waiting, according to the device: the
    /// stream reports them only ten times a second.
    pub fn periods_missed(&mut self, channel: Channel) -> anyhow::Result<u64> {
        let status = self.device.status()?.channels[channel.index()];
        let waiting = if self.stands_still { u64::from(status.tx_pending) } else { 0 };
        self.overtaken = u64::from(status.transmit_failures).saturating_sub(self.failed);
        Ok(self.overtaken + waiting)
    }

    /// The fate of as many frames as were requested; fewer if the user ended it. Call it before the channels are closed.
    pub fn outcome(&mut self, asked: u64) -> anyhow::Result<Outcome> {
        let error = self.error.take();
        let not_sent = asked.saturating_sub(self.sent);
        let cause = match (not_sent, self.overtaken) {
            // What the device would say is not known any more.
            _ if error.is_some() => None,
            (0, 0) => None,
            (0, _) => Some(Cause::Overtaken),
            _ => Some(self.watch.cause()?),
        };
        let mut left_out = self.failures.clone();
        let never_left = not_sent.saturating_sub(self.failed);
        if never_left > 0 {
            let reason = if error.is_some() { UNKNOWN } else { NEVER_LEFT };
            left_out.insert(reason.into(), never_left);
        }
        let (overtaken, is_one_shot) = (self.overtaken, self.failed > 0);
        Ok(Outcome { asked, not_sent, left_out, overtaken, merged: 0, is_one_shot, cause, error })
    }

    /// The fate of replies, of which `merged` were not sent because the one before was still waiting.
    pub fn outcome_of_replies(&mut self, asked: u64, merged: u64) -> anyhow::Result<Outcome> {
        let mut outcome = self.outcome(asked)?;
        if merged > 0 {
            outcome.merged = merged;
            outcome.left_out.remove(NEVER_LEFT);
            outcome.left_out.insert("the reply before was still waiting".into(), merged);
            let rest = outcome.not_sent.saturating_sub(merged + self.failed);
            if rest > 0 {
                outcome.left_out.insert(NEVER_LEFT.into(), rest);
            }
        }
        Ok(outcome)
    }

    /// Waits for the rest of a stream. When frames are stuck, or after Ctrl-C, what is still in the device is taken back, and what it
    /// sent meanwhile is counted.
    pub fn finish(&mut self, stream: &mut impl Flight) -> anyhow::Result<()> {
        stream.flush()?;
        while self.goes_on(&stream.take_ended(), stream.oldest_due()) && stream.under_way() > 0 {
            stream.wait(LOOK_EVERY)?;
        }
        if self.error.is_some() || stream.under_way() == 0 {
            return Ok(());
        }
        self.withdraws = true;
        for (channel, config) in self.device.open_channels() {
            if config.mode.transmits() {
                self.device.abort(channel)?;
            }
        }
        let mut moved = Instant::now();
        while stream.under_way() > 0 && moved.elapsed() < PATIENCE {
            stream.wait(LOOK_EVERY)?;
            let ends = stream.take_ended();
            if !ends.is_empty() {
                moved = Instant::now();
                self.add(&ends)?;
            }
        }
        Ok(())
    }
}

/// Frames on their way: a stream, or a replay, whose last frames may be due long after the others.
pub trait Flight {
    /// Hands everything to the device.
    fn flush(&mut self) -> Result<(), DeviceError>;
    /// Waits for the next transmission to end, at most this long.
    fn wait(&mut self, at_most: Duration) -> Result<(), DeviceError>;
    /// How transmissions ended since the last call.
    fn take_ended(&mut self) -> Vec<Transmission>;
    /// See [`Stream::oldest_due`].
    fn oldest_due(&self) -> [Option<u64>; CHANNELS];
    /// Number of frames handed over that have not ended.
    fn under_way(&self) -> usize;
}

macro_rules! flight {
    ($type:ident) => {
        impl Flight for $type<'_> {
            fn flush(&mut self) -> Result<(), DeviceError> {
                $type::flush(self)
            }

            fn wait(&mut self, at_most: Duration) -> Result<(), DeviceError> {
                $type::wait(self, at_most)
            }

            fn take_ended(&mut self) -> Vec<Transmission> {
                $type::take_ended(self)
            }

            fn oldest_due(&self) -> [Option<u64>; CHANNELS] {
                $type::oldest_due(self)
            }

            fn under_way(&self) -> usize {
                $type::under_way(self)
            }
        }
    };
}

flight!(Stream);
flight!(Replay);

/// The fate of the frames.
pub struct Outcome {
    asked: u64,
    not_sent: u64,
    /// The same by reason.
    left_out: BTreeMap<Cow<'static, str>, u64>,
    overtaken: u64,
    /// Replies that were not sent because the one before was still waiting.
    merged: u64,
    /// Whether some failed for good at the first try.
    is_one_shot: bool,
    /// The cause, if anything went wrong.
    cause: Option<Cause>,
    /// Why it ended early, if the device is gone or refused something.
    error: Option<anyhow::Error>,
}

impl Outcome {
    /// The reason in a sentence, with what to do; `None` if all is well.
    pub fn reason(&self) -> Option<String> {
        let Self { asked, not_sent, overtaken, merged, .. } = self;
        if let Some(error) = &self.error {
            return Some(sentence(error));
        }
        if *merged > 0 && merged == not_sent {
            return Some(format!(
                "{merged} of {asked} frames that match got no reply of their own: the one before was still waiting for the bus; \
                 use a lower identifier, or a quieter bus"
            ));
        }
        let were_not = format!("{not_sent} of {asked} frames were not sent");
        let again = if self.is_one_shot { ", or omit --one-shot to try again until sent" } else { "" };
        Some(match self.cause? {
            Cause::Unacknowledged => format!(
                "nobody acknowledged {not_sent} of {asked}; check that another node is on the bus, at this bit rate, \
                 and the termination{again}",
                asked = counted(asked, "frame")
            ),
            Cause::Destroyed => {
                format!("{were_not}: errors destroyed them; check bit rate and wiring{again}")
            }
            Cause::BusFull { load_pct } => {
                let load = load_pct.map_or_else(String::new, |load| format!(" ({load:.0} %)"));
                format!(
                    "{were_not}: the bus is full{load} of frames with lower identifiers, and arbitration was never won in \
                     {} s; use a lower identifier, or a quieter bus",
                    PATIENCE.as_secs()
                )
            }
            Cause::BusOff => format!(
                "{were_not}: the controller went bus-off; check bit rate, wiring and termination, and see --recovery"
            ),
            Cause::ArbitrationLost => {
                format!("{were_not}: arbitration was lost; omit --one-shot to try again until sent")
            }
            Cause::Overtaken if *not_sent == 0 => format!(
                "all {asked} frames were sent, but {overtaken} passed without one: their period is shorter than the \
                 bus allows; choose a longer --period",
                overtaken = counted(overtaken, "period")
            ),
            Cause::Overtaken => {
                format!("{were_not}: their period is shorter than the bus allows; choose a longer --period")
            }
            Cause::Aborted => format!("{were_not}: they were aborted"),
            Cause::Closed => format!("{were_not}: the channel was closed before"),
            Cause::Unknown => format!(
                "{were_not}: none left, and neither an error nor another frame was seen; check the transceiver and that the \
                 bus is not stuck dominant"
            ),
        })
    }

    /// The counts, for scripts.
    pub fn object(&self) -> serde_json::Value {
        serde_json::json!({
            "asked": self.asked,
            "not_sent": self.not_sent,
            "left_out": self.left_out,
            "overtaken": self.overtaken,
            "reason": self.reason(),
        })
    }

    /// An error with the reason if anything went wrong.
    pub fn verdict(self) -> anyhow::Result<()> {
        match (self.reason(), self.error) {
            (_, Some(error)) => Err(error),
            (Some(reason), None) => bail!(reason),
            (None, None) => Ok(()),
        }
    }

    /// Whether it ended early because the device is gone or refused something: then there is nothing to be closed properly.
    pub const fn is_cut_short(&self) -> bool {
        self.error.is_some()
    }
}
