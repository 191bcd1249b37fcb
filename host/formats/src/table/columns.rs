//! Which columns of a table mean what, as users write it and as the names above the columns say.

use std::fmt;
use std::str::FromStr;

/// What a column means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    Time,
    Id,
    Dlc,
    /// All bytes in one cell.
    Data,
    /// The first of the columns with one byte each.
    Bytes,
    Channel,
    Extended,
    Remote,
    Direction,
    /// Whether it is an error frame.
    Error,
}

/// The names of the roles in a text of columns, in the order of [`Role`].
pub(super) const ROLES: [(&str, Role); 10] = [
    ("time", Role::Time),
    ("id", Role::Id),
    ("dlc", Role::Dlc),
    ("data", Role::Data),
    ("bytes", Role::Bytes),
    ("channel", Role::Channel),
    ("extended", Role::Extended),
    ("remote", Role::Remote),
    ("direction", Role::Direction),
    ("error", Role::Error),
];

/// How a column's cells are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    Hex,
    Decimal,
    /// A time, in units of so many nanoseconds.
    Unit(i64),
    /// Channels that count from 0.
    FromZero,
}

const FORMS: [(&str, Form); 7] = [
    ("hex", Form::Hex),
    ("dec", Form::Decimal),
    ("s", Form::Unit(1_000_000_000)),
    ("ms", Form::Unit(1_000_000)),
    ("us", Form::Unit(1_000)),
    ("ns", Form::Unit(1)),
    ("0", Form::FromZero),
];

impl Role {
    fn name(self) -> &'static str {
        ROLES[self as usize].0
    }

    fn takes(self, form: Form) -> bool {
        match form {
            Form::Hex | Form::Decimal => matches!(self, Self::Id | Self::Data | Self::Bytes),
            Form::Unit(_) => self == Self::Time,
            Form::FromZero => self == Self::Channel,
        }
    }
}

/// One column: its name above it, or its number from 1.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Column {
    pub role: Role,
    pub name: String,
    pub form: Option<Form>,
}

/// A column whose type is known, unlike that of a text.
pub(crate) struct TypedColumn<'a> {
    pub name: &'a str,
    pub form: TypedForm,
}

/// What its type says about how its cells are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum TypedForm {
    /// Times in seconds.
    #[cfg_attr(not(feature = "parquet"), expect(dead_code, reason = "only Parquet has a type of times"))]
    Seconds,
    /// Numbers in decimal digits.
    Number,
    /// Bytes in hexadecimal digits.
    Bytes,
    /// Texts, which may be anything.
    Text,
    /// It has no cells.
    None,
}

/// Which columns of a table mean what, such as `time=Timestamp:ms,id=ID:hex,data=Data`.
///
/// A column is named as above it, or by its number from 1, as in a table without names. The meanings are `time` (`:s`, `:ms`, `:us`, `:ns`), `id`
/// (`:hex`, `:dec`), `dlc`, `data` or `bytes`, which is the first column of one byte each (`:hex`, `:dec`), `channel` (`:0`: counts from 0),
/// `extended`, `remote`, `direction` and `error`. What is not said after a colon is found out from the rows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Columns(pub(super) Vec<Column>);

/// A text is not one of [`Columns`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BadColumns {
    /// Not a meaning and a name.
    #[error("'{0}' is not a column; write a meaning and a name such as time=Timestamp (meanings: {roles})", roles = role_names())]
    Column(String),
    /// The same meaning twice.
    #[error("the column for '{0}' is given twice")]
    Twice(&'static str),
    /// A form of another meaning.
    #[error("a column for '{0}' has no form '{1}'")]
    Form(&'static str, &'static str),
    /// What every frame has is not given.
    #[error("a table needs columns for the identifier and the bytes, such as id=ID,data=Data")]
    Missing,
}

fn role_names() -> String {
    ROLES.map(|(name, _)| name).join(", ")
}

impl FromStr for Columns {
    type Err = BadColumns;

    fn from_str(text: &str) -> Result<Self, BadColumns> {
        let mut columns: Vec<Column> = Vec::new();
        for part in text.split(',') {
            let bad = || BadColumns::Column(part.to_owned());
            let (role, name) = part.split_once('=').ok_or_else(bad)?;
            let role = ROLES.iter().find(|(own, _)| role.trim().eq_ignore_ascii_case(own));
            let role = role.ok_or_else(bad)?.1;
            let form = name.rsplit_once(':').and_then(|(name, form)| {
                FORMS.iter().find(|(own, _)| *own == form.trim()).map(|(text, form)| (name, *text, *form))
            });
            let (name, form) = match form {
                Some((_, text, form)) if !role.takes(form) => {
                    return Err(BadColumns::Form(role.name(), text));
                }
                Some((name, _, form)) => (name, Some(form)),
                None => (name, None),
            };
            if name.trim().is_empty() {
                return Err(bad());
            }
            if columns.iter().any(|column| column.role == role) {
                return Err(BadColumns::Twice(role.name()));
            }
            columns.push(Column { role, name: name.trim().to_owned(), form });
        }
        let has = |role| columns.iter().any(|column| column.role == role);
        if has(Role::Id) && (has(Role::Data) || has(Role::Bytes)) {
            Ok(Self(columns))
        } else {
            Err(BadColumns::Missing)
        }
    }
}

impl fmt::Display for Columns {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (at, Column { role, name, form }) in self.0.iter().enumerate() {
            let comma = if at == 0 { "" } else { "," };
            write!(f, "{comma}{}={name}", role.name())?;
            if let Some((text, _)) = form.and_then(|form| FORMS.iter().find(|(_, own)| *own == form)) {
                write!(f, ":{text}")?;
            }
        }
        Ok(())
    }
}

/// What a name above a column says, if it is one of the usual ones. [`Role::Bytes`] is that of any column of one byte.
pub(super) fn role_of(name: &[u8]) -> Option<(Role, Option<Form>)> {
    let plain: Vec<u8> =
        name.iter().filter(|byte| byte.is_ascii_alphanumeric()).map(u8::to_ascii_lowercase).collect();
    let plain = std::str::from_utf8(&plain).ok()?;
    // As `rostopic echo -p` names them: all its numbers are decimal.
    if let Some(field) = name.strip_prefix(b"field.") {
        let (role, form) = role_of(field)?;
        return Some((role, role.takes(Form::Decimal).then_some(Form::Decimal).or(form)));
    }
    // As `tshark -T fields` and `-T json` name them, and `-T ek`, whose identifiers are decimal.
    match name {
        b"frame.time_epoch" | b"frame.time_relative" | b"frame_frame_time_epoch" => {
            return Some((Role::Time, Some(Form::Unit(1_000_000_000))));
        }
        b"can.id" | b"can_can_id" => return Some((Role::Id, Some(Form::Decimal))),
        b"can.len" | b"can_can_len" => return Some((Role::Dlc, None)),
        b"data.data" | b"data_data_data" => return Some((Role::Data, Some(Form::Hex))),
        b"can.flags.xtd" | b"can_can_flags_xtd" => return Some((Role::Extended, None)),
        b"can.flags.rtr" | b"can_can_flags_rtr" => return Some((Role::Remote, None)),
        b"can.flags.err" | b"can_can_flags_err" => return Some((Role::Error, None)),
        _ => {}
    }
    let stem = plain.trim_end_matches(|last: char| last.is_ascii_digit());
    if stem.len() < plain.len() && matches!(stem, "d" | "b" | "data" | "byte" | "databyte" | "db") {
        return Some((Role::Bytes, None));
    }
    for prefix in [
        "timestamps",
        "timestamp",
        "timeoffset",
        "unixtimestamp",
        "unixtime",
        "abstime",
        "starttime",
        "time",
        "ts",
        "zeitstempel",
        "zeit",
    ] {
        if let Some(unit) = plain.strip_prefix(prefix) {
            let unit = match unit {
                "" | "stamp" | "epoch" | "abs" => None,
                "s" | "sec" | "secs" | "second" | "seconds" => Some("s"),
                "ms" | "msec" | "milliseconds" => Some("ms"),
                "us" | "usec" | "microseconds" => Some("us"),
                "ns" | "nsec" | "nanoseconds" => Some("ns"),
                _ => return None,
            };
            let form = FORMS.iter().find(|(text, _)| Some(*text) == unit).map(|(_, form)| *form);
            return Some((Role::Time, form));
        }
    }
    // As sketches call what their boards count.
    match plain {
        // AutoPi's `_stamp`.
        "t" | "stamp" => return Some((Role::Time, None)),
        "millis" => return Some((Role::Time, Some(Form::Unit(1_000_000)))),
        "micros" => return Some((Role::Time, Some(Form::Unit(1_000)))),
        _ => {}
    }
    let (bare, radix) = match (plain.strip_suffix("hex"), plain.strip_suffix("dec")) {
        (Some(bare), _) => (bare, Some(Form::Hex)),
        (_, Some(bare)) => (bare, Some(Form::Decimal)),
        _ => (plain, None),
    };
    let role = match bare {
        "id" | "canid" | "arbitrationid" | "arbid" | "identifier" | "canidentifier" | "addr" | "address"
        | "messageid" | "msgid" | "frameid" | "idh" => Role::Id,
        "dlc" | "dl" | "len" | "length" | "datalength" | "datalen" | "candlc" | "control"
        | "messagelength" | "laenge" | "lnge" | "datenlaenge" | "datenlnge" => Role::Dlc,
        "data" | "payload" | "databytes" | "datafield" | "candata" | "rawdata" | "daten" => Role::Data,
        "bus" | "busid" | "busnumber" => return Some((Role::Channel, Some(Form::FromZero))),
        "channel" | "chn" | "ch" | "interface" | "network" | "buschannel" | "canchannel" | "kanal" => {
            Role::Channel
        }
        "extended" | "ide" | "ext" | "extd" | "isextended" | "isextendedid" | "extendedid" | "idtype" => {
            Role::Extended
        }
        "remote" | "remoteedlbrsesi" | "rtr" | "isremote" | "isrtr" | "isremoteframe" => Role::Remote,
        "error" | "er" | "iserror" | "errorframe" | "iserrorframe" => Role::Error,
        "dir" | "direction" | "rxtx" | "txrx" | "tx" | "richtung" => Role::Direction,
        _ => return None,
    };
    Some((role, radix.filter(|form| role.takes(*form))))
}

/// Whether a column of this name describes the frame of a row in words: its type (true), or one or another property of it (false).
pub(super) fn kind_of(name: &[u8]) -> Option<bool> {
    let letters = name.iter().filter(|byte| byte.is_ascii_alphanumeric()).map(u8::to_ascii_lowercase);
    match letters.collect::<Vec<_>>().as_slice() {
        b"type" | b"frametype" | b"frame" | b"format" | b"frameformat" | b"msgtype" | b"messagetype"
        | b"eventtype" | b"kind" => Some(true),
        b"flags" | b"flag" | b"state" => Some(false),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn columns_are_read_as_they_are_written_and_what_is_bad_is_named() {
        let text = "time=Time Stamp:us,id=CAN: ID:hex,dlc=3,bytes=D0:dec,channel=Bus:0";
        assert_eq!(text.parse::<Columns>().unwrap().to_string(), text);
        for (bad, message) in [
            ("time", "'time' is not a column"),
            ("speed=1,id=2,data=3", "'speed=1' is not a column"),
            ("id=1,id=2,data=3", "the column for 'id' is given twice"),
            ("id=1:ms,data=3", "a column for 'id' has no form 'ms'"),
            ("id=,data=3", "'id=' is not a column"),
            ("time=1,id=2", "a table needs columns for the identifier and the bytes"),
            ("", "'' is not a column"),
        ] {
            let error = bad.parse::<Columns>().unwrap_err().to_string();
            assert!(error.starts_with(message), "{error}");
        }
    }

    #[test]
    fn the_usual_names_are_known() {
        for (name, role) in [
            ("Timestamp", Role::Time),
            ("time_s", Role::Time),
            ("Time (ms)", Role::Time),
            ("Time (abs)", Role::Time),
            ("Start Time", Role::Time),
            ("Unix Time", Role::Time),
            ("CAN ID", Role::Id),
            ("Arbitration_ID", Role::Id),
            ("ID (hex)", Role::Id),
            ("Data Bytes", Role::Data),
            ("DATA0", Role::Bytes),
            ("D8", Role::Bytes),
            ("Byte 3", Role::Bytes),
            ("DLC", Role::Dlc),
            ("Bus", Role::Channel),
            ("t", Role::Time),
            ("_stamp", Role::Time),
            ("extd", Role::Extended),
            ("MessageLength", Role::Dlc),
        ] {
            assert_eq!(role_of(name.as_bytes()).map(|(role, _)| role), Some(role), "{name}");
        }
        for (name, unit_ns) in [("Time [ms]", 1_000_000), ("millis", 1_000_000), ("micros", 1_000)] {
            assert_eq!(role_of(name.as_bytes()), Some((Role::Time, Some(Form::Unit(unit_ns)))), "{name}");
        }
        for none in ["", "Time (rel)", "Label", "Signal1_of_ID", "Class", "D", "timer"] {
            assert_eq!(role_of(none.as_bytes()), None, "{none}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_columns_or_refused(text: String) {
            if let Ok(columns) = text.parse::<Columns>() {
                prop_assert_eq!(columns.to_string().parse(), Ok(columns));
            }
        }
    }
}
