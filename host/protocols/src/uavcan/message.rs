//! What a transfer's bytes mean.

use super::header::Purpose;
use super::transfers::Transfer;
use crate::crc::crc16;
use crate::dsdl::{DataTypes, Definition, Generation, Section, Unread, read};
use crate::{Bytes, Field, Trouble};

/// A message has fewer bytes than its type.
const SHORT: &str = "it is shorter than its data type";
/// A message has what its type does not allow.
const WRONG: &str = "it has what its data type does not allow";
const CRC: &str = "its CRC does not fit its content";

/// Whether a transfer came as it was sent, whatever its content.
pub fn is_whole(trouble: Option<Trouble>) -> bool {
    trouble.is_none_or(|trouble| [SHORT, WRONG].map(Trouble::Malformed).contains(&trouble))
}

/// Fields that every transfer has in front of its values: number, priority, number of the transfer.
pub const COMMON_FIELDS: usize = 3;

/// Before the names of a request's fields: its response has others, often with the same names.
const OF_REQUEST: &str = "request.";

/// Gives a transfer its title and fields, and takes the CRC from its bytes. What is wrong with it becomes its trouble.
pub fn describe(
    generation: Generation,
    types: &DataTypes,
    learned: Option<&Definition>,
    transfer: &mut Transfer,
    fields: &mut Vec<Field>,
) -> String {
    let header = transfer.header;
    let name = match (generation, header.purpose) {
        (Generation::DroneCan, Purpose::Message) => "data_type",
        (Generation::Cyphal, Purpose::Message) => "subject",
        _ => "service",
    };
    fields.push(Field::number(name, header.port));
    fields.push(Field::number("priority", header.priority));
    fields.push(Field::number("transfer", transfer.id));
    let library = types.of(generation);
    let known: Vec<&Definition> = match header.purpose {
        Purpose::Message => learned.into_iter().chain(library.messages(header.port)).collect(),
        Purpose::Request | Purpose::Response => library.services(header.port).collect(),
    };
    if transfer.trouble.is_some() {
        let title = title(known.first().copied(), generation, header.port, header.purpose);
        fields.push(Field::number("received", transfer.payload.len() as i64).unit("bytes"));
        return title;
    }
    // A number may have several types, of which the CRC tells the right one in DroneCAN.
    let mut fitting = known.clone();
    if transfer.frames > 1 {
        let crc = take_crc(generation, transfer);
        let fits = |definition: &Definition| match generation {
            Generation::DroneCan => crc == Some(crc_of(definition.signature, &transfer.payload)),
            Generation::Cyphal => crc == Some(0),
        };
        fitting.retain(|definition| fits(definition));
        let is_checked = generation == Generation::Cyphal || !known.is_empty();
        let is_wrong = match generation {
            Generation::DroneCan => fitting.is_empty(),
            Generation::Cyphal => crc != Some(0),
        };
        if is_checked && is_wrong {
            transfer.trouble = Some(Trouble::Malformed(CRC));
            fields.push(Field::bytes("data", &transfer.payload));
            return title(known.first().copied(), generation, header.port, header.purpose);
        }
        if !is_checked {
            fields.push(Field::text("crc", "not checked, since the data type is not known"));
        }
    }
    let Some(first) = fitting.first().copied() else {
        fields.push(Field::bytes("data", &transfer.payload));
        return title(None, generation, header.port, header.purpose);
    };
    let prefix = if header.purpose == Purpose::Request { OF_REQUEST } else { "" };
    let is_open = generation == Generation::DroneCan && !transfer.is_fd;
    let before = fields.len();
    let mut try_one = |definition: &Definition| {
        fields.truncate(before);
        let section = section(definition, header.purpose)?;
        let rest = read(library, section, &transfer.payload, is_open, prefix, fields);
        Some(rest.map(<[u8]>::len))
    };
    // Of several, the one that it fits without a rest; padding is a rest, too.
    let tried: Vec<_> = fitting.iter().map(|definition| (*definition, try_one(definition))).collect();
    let whole = tried.iter().find(|(_, read)| *read == Some(Ok(0)));
    let best = whole.or_else(|| tried.iter().find(|(_, read)| matches!(read, Some(Ok(_)))));
    let best = best.map_or(first, |(definition, _)| *definition);
    match try_one(best) {
        Some(Ok(_)) => {}
        Some(Err(Unread::Short)) => transfer.trouble = Some(Trouble::Malformed(SHORT)),
        Some(Err(Unread::Wrong(what))) => {
            transfer.trouble = Some(Trouble::Malformed(WRONG));
            fields.push(Field::text("not_read", what));
        }
        None => fields.push(Field::bytes("data", &transfer.payload)),
    }
    title(Some(best), generation, header.port, header.purpose)
}

/// The message, or one of a service's two.
fn section(definition: &Definition, purpose: Purpose) -> Option<&Section> {
    match purpose {
        Purpose::Message | Purpose::Request => Some(&definition.request),
        Purpose::Response => definition.response.as_ref(),
    }
}

fn title(known: Option<&Definition>, generation: Generation, port: u16, purpose: Purpose) -> String {
    match (known, generation, purpose) {
        (Some(definition), ..) => definition.name.clone(),
        (None, Generation::DroneCan, Purpose::Message) => format!("data type {port}"),
        (None, Generation::Cyphal, Purpose::Message) => format!("subject {port}"),
        (None, _, Purpose::Request | Purpose::Response) => format!("service {port}"),
    }
}

/// Takes the CRC from the payload: DroneCAN's stands in front, and is returned; of Cyphal's, behind it and the padding, what is returned
/// is the CRC of all, which is 0 if it fits.
fn take_crc(generation: Generation, transfer: &mut Transfer) -> Option<u16> {
    let payload = &mut transfer.payload;
    match generation {
        Generation::DroneCan => {
            let [low, high, rest @ ..] = &payload[..] else { return None };
            let crc = u16::from_le_bytes([*low, *high]);
            *payload = Bytes::from_slice(rest);
            Some(crc)
        }
        Generation::Cyphal => {
            let all = crc16(0xFFFF, payload);
            let length = payload.len().checked_sub(2)?;
            payload.truncate(length);
            Some(all)
        }
    }
}

/// DroneCAN's CRC of a payload: the signature of its data type comes first.
pub fn crc_of(signature: u64, payload: &[u8]) -> u16 {
    crc16(crc16(0xFFFF, &signature.to_le_bytes()), payload)
}
