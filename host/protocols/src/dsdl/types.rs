//! The data types that are built in, and a user's own.

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
