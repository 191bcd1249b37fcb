//! What a record says if it is no frame, as one line.

use crate::counted;
use std::borrow::Cow;
use std::fmt;

use cantap_can::{BusErrorKind, LossStage, TransmitFailure};

use crate::TraceEvent;

/// Why a frame was not sent, and how often.
pub fn failure_text(reason: TransmitFailure) -> Cow<'static, str> {
    match reason {
        TransmitFailure::Overtaken { periods: 1 } => "overtaken: its next period came first".into(),
        TransmitFailure::Overtaken { periods } => {
            format!("overtaken: its next {periods} came first", periods = counted(periods, "period")).into()
        }
        TransmitFailure::Loop => "loop: both channels of the gateway are on one bus, and it has ended".into(),
        reason => reason.name().into(),
    }
}

/// The number of missing frames.
pub fn lost(count: u32, at_least: bool) -> String {
    match (count, at_least) {
        // For example while a device was gone.
        (0, true) => "an unknown number of".to_owned(),
        (count, true) => format!("at least {count}"),
        (count, false) => count.to_string(),
    }
}

impl fmt::Display for TraceEvent {
    /// A frame as candump writes it, and anything else as a phrase: `bus error: stuff`, `3 frames lost (queue)`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counters = |counters: Option<(u8, u8)>| {
            counters.map_or(String::new(), |(tec, rec)| format!(", counters {tec} / {rec}"))
        };
        match *self {
            Self::Frame { frame, .. } => frame.fmt(f),
            Self::BusError { kind, counters: at } => {
                write!(f, "bus error: {}{}", kind.map_or("unknown", BusErrorKind::name), counters(at))
            }
            Self::ErrorsSuppressed { count } => f.write_str(&counted(count, "more bus error")),
            Self::State { state, counters: at } => write!(f, "controller {}{}", state.name(), counters(at)),
            Self::Lost { stage, count, at_least } => {
                let stage = stage.map_or("unknown", LossStage::name);
                write!(f, "{} lost ({stage})", counted(lost(count, at_least), "frame"))
            }
            Self::TransmitFailed { tag, reason } => {
                write!(f, "frame {tag} not sent: {}", failure_text(reason))
            }
            Self::Lin { frame, .. } => frame.fmt(f),
            Self::Disturbed { length_ns: 0 } => f.write_str("not disturbed: the device was busy"),
            Self::Disturbed { length_ns } => {
                write!(f, "disturbed on purpose for {:.1} us", f64::from(length_ns) / 1000.0)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Direction, ErrorState};

    /// What users read in every view, in files of text and in messages.
    #[test]
    fn every_event_says_what_happened_in_a_line() {
        let lost = |stage, count, at_least| TraceEvent::Lost { stage, count, at_least };
        let not_sent = |reason| TraceEvent::TransmitFailed { tag: 7, reason };
        let frame =
            TraceEvent::Frame { frame: "123#DEAD".parse().unwrap(), direction: Direction::Rx, late: false };
        for (event, text) in [
            (frame, "123#DEAD"),
            (TraceEvent::BusError { kind: Some(BusErrorKind::Stuff), counters: None }, "bus error: stuff"),
            (
                TraceEvent::BusError { kind: None, counters: Some((8, 1)) },
                "bus error: unknown, counters 8 / 1",
            ),
            (TraceEvent::ErrorsSuppressed { count: 3 }, "3 more bus errors"),
            (TraceEvent::State { state: ErrorState::BusOff, counters: None }, "controller bus-off"),
            (
                TraceEvent::State { state: ErrorState::Passive, counters: Some((128, 0)) },
                "controller passive, counters 128 / 0",
            ),
            (lost(Some(LossStage::Queue), 3, false), "3 frames lost (queue)"),
            (lost(None, 3, true), "at least 3 frames lost (unknown)"),
            (lost(Some(LossStage::Link), 0, true), "an unknown number of frames lost (link)"),
            (lost(Some(LossStage::Link), 0, false), "0 frames lost (link)"),
            (not_sent(TransmitFailure::BusOff), "frame 7 not sent: bus-off"),
            (
                not_sent(TransmitFailure::Overtaken { periods: 1 }),
                "frame 7 not sent: overtaken: its next period came first",
            ),
            (
                not_sent(TransmitFailure::Overtaken { periods: 2 }),
                "frame 7 not sent: overtaken: its next 2 periods came first",
            ),
            (
                not_sent(TransmitFailure::Loop),
                "frame 7 not sent: loop: both channels of the gateway are on one bus, and it has ended",
            ),
            (TraceEvent::Disturbed { length_ns: 0 }, "not disturbed: the device was busy"),
            (TraceEvent::Disturbed { length_ns: 12_340 }, "disturbed on purpose for 12.3 us"),
        ] {
            assert_eq!(event.to_string(), text);
        }
    }
}
