//! Why a file is not read, and what of it is not understood.

use std::fmt;

/// Something in a file that is not understood.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Issue {
    /// The document.
    pub file: String,
    /// The line, from 1.
    pub line: u32,
    /// What it is.
    pub what: String,
}

/// Why a file is not read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum OdxError {
    /// It is larger than an ECU's description.
    #[error(
        "it is larger than what is read: 256 MiB of XML when unpacked, 16 million elements and texts in a document; take the \
         documents of the ECU out of it"
    )]
    TooLarge,
    /// The package is damaged.
    #[error("the package cannot be read: {0}")]
    Package(String),
    /// A document is not in the encoding that it declares.
    #[error("{document} is not in its encoding, {encoding}; save it in UTF-8")]
    Encoding {
        /// The document.
        document: String,
        /// Its encoding.
        encoding: String,
    },
    /// A document is not XML.
    #[error("{document} is not XML: {reason}; was it copied to its end?")]
    Xml {
        /// The document.
        document: String,
        /// What is wrong, and where.
        reason: String,
    },
    /// There is no layer in it.
    #[error("there is no diagnostic layer in it; give the .pdx, .odx-d or .cdd file of the ECU")]
    NoLayer,
    /// Layers inherit from each other without end, or nearly so.
    #[error("its layers inherit from each other more deeply, or more, than those of any ECU")]
    Inheritance,
    /// It has no layer of this name.
    #[error("there is no layer {name} in it; there are: {}", layers.join(", "))]
    UnknownLayer {
        /// The name.
        name: String,
        /// Those that there are.
        layers: Vec<String>,
    },
    /// Nothing says which layer is meant.
    #[error("none of its ECUs has identifiers on CAN; say which one is meant, as FILE:LAYER: {}", layers.join(", "))]
    WhichLayer {
        /// Those that there are.
        layers: Vec<String>,
    },
}

impl fmt::Display for Issue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}: {}", self.file, self.line, self.what)
    }
}
