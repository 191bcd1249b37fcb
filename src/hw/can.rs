//! The two bxCAN controllers (RM0090, "Controller area network"), each in two halves that share no register
//! that both write: [`CanTraffic`] for the tasks of priority 4, [`CanControl`] for commands.
//! [`CanFilters`] are the banks, which lie in CAN1's registers for both.
//!
//! The `bxcan` crate is not used: its `enable` waits for the bus, it cannot lock the receive FIFO (so an
//! overrun would overwrite the newest frame) and it hides which mailbox a confirmation belongs to.

use core::ops::Deref;
use core::sync::atomic::{AtomicU32, Ordering};

use cantap_firmware::bus::filters::{BANKS, Layout, Shape};
use cantap_firmware::bus::mailboxes::MAILBOXES;
use cantap_firmware::ports::{Control, ErrorStatus, FilterBanks, Outcome, Traffic};
use cantap_wire::message::{ChannelConfig, Mode, RegisterSet};
use cantap_wire::record::{BusErrorKind, ErrorState};
use cantap_wire::{CHANNELS, Frame, Id};
use stm32f4xx_hal::pac::can1::RegisterBlock;
use stm32f4xx_hal::pac::can1::rx::rir;
use stm32f4xx_hal::pac::{CAN1, CAN2};
use stm32f4xx_hal::rcc::{Enable, Rcc, Reset};

/// After a frame is released from the FIFO, the next is there some APB1 clocks later. So many reads, of at
/// least two such clocks each, are far more than that; the bound only keeps a defect from hanging an interrupt.
const RELEASE_READS: u32 = 32;
/// LEC's value that the hardware never writes: it shows whether there was an error since.
const LEC_SEEN: u8 = 7;

/// Both controllers' halves, and the filters.
pub struct Controllers {
    /// For the tasks of priority 4.
    pub traffic: [CanTraffic; CHANNELS],
    /// For commands.
    pub control: [CanControl; CHANNELS],
    /// For commands.
    pub filters: CanFilters,
    /// For the interrupts that stamp, and the tasks that they raise.
    pub bells: (Bells<0>, Bells<1>),
}

impl Controllers {
    /// Switches both controllers on; they are off the bus and let no frame pass.
    pub fn new(_: CAN1, _: CAN2, rcc: &mut Rcc, sent_at: &'static [AtomicU32; CHANNELS]) -> Self {
        CAN1::enable(rcc);
        CAN2::enable(rcc);
        CAN1::reset(rcc);
        CAN2::reset(rcc);
        let blocks = [Registers(CAN1::ptr()), Registers(CAN2::ptr())];
        let mut control = blocks.map(|can| CanControl { can, halt: Halt::None });
        // After a reset a controller sleeps.
        control.iter_mut().for_each(Control::stop);
        Self {
            traffic: [CanTraffic::new(blocks[0], &sent_at[0]), CanTraffic::new(blocks[1], &sent_at[1])],
            control,
            filters: CanFilters { can1: Registers(CAN1::ptr()) },
            bells: (Bells(()), Bells(())),
        }
    }
}

/// Bits of IER: transmit mailbox empty, FIFO 0 message pending (RM0090, CAN_IER).
const TMEIE: usize = 0;
const FMPIE0: usize = 1;

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

/// A controller's registers.
#[derive(Clone, Copy)]
struct Registers(*const RegisterBlock);

// SAFETY: the registers are there for the whole program, wherever it touches them from. What the halves that hold
// copies of the pointer write is disjoint, as their docs say.
unsafe impl Send for Registers {}

impl Deref for Registers {
    type Target = RegisterBlock;

    #[inline]
    fn deref(&self) -> &RegisterBlock {
        // SAFETY: the pointer is one of the PAC's, made from a peripheral that `Controllers::new` took.
        unsafe { &*self.0 }
    }
}

/// The switches of a controller's receive and transmit interrupts: `CAN` is 0 or 1. Each interrupt only stamps, silences itself and leaves
/// the rest to a task of lower priority, which switches it on again.
///
/// Both tasks and both interrupts share these. The switches are bits of one register, each changed through its bit-band alias (Cortex-M4
/// technical reference manual, "Bit-banding"), one at a time and untorn: an interrupt between reading and writing the whole register
/// would be undone. Commands write the register only while the controller is off the bus.
///
/// FIFO 0's overrun needs no interrupt: a FIFO that overran is full, and the frames in it interrupt.
pub struct Bells<const CAN: usize>(());

#[expect(clippy::unused_self, reason = "only whoever holds the bells may ring them")]
impl<const CAN: usize> Bells<CAN> {
    #[inline]
    fn registers() -> &'static RegisterBlock {
        let block = if CAN == 0 { CAN1::ptr() } else { CAN2::ptr() };
        // SAFETY: the registers are there for the whole program, and `Controllers::new`, which makes the only bells, took them.
        unsafe { &*block }
    }

    /// Silenced bells are read back, so that the line has fallen before the interrupt returns.
    #[inline]
    fn silence(bit: usize) {
        switch(Self::registers(), bit, false);
        Self::registers().ier().read();
    }

    /// Ends the receive interrupt though frames are waiting.
    #[inline]
    pub fn silence_receive(&self) {
        Self::silence(FMPIE0);
    }

    /// Interrupts again on a frame: at once if one is waiting.
    #[inline]
    pub fn open_receive(&self) {
        switch(Self::registers(), FMPIE0, true);
    }

    /// Ends the transmit interrupt though a mailbox has finished, until [`Traffic::await_finished`].
    #[inline]
    pub fn silence_transmit(&self) {
        Self::silence(TMEIE);
    }
}

/// Switches an interrupt of a controller through its bit's alias (see [`Bells`]).
#[inline]
fn switch(controller: &RegisterBlock, bit: usize, on: bool) {
    const PERIPHERALS: usize = 0x4000_0000;
    const ALIAS: usize = 0x4200_0000;
    let register = controller.ier().as_ptr() as usize;
    let alias = (ALIAS + (register - PERIPHERALS) * 32 + bit * 4) as *mut u32;
    // SAFETY: the controllers lie in the first megabyte of the peripherals, so the word is IER's bit.
    unsafe { alias.write_volatile(u32::from(on)) };
}

/// A controller's traffic half. It alone writes TSR, the mailboxes, RF0R, MSR and ESR.
pub struct CanTraffic {
    can: Registers,
    /// Per mailbox: the number of the request in it.
    requests: [u32; MAILBOXES],
    next_request: u32,
    /// Per mailbox: TIxR as it was written, so that the request need not read it.
    identifiers: [u32; MAILBOXES],
    /// Per mailbox: whether it was asked to be given up.
    aborting: [bool; MAILBOXES],
    /// When the transmit interrupt last stamped. It holds while that is silent.
    sent_at: &'static AtomicU32,
}

impl CanTraffic {
    const fn new(can: Registers, sent_at: &'static AtomicU32) -> Self {
        Self {
            can,
            requests: [0; MAILBOXES],
            next_request: 0,
            identifiers: [0; MAILBOXES],
            aborting: [false; MAILBOXES],
            sent_at,
        }
    }

    /// Of mailboxes that have completed, a flag for each, the one with the oldest request.
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
    #[inline]
    fn pending(&self) -> u8 {
        self.can.rf0r().read().fmp().bits()
    }

    #[inline]
    fn receive(&mut self) -> Option<Frame> {
        let fifo = self.can.rf0r();
        // While a frame is being released, the mailbox still shows it.
        let mut status = fifo.read();
        let mut reads = RELEASE_READS;
        while status.rfom().bit() && reads > 0 {
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
        fifo.write(|w| w.rfom().release());

        let data = (u64::from(high) << 32 | u64::from(low)).to_le_bytes();
        Some(Frame::from_bus(received_id(&rir), rir.rtr().is_remote(), dlc, data))
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
        // A mailbox whose outcome nobody has taken yet is empty, but not free.
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
        // What is behind the data is not sent, and a write takes as long as a dozen instructions.
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
        // The interrupt silences itself when it has stamped. Without one that has finished, the stamp is an old one.
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
            // Before the flags: they may be of an attempt before.
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
        // In this order an error that comes in between raises the interrupt again.
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

/// How far [`Control::halt`] has come.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Halt {
    None,
    /// The reset is written; the controller acknowledges it by sleeping.
    Resetting,
    /// It no longer sleeps, and is asked for initialisation mode.
    Entering,
}

/// A controller's control half. It alone writes MCR and BTR, and IER while the controller is off the bus.
pub struct CanControl {
    can: Registers,
    halt: Halt,
}

impl CanControl {
    /// Sleep is left and initialisation mode entered by one write: without INRQ a controller would first wait for eleven recessive
    /// bits, which a stuck bus does not have (Zephyr, issue 71142).
    fn ask_for_initialisation(&self) {
        self.can.mcr().modify(|_, w| w.sleep().clear_bit().inrq().set_bit());
    }
}

impl Control for CanControl {
    fn stop(&mut self) {
        self.halt = Halt::None;
        self.ask_for_initialisation();
    }

    /// The controller's own reset, once: another, or any write of MCR before SLAK has acknowledged the first, would begin it anew or
    /// be lost. As Linux's `bxcan_chip_softreset`, but without waiting.
    fn halt(&mut self) {
        match self.halt {
            Halt::None => {
                self.can.mcr().modify(|_, w| w.reset().set_bit());
                self.halt = Halt::Resetting;
            }
            Halt::Resetting if self.can.msr().read().slak().bit() => {
                self.ask_for_initialisation();
                self.halt = Halt::Entering;
            }
            Halt::Resetting | Halt::Entering => {}
        }
    }

    fn is_stopped(&self) -> bool {
        self.can.msr().read().inak().bit()
    }

    fn start(&mut self, config: &ChannelConfig) {
        let timing = &config.timing;
        let silent = matches!(config.mode, Mode::ListenOnly | Mode::SilentLoopback);
        let loopback = matches!(config.mode, Mode::Loopback | Mode::SilentLoopback);
        self.can.btr().write(|w| {
            // SAFETY: the timing is valid, so each value less one fits its field.
            unsafe {
                w.brp().bits(timing.prescaler - 1);
                w.ts1().bits(timing.segment1 - 1);
                w.ts2().bits(timing.segment2 - 1);
                w.sjw().bits(timing.jump_width - 1);
            }
            w.silm().bit(silent).lbkm().bit(loopback)
        });
        self.can.mcr().modify(|_, w| {
            // The stamps of time-triggered mode are not to be used (ES0206 2.13.1, for the F42x; the F405 is taken for
            // alike).
            w.ttcm().clear_bit();
            w.abom().bit(!config.manual_recovery);
            w.awum().clear_bit();
            w.nart().bit(config.one_shot);
            // A full FIFO keeps what it has.
            w.rflm().set_bit();
            // Mailboxes leave in the order of their requests.
            w.txfp().set_bit()
        });
        self.can.ier().modify(|_, w| {
            w.fmpie0().set_bit().tmeie().set_bit();
            w.errie().set_bit().lecie().set_bit();
            w.ewgie().set_bit().epvie().set_bit().bofie().set_bit()
        });
        self.resume();
    }

    fn resume(&mut self) {
        self.can.mcr().modify(|_, w| w.inrq().clear_bit());
    }
}

/// The acceptance filters of both controllers. They alone write FMR, FM1R, FS1R, FFA1R, FA1R and the banks.
pub struct CanFilters {
    can1: Registers,
}

impl FilterBanks for CanFilters {
    fn write(&mut self, layout: &Layout) -> bool {
        let can = &self.can1;
        let bits = |is: fn(Shape) -> bool| {
            let bit = |(number, bank): (usize, &Option<_>)| {
                u32::from(bank.is_some_and(|bank: cantap_firmware::bus::filters::Bank| is(bank.shape)))
                    << number
            };
            layout.banks.iter().enumerate().map(bit).sum::<u32>()
        };
        let lists = bits(|shape| matches!(shape, Shape::List32 | Shape::List16));
        let wide = bits(|shape| matches!(shape, Shape::List32 | Shape::Mask32));
        let active = bits(|_| true);

        // In initialisation mode neither controller receives, so it is entered only if it must be.
        // It is in that mode after a reset, too.
        let reshaped = can.fmr().read().finit().bit()
            || can.fmr().read().can2sb().bits() != layout.split
            || can.fm1r().read().bits() != lists
            || can.fs1r().read().bits() != wide
            || can.fa1r().read().bits() != active;
        if reshaped {
            can.fmr().modify(|_, w| {
                // SAFETY: a layout's split is at most 28, and the field has six bits.
                unsafe { w.can2sb().bits(layout.split) };
                w.finit().set_bit()
            });
            // SAFETY: one bit for each of the 28 banks, no others.
            can.fm1r().write(|w| unsafe { w.bits(lists) });
            // SAFETY: as above.
            can.fs1r().write(|w| unsafe { w.bits(wide) });
            // SAFETY: as above; all banks lead to FIFO 0.
            can.ffa1r().write(|w| unsafe { w.bits(0) });
        }
        let mut differed = reshaped;
        for (number, bank) in layout.banks.iter().enumerate().take(BANKS) {
            let Some(bank) = bank else { continue };
            let registers = can.fb(number);
            if registers.fr1().read().bits() == bank.first && registers.fr2().read().bits() == bank.second {
                continue;
            }
            differed = true;
            // A bank can only be written while it is off.
            // SAFETY: one bit for each of the 28 banks, no others.
            can.fa1r().modify(|r, w| unsafe { w.bits(r.bits() & !(1 << number)) });
            // SAFETY: every value is a filter.
            registers.fr1().write(|w| unsafe { w.bits(bank.first) });
            // SAFETY: every value is a filter.
            registers.fr2().write(|w| unsafe { w.bits(bank.second) });
            // SAFETY: one bit for each of the 28 banks, no others.
            can.fa1r().modify(|r, w| unsafe { w.bits(r.bits() | 1 << number) });
        }
        if reshaped {
            // SAFETY: one bit for each of the 28 banks, no others.
            can.fa1r().write(|w| unsafe { w.bits(active) });
            can.fmr().modify(|_, w| w.finit().clear_bit());
        }
        differed
    }
}
