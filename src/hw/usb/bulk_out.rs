//! The data endpoint from the host. It is armed for as many packets as there is room for, and again only once all of them have
//! been read and the port is not held: until then the answer is NAK.
//!
//! Nothing arms it between a packet's data and the end of its transfer, where cores of this family lose four bytes of the packet
//! (libopencm3 #600, #672, #873).

use cantap_firmware::ports::{ON_ITS_WAY, PACKET};

use super::registers::{Endpoint, Registers, epctl, eptsiz};
use super::{BULK_OUT, fifo};

const ENDPOINT: Endpoint = Endpoint::output(BULK_OUT);
/// Bulk, packets of 64 bytes, DATA0.
const ACTIVE: u32 = epctl::USBAEP | 2 << epctl::EPTYP_SHIFT | PACKET as u32 | epctl::SD0PID;

/// Bulk OUT.
pub struct BulkOut {
    packets: [[u8; PACKET]; ON_ITS_WAY],
    lens: [usize; ON_ITS_WAY],
    /// Packets taken from the FIFO since the endpoint was armed, and how many of them have been read.
    taken: usize,
    read: usize,
    armed: bool,
    /// A bus reset has left it answering NAK, perhaps with a transfer armed.
    muted: bool,
    active: bool,
    held: bool,
    halted: bool,
}

impl BulkOut {
    pub const fn new() -> Self {
        Self {
            packets: [[0; PACKET]; ON_ITS_WAY],
            lens: [0; ON_ITS_WAY],
            taken: 0,
            read: 0,
            armed: false,
            muted: false,
            active: false,
            held: false,
            halted: false,
        }
    }

    /// After a bus reset: out of use, and nothing waits. The receive FIFO is about to be emptied.
    ///
    /// An armed transfer is not disabled: that would take global OUT NAK first (RM0090, "Disabling an OUT endpoint"), which has to
    /// pass through the receive FIFO. Answering NAK is enough, as in TinyUSB: the transfer is used again, with the packets that it has left.
    pub fn reset(&mut self, registers: &mut Registers) {
        registers.control(ENDPOINT, epctl::USBAEP, epctl::SNAK);
        let armed = registers.is_armed(ENDPOINT);
        *self = Self { held: self.held, armed, muted: true, ..Self::new() };
    }

    /// Puts the endpoint into or out of use, with DATA0 and not halted (USB 2.0, 9.1.1.5). What has been received stays, and
    /// so does an armed transfer.
    pub fn configure(&mut self, registers: &mut Registers, active: bool) {
        self.active = active;
        self.halted = false;
        let mut ctl = if active { ACTIVE } else { 0 };
        if active && core::mem::take(&mut self.muted) && self.armed {
            ctl |= epctl::CNAK;
        }
        registers.write(ENDPOINT.ctl(), ctl);
        self.arm(registers);
    }

    /// Lets packets in, if there is room for as many as may come. Call it again and again.
    pub fn arm(&mut self, registers: &mut Registers) {
        if !self.active || self.armed || self.held || self.read < self.taken {
            return;
        }
        // The controller takes a moment to end a transfer whose end it has reported, or has reported what was not so.
        if registers.is_armed(ENDPOINT) {
            return;
        }
        (self.taken, self.read) = (0, 0);
        self.armed = true;
        let size = (ON_ITS_WAY as u32) << eptsiz::PKTCNT_SHIFT | (ON_ITS_WAY * PACKET) as u32;
        registers.write(ENDPOINT.tsiz(), size);
        registers.control(ENDPOINT, 0, epctl::EPENA | epctl::CNAK);
    }

    /// Whether packets for it can be in the FIFO: it is in use, or was when its transfer was armed.
    const fn can_receive(&self) -> bool {
        self.active || self.armed && !self.muted
    }

    /// A packet is in the FIFO. Returns whether there can be one.
    pub fn take_packet(&mut self, registers: &Registers, len: usize) -> bool {
        if !self.can_receive() {
            return false;
        }
        match self.packets.get_mut(self.taken) {
            Some(packet) => {
                fifo::pop(registers, len, packet);
                self.lens[self.taken] = len.min(PACKET);
                self.taken += 1;
            }
            // Cannot happen: no more are let in than there is room for.
            None => fifo::pop(registers, len, &mut []),
        }
        true
    }

    /// The transfer has ended: it is full, or its last packet was short. Returns whether there can have been one.
    pub const fn transfer_done(&mut self) -> bool {
        let can_receive = self.can_receive();
        self.armed = false;
        can_receive
    }

    /// Takes a packet and returns its length.
    pub fn read(&mut self, registers: &mut Registers, out: &mut [u8]) -> Option<usize> {
        if self.read == self.taken {
            return None;
        }
        let packet = &self.packets[self.read][..self.lens[self.read]];
        self.read += 1;
        let len = packet.len().min(out.len());
        out[..len].copy_from_slice(&packet[..len]);
        self.arm(registers);
        Some(len)
    }

    /// If `held`, lets in no packets beyond those it is armed for; otherwise lets them in again.
    pub fn hold(&mut self, registers: &mut Registers, held: bool) {
        self.held = held;
        self.arm(registers);
    }

    /// Answers with STALL from here on.
    pub fn halt(&mut self, registers: &mut Registers) {
        self.halted = true;
        registers.control(ENDPOINT, 0, epctl::STALL);
    }

    /// Begins with DATA0 again, no longer halted (USB 2.0, 9.4.5).
    pub fn restart(&mut self, registers: &mut Registers) {
        if self.active {
            self.halted = false;
            registers.control(ENDPOINT, epctl::STALL, epctl::SD0PID);
        }
    }

    /// Whether it is halted.
    pub const fn is_halted(&self) -> bool {
        self.halted
    }
}
