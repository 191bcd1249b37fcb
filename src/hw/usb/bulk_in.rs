//! The data endpoint towards the host: one transfer of several packets at a time, with one interrupt for all of them.

use cantap_firmware::ports::PACKET;

use super::registers::{Endpoint, Registers, epctl, epint, eptsiz};
use super::{BULK_IN, fifo};

/// Longest transfer: what the FIFO holds, so that no interrupt has to bring more.
pub const TRANSFER: usize = fifo::BULK_PACKETS * PACKET;

const ENDPOINT: Endpoint = Endpoint::input(BULK_IN);
/// Bulk, packets of 64 bytes, the FIFO of the endpoint's number, DATA0.
const ACTIVE: u32 = epctl::USBAEP
    | 2 << epctl::EPTYP_SHIFT
    | (BULK_IN as u32) << epctl::TXFNUM_SHIFT
    | PACKET as u32
    | epctl::SD0PID;

/// Bulk IN.
pub struct BulkIn {
    /// The transfer under way. If it has to be taken back, it is sent again from where the host had got to.
    bytes: [u8; TRANSFER],
    start: usize,
    end: usize,
    under_way: bool,
    /// The controller has the transfer under way.
    armed: bool,
    active: bool,
    halted: bool,
    /// For how many milliseconds the controller has not been able to take a transfer.
    blocked_ms: u32,
}

impl BulkIn {
    pub const fn new() -> Self {
        Self {
            bytes: [0; TRANSFER],
            start: 0,
            end: 0,
            under_way: false,
            armed: false,
            active: false,
            halted: false,
            blocked_ms: 0,
        }
    }

    /// Puts the endpoint into or out of use: empty, with DATA0 and not halted (USB 2.0, 9.1.1.5).
    pub fn configure(&mut self, registers: &mut Registers, active: bool) {
        registers.disable_input(BULK_IN);
        registers.write(ENDPOINT.int(), epint::XFRC);
        registers.write(ENDPOINT.ctl(), epctl::SNAK | if active { ACTIVE } else { 0 });
        self.forget(active);
    }

    /// Forgets the transfer under way.
    pub const fn forget(&mut self, active: bool) {
        self.under_way = false;
        self.armed = false;
        self.halted = false;
        self.active = active;
        self.blocked_ms = 0;
    }

    /// Begins a transfer with as many bytes as fit into one and returns how many; `None` if the last one is still under way.
    pub fn write(&mut self, registers: &mut Registers, bytes: &[u8]) -> Option<usize> {
        if !self.active || self.under_way || !registers.is_free(ENDPOINT) {
            return None;
        }
        let len = bytes.len().min(TRANSFER);
        self.bytes[..len].copy_from_slice(&bytes[..len]);
        (self.start, self.end) = (0, len);
        self.under_way = true;
        if !self.halted {
            self.arm(registers);
        }
        Some(len)
    }

    fn packets(&self) -> usize {
        (self.end - self.start).div_ceil(PACKET).max(1)
    }

    /// Gives the transfer to the controller, if that can take it now; otherwise [`Self::tick`] does.
    fn arm(&mut self, registers: &mut Registers) {
        if !registers.is_free(ENDPOINT) {
            return;
        }
        self.armed = true;
        let bytes = &self.bytes[self.start..self.end];
        let size = (self.packets() as u32) << eptsiz::PKTCNT_SHIFT | bytes.len() as u32;
        registers.write(ENDPOINT.tsiz(), size);
        registers.control(ENDPOINT, 0, epctl::EPENA | epctl::CNAK);
        fifo::push(registers, BULK_IN, bytes);
    }

    /// The transfer has completed.
    pub fn done(&mut self) {
        self.under_way = false;
        self.armed = false;
    }

    /// Once a millisecond: gives the controller what it could not take before. Returns for how many milliseconds it has not been able to
    /// take anything.
    pub fn tick(&mut self, registers: &mut Registers) -> u32 {
        if !self.active || self.halted || self.armed {
            self.blocked_ms = 0;
            return 0;
        }
        if self.under_way {
            self.arm(registers);
        }
        let is_blocked = !self.armed && !registers.is_free(ENDPOINT);
        self.blocked_ms = if is_blocked { self.blocked_ms + 1 } else { 0 };
        self.blocked_ms
    }

    /// Takes the transfer under way out of the controller and keeps what the host has not received.
    fn take_back(&mut self, registers: &mut Registers) {
        if !self.armed {
            return;
        }
        self.armed = false;
        registers.disable_input(BULK_IN);
        let left = (registers.read(ENDPOINT.tsiz()) & eptsiz::PKTCNT) >> eptsiz::PKTCNT_SHIFT;
        let gone = self.packets().saturating_sub(left as usize);
        self.start = self.end.min(self.start + gone * PACKET);
        if left == 0 {
            self.under_way = false;
            registers.write(ENDPOINT.int(), epint::XFRC);
        }
    }

    /// Answers with STALL from here on.
    pub fn halt(&mut self, registers: &mut Registers) {
        self.take_back(registers);
        self.halted = true;
        registers.control(ENDPOINT, 0, epctl::STALL);
    }

    /// Begins with DATA0 again, no longer halted (USB 2.0, 9.4.5), with what the host has not received yet.
    pub fn restart(&mut self, registers: &mut Registers) {
        if !self.active {
            return;
        }
        self.take_back(registers);
        self.halted = false;
        registers.control(ENDPOINT, epctl::STALL, epctl::SD0PID);
        if self.under_way {
            self.arm(registers);
        }
    }

    /// Whether it is halted.
    pub const fn is_halted(&self) -> bool {
        self.halted
    }
}
