//! The controller as usb-device sees it: [`Bus`], and behind it [`Core`], which the port and the observer of requests share.

use core::cell::UnsafeCell;

use cantap_firmware::oddities::UsbOddities;
use cantap_firmware::ports::{PACKET, PortHistory};
use usb_device::bus::PollResult;
use usb_device::endpoint::{EndpointAddress, EndpointType};
use usb_device::{Result, UsbDirection, UsbError};

use super::bulk_in::BulkIn;
use super::bulk_out::BulkOut;
use super::control::Control;
use super::registers::{
    DAINT, DAINTMSK, DCFG, DCTL, DIEPMSK, DOEPMSK, DSTS, Endpoint, GAHBCFG, GCCFG, GINTMSK, GINTSTS, GOTGINT,
    GRSTCTL, GRXSTSP, GUSBCFG, PCGCCTL, Registers, dcfg, dctl, dsts, epctl, epint, gahbcfg, gccfg, gint,
    gotgint, grstctl, gusbcfg, pktsts,
};
use super::{BULK_IN, BULK_OUT, NOTIFY_IN, fifo};
use crate::board;

/// TRDT, the answer time in clocks of PHY and AHB, for AHB clocks from 32 MHz up (RM0090, "TRDT values").
const TURNAROUND: u32 = 6;
/// Interrupt IN, packets of 8 bytes, the FIFO of the endpoint's number, DATA0. Nothing is ever sent there.
const NOTIFY_ACTIVE: u32 = epctl::USBAEP
    | 3 << epctl::EPTYP_SHIFT
    | (NOTIFY_IN as u32) << epctl::TXFNUM_SHIFT
    | NOTIFY_PACKET as u32
    | epctl::SD0PID;
/// The notification endpoint's packets, as usbd-serial describes them.
const NOTIFY_PACKET: u16 = 8;
/// Words of the receive FIFO that one poll looks at: twice what it holds of the shortest packets. A FIFO that goes on has its interrupt
/// again, and the tick comes in between.
const WORDS_PER_POLL: usize = 64;
/// A controller that has not taken a packet after this time, in ms, will not: the transfer before does not end.
const BLOCKED_MS: u32 = 100;
/// How long the device then stays away from the bus, in ms, so that a host notices (as `hw::start` does); also how long it waits before it
/// tries again to reset a core whose reset did not end.
const AWAY_MS: u32 = 10;

/// Whether the host has the port open.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Line {
    /// No: DTR is down.
    Down,
    /// Yes: DTR is up.
    Up,
    /// It had when it reconfigured the device, and has not set DTR since.
    Assumed,
}

/// The controller with its endpoints.
pub struct Core {
    registers: Registers,
    control: Control,
    bulk_in: BulkIn,
    bulk_out: BulkOut,
    notify_halted: bool,
    configured: bool,
    line: Line,
    history: PortHistory,
    /// Whether usb-device takes the bus for suspended.
    suspended: bool,
    /// Words of the receive FIFO that say what cannot be; wraps.
    words_dropped: u32,
    /// Away from the bus for so many more milliseconds.
    away_ms: Option<u32>,
}

impl Core {
    /// Off.
    pub const fn new(registers: Registers) -> Self {
        Self {
            registers,
            control: Control::new(),
            bulk_in: BulkIn::new(),
            bulk_out: BulkOut::new(),
            notify_halted: false,
            configured: false,
            line: Line::Down,
            history: PortHistory { opened: 0, configured: 0 },
            suspended: false,
            words_dropped: 0,
            away_ms: None,
        }
    }

    /// Connects to the bus (RM0090, "Core initialization" and "Device initialization"). If the core's reset does not end, [`Self::tick`] tries
    /// again: whatever is written before its end would be lost.
    fn enable(&mut self) {
        let registers = &mut self.registers;
        registers.wait_until(|registers| registers.read(GRSTCTL) & grstctl::AHBIDL != 0);
        registers.write(GRSTCTL, grstctl::CSRST);
        if !registers.wait_until(|registers| registers.read(GRSTCTL) & grstctl::CSRST == 0) {
            self.away_ms = Some(AWAY_MS);
            return;
        }
        registers.forget_flushes();
        registers.wait_until(|registers| registers.read(GRSTCTL) & grstctl::AHBIDL != 0);
        // Before a host can see the device: what it does from then on is not to be forgotten.
        registers.write(GINTSTS, !0);
        // The transceiver is on, but does not look for VBUS yet, so that no host sees the device before it is ready.
        registers.write(GCCFG, gccfg::PWRDWN);
        // After the reset, as in ST's driver, because it is not said to keep this.
        registers.modify(GUSBCFG, 0, gusbcfg::FDMOD);
        // What follows are a device's registers.
        registers.wait_for_device_mode();
        registers.write(PCGCCTL, 0);
        registers.modify(DCTL, 0, dctl::SDIS);
        let vbus = if board::SENSES_VBUS { gccfg::VBUSBSEN } else { gccfg::NOVBUSSENS };
        registers.write(GCCFG, gccfg::PWRDWN | vbus);
        registers.modify(DCFG, 0, dcfg::DSPD_FULL);
        registers.write(DIEPMSK, epint::XFRC);
        // The receive FIFO's status reports what arrives.
        registers.write(DOEPMSK, 0);
        registers.write(DAINTMSK, 1 | 1 << BULK_IN);
        let wanted = [gint::USBRST, gint::ENUMDNE, gint::USBSUSP, gint::WKUPINT, gint::IEPINT, gint::RXFLVL];
        let session = if board::SENSES_VBUS { gint::OTGINT } else { 0 };
        registers.write(GINTMSK, wanted.iter().fold(session, |mask, flag| mask | flag));
        registers.modify(GAHBCFG, 0, gahbcfg::GINT);
        registers.modify(DCTL, dctl::SDIS, 0);
    }

    /// The host drives a reset: everything under way is over (RM0090, "Endpoint initialization on USB reset"). Endpoint 0
    /// accepts OUT packets once the speed enumeration has ended.
    fn reset(&mut self) {
        let Self { registers, control, bulk_in, bulk_out, .. } = self;
        bulk_in.configure(registers, false);
        bulk_out.reset(registers);
        registers.write(Endpoint::input(NOTIFY_IN).ctl(), epctl::SNAK);
        control.reset(registers);
        registers.flush_tx(grstctl::ALL_TX_FIFOS);
        registers.flush_rx();
        fifo::divide(registers);
        registers.modify(DCFG, dcfg::DAD, 0);
        self.configured = false;
        self.notify_halted = false;
        self.line = Line::Down;
    }

    /// SET_CONFIGURATION. A program that had the port open has lost it, and may not know.
    pub fn configure(&mut self, configured: bool) {
        let Self { registers, bulk_in, bulk_out, .. } = self;
        bulk_in.configure(registers, configured);
        bulk_out.configure(registers, configured);
        let notify = if configured { NOTIFY_ACTIVE } else { 0 };
        registers.write(Endpoint::input(NOTIFY_IN).ctl(), notify | epctl::SNAK);
        self.notify_halted = false;
        self.configured = configured;
        if self.line != Line::Down {
            self.line = Line::Assumed;
            self.history.configured = self.history.configured.wrapping_add(1);
        }
    }

    /// SET_INTERFACE, or the end of a halt: both sides begin with DATA0 again.
    pub fn restart(&mut self, address: EndpointAddress) {
        let Self { registers, bulk_in, bulk_out, .. } = self;
        match (address.direction(), address.index()) {
            (UsbDirection::In, BULK_IN) => bulk_in.restart(registers),
            (UsbDirection::Out, BULK_OUT) => bulk_out.restart(registers),
            (UsbDirection::In, NOTIFY_IN) if self.configured => {
                self.notify_halted = false;
                registers.control(Endpoint::input(NOTIFY_IN), epctl::STALL, epctl::SD0PID);
            }
            _ => {}
        }
    }

    fn halt(&mut self, address: EndpointAddress) {
        let Self { registers, bulk_in, bulk_out, .. } = self;
        match (address.direction(), address.index()) {
            // The controller clears it at the next SETUP packet.
            (UsbDirection::In, 0) => registers.control(Endpoint::input(0), 0, epctl::STALL),
            (UsbDirection::Out, 0) => registers.control(Endpoint::output(0), 0, epctl::STALL),
            (UsbDirection::In, BULK_IN) if self.configured => bulk_in.halt(registers),
            (UsbDirection::Out, BULK_OUT) if self.configured => bulk_out.halt(registers),
            (UsbDirection::In, NOTIFY_IN) if self.configured => {
                self.notify_halted = true;
                registers.control(Endpoint::input(NOTIFY_IN), 0, epctl::STALL);
            }
            _ => {}
        }
    }

    fn is_halted(&self, address: EndpointAddress) -> bool {
        match (address.direction(), address.index()) {
            (UsbDirection::In, BULK_IN) => self.bulk_in.is_halted(),
            (UsbDirection::Out, BULK_OUT) => self.bulk_out.is_halted(),
            (UsbDirection::In, NOTIFY_IN) => self.notify_halted,
            _ => false,
        }
    }

    fn poll(&mut self) -> PollResult {
        let flags = self.registers.read(GINTSTS);
        if flags & gint::USBRST != 0 {
            // The silence before a reset no longer matters.
            self.registers.write(GINTSTS, gint::USBRST | gint::USBSUSP | gint::WKUPINT);
            return PollResult::Reset;
        }
        if flags & gint::ENUMDNE != 0 {
            self.registers.write(GINTSTS, gint::ENUMDNE);
            self.registers.modify(GUSBCFG, gusbcfg::TRDT, TURNAROUND << gusbcfg::TRDT_SHIFT);
            Control::arm(&mut self.registers);
        }
        if flags & gint::WKUPINT != 0 {
            self.registers.write(GINTSTS, gint::WKUPINT);
            return PollResult::Resume;
        }
        if flags & gint::USBSUSP != 0 {
            self.registers.write(GINTSTS, gint::USBSUSP);
            // The bus may have been woken since.
            if self.registers.read(DSTS) & dsts::SUSPSTS != 0 {
                return PollResult::Suspend;
            }
        }
        if board::SENSES_VBUS && flags & gint::OTGINT != 0 && self.take_session_end() {
            return PollResult::Suspend;
        }
        let received = self.receive();
        // After the FIFO: a SETUP packet there ends whatever was being sent.
        let sent = self.sent();
        let (setup, packet) = self.control.waits();
        // usb-device needs the data endpoints' events only as a sign that the bus is alive.
        let data = if self.suspended { received | sent & !1 } else { 0 };
        if setup || packet || (sent & 1 | data) != 0 {
            return PollResult::Data {
                ep_setup: u16::from(setup),
                ep_out: u16::from(packet) | (data & 1 << BULK_OUT),
                ep_in_complete: sent & 1 | (data & 1 << BULK_IN),
            };
        }
        PollResult::None
    }

    /// VBUS is gone: to the device that is a suspended bus, as it is where nothing senses VBUS. Returns whether it is so.
    fn take_session_end(&mut self) -> bool {
        let flags = self.registers.read(GOTGINT);
        self.registers.write(GOTGINT, flags);
        flags & gotgint::SEDET != 0
    }

    /// Empties the receive FIFO. Returns the bulk endpoint's bit if there was something for it.
    ///
    /// Controllers of this family have been seen to deliver words that cannot be (libopencm3, issue 672; Klipper drops them, too). Only
    /// what fits this device is believed; of anything else, the word is dropped and counted, and no data is read for it.
    fn receive(&mut self) -> u16 {
        let mut bulk = 0;
        for _ in 0..WORDS_PER_POLL {
            if self.registers.read(GINTSTS) & gint::RXFLVL == 0 {
                break;
            }
            bulk |= self.take_word();
        }
        self.bulk_out.arm(&mut self.registers);
        bulk
    }

    /// Takes a word of the receive FIFO, and what belongs to it. Most interrupts are for packets to the host and find none, so that this is kept out
    /// of their way.
    #[inline(never)]
    fn take_word(&mut self) -> u16 {
        let Self { registers, control, bulk_out, .. } = self;
        let mut bulk = 0;
        let status = registers.read(GRXSTSP);
        let number = (status & 0xF) as usize;
        let len = (status >> 4 & 0x7FF) as usize;
        let believed = match (status >> 17 & 0xF, number) {
            (pktsts::SETUP_DATA, 0) if len == 8 => {
                control.take_setup(registers, len);
                true
            }
            (pktsts::SETUP_COMPLETE, 0) => control.setup_done(registers),
            (pktsts::OUT_DATA, 0) if len <= PACKET => {
                control.take_packet(registers, len);
                true
            }
            (pktsts::OUT_COMPLETE, 0) => control.packet_done(),
            (pktsts::OUT_DATA, BULK_OUT) if len <= PACKET => {
                bulk = 1 << BULK_OUT;
                bulk_out.take_packet(registers, len)
            }
            (pktsts::OUT_COMPLETE, BULK_OUT) => bulk_out.transfer_done(),
            _ => false,
        };
        if !believed {
            self.words_dropped = self.words_dropped.wrapping_add(1);
        }
        bulk
    }

    /// Handles the IN endpoints whose transfer has completed; returns a bit for each.
    fn sent(&mut self) -> u16 {
        let Self { registers, bulk_in, .. } = self;
        let mut ended = 0;
        // DAINT only says where to look: other flags of DIEPINT are set as well.
        let reported = registers.read(DAINT);
        for number in [0, BULK_IN] {
            let int = Endpoint::input(number).int();
            if reported >> number & 1 != 0 && registers.read(int) & epint::XFRC != 0 {
                registers.write(int, epint::XFRC);
                ended |= 1 << number;
            }
        }
        if ended >> BULK_IN & 1 != 0 {
            bulk_in.done();
        }
        ended
    }

    /// Once a millisecond: gives the controller what it could not take before. If it takes nothing at all any more, the device goes
    /// away from the bus and begins anew, as if it had been unplugged.
    pub fn tick(&mut self) {
        match self.away_ms {
            Some(0) => {
                self.away_ms = None;
                self.enable();
            }
            Some(left) => self.away_ms = Some(left - 1),
            None => {
                let Self { registers, control, bulk_in, bulk_out, .. } = self;
                registers.flush_rest();
                let blocked_ms = control.tick(registers).max(bulk_in.tick(registers));
                bulk_out.arm(registers);
                if blocked_ms > BLOCKED_MS {
                    // Until the host resets the bus, the FIFOs are not divided up: nothing may be armed.
                    control.forget();
                    bulk_in.forget(false);
                    bulk_out.reset(registers);
                    registers.modify(DCTL, 0, dctl::SDIS);
                    self.away_ms = Some(AWAY_MS);
                }
            }
        }
    }

    /// What the controller did that it should not.
    pub const fn oddities(&self) -> UsbOddities {
        UsbOddities { words_dropped: self.words_dropped, waits_given_up: self.registers.waits_given_up() }
    }

    /// SET_CONTROL_LINE_STATE.
    pub fn set_dtr(&mut self, up: bool) {
        let line = if up && self.configured { Line::Up } else { Line::Down };
        if line == Line::Up && self.line != Line::Up {
            self.history.opened = self.history.opened.wrapping_add(1);
        }
        self.line = line;
    }

    /// What the device knows about DTR.
    pub const fn line(&self) -> Line {
        self.line
    }

    /// What the host has done with the port.
    pub const fn history(&self) -> PortHistory {
        self.history
    }

    /// Begins a transfer to the host: see [`BulkIn::write`].
    pub fn write_bulk(&mut self, bytes: &[u8]) -> Option<usize> {
        self.bulk_in.write(&mut self.registers, bytes)
    }

    /// Takes a packet from the host: see [`BulkOut::read`].
    pub fn read_bulk(&mut self, out: &mut [u8]) -> Option<usize> {
        self.bulk_out.read(&mut self.registers, out)
    }

    /// Makes the host wait, or lets it send again: see [`BulkOut::hold`].
    pub fn hold_bulk(&mut self, held: bool) {
        self.bulk_out.hold(&mut self.registers, held);
    }
}

/// The core, shared by code of one priority.
pub struct Shared(UnsafeCell<Core>);

// SAFETY: everything that has a reference to it lives in the one `UsbPort`: its `UsbDevice`, its class, its observer. The port is
// RTIC's `#[lock_free]` resource of tasks at priority 2, each of which runs to its end before another begins, and every way in is
// through `&mut UsbPort`. So there is never more than one context, as with a `Cell` in one thread.
unsafe impl Sync for Shared {}

impl Shared {
    pub const fn new(core: Core) -> Self {
        Self(UnsafeCell::new(core))
    }

    /// Runs `act` on the core. `act` must not come back here; it cannot, since the core does not know of `Shared`.
    pub fn with<R>(&self, act: impl FnOnce(&mut Core) -> R) -> R {
        // SAFETY: the only reference: one context (see `Sync` above), and no `act` in this module's files calls `with`.
        act(unsafe { &mut *self.0.get() })
    }
}

/// What usb-device drives.
pub struct Bus {
    core: &'static Shared,
    /// Endpoints already allocated, IN in the upper half.
    given: u32,
}

impl Bus {
    pub const fn new(core: &'static Shared) -> Self {
        Self { core, given: 0 }
    }
}

impl usb_device::bus::UsbBus for Bus {
    /// The controller is set up for endpoint 0 and a CDC-ACM function, and nothing else.
    fn alloc_ep(
        &mut self,
        direction: UsbDirection,
        _wanted: Option<EndpointAddress>,
        kind: EndpointType,
        packet: u16,
        _interval: u8,
    ) -> Result<EndpointAddress> {
        let (number, most) = match (direction, kind) {
            (_, EndpointType::Control) => (0, PACKET as u16),
            (UsbDirection::In, EndpointType::Bulk) => (BULK_IN, PACKET as u16),
            (UsbDirection::Out, EndpointType::Bulk) => (BULK_OUT, PACKET as u16),
            (UsbDirection::In, EndpointType::Interrupt) => (NOTIFY_IN, NOTIFY_PACKET),
            _ => return Err(UsbError::Unsupported),
        };
        let bit = 1 << (number + if direction == UsbDirection::In { 16 } else { 0 });
        if self.given & bit != 0 || packet != most {
            return Err(UsbError::EndpointOverflow);
        }
        self.given |= bit;
        Ok(EndpointAddress::from_parts(number, direction))
    }

    fn enable(&mut self) {
        self.core.with(Core::enable);
    }

    fn reset(&self) {
        self.core.with(Core::reset);
    }

    fn set_device_address(&self, address: u8) {
        self.core.with(|core| core.registers.modify(DCFG, dcfg::DAD, u32::from(address) << dcfg::DAD_SHIFT));
    }

    fn write(&self, address: EndpointAddress, bytes: &[u8]) -> Result<usize> {
        self.core.with(|core| match (address.is_in(), address.index()) {
            (true, 0) => core.control.write(&mut core.registers, bytes),
            (true, BULK_IN) => core.write_bulk(bytes).ok_or(UsbError::WouldBlock),
            _ => Err(UsbError::InvalidEndpoint),
        })
    }

    fn read(&self, address: EndpointAddress, out: &mut [u8]) -> Result<usize> {
        self.core.with(|core| match (address.is_out(), address.index()) {
            (true, 0) => core.control.read(&mut core.registers, out),
            (true, BULK_OUT) => core.read_bulk(out).ok_or(UsbError::WouldBlock),
            _ => Err(UsbError::InvalidEndpoint),
        })
    }

    fn set_stalled(&self, address: EndpointAddress, stalled: bool) {
        self.core.with(|core| if stalled { core.halt(address) } else { core.restart(address) });
    }

    fn is_stalled(&self, address: EndpointAddress) -> bool {
        self.core.with(|core| core.is_halted(address))
    }

    /// The transceiver's clock stays on. Stopping it saves little compared with a processor at 144 MHz, and whether a
    /// reset after a replug would then be noticed, where nothing measures VBUS, only a real board can show.
    fn suspend(&self) {
        self.core.with(|core| core.suspended = true);
    }

    fn resume(&self) {
        self.core.with(|core| core.suspended = false);
    }

    fn poll(&self) -> PollResult {
        self.core.with(Core::poll)
    }

    /// The controller answers the status stage with its old address, and adopts the new one afterwards (RM0090, "Endpoint
    /// initialization on SetAddress command").
    const QUIRK_SET_ADDRESS_BEFORE_STATUS: bool = true;
}
