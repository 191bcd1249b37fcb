//! Ready nodes: scripts that come with the program.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::node::Script;
use crate::sheets;

/// No script is larger, in bytes: that of a bus of a thousand identifiers has a tenth of it.
const MOST_BYTES: u64 = 16 << 20;
pub use crate::names::PREFIX;

/// A script that comes with the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReadyNode {
    /// Its name, after [`PREFIX`].
    pub name: &'static str,
    /// Its script.
    pub source: &'static str,
}

const NODES: [ReadyNode; 5] = [
    ReadyNode { name: "boat", source: include_str!("../nodes/boat.rhai") },
    ReadyNode { name: "drive", source: include_str!("../nodes/drive.rhai") },
    ReadyNode { name: "engine", source: include_str!("../nodes/engine.rhai") },
    ReadyNode { name: "obd", source: include_str!("../nodes/obd.rhai") },
    ReadyNode { name: "valves", source: include_str!("../nodes/valves.rhai") },
];

/// The sheet of the ready node with this name, an EDS file.
///
/// # Errors
/// If there is none.
pub fn sheet(name: &str) -> Result<&'static str, LibraryError> {
    sheets::sheet(name).ok_or_else(|| LibraryError::Sheet { name: name.to_owned() })
}

/// Why there is no such ready node.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LibraryError {
    /// None has this name.
    #[error("there is no ready node {name:?}; there are {}", names())]
    Unknown {
        /// The name.
        name: String,
    },
    /// A script's file cannot be read.
    #[error("cannot read {path}: {reason}")]
    File {
        /// The file.
        path: String,
        /// Why not.
        reason: String,
    },
    /// A script's file is larger than any script.
    #[error("{path} is no script: it has more than {} MiB", MOST_BYTES >> 20)]
    TooLarge {
        /// The file.
        path: String,
    },
    /// A script's file is no text.
    #[error("{path} is no script: it is not text in UTF-8")]
    NoText {
        /// The file.
        path: String,
    },
    /// It has no electronic data sheet.
    #[error("there is no sheet of a ready node {name:?}; there are {}", sheets::names())]
    Sheet {
        /// The name.
        name: String,
    },
    /// Its settings are not `NAME=VALUE`.
    #[error("{text:?} is no setting; write settings as in {example}")]
    Setting {
        /// What is not one.
        text: String,
        /// How to write it.
        example: String,
    },
}

fn names() -> String {
    NODES.map(|node| node.name).join(", ")
}

impl ReadyNode {
    /// All of them.
    pub const fn all() -> &'static [Self] {
        &NODES
    }

    /// The one with this name, without [`PREFIX`].
    ///
    /// # Errors
    /// If there is none.
    pub fn find(name: &str) -> Result<Self, LibraryError> {
        let found = NODES.into_iter().find(|node| node.name == name);
        found.ok_or_else(|| LibraryError::Unknown { name: name.to_owned() })
    }

    /// What it is: the first line of its script.
    pub fn title(&self) -> &'static str {
        self.source.lines().next().unwrap_or_default().trim_start_matches('/').trim()
    }
}

/// A script as users name it: its file, or a ready node with [`PREFIX`].
///
/// # Errors
/// If the file cannot be read, or there is no such node.
pub fn read(path: &Path) -> Result<Script, LibraryError> {
    if let Some(name) = path.to_str().and_then(|path| path.strip_prefix(PREFIX)) {
        return script(name);
    }
    let name = path.display().to_string();
    let mut bytes = Vec::new();
    File::open(path)
        .and_then(|file| file.take(MOST_BYTES + 1).read_to_end(&mut bytes))
        .map_err(|error| LibraryError::File { path: name.clone(), reason: error.to_string() })?;
    if bytes.len() as u64 > MOST_BYTES {
        return Err(LibraryError::TooLarge { path: name });
    }
    match String::from_utf8(bytes) {
        Ok(source) => Ok(Script::new(name, source)),
        Err(_) => Err(LibraryError::NoText { path: name }),
    }
}

/// The script of a ready node, by `NAME` or `NAME?SETTING=VALUE&SETTING=VALUE`, without [`PREFIX`].
///
/// # Errors
/// If there is no such node, or a setting is not written so. Whether the node has the setting turns out when it runs.
pub fn script(text: &str) -> Result<Script, LibraryError> {
    let (name, settings) = text.split_once('?').unwrap_or((text, ""));
    let node = ReadyNode::find(name)?;
    let pairs = settings.split('&').filter(|pair| !pair.is_empty());
    let settings = pairs.map(|pair| match pair.split_once('=') {
        Some((setting, value)) if !setting.is_empty() => Ok((setting.to_owned(), value.to_owned())),
        _ => {
            let example = format!("{PREFIX}{name}?name=value&other=value");
            Err(LibraryError::Setting { text: pair.to_owned(), example })
        }
    });
    let settings: BTreeMap<String, String> = settings.collect::<Result<_, _>>()?;
    Ok(Script { name: format!("{PREFIX}{name}"), source: node.source.to_owned(), settings })
}
