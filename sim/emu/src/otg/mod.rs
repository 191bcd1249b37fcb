//! The chip's USB controller, OTG_FS, as a full-speed device: its registers, its FIFOs and its
//! interrupt line on one side ([`Otg::read`], [`Otg::write`], [`Otg::irq`]), the cable on the other
//! (`wire.rs`). It follows RM0090, "USB on-the-go full-speed", as far as device drivers use it; it
//! has no host mode, no isochronous endpoints and no DMA.
//!
//! It acts when the other end of the cable calls. Only what may come late needs the time, which [`Otg::settle`] tells it.

mod endpoint;
mod fifo;
mod hostility;
mod late;
mod registers;
mod wire;

pub use wire::{InReply, OutReply};

use std::collections::BTreeMap;

use endpoint::Endpoint;
use fifo::{RxFifo, TxFifo};
use late::Late;
use registers::{
    FIFO_STRIDE, FIFOS, dctl, device, dsts, epint, eptsiz, gahbcfg, gccfg, gint, global, grstctl,
};

/// Endpoints in each direction, endpoint 0 included (RM0090: 4 in OTG_FS of the STM32F405).
pub const ENDPOINTS: usize = 4;
/// Words that all FIFOs share (RM0090: 1.25 KiB).
pub const FIFO_WORDS: u32 = 320;
/// The core ID of OTG_FS in the STM32F405.
const CORE_ID: u32 = 0x1200;

/// The controller.
#[derive(Debug)]
pub struct Otg {
    /// Registers that only store what is written, by offset.
    plain: BTreeMap<u32, u32>,
    ahb: u32,
    interrupts: u32,
    interrupt_mask: u32,
    rx_size: u32,
    /// DIEPTXF0..3: depth and start of each transmit FIFO.
    tx_sizes: [u32; ENDPOINTS],
    gccfg: u32,
    dcfg: u32,
    dctl: u32,
    /// The address that tokens must have.
    address: u8,
    in_control_transfer: bool,
    frame: u32,
    suspended: bool,
    /// A bus reset was seen since the controller's own.
    reset_seen: bool,
    in_mask: u32,
    out_mask: u32,
    all_mask: u32,
    in_empty_mask: u32,
    ins: [Endpoint; ENDPOINTS],
    outs: [Endpoint; ENDPOINTS],
    rx: RxFifo,
    /// The status that was last peeked at and has not been taken since.
    peeked: Option<u32>,
    /// Ends of OUT transfers waiting in the receive FIFO, by endpoint.
    completing: [u32; ENDPOINTS],
    txs: [TxFifo; ENDPOINTS],
    /// The interrupt line, recomputed after every change.
    line: bool,
    misuse: Misuse,
    late: Late,
    /// OUT packets that were acknowledged and thrown away because of their toggle.
    thrown_away: u64,
}

/// What a driver did that the chip does not forgive. A test can assert that none of it happened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Misuse {
    /// Words written to a full transmit FIFO.
    pub tx_overflows: u64,
    /// Status words read as data, data read as a status, or reads from an empty receive FIFO.
    pub rx_misreads: u64,
    /// Accesses to registers that the model does not have.
    pub unknown_registers: u64,
    /// FIFOs that overlap, pass the end of the RAM or are too small when endpoints are in use.
    pub bad_fifo_layout: u64,
    /// An OUT endpoint's NAK cleared while the end of its transfer waits in the receive FIFO, unseen by the driver: cores of this family
    /// then lose four bytes of a packet (libopencm3 #600, #672, #873).
    pub early_cnaks: u64,
    /// IN endpoints disabled before their NAK was effective, or FIFOs flushed under a transfer (RM0090, "IN endpoint disable",
    /// GRSTCTL).
    pub unruly_disables: u64,
    /// Transfer sizes written while the transfer is armed.
    pub resized_transfers: u64,
}

/// The minimum size of the receive FIFO in words: 5 · 1 + 8 for SETUP packets, 1 for global OUT NAK, a packet of 64 bytes with its
/// status, two for each of two OUT endpoints (RM0090, "Receive data FIFO").
const LEAST_RX_WORDS: u32 = 5 + 8 + 1 + 16 + 1 + 2 * 2;
/// The minimum size of a transmit FIFO in words (RM0090, DIEPTXFx).
const LEAST_TX_WORDS: u32 = 16;

impl Otg {
    /// The state after a reset.
    pub fn new() -> Self {
        let plain = BTreeMap::from([
            (global::GOTGCTL, 0x0000_0800),
            (global::GOTGINT, 0),
            (global::GUSBCFG, 0x0000_0A00),
            (global::HNPTXSTS, 0x0008_0200),
            (global::HPTXFSIZ, 0x0200_0600),
            (device::DVBUSDIS, 0x17D7),
            (device::DVBUSPULSE, 0x05B8),
            (device::PCGCCTL, 0),
        ]);
        let mut otg = Self {
            plain,
            ahb: 0,
            interrupts: 0,
            interrupt_mask: 0,
            rx_size: 0x200,
            tx_sizes: [0x0000_0200, 0x0200_0400, 0x0200_0400, 0x0200_0400],
            gccfg: 0,
            dcfg: 0x0220_0000,
            dctl: 0,
            address: 0,
            in_control_transfer: false,
            frame: 0,
            suspended: false,
            reset_seen: false,
            in_mask: 0,
            out_mask: 0,
            all_mask: 0,
            in_empty_mask: 0,
            ins: [Endpoint::default(); ENDPOINTS],
            outs: [Endpoint::default(); ENDPOINTS],
            rx: RxFifo::default(),
            peeked: None,
            completing: [0; ENDPOINTS],
            txs: Default::default(),
            line: false,
            misuse: Misuse::default(),
            late: Late::default(),
            thrown_away: 0,
        };
        otg.ins[0] = Endpoint::control_pipe();
        otg.outs[0] = Endpoint::control_pipe();
        otg
    }

    /// The state after a reset of a controller with the same faults.
    #[must_use]
    pub fn after_reset(&self) -> Self {
        Self { late: self.late.after_reset(), ..Self::new() }
    }

    /// The interrupt line.
    pub fn irq(&self) -> bool {
        self.line
    }

    /// What a driver did wrong so far.
    pub fn misuse(&self) -> Misuse {
        self.misuse
    }

    /// OUT packets that were acknowledged and thrown away because of their toggle: repetitions, if the host missed a handshake; otherwise
    /// one of the two sides has not begun anew with DATA0, and the packet is lost.
    pub fn thrown_away(&self) -> u64 {
        self.thrown_away
    }

    /// Reads a whole register; reading the receive queue or a FIFO removes what was read.
    pub fn read(&mut self, offset: u32) -> u32 {
        match offset {
            global::GAHBCFG => self.ahb,
            global::GRSTCTL => self.grstctl(),
            global::GINTSTS => self.gintsts(),
            global::GINTMSK => self.interrupt_mask,
            global::GRXSTSR => {
                self.peeked = self.rx.peek_status();
                self.peeked.unwrap_or_else(|| self.misread())
            }
            global::GRXSTSP => self.pop_status(),
            global::GRXFSIZ => self.rx_size,
            global::DIEPTXF0 => self.tx_sizes[0],
            global::GCCFG => self.gccfg,
            global::CID => CORE_ID,
            global::DIEPTXF1..=global::DIEPTXF3 => {
                self.tx_sizes[1 + ((offset - global::DIEPTXF1) / 4) as usize]
            }
            device::DCFG => self.dcfg,
            device::DCTL => self.dctl,
            device::DSTS => {
                self.frame << dsts::FNSOF_SHIFT
                    | dsts::ENUMSPD_FULL
                    | if self.suspended { dsts::SUSPSTS } else { 0 }
            }
            device::DIEPMSK => self.in_mask,
            device::DOEPMSK => self.out_mask,
            device::DAINT => self.daint() | self.unmasked_flags(),
            device::DAINTMSK => self.all_mask,
            device::DIEPEMPMSK => self.in_empty_mask,
            FIFOS.. => self.read_fifo(),
            _ => {
                if let Some((input, number, register)) = endpoint_register(offset) {
                    return self.read_endpoint(input, number, register);
                }
                self.plain.get(&offset).copied().unwrap_or_else(|| self.unknown())
            }
        }
    }

    /// Writes a whole register or a FIFO word.
    pub fn write(&mut self, offset: u32, value: u32) {
        if self.loses_write(offset, value) {
            return;
        }
        match offset {
            global::GAHBCFG => self.ahb = value & 0x181,
            global::GRSTCTL => self.write_grstctl(value),
            global::GINTSTS => self.interrupts &= !(value & gint::WRITE_CLEARS),
            global::GINTMSK => self.interrupt_mask = value,
            global::GRXFSIZ => self.rx_size = value & 0xFFFF,
            global::DIEPTXF0 => self.tx_sizes[0] = value,
            global::GCCFG => self.gccfg = value,
            global::DIEPTXF1..=global::DIEPTXF3 => {
                self.tx_sizes[1 + ((offset - global::DIEPTXF1) / 4) as usize] = value;
            }
            device::DCFG => {
                self.dcfg = value;
                self.take_address();
            }
            device::DCTL => self.write_dctl(value),
            device::DIEPMSK => self.in_mask = value,
            device::DOEPMSK => self.out_mask = value,
            device::DAINTMSK => self.all_mask = value,
            device::DIEPEMPMSK => self.in_empty_mask = value,
            // Read-only.
            global::GRXSTSR
            | global::GRXSTSP
            | global::CID
            | global::HNPTXSTS
            | device::DSTS
            | device::DAINT => {}
            FIFOS.. => self.write_fifo(((offset - FIFOS) / FIFO_STRIDE) as usize, value),
            _ => {
                if let Some((input, number, register)) = endpoint_register(offset) {
                    self.write_endpoint(input, number, register, value);
                } else if let Some(register) = self.plain.get_mut(&offset) {
                    *register = value;
                } else {
                    self.unknown();
                }
            }
        }
        self.update();
    }

    fn unknown(&mut self) -> u32 {
        self.misuse.unknown_registers += 1;
        0
    }

    fn misread(&mut self) -> u32 {
        self.misuse.rx_misreads += 1;
        0
    }

    /// Recomputes the interrupt line.
    fn update(&mut self) {
        self.line = self.ahb & gahbcfg::GINT != 0 && self.gintsts() & self.interrupt_mask != 0;
    }

    /// GINTSTS: the latched flags, and those that follow the FIFOs and endpoints.
    fn gintsts(&self) -> u32 {
        let mut status = self.interrupts | gint::NPTXFE | self.mode_flag();
        if self.rx.has_status() {
            status |= gint::RXFLVL;
        }
        if self.dctl & dctl::GINSTS != 0 {
            status |= gint::GINAKEFF;
        }
        if self.dctl & dctl::GONSTS != 0 {
            status |= gint::GONAKEFF;
        }
        let pending = self.daint() & self.all_mask;
        if pending & 0xFFFF != 0 {
            status |= gint::IEPINT;
        }
        if pending >> 16 != 0 {
            status |= gint::OEPINT;
        }
        status
    }

    /// DAINT: a bit for each endpoint with an unmasked interrupt.
    fn daint(&self) -> u32 {
        let mut bits = 0;
        for number in 0..ENDPOINTS {
            let mut input = self.ins[number].interrupt & self.in_mask;
            if self.in_empty_mask >> number & 1 != 0 {
                input |= self.txfe(number);
            }
            bits |= u32::from(input != 0) << number;
            bits |= u32::from(self.outs[number].interrupt & self.out_mask != 0) << (16 + number);
        }
        bits
    }

    fn write_grstctl(&mut self, value: u32) {
        if value & grstctl::CSRST != 0 {
            self.begin_core_reset();
        }
        if value & grstctl::RXFFLSH != 0 {
            self.rx.flush();
            self.completing = [0; ENDPOINTS];
        }
        if value & grstctl::TXFFLSH != 0 {
            let flushed = value >> grstctl::TXFNUM_SHIFT & 0x1F;
            let under_way = (0..ENDPOINTS).filter(|number| {
                let named = flushed == grstctl::TXFNUM_ALL || flushed as usize == self.fifo_of(*number);
                named
                    && self.ins[*number].active()
                    && self.ins[*number].enabled()
                    && !self.ins[*number].naks()
            });
            self.misuse.unruly_disables += under_way.count() as u64;
            self.begin_flush(flushed);
        }
    }

    /// Empties a transmit FIFO, or all of them.
    fn flush(&mut self, number: u32) {
        if number == grstctl::TXFNUM_ALL {
            self.txs.iter_mut().for_each(TxFifo::flush);
        } else if let Some(fifo) = self.txs.get_mut(number as usize) {
            fifo.flush();
        }
    }

    /// CSRST: everything but the transceiver's configuration and the device speed.
    fn core_soft_reset(&mut self) {
        let fresh = Self::new();
        let old = std::mem::replace(self, fresh);
        self.plain = old.plain;
        self.gccfg = old.gccfg;
        self.dcfg = self.dcfg & !3 | old.dcfg & 3;
        self.frame = old.frame;
        self.misuse = old.misuse;
        self.late = old.late;
        self.thrown_away = old.thrown_away;
    }

    fn write_dctl(&mut self, value: u32) {
        let value = self.without_global_out_nak(value);
        let mut status = self.dctl & (dctl::GINSTS | dctl::GONSTS);
        for (command, bit, set) in [
            (dctl::SGINAK, dctl::GINSTS, true),
            (dctl::CGINAK, dctl::GINSTS, false),
            (dctl::SGONAK, dctl::GONSTS, true),
            (dctl::CGONAK, dctl::GONSTS, false),
        ] {
            if value & command != 0 {
                status = if set { status | bit } else { status & !bit };
            }
        }
        self.dctl = value & dctl::STORED | status;
    }

    /// Takes a status from the receive queue. The two "complete" states raise the endpoint's interrupt
    /// when they are taken (RM0090, GRXSTSP).
    fn pop_status(&mut self) -> u32 {
        self.peeked = None;
        let Some(status) = self.rx.pop_status() else {
            return self.misread();
        };
        let Some(out) = self.outs.get_mut((status & 0xF) as usize) else {
            self.update();
            return status;
        };
        match status >> 17 & 0xF {
            registers::pktsts::OUT_COMPLETE => {
                out.interrupt |= epint::XFRC;
                let completing = &mut self.completing[(status & 0xF) as usize % ENDPOINTS];
                *completing = completing.saturating_sub(1);
            }
            registers::pktsts::SETUP_COMPLETE if (status & 0xF) as u8 == 0 => {
                out.interrupt |= epint::STUP;
                if self.late.faults.setup_complete_disarms {
                    out.control = out.control & !registers::epctl::EPENA | registers::epctl::NAKSTS;
                }
            }
            registers::pktsts::GLOBAL_OUT_NAK => self.dctl |= dctl::GONSTS,
            _ => {}
        }
        self.update();
        status
    }

    fn read_fifo(&mut self) -> u32 {
        let word = self.rx.pop_data();
        word.unwrap_or_else(|| self.misread())
    }

    fn write_fifo(&mut self, number: usize, word: u32) {
        let depth = self.tx_depth(number);
        match self.txs.get_mut(number) {
            Some(fifo) if fifo.len() < depth => fifo.push(word),
            _ => self.misuse.tx_overflows += 1,
        }
    }

    /// Words of a transmit FIFO.
    fn tx_depth(&self, number: usize) -> usize {
        self.tx_sizes.get(number).map_or(0, |size| (size >> 16) as usize)
    }

    /// The FIFO that an IN endpoint sends from.
    fn fifo_of(&self, number: usize) -> usize {
        if number == 0 {
            return 0;
        }
        let fifo = (self.ins[number].control & registers::epctl::TXFNUM) >> registers::epctl::TXFNUM_SHIFT;
        fifo as usize % ENDPOINTS
    }

    /// TXFE of an IN endpoint.
    fn txfe(&self, number: usize) -> u32 {
        let fifo = self.fifo_of(number);
        let used = self.txs[fifo].len();
        let only_when_empty = self.ahb & gahbcfg::TXFELVL != 0;
        let empty = if only_when_empty { used == 0 } else { used * 2 <= self.tx_depth(fifo) };
        if empty { epint::TXFE } else { 0 }
    }

    fn read_endpoint(&mut self, input: bool, number: usize, register: u32) -> u32 {
        let endpoint = if input { &self.ins[number] } else { &self.outs[number] };
        match register {
            device::EPCTL => endpoint.control,
            device::EPINT if input => endpoint.interrupt | self.txfe(number),
            device::EPINT => endpoint.interrupt,
            device::EPTSIZ => endpoint.size,
            device::TXFSTS if input => {
                let fifo = self.fifo_of(number);
                self.tx_depth(fifo).saturating_sub(self.txs[fifo].len()) as u32
            }
            _ => self.unknown(),
        }
    }

    fn write_endpoint(&mut self, input: bool, number: usize, register: u32, value: u32) {
        self.judge(input, number, register, value);
        let (value, due) = self.as_it_takes(input, register, value);
        let endpoint = if input { &mut self.ins[number] } else { &mut self.outs[number] };
        match register {
            // Endpoint 0 OUT cannot be disabled (RM0090, DOEPCTL0).
            device::EPCTL if !input && number == 0 => {
                endpoint.write_control(0, value & !registers::epctl::EPDIS, due);
            }
            device::EPCTL => {
                endpoint.write_control(number, value, due);
                if value & registers::epctl::EPENA != 0 {
                    self.check_layout();
                }
            }
            device::EPINT => {
                endpoint.interrupt &= !value;
                self.end_setup_stage(false);
            }
            device::EPTSIZ if number == 0 && input => {
                endpoint.size = value & (0x7F | 3 << eptsiz::PKTCNT_SHIFT);
            }
            device::EPTSIZ => endpoint.size = value & 0x7FFF_FFFF,
            device::TXFSTS if input => {}
            _ => {
                self.unknown();
            }
        }
    }

    /// Counts writes that a driver must not make to an endpoint in its present state.
    fn judge(&mut self, input: bool, number: usize, register: u32, value: u32) {
        let endpoint = if input { &self.ins[number] } else { &self.outs[number] };
        match register {
            device::EPCTL if input => {
                let ends = value & registers::epctl::EPDIS != 0 && endpoint.enabled() && endpoint.active();
                let waited = endpoint.interrupt & epint::INEPNE != 0 || self.late.excuses(endpoint);
                self.misuse.unruly_disables += u64::from(ends && !waited);
            }
            device::EPCTL => {
                let clears = value & registers::epctl::CNAK != 0;
                let seen = self.peeked.is_some_and(|status| {
                    status >> 17 & 0xF == registers::pktsts::OUT_COMPLETE && (status & 0xF) as usize == number
                });
                self.misuse.early_cnaks += u64::from(clears && self.completing[number] > 0 && !seen);
            }
            device::EPTSIZ => {
                // Endpoint 0 OUT cannot be disabled, and takes new SETUP packets while it is armed.
                let armed = endpoint.enabled() && endpoint.active() && (input || number != 0);
                self.misuse.resized_transfers += u64::from(armed);
            }
            _ => {}
        }
    }

    /// Counts a FIFO layout that does not fit the RAM or overlaps.
    fn check_layout(&mut self) {
        let mut parts = vec![(0, self.rx_size)];
        for size in self.tx_sizes {
            if size >> 16 != 0 {
                parts.push((size & 0xFFFF, (size & 0xFFFF) + (size >> 16)));
            }
        }
        parts.sort_unstable();
        let active = (0..ENDPOINTS).filter(|number| self.ins[*number].active());
        let large_enough = self.rx_size >= LEAST_RX_WORDS
            && active
                .map(|number| self.tx_depth(self.fifo_of(number)))
                .all(|words| words >= LEAST_TX_WORDS as usize);
        let fits = parts.windows(2).all(|pair| pair[0].1 <= pair[1].0)
            && parts.last().is_none_or(|last| last.1 <= FIFO_WORDS)
            && large_enough;
        if !fits {
            self.misuse.bad_fifo_layout += 1;
        }
    }

    /// Whether the pull-up on D+ shows a host that a device is there: the transceiver is on, the
    /// device is not soft-disconnected, and VBUS is either present or not sensed.
    pub fn pulled_up(&self, vbus: bool) -> bool {
        let sees_vbus = self.gccfg & gccfg::NOVBUSSENS != 0 || self.gccfg & gccfg::VBUSBSEN != 0 && vbus;
        self.gccfg & gccfg::PWRDWN != 0 && self.dctl & dctl::SDIS == 0 && sees_vbus
    }
}

impl Default for Otg {
    fn default() -> Self {
        Self::new()
    }
}

/// Direction (IN is true), number and register of an endpoint register's offset.
fn endpoint_register(offset: u32) -> Option<(bool, usize, u32)> {
    let (input, from) = match offset {
        device::IN_ENDPOINTS..device::OUT_ENDPOINTS => (true, device::IN_ENDPOINTS),
        device::OUT_ENDPOINTS..0xD00 => (false, device::OUT_ENDPOINTS),
        _ => return None,
    };
    let number = ((offset - from) / device::ENDPOINT_STRIDE) as usize;
    (number < ENDPOINTS).then_some((input, number, (offset - from) % device::ENDPOINT_STRIDE))
}

#[cfg(test)]
mod tests;
