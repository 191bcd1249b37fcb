//! One endpoint's registers, with the side effects of writing them.

use super::registers::{epctl, epint, eptsiz};

/// An IN or OUT endpoint; only the OTG core knows which.
#[derive(Clone, Copy, Debug, Default)]
pub struct Endpoint {
    /// DIEPCTLx or DOEPCTLx.
    pub control: u32,
    /// DIEPINTx or DOEPINTx, without TXFE, which follows the FIFO.
    pub interrupt: u32,
    /// DIEPTSIZx or DOEPTSIZx.
    pub size: u32,
    /// When a NAK that was asked for takes effect, and when a disable does.
    pub nak_at: Option<u64>,
    pub disabled_at: Option<u64>,
}

/// When what a write asks for takes effect; 0 is at once.
#[derive(Clone, Copy, Debug, Default)]
pub struct Due {
    /// The NAK, for SNAK.
    pub nak: u64,
    /// Nothing reports a NAK that is in effect already.
    pub silent_nak: bool,
    /// The end of the transfer, for EPDIS.
    pub disable: u64,
}

impl Endpoint {
    /// Endpoint 0 after a reset: always active, answers NAK.
    pub const fn control_pipe() -> Self {
        Self { control: epctl::USBAEP, interrupt: 0, size: 0, nak_at: None, disabled_at: None }
    }

    /// Bytes of the largest packet. Endpoint 0 uses a code instead of the number.
    pub fn max_packet(&self, number: usize) -> usize {
        let field = self.control & epctl::MPSIZ;
        if number == 0 { 64 >> (field & 3) } else { field as usize }
    }

    /// Whether a transfer is armed.
    pub fn enabled(&self) -> bool {
        self.control & epctl::EPENA != 0
    }

    /// Whether the endpoint exists for the host.
    pub fn active(&self) -> bool {
        self.control & epctl::USBAEP != 0
    }

    /// Whether tokens are answered with STALL.
    pub fn stalled(&self) -> bool {
        self.control & epctl::STALL != 0
    }

    /// Whether tokens are answered with NAK.
    pub fn naks(&self) -> bool {
        self.control & epctl::NAKSTS != 0
    }

    /// The data toggle: DATA1 if set.
    pub fn toggle(&self) -> bool {
        self.control & epctl::DPID != 0
    }

    /// Sets the data toggle.
    pub fn set_toggle(&mut self, data1: bool) {
        self.control = self.control & !epctl::DPID | if data1 { epctl::DPID } else { 0 };
    }

    /// Bytes left in the transfer.
    pub fn transfer_left(&self) -> usize {
        (self.size & eptsiz::XFRSIZ) as usize
    }

    /// Packets left in the transfer.
    pub fn packets_left(&self) -> u32 {
        (self.size & eptsiz::PKTCNT) >> eptsiz::PKTCNT_SHIFT
    }

    /// Deducts a packet of `bytes` bytes from the transfer.
    pub fn count_packet(&mut self, bytes: usize) {
        let left = self.transfer_left().saturating_sub(bytes) as u32;
        let packets = self.packets_left().saturating_sub(1);
        self.size = self.size & !(eptsiz::XFRSIZ | eptsiz::PKTCNT) | left | packets << eptsiz::PKTCNT_SHIFT;
    }

    /// Ends the transfer: disabled, answers NAK. Setting the interrupt flag is left to the caller.
    pub fn finish(&mut self) {
        self.control = self.control & !epctl::EPENA | epctl::NAKSTS;
    }

    /// A write to the control register. `due` says when a NAK and a disable that it asks for take effect: 0 is at once.
    ///
    /// Software can only set EPENA and only request EPDIS; writing zeros to them changes nothing. So a
    /// transfer survives a driver that writes the whole register.
    pub fn write_control(&mut self, number: usize, value: u32, due: Due) {
        let mut stored = epctl::EPTYP | epctl::SNPM | epctl::STALL | epctl::TXFNUM | epctl::MPSIZ;
        if number == 0 {
            // Endpoint 0 is always active and a control endpoint, and only the next SETUP clears its
            // STALL.
            stored &= !epctl::EPTYP;
            let stall = self.control & epctl::STALL;
            self.control = self.control & !stored | value & stored | stall;
        } else {
            stored |= epctl::USBAEP;
            self.control = self.control & !stored | value & stored;
            if value & epctl::SD0PID != 0 {
                self.set_toggle(false);
            }
            if value & epctl::SODDFRM != 0 {
                self.set_toggle(true);
            }
        }
        if value & epctl::CNAK != 0 {
            self.control &= !epctl::NAKSTS;
            self.interrupt &= !epint::INEPNE;
            self.nak_at = None;
        }
        if value & epctl::SNAK != 0 && !(due.silent_nak && self.naks()) {
            self.nak_at = Some(due.nak);
        }
        if value & epctl::EPENA != 0 {
            self.control |= epctl::EPENA;
        }
        // Only if a transfer is armed. Endpoint 0 OUT cannot be disabled, which the core checks before
        // the call.
        if value & epctl::EPDIS != 0 && self.enabled() && self.disabled_at.is_none() {
            self.disabled_at = Some(due.disable);
        }
        self.advance(|at| at == 0);
    }

    /// Lets what was asked for take effect if its time `has_come`.
    pub fn advance(&mut self, has_come: impl Fn(u64) -> bool) {
        if self.nak_at.is_some_and(&has_come) {
            self.nak_at = None;
            self.control |= epctl::NAKSTS;
            self.interrupt |= epint::INEPNE;
        }
        if self.disabled_at.is_some_and(&has_come) {
            self.disabled_at = None;
            self.control &= !epctl::EPENA;
            self.interrupt |= epint::EPDISD;
        }
    }

    /// What a USB reset does to the endpoint: it is no longer active (endpoint 0 stays active). An
    /// armed transfer stays armed until software disables it.
    pub fn bus_reset(&mut self, number: usize) {
        if number != 0 {
            self.control &= !epctl::USBAEP;
        }
    }
}
