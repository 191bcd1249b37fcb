//! Times as text.

/// A time in seconds with six decimals.
pub fn seconds(ns: i64) -> String {
    let sign = if ns < 0 { "-" } else { "" };
    let us = ns.unsigned_abs() / 1000;
    format!("{sign}{}.{:06}", us / 1_000_000, us % 1_000_000)
}

/// A time of day (UTC) with this many decimals of a second, at most nine: `17:14:42.622`.
pub fn clock(time_ns: i64, decimals: usize) -> String {
    const DAY_NS: i64 = 86_400_000_000_000;
    let ns = time_ns.rem_euclid(DAY_NS);
    let (second, ns) = (ns / 1_000_000_000, ns % 1_000_000_000);
    let whole = format!("{:02}:{:02}:{:02}", second / 3600, second / 60 % 60, second % 60);
    match decimals {
        0 => whole,
        _ => format!("{whole}.{}", &format!("{ns:09}")[..decimals.min(9)]),
    }
}

/// A duration as a player shows it: `0:05`, `12:30`, `1:02:03`.
pub fn duration(ns: i64) -> String {
    let seconds = ns.max(0) / 1_000_000_000;
    match seconds / 3600 {
        0 => format!("{}:{:02}", seconds / 60, seconds % 60),
        hours => format!("{hours}:{:02}:{:02}", seconds / 60 % 60, seconds % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_told_as_clocks_and_players_do() {
        assert_eq!(clock(1_410_714_882_622_188_000, 6), "17:14:42.622188");
        assert_eq!(clock(1_410_714_882_622_188_000, 0), "17:14:42");
        assert_eq!((clock(-1, 3), clock(0, 9)), ("23:59:59.999".to_owned(), "00:00:00.000000000".to_owned()));
        assert_eq!(seconds(-1_500_000), "-0.001500");
        let at = |s: i64| duration(s * 1_000_000_000);
        assert_eq!([at(5), at(750), at(3723), at(-4)], ["0:05", "12:30", "1:02:03", "0:00"]);
    }
}
