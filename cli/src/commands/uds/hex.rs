//! Numbers and bytes in hexadecimal, as users write them.

/// Bytes given in hexadecimal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Hex(pub Vec<u8>);

/// See [`Hex`].
pub fn bytes(text: &str) -> Result<Hex, String> {
    let digits: String = text.chars().filter(|letter| !letter.is_whitespace() && *letter != '.').collect();
    let pairs =
        || (0..digits.len()).step_by(2).map(|at| u8::from_str_radix(digits.get(at..at + 2)?, 16).ok());
    let all =
        (digits.is_ascii() && digits.len().is_multiple_of(2)).then(|| pairs().collect::<Option<Vec<u8>>>());
    all.flatten()
        .filter(|bytes| !bytes.is_empty())
        .map(Hex)
        .ok_or_else(|| "write bytes in hexadecimal, two digits each, as 22F190".to_owned())
}

/// A number up to a maximum.
pub fn number(text: &str, most: u32) -> Option<u32> {
    let digits = text.trim_start_matches("0x").trim_start_matches("0X");
    u32::from_str_radix(digits, 16).ok().filter(|number| *number <= most)
}

/// Up to four digits.
pub fn word(text: &str) -> Result<u16, String> {
    number(text, 0xFFFF)
        .map(|word| word as u16)
        .ok_or_else(|| "write up to four hexadecimal digits, as F190".to_owned())
}

/// Up to two digits.
pub fn byte(text: &str) -> Result<u8, String> {
    number(text, 0xFF)
        .map(|byte| byte as u8)
        .ok_or_else(|| "write up to two hexadecimal digits, as 2A".to_owned())
}
