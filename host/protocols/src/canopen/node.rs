//! What is known of a node, and of a bus.

use rustc_hash::FxHashMap;

use super::drive::DriveView;
use super::lss::Lss;
use super::pdo::Pdos;
use super::safety::Safety;
use super::sdo::{Sdo, SdoTransfer};
use super::sdo_channels::SdoChannels;
use super::types::number_of;

/// Servers beyond the first that are kept of a node.
const MOST_SERVERS: usize = 127;

#[derive(Default)]
pub struct Node {
    pub state: Option<u8>,
    /// The last heartbeat, and its period: measured, or as configured.
    pub beat_ns: Option<i64>,
    pub period_ns: Option<i64>,
    pub is_period_set: bool,
    pub is_missing: bool,
    /// The shortest time for which others wait for its heartbeat, as configured in their object 1016.
    pub consumer_ns: Option<i64>,
    /// Objects 100C and 100D as configured: guard time in milliseconds, and life time factor.
    pub life: (i64, i64),
    /// When it was last guarded; `None` once that has stopped for longer than its life time.
    pub guarded_ns: Option<i64>,
    /// A guarding request that waits for its answer.
    pub guard_ns: Option<i64>,
    pub toggle: Option<bool>,
    pub sdo: Sdo,
    /// Those beyond the first, by the identifier of their requests.
    further: Vec<(u16, Sdo)>,
    pub pdos: Pdos,
    pub drive: DriveView,
    pub frames_lost: bool,
}

impl Node {
    /// The server of a channel: the first, or the one that has this identifier for requests.
    pub fn sdo_of(&mut self, request: Option<u16>) -> &mut Sdo {
        let Some(request) = request else { return &mut self.sdo };
        let place = self.further.iter().position(|(known, _)| *known == request).unwrap_or_else(|| {
            // A node has 128 servers; more are those whose identifiers were set anew.
            if self.further.len() >= MOST_SERVERS {
                self.further.remove(0);
            }
            self.further.push((request, Sdo::default()));
            self.further.len() - 1
        });
        &mut self.further[place].1
    }

    /// All its servers; those beyond the first with the identifier of their requests.
    pub fn sdos(&mut self) -> impl Iterator<Item = (Option<u16>, &mut Sdo)> {
        let further = self.further.iter_mut().map(|(request, sdo)| (Some(*request), sdo));
        std::iter::once((None, &mut self.sdo)).chain(further)
    }

    /// The transfers that its servers have under way.
    pub fn open_transfers(&self) -> impl Iterator<Item = &SdoTransfer> {
        self.sdo.open.iter().chain(self.further.iter().filter_map(|(_, sdo)| sdo.open.as_ref()))
    }

    /// Takes timeouts from an SDO transfer that wrote them; returns those of another node, with its number and in nanoseconds.
    pub fn learn_timeouts(&mut self, transfer: &SdoTransfer) -> Option<(u8, i64)> {
        if transfer.trouble.is_some() || !transfer.is_write {
            return None;
        }
        let value = i64::from(number_of(&transfer.data));
        match (transfer.index, transfer.sub) {
            (0x100C, 0) => self.life.0 = value & 0xFFFF,
            (0x100D, 0) => self.life.1 = value & 0xFF,
            (0x1016, 1..) => {
                let (node, ms) = ((value >> 16 & 0xFF) as u8, value & 0xFFFF);
                return ((1..128).contains(&node) && ms > 0).then_some((node, ms * 1_000_000));
            }
            _ => {}
        }
        None
    }
}

#[derive(Default)]
pub struct Bus {
    pub nodes: FxHashMap<u8, Node>,
    /// Which node's PDO an identifier is, if it is not the predefined one.
    pub pdo_ids: FxHashMap<u16, (u8, u16)>,
    /// SDO channels beyond the first of each node.
    pub channels: SdoChannels,
    pub lss: Lss,
    pub safety: Safety,
    pub sync_ns: Option<i64>,
    pub sync_counter: Option<u8>,
}
