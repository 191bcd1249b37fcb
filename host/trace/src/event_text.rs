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
            Self::Disturbed { length_ns: 0 } => f.write_str("not disturbed: the device was busy"),
            Self::Disturbed { length_ns } => {
                write!(f, "disturbed on purpose for {:.1} us", f64::from(length_ns) / 1000.0)
            }
        }
    }
}
