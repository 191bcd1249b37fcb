//! Asks who is there. Each question has a number and a port of its own, and answers come to that port: whoever is not on the link, and has not
//! answers the question, would have to guess both.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

use cantap_trace::clean;

use super::link::{Link, Speaker};
use super::message::{MOST_BYTES, Message, Name, Question, Record, kind};
use super::{LOCAL, Network, kind_name, random};

/// Most servers that are listed: strangers may invent any number.
const MOST_FOUND: usize = 256;
/// Most names of servers that are kept.
const MOST_NAMED: usize = 2 * MOST_FOUND;
/// Most addresses of a host that are kept.
const MOST_ADDRESSES: usize = 8;
/// Most names whose owners are asked where they are, at a time: each question goes to everybody on the network.
const MOST_ASKED: usize = 32;
/// Most letters of a name that is shown.
const MOST_LETTERS: usize = 64;
/// How often it is asked: an answer may get lost.
const ASK_EVERY: Duration = Duration::from_secs(1);
/// How often to look for answers.
const LOOK_EVERY: Duration = Duration::from_millis(5);

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

pub(super) fn browse_on(network: Network, time: Duration) -> io::Result<Browsed> {
    let is_meant = |link: &Link| link.ip().is_loopback() == network.with_loopback;
    // An interface without multicast is one on which nobody is found.
    let speakers: Vec<Speaker> = Link::all()?
        .iter()
        .filter(|link| is_meant(link))
        .filter_map(|link| link.asking(network).ok())
        .collect();
    let deadline = Instant::now() + time;
    let mut answers = Answers::default();
    let mut ask_at = Instant::now();
    let id = random(1..1 << 16) as u16;
    let mut bytes = vec![0; MOST_BYTES + 1];
    while Instant::now() < deadline && !answers.is_cut {
        if Instant::now() >= ask_at {
            ask_at += ASK_EVERY;
            let question = Message { id, ..answers.question() };
            for speaker in &speakers {
                speaker.tell_all(&question);
            }
        }
        let mut is_quiet = true;
        for speaker in &speakers {
            // One that does not work any more is one on which nobody answers.
            let Ok(Some((len, from))) = speaker.hear(&mut bytes) else { continue };
            is_quiet = false;
            if let Some(message) = Message::read(&bytes[..len]).filter(|_| from.port() == network.port)
                && message.is_answer
                && message.id == id
            {
                answers.take(message);
            }
        }
        if is_quiet {
            std::thread::sleep(LOOK_EVERY);
        }
    }
    Ok(answers.browsed(network.with_loopback))
}

/// What came back.
#[derive(Default)]
struct Answers {
    /// Servers, and where they are: a port of a host.
    servers: BTreeMap<Name, Option<(u16, Name)>>,
    hosts: BTreeMap<Name, BTreeSet<IpAddr>>,
    is_cut: bool,
}

impl Answers {
    /// Asks for servers, and for what is not known yet of those that there are.
    fn question(&self) -> Message {
        let mut message = Message::question(kind_name(), kind::PTR);
        let nowhere = self.servers.iter().filter(|(_, place)| place.is_none());
        message
            .questions
            .extend(nowhere.take(MOST_ASKED).map(|(name, _)| Question::new(name.clone(), kind::SRV)));
        let hosts = self.servers.values().flatten().map(|(_, host)| host);
        let without: BTreeSet<&Name> = hosts.filter(|host| !self.hosts.contains_key(*host)).collect();
        message.questions.extend(
            without
                .into_iter()
                .take(MOST_ASKED)
                .flat_map(|host| [kind::A, kind::AAAA].map(|kind| Question::new(host.clone(), kind))),
        );
        message
    }

    fn take(&mut self, message: Message) {
        let records: Vec<_> = message.answers.into_iter().chain(message.additional).collect();
        let kind = kind_name();
        for name in records.iter().filter(|record| record.name == kind).filter_map(Record::target) {
            // It may be of another kind: whoever answers says so.
            if name.first_before(&kind).is_none() {
                continue;
            }
            if self.servers.len() >= MOST_NAMED && !self.servers.contains_key(&name) {
                self.is_cut = true;
                return;
            }
            self.servers.entry(name).or_default();
        }
        for record in &records {
            if let Some(place) = self.servers.get_mut(&record.name)
                && let Some(at) = record.port_and_host()
            {
                *place = Some(at);
            }
        }
        // Of hosts on which there is a server, and no others: their number is limited as well.
        let wanted: BTreeSet<&Name> = self.servers.values().flatten().map(|(_, host)| host).collect();
        for record in records.iter().filter(|record| wanted.contains(&record.name)) {
            let of_host = self.hosts.entry(record.name.clone()).or_default();
            of_host.extend(record.ip().filter(|_| of_host.len() < MOST_ADDRESSES));
        }
    }

    fn browsed(self, with_loopback: bool) -> Browsed {
        let mut browsed = Browsed { is_cut: self.is_cut, ..Browsed::default() };
        for (name, place) in &self.servers {
            let found = place.as_ref().and_then(|(port, host)| Some((*port, self.hosts.get(host)?)));
            match found {
                Some(_) if browsed.servers.len() >= MOST_FOUND => browsed.left_out += 1,
                None => browsed.left_out += 1,
                Some((port, ips)) => match usable(port, ips, with_loopback) {
                    Some(place) => browsed.servers.push(AnnouncedServer { place, name: shown(name) }),
                    None => browsed.unusable += 1,
                },
            }
        }
        browsed.servers.sort_by(|one, other| one.name.cmp(&other.name));
        browsed
    }
}

/// Where a server is, if one can be there.
pub(super) fn usable(port: u16, ips: &BTreeSet<IpAddr>, with_loopback: bool) -> Option<SocketAddr> {
    let is_possible = |ip: &&IpAddr| match ip {
        IpAddr::V4(ip) => !(ip.is_unspecified() || ip.is_multicast() || ip.is_broadcast()),
        // An address of the link alone is none without the interface.
        IpAddr::V6(ip) => !(ip.is_unspecified() || ip.is_multicast() || ip.is_unicast_link_local()),
    };
    let leads_back = |ip: &IpAddr| ip.to_canonical().is_loopback();
    let possible = ips.iter().filter(is_possible).filter(|ip| with_loopback || !leads_back(ip));
    // IPv4 first, as it is easier to type.
    let ip = possible.min_by_key(|ip| (ip.is_ipv6(), **ip)).filter(|_| port != 0)?;
    Some(SocketAddr::new(*ip, port))
}

/// A server's name for a terminal.
fn shown(name: &Name) -> String {
    let label = name.first_before(&kind_name()).unwrap_or_default();
    clean::line(&String::from_utf8_lossy(label)).chars().take(MOST_LETTERS).collect()
}
