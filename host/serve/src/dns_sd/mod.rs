//! Servers on the local network: announced and found by DNS-SD over multicast DNS (RFC 6763, RFC 6762). Anybody on the network can announce
//! anything, so nothing that is found is more than a hint, and its texts are cleaned. What comes from other networks is neither answered nor
//! believed.

mod announcing;
mod browse;
mod link;
mod message;
mod responder;

use std::hash::{BuildHasher, RandomState};
use std::net::SocketAddr;
use std::ops::Range;

use message::Name;

pub use announcing::{Announcing, announce};
pub use browse::{AnnouncedServer, Browsed, browse_for};

/// What is announced: this project's own protocol, over TCP.
pub const SERVICE: &str = "_cantap._tcp.local.";
/// The port of multicast DNS.
const PORT: u16 = 5353;

/// Where multicast DNS is spoken.
#[derive(Clone, Copy)]
struct Network {
    port: u16,
    /// Whether addresses of this computer alone are believed, as in tests.
    with_loopback: bool,
}

const LOCAL: Network = Network { port: PORT, with_loopback: false };

/// A listener that is announced.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listener {
    /// The serial number of its board, if that is there.
    pub serial: Option<String>,
    /// Where it listens: an address of this computer.
    pub address: SocketAddr,
}

/// [`SERVICE`] as it is on the wire.
fn kind_name() -> Name {
    Name::of(&SERVICE.trim_end_matches('.').split('.').collect::<Vec<_>>())
}

/// What is said of each server beside its place (RFC 6763 §6).
fn text() -> Vec<u8> {
    let protocol = format!("protocol={}", cantap_wire::PROTOCOL_VERSION);
    ["txtvers=1", &protocol, "tls=1"]
        .iter()
        .flat_map(|text| [&[text.len() as u8], text.as_bytes()].concat())
        .collect()
}

/// A number that nobody else knows.
fn random(range: Range<u64>) -> u64 {
    // The hasher's keys are the system's random numbers.
    let number = RandomState::new().hash_one(0);
    range.start + number % (range.end - range.start)
}

#[cfg(test)]
mod tests;
