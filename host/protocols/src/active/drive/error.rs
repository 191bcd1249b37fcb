//! Why a drive did not do what it was to do.

use crate::active::sdo::SdoError;
use crate::canopen::drive::{self, DriveState, mode_name};

/// Why a step failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DriveError {
    /// An object could not be read or written.
    #[error("object {index:04X}: {error}")]
    Sdo {
        /// The object.
        index: u16,
        /// Why.
        error: SdoError,
    },
    /// An object is shorter or longer than the profile says.
    #[error("object {index:04X} has {bytes} bytes, which is not what a drive has there")]
    Length {
        /// The object.
        index: u16,
        /// Its length.
        bytes: usize,
    },
    /// The statusword is that of no state.
    #[error("its statusword {statusword:04X} is that of no state")]
    NoState {
        /// The statusword.
        statusword: u16,
    },
    /// It has a fault.
    #[error("it has a fault{}", fault(*code))]
    Fault {
        /// Its error code, if it says one.
        code: Option<u16>,
    },
    /// It did not change its state.
    #[error("it is still {} ({statusword:04X}) {after_ms} ms after it was to become {}", last.name(), wanted.name())]
    NotConfirmed {
        /// The state that it should have.
        wanted: DriveState,
        /// The state that it has.
        last: DriveState,
        /// Its statusword.
        statusword: u16,
        /// How long we waited.
        after_ms: u64,
    },
    /// It went to a state that does not follow.
    #[error("it was {} and was to become {}, but it is {} ({statusword:04X})", from.name(), wanted.name(), got.name())]
    Jumped {
        /// The state before.
        from: DriveState,
        /// The state that it should have.
        wanted: DriveState,
        /// The state that it has.
        got: DriveState,
        /// Its statusword.
        statusword: u16,
    },
    /// It went back and forth.
    #[error("it does not stay in the states that it confirms, after {commands} commands")]
    Restless {
        /// How many controlwords were written.
        commands: u32,
    },
    /// Operation was no longer enabled, and not by us.
    #[error("it is {} ({statusword:04X}) by itself, and was operation enabled", got.name())]
    Left {
        /// The state that it has.
        got: DriveState,
        /// Its statusword.
        statusword: u16,
    },
    /// It does not take the mode of operation.
    #[error("it does not take the mode {}, but {}", mode_text(*wanted), shown.map_or_else(|| "shows none".to_owned(), |mode| format!("shows {}", mode_text(mode))))]
    Mode {
        /// The mode that it should have.
        wanted: i8,
        /// The mode that it shows.
        shown: Option<i8>,
    },
    /// The handshake for a set-point came to nothing.
    #[error("it does not {} the set-point within {after_ms} ms", if *is_acknowledged { "release" } else { "acknowledge" })]
    SetPoint {
        /// It had acknowledged it.
        is_acknowledged: bool,
        /// How long we waited.
        after_ms: u64,
    },
    /// The position does not follow its demand.
    #[error("it reports a following error")]
    FollowingError,
    /// Homing failed.
    #[error("it reports that homing has failed")]
    HomingError,
    /// The target was not reached.
    #[error("the target was not reached within {after_ms} ms")]
    NotReached {
        /// How long we waited.
        after_ms: u64,
    },
    /// It sent an emergency.
    #[error("it sent an emergency: {} ({code:04X})", drive::error(*code))]
    Emergency {
        /// The error code.
        code: u16,
    },
    /// It started anew.
    #[error("it has restarted by itself")]
    Restarted,
    /// Its heartbeat stopped.
    #[error("its heartbeat has been missing for {after_ms} ms")]
    HeartbeatMissing {
        /// How long.
        after_ms: u64,
    },
    /// Network management stopped it.
    #[error("it was stopped by network management")]
    Stopped,
    /// More than one answer came to a request.
    #[error("answers come that nobody has asked for: two nodes may have this number")]
    TwoAnswers,
    /// Another client uses the SDO channel.
    #[error("another client uses its SDO channel at the same time")]
    OtherClient,
    /// It was ended from outside.
    #[error("ended before it was complete")]
    Cancelled,
}

fn fault(code: Option<u16>) -> String {
    match code {
        Some(code) if code != 0 => format!(": {} ({code:04X})", drive::error(code)),
        _ => ", and does not say which".to_owned(),
    }
}

fn mode_text(mode: i8) -> String {
    mode_name(mode).map_or_else(|| mode.to_string(), |name| format!("{name} ({mode})"))
}
