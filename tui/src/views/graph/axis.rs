//! The graph's ticks: values on the left, times of day below.

use cantap_analysis::plot::scale::{label, ticks, time_ticks};
use cantap_work::cut::cut;

use super::super::super::times::clock;
use super::curve::Time;

/// Columns for the values on the left, including the tick itself.
pub const GUTTER: u16 = 10;
/// Columns needed for a time, including the distance to its neighbours.
const TIME_COLUMNS: usize = 16;
/// Number of rows between values.
const VALUE_ROWS: usize = 3;

/// The labels of values, each with its row, for a pane with this many rows.
pub fn values([low, high]: [f64; 2], rows: u16) -> Vec<(u16, String)> {
    if rows == 0 || high.total_cmp(&low).is_le() {
        return Vec::new();
    }
    let wanted = (usize::from(rows) / VALUE_ROWS).clamp(2, 8);
    let (places, step) = ticks((low, high), wanted);
    let last = f64::from(rows - 1);
    let mut labels: Vec<(u16, String)> = Vec::new();
    for value in places {
        let row = ((high - value) / (high - low) * last).round().clamp(0.0, last) as u16;
        if labels.iter().all(|(other, _)| *other != row) {
            let columns = usize::from(GUTTER) - 1;
            let exact = label(value, step);
            let text = if exact.chars().count() <= columns { exact } else { format!("{value:.2e}") };
            labels.push((row, cut(&text, columns)));
        }
    }
    labels
}

/// The line below the curves: times of day at their positions.
pub fn times(time: Time, tick: char) -> String {
    const DAY_NS: i64 = 86_400_000_000_000;
    let mut line = vec![' '; time.columns];
    // Counted from midnight, so that ticks are at round times of day.
    let midnight = time.from_ns.div_euclid(DAY_NS).saturating_mul(DAY_NS);
    let from = time.from_ns.saturating_sub(midnight) as f64 / 1e9;
    let range = (from, from + time.span_ns as f64 / 1e9);
    let (places, step) = time_ticks(range, (time.columns / TIME_COLUMNS).max(1));
    let decimals = (-(step.max(1e-9) * 1.000_001).log10().floor()).clamp(0.0, 9.0) as usize;
    let mut free = 0;
    for at in places {
        let time_ns = midnight.saturating_add((at * 1e9).round() as i64);
        let Some(place) = time.place(time_ns) else { continue };
        let text = clock(time_ns, decimals);
        if place < free || place + 1 + text.len() > line.len() {
            continue;
        }
        line[place] = tick;
        for (cell, character) in line[place + 1..].iter_mut().zip(text.chars()) {
            *cell = character;
        }
        free = place + text.len() + 3;
    }
    line.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    #[test]
    fn times_stand_at_round_times_of_day() {
        let time = Time { from_ns: 1_410_714_882_622_188_000, span_ns: 10 * S, columns: 64 };
        let line = times(time, '|');
        assert_eq!(
            (line.find("|17:14:45"), line.find("|17:14:50"), line.matches('|').count()),
            (Some(15), Some(47), 2)
        );
        let time = Time { from_ns: 1_410_714_882_622_188_000, span_ns: S / 100, columns: 64 };
        assert!(times(time, '|').contains("|17:14:42.625"), "{}", times(time, '|'));
        for span_ns in [1, 1000, i64::MAX / 4] {
            for columns in [0, 1, 5, 300] {
                for from_ns in [i64::MIN, 0, i64::MAX] {
                    assert_eq!(times(Time { from_ns, span_ns, columns }, '|').chars().count(), columns);
                }
            }
        }
    }

    #[test]
    fn values_stand_at_round_numbers_and_each_in_a_row_of_its_own() {
        assert_eq!(values([0.0, 10.0], 9), [(8, "0".to_owned()), (4, "5".to_owned()), (0, "10".to_owned())]);
        assert_eq!(values([1.0, 1.0], 9), []);
        assert!(values([0.0, 1e300], 3).len() <= 3);
        assert!(values([-1e-12, 1e-12], 50).iter().all(|(row, text)| *row < 50 && text.chars().count() < 10));
    }
}
