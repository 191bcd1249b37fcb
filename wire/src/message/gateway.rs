//! The device as a gateway between its two channels' buses.

use heapless::Vec;
use serde::{Deserialize, Serialize};

use super::{Filter, Modifier};
use crate::{Channel, Frame, Id};

/// Most rules of a gateway in one direction.
pub const MAX_GATEWAY_RULES: usize = 32;
/// Most modifiers of one rule: a counter and a checksum.
pub const MAX_RULE_MODIFIERS: usize = 2;
/// Most rules whose counts are in one [`GatewayStatus`].
pub const MAX_RULE_COUNTS: usize = 16;
/// Tags of frames that a gateway has sent: this, and the slot of the rule that let it pass.
pub const GATEWAY_TAG: u32 = 0xFFFF_C000;

/// What becomes of the frames that one channel receives. Of the rules of a direction, the first that matches decides; a frame that none
/// matches is not passed on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GatewayRule {
    /// The frames that it matches.
    pub filter: Filter,
    /// How they are sent on the other channel; `None` drops them.
    pub pass: Option<Pass>,
}

/// How a frame is sent on the other channel. Every change of bits, SET, AND, OR and XOR in any order, is `value & and ^ xor`.
///
/// The data are changed as eight bytes, of which those after the received ones are zero. Those after the sent ones are left out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pass {
    /// Sends a 29-bit identifier rather than an 11-bit one.
    pub extended: bool,
    /// The bits of the received identifier that are kept.
    pub id_and: u32,
    /// The bits of it that are then inverted. An 11-bit identifier's upper bits must come out as zero for every frame.
    pub id_xor: u32,
    /// The same for the DLC: 4 bits.
    pub dlc_and: u8,
    /// See [`Self::dlc_and`].
    pub dlc_xor: u8,
    /// The same for the data.
    pub data_and: [u8; 8],
    /// See [`Self::data_and`].
    pub data_xor: [u8; 8],
    /// Applied in this order after the other changes. A counter adds the number of frames that the rule has passed on so far to
    /// the value found: clear its bits before, and it counts from zero. What is outside the frame's data is left alone.
    pub modifiers: Vec<Modifier, MAX_RULE_MODIFIERS>,
    /// At most one frame in so many ticks, or 0: one that comes too early waits, and a newer one takes its place.
    pub period_ticks: u32,
    /// Ticks that a frame waits before it is sent.
    pub delay_ticks: u32,
}

impl Pass {
    /// As received: the same frame, at once.
    pub const fn unchanged(extended: bool) -> Self {
        Self {
            extended,
            id_and: u32::MAX,
            id_xor: 0,
            dlc_and: 15,
            dlc_xor: 0,
            data_and: [0xFF; 8],
            data_xor: [0; 8],
            modifiers: Vec::new(),
            period_ticks: 0,
            delay_ticks: 0,
        }
    }

    /// The frame as it is sent, before [`Self::modifiers`]; `None` if its identifier would have too many bits, which
    /// [`GatewayRule::has_valid_ids`] excludes.
    pub fn changed(&self, frame: &Frame) -> Option<Frame> {
        let raw = frame.id().raw() & self.id_and ^ self.id_xor;
        let id = if self.extended { Id::extended(raw) } else { Id::standard(raw) }?;
        // As one number: eight bytes one by one take a device a microsecond.
        let [data, and, xor] = [frame.padded_data(), self.data_and, self.data_xor].map(u64::from_ne_bytes);
        let data = (data & and ^ xor).to_ne_bytes();
        let dlc = (frame.dlc() & self.dlc_and ^ self.dlc_xor) & 15;
        Some(Frame::from_bus(id, frame.is_remote(), dlc, data))
    }
}

impl GatewayRule {
    /// Whether the filter's identifier and mask, and every identifier that it can send, have no more bits than such identifiers.
    pub const fn has_valid_ids(&self) -> bool {
        let Some(pass) = &self.pass else { return self.filter.is_valid() };
        let received = if self.filter.extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
        // Of the bits kept, those that the filter fixes are known; the others can be anything.
        let free = received & !self.filter.mask & pass.id_and;
        let fixed = self.filter.id & self.filter.mask & pass.id_and ^ pass.id_xor;
        let widest = if pass.extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
        self.filter.is_valid() && (free | fixed) & !widest == 0
    }

    /// Whether every modifier is inside a frame of eight bytes, and the DLC's changes are of 4 bits.
    pub fn has_valid_changes(&self) -> bool {
        self.pass.as_ref().is_none_or(|pass| {
            pass.dlc_and <= 15 && pass.dlc_xor <= 15 && pass.modifiers.iter().all(|modifier| modifier.fits(8))
        })
    }
}

/// What a gateway does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum GatewayState {
    /// It has not been started, or it was stopped on request.
    Off,
    /// It passes frames on.
    Running,
    /// It has ended on its own.
    Ended(GatewayEnd),
}

/// Why a gateway has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum GatewayEnd {
    /// Each frame that one channel sent was received by the other at the same moment: both are on one bus.
    Loop,
    /// A channel was closed.
    ChannelClosed,
}

/// One direction of a gateway. Counters run from its start and wrap.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GatewayStatus {
    /// What the gateway does.
    pub state: GatewayState,
    /// Whether the device started it on its own, from what [`super::Command::SaveGateway`] stored: it goes on without a host.
    pub standalone: bool,
    /// The channel whose frames these rules are for.
    pub from: Channel,
    /// Frames received that no rule matched.
    pub unmatched: u32,
    /// Frames that wait: for the bus, for their delay, or for their period.
    pub waiting: u16,
    /// Rules in all.
    pub rules: u8,
    /// The slot of the first of [`Self::counts`].
    pub first: u8,
    /// The counts of this rule and those after it, [`MAX_RULE_COUNTS`] at most.
    pub counts: Vec<RuleCounts, MAX_RULE_COUNTS>,
}

/// What became of the frames that a rule matched: `matched = sent + overtaken + lost + failed`, apart from those that wait. A rule that
/// drops frames has only the first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct RuleCounts {
    /// Frames that it matched.
    pub matched: u32,
    /// Sent: [`crate::Event::Transmitted`] confirms each.
    pub sent: u32,
    /// Replaced by a newer one within [`Pass::period_ticks`].
    pub overtaken: u32,
    /// Lost, because more came than the other bus took ([`crate::record::LossStage::Gateway`]), or the gateway ended.
    pub lost: u32,
    /// Given up by the controller or with the channel: [`crate::Event::TransmitFailed`] says why.
    pub failed: u32,
}
