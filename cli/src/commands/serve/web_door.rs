//! The page beside the other listeners: the server of `cantap ui`, with the shared boards in place of a device of its own.

use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::Context;
use cantap_serve::{Board, News, Role};
use cantap_ui::{Device, Hosted, Server, Site, Source, Stopper, Visit, Visits};
use cantap_work::boards::Boards;
use cantap_work::channel_options::ChannelOptions;

use super::doors::address;
use crate::commands::ui::DEAD_MAN;
use crate::database_args::{DatabaseArgs, load};
use crate::page;
use crate::stderr;
use crate::usage_error::usage;

/// The default port of `--web`.
const PORT: u16 = 29_540;
/// For how long the boards are listened to after the last page has gone: one that is loaded anew, or whose connection broke, misses nothing.
const LINGER: Duration = Duration::from_mins(1);
/// The pages' session with a board, in messages.
const CLIENT: &str = "the page";

/// Where the page will be, and with what.
pub struct WebDoor {
    address: SocketAddr,
    site: Site,
    databases: cantap_signals::Decoder,
}

/// The page is served until this is dropped.
pub struct Serving {
    stopper: Stopper,
    thread: Option<JoinHandle<()>>,
}

impl WebDoor {
    /// Finds the page, so that a mistake is known before there is a server.
    pub fn new(text: &str, boards: &Boards, databases: &DatabaseArgs) -> anyhow::Result<Self> {
        let address = address(text, PORT)?;
        if !address.ip().is_loopback() {
            return Err(usage(format!(
                "at {address} the page would cross the network unencrypted; on the other computer, use cantap ui -d tls://… or \
                 -d ssh://…, or ssh -L {PORT}:127.0.0.1:{PORT}"
            )));
        }
        let options = databases.or_of(boards.addresses());
        let decoder = load(&options, false, false)?;
        let about = page::about_devices(boards.addresses(), &options, "cantap serve")?;
        let site = Site::new(&page::with(&page::find()?, page::LIVE, &about)?)?;
        Ok(Self { address, site, databases: decoder })
    }

    /// Serves it. Returns its address, with its token.
    pub fn open(
        self,
        devices: &Boards,
        boards: &[Arc<Board>],
        role: Role,
    ) -> anyhow::Result<(String, Serving)> {
        let shared = boards.to_vec();
        let link = move |at: usize| Ok(shared[at].link(CLIENT, role)?);
        let device = Device {
            boards: devices.clone(),
            hosted: Some(Hosted { link: Arc::new(link), linger: LINGER }),
            open: ChannelOptions::default(),
            filters: Vec::new(),
            role,
            decoder: self.databases,
            folder: None,
            record: None,
            dead_man: DEAD_MAN,
        };
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
        Ok((url, Serving { stopper, thread: Some(thread) }))
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
            Visit::Missed(records) => {
                News::LeftOut { client, what: format!("{records} records, for which it was too slow") }
            }
            Visit::NotDone(reason) => News::NotDone { client, reason },
            _ => return,
        });
    })
}

impl Drop for Serving {
    fn drop(&mut self) {
        self.stopper.stop();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
