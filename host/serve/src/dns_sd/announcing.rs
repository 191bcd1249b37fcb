//! Announces listeners, and answers for them, until they are no longer there.

use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::link::{Link, Speaker};
use super::message::{MOST_BYTES, Message};
use super::responder::{Responder, Service};
use super::{LOCAL, Listener, Network, kind_name, text};
use crate::beacon::host_name;

/// How often to check whether it is over.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// How often to check whether the address is still where it was: cables are pulled, and networks left.
const CHECK_EVERY: Duration = Duration::from_secs(5);

/// Listeners are announced until this is dropped; then others are told that they have gone.
pub struct Announcing {
    is_over: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

/// Announces listeners on the network of each one's address, and nowhere else.
pub fn announce(listeners: &[Listener]) -> io::Result<Announcing> {
    announce_on(LOCAL, listeners)
}

pub(super) fn announce_on(network: Network, listeners: &[Listener]) -> io::Result<Announcing> {
    let mut announcing = Announcing { is_over: Arc::default(), threads: Vec::new() };
    // Those at one address share its host's name.
    let place = |listener: &Listener| SocketAddr::new(listener.address.ip(), 0);
    let mut places: Vec<SocketAddr> = listeners.iter().map(place).collect();
    places.sort_unstable();
    places.dedup();
    for at in places {
        let services: Vec<Service> =
            listeners.iter().filter(|listener| place(listener) == at).map(service).collect();
        // The zone of an IPv6 address is in the listener's.
        let address = listeners.iter().find(|listener| place(listener) == at).map_or(at, |one| one.address);
        let speaker = Link::of(address)?.listening(network)?;
        let host = host_label(at.ip());
        let responder = Responder::new(kind_name(), at.ip(), &host, &services, text(), Instant::now());
        let is_over = Arc::clone(&announcing.is_over);
        let thread = std::thread::Builder::new().name("cantap-dns-sd".to_owned());
        let body = move || run(network, address, speaker, responder, &is_over);
        announcing.threads.push(thread.spawn(body)?);
    }
    Ok(announcing)
}

/// What others are told of a listener.
pub(super) fn service(listener: &Listener) -> Service {
    let place = host_name().map_or_else(String::new, |host| format!(" at {host}"));
    let serial = listener.serial.as_ref().map_or_else(String::new, |serial| format!(" {serial}"));
    Service { label: format!("cantap{serial}{place}"), port: listener.address.port() }
}

/// A host's name of its own: the computer's may be announced by the system, with other addresses. A listener has one address, so that the other
/// kind has another name.
pub(super) fn host_label(ip: IpAddr) -> String {
    let is_plain = |letter: &char| letter.is_ascii_alphanumeric() || *letter == '-';
    let plain: String = host_name().unwrap_or_default().chars().filter(is_plain).take(40).collect();
    format!("cantap{}-{plain}", if ip.is_ipv6() { "6" } else { "" })
}

fn run(
    network: Network,
    address: SocketAddr,
    speaker: Speaker,
    mut responder: Responder,
    is_over: &AtomicBool,
) {
    let mut speaker = Some(speaker);
    let mut checked_at = Instant::now();
    let mut bytes = vec![0; MOST_BYTES + 1];
    while !is_over.load(Ordering::Relaxed) {
        if checked_at.elapsed() >= CHECK_EVERY {
            checked_at = Instant::now();
            let link = Link::of(address).ok();
            if speaker.as_ref().map(|speaker| &speaker.link) != link.as_ref() {
                speaker = link.and_then(|link| link.listening(network).ok());
                // Others may have taken the names meanwhile.
                responder.begin_anew(Instant::now());
            }
        }
        let Some(there) = &speaker else {
            std::thread::sleep(LOOK_EVERY);
            continue;
        };
        responder.go_on(Instant::now()).iter().for_each(|message| there.tell_all(message));
        let due = responder.due().map_or(LOOK_EVERY, |due| due.saturating_duration_since(Instant::now()));
        match there.hear_within(&mut bytes, due.min(LOOK_EVERY)) {
            Ok(Some((len, from))) => {
                let Some(message) = Message::read(&bytes[..len]) else { continue };
                let asks_once = from.port() != network.port;
                // Whoever answers does so from the port of multicast DNS (RFC 6762 §6).
                if message.is_answer && asks_once {
                    continue;
                }
                let answers = responder.take(&message, asks_once, Instant::now());
                for answer in &answers {
                    there.tell(from, answer);
                }
            }
            Ok(None) => {}
            // Windows says so of somebody who was answered and has gone.
            Err(error) if error.kind() == io::ErrorKind::ConnectionReset => {}
            // The network may come back.
            Err(_) => speaker = None,
        }
    }
    if let Some(speaker) = speaker {
        responder.goodbye().iter().for_each(|message| speaker.tell_all(message));
    }
}

impl Drop for Announcing {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}
