//! A board whose silicon answers late, wrongly or never, on a host that misbehaves ([`cantap_emu::hostile`]): everything from one seed.
//!
//! A trial is a storm and then calm. In the storm anything may fail, except what must never happen: a dominant bit that nobody asked for,
//! a frame that is neither delivered nor counted, a frame that was never on the bus, misuse of the USB controller. In the calm, within [`BACK_WITHIN`], the device is
//! back without the watchdog's help: it enumerates, begins a session and captures every frame.

use cantap_emu::hostile::Hostile;
use cantap_emu::otg::Misuse;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::{Status, Timing};
use cantap_emu::{Image, Setup};
use cantap_wire::message::{ChannelConfig, Filter, FrameKind, GatewayRule, Mode, Pass, RuleCounts, TxFrame};
use cantap_wire::{CHANNELS, Channel, Command, Reply};
use fastrand::Rng;

use crate::board::{self, CLOCK};
use crate::capture::Ledger;
use crate::rig::{MS, Rig, RigError, timing};

const MEGABIT: u32 = 1_000_000;
/// How long the device may take to be back once the silicon is prompt again: a controller that does not leave its bus is given up after
/// 200 ms, and a host debounces, resets and enumerates.
pub const BACK_WITHIN: u64 = 1_500 * MS;
/// How long the host waits for an answer in the storm.
const PATIENCE: u64 = 60 * MS;
/// How long it waits for a port in the storm.
const PORT_PATIENCE: u64 = 250 * MS;
/// What befalls the board in the storm.
const BLOWS: usize = 6;
/// Time after which a device whose host is gone is off the bus: 3 ms of silence, a tick, and a controller that is given up.
const SILENT_WITHIN: u64 = 250 * MS;

/// What happens to the board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Blow {
    Nothing,
    Status,
    Reopen,
    Send,
    Save,
    StopReading,
    HoldDominant,
    ResetBus,
    Suspend,
    Unplug,
    BrownOut,
    Restart,
}

const ALL: [Blow; 12] = [
    Blow::Nothing,
    Blow::Status,
    Blow::Reopen,
    Blow::Send,
    Blow::Save,
    Blow::StopReading,
    Blow::HoldDominant,
    Blow::ResetBus,
    Blow::Suspend,
    Blow::Unplug,
    Blow::BrownOut,
    Blow::Restart,
];

/// How a trial ended.
#[derive(Debug)]
pub struct Trial {
    /// Its seed.
    pub seed: u64,
    /// What was wrong; empty if nothing was.
    pub faults: Vec<String>,
    /// What happened, in order.
    pub story: Vec<String>,
    /// Frames delivered.
    pub delivered: u64,
    /// Frames counted lost.
    pub lost: u64,
}

/// Runs the trial of a seed on firmware for our default board.
pub fn try_seed(image: Image, seed: u64) -> Trial {
    run(image, seed, false)
}

/// The same for a board that passes on between its buses whatever they carry.
pub fn try_gateway(image: Image, seed: u64) -> Trial {
    run(image, seed, true)
}

fn run(image: Image, seed: u64, is_gateway: bool) -> Trial {
    let hostile = Hostile::seeded(seed);
    let setup = Setup {
        hostile: Some(hostile),
        survive_watchdog: true,
        survive_failures: true,
        ..board::setup_for(&image)
    };
    let rig = Rig::new(image, setup, Timing::hasty(CLOCK));
    let mut bench = Bench {
        rig,
        random: Rng::with_seed(seed),
        is_gateway,
        in_session: false,
        may_send: [false; CHANNELS],
        resets: 0,
        resets_wanted: 0,
        misuse: Misuse::default(),
        story: vec![format!("{hostile:?}")],
        faults: Vec::new(),
    };
    if let Err(error) = bench.run() {
        bench.faults.push(format!("the emulation ended: {error}"));
    }
    let Bench { rig, faults, story, .. } = bench;
    let sum = |of: &dyn Fn(Channel) -> u64| Channel::ALL.into_iter().map(of).sum();
    Trial {
        seed,
        faults,
        story,
        delivered: sum(&|channel| rig.ledger.delivered_count(channel)),
        lost: sum(&|channel| rig.ledger.losses(channel).total()),
    }
}

struct Bench {
    rig: Rig,
    random: Rng,
    is_gateway: bool,
    in_session: bool,
    /// Whether the session has been asked to take part in a channel's bus.
    may_send: [bool; CHANNELS],
    /// Resets seen so far, and those that something else than the firmware's failure caused.
    resets: u64,
    resets_wanted: u64,
    /// As last seen.
    misuse: Misuse,
    story: Vec<String>,
    faults: Vec<String>,
}

impl Bench {
    fn run(&mut self) -> Result<(), RigError> {
        for channel in Channel::ALL {
            let load = [5.0, 20.0, 60.0][self.random.usize(..3)];
            let traffic = Traffic::new(Kind::Mix, self.random.u64(..), load, 0, u64::MAX);
            self.rig.add_traffic(channel, MEGABIT, traffic);
        }
        self.storm()?;
        self.rig.calm();
        self.tell("calm");
        self.end_session()?;
        self.be_silent()?;
        self.come_back()?;
        self.judge();
        Ok(())
    }

    fn tell(&mut self, what: impl std::fmt::Display) {
        let misuse = self.rig.with_host(|_, otg| otg.misuse());
        if misuse != self.misuse {
            self.misuse = misuse;
            self.story.push(format!("{misuse:?}"));
        }
        let at_us = CLOCK.to_us(self.rig.now()) as u64;
        self.story.push(format!("{at_us} µs: {what}"));
    }

    fn fault(&mut self, what: impl std::fmt::Display) {
        let at_us = CLOCK.to_us(self.rig.now()) as u64;
        self.faults.push(format!("{at_us} µs: {what}"));
    }

    fn storm(&mut self) -> Result<(), RigError> {
        self.rig.be_patient_for(PATIENCE);
        for _ in 0..BLOWS {
            if !self.in_session {
                self.begin_session(PORT_PATIENCE)?;
            }
            let span = self.random.u64(MS / 10..5 * MS);
            self.rig.run_for(span)?;
            let blow = ALL[self.random.usize(..ALL.len())];
            self.tell(format_args!("{blow:?}"));
            self.strike(blow)?;
            self.notice_reset()?;
        }
        Ok(())
    }

    /// Puts the cable in and opens both channels. A device that does not answer is left alone; the storm may be in its way.
    fn begin_session(&mut self, patience: u64) -> Result<bool, RigError> {
        if !self.find_port(patience)? || self.asks(|rig| rig.greet().map(|_| ()))?.is_err() {
            return Ok(false);
        }
        self.in_session = true;
        for channel in Channel::ALL {
            self.open(channel)?;
        }
        self.start_gateway()?;
        Ok(self.in_session)
    }

    /// Refused where a channel has not been opened, or while it runs.
    fn start_gateway(&mut self) -> Result<(), RigError> {
        let rules = Channel::ALL.into_iter().flat_map(|from| {
            [false, true].map(|extended| {
                let filter = Filter { extended, kind: FrameKind::Any, id: 0, mask: 0 };
                let rule = Some(GatewayRule { filter, pass: Some(Pass::unchanged(extended)) });
                Command::SetGatewayRule { from, slot: extended.into(), rule }
            })
        });
        for command in rules.chain([Command::StartGateway]) {
            if self.is_gateway && self.in_session {
                drop(self.asks(|rig| rig.ask(command).map(drop))?);
            }
        }
        Ok(())
    }

    /// Every frame that the gateway has matched was sent, or is counted.
    fn account_for_passed(&mut self) -> Result<(), RigError> {
        for from in Channel::ALL {
            if !self.is_gateway || !self.in_session {
                return Ok(());
            }
            let mut found = None;
            let asked = self.asks(|rig| {
                found = Some(rig.ask(Command::GatewayStatus { from, first: 0 })?);
                Ok(())
            })?;
            let Some(Reply::Gateway(status)) = found else {
                self.tell(format_args!("no counts of the gateway: {asked:?}"));
                continue;
            };
            let is_open = |counts: &RuleCounts| {
                counts.matched != counts.sent + counts.overtaken + counts.lost + counts.failed
            };
            if status.waiting > 0 || status.counts.iter().any(is_open) {
                self.fault(format_args!("frames of a gateway that are nowhere: {status:?}"));
            }
            self.tell(format_args!("{status:?}"));
        }
        Ok(())
    }

    /// Waits for a configured port, as patiently as a user who pulls the cable and tries again.
    fn find_port(&mut self, patience: u64) -> Result<bool, RigError> {
        let until = self.rig.now() + patience;
        self.rig.with_host(|host, _| host.plug());
        while self.rig.now() < until {
            let status = self.rig.with_host(|host, _| {
                if host.status() == Status::Ready {
                    host.open_port();
                }
                (host.status(), host.port_ready())
            });
            match status {
                (_, true) => return Ok(true),
                (Status::Failed(error), _) => {
                    self.tell(format_args!("no device: {error}"));
                    self.rig.with_host(|host, _| host.unplug());
                    self.rig.run_for(10 * MS)?;
                    self.rig.with_host(|host, _| host.plug());
                }
                (Status::Suspended, _) => self.rig.with_host(cantap_emu::usb_host::UsbHost::resume),
                _ => {}
            }
            self.rig.run_for(MS)?;
        }
        self.tell("no port");
        Ok(false)
    }

    /// Asks something that the storm may keep from being answered; then the session is over for this host.
    fn asks(
        &mut self,
        ask: impl FnOnce(&mut Rig) -> Result<(), RigError>,
    ) -> Result<Result<(), RigError>, RigError> {
        match ask(&mut self.rig) {
            Err(error @ RigError::Stopped(_)) => Err(error),
            Err(error) => {
                self.tell(&error);
                if !matches!(error, RigError::Refused { .. }) {
                    self.cut()?;
                }
                Ok(Err(error))
            }
            Ok(()) => Ok(Ok(())),
        }
    }

    /// The session is over, whatever became of it; the port is closed.
    fn cut(&mut self) -> Result<(), RigError> {
        self.rig.with_host(|host, _| host.close_port());
        let takes_part = |rig: &mut Rig| Channel::ALL.into_iter().any(|channel| rig.takes_part(channel));
        self.rig.run_while(SILENT_WITHIN, takes_part)?;
        self.rig.run_for(5 * MS)?;
        self.rig.cut();
        self.in_session = false;
        self.may_send = [false; CHANNELS];
        Ok(())
    }

    fn open(&mut self, channel: Channel) -> Result<(), RigError> {
        if !self.in_session {
            return Ok(());
        }
        let mode = if self.random.u8(..4) == 0 || self.is_gateway { Mode::Normal } else { Mode::ListenOnly };
        self.may_send[channel.index()] |= mode == Mode::Normal;
        let config = ChannelConfig { mode, ..ChannelConfig::listen_only(timing(MEGABIT)?) };
        let driven = self.rig.dominant_bits(channel);
        let opened = self.asks(|rig| rig.open(channel, config))?;
        if !self.may_send[channel.index()] && self.rig.dominant_bits(channel) != driven {
            self.fault(format_args!("{channel:?} drove its bus while it was opened to listen"));
        }
        if let Err(RigError::Refused { .. }) = opened {
            self.cut()?;
        }
        Ok(())
    }

    fn strike(&mut self, blow: Blow) -> Result<(), RigError> {
        let channel = Channel::ALL[self.random.usize(..CHANNELS)];
        let span = self.random.u64(MS / 10..8 * MS);
        match blow {
            Blow::Nothing => {}
            Blow::Status | Blow::Reopen | Blow::Send | Blow::Save | Blow::Restart if !self.in_session => {}
            Blow::Status => drop(self.asks(|rig| rig.status().map(drop))?),
            Blow::Reopen => {
                if self.asks(|rig| rig.close(channel))?.is_ok() {
                    self.open(channel)?;
                    self.start_gateway()?;
                } else if self.in_session {
                    self.cut()?;
                }
            }
            Blow::Send => {
                let frame = "123#1122".parse().expect("it is a frame");
                let frames = [TxFrame { tag: 1, frame, at_ticks: None }].into_iter().collect();
                // Refused where the channel only listens.
                drop(self.asks(|rig| rig.ask(Command::Send { channel, frames }).map(drop))?);
            }
            Blow::Save => {
                for channel in Channel::ALL {
                    if !self.in_session {
                        break;
                    }
                    let is_refused = self.asks(|rig| rig.close(channel))?.is_err();
                    // The question may have ended the session.
                    if is_refused && self.in_session {
                        self.cut()?;
                    }
                }
                if self.in_session {
                    drop(self.asks(|rig| rig.ask(Command::SaveDefaults).map(drop))?);
                }
                for channel in Channel::ALL {
                    self.open(channel)?;
                }
                self.start_gateway()?;
            }
            Blow::StopReading => {
                self.rig.with_host(|host, _| host.read(false));
                self.rig.run_for(span)?;
                self.rig.with_host(|host, _| host.read(true));
            }
            Blow::HoldDominant => {
                self.rig.machine.board().hold_buses_dominant(true);
                self.rig.run_for(span)?;
                self.rig.machine.board().hold_buses_dominant(false);
            }
            Blow::ResetBus => {
                self.rig.with_host(cantap_emu::usb_host::UsbHost::reset);
                self.rig.run_for(span)?;
                self.cut()?;
            }
            Blow::Suspend => {
                self.rig.with_host(|host, _| host.suspend());
                self.rig.run_for(4 * MS + span)?;
                self.rig.with_host(cantap_emu::usb_host::UsbHost::resume);
                self.cut()?;
            }
            Blow::Unplug => {
                self.rig.with_host(|host, _| host.unplug());
                self.rig.run_for(span)?;
                self.cut()?;
            }
            Blow::BrownOut => {
                self.resets_wanted += 1;
                let seed = self.random.u64(..);
                self.rig.machine.brown_out(seed);
            }
            Blow::Restart => {
                self.resets_wanted += 1;
                drop(self.asks(|rig| rig.ask(Command::Reset).map(drop))?);
                self.rig.run_for(60 * MS)?;
            }
        }
        Ok(())
    }

    /// A chip that was reset has forgotten its session.
    fn notice_reset(&mut self) -> Result<(), RigError> {
        if self.rig.machine.resets() != self.resets {
            self.resets = self.rig.machine.resets();
            self.tell("the chip was reset");
            self.cut()?;
        }
        Ok(())
    }

    /// In the calm, a session that has survived ends as every session does: with every frame accounted for.
    fn end_session(&mut self) -> Result<(), RigError> {
        self.rig.be_patient_for(BACK_WITHIN);
        for channel in Channel::ALL {
            let closed = if self.in_session { self.asks(|rig| rig.close(channel))? } else { Ok(()) };
            // A reset that was asked for comes late if a controller does not leave its bus, and then it is what ends the session.
            let resets = self.resets;
            self.notice_reset()?;
            if let Some(error) = closed.err().filter(|_| self.resets == resets) {
                self.fault(format_args!("a session that was alive does not end: {error}"));
            }
        }
        self.account_for_passed()
    }

    /// Nobody is there: nothing reaches the buses.
    fn be_silent(&mut self) -> Result<(), RigError> {
        self.cut()?;
        self.rig.with_host(|host, _| host.unplug());
        self.rig.run_for(10 * MS)?;
        let before = Channel::ALL.map(|channel| self.rig.dominant_bits(channel));
        self.rig.run_for(10 * MS)?;
        for channel in Channel::ALL {
            if self.rig.takes_part(channel) || self.rig.dominant_bits(channel) != before[channel.index()] {
                self.fault(format_args!("{channel:?} is on its bus with nobody there"));
            }
        }
        Ok(())
    }

    fn come_back(&mut self) -> Result<(), RigError> {
        let from = self.rig.now();
        let found = self.find_port(BACK_WITHIN)?;
        let begun = if found { self.asks(|rig| rig.greet().map(drop))? } else { Ok(()) };
        if !found || begun.is_err() || self.rig.now() - from > BACK_WITHIN {
            self.fault("the device is not back");
            return Ok(());
        }
        let before = Channel::ALL.map(|channel| self.rig.ledger.delivered_count(channel));
        for channel in Channel::ALL {
            if let Err(error) = self.asks(|rig| rig.listen(channel, MEGABIT))? {
                self.fault(format_args!("{channel:?} does not open: {error}"));
                return Ok(());
            }
        }
        self.rig.run_for(5 * MS)?;
        for channel in Channel::ALL {
            if let Err(error) = self.asks(|rig| rig.close(channel))? {
                self.fault(format_args!("{channel:?} does not close: {error}"));
            }
            if self.rig.ledger.delivered_count(channel) == before[channel.index()] {
                self.fault(format_args!("{channel:?} captures nothing any more"));
            }
        }
        Ok(())
    }

    fn judge(&mut self) {
        if self.rig.machine.resets() > self.resets_wanted {
            let unwanted = self.rig.machine.resets() - self.resets_wanted;
            self.fault(format_args!("{unwanted} resets by failures or the watchdog"));
        }
        self.tell("the end");
        let misuse = self.misuse;
        if misuse != Misuse::default() {
            self.fault(format_args!("OTG_FS was misused: {misuse:?}"));
        }
        let Self { rig, faults, .. } = self;
        faults.extend(law(&rig.ledger));
        faults.extend(rig.session.corruptions().iter().map(|corruption| format!("on USB: {corruption:?}")));
        faults.extend(rig.machine.board().odd_accesses().iter().map(|odd| format!("odd access: {odd}")));
    }
}

fn law(ledger: &Ledger) -> Vec<String> {
    let mut faults = ledger.faults().to_vec();
    if !ledger.holds() && faults.is_empty() {
        faults.push("the books do not balance".to_owned());
    }
    faults
}
