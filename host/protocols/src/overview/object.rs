//! What an event is about: a data identifier, an entry of an object dictionary, a parameter group.

use std::borrow::Cow;

use crate::{Event, EventKind, Protocol};

/// How many characters of a value are kept.
const MOST_TEXT: usize = 256;

/// What an event is about, without words: most are about something that is known already.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) enum ObjectKey {
    /// A kind of object, and the bits of its numbers.
    Numbered(&'static str, [Option<u64>; 3]),
    Titled(Cow<'static, str>),
}

/// The object that an event is about.
pub(super) fn key_of(event: &Event) -> Option<ObjectKey> {
    let bits = |name: &str| number(event, name).map(f64::to_bits);
    let one =
        |kind, name: &str| bits(name).map(|number| ObjectKey::Numbered(kind, [Some(number), None, None]));
    match event.protocol {
        Protocol::Uds => one("did", "did").or_else(|| one("routine", "routine")),
        Protocol::Kwp2000 => one("identifier", "local_identifier"),
        Protocol::Obd => Some(ObjectKey::Numbered("pid", [Some(bits("pid")?), Some(bits("sid")?), None])),
        Protocol::CanOpen => match event.kind {
            EventKind::SdoRead | EventKind::SdoWrite => {
                Some(ObjectKey::Numbered("object", [Some(bits("index")?), Some(bits("sub")?), None]))
            }
            EventKind::Pdo => Some(ObjectKey::Titled(event.title.clone())),
            _ => None,
        },
        Protocol::J1939 | Protocol::Nmea2000 => match event.kind {
            EventKind::Request | EventKind::NoResponse | EventKind::Acknowledgement => None,
            _ => one("pgn", "pgn"),
        },
        Protocol::DeviceNet if event.kind == EventKind::Io => Some(ObjectKey::Titled(event.title.clone())),
        Protocol::DeviceNet => {
            let numbers = [Some(bits("class")?), Some(bits("instance")?), bits("attribute")];
            Some(ObjectKey::Numbered("class", numbers))
        }
        // A parameter or a register, or a message.
        Protocol::DroneCan | Protocol::Cyphal => match event.kind {
            EventKind::Message => Some(ObjectKey::Titled(event.title.clone())),
            _ => crate::uavcan::parameter(event).map(|(name, _)| ObjectKey::Titled(name.into())),
        },
        Protocol::IsoTp | Protocol::Xcp | Protocol::Ccp => None,
    }
}

/// The object in words: its kind and number.
pub(super) fn object_text(event: &Event) -> String {
    let value = |name: &str| event.field(name).map_or_else(String::new, |field| field.value.to_string());
    match event.protocol {
        Protocol::Uds if event.field("did").is_some() => format!("did {}", value("did")),
        Protocol::Uds => format!("routine {}", value("routine")),
        Protocol::Kwp2000 => format!("identifier {}", value("local_identifier")),
        Protocol::Obd => format!("pid {} of service {}", value("pid"), value("sid")),
        Protocol::CanOpen if event.kind != EventKind::Pdo => {
            let number = |name: &str| number(event, name).unwrap_or_default();
            format!("{:04X}:{:02X}", number("index") as u32, number("sub") as u32)
        }
        Protocol::J1939 | Protocol::Nmea2000 => format!("pgn {}", value("pgn")),
        Protocol::DeviceNet if event.kind != EventKind::Io => {
            let attribute = event.field("attribute").map(|field| format!(" attribute {}", field.value));
            let class = format!("class {} instance {}", value("class"), value("instance"));
            class + attribute.as_deref().unwrap_or_default()
        }
        Protocol::DroneCan | Protocol::Cyphal if event.kind != EventKind::Message => {
            crate::uavcan::parameter(event).map_or_else(String::new, |(name, _)| name)
        }
        _ => event.title.to_string(),
    }
}

/// The object's name, if the event has it.
pub(super) fn name_of(event: &Event) -> Option<String> {
    let meaning = |name: &str| event.field(name)?.text.as_ref().map(ToString::to_string);
    match event.protocol {
        Protocol::Uds => meaning(if event.field("did").is_some() { "did" } else { "routine" }),
        Protocol::Obd => meaning("pid"),
        Protocol::CanOpen => meaning("index"),
        Protocol::J1939 | Protocol::Nmea2000 => Some(event.title.to_string()),
        Protocol::DeviceNet => meaning("class"),
        Protocol::Kwp2000
        | Protocol::IsoTp
        | Protocol::Xcp
        | Protocol::Ccp
        | Protocol::DroneCan
        | Protocol::Cyphal => None,
    }
}

/// The object's value as text, if it is of a kind that need not change.
pub(super) fn value_of(event: &Event) -> Option<String> {
    if let Some((_, value)) = crate::uavcan::parameter(event) {
        return Some(short(value));
    }
    let has_value = match event.protocol {
        Protocol::Uds => event.fields.iter().filter(|field| field.name == "did").count() == 1,
        Protocol::Kwp2000 => true,
        Protocol::CanOpen => event.kind != EventKind::Pdo,
        Protocol::DeviceNet => event.kind != EventKind::Io,
        _ => false,
    };
    let value = event.field("value").filter(|_| has_value && event.trouble.is_none())?;
    Some(short(value.value.to_string()))
}

/// The field as a number, if it is one.
pub(super) fn number(event: &Event, name: &str) -> Option<f64> {
    event.field(name)?.value.as_number()
}

/// The text, cut to what is kept.
pub(super) fn short(text: String) -> String {
    if text.chars().count() <= MOST_TEXT {
        text
    } else {
        text.chars().take(MOST_TEXT).chain(['…']).collect()
    }
}
