//! The lines of slcan: taken apart, and those for frames.

use std::fmt::Write;

use cantap_wire::Frame;

/// The longest line there is: an extended frame with eight bytes and a stamp is 35 bytes, `V` of CANable a web address.
const MAX_LINE: usize = 128;
const CR: u8 = b'\r';
const LF: u8 = b'\n';
const BEL: u8 = 7;

/// One line, without its end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Text {
    /// Ended by CR, or by LF as some firmware does.
    Line(Vec<u8>),
    /// BEL: refused.
    Bell,
    /// More bytes than any line has.
    TooLong,
}

/// Splits bytes into lines.
#[derive(Default)]
pub(super) struct Splitter {
    partial: Vec<u8>,
    overlong: bool,
}

impl Splitter {
    pub fn push(&mut self, bytes: &[u8], mut take: impl FnMut(Text)) {
        for &byte in bytes {
            match byte {
                CR | LF => {
                    let line = std::mem::take(&mut self.partial);
                    match (std::mem::take(&mut self.overlong), byte) {
                        (true, _) => take(Text::TooLong),
                        // The LF of CR LF.
                        (false, LF) if line.is_empty() => {}
                        (false, _) => take(Text::Line(line)),
                    }
                }
                BEL => {
                    self.partial.clear();
                    self.overlong = false;
                    take(Text::Bell);
                }
                _ if self.overlong => {}
                _ if self.partial.len() == MAX_LINE => {
                    self.overlong = true;
                    self.partial.clear();
                }
                _ => self.partial.push(byte),
            }
        }
    }
}

/// A decimal number; 0 if it is none.
pub(super) fn number(digits: &[u8]) -> u16 {
    std::str::from_utf8(digits).ok().and_then(|digits| digits.parse().ok()).unwrap_or(0)
}

/// The number that hexadecimal digits say.
pub(super) fn hex(digits: &[u8]) -> Option<u32> {
    if digits.is_empty() || digits.len() > 8 {
        return None;
    }
    digits.iter().try_fold(0, |value: u32, digit| Some(value << 4 | char::from(*digit).to_digit(16)?))
}

/// A frame as a command.
pub(super) fn line_of(frame: &Frame) -> Vec<u8> {
    let id = frame.id();
    let kind = match (id.is_extended(), frame.is_remote()) {
        (false, false) => 't',
        (true, false) => 'T',
        (false, true) => 'r',
        (true, true) => 'R',
    };
    let width = if id.is_extended() { 8 } else { 3 };
    let mut line = format!("{kind}{:0width$X}{:X}", id.raw(), frame.dlc().min(8));
    for byte in frame.data() {
        // Writing to a text cannot fail.
        let _ = write!(line, "{byte:02X}");
    }
    line.push('\r');
    line.into_bytes()
}
