//! An adapter as the firmware's hardware.

use std::cell::{Cell, RefCell};
use std::io::Write;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use cantap::device::{PipeReader, PipeWriter};
use cantap_firmware::bus::capture::Capture;
use cantap_firmware::bus::filters::{Bank, Layout};
use cantap_firmware::bus::sof::SofReading;
use cantap_firmware::port::board::Board;
use cantap_firmware::ports::{Chip, Clock, EdgeMeter, FilterBanks, PACKET, PinEdge, Port};
use cantap_firmware::{CAN_CLOCK_HZ, QUEUE_BYTES, TICK_HZ};
use cantap_trace::TraceFrame;
use cantap_wire::message::{ChannelConfig, Failures, MAX_FAILURE_TEXT, Mode, capability};
use cantap_wire::{BitTiming, CHANNELS, Channel, Command, Hello, Refusal};
use heapless::String;

use crate::driver::{Driver, Opening};
use crate::mailboxes::{ControlSide, Mailboxes, Phase, TrafficSide};
use crate::rows::{Confirmation, ListenOnly};

/// Nanoseconds of a tick, times three: 12 MHz.
const TICKS_PER_3_US: u128 = 3 * TICK_HZ as u128 / 1_000_000;

/// This computer's monotonic clock as the stamp timer.
pub(crate) struct HostClock {
    started: Instant,
    alarm: Cell<Option<u64>>,
}

impl HostClock {
    pub fn start() -> Self {
        Self { started: Instant::now(), alarm: Cell::new(None) }
    }

    /// The timer at a time; 0 before it started.
    pub fn ticks_at(&self, at: Instant) -> u64 {
        (at.saturating_duration_since(self.started).as_nanos() * TICKS_PER_3_US / 3_000) as u64
    }

    /// How long until the alarm; `None` if there is none.
    pub fn until_alarm(&self) -> Option<Duration> {
        let due = self.alarm.get()?;
        let at =
            self.started + Duration::from_nanos((u128::from(due) * 3_000).div_ceil(TICKS_PER_3_US) as u64);
        Some(at.saturating_duration_since(Instant::now()))
    }

    /// Whether the alarm was due; it is off afterwards.
    pub fn take_alarm(&self) -> bool {
        let is_due = self.until_alarm().is_some_and(|wait| wait.is_zero());
        if is_due {
            self.alarm.set(None);
        }
        is_due
    }
}

impl Clock for HostClock {
    fn now(&self) -> u32 {
        self.ticks_at(Instant::now()) as u32
    }

    fn set_alarm(&self, at: Option<u32>) {
        self.alarm.set(at.map(|at| {
            let now = self.ticks_at(Instant::now());
            let ahead = at.wrapping_sub(now as u32) as i32;
            now + u64::from(ahead.max(0) as u32)
        }));
    }
}

/// Filters in this program, as a board's hardware would apply them: an adapter's own are not used.
#[derive(Default)]
pub(crate) struct Filters([Vec<Bank>; CHANNELS]);

impl Filters {
    pub fn open() -> Self {
        Self([const { Vec::new() }; CHANNELS].map(|_: Vec<Bank>| vec![Bank::ALL]))
    }

    pub fn pass(&self, channel: Channel, frame: &TraceFrame) -> bool {
        let frame = match frame {
            TraceFrame::Classic(frame) => *frame,
            TraceFrame::Fd(frame) => frame.identifier_frame(),
        };
        self.0[channel.index()].iter().any(|bank| bank.passes(&frame))
    }
}

impl FilterBanks for Filters {
    fn write(&mut self, layout: &Layout) -> bool {
        let (first, second) = layout.banks.split_at(usize::from(layout.split));
        let banks = [first, second].map(|banks| banks.iter().flatten().copied().collect());
        let differed = self.0 != banks;
        self.0 = banks;
        differed
    }
}

/// There is no chip. What the adapter sent that makes no sense is reported in its place.
pub(crate) struct NoChip(pub (u32, std::string::String));

impl Chip for NoChip {
    fn temperature_decicelsius(&mut self) -> Option<i16> {
        None
    }

    fn supply_millivolts(&mut self) -> Option<u16> {
        None
    }

    fn failures(&mut self) -> Failures {
        let (count, text) = &self.0;
        let mut last = String::<MAX_FAILURE_TEXT>::new();
        for letter in text.chars() {
            if last.push(letter).is_err() {
                break;
            }
        }
        Failures { count: *count, last }
    }

    fn identify(&mut self, _seconds: u8) {}

    fn reset(&mut self) {}

    fn bootloader(&mut self) -> bool {
        false
    }

    fn save(&mut self, _bytes: &[u8]) -> bool {
        false
    }

    fn load(&mut self, _out: &mut [u8]) -> usize {
        0
    }
}

/// No pin can be measured.
pub(crate) struct NoMeter;

impl EdgeMeter for NoMeter {
    fn watch(&mut self, _channel: Option<Channel>) {}

    fn next(&mut self) -> Option<PinEdge> {
        None
    }

    fn is_dominant(&self) -> bool {
        false
    }
}

/// Everything that the firmware's commands access.
pub(crate) struct AdapterBoard<'q> {
    pub capture: Capture<'q>,
    pub boxes: [Rc<RefCell<Mailboxes>>; CHANNELS],
    pub traffic: [TrafficSide; CHANNELS],
    pub control: [ControlSide; CHANNELS],
    pub clock: HostClock,
    pub filters: Filters,
    pub chip: NoChip,
    pub meter: NoMeter,
    pub driver: Box<dyn Driver>,
    /// The time at which the firmware's commands stand still, while the engine delivers what a channel that is being closed had received.
    pub held_at: Option<u32>,
}

impl AdapterBoard<'_> {
    /// Asks the adapter to take part in a bus.
    fn open_channel(&mut self, channel: Channel, config: &ChannelConfig) -> Result<(), Refusal> {
        let row = self.driver.row();
        let listen_only = match config.mode {
            Mode::ListenOnly => true,
            Mode::Normal => false,
            Mode::Loopback | Mode::SilentLoopback => return Err(Refusal::Unsupported),
        };
        let too_many = channel.number() > self.driver.channels();
        if too_many
            || config.one_shot
            || config.manual_recovery
            || listen_only && row.listen_only == ListenOnly::Never
        {
            return Err(Refusal::Unsupported);
        }
        let boxes = Rc::clone(&self.boxes[channel.index()]);
        if boxes.borrow().phase == Phase::Opened {
            // An earlier request got no further than this.
            self.driver.close(channel);
            boxes.borrow_mut().switch_off();
        }
        let opening = Opening {
            bitrate_bps: config.timing.bitrate_bps(CAN_CLOCK_HZ),
            sample_point_permille: config.timing.sample_point_permille(),
            listen_only,
        };
        self.driver.open(channel, opening)?;
        boxes.borrow_mut().phase = Phase::Opened;
        Ok(())
    }
}

impl<'q> Board<'q, QUEUE_BYTES> for AdapterBoard<'q> {
    type Traffic = TrafficSide;
    type Control = ControlSide;
    type Clock = HostClock;
    type Filters = Filters;
    type Chip = NoChip;
    type Meter = NoMeter;

    fn with_capture<R>(
        &mut self,
        act: impl FnOnce(&mut Capture<'q>, &mut [TrafficSide; CHANNELS], &HostClock) -> R,
    ) -> R {
        act(&mut self.capture, &mut self.traffic, &self.clock)
    }

    fn now(&self) -> u32 {
        self.held_at.unwrap_or_else(|| self.clock.now())
    }

    fn take_sof(&mut self) -> Option<SofReading> {
        None
    }

    fn control(&mut self, channel: Channel) -> &mut ControlSide {
        &mut self.control[channel.index()]
    }

    fn filters(&mut self) -> &mut Filters {
        &mut self.filters
    }

    fn chip(&mut self) -> &mut NoChip {
        self.chip = NoChip(self.driver.oddities());
        &mut self.chip
    }

    fn meter(&mut self) -> &mut NoMeter {
        &mut self.meter
    }

    fn describe(&self, hello: &mut Hello) {
        let row = self.driver.row();
        let sends = row.confirmation != Confirmation::CannotSend;
        hello.firmware = self.driver.version();
        hello.channels = self.driver.channels().min(CHANNELS as u8);
        hello.capabilities = capability::ADAPTER;
        if sends {
            hello.capabilities |= capability::TRANSMIT | capability::TIMED_TRANSMIT;
        } else {
            (hello.tx_queue, hello.periodic_slots, hello.trigger_slots) = (0, 0, 0);
        }
        if sends && self.driver.sends_fd() {
            hello.capabilities |= capability::FD_TRANSMIT;
        }
        if row.listen_only == ListenOnly::Never {
            hello.capabilities |= capability::ALWAYS_ACKNOWLEDGES;
        }
        if !row.losses.are_counted() {
            hello.capabilities |= capability::UNCOUNTED_LOSSES;
        }
        if !row.sets_bit_rate {
            hello.capabilities |= capability::NO_BIT_RATE;
        }
    }

    fn needs_no_bit_rate(&self) -> bool {
        !self.driver.row().sets_bit_rate
    }

    fn sends_fd(&self) -> bool {
        self.driver.sends_fd()
    }

    fn prepare(&mut self, command: &Command) -> Result<(), Refusal> {
        let sends = self.driver.row().confirmation != Confirmation::CannotSend;
        match command {
            Command::SetPeriodic { .. } | Command::SetTrigger { .. } if !sends => Err(Refusal::Unsupported),
            Command::Registers { .. }
            | Command::Reset
            | Command::Bootloader
            | Command::SaveDefaults
            | Command::ClearDefaults
            | Command::MeasureEdges { .. }
            | Command::SetGatewayRule { .. }
            | Command::StartGateway
            | Command::SaveGateway
            | Command::UnlockDisturbance { .. }
            | Command::Disturb { .. } => Err(Refusal::Unsupported),
            Command::Identify { seconds } => self.driver.identify(*seconds),
            // What the firmware refuses anyway must not reach the adapter.
            Command::Open { channel, config: Some(config) }
                if (config.timing.is_valid()
                    || config.timing == BitTiming::UNKNOWN && self.needs_no_bit_rate())
                    && !self.is_open(*channel) =>
            {
                self.open_channel(*channel, config)
            }
            _ => Ok(()),
        }
    }
}

/// The pipe to the host as the firmware's port.
pub(crate) struct PipePort {
    pub from_host: PipeReader,
    pub to_host: PipeWriter,
    pub quit: Arc<AtomicBool>,
    held: bool,
}

impl PipePort {
    pub const fn new(from_host: PipeReader, to_host: PipeWriter, quit: Arc<AtomicBool>) -> Self {
        Self { from_host, to_host, quit, held: false }
    }
}

impl Port for PipePort {
    fn is_open(&self) -> bool {
        !self.to_host.is_closed() && !self.quit.load(Ordering::Relaxed)
    }

    fn write(&mut self, bytes: &[u8]) -> Option<usize> {
        // Whole packets, or all of it.
        let room = self.to_host.room();
        let len = if bytes.len() <= room { bytes.len() } else { room / PACKET * PACKET };
        (len > 0 || bytes.is_empty()).then_some(())?;
        // There is room, so it takes all of it at once.
        self.to_host.write_all(&bytes[..len]).ok().map(|()| len)
    }

    fn read(&mut self, packet: &mut [u8; PACKET]) -> Option<usize> {
        let len = if self.held { 0 } else { self.from_host.take(packet) };
        (len > 0).then_some(len)
    }

    fn hold(&mut self, hold: bool) {
        self.held = hold;
    }
}
