//! The fate of a frame, bit by bit, on a bus that something other than its nodes drives dominant, or from which a controller's pin has been
//! taken away. Nothing is concluded from the frame as a whole: each member puts its bit on the bus, samples the level, and goes on from there.
//!
//! Members stay in step: an edge from outside moves nobody's bit boundaries, except that one on an idle bus is a start of frame. Not modelled:
//! a level between an error's end and the next frame (overload frames).

use cantap_can::BusErrorKind;

use super::bits::{FrameBits, INTERMISSION};
use super::outcome::{Detection, FLAG, Participant};
use super::sampling::Parser;

/// Recessive bits that end an error.
const DELIMITER: usize = 8;
/// After so many bits a level that does not end is no longer part of a frame.
pub(super) const LONGEST: usize = 240;

/// What reaches the bus from outside the controllers and nodes.
#[derive(Debug, Default)]
pub(super) struct Outside {
    /// Since when the bus is driven dominant.
    since: Option<u64>,
    /// When it was before, since the start of the frame under way.
    levels: Vec<(u64, u64)>,
    /// Since when a controller's pin is not connected to it: by controller.
    cut: [Option<u64>; 2],
    /// When it was not before, since the start of the frame under way.
    cuts: Vec<(usize, u64, u64)>,
}

impl Outside {
    /// Whether there is anything to consider.
    pub(super) fn is_active(&self) -> bool {
        self.since.is_some() || self.cut != [None; 2] || !self.levels.is_empty() || !self.cuts.is_empty()
    }

    pub(super) fn is_dominant(&self) -> bool {
        self.since.is_some()
    }

    /// Notes a level from cycle `at` on; returns whether it is another one.
    pub(super) fn drive(&mut self, dominant: bool, at: u64) -> bool {
        match (self.since, dominant) {
            (None, true) => self.since = Some(at),
            (Some(since), false) => {
                self.levels.push((since, at));
                self.since = None;
            }
            _ => return false,
        }
        true
    }

    /// Notes from cycle `at` on whether a controller is off its pin; returns whether that is new.
    pub(super) fn cut(&mut self, controller: usize, cut: bool, at: u64) -> bool {
        match (self.cut[controller], cut) {
            (None, true) => self.cut[controller] = Some(at),
            (Some(since), false) => {
                self.cuts.push((controller, since, at));
                self.cut[controller] = None;
            }
            _ => return false,
        }
        true
    }

    /// The frame under way has ended: what is over no longer matters.
    pub(super) fn forget_past(&mut self) {
        self.levels.clear();
        self.cuts.clear();
    }

    pub(super) fn level_at(&self, cycle: u64) -> bool {
        self.since.is_some_and(|since| cycle >= since)
            || self.levels.iter().any(|(from, to)| (*from..*to).contains(&cycle))
    }

    pub(super) fn cuts_at(&self, controller: usize, cycle: u64) -> bool {
        self.cut[controller].is_some_and(|since| cycle >= since)
            || self.cuts.iter().any(|(who, from, to)| *who == controller && (*from..*to).contains(&cycle))
    }

    /// When the bus was or is driven dominant; the end of a level that goes on is unknown.
    pub(super) fn levels(&self) -> impl Iterator<Item = (u64, Option<u64>)> + use<'_> {
        let over = self.levels.iter().map(|(from, to)| (*from, Some(*to)));
        over.chain(self.since.map(|since| (since, None)))
    }
}

/// How a frame ends, as [`super::outcome::FrameEnd`] says it for an undisturbed one.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Fate {
    /// Every error, and whether the member was sending then.
    pub(super) errors: Vec<(Detection, bool)>,
    /// Senders that lost arbitration to the level, and the bit at which each did.
    pub(super) lost: Vec<(usize, usize)>,
    /// Receivers that took the frame.
    pub(super) takers: Vec<usize>,
    /// Whether a sender got it through.
    pub(super) sent: bool,
    /// Whether the members make each bit dominant.
    pub(super) levels: Vec<bool>,
    /// Dominant bits that each member puts on the bus.
    pub(super) driven: Vec<u64>,
    /// Bits from the start after which the bus is recessive for good, and after which the next frame may begin.
    pub(super) recessive_from: usize,
    /// See above.
    pub(super) free_after: usize,
}

enum State {
    Sending,
    Receiving(Parser),
    Flag {
        left: usize,
    },
    /// After its flag; the error's index, until it is known whether others' dominant bits follow.
    Waiting {
        recessive: usize,
        error: Option<usize>,
    },
    Over,
}

/// Works out the fate of a frame. `bits` are absent if nobody sends: the level itself began the frame. `outside` and `is_cut` say, for each
/// bit where it is sampled, whether the level is driven, and whether a participant's pin is disconnected.
pub(super) fn fate(
    bits: Option<&FrameBits>,
    participants: &[Participant],
    outside: impl Fn(usize) -> bool,
    is_cut: impl Fn(usize, usize) -> bool,
) -> Fate {
    let mut fate = Fate { driven: vec![0; participants.len()], ..Fate::default() };
    let mut states: Vec<State> = participants
        .iter()
        .map(|one| if one.sender { State::Sending } else { State::Receiving(Parser::default()) })
        .collect();
    let level = |n: usize| bits.and_then(|bits| bits.levels().get(n).copied()).unwrap_or(true);
    for n in 0..LONGEST {
        let mut dominant = false;
        for (who, (state, one)) in states.iter().zip(participants).enumerate() {
            let drives = match state {
                State::Sending => !level(n),
                State::Receiving(parser) => {
                    let has_bad_sum = matches!(one.own, Some((_, BusErrorKind::Crc)));
                    parser.is_to_acknowledge() && one.acknowledges && !has_bad_sum
                }
                State::Flag { .. } => one.flags,
                State::Waiting { .. } | State::Over => false,
            };
            if drives && !is_cut(who, n) {
                dominant = true;
                fate.driven[who] += 1;
            }
        }
        fate.levels.push(dominant);
        dominant |= outside(n);
        if dominant {
            fate.recessive_from = n + 1;
        }
        for (who, (state, one)) in states.iter_mut().zip(participants).enumerate() {
            let forced = one.own.filter(|(at, _)| *at == n).map(|(_, kind)| kind);
            let mut sends = false;
            let error = match state {
                State::Sending => {
                    sends = true;
                    let bits = bits.expect("who sends has a frame");
                    match forced.or_else(|| sender_error(bits, n, dominant)) {
                        None if n < bits.arbitration_end() && level(n) && dominant && !bits.is_stuff(n) => {
                            let mut parser = Parser::default();
                            for bit in 0..n {
                                parser.take(level(bit));
                            }
                            parser.take(false);
                            fate.lost.push((who, n));
                            *state = State::Receiving(parser);
                            None
                        }
                        None if n + 1 == bits.len() => {
                            fate.sent = true;
                            *state = State::Over;
                            None
                        }
                        error => error,
                    }
                }
                State::Receiving(parser) => match parser.take(!dominant) {
                    _ if forced.is_some() => forced,
                    Some(Err(kind)) => Some(kind),
                    Some(Ok(())) => {
                        fate.takers.push(who);
                        // The last bit of the end of frame still belongs to it.
                        *state = State::Waiting { recessive: DELIMITER - 1, error: None };
                        continue;
                    }
                    None => None,
                },
                State::Flag { left } => {
                    *left -= 1;
                    if *left == 0 {
                        let error = fate.errors.iter().position(|(seen, _)| seen.who == who);
                        *state = State::Waiting { recessive: 0, error };
                    }
                    None
                }
                State::Waiting { recessive, error } => {
                    if let Some(error) = error.take() {
                        fate.errors[error].0.first = dominant;
                    }
                    *recessive = if dominant { 0 } else { *recessive + 1 };
                    if *recessive >= DELIMITER {
                        *state = State::Over;
                    }
                    None
                }
                State::Over => None,
            };
            if let Some(kind) = error {
                fate.errors.push((Detection { who, bit: n, kind, first: false }, sends));
                *state = State::Flag { left: FLAG };
            }
        }
        if states.iter().all(|state| matches!(state, State::Over)) {
            break;
        }
    }
    let flagged = fate.errors.iter().any(|(error, _)| participants[error.who].flags);
    let over = match bits {
        Some(bits) if fate.sent => bits.len(),
        // Who flags without a dominant bit may be behind, and waits on its own.
        _ if flagged => fate.recessive_from + DELIMITER,
        _ => fate.levels.len(),
    };
    fate.free_after = over + INTERMISSION;
    fate
}

/// The error that a sender finds at bit `n`; a recessive bit of the arbitration field that becomes dominant is none.
fn sender_error(bits: &FrameBits, n: usize, dominant: bool) -> Option<BusErrorKind> {
    match (bits.levels()[n], dominant) {
        (true, false) if n == bits.ack_slot() => Some(BusErrorKind::Acknowledgment),
        (true, true) if n == bits.ack_slot() => None,
        (true, true) if n < bits.arbitration_end() && !bits.is_stuff(n) => None,
        (true, true) if n >= bits.crc_delimiter() => Some(BusErrorKind::Form),
        (true, true) => Some(BusErrorKind::BitRecessive),
        (false, false) => Some(BusErrorKind::BitDominant),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::outcome::FrameEnd;

    const SENDER: Participant = Participant { sender: true, acknowledges: true, flags: true, own: None };
    const RECEIVER: Participant = Participant { sender: false, ..SENDER };
    const LISTENER: Participant = Participant { acknowledges: false, flags: false, ..RECEIVER };
    const PASSIVE: Participant = Participant { flags: false, ..RECEIVER };

    fn untouched(bits: &FrameBits, participants: &[Participant]) -> Fate {
        fate(Some(bits), participants, |_| false, |_, _| false)
    }

    fn pulse(bits: &FrameBits, participants: &[Participant], from: usize, length: usize) -> Fate {
        fate(Some(bits), participants, |n| (from..from + length).contains(&n), |_, _| false)
    }

    fn seen(fate: &Fate) -> Vec<(usize, usize, BusErrorKind)> {
        let mut seen: Vec<_> = fate.errors.iter().map(|(one, _)| (one.who, one.bit, one.kind)).collect();
        seen.sort_by_key(|(who, ..)| *who);
        seen
    }

    /// Two models of one bus, written apart: where nothing is driven they must agree, errors of single members included. Not those whose flag begins in
    /// the arbitration field, where this model has the sender lose, or in the ACK slot, where it takes the flag for an acknowledgement: the other one is simpler there.
    #[test]
    fn without_a_level_from_outside_it_says_what_the_other_model_says() {
        use BusErrorKind::{Crc, Stuff};
        let texts = ["123#1122", "000#55", "7FF#FFFFFFFFFFFFFFFF", "1ABCDEF0#00", "555#R3"];
        for bits in texts.map(|text| FrameBits::new(&text.parse().unwrap())) {
            let own = [None, Some((bits.arbitration_end() + 2, Stuff)), Some((bits.ack_delimiter(), Crc))];
            for own in own {
                let confused = Participant { own, ..RECEIVER };
                for others in [&[confused][..], &[LISTENER, confused], &[confused, PASSIVE, RECEIVER]] {
                    let participants = [&[SENDER], others].concat();
                    let expected = FrameEnd::of(&bits, &participants, None);
                    let found = untouched(&bits, &participants);
                    let mut errors: Vec<_> = found.errors.iter().map(|(one, _)| *one).collect();
                    errors.sort_by_key(|one| one.who);
                    assert_eq!(errors, expected.detections, "{own:?} {participants:?}");
                    assert_eq!(found.free_after, expected.free_after, "{own:?} {participants:?}");
                    assert_eq!(found.sent, expected.detections.is_empty());
                }
            }
        }
    }

    #[test]
    fn a_level_over_a_recessive_bit_is_the_sender_s_bit_error_and_the_receivers_answer() {
        let bits = FrameBits::new(&"123#1122".parse().unwrap());
        let at = (20..bits.len()).find(|n| bits.levels()[*n]).unwrap();
        let fate = pulse(&bits, &[SENDER, RECEIVER], at, 1);
        let found = seen(&fate);
        assert_eq!(found[0], (0, at, BusErrorKind::BitRecessive));
        assert_eq!(found[1].2, BusErrorKind::Stuff);
        assert!((at + 1..=at + 6).contains(&found[1].1), "{found:?}");
        assert!(!fate.sent && fate.takers.is_empty());
        // Two flags, one behind the other at most; eight recessive bits; the intermission.
        assert!((at + 1 + 6 + 11..=at + 1 + 12 + 11).contains(&fate.free_after));
    }

    #[test]
    fn a_level_over_dominant_bits_only_does_nothing() {
        let bits = FrameBits::new(&"000#0000".parse().unwrap());
        let at = (20..bits.len()).find(|n| !bits.levels()[*n]).unwrap();
        assert_eq!(pulse(&bits, &[SENDER, RECEIVER], at, 1), untouched(&bits, &[SENDER, RECEIVER]));
    }

    /// Six equal bits anywhere before the CRC delimiter violate the stuffing rule.
    #[test]
    fn six_bits_destroy_a_frame_wherever_they_begin() {
        for bits in
            ["123#1122", "000#0000000000000000", "7FF#"].map(|text| FrameBits::new(&text.parse().unwrap()))
        {
            for at in 1..bits.len() - 2 {
                let fate = pulse(&bits, &[SENDER, RECEIVER, LISTENER], at, 6);
                assert!(!fate.sent && !fate.takers.contains(&1), "bit {at}: {fate:?}");
                assert_eq!(fate.errors.iter().filter(|(one, _)| one.who == 1).count(), 1, "bit {at}");
            }
        }
    }

    #[test]
    fn a_sender_overwritten_in_its_identifier_loses_arbitration_and_counts_as_a_receiver() {
        let bits = FrameBits::new(&"7F0#".parse().unwrap());
        let fate = pulse(&bits, &[SENDER, RECEIVER], 2, 1);
        assert_eq!(fate.lost, [(0, 2)]);
        assert_eq!(
            fate.errors.iter().map(|(one, sends)| (one.kind, *sends)).collect::<Vec<_>>(),
            [(BusErrorKind::Stuff, false), (BusErrorKind::Stuff, false)]
        );
        assert!(!fate.sent);
    }

    /// One dominant bit on an idle bus is a start of frame; six recessive ones follow it.
    #[test]
    fn a_glitch_on_an_idle_bus_is_an_error_of_all_that_listen() {
        let fate = fate(None, &[RECEIVER, PASSIVE, LISTENER], |n| n == 0, |_, _| false);
        assert_eq!(
            seen(&fate),
            [(0, 6, BusErrorKind::Stuff), (1, 6, BusErrorKind::Stuff), (2, 6, BusErrorKind::Stuff)]
        );
        assert_eq!((fate.recessive_from, fate.free_after), (13, 13 + 8 + 3));
    }

    #[test]
    fn a_sender_whose_pin_is_taken_away_finds_a_recessive_bus() {
        let bits = FrameBits::new(&"123#1122".parse().unwrap());
        let at = (25..bits.len()).find(|n| !bits.levels()[*n]).unwrap();
        let cut = |who, n| who == 0 && n >= at;
        let fate = fate(Some(&bits), &[SENDER, RECEIVER], |_| false, cut);
        assert_eq!(seen(&fate)[0], (0, at, BusErrorKind::BitDominant));
    }
}
