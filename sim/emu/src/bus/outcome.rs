//! How a frame on the bus ends: who detects an error at which bit, who flags it, and what all others
//! then see (ISO 11898-1, "error detection" and "error signalling").

use cantap_can::BusErrorKind;

use super::bits::FrameBits;

/// Bits of an error flag.
pub const FLAG: usize = 6;
/// Bits of the error delimiter.
const DELIMITER: usize = 8;

/// A disturbance to inject into a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Disturbance {
    /// The sender reads back the opposite of what it sent at this bit (counted from the start of frame;
    /// at the earliest the first one after arbitration).
    Bit {
        /// Which bit.
        index: usize,
    },
    /// All receivers see six equal bits in the arbitration field.
    Stuff,
    /// All receivers compute another CRC.
    Crc,
    /// All receivers see a dominant CRC delimiter.
    Form,
    /// The acknowledgement does not reach the sender.
    Ack,
}

/// One node's part in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Participant {
    /// Sends the frame.
    pub sender: bool,
    /// Puts a dominant bit into the ACK slot of a good frame.
    pub acknowledges: bool,
    /// Flags errors with dominant bits.
    pub flags: bool,
    /// An error it sees for reasons of its own, such as a wrong bit rate or a collision.
    pub own: Option<(usize, BusErrorKind)>,
}

/// An error as one node sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Detection {
    /// Which participant.
    pub who: usize,
    /// At the end of which bit.
    pub bit: usize,
    /// What it takes the error for.
    pub kind: BusErrorKind,
    /// Whether other nodes' dominant bits followed its own error flag.
    pub first: bool,
}

/// How a frame ends.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameEnd {
    /// Every error, as each node sees it. A receiver that is not among them takes the frame.
    pub detections: Vec<Detection>,
    /// Who acknowledged.
    pub acknowledged_by: Vec<usize>,
    /// Bits from the start of frame after which the bus is recessive for good.
    pub recessive_from: usize,
    /// Bits from the start of frame until the next may begin.
    pub free_after: usize,
}

impl FrameEnd {
    /// Works out how a frame ends for these participants.
    pub fn of(bits: &FrameBits, participants: &[Participant], disturbance: Option<Disturbance>) -> Self {
        let mut seen: Vec<Option<(usize, BusErrorKind)>> = participants.iter().map(|p| p.own).collect();
        let disturbed = |sender: bool| match disturbance? {
            Disturbance::Bit { index } if sender => {
                let index = index.clamp(bits.arbitration_end(), bits.crc_delimiter() - 1);
                let recessive = bits.levels()[index];
                Some((index, if recessive { BusErrorKind::BitRecessive } else { BusErrorKind::BitDominant }))
            }
            Disturbance::Stuff if !sender => Some((bits.arbitration_end() - 1, BusErrorKind::Stuff)),
            Disturbance::Crc if !sender => Some((bits.ack_delimiter(), BusErrorKind::Crc)),
            Disturbance::Form if !sender => Some((bits.crc_delimiter(), BusErrorKind::Form)),
            _ => None,
        };
        for (own, participant) in seen.iter_mut().zip(participants) {
            *own = earliest(*own, disturbed(participant.sender));
        }
        let first_flag = |seen: &[Option<(usize, BusErrorKind)>]| {
            let flagged = seen.iter().zip(participants).filter(|(_, participant)| participant.flags);
            flagged.filter_map(|(seen, _)| Some((*seen)?.0 + 1)).min()
        };
        // A receiver that sees no error before the ACK slot acknowledges, unless an error flag has
        // already begun.
        let early_flag = first_flag(&seen).is_some_and(|flag| flag <= bits.ack_slot());
        let crc_seen = |seen: &Option<(usize, BusErrorKind)>| matches!(seen, Some((_, BusErrorKind::Crc)));
        let acknowledged_by: Vec<usize> = (0..participants.len())
            .filter(|who| {
                participants[*who].acknowledges
                    && !participants[*who].sender
                    && !early_flag
                    && !crc_seen(&seen[*who])
                    && seen[*who].is_none_or(|(bit, _)| bit > bits.ack_slot())
            })
            .collect();
        if acknowledged_by.is_empty() || disturbance == Some(Disturbance::Ack) {
            for (own, _) in seen.iter_mut().zip(participants).filter(|(_, participant)| participant.sender) {
                *own = earliest(*own, Some((bits.ack_slot(), BusErrorKind::Acknowledgment)));
            }
        }
        let aborted = seen
            .iter()
            .zip(participants)
            .filter(|(_, participant)| participant.sender)
            .map(|(seen, _)| seen.map(|(bit, _)| bit + 1))
            .max()
            .flatten();
        if let Some(aborted) = aborted
            && aborted <= bits.crc_delimiter()
        {
            // The sender falls silent: even without a dominant flag, six recessive bits violate the
            // stuffing rule.
            for (own, _) in seen.iter_mut().zip(participants).filter(|(_, participant)| !participant.sender) {
                *own = earliest(*own, Some((aborted + FLAG - 1, BusErrorKind::Stuff)));
            }
        }
        if let Some(flag) = first_flag(&seen) {
            for (own, participant) in seen.iter_mut().zip(participants) {
                *own = earliest(*own, answer(bits, flag, participant.sender));
            }
        }
        let dominant_end = seen
            .iter()
            .zip(participants)
            .filter(|(_, participant)| participant.flags)
            .filter_map(|(seen, _)| Some((*seen)?.0 + 1 + FLAG))
            .max();
        let detections: Vec<Detection> = seen
            .iter()
            .enumerate()
            .filter_map(|(who, seen)| {
                let (bit, kind) = (*seen)?;
                let first = dominant_end.is_some_and(|end| bit + 1 + FLAG < end);
                Some(Detection { who, bit, kind, first })
            })
            .collect();
        let (recessive_from, free_after) = match (dominant_end, aborted) {
            (Some(end), _) => (end, end + DELIMITER + super::bits::INTERMISSION),
            (None, Some(aborted)) => (aborted, aborted + FLAG + DELIMITER + super::bits::INTERMISSION),
            (None, None) => (bits.ack_delimiter(), bits.len() + super::bits::INTERMISSION),
        };
        Self { detections, acknowledged_by, recessive_from, free_after }
    }

    /// The error that participant `who` saw, if any.
    pub fn of_participant(&self, who: usize) -> Option<&Detection> {
        self.detections.iter().find(|detection| detection.who == who)
    }
}

/// How a node that has not seen an error yet interprets a dominant flag that begins at bit `flag`.
fn answer(bits: &FrameBits, flag: usize, sender: bool) -> Option<(usize, BusErrorKind)> {
    let last = bits.len() - 1;
    if flag >= bits.crc_delimiter() {
        let bit = if flag == bits.ack_slot() { flag + 1 } else { flag };
        // To a receiver, a dominant last bit is an overload request, not an error.
        let harmless = bit > last || bit == last && !sender;
        return (!harmless).then_some((bit, BusErrorKind::Form));
    }
    if sender {
        let recessive = (flag..flag + FLAG).find(|bit| bits.levels().get(*bit) == Some(&true))?;
        let kind =
            if recessive < bits.crc_delimiter() { BusErrorKind::BitRecessive } else { BusErrorKind::Form };
        return Some((recessive, kind));
    }
    let before = bits.levels()[..flag].iter().rev().take_while(|recessive| !**recessive).count();
    Some((flag + 5 - before.min(5), BusErrorKind::Stuff))
}

fn earliest(
    one: Option<(usize, BusErrorKind)>,
    other: Option<(usize, BusErrorKind)>,
) -> Option<(usize, BusErrorKind)> {
    match (one, other) {
        (Some(one), Some(other)) => Some(if other.0 < one.0 { other } else { one }),
        (one, other) => one.or(other),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SENDER: Participant = Participant { sender: true, acknowledges: true, flags: true, own: None };
    const RECEIVER: Participant = Participant { sender: false, acknowledges: true, flags: true, own: None };
    const LISTENER: Participant = Participant { sender: false, acknowledges: false, flags: false, own: None };

    fn bits() -> FrameBits {
        FrameBits::new(&"123#1122".parse().unwrap())
    }

    fn kinds(outcome: &FrameEnd) -> Vec<(usize, BusErrorKind)> {
        outcome.detections.iter().map(|detection| (detection.who, detection.kind)).collect()
    }

    #[test]
    fn a_good_frame_has_no_error_and_three_bits_of_intermission() {
        let outcome = FrameEnd::of(&bits(), &[SENDER, RECEIVER, LISTENER], None);
        assert_eq!(outcome.detections, []);
        assert_eq!(outcome.acknowledged_by, [1]);
        assert_eq!(outcome.free_after, bits().len() + 3);
    }

    /// A listen-only node and a lone sender: the sender flags the missing acknowledgement, which the
    /// listener sees as a form error.
    #[test]
    fn nobody_acknowledges_for_a_listener() {
        let outcome = FrameEnd::of(&bits(), &[SENDER, LISTENER], None);
        assert_eq!(kinds(&outcome), [(0, BusErrorKind::Acknowledgment), (1, BusErrorKind::Form)]);
        assert_eq!(outcome.free_after, bits().ack_slot() + 1 + 6 + 8 + 3);
    }

    /// An error-passive sender flags recessively: the listener takes the frame.
    #[test]
    fn a_passive_lone_sender_is_heard_by_a_listener() {
        let passive = Participant { flags: false, ..SENDER };
        let outcome = FrameEnd::of(&bits(), &[passive, LISTENER], None);
        assert_eq!(kinds(&outcome), [(0, BusErrorKind::Acknowledgment)]);
    }

    #[test]
    fn an_error_that_only_a_listener_sees_harms_nobody() {
        let confused = Participant { own: Some((20, BusErrorKind::Stuff)), ..LISTENER };
        let outcome = FrameEnd::of(&bits(), &[SENDER, RECEIVER, confused], None);
        assert_eq!(kinds(&outcome), [(2, BusErrorKind::Stuff)]);
        assert_eq!(outcome.free_after, bits().len() + 3);
    }

    #[test]
    fn an_error_that_a_receiver_sees_destroys_the_frame_for_all() {
        let confused = Participant { own: Some((20, BusErrorKind::Stuff)), ..RECEIVER };
        let outcome = FrameEnd::of(&bits(), &[SENDER, RECEIVER, confused], None);
        assert_eq!(outcome.detections.len(), 3);
        assert!(outcome.detections[2].first && !outcome.detections[1].first);
        assert_eq!(outcome.acknowledged_by, [] as [usize; 0]);
    }

    #[test]
    fn each_disturbance_is_seen_for_what_it_is() {
        use BusErrorKind::{Acknowledgment, Crc, Form, Stuff};
        for (disturbance, sender, receiver) in [
            (Disturbance::Stuff, BusErrorKind::BitRecessive, Stuff),
            (Disturbance::Crc, Acknowledgment, Form),
            (Disturbance::Form, Acknowledgment, Form),
            (Disturbance::Ack, Acknowledgment, Form),
        ] {
            let outcome = FrameEnd::of(&bits(), &[SENDER, RECEIVER], Some(disturbance));
            assert_eq!(kinds(&outcome)[0].1, sender, "{disturbance:?}");
            if disturbance == Disturbance::Crc {
                // The sender's flag for the missing ACK hides the CRC error from the only receiver.
                assert_eq!(outcome.detections[1].bit, bits().ack_delimiter());
                assert_eq!(outcome.detections[1].kind, Crc);
            } else {
                assert_eq!(kinds(&outcome)[1].1, receiver, "{disturbance:?}");
            }
        }
    }

    #[test]
    fn a_bit_error_is_seen_by_the_sender_first() {
        let outcome = FrameEnd::of(&bits(), &[SENDER, RECEIVER], Some(Disturbance::Bit { index: 30 }));
        assert_eq!(outcome.detections[0].bit, 30);
        let expected =
            if bits().levels()[30] { BusErrorKind::BitRecessive } else { BusErrorKind::BitDominant };
        assert_eq!(outcome.detections[0].kind, expected);
        assert_eq!(outcome.detections[1].kind, BusErrorKind::Stuff);
        assert!(outcome.detections[1].bit > 30 && outcome.detections[0].first);
    }
}
