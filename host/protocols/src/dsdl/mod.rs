//! Data types of DroneCAN (UAVCAN v0) and Cyphal (UAVCAN v1): their definition language, DSDL, read from text, and messages read by them.
//!
//! The types of both projects' public repositories are built in (`data/`); a user's own can be added. What of a definition says how bytes
//! are read is understood: fields, constants, unions, arrays, nested and delimited types. Assertions and extents are not evaluated, since they
//! change nothing of that.

mod bits;
mod condensed;
mod expression;
mod library;
mod meaning;
mod model;
mod parse;
mod read;
mod signature;
#[cfg(test)]
mod tests;
mod types;
mod unit;

pub use condensed::condensed;
pub(crate) use model::{Definition, Generation, Section};
pub use parse::DsdlSource;
pub(crate) use read::{Unread, read};
pub use types::{BadSubjectType, DataTypes, SubjectType, UnknownType};
