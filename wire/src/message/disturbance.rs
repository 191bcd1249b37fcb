//! Limits of disturbances.

/// What [`super::Command::UnlockDisturbance`] must say: no request becomes one by accident.
pub const DISTURBANCE_WORD: u32 = 0xE440_F4A3;
/// Most bits of one level: as long as two error flags, one behind the other (ISO 11898-1, "error flag": 6 to 12 bits).
pub const MAX_DISTURBANCE_BITS: u8 = 12;
/// Least time between the beginnings of two levels: 10 ms, in ticks. At 5 kbit/s, where 12 bits take 2.4 ms, the bus is disturbed for a
/// quarter of the time at most.
pub const DISTURBANCE_PAUSE_TICKS: u32 = 120_000;
/// Least time from the request to the level: 1 ms, in ticks.
pub const DISTURBANCE_LEAD_TICKS: u32 = 12_000;
