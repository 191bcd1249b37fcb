//! Objects in a text of JSON: where the next one ends, and the names and values in it. A general parser would round times of nanoseconds to what a
//! float holds, and end at the first damaged byte.

/// The longest object that is taken apart; a frame has some hundred bytes.
const MOST_BYTES: usize = 256 << 10;

/// What comes next in a text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Next {
    /// An object, from here to there. `inner` is where an array of objects in it begins.
    Object { start: usize, end: usize, inner: Option<usize> },
    /// An object that is longer than any frame, with an array of objects in it, which begins there.
    Wrapper { inner: usize },
    /// Something else, from here to there.
    Other { start: usize, end: usize },
    /// An object that is not whole, although the text goes on behind it.
    Broken { start: usize, end: usize },
    /// Its end is not there yet.
    More { start: usize },
    /// Nothing.
    End,
}

/// Finds the next object. `inside` says that the text is inside of an object that was entered.
pub(super) fn next(text: &[u8], inside: bool) -> Next {
    let mut at = 0;
    while let Some(byte) = text.get(at) {
        match byte {
            b'{' => return object(text, at),
            // RS begins each text of a JSON text sequence (RFC 7464).
            b' ' | b'\t' | b'\r' | b'\n' | b',' | b'[' | b']' | 0x1E => at += 1,
            b'"' if inside => match string_end(text, at) {
                StringEnd::At(end) => at = end,
                StringEnd::Broken(_) => at += 1,
                StringEnd::More => return Next::More { start: at },
            },
            _ if inside => at += 1,
            _ => {
                if let Some(topic) = behind_topic(&text[at..]) {
                    return object(text, at + topic);
                }
                let end = memchr::memchr(b'\n', &text[at..]);
                return end.map_or(Next::More { start: at }, |end| Next::Other { start: at, end: at + end });
            }
        }
    }
    Next::End
}

/// Whether an object begins behind other words on the first line.
pub(super) fn begins_behind_topic(text: &[u8]) -> bool {
    behind_topic(text).is_some()
}

/// Where an object begins behind other words on its line: a topic, as `mosquitto_sub -v` prints it, or a time.
fn behind_topic(text: &[u8]) -> Option<usize> {
    /// Longer than any topic with a time.
    const MOST_BYTES: usize = 300;
    let line = text[..text.len().min(MOST_BYTES)].split(|byte| *byte == b'\n').next()?;
    let brace = memchr::memchr(b'{', line)?;
    let (before, rest) = line.split_at(brace);
    let is_object = rest[1..].trim_ascii_start().first().is_none_or(|first| matches!(first, b'"' | b'}'));
    (before.ends_with(b" ") && memchr::memchr2(b'"', b'}', before).is_none() && is_object).then_some(brace)
}

enum StringEnd {
    /// Behind the closing mark.
    At(usize),
    /// A line ends in it, which none may.
    Broken(usize),
    More,
}

fn string_end(text: &[u8], start: usize) -> StringEnd {
    let mut at = start + 1;
    while let Some(byte) = text.get(at) {
        match byte {
            b'"' => return StringEnd::At(at + 1),
            b'\n' => return StringEnd::Broken(at),
            b'\\' => at += 2,
            _ => at += 1,
        }
    }
    StringEnd::More
}

fn object(text: &[u8], start: usize) -> Next {
    let (mut at, mut depth, mut before, mut inner) = (start, 0_usize, b':', None);
    while let Some(byte) = text.get(at).filter(|_| at - start < MOST_BYTES) {
        match byte {
            b'"' => {
                at = match string_end(text, at) {
                    StringEnd::At(end) => end,
                    StringEnd::Broken(end) => return Next::Broken { start, end },
                    StringEnd::More => return Next::More { start },
                };
                before = b'"';
                continue;
            }
            b'{' | b'[' => {
                // Where no value may be, another object begins, and this one is not whole.
                if *byte == b'{' && !matches!(before, b':' | b'[' | b',') {
                    return Next::Broken { start, end: at };
                }
                if *byte == b'{' && before == b'[' {
                    inner.get_or_insert(at);
                }
                depth += 1;
            }
            b'}' | b']' => {
                depth -= 1;
                if depth == 0 {
                    return Next::Object { start, end: at + 1, inner };
                }
            }
            _ => {}
        }
        if !byte.is_ascii_whitespace() {
            before = *byte;
        }
        at += 1;
    }
    match (text.len() - start < MOST_BYTES, inner) {
        (true, _) => Next::More { start },
        (false, Some(inner)) => Next::Wrapper { inner },
        (false, None) => Next::Broken { start, end: at },
    }
}

/// What kind of value a name has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Number,
    Text,
    /// An array of numbers up to 255, as hexadecimal digits.
    Bytes,
    Nothing,
}

/// A name and its value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Field {
    pub name: String,
    pub kind: Kind,
    pub value: String,
}

/// The names and values of a whole object, also of objects in it, whose names stand behind those around them.
pub(super) fn fields(object: &[u8]) -> Option<Vec<Field>> {
    let mut found = Vec::new();
    let mut at = 0;
    push_fields(object, &mut at, 0, &mut found)?;
    found.sort_by_key(|(depth, _)| *depth);
    let mut fields: Vec<Field> = Vec::with_capacity(found.len());
    for (_, field) in found {
        if fields.iter().all(|other| other.name != field.name) {
            fields.push(field);
        }
    }
    Some(fields)
}

fn skip_space(text: &[u8], at: &mut usize) -> Option<u8> {
    while text.get(*at)?.is_ascii_whitespace() {
        *at += 1;
    }
    text.get(*at).copied()
}

fn take(text: &[u8], at: &mut usize, wanted: u8) -> Option<()> {
    (skip_space(text, at)? == wanted).then(|| *at += 1)
}

fn push_fields(text: &[u8], at: &mut usize, depth: usize, found: &mut Vec<(usize, Field)>) -> Option<()> {
    /// Deeper than any frame.
    const MOST_DEPTH: usize = 8;
    take(text, at, b'{')?;
    if skip_space(text, at)? == b'}' {
        *at += 1;
        return Some(());
    }
    loop {
        skip_space(text, at)?;
        let name = string(text, at)?;
        take(text, at, b':')?;
        match skip_space(text, at)? {
            b'{' if depth < MOST_DEPTH => push_fields(text, at, depth + 1, found)?,
            _ => {
                let (kind, value) = value(text, at)?;
                found.push((depth, Field { name, kind, value }));
            }
        }
        match skip_space(text, at)? {
            b',' => *at += 1,
            b'}' => {
                *at += 1;
                return Some(());
            }
            _ => return None,
        }
    }
}

fn value(text: &[u8], at: &mut usize) -> Option<(Kind, String)> {
    match skip_space(text, at)? {
        b'"' => Some((Kind::Text, string(text, at)?)),
        b'[' => array(text, at),
        b'{' => {
            let Next::Object { end, .. } = object(text, *at) else { return None };
            *at = end;
            Some((Kind::Nothing, String::new()))
        }
        _ => {
            let word = text[*at..]
                .split(|byte| matches!(byte, b',' | b'}' | b']') || byte.is_ascii_whitespace())
                .next()?;
            *at += word.len();
            let is_number = word.first().is_some_and(|first| first.is_ascii_digit() || *first == b'-');
            let kind = match word {
                b"null" => return Some((Kind::Nothing, String::new())),
                b"true" | b"false" => Kind::Text,
                _ if is_number => Kind::Number,
                // Python writes NaN, which is no JSON.
                b"NaN" => return Some((Kind::Nothing, String::new())),
                _ => return None,
            };
            Some((kind, std::str::from_utf8(word).ok()?.to_owned()))
        }
    }
}

/// An array: bytes, or texts with a blank between them.
fn array(text: &[u8], at: &mut usize) -> Option<(Kind, String)> {
    use std::fmt::Write as _;
    let (mut joined, mut kind) = (String::new(), Kind::Bytes);
    take(text, at, b'[')?;
    loop {
        match skip_space(text, at)? {
            b']' => {
                *at += 1;
                return Some((kind, joined));
            }
            b',' => *at += 1,
            _ => {
                let (of, value) = value(text, at)?;
                if !joined.is_empty() {
                    joined.push(' ');
                }
                match (of, value.parse::<u8>()) {
                    (Kind::Number, Ok(byte)) if kind == Kind::Bytes => _ = write!(joined, "{byte:02X}"),
                    _ => {
                        kind = Kind::Text;
                        joined.push_str(&value);
                    }
                }
            }
        }
    }
}

/// A string, of which only escaped marks are of any use here.
fn string(text: &[u8], at: &mut usize) -> Option<String> {
    let StringEnd::At(end) = (text.get(*at) == Some(&b'"')).then(|| string_end(text, *at))? else {
        return None;
    };
    let inside = String::from_utf8_lossy(&text[*at + 1..end - 1]);
    *at = end;
    if !inside.contains('\\') {
        return Some(inside.into_owned());
    }
    let mut plain = String::with_capacity(inside.len());
    let mut rest = inside.chars();
    while let Some(next) = rest.next() {
        if next != '\\' {
            plain.push(next);
            continue;
        }
        match rest.next()? {
            'n' => plain.push('\n'),
            't' => plain.push('\t'),
            'r' => plain.push('\r'),
            'u' => {
                let digits: String = rest.by_ref().take(4).collect();
                let code = u32::from_str_radix(&digits, 16).ok()?;
                plain.push(char::from_u32(code).unwrap_or(char::REPLACEMENT_CHARACTER));
            }
            other => plain.push(other),
        }
    }
    Some(plain)
}
