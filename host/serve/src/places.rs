//! Places at one listener. They are limited, so that strangers cannot take up the machine; and whoever comes gets one while somebody is there
//! who has not said what it wants, so that strangers who only connect keep nobody out.

use std::io::Write;
use std::net::{IpAddr, Ipv6Addr, Shutdown, SocketAddr, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// The limits of a listener.
pub struct Places {
    most: usize,
    /// For one address of another computer.
    most_from_one: usize,
    /// For all other computers together: those that are left are for programs of this one.
    most_from_others: usize,
    table: Mutex<Table>,
}

#[derive(Default)]
struct Table {
    next: u64,
    /// In the order in which they were taken.
    seats: Vec<Seat>,
}

struct Seat {
    number: u64,
    from: Origin,
    standing: Standing,
    /// Ends the connection.
    end: Box<dyn Fn() + Send>,
}

/// Where a peer comes from, as far as places go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Origin(Option<IpAddr>);

impl Origin {
    /// From this computer.
    pub const HERE: Self = Self(None);

    /// That of a connection.
    pub fn of(stream: &TcpStream, peer: SocketAddr) -> Self {
        let is_own = stream.local_addr().is_ok_and(|own| own.ip() == peer.ip());
        if is_own { Self::HERE } else { Self::at(peer.ip()) }
    }

    /// That of an address. Whoever has one of IPv6 has the 2^64 others of its network as well.
    pub fn at(ip: IpAddr) -> Self {
        Self(match ip.to_canonical() {
            ip if ip.is_loopback() => None,
            IpAddr::V6(ip) => Some(IpAddr::V6(Ipv6Addr::from_bits(ip.to_bits() & u128::MAX << 64))),
            IpAddr::V4(ip) => Some(IpAddr::V4(ip)),
        })
    }
}

/// Whether a seat counts against a limit.
type Counts<'a> = &'a dyn Fn(&Seat) -> bool;

/// What a peer has shown of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Standing {
    /// Nothing.
    Silent,
    /// Something, but not yet what is needed to be served.
    Speaking,
    /// It is being served.
    Served,
}

/// Nobody can be let go for a newcomer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoPlace {
    /// All are being served.
    #[error("there are {0} clients already")]
    Full(usize),
    /// All from this address are being served.
    #[error("there are {0} clients from this address already")]
    FromOne(usize),
    /// All for other computers are being served.
    #[error("there are {0} clients from other computers already")]
    FromOthers(usize),
}

/// A place; it becomes free when this is dropped.
pub struct Place {
    places: Arc<Places>,
    number: u64,
}

impl Places {
    /// So many, half of them for one address of another computer, and an eighth for this computer alone.
    pub fn new(most: usize) -> Arc<Self> {
        let most_from_others = most - most / 8;
        Arc::new(Self { most, most_from_one: most.div_ceil(2), most_from_others, table: Mutex::default() })
    }

    /// Takes a place. If there is none, the peer that has said least, and of those the one that has been there longest, is let go
    /// with its `end`; peers that are being served stay.
    pub fn enter(self: &Arc<Self>, from: Origin, end: impl Fn() + Send + 'static) -> Result<Place, NoPlace> {
        let mut table = self.lock();
        // Of the seats that count against each limit, one is free, or has to be freed.
        let of_one = |seat: &Seat| seat.from == from;
        let of_others = |seat: &Seat| seat.from != Origin::HERE;
        let of_all = |_: &Seat| true;
        let limits: [(usize, Counts<'_>, NoPlace); 3] = [
            (self.most_from_one, &of_one, NoPlace::FromOne(self.most_from_one)),
            (self.most_from_others, &of_others, NoPlace::FromOthers(self.most_from_others)),
            (self.most, &of_all, NoPlace::Full(self.most)),
        ];
        // On this computer, addresses say nothing.
        let limits = limits.iter().skip(if from == Origin::HERE { 2 } else { 0 });
        for (most, counts, full) in limits {
            if table.seats.iter().filter(|seat| counts(seat)).count() < *most {
                continue;
            }
            let may_go = |seat: &&Seat| seat.standing < Standing::Served && counts(seat);
            let least = table.seats.iter().filter(may_go).min_by_key(|seat| (seat.standing, seat.number));
            let Some(number) = least.map(|seat| seat.number) else { return Err(*full) };
            table.leave(number).into_iter().for_each(|seat| (seat.end)());
        }
        let number = table.next;
        table.next += 1;
        table.seats.push(Seat { number, from, standing: Standing::Silent, end: Box::new(end) });
        drop(table);
        Ok(Place { places: Arc::clone(self), number })
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        // Every holder leaves it consistent.
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Table {
    fn leave(&mut self, number: u64) -> Option<Seat> {
        let at = self.seats.iter().position(|seat| seat.number == number)?;
        Some(self.seats.remove(at))
    }
}

impl Place {
    /// It has said something.
    pub fn spoke(&self) {
        self.rise(Standing::Speaking);
    }

    /// It is being served, and keeps its place until it leaves.
    pub fn is_served(&self) {
        self.rise(Standing::Served);
    }

    fn rise(&self, to: Standing) {
        let mut table = self.places.lock();
        if let Some(seat) = table.seats.iter_mut().find(|seat| seat.number == self.number) {
            seat.standing = seat.standing.max(to);
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.places.lock().leave(self.number);
    }
}

/// What a refusal begins with, where a client expects our own protocol, in which nothing begins so.
pub const REFUSAL: &[u8] = b"cantap: ";

/// Tells a client of our own protocol why it is not served. It may already have gone, and is not waited for.
pub fn refuse(output: &mut (impl Write + ?Sized), reason: &str) {
    let text = format!("{}{reason}\n", String::from_utf8_lossy(REFUSAL));
    let _ = output.write(text.as_bytes()).and_then(|_| output.flush());
}

/// Ends a TCP connection from another thread.
pub fn ends(stream: &TcpStream) -> std::io::Result<impl Fn() + Send + 'static> {
    let stream = stream.try_clone()?;
    Ok(move || drop(stream.shutdown(Shutdown::Both)))
}

/// How long a peer may take for what is needed to be served.
pub const GREETING_TIMEOUT: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    fn address(last: u8) -> IpAddr {
        IpAddr::from([192, 0, 2, last])
    }

    #[test]
    fn the_most_silent_peer_goes_for_whoever_comes_and_those_served_stay() {
        let places = Places::new(3);
        let gone = Arc::new(Mutex::new(Vec::new()));
        let enter = |name: &'static str| {
            let gone = Arc::clone(&gone);
            places.enter(Origin::HERE, move || gone.lock().unwrap().push(name))
        };
        let [served, speaks, _silent] = ["served", "speaks", "silent"].map(|name| enter(name).unwrap());
        served.is_served();
        speaks.spoke();
        let second = enter("second").unwrap();
        assert_eq!(*gone.lock().unwrap(), ["silent"]);
        second.is_served();
        let third = enter("third").unwrap();
        assert_eq!(*gone.lock().unwrap(), ["silent", "speaks"]);
        third.is_served();
        assert_eq!(enter("fourth").err(), Some(NoPlace::Full(3)));
        // Whoever was let go takes nobody's place along when its thread ends.
        drop(speaks);
        assert_eq!(enter("fourth").err(), Some(NoPlace::Full(3)));
        drop(served);
        assert!(enter("fourth").is_ok());
    }

    /// A limit that is reached, with silent peers: how many of them had to go.
    fn crowd(places: &Arc<Places>, from: impl Fn(u16) -> IpAddr, count: u16) -> (Vec<Place>, usize) {
        let gone = Arc::new(AtomicUsize::new(0));
        let enter = |number| {
            let gone = Arc::clone(&gone);
            places.enter(Origin::at(from(number)), move || {
                gone.fetch_add(1, Ordering::Relaxed);
            })
        };
        let crowd = (0..count).map(|number| enter(number).unwrap()).collect();
        (crowd, gone.load(Ordering::Relaxed))
    }

    #[test]
    fn one_address_has_half_of_the_places_and_lets_go_of_its_own() {
        let places = Places::new(4);
        let (own, _) = crowd(&places, |_| address(1), 1);
        let (_crowd, gone) = crowd(&places, |_| address(2), 20);
        assert_eq!(gone, 18);
        own[0].is_served();
        let (last, _) = crowd(&places, |_| address(2), 2);
        last.iter().for_each(Place::is_served);
        let enter = |ip| places.enter(Origin::at(ip), || ());
        assert_eq!(enter(address(2)).err(), Some(NoPlace::FromOne(2)));
        assert!(enter(address(3)).is_ok());
        // On this computer, addresses say nothing.
        let local: Vec<_> = (0..9).map(|_| enter(IpAddr::from([127, 0, 0, 1]))).collect();
        assert!(local.iter().all(Result::is_ok));
    }

    #[test]
    fn a_network_of_ipv6_is_one_address_and_a_mapped_one_is_that_of_ipv4() {
        let in_network =
            |network: u16, host: u16| IpAddr::from([0x2001, 0xDB8, 0, network, host, 0, 0, host]);
        let places = Places::new(8);
        let (all, gone) = crowd(&places, |host| in_network(1, host), 100);
        assert_eq!(gone, 96);
        all.iter().for_each(Place::is_served);
        let enter = |ip| places.enter(Origin::at(ip), || ());
        assert_eq!(enter(in_network(1, 1000)).err(), Some(NoPlace::FromOne(4)));
        assert!(enter(in_network(2, 1)).is_ok());
        assert_eq!(Origin::at("::ffff:127.0.0.1".parse().unwrap()), Origin::HERE);
        assert_eq!(Origin::at("::ffff:192.0.2.1".parse().unwrap()), Origin::at(address(1)));
    }

    /// However many addresses strangers have, they take no place from programs of this computer.
    #[test]
    fn some_places_are_kept_for_this_computer() {
        let places = Places::new(32);
        let (strangers, _) = crowd(&places, |number| address(number as u8), 28);
        strangers.iter().for_each(Place::is_served);
        assert_eq!(places.enter(Origin::at(address(99)), || ()).err(), Some(NoPlace::FromOthers(28)));
        let local: Vec<_> = (0..4).map(|_| places.enter(Origin::HERE, || ()).unwrap()).collect();
        local.iter().for_each(Place::is_served);
        assert_eq!(places.enter(Origin::HERE, || ()).err(), Some(NoPlace::Full(32)));
    }
}
