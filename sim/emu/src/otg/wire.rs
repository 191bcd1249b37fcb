//! The cable's end of OTG_FS: what a host's tokens, resets and silence do to it.

use super::registers::{dcfg, dctl, epctl, epint, gint, pktsts};
use super::{ENDPOINTS, Endpoint, Otg};

/// The device's answer to an IN token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum InReply {
    /// Nothing: wrong address, endpoint not active, device not there.
    Silence,
    /// Not now.
    Nak,
    /// The endpoint is halted, or the request is not supported.
    Stall,
    /// A packet.
    Data {
        /// DATA1 rather than DATA0.
        data1: bool,
        /// Its bytes.
        bytes: Vec<u8>,
    },
}

/// The device's answer to an OUT or SETUP packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutReply {
    /// Nothing: wrong address, endpoint not active, no room for a SETUP.
    Silence,
    /// Not now.
    Nak,
    /// The endpoint is halted, or the request is not supported.
    Stall,
    /// Taken, or a repetition of one taken before.
    Ack,
}

/// Words that the receive FIFO keeps free for SETUP packets while it takes OUT data: two packets of
/// two data words with their two status words each.
const SETUP_RESERVE_WORDS: usize = 8;

impl Otg {
    /// The host begins to drive a reset.
    ///
    /// The core raises USBRST and takes the endpoints out of use. It disables no transfer, flushes no FIFO
    /// and keeps the device address: that is left to the driver (RM0090, "Endpoint initialization on USB
    /// reset").
    pub fn bus_reset(&mut self) {
        self.suspended = false;
        self.reset_seen = true;
        self.in_control_transfer = false;
        for number in 0..ENDPOINTS {
            self.ins[number].bus_reset(number);
            self.outs[number].bus_reset(number);
        }
        self.raise(gint::USBRST);
    }

    /// The host ends the reset; the speed is now known. A controller that was itself reset meanwhile has seen the rest of it.
    pub fn enumeration_done(&mut self) {
        if !self.reset_seen {
            self.bus_reset();
        }
        self.raise(gint::ENUMDNE);
    }

    /// Start of frame `number`.
    pub fn start_of_frame(&mut self, number: u32) {
        self.frame = number & 0x3FFF;
        self.raise(gint::EOPF | gint::SOF);
    }

    /// The bus has been silent for 3 ms. Does nothing if the device is already suspended.
    pub fn bus_idle(&mut self) {
        if !self.suspended {
            self.suspended = true;
            self.raise(gint::ESUSP | gint::USBSUSP);
        }
    }

    /// The host signals resume.
    pub fn resume(&mut self) {
        if self.suspended {
            self.suspended = false;
            self.raise(gint::WKUPINT);
        }
    }

    /// Whether the device has seen 3 ms of silence.
    pub fn suspended(&self) -> bool {
        self.suspended
    }

    fn raise(&mut self, flags: u32) {
        self.interrupts |= flags;
        self.update();
    }

    fn addressed(&self, address: u8) -> bool {
        self.address == address && !self.late.is_dead
    }

    /// DCFG was written. An address written during a transfer is that of SET_ADDRESS and takes effect at
    /// the end of the transfer's status stage, which drivers rely on.
    pub(super) fn take_address(&mut self) {
        if !self.in_control_transfer {
            self.address = ((self.dcfg & dcfg::DAD) >> dcfg::DAD_SHIFT) as u8;
        }
    }

    /// A SETUP packet. The device must accept it whatever its endpoint 0 is doing, unless the receive FIFO
    /// is full.
    pub fn setup(&mut self, address: u8, packet: [u8; 8]) -> OutReply {
        if !self.addressed(address) || self.rx.len() + 4 > self.rx_size as usize {
            return OutReply::Silence;
        }
        for endpoint in [&mut self.ins[0], &mut self.outs[0]] {
            endpoint.control = endpoint.control & !epctl::STALL | epctl::NAKSTS;
            // The data and status stages begin with DATA1.
            endpoint.set_toggle(true);
        }
        if !self.late.faults.setup_complete_disarms {
            self.outs[0].control &= !epctl::EPENA;
        }
        // A request without a data stage, or one that carries data out, ends with an IN packet.
        self.in_control_transfer = packet[0] & 0x80 == 0;
        self.precede_by_bogus();
        self.rx.push(0, pktsts::SETUP_DATA, false, &packet);
        self.begin_setup_stage();
        self.update();
        OutReply::Ack
    }

    /// An OUT packet.
    pub fn out(&mut self, address: u8, endpoint: u8, data1: bool, bytes: &[u8]) -> OutReply {
        let number = usize::from(endpoint);
        if !self.addressed(address) || number >= ENDPOINTS || !self.outs[number].active() {
            return OutReply::Silence;
        }
        if number == 0 && self.end_setup_stage(true) {
            return OutReply::Nak;
        }
        let room = self.rx.len() + bytes.len().div_ceil(4) + 2 + SETUP_RESERVE_WORDS <= self.rx_size as usize;
        let held_off = self.dctl & dctl::GONSTS != 0;
        let out = &mut self.outs[number];
        if out.stalled() {
            return OutReply::Stall;
        }
        if !out.enabled() || out.naks() || held_off || !room {
            if !out.enabled() {
                out.interrupt |= epint::TOKEN_UNSERVED;
                self.update();
            }
            return OutReply::Nak;
        }
        if data1 != out.toggle() {
            // The host did not see our ACK and repeats the packet: acknowledged and thrown away.
            self.thrown_away += 1;
            return OutReply::Ack;
        }
        out.set_toggle(!data1);
        // Drivers differ in whether they program a transfer size; if they do not, each packet is a
        // transfer.
        out.count_packet(bytes.len());
        let complete = out.packets_left() == 0 || bytes.len() < out.max_packet(number);
        if complete {
            out.finish();
        }
        self.precede_by_bogus();
        self.rx.push(endpoint, pktsts::OUT_DATA, data1, bytes);
        if complete {
            self.completing[number] += 1;
            self.rx.push(endpoint, pktsts::OUT_COMPLETE, data1, &[]);
        }
        self.update();
        OutReply::Ack
    }

    /// An IN token. If `acknowledged`, the host receives the packet and acknowledges it; otherwise the
    /// packet or the host's ACK is lost on the cable, and the device will send it again.
    pub fn in_token(&mut self, address: u8, endpoint: u8, acknowledged: bool) -> InReply {
        let number = usize::from(endpoint);
        if !self.addressed(address) || number >= ENDPOINTS || !self.ins[number].active() {
            return InReply::Silence;
        }
        if number == 0 && self.end_setup_stage(true) {
            return InReply::Nak;
        }
        let fifo = self.fifo_of(number);
        let held_off = self.dctl & dctl::GINSTS != 0;
        let input = &mut self.ins[number];
        if input.stalled() {
            return InReply::Stall;
        }
        let bytes = input.transfer_left().min(input.max_packet(number));
        let ready = input.enabled() && !input.naks() && !held_off && input.packets_left() > 0;
        if !ready || !self.txs[fifo].holds(bytes) {
            input.interrupt |= epint::TOKEN_UNSERVED;
            self.update();
            return InReply::Nak;
        }
        let reply = InReply::Data { data1: input.toggle(), bytes: self.txs[fifo].front(bytes) };
        if acknowledged {
            self.txs[fifo].consume(bytes);
            sent(input, bytes);
            if number == 0 && bytes == 0 {
                self.in_control_transfer = false;
                self.take_address();
            }
            self.update();
        }
        reply
    }
}

/// A packet of the transfer was sent.
fn sent(input: &mut Endpoint, bytes: usize) {
    input.set_toggle(!input.toggle());
    input.count_packet(bytes);
    if input.packets_left() == 0 {
        input.finish();
        input.interrupt |= epint::XFRC;
    }
}
