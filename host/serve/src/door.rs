//! Where clients of protocols that are not ours connect. All of these doors admit them by the same rules: each client has a place and a
//! thread. Each protocol decides what is a greeting; without one, a client leaves after [`GREETING_TIMEOUT`], or the protocol's own time.

use std::io::{self, Read};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use cantap::device::is_idle;
use cantap_wire::message::Role;

use crate::listen::{accept, bind};
use crate::places::{GREETING_TIMEOUT, NoPlace, Origin, Place, Places, ends};

/// A listener of one protocol.
pub struct Door {
    listener: TcpListener,
    places: Arc<Places>,
    /// What its clients are called.
    kind: &'static str,
    /// With the port chosen by the system.
    pub address: SocketAddr,
    /// What clients may do.
    pub role: Role,
}

/// A client that has got a place.
pub struct AdmittedClient {
    /// Its connection.
    pub stream: TcpStream,
    /// Its name in messages.
    pub name: String,
    /// Free again when the client is served no more.
    pub place: Place,
    came: Instant,
}

/// What clients may do at an address by a protocol without authentication: where other computers reach it, listen.
pub fn role_at(address: SocketAddr, role: Role) -> Role {
    if address.ip().is_loopback() { role } else { Role::Listen }
}

impl Door {
    /// Binds the address, for so many clients at a time.
    pub fn open(kind: &'static str, address: SocketAddr, role: Role, most: usize) -> io::Result<Self> {
        let role = role_at(address, role);
        let (listener, address) = bind(address)?;
        Ok(Self { listener, places: Places::new(most), kind, address, role })
    }

    /// Has the next client served in a thread of its own, or, without a place for it, turned away. An error: nobody is there, or whoever came
    /// has gone.
    pub fn admit(
        &self,
        turn_away: impl FnOnce(&mut TcpStream, String, NoPlace),
        serve: impl FnOnce(AdmittedClient) + Send + 'static,
    ) -> io::Result<()> {
        let (mut stream, peer) = accept(&self.listener, self.role)?;
        let name = format!("{} {peer}", self.kind);
        match self.places.enter(Origin::of(&stream, peer), ends(&stream)?) {
            Ok(place) => {
                let visitor = AdmittedClient { stream, name, place, came: Instant::now() };
                let thread = std::thread::Builder::new().name("cantap-client".to_owned());
                thread.spawn(move || serve(visitor)).map(drop)
            }
            Err(full) => {
                turn_away(&mut stream, name, full);
                Ok(())
            }
        }
    }
}

impl AdmittedClient {
    /// Takes what it has sent: how many bytes, 0 if there are none yet; `None` if it has gone.
    pub fn read(&mut self, bytes: &mut [u8]) -> Option<usize> {
        match self.stream.read(bytes) {
            Ok(0) => None,
            Ok(len) => Some(len),
            Err(error) if is_idle(&error) => Some(0),
            Err(_) => None,
        }
    }

    /// Whether it has been there for longer than a client may take for its greeting.
    pub fn is_late(&self) -> bool {
        self.has_been_for(GREETING_TIMEOUT)
    }

    /// Whether it has been there for longer than this.
    pub fn has_been_for(&self, time: Duration) -> bool {
        self.came.elapsed() > time
    }
}
