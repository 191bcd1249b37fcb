//! Endpoint 0, between the controller and usb-device.

use cantap_firmware::ports::PACKET;
use usb_device::{Result, UsbError};

use super::fifo;
use super::registers::{Endpoint, Registers, epctl, epint, eptsiz};

/// The most data of a request that usb-device has room for (`control-buffer-256` is off). It ignores a request with more, and
/// the data that follow would stay in the way.
const MOST_DATA: u16 = 128;

const IN: Endpoint = Endpoint::input(0);
const OUT: Endpoint = Endpoint::output(0);

/// The control endpoint.
pub struct Control {
    setup: [u8; 8],
    /// A SETUP packet has been taken from the FIFO, and its stage is not over.
    setup_taken: bool,
    setup_waits: bool,
    packet: [u8; PACKET],
    packet_len: usize,
    /// An OUT packet has been taken from the FIFO, and is not complete.
    packet_taken: bool,
    packet_waits: bool,
    /// A packet to the host that the controller could not take yet.
    held: [u8; PACKET],
    held_len: Option<usize>,
    /// For how many milliseconds it could not.
    held_ms: u32,
}

impl Control {
    pub const fn new() -> Self {
        Self {
            setup: [0; 8],
            setup_taken: false,
            setup_waits: false,
            packet: [0; PACKET],
            packet_len: 0,
            packet_taken: false,
            packet_waits: false,
            held: [0; PACKET],
            held_len: None,
            held_ms: 0,
        }
    }

    /// After a bus reset: nothing is waiting, and only SETUP packets are answered. MPSIZ 0 means packets of 64 bytes.
    pub fn reset(&mut self, registers: &mut Registers) {
        self.forget();
        registers.disable_input(0);
        registers.write(IN.int(), epint::XFRC);
        registers.write(OUT.int(), epint::STUP);
        registers.write(IN.ctl(), epctl::SNAK);
        registers.write(OUT.ctl(), epctl::SNAK);
        registers.write(OUT.tsiz(), eptsiz::STUPCNT_3);
    }

    /// Forgets whatever is under way.
    pub fn forget(&mut self) {
        self.setup_waits = false;
        self.setup_taken = false;
        self.forget_packets();
    }

    fn forget_packets(&mut self) {
        self.packet_taken = false;
        self.packet_waits = false;
        self.held_len = None;
        self.held_ms = 0;
    }

    /// Lets the next OUT packet in.
    pub fn arm(registers: &mut Registers) {
        let one_packet = 1 << eptsiz::PKTCNT_SHIFT | PACKET as u32;
        registers.write(OUT.tsiz(), eptsiz::STUPCNT_3 | one_packet);
        registers.control(OUT, 0, epctl::EPENA | epctl::CNAK);
    }

    /// A SETUP packet is in the FIFO; of several, the last counts.
    pub fn take_setup(&mut self, registers: &Registers, len: usize) {
        fifo::pop(registers, len, &mut self.setup);
        self.setup_taken = true;
    }

    /// The setup stage is over: what was left of an earlier request is dropped, its completion included. Returns whether there was a
    /// SETUP packet.
    pub fn setup_done(&mut self, registers: &mut Registers) -> bool {
        // Left set, it kept the next stage's end from being reported on an F722 (libopencm3, pull request 1262).
        registers.write(OUT.int(), epint::STUP);
        if !core::mem::take(&mut self.setup_taken) {
            return false;
        }
        self.forget_packets();
        registers.disable_input(0);
        registers.write(IN.int(), epint::XFRC);
        Self::arm(registers);
        let [kind, .., low, high] = self.setup;
        let to_device = kind & 0x80 == 0;
        self.setup_waits = !(to_device && u16::from_le_bytes([low, high]) > MOST_DATA);
        if !self.setup_waits {
            registers.control(OUT, 0, epctl::STALL);
            registers.control(IN, 0, epctl::STALL);
        }
        true
    }

    /// An OUT packet is in the FIFO.
    pub fn take_packet(&mut self, registers: &Registers, len: usize) {
        fifo::pop(registers, len, &mut self.packet);
        self.packet_len = len.min(PACKET);
        self.packet_taken = true;
    }

    /// The packet is complete. The next one is let in once it has been read. Returns whether there was one.
    pub fn packet_done(&mut self) -> bool {
        let taken = core::mem::take(&mut self.packet_taken);
        self.packet_waits |= taken;
        taken
    }

    /// Whether a SETUP packet and whether an OUT packet is waiting to be read.
    pub const fn waits(&self) -> (bool, bool) {
        (self.setup_waits, self.packet_waits)
    }

    /// Takes what is waiting. A packet too long for `out` is lost.
    pub fn read(&mut self, registers: &mut Registers, out: &mut [u8]) -> Result<usize> {
        let bytes = if core::mem::take(&mut self.setup_waits) {
            &self.setup[..]
        } else if core::mem::take(&mut self.packet_waits) {
            Self::arm(registers);
            &self.packet[..self.packet_len]
        } else {
            return Err(UsbError::WouldBlock);
        };
        out.get_mut(..bytes.len()).ok_or(UsbError::BufferOverflow)?.copy_from_slice(bytes);
        Ok(bytes.len())
    }

    /// Sends a packet, as soon as the controller can take it.
    pub fn write(&mut self, registers: &mut Registers, bytes: &[u8]) -> Result<usize> {
        let room = self.held.get_mut(..bytes.len()).ok_or(UsbError::BufferOverflow)?;
        if self.held_len.is_some() {
            return Err(UsbError::WouldBlock);
        }
        if registers.is_free(IN) {
            Self::send(registers, bytes);
        } else {
            room.copy_from_slice(bytes);
            self.held_len = Some(bytes.len());
        }
        Ok(bytes.len())
    }

    fn send(registers: &mut Registers, bytes: &[u8]) {
        registers.write(IN.tsiz(), 1 << eptsiz::PKTCNT_SHIFT | bytes.len() as u32);
        registers.control(IN, 0, epctl::EPENA | epctl::CNAK);
        fifo::push(registers, 0, bytes);
    }

    /// Once a millisecond: sends what the controller could not take before. Returns for how many milliseconds it has not been able to.
    pub fn tick(&mut self, registers: &mut Registers) -> u32 {
        match self.held_len {
            Some(len) if registers.is_free(IN) => {
                Self::send(registers, &self.held[..len]);
                self.held_len = None;
                self.held_ms = 0;
            }
            Some(_) => self.held_ms += 1,
            None => {}
        }
        self.held_ms
    }
}
