//! Descriptions of ECUs by ODX 2.0 to 2.2 (ISO 22901-1; ASAM MCD-2 D): the names of services and of what they say, with values and
//! units, in a PDX package or a single document.
//!
//! What is read: layers with what they inherit, services with their requests and responses, all kinds of parameters but DYNAMIC and
//! TABLE-ENTRY, simple types, structures, fields, multiplexers, tables, trouble codes, and conversions other than programs. Programs
//! (COMPUCODE, jobs), environment data and condensed bit masks are not evaluated, which an [`Issue`] says with its place.
//!
//! A CDD, Vector's CANdela description, is read into the same model.
//!
//! Files come from anywhere: what is unpacked, what documents expand to, how deep things contain or inherit each other, and how many
//! values a message has are all limited.

mod addressing;
mod coded;
mod compu;
mod decode;
mod descriptions;
mod ecu;
mod error;
mod internal;
mod layer;
mod load;
mod model;
mod package;
mod prefix;
mod requests;
#[cfg(test)]
mod tests;
mod xml;

use std::sync::Arc;

pub use self::coded::Stop;
pub use self::compu::Physical;
pub use self::decode::{Decoded, Reading};
pub use self::descriptions::{Descriptions, Source};
pub use self::ecu::{Described, Ecu};
pub use self::error::{Issue, OdxError};
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
