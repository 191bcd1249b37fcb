//! The documents of a file: a single ODX document, or those of a PDX package, a ZIP archive.

use std::borrow::Cow;

use cantap_signals::zip::{self, Archive, MemberError};
use encoding_rs::{Encoding, UTF_8};

use super::error::OdxError;

/// So much XML is read of one file, unpacked: more is damage, malice, or not one ECU's.
pub const MOST_BYTES: u64 = 256 << 20;
/// So many files of a package are looked at.
const MOST_FILES: usize = 10_000;

/// Whether a name is that of an ODX document or of a CDD: `car.odx`, `car.odx-d`, `CAR.ODX-CS`, `car.cdd`.
pub fn is_document(name: &str) -> bool {
    let extension = name.rsplit('/').next().and_then(|name| name.rsplit_once('.'));
    extension.is_some_and(|(_, extension)| {
        let extension = extension.to_ascii_lowercase();
        matches!(extension.as_str(), "odx" | "cdd") || extension.starts_with("odx-")
    })
}

/// Reads the documents of a file one after another, by their names and bytes; together they are no longer than `most_bytes`.
pub fn each(
    file: &str,
    bytes: &[u8],
    most_bytes: u64,
    mut read: impl FnMut(&str, &[u8]) -> Result<(), OdxError>,
) -> Result<(), OdxError> {
    if !zip::is_archive(bytes) {
        return if bytes.len() as u64 > most_bytes { Err(OdxError::TooLarge) } else { read(file, bytes) };
    }
    let archive = Archive::new(bytes).map_err(|error| OdxError::Package(error.to_string()))?;
    let (mut left, mut documents) = (most_bytes, 0);
    for (number, member) in archive.members().enumerate() {
        let member = member.map_err(|error| OdxError::Package(error.to_string()))?;
        if number >= MOST_FILES {
            return Err(OdxError::Package("it has more than 10,000 files".to_owned()));
        }
        let name = cantap_trace::clean::line(&member.name);
        if !is_document(&name) {
            continue;
        }
        let unpacked = archive.unpack(&member, left).map_err(|error| match error {
            MemberError::TooLong => OdxError::TooLarge,
            MemberError::Damaged(_) => {
                OdxError::Package(format!("{name} is damaged: its check does not fit"))
            }
            error => OdxError::Package(format!("{name} {error}")),
        })?;
        left -= unpacked.len() as u64;
        read(&name, &unpacked)?;
        documents += 1;
    }
    if documents == 0 {
        return Err(OdxError::Package(
            "it has no .odx document; give the PDX, ODX or CDD file of the ECU".to_owned(),
        ));
    }
    Ok(())
}

/// A document's text, by its byte order mark, or else by the encoding that it declares.
pub fn text<'a>(name: &str, bytes: &'a [u8]) -> Result<Cow<'a, str>, OdxError> {
    let encoding = match Encoding::for_bom(bytes) {
        Some((encoding, _)) => encoding,
        None => declared(name, bytes)?,
    };
    let (text, _, has_errors) = encoding.decode(bytes);
    if has_errors {
        return Err(OdxError::Encoding { document: name.to_owned(), encoding: encoding.name().to_owned() });
    }
    Ok(text)
}

/// The encoding of an XML declaration; UTF-8 without one.
fn declared(name: &str, bytes: &[u8]) -> Result<&'static Encoding, OdxError> {
    let head = &bytes[..bytes.len().min(200)];
    // A document in UTF-16 without a mark.
    match head {
        [b'<', 0, ..] => return Ok(encoding_rs::UTF_16LE),
        [0, b'<', ..] => return Ok(encoding_rs::UTF_16BE),
        _ => {}
    }
    let head = String::from_utf8_lossy(head);
    let declaration = head.strip_prefix("<?xml").and_then(|rest| rest.split("?>").next()).unwrap_or_default();
    let Some((_, rest)) = declaration.split_once("encoding") else { return Ok(UTF_8) };
    let rest = rest.trim_start_matches([' ', '=', '\t']);
    let label = rest.get(1..).and_then(|label| label.split(['"', '\'']).next()).unwrap_or_default();
    Encoding::for_label(label.as_bytes())
        .ok_or_else(|| OdxError::Encoding { document: name.to_owned(), encoding: label.to_owned() })
}
