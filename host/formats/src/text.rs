//! Numbers in lines of text, from and to bytes, without allocation: readers and writers of
//! text formats spend most of their time here.

/// Nanoseconds per second.
pub(crate) const NS_PER_S: i64 = 1_000_000_000;

/// The two hexadecimal digits of every byte, upper case.
const HEX_PAIRS: [[u8; 2]; 256] = {
    let digits = b"0123456789ABCDEF";
    let mut pairs = [[0; 2]; 256];
    let mut value = 0;
    while value < 256 {
        pairs[value] = [digits[value >> 4], digits[value & 15]];
        value += 1;
    }
    pairs
};

/// The two decimal digits of every number below 100.
const DECIMAL_PAIRS: [[u8; 2]; 100] = {
    let mut pairs = [[0; 2]; 100];
    let mut value = 0;
    while value < 100 {
        pairs[value] = [b'0' + (value / 10) as u8, b'0' + (value % 10) as u8];
        value += 1;
    }
    pairs
};

/// The value of each hexadecimal digit; 0xFF for every other byte.
const HEX_VALUES: [u8; 256] = {
    let mut values = [0xFF; 256];
    let mut digit = 0;
    while digit < 10 {
        values[(b'0' + digit) as usize] = digit;
        digit += 1;
    }
    let mut digit = 0;
    while digit < 6 {
        values[(b'A' + digit) as usize] = 10 + digit;
        values[(b'a' + digit) as usize] = 10 + digit;
        digit += 1;
    }
    values
};

/// A byte's two hexadecimal digits.
#[inline]
pub(crate) fn hex_pair_of(byte: u8) -> [u8; 2] {
    HEX_PAIRS[byte as usize]
}

/// Appends a byte as two hexadecimal digits.
#[inline]
pub(crate) fn push_hex_byte(out: &mut Vec<u8>, byte: u8) {
    out.extend_from_slice(&hex_pair_of(byte));
}

/// A value's eight hexadecimal digits.
#[inline]
pub(crate) fn hex_digits_of(value: u32) -> [u8; 8] {
    let [a, b, c, d] = value.to_be_bytes().map(hex_pair_of);
    [a[0], a[1], b[0], b[1], c[0], c[1], d[0], d[1]]
}

/// Eight bytes as sixteen hexadecimal digits.
#[inline]
pub(crate) fn hex_digits_of_eight(bytes: [u8; 8]) -> [u8; 16] {
    let mut digits = [0; 16];
    for (pair, byte) in digits.chunks_exact_mut(2).zip(bytes) {
        pair.copy_from_slice(&hex_pair_of(byte));
    }
    digits
}

/// Appends the low `digits` (1 to 8) hexadecimal digits of a value.
#[inline]
pub(crate) fn push_hex(out: &mut Vec<u8>, value: u32, digits: usize) {
    out.extend_from_slice(&hex_digits_of(value)[8 - digits.min(8)..]);
}

/// The six decimal digits of a number below a million.
#[inline]
pub(crate) fn six_digits(value: u32) -> [u8; 6] {
    let pair = |value: u32| DECIMAL_PAIRS[(value % 100) as usize];
    let [[a, b], [c, d], [e, f]] = [pair(value / 10_000), pair(value / 100), pair(value)];
    [a, b, c, d, e, f]
}

/// How many hexadecimal digits a value needs; at least 1.
pub(crate) const fn hex_len(value: u32) -> usize {
    if value == 0 { 1 } else { (35 - value.leading_zeros() as usize) / 4 }
}

/// Appends a decimal number.
#[inline]
pub(crate) fn push_decimal(out: &mut Vec<u8>, value: u64) {
    // Most numbers are channels and lengths.
    if value < 10 {
        out.push(b'0' + value as u8);
    } else {
        push_padded(out, value, 1);
    }
}

/// Appends a decimal number with leading zeros up to `width` (at most 20) digits.
#[inline]
pub(crate) fn push_padded(out: &mut Vec<u8>, mut value: u64, width: usize) {
    let mut digits = [b'0'; 20];
    let mut start = 20;
    while value > 0 {
        start -= 1;
        digits[start] = b'0' + (value % 10) as u8;
        value /= 10;
    }
    out.extend_from_slice(&digits[start.min(20 - width.min(20))..]);
}

/// Appends `value_ns` as seconds (or another unit of `unit_ns` nanoseconds, a power of ten) with
/// `decimals` digits after `mark`, rounded down.
///
/// Inlined because the unit is always a constant, so that three divisions by it disappear.
#[inline]
pub(crate) fn push_time(out: &mut Vec<u8>, value_ns: i64, unit_ns: i64, decimals: u32, mark: u8) {
    let step = (unit_ns / 10_i64.pow(decimals)).max(1);
    let steps = value_ns.div_euclid(step);
    if steps < 0 {
        out.push(b'-');
    }
    let steps = steps.unsigned_abs();
    let per_unit = (unit_ns / step) as u64;
    push_decimal(out, steps / per_unit);
    if decimals > 0 {
        out.push(mark);
        push_padded(out, steps % per_unit, decimals as usize);
    }
}

/// Pads `out` with spaces before `start` until it has at least `width` bytes since then.
pub(crate) fn pad_left(out: &mut Vec<u8>, start: usize, width: usize) {
    let missing = width.saturating_sub(out.len() - start);
    if missing > 0 {
        let end = out.len();
        out.resize(end + missing, b' ');
        out.copy_within(start..end, start + missing);
        out[start..start + missing].fill(b' ');
    }
}

/// Pads `out` with spaces at its end until it has at least `width` bytes since `start`.
pub(crate) fn pad_right(out: &mut Vec<u8>, start: usize, width: usize) {
    let end = start + width;
    if out.len() < end {
        out.resize(end, b' ');
    }
}

/// A hexadecimal digit's value.
#[inline]
pub(crate) fn hex_digit(digit: u8) -> Option<u8> {
    let value = HEX_VALUES[digit as usize];
    (value < 16).then_some(value)
}

/// Two hexadecimal digits.
#[inline]
pub(crate) fn hex_pair(high: u8, low: u8) -> Option<u8> {
    let (high, low) = (HEX_VALUES[high as usize], HEX_VALUES[low as usize]);
    (high | low < 16).then_some(high << 4 | low)
}

/// What follows `0x`, if that is how a number begins.
pub(crate) fn after_0x(word: &[u8]) -> Option<&[u8]> {
    word.strip_prefix(b"0x").or_else(|| word.strip_prefix(b"0X"))
}

/// A number of 32 bits: hexadecimal behind `0x`; without it, decimal or not.
pub(crate) fn number(word: &[u8], is_decimal: bool) -> Option<u32> {
    match after_0x(word) {
        Some(digits) => hex(digits),
        None if is_decimal => decimal(word).and_then(|number| u32::try_from(number).ok()),
        None => hex(word),
    }
}

/// A hexadecimal number of up to eight digits.
#[inline]
pub(crate) fn hex(digits: &[u8]) -> Option<u32> {
    if digits.is_empty() || digits.len() > 8 {
        return None;
    }
    let (mut value, mut seen) = (0, 0);
    for &digit in digits {
        let digit = HEX_VALUES[digit as usize];
        seen |= digit;
        value = value << 4 | u32::from(digit);
    }
    (seen < 16).then_some(value)
}

/// Sixteen hexadecimal digits as eight bytes. One test at the end instead of one per byte: this is the inner loop of
/// reading a log.
#[inline]
pub(crate) fn eight_bytes(digits: &[u8; 16]) -> Option<[u8; 8]> {
    let mut bytes = [0; 8];
    let mut seen = 0;
    for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
        let (high, low) = (HEX_VALUES[pair[0] as usize], HEX_VALUES[pair[1] as usize]);
        seen |= high | low;
        *byte = high << 4 | low;
    }
    (seen < 16).then_some(bytes)
}

/// A decimal number of exactly this many digits, at most 18, checked in a single test.
#[inline]
pub(crate) fn digits<const N: usize>(digits: &[u8; N]) -> Option<i64> {
    const { assert!(N <= 18, "more digits than an i64 holds") };
    let mut value = 0_i64;
    let mut all = true;
    // In pairs: the chain of multiplications is half as long.
    for pair in digits.chunks(2) {
        let mut number = 0;
        for digit in pair {
            let digit = digit.wrapping_sub(b'0');
            all &= digit < 10;
            number = 10 * number + u32::from(digit);
        }
        value = value * if pair.len() == 2 { 100 } else { 10 } + i64::from(number);
    }
    all.then_some(value)
}

/// A decimal number.
#[inline]
pub(crate) fn decimal(digits: &[u8]) -> Option<u64> {
    if digits.is_empty() || digits.len() > 20 {
        return None;
    }
    let mut value = 0_u64;
    for &digit in digits {
        if !digit.is_ascii_digit() {
            return None;
        }
        value = value.checked_mul(10)?.checked_add(u64::from(digit - b'0'))?;
    }
    Some(value)
}

/// A decimal number with an optional sign and fraction, in units of `unit_ns` nanoseconds, converted to
/// nanoseconds. Digits beyond a nanosecond are dropped. `mark` separates the fraction.
pub(crate) fn time(text: &[u8], unit_ns: i64, mark: u8) -> Option<i64> {
    let (negative, text) = match text {
        [b'-', rest @ ..] => (true, rest),
        [b'+', rest @ ..] => (false, rest),
        _ => (false, text),
    };
    let mut whole = 0_i64;
    let mut digits = 0;
    let mut rest = text;
    while let [digit @ b'0'..=b'9', after @ ..] = rest {
        whole = whole.checked_mul(10)?.checked_add(i64::from(digit - b'0'))?;
        digits += 1;
        rest = after;
    }
    let mut value = whole.checked_mul(unit_ns)?;
    if let [first, fraction @ ..] = rest {
        if *first != mark {
            return None;
        }
        let mut scale = unit_ns;
        for digit in fraction {
            if !digit.is_ascii_digit() {
                return None;
            }
            scale /= 10;
            value = value.checked_add(i64::from(digit - b'0') * scale)?;
            digits += 1;
        }
    }
    if digits == 0 {
        return None;
    }
    Some(if negative { -value } else { value })
}

/// Like [`time`], with a point or a comma before the fraction: programs follow their computer's language.
#[inline]
pub(crate) fn time_of_any_mark(text: &[u8], unit_ns: i64) -> Option<i64> {
    time(text, unit_ns, b'.').or_else(|| time(text, unit_ns, b','))
}

/// Splits off the first word: returns it and the rest. The word is empty at the end.
#[inline]
pub(crate) fn word(text: &[u8]) -> (&[u8], &[u8]) {
    let text = text.trim_ascii_start();
    let end = text.iter().position(u8::is_ascii_whitespace).unwrap_or(text.len());
    text.split_at(end)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn text(push: impl FnOnce(&mut Vec<u8>)) -> String {
        let mut out = Vec::new();
        push(&mut out);
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn times_are_rounded_down_also_before_the_epoch() {
        assert_eq!(text(|out| push_time(out, 1_999, NS_PER_S, 6, b'.')), "0.000001");
        assert_eq!(text(|out| push_time(out, -1, NS_PER_S, 6, b'.')), "-0.000001");
        assert_eq!(text(|out| push_time(out, -1_500_000_000, NS_PER_S, 3, b',')), "-1,500");
        assert_eq!(text(|out| push_time(out, 12_345_678, 1_000_000, 0, b'.')), "12");
    }

    #[test]
    fn numbers_that_are_none_are_refused() {
        for bad in ["", "-", ".", "1.2.3", "1e5", "1,5", " 1", "99999999999999999999"] {
            assert_eq!(time(bad.as_bytes(), NS_PER_S, b'.'), None, "{bad}");
        }
        assert_eq!(time(b".5", NS_PER_S, b'.'), Some(500_000_000));
        assert_eq!(time(b"7.", NS_PER_S, b'.'), Some(7_000_000_000));
        assert_eq!(time(b"0.1234567899", NS_PER_S, b'.'), Some(123_456_789));
        assert_eq!((hex(b""), hex(b"123456789"), hex(b"G")), (None, None, None));
        assert_eq!((decimal(b"18446744073709551616"), decimal(b"1x")), (None, None));
    }

    proptest! {
        #[test]
        fn what_is_written_reads_back(value: u64, id: u32, byte: u8, time_ns: i64) {
            prop_assert_eq!(decimal(text(|out| push_decimal(out, value)).as_bytes()), Some(value));
            let digits = text(|out| push_hex(out, id, 8));
            prop_assert_eq!(hex(digits.as_bytes()), Some(id));
            prop_assert_eq!(hex_len(id), format!("{id:x}").len());
            let pair = text(|out| push_hex_byte(out, byte)).into_bytes();
            prop_assert_eq!(hex_pair(pair[0], pair[1]), Some(byte));
            let sixteen = format!("{value:016x}").into_bytes();
            prop_assert_eq!(eight_bytes(sixteen.first_chunk().unwrap()), Some(value.to_be_bytes()));
            let ten = format!("{id:010}").into_bytes();
            prop_assert_eq!(super::digits::<10>(ten.first_chunk().unwrap()), Some(i64::from(id)));
            prop_assert_eq!(super::digits(b"12:4"), None);
            prop_assert_eq!(eight_bytes(b"0123456789ABCDEG"), None);
            // The extreme second cannot be written without an overflow when read back.
            let time_ns = time_ns.clamp(-i64::MAX, i64::MAX);
            let written = text(|out| push_time(out, time_ns, NS_PER_S, 9, b'.'));
            prop_assert_eq!(time(written.as_bytes(), NS_PER_S, b'.'), Some(time_ns));
        }
    }
}
