//! Reads A2L files with the crate a2lfile.

use a2lfile::A2lFile;
use encoding_rs::{UTF_16BE, UTF_16LE, WINDOWS_1252};

use super::description::Description;
use super::module::Loader;
use super::nesting::{TooDeep, bounded};
use super::shown::{MOST_ISSUES, shown};

/// The largest file that is read, with what it includes, in bytes.
const MOST_BYTES: usize = 512 << 20;
/// How deep files may include each other.
const DEEPEST: usize = 8;
/// How many files may be included altogether: those that include each other twice would never end.
const MOST_INCLUDED: usize = 1000;

/// Why a file cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum A2lError {
    /// With all that it includes, it is too large.
    #[error("with what it includes, it is larger than 512 MiB")]
    TooLarge,
    /// Its blocks are in each other deeper than in any file of a tool.
    #[error("more than 64 of its blocks are in each other; is it damaged?")]
    TooDeep,
    /// It is no A2L.
    #[error("it is no A2L file: {0}")]
    Malformed(String),
    /// There is no ECU in it.
    #[error("there is no MODULE in it")]
    Empty,
}

/// The bytes of a file that is included under this name, if there is one.
pub type Include<'f> = dyn FnMut(&str) -> Option<Vec<u8>> + 'f;

impl Description {
    /// Reads a file, and those that it includes. One description for each module. What is missing is left out.
    ///
    /// # Errors
    ///
    /// It is no A2L, larger than 512 MiB, or has blocks in each other that are too deep.
    pub fn read(bytes: &[u8], include: &mut Include<'_>) -> Result<Vec<Self>, A2lError> {
        let mut issues = Vec::new();
        let text = expanded(&decode(bytes), include, (0, &mut 0), &mut issues)?;
        let (text, without_grammar) = bounded(text).map_err(|TooDeep| A2lError::TooDeep)?;
        if without_grammar {
            issues.push("its A2ML, which comes to more than is read, is left out".to_owned());
        }
        match a2lfile::load_from_string(&text, None, false) {
            Ok((file, _)) => of_file(&file, &issues),
            Err(error) => Self::parse_bare(&text, &format!("without its A2ML: {error}"), issues),
        }
    }

    /// Reads the text of a file, or of what is within its MODULE. What it includes is left out.
    ///
    /// # Errors
    ///
    /// It is no A2L.
    pub fn parse(text: &str) -> Result<Vec<Self>, A2lError> {
        Self::read(text.as_bytes(), &mut |_| None)
    }

    /// Without all that is not needed, and more often wrong than the rest: the grammar of IF_DATA, the project's name.
    fn parse_bare(text: &str, issue: &str, mut issues: Vec<String>) -> Result<Vec<Self>, A2lError> {
        let bare = without_project_name(&without_a2ml(text));
        issues.push(shown(issue));
        let error = match a2lfile::load_from_string(&bare, None, false) {
            Ok((file, _)) => return of_file(&file, &issues),
            Err(error) => error,
        };
        if !bare.contains("/begin PROJECT")
            && let Ok(module) = a2lfile::load_fragment(&bare, None)
        {
            let one = Loader::new(&module, issues).load();
            // A file of something else is a fragment without anything in it.
            if !one.objects().is_empty() {
                return Ok(vec![one]);
            }
        }
        Err(A2lError::Malformed(shown(&error.to_string())))
    }
}

/// The text of a file, in whichever of the usual encodings.
fn decode(bytes: &[u8]) -> String {
    let encoding = match bytes {
        [0xFF, 0xFE, ..] => Some(UTF_16LE),
        [0xFE, 0xFF, ..] => Some(UTF_16BE),
        _ => None,
    };
    match (encoding, std::str::from_utf8(bytes)) {
        (Some(encoding), _) => encoding.decode(bytes).0.into_owned(),
        (None, Ok(text)) => text.trim_start_matches('\u{FEFF}').to_owned(),
        (None, Err(_)) => WINDOWS_1252.decode(bytes).0.into_owned(),
    }
}

/// Without the blocks that describe IF_DATA.
fn without_a2ml(text: &str) -> String {
    let (mut out, mut rest) = (String::with_capacity(text.len()), text);
    while let Some(at) = rest.find("/begin A2ML") {
        let Some(end) = rest[at..].find("/end A2ML") else { break };
        out.push_str(&rest[..at]);
        rest = &rest[at + end + "/end A2ML".len()..];
    }
    out.push_str(rest);
    out
}

/// With the texts of the files that it includes.
fn expanded(
    text: &str,
    include: &mut Include<'_>,
    (depth, included): (usize, &mut usize),
    issues: &mut Vec<String>,
) -> Result<String, A2lError> {
    let (mut out, mut rest) = (String::with_capacity(text.len()), text);
    let is_next = |rest: &[u8]| rest.starts_with(b"/include") || rest.starts_with(b"/INCLUDE");
    let next =
        |rest: &str| rest.match_indices('/').map(|(at, _)| at).find(|at| is_next(&rest.as_bytes()[*at..]));
    while let Some(at) = next(rest) {
        out.push_str(&rest[..at]);
        // What stands on both sides of it is not to become another one.
        out.push(' ');
        let after = rest[at + "/include".len()..].trim_start();
        let (name, behind) = match after.strip_prefix('"') {
            Some(quoted) => quoted.split_once('"').unwrap_or((quoted, "")),
            None => after.split_at(after.find(char::is_whitespace).unwrap_or(after.len())),
        };
        rest = behind;
        *included += 1;
        let is_one_more = depth < DEEPEST && *included <= MOST_INCLUDED;
        match is_one_more.then(|| include(name)).flatten() {
            Some(bytes) => {
                out.push_str(&expanded(&decode(&bytes), include, (depth + 1, included), issues)?);
                out.push(' ');
            }
            None if issues.len() < MOST_ISSUES => {
                issues.push(shown(&format!("{name}, which it includes, is left out")));
            }
            None => {}
        }
        if out.len() > MOST_BYTES {
            return Err(A2lError::TooLarge);
        }
    }
    out.push_str(rest);
    if out.len() > MOST_BYTES { Err(A2lError::TooLarge) } else { Ok(out) }
}

/// With another name for the project: nobody needs it, and it is where names are that the standard does not allow.
fn without_project_name(text: &str) -> String {
    let begin = "/begin PROJECT";
    let Some(at) = text.find(begin) else { return text.to_owned() };
    let (before, after) = text.split_at(at + begin.len());
    let name = after.trim_start();
    let end =
        name.find(|character: char| character.is_whitespace() || character == '"').unwrap_or(name.len());
    format!("{before} Project {}", &name[end..])
}

fn of_file(file: &A2lFile, issues: &[String]) -> Result<Vec<Description>, A2lError> {
    let all: Vec<_> =
        file.project.module.iter().map(|module| Loader::new(module, issues.to_vec()).load()).collect();
    if all.is_empty() { Err(A2lError::Empty) } else { Ok(all) }
}
