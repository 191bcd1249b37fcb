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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::message::{Checksum, FrameKind};

    fn frame(text: &str) -> Frame {
        text.parse().unwrap()
    }

    #[test]
    fn an_unchanged_frame_is_sent_as_received() {
        for text in
            ["123#", "7FF#1122334455667788", "123#R8", "123#1122334455667788_F", "00000123#11", "1FFFFFFF#R"]
        {
            assert_eq!(
                Pass::unchanged(frame(text).id().is_extended()).changed(&frame(text)),
                Some(frame(text)),
                "{text}"
            );
        }
        let pass = Pass::unchanged(false);
        assert!(pass.modifiers.is_empty() && (pass.period_ticks, pass.delay_ticks) == (0, 0));
    }

    #[test]
    fn bits_are_kept_by_the_and_and_inverted_by_the_xor() {
        let pass = Pass {
            id_and: 0x0F0,
            id_xor: 0x701,
            dlc_and: 0b1110,
            dlc_xor: 0b0001,
            data_and: [0xF0, 0xFF, 0xFF, 0, 0, 0, 0, 0],
            data_xor: [0x05, 0, 0xFF, 0, 0xA5, 0, 0, 0],
            ..Pass::unchanged(false)
        };
        // One byte more than was received: of the eight bytes, those behind the data are zero.
        assert_eq!(pass.changed(&frame("123#123456AB")), Some(frame("721#1534A900A5")));
        assert_eq!(
            Pass { extended: true, ..pass.clone() }.changed(&frame("123#R4")),
            Some(frame("00000721#R5"))
        );
        // A DLC has four bits, whatever the rule says.
        assert_eq!(
            Pass { dlc_xor: 0xF0, ..Pass::unchanged(false) }.changed(&frame("123#11")),
            Some(frame("123#11"))
        );
        assert_eq!(Pass { id_xor: 0x800, ..Pass::unchanged(false) }.changed(&frame("123#")), None);
        assert_eq!(Pass { id_xor: 0x2000_0000, ..Pass::unchanged(true) }.changed(&frame("123#")), None);
    }

    fn rule() -> impl Strategy<Value = GatewayRule> {
        // Few bits that the filter leaves open, so that every identifier can be tried.
        let bits = || (any::<u32>(), 0..32_u32).prop_map(|(bits, narrow)| bits >> narrow);
        let open = (0..30_u32, 0..30_u32, 0..30_u32).prop_map(|(a, b, c)| 1 << a | 1 << b | 1 << c);
        (any::<[bool; 3]>(), bits(), open, bits(), bits()).prop_map(
            |([received, sent, keeps], id, open, id_and, id_xor)| {
                let widest = if received { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
                let filter = Filter {
                    extended: received,
                    kind: FrameKind::Any,
                    id: id & widest,
                    mask: widest & !open,
                };
                let id_and = if keeps { u32::MAX } else { id_and };
                GatewayRule { filter, pass: Some(Pass { id_and, id_xor, ..Pass::unchanged(sent) }) }
            },
        )
    }

    proptest! {
        /// What the device refuses is what could not be sent, and nothing else.
        #[test]
        fn a_rule_is_valid_if_each_frame_that_it_matches_can_be_sent(rule in rule()) {
            let Filter { extended, id, mask, .. } = rule.filter;
            let widest = if extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
            let open = widest & !mask;
            let mut every_frame_can_be_sent = true;
            let mut part = 0;
            loop {
                let raw = id & mask | part;
                let id = if extended { Id::extended(raw) } else { Id::standard(raw) }.unwrap();
                let received = Frame::from_bus(id, false, 0, [0; 8]);
                prop_assert!(rule.filter.matches(&received));
                every_frame_can_be_sent &= rule.pass.as_ref().unwrap().changed(&received).is_some();
                part = part.wrapping_sub(open) & open;
                if part == 0 {
                    break;
                }
            }
            prop_assert_eq!(rule.has_valid_ids(), every_frame_can_be_sent);
        }
    }

    #[test]
    fn a_rule_whose_filter_no_frame_can_match_is_not_valid() {
        for pass in [None, Some(Pass::unchanged(true))] {
            let rule = |id, mask| {
                let filter = Filter { extended: false, kind: FrameKind::Any, id, mask };
                GatewayRule { filter, pass: pass.clone() }.has_valid_ids()
            };
            assert!(rule(0x7FF, 0x7FF) && !rule(0x800, 0x7FF) && !rule(0, 0x800));
        }
    }

    #[test]
    fn changes_stay_inside_eight_bytes_and_four_bits() {
        let valid = |change: &dyn Fn(&mut Pass)| {
            let mut pass = Pass::unchanged(false);
            change(&mut pass);
            let filter = Filter { extended: false, kind: FrameKind::Any, id: 0, mask: 0 };
            GatewayRule { filter, pass: Some(pass) }.has_valid_changes()
        };
        assert!(valid(&|_| ()) && valid(&|pass| (pass.dlc_and, pass.dlc_xor) = (15, 15)));
        assert!(!valid(&|pass| pass.dlc_and = 16) && !valid(&|pass| pass.dlc_xor = 16));
        let modified = |modifier: Modifier| valid(&|pass| pass.modifiers.push(modifier).unwrap());
        assert!(modified(Modifier::Random { byte: 7 }) && !modified(Modifier::Random { byte: 8 }));
        let checksum = |byte| Modifier::Checksum { byte, algorithm: Checksum::Xor };
        assert!(modified(checksum(7)) && !modified(checksum(8)));
        let counter = |byte, low_bit, bits| modified(Modifier::Counter { byte, low_bit, bits });
        assert!(counter(7, 0, 8) && counter(0, 7, 1) && counter(0, 4, 4));
        assert!(
            !counter(8, 0, 8)
                && !counter(0, 8, 1)
                && !counter(0, 4, 5)
                && !counter(0, 0, 0)
                && !counter(0, 0, 9)
        );
    }
}
