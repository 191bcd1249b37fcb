//! Handles the text of a DBC file before it is parsed: its encoding, and which line contains what.
//!
//! can-dbc's result has no positions, so the lines of messages and signals are found here. A
//! statement starts on a new line; a string may span several.

use std::borrow::Cow;
use std::collections::HashMap;
use std::ops::Range;

use can_dbc::encodings;

/// Statements that do not affect how frames are decoded.
const NEEDLESS: &[&str] = &[
    "VERSION",
    "NS_",
    "BS_",
    "BU_",
    "CM_",
    "BA_DEF_",
    "BA_DEF_DEF_",
    "BA_DEF_REL_",
    "BA_DEF_DEF_REL_",
    "BA_DEF_SGTYPE_",
    "BA_REL_",
    "BA_SGTYPE_",
    "BA_",
    "EV_",
    "EV_DATA_",
    "ENVVAR_DATA_",
    "BO_TX_BU_",
    "BU_SG_REL_",
    "BU_EV_REL_",
    "BU_BO_REL_",
    "CAT_",
    "CAT_DEF_",
    "FILTER",
    "SGTYPE_",
    "SGTYPE_VAL_",
    "SIGTYPE_VALTYPE_",
    "SIG_TYPE_REF_",
    "SIG_GROUP_",
    "SIG_TYPE_DEF_",
    "SIG_TYPE_",
    "VAL_TABLE_",
];

/// Statements that do.
const NEEDED: &[&str] = &["BO_", "SG_", "VAL_", "SIG_VALTYPE_", "SG_MUL_VAL_"];

/// The text, and how it is encoded if that is neither of the usual ways: DBC files are in Windows' Western code page, and newer tools write UTF-8.
/// Lines that end with a carriage return alone get a line feed.
pub fn decode(bytes: &[u8]) -> (Cow<'_, str>, Option<&'static str>) {
    let encoding = unusual(bytes);
    let text = if let Some(encoding) = encoding {
        encoding.decode(bytes).0
    } else {
        let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
        match str::from_utf8(bytes) {
            Ok(text) => Cow::Borrowed(text),
            Err(_) => encodings::WINDOWS_1252.decode_without_bom_handling(bytes).0,
        }
    };
    let text =
        if text.contains('\r') && !text.contains('\n') { text.replace('\r', "\n").into() } else { text };
    (text, encoding.map(encodings::Encoding::name))
}

/// UTF-16 by its mark or by the zeros in its first characters, which are ASCII; Shift-JIS; and GBK, as programs in China write.
fn unusual(bytes: &[u8]) -> Option<&'static encodings::Encoding> {
    match bytes {
        [0xFF, 0xFE, ..] | [(1..=0xFF), 0, (1..=0xFF), 0, ..] => Some(encodings::UTF_16LE),
        [0xFE, 0xFF, ..] | [0, (1..=0xFF), 0, (1..=0xFF), ..] => Some(encodings::UTF_16BE),
        _ if str::from_utf8(bytes).is_ok() => None,
        _ if is_shift_jis(bytes) => Some(encodings::SHIFT_JIS),
        _ if is_gbk(bytes) => Some(encodings::GBK),
        _ => None,
    }
}

/// Whether bytes that are not ASCII are pairs of Shift-JIS, as nearly all Japanese text is. Each of the Western code page could be one, too, but there
/// letters with accents stand between others, and the bytes that begin most pairs are marks, which are rare.
fn is_shift_jis(bytes: &[u8]) -> bool {
    let (mut pairs, mut others) = (0, 0);
    let mut rest = bytes;
    while let [first, after @ ..] = rest {
        rest = after;
        match (first, after) {
            (0..=0x7F, _) => {}
            (0x81..=0x9F | 0xE0..=0xFC, [second @ (0x40..=0x7E | 0x80..=0xFC), behind @ ..]) => {
                // In the other code page these are two marks, or a mark and a letter with an accent.
                let is_clear = *first <= 0x9F && *second >= 0x80
                    || matches!(first, 0x81 | 0x83 | 0x8D | 0x8F | 0x90 | 0x9D);
                if is_clear {
                    pairs += 1;
                } else {
                    others += usize::from(*first > 0x9F);
                }
                rest = behind;
            }
            _ => others += 1,
        }
    }
    pairs > 0
        && pairs >= others
        && encodings::SHIFT_JIS.decode_without_bom_handling_and_without_replacement(bytes).is_some()
}

/// Whether bytes that are not ASCII are pairs of GBK. Letters with accents are rarely two side by side and hardly ever without one alone elsewhere;
/// Korean's pairs begin with B0 to C8, of which no Chinese sentence consists.
fn is_gbk(bytes: &[u8]) -> bool {
    let (mut clear, mut common, mut rare) = (0, 0, 0);
    let mut rest = bytes;
    while let [first, after @ ..] = rest {
        rest = after;
        if first.is_ascii() {
            continue;
        }
        let [second, behind @ ..] = after else { return false };
        match (first, second) {
            // The more frequent half of the characters, from S to Z, and the signs for °C, degrees and ohms.
            (0xC9..=0xD7, 0xA1..=0xFE) | (0xA1, 0xE3 | 0xE6) | (0xA6, 0xB8) => clear += 1,
            (0xA1..=0xA9 | 0xB0..=0xC8, 0xA1..=0xFE) => common += 1,
            (0x81..=0xFE, 0x40..=0x7E | 0x80..=0xFE) => rare += 1,
            _ => return false,
        }
        rest = behind;
    }
    clear > 0
        && clear + common >= 8 * rare
        && encodings::GBK.decode_without_bom_handling_and_without_replacement(bytes).is_some()
}

/// The text with receivers in each definition of a signal as can-dbc wants them: one or more names with commas between. Some programs write none
/// where nobody receives it, a `*` for all, or blanks between them; no value depends on them.
pub fn with_receivers(text: &str) -> Cow<'_, str> {
    let mut out = String::new();
    let (mut in_string, mut used, mut offset) = (false, 0, 0);
    for line in text.split_inclusive('\n') {
        let content = line.trim_end();
        let is_definition = !in_string && content.trim_start().starts_with("SG_ ") && content.contains('@');
        in_string = ends_in_string(line, in_string);
        let receivers = content.rfind('"').map(|quote| &content[quote + 1..]);
        if let Some(receivers) = receivers.filter(|_| is_definition && !in_string)
            && let Some(better) = better_receivers(receivers)
        {
            out.push_str(&text[used..offset + content.len() - receivers.len()]);
            out.push_str(&better);
            used = offset + content.len();
        }
        offset += line.len();
    }
    if used == 0 {
        return Cow::Borrowed(text);
    }
    out.push_str(&text[used..]);
    out.into()
}

/// Receivers with commas between them, if they were written otherwise; `None` if there is nothing to mend, or something else than names.
fn better_receivers(written: &str) -> Option<String> {
    let is_name = |word: &str| word.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
    let in_order = |part: &str| !part.is_empty() && is_name(part);
    if written.split(',').map(str::trim_ascii).all(in_order) {
        return None;
    }
    let words = written.split([',', ' ', '\t']).filter(|word| !word.is_empty());
    let (names, others): (Vec<_>, Vec<_>) = words.partition(|word| is_name(word));
    if others.iter().any(|other| *other != "*") {
        return None;
    }
    Some(if names.is_empty() { " Vector__XXX".to_owned() } else { format!(" {}", names.join(",")) })
}

/// A statement's place in the text.
#[derive(Debug)]
pub struct Statement {
    /// Its first line, from 1.
    pub line: u32,
    /// Its bytes, up to the next statement.
    pub range: Range<usize>,
    /// Its first word.
    pub keyword: String,
    /// `Message` or `Message.Signal` for definitions, otherwise the keyword and the words after it.
    pub symbol: String,
}

/// The positions of everything.
#[derive(Debug, Default)]
pub struct Index {
    /// In the order of the text.
    pub statements: Vec<Statement>,
    /// Identifier as written in the file, name and line of each `BO_`.
    pub messages: Vec<(u64, String, u32)>,
    /// Lines of signals, by their message's index in `messages` and their name.
    signals: HashMap<(usize, String), u32>,
    /// Lines of the first statement about a signal, by keyword, message identifier and name.
    references: HashMap<(String, String, String), u32>,
}

impl Index {
    /// Finds all statements.
    pub fn of(text: &str) -> Self {
        let mut index = Self::default();
        let mut in_string = false;
        let mut in_symbols = false;
        let mut offset = 0;
        for (number, line) in text.split_inclusive('\n').enumerate() {
            if !in_string {
                // The list after NS_ names keywords on separate, indented lines.
                in_symbols &= line.starts_with([' ', '\t', '\r', '\n']);
                if !in_symbols {
                    index.start_statement(line, number as u32 + 1, offset);
                }
                in_symbols |= line.trim_start().starts_with("NS_");
            }
            in_string = ends_in_string(line, in_string);
            offset += line.len();
            if let Some(statement) = index.statements.last_mut() {
                statement.range.end = offset;
            }
        }
        index
    }

    fn start_statement(&mut self, line: &str, number: u32, offset: usize) {
        let mut words = line.split(|c: char| c.is_ascii_whitespace() || c == ':').filter(|w| !w.is_empty());
        let Some(keyword) = words.next() else { return };
        if !NEEDED.contains(&keyword) && !NEEDLESS.contains(&keyword) {
            // An unknown keyword starts a statement if it looks like one.
            let looks_like = keyword.len() > 1
                && keyword.ends_with('_')
                && keyword.bytes().all(|byte| byte.is_ascii_uppercase() || byte == b'_');
            if !looks_like {
                return;
            }
        }
        let (first, second) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
        let symbol = match keyword {
            "BO_" => {
                if let Ok(id) = first.parse() {
                    self.messages.push((id, second.to_owned(), number));
                }
                second.to_owned()
            }
            "SG_" => {
                let message = self.messages.len().checked_sub(1);
                let message_name = message.map_or("", |message| self.messages[message].1.as_str());
                let symbol = format!("{message_name}.{first}");
                if let Some(message) = message {
                    self.signals.entry((message, first.to_owned())).or_insert(number);
                }
                symbol
            }
            _ => {
                if NEEDED.contains(&keyword) {
                    let reference = (keyword.to_owned(), first.to_owned(), second.to_owned());
                    self.references.entry(reference).or_insert(number);
                }
                [keyword, first, second].join(" ").trim_end().to_owned()
            }
        };
        let range = offset..offset;
        self.statements.push(Statement { line: number, range, keyword: keyword.to_owned(), symbol });
    }

    /// The line of the `message`th message; 0 if unknown.
    pub fn message_line(&self, message: usize) -> u32 {
        self.messages.get(message).map_or(0, |&(_, _, line)| line)
    }

    /// The line of a signal of the `message`th message; 0 if unknown.
    pub fn signal_line(&self, message: usize, name: &str) -> u32 {
        self.signals.get(&(message, name.to_owned())).copied().unwrap_or_default()
    }

    /// The index in [`Self::statements`] of the one that a line belongs to.
    pub fn place_at(&self, line: u32) -> Option<usize> {
        self.statements.partition_point(|statement| statement.line <= line).checked_sub(1)
    }

    /// The line of the first statement of that keyword about a signal; 0 if unknown.
    pub fn reference_line(&self, keyword: &str, id: u32, signal: &str) -> u32 {
        let reference = (keyword.to_owned(), id.to_string(), signal.to_owned());
        self.references.get(&reference).copied().unwrap_or_default()
    }
}

/// Where in a statement its message's identifier is: `BO_ ID`, `VAL_ ID SIGNAL`, `CM_ SG_ ID SIGNAL`, `BA_ "ATTRIBUTE"
/// SG_ ID SIGNAL VALUE`.
pub fn id_place(statement: &str) -> Option<Range<usize>> {
    let line = statement.split('\n').next()?;
    let mut end = 0;
    let mut next = || {
        let is_between = |c: char| c.is_ascii_whitespace() || c == ':';
        let start = end + line[end..].find(|c| !is_between(c))?;
        end = start + line[start..].find(is_between).unwrap_or(line.len() - start);
        Some(start..end)
    };
    let word = match &line[next()?] {
        // A signal's name may be a number.
        "SG_" => return None,
        keyword @ ("BA_" | "CM_") => {
            let object = if keyword == "BA_" { next().and_then(|_| next())? } else { next()? };
            matches!(&line[object], "BO_" | "SG_").then(&mut next)??
        }
        _ => next()?,
    };
    line[word.clone()].bytes().all(|byte| byte.is_ascii_digit()).then_some(word)
}

/// The identifier of a statement's message, as written.
pub fn id(statement: &str) -> Option<&str> {
    id_place(statement).map(|place| &statement[place])
}

/// Whether a string is open at the line's end. `\"` inside one does not close it.
fn ends_in_string(line: &str, mut in_string: bool) -> bool {
    let mut bytes = line.bytes().peekable();
    while let Some(byte) = bytes.next() {
        match byte {
            b'\\' if in_string && bytes.peek() == Some(&b'"') => {
                bytes.next();
            }
            b'"' => in_string = !in_string,
            b'/' if !in_string && bytes.peek() == Some(&b'/') => break,
            _ => {}
        }
    }
    in_string
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "VERSION \"\"\nNS_ :\n\tCM_\n\tVAL_\n\nBU_: A\n\nBO_ 5 First: 8 A\n SG_ One : 0|8@1+ (1,0) [0|0] \"\" A\n\
                        CM_ BO_ 5 \"BO_ 6 \\\"No\\\"\nBO_ 7 Neither: 8 A\";\nBO_ 8 Last : 8 A\n SG_ One m0 : 0|8@1+ (1,0) [0|0] \"\" A\n";

    #[test]
    fn utf_16_shift_jis_and_gbk_are_known_by_their_bytes_and_western_text_stays() {
        let text = "BO_ 5 First: 8 A\r\n SG_ One : 0|8@1+ (1,0) [0|0] \"°C\" A\r\n";
        let little: Vec<u8> = text.encode_utf16().flat_map(u16::to_le_bytes).collect();
        let big: Vec<u8> = text.encode_utf16().flat_map(u16::to_be_bytes).collect();
        for (bytes, encoding) in [
            ([&[0xFF, 0xFE][..], &little].concat(), "UTF-16LE"),
            ([&[0xFE, 0xFF][..], &big].concat(), "UTF-16BE"),
            (little, "UTF-16LE"),
            (big, "UTF-16BE"),
        ] {
            assert_eq!(decode(&bytes), (text.into(), Some(encoding)));
        }
        for japanese in ["温度", "車速 [km/h]", "エンジン回転数", "℃", "ﾄﾞｱ 開閉状態"]
        {
            let text = format!("CM_ SG_ 5 One \"{japanese}\";\n");
            let bytes = encodings::SHIFT_JIS.encode(&text).0;
            assert_eq!(decode(&bytes), (text.as_str().into(), Some("Shift_JIS")));
        }
        for chinese in ["电池温度", "车速信号", "℃", "整车控制器：状态正常", "电阻 Ω"]
        {
            let text = format!("CM_ SG_ 5 One \"{chinese}\";\n");
            let bytes = encodings::GBK.encode(&text).0;
            assert_eq!(decode(&bytes), (text.as_str().into(), Some("GBK")), "{chinese}");
        }
        let korean = encodings::EUC_KR.encode("CM_ \"배터리 온도\";").0;
        assert_eq!(decode(&korean).1, None);
        for western in [
            "CÔTÉ gauche",
            "Größe",
            "créée",
            "ÄÖÜäöü",
            "Öltemperatur in °C",
            "don’t",
            "“quoted” – naïve",
            "Größe änderbar",
            "déjà été",
            "½ µm²",
            "ÄÖÜäöüß",
            "20 €",
        ] {
            let text = format!("CM_ SG_ 5 One \"{western}\";\n");
            let bytes = encodings::WINDOWS_1252.encode(&text).0;
            assert_eq!(decode(&bytes), (text.as_str().into(), None), "{western}");
        }
    }

    #[test]
    fn signals_without_a_receiver_get_one_and_nothing_else_changes() {
        let text = "BO_ 5 First: 8 A\n SG_ One : 0|8@1+ (1,0) [0|0] \"\"  \n SG_ Two : 8|8@1+ (1,0) [0|0] \"km/h\"\r\n\
                    \x20SG_ Three : 16|8@1+ (1,0) [0|0] \"\" A\nCM_ \"\n SG_ Four : 0|8@1+ (1,0) [0|0] \"\"\n";
        let expected = text.replacen("[0|0] \"\"  \n", "[0|0] \"\" Vector__XXX  \n", 1).replacen(
            "\"km/h\"\r",
            "\"km/h\" Vector__XXX\r",
            1,
        );
        assert_eq!(with_receivers(text), expected);
        assert!(matches!(with_receivers(TEXT), Cow::Borrowed(_)));
    }

    #[test]
    fn receivers_have_commas_between_them_however_they_were_written() {
        for (written, expected) in [
            ("A", None),
            ("A,B , C", None),
            ("A B", Some(" A,B")),
            ("A, B C", Some(" A,B,C")),
            ("A,,B,", Some(" A,B")),
            ("*", Some(" Vector__XXX")),
            ("* A", Some(" A")),
            ("A // and B", None),
            ("A; B", None),
        ] {
            let line = |receivers: &str| format!(" SG_ One : 0|8@1+ (1,0) [0|0] \"km h\"{receivers}\r\n");
            let text = line(&format!(" {written}"));
            assert_eq!(with_receivers(&text), expected.map_or(text.clone(), line), "{written}");
        }
    }

    #[test]
    fn statements_are_found_and_strings_are_not() {
        let index = Index::of(TEXT);
        let found: Vec<_> = index.statements.iter().map(|s| (s.line, s.symbol.as_str())).collect();
        assert_eq!(
            found,
            [
                (1, "VERSION \"\""),
                (2, "NS_"),
                (6, "BU_ A"),
                (8, "First"),
                (9, "First.One"),
                (10, "CM_ BO_ 5"),
                (12, "Last"),
                (13, "Last.One")
            ]
        );
        assert_eq!(
            (index.message_line(1), index.signal_line(0, "One"), index.signal_line(1, "One")),
            (12, 9, 13)
        );
        assert_eq!(index.place_at(11), Some(5));
    }

    #[test]
    fn a_statement_s_identifier_is_no_number_of_its_text() {
        for (statement, expected) in [
            ("BO_ 5 First: 8 A\n SG_ One : 0|8@1+", Some("5")),
            (" SG_ 5 : 0|8@1+ (1,0) [0|0] \"\" A", None),
            ("CM_ BO_ 5 \"6\";", Some("5")),
            ("CM_ SG_ 5 One \"6\";", Some("5")),
            ("BA_ \"Cycle\" BO_ 5 100;", Some("5")),
            ("BA_ \"Cycle\" SG_ 5 One 100;", Some("5")),
            ("BO_TX_BU_ 5 : A,B;", Some("5")),
            ("VAL_ 5 One 6 \"a\" ;", Some("5")),
            ("CM_ \"see BO_ 5\";", None),
            ("CM_ \" BO_ 5 is old\";", None),
            ("BA_ \"Year\" 5;", None),
            ("BA_ \"Cycle\" BU_ Node 5;", None),
            ("VAL_ Variable 5 \"a\" ;", None),
            ("BO_", None),
            ("", None),
        ] {
            assert_eq!(id(statement), expected, "{statement}");
        }
    }

    #[test]
    fn kana_alone_are_known_and_western_words_stay() {
        let bytes = encodings::SHIFT_JIS.encode("VAL_ 1 S 0 \"オフ\" ;").0;
        assert_eq!(decode(&bytes), ("VAL_ 1 S 0 \"オフ\" ;".into(), Some("Shift_JIS")));
        for text in [
            "Fläche größer Öl",
            "°C",
            "don’t",
            "“quoted” text – and more",
            "température élevée à l’arrêt",
            "µ ± ² ½",
            "€ 5",
        ] {
            assert_eq!(decode(&encodings::WINDOWS_1252.encode(text).0), (text.into(), None));
            assert_eq!(decode(text.as_bytes()), (text.into(), None));
        }
    }
}
