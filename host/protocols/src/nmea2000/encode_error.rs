//! Why a message could not be made of its fields' values.

/// A group, a field or a value that there is not.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// No group has this name or number.
    #[error("CANboat's database has no group '{name}'{}", list("; there are", near))]
    NoGroup {
        /// What was given.
        name: String,
        /// Names with a part of it.
        near: Vec<&'static str>,
    },
    /// Several groups have this name or number, and these fields.
    #[error("'{name}' is one of several groups; name one{}", list(":", names))]
    SeveralGroups {
        /// What was given.
        name: String,
        /// Their names.
        names: Vec<&'static str>,
    },
    /// The group does not have the field, or not as often.
    #[error("{group} has no field '{name}'{}", list("; it has", names))]
    NoField {
        /// The group's name.
        group: &'static str,
        /// What was given.
        name: String,
        /// The names of its fields.
        names: Vec<&'static str>,
    },
    /// A value that the field cannot have.
    #[error("{field} cannot be '{text}': {reason}")]
    Value {
        /// The field's name.
        field: &'static str,
        /// What was given.
        text: String,
        /// What would be right.
        reason: String,
    },
    /// Every number of these fields' bits is a value: they have none for "not available".
    #[error("{} {} no value for \"not available\": give {} one", fields.join(", "), if fields.len() == 1 { "has" } else { "have" }, if fields.len() == 1 { "it" } else { "each" })]
    Needed {
        /// The fields' names, followed by `_2` if it is the second with this name, and so on.
        fields: Vec<String>,
    },
    /// The message is longer than a fast packet.
    #[error(
        "the message would have {bytes} bytes, and a fast packet has at most {}",
        crate::j1939::MOST_FAST_BYTES
    )]
    TooLong {
        /// Its length.
        bytes: usize,
    },
}

/// At most this many names are listed.
const MOST_NAMES: usize = 20;

fn list(before: &str, names: &[&'static str]) -> String {
    if names.is_empty() {
        return String::new();
    }
    let more = if names.len() > MOST_NAMES { ", …" } else { "" };
    format!("{before} {}{more}", names[..names.len().min(MOST_NAMES)].join(", "))
}
