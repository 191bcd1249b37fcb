//! Dividing a controller's clock to a bit rate, within what the controller can be set to.

use std::cmp::Reverse;
use std::ops::RangeInclusive;

use cantap_wire::BitTiming;

/// Where the bits of data phases are sampled, in thousandths: Linux's own choice above 800 kbit/s (`can_calc_bittiming`).
const DATA_SAMPLE_POINT_PERMILLE: u32 = 750;

/// What a bit timing may be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Limits {
    /// Quanta before the sample point, without the first.
    pub segment1: RangeInclusive<u32>,
    /// Quanta after it.
    pub segment2: RangeInclusive<u32>,
    /// Quanta of the largest jump width.
    pub jump_width_max: u32,
    /// Clocks per quantum.
    pub prescaler: RangeInclusive<u32>,
    /// By how much prescalers differ.
    pub prescaler_step: u32,
}

/// A bit timing of any controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Timing {
    /// Clocks per quantum.
    pub prescaler: u32,
    /// Quanta before the sample point, without the first.
    pub segment1: u32,
    /// Quanta after it.
    pub segment2: u32,
    /// In quanta.
    pub jump_width: u32,
}

impl Limits {
    /// Everything from 1 up to these.
    pub const fn up_to(segment1: u32, segment2: u32, jump_width: u32, prescaler: u32) -> Self {
        Self {
            segment1: 1..=segment1,
            segment2: 1..=segment2,
            jump_width_max: jump_width,
            prescaler: 1..=prescaler,
            prescaler_step: 1,
        }
    }

    /// For a bit rate; `None` if this clock cannot be divided to it. A sample point within what is possible.
    pub fn nominal(&self, clock_hz: u32, bitrate_bps: u32, sample_point_permille: u32) -> Option<Timing> {
        let fits = |timing: &BitTiming| {
            let prescaler = u32::from(timing.prescaler);
            self.prescaler.contains(&prescaler)
                && (prescaler - self.prescaler.start()).is_multiple_of(self.prescaler_step.max(1))
                && self.segment1.contains(&u32::from(timing.segment1))
                && self.segment2.contains(&u32::from(timing.segment2))
        };
        let best = BitTiming::all(clock_hz, bitrate_bps).filter(fits).min_by_key(|timing| {
            let off = timing.sample_point_permille().abs_diff(sample_point_permille);
            (off, Reverse(timing.quanta()))
        })?;
        let (segment1, segment2) = (u32::from(best.segment1), u32::from(best.segment2));
        Some(self.timing(best.prescaler.into(), segment1, segment2, best.quanta() / 8))
    }

    /// For the data phases of CAN FD frames, sampled at [`DATA_SAMPLE_POINT_PERMILLE`], with the largest jump width.
    pub fn data(&self, clock_hz: u32, bitrate_bps: u32) -> Option<Timing> {
        let (first, last) = (*self.prescaler.start(), *self.prescaler.end());
        // No clock is divided by more than this.
        let prescalers = (first.max(1)..=last.min(1024)).step_by(self.prescaler_step.max(1) as usize);
        let fitting = prescalers.filter_map(|prescaler| {
            let per_quantum = u64::from(prescaler) * u64::from(bitrate_bps.max(1));
            let clock_hz = u64::from(clock_hz);
            let quanta =
                u32::try_from(clock_hz / per_quantum).ok().filter(|_| clock_hz % per_quantum == 0)?;
            let wanted = (quanta * DATA_SAMPLE_POINT_PERMILLE).div_ceil(1000);
            let most =
                (*self.segment1.end()).min(quanta.checked_sub(self.segment2.start().saturating_add(1))?);
            let segment1 = wanted.checked_sub(1)?.min(most);
            let segment2 = quanta - 1 - segment1;
            let fits = self.segment1.contains(&segment1) && self.segment2.contains(&segment2);
            let off = ((1 + segment1) * 1000 / quanta).abs_diff(DATA_SAMPLE_POINT_PERMILLE);
            fits.then_some((off, prescaler, segment1, segment2))
        });
        let (_, prescaler, segment1, segment2) = fitting.min()?;
        Some(self.timing(prescaler, segment1, segment2, segment2))
    }

    fn timing(&self, prescaler: u32, segment1: u32, segment2: u32, jump_width: u32) -> Timing {
        let jump_width = jump_width.clamp(1, self.jump_width_max.min(segment2).max(1));
        Timing { prescaler, segment1, segment2, jump_width }
    }
}
