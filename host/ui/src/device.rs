//! The devices that pages see.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::bail;
use cantap::Channel;
use cantap::device::{Link, channel_number};
use cantap::wire::message::{Mode, Role};
use cantap_address::{Address, OpenDevice};
use cantap_signals::Decoder;
use cantap_trace::filter::Filter;
use cantap_work::boards::{Boards, filters_on};
use cantap_work::channel_options::ChannelOptions;
use cantap_work::live::{Line, Lines};
use cantap_work::report::Reporter;

/// Which devices, and how.
pub struct Device {
    /// Which.
    pub boards: Boards,
    /// How they are reached, if not by their addresses.
    pub hosted: Option<Hosted>,
    /// How to open their channels: they only listen unless it says otherwise.
    pub open: ChannelOptions,
    /// What passes; everything if there are none.
    pub filters: Vec<Filter>,
    /// The most that pages may do: look; choose bit rates and filters; send and take part in the buses.
    pub role: Role,
    /// For frames that are given by their signals.
    pub decoder: Decoder,
    /// The folder of recordings that pages begin; without one, they begin none.
    pub folder: Option<PathBuf>,
    /// A recording from the start, into a file that is new; `FILE if CONDITION` for what happens around events.
    pub record: Option<PathBuf>,
    /// What the device sends by itself stops when no page has shown for this long that it is there. Pages show it every second.
    pub dead_man: Duration,
}

/// Devices that another part of this program shares: pages are one more client of theirs, while there are any.
#[derive(Clone)]
pub struct Hosted {
    /// Links to one, by its place from 0.
    pub link: Arc<dyn Fn(usize) -> anyhow::Result<Link> + Send + Sync>,
    /// Whether a channel may be listened to, by its number from 1. The others are not opened.
    pub may_use: Arc<dyn Fn(u8) -> bool + Send + Sync>,
    /// For how long they are still listened to when no page is there any more.
    pub linger: Duration,
}

impl Device {
    /// The command that serves it, as its user knows it.
    pub(crate) const fn command(&self) -> &'static str {
        if self.hosted.is_some() { "cantap serve" } else { "cantap ui" }
    }

    /// The option with which pages have a role.
    pub(crate) fn option(&self, role: Role) -> String {
        format!("--allow {}{role}", if self.hosted.is_some() { "web:" } else { "" })
    }

    /// Whether one that has gone is waited for.
    pub(crate) fn may_come_back(&self, board: usize) -> bool {
        self.hosted.is_some() || self.boards.addresses().get(board).is_some_and(Address::may_come_back)
    }

    /// The devices, to be opened.
    pub(crate) fn lines(&self, reporter: &Reporter) -> Lines {
        let line = |(board, address): (usize, &Address)| {
            let (at, hosted) = (address.clone(), self.hosted.clone());
            let connect = move |serial: Option<&str>| match &hosted {
                Some(hosted) => Ok(at.over((hosted.link)(board)?)?),
                None => Ok(at.open_again(serial)?),
            };
            let (open, filters) = (self.open.on_board(board), filters_on(board, &self.filters));
            let channels: Vec<Channel> = self.boards.channels_of(board).collect();
            let (may_use, reporter) =
                (self.hosted.as_ref().map(|hosted| Arc::clone(&hosted.may_use)), reporter.clone());
            Line::new(&address.to_string(), connect, move |device| {
                let channels = match &may_use {
                    Some(may_use) => known(device, board, &channels, &**may_use)?,
                    None => channels.clone(),
                };
                open.open(device, channels.into_iter(), Mode::ListenOnly, Some(&filters), &reporter)
                    .map(|_| ())
            })
        };
        Lines::new(self.boards.addresses().iter().enumerate().map(line).collect())
    }
}

/// The channels of a shared device that may be used, and whose bit rates its owner has given.
fn known(
    device: &OpenDevice,
    board: usize,
    channels: &[Channel],
    may_use: &dyn Fn(u8) -> bool,
) -> anyhow::Result<Vec<Channel>> {
    let mut known = Vec::new();
    let may_use: Vec<_> =
        channels.iter().filter(|channel| may_use(channel_number(board, **channel))).collect();
    if may_use.is_empty() {
        bail!("the permissions name no channel of '{}' for this certificate", device.name());
    }
    for channel in may_use {
        if device.defaults(*channel)?.is_some() {
            known.push(*channel);
        }
    }
    if known.is_empty() {
        bail!("no bit rate is known for '{}': give it to cantap serve with -b", device.name());
    }
    Ok(known)
}
