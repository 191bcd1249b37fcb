//! Places at one listener. They are limited, so that strangers cannot take up the machine; and whoever comes gets one while somebody is there
//! who has not said what it wants, so that strangers who only connect keep nobody out.

use std::io::Write;
use std::net::{IpAddr, Shutdown, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// The limits of a listener.
pub struct Places {
    most: usize,
    /// For one address of another computer.
    most_from_one: usize,
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
    from: Option<IpAddr>,
    standing: Standing,
    /// Ends the connection.
    end: Box<dyn Fn() + Send>,
}

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
}

/// A place; it becomes free when this is dropped.
pub struct Place {
    places: Arc<Places>,
    number: u64,
}

impl Places {
    /// So many, half of them for one address. Whoever is on this computer has all of them: there, an address says nothing.
    pub fn new(most: usize) -> Arc<Self> {
        Arc::new(Self { most, most_from_one: most.div_ceil(2), table: Mutex::default() })
    }

    /// Takes a place. If there is none, the peer that has said least, and of those the one that has been there longest, is let go
    /// with its `end`; peers that are being served stay.
    pub fn enter(
        self: &Arc<Self>,
        from: Option<IpAddr>,
        end: impl Fn() + Send + 'static,
    ) -> Result<Place, NoPlace> {
        let mut table = self.lock();
        let same = from.filter(|from| !from.is_loopback());
        let is_crowded = same.is_some()
            && table.seats.iter().filter(|seat| seat.from == same).count() >= self.most_from_one;
        if is_crowded || table.seats.len() >= self.most {
            let may_go =
                |seat: &&Seat| seat.standing < Standing::Served && (!is_crowded || seat.from == same);
            let least = table.seats.iter().filter(may_go).min_by_key(|seat| (seat.standing, seat.number));
            let Some(number) = least.map(|seat| seat.number) else {
                return Err(if is_crowded {
                    NoPlace::FromOne(self.most_from_one)
                } else {
                    NoPlace::Full(self.most)
                });
            };
            table.leave(number).into_iter().for_each(|seat| (seat.end)());
        }
        let number = table.next;
        table.next += 1;
        table.seats.push(Seat { number, from: same, standing: Standing::Silent, end: Box::new(end) });
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
            places.enter(None, move || gone.lock().unwrap().push(name))
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

    #[test]
    fn one_address_has_half_of_the_places_and_lets_go_of_its_own() {
        let places = Places::new(4);
        let gone = Arc::new(AtomicUsize::new(0));
        let enter = |from| {
            let gone = Arc::clone(&gone);
            places.enter(from, move || {
                gone.fetch_add(1, Ordering::Relaxed);
            })
        };
        let own = enter(Some(address(1))).unwrap();
        let _crowd: Vec<_> = (0..20).map(|_| enter(Some(address(2))).unwrap()).collect();
        assert_eq!(gone.load(Ordering::Relaxed), 18);
        own.is_served();
        let last: Vec<_> = (0..2).map(|_| enter(Some(address(2))).unwrap()).collect();
        last.iter().for_each(Place::is_served);
        assert_eq!(enter(Some(address(2))).err(), Some(NoPlace::FromOne(2)));
        assert!(enter(Some(address(3))).is_ok());
        // On this computer, addresses say nothing.
        let local: Vec<_> = (0..9).map(|_| enter(Some(IpAddr::from([127, 0, 0, 1])))).collect();
        assert!(local.iter().all(Result::is_ok));
    }
}
