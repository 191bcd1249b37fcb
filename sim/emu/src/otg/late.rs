//! What the controller may do late or wrongly ([`crate::hostile`]), and what of it waits for its time.

use super::endpoint::{Due, Endpoint};
use super::registers::{epctl, epint, pktsts};
use crate::hostile::{Dice, UsbFaults};

/// A word that was seen in GRXSTSP of an F4 (libopencm3 #672): OUT data for an endpoint that does not exist.
const SEEN: u32 = 0xB4E4_8168;

/// The faults, and what waits for its time.
#[derive(Debug, Default)]
pub struct Late {
    pub faults: UsbFaults,
    /// Whether anything was ever to come late.
    pub is_hostile: bool,
    pub dice: Dice,
    /// The controller has no clock.
    pub is_dead: bool,
    pub now: u64,
    /// When the core soft reset under way ends.
    pub reset_at: Option<u64>,
    /// When the bus is idle after it.
    pub idle_at: u64,
    /// The flush under way: when it ends, and which FIFO.
    pub flush: Option<(u64, u32)>,
    /// When device mode begins.
    pub device_mode_at: u64,
    /// The end of a setup stage that has not entered the receive FIFO.
    pub setup_is_open: bool,
}

impl Late {
    /// Whether something due at `at` has come.
    pub fn has_come(&self, at: u64) -> bool {
        self.dice.has_come(at, self.now)
    }

    /// The same faults after a reset.
    pub fn after_reset(&self) -> Self {
        Self {
            faults: self.faults,
            is_hostile: self.is_hostile,
            dice: self.dice.clone(),
            now: self.now,
            ..Self::default()
        }
    }

    /// Whether a driver may disable an IN endpoint that does not report its NAK: it has waited long enough.
    pub fn excuses(&self, endpoint: &Endpoint) -> bool {
        endpoint.nak_at == Some(u64::MAX) || self.faults.silent_nak && endpoint.naks()
    }

    /// When what a write to an endpoint's control register asks for takes effect.
    pub fn due(&mut self, control: u32) -> Due {
        let Self { faults, dice, now, .. } = self;
        let mut due = |action: u32, tardy| if control & action != 0 { dice.due(tardy, *now) } else { 0 };
        let nak = due(epctl::SNAK, faults.nak);
        Due { nak, silent_nak: faults.silent_nak, disable: due(epctl::EPDIS, faults.disable) }
    }

    /// Whether the end of a setup stage now enters the receive FIFO: nothing holds it up, or what did is over. `flags` is DOEPINT0.
    pub fn setup_stage_ends(&mut self, by_token: bool, flags: u32) -> bool {
        let blocked = self.faults.stup_blocks && flags & epint::STUP != 0;
        let ends = self.setup_is_open && !blocked && (by_token || !self.faults.late_setup_complete);
        self.setup_is_open &= !ends;
        ends
    }

    /// An impossible status, if one is to stand before a packet.
    pub fn bogus_status(&mut self, is_active: impl Fn(usize) -> bool) -> Option<u32> {
        let Self { faults, dice, .. } = self;
        let word = dice.hits(faults.bogus_status_percent).then(|| dice.word())?;
        Some(if is_impossible(word, is_active) { word } else { SEEN })
    }
}

/// Whether a status is not one that the core can mean, with these OUT endpoints and full-speed packets.
fn is_impossible(status: u32, is_active: impl Fn(usize) -> bool) -> bool {
    let (number, length) = ((status & 0xF) as usize, status >> 4 & 0x7FF);
    match status >> 17 & 0xF {
        pktsts::OUT_DATA => !is_active(number) || length > 64,
        pktsts::SETUP_DATA => number != 0 || length != 8,
        pktsts::OUT_COMPLETE => !is_active(number),
        pktsts::SETUP_COMPLETE => number != 0,
        pktsts::GLOBAL_OUT_NAK => false,
        _ => true,
    }
}
