//! What the machine needs from a device at a bus address.

/// A device that the core reaches through memory-mapped registers.
///
/// All times are core cycles since the machine was made ([`crate::Clock`]), and never go back.
///
/// How the machine uses it:
/// - a register access calls [`read`](Self::read) or [`write`](Self::write) with the time of the
///   instruction; the device should first bring its state up to that time, where it matters;
/// - when the time that [`next_event`](Self::next_event) names has come, [`advance`](Self::advance) is
///   called, at that cycle or a few later (instructions are not interrupted);
/// - after each of these, `irq` and `next_event` are called again. The interrupt is a level: it
///   stays asserted as long as `irq` says so.
///
/// A device attached from outside (`Machine::attach`) stays shared with its creator: the machine
/// queries it again at the start of every `run_until`, so it may be changed between two runs.
pub trait Peripheral {
    /// Reads `size` bytes (1, 2 or 4) at `offset` from the device's base; the value is in the low bits.
    /// May have side effects, as in the device.
    fn read(&mut self, offset: u32, size: u8, now: u64) -> u32;
    /// Writes the low `size` bytes (1, 2 or 4) of `value` at `offset` from the device's base.
    fn write(&mut self, offset: u32, size: u8, value: u32, now: u64);
    /// Whether the device's interrupt line is asserted.
    fn irq(&self) -> bool;
    /// When the device next needs [`Self::advance`], if it does; a time in the past means at once.
    fn next_event(&self) -> Option<u64>;
    /// Processes everything that is due at or before `now`.
    fn advance(&mut self, now: u64);
    /// When the device last pulsed its trigger output, if it has since the last call: OTG_FS does so at each start of
    /// frame.
    fn take_trigger(&mut self) -> Option<u64> {
        None
    }
    /// A system reset of the chip: registers go back to their reset values.
    fn reset(&mut self, _now: u64) {}
}
