//! What clients with certificates may do beyond their roles, as the owner of a server writes it in a file (docs/serve.md).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use cantap_wire::Id;
use cantap_wire::message::{Mode, Role};
use serde::Deserialize;

use crate::client::budget::Budgets;
use crate::small_file;

const MINUTES_PER_DAY: u16 = 24 * 60;

/// Why a file cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("'{}': {reason}", path.display())]
pub struct PermissionsError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong, and where.
    pub reason: String,
}

/// A file's content.
#[derive(Clone, Debug, Default)]
pub struct Permissions {
    clients: BTreeMap<String, Permit>,
    /// For certificates that the file does not name; without it, they are refused.
    default: Option<Permit>,
    /// For the boards that get these first. What has been sent counts on when the file is read again.
    pub(crate) budgets: Budgets,
}

/// What one client may do. What is left out is not restricted.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Permit {
    role: Option<Role>,
    /// By their numbers, from 1.
    channels: Option<Vec<u8>>,
    send: Option<Vec<IdRange>>,
    /// Frames that the client may have sent per second.
    pub frames_per_second: Option<u32>,
    modes: Option<Vec<Mode>>,
    hours: Option<Hours>,
}

/// Identifiers that agree with one in the bits of a mask.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct IdRange {
    id: Id,
    mask: u32,
}

/// Minutes of the day in UTC, from the first to before the last. The last may be earlier: then midnight is between them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Hours {
    from: u16,
    until: u16,
}

/// Why a client may not do something.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Denied {
    /// Nobody wrote anything of its certificate.
    #[error("the permissions do not name its certificate")]
    Unknown,
    /// It is the wrong time of the day.
    #[error("its hours are over")]
    Hours,
    /// The channel's number, from 1.
    #[error("channel {0} is not permitted")]
    Channel(u8),
    /// The identifier of a frame.
    #[error("sending {0} is not permitted")]
    Id(Id),
    /// A channel's mode.
    #[error("the mode {} is not permitted", .0.name())]
    Mode(Mode),
    /// More frames per second.
    #[error("more than {0} frames/s are not permitted")]
    Rate(u32),
    /// Replies of the board, whose number per second nobody knows in advance.
    #[error("replies of the board are not permitted, because only {0} frames/s are")]
    Replies(u32),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FileText {
    #[serde(default)]
    clients: BTreeMap<String, PermitText>,
    default: Option<PermitText>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PermitText {
    role: Option<String>,
    channels: Option<Vec<u8>>,
    send: Option<Vec<String>>,
    frames_per_second: Option<u32>,
    modes: Option<Vec<String>>,
    hours: Option<String>,
}

impl Permissions {
    /// Reads a file.
    pub fn read(path: &Path) -> Result<Self, PermissionsError> {
        let bad = |reason: String| PermissionsError { path: path.to_owned(), reason };
        let text = small_file::read_text(path).map_err(|error| bad(error.to_string()))?;
        Self::parse(&text).map_err(bad)
    }

    /// The content of a file. An error says what is wrong with it.
    pub fn parse(text: &str) -> Result<Self, String> {
        let FileText { clients, default } = toml::from_str(text).map_err(|error| error.to_string())?;
        let permit = |name: &str, text: PermitText| text.permit().map_err(|why| format!("{name}: {why}"));
        let named = |(name, text): (String, PermitText)| {
            let permit = permit(&format!("clients.{name}"), text)?;
            Ok((name, permit))
        };
        Ok(Self {
            clients: clients.into_iter().map(named).collect::<Result<_, String>>()?,
            default: default.map(|text| permit("default", text)).transpose()?,
            budgets: Budgets::default(),
        })
    }

    /// What the client with a certificate of this name may do now.
    pub fn of(&self, certificate: &str) -> Result<&Permit, Denied> {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        self.at(certificate, (now.as_secs() / 60 % u64::from(MINUTES_PER_DAY)) as u16)
    }

    fn at(&self, certificate: &str, minute: u16) -> Result<&Permit, Denied> {
        let permit = self.clients.get(certificate).or(self.default.as_ref()).ok_or(Denied::Unknown)?;
        if permit.hours.is_none_or(|hours| hours.contain(minute)) { Ok(permit) } else { Err(Denied::Hours) }
    }
}

impl Permit {
    /// The most that it may do, if it is less than this.
    pub fn role(&self, most: Role) -> Role {
        self.role.map_or(most, |role| role.min(most))
    }

    /// Whether it may use a channel, by its number from 1.
    pub fn channel(&self, number: u8) -> Result<(), Denied> {
        let is_permitted = self.channels.as_ref().is_none_or(|channels| channels.contains(&number));
        if is_permitted { Ok(()) } else { Err(Denied::Channel(number)) }
    }

    /// Whether it may open a channel in a mode.
    pub fn mode(&self, mode: Mode) -> Result<(), Denied> {
        let is_permitted = self.modes.as_ref().is_none_or(|modes| modes.contains(&mode));
        if is_permitted { Ok(()) } else { Err(Denied::Mode(mode)) }
    }

    /// Whether it may send frames with an identifier.
    pub fn send(&self, id: Id) -> Result<(), Denied> {
        let is_permitted = self.send.as_ref().is_none_or(|all| all.iter().any(|range| range.contains(id)));
        if is_permitted { Ok(()) } else { Err(Denied::Id(id)) }
    }
}

impl PermitText {
    fn permit(self) -> Result<Permit, String> {
        let role = |name: String| {
            let found = Role::ALL.into_iter().find(|role| role.name() == name);
            found.ok_or_else(|| format!("'{name}' is no role; roles are listen, configure and send"))
        };
        let mode = |name: &String| {
            let found = Mode::ALL.into_iter().find(|mode| mode.name() == name);
            found.ok_or_else(|| {
                let all: Vec<&str> = Mode::ALL.into_iter().map(Mode::name).collect();
                format!("'{name}' is no mode; modes are {}", all.join(", "))
            })
        };
        if self.channels.as_ref().is_some_and(|channels| channels.contains(&0)) {
            return Err("channels are numbered from 1".to_owned());
        }
        if self.frames_per_second == Some(0) {
            return Err("frames_per_second is at least 1; role = \"listen\" permits none".to_owned());
        }
        let ranges = |texts: Vec<String>| texts.iter().map(|text| IdRange::parse(text)).collect();
        Ok(Permit {
            role: self.role.map(role).transpose()?,
            channels: self.channels,
            send: self.send.map(ranges).transpose()?,
            frames_per_second: self.frames_per_second,
            modes: self.modes.map(|modes| modes.iter().map(mode).collect()).transpose()?,
            hours: self.hours.as_deref().map(Hours::parse).transpose()?,
        })
    }
}

impl IdRange {
    /// `123`, `18DAF110`, or with a mask behind it: `600:7F0`.
    fn parse(text: &str) -> Result<Self, String> {
        let bad =
            || format!("'{text}' is no identifier; write it as 123, 18DAF110, or with a mask as 600:7F0");
        let (id, mask) = text.split_once(':').map_or((text, None), |(id, mask)| (id, Some(mask)));
        let id: Id = id.parse().map_err(|_| bad())?;
        let all = if id.is_extended() { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
        let mask = match mask {
            None => all,
            Some(mask) if !mask.is_empty() && mask.bytes().all(|digit| digit.is_ascii_hexdigit()) => {
                u32::from_str_radix(mask, 16).ok().filter(|mask| *mask <= all).ok_or_else(bad)?
            }
            Some(_) => return Err(bad()),
        };
        Ok(Self { id, mask })
    }

    const fn contains(self, id: Id) -> bool {
        self.id.is_extended() == id.is_extended() && (self.id.raw() ^ id.raw()) & self.mask == 0
    }
}

impl Hours {
    fn parse(text: &str) -> Result<Self, String> {
        let minute = |text: &str| {
            let (hours, minutes) = text.split_once(':')?;
            let is_time = |text: &str| text.len() == 2 && text.bytes().all(|digit| digit.is_ascii_digit());
            if !is_time(hours) || !is_time(minutes) {
                return None;
            }
            let (hours, minutes): (u16, u16) = (hours.parse().ok()?, minutes.parse().ok()?);
            let minute = hours * 60 + minutes;
            (minutes < 60 && minute <= MINUTES_PER_DAY).then_some(minute)
        };
        let hours = text.split_once('-').and_then(|(from, until)| {
            let hours = Self { from: minute(from)?, until: minute(until)? };
            (hours.from != hours.until).then_some(hours)
        });
        hours.ok_or_else(|| format!("'{text}' are no hours; write them in UTC as 08:00-18:00"))
    }

    const fn contain(self, minute: u16) -> bool {
        if self.from < self.until {
            self.from <= minute && minute < self.until
        } else {
            self.from <= minute || minute < self.until
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = r#"
        [clients.alice]
        channels = [1]
        send = ["123", "600:7F0", "18DA00F1:1FFF00FF"]
        frames_per_second = 100
        modes = ["listen-only", "normal"]
        hours = "22:00-06:00"

        [default]
        role = "listen"
    "#;

    fn id(text: &str) -> Id {
        text.parse().unwrap()
    }

    #[test]
    fn a_permit_permits_what_it_names_and_nothing_else() {
        let all = Permissions::parse(FILE).unwrap();
        let alice = all.at("alice", 23 * 60).unwrap();
        assert_eq!(alice.role(Role::Send), Role::Send);
        assert_eq!((alice.channel(1), alice.channel(2)), (Ok(()), Err(Denied::Channel(2))));
        for sent in ["123", "600", "60F", "18DA10F1", "18DAFFF1"] {
            assert_eq!(alice.send(id(sent)), Ok(()), "{sent}");
        }
        // An extended identifier with the same number is another one.
        for sent in ["124", "610", "00000123", "00000600", "18DA10F2", "18DB10F1"] {
            assert_eq!(alice.send(id(sent)), Err(Denied::Id(id(sent))), "{sent}");
        }
        assert_eq!(alice.mode(Mode::Normal), Ok(()));
        assert_eq!(alice.mode(Mode::Loopback), Err(Denied::Mode(Mode::Loopback)));
        let is_open = |minute| all.at("alice", minute).is_ok();
        assert_eq!(
            [22 * 60 - 1, 22 * 60, 0, 6 * 60 - 1, 6 * 60].map(is_open),
            [false, true, true, true, false]
        );
        // Everybody else.
        let other = all.at("bob", 0).unwrap();
        assert_eq!((other.role(Role::Send), other.role(Role::Listen)), (Role::Listen, Role::Listen));
        let only = Permissions::parse("[clients.alice]\n").unwrap();
        assert_eq!(only.at("bob", 0).err(), Some(Denied::Unknown));
        assert_eq!(only.at("alice", 0).unwrap().send(id("7FF")), Ok(()));
    }

    /// A slip in the file must not permit more than was meant.
    #[test]
    fn what_is_not_understood_is_an_error() {
        for (text, named) in [
            ("[clients.a]\nlanes = [1]", "lanes"),
            ("[client.a]", "client"),
            ("[clients.a]\nrole = \"admin\"", "clients.a: 'admin' is no role"),
            ("[clients.a]\nsend = [\"1234\"]", "'1234' is no identifier"),
            ("[clients.a]\nsend = [\"123:\"]", "'123:' is no identifier"),
            ("[clients.a]\nsend = [\"123:FFFF\"]", "'123:FFFF' is no identifier"),
            ("[clients.a]\nsend = [\"+123\"]", "no identifier"),
            ("[default]\nmodes = [\"loud\"]", "default: 'loud' is no mode"),
            ("[default]\nhours = \"8-18\"", "'8-18' are no hours"),
            ("[default]\nhours = \"08:00-24:01\"", "are no hours"),
            ("[default]\nhours = \"08:00-08:00\"", "are no hours"),
            ("[default]\nchannels = [0]", "from 1"),
            ("[default]\nframes_per_second = 0", "at least 1"),
        ] {
            let error = Permissions::parse(text).err().unwrap_or_default();
            assert!(error.contains(named), "{text}: {error}");
        }
    }
}
