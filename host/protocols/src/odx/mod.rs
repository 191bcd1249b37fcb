//! Descriptions of ECUs by ODX 2.0 to 2.2 (ISO 22901-1; ASAM MCD-2 D): the names of services and of what they say, with values and
//! units, in a PDX package or a single document.
//!
//! What is read: layers with what they inherit, services with their requests and responses, all kinds of parameters but DYNAMIC and
//! TABLE-ENTRY, simple types, structures, fields, multiplexers, tables, trouble codes, and conversions other than programs. Programs
//! (COMPUCODE, jobs), environment data and condensed bit masks are not evaluated, which an [`Issue`] says with its place.
//!
//! Files come from anywhere: what is unpacked, what documents expand to, how deep things contain or inherit each other, and how many
//! values a message has are all limited.

mod addressing;
mod coded;
mod compu;
mod decode;
mod descriptions;
mod ecu;
mod layer;
mod load;
mod model;
mod package;
mod prefix;
mod requests;
#[cfg(test)]
mod tests;
mod xml;

use std::fmt;
use std::sync::Arc;

pub use self::coded::Stop;
pub use self::compu::Physical;
pub use self::decode::{Decoded, Reading};
pub use self::descriptions::{Descriptions, Source};
pub use self::ecu::{Described, Ecu};
use self::load::Loader;
use self::model::Model;
pub use self::model::{Internal, LayerKind};
pub use self::package::is_document;
pub use self::requests::{NameError, NamedRequest};

/// What a file describes.
#[derive(Clone, Debug)]
pub struct Odx {
    model: Arc<Model>,
    /// What is not understood, in the order of the file; the first thousand.
    pub issues: Vec<Issue>,
    /// How many more there are.
    pub issues_left_out: usize,
}

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
    #[error("there is no diagnostic layer in it; give the .pdx or .odx-d file of the ECU")]
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

impl LayerKind {
    /// As the standard calls it, in lower case.
    pub const fn name(self) -> &'static str {
        match self {
            Self::SharedData => "ecu-shared-data",
            Self::Protocol => "protocol",
            Self::FunctionalGroup => "functional-group",
            Self::BaseVariant => "base-variant",
            Self::EcuVariant => "ecu-variant",
        }
    }

    /// Whether it describes an ECU.
    pub const fn is_ecu(self) -> bool {
        matches!(self, Self::BaseVariant | Self::EcuVariant)
    }
}

impl Odx {
    /// Reads a package or document; `file` is its name.
    ///
    /// # Errors
    ///
    /// It is damaged, too large, or has no layer.
    pub fn read(file: &str, bytes: &[u8]) -> Result<Self, OdxError> {
        let mut loader = Loader::default();
        package::each(file, bytes, package::MOST_BYTES, |name, bytes| {
            loader.document(name, &package::text(name, bytes)?)
        })?;
        loader.resolve();
        if loader.model.layers.is_empty() {
            return Err(OdxError::NoLayer);
        }
        let Loader { model, issues, left_out, .. } = loader;
        Ok(Self { model: Arc::new(model), issues, issues_left_out: left_out })
    }

    /// The names and kinds of its layers, in the order of the file.
    pub fn layers(&self) -> impl ExactSizeIterator<Item = (LayerKind, &str)> {
        self.model.layers.iter().map(|layer| (layer.kind, &*layer.name))
    }

    /// A layer with everything that it inherits.
    ///
    /// # Errors
    ///
    /// There is none of this name, or it inherits too much.
    pub fn ecu(&self, name: &str) -> Result<Ecu, OdxError> {
        let number = self.model.layers.iter().position(|layer| &*layer.name == name);
        let number = number.ok_or_else(|| OdxError::UnknownLayer {
            name: cantap_trace::clean::line(name).into_owned(),
            layers: self.layers().map(|(_, name)| name.to_owned()).collect(),
        })?;
        Ecu::new(&self.model, number as u32)
    }
}
