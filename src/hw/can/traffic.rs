//! A controller's frames: those received, and those sent.

use core::sync::atomic::{AtomicU32, Ordering};

use cantap_firmware::bus::mailboxes::MAILBOXES;
use cantap_firmware::ports::{ErrorStatus, Outcome, Traffic};
use cantap_wire::message::RegisterSet;
use cantap_wire::record::{BusErrorKind, ErrorState};
use cantap_wire::{Frame, Id};
use stm32f4xx_hal::pac::can1::rx::rir;

use super::bells::{TMEIE, switch};
use super::registers::Registers;

/// After a frame is released from the FIFO, the next appears some APB1 clocks later. This many reads, of at
/// least two such clocks each, take far longer than that; the bound only keeps a defect from hanging an
/// interrupt.
const RELEASE_READS: u32 = 32;
/// The value of LEC that the hardware never writes: once written, it shows whether there has been an error since.
const LEC_SEEN: u8 = 7;

/// Bits of TSR (RM0090, CAN_TSR): a byte for each mailbox, and the flags of empty ones.
mod tsr {
    pub const MAILBOX_BITS: usize = 8;
    pub const RQCP: u32 = 1 << 0;
    pub const TXOK: u32 = 1 << 1;
    pub const ALST: u32 = 1 << 2;
    pub const EACH_RQCP: u32 = RQCP | RQCP << MAILBOX_BITS | RQCP << (2 * MAILBOX_BITS);
    pub const TME_SHIFT: usize = 26;
}

/// Fields of TIxR (RM0090, CAN_TIxR).
mod tir {
    pub const TXRQ: u32 = 1 << 0;
    pub const RTR: u32 = 1 << 1;
    pub const IDE: u32 = 1 << 2;
    pub const EXID_SHIFT: u32 = 3;
    pub const STID_SHIFT: u32 = 21;
}

/// A controller's traffic half. It alone writes TSR, the mailboxes, RF0R, MSR and ESR.
pub struct CanTraffic {
    can: Registers,
    /// Per mailbox: the number of the request in it.
    requests: [u32; MAILBOXES],
    next_request: u32,
    /// Per mailbox: TIxR as it was written, so that the request need not read it.
    identifiers: [u32; MAILBOXES],
    /// Per mailbox: whether its abort was requested.
    aborting: [bool; MAILBOXES],
    /// When the transmit interrupt last stamped. Valid while that interrupt is silenced.
    sent_at: &'static AtomicU32,
}

impl CanTraffic {
    pub(super) const fn new(can: Registers, sent_at: &'static AtomicU32) -> Self {
        Self {
            can,
            requests: [0; MAILBOXES],
            next_request: 0,
            identifiers: [0; MAILBOXES],
            aborting: [false; MAILBOXES],
            sent_at,
        }
    }

    /// Of the completed mailboxes, given as one flag each, the one with the oldest request.
    fn oldest(&self, completed: u32) -> usize {
        if completed.is_power_of_two() {
            return completed.trailing_zeros() as usize / tsr::MAILBOX_BITS;
        }
        // Compared by distance, because the numbers wrap.
        (0..MAILBOXES)
            .filter(|mailbox| completed >> (mailbox * tsr::MAILBOX_BITS) & tsr::RQCP != 0)
            .max_by_key(|&mailbox| self.next_request.wrapping_sub(self.requests[mailbox]))
            .unwrap_or(0)
    }
}

impl Traffic for CanTraffic {
    fn pending(&self) -> u8 {
        let status = self.can.rf0r().read();
        status.fmp().bits().saturating_sub(status.rfom().bit().into())
    }

    #[inline(always)]
    #[expect(clippy::inline_always, reason = "measured, as for `Recorder::frame`")]
    fn front(&self) -> Option<Frame> {
        let fifo = self.can.rf0r();
        // While a frame is being released, the mailbox still shows it.
        let mut status = fifo.read();
        let mut reads = RELEASE_READS;
        while status.rfom().bit() {
            if reads == 0 {
                // It would be the same frame again.
                return None;
            }
            status = fifo.read();
            reads -= 1;
        }
        if status.fmp().bits() == 0 {
            return None;
        }
        let mailbox = self.can.rx(0);
        let rir = mailbox.rir().read();
        let dlc = mailbox.rdtr().read().dlc().bits();
        let low = mailbox.rdlr().read().bits();
        let high = mailbox.rdhr().read().bits();
        let data = (u64::from(high) << 32 | u64::from(low)).to_le_bytes();
        Some(Frame::from_bus(received_id(&rir), rir.rtr().is_remote(), dlc, data))
    }

    #[inline(always)]
    #[expect(clippy::inline_always, reason = "measured, as for `Recorder::frame`")]
    fn receive(&mut self) -> Option<Frame> {
        let frame = self.front()?;
        self.can.rf0r().write(|w| w.rfom().release());
        Some(frame)
    }

    fn is_leaving(&self) -> bool {
        // SLEEP, because a master reset sets that and clears INRQ (RM0090, CAN_MCR).
        let mcr = self.can.mcr().read();
        mcr.inrq().bit() || mcr.sleep().bit() || mcr.reset().bit()
    }

    #[inline]
    fn look(&mut self) -> (u8, bool) {
        let status = self.can.rf0r().read();
        let overrun = status.fovr().is_overrun();
        if overrun {
            self.can.rf0r().write(|w| w.fovr().clear());
        }
        (status.fmp().bits(), overrun)
    }

    #[inline]
    fn take_overrun(&mut self) -> bool {
        let overrun = self.can.rf0r().read().fovr().is_overrun();
        if overrun {
            self.can.rf0r().write(|w| w.fovr().clear());
        }
        overrun
    }

    fn prepare(&mut self, frame: &Frame) -> Option<u8> {
        let tsr = self.can.tsr().read().bits();
        // A mailbox whose outcome has not been taken yet is empty, but not free.
        let number = (0..MAILBOXES).find(|number| {
            tsr >> (tsr::TME_SHIFT + number) & 1 != 0 && tsr >> (number * tsr::MAILBOX_BITS) & tsr::RQCP == 0
        })?;
        let mailbox = self.can.tx(number);
        let [low, high] = [0, 4].map(|from| {
            let bytes = frame.padded_data();
            u32::from_le_bytes([bytes[from], bytes[from + 1], bytes[from + 2], bytes[from + 3]])
        });
        // Written whole: a stray TGT would replace the last data bytes.
        mailbox.tdtr().write(|w| {
            // SAFETY: a frame's DLC has four bits, as the field.
            unsafe { w.dlc().bits(frame.dlc()) }
        });
        // Bytes past the data are not sent, and a write takes as long as a dozen instructions.
        if frame.data_len() > 0 {
            mailbox.tdlr().write(|w| {
                // SAFETY: every value is data.
                unsafe { w.bits(low) }
            });
        }
        if frame.data_len() > 4 {
            mailbox.tdhr().write(|w| {
                // SAFETY: every value is data.
                unsafe { w.bits(high) }
            });
        }
        let id = frame.id();
        let identifier = if id.is_extended() {
            id.raw() << tir::EXID_SHIFT | tir::IDE
        } else {
            id.raw() << tir::STID_SHIFT
        };
        let identifier = identifier | if frame.is_remote() { tir::RTR } else { 0 };
        // SAFETY: an identifier of 11 or 29 bits in its place, and the register's own flags.
        mailbox.tir().write(|w| unsafe { w.bits(identifier) });
        self.identifiers[number] = identifier;
        Some(number as u8)
    }

    #[inline]
    fn request(&mut self, mailbox: u8) {
        let number = usize::from(mailbox).min(MAILBOXES - 1);
        // SAFETY: what `prepare` wrote there, and the register's own flag.
        self.can.tx(number).tir().write(|w| unsafe { w.bits(self.identifiers[number] | tir::TXRQ) });
        self.requests[number] = self.next_request;
        self.next_request = self.next_request.wrapping_add(1);
        self.aborting[number] = false;
    }

    #[inline]
    fn stamped(&self) -> Option<u32> {
        // The interrupt silences itself once it has stamped. If no mailbox has finished, the stamp is an old one.
        let finished = self.can.tsr().read().bits() & tsr::EACH_RQCP != 0;
        let stamped = finished && self.can.ier().read().bits() & 1 << TMEIE == 0;
        stamped.then(|| self.sent_at.load(Ordering::Relaxed))
    }

    #[inline]
    fn await_finished(&mut self) {
        switch(&self.can, TMEIE, true);
    }

    fn take_finished(&mut self) -> Option<(u8, Outcome)> {
        let tsr = self.can.tsr().read().bits();
        let completed = tsr & tsr::EACH_RQCP;
        if completed == 0 {
            return None;
        }
        let mailbox = self.oldest(completed);
        let flags = tsr >> (mailbox * tsr::MAILBOX_BITS);
        let outcome = if flags & tsr::TXOK != 0 {
            Outcome::Sent
        } else if self.aborting[mailbox] {
            // Checked before the flags, which may come from an earlier attempt.
            Outcome::Aborted
        } else if flags & tsr::ALST != 0 {
            Outcome::ArbitrationLost
        } else {
            Outcome::Error
        };
        // Writing RQCP clears the mailbox's other flags, too.
        // SAFETY: one of the register's own flags.
        self.can.tsr().write(|w| unsafe { w.bits(tsr::RQCP << (mailbox * tsr::MAILBOX_BITS)) });
        Some((mailbox as u8, outcome))
    }

    fn abort(&mut self) {
        let tsr = self.can.tsr().read();
        let busy = [tsr.tme0().bit_is_clear(), tsr.tme1().bit_is_clear(), tsr.tme2().bit_is_clear()];
        for (aborting, busy) in self.aborting.iter_mut().zip(busy) {
            *aborting |= busy;
        }
        self.can.tsr().write(|w| w.abrq0().bit(busy[0]).abrq1().bit(busy[1]).abrq2().bit(busy[2]));
    }

    fn take_errors(&mut self) -> ErrorStatus {
        // In this order, an error that occurs in between raises the interrupt again.
        self.can.msr().write(|w| w.erri().set_bit());
        let esr = self.can.esr().read();
        let kind = match esr.lec().bits() {
            1 => Some(BusErrorKind::Stuff),
            2 => Some(BusErrorKind::Form),
            3 => Some(BusErrorKind::Acknowledgment),
            4 => Some(BusErrorKind::BitRecessive),
            5 => Some(BusErrorKind::BitDominant),
            6 => Some(BusErrorKind::Crc),
            _ => None,
        };
        if kind.is_some() {
            self.can.esr().write(|w| w.lec().set(LEC_SEEN));
        }
        let state = if esr.boff().bit() {
            ErrorState::BusOff
        } else if esr.epvf().bit() {
            ErrorState::Passive
        } else if esr.ewgf().bit() {
            ErrorState::Warning
        } else {
            ErrorState::Active
        };
        ErrorStatus { kind, state, tec: esr.tec().bits(), rec: esr.rec().bits() }
    }

    fn registers(&self) -> RegisterSet {
        RegisterSet {
            mcr: self.can.mcr().read().bits(),
            msr: self.can.msr().read().bits(),
            tsr: self.can.tsr().read().bits(),
            rf0r: self.can.rf0r().read().bits(),
            ier: self.can.ier().read().bits(),
            esr: self.can.esr().read().bits(),
            btr: self.can.btr().read().bits(),
        }
    }
}

#[inline]
fn received_id(rir: &rir::R) -> Id {
    let standard = u32::from(rir.stid().bits());
    if rir.ide().is_extended() {
        Id::extended_truncated(standard << 18 | rir.exid().bits())
    } else {
        Id::standard_truncated(standard)
    }
}
