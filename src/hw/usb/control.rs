//! Endpoint 0, between the controller and usb-device.

use cantap_firmware::ports::PACKET;
use usb_device::{Result, UsbError};

use super::fifo;
use super::registers::{Endpoint, Registers, epctl, eptsiz};

/// The most data of a request that usb-device has room for (`control-buffer-256` is off). It ignores a request with more, and
/// the data that follow would stay in the way.
const MOST_DATA: u16 = 128;

const IN: Endpoint = Endpoint::input(0);
const OUT: Endpoint = Endpoint::output(0);

/// The control endpoint.
pub struct Control {
    setup: [u8; 8],
    setup_waits: bool,
    packet: [u8; PACKET],
    packet_len: usize,
    packet_waits: bool,
}

impl Control {
    pub const fn new() -> Self {
        Self { setup: [0; 8], setup_waits: false, packet: [0; PACKET], packet_len: 0, packet_waits: false }
    }

    /// After a bus reset: nothing is waiting, and only SETUP packets are answered. MPSIZ 0 means packets of 64 bytes.
    pub fn reset(&mut self, registers: &mut Registers) {
        self.setup_waits = false;
        self.packet_waits = false;
        registers.disable_input(0);
        registers.write(IN.ctl(), epctl::SNAK);
        registers.write(OUT.ctl(), epctl::SNAK);
        registers.write(OUT.tsiz(), eptsiz::STUPCNT_3);
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
    }

    /// The setup stage is over: what was left of an earlier request is dropped.
    pub fn setup_done(&mut self, registers: &mut Registers) {
        self.packet_waits = false;
        registers.disable_input(0);
        Self::arm(registers);
        let [kind, .., low, high] = self.setup;
        let to_device = kind & 0x80 == 0;
        self.setup_waits = !(to_device && u16::from_le_bytes([low, high]) > MOST_DATA);
        if !self.setup_waits {
            registers.control(OUT, 0, epctl::STALL);
            registers.control(IN, 0, epctl::STALL);
        }
    }

    /// An OUT packet is in the FIFO.
    pub fn take_packet(&mut self, registers: &Registers, len: usize) {
        fifo::pop(registers, len, &mut self.packet);
        self.packet_len = len.min(PACKET);
    }

    /// The packet is complete. The next one is let in once it has been read.
    pub fn packet_done(&mut self) {
        self.packet_waits = true;
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

    /// Sends a packet.
    pub fn write(registers: &mut Registers, bytes: &[u8]) -> Result<usize> {
        if bytes.len() > PACKET {
            return Err(UsbError::BufferOverflow);
        }
        if registers.is_armed(IN) {
            return Err(UsbError::WouldBlock);
        }
        registers.write(IN.tsiz(), 1 << eptsiz::PKTCNT_SHIFT | bytes.len() as u32);
        registers.control(IN, 0, epctl::EPENA | epctl::CNAK);
        fifo::push(registers, 0, bytes);
        Ok(bytes.len())
    }
}
