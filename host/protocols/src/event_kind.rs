//! The kinds of events, with the names that they have in text, JSON, columns and Python.

use std::fmt;
use std::str::FromStr;

/// Defines the type, its names and [`EventKind::ALL`] from one list.
macro_rules! kinds {
    ($($(#[doc = $doc:literal])+ $kind:ident = $name:literal,)+) => {
        /// What kind of event it is, within its protocol.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        #[non_exhaustive]
        pub enum EventKind {
            $($(#[doc = $doc])+ $kind,)+
        }

        impl EventKind {
            /// All kinds.
            pub const ALL: &[Self] = &[$(Self::$kind,)+];

            /// The name for programs: `no_response`.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$kind => $name,)+
                }
            }
        }
    };
}

kinds! {
    /// A request with its response.
    Exchange = "exchange",
    /// A request with a negative response.
    Refusal = "refusal",
    /// A request that nobody has answered in time.
    NoResponse = "no_response",
    /// A request that wants no response, or whose response is an event of its own.
    Request = "request",
    /// A response without its request.
    Response = "response",
    /// Data that a server sends by itself.
    Periodic = "periodic",
    /// A complete transfer of ISO-TP whose content is not interpreted.
    Transfer = "transfer",
    /// A message that is not whole.
    Broken = "broken",
    /// A parameter group.
    Message = "message",
    /// An acknowledgement or a refusal of a parameter group.
    Acknowledgement = "acknowledgement",
    /// A node has claimed an address, or has none.
    AddressClaim = "address_claim",
    /// A node is told to take another address.
    AddressCommand = "address_command",
    /// Trouble codes of J1939.
    TroubleCodes = "trouble_codes",
    /// Network management of CANopen.
    Nmt = "nmt",
    /// A node has started.
    BootUp = "boot_up",
    /// A node's state, as its heartbeat tells it.
    State = "state",
    /// A node's state, in answer to guarding.
    Guard = "guard",
    /// A heartbeat does not come any more.
    HeartbeatMissing = "heartbeat_missing",
    /// A heartbeat that was missing comes again.
    HeartbeatBack = "heartbeat_back",
    /// A node does not answer guarding.
    GuardMissing = "guard_missing",
    /// A node is no longer guarded.
    GuardingStopped = "guarding_stopped",
    /// The first SYNC, or a counter that jumps.
    Sync = "sync",
    /// The time of day.
    Time = "time",
    /// An emergency.
    Emergency = "emergency",
    /// A PDO.
    Pdo = "pdo",
    /// A safety-related data object of CANopen: two frames.
    Srdo = "srdo",
    /// The command that sends all safety-related nodes of CANopen to their safe state.
    Failsafe = "failsafe",
    /// An object was read by SDO.
    SdoRead = "sdo_read",
    /// An object was written by SDO.
    SdoWrite = "sdo_write",
    /// A frame of the master of the layer setting services.
    Lss = "lss",
    /// A slave's answer to it.
    LssAnswer = "lss_answer",
    /// I/O of DeviceNet.
    Io = "io",
    /// A check whether another node has this MAC ID.
    DuplicateCheck = "duplicate_check",
    /// Another node has this MAC ID.
    Duplicate = "duplicate",
    /// An event or a request that a slave reports by itself.
    Notification = "notification",
    /// A message of a node that is not on line.
    Offline = "offline",
}

impl fmt::Display for EventKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// A text is not the name of a kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("no such kind of event; docs/protocols.md lists them")]
pub struct UnknownEventKind;

impl FromStr for EventKind {
    type Err = UnknownEventKind;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL.iter().copied().find(|kind| kind.name() == text).ok_or(UnknownEventKind)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_has_a_name_of_its_own() {
        for kind in EventKind::ALL {
            assert_eq!(kind.name().parse(), Ok(*kind));
        }
        assert_eq!("heartbeat".parse::<EventKind>(), Err(UnknownEventKind));
    }
}
