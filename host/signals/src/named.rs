//! Filters and identifiers in which messages of a database may be named: `EngineData`, `can0,EngineData,123`, `msg:EEC1`.
//!
//! A command line is parsed before its databases are loaded. So parsing only notes a name, and [`NamedFilter::resolve`] and
//! [`NamedId::resolve`] look it up.

use std::fmt;
use std::str::FromStr;

use cantap_trace::Interface;
use cantap_trace::filter::{Filter, ParseFilterError};
use cantap_trace::grammar::{IdError, IdPattern, group_of, interface};

use crate::{Decoder, Message, Suggestion};

/// Before a name that could also be something else.
pub(crate) const PREFIX: &str = "msg:";
/// Stands for an identifier that is not known yet.
const PLACEHOLDER: &str = "000";

/// Why a text is not a filter or an identifier, or its name not one of a message.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NameError {
    /// There is no database.
    #[error("'{0}' can only be the name of a message, and no database is loaded")]
    NoDatabase(String),
    /// The databases do not have it.
    #[error("no database has a message '{name}'{near}")]
    Unknown {
        /// The name.
        name: String,
        /// A similar name.
        near: Suggestion,
    },
    /// Probably a message's name with a mistake in it, but it could be an interface's.
    #[error("no database has a message '{name}'{near} If it is an interface, write {interface}")]
    Interface {
        /// The name.
        name: String,
        /// A similar name.
        near: Suggestion,
        /// The same interface by a name that no message has.
        interface: String,
    },
    /// It is a message, and hexadecimal as well.
    #[error("'{name}' is a message of a database, and also an identifier; write msg:{name} or 0x{name}")]
    Ambiguous {
        /// The name.
        name: String,
    },
    /// Hexadecimal, but too large for an identifier: perhaps it is a name.
    #[error("{error}, or msg:{name} for the message of that name")]
    TooLarge {
        /// Why it is not an identifier.
        error: IdError,
        /// The possible name.
        name: String,
    },
    /// Not a filter.
    #[error(transparent)]
    Filter(ParseFilterError),
    /// Not an identifier.
    #[error(transparent)]
    Id(IdError),
}

impl From<IdError> for NameError {
    fn from(error: IdError) -> Self {
        match &error {
            IdError::TooLarge { text, .. } if text.starts_with(|first: char| first.is_ascii_alphabetic()) => {
                Self::TooLarge { name: text.clone(), error }
            }
            _ => Self::Id(error),
        }
    }
}

impl From<ParseFilterError> for NameError {
    fn from(error: ParseFilterError) -> Self {
        match error {
            ParseFilterError::Id(error) => error.into(),
            error => Self::Filter(error),
        }
    }
}

/// Whether a text can be the name of a message and is not hexadecimal: letters, digits, `_` and `.`.
fn is_name(text: &str) -> bool {
    text.len() > 1
        && text.starts_with(|first: char| first.is_alphabetic() || first == '_')
        && text.chars().all(|each| each.is_alphanumeric() || matches!(each, '_' | '.'))
        && !text.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// The name in a part of a filter: after `msg:`, or the part itself if it cannot be an identifier.
fn name_of(part: &str) -> Option<&str> {
    match part.strip_prefix(PREFIX) {
        Some(name) => Some(name).filter(|name| !name.is_empty()),
        None => Some(part).filter(|part| is_name(part)),
    }
}

/// Whether a part of a filter cannot be anything but a name. Only the first part can be an interface.
fn is_only_a_name(at: usize, part: &str) -> bool {
    let is_interface = at == 0 && part.parse::<Filter>().is_ok() || interface(part).is_some();
    name_of(part).is_some() && !is_interface
}

/// The messages of that name, of all databases.
fn named<'d>(name: &str, decoder: &'d Decoder) -> impl Iterator<Item = &'d Message> {
    decoder.messages().map(|(_, _, message)| message).filter(move |message| message.name == name)
}

fn nearest(name: &str, decoder: &Decoder) -> Suggestion {
    Suggestion::nearest(name, decoder.messages().map(|(_, _, message)| message.name.as_str()))
}

/// How the grammar writes a message's identifier.
fn identifier(message: &Message) -> String {
    match group_of(message.id).filter(|_| message.j1939) {
        Some(group) => format!("pgn:{group}"),
        None => message.id.to_string(),
    }
}

/// The identifiers of the messages of a name.
fn identifiers(name: &str, decoder: &Decoder) -> Result<Vec<String>, NameError> {
    let mut found: Vec<String> = named(name, decoder).map(identifier).collect();
    found.sort();
    found.dedup();
    if !found.is_empty() {
        return Ok(found);
    }
    Err(match decoder.messages().next() {
        Some(_) => NameError::Unknown { name: name.to_owned(), near: nearest(name, decoder) },
        None => NameError::NoDatabase(name.to_owned()),
    })
}

/// A filter in which messages may be named.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NamedFilter {
    text: String,
    /// With [`PLACEHOLDER`] for each name.
    outline: Filter,
}

impl FromStr for NamedFilter {
    type Err = NameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let named = text.split(',').enumerate();
        let outline: Vec<&str> =
            named.map(|(at, part)| if is_only_a_name(at, part) { PLACEHOLDER } else { part }).collect();
        Ok(Self { text: text.to_owned(), outline: outline.join(",").parse()? })
    }
}

impl fmt::Display for NamedFilter {
    /// As typed.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl NamedFilter {
    /// The filter with the identifiers of the messages that it names, on whichever channel their database is used.
    pub fn resolve(&self, decoder: &Decoder) -> Result<Filter, NameError> {
        let mut parts = Vec::new();
        for (at, part) in self.text.split(',').enumerate() {
            let is_message = named(part, decoder).next().is_some();
            if is_message && part.parse::<IdPattern>().is_ok() {
                return Err(NameError::Ambiguous { name: part.to_owned() });
            }
            let is_interface = at == 0 && interface(part).is_some();
            match name_of(part).filter(|_| is_only_a_name(at, part) || is_message && !is_interface) {
                Some(name) => {
                    let all = identifiers(name, decoder)?;
                    if self.outline.join && all.len() > 1 {
                        return Err(ParseFilterError::JoinedRange(part.to_owned()).into());
                    }
                    parts.extend(all);
                }
                None if at == 0 && !is_interface => {
                    self.refuse_near_names(part, decoder)?;
                    parts.push(part.to_owned());
                }
                None => parts.push(part.to_owned()),
            }
        }
        Ok(parts.join(",").parse()?)
    }

    /// `TCM_Trans1` could be any computer's interface, but with a database that has `TCM_Transmission1`, hardly.
    fn refuse_near_names(&self, part: &str, decoder: &Decoder) -> Result<(), NameError> {
        let Some(channel) = self.outline.channel.filter(|_| is_name(part)) else { return Ok(()) };
        match nearest(part, decoder) {
            near if near.is_none() => Ok(()),
            near => Err(NameError::Interface {
                name: part.to_owned(),
                near,
                interface: Interface(channel).to_string(),
            }),
        }
    }
}

/// Identifiers as [`IdPattern`] has them, or the name of a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NamedId {
    text: String,
    /// `None` if it is a name.
    pattern: Option<IdPattern>,
}

impl FromStr for NamedId {
    type Err = NameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let pattern = match text.parse() {
            Ok(pattern) => Some(pattern),
            Err(_) if name_of(text).is_some() => None,
            Err(error) => return Err(IdError::into(error)),
        };
        Ok(Self { text: text.to_owned(), pattern })
    }
}

impl NamedId {
    /// The identifiers: several if several messages have the name.
    pub fn resolve(&self, decoder: &Decoder) -> Result<Vec<IdPattern>, NameError> {
        match &self.pattern {
            Some(_) if named(&self.text, decoder).next().is_some() => {
                Err(NameError::Ambiguous { name: self.text.clone() })
            }
            Some(pattern) => Ok(vec![pattern.clone()]),
            None => {
                let all = identifiers(name_of(&self.text).unwrap_or(&self.text), decoder)?;
                all.iter().map(|text| text.parse::<IdPattern>().map_err(Into::into)).collect()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Source, dbc};

    fn decoder() -> Decoder {
        let text = "BO_ 291 EngineData: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\nBO_ 2566844672 Extended_1: 8 A\n\
                    BO_ 512 EEC1: 8 A\nBO_ 513 Body2: 8 A\nBO_ 514 ACC: 8 A\nBO_ 3221225472 x: 8 A\n";
        let database = dbc::parse("x.dbc", text.as_bytes()).unwrap();
        let twice = dbc::parse("y.dbc", b"BO_ 292 EngineData: 8 A\n").unwrap();
        Decoder::new(vec![
            Source { channel: Some(1), database },
            Source { channel: Some(2), database: twice },
        ])
    }

    fn filter(text: &str) -> Result<String, String> {
        let named = text.parse::<NamedFilter>().map_err(|error| error.to_string())?;
        named.resolve(&decoder()).map(|filter| filter.to_string()).map_err(|error| error.to_string())
    }

    fn same(text: &str) -> Result<String, String> {
        text.parse::<Filter>().map(|filter| filter.to_string()).map_err(|error| error.to_string())
    }

    #[test]
    fn names_stand_for_the_identifiers_of_their_messages() {
        assert_eq!(filter("EngineData"), same("123,124"));
        assert_eq!(filter("can0,EngineData,7FF"), same("can0,123,124,7FF"));
        assert_eq!(filter("msg:EEC1"), same("200"));
        assert_eq!(filter("any,Body2"), same("201"));
        assert_eq!(filter("Extended_1,#FF"), same("18FEF100,#FF"));
        // Without a name, nothing changes.
        for text in ["123:7FF", "can1", "C0", "pgn:61444", "can1,400~7F0,#FF,j"] {
            assert_eq!(filter(text), same(text), "{text}");
        }
        let ids = |text: &str| text.parse::<NamedId>().unwrap().resolve(&decoder()).unwrap();
        assert_eq!(ids("EngineData"), ["123".parse().unwrap(), "124".parse().unwrap()]);
        assert_eq!(ids("100-1FF"), ["100-1FF".parse().unwrap()]);
        assert_eq!(ids("msg:EEC1"), ["200".parse().unwrap()]);
    }

    #[test]
    fn what_may_mean_two_things_is_an_error_that_shows_both_spellings() {
        let error = filter("EEC1").unwrap_err();
        assert!(error.contains("msg:EEC1 or 0xEEC1"), "{error}");
        // Nobody gives an interface the name of a message.
        assert_eq!(filter("Body2"), same("201"));
        assert_eq!(filter("eth0,Body2"), same("can0,201"));
        let error = "EEC1".parse::<NamedId>().unwrap().resolve(&decoder()).unwrap_err().to_string();
        assert!(error.contains("msg:EEC1 or 0xEEC1"), "{error}");
        // Several messages cannot all match.
        assert!(filter("EngineData,j").unwrap_err().contains("with j all of them must match"));
    }

    #[test]
    fn an_unknown_name_and_one_without_a_database_say_what_to_do() {
        let error = filter("EngineDate").unwrap_err();
        assert!(
            error.ends_with("no database has a message 'EngineDate'; did you mean EngineData?"),
            "{error}"
        );
        let alone = "EngineData".parse::<NamedFilter>().unwrap().resolve(&Decoder::new(Vec::new()));
        assert_eq!(alone, Err(NameError::NoDatabase("EngineData".to_owned())));
        for text in ["x", "12g", "ca0", "msg:", "En gine", "EngineData,12g", "EngineData,#", "EngineData,,"] {
            assert!(text.parse::<NamedFilter>().is_err(), "{text}");
        }
        for text in ["x", "12g", "ca0", "800", "", "123456789", "msg:"] {
            assert!(text.parse::<NamedId>().is_err(), "{text}");
        }
    }

    /// A mistake in a name that ends with a digit must not become another channel.
    #[test]
    fn an_interface_that_is_nearly_a_message_is_an_error_that_shows_both() {
        let error = filter("Bdoy2").unwrap_err();
        assert!(error.ends_with("did you mean Body2? If it is an interface, write can2"), "{error}");
        for text in ["eth0", "can1", "vcan0", "any", "any,123"] {
            assert_eq!(filter(text), same(text), "{text}");
        }
        let without = "Bdoy2".parse::<NamedFilter>().unwrap().resolve(&Decoder::new(Vec::new()));
        assert_eq!(without.unwrap(), Filter::on_channel(3));
    }

    /// ACC is a usual name, and hexadecimal, but no identifier.
    #[test]
    fn a_name_that_looks_like_too_large_an_identifier_can_be_written_with_its_prefix() {
        assert_eq!(filter("msg:ACC"), same("202"));
        for error in [
            filter("ACC").unwrap_err(),
            filter("EngineData,ACC").unwrap_err(),
            "ACC".parse::<NamedId>().unwrap_err().to_string(),
        ] {
            assert!(error.ends_with("can0, or msg:ACC for the message of that name"), "{error}");
        }
    }

    /// Of a parameter group, every sender's frames.
    #[test]
    fn a_j1939_message_is_its_parameter_group() {
        let mut decoder = decoder();
        decoder.assume_j1939();
        let filter = "Extended_1".parse::<NamedFilter>().unwrap().resolve(&decoder).unwrap();
        assert!(filter.accepts_frame(&"18FEF1AA#".parse().unwrap()));
    }
}
