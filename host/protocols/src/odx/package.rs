//! The documents of a file: a single ODX document, or those of a PDX package, a ZIP archive.

use std::borrow::Cow;
use std::io::Read as _;

use encoding_rs::{Encoding, UTF_8};
use rawzip::ZipArchive;

use super::error::OdxError;

/// So much XML is read of one file, unpacked: more is damage, malice, or not one ECU's.
pub const MOST_BYTES: u64 = 256 << 20;
/// So many files of a package are looked at.
const MOST_FILES: usize = 10_000;
/// Methods of packing that are read (PKWARE's APPNOTE 6.3.10, section 4.4.5).
const STORED: u16 = 0;
const DEFLATED: u16 = 8;

/// Whether bytes begin as a ZIP archive does.
fn is_package(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04") || bytes.starts_with(b"PK\x05\x06")
}

/// Whether a name is that of an ODX document: `car.odx`, `car.odx-d`, `CAR.ODX-CS`.
pub fn is_document(name: &str) -> bool {
    let extension = name.rsplit('/').next().and_then(|name| name.rsplit_once('.'));
    extension.is_some_and(|(_, extension)| {
        let extension = extension.to_ascii_lowercase();
        extension == "odx" || extension.starts_with("odx-")
    })
}

/// Reads the documents of a file one after another, by their names and bytes; together they are no longer than `most_bytes`.
pub fn each(
    file: &str,
    bytes: &[u8],
    most_bytes: u64,
    mut read: impl FnMut(&str, &[u8]) -> Result<(), OdxError>,
) -> Result<(), OdxError> {
    if !is_package(bytes) {
        return if bytes.len() as u64 > most_bytes { Err(OdxError::TooLarge) } else { read(file, bytes) };
    }
    let damaged = |what: &str| OdxError::Package(what.to_owned());
    let archive = ZipArchive::from_slice(bytes)
        .map_err(|_| damaged("its directory is missing; was it copied to its end?"))?;
    let mut entries = archive.entries();
    let (mut left, mut files, mut documents) = (most_bytes, 0, 0);
    while let Some(entry) = entries.next_entry().map_err(|_| damaged("its directory is not whole"))? {
        files += 1;
        if files > MOST_FILES {
            return Err(damaged("it has more than 10,000 files"));
        }
        let name = String::from_utf8_lossy(entry.file_path().as_ref()).replace('\\', "/");
        let name = cantap_trace::clean::line(&name);
        if !is_document(&name) {
            continue;
        }
        let failed = |what: &str| OdxError::Package(format!("{name} {what}"));
        if entry.flags().is_encrypted() {
            return Err(failed("is encrypted; unpack it first"));
        }
        let place = archive.get_entry(entry.wayfinder()).map_err(|_| failed("is not whole"))?;
        let packed = place.data();
        let source: Box<dyn std::io::Read> = match entry.compression_method().as_u16() {
            STORED => Box::new(packed),
            DEFLATED => Box::new(flate2::read::DeflateDecoder::new(packed)),
            method => return Err(failed(&format!("is packed by method {method}; unpack it first"))),
        };
        let mut unpacked = Vec::new();
        let ended = place.verifying_reader(source).take(left + 1).read_to_end(&mut unpacked);
        left = left.checked_sub(unpacked.len() as u64).ok_or(OdxError::TooLarge)?;
        ended.map_err(|_| failed("is damaged: its check does not fit"))?;
        read(&name, &unpacked)?;
        documents += 1;
    }
    if documents == 0 {
        return Err(damaged("it has no .odx document; give the PDX or ODX file of the ECU"));
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
