//! The port at which the page is served, with one thread for each connection.

use std::fs::File;
use std::io;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::Context;
use cantap::wire::message::Role;
use cantap_work::interrupt;
use cantap_work::report::Reporter;

use crate::access::{self, Door, Refusal, Token};
use crate::bus::Bus;
use crate::connections::Connections;
use crate::device::Device;
use crate::entrance;
use crate::head::{self, Head};
use crate::session::Live;
use crate::shared::Shared;
use crate::site::Site;
use crate::stream::Connection;
use crate::visits::{Visit, Visitor, Visits};

/// Pages at a time.
pub(crate) const MOST_PAGES: usize = 8;
/// A browser that takes nothing for this long has gone.
const WRITE_PATIENCE: Duration = Duration::from_secs(10);
/// How often to check for Ctrl-C where there is no device.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// What the page shows.
pub enum Source {
    /// What devices receive.
    Device(Box<Device>),
    /// A file.
    Trace(PathBuf),
}

/// A server, ready to run.
pub struct Server {
    listener: TcpListener,
    doors: Arc<Doors>,
    bus: Option<Bus>,
}

/// What the connections' threads share.
struct Doors {
    address: SocketAddr,
    token: Token,
    site: Site,
    /// With the name of this run, so that a page knows whether its place in the records is still one.
    live: Option<(Arc<Shared>, Token)>,
    trace: Option<PathBuf>,
    /// The most that pages may do.
    role: Role,
    visits: Visits,
    connections: Connections,
    is_over: AtomicBool,
}

/// Ends a server from another thread.
#[derive(Clone)]
pub struct Stopper(Arc<Doors>);

impl Stopper {
    /// The server ends: recordings are finished, pages are told.
    pub fn stop(&self) {
        self.0.is_over.store(true, Ordering::Relaxed);
        if let Some((shared, _)) = &self.0.live {
            shared.end();
        }
    }
}

impl Server {
    /// Opens the device or the file, and a port at an address of this machine (loopback); 0 for any that is free. `visits` gets what visitors
    /// do.
    pub fn open(
        site: Site,
        source: Source,
        address: SocketAddr,
        reporter: Reporter,
        visits: Visits,
    ) -> anyhow::Result<Self> {
        if !address.ip().is_loopback() {
            anyhow::bail!("{address} is no address of this machine alone; give one such as 127.0.0.1");
        }
        let token = Token::new().context("the system gives no random numbers")?;
        let run = Token::new().context("the system gives no random numbers")?;
        let listener = TcpListener::bind(address)
            .with_context(|| format!("cannot listen at {address}; give another port"))?;
        let address = listener.local_addr()?;
        let mut role = Role::Listen;
        let (bus, trace) = match source {
            Source::Device(device) => {
                role = device.role;
                (Some(Bus::open(*device, reporter, Arc::clone(&visits))?), None)
            }
            Source::Trace(path) => {
                let file = File::open(&path).with_context(|| format!("cannot read {}", path.display()))?;
                if !file.metadata()?.is_file() {
                    anyhow::bail!("{} is no file; give a trace", path.display());
                }
                (None, Some(path))
            }
        };
        let live = bus.as_ref().map(|bus| (bus.shared(), run));
        let doors = Doors {
            address,
            token,
            site,
            live,
            trace,
            role,
            visits,
            connections: Connections::default(),
            is_over: AtomicBool::new(false),
        };
        Ok(Self { listener, doors: Arc::new(doors), bus })
    }

    /// The page's address, with its token.
    pub fn url(&self) -> String {
        format!("http://{}/?token={}", self.doors.address, self.doors.token.text())
    }

    /// For ending it.
    pub fn stopper(&self) -> Stopper {
        Stopper(Arc::clone(&self.doors))
    }

    /// Serves until Ctrl-C.
    ///
    /// # Errors
    ///
    /// If the system gives no thread.
    pub fn run(self) -> anyhow::Result<()> {
        let Self { listener, doors, bus } = self;
        let accepting = Arc::clone(&doors);
        let thread = std::thread::Builder::new().name("cantap-ui".to_owned());
        let thread = thread.spawn(move || accept(&listener, &accepting))?;
        match bus {
            Some(bus) => bus.run(),
            None => {
                while !interrupt::requested() && !doors.is_over.load(Ordering::Relaxed) {
                    std::thread::sleep(LOOK_EVERY);
                }
            }
        }
        doors.is_over.store(true, Ordering::Relaxed);
        // It waits for a connection.
        let _ = TcpStream::connect(doors.address);
        let _ = thread.join();
        // Pages are told within a tick or two that it ends, on a busy computer later; those that do not listen are not waited for.
        for _ in 0..120 {
            if doors.connections.are_gone() {
                break;
            }
            std::thread::sleep(Duration::from_millis(25));
        }
        Ok(())
    }
}

fn accept(listener: &TcpListener, doors: &Arc<Doors>) {
    while !doors.is_over.load(Ordering::Relaxed) {
        let Ok((stream, _)) = listener.accept() else {
            // Such as no file descriptor being free: that passes.
            std::thread::sleep(LOOK_EVERY);
            continue;
        };
        let Ok(number) = doors.connections.enter(&stream) else { continue };
        let shared = Arc::clone(doors);
        let spawned = std::thread::Builder::new().name("cantap-ui-page".to_owned()).spawn(move || {
            // Whoever has left needs no answer.
            let _ = shared.answer(stream, number);
            shared.connections.leave(number);
        });
        // Without a thread the connection ends, and the browser may try again.
        if spawned.is_err() {
            doors.connections.leave(number);
        }
    }
}

impl Doors {
    fn answer(&self, stream: TcpStream, number: u64) -> io::Result<()> {
        stream.set_nodelay(true)?;
        stream.set_write_timeout(Some(WRITE_PATIENCE))?;
        let name = format!("page {}", stream.peer_addr()?);
        let mut stream: Connection = Box::new(stream);
        let Some(head) = entrance::request(&mut stream, &name, &self.visits)? else { return Ok(()) };
        let is_live = head.path == "/live";
        let (host, origin) = (head.header("host"), head.header("origin"));
        let is_own_host = |host: &str| access::is_own_host(host, self.address);
        let door = Door { scheme: "http", is_own_host: &is_own_host, token: Some(&self.token) };
        if let Err(refusal) = access::check(host, origin, head.parameter("token"), is_live, &door) {
            // Browsers ask for it by themselves, and without a token.
            let is_icon = refusal == Refusal::Token && head.path == "/favicon.ico";
            if !is_icon {
                self.refused(&name, refusal.reason());
            }
            let status = if is_icon { "404 Not Found" } else { refusal.status() };
            return head::sentence(&mut stream, status, refusal.text());
        }
        self.connections.has_shown_token(number);
        if head.method != "GET" {
            return head::sentence(&mut stream, "405 Method Not Allowed", "This server answers GET alone.");
        }
        match (head.path.as_str(), &self.live, &self.trace) {
            ("/", ..) => {
                let policy = self.site.policy(host.unwrap_or_default(), false);
                entrance::page(&mut stream, &self.site, &policy)
            }
            ("/live", Some((shared, run)), _) => self.upgrade(stream, &head, shared, run.text(), &name),
            ("/trace", _, Some(path)) => trace(&mut stream, path),
            _ => head::sentence(&mut stream, "404 Not Found", "There is nothing here; the page is at /."),
        }
    }

    fn refused(&self, name: &str, reason: &str) {
        (self.visits)(name, Visit::Refused(reason.to_owned()));
    }

    /// Makes the connection a WebSocket and serves it.
    fn upgrade(
        &self,
        stream: Connection,
        head: &Head,
        shared: &Shared,
        run: &str,
        name: &str,
    ) -> io::Result<()> {
        let Some(socket) = entrance::upgrade(stream, head)? else { return Ok(()) };
        let Some(page) = shared.enter(MOST_PAGES) else {
            entrance::no_room(socket, name, &self.visits, &format!("{MOST_PAGES} pages"));
            return Ok(());
        };
        let live = Live { shared, run, visits: &self.visits, check: &|| Ok(()) };
        let visitor = Visitor { name: name.to_owned(), role: self.role };
        entrance::serve(socket, head, &live, page, visitor)
    }
}

/// The trace's bytes. A file that grows meanwhile is served as long as it was.
fn trace(stream: &mut Connection, path: &Path) -> io::Result<()> {
    let Ok(file) = File::open(path) else {
        return head::sentence(stream, "404 Not Found", "The trace is no longer there.");
    };
    let length = file.metadata()?.len();
    head::answer(
        stream,
        "200 OK",
        "application/octet-stream",
        length,
        "Content-Security-Policy: default-src 'none'\r\n",
    )?;
    io::copy(&mut io::Read::take(file, length), stream).map(|_| ())
}
