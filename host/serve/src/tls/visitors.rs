//! People at an encrypted listener for another protocol than ours, such as a browser's. Who they are is found out here, as for clients: by their
//! certificates. What they may do then is enforced by the sessions with the boards that are opened for them.

use std::io::{self, Read, Write};
use std::net::{IpAddr, SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use cantap::device::Link;
use cantap_wire::message::Role;
use rustls::pki_types::{CertificateDer, ServerName};

use super::stream::{Reader, Writer};
use super::{HANDSHAKE_TIMEOUT, MOST_HANDSHAKES, Own, Server, has_spoken, welcome};
use crate::audit::{AT, PAGE_OF};
use crate::client::Identity;
use crate::client::admission::Guest;
use crate::listen::{Listening, accept, bind};
use crate::places::{Origin, Place, Places, ends};
use crate::shared::Refused;
use crate::{Board, News, foreign};

/// A visitor that takes nothing for this long has gone.
const WRITE_PATIENCE: Duration = Duration::from_secs(10);
/// The protocol that is spoken inside, as browsers and servers name it: a connection that was meant for another one fails.
const INSIDE: &[u8] = b"http/1.1";
/// The port that a URL need not name.
const HTTPS_PORT: u16 = 443;

/// Somebody who has shown a certificate that is trusted.
pub struct Visitor {
    own: Arc<Own>,
    name: String,
    role: Role,
    here: SocketAddr,
    server: Server,
    boards: Arc<[Arc<Board>]>,
    place: Place,
}

/// A visitor's connection.
pub struct Stream {
    socket: TcpStream,
    reader: Reader,
    writer: Writer,
}

/// Admits whoever has a certificate of the authority's, at any address of this computer, and hands over their connections, each in a thread of
/// its own. Nobody else is sent anything. `most` limits their roles.
pub fn visitors(
    boards: &[Arc<Board>],
    address: SocketAddr,
    most: Role,
    server: &Server,
    serve: impl Fn(Visitor, Stream) + Send + Sync + 'static,
) -> io::Result<Listening> {
    let (listener, address) = bind(address)?;
    let (boards, server, serve) = (Arc::<[_]>::from(boards), server.clone(), Arc::new(serve));
    let (handshakes, places) = (Places::new(MOST_HANDSHAKES), Places::new(boards[0].most_clients()));
    Listening::start("cantap-https", Some(address), move || {
        let (stream, peer) = accept(&listener, most)?;
        let origin = Origin::of(&stream, peer);
        let Ok(handshake) = handshakes.enter(origin, ends(&stream)?) else { return Ok(()) };
        let (boards, server, places) = (Arc::clone(&boards), server.clone(), Arc::clone(&places));
        let serve = Arc::clone(&serve);
        std::thread::Builder::new().name("cantap-https-visitor".to_owned()).spawn(move || {
            let deadline = Instant::now() + HANDSHAKE_TIMEOUT;
            if !has_spoken(&stream, deadline) {
                return;
            }
            handshake.spoke();
            match introduce(stream, peer, most, &server, &boards, &places, deadline) {
                Ok((visitor, stream)) => {
                    drop(handshake);
                    serve(visitor, stream);
                }
                Err((name, reason)) => refused(&boards[0], name, reason),
            }
        })?;
        Ok(())
    })
}

fn refused(board: &Board, client: String, reason: String) {
    board.tell(News::Refused { client, reason });
}

/// Finds out who has come; an error has a name and why nobody is let in.
fn introduce(
    stream: TcpStream,
    peer: SocketAddr,
    most: Role,
    server: &Server,
    boards: &Arc<[Arc<Board>]>,
    places: &Arc<Places>,
    deadline: Instant,
) -> Result<(Visitor, Stream), (String, String)> {
    let stranger = || format!("page {peer}");
    let bad = |error: io::Error| (stranger(), error.to_string());
    let mut first = [0; foreign::ENOUGH];
    let len = stream.peek(&mut first).map_err(bad)?;
    if let Some(protocol) = foreign::protocol(&first[..len]).filter(|protocol| *protocol != "TLS") {
        return Err((
            stranger(),
            format!("it speaks {protocol}, without encryption: the address begins with https://"),
        ));
    }
    let mut config = (*server.trust().config).clone();
    config.alpn_protocols = vec![INSIDE.to_vec()];
    let raw = stream.try_clone().map_err(bad)?;
    let here = stream.local_addr().map_err(bad)?;
    let (own, secured) = welcome(stream, Arc::new(config), deadline).map_err(bad)?;
    raw.set_write_timeout(Some(WRITE_PATIENCE)).map_err(bad)?;
    let (reader, writer) = secured.split();
    let name = own.name.as_deref().map_or_else(stranger, |own| format!("{PAGE_OF}{own}{AT} {peer}"));
    let place = places.enter(Origin::of(&raw, peer), ends(&raw).map_err(bad)?);
    let place = place.map_err(|full| (name.clone(), full.to_string()))?;
    place.spoke();
    let role = own.role.min(most);
    let (own, server, boards) = (Arc::new(own), server.clone(), Arc::clone(boards));
    let mut visitor = Visitor { own, name, role, here, server, boards, place };
    // A session that is resumed does not show its certificate again.
    visitor.check().map_err(|reason| (visitor.name.clone(), reason))?;
    if let Ok(Some(permit)) = visitor.boards[0].permit_of(visitor.certificate_name()) {
        visitor.role = permit.role(role);
    }
    Ok((visitor, Stream { socket: raw, reader, writer }))
}

impl Visitor {
    /// Its name in messages: that of its certificate, and its address.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The most that it may do.
    pub const fn role(&self) -> Role {
        self.role
    }

    /// Its certificate, in DER: whoever shows the same one is the same.
    pub fn certificate(&self) -> &[u8] {
        &self.own.der
    }

    fn certificate_name(&self) -> &str {
        self.own.name.as_deref().unwrap_or_default()
    }

    /// It is being served, and keeps its place until its connection ends.
    pub fn is_served(&self) {
        self.place.is_served();
    }

    /// Whether the certificate is still trusted, and permitted at this time. An error says why not.
    pub fn check(&self) -> Result<(), String> {
        self.server.check(&self.own.der)?;
        let permit = self.boards[0].permit_of(self.certificate_name());
        permit.map(drop).map_err(|denied| denied.to_string())
    }

    /// Whether a `Host` header, with its port, is a name of this server: one that its certificate is valid for.
    pub fn is_host(&self, header: &str) -> bool {
        let (name, port) = match header.rsplit_once(':') {
            Some((name, port)) if !port.ends_with(']') => (name, port.parse().ok()),
            _ => (header, Some(HTTPS_PORT)),
        };
        if port != Some(self.here.port()) {
            return false;
        }
        let name = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
        let name = match name.parse::<IpAddr>() {
            Ok(address) => ServerName::IpAddress(address.into()),
            Err(_) => match ServerName::try_from(name) {
                Ok(name) => name,
                Err(_) => return false,
            },
        };
        self.server.is_for(&name)
    }

    /// What opens sessions with the boards for this certificate, as long as it is trusted.
    pub fn sessions(&self) -> Sessions {
        Sessions {
            own: Arc::clone(&self.own),
            server: self.server.clone(),
            boards: Arc::clone(&self.boards),
            role: self.own.role,
        }
    }
}

/// Opens sessions with boards under the role and the permissions of a certificate.
#[derive(Clone)]
pub struct Sessions {
    own: Arc<Own>,
    server: Server,
    boards: Arc<[Arc<Board>]>,
    role: Role,
}

impl Sessions {
    /// Whether the certificate may use a channel, by its number from 1. A board checks that again.
    pub fn may_use(&self, channel: u8) -> bool {
        let name = self.own.name.as_deref().unwrap_or_default();
        let permit = self.boards[0].permit_of(name);
        permit.is_ok_and(|permit| permit.is_none_or(|permit| permit.channel(channel).is_ok()))
    }

    /// A session with a board, by its place from 0, in a role of no more than `most`.
    ///
    /// # Errors
    ///
    /// If the certificate is not trusted or permitted at this time, or there is no place.
    pub fn link(&self, board: usize, most: Role) -> Result<Link, Refused> {
        let (own, server) = (Arc::clone(&self.own), self.server.clone());
        let certificate = own.name.clone().unwrap_or_default();
        server.check(&own.der).map_err(Refused::NotTrusted)?;
        let check = Box::new(move || server.check(&own.der));
        let guest = Guest::of_board(&format!("{PAGE_OF}{certificate}"), self.role.min(most));
        // Its place is that of the visitor's connection.
        let identity = Some(Identity { certificate, check });
        self.boards[board].link_of(Guest { is_counted: false, identity, ..guest })
    }
}

impl Stream {
    /// After this time, a read that got nothing ends with [`WouldBlock`](io::ErrorKind::WouldBlock) or
    /// [`TimedOut`](io::ErrorKind::TimedOut). It can do so earlier.
    pub fn set_read_timeout(&self, timeout: Duration) -> io::Result<()> {
        self.socket.set_read_timeout(Some(timeout))
    }
}

impl Read for Stream {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        self.reader.read(out)
    }
}

impl Write for Stream {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.writer.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.writer.flush()
    }
}

impl Server {
    /// Whether its own certificate is valid for a name.
    fn is_for(&self, name: &ServerName<'_>) -> bool {
        let own: CertificateDer<'static> = self.trust().own;
        webpki::EndEntityCert::try_from(&own)
            .is_ok_and(|own| own.verify_is_valid_for_subject_name(name).is_ok())
    }
}
