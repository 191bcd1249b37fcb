//! What sending commands have in common: the fate of each frame, how long to wait, and why frames were not sent.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::Write;
use std::time::Duration;

use anyhow::bail;
use cantap::device::Transmission;
use cantap::replay::Replay;
use cantap::transmit::Stream;
use cantap::unsent::{Cause, PATIENCE, Watch};
use cantap::wire::record::TransmitFailure;
use cantap::wire::{CHANNELS, Channel};
use cantap::{Device, TraceRecord};

use crate::rescue::Rescue;
use crate::words::failure_text;
use cantap_work::interrupt;

/// How often to check whether to continue.
pub const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Frames being sent: counts their ends, prints them like candump, and notices when no more can be sent.
pub struct Sending<'d> {
    device: &'d Device,
    rescue: Rescue,
    watch: Watch<'d>,
    quiet: bool,
    sent: u64,
    failed: u64,
    /// Failed frames, by the device's reason.
    failures: BTreeMap<Cow<'static, str>, u64>,
    /// Number of periods that passed before their frame could be sent.
    overtaken: u64,
    stands_still: bool,
    /// The error that ended it, where only yes or no could be returned.
    error: Option<anyhow::Error>,
}

impl<'d> Sending<'d> {
    /// Nothing has been sent yet. Prints nothing if `quiet`.
    pub fn new(device: &'d Device, rescue: Rescue, quiet: bool) -> Self {
        Self::over(device, Watch::new(device, rescue.is_on_duty()), rescue, quiet)
    }

    const fn over(device: &'d Device, watch: Watch<'d>, rescue: Rescue, quiet: bool) -> Self {
        Self {
            device,
            watch,
            rescue,
            quiet,
            sent: 0,
            failed: 0,
            failures: BTreeMap::new(),
            overtaken: 0,
            stands_still: false,
            error: None,
        }
    }

    /// The same for a command that uses the device's records itself, and passes each of them to [`Self::take`]. Prints
    /// nothing.
    pub fn fed(device: &'d Device, rescue: Rescue) -> Self {
        Self::over(device, Watch::fed(device, rescue.is_on_duty()), rescue, true)
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
        self.stands_still || self.error.is_some() || interrupt::requested()
    }

    fn add(&mut self, ends: &[Transmission]) -> anyhow::Result<()> {
        self.watch.note(ends);
        self.rescue.note(ends);
        let mut out = std::io::stdout().lock();
        for end in ends {
            match end.result {
                Ok(frame) => {
                    self.sent += 1;
                    if !self.quiet {
                        let (seconds, us) = (end.time_ns / 1_000_000_000, end.time_ns / 1000 % 1_000_000);
                        writeln!(out, "({seconds}.{us:06}) can{} {frame} T", end.channel.index())?;
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

    /// Takes ends of transmissions; false after Ctrl-C, an error, or when frames that are due (see
    /// [`Stream::oldest_due`]) are stuck. Waits while a channel is to come back from bus-off: frames sent meanwhile would
    /// only fail.
    pub fn goes_on(&mut self, ends: &[Transmission], due: [Option<u64>; CHANNELS]) -> bool {
        let goes_on = self.add(ends).and_then(|()| {
            if self.rescue.wait(self.device) {
                self.watch.excuse();
            }
            self.stands_still |= self.watch.stands_still(|channel, _| due[channel.index()])?;
            Ok(!self.stands_still && !interrupt::requested())
        });
        self.or_stop(goes_on)
    }

    /// Like [`Self::goes_on`], for what the device sends on its own, and without waiting.
    pub fn device_goes_on(&mut self, ends: &[Transmission]) -> bool {
        let goes_on = self.add(ends).and_then(|()| {
            self.rescue.look(self.device)?;
            if self.rescue.is_waiting() {
                self.watch.excuse();
            }
            self.stands_still |= self.watch.stands_still(|_, status| (status.tx_pending > 0).then_some(0))?;
            Ok(!self.stands_still && !interrupt::requested())
        });
        self.or_stop(goes_on)
    }

    fn or_stop(&mut self, goes_on: anyhow::Result<bool>) -> bool {
        goes_on.unwrap_or_else(|error| {
            self.error = Some(error);
            false
        })
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
        if let Some(error) = self.error.take() {
            return Err(error);
        }
        let not_sent = asked.saturating_sub(self.sent);
        let cause = match (not_sent, self.overtaken) {
            (0, 0) => None,
            (0, _) => Some(Cause::Overtaken),
            _ => Some(self.watch.cause()?),
        };
        let mut left_out = self.failures.clone();
        let never_left = not_sent.saturating_sub(self.failed);
        if never_left > 0 {
            left_out.insert("never left the device".into(), never_left);
        }
        let (overtaken, is_one_shot) = (self.overtaken, self.failed > 0);
        Ok(Outcome { asked, not_sent, left_out, overtaken, is_one_shot, cause })
    }

    /// Waits for the rest of a stream, until frames are stuck or Ctrl-C.
    pub fn finish(&mut self, stream: &mut Stream<'_>) -> anyhow::Result<()> {
        stream.flush()?;
        while self.goes_on(&stream.take_ended(), stream.oldest_due()) && stream.under_way() > 0 {
            stream.wait(LOOK_EVERY)?;
        }
        Ok(())
    }

    /// Like [`Self::finish`], for a replay, whose last frames may be due long after the others.
    pub fn finish_replay(&mut self, replay: &mut Replay<'_>) -> anyhow::Result<()> {
        replay.flush()?;
        while self.goes_on(&replay.take_ended(), replay.oldest_due()) && replay.under_way() > 0 {
            replay.wait(LOOK_EVERY)?;
        }
        Ok(())
    }
}

/// The fate of the frames.
pub struct Outcome {
    asked: u64,
    not_sent: u64,
    /// The same by reason.
    left_out: BTreeMap<Cow<'static, str>, u64>,
    overtaken: u64,
    /// Whether some failed for good at the first try.
    is_one_shot: bool,
    /// The cause, if anything went wrong.
    cause: Option<Cause>,
}

impl Outcome {
    /// The reason in a sentence, with what to do; `None` if all is well.
    pub fn reason(&self) -> Option<String> {
        let Self { asked, not_sent, overtaken, .. } = self;
        let were_not = format!("{not_sent} of {asked} frames were not sent");
        let again = if self.is_one_shot { ", or omit --one-shot to try again until sent" } else { "" };
        Some(match self.cause? {
            Cause::Unacknowledged => format!(
                "nobody acknowledged {not_sent} of {asked} frames; check that another node is on the bus, at this bit rate, \
                 and the termination{again}"
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
                "all {asked} frames were sent, but {overtaken} periods passed without one: their period is shorter than the \
                 bus allows; choose a longer --period"
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
    pub fn verdict(&self) -> anyhow::Result<()> {
        match self.reason() {
            Some(reason) => bail!(reason),
            None => Ok(()),
        }
    }
}
