//! The controller while it is late or wrong ([`super::late`]).

use super::endpoint::{Due, Endpoint};
use super::registers::{FIFOS, dctl, device, epctl, gint, global, grstctl, gusbcfg, pktsts};
use super::{ENDPOINTS, Otg};
use crate::Clock;
use crate::hostile::{Dice, Hostile, UsbFaults};

impl Otg {
    /// Makes the controller as `hostile` has it.
    pub fn set_hostile(&mut self, hostile: &Hostile, clock: Clock) {
        self.late.faults = hostile.usb;
        self.late.is_hostile = true;
        self.late.dice = Dice::new(hostile.seed, 0, clock);
    }

    /// Ends that: see [`Dice::calm`].
    pub fn calm(&mut self) {
        self.late.dice.calm();
        self.late.faults = UsbFaults::default();
        self.settle(self.late.now);
        self.end_setup_stage(true);
    }

    /// The controller has lost its clock: it answers nothing until a reset of the chip.
    pub fn die(&mut self) {
        self.late.is_dead = true;
    }

    /// Time has come to `now`.
    pub fn settle(&mut self, now: u64) {
        self.late.now = now;
        if !self.late.is_hostile {
            return;
        }
        if self.late.reset_at.is_some_and(|at| self.late.has_come(at)) {
            self.end_core_reset();
        }
        if let Some((at, number)) = self.late.flush
            && self.late.has_come(at)
        {
            self.late.flush = None;
            self.flush(number);
        }
        let Self { late, ins, outs, .. } = self;
        let late_ones = ins.iter_mut().chain(outs).filter(|one| one.nak_at.or(one.disabled_at).is_some());
        let mut changed = false;
        for endpoint in late_ones {
            endpoint.advance(|at| late.has_come(at));
            changed = true;
        }
        if changed {
            self.update();
        }
    }

    /// GRSTCTL.
    pub(super) fn grstctl(&self) -> u32 {
        let late = &self.late;
        let idle = late.reset_at.is_none() && late.has_come(late.idle_at);
        (if idle { grstctl::AHBIDL } else { 0 })
            | late.reset_at.map_or(0, |_| grstctl::CSRST)
            | late.flush.map_or(0, |(_, number)| grstctl::TXFFLSH | number << grstctl::TXFNUM_SHIFT)
    }

    pub(super) fn begin_core_reset(&mut self) {
        match self.late.dice.due(self.late.faults.core_reset, self.late.now) {
            0 => self.end_core_reset(),
            due => self.late.reset_at = Some(due),
        }
    }

    fn end_core_reset(&mut self) {
        self.core_soft_reset();
        let late = &mut self.late;
        late.idle_at = late.dice.due(late.faults.core_reset, late.now);
        (late.reset_at, late.flush, late.setup_is_open) = (None, None, false);
    }

    pub(super) fn begin_flush(&mut self, number: u32) {
        match self.late.dice.due(self.late.faults.flush, self.late.now) {
            0 => self.flush(number),
            due => self.late.flush = Some((due, number)),
        }
    }

    /// Whether a write is lost: the core is being reset, or is not in device mode yet.
    pub(super) fn loses_write(&mut self, offset: u32, value: u32) -> bool {
        let forces = |value: u32| value & gusbcfg::FDMOD != 0;
        let forced = self.plain.get(&global::GUSBCFG).copied().is_some_and(forces);
        if offset == global::GUSBCFG && forces(value) && !forced {
            self.late.device_mode_at = self.late.dice.due(self.late.faults.device_mode, self.late.now);
        }
        let of_device = (device::DCFG..device::PCGCCTL).contains(&offset);
        self.late.reset_at.is_some() && offset != global::GRSTCTL && offset < FIFOS
            || of_device && self.mode_flag() != 0
    }

    /// CMOD.
    pub(super) fn mode_flag(&self) -> u32 {
        if self.late.has_come(self.late.device_mode_at) { 0 } else { gint::CMOD }
    }

    /// What DAINT shows beyond the unmasked flags.
    pub(super) fn unmasked_flags(&self) -> u32 {
        if !self.late.faults.daint_shows_all {
            return 0;
        }
        let shown = |number: usize| {
            let input = self.ins[number].interrupt | self.txfe(number);
            u32::from(input != 0) << number | u32::from(self.outs[number].interrupt != 0) << (16 + number)
        };
        (0..ENDPOINTS).map(shown).sum()
    }

    /// What a write to an endpoint's register comes to, and when.
    pub(super) fn as_it_takes(&mut self, input: bool, register: u32, value: u32) -> (u32, Due) {
        if register != device::EPCTL {
            return (value, Due::default());
        }
        let ignored = !input && self.late.faults.out_needs_global_nak && self.dctl & dctl::GONSTS == 0;
        let value = if ignored { value & !epctl::EPDIS } else { value };
        (value, self.late.due(value))
    }

    /// What a write to DCTL comes to: a global OUT NAK may take effect only when its pattern is taken from the receive FIFO.
    pub(super) fn without_global_out_nak(&mut self, value: u32) -> u32 {
        if !self.late.faults.out_needs_global_nak || value & dctl::SGONAK == 0 {
            return value;
        }
        self.rx.push(0, pktsts::GLOBAL_OUT_NAK, false, &[]);
        value & !dctl::SGONAK
    }

    /// The setup stage ends: at once, or when the next token comes.
    pub(super) fn begin_setup_stage(&mut self) {
        self.late.setup_is_open = true;
        self.end_setup_stage(false);
    }

    /// A token for endpoint 0 came, or something else that a setup stage waits for to end. Returns whether one ended by a token.
    pub(super) fn end_setup_stage(&mut self, by_token: bool) -> bool {
        if !self.late.setup_stage_ends(by_token, self.outs[0].interrupt) {
            return false;
        }
        self.rx.push(0, pktsts::SETUP_COMPLETE, false, &[]);
        self.update();
        by_token
    }

    /// An impossible status may stand before a packet.
    pub(super) fn precede_by_bogus(&mut self) {
        let Self { late, outs, .. } = self;
        let is_active = |number: usize| outs.get(number).is_some_and(Endpoint::active);
        if let Some(status) = late.bogus_status(is_active) {
            self.rx.push_bogus(status);
        }
    }
}
