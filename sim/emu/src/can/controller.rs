//! One bxCAN controller as the firmware sees it: its modes, registers and interrupts.

mod node;

use super::fault::ErrorCounters;
use super::fifo::Fifo;
use super::mailbox::Mailboxes;
use crate::hostile::{CanFaults, Dice, ReleaseInInit};

mod mcr {
    pub const INRQ: u32 = 1;
    pub const SLEEP: u32 = 1 << 1;
    pub const TXFP: u32 = 1 << 2;
    pub const RFLM: u32 = 1 << 3;
    pub const NART: u32 = 1 << 4;
    pub const AWUM: u32 = 1 << 5;
    pub const ABOM: u32 = 1 << 6;
    pub const RESET: u32 = 1 << 15;
    pub const DBF: u32 = 1 << 16;
    pub const WRITABLE: u32 = DBF | 0xFF;
}

mod msr {
    pub const INAK: u32 = 1;
    pub const SLAK: u32 = 1 << 1;
    pub const ERRI: u32 = 1 << 2;
    pub const WKUI: u32 = 1 << 3;
    pub const SLAKI: u32 = 1 << 4;
    pub const TXM: u32 = 1 << 8;
    pub const RXM: u32 = 1 << 9;
    /// The receive pin: recessive.
    pub const RX: u32 = 1 << 11 | 1 << 10;
}

mod rfr {
    pub const RELEASE: u32 = 1 << 5;
}

mod ier {
    pub const TMEIE: u32 = 1;
    /// FMPIE0, FFIE0, FOVIE0; those of FIFO 1 are three bits higher.
    pub const FIFO0: u32 = 1;
    pub const EWGIE: u32 = 1 << 8;
    pub const EPVIE: u32 = 1 << 9;
    pub const BOFIE: u32 = 1 << 10;
    pub const LECIE: u32 = 1 << 11;
    pub const ERRIE: u32 = 1 << 15;
    pub const WKUIE: u32 = 1 << 16;
    pub const SLKIE: u32 = 1 << 17;
    pub const WRITABLE: u32 = 0x3_8F7F;
}

mod btr {
    pub const LBKM: u32 = 1 << 30;
    pub const SILM: u32 = 1 << 31;
    pub const WRITABLE: u32 = 0xC37F_03FF;
    /// One clock per quantum, 4 + 3 quanta of segments, jump width 2.
    pub const RESET: u32 = 0x0123_0000;
}

/// Sequences of eleven recessive bits that a controller waits for in bus-off.
const RECOVERY_SEQUENCES: u32 = 128;

/// Clocks of the controller from a master reset (MCR.RESET) to its acknowledgement by SLAK: 20 µs at 36 MHz. The manual gives no time; Linux's
/// driver (`drivers/net/can/bxcan.c`) polls every 10 ms. This is long enough to expose a firmware that does not wait.
const RESET_CLOCKS: u64 = 720;

/// What a master reset clears. RM0090 Rev 21 §32.9.2 (CAN_MCR, RESET) only says that afterwards the receive FIFOs are empty and
/// MCR has its reset value; Linux's driver sets everything up again. A firmware must live with both.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MasterReset {
    /// Only what the manual says: frames in the transmit mailboxes are sent once the controller is back on a bus.
    Least,
    /// All registers; CAN1's reset also clears the filter banks, which are CAN2's too.
    #[default]
    Most,
}

/// The controller's mode, as far as its handshakes have got.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// A master reset is under way. Writes to MCR are lost.
    Resetting {
        /// It ends, in sleep mode, at this cycle.
        until: u64,
    },
    /// Low power; the state after reset.
    Sleep,
    /// Set-up; nothing is sent or received.
    Initialisation,
    /// Asked to take part; waiting since this cycle for eleven recessive bits.
    Synchronising {
        /// When it was asked.
        since: u64,
    },
    /// Takes part.
    Normal,
    /// Off the bus, waiting for this many sequences of eleven recessive bits; `None` if software
    /// must start the recovery.
    BusOff {
        /// Sequences still to come.
        left: Option<u32>,
        /// They count from this cycle on.
        since: u64,
    },
}

/// A controller's bit timing in core cycles and quanta.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BitTiming {
    /// Core cycles of a quantum.
    pub quantum: u64,
    /// Quanta of the propagation and first phase segment.
    pub segment1: u64,
    /// Quanta of the second phase segment.
    pub segment2: u64,
    /// Quanta by which a resynchronisation may move a bit.
    pub jump: u64,
}

impl BitTiming {
    /// Core cycles of a bit.
    pub fn bit(&self) -> u64 {
        self.quantum * (1 + self.segment1 + self.segment2)
    }
}

/// One controller.
#[derive(Clone, Debug)]
pub struct Controller {
    mode: Mode,
    /// Initialisation was requested while a frame is under way.
    init_pending: bool,
    /// The cycle before which initialisation mode is not entered, for the request under way; 0 if at once.
    init_due: u64,
    /// When initialisation mode is entered, on a request that nothing but this delays.
    init_at: Option<u64>,
    mcr: u32,
    msr_flags: u32,
    ier: u32,
    btr: u32,
    last_error: u32,
    counters: ErrorCounters,
    mailboxes: Mailboxes,
    fifos: [Fifo; 2],
    /// The mailbox on the bus.
    sending: Option<usize>,
    receiving: bool,
    /// In loop-back mode: when the mailbox under way is done.
    loopback_end: Option<u64>,
    loopback_from: u64,
    cycles_per_clock: u64,
    dominant_bits: u64,
    /// What a master reset clears.
    pub(super) master_reset: MasterReset,
    /// What may come late.
    pub(super) faults: CanFaults,
    pub(super) dice: Dice,
    /// Whether anything was ever to come late.
    pub(super) is_hostile: bool,
}

impl Default for Controller {
    fn default() -> Self {
        Self {
            mode: Mode::Sleep,
            init_pending: false,
            init_due: 0,
            init_at: None,
            mcr: mcr::SLEEP | mcr::DBF,
            msr_flags: 0,
            ier: 0,
            btr: btr::RESET,
            last_error: 0,
            counters: ErrorCounters::default(),
            mailboxes: Mailboxes::default(),
            fifos: Default::default(),
            sending: None,
            receiving: false,
            loopback_end: None,
            loopback_from: 0,
            cycles_per_clock: 1,
            dominant_bits: 0,
            master_reset: MasterReset::default(),
            faults: CanFaults::default(),
            dice: Dice::default(),
            is_hostile: false,
        }
    }
}

impl Controller {
    /// Reads a register of this controller; `None` where there is none.
    pub(super) fn read(&self, offset: u32) -> Option<u32> {
        Some(match offset {
            0x00 => self.mcr,
            0x04 => self.msr(),
            0x08 => self.mailboxes.status(self.mcr & mcr::TXFP != 0),
            0x0C => self.fifos[0].status(),
            0x10 => self.fifos[1].status(),
            0x14 => self.ier,
            0x18 => self.esr(),
            0x1C => self.btr,
            0x180..0x1B0 => {
                let (n, register) = place(offset - 0x180);
                self.mailboxes.read(n, register)
            }
            0x1B0..0x1D0 => {
                let (n, register) = place(offset - 0x1B0);
                self.fifos[n].mailbox(register as u32)
            }
            _ => return None,
        })
    }

    /// Writes a register; `None` where there is none, or if the hardware would not accept it.
    pub(super) fn write(&mut self, offset: u32, value: u32, now: u64) -> Option<()> {
        match offset {
            0x00 => self.write_mcr(value, now),
            0x04 => self.msr_flags &= !(value & (msr::ERRI | msr::WKUI | msr::SLAKI)),
            0x08 => self.mailboxes.control(value),
            0x0C => self.control_fifo(0, value, now),
            0x10 => self.control_fifo(1, value, now),
            0x14 => self.ier = value & ier::WRITABLE,
            0x18 => self.last_error = value >> 4 & 7,
            // The bit timing can only be set in initialisation mode.
            0x1C if self.mode == Mode::Initialisation => self.btr = value & btr::WRITABLE,
            0x180..0x1B0 => {
                let (n, register) = place(offset - 0x180);
                self.loopback_from = self.loopback_from.max(now);
                self.mailboxes.write(n, register, value)?;
            }
            _ => return None,
        }
        Some(())
    }

    /// A write to RFxR.
    fn control_fifo(&mut self, fifo: usize, value: u32, now: u64) {
        let Self { faults, dice, mode, .. } = self;
        let in_init =
            if *mode == Mode::Initialisation { faults.release_in_init } else { ReleaseInInit::Works };
        match in_init {
            ReleaseInInit::Works => self.fifos[fifo].control(value, || dice.due(faults.release, now)),
            ReleaseInInit::Waits => self.fifos[fifo].control(value, || u64::MAX),
            ReleaseInInit::Ignored => self.fifos[fifo].control(value & !rfr::RELEASE, || 0),
        }
    }

    fn write_mcr(&mut self, value: u32, now: u64) {
        if value & mcr::RESET != 0 {
            *self = self.after_master_reset(now);
            return;
        }
        if let Mode::Resetting { .. } = self.mode {
            return;
        }
        self.mcr = value & mcr::WRITABLE;
        let (init, sleep) = (value & mcr::INRQ != 0, value & mcr::SLEEP != 0);
        if !init {
            self.init_at = None;
        }
        let busy = self.sending.is_some() || self.receiving;
        match self.mode {
            Mode::Initialisation if !init && sleep => self.fall_asleep(),
            Mode::Initialisation if !init => self.leave_initialisation(now),
            Mode::Initialisation => {}
            _ if init => {
                if !self.init_pending && self.init_at.is_none() {
                    self.init_due = self.dice.due(self.faults.initialisation, now);
                }
                // A frame under way is completed first.
                self.init_pending |= busy;
                if !busy {
                    self.enter_initialisation();
                }
            }
            Mode::Sleep if !sleep => self.mode = Mode::Synchronising { since: now },
            Mode::Normal | Mode::Synchronising { .. } if sleep && !busy => self.fall_asleep(),
            _ => {}
        }
    }

    /// Nothing on the bus is in the way of initialisation mode any more.
    fn enter_initialisation(&mut self) {
        (self.mode, self.init_at) = match self.init_due {
            0 => (Mode::Initialisation, None),
            due => (self.mode, Some(due)),
        };
    }

    fn fall_asleep(&mut self) {
        self.mode = Mode::Sleep;
        if self.ier & ier::SLKIE != 0 {
            self.msr_flags |= msr::SLAKI;
        }
    }

    fn leave_initialisation(&mut self, now: u64) {
        self.fifos.iter_mut().for_each(Fifo::hasten);
        self.mode = if self.counters.bus_off() {
            Mode::BusOff { left: Some(RECOVERY_SEQUENCES), since: now }
        } else {
            Mode::Synchronising { since: now }
        };
        if self.loops_back() {
            // Nothing comes in from the pin, so it always sees a recessive bus.
            self.mode = Mode::Normal;
            self.loopback_from = now + 11 * self.timing().bit();
        }
    }

    fn msr(&self) -> u32 {
        let mode = match self.mode {
            Mode::Sleep => msr::SLAK,
            // The acknowledgement stays until the controller has synchronised. SLEEP, still set, does not withhold it: candleLight's driver
            // (src/can/bxcan.c) requests initialisation right after a reset, and boards run with it.
            Mode::Initialisation | Mode::Synchronising { .. } => msr::INAK,
            _ => 0,
        };
        mode | self.msr_flags
            | msr::RX
            | if self.sending.is_some() { msr::TXM } else { 0 }
            | if self.receiving { msr::RXM } else { 0 }
    }

    fn esr(&self) -> u32 {
        u32::from(self.counters.warning())
            | u32::from(self.counters.passive()) << 1
            | u32::from(self.counters.bus_off()) << 2
            | self.last_error << 4
            | u32::from(self.counters.transmit()) << 16
            | u32::from(self.counters.receive()) << 24
    }

    /// The interrupt lines: transmit, FIFO 0, FIFO 1, status change and error.
    pub(super) fn irqs(&self) -> [bool; 4] {
        let on = |bits: u32| self.ier & bits != 0;
        let fifo = |n: usize| {
            let at = ier::FIFO0 << (1 + 3 * n);
            self.fifos[n].irq(on(at), on(at << 1), on(at << 2))
        };
        let flag = |bit: u32| self.msr_flags & bit != 0;
        let change = on(ier::ERRIE) && flag(msr::ERRI)
            || on(ier::WKUIE) && flag(msr::WKUI)
            || on(ier::SLKIE) && flag(msr::SLAKI);
        [on(ier::TMEIE) && self.mailboxes.irq(), fifo(0), fifo(1), change]
    }

    /// Ends what takes time and has had it: a master reset, and whatever comes late.
    pub(super) fn advance_flags(&mut self, now: u64) {
        if let Mode::Resetting { until } = self.mode
            && self.dice.has_come(until, now)
        {
            self.mode = Mode::Sleep;
        }
        if !self.is_hostile {
            return;
        }
        let Self { dice, fifos, .. } = self;
        for fifo in fifos {
            fifo.advance(|at| dice.has_come(at, now));
        }
        if self.init_at.is_some_and(|at| self.dice.has_come(at, now)) {
            // Frames are completed, as for a request that has just been made.
            self.init_due = 0;
            self.init_at = None;
            self.init_pending = self.sending.is_some() || self.receiving;
            if !self.init_pending {
                self.enter_initialisation();
            }
        }
    }

    /// When the next of them has had its time, if that is known and no access will find out.
    pub(super) fn next_flag(&self) -> Option<u64> {
        if !self.is_hostile {
            return None;
        }
        let late = self.fifos.iter().filter_map(Fifo::next_event).chain(self.init_at);
        late.filter(|at| *at != u64::MAX).min()
    }

    /// A controller whose master reset begins.
    fn after_master_reset(&self, now: u64) -> Self {
        let mut after = self.after_reset();
        let least = now + RESET_CLOCKS * self.cycles_per_clock;
        after.mode = Mode::Resetting { until: after.dice.due(self.faults.master_reset, least).max(least) };
        if self.master_reset == MasterReset::Least {
            (after.ier, after.btr) = (self.ier, self.btr);
            after.mailboxes = self.mailboxes.clone();
            after.mailboxes.cut_off();
        }
        after
    }

    /// A controller in its reset state; everything that is not a register is kept.
    pub(super) fn after_reset(&self) -> Self {
        Self {
            cycles_per_clock: self.cycles_per_clock,
            dominant_bits: self.dominant_bits,
            master_reset: self.master_reset,
            faults: self.faults,
            dice: self.dice.clone(),
            is_hostile: self.is_hostile,
            ..Self::default()
        }
    }
}

/// The mailbox, and which of its four registers, that an offset names.
fn place(offset: u32) -> (usize, usize) {
    ((offset / 0x10) as usize, (offset / 4 % 4) as usize)
}
