//! Clients on other computers: each side shows a certificate from one authority, and a client's contains its maximum role.

mod keys;
mod stream;
mod visitors;

use std::io;
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cantap::device::{Link, is_idle};
use cantap_wire::message::Role;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{
    CertificateDer, CertificateRevocationListDer, DnsName, PrivateKeyDer, ServerName, UnixTime,
};
use rustls::server::WebPkiClientVerifier;
use rustls::server::danger::ClientCertVerifier;
use rustls::{
    ClientConfig, ClientConnection, Connection, RootCertStore, ServerConfig, ServerConnection, crypto,
};

use crate::audit::AT;
use crate::client::Identity;
use crate::connect::dial;
use crate::flow::acknowledging;
use crate::listen::{Arrival, Listening, accept, bind, let_in, turn_away};
use crate::lock::lock;
use crate::places::{Origin, Places, ends};
use crate::{Board, News, small_file};

pub use keys::{Keys, KeysError, LIFETIME_DAYS, REVOKED};
use stream::{Secured, shake_hands};
pub use visitors::{Sessions, Stream, Visitor, visitors};

/// A peer that has not shown its certificate by this time is dropped.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);
/// A server that admits a client sends it tickets immediately.
const VERDICT_TIMEOUT: Duration = Duration::from_secs(1);
/// Limit for peers that have not shown theirs, at a time. So many must come within the time of a handshake to keep somebody out.
const MOST_HANDSHAKES: usize = 64;

/// Why TLS could not be set up, or a peer was not trusted.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file is missing or is not what it should be.
    #[error("'{}' cannot be used: {reason}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The certificate does not match its key, or similar.
    #[error("TLS cannot be set up: {0}")]
    Setup(String),
    /// The other side cannot be reached, or has gone.
    #[error(transparent)]
    Io(#[from] io::Error),
}

/// The files of one side, in PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Files {
    /// Its certificate.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
    /// The certificate of the authority that must have signed the other side's.
    pub authority: PathBuf,
}

/// A side's identity and whom it trusts, read from files.
struct Credentials {
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
    authority: Arc<RootCertStore>,
}

impl Files {
    fn read(&self) -> Result<Credentials, TlsError> {
        let bad = |path: &Path, reason: String| TlsError::File { path: path.to_owned(), reason };
        let certificates = |path: &Path| {
            let pem = small_file::read(path).map_err(|error| bad(path, error.to_string()))?;
            let all: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&pem).collect();
            match all {
                Ok(all) if all.is_empty() => Err(bad(path, "there is no certificate in it".to_owned())),
                all => all.map_err(|error| bad(path, error.to_string())),
            }
        };
        let mut authority = RootCertStore::empty();
        for certificate in certificates(&self.authority)? {
            authority.add(certificate).map_err(|error| bad(&self.authority, error.to_string()))?;
        }
        private(&self.key)?;
        let key = small_file::read(&self.key).map_err(|error| bad(&self.key, error.to_string()))?;
        Ok(Credentials {
            chain: certificates(&self.certificate)?,
            key: PrivateKeyDer::from_pem_slice(&key).map_err(|error| bad(&self.key, error.to_string()))?,
            authority: Arc::new(authority),
        })
    }
}

/// Refuses a key that other users can read or replace. A system's own may be readable to a group, if it belongs to root.
#[cfg(unix)]
fn private(key: &Path) -> Result<(), TlsError> {
    use std::os::unix::fs::MetadataExt;
    let bad = |reason: &str| TlsError::File { path: key.to_owned(), reason: reason.to_owned() };
    let there = key.metadata().map_err(|error| bad(&error.to_string()))?;
    let own = rustix::process::geteuid().as_raw();
    let allowed = if there.uid() == 0 { 0o740 } else { 0o700 };
    if there.uid() != own && there.uid() != 0 {
        return Err(bad("it belongs to another user"));
    }
    if there.mode() & 0o777 & !allowed != 0 {
        return Err(bad("other users can use it; `chmod 600` it"));
    }
    Ok(())
}

#[cfg(not(unix))]
fn private(_: &Path) -> Result<(), TlsError> {
    Ok(())
}

fn provider() -> Arc<crypto::CryptoProvider> {
    Arc::new(crypto::ring::default_provider())
}

fn setup(error: impl std::fmt::Display) -> TlsError {
    TlsError::Setup(error.to_string())
}

/// A server that requires a certificate from each client.
#[derive(Clone)]
pub struct Server {
    files: Files,
    revoked: Option<PathBuf>,
    trust: Arc<Mutex<Trust>>,
}

/// What a server shows, and whom it trusts.
#[derive(Clone)]
struct Trust {
    config: Arc<ServerConfig>,
    clients: Arc<dyn ClientCertVerifier>,
    /// Its own certificate.
    own: CertificateDer<'static>,
}

impl Server {
    /// Reads the files; the authority is that of the clients. `revoked` is its list of revoked certificates (PEM): whoever is on it is
    /// refused, and with a list of another authority, everybody.
    pub fn new(files: &Files, revoked: Option<&Path>) -> Result<Self, TlsError> {
        let trust = Trust::read(files, revoked)?;
        let revoked = revoked.map(Path::to_owned);
        Ok(Self { files: files.clone(), revoked, trust: Arc::new(Mutex::new(trust)) })
    }

    /// Reads the files again. If one of them cannot be used, nothing changes. Clients that are no longer trusted are let go within a second.
    pub fn reload(&self) -> Result<(), TlsError> {
        self.read_again().map(Reread::apply)
    }

    /// Reads the files again without using them yet, for whoever has others to read before that.
    pub fn read_again(&self) -> Result<Reread, TlsError> {
        let trust = Trust::read(&self.files, self.revoked.as_deref())?;
        Ok(Reread { trust, server: Arc::clone(&self.trust) })
    }

    fn trust(&self) -> Trust {
        lock(&self.trust).clone()
    }

    /// Whether a certificate is trusted at this moment.
    fn check(&self, certificate: &CertificateDer<'_>) -> Result<(), String> {
        let clients = self.trust().clients;
        match clients.verify_client_cert(certificate, &[], UnixTime::now()) {
            Ok(_) => Ok(()),
            Err(error) => Err(format!("its certificate is no longer trusted: {error}")),
        }
    }
}

/// A server's files, read again.
pub struct Reread {
    trust: Trust,
    server: Arc<Mutex<Trust>>,
}

impl Reread {
    /// From now on, the server uses them.
    pub fn apply(self) {
        *lock(&self.server) = self.trust;
    }
}

impl Trust {
    fn read(files: &Files, revoked: Option<&Path>) -> Result<Self, TlsError> {
        let Credentials { chain, key, authority } = files.read()?;
        let mut clients = WebPkiClientVerifier::builder_with_provider(authority, provider());
        if let Some(path) = revoked {
            clients = clients.with_crls([revocations(path)?]);
        }
        let clients = clients.build().map_err(setup)?;
        let own = chain[0].clone();
        let config = ServerConfig::builder_with_provider(provider())
            .with_protocol_versions(&[&rustls::version::TLS13])
            .map_err(setup)?
            .with_client_cert_verifier(Arc::clone(&clients))
            .with_single_cert(chain, key)
            .map_err(setup)?;
        Ok(Self { config: Arc::new(config), clients, own })
    }
}

/// The list in a file.
fn revocations(path: &Path) -> Result<CertificateRevocationListDer<'static>, TlsError> {
    let bad = |reason: String| TlsError::File { path: path.to_owned(), reason };
    let pem = small_file::read(path).map_err(|error| bad(error.to_string()))?;
    CertificateRevocationListDer::from_pem_slice(&pem).map_err(|error| bad(error.to_string()))
}

/// Admits clients at any address of this computer. Each may do what its certificate says, limited to `most`. A client
/// without a certificate signed by the authority receives nothing.
pub fn listen(board: &Arc<Board>, address: SocketAddr, most: Role, server: &Server) -> io::Result<Listening> {
    let (listener, address) = bind(address)?;
    let (board, server) = (Arc::clone(board), server.clone());
    let (handshakes, places) = (Places::new(MOST_HANDSHAKES), Places::new(board.most_clients()));
    Listening::start("cantap-tls", Some(address), move || {
        let (stream, peer) = accept(&listener, most)?;
        let name = format!("client {peer}");
        // Who is let go is not reported: a flood of connections would be a flood of messages.
        let origin = Origin::of(&stream, peer);
        let Ok(handshake) = handshakes.enter(origin, ends(&stream)?) else { return Ok(()) };
        let (board, server, places) = (Arc::clone(&board), server.clone(), Arc::clone(&places));
        std::thread::Builder::new().name("cantap-tls-client".to_owned()).spawn(move || {
            let end = ends(&stream);
            let deadline = Instant::now() + HANDSHAKE_TIMEOUT;
            if !has_spoken(&stream, deadline) {
                return;
            }
            handshake.spoke();
            let secured = welcome(stream, server.trust().config, deadline);
            drop(handshake);
            let secured = secured.and_then(|secured| Ok((secured, places.enter(origin, end?))));
            match secured {
                Ok(((own, secured), place)) => {
                    let (input, mut output) = secured.split();
                    let name = own.name.as_ref().map_or(name, |own| format!("{own}{AT} {peer}"));
                    let certificate = own.name.unwrap_or_default();
                    // A session that is resumed does not show its certificate again, which may have expired meanwhile.
                    if let Err(reason) = server.check(&own.der) {
                        turn_away(&board, &mut output, name, &reason);
                        return;
                    }
                    if let Err(denied) = board.permit_of(&certificate) {
                        turn_away(&board, &mut output, name, &denied);
                        return;
                    }
                    let check = Box::new(move || server.check(&own.der));
                    let identity = Some(Identity { certificate, check });
                    let arrival = Arrival { name, role: own.role.min(most), is_remote: true, identity };
                    let_in(&board, place, input, output, arrival);
                }
                Err(error) => board.tell(News::Refused { client: name, reason: error.to_string() }),
            }
        })?;
        Ok(())
    })
}

/// Waits until a peer says something, which a client does at once. Returns whether it has.
fn has_spoken(stream: &TcpStream, deadline: Instant) -> bool {
    while Instant::now() < deadline {
        match stream.peek(&mut [0]) {
            Err(error) if is_idle(&error) => {}
            said => return matches!(said, Ok(1..)),
        }
    }
    false
}

/// What a client's certificate says.
struct Own {
    der: CertificateDer<'static>,
    /// Another authority's certificates may have names that are no good for messages and files, or none.
    name: Option<String>,
    role: Role,
}

fn welcome(stream: TcpStream, config: Arc<ServerConfig>, deadline: Instant) -> io::Result<(Own, Secured)> {
    let connection = ServerConnection::new(config).map_err(io::Error::other)?;
    let secured = shake_hands(stream, Connection::Server(connection), deadline)?;
    let without = |what: &str| io::Error::other(format!("its certificate says nothing of {what}"));
    let der = secured.peer_certificate().ok_or_else(|| without("whose it is"))?;
    let role = role_of(&der).ok_or_else(|| without("what it may do"))?;
    Ok((Own { name: certificate_name(&der), der, role }, secured))
}

/// The common name in a certificate, if it is one that `keygen` makes: what it is used for, in messages and files, needs no more.
fn certificate_name(certificate: &CertificateDer<'_>) -> Option<String> {
    /// The object identifier 2.5.4.3, as DER has it.
    const COMMON_NAME: [u8; 5] = [6, 3, 0x55, 4, 3];
    let certificate = webpki::EndEntityCert::try_from(certificate).ok()?;
    let subject = certificate.subject();
    let at = subject.windows(COMMON_NAME.len()).position(|bytes| bytes == COMMON_NAME)?;
    let [_type, len, rest @ ..] = subject.get(at + COMMON_NAME.len()..)? else { return None };
    let name = std::str::from_utf8(rest.get(..usize::from(*len))?).ok()?;
    is_name(name).then(|| name.to_owned())
}

/// Whether a text is a client's name.
fn is_name(text: &str) -> bool {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || matches!(letter, '-' | '_');
    (1..=64).contains(&text.len()) && text.chars().all(is_plain)
}

/// The name for a role in a client's certificate: one that no computer has.
fn name_of(role: Role) -> String {
    format!("{role}.role.cantap.invalid")
}

/// The role in a client's certificate, which the authority has signed.
fn role_of(certificate: &CertificateDer<'_>) -> Option<Role> {
    let certificate = webpki::EndEntityCert::try_from(certificate).ok()?;
    Role::ALL.into_iter().rev().find(|role| {
        DnsName::try_from(name_of(*role)).is_ok_and(|name| {
            certificate.verify_is_valid_for_subject_name(&ServerName::DnsName(name)).is_ok()
        })
    })
}

/// Connects to a server at `HOST:PORT`, whose certificate must be valid for that host.
pub fn connect(address: &str, files: &Files) -> Result<Link, TlsError> {
    let Credentials { chain, key, authority } = files.read()?;
    let config = ClientConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(setup)?
        .with_root_certificates(authority)
        .with_client_auth_cert(chain, key)
        .map_err(setup)?;
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']']);
    // A zone is this computer's way there, and no part of the server's address.
    let host = host.split_once('%').map_or(host, |(host, _)| host);
    let host = ServerName::try_from(host.to_owned()).map_err(setup)?;
    let connection = ClientConnection::new(Arc::new(config), host).map_err(setup)?;
    let stream = dial(address)?;
    let secured = shake_hands(stream, Connection::Client(connection), Instant::now() + HANDSHAKE_TIMEOUT)?;
    secured.wait_for_verdict(Instant::now() + VERDICT_TIMEOUT)?;
    let (reader, writer) = secured.split();
    Ok(acknowledging(Link::new(reader, writer)))
}
