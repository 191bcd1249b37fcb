//! The texts in a device's answers. A board's are plain, but a server may be anybody.

use cantap_trace::clean::is_harmful;
use cantap_wire::Hello;

/// Replaces what a terminal would obey in a device's description of itself.
pub fn clean(hello: &mut Hello) {
    printable(&mut hello.board);
    printable(&mut hello.serial);
}

/// Replaces what a terminal would obey by question marks, which take no more room.
pub fn printable<const N: usize>(text: &mut heapless::String<N>) {
    if text.contains(is_harmful) {
        // None of them is shorter than a question mark.
        *text = text.chars().map(|character| if is_harmful(character) { '?' } else { character }).collect();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_text_of_escapes_is_replaced() {
        let mut text: heapless::String<24> = "\x1b]0;P\x07\u{9b}31m\u{202e}\x7f°".try_into().unwrap();
        printable(&mut text);
        assert_eq!(text, "?]0;P??31m??°");
        let mut full: heapless::String<24> = "\u{202e}".repeat(8).as_str().try_into().unwrap();
        printable(&mut full);
        assert_eq!(full, "????????");
    }
}
