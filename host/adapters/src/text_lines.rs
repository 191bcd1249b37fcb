//! The lines of adapters that speak text: taken apart, and their numbers.

/// The longest line there is: an extended frame with eight bytes and a stamp is 35 bytes, `V` of CANable a web address.
const MAX_LINE: usize = 128;
const CR: u8 = b'\r';
const LF: u8 = b'\n';
/// Some chips insert it (ELM327 data sheet, "Communicating with the ELM327"); it is never part of a line.
const NUL: u8 = 0;

/// One line, without its end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Text {
    /// Ended by CR, or by LF as some firmware does.
    Line(Vec<u8>),
    /// The byte that stands outside lines: see [`Mark`].
    Mark,
    /// More bytes than any line has.
    TooLong,
}

/// The byte that means something by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mark {
    /// slcan's BEL refuses, whatever half a line is before it.
    Bell,
    /// The ELM327's prompt `>`. What is before it is a line.
    Prompt,
}

impl Mark {
    const fn byte(self) -> u8 {
        match self {
            Self::Bell => 7,
            Self::Prompt => b'>',
        }
    }
}

/// Splits bytes into lines.
pub(crate) struct Splitter {
    mark: Mark,
    partial: Vec<u8>,
    overlong: bool,
}

impl Splitter {
    pub const fn new(mark: Mark) -> Self {
        Self { mark, partial: Vec::new(), overlong: false }
    }

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
                _ if byte == self.mark.byte() => {
                    let line = std::mem::take(&mut self.partial);
                    let overlong = std::mem::take(&mut self.overlong);
                    if self.mark == Mark::Prompt && overlong {
                        take(Text::TooLong);
                    } else if self.mark == Mark::Prompt && !line.is_empty() {
                        take(Text::Line(line));
                    }
                    take(Text::Mark);
                }
                NUL if self.mark == Mark::Prompt => {}
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
pub(crate) fn number(digits: &[u8]) -> u16 {
    std::str::from_utf8(digits).ok().and_then(|digits| digits.parse().ok()).unwrap_or(0)
}

/// The number that hexadecimal digits say.
pub(crate) fn hex(digits: &[u8]) -> Option<u32> {
    if digits.is_empty() || digits.len() > 8 {
        return None;
    }
    digits.iter().try_fold(0, |value: u32, digit| Some(value << 4 | char::from(*digit).to_digit(16)?))
}
