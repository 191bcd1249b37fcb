//! The encoding of a database's text, which no such file states.

use std::borrow::Cow;

use can_dbc::encodings::{Encoding, SHIFT_JIS, UTF_16BE, UTF_16LE, WINDOWS_1252};

use super::fault::{Fault, FaultKind};

/// DBC and SYM files are in Windows' Western code page; newer tools write UTF-8, some UTF-16, and Japanese ones Shift-JIS. The last two are
/// told in `faults`. Lines that end with a carriage return alone get a line feed.
pub fn decode<'a>(bytes: &'a [u8], faults: &mut Vec<Fault>) -> Cow<'a, str> {
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    let text = match (utf_16(bytes), str::from_utf8(bytes)) {
        (Some(encoding), _) => with(encoding, bytes, faults),
        (None, Ok(text)) => Cow::Borrowed(text),
        (None, Err(_)) if is_shift_jis(bytes) => with(SHIFT_JIS, bytes, faults),
        (None, Err(_)) => WINDOWS_1252.decode_without_bom_handling(bytes).0,
    };
    if text.contains('\r') && !text.contains('\n') { text.replace('\r', "\n").into() } else { text }
}

fn with<'a>(encoding: &'static Encoding, bytes: &'a [u8], faults: &mut Vec<Fault>) -> Cow<'a, str> {
    faults.push(Fault { line: 0, symbol: String::new(), kind: FaultKind::Encoding(encoding.name()) });
    encoding.decode_with_bom_removal(bytes).0
}

/// By its byte order mark, or because every other of the first bytes is 0, as in no other text.
fn utf_16(bytes: &[u8]) -> Option<&'static Encoding> {
    let zeros = |at: usize| bytes.len() >= 4 && bytes[..4].iter().skip(at).step_by(2).all(|byte| *byte == 0);
    let others = |at: usize| bytes[..4].iter().skip(at).step_by(2).all(|byte| *byte != 0);
    match bytes {
        [0xFF, 0xFE, ..] => Some(UTF_16LE),
        [0xFE, 0xFF, ..] => Some(UTF_16BE),
        _ if zeros(1) && others(0) => Some(UTF_16LE),
        _ if zeros(0) && others(1) => Some(UTF_16BE),
        _ => None,
    }
}

/// Whether a text that is not UTF-8 is Shift-JIS. Much Western text is valid Shift-JIS too ("Fläche" has a kanji then), but kana, or two
/// characters of two bytes side by side, begin with bytes that are quotation marks and the like in the Western code page, and in pairs.
fn is_shift_jis(bytes: &[u8]) -> bool {
    let Some(text) = SHIFT_JIS.decode_without_bom_handling_and_without_replacement(bytes) else {
        return false;
    };
    let is_kana = |letter: char| matches!(letter, '\u{3041}'..='\u{30FF}');
    let is_kanji = |letter: char| matches!(letter, '\u{4E00}'..='\u{9FFF}');
    let mut kanji_before = false;
    text.chars().any(|letter| {
        let is_pair = kanji_before && is_kanji(letter);
        kanji_before = is_kanji(letter);
        is_pair || is_kana(letter)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decoded(bytes: &[u8]) -> (String, Vec<String>) {
        let mut faults = Vec::new();
        let text = decode(bytes, &mut faults).into_owned();
        (text, faults.iter().map(ToString::to_string).collect())
    }

    #[test]
    fn japanese_and_utf_16_are_read_and_named() {
        for text in ["BO_ 1 A: 8 B\nCM_ \"車速センサー\";\n", "CM_ \"温度\";", "VAL_ 1 S 0 \"オフ\" ;"]
        {
            let (bytes, ..) = SHIFT_JIS.encode(text);
            let (found, faults) = decoded(&bytes);
            assert_eq!((found.as_str(), faults.len()), (text, 1), "{faults:?}");
            assert!(faults[0].contains("Shift_JIS"), "{faults:?}");
            for (mark, to_bytes) in [
                ("\u{FEFF}", u16::to_le_bytes as fn(u16) -> [u8; 2]),
                ("\u{FEFF}", u16::to_be_bytes),
                ("", u16::to_le_bytes),
                ("", u16::to_be_bytes),
            ] {
                let bytes: Vec<u8> = format!("{mark}{text}").encode_utf16().flat_map(to_bytes).collect();
                let (found, faults) = decoded(&bytes);
                assert_eq!(found, text);
                assert!(faults[0].contains("UTF-16"), "{faults:?}");
            }
        }
    }

    /// As Western tools write them, some with words that would be valid Shift-JIS.
    #[test]
    fn western_text_is_not_taken_for_japanese() {
        for text in [
            "CM_ \"Fläche größer Öl Überdruck\";",
            "SG_ T : 0|8@1+ (1,0) [0|0] \"°C\" X",
            "CM_ \"don’t\";",
            "CM_ \"“quoted” text – and more\";",
            "CM_ \"température élevée à l’arrêt\";",
            "CM_ \"señal µ ± ² ³ ½\";",
            "CM_ \"€ 5\";",
        ] {
            let (bytes, ..) = WINDOWS_1252.encode(text);
            assert_eq!(decoded(&bytes), (text.to_owned(), Vec::new()));
            assert_eq!(decoded(text.as_bytes()), (text.to_owned(), Vec::new()));
        }
    }
}
