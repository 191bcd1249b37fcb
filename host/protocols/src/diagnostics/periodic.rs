//! Messages that a server sends by itself, again and again, after ReadDataByPeriodicIdentifier: they begin with the low byte of an
//! identifier instead of a service (ISO 14229-1, message type 1), so only the request tells what they are.

use rustc_hash::FxHashMap;

use crate::iso_tp::{Endpoint, Transfer};

/// How many servers are kept.
const MOST_SERVERS: usize = 256;
const STOP: u8 = 4;

/// Which identifiers each server was asked to send.
#[derive(Clone, Debug, Default)]
pub struct Periodic {
    asked: FxHashMap<(u8, Endpoint), Vec<u8>>,
}

impl Periodic {
    /// Takes a request that the server accepted.
    pub fn learn(&mut self, channel: u8, server: Endpoint, request: &[u8]) {
        let [0x2A, mode, identifiers @ ..] = request else { return };
        let key = (channel, server);
        if *mode == STOP {
            if identifiers.is_empty() {
                self.asked.remove(&key);
            } else if let Some(asked) = self.asked.get_mut(&key) {
                asked.retain(|asked| !identifiers.contains(asked));
            }
        } else if self.asked.len() < MOST_SERVERS || self.asked.contains_key(&key) {
            let asked = self.asked.entry(key).or_default();
            asked.extend(identifiers);
            asked.sort_unstable();
            asked.dedup();
        }
    }

    /// The identifier whose data this is, and the data.
    pub fn data<'a>(&self, transfer: &'a Transfer) -> Option<(u16, &'a [u8])> {
        if self.asked.is_empty() {
            return None;
        }
        let asked = self.asked.get(&(transfer.channel, transfer.from))?;
        let (low, data) = transfer.data.split_first()?;
        asked.contains(low).then_some((0xF200 | u16::from(*low), data))
    }
}
