//! The page for people on other computers. Whoever accepts their connections has found out who they are, by certificates; each certificate has
//! a session of its own with the devices, so that what one may do is no more than that, whatever the others may.

use std::collections::BTreeMap;
use std::io;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::Context;
use cantap::wire::message::Role;
use cantap_work::report::Reporter;

use crate::access::{self, Door, Token};
use crate::bus::Bus;
use crate::device::Device;
use crate::entrance;
use crate::head;
use crate::server::MOST_PAGES;
use crate::session::Live;
use crate::shared::Shared;
use crate::site::Site;
use crate::stream::Connection;
use crate::visits::{Visit, Visitor, Visits};

/// Sessions at a time: each keeps what its devices received for its pages.
const MOST_SESSIONS: usize = 8;

/// Serves the page to people. A clone serves the same.
#[derive(Clone)]
pub struct People(Arc<Inner>);

/// Somebody who has shown who they are.
pub struct Person<'a> {
    /// Their certificate, or what else tells one from another. Whoever has the same one shares a session.
    pub identity: &'a [u8],
    /// Their name in messages.
    pub name: &'a str,
    /// The most that they may do.
    pub role: Role,
    /// Whether the host that a request names, with its port, is this server.
    pub is_own_host: &'a dyn Fn(&str) -> bool,
    /// Whether they may still be there; an error says why not. It is asked once a second.
    pub check: &'a dyn Fn() -> Result<(), String>,
    /// Called when their page is served, and not only something else.
    pub is_served: &'a dyn Fn(),
    /// The devices as they may use them. They must be [`hosted`](Device::hosted).
    pub device: &'a dyn Fn() -> Device,
}

struct Inner {
    site: Site,
    reporter: Reporter,
    visits: Visits,
    rooms: Mutex<BTreeMap<Vec<u8>, Room>>,
    /// Connections that are being answered.
    open: AtomicUsize,
    is_over: AtomicBool,
}

/// The session of one certificate's pages.
struct Room {
    shared: Arc<Shared>,
    run: Token,
    thread: JoinHandle<()>,
}

impl People {
    /// Nobody is there yet. `visits` gets what visitors do.
    pub fn new(site: Site, reporter: Reporter, visits: Visits) -> Self {
        let (rooms, open, is_over) = (Mutex::default(), AtomicUsize::new(0), AtomicBool::new(false));
        Self(Arc::new(Inner { site, reporter, visits, rooms, open, is_over }))
    }

    /// Answers one request, and serves the page if it is one for that. Returns when that is over.
    ///
    /// # Errors
    ///
    /// If the connection ends meanwhile; nobody needs to know.
    pub fn serve(&self, stream: Connection, person: &Person<'_>) -> io::Result<()> {
        self.0.open.fetch_add(1, Ordering::Relaxed);
        let result = self.answer(stream, person);
        self.0.open.fetch_sub(1, Ordering::Relaxed);
        result
    }

    /// Tells all pages that the server ends, and waits until they have gone, though not for those that do not listen.
    pub fn end(&self) {
        self.0.is_over.store(true, Ordering::Relaxed);
        let rooms: Vec<Room> = std::mem::take(&mut *self.0.rooms()).into_values().collect();
        for room in &rooms {
            room.shared.end();
        }
        for room in rooms {
            let _ = room.thread.join();
        }
        for _ in 0..120 {
            if self.0.open.load(Ordering::Relaxed) == 0 {
                return;
            }
            std::thread::sleep(Duration::from_millis(25));
        }
    }

    fn answer(&self, mut stream: Connection, person: &Person<'_>) -> io::Result<()> {
        let Inner { site, visits, .. } = &*self.0;
        let Some(head) = entrance::request(&mut stream, person.name, visits)? else { return Ok(()) };
        let is_live = head.path == "/live";
        let (host, origin) = (head.header("host"), head.header("origin"));
        let door = Door { scheme: "https", is_own_host: person.is_own_host, token: None };
        if let Err(refusal) = access::check(host, origin, None, is_live, &door) {
            visits(person.name, Visit::Refused(refusal.reason().to_owned()));
            return head::sentence(&mut stream, refusal.status(), refusal.text());
        }
        if head.method != "GET" {
            return head::sentence(&mut stream, "405 Method Not Allowed", "This server answers GET alone.");
        }
        match head.path.as_str() {
            "/" => {
                let policy = site.policy(host.unwrap_or_default(), true);
                entrance::page(&mut stream, site, &policy)
            }
            "/live" => self.live(stream, &head, person),
            _ => head::sentence(&mut stream, "404 Not Found", "There is nothing here; the page is at /."),
        }
    }

    fn live(&self, stream: Connection, head: &head::Head, person: &Person<'_>) -> io::Result<()> {
        let visits = &self.0.visits;
        let Some(socket) = entrance::upgrade(stream, head)? else { return Ok(()) };
        let (shared, run);
        let page = {
            let mut rooms = self.0.rooms();
            (shared, run) = match self.room(&mut rooms, person) {
                Ok(Some(room)) => room,
                Ok(None) => {
                    drop(rooms);
                    let what = format!("sessions of {MOST_SESSIONS} certificates");
                    entrance::no_room(socket, person.name, visits, &what);
                    return Ok(());
                }
                Err(error) => return Err(io::Error::other(error)),
            };
            // While nobody can end the session.
            shared.enter(MOST_PAGES)
        };
        let Some(page) = page else {
            entrance::no_room(socket, person.name, visits, &format!("{MOST_PAGES} pages"));
            return Ok(());
        };
        (person.is_served)();
        let live = Live { shared: &shared, run: run.text(), visits, check: person.check };
        let visitor = Visitor { name: person.name.to_owned(), role: person.role };
        entrance::serve(socket, head, &live, page, visitor)
    }

    /// The session of somebody, begun if there is none; `None` if there are too many.
    fn room(
        &self,
        rooms: &mut BTreeMap<Vec<u8>, Room>,
        person: &Person<'_>,
    ) -> anyhow::Result<Option<(Arc<Shared>, Token)>> {
        if self.0.is_over.load(Ordering::Relaxed) {
            anyhow::bail!("the server ends");
        }
        rooms.retain(|_, room| !room.thread.is_finished());
        if let Some(room) = rooms.get(person.identity) {
            return Ok(Some((Arc::clone(&room.shared), room.run.clone())));
        }
        if rooms.len() >= MOST_SESSIONS {
            // One that is only kept for pages that come back gives way.
            let idle = rooms.iter().find(|(_, room)| !room.shared.has_pages());
            let Some(idle) = idle.map(|(identity, _)| identity.clone()) else { return Ok(None) };
            rooms.remove(&idle).inspect(|room| room.shared.end());
        }
        let run = Token::new().context("the system gives no random numbers")?;
        let bus = Bus::open((person.device)(), self.0.reporter.clone(), Arc::clone(&self.0.visits))?;
        let shared = bus.shared();
        let (identity, people, own) =
            (person.identity.to_vec(), Arc::downgrade(&self.0), Arc::clone(&shared));
        let thread = std::thread::Builder::new().name("cantap-page".to_owned()).spawn(move || {
            bus.run_while(|| people.upgrade().is_some_and(|people| !people.may_end(&identity, &own)));
        })?;
        rooms
            .insert(person.identity.to_vec(), Room { shared: Arc::clone(&shared), run: run.clone(), thread });
        Ok(Some((shared, run)))
    }
}

impl Inner {
    fn rooms(&self) -> MutexGuard<'_, BTreeMap<Vec<u8>, Room>> {
        // Every holder leaves it consistent.
        self.rooms.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A session without pages leaves its place, unless one has just come.
    fn may_end(&self, identity: &[u8], shared: &Arc<Shared>) -> bool {
        let mut rooms = self.rooms();
        if shared.has_pages() {
            return false;
        }
        // Another may have its place already.
        if rooms.get(identity).is_some_and(|room| Arc::ptr_eq(&room.shared, shared)) {
            rooms.remove(identity);
        }
        true
    }
}
