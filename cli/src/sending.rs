//! What commands that send have in common: a device open for sending, and what became of each frame.

use std::io::Write;
use std::time::{Duration, Instant};

use anyhow::bail;
use cantap::Device;
use cantap::device::Transmission;
use cantap::replay::Replay;
use cantap::transmit::Stream;
use cantap::wire::message::ChannelStatus;
use cantap::wire::record::{ErrorState, TransmitFailure};

use crate::interrupt;
use crate::rescue::Rescue;

/// A frame that nobody acknowledged for so long is given up.
pub const GIVE_UP_AFTER: Duration = Duration::from_secs(1);

/// How often is looked whether to go on.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Counts ends of transmissions, and prints them as candump would.
#[derive(Default)]
pub struct Tally {
    /// Confirmed.
    pub sent: u64,
    /// Not sent.
    pub failed: u64,
    /// The last reason.
    reason: Option<TransmitFailure>,
    quiet: bool,
}

impl Tally {
    /// A tally that prints nothing if `quiet`.
    pub fn new(quiet: bool) -> Self {
        Self { quiet, ..Self::default() }
    }

    /// Counts and prints.
    pub fn add(&mut self, ends: &[Transmission]) -> anyhow::Result<()> {
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
                Err(reason) => {
                    self.failed += 1;
                    self.reason = Some(reason);
                }
            }
        }
        Ok(())
    }

    /// An error that says what to do if anything was not sent.
    pub fn verdict(&self, still_waiting: usize) -> anyhow::Result<()> {
        if still_waiting > 0 {
            bail!(
                "nobody acknowledged {still_waiting} of {} frames; check that another node is on the bus, at this \
                 bit rate, and the termination",
                self.sent + self.failed + still_waiting as u64
            );
        }
        match self.reason {
            Some(reason) => bail!(
                "{} of {} frames were not sent: {}",
                self.failed,
                self.sent + self.failed,
                sentence(reason)
            ),
            None => Ok(()),
        }
    }
}

/// Looks after a bus while frames wait for their time: silence alone does not tell that it is dead.
pub struct BusWatch<'d> {
    device: &'d Device,
    rescue: Rescue<'d>,
    look_at: Instant,
}

impl<'d> BusWatch<'d> {
    /// Watches the buses of a device, and brings its channels back from bus-off if it is to.
    pub fn new(device: &'d Device, rescue: Rescue<'d>) -> Self {
        Self { device, rescue, look_at: Instant::now() + GIVE_UP_AFTER }
    }

    /// Takes notice of how transmissions ended.
    pub fn note(&mut self, ends: &[Transmission]) {
        self.rescue.note(ends);
    }

    /// False after Ctrl-C, and where a controller is so far gone (error passive, bus-off) that nobody hears it.
    pub fn goes_on(&mut self) -> bool {
        const PASSIVE: u8 = 128;
        self.rescue.wait();
        if self.look_at <= Instant::now() {
            self.look_at = Instant::now() + GIVE_UP_AFTER;
            // An error is told by the next request.
            let channels = self.device.status().map(|status| status.channels);
            let is_gone = |channel: &ChannelStatus| {
                let is_rescued = self.rescue.is_on_duty() && channel.state == ErrorState::BusOff;
                channel.tec >= PASSIVE && !is_rescued
            };
            if channels.is_ok_and(|channels| channels.iter().any(is_gone)) {
                return false;
            }
        }
        !interrupt::requested()
    }
}

/// Waits for the rest of a replay, which may be due long after the others, and adds each end up as it comes.
pub fn see_out(replay: &mut Replay<'_>, tally: &mut Tally, bus: &mut BusWatch<'_>) -> anyhow::Result<()> {
    let mut ended = |replay: &mut Replay<'_>, bus: &mut BusWatch<'_>| {
        let ends = replay.take_ended();
        bus.note(&ends);
        tally.add(&ends)
    };
    replay.flush()?;
    while replay.under_way() > 0 && bus.goes_on() {
        replay.wait(LOOK_EVERY)?;
        ended(replay, bus)?;
    }
    ended(replay, bus)
}

/// Waits for the rest of a stream, until nothing ends for [`GIVE_UP_AFTER`] or Ctrl-C, and adds it up.
pub fn finish(stream: &mut Stream<'_>, tally: &mut Tally, rescue: &mut Rescue<'_>) -> anyhow::Result<()> {
    stream.finish(|since| {
        rescue.wait();
        since < GIVE_UP_AFTER && !interrupt::requested()
    })?;
    tally.add(&stream.take_ended())
}

fn sentence(reason: TransmitFailure) -> &'static str {
    match reason {
        TransmitFailure::ArbitrationLost => {
            "arbitration was lost; leave --one-shot away to try again until sent"
        }
        TransmitFailure::BusError => {
            "an error hit them; check bit rate and wiring, or leave --one-shot away to try again until sent"
        }
        TransmitFailure::Aborted => "they were aborted",
        TransmitFailure::Closed => "the channel was closed before",
        TransmitFailure::BusOff => {
            "the controller went bus-off; check bit rate, wiring and termination, and see --recovery"
        }
        TransmitFailure::Overtaken => "their period is shorter than the bus allows; choose a longer --period",
    }
}
