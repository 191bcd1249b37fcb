//! What scripts in a thread of their own want of the device that somebody else has, and what both sides know of each other.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use cantap::device::Transmission;
use cantap::wire::message::{Periodic, Trigger};
use cantap_can::{Channel, DEVICE_TAG, Frame};

use super::events::ScriptEvent;
use super::port::Port;
use super::settings::LiveError;

/// Frames that may wait for room in the device's queue. A script has no more than 4096; what is repeated from here comes on top.
const MOST_WAITING: usize = 8192;
/// The tags of the scripts' frames. The one below is for frames that the owner of the device sends itself.
pub(super) const TAGS: std::ops::Range<u32> = 1..1 << 24;

/// What the scripts' thread hands to the owner of the device.
pub(super) enum Request {
    Send { of: usize, tag: u32, channel: Channel, frame: Frame },
    Periodic { of: usize, channel: Channel, slot: u8, entry: Option<Periodic> },
    Event(ScriptEvent),
    Broken(LiveError),
}

/// Who has a periodic entry.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Owner {
    Scripts,
    Device,
}

/// What both sides look at.
#[derive(Default)]
pub(super) struct Shared {
    slots: Mutex<BTreeMap<(usize, u8), Owner>>,
    /// Frames that wait for room in the device's queue.
    pub waiting: AtomicUsize,
    /// Records that the scripts have not taken yet.
    pub backlog: AtomicUsize,
}

impl Shared {
    fn slots(&self) -> MutexGuard<'_, BTreeMap<(usize, u8), Owner>> {
        self.slots.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a periodic entry; false if the other side has it.
    pub fn claim(&self, channel: Channel, slot: u8, owner: Owner) -> bool {
        *self.slots().entry((channel.index(), slot)).or_insert(owner) == owner
    }

    /// Gives an entry back, if it was taken by this side; returns whether it was.
    pub fn release(&self, channel: Channel, slot: u8, owner: Owner) -> bool {
        let key = (channel.index(), slot);
        let mut slots = self.slots();
        let is_own = slots.get(&key) == Some(&owner);
        if is_own {
            slots.remove(&key);
        }
        is_own
    }

    /// The entries that the scripts have.
    pub fn of_scripts(&self) -> Vec<(Channel, u8)> {
        let of_scripts = |((channel, slot), owner): (&(usize, u8), &Owner)| {
            (*owner == Owner::Scripts).then_some((Channel::ALL[*channel], *slot))
        };
        self.slots().iter().filter_map(of_scripts).collect()
    }
}

/// The scripts' side.
pub(super) struct ThreadPort {
    requests: Sender<Request>,
    shared: Arc<Shared>,
    next_tag: u32,
}

impl ThreadPort {
    pub(super) fn new(requests: Sender<Request>, shared: Arc<Shared>) -> Self {
        Self { requests, shared, next_tag: TAGS.start }
    }

    fn request(&self, request: Request) -> Result<(), LiveError> {
        self.requests.send(request).map_err(|_| LiveError::Over)
    }
}

impl Port for ThreadPort {
    fn push(&mut self, of: usize, channel: Channel, frame: Frame) -> Result<Option<u32>, LiveError> {
        if self.shared.waiting.load(Ordering::Relaxed) >= MOST_WAITING {
            return Ok(None);
        }
        let tag = self.next_tag;
        self.next_tag = if tag + 1 == TAGS.end { TAGS.start } else { tag + 1 };
        self.shared.waiting.fetch_add(1, Ordering::Relaxed);
        self.request(Request::Send { of, tag, channel, frame })?;
        Ok(Some(tag))
    }

    fn flush(&mut self) -> Result<(), LiveError> {
        Ok(())
    }

    fn take_ended(&mut self) -> Result<Vec<Transmission>, LiveError> {
        // The thread is handed them with the records.
        Ok(Vec::new())
    }

    fn claim(&self, channel: Channel, slot: u8) -> bool {
        self.shared.claim(channel, slot, Owner::Scripts)
    }

    fn is_of_owner(&self, channel: Channel, tag: u32) -> bool {
        let slot = tag.checked_sub(DEVICE_TAG).and_then(|slot| u8::try_from(slot).ok());
        let owner = |slot: u8| self.shared.slots().get(&(channel.index(), slot)).copied();
        slot.and_then(owner) == Some(Owner::Device)
    }

    fn set_periodic(
        &mut self,
        of: usize,
        channel: Channel,
        slot: u8,
        entry: Option<Periodic>,
    ) -> Result<(), LiveError> {
        self.request(Request::Periodic { of, channel, slot, entry })
    }

    fn set_reply(&mut self, _: Channel, _: u8, _: Option<Trigger>) -> Result<(), LiveError> {
        // Scripts beside others have no replies of the device: see [`super::run::LiveRun::let_device_reply`].
        Ok(())
    }

    fn finish(&mut self, _: Duration) -> Result<(), LiveError> {
        // What is under way then is the owner's to wait for or to take back.
        Ok(())
    }

    fn abort(&mut self, _: Channel) -> Result<(), LiveError> {
        Ok(())
    }
}
