//! How transmissions end, and who asked for them: several users of a session share its channels.

use std::collections::{HashMap, VecDeque};
use std::sync::Mutex;
use std::sync::mpsc::{Receiver, SyncSender};

use cantap::device::Transmission;
use cantap::wire::message::DEVICE_TAG;
use cantap::wire::{CHANNELS, Channel};
use cantap::{Direction, TraceEvent, TraceFrame, TraceRecord};

use super::lock::lock;

/// Who has a frame sent: a number that the Python half gives to each of its Bus objects.
pub type SenderId = u32;

/// No Bus object: the program itself, or another client of a shared board.
pub const NOBODY: SenderId = 0;

/// How many frames may be on their way from the device's confirmation to its record.
const MOST_CONFIRMED: usize = 1 << 16;

/// The transmissions of a device.
pub struct Transmissions {
    ends: Mutex<Receiver<Transmission>>,
    /// Who waits for the end of one, by its tag.
    waiting: Mutex<HashMap<u32, SyncSender<Transmission>>>,
    /// Who requested it, by its tag; for frames that the device sends on its own, until the tag is used again.
    requested: Mutex<HashMap<(Channel, u32), SenderId>>,
    /// Frames that were sent but whose records have not come yet, in order.
    confirmed: Mutex<[VecDeque<(TraceFrame, SenderId)>; CHANNELS]>,
}

impl Transmissions {
    /// Those whose ends come from here.
    pub fn new(ends: Receiver<Transmission>) -> Self {
        let (waiting, requested, confirmed) = (Mutex::default(), Mutex::default(), Mutex::default());
        Self { ends: Mutex::new(ends), waiting, requested, confirmed }
    }

    /// Has the end of a transmission reported to a channel.
    pub fn wait_for(&self, tag: u32, told: SyncSender<Transmission>) {
        lock(&self.waiting).insert(tag, told);
    }

    /// Nobody waits for these any more.
    pub fn forget(&self, tags: &[u32]) {
        let mut waiting = lock(&self.waiting);
        for tag in tags {
            waiting.remove(tag);
        }
    }

    /// Remembers who has the frame with this tag sent.
    pub fn requested(&self, channel: Channel, tag: u32, sender: SenderId) {
        let mut requested = lock(&self.requested);
        if sender == NOBODY {
            requested.remove(&(channel, tag));
        } else {
            requested.insert((channel, tag), sender);
        }
    }

    /// Reports those that have ended to whoever waits for them.
    pub fn report(&self) {
        for end in lock(&self.ends).try_iter() {
            let key = (end.channel, end.tag);
            let mut requested = lock(&self.requested);
            let sender =
                if end.tag < DEVICE_TAG { requested.remove(&key) } else { requested.get(&key).copied() };
            drop(requested);
            if let Ok(frame) = end.result {
                let confirmed = &mut lock(&self.confirmed)[end.channel.index()];
                if confirmed.len() == MOST_CONFIRMED {
                    confirmed.pop_front();
                }
                confirmed.push_back((frame, sender.unwrap_or(NOBODY)));
            }
            if let Some(waiting) = lock(&self.waiting).remove(&end.tag) {
                // It does not matter if nobody waits any more.
                let _ = waiting.try_send(end);
            }
        }
    }

    /// Who had each of these frames sent; empty if none of them was.
    pub fn senders(&self, batch: &[TraceRecord]) -> Vec<SenderId> {
        let mut senders = Vec::new();
        let mut confirmed = lock(&self.confirmed);
        for (at, record) in batch.iter().enumerate() {
            let TraceEvent::Frame { frame, direction: Direction::Tx, .. } = &record.event else { continue };
            let confirmed = confirmed.get_mut(usize::from(record.channel).wrapping_sub(1));
            let Some(confirmed) = confirmed else { continue };
            // In front of it are those whose records were lost on the way.
            let Some(place) = confirmed.iter().position(|(sent, _)| *frame == *sent) else {
                continue;
            };
            let sender = confirmed.drain(..=place).next_back().map_or(NOBODY, |(_, sender)| sender);
            senders.resize(at, NOBODY);
            senders.push(sender);
        }
        senders
    }

    /// There are no more: everyone waiting learns that nothing comes.
    pub fn end(&self) {
        self.report();
        lock(&self.waiting).clear();
    }
}
