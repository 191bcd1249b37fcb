//! What a channel's errors, or its silence, usually mean, and what to do next. Every command takes its hints from here.
//!
//! A hint is a guess from what a controller reports. Only a look at the receive pin's edges can tell a dominant bus from a silent one; see
//! [`BusHint::DominantBus`].

use cantap::wire::record::{BusErrorKind, ErrorState};
use cantap::{TraceEvent, TraceRecord};

/// With this many bus errors or more, a channel that also receives frames is disturbed if the share is high enough, too.
const LEAST_ERRORS: u64 = 10;
/// One error for this many frames: a good bus has less than one in a million.
const FRAMES_PER_ERROR: u64 = 100;

/// What a channel has reported so far, as far as it hints at faults of its bus.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BusEvidence {
    frames: u64,
    /// By the position of the kind in [`BusErrorKind::ALL`].
    errors: [u64; BusErrorKind::ALL.len()],
    /// Errors that were only counted.
    unknown_errors: u64,
    state: Option<ErrorState>,
}

impl BusEvidence {
    /// Takes the channel's next record. Lost frames count as frames: they were on the bus.
    pub fn take(&mut self, event: &TraceEvent) {
        match event {
            TraceEvent::Frame { .. } => self.frames += 1,
            // For the start of a channel whose losses are not counted, nothing was on the bus.
            TraceEvent::Lost { stage: None, count: 0, at_least: true }
            | TraceEvent::TransmitFailed { .. }
            | TraceEvent::Disturbed { .. }
            | TraceEvent::Lin { .. } => {}
            TraceEvent::Lost { count, .. } => self.frames += u64::from(*count).max(1),
            TraceEvent::BusError { kind: Some(kind), .. } => self.errors[index(*kind)] += 1,
            TraceEvent::BusError { kind: None, .. } => self.unknown_errors += 1,
            TraceEvent::ErrorsSuppressed { count } => self.unknown_errors += u64::from(*count),
            TraceEvent::State { state, .. } => self.state = Some(*state),
        }
    }

    /// Takes those of these records that are the channel's, numbered from 1.
    pub fn take_all<'r>(&mut self, channel: u8, records: impl IntoIterator<Item = &'r TraceRecord>) {
        records
            .into_iter()
            .filter(|record| record.channel == channel)
            .for_each(|record| self.take(&record.event));
    }

    /// Frames received, sent, or lost.
    pub const fn frames(&self) -> u64 {
        self.frames
    }

    /// Bus errors of all kinds, including those only counted.
    pub fn errors(&self) -> u64 {
        self.errors.iter().sum::<u64>() + self.unknown_errors
    }

    /// Bus errors of a kind that were reported one by one.
    pub const fn errors_of(&self, kind: BusErrorKind) -> u64 {
        self.errors[index(kind)]
    }

    /// What this usually means; `None` if it is as it should be. Of a channel whose filters keep frames back, only what does not
    /// depend on frames that are absent.
    pub fn hint(&self, is_filtered: bool) -> Option<BusHint> {
        let of = |kind| self.errors_of(kind);
        let errors = self.errors();
        if self.state == Some(ErrorState::BusOff) {
            return Some(BusHint::BusOff);
        }
        let is_most = |count: u64| count * 2 > errors;
        if self.frames == 0 && is_most(of(BusErrorKind::Acknowledgment)) {
            return Some(BusHint::NoAcknowledgment);
        }
        if self.frames == 0 && is_most(of(BusErrorKind::BitDominant)) {
            return Some(BusHint::NotDriven);
        }
        if self.frames == 0 && is_most(of(BusErrorKind::BitRecessive)) {
            return Some(BusHint::DominantBus);
        }
        if is_filtered {
            return None;
        }
        if self.frames == 0 {
            return Some(match errors {
                0 => BusHint::Silent,
                _ if of(BusErrorKind::Form) == errors - self.unknown_errors && of(BusErrorKind::Form) > 0 => {
                    BusHint::LoneSender
                }
                _ => BusHint::WrongBitRate,
            });
        }
        (errors >= LEAST_ERRORS && errors >= self.frames / FRAMES_PER_ERROR).then_some(BusHint::Disturbed)
    }

    /// The errors by kind, as in `stuff 7, form 2`; empty if there are none.
    pub fn errors_text(&self) -> String {
        let kinds = BusErrorKind::ALL.into_iter().map(|kind| (kind.name(), self.errors_of(kind)));
        let all = kinds.chain([("not reported one by one", self.unknown_errors)]);
        let some: Vec<String> =
            all.filter(|(_, count)| *count > 0).map(|(name, count)| format!("{name} {count}")).collect();
        some.join(", ")
    }
}

const fn index(kind: BusErrorKind) -> usize {
    match kind {
        BusErrorKind::Stuff => 0,
        BusErrorKind::Form => 1,
        BusErrorKind::Acknowledgment => 2,
        BusErrorKind::BitRecessive => 3,
        BusErrorKind::BitDominant => 4,
        BusErrorKind::Crc => 5,
    }
}

/// What is probably the matter with a channel's bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum BusHint {
    /// Neither frames nor errors.
    Silent,
    /// Errors and no frame, other than the next one's.
    WrongBitRate,
    /// Only form errors and no frame: frames that nobody acknowledges end so for one who only listens.
    LoneSender,
    /// What this channel sends is not acknowledged.
    NoAcknowledgment,
    /// What this channel sends does not appear on the bus.
    NotDriven,
    /// The bus is dominant while this channel sends recessive bits, or whenever it is looked at.
    DominantBus,
    /// This channel's controller has left the bus after too many errors of its own.
    BusOff,
    /// Frames, and too many errors among them.
    Disturbed,
}

/// Which channel a hint is about.
#[derive(Clone, Copy, Debug)]
pub struct HintPlace<'a> {
    /// The channel's number for the user.
    pub number: u8,
    /// The device's address.
    pub device: &'a str,
    /// The channel's number on that device.
    pub channel_there: u8,
}

impl BusHint {
    /// Its name in JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Silent => "silent",
            Self::WrongBitRate => "wrong-bit-rate",
            Self::LoneSender => "lone-sender",
            Self::NoAcknowledgment => "no-acknowledgment",
            Self::NotDriven => "not-driven",
            Self::DominantBus => "dominant-bus",
            Self::BusOff => "bus-off",
            Self::Disturbed => "disturbed",
        }
    }

    /// In as few words as a status line has room for.
    pub const fn short(self) -> &'static str {
        match self {
            Self::Silent => "SILENT",
            Self::WrongBitRate | Self::LoneSender => "ONLY ERRORS",
            Self::NoAcknowledgment => "NO ACKNOWLEDGMENT",
            Self::NotDriven => "NOT DRIVEN",
            Self::DominantBus => "DOMINANT BUS",
            Self::BusOff => "BUS-OFF",
            Self::Disturbed => "DISTURBED",
        }
    }

    /// What it means, without a full stop.
    pub const fn meaning(self) -> &'static str {
        match self {
            Self::Silent => {
                "neither frames nor errors: nothing is sent on this bus, or the channel is not connected to it"
            }
            Self::WrongBitRate => {
                "only errors and no frame, which usually means a wrong bit rate, otherwise a broken bus"
            }
            Self::LoneSender => {
                "only errors and no frame, all of them form errors, which usually means a lone node that nobody acknowledges, \
                 otherwise a wrong bit rate"
            }
            Self::NoAcknowledgment => {
                "nobody acknowledges what is sent: this node is alone on the bus, the others run at another bit rate, or the \
                 wiring is interrupted"
            }
            Self::NotDriven => {
                "dominant bits that are sent read back recessive: the transceiver does not drive the bus"
            }
            Self::DominantBus => "the bus is dominant while it should be recessive",
            Self::BusOff => "bus-off: the controller has left the bus after too many errors in what it sent",
            Self::Disturbed => "more than one error for a hundred frames: the bus works, but is disturbed",
        }
    }

    /// What to do next, without a full stop.
    pub fn next_step(self, place: &HintPlace<'_>) -> String {
        let HintPlace { device, channel_there, .. } = place;
        match self {
            Self::Silent => "check that the ignition or the machine is on, and CAN_H, CAN_L and ground; a bus at rest needs no \
                             mending; `cantap help wiring` shows where to connect"
                .to_owned(),
            Self::WrongBitRate => format!(
                "`cantap autobaud -d {device} -c {channel_there}` finds the bit rate, if the bus is whole"
            ),
            Self::LoneSender => format!(
                "if this device may take part, open the channel with --mode normal, which acknowledges; otherwise \
                 `cantap autobaud -d {device} -c {channel_there}` finds the bit rate"
            ),
            Self::NoAcknowledgment => "check that another node is on the bus and awake, the bit rate (-b), CAN_H and CAN_L, and \
                                       60 ohms between them with the power off"
                .to_owned(),
            Self::NotDriven => "check the wire from the board's TX to the transceiver's D or TXD, its supply, and that its Rs, S or \
                                STB is low"
                .to_owned(),
            Self::DominantBus => "look for a short circuit between CAN_H and a supply or CAN_L and ground, swapped wires, or a \
                                  transceiver without supply: unplug nodes one by one until the bus is recessive"
                .to_owned(),
            Self::BusOff => "look for a short circuit, swapped wires or a wrong bit rate (-b), then open the channel again or give \
                             --recovery 100ms"
                .to_owned(),
            Self::Disturbed => "measure 60 ohms between CAN_H and CAN_L with the power off (two terminators of 120, one at each \
                                end), check ground and long stubs, and look for a node at another bit rate"
                .to_owned(),
        }
    }

    /// Both in one sentence that begins with the channel.
    pub fn sentence(self, place: &HintPlace<'_>) -> String {
        format!("channel {}: {}; {}", place.number, self.meaning(), self.next_step(place))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap::Direction;

    fn error(kind: BusErrorKind) -> TraceEvent {
        TraceEvent::BusError { kind: Some(kind), counters: None }
    }

    fn frame() -> TraceEvent {
        TraceEvent::Frame { frame: "123#".parse().unwrap(), direction: Direction::Rx, late: false }
    }

    fn evidence(events: impl IntoIterator<Item = TraceEvent>) -> BusEvidence {
        let mut evidence = BusEvidence::default();
        events.into_iter().for_each(|event| evidence.take(&event));
        evidence
    }

    #[test]
    fn each_pattern_of_errors_has_its_hint() {
        use BusErrorKind::{Acknowledgment, BitDominant, BitRecessive, Crc, Form, Stuff};
        let suppressed = TraceEvent::ErrorsSuppressed { count: 900 };
        let unknown = TraceEvent::BusError { kind: None, counters: None };
        let off = TraceEvent::State { state: ErrorState::BusOff, counters: None };
        let back = TraceEvent::State { state: ErrorState::Active, counters: None };
        for (events, hint) in [
            (vec![], BusHint::Silent),
            // That an adapter counts no losses is no sign of traffic.
            (vec![TraceEvent::UNCOUNTED], BusHint::Silent),
            (vec![error(Stuff), error(Form)], BusHint::WrongBitRate),
            (vec![error(Crc)], BusHint::WrongBitRate),
            (vec![unknown], BusHint::WrongBitRate),
            (vec![suppressed], BusHint::WrongBitRate),
            (vec![error(Form), error(Form), suppressed], BusHint::LoneSender),
            (vec![error(Acknowledgment), error(Acknowledgment), error(Form)], BusHint::NoAcknowledgment),
            (vec![error(BitDominant)], BusHint::NotDriven),
            (vec![error(BitRecessive)], BusHint::DominantBus),
            (vec![frame(), error(BitDominant), off], BusHint::BusOff),
            (vec![frame(), suppressed], BusHint::Disturbed),
            (vec![off, back, error(Stuff)], BusHint::WrongBitRate),
        ] {
            assert_eq!(evidence(events.clone()).hint(false), Some(hint), "{events:?}");
        }
    }

    #[test]
    fn a_good_bus_and_one_of_which_filters_keep_frames_back_have_none() {
        let some_errors = std::iter::repeat_n(frame(), 2_000).chain([error(BusErrorKind::Stuff), frame()]);
        assert_eq!(evidence(some_errors).hint(false), None);
        let few = std::iter::repeat_n(error(BusErrorKind::Stuff), 9).chain([frame()]);
        assert_eq!(evidence(few).hint(false), None);
        assert_eq!(evidence([TraceEvent::GAP]).hint(false), None);
        assert_eq!(evidence([]).hint(true), None);
        assert_eq!(evidence([error(BusErrorKind::Stuff)]).hint(true), None);
        let alone = evidence([error(BusErrorKind::Acknowledgment)]);
        assert_eq!(alone.hint(true), Some(BusHint::NoAcknowledgment));
    }

    #[test]
    fn errors_are_listed_by_kind_and_each_hint_has_a_next_step() {
        let seen = evidence([
            error(BusErrorKind::Crc),
            error(BusErrorKind::Stuff),
            TraceEvent::ErrorsSuppressed { count: 4 },
        ]);
        assert_eq!(seen.errors_text(), "stuff 1, crc 1, not reported one by one 4");
        assert_eq!((seen.errors(), evidence([]).errors_text()), (6, String::new()));
        for (position, kind) in BusErrorKind::ALL.into_iter().enumerate() {
            assert_eq!(index(kind), position);
        }
        let place = HintPlace { number: 3, device: "/dev/ttyACM1", channel_there: 1 };
        let sentence = BusHint::WrongBitRate.sentence(&place);
        assert!(
            sentence.starts_with("channel 3: only errors and no frame, which usually means"),
            "{sentence}"
        );
        assert!(sentence.contains("`cantap autobaud -d /dev/ttyACM1 -c 1`"), "{sentence}");
    }
}
