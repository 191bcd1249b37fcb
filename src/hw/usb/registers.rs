//! OTG_FS's registers in device mode (RM0090, "OTG_FS control and status registers"): offsets, bits, and the only access to
//! them. The names are the manual's.

use cantap_firmware::TICKS_PER_MS;
use stm32f4xx_hal::pac::{OTG_FS_DEVICE, OTG_FS_GLOBAL, OTG_FS_PWRCLK};

use crate::hw::stamp::StampTimer;

pub const GOTGINT: usize = 0x004;
pub const GAHBCFG: usize = 0x008;
pub const GUSBCFG: usize = 0x00C;
pub const GRSTCTL: usize = 0x010;
pub const GINTSTS: usize = 0x014;
pub const GINTMSK: usize = 0x018;
pub const GRXSTSP: usize = 0x020;
pub const GRXFSIZ: usize = 0x024;
pub const DIEPTXF0: usize = 0x028;
pub const GCCFG: usize = 0x038;
/// DIEPTXF1, the first of the registers for endpoints other than 0.
pub const DIEPTXF: usize = 0x104;
pub const DCFG: usize = 0x800;
pub const DCTL: usize = 0x804;
pub const DSTS: usize = 0x808;
pub const DIEPMSK: usize = 0x810;
pub const DOEPMSK: usize = 0x814;
pub const DAINT: usize = 0x818;
pub const DAINTMSK: usize = 0x81C;
pub const PCGCCTL: usize = 0xE00;
/// FIFO n is written through the 4 KiB from `FIFO + n * FIFO_STRIDE`; the receive FIFO is read through any of them.
pub const FIFO: usize = 0x1000;
pub const FIFO_STRIDE: usize = 0x1000;

/// Bits of GOTGINT.
pub mod gotgint {
    pub const SEDET: u32 = 1 << 2;
}

/// Bits of GAHBCFG.
pub mod gahbcfg {
    pub const GINT: u32 = 1 << 0;
}

/// Bits of GUSBCFG.
pub mod gusbcfg {
    pub const TRDT_SHIFT: u32 = 10;
    pub const TRDT: u32 = 0xF << TRDT_SHIFT;
    pub const FDMOD: u32 = 1 << 30;
}

/// Bits of GRSTCTL.
pub mod grstctl {
    pub const CSRST: u32 = 1 << 0;
    pub const RXFFLSH: u32 = 1 << 4;
    pub const TXFFLSH: u32 = 1 << 5;
    pub const TXFNUM_SHIFT: u32 = 6;
    /// In place of a FIFO's number.
    pub const ALL_TX_FIFOS: u32 = 0x10;
    pub const AHBIDL: u32 = 1 << 31;
}

/// Bits of GINTSTS and GINTMSK.
pub mod gint {
    pub const CMOD: u32 = 1 << 0;
    pub const OTGINT: u32 = 1 << 2;
    pub const RXFLVL: u32 = 1 << 4;
    pub const USBSUSP: u32 = 1 << 11;
    pub const USBRST: u32 = 1 << 12;
    pub const ENUMDNE: u32 = 1 << 13;
    pub const IEPINT: u32 = 1 << 18;
    pub const WKUPINT: u32 = 1 << 31;
}

/// PKTSTS in GRXSTSP.
pub mod pktsts {
    pub const OUT_DATA: u32 = 2;
    pub const OUT_COMPLETE: u32 = 3;
    pub const SETUP_COMPLETE: u32 = 4;
    pub const SETUP_DATA: u32 = 6;
}

/// Bits of GCCFG.
pub mod gccfg {
    pub const PWRDWN: u32 = 1 << 16;
    pub const VBUSBSEN: u32 = 1 << 19;
    pub const NOVBUSSENS: u32 = 1 << 21;
}

/// Fields of DCFG.
pub mod dcfg {
    /// Full speed by the chip's own transceiver.
    pub const DSPD_FULL: u32 = 3;
    pub const DAD_SHIFT: u32 = 4;
    pub const DAD: u32 = 0x7F << DAD_SHIFT;
}

/// Bits of DCTL.
pub mod dctl {
    pub const SDIS: u32 = 1 << 1;
}

/// Bits of DSTS.
pub mod dsts {
    pub const SUSPSTS: u32 = 1 << 0;
}

/// Bits of DIEPCTLx and DOEPCTLx.
pub mod epctl {
    pub const USBAEP: u32 = 1 << 15;
    pub const NAKSTS: u32 = 1 << 17;
    pub const EPTYP_SHIFT: u32 = 18;
    pub const STALL: u32 = 1 << 21;
    pub const TXFNUM_SHIFT: u32 = 22;
    pub const CNAK: u32 = 1 << 26;
    pub const SNAK: u32 = 1 << 27;
    pub const SD0PID: u32 = 1 << 28;
    pub const EPDIS: u32 = 1 << 30;
    pub const EPENA: u32 = 1 << 31;
    /// Bits that trigger an action when written as 1. They must not be written back as read: a transfer that ends in
    /// between would be armed again.
    pub const ACTIONS: u32 = CNAK | SNAK | SD0PID | 1 << 29 | EPDIS | EPENA;
}

/// Bits of DIEPINTx and DOEPINTx.
pub mod epint {
    pub const XFRC: u32 = 1 << 0;
    pub const EPDISD: u32 = 1 << 1;
    pub const STUP: u32 = 1 << 3;
    pub const INEPNE: u32 = 1 << 6;
}

/// Fields of DIEPTSIZx and DOEPTSIZx.
pub mod eptsiz {
    pub const PKTCNT_SHIFT: u32 = 19;
    pub const PKTCNT: u32 = 0x3FF << PKTCNT_SHIFT;
    /// Three SETUP packets in a row, in DOEPTSIZ0.
    pub const STUPCNT_3: u32 = 3 << 29;
}

/// An endpoint's registers.
#[derive(Clone, Copy)]
pub struct Endpoint(usize);

impl Endpoint {
    /// IN endpoint `number`.
    pub const fn input(number: usize) -> Self {
        Self(0x900 + 0x20 * number)
    }

    /// OUT endpoint `number`.
    pub const fn output(number: usize) -> Self {
        Self(0xB00 + 0x20 * number)
    }

    /// DIEPCTLx or DOEPCTLx.
    pub const fn ctl(self) -> usize {
        self.0
    }

    /// DIEPINTx or DOEPINTx.
    pub const fn int(self) -> usize {
        self.0 + 0x08
    }

    /// DIEPTSIZx or DOEPTSIZx.
    pub const fn tsiz(self) -> usize {
        self.0 + 0x10
    }
}

/// How long to wait for a flag of the controller, in ticks: 1 ms. It follows within some clocks of USB as a rule, and within a frame where
/// a packet has to end first.
const MOST_TICKS: u32 = TICKS_PER_MS;
/// A bit for each transmit FIFO: there are four.
const ALL_FIFOS: u32 = 0xF;
/// How long the core may take to become a device, in ticks: 50 ms. The manual asks for 25 (RM0090, GUSBCFG, FDMOD), and NuttX waits for 50.
const MODE_TICKS: u32 = 50 * TICKS_PER_MS;

/// The controller. Only the owner of this value touches it.
pub struct Registers {
    timer: StampTimer,
    /// Flags that were waited for and did not come in time; wraps.
    waits_given_up: u32,
    /// Transmit FIFOs that the bus was not idle enough to flush, one bit each: what is left in them must not be sent.
    unflushed: u32,
}

#[expect(clippy::unused_self, reason = "having it is the right to touch the controller")]
impl Registers {
    /// Made from the peripheral itself, which nobody else can then have.
    pub const fn new(_: (OTG_FS_GLOBAL, OTG_FS_DEVICE, OTG_FS_PWRCLK), timer: StampTimer) -> Self {
        Self { timer, waits_given_up: 0, unflushed: 0 }
    }

    fn at(offset: usize) -> *mut u32 {
        OTG_FS_GLOBAL::ptr().cast_mut().cast::<u32>().wrapping_byte_add(offset)
    }

    /// Reads a register. Some change by being read.
    #[inline]
    pub fn read(&self, offset: usize) -> u32 {
        // SAFETY: an aligned address within OTG_FS's 256 KiB, since all offsets are from this file; there is only one `self`.
        unsafe { Self::at(offset).read_volatile() }
    }

    /// Writes a register.
    #[inline]
    pub fn write(&mut self, offset: usize, value: u32) {
        // SAFETY: as in `read`; nothing that is written here touches memory, because DMA is never switched on.
        unsafe { Self::at(offset).write_volatile(value) }
    }

    /// Clears and sets bits of a register.
    pub fn modify(&mut self, offset: usize, clear: u32, set: u32) {
        self.write(offset, self.read(offset) & !clear | set);
    }

    /// Clears bits of an endpoint's control register, and sets others or triggers their actions.
    #[inline]
    pub fn control(&mut self, endpoint: Endpoint, clear: u32, set: u32) {
        self.modify(endpoint.ctl(), clear | epctl::ACTIONS, set);
    }

    /// Whether a transfer of the endpoint is armed.
    pub fn is_armed(&self, endpoint: Endpoint) -> bool {
        self.read(endpoint.ctl()) & epctl::EPENA != 0
    }

    /// Waits until `done`, but not for ever; returns whether it was.
    pub fn wait_until(&mut self, done: impl Fn(&Self) -> bool) -> bool {
        self.wait(MOST_TICKS, done)
    }

    /// Waits until the core is a device.
    pub fn wait_for_device_mode(&mut self) {
        self.wait(MODE_TICKS, |registers| registers.read(GINTSTS) & gint::CMOD == 0);
    }

    fn wait(&mut self, most_ticks: u32, done: impl Fn(&Self) -> bool) -> bool {
        let from = self.timer.now();
        loop {
            // Before the flag: if something of a higher priority runs in between, the flag counts.
            let late = self.timer.now().wrapping_sub(from) > most_ticks;
            if done(self) {
                return true;
            }
            if late {
                self.waits_given_up = self.waits_given_up.wrapping_add(1);
                return false;
            }
        }
    }

    /// Flags that were waited for and did not come in time, since the start.
    pub const fn waits_given_up(&self) -> u32 {
        self.waits_given_up
    }

    /// Ends an IN endpoint's transfer in the manual's order: NAK, disable, and flush the FIFO of the same number (RM0090, "IN
    /// endpoint disable"). If there is no transfer, the FIFO is left alone: a flush has no place in the middle of a transaction
    /// (RM0090, GRSTCTL, TXFFLSH), and other drivers, too, flush only if EPENA (TinyUSB, Klipper) or PKTCNT (libopencm3, embassy) says
    /// that something is there.
    pub fn disable_input(&mut self, number: usize) {
        let endpoint = Endpoint::input(number);
        if self.is_armed(endpoint) {
            self.write(endpoint.int(), epint::INEPNE | epint::EPDISD);
            self.control(endpoint, 0, epctl::SNAK);
            // INEPNE does not come if the answer was NAK already (Zephyr, issue 73142), and not if the transfer has just ended.
            self.wait_until(|registers| {
                let ctl = registers.read(endpoint.ctl());
                registers.read(endpoint.int()) & epint::INEPNE != 0
                    || ctl & epctl::NAKSTS != 0
                    || ctl & epctl::EPENA == 0
            });
            if self.is_armed(endpoint) {
                self.control(endpoint, 0, epctl::EPDIS | epctl::SNAK);
                self.wait_until(|registers| {
                    registers.read(endpoint.int()) & epint::EPDISD != 0 || !registers.is_armed(endpoint)
                });
            }
            self.write(endpoint.int(), epint::INEPNE | epint::EPDISD);
            self.flush_tx(number as u32);
        } else if self.read(endpoint.tsiz()) & eptsiz::PKTCNT != 0 {
            self.flush_tx(number as u32);
        }
    }

    /// Whether a new transfer may be written to an IN endpoint: the last one is over, and no FIFO is being flushed or still has to be.
    pub fn is_free(&self, endpoint: Endpoint) -> bool {
        self.unflushed == 0 && !self.is_armed(endpoint) && self.read(GRSTCTL) & grstctl::TXFFLSH == 0
    }

    /// Empties a transmit FIFO, or all of them. If that takes too long, or cannot begin, [`Self::is_free`] says when it has ended.
    pub fn flush_tx(&mut self, number: u32) {
        self.unflushed |= if number == grstctl::ALL_TX_FIFOS { ALL_FIFOS } else { 1 << number };
        if self.wait_until(Self::can_flush) {
            self.flush_rest();
            self.wait_until(|registers| registers.read(GRSTCTL) & grstctl::TXFFLSH == 0);
        }
    }

    fn can_flush(&self) -> bool {
        self.read(GRSTCTL) & (grstctl::AHBIDL | grstctl::TXFFLSH) == grstctl::AHBIDL
    }

    /// Begins to empty what [`Self::flush_tx`] could not, if that is possible now: one FIFO, or all.
    pub fn flush_rest(&mut self) {
        if self.unflushed == 0 || !self.can_flush() {
            return;
        }
        let number =
            if self.unflushed == ALL_FIFOS { grstctl::ALL_TX_FIFOS } else { self.unflushed.trailing_zeros() };
        self.write(GRSTCTL, grstctl::TXFFLSH | number << grstctl::TXFNUM_SHIFT);
        self.unflushed =
            if number == grstctl::ALL_TX_FIFOS { 0 } else { self.unflushed & (self.unflushed - 1) };
    }

    /// The core has been reset: its FIFOs are empty.
    pub const fn forget_flushes(&mut self) {
        self.unflushed = 0;
    }

    /// Empties the receive FIFO.
    pub fn flush_rx(&mut self) {
        self.write(GRSTCTL, grstctl::RXFFLSH);
        self.wait_until(|registers| registers.read(GRSTCTL) & grstctl::RXFFLSH == 0);
    }
}
