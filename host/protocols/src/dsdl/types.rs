//! The data types that are built in, and a user's own.

use std::fmt;
use std::str::FromStr;
use std::sync::{Arc, OnceLock};

use super::condensed;
use super::library::Library;
use super::model::Generation;
use super::parse::DsdlSource;

/// Data types by which messages of DroneCAN and Cyphal are read.
#[derive(Debug)]
pub struct DataTypes {
    dronecan: Library,
    cyphal: Library,
}

/// No message of Cyphal has this data type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "no data type of Cyphal's messages is called '{name}'; a name has its namespace and version, as uavcan.node.Heartbeat.1.0"
)]
pub struct UnknownType {
    /// The given name.
    pub name: String,
}

/// How many subjects Cyphal has.
const SUBJECTS: u16 = 8192;

/// A subject of Cyphal and the data type of its messages, as a text such as `1620=uavcan.si.sample.voltage.Scalar.1.0`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SubjectType {
    /// The subject's number, from 0 to 8191.
    pub subject: u16,
    /// The data type's name.
    pub name: String,
}

/// A text that is no [`SubjectType`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("write it as NUMBER=TYPE, with subjects from 0 to 8191: 1620=uavcan.si.sample.voltage.Scalar.1.0")]
pub struct BadSubjectType;

impl FromStr for SubjectType {
    type Err = BadSubjectType;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (number, name) = text.split_once('=').ok_or(BadSubjectType)?;
        let subject = number.parse().ok().filter(|number| *number < SUBJECTS).ok_or(BadSubjectType)?;
        Ok(Self { subject, name: name.to_owned() })
    }
}

impl fmt::Display for SubjectType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.subject, self.name)
    }
}

const DRONECAN: &str = include_str!("../../data/dronecan.dsdl");
const CYPHAL: &str = include_str!("../../data/cyphal.dsdl");

impl DataTypes {
    /// Those that are built in, read when they are first needed.
    pub fn built_in() -> Arc<Self> {
        static BUILT_IN: OnceLock<Arc<DataTypes>> = OnceLock::new();
        BUILT_IN.get_or_init(|| Arc::new(Self::with(&[]).0)).clone()
    }

    /// Those that are built in and these, which come first where they have the same name or number. What is not understood is returned in
    /// words, with its place; a type that contains it is left out.
    pub fn with(own: &[DsdlSource]) -> (Self, Vec<String>) {
        let mut problems = Vec::new();
        let mut library = |generation, built_in| {
            let of_own = own.iter().filter(|source| source.generation() == Some(generation)).cloned();
            let sources: Vec<_> = of_own.chain(condensed::split(built_in)).collect();
            Library::of(generation, &sources, &mut problems)
        };
        let (dronecan, cyphal) =
            (library(Generation::DroneCan, DRONECAN), library(Generation::Cyphal, CYPHAL));
        (Self { dronecan, cyphal }, problems)
    }

    /// From now on, messages of this subject of Cyphal have this data type, as `reg.udral.physics.acoustics.Note.0.1`.
    ///
    /// # Errors
    ///
    /// There is no such type, or it is a service.
    pub fn name_subject(&mut self, subject: u16, name: &str) -> Result<(), UnknownType> {
        let is_named = self.cyphal.name_message(subject, name);
        is_named.then_some(()).ok_or_else(|| UnknownType { name: name.to_owned() })
    }

    /// Those of one of the two.
    pub(crate) const fn of(&self, generation: Generation) -> &Library {
        match generation {
            Generation::DroneCan => &self.dronecan,
            Generation::Cyphal => &self.cyphal,
        }
    }
}
