//! The rest of the firmware's hardware: clock, filters, chip, port.

use std::cell::{Cell, RefCell};
use std::io::Write;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use cantap_firmware::bus::capture::Capture;
use cantap_firmware::bus::filters::Layout;
use cantap_firmware::bus::sof::SofReading;
use cantap_firmware::port::board::Board;
use cantap_firmware::ports::{Chip, Clock, FilterBanks, PACKET, Port};
use cantap_firmware::{QUEUE_BYTES, TICK_HZ};
use cantap_wire::message::Failures;
use cantap_wire::{CHANNELS, Channel};

use super::controller::{ControlSide, Controller, TrafficSide};
use super::edges::VirtualMeter;
use super::flash::Flash;
use cantap::device::{PipeReader, PipeWriter};

/// Bulk packets per millisecond: 1.02 MB/s. Full speed would allow 19 (USB 2.0, table 5-9).
const PACKETS_PER_MS: u32 = 16;

/// Nanoseconds in 10⁹ seconds.
const GS_NS: u128 = 1_000_000_000_000_000_000;
/// Nanoseconds of a USB frame.
pub const FRAME_NS: u64 = 1_000_000;
/// When the device's millisecond ticks come after the start of the host's frames, if neither is delayed.
pub const TICK_PHASE_NS: u64 = 700_000;
/// The bits of a frame number in a SOF token (USB 2.0, 8.4.3).
const FRAME_NUMBER: u16 = 0x7FF;

/// Model time as the firmware's stamp timer shows it.
pub struct ModelClock {
    now_ns: Cell<u64>,
    /// When the firmware started.
    started_ns: u64,
    alarm_ns: Cell<Option<u64>>,
    /// Ticks in 10⁹ seconds: [`TICK_HZ`], adjusted by the error of the crystal.
    ticks_per_gs: u64,
    /// Added to model time, this gives the USB host's time, whose frames are whole milliseconds.
    usb_ahead_ns: Cell<u64>,
    /// The last frame shown by the latch.
    frame_seen: Cell<u64>,
}

impl ModelClock {
    /// The clock of a firmware that starts now, with a crystal that is too fast by this much.
    pub fn started_at(now_ns: u64, crystal_ppm: f64) -> Self {
        Self {
            now_ns: Cell::new(now_ns),
            started_ns: now_ns,
            alarm_ns: Cell::new(None),
            ticks_per_gs: (f64::from(TICK_HZ) * (1e9 + crystal_ppm * 1e3)) as u64,
            usb_ahead_ns: Cell::new(TICK_PHASE_NS),
            frame_seen: Cell::new(0),
        }
    }

    /// The stamp timer at a model time.
    pub fn ticks_at(&self, now_ns: u64) -> u64 {
        let since_ns = u128::from(now_ns.saturating_sub(self.started_ns));
        (since_ns * u128::from(self.ticks_per_gs) / GS_NS) as u64
    }

    /// How far the USB host's time is ahead of model time.
    pub fn set_usb_ahead_ns(&self, ahead_ns: u64) {
        self.usb_ahead_ns.set(ahead_ns);
    }

    /// Takes the latch's reading of the USB host's frames.
    fn take_sof(&self) -> Option<SofReading> {
        let ahead_ns = self.usb_ahead_ns.get();
        let frame = (self.now_ns.get() + ahead_ns) / FRAME_NS;
        let seen = self.frame_seen.replace(frame);
        let start_ns =
            (frame * FRAME_NS).checked_sub(ahead_ns).filter(|start_ns| *start_ns >= self.started_ns)?;
        let at = self.ticks_at(start_ns) as u32;
        let reading = SofReading {
            latched: [at; 2],
            frame: frame as u16 & FRAME_NUMBER,
            now: self.now(),
            several: seen != 0 && frame > seen + 1,
        };
        (frame != seen).then_some(reading)
    }

    pub fn set(&self, now_ns: u64) {
        self.now_ns.set(now_ns);
    }

    /// When the alarm is due.
    pub fn alarm_ns(&self) -> u64 {
        self.alarm_ns.get().unwrap_or(u64::MAX)
    }

    /// The alarm has gone off.
    pub fn clear_alarm(&self) {
        self.alarm_ns.set(None);
    }

    fn ticks(&self) -> u64 {
        self.ticks_at(self.now_ns.get())
    }
}

impl Clock for ModelClock {
    fn now(&self) -> u32 {
        self.ticks() as u32
    }

    fn set_alarm(&self, at: Option<u32>) {
        let at_ns = at.map(|at| {
            let now = self.ticks();
            let ahead = at.wrapping_sub(now as u32) as i32;
            // One that has passed goes off a tick from now, because a handler takes a moment to be entered again.
            let at = now + u64::from(ahead.max(1) as u32);
            self.started_ns + (u128::from(at) * GS_NS).div_ceil(u128::from(self.ticks_per_gs)) as u64
        });
        self.alarm_ns.set(at_ns);
    }
}

/// How the firmware ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// It starts again.
    Restart,
    /// The chip is in its bootloader. There is none here, and nothing to flash: the device is gone.
    Bootloader,
}

/// The chip.
pub struct VirtualChip {
    pub flash: Flash,
    /// Set when the firmware asked to end.
    pub ending: Option<Ending>,
}

impl Chip for VirtualChip {
    fn temperature_decicelsius(&mut self) -> Option<i16> {
        None
    }

    fn supply_millivolts(&mut self) -> Option<u16> {
        None
    }

    fn failures(&mut self) -> Failures {
        Failures::default()
    }

    fn identify(&mut self, _seconds: u8) {}

    fn reset(&mut self) {
        // When asked for the bootloader, the logic also asks for a reset, in case there is none.
        self.ending.get_or_insert(Ending::Restart);
    }

    fn bootloader(&mut self) -> bool {
        self.ending = Some(Ending::Bootloader);
        true
    }

    fn save(&mut self, bytes: &[u8]) -> bool {
        self.flash.save(bytes)
    }

    fn load(&mut self, out: &mut [u8]) -> usize {
        self.flash.load(out)
    }
}

/// Writes the firmware's filter layout into the controllers.
pub struct Filters(pub [Rc<RefCell<Controller>>; CHANNELS]);

impl FilterBanks for Filters {
    fn write(&mut self, layout: &Layout) -> bool {
        let (first, second) = layout.banks.split_at(usize::from(layout.split));
        let mut differed = false;
        for (controller, banks) in self.0.iter().zip([first, second]) {
            differed |= controller.borrow_mut().set_filters(banks.iter().flatten().copied().collect());
        }
        differed
    }
}

/// Everything that the firmware's commands access.
pub struct VirtualBoard<'q> {
    pub capture: Capture<'q>,
    pub traffic: [TrafficSide; CHANNELS],
    pub control: [ControlSide; CHANNELS],
    pub clock: ModelClock,
    pub filters: Filters,
    pub chip: VirtualChip,
    pub meter: VirtualMeter,
}

impl<'q> Board<'q, QUEUE_BYTES> for VirtualBoard<'q> {
    type Traffic = TrafficSide;
    type Control = ControlSide;
    type Clock = ModelClock;
    type Filters = Filters;
    type Chip = VirtualChip;
    type Meter = VirtualMeter;

    fn with_capture<R>(
        &mut self,
        act: impl FnOnce(&mut Capture<'q>, &mut [TrafficSide; CHANNELS], &ModelClock) -> R,
    ) -> R {
        act(&mut self.capture, &mut self.traffic, &self.clock)
    }

    fn now(&self) -> u32 {
        self.clock.now()
    }

    fn take_sof(&mut self) -> Option<SofReading> {
        self.clock.take_sof()
    }

    fn control(&mut self, channel: Channel) -> &mut ControlSide {
        &mut self.control[channel.index()]
    }

    fn filters(&mut self) -> &mut Filters {
        &mut self.filters
    }

    fn chip(&mut self) -> &mut VirtualChip {
        &mut self.chip
    }

    fn meter(&mut self) -> &mut VirtualMeter {
        &mut self.meter
    }
}

/// Whether the host has the port open: set by the host, seen by the firmware when it looks.
#[derive(Debug)]
pub struct Dtr {
    is_up: AtomicBool,
    seen: AtomicBool,
}

impl Dtr {
    /// In a state that both sides know.
    pub const fn new(is_up: bool) -> Self {
        Self { is_up: AtomicBool::new(is_up), seen: AtomicBool::new(is_up) }
    }

    /// The host opens or closes the port.
    pub fn set(&self, is_up: bool) {
        self.is_up.store(is_up, Ordering::SeqCst);
    }

    /// Whether the host has it open.
    pub fn is_up(&self) -> bool {
        self.is_up.load(Ordering::SeqCst)
    }

    /// Whether the firmware has noticed the current state: it has finished reacting to the previous one.
    pub fn is_seen(&self) -> bool {
        self.seen.load(Ordering::SeqCst) == self.is_up()
    }

    fn look(&self) -> bool {
        let is_up = self.is_up();
        self.seen.store(is_up, Ordering::SeqCst);
        is_up
    }
}

/// USB as a pipe: a limited number of packets per millisecond, none while the host does not read.
pub struct VirtualPort {
    pub from_host: PipeReader,
    pub to_host: PipeWriter,
    /// Whether a host has the port open.
    pub open: Arc<Dtr>,
    /// Packets that may still be sent now.
    credit: u32,
    /// Whether the host has to wait.
    held: bool,
}

impl VirtualPort {
    pub const fn new(from_host: PipeReader, to_host: PipeWriter, open: Arc<Dtr>) -> Self {
        Self { from_host, to_host, open, credit: 0, held: false }
    }

    /// A fraction of a millisecond has passed: one of `parts`.
    pub fn allow(&mut self, parts: u32) {
        self.credit = PACKETS_PER_MS.div_ceil(parts);
    }
}

impl Port for VirtualPort {
    fn is_open(&self) -> bool {
        self.open.look() && !self.to_host.is_closed()
    }

    fn write(&mut self, bytes: &[u8]) -> Option<usize> {
        let packet = &bytes[..bytes.len().min(PACKET)];
        if self.credit == 0 || self.to_host.room() < packet.len() {
            return None;
        }
        self.credit -= 1;
        // There is room, so it takes all of it at once.
        self.to_host.write_all(packet).ok().map(|()| packet.len())
    }

    fn read(&mut self, packet: &mut [u8; PACKET]) -> Option<usize> {
        let len = if self.held { 0 } else { self.from_host.take(packet) };
        (len > 0).then_some(len)
    }

    fn hold(&mut self, hold: bool) {
        self.held = hold;
    }
}
