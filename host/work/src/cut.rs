//! Text that does not fit ends in `…`: a number that is cut must not look like a smaller one.

/// At the end of what was cut.
pub const MARK: &str = "…";

/// A text in at most this many characters.
pub fn cut(text: &str, columns: usize) -> String {
    if text.chars().count() <= columns {
        return text.to_owned();
    }
    let kept = text.chars().take(columns.saturating_sub(1));
    kept.chain(MARK.chars()).take(columns).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_that_is_cut_says_so() {
        assert_eq!([3, 2, 1, 0].map(|columns| cut("255", columns)), ["255", "2…", "…", ""]);
    }
}
