//! Names and bit rates of Linux's CAN interfaces, on every system.

/// Room for a name, with its end (`IFNAMSIZ` of `linux/if.h`).
const NAME_BYTES: usize = 16;
/// The prefixes of names that are known as interfaces without looking (docs/grammar.md).
const PREFIXES: [&str; 4] = ["can", "vcan", "vxcan", "slcan"];

/// Whether a text can be the name of an interface.
pub(crate) fn is_possible(name: &str) -> bool {
    (1..NAME_BYTES).contains(&name.len())
        && !name.starts_with('.')
        && name.chars().all(|letter| letter.is_ascii_graphic() && !"/:".contains(letter))
}

/// Whether a text is the name of an interface, without a scheme before it: `can0`, `vcan12`, or that of a CAN interface that exists.
/// `exists` looks.
pub(crate) fn is_meant(text: &str, exists: impl FnOnce(&str) -> bool) -> bool {
    let is_numbered = PREFIXES.into_iter().any(|prefix| {
        text.strip_prefix(prefix).is_some_and(|number| {
            (1..=5).contains(&number.len()) && number.bytes().all(|digit| digit.is_ascii_digit())
        })
    });
    is_numbered || is_possible(text) && exists(text)
}

/// Whether two bit rates are the same one, but for what a controller's clock cannot divide.
pub(crate) const fn same_rate(one_bps: u32, other_bps: u32) -> bool {
    one_bps.abs_diff(other_bps) as u64 * 200 <= one_bps as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interfaces_are_known_by_their_names_and_nothing_else_is() {
        for name in ["can0", "vcan12", "vxcan3", "slcan0"] {
            assert!(is_meant(name, |_| false) && is_possible(name), "{name}");
        }
        for name in ["can", "canal", "can0.log", "CAN1", "xcan0", "can123456", "", "/dev/can0", "lo"] {
            assert!(!is_meant(name, |_| false), "{name}");
        }
        for name in ["", "a/b", "..", "sixteen-letters-", "with space", "a:b"] {
            assert!(!is_possible(name), "{name}");
        }
    }

    #[test]
    fn a_rate_within_what_clocks_divide_is_the_same() {
        assert!(same_rate(500_000, 500_000) && same_rate(499_999, 500_000) && same_rate(83_333, 83_300));
        assert!(!same_rate(500_000, 250_000) && !same_rate(1_000_000, 990_000));
    }
}
