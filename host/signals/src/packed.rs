//! Databases in a ZIP archive or compressed with gzip, as vendors and collections hand them out.

use std::borrow::Cow;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::fault::DatabaseError;
use super::file_kind::FileKind;
use super::zip::{self, Archive, MemberError};

/// No database is longer: more is damage or malice.
const MOST_BYTES: u64 = 256 << 20;
/// So many files of an archive are looked at.
const MOST_FILES: usize = 100_000;
const TOO_LONG: &str = "unpacked, it has more than 256 MiB";

/// The bytes of the database at a path, and the path with the name in an archive; `traces.zip/inside/a.dbc` names one of several.
pub(super) fn read(path: &Path) -> Result<(PathBuf, Vec<u8>), DatabaseError> {
    let (file, inside) = split(path);
    let shown = file.display().to_string();
    let is_packed = inside.is_some() || is_packed(file);
    if !is_packed {
        // What is no database is not read first.
        FileKind::of(&shown, file)?;
    }
    let bytes = std::fs::read(file).map_err(|source| DatabaseError::Read { file: shown.clone(), source })?;
    let (name, unpacked) = unpack(&shown, &bytes, inside.as_deref())?;
    let unpacked = match unpacked {
        Cow::Borrowed(_) => None,
        Cow::Owned(unpacked) => Some(unpacked),
    };
    let path = if unpacked.is_some() { PathBuf::from(name) } else { path.to_owned() };
    Ok((path, unpacked.unwrap_or(bytes)))
}

/// Whether a path has the suffix of what is unpacked first.
fn is_packed(path: &Path) -> bool {
    path.extension()
        .is_some_and(|suffix| ["zip", "gz"].iter().any(|packed| suffix.eq_ignore_ascii_case(packed)))
}

/// A path into an archive as the archive and the name in it.
fn split(path: &Path) -> (&Path, Option<String>) {
    if path.exists() {
        return (path, None);
    }
    let archive = path.ancestors().skip(1).find(|ancestor| ancestor.is_file());
    let inside = archive.and_then(|archive| Some((archive, path.strip_prefix(archive).ok()?)));
    let name = |path: &Path| path.iter().map(|part| part.to_string_lossy()).collect::<Vec<_>>().join("/");
    inside.map_or((path, None), |(archive, inside)| (archive, Some(name(inside))))
}

/// What a file of this name holds, with its name: itself if it is not packed.
pub(super) fn unpack<'a>(
    file: &str,
    bytes: &'a [u8],
    inside: Option<&str>,
) -> Result<(String, Cow<'a, [u8]>), DatabaseError> {
    let packed = |what: &str| DatabaseError::Packed { file: file.to_owned(), what: what.to_owned() };
    if bytes.starts_with(&[0x1F, 0x8B]) {
        let name = file.strip_suffix(".gz").or_else(|| file.strip_suffix(".GZ")).unwrap_or(file);
        let unpacked =
            all(flate2::read::MultiGzDecoder::new(bytes)).map_err(|error| packed(&error.to_string()))?;
        return Ok((name.to_owned(), unpacked.into()));
    }
    let is_workbook =
        inside.is_none() && FileKind::of(file, Path::new(file)).is_ok_and(FileKind::is_workbook);
    if zip::is_archive(bytes) && !is_workbook {
        return member(file, bytes, inside).map(|(name, bytes)| (format!("{file}/{name}"), bytes.into()));
    }
    match inside {
        Some(_) => Err(packed("it is no ZIP archive, so nothing in it can be named")),
        None => Ok((file.to_owned(), bytes.into())),
    }
}

/// At most as many bytes as a database may have.
fn all(source: impl Read) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    source.take(MOST_BYTES + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > MOST_BYTES {
        return Err(io::Error::other(TOO_LONG));
    }
    Ok(bytes)
}

/// The file of this name in an archive, or the only database there.
fn member(file: &str, bytes: &[u8], wanted: Option<&str>) -> Result<(String, Vec<u8>), DatabaseError> {
    let failed = |what: String| DatabaseError::Packed { file: file.to_owned(), what };
    let several = |names| {
        let missing = wanted.map(str::to_owned);
        DatabaseError::Several { file: file.to_owned(), missing, names }
    };
    let archive = Archive::new(bytes).map_err(|error| failed(error.to_string()))?;
    let (mut found, mut names) = (None, Vec::new());
    for member in archive.members() {
        let member = member.map_err(|error| failed(error.to_string()))?;
        let name = member.name.as_str();
        let is_own = !name.starts_with("__MACOSX/")
            && !name.rsplit('/').next().is_some_and(|last| last.starts_with('.'));
        let is_database = is_own && FileKind::of(name, Path::new(name)).is_ok_and(FileKind::is_sure);
        if is_database && names.len() < MOST_FILES {
            names.push(name.to_owned());
        }
        if wanted.map_or(is_database, |wanted| wanted == name) {
            found = Some(member);
        }
    }
    let member = match found {
        Some(member) if wanted.is_some() || names.len() == 1 => member,
        None if wanted.is_none() => {
            return Err(failed("it has no .dbc, .kcd, .sym, .arxml or .dbf file".to_owned()));
        }
        _ => return Err(several(names)),
    };
    match archive.unpack(&member, MOST_BYTES) {
        Ok(bytes) => Ok((member.name, bytes)),
        Err(MemberError::TooLong) => Err(failed(format!("{} is damaged: {TOO_LONG}", member.name))),
        Err(error) => Err(failed(format!("{} {error}", member.name))),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    const CAR: &str = "VERSION \"\"\nBU_:\nBO_ 291 Engine: 8 Vector__XXX\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"\" Vector__XXX\n";

    fn zip(files: &[(&str, &str)]) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut archive = rawzip::ZipArchiveWriter::new(&mut bytes);
        for (name, text) in files {
            let (mut entry, config) = archive
                .new_file(name)
                .compression_method(rawzip::CompressionMethod::DEFLATE)
                .start()
                .unwrap();
            let encoder = flate2::write::DeflateEncoder::new(&mut entry, flate2::Compression::default());
            let mut writer = config.wrap(encoder);
            writer.write_all(text.as_bytes()).unwrap();
            let (encoder, output) = writer.finish().unwrap();
            encoder.finish().unwrap();
            entry.finish(output).unwrap();
        }
        archive.finish().unwrap();
        bytes
    }

    #[test]
    fn a_database_in_an_archive_is_read_and_one_of_several_is_named() {
        let dir = std::env::temp_dir().join(format!("cantap-packed-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        let put = |name: &str, bytes: &[u8]| {
            let path = dir.join(name);
            std::fs::write(&path, bytes).unwrap();
            path
        };
        let one =
            put("one.zip", &zip(&[("README.txt", "x"), ("a/car.dbc", CAR), ("__MACOSX/a/._car.dbc", "x")]));
        let database = crate::load(&one).unwrap();
        assert_eq!(database.messages[0].name, "Engine");
        assert!(database.file.ends_with("one.zip/a/car.dbc"), "{}", database.file);
        let two = put("two.zip", &zip(&[("a.dbc", CAR), ("b.dbc", "BU_:\n")]));
        let error = crate::load(&two).unwrap_err().to_string();
        assert!(error.contains("two.zip/a.dbc, ") && error.ends_with("two.zip/b.dbc"), "{error}");
        assert_eq!(crate::load(&two.join("a.dbc")).unwrap().messages.len(), 1);
        let error = crate::load(&two.join("c.dbc")).unwrap_err().to_string();
        assert!(error.contains("no file c.dbc"), "{error}");
        let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        packed.write_all(CAR.as_bytes()).unwrap();
        let packed = packed.finish().unwrap();
        assert_eq!(crate::load(&put("car.dbc.gz", &packed)).unwrap().messages.len(), 1);
        assert_eq!(crate::parse("car.dbc.gz", &packed).unwrap().messages.len(), 1);
        for (name, bytes, expected) in [
            ("none.zip", zip(&[("x.txt", "x")]), "it has no .dbc"),
            ("cut.zip", zip(&[("a.dbc", CAR)])[..60].to_vec(), "its directory is missing"),
            ("cut.dbc.gz", packed[..packed.len() - 9].to_vec(), "cut.dbc.gz"),
            ("plain.zip", CAR.as_bytes().to_vec(), "not a known kind"),
        ] {
            let error = crate::load(&put(name, &bytes)).unwrap_err().to_string();
            assert!(error.contains(expected), "{name}: {error}");
        }
        std::fs::remove_dir_all(dir).unwrap();
    }
}
