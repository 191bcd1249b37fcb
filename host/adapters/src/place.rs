//! Where an adapter is, as users type it.

use std::fmt;
use std::str::FromStr;

use cantap::device::Link;
use cantap_formats::Format;
use cantap_trace::grammar::bit_rate;
use cantap_vendor::pcan_basic;

use crate::canalyst_ii::CanalystIi;
use crate::cannelloni::{self, Cannelloni};
use crate::cannelloni_tcp::CannelloniTcp;
use crate::driver::{Driver, OpenError};
use crate::elm327::{self, Elm327, Family, Ids};
use crate::engine;
use crate::gs_usb::{self, GsUsb};
use crate::gvret::{self, Gvret};
use crate::interface_name;
use crate::kvaser::{self, Kvaser};
use crate::line::Line;
use crate::maker_options::MakerOptions;
use crate::pcan::Pcan;
use crate::slcan::{self, Slcan};
#[cfg(target_os = "linux")]
use crate::socketcan::exists;
use crate::socketcand::{self, Socketcand};
use crate::trace_pipe::TracePipe;
use crate::usb_can_a::{self, UsbCanA};

/// Only Linux has CAN interfaces.
#[cfg(not(target_os = "linux"))]
fn exists(_: &str) -> bool {
    false
}

/// An adapter's place: `can0`, `socketcan:can0`, `slcan:/dev/ttyACM0@115200`, `usb-can-a:/dev/ttyUSB0`, `gvret:tcp://192.168.4.1`, `pcan:PCAN_USBBUS1`, `kvaser:0`, `elm327:tcp://192.168.0.10`,
/// `stn:/dev/ttyUSB0`, `socketcand://HOST/can0`, `cannelloni://HOST:PORT`, `cannelloni:tcp://HOST`, `candump:-`, `pcapng:-`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Place {
    text: String,
    kind: Kind,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Kind {
    Slcan { port: String, baud: u32 },
    CanalystIi { serial: String },
    UsbCanA { port: String, baud: u32, extended: bool },
    GvretSerial { port: String, baud: u32, data_bitrate_bps: Option<u32> },
    GvretTcp { host: String, data_bitrate_bps: Option<u32> },
    Elm327 { family: Family, place: ElmPlace, ids: Option<Ids> },
    Socketcan { interface: String },
    GsUsb { serial: String, options: gs_usb::Options },
    Pcan { channel: Option<pcan_basic::Channel>, options: MakerOptions },
    Kvaser { which: kvaser::Which, options: MakerOptions },
    Socketcand { host: String, interface: String },
    Cannelloni { host: String, listen: u16 },
    CannelloniTcp { host: String },
    Trace { path: String, format: TraceFormat },
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum ElmPlace {
    Serial { port: String, baud: u32 },
    Tcp { host: String },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TraceFormat {
    Candump,
    Pcapng,
}

/// Why a text is no adapter's place. It says what would be right.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct BadPlace(String);

/// What addresses of adapters begin with.
const SCHEMES: [&str; 14] = [
    "socketcan:",
    "gs_usb:",
    "slcan:",
    "usb-can-a:",
    "canalyst-ii:",
    "gvret:",
    "pcan:",
    "kvaser:",
    "elm327:",
    "stn:",
    "socketcand:",
    "cannelloni:",
    "candump:",
    "pcapng:",
];

impl Place {
    /// Whether a text is meant for an adapter.
    pub fn is_meant(text: &str) -> bool {
        SCHEMES.iter().any(|scheme| text.starts_with(scheme))
            || text == "gs_usb"
            || interface_name::is_meant(text, exists)
    }

    /// The bit rate that the adapter's owner has set, in bit/s, if it can be read without the adapter.
    pub fn bitrate(&self) -> Option<u32> {
        match &self.kind {
            Kind::Socketcan { interface } => bitrate_of(interface),
            _ => None,
        }
    }

    /// Whether a bit rate has to be given, since the adapter is set to it. Otherwise it is set elsewhere, or there is none.
    pub const fn sets_bit_rate(&self) -> bool {
        !matches!(
            self.kind,
            Kind::Socketcan { .. }
                | Kind::Socketcand { .. }
                | Kind::Cannelloni { .. }
                | Kind::CannelloniTcp { .. }
                | Kind::Trace { .. }
        )
    }

    /// The bit rate of the data phases of CAN FD frames, in bit/s, if the adapter's owner or the address has set one.
    pub fn data_bitrate(&self) -> Option<u32> {
        match &self.kind {
            Kind::Socketcan { interface } => data_bitrate_of(interface),
            Kind::GsUsb { options, .. } => options.data_bitrate_bps,
            Kind::GvretSerial { data_bitrate_bps, .. } | Kind::GvretTcp { data_bitrate_bps, .. } => {
                *data_bitrate_bps
            }
            Kind::Pcan { options, .. } | Kind::Kvaser { options, .. } => options.data_bitrate_bps,
            _ => None,
        }
    }

    /// Why a bit rate that a user asks for cannot be used: it is another than the one that the adapter's owner has set.
    pub fn rate_conflict(&self, bitrate_bps: u32) -> Option<String> {
        let set = self.bitrate().filter(|set| !interface_name::same_rate(*set, bitrate_bps))?;
        let Kind::Socketcan { interface } = &self.kind else { return None };
        Some(format!(
            "{interface} runs at {set} bit/s, not at {bitrate_bps}: leave out -b, or set it, as root: ip link set {interface} down && \
             ip link set {interface} up type can bitrate {bitrate_bps} (or: cantap interface {interface} -b {bitrate_bps})"
        ))
    }

    /// Whether the adapter may come back after it was pulled out. A trace that has ended does not go on.
    pub const fn may_come_back(&self) -> bool {
        !matches!(self.kind, Kind::Trace { .. })
    }
}

impl FromStr for Place {
    type Err = BadPlace;

    fn from_str(text: &str) -> Result<Self, BadPlace> {
        let bad = |reason: &str| BadPlace(reason.to_owned());
        let (scheme, rest) = match text.split_once(':') {
            None if interface_name::is_meant(text, exists) => ("socketcan", text),
            None => (text, ""),
            Some(parts) => parts,
        };
        let kind = match scheme {
            "socketcan" if interface_name::is_possible(rest) => Kind::Socketcan { interface: rest.to_owned() },
            "socketcan" => return Err(bad("name the interface, as in socketcan:can0")),
            "gs_usb" => gs_usb_of(rest).ok_or_else(|| {
                bad("write gs_usb: or gs_usb:SERIAL, and after it ?termination=on or ?termination=off if that is to be changed, and ?data-bitrate=2M (or &data-bitrate=2M) for CAN FD")
            })?,
            "slcan" => {
                let (port, baud) = port_and_baud(rest, slcan::DEFAULT_BAUD)
                    .ok_or_else(|| bad("write slcan:PORT or slcan:PORT@BAUD, as in slcan:/dev/ttyACM0"))?;
                Kind::Slcan { port, baud }
            }
            "usb-can-a" => usb_can_a_of(rest).ok_or_else(|| {
                bad("write usb-can-a:PORT or usb-can-a:PORT@BAUD, as in usb-can-a:/dev/ttyUSB0, and ?ids=extended after it for extended frames")
            })?,
            "canalyst-ii" if rest.chars().all(|letter| letter.is_ascii_graphic()) => {
                Kind::CanalystIi { serial: rest.to_owned() }
            }
            "canalyst-ii" => return Err(bad("write canalyst-ii: or canalyst-ii:SERIAL")),
            "gvret" => gvret_of(rest).ok_or_else(|| {
                bad("write gvret:PORT, gvret:PORT@BAUD or gvret:tcp://HOST, and ?data-bitrate=2M after it if the adapter is set up for a bus with CAN FD")
            })?,
            "elm327" => elm327_of(Family::Elm, rest).ok_or_else(|| {
                bad("write elm327:PORT, elm327:PORT@BAUD or elm327:tcp://HOST:PORT, and ?ids=standard or ?ids=extended after it to choose")
            })?,
            "stn" => elm327_of(Family::Stn, rest)
                .ok_or_else(|| bad("write stn:PORT, stn:PORT@BAUD or stn:tcp://HOST:PORT"))?,
            "pcan" => pcan_of(rest)?,
            "kvaser" => kvaser_of(rest).ok_or_else(|| {
                bad("write kvaser: or kvaser:CHANNEL with CANlib's number, from 0, and after it ?data-bitrate=2M for CAN FD or ?library=PATH for a library that is not the system's")
            })?,
            "socketcand" => {
                let place = rest.strip_prefix("//").and_then(|rest| rest.split_once('/'));
                let is_name = |name: &str| {
                    !name.is_empty() && name.len() < 16 && name.chars().all(|letter| letter.is_ascii_graphic() && !"<>/".contains(letter))
                };
                place
                    .filter(|(_, interface)| is_name(interface))
                    .and_then(|(host, interface)| {
                        let host = with_port(host, socketcand::PORT)?;
                        Some(Kind::Socketcand { host, interface: interface.to_owned() })
                    })
                    .ok_or_else(|| bad("write socketcand://HOST/INTERFACE, as in socketcand://raspberry/can0"))?
            }
            "cannelloni" => cannelloni_of(rest)
                .ok_or_else(|| bad("write cannelloni://HOST:PORT, and ?listen=PORT after it if the other end sends to another port here; or cannelloni:tcp://HOST:PORT for a tunnel over TCP"))?,
            "candump" | "pcapng" if !rest.is_empty() => {
                let format = if scheme == "candump" { TraceFormat::Candump } else { TraceFormat::Pcapng };
                Kind::Trace { path: rest.to_owned(), format }
            }
            "candump" | "pcapng" => return Err(bad("name the pipe, as in candump:- for standard input")),
            _ => {
                let schemes = SCHEMES.join(", ");
                return Err(BadPlace(format!("it is no CAN interface's name, and begins with none of {schemes}")));
            }
        };
        Ok(Self { text: text.to_owned(), kind })
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

fn port_and_baud(text: &str, default: u32) -> Option<(String, u32)> {
    let (port, baud) = match text.rsplit_once('@') {
        Some((port, baud)) => (port, baud.parse().ok().filter(|baud| *baud > 0)?),
        None => (text, default),
    };
    (!port.is_empty()).then(|| (port.to_owned(), baud))
}

/// What stands before `?`, and what stands behind it between `&`.
fn and_options(rest: &str) -> (&str, impl Iterator<Item = &str>) {
    let (place, texts) = rest.split_once('?').map_or((rest, None), |(place, texts)| (place, Some(texts)));
    (place, texts.into_iter().flat_map(|texts| texts.split('&')))
}

fn gs_usb_of(rest: &str) -> Option<Kind> {
    let (serial, texts) = and_options(rest);
    let mut options = gs_usb::Options::default();
    for text in texts {
        match text.split_once('=')? {
            ("termination", "on") => options.termination = Some(true),
            ("termination", "off") => options.termination = Some(false),
            ("data-bitrate", rate) => options.data_bitrate_bps = Some(bit_rate(rate).ok()?),
            _ => return None,
        }
    }
    let is_serial = serial.chars().all(|letter| letter.is_ascii_graphic());
    is_serial.then(|| Kind::GsUsb { serial: serial.to_owned(), options })
}

fn usb_can_a_of(rest: &str) -> Option<Kind> {
    let (place, extended) = match rest.split_once('?') {
        None | Some((_, "ids=standard")) => (rest.split('?').next()?, false),
        Some((place, "ids=extended")) => (place, true),
        Some(_) => return None,
    };
    let (port, baud) = port_and_baud(place, usb_can_a::DEFAULT_BAUD)?;
    Some(Kind::UsbCanA { port, baud, extended })
}

fn gvret_of(rest: &str) -> Option<Kind> {
    let (place, data_bitrate_bps) = match rest.split_once('?') {
        Some((place, option)) => (place, Some(bit_rate(option.strip_prefix("data-bitrate=")?).ok()?)),
        None => (rest, None),
    };
    if let Some(host) = place.strip_prefix("tcp://") {
        return Some(Kind::GvretTcp { host: with_port(host, gvret::PORT)?, data_bitrate_bps });
    }
    let (port, baud) = port_and_baud(place, gvret::DEFAULT_BAUD)?;
    Some(Kind::GvretSerial { port, baud, data_bitrate_bps })
}

/// What an address of a maker's adapter has behind its channel.
fn maker_options<'t>(texts: impl Iterator<Item = &'t str>) -> Option<MakerOptions> {
    let mut options = MakerOptions::default();
    for text in texts {
        match text.split_once('=')? {
            ("data-bitrate", rate) => options.data_bitrate_bps = Some(bit_rate(rate).ok()?),
            ("library", path) if !path.is_empty() => options.library = Some(path.into()),
            _ => return None,
        }
    }
    Some(options)
}

fn pcan_of(rest: &str) -> Result<Kind, BadPlace> {
    let (channel, texts) = and_options(rest);
    let options = maker_options(texts).ok_or_else(|| {
        BadPlace("behind pcan:CHANNEL write ?data-bitrate=2M for CAN FD or ?library=PATH for a library that is not the system's".to_owned())
    })?;
    let parse = || channel.parse().map_err(|error: pcan_basic::BadChannel| BadPlace(error.to_string()));
    let channel = (!channel.is_empty()).then(parse).transpose()?;
    Ok(Kind::Pcan { channel, options })
}

fn kvaser_of(rest: &str) -> Option<Kind> {
    let (channel, texts) = and_options(rest);
    let options = maker_options(texts)?;
    let which =
        if channel.is_empty() { kvaser::Which::Only } else { kvaser::Which::Number(channel.parse().ok()?) };
    Some(Kind::Kvaser { which, options })
}

fn elm327_of(family: Family, rest: &str) -> Option<Kind> {
    let (place, ids) = match rest.split_once('?') {
        Some((place, "ids=standard")) if family == Family::Elm => (place, Some(Ids::Standard)),
        Some((place, "ids=extended")) if family == Family::Elm => (place, Some(Ids::Extended)),
        Some(_) => return None,
        None => (rest, None),
    };
    let place = if let Some(host) = place.strip_prefix("tcp://") {
        ElmPlace::Tcp { host: with_port(host, elm327::PORT)? }
    } else {
        let (port, baud) = port_and_baud(place, family.default_baud())?;
        ElmPlace::Serial { port, baud }
    };
    Some(Kind::Elm327 { family, place, ids })
}

fn with_port(host: &str, port: u16) -> Option<String> {
    if host.is_empty() || host.contains(|letter: char| letter.is_whitespace() || "/?".contains(letter)) {
        return None;
    }
    // An IPv6 address has its colons in brackets.
    let after = host.rsplit_once(']').map_or(host, |(_, after)| after);
    Some(match after.rsplit_once(':') {
        Some((_, port)) => {
            port.parse::<u16>().ok()?;
            host.to_owned()
        }
        None => format!("{host}:{port}"),
    })
}

fn cannelloni_of(rest: &str) -> Option<Kind> {
    if let Some(host) = rest.strip_prefix("tcp://") {
        return Some(Kind::CannelloniTcp { host: with_port(host, cannelloni::PORT)? });
    }
    let rest = rest.strip_prefix("//")?;
    let (host, listen) = match rest.split_once("?listen=") {
        Some((host, listen)) => (host, Some(listen.parse().ok()?)),
        None => (rest, None),
    };
    let host = with_port(host, cannelloni::PORT)?;
    let port = host.rsplit_once(':')?.1.parse().ok()?;
    Some(Kind::Cannelloni { host, listen: listen.unwrap_or(port) })
}

/// Connects to an adapter. Nothing is sent to its bus, and nothing acknowledged, before a channel is opened.
pub fn open(place: &Place) -> Result<Link, OpenError> {
    let address = place.text.as_str();
    let driver: Box<dyn Driver> = match &place.kind {
        Kind::Slcan { port, baud } => Box::new(Slcan::open_port(port, *baud)?),
        Kind::CanalystIi { serial } => Box::new(CanalystIi::connect(serial, address)?),
        Kind::UsbCanA { port, baud, extended } => {
            Box::new(UsbCanA::over(Line::serial(port, *baud)?, *extended, address)?)
        }
        Kind::GvretSerial { port, baud, data_bitrate_bps } => {
            Box::new(Gvret::over(Line::serial(port, *baud)?, data_bitrate_bps.is_some(), address)?)
        }
        Kind::GvretTcp { host, data_bitrate_bps } => {
            Box::new(Gvret::over(Line::tcp(host)?, data_bitrate_bps.is_some(), address)?)
        }
        Kind::Elm327 { family, place, ids } => {
            let line = match place {
                ElmPlace::Serial { port, baud } => Line::serial(port, *baud)?,
                ElmPlace::Tcp { host } => Line::tcp(host)?,
            };
            Box::new(Elm327::over(line, *family, *ids, address)?)
        }
        Kind::Socketcan { interface } => socketcan(interface, address)?,
        Kind::GsUsb { serial, options } => Box::new(GsUsb::connect(serial, *options, address)?),
        Kind::Pcan { channel, options } => Box::new(Pcan::connect(*channel, options.clone(), address)?),
        Kind::Kvaser { which, options } => Box::new(Kvaser::connect(*which, options.clone(), address)?),
        Kind::Socketcand { host, interface } => Box::new(Socketcand::connect(host, interface, address)?),
        Kind::Cannelloni { host, listen } => Box::new(Cannelloni::connect(host, *listen, address)?),
        Kind::CannelloniTcp { host } => Box::new(CannelloniTcp::connect(host, address)?),
        Kind::Trace { path, format } => {
            let format = match format {
                TraceFormat::Candump => Format::Candump,
                TraceFormat::Pcapng => Format::Pcapng,
            };
            Box::new(TracePipe::open_path(path, format, address)?)
        }
    };
    engine::start(driver).map_err(|source| OpenError::Unreachable { address: address.to_owned(), source })
}

/// The CAN interfaces of this computer, by name; none but on Linux.
pub fn can_interfaces() -> Vec<String> {
    #[cfg(target_os = "linux")]
    return crate::socketcan::interfaces();
    #[cfg(not(target_os = "linux"))]
    Vec::new()
}

#[cfg(target_os = "linux")]
use crate::socketcan::{bitrate_of, data_bitrate_of};

#[cfg(target_os = "linux")]
fn socketcan(interface: &str, address: &str) -> Result<Box<dyn Driver>, OpenError> {
    Ok(Box::new(crate::socketcan::SocketCan::connect(interface, address)?))
}

#[cfg(not(target_os = "linux"))]
fn bitrate_of(_: &str) -> Option<u32> {
    None
}

#[cfg(not(target_os = "linux"))]
fn data_bitrate_of(_: &str) -> Option<u32> {
    None
}

#[cfg(not(target_os = "linux"))]
fn socketcan(_: &str, address: &str) -> Result<Box<dyn Driver>, OpenError> {
    let there = "only Linux has them".to_owned();
    Err(OpenError::NoInterface { address: address.to_owned(), there })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_round_trip_and_bad_ones_say_what_would_be_right() {
        for text in [
            "can0",
            "vcan3",
            "socketcan:can0",
            "socketcan:bus-a",
            "gs_usb",
            "gs_usb:",
            "gs_usb:003F0023",
            "gs_usb:?termination=on",
            "gs_usb:003F0023?data-bitrate=2M",
            "gs_usb:?termination=off&data-bitrate=5000000",
            "slcan:/dev/ttyACM0",
            "slcan:COM5@921600",
            "canalyst-ii:",
            "canalyst-ii:31F0000B1",
            "usb-can-a:/dev/ttyUSB0",
            "usb-can-a:COM4@115200?ids=extended",
            "usb-can-a:COM4?ids=standard",
            "gvret:/dev/ttyUSB0",
            "gvret:tcp://192.168.4.1",
            "gvret:tcp://[::1]:2300",
            "gvret:tcp://192.168.4.1?data-bitrate=2M",
            "gvret:/dev/ttyUSB0@921600?data-bitrate=5M",
            "pcan:",
            "pcan:PCAN_USBBUS1",
            "pcan:usbbus2?data-bitrate=2M",
            "kvaser:",
            "kvaser:1?library=/opt/lib/libcanlib.so",
            "elm327:/dev/rfcomm0",
            "elm327:COM4@115200?ids=extended",
            "elm327:tcp://192.168.0.10",
            "elm327:tcp://192.168.0.10:35000?ids=standard",
            "stn:/dev/ttyUSB0",
            "stn:tcp://car:23",
            "socketcand://pi/can0",
            "socketcand://pi:29000/vcan1",
            "cannelloni://pi:20001",
            "cannelloni://pi?listen=4",
            "cannelloni:tcp://pi",
            "cannelloni:tcp://[::1]:20001",
            "candump:-",
            "pcapng:/tmp/pipe",
        ] {
            assert!(Place::is_meant(text));
            assert_eq!(text.parse::<Place>().unwrap().to_string(), text);
        }
        for text in [
            "canal",
            "socketcan:",
            "socketcan:/dev/can0",
            "socketcan:a-name-that-is-too-long",
            "gs_usb:a b",
            "gs_usb:?termination=yes",
            "gs_usb:?data-bitrate=fast",
            "gs_usb:?data-bitrate=2M&",
            "slcan:",
            "slcan:@9600",
            "slcan:COM1@fast",
            "canalyst-ii:a b",
            "usb-can-a:",
            "usb-can-a:COM4?ids=both",
            "usb-can-a:?ids=extended",
            "gvret:",
            "gvret:tcp://",
            "gvret:tcp://a:b",
            "gvret:?data-bitrate=2M",
            "gvret:COM4?data-bitrate=fast",
            "gvret:COM4?fd=on",
            "pcan:USB1",
            "pcan:PCAN_USBBUS1?data-bitrate=fast",
            "kvaser:first",
            "kvaser:0?library=",
            "elm327:",
            "elm327:tcp://",
            "elm327:COM4?ids=all",
            "elm327:?ids=standard",
            "stn:COM4?ids=standard",
            "socketcand:pi/can0",
            "socketcand://pi",
            "socketcand://pi/can 0",
            "socketcand://pi/> < send",
            "cannelloni:pi",
            "cannelloni://pi?listen=x",
            "cannelloni:tcp://",
            "cannelloni:tcp://pi?listen=4",
            "candump:",
            "usb:1",
        ] {
            assert!(text.parse::<Place>().is_err(), "{text}");
        }
    }
}
