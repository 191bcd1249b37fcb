//! The text of one definition, as far as it can be understood without the others.

use super::model::Generation;

/// A file of definitions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DsdlSource {
    /// Its path from the folder of the outermost namespace on, with `/`: `uavcan/protocol/341.NodeStatus.uavcan`.
    pub path: String,
    /// Its content.
    pub text: String,
}

/// What a path says.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Name {
    /// Without the type's own name: `uavcan.protocol`.
    pub namespace: String,
    /// With it, and with the version of one of Cyphal's.
    pub full: String,
    pub port: Option<u16>,
    pub version: (u8, u8),
}

/// A definition whose types are still text.
#[derive(Clone, Debug, Default)]
pub(crate) struct Raw {
    pub name: Name,
    /// One, or two of a service.
    pub sections: Vec<RawSection>,
    pub signature: Option<u64>,
}

#[derive(Clone, Debug, Default)]
pub(crate) struct RawSection {
    pub is_union: bool,
    pub is_sealed: bool,
    pub fields: Vec<RawField>,
    /// Name and expression.
    pub constants: Vec<(String, String)>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RawField {
    pub line: usize,
    pub is_truncated: bool,
    /// Without what stands in brackets.
    pub kind: String,
    pub array: Option<RawArray>,
    /// Empty for a void.
    pub name: String,
    pub comment: String,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RawArray {
    pub is_variable: bool,
    /// Its expression is one more than the most.
    pub is_below: bool,
    pub capacity: String,
}

impl RawArray {
    /// What stands in brackets.
    fn of(size: &str) -> Self {
        let below = size.strip_prefix('<');
        let up_to = below.and_then(|size| size.strip_prefix('='));
        let capacity = up_to.or(below).unwrap_or(size).trim().to_owned();
        Self { is_variable: below.is_some(), is_below: below.is_some() && up_to.is_none(), capacity }
    }
}

impl DsdlSource {
    /// Whether the name of a file is that of a definition.
    pub fn has_name(name: &str) -> bool {
        generation_of(name).is_some()
    }

    /// Which language its name is of.
    pub(crate) fn generation(&self) -> Option<Generation> {
        generation_of(&self.path)
    }
}

fn generation_of(path: &str) -> Option<Generation> {
    match path.rsplit_once('.')?.1 {
        "uavcan" => Some(Generation::DroneCan),
        "dsdl" => Some(Generation::Cyphal),
        _ => None,
    }
}

/// Reads what a path says; `None` if it is not of the form that the language asks for.
fn name_of(path: &str, generation: Generation) -> Option<Name> {
    let (folders, file) = path.rsplit_once('/')?;
    let namespace = folders.replace('/', ".");
    let parts: Vec<_> = file.split('.').collect();
    let number = |text: &str| text.parse::<u8>().ok();
    let (head, version) = match (generation, parts.as_slice()) {
        (_, [head @ .., major, minor, _]) if !head.is_empty() && number(major).is_some() => {
            (head, (number(major)?, number(minor)?))
        }
        (Generation::DroneCan, [head @ .., _]) => (head, (0, 0)),
        _ => return None,
    };
    let (port, short) = match head {
        [short] => (None, short),
        [port, short] => (Some(port.parse().ok()?), short),
        _ => return None,
    };
    let full = match generation {
        Generation::DroneCan => format!("{namespace}.{short}"),
        Generation::Cyphal => format!("{namespace}.{short}.{}.{}", version.0, version.1),
    };
    Some(Name { namespace, full, port, version })
}

/// Reads a definition. What cannot be understood is an error, in words with its line.
pub(crate) fn parse(source: &DsdlSource, generation: Generation) -> Result<Raw, String> {
    let wrong = |line: usize, what: &str| format!("{}: line {line}: {what}", source.path);
    let name = name_of(&source.path, generation)
        .ok_or_else(|| format!("{}: its name is not that of a data type", source.path))?;
    let mut raw = Raw { name, sections: vec![RawSection::default()], signature: None };
    for (line, text) in (1..).zip(source.text.lines()) {
        let (code, comment) = text.split_once('#').unwrap_or((text, ""));
        let code = code.trim();
        if code.is_empty() {
            continue;
        }
        if code.starts_with("---") {
            if raw.sections.len() > 1 {
                return Err(wrong(line, "a second '---'"));
            }
            raw.sections.push(RawSection::default());
            continue;
        }
        let Some(section) = raw.sections.last_mut() else { continue };
        if let Some(directive) = code.strip_prefix('@') {
            match directive.split_whitespace().next() {
                Some("union") => section.is_union = true,
                Some("sealed") => section.is_sealed = true,
                Some("extent" | "assert" | "deprecated" | "print") => {}
                _ => return Err(wrong(line, "a directive that is not known")),
            }
            continue;
        }
        if let Some(signature) = code.strip_prefix("OVERRIDE_SIGNATURE") {
            let digits = signature.trim().trim_start_matches("0x");
            let signature = u64::from_str_radix(digits, 16).map_err(|_| wrong(line, "not a signature"))?;
            raw.signature = Some(signature);
            continue;
        }
        attribute(code, comment, line, section)
            .ok_or_else(|| wrong(line, "neither a field nor a constant"))?;
    }
    Ok(raw)
}

/// What is declared, and the expression of its value, if it is a constant.
pub fn constant(code: &str) -> Option<(&str, &str)> {
    // `uint8[<=7] name` has a sign that assigns nothing.
    code.split_once('=').filter(|(before, _)| !before.trim_end().ends_with('<'))
}

/// Adds a field or a constant.
fn attribute(code: &str, comment: &str, line: usize, section: &mut RawSection) -> Option<()> {
    let (declared, value) = match constant(code) {
        Some((declared, value)) => (declared, Some(value.trim())),
        None => (code, None),
    };
    let is_truncated = declared.starts_with("truncated ");
    let declared = declared
        .strip_prefix("truncated ")
        .or_else(|| declared.strip_prefix("saturated "))
        .unwrap_or(declared)
        .trim();
    let (kind, array, name) = if let Some((kind, rest)) = declared.split_once('[') {
        let (size, name) = rest.split_once(']')?;
        (kind, Some(RawArray::of(size.trim())), name)
    } else {
        let (kind, name) = declared.split_once(char::is_whitespace).unwrap_or((declared, ""));
        (kind, None, name)
    };
    let (kind, name) = (kind.trim(), name.trim());
    let is_name = |name: &str| {
        name.chars().all(|letter| letter.is_ascii_alphanumeric() || letter == '_') && !name.is_empty()
    };
    if let Some(value) = value {
        is_name(name).then(|| section.constants.push((name.to_owned(), value.to_owned())))
    } else {
        let is_void = kind.starts_with("void") && name.is_empty();
        (is_void || is_name(name)).then(|| {
            section.fields.push(RawField {
                line,
                is_truncated,
                kind: kind.to_owned(),
                array,
                name: name.to_owned(),
                comment: comment.to_owned(),
            });
        })
    }
}
