//! The parts of a printed line.

use std::borrow::Cow;

use super::super::text;
use cantap_trace::Direction;

/// What a label stands before.
#[derive(Clone, Copy, PartialEq)]
enum Part {
    Id,
    Standard,
    Extended,
    IsExtended,
    IsRemote,
    Len,
    Data,
    Other,
}

/// The last one or two words before a colon or an equals sign, as programs have them.
const LABELS: &[(&str, Part)] = &[
    ("standard id", Part::Standard),
    ("std id", Part::Standard),
    ("stdid", Part::Standard),
    ("extended id", Part::Extended),
    ("ext id", Part::Extended),
    ("extid", Part::Extended),
    ("id", Part::Id),
    ("canid", Part::Id),
    ("can_id", Part::Id),
    ("identifier", Part::Id),
    ("dlc", Part::Len),
    ("dl", Part::Len),
    ("len", Part::Len),
    ("length", Part::Len),
    ("size", Part::Len),
    ("data", Part::Data),
    ("bytes", Part::Data),
    ("buffer", Part::Data),
    ("buf", Part::Data),
    ("payload", Part::Data),
    ("ext", Part::IsExtended),
    ("extended", Part::IsExtended),
    ("ide", Part::IsExtended),
    ("rtr", Part::IsRemote),
    ("remote", Part::IsRemote),
];

/// Words before the identifier that say that the frame was sent.
const SENT: &[&str] = &["tx", "sent", "send", "sending", "transmit", "transmitted"];

/// Where a frame's parts are in a line.
#[derive(Default)]
pub(super) struct Parts<'a> {
    pub id: Option<Cow<'a, [u8]>>,
    /// The line says that the identifier is decimal.
    pub is_decimal: bool,
    pub extended: Option<bool>,
    pub remote: bool,
    pub len: Option<usize>,
    pub data: Option<&'a [u8]>,
    pub direction: Direction,
    /// It is a line of arduino-CAN's example, whose bytes stand below: as characters, or as numbers if somebody changed it.
    pub is_packet: bool,
}

/// The last word, and what is before it.
fn last_word(text: &[u8]) -> (&[u8], &[u8]) {
    let text = text.trim_ascii_end();
    let is_of_word = |byte: &u8| byte.is_ascii_alphanumeric() || *byte == b'_';
    let at = text.iter().rposition(|byte| !is_of_word(byte)).map_or(0, |at| at + 1);
    text.split_at(at)
}

/// The part whose label ends this text, and where the label begins.
fn label(text: &[u8]) -> Option<(Part, usize)> {
    let (before, word) = last_word(text);
    if !word.last().is_some_and(u8::is_ascii_alphabetic) {
        return None;
    }
    let (start, other) = last_word(before);
    let two = [other, b" ", word].concat().to_ascii_lowercase();
    let one = word.to_ascii_lowercase();
    let named = |name: &[u8]| LABELS.iter().find(|(label, _)| label.as_bytes() == name);
    if let Some((_, part)) = named(&two) {
        return Some((*part, start.len()));
    }
    let known = named(&one).map(|(_, part)| *part);
    // Bytes may have colons between them.
    let is_byte = word.len() <= 2 && text::hex(word).is_some();
    known.or((!is_byte).then_some(Part::Other)).map(|part| (part, before.len()))
}

impl<'a> Parts<'a> {
    /// Those of a line without its time.
    pub(super) fn of(line: &'a [u8]) -> Self {
        let mut parts = Self::default();
        let mut last: Option<(Part, usize)> = None;
        for at in memchr::memchr2_iter(b':', b'=', line) {
            let from = last.map_or(0, |(_, from)| from);
            let Some((part, start)) = label(&line[from.min(at)..at]) else { continue };
            if let Some((before, _)) = last {
                parts.take(before, &line[from..from + start]);
            }
            if matches!(part, Part::Id | Part::Standard | Part::Extended) {
                parts.direction = direction(&line[..from + start]);
            }
            last = Some((part, at + 1));
        }
        if let Some((part, from)) = last {
            parts.take(part, &line[from..]);
        }
        if parts.id.is_none()
            && let Some(id) = after_words(line, b"id is ")
        {
            let id = tokens(id).next().unwrap_or_default();
            parts.is_decimal = text::after_0x(id).is_none();
            parts.id = text::number(id, parts.is_decimal).map(|_| Cow::Borrowed(id));
        }
        if parts.id.is_none()
            && let Some(id) = after_words(line, b"packet with id ")
        {
            let id = tokens(id).next().unwrap_or_default();
            parts.id = text::number(id, false).map(|_| Cow::Borrowed(id));
            parts.is_packet = parts.id.is_some();
            parts.extended = Some(contains(line, b"extended "));
            parts.remote = contains(line, b"rtr packet");
            let len = after_words(line, b"length ").and_then(|len| tokens(len).next());
            parts.len = len.and_then(|len| text::number(len, true)).map(|len| len as usize);
        }
        parts.remote |= contains(line, b"remote request") || contains(line, b"(rtr)");
        parts
    }

    fn take(&mut self, part: Part, value: &'a [u8]) {
        let first = tokens(value).next().unwrap_or_default();
        match part {
            // A device's, behind the frame's.
            Part::Id if self.id.is_some() && self.extended.is_some() => {}
            Part::Id | Part::Standard | Part::Extended => {
                if part != Part::Id {
                    self.extended = Some(part == Part::Extended);
                }
                self.id = Some(Cow::Borrowed(first)).filter(|_| !first.is_empty());
            }
            Part::IsExtended => self.extended = yes(first),
            Part::IsRemote => self.remote |= yes(first).unwrap_or(false),
            Part::Len => self.len = text::number(first, true).map(|len| len as usize),
            Part::Data => self.data = Some(value),
            Part::Other => {}
        }
    }

    /// Without the line.
    pub(super) fn into_owned(self) -> Parts<'static> {
        let id = self.id.map(|id| Cow::Owned(id.into_owned()));
        Parts { id, data: None, ..self }
    }
}

fn yes(word: &[u8]) -> Option<bool> {
    match word.to_ascii_lowercase().as_slice() {
        b"1" | b"true" | b"yes" => Some(true),
        b"0" | b"false" | b"no" => Some(false),
        _ => None,
    }
}

fn direction(before: &[u8]) -> Direction {
    let mut words = before.split(|byte| !byte.is_ascii_alphabetic());
    let is_sent = words.any(|word| SENT.iter().any(|sent| word.eq_ignore_ascii_case(sent.as_bytes())));
    if is_sent { Direction::Tx } else { Direction::Rx }
}

fn find(line: &[u8], words: &[u8]) -> Option<usize> {
    line.windows(words.len()).position(|window| window.eq_ignore_ascii_case(words))
}

fn contains(line: &[u8], words: &[u8]) -> bool {
    find(line, words).is_some()
}

fn after_words<'a>(line: &'a [u8], words: &[u8]) -> Option<&'a [u8]> {
    let at = find(line, words)?;
    let begins = at == 0 || !line[at - 1].is_ascii_alphanumeric();
    begins.then(|| &line[at + words.len()..])
}

/// The line of ESP-IDF's example that says whether the next identifier has 29 bits.
pub(super) fn says_format(line: &[u8]) -> Option<bool> {
    let words = after_words(line, b"message is in ")?;
    match words.to_ascii_lowercase().as_slice() {
        b"extended format" => Some(true),
        b"standard format" => Some(false),
        _ => None,
    }
}

/// Whether a line is the names above a table of the three parts.
pub(super) fn are_names(line: &[u8]) -> bool {
    let words: Vec<_> = line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()).collect();
    matches!(&words[..], [id, dlc, data] if id.eq_ignore_ascii_case(b"id") && dlc.eq_ignore_ascii_case(b"dlc") && data.eq_ignore_ascii_case(b"data"))
}

/// The words of a value.
pub(super) fn tokens(value: &[u8]) -> impl Iterator<Item = &[u8]> {
    let is_between = |byte: &u8| byte.is_ascii_whitespace() || b",;[](){}|-:.\"".contains(byte);
    value.split(is_between).filter(|word| !word.is_empty())
}

/// The list in brackets that a value begins with, as Python prints one.
pub(super) fn list(value: &[u8]) -> Option<&[u8]> {
    let value = value.trim_ascii_start();
    let end = memchr::memchr(b']', value).filter(|_| value.starts_with(b"["))?;
    Some(&value[..=end]).filter(|list| list.contains(&b','))
}

fn byte(word: &[u8], is_decimal: bool) -> Option<u8> {
    let number = match text::after_0x(word) {
        None if is_decimal => text::number(word, true),
        digits => text::hex(digits.unwrap_or(word)).filter(|_| digits.unwrap_or(word).len() <= 2),
    };
    number.and_then(|number| u8::try_from(number).ok())
}

/// The bytes that a value begins with: a word each, or all in a word.
pub(super) fn bytes_of<'a>(words: impl Iterator<Item = &'a [u8]>, is_decimal: bool) -> Vec<u8> {
    let mut words = words.peekable();
    let first = words.peek().map(|word| text::after_0x(word).unwrap_or(word)).unwrap_or_default();
    if first.len() > 2 && first.len().is_multiple_of(2) && !is_decimal {
        let pairs = first.chunks(2).map(|pair| text::hex_pair(pair[0], pair[1]));
        return pairs.collect::<Option<_>>().unwrap_or_default();
    }
    words.map_while(|word| byte(word, is_decimal)).collect()
}

/// A line of bytes and nothing else.
pub(super) fn plain_bytes(line: &[u8]) -> Option<&[u8]> {
    let mut words = tokens(line);
    let is_byte = |word: &[u8]| byte(word, false).or_else(|| byte(word, true)).is_some();
    (words.next().is_some_and(is_byte) && words.all(is_byte)).then_some(line)
}

/// The bytes of a line behind an identifier, after `count` of them, and whether they are the last ones if no length says it: a line of bytes,
/// `Byte: 0 = 01, 1 = 02,`, or `Data byte 0 = 1`, of which more may come. `None` if it is another line.
pub(super) fn next_line(line: &[u8], count: usize, is_decimal: bool) -> Option<(Vec<u8>, bool)> {
    if let Some(one) = after_words(line, b"data byte ") {
        let mut words = one.split(|byte| *byte == b'=').map(<[u8]>::trim_ascii);
        let (number, value) = (text::decimal(words.next()?)?, words.next()?);
        let value = u8::try_from(text::number(value, true)?).ok()?;
        return (number == count as u64).then(|| (vec![value], false));
    }
    if count > 0 {
        return None;
    }
    if let Some(numbered) = after_words(line, b"byte:") {
        let pairs =
            numbered.split(|byte| *byte == b',').map(<[u8]>::trim_ascii).filter(|pair| !pair.is_empty());
        let bytes = pairs.enumerate().map(|(at, pair)| {
            let equals = memchr::memchr(b'=', pair)?;
            let number = text::decimal(pair[..equals].trim_ascii())?;
            byte(pair[equals + 1..].trim_ascii(), is_decimal).filter(|_| number == at as u64)
        });
        return Some((bytes.collect::<Option<_>>()?, true));
    }
    let after = ["data:", "data ="].iter().find_map(|label| after_words(line, label.as_bytes()));
    let bytes = after.or_else(|| plain_bytes(line))?;
    let count = tokens(bytes).count();
    let bytes = bytes_of(tokens(bytes), is_decimal);
    (bytes.len() == count || after.is_some() && !bytes.is_empty()).then_some((bytes, true))
}

/// How the line below one of arduino-CAN's has so many bytes.
pub(super) enum Packet {
    /// As numbers.
    Numbers(Vec<u8>),
    /// As characters, as the example prints them.
    Characters,
    /// Either: a single digit.
    Either(u8),
}

impl Packet {
    pub(super) fn of(line: &[u8], len: usize, is_decimal: bool) -> Option<Self> {
        let words = tokens(line).count();
        let numbers = bytes_of(tokens(line), is_decimal);
        let are_numbers = numbers.len() == len && (words == len || words == 1 && line.len() == 2 * len);
        match (are_numbers, line.len() == len) {
            (true, true) => numbers.first().map(|byte| Self::Either(*byte)),
            (true, false) => Some(Self::Numbers(numbers)),
            (false, true) => Some(Self::Characters),
            (false, false) => None,
        }
    }
}

/// A line without the terminal's colours.
pub(super) fn without_colours(line: &[u8]) -> Cow<'_, [u8]> {
    if memchr::memchr(0x1B, line).is_none() {
        return Cow::Borrowed(line);
    }
    let mut rest = line;
    let mut clean = Vec::with_capacity(line.len());
    while let Some(at) = memchr::memchr(0x1B, rest) {
        clean.extend_from_slice(&rest[..at]);
        let end = rest[at..].iter().position(|byte| *byte == b'm').map_or(rest.len(), |end| at + end + 1);
        rest = &rest[end..];
    }
    clean.extend_from_slice(rest);
    Cow::Owned(clean.trim_ascii().to_vec())
}
