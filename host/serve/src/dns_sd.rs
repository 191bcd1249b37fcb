//! Servers on the local network: announced and found by DNS-SD over multicast DNS (RFC 6763, RFC 6762), which mdns-sd speaks. Anybody on the network
//! can announce anything, so nothing that is found is more than a hint, and its texts are cleaned.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cantap_trace::clean;
use mdns_sd::{IfKind, ResolvedService, ServiceDaemon, ServiceEvent, ServiceInfo};

use crate::beacon::host_name;

/// What is announced: this project's own protocol, over TCP.
pub const SERVICE: &str = "_cantap._tcp.local.";
/// Most servers that are listed: strangers may invent any number.
const MOST_FOUND: usize = 256;
/// Most names whose owners are asked where they are. Each question goes to everybody on the network.
const MOST_ASKED: usize = 2 * MOST_FOUND;
/// Most letters of a name that is shown.
const MOST_LETTERS: usize = 64;
/// Most bytes of a part of a name (RFC 1035 §2.3.4).
const MOST_LABEL: usize = 63;
/// Records of others that mdns-sd may keep beside our own: whoever floods the network must not fill this computer's memory.
const MOST_RECORDS: i64 = 4096;
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// How long others are told that a server has gone.
const GOODBYE: Duration = Duration::from_millis(500);

/// Where multicast DNS is spoken.
#[derive(Clone, Copy)]
struct Network {
    port: u16,
    /// Whether addresses of this computer alone are believed, as in tests.
    with_loopback: bool,
}

const LOCAL: Network = Network { port: mdns_sd::MDNS_PORT, with_loopback: false };

fn failed(error: &mdns_sd::Error) -> io::Error {
    io::Error::other(error.to_string())
}

/// A listener that is announced.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listener {
    /// The serial number of its board, if that is there.
    pub serial: Option<String>,
    /// Where it listens: an address of this computer.
    pub address: SocketAddr,
}

/// Listeners are announced until this is dropped; then others are told that they have gone.
pub struct Announcing {
    is_over: Arc<AtomicBool>,
    /// How often it was begun anew, because others had said too much: for tests.
    #[cfg_attr(not(test), expect(dead_code))]
    begun_anew: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

/// Announces listeners on the network of each one's address, and nowhere else.
pub fn announce(listeners: &[Listener]) -> io::Result<Announcing> {
    announce_on(LOCAL, listeners)
}

fn announce_on(network: Network, listeners: &[Listener]) -> io::Result<Announcing> {
    let services =
        listeners.iter().map(service).collect::<Result<Vec<_>, _>>().map_err(|error| failed(&error))?;
    let mut daemon = Some(begin(network, &services)?);
    let is_over = Arc::new(AtomicBool::new(false));
    let ends = Arc::clone(&is_over);
    let begun_anew = Arc::new(AtomicU64::new(0));
    let begins = Arc::clone(&begun_anew);
    let thread = std::thread::Builder::new().name("cantap-dns-sd".to_owned()).spawn(move || {
        while !ends.load(Ordering::Relaxed) {
            std::thread::sleep(LOOK_EVERY);
            // It keeps what others say, and may have ended.
            if daemon.as_ref().is_none_or(|daemon| records(daemon).is_none_or(|count| count > MOST_RECORDS)) {
                if let Some(daemon) = daemon.take() {
                    let _ = daemon.shutdown();
                }
                daemon = begin(network, &services).ok();
                begins.fetch_add(1, Ordering::Relaxed);
            }
        }
        if let Some(daemon) = daemon {
            end(&daemon, &services);
        }
    })?;
    Ok(Announcing { is_over, begun_anew, thread: Some(thread) })
}

/// What others are told of a listener.
fn service(listener: &Listener) -> mdns_sd::Result<ServiceInfo> {
    let host = host_name();
    let place = host.as_ref().map_or_else(String::new, |host| format!(" at {host}"));
    let serial = listener.serial.as_ref().map_or_else(String::new, |serial| format!(" {serial}"));
    let name = format!("cantap{serial}{place}");
    let name = up_to_bytes(&name, MOST_LABEL);
    // A name of its own: the computer's may be announced by the system, with other addresses.
    let is_plain = |letter: &char| letter.is_ascii_alphanumeric() || *letter == '-';
    let plain: String = host.unwrap_or_default().chars().filter(is_plain).take(40).collect();
    let host = format!("cantap-{plain}.local.");
    let protocol = cantap_wire::PROTOCOL_VERSION.to_string();
    let texts = [("protocol", protocol.as_str()), ("tls", "1")];
    let address = listener.address;
    let mut service = ServiceInfo::new(SERVICE, name, &host, address.ip(), address.port(), &texts[..])?;
    service.set_interfaces(vec![IfKind::Addr(address.ip())]);
    Ok(service)
}

fn up_to_bytes(text: &str, most: usize) -> &str {
    &text[..text.floor_char_boundary(most)]
}

/// Announces services on their own networks alone.
fn begin(network: Network, services: &[ServiceInfo]) -> io::Result<ServiceDaemon> {
    let begin = || {
        let daemon = ServiceDaemon::new_with_port(network.port)?;
        daemon.disable_interface(IfKind::All)?;
        for service in services {
            let own = service.get_addresses().iter().map(|address| IfKind::Addr(*address));
            daemon.enable_interface(own.collect::<Vec<_>>())?;
            daemon.register(service.clone())?;
        }
        Ok(daemon)
    };
    begin().map_err(|error| failed(&error))
}

/// How many records of others it keeps; `None` if it does not answer any more.
fn records(daemon: &ServiceDaemon) -> Option<i64> {
    let metrics = daemon.get_metrics().ok()?.recv_timeout(Duration::from_secs(5)).ok()?;
    Some(metrics.iter().filter(|(name, _)| name.starts_with("cached-")).map(|(_, count)| *count).sum())
}

fn end(daemon: &ServiceDaemon, services: &[ServiceInfo]) {
    let deadline = Instant::now() + GOODBYE;
    let told: Vec<_> =
        services.iter().filter_map(|service| daemon.unregister(service.get_fullname()).ok()).collect();
    for told in told {
        let _ = told.recv_timeout(deadline.saturating_duration_since(Instant::now()));
    }
    if let Ok(ended) = daemon.shutdown() {
        let _ = ended.recv_timeout(GOODBYE);
    }
}

impl Drop for Announcing {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A server that announced itself. Texts are cleaned for a terminal, and of limited length.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AnnouncedServer {
    /// Where it says that it is: an address and a port.
    pub place: SocketAddr,
    /// What it calls itself.
    pub name: String,
}

/// What was found on the network.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Browsed {
    /// Each server once, by its name; at most 256.
    pub servers: Vec<AnnouncedServer>,
    /// Further servers, or those that did not say where they are.
    pub left_out: u64,
    /// Servers at places where none can be: at no port, or at addresses that lead back to whoever tries them.
    pub unusable: u64,
    /// More was announced than anybody has: the rest was not waited for.
    pub is_cut: bool,
}

/// Asks for servers, and waits for answers for this long.
pub fn browse_for(time: Duration) -> io::Result<Browsed> {
    browse_on(LOCAL, time)
}

fn browse_on(network: Network, time: Duration) -> io::Result<Browsed> {
    let daemon = ServiceDaemon::new_with_port(network.port).map_err(|error| failed(&error))?;
    if !network.with_loopback {
        let both = vec![IfKind::LoopbackV4, IfKind::LoopbackV6];
        daemon.disable_interface(both).map_err(|error| failed(&error))?;
    }
    let events = daemon.browse(SERVICE).map_err(|error| failed(&error))?;
    let deadline = Instant::now() + time;
    let mut browsed = Browsed::default();
    let (mut named, mut found) = (BTreeSet::new(), BTreeMap::new());
    let mut others = BTreeSet::new();
    while let Some(left) = deadline.checked_duration_since(Instant::now()) {
        match events.recv_timeout(left) {
            Ok(ServiceEvent::ServiceFound(_, name)) => {
                named.insert(name);
                if named.len() > MOST_ASKED {
                    browsed.is_cut = true;
                    break;
                }
            }
            Ok(ServiceEvent::ServiceResolved(service)) => {
                let server = read(&service, network.with_loopback);
                // It may say more of itself later, such as another address.
                if let Some(known) = found.get_mut(&service.fullname) {
                    if server.is_some() {
                        *known = server;
                    }
                } else if found.len() < MOST_FOUND {
                    found.insert(service.fullname.clone(), server);
                } else {
                    others.insert(service.fullname.clone());
                    browsed.is_cut = others.len() > MOST_ASKED;
                }
                if browsed.is_cut {
                    break;
                }
            }
            // One that leaves while it is listed may come back.
            Ok(_) => {}
            Err(error) => {
                // The deadline, or the end of what was listened to.
                browsed.is_cut = matches!(error, mdns_sd::RecvTimeoutError::Disconnected);
                break;
            }
        }
    }
    let _ = daemon.shutdown();
    let silent = named.iter().filter(|name| !found.contains_key(*name)).count();
    browsed.left_out = silent.max(others.len()) as u64;
    browsed.unusable = found.values().filter(|server| server.is_none()).count() as u64;
    browsed.servers = found.into_values().flatten().collect();
    Ok(browsed)
}

/// A server, if it can be where it says that it is.
fn read(service: &ResolvedService, with_loopback: bool) -> Option<AnnouncedServer> {
    let is_possible = |ip: &IpAddr| match ip {
        IpAddr::V4(ip) => !(ip.is_unspecified() || ip.is_multicast() || ip.is_broadcast()),
        // An address of the link alone is none without the interface.
        IpAddr::V6(ip) => !(ip.is_unspecified() || ip.is_multicast() || ip.is_unicast_link_local()),
    };
    let addresses = service.addresses.iter().map(mdns_sd::ScopedIp::to_ip_addr);
    let addresses =
        addresses.filter(|ip| is_possible(ip) && (with_loopback || !ip.to_canonical().is_loopback()));
    // IPv4 first, as it is easier to type.
    let ip = addresses.min_by_key(|ip| (ip.is_ipv6(), *ip)).filter(|_| service.port != 0)?;
    let name = service.fullname.strip_suffix(SERVICE).unwrap_or(&service.fullname);
    let name = name.strip_suffix('.').unwrap_or(name);
    let name = clean::line(name).chars().take(MOST_LETTERS).collect();
    Some(AnnouncedServer { place: SocketAddr::new(ip, service.port), name })
}

#[cfg(test)]
mod tests;
