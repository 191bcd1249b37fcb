//! The rest of the firmware's hardware: clock, filters, chip, port.

use std::cell::{Cell, RefCell};
use std::io::Write;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use cantap_firmware::capture::Capture;
use cantap_firmware::filters::Layout;
use cantap_firmware::ports::{Board, Chip, Clock, FilterBanks, PACKET, Port};
use cantap_firmware::{QUEUE_BYTES, TICK_HZ};
use cantap_wire::{CHANNELS, Channel};

use super::controller::{ControlSide, Controller, TrafficSide};
use super::flash::Flash;
use crate::device::{PipeReader, PipeWriter};

/// Bulk packets in each millisecond: 1.02 MB/s. Full speed would allow 19 (USB 2.0, table 5-9).
const PACKETS_PER_MS: u32 = 16;

/// Model time, seen as the firmware's stamp timer.
#[expect(clippy::struct_field_names, reason = "units")]
#[derive(Default)]
pub struct ModelClock {
    now_ns: Cell<u64>,
    /// When the firmware started.
    started_ns: u64,
    alarm_ns: Cell<Option<u64>>,
}

impl ModelClock {
    /// The clock of a firmware that starts now.
    pub fn started_at(now_ns: u64) -> Self {
        Self { now_ns: Cell::new(now_ns), started_ns: now_ns, ..Self::default() }
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
        (u128::from(self.now_ns.get() - self.started_ns) * u128::from(TICK_HZ) / 1_000_000_000) as u64
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
            // One that has passed goes off a tick from now, as a handler that is left takes a moment to be entered again.
            let at = now + u64::from(ahead.max(1) as u32);
            self.started_ns + (u128::from(at) * 1_000_000_000).div_ceil(u128::from(TICK_HZ)) as u64
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
    /// The firmware asked for it.
    pub ending: Option<Ending>,
}

impl Chip for VirtualChip {
    fn temperature_decicelsius(&mut self) -> Option<i16> {
        None
    }

    fn supply_millivolts(&mut self) -> Option<u16> {
        None
    }

    fn identify(&mut self, _seconds: u8) {}

    fn reset(&mut self) {
        // Asked for the bootloader, the logic asks for a reset too, in case that there is none.
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
    fn write(&mut self, layout: &Layout) {
        let (first, second) = layout.banks.split_at(usize::from(layout.split));
        for (controller, banks) in self.0.iter().zip([first, second]) {
            controller.borrow_mut().set_filters(banks.iter().flatten().copied().collect());
        }
    }
}

/// Everything that the firmware's commands see.
pub struct VirtualBoard<'q> {
    pub capture: Capture<'q>,
    pub traffic: [TrafficSide; CHANNELS],
    pub control: [ControlSide; CHANNELS],
    pub clock: ModelClock,
    pub filters: Filters,
    pub chip: VirtualChip,
}

impl<'q> Board<'q, QUEUE_BYTES> for VirtualBoard<'q> {
    type Traffic = TrafficSide;
    type Control = ControlSide;
    type Clock = ModelClock;
    type Filters = Filters;
    type Chip = VirtualChip;

    fn with_capture<R>(
        &mut self,
        act: impl FnOnce(&mut Capture<'q>, &mut [TrafficSide; CHANNELS], &ModelClock) -> R,
    ) -> R {
        act(&mut self.capture, &mut self.traffic, &self.clock)
    }

    fn now(&self) -> u32 {
        self.clock.now()
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
}

/// USB as a pipe: a limited number of packets each millisecond, none while the host does not read.
pub struct VirtualPort {
    pub from_host: PipeReader,
    pub to_host: PipeWriter,
    /// Whether a host has the port open.
    pub open: Arc<AtomicBool>,
    /// Packets that may still be sent now.
    credit: u32,
    /// The host was told to wait.
    held: bool,
}

impl VirtualPort {
    pub const fn new(from_host: PipeReader, to_host: PipeWriter, open: Arc<AtomicBool>) -> Self {
        Self { from_host, to_host, open, credit: 0, held: false }
    }

    /// A share of a millisecond has passed: so many of `parts`.
    pub fn allow(&mut self, parts: u32) {
        self.credit = PACKETS_PER_MS.div_ceil(parts);
    }
}

impl Port for VirtualPort {
    fn is_open(&self) -> bool {
        self.open.load(Ordering::Relaxed) && !self.to_host.is_closed()
    }

    fn write(&mut self, packet: &[u8]) -> bool {
        if self.credit == 0 || self.to_host.room() < packet.len() {
            return false;
        }
        self.credit -= 1;
        // There is room, so it takes all of it at once.
        self.to_host.write_all(packet).is_ok()
    }

    fn read(&mut self, packet: &mut [u8; PACKET]) -> Option<usize> {
        let len = if self.held { 0 } else { self.from_host.take(packet) };
        (len > 0).then_some(len)
    }

    fn hold(&mut self, hold: bool) {
        self.held = hold;
    }
}
