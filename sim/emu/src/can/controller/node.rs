//! A controller as a node on the bus: what it sends, receives and counts.

use cantap_can::BusErrorKind;
use cantap_can::Frame;

use super::{BitTiming, Controller, Mode, RECOVERY_SEQUENCES, btr, ier, mcr, msr};
use crate::bus::bits::{FrameBits, INTERMISSION};
use crate::can::fault::ErrorCounters;
use crate::can::fifo::Fifo;
use crate::can::filter::Match;
use crate::can::mailbox::Attempt;

impl Controller {
    /// Whether a frame of its own is on the bus.
    pub fn is_sending(&self) -> bool {
        self.sending.is_some()
    }

    /// Its mode.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Sets the core cycles per controller clock, which follow from the clock tree.
    pub fn set_cycles_per_clock(&mut self, cycles: u64) {
        self.cycles_per_clock = cycles;
    }

    /// The bit timing in BTR.
    pub fn timing(&self) -> BitTiming {
        let field = |at: u32, bits: u32| u64::from(self.btr >> at & ((1 << bits) - 1)) + 1;
        BitTiming {
            quantum: field(0, 10) * self.cycles_per_clock,
            segment1: field(16, 4),
            segment2: field(20, 3),
            jump: field(24, 2),
        }
    }

    /// Dominant bits that it has put on its transmit pin since power-on: frames, ACK slots, error flags.
    pub fn dominant_bits(&self) -> u64 {
        self.dominant_bits
    }

    /// Frames waiting in a receive FIFO (0 or 1): 0 to 3.
    pub fn fifo_fill(&self, fifo: usize) -> usize {
        self.fifos[fifo].fill()
    }

    /// Frames that both receive FIFOs lost to overruns since the controller's reset.
    pub fn overruns(&self) -> u64 {
        self.fifos.iter().map(Fifo::lost).sum()
    }

    /// The error counters.
    pub fn counters(&self) -> ErrorCounters {
        self.counters
    }

    /// Whether it is in silent mode: never dominant, sends nothing.
    pub fn silent(&self) -> bool {
        self.btr & btr::SILM != 0
    }

    pub(super) fn loops_back(&self) -> bool {
        self.btr & btr::LBKM != 0
    }

    /// Whether it takes part in the bus, if only as a listener.
    pub fn listens(&self) -> bool {
        self.mode == Mode::Normal && !self.loops_back()
    }

    /// Whether it acknowledges, and flags errors with dominant bits.
    pub(crate) fn answers(&self) -> bool {
        self.listens() && !self.silent()
    }

    /// The frame it wants to send now.
    pub(crate) fn next_frame(&self) -> Option<Frame> {
        if !self.answers() || self.init_pending || self.init_at.is_some() {
            return None;
        }
        Some(self.mailboxes.next(self.mcr & mcr::TXFP != 0)?.1)
    }

    /// The bus is occupied: by its own frame if `own`.
    pub(crate) fn start_of_frame(&mut self, own: bool, now: u64) {
        match self.mode {
            Mode::Normal if own => {
                if let Some((n, _)) = self.mailboxes.next(self.mcr & mcr::TXFP != 0) {
                    self.mailboxes.start(n);
                    self.sending = Some(n);
                }
            }
            Mode::Normal => self.receiving = true,
            Mode::Sleep => {
                self.msr_flags |= msr::WKUI;
                if self.mcr & mcr::AWUM != 0 {
                    self.mcr &= !mcr::SLEEP;
                    self.mode = Mode::Synchronising { since: now };
                }
            }
            _ => {}
        }
    }

    /// It lost arbitration and continues as a receiver.
    pub(crate) fn lost_arbitration(&mut self) {
        self.end_attempt(Attempt::LostArbitration);
        self.receiving = true;
    }

    /// Its frame was sent.
    pub(crate) fn sent(&mut self) {
        self.counters.sent();
        self.last_error = 0;
        self.end_attempt(Attempt::Sent);
    }

    fn end_attempt(&mut self, attempt: Attempt) {
        if let Some(n) = self.sending.take() {
            self.mailboxes.finish(n, attempt, self.mcr & mcr::NART != 0);
        }
    }

    /// A frame was received without error; `found` says whether the filters pass it, and where to.
    pub(in crate::can) fn received(&mut self, frame: &Frame, found: Option<Match>) {
        self.counters.received();
        self.last_error = 0;
        if let Some(Match { fifo, index }) = found {
            self.fifos[fifo].put(*frame, index, self.mcr & mcr::RFLM != 0);
        }
    }

    /// Its own frame failed.
    pub(crate) fn transmit_error(&mut self, kind: BusErrorKind, flag_seen: bool) {
        self.note(kind, |counters| counters.transmit_error(kind, flag_seen));
        self.end_attempt(Attempt::Failed);
    }

    /// A frame it received failed; `first` as in [`ErrorCounters::receive_error`].
    pub(crate) fn receive_error(&mut self, kind: BusErrorKind, first: bool) {
        self.note(kind, |counters| counters.receive_error(first));
    }

    fn note(&mut self, kind: BusErrorKind, count: impl FnOnce(&mut ErrorCounters)) {
        let before = self.counters;
        count(&mut self.counters);
        let after = self.counters;
        self.last_error = match kind {
            BusErrorKind::Stuff => 1,
            BusErrorKind::Form => 2,
            BusErrorKind::Acknowledgment => 3,
            BusErrorKind::BitRecessive => 4,
            BusErrorKind::BitDominant => 5,
            BusErrorKind::Crc => 6,
        };
        let news = [
            (ier::LECIE, true),
            (ier::EWGIE, after.warning() && !before.warning()),
            (ier::EPVIE, after.passive() && !before.passive()),
            (ier::BOFIE, after.bus_off() && !before.bus_off()),
        ];
        if news.iter().any(|(enable, happened)| *happened && self.ier & enable != 0) {
            self.msr_flags |= msr::ERRI;
        }
        if after.bus_off() {
            let automatic = self.mcr & mcr::ABOM != 0;
            self.mode = Mode::BusOff { left: automatic.then_some(RECOVERY_SEQUENCES), since: 0 };
        }
    }

    /// It put this many dominant bits on the bus.
    pub(crate) fn drove(&mut self, dominant_bits: u64) {
        self.dominant_bits += dominant_bits;
    }

    /// It puts another number of dominant bits on the bus in the frame under way than was counted.
    pub(crate) fn drove_instead(&mut self, counted: u64, driven: u64) {
        self.dominant_bits = self.dominant_bits - counted + driven;
    }

    /// The bus is held dominant: the frame under way never ends.
    pub(crate) fn bus_stuck(&mut self) {
        self.receiving |= self.listens();
    }

    /// The frame or error frame is over.
    pub(crate) fn bus_free(&mut self) {
        self.receiving = false;
        if self.init_pending {
            self.init_pending = false;
            self.enter_initialisation();
        } else if self.mode == Mode::Normal && self.mcr & mcr::SLEEP != 0 {
            self.fall_asleep();
        }
    }

    /// Eleven recessive bits have passed since its request.
    pub(crate) fn synchronised(&mut self) {
        if matches!(self.mode, Mode::Synchronising { .. }) {
            self.mode = Mode::Normal;
        }
    }

    /// `sequences` of eleven recessive bits have passed in bus-off.
    pub(crate) fn recover(&mut self, sequences: u32) {
        if let Mode::BusOff { left: Some(left), .. } = &mut self.mode {
            *left = left.saturating_sub(sequences);
            if *left == 0 {
                self.mode = Mode::Normal;
                self.counters = ErrorCounters::default();
            }
        }
    }

    /// When the loop-back transmission under way is done, or the next may begin.
    pub(in crate::can) fn loopback_event(&self) -> Option<u64> {
        if self.mode != Mode::Normal || !self.loops_back() {
            return None;
        }
        self.loopback_end.or_else(|| {
            self.mailboxes.next(self.mcr & mcr::TXFP != 0)?;
            Some(self.loopback_from)
        })
    }

    /// Sends to itself until `now`; returns a frame that came back.
    pub(in crate::can) fn advance_loopback(&mut self, now: u64) -> Option<Frame> {
        while self.loopback_event().is_some_and(|due| due <= now) {
            let by_request = self.mcr & mcr::TXFP != 0;
            if let Some(end) = self.loopback_end.take() {
                self.loopback_from = end + INTERMISSION as u64 * self.timing().bit();
                let frame = self.sending.map(|n| self.mailboxes.frame_in(n));
                self.sent();
                return frame;
            }
            let (n, frame) = self.mailboxes.next(by_request)?;
            let bits = FrameBits::new(&frame);
            self.mailboxes.start(n);
            self.sending = Some(n);
            self.loopback_end = Some(self.loopback_from + bits.len() as u64 * self.timing().bit());
            if !self.silent() {
                self.dominant_bits += bits.dominant_in(bits.len());
            }
        }
        None
    }
}
