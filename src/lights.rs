//! What the LEDs show: power, traffic, errors, and a pattern to find the device by.

/// A frame lights the traffic LED for this long, in ms, after which it is dark for the same time: at full load
/// it flickers at 10 Hz.
const FLICKER_MS: u16 = 50;
/// Half a period of the pattern for errors, in ms.
const ERROR_MS: u16 = 125;
/// An error is shown for at least this long, in ms.
const ERROR_FOR_MS: u16 = 1_000;
/// Half a period of the pattern that shows where the device is, in ms.
const IDENTIFY_MS: u16 = 60;

/// A gateway that needs no host: the power LED goes out for so long, in ms.
const STANDALONE_OUT_MS: u16 = 128;
/// Once in so many ms.
const STANDALONE_MS: u16 = 1_024;

/// Length of each flash of the pattern for a clock that does not start, and of the pause after it, in ms.
const NO_CLOCK_FLASH_MS: u32 = 100;
/// Flashes of that pattern.
const NO_CLOCK_FLASHES: u32 = 3;
/// Its period in ms: the flashes, then dark for longer than any other pattern is.
pub const NO_CLOCK_MS: u32 = 1_500;

/// The pattern for a clock that does not start, when nothing else runs: three short flashes, then dark for a second.
pub const fn no_clock(at_ms: u32) -> Lit {
    let half = at_ms % NO_CLOCK_MS / NO_CLOCK_FLASH_MS;
    let flash = half < 2 * NO_CLOCK_FLASHES && half.is_multiple_of(2);
    Lit { power: flash, traffic: false, error: false }
}

/// What happened in the last millisecond.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Activity {
    /// A frame was received or sent.
    pub traffic: bool,
    /// A bus error, a loss, or a channel that is bus-off.
    pub error: bool,
    /// A gateway runs that needs no host.
    pub standalone: bool,
}

/// Which LEDs are lit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lit {
    /// Power.
    pub power: bool,
    /// Traffic.
    pub traffic: bool,
    /// Error.
    pub error: bool,
}

impl Lit {
    /// For a board with a single LED: it is on, goes out briefly for frames, and blinks more slowly for errors.
    pub const fn single(self) -> bool {
        self.power && !self.traffic && !self.error
    }
}

/// The LEDs' state.
#[derive(Debug, Default)]
#[expect(clippy::struct_field_names, reason = "a unit belongs in a name")]
pub struct Lights {
    /// Millisecond count; wraps.
    now_ms: u16,
    traffic_left_ms: u16,
    error_left_ms: u16,
    identify_left_ms: u32,
}

impl Lights {
    /// Power only.
    pub const fn new() -> Self {
        Self { now_ms: 0, traffic_left_ms: 0, error_left_ms: 0, identify_left_ms: 0 }
    }

    /// Shows the pattern for this long; 0 ends it.
    pub const fn identify(&mut self, seconds: u8) {
        self.identify_left_ms = seconds as u32 * 1000;
    }

    /// Call once a millisecond.
    pub fn tick(&mut self, activity: Activity) -> Lit {
        self.now_ms = self.now_ms.wrapping_add(1);
        self.traffic_left_ms = match self.traffic_left_ms {
            0 if activity.traffic => 2 * FLICKER_MS,
            left => left.saturating_sub(1),
        };
        self.error_left_ms = if activity.error { ERROR_FOR_MS } else { self.error_left_ms.saturating_sub(1) };
        if self.identify_left_ms > 0 {
            self.identify_left_ms -= 1;
            let lit = (self.now_ms / IDENTIFY_MS).is_multiple_of(2);
            return Lit { power: lit, traffic: !lit, error: !lit };
        }
        Lit {
            power: !activity.standalone || self.now_ms % STANDALONE_MS >= STANDALONE_OUT_MS,
            traffic: self.traffic_left_ms > FLICKER_MS,
            error: self.error_left_ms > 0 && (self.now_ms / ERROR_MS).is_multiple_of(2),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const QUIET: Activity = Activity { traffic: false, error: false, standalone: false };
    const FRAME: Activity = Activity { traffic: true, error: false, standalone: false };
    const ERROR: Activity = Activity { traffic: false, error: true, standalone: false };

    /// How often `is` turns true in this many milliseconds.
    fn turns(lights: &mut Lights, ms: u32, activity: Activity, is: fn(Lit) -> bool) -> usize {
        let seen: Vec<bool> = (0..ms).map(|_| is(lights.tick(activity))).collect();
        seen.windows(2).filter(|pair| !pair[0] && pair[1]).count()
    }

    #[test]
    fn one_frame_flashes_once() {
        let mut lights = Lights::new();
        assert!(lights.tick(FRAME).traffic);
        assert_eq!((0..200).filter(|_| lights.tick(QUIET).traffic).count() as u16, FLICKER_MS - 1);
    }

    #[test]
    fn a_saturated_bus_flickers_ten_times_a_second() {
        let mut lights = Lights::new();
        assert!((9..=10).contains(&turns(&mut lights, 1000, FRAME, |lit| lit.traffic)));
    }

    #[test]
    fn an_error_blinks_for_a_second_and_no_longer() {
        let mut lights = Lights::new();
        lights.tick(ERROR);
        assert!(turns(&mut lights, 1000, QUIET, |lit| lit.error) >= 3);
        assert_eq!(turns(&mut lights, 1000, QUIET, |lit| lit.error), 0);
    }

    #[test]
    fn a_gateway_that_needs_no_host_shows_in_the_power_led() {
        let mut lights = Lights::new();
        let alone = Activity { standalone: true, ..QUIET };
        assert_eq!(turns(&mut lights, 4096, alone, |lit| lit.power), 4);
        assert_eq!(turns(&mut lights, 4096, QUIET, |lit| lit.power), 0);
    }

    #[test]
    fn identify_blinks_for_its_time_whatever_else_happens() {
        let mut lights = Lights::new();
        lights.identify(2);
        assert!(turns(&mut lights, 2000, FRAME, Lit::single) >= 15);
        assert!(lights.tick(QUIET).power && lights.identify_left_ms == 0);
    }

    #[test]
    fn a_clock_that_does_not_start_flashes_three_times_in_a_period() {
        let lit: Vec<bool> = (0..2 * NO_CLOCK_MS).map(|at_ms| no_clock(at_ms).power).collect();
        assert_eq!(lit.iter().filter(|&&lit| lit).count() as u32, 2 * NO_CLOCK_FLASHES * NO_CLOCK_FLASH_MS);
        // The first begins at once.
        assert_eq!(
            lit.windows(2).filter(|pair| !pair[0] && pair[1]).count() as u32,
            2 * NO_CLOCK_FLASHES - 1
        );
    }

    #[test]
    fn a_single_led_is_steady_when_all_is_quiet() {
        let mut lights = Lights::new();
        assert!((0..5000).all(|_| lights.tick(QUIET).single()));
    }
}
