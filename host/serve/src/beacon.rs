//! The beacons of socketcand's protocol: UDP datagrams that say where a server is and which buses it has. Anybody on the network can send one, so
//! nothing in a beacon is more than a hint, and its texts are cleaned.

use std::collections::BTreeMap;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::Arc;
use std::time::{Duration, Instant};

use cantap::device::is_idle;
use cantap_trace::clean;

use crate::Board;
use crate::connect::SOCKET_TIMEOUT;

/// The port for beacons.
pub const PORT: u16 = 42_000;
/// The page requires one at least every three seconds.
pub const EVERY: Duration = Duration::from_secs(2);
/// Longest beacon that is read.
const MOST_BYTES: usize = 2048;
/// Most servers that are listed: strangers may invent any number.
const MOST_FOUND: usize = 256;
/// Most letters of a name.
const MOST_LETTERS: usize = 64;
/// Most buses of a server that are listed.
const MOST_BUSES: usize = 32;

/// Announces a server.
pub(crate) struct Beacon {
    socket: UdpSocket,
    to: SocketAddr,
    address: SocketAddr,
    boards: Vec<Arc<Board>>,
    buses: String,
}

impl Beacon {
    /// A beacon for a server at an address: on this computer only, if that is a loopback address.
    pub fn new(address: SocketAddr, boards: &[Arc<Board>], buses: &[&str]) -> io::Result<Self> {
        let is_local = address.ip().is_loopback();
        let (from, to) = if is_local {
            (Ipv4Addr::LOCALHOST, Ipv4Addr::LOCALHOST)
        } else {
            (Ipv4Addr::UNSPECIFIED, Ipv4Addr::BROADCAST)
        };
        let socket = UdpSocket::bind((from, 0))?;
        socket.set_broadcast(!is_local)?;
        let buses: Vec<String> =
            buses.iter().map(|bus| format!("<Bus name=\"{}\"/>", escaped(bus))).collect();
        let buses = buses.concat();
        Ok(Self { socket, to: (to, PORT).into(), address, boards: boards.to_vec(), buses })
    }

    pub fn send(&self) {
        // Nobody may be listening.
        let _ = self.socket.send_to(self.text().as_bytes(), self.to);
    }

    /// What is sent. The name has the serial numbers of the boards that are there, and the computer's name.
    fn text(&self) -> String {
        let serials: Vec<String> =
            self.boards.iter().filter_map(|board| Some(board.hello()?.serial.as_str().to_owned())).collect();
        let boards = if serials.is_empty() { String::new() } else { format!(" {}", serials.join("+")) };
        let host = host_name().map_or_else(String::new, |host| format!(" at {host}"));
        let name = format!("cantap{boards}{host}");
        let name: String = name.chars().take(MOST_LETTERS).collect();
        format!(
            "<CANBeacon name=\"{}\" type=\"adapter\" description=\"cantap CAN analyser\"><URL>can://{}</URL>{}</CANBeacon>",
            escaped(&name),
            self.address,
            self.buses
        )
    }
}

/// This computer's name, if the system tells it.
pub(crate) fn host_name() -> Option<String> {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname")
        .or_else(|_| std::env::var("COMPUTERNAME"))
        .or_else(|_| std::env::var("HOSTNAME"));
    let name = clean::line(name.ok()?.trim()).into_owned();
    (!name.is_empty()).then_some(name)
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn unescaped(text: &str) -> String {
    text.replace("&lt;", "<")
        .replace("&gt;", ">")
        .replace("&quot;", "\"")
        .replace("&apos;", "'")
        .replace("&amp;", "&")
}

/// A server that announced itself. Texts are cleaned for a terminal, and of limited length.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found {
    /// Where it says that it is: `HOST:PORT`.
    pub place: String,
    /// Where the beacon came from, as far as that can be known.
    pub from: IpAddr,
    /// What it calls itself.
    pub name: String,
    /// Its buses; at most 32.
    pub buses: Vec<String>,
    /// How many more buses it says that it has.
    pub more_buses: usize,
}

/// What was heard on the network.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Announced {
    /// Each server once, by its place; at most 256.
    pub servers: Vec<Found>,
    /// Beacons of further servers. How many servers these are is not known: each sends one every few seconds.
    pub beacons_left_out: u64,
    /// Datagrams that are no beacon.
    pub unreadable: u64,
}

/// Listens for beacons for this long.
pub fn listen_for(time: Duration) -> io::Result<Announced> {
    gather(&socket()?, time)
}

fn gather(socket: &UdpSocket, time: Duration) -> io::Result<Announced> {
    socket.set_read_timeout(Some(SOCKET_TIMEOUT))?;
    let mut announced = Announced::default();
    let mut found = BTreeMap::new();
    let deadline = Instant::now() + time;
    let mut bytes = vec![0; MOST_BYTES + 1];
    while Instant::now() < deadline {
        match socket.recv_from(&mut bytes) {
            Ok((len, from)) => {
                // A longer one is cut, and counts as unreadable.
                let Some(server) = read(&bytes[..len], from.ip()).filter(|_| len <= MOST_BYTES) else {
                    announced.unreadable += 1;
                    continue;
                };
                let key = (server.place.clone(), server.from);
                if found.len() < MOST_FOUND {
                    // The first one stays, so that nobody takes its place.
                    found.entry(key).or_insert(server);
                } else if !found.contains_key(&key) {
                    announced.beacons_left_out += 1;
                }
            }
            Err(error) if is_idle(&error) => {}
            Err(error) => return Err(error),
        }
    }
    announced.servers = found.into_values().collect();
    Ok(announced)
}

/// The port is shared with other programs that listen for beacons.
#[cfg(unix)]
fn socket() -> io::Result<UdpSocket> {
    use nix::sys::socket::{
        AddressFamily, SockFlag, SockType, SockaddrIn, bind, setsockopt, socket, sockopt,
    };
    use std::os::fd::AsRawFd;
    let socket = socket(AddressFamily::Inet, SockType::Datagram, SockFlag::empty(), None)?;
    setsockopt(&socket, sockopt::ReuseAddr, &true)?;
    bind(socket.as_raw_fd(), &SockaddrIn::new(0, 0, 0, 0, PORT))?;
    Ok(socket.into())
}

#[cfg(not(unix))]
fn socket() -> io::Result<UdpSocket> {
    UdpSocket::bind((Ipv4Addr::UNSPECIFIED, PORT))
}

/// Reads a beacon: the few parts of it that are needed, wherever they stand.
fn read(bytes: &[u8], from: IpAddr) -> Option<Found> {
    let text = std::str::from_utf8(bytes).ok()?;
    let beacon = text.split_once("<CANBeacon")?.1;
    let short = |text: &str| -> String { clean::line(&unescaped(text)).chars().take(MOST_LETTERS).collect() };
    let url = beacon.split_once("<URL>")?.1.split_once("</URL>")?.0;
    let place = url.trim().strip_prefix("can://")?;
    let is_place = !place.is_empty()
        && place.len() <= 256
        && place.bytes().all(|byte| byte.is_ascii_alphanumeric() || b".-_:[]%".contains(&byte));
    let mut buses = beacon.split("<Bus").skip(1).filter_map(|bus| attribute(bus, "name"));
    is_place.then(|| Found {
        place: place.to_owned(),
        from,
        name: short(attribute(beacon, "name").unwrap_or_default()),
        buses: buses.by_ref().take(MOST_BUSES).map(short).collect(),
        more_buses: buses.count(),
    })
}

/// The value of an attribute in the tag in which the text begins.
fn attribute<'a>(text: &'a str, name: &str) -> Option<&'a str> {
    let tag = text.split_once('>').map_or(text, |(tag, _)| tag);
    let value = tag.split_once(&format!(" {name}="))?.1;
    let quote = value.chars().next().filter(|quote| matches!(quote, '"' | '\''))?;
    value[1..].split_once(quote).map(|(value, _)| value)
}

#[cfg(test)]
mod tests {
    use super::*;

    const FROM: IpAddr = IpAddr::V4(Ipv4Addr::new(192, 0, 2, 7));

    #[test]
    fn a_beacon_of_the_protocol_s_page_is_read() {
        let text = "<CANBeacon name=\"HeartOfGold\" type=\"SocketCAN\" description=\"A human readable description\">\n    \
                    <URL>can://127.0.0.1:29536</URL>\n    <Bus name=\"vcan0\"/>\n    <Bus name=\"vcan1\"/>\n</CANBeacon>";
        let found = read(text.as_bytes(), FROM).unwrap();
        assert_eq!((found.place.as_str(), found.name.as_str()), ("127.0.0.1:29536", "HeartOfGold"));
        assert_eq!(found.buses, ["vcan0", "vcan1"]);
    }

    #[test]
    fn what_a_stranger_writes_harms_no_terminal_and_no_list() {
        let with = |name: &str, url: &str| {
            format!(
                "<CANBeacon name=\"{name}\" type='x'><URL>{url}</URL><Bus name=\"\u{1b}]0;x\u{7}\"/></CANBeacon>"
            )
        };
        let found = read(with("\u{1b}[2Jx&lt;\u{202e}", "can://h:1").as_bytes(), FROM).unwrap();
        assert_eq!(
            (found.name.as_str(), found.buses[0].as_str()),
            ("\u{FFFD}[2Jx<\u{FFFD}", "\u{FFFD}]0;x\u{FFFD}")
        );
        let long = read(with(&"x".repeat(1000), "can://h:1").as_bytes(), FROM).unwrap();
        assert_eq!(long.name.len(), MOST_LETTERS);
        for url in
            ["can://", "http://h", "can://-o ProxyCommand=x", "can://h;rm", "can://\u{1b}[2J", "can://a/b"]
        {
            assert_eq!(read(with("x", url).as_bytes(), FROM), None, "{url}");
        }
        let many = format!("<CANBeacon><URL>can://h</URL>{}", "<Bus name='a'/>".repeat(100));
        let found = read(many.as_bytes(), FROM).unwrap();
        assert_eq!((found.buses.len(), found.more_buses), (MOST_BUSES, 100 - MOST_BUSES));
        for text in ["", "<CANBeacon", "<CANBeacon name=", "<CANBeacon name=\"", "<URL>can://h</URL>"] {
            assert_eq!(read(text.as_bytes(), FROM), None, "{text}");
        }
    }

    proptest::proptest! {
        #[test]
        fn any_text_is_a_beacon_or_none(text in "(<CANBeacon| name=|\"|'|<URL>|can://|</URL>|<Bus|>|é|.){0,20}") {
            let _ = read(text.as_bytes(), FROM);
        }
    }

    #[test]
    fn each_server_is_listed_once_and_no_more_than_there_is_room_for() {
        let here = UdpSocket::bind("127.0.0.1:0").unwrap();
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        let say = |text: String| {
            sender.send_to(text.as_bytes(), here.local_addr().unwrap()).unwrap();
        };
        for number in [1, 2, 1] {
            say(format!("<CANBeacon name=\"{number}\"><URL>can://h:{number}</URL></CANBeacon>"));
        }
        say("<CANBeacon name=\"liar\"><URL>can://h:1</URL></CANBeacon>".to_owned());
        let found = gather(&here, Duration::from_millis(200)).unwrap();
        let names: Vec<&str> = found.servers.iter().map(|server| server.name.as_str()).collect();
        assert_eq!(
            (names.as_slice(), found.beacons_left_out, found.unreadable),
            (["1", "2"].as_slice(), 0, 0)
        );
    }

    /// Whoever invents servers by the hundred must not keep the true ones out without a trace.
    #[test]
    fn what_there_is_no_room_for_is_counted() {
        let here = UdpSocket::bind("127.0.0.1:0").unwrap();
        let address = here.local_addr().unwrap();
        let flood = std::thread::spawn(move || {
            let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
            let say = |text: String| {
                sender.send_to(text.as_bytes(), address).unwrap();
                // The system keeps only so many that are not read yet.
                std::thread::sleep(Duration::from_micros(500));
            };
            let beacon = |name: &str, port| {
                format!("<CANBeacon name=\"{name}\"><URL>can://h:{port}</URL></CANBeacon>")
            };
            (0..MOST_FOUND).for_each(|number| say(beacon("liar", number)));
            say(beacon("true", 29_536));
            // One that is listed says so again.
            say(beacon("liar", 0));
            say("<CANBeacon".to_owned());
            say(format!("{}{}", beacon("long", 1), " ".repeat(MOST_BYTES)));
        });
        let found = gather(&here, Duration::from_secs(3)).unwrap();
        flood.join().unwrap();
        assert_eq!((found.servers.len(), found.beacons_left_out, found.unreadable), (MOST_FOUND, 1, 2));
    }
}
