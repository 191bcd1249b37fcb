//! Error frames as Linux's SocketCAN defines them (`linux/can/error.h`): the form in which everything that is
//! not a frame appears in candump logs, pcapng and python-can's CSV.
//!
//! A frame with bit 29 set in its ID has error classes in the low bits and details in eight data bytes.
//! Information without a place in SocketCAN (how many frames were lost, and where) goes into bytes that the
//! classes in use leave free, so other programs see an ordinary error frame of the right class.

use cantap_can::{BusErrorKind, DEVICE_TAG, ErrorState, LossStage, TransmitFailure};

use crate::TraceEvent;

/// The flag in an ID that marks an error frame.
pub const ERROR_FLAG: u32 = 0x2000_0000;

const TX_TIMEOUT: u32 = 0x001;
const LOST_ARBITRATION: u32 = 0x002;
const CONTROLLER: u32 = 0x004;
const PROTOCOL: u32 = 0x008;
const NO_ACK: u32 = 0x020;
/// The class for a controller that went bus-off.
pub const BUS_OFF: u32 = 0x040;
/// The class by which python-can recognises an error frame.
pub const BUS_ERROR: u32 = 0x080;
const RESTARTED: u32 = 0x100;
const COUNTERS: u32 = 0x200;

// Details of CONTROLLER, data[1].
const RX_OVERFLOW: u8 = 0x01;
const TX_OVERFLOW: u8 = 0x02;
const WARNING: u8 = 0x04 | 0x08;
const PASSIVE: u8 = 0x10 | 0x20;
const ACTIVE: u8 = 0x40;

// Details of PROTOCOL, data[2] and data[3].
const SINGLE_BIT: u8 = 0x01;
const FORM: u8 = 0x02;
const STUFF: u8 = 0x04;
const BIT_DOMINANT: u8 = 0x08;
const BIT_RECESSIVE: u8 = 0x10;
const AT_CRC: u8 = 0x08;
const AT_CRC_DELIMITER: u8 = 0x18;
const AT_ACK: u8 = 0x19;

// These are ours. data[0] belongs to LOST_ARBITRATION, data[2..6] to PROTOCOL and to the transceiver's
// status.
const AT_LEAST: u8 = 0x80;
const SUPPRESSED: u8 = 0x40;
const DISTURBED: u8 = 0x20;

const STAGES: [LossStage; 5] = LossStage::ALL;
const FAILURES: [TransmitFailure; 5] = [
    TransmitFailure::ArbitrationLost,
    TransmitFailure::BusError,
    TransmitFailure::Aborted,
    TransmitFailure::Closed,
    TransmitFailure::BusOff,
];
/// Takes the place of a position in [`FAILURES`]: the count is then that of the periods. Only the device's own frames are overtaken,
/// so the lower half of the tag is enough; it uses the bytes of the error counters.
const OVERTAKEN: u8 = 6;
/// The same for [`TransmitFailure::Loop`], with a tag as the others have.
const LOOP: u8 = 7;

/// An error frame: its classes, without [`ERROR_FLAG`], and its data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ErrorFrame {
    /// The classes, as bits.
    pub classes: u32,
    /// The details.
    pub data: [u8; 8],
}

/// The position of `item` in `list`, from 1; 0 if it is unknown.
fn position<T: PartialEq>(list: &[T], item: Option<T>) -> u8 {
    item.and_then(|item| list.iter().position(|entry| *entry == item)).map_or(0, |at| at as u8 + 1)
}

impl ErrorFrame {
    /// The error frame for an event; `None` for a frame, be it one of LIN.
    pub fn of(event: &TraceEvent) -> Option<Self> {
        let mut data = [0; 8];
        let mut classes = match *event {
            TraceEvent::Frame { .. } | TraceEvent::Lin { .. } => return None,
            TraceEvent::Lost { stage, count, at_least } => {
                data[0] = position(&STAGES, stage) | if at_least { AT_LEAST } else { 0 };
                data[1] = RX_OVERFLOW;
                data[2..6].copy_from_slice(&count.to_le_bytes());
                CONTROLLER
            }
            TraceEvent::BusError { kind, .. } => match kind {
                None => BUS_ERROR,
                Some(BusErrorKind::Acknowledgment) => BUS_ERROR | NO_ACK,
                Some(kind) => {
                    data[2] = match kind {
                        BusErrorKind::Stuff => STUFF,
                        BusErrorKind::Form => FORM,
                        BusErrorKind::BitRecessive => BIT_RECESSIVE,
                        BusErrorKind::BitDominant => BIT_DOMINANT,
                        BusErrorKind::Crc | BusErrorKind::Acknowledgment => 0,
                    };
                    if kind == BusErrorKind::Crc {
                        data[3] = AT_CRC;
                    }
                    BUS_ERROR | PROTOCOL
                }
            },
            TraceEvent::ErrorsSuppressed { count } => {
                data[0] = SUPPRESSED;
                data[2..6].copy_from_slice(&count.to_le_bytes());
                BUS_ERROR
            }
            TraceEvent::Disturbed { length_ns } => {
                data[0] = DISTURBED;
                data[2..6].copy_from_slice(&length_ns.to_le_bytes());
                BUS_ERROR
            }
            TraceEvent::State { state, .. } => {
                data[1] = match state {
                    ErrorState::Active => ACTIVE,
                    ErrorState::Warning => WARNING,
                    ErrorState::Passive => PASSIVE,
                    ErrorState::BusOff => 0,
                };
                if state == ErrorState::BusOff { BUS_OFF } else { CONTROLLER }
            }
            TraceEvent::TransmitFailed { tag, reason: TransmitFailure::Overtaken { periods } } => {
                data[1] = OVERTAKEN;
                data[2..6].copy_from_slice(&periods.to_le_bytes());
                data[6..].copy_from_slice(&(tag as u16).to_le_bytes());
                TX_TIMEOUT
            }
            TraceEvent::TransmitFailed { tag, reason } => {
                let is_loop = reason == TransmitFailure::Loop;
                data[1] = if is_loop { LOOP } else { position(&FAILURES, Some(reason)) };
                data[2..6].copy_from_slice(&tag.to_le_bytes());
                if reason == TransmitFailure::ArbitrationLost { LOST_ARBITRATION } else { TX_TIMEOUT }
            }
        };
        if let TraceEvent::BusError { counters: Some((tec, rec)), .. }
        | TraceEvent::State { counters: Some((tec, rec)), .. } = *event
        {
            classes |= COUNTERS;
            [data[6], data[7]] = [tec, rec];
        }
        Some(Self { classes, data })
    }

    /// The meaning of an error frame: the most important event, and for a change of state also the bus error
    /// that caused it, if the frame names one.
    pub fn events(&self) -> (TraceEvent, Option<TraceEvent>) {
        let Self { classes, data } = *self;
        let has = |class| classes & class != 0;
        let counters = has(COUNTERS).then_some((data[6], data[7]));
        let number = u32::from_le_bytes([data[2], data[3], data[4], data[5]]);
        let bus_error = TraceEvent::BusError { kind: self.kind(), counters };
        if has(CONTROLLER) && data[1] & RX_OVERFLOW != 0 {
            let stage = STAGES.get((data[0] & !AT_LEAST).wrapping_sub(1) as usize).copied();
            let is_at_least = data[0] & AT_LEAST != 0;
            // There is a count only if nothing else uses the bytes. A loss of unknown size has no count, but the flag, which drivers never set.
            let counted = (number > 0 || is_at_least) && !has(PROTOCOL);
            let (count, at_least) = if counted { (number, is_at_least) } else { (1, true) };
            return (TraceEvent::Lost { stage, count, at_least }, None);
        }
        if has(CONTROLLER) && data[1] & TX_OVERFLOW != 0 {
            return (TraceEvent::TransmitFailed { tag: 0, reason: TransmitFailure::Aborted }, None);
        }
        let state = if has(BUS_OFF) {
            Some(ErrorState::BusOff)
        } else if has(CONTROLLER) && data[1] & PASSIVE != 0 {
            Some(ErrorState::Passive)
        } else if has(CONTROLLER) && data[1] & WARNING != 0 {
            Some(ErrorState::Warning)
        } else if has(CONTROLLER) && data[1] & ACTIVE != 0 || has(RESTARTED) {
            Some(ErrorState::Active)
        } else {
            None
        };
        if let Some(state) = state {
            let named = has(PROTOCOL | NO_ACK);
            return (TraceEvent::State { state, counters }, named.then_some(bus_error));
        }
        if has(LOST_ARBITRATION | TX_TIMEOUT) && !has(PROTOCOL | NO_ACK) {
            if data[1] == OVERTAKEN && !has(COUNTERS) {
                let tag = DEVICE_TAG | u32::from(u16::from_le_bytes([data[6], data[7]]));
                let reason = TransmitFailure::Overtaken { periods: number };
                return (TraceEvent::TransmitFailed { tag, reason }, None);
            }
            let told = match data[1] {
                LOOP => Some(TransmitFailure::Loop),
                place => FAILURES.get(place.wrapping_sub(1) as usize).copied(),
            };
            let guess = if has(LOST_ARBITRATION) {
                TransmitFailure::ArbitrationLost
            } else {
                TransmitFailure::Aborted
            };
            let tag = if told.is_some() { number } else { 0 };
            return (TraceEvent::TransmitFailed { tag, reason: told.unwrap_or(guess) }, None);
        }
        if has(BUS_ERROR) && !has(PROTOCOL | NO_ACK | LOST_ARBITRATION) && data[0] == SUPPRESSED {
            return (TraceEvent::ErrorsSuppressed { count: number }, None);
        }
        if classes == BUS_ERROR && data[0] == DISTURBED {
            return (TraceEvent::Disturbed { length_ns: number }, None);
        }
        (bus_error, None)
    }

    /// Whether [`Self::events`] return everything that the frame says.
    pub fn is_told_whole(&self) -> bool {
        let (event, second) = self.events();
        let mut again = Self { classes: 0, data: [0; 8] };
        for frame in [Some(event), second].into_iter().flatten().filter_map(|event| Self::of(&event)) {
            again.classes |= frame.classes;
            again.data.iter_mut().zip(frame.data).for_each(|(byte, other)| *byte |= other);
        }
        let mut bare = again;
        // Without the bytes that only this program writes.
        match event {
            TraceEvent::Lost { .. } => bare.data = [0, RX_OVERFLOW, 0, 0, 0, 0, 0, 0],
            TraceEvent::TransmitFailed { .. } => bare.data = [0; 8],
            // Which of the counters, and which way the state changed, may be missing: the state itself is
            // enough.
            TraceEvent::State { .. } => {
                const CHANGES: u32 = CONTROLLER | BUS_OFF | RESTARTED;
                bare.classes = bare.classes & !CHANGES | self.classes & CHANGES;
                bare.data[1] = self.data[1] & (WARNING | PASSIVE | ACTIVE);
            }
            _ => {}
        }
        let same =
            |other: &Self| other.classes | BUS_ERROR == self.classes | BUS_ERROR && other.data == self.data;
        same(&again) || same(&bare)
    }

    /// The kind of bus error, if the frame names one.
    fn kind(&self) -> Option<BusErrorKind> {
        if self.classes & NO_ACK != 0 {
            return Some(BusErrorKind::Acknowledgment);
        }
        if self.classes & PROTOCOL == 0 {
            return None;
        }
        let [_, _, what, place, ..] = self.data;
        match what {
            _ if what & STUFF != 0 => Some(BusErrorKind::Stuff),
            _ if what & FORM != 0 => Some(BusErrorKind::Form),
            _ if what & BIT_DOMINANT != 0 => Some(BusErrorKind::BitDominant),
            _ if what & (BIT_RECESSIVE | SINGLE_BIT) != 0 => Some(BusErrorKind::BitRecessive),
            _ if place == AT_CRC || place == AT_CRC_DELIMITER => Some(BusErrorKind::Crc),
            _ if place == AT_ACK => Some(BusErrorKind::Acknowledgment),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::event;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_event_round_trips(event in event()) {
            let frame = ErrorFrame::of(&event).unwrap();
            prop_assert_eq!(frame.events(), (event, None));
            prop_assert!(frame.is_told_whole());
            // With the class by which python-can recognises an error frame.
            let marked = ErrorFrame { classes: frame.classes | BUS_ERROR, ..frame };
            prop_assert_eq!(marked.events(), (event, None));
        }

        #[test]
        fn any_error_frame_says_something(classes in 0..0x2000_0000_u32, data: [u8; 8]) {
            let (event, _) = ErrorFrame { classes, data }.events();
            prop_assert!(ErrorFrame::of(&event).is_some());
        }
    }

    /// Frames as Linux drivers make them.
    #[test]
    fn drivers_error_frames_are_understood() {
        let events = |classes, data| ErrorFrame { classes, data }.events();
        let passive = TraceEvent::State { state: ErrorState::Passive, counters: Some((0, 128)) };
        assert_eq!(events(0x204, [0, 0x10, 0, 0, 0, 0, 0, 128]), (passive, None));
        let lost = TraceEvent::Lost { stage: None, count: 1, at_least: true };
        assert_eq!(events(0x004, [0, 1, 0, 0, 0, 0, 0, 0]), (lost, None));
        let not_sent = TraceEvent::TransmitFailed { tag: 0, reason: TransmitFailure::Aborted };
        assert_eq!(events(0x004, [0, 2, 0, 0, 0, 0, 0, 0]), (not_sent, None));
        let stuff = TraceEvent::BusError { kind: Some(BusErrorKind::Stuff), counters: None };
        assert_eq!(events(0x088, [0, 0, 4, 0, 0, 0, 0, 0]), (stuff, None));
        let warning = TraceEvent::State { state: ErrorState::Warning, counters: None };
        assert_eq!(events(0x08C, [0, 8, 4, 0, 0, 0, 0, 0]), (warning, Some(stuff)));
        let no_ack = TraceEvent::BusError { kind: Some(BusErrorKind::Acknowledgment), counters: None };
        assert_eq!(events(0x020, [0; 8]), (no_ack, None));
        let restarted = TraceEvent::State { state: ErrorState::Active, counters: None };
        assert_eq!(events(0x100, [0; 8]), (restarted, None));
        let whole = |classes, data| ErrorFrame { classes, data }.is_told_whole();
        assert!(whole(0x204, [0, 0x10, 0, 0, 0, 0, 0, 128]) && whole(0x08C, [0, 8, 4, 0, 0, 0, 0, 0]));
        assert!(whole(0x004, [0, 1, 0, 0, 0, 0, 0, 0]) && whole(0x001, [0; 8]) && whole(0x020, [0; 8]));
        // The position in the frame, the bit at which arbitration was lost, and a transceiver's fault are not
        // kept.
        assert!(!whole(0x088, [0, 0, 4, 0x0B, 0, 0, 0, 0]) && !whole(0x002, [9, 0, 0, 0, 0, 0, 0, 0]));
        assert!(!whole(0x010, [0, 0, 0, 0, 4, 0, 0, 0]));
    }

    /// As drivers name them: the kind in byte 2, or the place in the frame in byte 3 (`linux/can/error.h`).
    #[test]
    fn every_kind_of_error_that_a_driver_names_is_read() {
        use BusErrorKind::{Acknowledgment, BitDominant, BitRecessive, Crc, Form, Stuff};
        let kind = |classes, what, place| {
            let (event, second) = ErrorFrame { classes, data: [0, 0, what, place, 0, 0, 0, 0] }.events();
            assert_eq!(second, None);
            let TraceEvent::BusError { kind, counters: None } = event else { panic!("{event}") };
            kind
        };
        for (what, place, expected) in [
            (0x04, 0, Some(Stuff)),
            (0x02, 0, Some(Form)),
            (0x08, 0, Some(BitDominant)),
            (0x10, 0, Some(BitRecessive)),
            (0x01, 0, Some(BitRecessive)),
            (0, 0x08, Some(Crc)),
            (0, 0x18, Some(Crc)),
            (0, 0x19, Some(Acknowledgment)),
            (0, 0x0B, None),
            (0x20, 0, None),
            (0, 0, None),
            // A kind says more than a place.
            (0x02, 0x19, Some(Form)),
            (0x10, 0x08, Some(BitRecessive)),
        ] {
            assert_eq!(kind(BUS_ERROR | PROTOCOL, what, place), expected, "{what:02X} {place:02X}");
        }
        // Nobody acknowledged, whatever else is there; without the class, byte 2 belongs to something else.
        assert_eq!(kind(BUS_ERROR | PROTOCOL | NO_ACK, 0x04, 0), Some(Acknowledgment));
        assert_eq!(kind(BUS_ERROR, 0x04, 0x08), None);
    }

    #[test]
    fn what_several_classes_say_together_is_told_apart() {
        let events = |classes, data| ErrorFrame { classes, data }.events();
        let state = |state| TraceEvent::State { state, counters: None };
        let bus_error = |kind| TraceEvent::BusError { kind: Some(kind), counters: None };
        assert_eq!(events(CONTROLLER, [0, ACTIVE, 0, 0, 0, 0, 0, 0]), (state(ErrorState::Active), None));
        assert_eq!(events(BUS_OFF, [0; 8]), (state(ErrorState::BusOff), None));
        // The error that changed the state, if it is named: nobody acknowledged.
        let no_ack = bus_error(BusErrorKind::Acknowledgment);
        assert_eq!(
            events(CONTROLLER | NO_ACK, [0, 8, 0, 0, 0, 0, 0, 0]),
            (state(ErrorState::Warning), Some(no_ack))
        );
        // Without its class, byte 1 is no state.
        assert_eq!(
            events(PROTOCOL, [0, ACTIVE | 0x30 | 0x0C, 4, 0, 0, 0, 0, 0]),
            (bus_error(BusErrorKind::Stuff), None)
        );
        // Byte 2 is the kind of an error rather than the count of a loss.
        let lost = TraceEvent::Lost { stage: None, count: 1, at_least: true };
        assert_eq!(events(CONTROLLER | PROTOCOL, [0, RX_OVERFLOW, 4, 0, 0, 0, 0, 0]), (lost, None));
        // A frame that met an error is that error; what was lost by arbitration alone was not sent.
        assert_eq!(
            events(LOST_ARBITRATION | PROTOCOL, [0, 0, 4, 0, 0, 0, 0, 0]),
            (bus_error(BusErrorKind::Stuff), None)
        );
        assert_eq!(events(TX_TIMEOUT | NO_ACK, [0; 8]), (no_ack, None));
        let not_sent = |reason| (TraceEvent::TransmitFailed { tag: 0, reason }, None);
        assert_eq!(
            events(LOST_ARBITRATION, [9, 0, 0, 0, 0, 0, 0, 0]),
            not_sent(TransmitFailure::ArbitrationLost)
        );
        assert_eq!(events(TX_TIMEOUT, [0; 8]), not_sent(TransmitFailure::Aborted));
        // The bytes of an overtaken frame's tag are counters here.
        let named = events(TX_TIMEOUT | COUNTERS, [0, OVERTAKEN, 5, 0, 0, 0, 1, 2]);
        assert_eq!(named, not_sent(TransmitFailure::Aborted));
        // Our own counts are not read out of a driver's bytes.
        for class in [PROTOCOL, NO_ACK] {
            let (event, _) = events(BUS_ERROR | class, [SUPPRESSED, 0, 4, 0, 0, 0, 0, 0]);
            assert!(matches!(event, TraceEvent::BusError { .. }), "{event}");
        }
        let (event, _) = events(BUS_ERROR | LOST_ARBITRATION, [SUPPRESSED, 0, 0, 0, 0, 0, 0, 0]);
        assert!(matches!(event, TraceEvent::TransmitFailed { .. }), "{event}");
        let (event, _) = events(BUS_ERROR | PROTOCOL, [DISTURBED, 0, 4, 0, 0, 0, 0, 0]);
        assert!(matches!(event, TraceEvent::BusError { .. }), "{event}");
    }
}
