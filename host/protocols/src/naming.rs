//! Names for the content of events: the protocol, a dot, and the field: `uds.sid`, `j1939.pgn`, `canopen.node`.
//!
//! A field has its name in the event, in lower case, with `_` for everything that is neither a letter nor a digit:
//! `nmea2000.cog_reference`. The second field with a name is `NAME_2`, as in JSON; without a number, all of them are meant. Every
//! event also has the names in [`COMMON`].

use cantap_signals::condition::ConditionEvent;
use cantap_trace::TraceRecord;

use crate::{Event, EventKind, Field, Party, Protocol, Value};

/// The names that every event has besides its own fields, which take precedence.
pub const COMMON: [(&str, &str); 13] = [
    ("kind", "what kind of event it is, such as exchange"),
    ("title", "the service, message or parameter group"),
    ("from", "who said it, as in text: 7E0, 6F1/12, 5"),
    ("to", "to whom"),
    ("node", "the number of the node that said it, or of the one it was said to"),
    ("channel", "the channel, from 1"),
    ("time_s", "when it was complete, in seconds"),
    ("response_ms", "from the request to its response, in milliseconds"),
    ("frames", "how many frames it took"),
    ("length", "how many bytes of data there are"),
    (
        "fault",
        "there, and 1, if something went wrong: a refusal, no response, a transfer that broke, frames that were lost",
    ),
    ("trouble", "what went wrong, in a word, such as timeout"),
    ("frames_lost", "there, and 1, if frames were lost meanwhile"),
];

/// A field's name in conditions and columns.
pub fn plain(name: &str) -> String {
    let mut plain = String::with_capacity(name.len());
    for letter in name.chars() {
        if letter.is_alphanumeric() {
            plain.extend(letter.to_lowercase());
        } else if !plain.ends_with('_') {
            plain.push('_');
        }
    }
    plain.trim_matches('_').to_owned()
}

fn is_plain(name: &str, wanted: &str) -> bool {
    // Most names are already in this form.
    name == wanted || plain(name) == wanted
}

/// The protocol and the field of a name such as `uds.sid`.
pub fn parts(name: &str) -> Option<(Protocol, String)> {
    let (protocol, field) = name.split_once('.')?;
    let field = plain(field);
    Some((protocol.parse().ok()?, field)).filter(|(_, field)| !field.is_empty())
}

/// Whether a name is `name`, or `name_2` and so on: `spn_version` is not the second `spn`.
fn is_again(known: &str, name: &str) -> bool {
    known.strip_prefix(name).is_some_and(|rest| {
        rest.is_empty() || rest.strip_prefix('_').is_some_and(|rest| rest.parse::<usize>().is_ok())
    })
}

/// Fields with their names in plain form, each once: the second of a name is `NAME_2`.
pub fn fields(event: &Event) -> Vec<(String, &Field)> {
    let mut fields: Vec<(String, &Field)> = Vec::with_capacity(event.fields.len());
    for field in &event.fields {
        let name = plain(&field.name);
        let before = fields.iter().filter(|(known, _)| is_again(known, &name)).count();
        let name = if before == 0 { name } else { format!("{name}_{}", before + 1) };
        fields.push((name, field));
    }
    fields
}

/// Whether a field, by its name in plain form, says which of several things an event is about: a data identifier, an object, an instance.
pub fn is_key(name: &str) -> bool {
    const KEYS: [&str; 11] =
        ["did", "ddi", "lid", "rid", "index", "sub", "class", "attribute", "instance", "element", "object"];
    KEYS.contains(&name)
        || (["_instance", "_index", "_id"].iter().any(|end| name.ends_with(end))
            && !["sequence_id", "message_id"].contains(&name))
}

/// The same of a pattern, whose field may have `*`, `?` and `[a-z]`.
pub(crate) fn parts_of_pattern(pattern: &str) -> Option<(Protocol, String)> {
    let (protocol, field) = pattern.split_once('.')?;
    Some((protocol.parse().ok()?, field.to_lowercase())).filter(|(_, field)| !field.is_empty())
}

/// A value for a name.
enum Named<'a> {
    Field(&'a Field),
    Number(f64),
    Text(std::borrow::Cow<'a, str>),
}

impl Event {
    /// Whether something went wrong: a refusal, an unanswered request, a broken transfer, missing frames.
    pub fn is_fault(&self) -> bool {
        self.trouble.is_some() || self.frames_lost || self.kind == EventKind::Refusal
    }

    /// The node that sent it, or that it was sent to.
    pub fn node(&self) -> Option<u8> {
        self.from.node().or(self.to.node())
    }

    /// Its fields with this name, which must be in plain form.
    fn named<'a>(&'a self, wanted: &'a str) -> Vec<Named<'a>> {
        let all = |wanted: &str| {
            self.fields
                .iter()
                .filter(|field| is_plain(&field.name, wanted))
                .map(Named::Field)
                .collect::<Vec<_>>()
        };
        let own = all(wanted);
        if !own.is_empty() {
            return own;
        }
        if let Some((name, number)) = wanted.rsplit_once('_')
            && let Some(before) = number.parse::<usize>().ok().and_then(|number| number.checked_sub(1))
            && let Some(one) = all(name).into_iter().nth(before)
        {
            return vec![one];
        }
        self.common(wanted).into_iter().collect()
    }

    fn common(&self, wanted: &str) -> Option<Named<'_>> {
        let number = |number: f64| Some(Named::Number(number));
        let party = |party: Party| (party != Party::Unknown).then(|| Named::Text(party.to_string().into()));
        match wanted {
            "kind" => Some(Named::Text(self.kind.name().into())),
            "title" => Some(Named::Text(self.title.as_ref().into())),
            "from" => party(self.from),
            "to" => party(self.to),
            "node" => self.node().and_then(|node| number(node.into())),
            "channel" => number(self.channel.into()),
            "time_s" => number(self.time_ns as f64 / 1e9),
            "response_ms" => self.response_ns.and_then(|ns| number(ns as f64 / 1e6)),
            "frames" => number(self.frames.into()),
            "length" => number(self.data.len() as f64),
            "fault" => self.is_fault().then_some(Named::Number(1.0)),
            "trouble" => self.trouble.map(|trouble| Named::Text(trouble.code().into())),
            "frames_lost" => self.frames_lost.then_some(Named::Number(1.0)),
            _ => None,
        }
    }

    /// The values for a condition's name; `None` if it belongs to another protocol.
    fn asked<'a>(&'a self, field: &'a mut String, name: &str) -> Option<Vec<Named<'a>>> {
        let (protocol, plain) = parts(name)?;
        *field = plain;
        (protocol == self.protocol).then(|| self.named(field))
    }
}

impl ConditionEvent for Event {
    fn channel(&self) -> u8 {
        self.channel
    }

    fn is_completed_by(&self, record: &TraceRecord) -> bool {
        (self.time_ns, self.channel) == (record.time_ns, record.channel) && record.frame().is_some()
    }

    fn has(&self, name: &str) -> Option<bool> {
        let there =
            |named: &Named<'_>| !matches!(named, Named::Field(field) if field.value == Value::Missing);
        Some(self.asked(&mut String::new(), name)?.iter().any(there))
    }

    fn numbers(&self, name: &str, out: &mut dyn FnMut(f64)) {
        for named in self.asked(&mut String::new(), name).into_iter().flatten() {
            match named {
                Named::Field(field) => field.value.as_number().into_iter().for_each(&mut *out),
                Named::Number(number) => out(number),
                // An identifier or a node's number.
                Named::Text(_) => {}
            }
        }
    }

    fn is_text(&self, name: &str, text: &str) -> Option<bool> {
        let mut field = String::new();
        let named = self.asked(&mut field, name)?;
        let same = |value: &str| value.to_lowercase() == text.to_lowercase();
        let is = |named: &Named<'_>| match named {
            Named::Field(Field { value, text, .. }) => {
                text.as_deref().is_some_and(same)
                    || match value {
                        Value::Text(value) => same(value),
                        Value::Bytes(bytes) => same(&crate::text::hex(bytes)),
                        _ => false,
                    }
            }
            Named::Text(value) => same(value),
            Named::Number(_) => false,
        };
        if named.is_empty() { None } else { Some(named.iter().any(is)) }
    }

    fn describe(&self) -> String {
        self.to_string()
    }
}
