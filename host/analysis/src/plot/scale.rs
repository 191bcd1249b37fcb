//! Ranges, ticks at round values, and their labels.

/// The smallest range that includes everything.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Range(Option<(f64, f64)>);

impl Range {
    pub(super) fn include(&mut self, value: f64) {
        if value.is_finite() {
            let (low, high) = self.0.unwrap_or((value, value));
            self.0 = Some((low.min(value), high.max(value)));
        }
    }

    /// The range, with a minimum width; zero to one if it is empty.
    pub(super) fn or_unit(self) -> (f64, f64) {
        match self.0 {
            None => (0.0, 1.0),
            Some((low, high)) if high - low > (low.abs() + high.abs()) * 1e-12 => (low, high),
            Some((value, _)) => {
                let half = if value == 0.0 { 0.5 } else { value.abs() * 0.05 };
                (value - half, value + half)
            }
        }
    }
}

/// Widens a range so that curves do not touch the frame.
pub(super) fn with_margin((low, high): (f64, f64)) -> (f64, f64) {
    let margin = (high - low) * 0.06;
    (low - margin, high + margin)
}

/// Ticks in a range, about `wanted` of them, at multiples of 1, 2 or 5 times a power of ten, and the step.
pub fn ticks((low, high): (f64, f64), wanted: usize) -> (Vec<f64>, f64) {
    let rough = (high - low) / wanted.max(1) as f64;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * power).into_iter().find(|step| *step >= rough);
    multiples((low, high), step.unwrap_or(rough))
}

/// Like [`ticks`], but only at whole numbers.
pub(super) fn whole_ticks(range: (f64, f64), wanted: usize) -> (Vec<f64>, f64) {
    let (found, step) = ticks(range, wanted);
    if step < 1.0 { multiples(range, 1.0) } else { (found, step) }
}

/// Ticks for seconds: like [`ticks`] up to a second, then at parts of minutes, hours and days.
pub fn time_ticks((low, high): (f64, f64), wanted: usize) -> (Vec<f64>, f64) {
    const STEPS: [f64; 21] = [
        2.0,
        5.0,
        10.0,
        15.0,
        30.0,
        60.0,
        120.0,
        300.0,
        600.0,
        900.0,
        1800.0,
        3600.0,
        7200.0,
        10_800.0,
        21_600.0,
        43_200.0,
        86_400.0,
        172_800.0,
        432_000.0,
        864_000.0,
        1_728_000.0,
    ];
    let rough = (high - low) / wanted.max(1) as f64;
    match STEPS.into_iter().find(|step| *step >= rough) {
        Some(step) if rough > 1.0 => multiples((low, high), step),
        _ => ticks((low, high), wanted),
    }
}

fn multiples((low, high): (f64, f64), step: f64) -> (Vec<f64>, f64) {
    // A step that vanishes compared with the values (or is not a number) would never reach the end.
    if !(step.is_finite() && step > 0.0 && (high - low) / step < 1000.0) {
        return (vec![low, high], high - low);
    }
    let first = (low / step - 1e-9).ceil() as i64;
    let last = (high / step + 1e-9).floor() as i64;
    ((first..=last).map(|n| n as f64 * step).collect(), step)
}

/// A value with as many decimals as the step between ticks needs.
pub fn label(value: f64, step: f64) -> String {
    let magnitude = value.abs().max(step.abs());
    if magnitude >= 1e7 || (magnitude > 0.0 && magnitude < 1e-4) {
        return if value == 0.0 { "0".to_owned() } else { format!("{value:.2e}") };
    }
    let decimals = (-(step.abs().max(1e-12) * 1.000_001).log10().floor()).clamp(0.0, 9.0) as usize;
    let text = format!("{value:.decimals$}");
    if text.trim_start_matches('-').bytes().all(|byte| matches!(byte, b'0' | b'.')) {
        text.trim_start_matches('-').to_owned()
    } else {
        text
    }
}

/// Seconds with as many digits as the step between ticks needs: `0.25`, `75`, `12:30`, `3:00:00`.
pub(super) fn time_label(seconds: f64, step: f64, span: f64) -> String {
    if span < 300.0 || step < 1.0 {
        return label(seconds, step);
    }
    let sign = if seconds < 0.0 { "-" } else { "" };
    let whole = seconds.abs().round() as u64;
    let (hours, minutes, seconds) = (whole / 3600, whole / 60 % 60, whole % 60);
    if hours > 0 || span >= 3600.0 {
        format!("{sign}{hours}:{minutes:02}:{seconds:02}")
    } else {
        format!("{sign}{minutes}:{seconds:02}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_stand_at_round_values_inside_the_range() {
        assert_eq!(ticks((0.0, 10.0), 5), (vec![0.0, 2.0, 4.0, 6.0, 8.0, 10.0], 2.0));
        let (ticks, step) = ticks((-0.013, 0.027), 4);
        let labels: Vec<_> = ticks.iter().map(|tick| label(*tick, step)).collect();
        assert_eq!(labels, ["-0.01", "0.00", "0.01", "0.02"]);
    }

    #[test]
    fn long_times_are_cut_into_minutes_and_hours() {
        let (ticks, step) = time_ticks((0.0, 7200.0), 8);
        let labels: Vec<_> = ticks.iter().map(|tick| time_label(*tick, step, 7200.0)).collect();
        assert_eq!(labels[..3], ["0:00:00", "0:15:00", "0:30:00"]);
        let (ticks, step) = time_ticks((0.0, 0.001), 5);
        assert_eq!(time_label(ticks[1], step, 0.001), "0.0002");
    }

    #[test]
    fn ranges_that_are_no_ranges_still_give_ticks() {
        for range in
            [(1.0, 1.0), (f64::MIN, f64::MAX), (1e300, 1e300 * (1.0 + 1e-15)), (0.0, f64::MIN_POSITIVE)]
        {
            let (found, step) = ticks(range, 5);
            assert!(found.len() <= 1001, "{range:?}");
            for tick in found {
                assert!(!label(tick, step).is_empty());
            }
        }
    }

    #[test]
    fn a_single_value_gets_room_around_it() {
        let mut range = Range::default();
        assert_eq!(range.or_unit(), (0.0, 1.0));
        range.include(f64::NAN);
        range.include(20.0);
        assert_eq!(range.or_unit(), (19.0, 21.0));
    }
}
