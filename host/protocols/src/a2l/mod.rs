//! A2lDescriptions of what is in an ECU's memory: A2L files (ASAM MCD-2 MC, versions 1.31 to 1.71).
//!
//! Read are measured values (MEASUREMENT), parameters (CHARACTERISTIC: values, blocks of values, text, curves, maps and cuboids with their
//! axes) and structures of them (INSTANCE), with their conversions, and, of IF_DATA, the identifiers and events of XCP and CCP. Formulas with
//! operations on bits, and what is behind pointers, are left out, and listed.

mod axes;
mod conversion;
mod data_type;
mod description;
mod if_data;
mod load;
#[cfg(test)]
mod map_tests;
mod module;
mod nesting;
mod object;
mod record;
mod shown;
mod structures;
#[cfg(test)]
mod tests;

pub use conversion::{Conversion, Meaning, Texts};
pub use data_type::{DataType, Dimension};
pub use description::{A2lDescriptions, Description};
pub use if_data::{DaqEvent, EcuConnection};
pub use load::{A2lError, Include};
pub use object::{Axis, Bits, MemoryObject, PartOfRecord, Shape, ValueError};

use crate::Field;
use crate::calibration::lists::ListEntry;
use crate::calibration::parts::ByteOrder;

/// Appends what an entry of a list contains: the description's values, or its bytes under its address.
pub(crate) fn push_entry(
    fields: &mut Vec<Field>,
    description: Option<&Description>,
    entry: ListEntry,
    bytes: &[u8],
    order: Option<ByteOrder>,
) {
    let ListEntry { extension, address, bit, .. } = entry;
    let named = description.filter(|_| bit.is_none());
    let named = named.map(|description| description.entry_fields(extension, address, bytes, order));
    match (named.filter(|named| !named.is_empty()), bit, extension) {
        (Some(named), ..) => fields.extend(named),
        (None, Some(bit), _) => fields.push(Field::bytes(format!("{address:08X}.{bit}"), bytes)),
        (None, None, 0) => fields.push(Field::bytes(format!("{address:08X}"), bytes)),
        (None, None, _) => fields.push(Field::bytes(format!("{extension:02X}:{address:08X}"), bytes)),
    }
}
