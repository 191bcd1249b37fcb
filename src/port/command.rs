//! Carries out a host's commands. Those that must wait for a controller become [`Work`], which each poll advances; nothing here blocks.

use cantap_wire::message::{ChannelConfig, Defaults, Filter, MAX_FILTERS, Status, capability};
use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS};
use cantap_wire::{BitTiming, CHANNELS, Channel, Command, Hello, PROTOCOL_VERSION, Refusal, Reply};
use heapless::{String, Vec};

use crate::bus::capture::Closing;
use crate::bus::filters::{BANKS, Layout};
use crate::bus::periodic::PERIODIC_SLOTS;
use crate::bus::transmit::{TRIGGER_SLOTS, TX_QUEUE};
use crate::port::board::Board;
use crate::ports::{Chip, Control, EdgeMeter, FilterBanks};
use crate::{CAN_CLOCK_HZ, QUEUE_BYTES, TICK_HZ, TICKS_PER_MS};

mod gateway;
mod measuring;
mod sending;
mod settings;

use measuring::Measuring;
pub use sending::send;
use sending::{set_periodic, set_trigger};
pub use settings::MAX_SAVED;
use settings::{
    ChannelSettings, MAX_SETTINGS, add_reports, load_gateway, saved, saved_reports, store, store_gateway,
};

/// A controller leaves the bus when its frame has ended: 160 bits at 5 kbit/s are 32 ms. After this long it is stuck, and made to leave.
const STOP_WITHIN_TICKS: u32 = 100 * TICKS_PER_MS;
/// A controller that is made to leave takes a moment (Linux's `drivers/net/can/bxcan.c` checks every 10 ms). After this it is broken.
const HALT_WITHIN_TICKS: u32 = 100 * TICKS_PER_MS;
/// A frame is released from a FIFO within a few clocks. After this long it is not, and the controller's reset is to empty the FIFO.
const RELEASE_WITHIN_TICKS: u32 = 2 * TICKS_PER_MS;
/// Steps of closing a channel that one poll takes: 32 records, each step under a lock of its own.
const STEPS_PER_POLL: usize = 8;
/// Time for the answer to reach the host before the device restarts.
const LEAVE_AFTER_TICKS: u32 = 50 * TICKS_PER_MS;

/// Who a device is.
#[derive(Clone, Debug)]
pub struct Identity {
    /// Board name.
    pub board: &'static str,
    /// Serial number.
    pub serial: String<24>,
}

/// Something that takes more than one poll.
#[derive(Clone, Copy, Debug)]
pub enum Work {
    /// Both channels leave the bus and everything is dropped: a session begins or ends.
    Silence,
    /// A session begins or ends beside a gateway that needs no host: its channels stay as they are.
    Keep,
    /// Both channels leave the bus and say so in the stream, which is kept: the host is asleep.
    Retreat,
    /// A channel joins the bus.
    Open(Channel, ChannelConfig),
    /// A channel leaves the bus and says so in the stream.
    Close(Channel),
    /// A channel leaves the bus and joins it again.
    Recover(Channel),
    /// The firmware restarts.
    Restart,
    /// The bootloader takes over.
    Bootloader,
}

impl Work {
    /// What begins or ends a session.
    pub fn fresh<'q, const N: usize>(board: &mut impl Board<'q, N>) -> Self {
        if board.with_capture(|capture, _, _| capture.is_standalone()) { Self::Keep } else { Self::Silence }
    }
}

/// A FIFO that does not become empty after its channel has left the bus.
#[derive(Clone, Copy, Debug)]
enum Emptying {
    /// It has not been found so.
    No,
    /// It was found so at this time.
    Since(u32),
    /// The controller's reset, which empties it, was requested at this time.
    Reset(u32),
}

/// The immediate result of a command.
#[expect(clippy::large_enum_variant, reason = "no allocation on the device")]
pub enum Step {
    /// It is done.
    Done(Reply),
    /// It has begun.
    Begun(Work),
}

/// What commands have set.
pub struct Commands {
    identity: Identity,
    layout: Layout,
    settings: [ChannelSettings; CHANNELS],
    /// Which controllers are being made to leave their bus.
    halting: [bool; CHANNELS],
    /// How far the work under way has come with each channel's FIFO.
    emptying: [Emptying; CHANNELS],
    /// The measurement of a receive pin under way, if any.
    measuring: Option<Measuring>,
    /// When the work under way began.
    begun: u32,
    /// Requests that could not be read.
    pub bad_requests: u32,
}

impl Commands {
    /// Nothing set.
    pub const fn new(identity: Identity) -> Self {
        const NOTHING: ChannelSettings = ChannelSettings { config: None, filters: Vec::new() };
        Self {
            identity,
            layout: Layout::open(),
            settings: [NOTHING; CHANNELS],
            halting: [false; CHANNELS],
            emptying: [Emptying::No; CHANNELS],
            measuring: None,
            begun: 0,
            bad_requests: 0,
        }
    }

    /// The answer to [`Command::Hello`].
    pub fn hello(&self) -> Hello {
        Hello {
            protocol: PROTOCOL_VERSION,
            firmware: VERSION,
            // Cannot fail: board names are short.
            board: String::try_from(self.identity.board).unwrap_or_default(),
            serial: self.identity.serial.clone(),
            channels: CHANNELS as u8,
            tick_hz: TICK_HZ,
            can_clock_hz: CAN_CLOCK_HZ,
            queue_bytes: QUEUE_BYTES as u32,
            tx_queue: TX_QUEUE as u16,
            periodic_slots: PERIODIC_SLOTS as u8,
            trigger_slots: TRIGGER_SLOTS as u8,
            filter_banks: BANKS as u8,
            capabilities: capability::TRANSMIT
                | capability::TIMED_TRANSMIT
                | capability::SLCAN
                | capability::DEFAULTS
                | capability::BOOTLOADER
                | capability::EDGES
                | capability::GATEWAY,
        }
    }

    /// Carries out a command, or begins to.
    pub fn execute<'q, const N: usize>(
        &mut self,
        command: Command,
        board: &mut impl Board<'q, N>,
    ) -> Result<Step, Refusal> {
        board.prepare(&command)?;
        let reply = match command {
            Command::Hello { protocol } if protocol != PROTOCOL_VERSION => {
                return Err(Refusal::Protocol { device: PROTOCOL_VERSION });
            }
            Command::Hello { .. } => return Ok(self.begin(Work::fresh(board), board)),
            Command::Open { channel, config } => return self.open(channel, config, board),
            Command::Close { channel } => return Ok(self.close(channel, board)),
            Command::Status => Reply::Status(self.status(board)),
            Command::Time => Reply::Time(board.with_capture(|capture, _, clock| capture.now(clock))),
            Command::SetFilters { channel, filters } => self.set_filters(channel, &filters, board)?,
            Command::Send { channel, frames } => Reply::Queued { free: send(channel, &frames, board)? },
            #[cfg(not(target_os = "none"))]
            Command::SendFd { channel, frames } if board.sends_fd() => {
                Reply::Queued { free: sending::send_fd(channel, &frames, board)? }
            }
            Command::SendFd { .. } => return Err(Refusal::Unsupported),
            Command::Abort { channel } => {
                board.with_capture(|capture, traffic, clock| {
                    capture.abort(channel, &mut traffic[channel.index()], clock);
                });
                Reply::Done
            }
            Command::SetPeriodic { channel, slot, entry } => set_periodic(channel, slot, entry, board)?,
            Command::SetTrigger { channel, slot, entry } => set_trigger(channel, slot, entry, board)?,
            Command::Registers { channel } => {
                Reply::Registers(board.with_capture(|capture, traffic, _| {
                    capture.registers(channel, &traffic[channel.index()])
                }))
            }
            Command::Recover { channel } => return self.recover(channel, board),
            Command::Identify { seconds } => {
                board.chip().identify(seconds);
                Reply::Done
            }
            Command::Reset => return Ok(self.begin(Work::Restart, board)),
            Command::Bootloader => return Ok(self.begin(Work::Bootloader, board)),
            Command::SaveDefaults => self.save(None, board)?,
            Command::ClearDefaults => store(&[], board)?,
            Command::Configure { channel, config } => self.configure(channel, config, board)?,
            Command::Defaults { channel } => {
                Reply::Defaults(saved(channel, board).ok_or(Refusal::NothingSaved)?)
            }
            Command::Failures => Reply::Failures(board.chip().failures()),
            Command::MeasureEdges { channel } => measuring::measure(&mut self.measuring, channel, board)?,
            Command::Edges => measuring::edges(&mut self.measuring, board)?,
            Command::SetGatewayRule { from, slot, rule } => gateway::set_rule(from, slot, rule, board)?,
            Command::GatewayRule { from, slot } => gateway::rule(from, slot, board)?,
            Command::StartGateway => gateway::start(board)?,
            Command::StopGateway => gateway::stop(board),
            Command::GatewayStatus { from, first } => gateway::status(from, first, board),
            Command::SaveGateway => store_gateway(&self.settings, board)?,
            #[cfg(any(feature = "disturb", not(target_os = "none")))]
            Command::UnlockDisturbance { word } => disturb::unlock(word, board)?,
            #[cfg(any(feature = "disturb", not(target_os = "none")))]
            Command::Disturb { channel, at_ticks, bits } => disturb::plan(channel, at_ticks, bits, board)?,
        };
        Ok(Step::Done(reply))
    }

    /// Begins work, which the session then advances.
    pub fn begin<'q, const N: usize>(&mut self, work: Work, board: &mut impl Board<'q, N>) -> Step {
        self.begun = board.now();
        self.emptying = [Emptying::No; CHANNELS];
        self.end_measurement(work, board);
        #[cfg(any(feature = "disturb", not(target_os = "none")))]
        match work {
            Work::Open(channel, _) | Work::Close(channel) | Work::Recover(channel) => {
                disturb::leave(&[channel], board);
            }
            Work::Retreat => {
                disturb::leave(&Channel::ALL, board);
                disturb::lock(board);
            }
            Work::Keep | Work::Silence | Work::Restart | Work::Bootloader => disturb::lock(board),
        }
        match work {
            // A restart in the middle of a frame would destroy it for everyone on the bus.
            Work::Silence | Work::Restart | Work::Bootloader => {
                for channel in Channel::ALL {
                    board.with_capture(|capture, traffic, _| {
                        capture.begin_abandon(channel, &mut traffic[channel.index()]);
                    });
                    board.control(channel).stop();
                }
            }
            Work::Retreat => {
                for channel in Channel::ALL {
                    if board.is_open(channel) {
                        begin_close(channel, board);
                        board.with_capture(|capture, _, _| capture.begin_leaving(channel));
                    }
                    board.control(channel).stop();
                }
            }
            Work::Close(channel) => {
                board.with_capture(|capture, _, _| capture.begin_leaving(channel));
                board.control(channel).stop();
            }
            Work::Open(channel, _) | Work::Recover(channel) => {
                board.control(channel).stop();
            }
            Work::Keep => {}
        }
        Step::Begun(work)
    }

    /// Anything that ends the session also ends a measurement, and so does opening its channel.
    fn end_measurement<'q, const N: usize>(&mut self, work: Work, board: &mut impl Board<'q, N>) {
        let ends = match work {
            Work::Open(channel, _) => self.measuring.is_some_and(|measuring| measuring.channel == channel),
            Work::Close(_) | Work::Recover(_) => false,
            Work::Keep | Work::Silence | Work::Retreat | Work::Restart | Work::Bootloader => true,
        };
        if ends && self.measuring.take().is_some() {
            board.meter().watch(None);
        }
    }

    /// Advances work: returns its result when it is done, `None` while it is under way.
    pub fn progress<'q, const N: usize>(
        &mut self,
        work: Work,
        board: &mut impl Board<'q, N>,
    ) -> Option<Result<Reply, Refusal>> {
        let waited = board.now().wrapping_sub(self.begun);
        match work {
            Work::Silence => {
                // Handle both, even if one of them does not respond.
                let leave = Channel::ALL.map(|channel| self.leave(channel, waited, board));
                if leave.iter().any(Option::is_none) || !self.abandon(board) {
                    return None;
                }
                self.forget(board);
                let refused = leave.into_iter().flatten().find_map(Result::err);
                let mut hello = self.hello();
                board.describe(&mut hello);
                Some(refused.map_or(Ok(Reply::Hello(hello)), Err))
            }
            Work::Keep => {
                self.bad_requests = 0;
                Some(Ok(Reply::Hello(self.hello())))
            }
            Work::Retreat => {
                // Both, as for `Silence`.
                let closed = Channel::ALL.map(|channel| self.leave_and_close(channel, waited, board));
                if closed.iter().any(Option::is_none) {
                    return None;
                }
                Some(closed.into_iter().flatten().find_map(Result::err).map_or(Ok(Reply::Done), Err))
            }
            Work::Open(channel, config) => {
                if let Err(refusal) = self.leave(channel, waited, board)? {
                    return Some(Err(refusal));
                }
                // A reset that was given up may have ended since, and have taken the filters with it.
                self.restore_filters(channel, board);
                board.with_capture(|capture, _, clock| capture.open(channel, config, clock));
                board.control(channel).start(&config);
                self.settings[channel.index()].config = Some(config);
                Some(Ok(Reply::Opened(config)))
            }
            Work::Close(channel) => {
                self.leave_and_close(channel, waited, board).map(|closed| closed.map(|()| Reply::Done))
            }
            Work::Recover(channel) => {
                let halted = self.halting[channel.index()];
                if let Err(refusal) = self.leave(channel, waited, board)? {
                    return Some(Err(refusal));
                }
                let config = board.with_capture(|capture, _, _| capture.config(channel).copied());
                match config.filter(|_| halted) {
                    Some(config) => board.control(channel).start(&config),
                    None => board.control(channel).resume(),
                }
                Some(Ok(Reply::Done))
            }
            Work::Restart | Work::Bootloader => {
                // A controller that does not respond is left alone in the end.
                let leave = Channel::ALL.map(|channel| self.leave(channel, waited, board));
                if waited < LEAVE_AFTER_TICKS || leave.iter().any(Option::is_none) {
                    return None;
                }
                if matches!(work, Work::Bootloader) {
                    board.chip().bootloader();
                }
                board.chip().reset();
                // Reached only where there is no chip to restart.
                Some(Ok(Reply::Done))
            }
        }
    }

    /// Whether a channel has left the bus; if that takes too long, it is made to. `None` while it is under way.
    fn leave<'q, const N: usize>(
        &mut self,
        channel: Channel,
        waited: u32,
        board: &mut impl Board<'q, N>,
    ) -> Option<Result<(), Refusal>> {
        let halting = &mut self.halting[channel.index()];
        if !board.control(channel).is_stopped() && (waited > STOP_WITHIN_TICKS || *halting) {
            board.control(channel).halt();
            // Right after the reset, because the other channel may hear nothing until then.
            if !core::mem::replace(halting, true) {
                self.restore_filters(channel, board);
            }
        }
        let halting = &mut self.halting[channel.index()];
        if board.control(channel).is_stopped() {
            if core::mem::take(halting) {
                self.restore_filters(channel, board);
            }
            return Some(Ok(()));
        }
        let overdue = waited > STOP_WITHIN_TICKS + HALT_WITHIN_TICKS;
        overdue.then(|| {
            *halting = false;
            Err(Refusal::Hardware)
        })
    }

    /// A channel's controller was reset. If that took the filters with it, another open channel may have missed frames.
    fn restore_filters<'q, const N: usize>(&self, channel: Channel, board: &mut impl Board<'q, N>) {
        if !board.filters().write(&self.layout) {
            return;
        }
        for other in Channel::ALL {
            if other != channel && board.is_open(other) {
                board.with_capture(|capture, _, clock| capture.was_deaf(other, clock));
            }
        }
    }

    /// As [`Self::leave`], and if the channel was open, its last records have been written too.
    fn leave_and_close<'q, const N: usize>(
        &mut self,
        channel: Channel,
        waited: u32,
        board: &mut impl Board<'q, N>,
    ) -> Option<Result<(), Refusal>> {
        if let Err(refusal) = self.leave(channel, waited, board)? {
            return Some(Err(refusal));
        }
        if !board.is_open(channel) {
            return Some(Ok(()));
        }
        let emptied = board.with_capture(|capture, traffic, clock| {
            capture.close_fifo(channel, &mut traffic[channel.index()], clock)
        });
        if !emptied {
            return self.empty(channel, true, board).then_some(Err(Refusal::Hardware));
        }
        let overdue = waited > STOP_WITHIN_TICKS;
        for _ in 0..STEPS_PER_POLL {
            let closing = board.with_capture(|capture, traffic, clock| {
                capture.finish_close(channel, &mut traffic[channel.index()], clock, overdue)
            });
            match closing {
                Closing::Done => return Some(Ok(())),
                Closing::Continue => {}
                Closing::Wait => break,
            }
        }
        None
    }

    /// A channel that has left the bus still has frames in its FIFO. After a while the controller's own reset, which empties it (RM0090, CAN_MCR,
    /// RESET), is requested, and if `told`, what it holds is recorded as lost. Returns whether even that has not helped in time.
    fn empty<'q, const N: usize>(
        &mut self,
        channel: Channel,
        told: bool,
        board: &mut impl Board<'q, N>,
    ) -> bool {
        let index = channel.index();
        let now = board.now();
        match self.emptying[index] {
            Emptying::No => self.emptying[index] = Emptying::Since(now),
            Emptying::Since(at) if now.wrapping_sub(at) > RELEASE_WITHIN_TICKS => {
                if told {
                    board.with_capture(|capture, _, clock| capture.lose_fifo(channel, clock));
                }
                board.control(channel).halt();
                self.halting[index] = true;
                self.emptying[index] = Emptying::Reset(now);
                self.restore_filters(channel, board);
            }
            Emptying::Reset(at) => return now.wrapping_sub(at) > HALT_WITHIN_TICKS,
            Emptying::Since(_) => {}
        }
        false
    }

    /// Both channels have left the bus, and nobody listens. Returns whether their FIFOs are empty, too, or nothing helps.
    fn abandon<'q, const N: usize>(&mut self, board: &mut impl Board<'q, N>) -> bool {
        let done = Channel::ALL.map(|channel| {
            let index = channel.index();
            let emptied =
                board.with_capture(|capture, traffic, _| capture.abandon(channel, &mut traffic[index]));
            emptied || self.empty(channel, false, board)
        });
        done == [true; CHANNELS]
    }

    /// Both channels have left the bus: nothing of the last session remains.
    fn forget<'q, const N: usize>(&mut self, board: &mut impl Board<'q, N>) {
        for settings in &mut self.settings {
            settings.filters.clear();
            settings.config = None;
        }
        self.bad_requests = 0;
        let open = Layout::open();
        if self.layout != open {
            board.filters().write(&open);
            self.layout = open;
        }
    }

    /// Begins what a stored gateway needs before it can start, if there is one: the next channel that is not open is opened.
    pub fn begin_stored_gateway<'q, const N: usize>(
        &mut self,
        board: &mut impl Board<'q, N>,
    ) -> Option<Work> {
        if Channel::ALL.iter().all(|&channel| !board.is_open(channel)) && !load_gateway(board) {
            return None;
        }
        let channel = Channel::ALL.into_iter().find(|&channel| !board.is_open(channel))?;
        match self.open(channel, None, board) {
            Ok(Step::Begun(work)) => Some(work),
            _ => None,
        }
    }

    /// A channel's configuration in this session.
    pub fn config(&self, channel: Channel) -> Option<ChannelConfig> {
        self.settings[channel.index()].config
    }

    /// A channel's configuration in this session, or the one that was saved.
    pub fn config_or_saved<'q, const N: usize>(
        &self,
        channel: Channel,
        board: &mut impl Board<'q, N>,
    ) -> Option<ChannelConfig> {
        self.config(channel).or_else(|| saved(channel, board).map(|saved| saved.config))
    }

    #[inline(never)]
    fn open<'q, const N: usize>(
        &mut self,
        channel: Channel,
        config: Option<ChannelConfig>,
        board: &mut impl Board<'q, N>,
    ) -> Result<Step, Refusal> {
        if board.is_open(channel) {
            return Err(Refusal::ChannelOpen);
        }
        let config = if let Some(config) = config {
            check(&config, board)?;
            config
        } else {
            let Defaults { config, filters } = saved(channel, board).ok_or(Refusal::NothingSaved)?;
            check(&config, board)?;
            // Last, because it is the one step that changes something.
            self.set_filters(channel, &filters, board)?;
            config
        };
        Ok(self.begin(Work::Open(channel, config), board))
    }

    fn configure<'q, const N: usize>(
        &mut self,
        channel: Channel,
        config: ChannelConfig,
        board: &mut impl Board<'q, N>,
    ) -> Result<Reply, Refusal> {
        if board.is_open(channel) {
            return Err(Refusal::ChannelOpen);
        }
        check(&config, board)?;
        self.settings[channel.index()].config = Some(config);
        Ok(Reply::Done)
    }

    fn close<'q, const N: usize>(&mut self, channel: Channel, board: &mut impl Board<'q, N>) -> Step {
        if !board.is_open(channel) {
            return Step::Done(Reply::Done);
        }
        begin_close(channel, board);
        self.begin(Work::Close(channel), board)
    }

    fn recover<'q, const N: usize>(
        &mut self,
        channel: Channel,
        board: &mut impl Board<'q, N>,
    ) -> Result<Step, Refusal> {
        let status = board.with_capture(|capture, _, clock| capture.status(channel, clock));
        if status.open.is_none() {
            return Err(Refusal::ChannelClosed);
        }
        if status.state != cantap_wire::record::ErrorState::BusOff {
            return Err(Refusal::NotBusOff);
        }
        Ok(self.begin(Work::Recover(channel), board))
    }

    /// Replaces a closed channel's filters.
    #[inline(never)]
    fn set_filters<'q, const N: usize>(
        &mut self,
        channel: Channel,
        filters: &Vec<Filter, MAX_FILTERS>,
        board: &mut impl Board<'q, N>,
    ) -> Result<Reply, Refusal> {
        if board.is_open(channel) {
            return Err(Refusal::ChannelOpen);
        }
        let layout = self.layout.with(channel, filters)?;
        let other_open = Channel::ALL.iter().any(|&other| other != channel && board.is_open(other));
        if other_open && self.layout.disturbs(&layout) {
            return Err(Refusal::WouldDisturb);
        }
        board.filters().write(&layout);
        self.layout = layout;
        self.settings[channel.index()].filters.clone_from(filters);
        let used = Channel::ALL.map(|channel| self.layout.used(channel));
        let banks_used = used[channel.index()];
        let others: usize = used.iter().sum::<usize>() - banks_used;
        Ok(Reply::Filters { banks_used: banks_used as u8, banks_total: (BANKS - others) as u8 })
    }

    fn status<'q, const N: usize>(&self, board: &mut impl Board<'q, N>) -> Status {
        let (ticks, fill) = board.with_capture(|capture, _, clock| (capture.now(clock), capture.fill()));
        // One channel at a time, to hold up the tasks of priority 4 for less time.
        let channels = Channel::ALL
            .map(|channel| board.with_capture(|capture, _, clock| capture.status(channel, clock)));
        let chip = board.chip();
        Status {
            ticks,
            queue_bytes: fill.0,
            queue_high_water_bytes: fill.1,
            bad_requests: self.bad_requests,
            temperature_decicelsius: chip.temperature_decicelsius(),
            supply_millivolts: chip.supply_millivolts(),
            channels,
        }
    }

    /// Whether the saved settings ask for slcan's reports.
    pub fn saved_reports<'q, const N: usize>(&self, board: &mut impl Board<'q, N>) -> bool {
        saved_reports(board)
    }

    /// Stores each configured channel's settings, keeping what is stored for the other, and, if given, whether slcan reports.
    #[inline(never)]
    pub fn save<'q, const N: usize>(
        &self,
        reports: Option<bool>,
        board: &mut impl Board<'q, N>,
    ) -> Result<Reply, Refusal> {
        if reports.is_none() && self.settings.iter().all(|settings| settings.config.is_none()) {
            return Err(Refusal::NothingSaved);
        }
        let reports = reports.unwrap_or_else(|| saved_reports(board));
        let mut bytes = [0; MAX_SETTINGS];
        let mut len = 0;
        for (channel, settings) in Channel::ALL.into_iter().zip(&self.settings) {
            let out = &mut bytes[len..];
            let written = match saved(channel, board) {
                Some(Defaults { config, filters }) if settings.config.is_none() => {
                    postcard::to_slice(&ChannelSettings { config: Some(config), filters }, out)
                }
                _ => postcard::to_slice(settings, out),
            };
            // Cannot fail: there is room for the most there can be.
            len += written.map_err(|_| Refusal::Hardware)?.len();
        }
        let len = add_reports(reports, len, &mut bytes);
        store(&bytes[..len], board)
    }
}

/// Checks that a channel can be opened so.
#[inline]
fn check<'q, const N: usize>(config: &ChannelConfig, board: &impl Board<'q, N>) -> Result<(), Refusal> {
    if board.needs_no_bit_rate() && config.timing == BitTiming::UNKNOWN {
        return Ok(());
    }
    check_timing(config)
}

/// Checks that a controller can take a configuration. Outside the range of bit rates, the arithmetic of the deadlines does not hold.
fn check_timing(config: &ChannelConfig) -> Result<(), Refusal> {
    let timing = &config.timing;
    let possible =
        timing.is_valid() && (MIN_BITRATE_BPS..=MAX_BITRATE_BPS).contains(&timing.bitrate_bps(CAN_CLOCK_HZ));
    if possible { Ok(()) } else { Err(Refusal::BadTiming) }
}

/// This firmware's version.
pub const VERSION: [u16; 3] = [
    parse(env!("CARGO_PKG_VERSION_MAJOR")),
    parse(env!("CARGO_PKG_VERSION_MINOR")),
    parse(env!("CARGO_PKG_VERSION_PATCH")),
];

const fn parse(text: &str) -> u16 {
    let bytes = text.as_bytes();
    let mut value = 0;
    let mut index = 0;
    while index < bytes.len() {
        value = value * 10 + (bytes[index] - b'0') as u16;
        index += 1;
    }
    value
}

fn begin_close<'q, const N: usize>(channel: Channel, board: &mut impl Board<'q, N>) {
    // Two locks: each takes a while.
    board.with_capture(|capture, _, clock| capture.end_entries(channel, clock));
    board.with_capture(|capture, traffic, clock| {
        capture.begin_close(channel, traffic, clock);
    });
}

#[cfg(any(feature = "disturb", not(target_os = "none")))]
mod disturb;
