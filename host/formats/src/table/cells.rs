//! What a cell of a table says.

use super::super::issue::Fault;
use super::super::text;
use cantap_trace::Direction;
use cantap_trace::fd::FD_MAX_BYTES;

pub(super) fn id(shown: &[u8], decimal: bool) -> Result<u32, Fault> {
    // Also in front of the bytes: `0x085: 7C 33`.
    let mark = shown.last().filter(|last| matches!(last, b'h' | b'x' | b':'));
    let digits = &shown[..shown.len() - usize::from(mark.is_some())];
    let digits = if decimal { whole(digits) } else { digits };
    let number = text::number(digits, decimal);
    let expected =
        if decimal { "an identifier in decimal digits" } else { "an identifier in hexadecimal digits" };
    number.ok_or_else(|| Fault::malformed(expected, shown))
}

/// A whole number without the fraction that programs put behind it which know no whole numbers, such as pandas where a row has nothing in its column.
pub(super) fn whole(cell: &[u8]) -> &[u8] {
    cell.strip_suffix(b".0").unwrap_or(cell)
}

/// A length.
pub(super) fn length(cell: &[u8]) -> Result<usize, Fault> {
    let number = match text::after_0x(cell) {
        Some(digits) => text::hex(digits).map(u64::from),
        None => text::decimal(whole(cell)),
    };
    let len = number.filter(|len| *len <= FD_MAX_BYTES as u64);
    len.map(|len| len as usize).ok_or_else(|| Fault::malformed("a length of 0 to 64", cell))
}

/// Yes or no, as different programs write it; `None` for anything else.
pub(super) fn mark(cell: &[u8]) -> Option<bool> {
    let is = |words: &[&str]| words.iter().any(|word| cell.eq_ignore_ascii_case(word.as_bytes()));
    if is(&[
        "1", "true", "t", "yes", "y", "x", "e", "ext", "extended", "xtd", "29", "29-bit", "r", "rtr",
        "remote",
    ]) {
        Some(true)
    } else if is(&["0", "false", "f", "no", "n", "s", "std", "standard", "11", "11-bit", "d", "-", ""]) {
        Some(false)
    } else {
        None
    }
}

pub(super) fn direction(way: &[u8]) -> Result<Direction, Fault> {
    let is = |words: &[&str]| words.iter().any(|word| way.eq_ignore_ascii_case(word.as_bytes()));
    if is(&["rx", "r", "receive", "received", "in", "0", "f", "false", ""]) {
        Ok(Direction::Rx)
    } else if is(&["tx", "t", "transmit", "transmitted", "sent", "out", "1", "true"]) {
        Ok(Direction::Tx)
    } else {
        Err(Fault::malformed("'Rx' or 'Tx'", way))
    }
}

/// Whether a cell of a byte holds none.
pub(super) fn is_empty(cell: &[u8]) -> bool {
    cell.is_empty() || cell.eq_ignore_ascii_case(b"nan") || cell == b"-"
}

/// One byte.
pub(super) fn byte(cell: &[u8], decimal: bool) -> Option<u8> {
    let cell = if decimal { whole(cell) } else { cell };
    text::number(cell, decimal).and_then(|byte| u8::try_from(byte).ok())
}

/// Whether a cell is a list or a tuple as Python prints one, `[78, 32, 137]`: its numbers are decimal.
pub(super) fn is_list(cell: &[u8]) -> bool {
    let between = |first: &[u8], last: &[u8]| cell.strip_prefix(first)?.strip_suffix(last);
    let inner = between(b"[", b"]").or_else(|| between(b"(", b")"));
    let is_number =
        |word: &[u8]| text::decimal(word).is_some() && (word.len() == 1 || !word.starts_with(b"0"));
    inner.is_some_and(|inner| {
        inner.contains(&b',') && inner.split(|byte| *byte == b',').all(|word| is_number(word.trim_ascii()))
    })
}

/// Whether a cell is in brackets.
pub(super) fn is_bracketed(cell: &[u8]) -> bool {
    matches!(cell, [b'[', .., b']'] | [b'(', .., b')'])
}

/// Whether the numbers in these cells in brackets are decimal: Python separates those of a list with commas, numpy those of an array with blanks,
/// and neither writes leading zeros. A single number in each is one of Python's.
pub(crate) fn lists_are_decimal(cells: &[&[u8]]) -> bool {
    let words = |cell: &'_ [u8]| {
        let inner = cell[1..cell.len() - 1].to_vec();
        inner
            .split(|byte| matches!(byte, b' ' | b','))
            .filter(|word| !word.is_empty())
            .map(<[u8]>::to_vec)
            .collect::<Vec<_>>()
    };
    let all: Vec<_> = cells.iter().map(|cell| words(cell)).collect();
    let is_plain =
        |word: &Vec<u8>| text::decimal(word).is_some() && (word.len() == 1 || !word.starts_with(b"0"));
    if !all.iter().flatten().all(is_plain) {
        return false;
    }
    let shows = |word: &Vec<u8>| matches!(word.len(), 1 | 3);
    cells.iter().any(|cell| is_list(cell))
        || all.iter().flatten().any(shows)
        || !all.is_empty() && all.iter().all(|words| words.len() < 2)
}

/// What Python prints of bytes, between its quotation marks: of `b'\xca\x18%'` or `bytearray(b'\xca\x18%')`, what an `str` of a message's data is.
fn python_bytes(cell: &[u8]) -> Option<&[u8]> {
    let inner = cell.strip_prefix(b"bytearray(").and_then(|cell| cell.strip_suffix(b")")).unwrap_or(cell);
    let quoted = inner.strip_prefix(b"b")?;
    // A cell with a quotation mark in it has each one twice.
    [&b"'"[..], b"\"\"", b"\""].iter().find_map(|mark| quoted.strip_prefix(*mark)?.strip_suffix(*mark))
}

/// The bytes that Python printed: those of letters as letters, the others escaped.
fn push_python_bytes(shown: &[u8], bytes: &mut Vec<u8>) -> Option<()> {
    let mut rest = shown;
    while let Some((first, after)) = rest.split_first() {
        let (byte, after) = match (first, after) {
            (b'\\', [b'x', high, low, after @ ..]) => (text::hex_pair(*high, *low)?, after),
            (b'\\', [escaped, after @ ..]) => {
                let byte = match escaped {
                    b'n' => b'\n',
                    b'r' => b'\r',
                    b't' => b'\t',
                    b'\\' | b'\'' | b'"' => *escaped,
                    _ => return None,
                };
                (byte, after)
            }
            (b'\\', []) => return None,
            (b'"', [b'"', after @ ..]) => (b'"', after),
            _ => (*first, after),
        };
        bytes.push(byte);
        rest = after;
    }
    Some(())
}

/// The bytes of a cell: digits without gaps, bytes with something between them, or what Python prints.
pub(super) fn push_bytes(cell: &[u8], decimal: bool, bytes: &mut Vec<u8>) -> Result<(), Fault> {
    if [&b"b'"[..], b"b\"", b"bytearray"].iter().any(|start| cell.starts_with(start)) {
        let read = python_bytes(cell).and_then(|shown| push_python_bytes(shown, bytes));
        return read.ok_or_else(|| Fault::malformed("data bytes", cell));
    }
    let is_between = |byte: &u8| {
        matches!(
            byte,
            b' ' | b'-' | b':' | b',' | b';' | b'_' | b'.' | b'|' | b'[' | b']' | b'\'' | b'(' | b')'
        )
    };
    for word in cell.split(is_between).filter(|word| !word.is_empty()) {
        let fault = || Fault::malformed("data bytes", cell);
        // No bytes at all, as Cabana writes them.
        if text::after_0x(word).is_some_and(<[u8]>::is_empty) {
            continue;
        }
        if decimal || text::after_0x(word).unwrap_or(word).len() <= 2 {
            bytes.push(byte(word, decimal).ok_or_else(fault)?);
        } else {
            let digits = text::after_0x(word).unwrap_or(word);
            if !digits.len().is_multiple_of(2) {
                return Err(fault());
            }
            for pair in digits.chunks_exact(2) {
                bytes.push(text::hex_pair(pair[0], pair[1]).ok_or_else(fault)?);
            }
        }
    }
    Ok(())
}
