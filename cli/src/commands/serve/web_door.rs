//! The page beside the other listeners: the server of `cantap ui`, with the shared boards in place of a device of its own.

use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::Context;
use cantap_serve::{Board, News, Role};
#[cfg(feature = "tls")]
use cantap_serve::{listen::Listening, tls};
use cantap_trace::counted;
use cantap_ui::{Device, Hosted, Server, Site, Source, Stopper, Visit, Visits};
#[cfg(feature = "tls")]
use cantap_ui::{People, Person};
use cantap_work::boards::Boards;
use cantap_work::channel_options::ChannelOptions;

use super::doors::{Allowed, Door, address, allow};
use super::way::Way;
use crate::commands::ui::DEAD_MAN;
use crate::database_args::{DatabaseArgs, load};
use crate::page;
use crate::protocols::ProtocolArgs;
use crate::stderr;
use crate::usage_error::usage;

/// What an address begins with that is to be encrypted.
const HTTPS: &str = "https://";
/// The default port of `--web`.
const PORT: u16 = 29_540;
/// For how long the boards are listened to after the last page has gone: one that is loaded anew, or whose connection broke, misses nothing.
const LINGER: Duration = Duration::from_mins(1);
/// The pages' session with a board, in messages.
const CLIENT: &str = "the page";

/// Where the page will be, and with what.
pub struct WebDoor {
    address: SocketAddr,
    /// For browsers of other computers, with certificates; without it, for those of this one, with a token.
    #[cfg(feature = "tls")]
    server: Option<tls::Server>,
    site: Site,
    databases: cantap_signals::Decoder,
}

/// The page is served until this is dropped.
pub enum Serving {
    /// On this computer.
    Here(Stopper, Option<JoinHandle<()>>),
    /// On others. Nobody is let in any more before those who are there are told.
    #[cfg(feature = "tls")]
    Encrypted(Option<Listening>, People),
}

/// Where a page will be.
struct Place {
    address: SocketAddr,
    #[cfg(feature = "tls")]
    server: Option<tls::Server>,
}

impl Place {
    fn new(text: &str, way: &Way) -> anyhow::Result<Self> {
        let (text, is_https) = text.strip_prefix(HTTPS).map_or((text, false), |text| (text, true));
        let address = address(text, PORT)?;
        let is_encrypted = is_https || !address.ip().is_loopback();
        #[cfg(feature = "tls")]
        let (server, is_possible) = {
            let server = if is_encrypted { way.server() } else { None };
            let is_possible = server.is_some();
            (server, is_possible)
        };
        #[cfg(not(feature = "tls"))]
        let (is_possible, Way::Plain) = (false, way);
        if is_encrypted && !is_possible {
            return Err(usage(format!(
                "at {address} the page would cross the network unencrypted; give --tls and --clients, for browsers that have a \
                 certificate; or on the other computer, use cantap ui -d tls://… or -d ssh://…, or ssh -L {PORT}:127.0.0.1:{PORT}"
            )));
        }
        Ok(Self {
            address,
            #[cfg(feature = "tls")]
            server,
        })
    }
}

impl WebDoor {
    /// One for each of these addresses, so that a mistake is known before there is a server.
    pub fn all(
        texts: &[String],
        way: &Way,
        boards: &Boards,
        databases: &DatabaseArgs,
        protocol: &ProtocolArgs,
    ) -> anyhow::Result<Vec<Self>> {
        let places: Vec<_> = texts.iter().map(|text| Place::new(text, way)).collect::<Result<_, _>>()?;
        for (at, Place { address, .. }) in places.iter().enumerate() {
            if address.port() != 0 && places[..at].iter().any(|other| other.address == *address) {
                return Err(usage(format!(
                    "--web is given twice for {address}; give each another address or port"
                )));
            }
        }
        if places.is_empty() {
            return Ok(Vec::new());
        }
        let options = databases.or_of(boards.addresses());
        let decoder = load(&options, false, false)?;
        let described = protocol.carried(false)?;
        let about = page::about_devices(boards.addresses(), &options, described, "cantap serve")?;
        let page = page::with(&page::find()?, page::LIVE, &about)?;
        let door = |place: Place| {
            anyhow::Ok(Self {
                address: place.address,
                #[cfg(feature = "tls")]
                server: place.server,
                site: Site::new(&page)?,
                databases: decoder.clone(),
            })
        };
        places.into_iter().map(door).collect()
    }

    /// Whether browsers show certificates.
    pub const fn is_encrypted(&self) -> bool {
        #[cfg(feature = "tls")]
        return self.server.is_some();
        #[cfg(not(feature = "tls"))]
        false
    }

    /// Serves it. Returns its address, with its token if it has one.
    pub fn open(
        self,
        devices: &Boards,
        boards: &[Arc<Board>],
        allowed: &[Allowed],
    ) -> anyhow::Result<(String, Serving)> {
        #[cfg(feature = "tls")]
        if self.server.is_some() {
            return self.open_encrypted(devices, boards, allow(allowed, Door::Https));
        }
        let role = allow(allowed, Door::Web);
        let shared = boards.to_vec();
        let link = move |at: usize| Ok(shared[at].link(CLIENT, role)?);
        let hosted = Hosted { link: Arc::new(link), may_use: Arc::new(|_| true), linger: LINGER };
        let device = device(devices, hosted, role, self.databases);
        let source = Source::Device(Box::new(device));
        let server = Server::open(self.site, source, self.address, stderr::reporter(), visits(&boards[0]))
            .context("give another port with --web")?;
        let (url, stopper) = (server.url(), server.stopper());
        if role >= Role::Send {
            stderr::warn("whoever has the address of the page can send on the buses");
        }
        let thread = std::thread::Builder::new().name("cantap-web".to_owned()).spawn(move || {
            if let Err(error) = server.run() {
                stderr::warn(&format!("the page is not served any more: {error}"));
            }
        })?;
        Ok((url, Serving::Here(stopper, Some(thread))))
    }

    /// The same for browsers of other computers: each certificate has sessions of its own with the boards, under its permissions.
    #[cfg(feature = "tls")]
    fn open_encrypted(
        self,
        devices: &Boards,
        boards: &[Arc<Board>],
        most: Role,
    ) -> anyhow::Result<(String, Serving)> {
        let Self { address, server, site, databases } = self;
        let server = server.context("there is no certificate for the page")?;
        let people = People::new(site, stderr::reporter(), visits(&boards[0]));
        let (serving, devices) = (people.clone(), devices.clone());
        let serve = move |visitor: tls::Visitor, stream: tls::Stream| {
            let role = visitor.role();
            let of_visitor = || {
                let (sessions, permitted) = (visitor.sessions(), visitor.sessions());
                let link = Arc::new(move |board: usize| Ok(sessions.link(board, role)?));
                let may_use = Arc::new(move |channel: u8| permitted.may_use(channel));
                device(&devices, Hosted { link, may_use, linger: LINGER }, role, databases.clone())
            };
            let person = Person {
                identity: visitor.certificate(),
                name: visitor.name(),
                role,
                is_own_host: &|host| visitor.is_host(host),
                check: &|| visitor.check(),
                is_served: &|| visitor.is_served(),
                device: &of_visitor,
            };
            // Whoever has left needs no answer.
            let _ = serving.serve(Box::new(Encrypted(stream)), &person);
        };
        let listening = tls::visitors(boards, address, most, &server, serve)
            .with_context(|| format!("nobody can listen at {address}; give another port with --web"))?;
        let address = listening.address().unwrap_or(address);
        Ok((format!("{HTTPS}{address}/"), Serving::Encrypted(Some(listening), people)))
    }
}

/// Shared boards as pages see them.
fn device(devices: &Boards, hosted: Hosted, role: Role, decoder: cantap_signals::Decoder) -> Device {
    Device {
        boards: devices.clone(),
        hosted: Some(hosted),
        open: ChannelOptions::default(),
        filters: Vec::new(),
        role,
        decoder,
        folder: None,
        record: None,
        dead_man: DEAD_MAN,
    }
}

/// A visitor's connection, for the page's server.
#[cfg(feature = "tls")]
struct Encrypted(tls::Stream);

#[cfg(feature = "tls")]
impl std::io::Read for Encrypted {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        self.0.read(out)
    }
}

#[cfg(feature = "tls")]
impl std::io::Write for Encrypted {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.0.flush()
    }
}

#[cfg(feature = "tls")]
impl cantap_ui::Stream for Encrypted {
    fn set_read_timeout(&self, timeout: Duration) -> std::io::Result<()> {
        self.0.set_read_timeout(timeout)
    }
}

/// Reports what visitors do like what other clients do.
fn visits(board: &Arc<Board>) -> Visits {
    let board = Arc::clone(board);
    Arc::new(move |visitor, visit| {
        let client = visitor.to_owned();
        board.tell(match visit {
            Visit::Came(role) => {
                board.count_page(true);
                News::ClientCame { client, role }
            }
            Visit::Left => {
                board.count_page(false);
                News::ClientLeft { client, reason: None }
            }
            Visit::Refused(reason) => News::Refused { client, reason },
            Visit::Asked(what) => News::Asked { client, what },
            Visit::Missed(records) => News::LeftOut {
                client,
                what: format!("{records}, for which it was too slow", records = counted(records, "record")),
            },
            Visit::NotDone(reason) => News::NotDone { client, reason },
            _ => return,
        });
    })
}

impl Drop for Serving {
    fn drop(&mut self) {
        match self {
            Self::Here(stopper, thread) => {
                stopper.stop();
                if let Some(thread) = thread.take() {
                    let _ = thread.join();
                }
            }
            #[cfg(feature = "tls")]
            Self::Encrypted(listening, people) => {
                drop(listening.take());
                people.end();
            }
        }
    }
}
