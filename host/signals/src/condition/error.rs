//! What is wrong with a condition, with the place marked.

use std::fmt;

use crate::Suggestion;

/// Why a text is not a condition.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConditionError {
    /// The condition.
    pub text: String,
    /// Where it is wrong, in bytes.
    pub at: usize,
    /// What is wrong.
    pub fault: ConditionFault,
}

/// What is wrong.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ConditionFault {
    /// Something else should be here.
    #[error("expected {expected}, found {found}")]
    Unexpected {
        /// What was expected.
        expected: &'static str,
        /// What was found.
        found: String,
    },
    /// A character that no part of a condition starts with.
    #[error("{0:?} has no meaning here")]
    Character(char),
    /// The closing quote is missing.
    #[error("this text has no closing quote")]
    OpenText,
    /// Not a number.
    #[error("{}", not_a_number(.0))]
    Number(String),
    /// An identifier compared with a number that is another one in hexadecimal digits.
    #[error(
        "identifiers are hexadecimal: write 0x{0} for the one that is shown as {0}, or 0x{1:X} for the one that is {0} in decimal digits"
    )]
    DecimalId(String, u64),
    /// An identifier compared with what filters take as a range.
    #[error("a range of identifiers is written id >= 0x{0:X} and id <= 0x{1:X}")]
    IdRange(u64, u64),
    /// A part of a frame compared with a number that it never has.
    #[error("{what} is from {first} to {last}")]
    NeverEqual {
        /// The part, with its article.
        what: &'static str,
        /// The lowest number that it can have.
        first: String,
        /// The highest one.
        last: String,
    },
    /// `a < b < c`.
    #[error("comparisons cannot be chained; write \"a < b and b < c\"")]
    Chained,
    /// Not the index of a data byte.
    #[error("a frame has no byte {0}; bytes are counted from 0 to 7, in CAN FD to 63")]
    ByteIndex(String),
    /// An unknown name.
    #[error("there is no signal or message {name:?}{near}")]
    UnknownName {
        /// The name.
        name: String,
        /// A similar name.
        near: Suggestion,
    },
    /// An unknown name, because no database was loaded.
    #[error("{0:?} is not part of a frame, and without a database there are neither signals nor messages")]
    NoDatabase(String),
    /// A number whose truth is asked: the same for every record.
    #[error("{}", lone_number(.0))]
    LoneNumber(String),
    /// A text where it cannot be compared.
    #[error("a text can only be compared with a signal, by == or !=")]
    LoneText,
    /// A text that the signal does not have.
    #[error("{signal} has no value {text:?}{choices}")]
    UnknownText {
        /// The signal.
        signal: String,
        /// The text.
        text: String,
        /// The texts it has, ready for printing.
        choices: String,
    },
    /// Too long.
    #[error("a condition may have {0} characters at most")]
    TooLong(usize),
    /// Parentheses are nested too deeply.
    #[error("parentheses are nested deeper than {0}")]
    TooDeep(usize),
}

/// With what may have been meant.
fn not_a_number(digits: &str) -> String {
    let is_hex = digits.len() <= 8 && digits.bytes().all(|byte| byte.is_ascii_hexdigit());
    let meant = if is_hex { format!("; in hexadecimal digits it is 0x{digits}") } else { String::new() };
    format!("{digits:?} is not a number{meant}")
}

/// With what was meant by whoever searches for an identifier.
fn lone_number(digits: &str) -> String {
    let digits = digits.trim_start_matches("0x").trim_start_matches("0X");
    let is_id = u32::from_str_radix(digits, 16).is_ok_and(|raw| raw <= 0x1FFF_FFFF);
    let meant =
        if is_id { format!("; frames with that identifier are id == 0x{digits}") } else { String::new() };
    format!("a number is to be compared with something{meant}")
}

impl fmt::Display for ConditionError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if matches!(self.fault, ConditionFault::TooLong(_)) {
            return write!(f, "{}", self.fault);
        }
        let before = self.text.get(..self.at).unwrap_or(&self.text);
        writeln!(f, "{}", self.fault)?;
        // A condition from a file can contain line ends and tabs: show it on one line, one column per
        // character.
        writeln!(f, "  {}", self.text.replace(cantap_trace::clean::is_harmful, " "))?;
        write!(f, "  {}^", " ".repeat(before.chars().count()))
    }
}

impl std::error::Error for ConditionError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        Some(&self.fault)
    }
}
