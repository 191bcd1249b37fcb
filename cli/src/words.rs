//! What devices report, in the usual terms.

use std::borrow::Cow;

use cantap::wire::record::{BusErrorKind, ErrorState, TransmitFailure};

/// `1 frame`, `2 frames`.
pub fn counted(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

/// The usual name of an error.
pub fn error_name(kind: BusErrorKind) -> &'static str {
    match kind {
        BusErrorKind::Stuff => "stuff",
        BusErrorKind::Form => "form",
        BusErrorKind::Acknowledgment => "acknowledgment",
        BusErrorKind::BitRecessive => "bit (recessive sent)",
        BusErrorKind::BitDominant => "bit (dominant sent)",
        BusErrorKind::Crc => "CRC",
    }
}

/// The usual name of a state.
pub fn state_name(state: ErrorState) -> &'static str {
    match state {
        ErrorState::Active => "error active",
        ErrorState::Warning => "error warning",
        ErrorState::Passive => "error passive",
        ErrorState::BusOff => "bus-off",
    }
}

/// Why a frame was not sent.
pub fn failure_name(reason: TransmitFailure) -> Cow<'static, str> {
    let name = match reason {
        TransmitFailure::ArbitrationLost => "arbitration lost",
        TransmitFailure::BusError => "bus error",
        TransmitFailure::Aborted => "aborted",
        TransmitFailure::Closed => "channel closed",
        TransmitFailure::BusOff => "bus-off",
        TransmitFailure::Overtaken { periods: 1 } => "its next period came first",
        TransmitFailure::Overtaken { periods } => {
            return format!("its next {periods} periods came first").into();
        }
    };
    name.into()
}
