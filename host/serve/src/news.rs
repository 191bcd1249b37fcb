//! What a server reports to the program that runs it.

use std::fmt;
use std::time::Duration;

use cantap_trace::counted;
use cantap_wire::Channel;
use cantap_wire::message::Role;

/// Something happened.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum News {
    /// A client was admitted.
    ClientCame {
        /// Its name.
        client: String,
        /// Its maximum role.
        role: Role,
    },
    /// A client has left, or was dropped.
    ClientLeft {
        /// Its name.
        client: String,
        /// The reason, if it did not leave on its own.
        reason: Option<String>,
    },
    /// A client was refused.
    Refused {
        /// Its name.
        client: String,
        /// The reason.
        reason: String,
    },
    /// So many more clients were refused since the last report: only some refusals are reported while there are many.
    RefusedMore {
        /// How many.
        count: u64,
    },
    /// So many more reports of clients that came, opened and closed channels and left were not made since the last one: there are too many.
    SessionsMore {
        /// How many.
        count: u64,
    },
    /// A client said nothing for the dead-man time: what it has sent on its own is stopped.
    DeadMan {
        /// Its name.
        client: String,
        /// The time.
        after: Duration,
    },
    /// A client's request was refused, because its role does not allow it, or the permissions of its certificate do not cover it.
    NotPermitted {
        /// Its name.
        client: String,
        /// What is not permitted.
        reason: String,
    },
    /// What a client of a foreign protocol asked for was not done.
    NotDone {
        /// Its name.
        client: String,
        /// What, and why.
        reason: String,
    },
    /// What a client asked for was done, where no other message tells of it.
    Asked {
        /// Its name.
        client: String,
        /// What.
        what: String,
    },
    /// A client was not told of what happened: because its protocol has no message for it, or because it was too slow, or gone.
    LeftOut {
        /// Its name.
        client: String,
        /// What, with its numbers.
        what: String,
    },
    /// A client has sent nothing for this long, and only listens again on a channel.
    Idle {
        /// Its name.
        client: String,
        /// The channel.
        channel: Channel,
        /// The time.
        after: Duration,
    },
    /// A channel was off its bus because its mode had to change, which clients that had it open see as a gap.
    OffBus {
        /// Who asked for it; `None` if the server went back to listening.
        client: Option<String>,
        /// The channel.
        channel: Channel,
        /// How many others had it open.
        others: usize,
    },
    /// The board is gone. The server keeps trying it.
    BoardLost {
        /// Its name.
        board: String,
        /// How that was noticed.
        reason: String,
    },
    /// The board is back.
    BoardBack {
        /// Its name.
        board: String,
    },
}

impl News {
    /// What kind it is, in the audit log.
    pub(crate) const fn event(&self) -> &'static str {
        match self {
            Self::ClientCame { .. } => "came",
            Self::ClientLeft { .. } => "left",
            Self::Refused { .. } => "refused",
            Self::RefusedMore { .. } => "refused_more",
            Self::SessionsMore { .. } => "sessions_more",
            Self::DeadMan { .. } => "dead_man",
            Self::NotPermitted { .. } => "not_permitted",
            Self::NotDone { .. } => "not_done",
            Self::Asked { .. } => "asked",
            Self::LeftOut { .. } => "left_out",
            Self::Idle { .. } => "idle",
            Self::OffBus { .. } => "off_bus",
            Self::BoardLost { .. } => "board_lost",
            Self::BoardBack { .. } => "board_back",
        }
    }

    /// The client that it is about.
    pub(crate) fn client(&self) -> Option<&str> {
        match self {
            Self::ClientCame { client, .. }
            | Self::ClientLeft { client, .. }
            | Self::Refused { client, .. }
            | Self::DeadMan { client, .. }
            | Self::NotPermitted { client, .. }
            | Self::NotDone { client, .. }
            | Self::Asked { client, .. }
            | Self::LeftOut { client, .. }
            | Self::Idle { client, .. }
            | Self::OffBus { client: Some(client), .. } => Some(client),
            Self::RefusedMore { .. }
            | Self::SessionsMore { .. }
            | Self::OffBus { client: None, .. }
            | Self::BoardLost { .. }
            | Self::BoardBack { .. } => None,
        }
    }
}

/// `1 client sees`, `2 clients see`.
fn seen_by(clients: usize, noun: &str) -> String {
    format!("{} {}", counted(clients, noun), if clients == 1 { "sees" } else { "see" })
}

impl fmt::Display for News {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ClientCame { client, role } => write!(f, "{client} is in and may {role}"),
            Self::ClientLeft { client, reason: None } => write!(f, "{client} has left"),
            Self::ClientLeft { client, reason: Some(reason) } => write!(f, "{client} was let go: {reason}"),
            Self::Refused { client, reason } => write!(f, "{client} was not let in: {reason}"),
            Self::RefusedMore { count } => write!(f, "{count} more were refused"),
            Self::SessionsMore { count } => {
                write!(f, "clients come and leave too fast to report: {count} reports of that are left out")
            }
            Self::DeadMan { client, after } => {
                write!(
                    f,
                    "{client} said nothing for {} s: what it has sent periodically is stopped",
                    after.as_secs_f64()
                )
            }
            Self::NotPermitted { client, reason } | Self::NotDone { client, reason } => {
                write!(f, "{client} was refused: {reason}")
            }
            Self::Asked { client, what } => write!(f, "{client} asked for: {what}"),
            Self::LeftOut { client, what } => {
                write!(f, "{client} was not told of {what}")
            }
            Self::Idle { client, channel, after } => write!(
                f,
                "{client} sent nothing on channel {} for {} s, and only listens there again",
                channel.number(),
                after.as_secs_f64()
            ),
            Self::OffBus { client: Some(client), channel, others } => write!(
                f,
                "channel {} was off its bus for a moment, because {client} may send on it; {} a gap",
                channel.number(),
                seen_by(*others, "other client")
            ),
            Self::OffBus { client: None, channel, others } => write!(
                f,
                "channel {} was off its bus for a moment, and only listens again; {} a gap",
                channel.number(),
                seen_by(*others, "client")
            ),
            // The reason names the board.
            Self::BoardLost { board, reason } if reason.contains(board.as_str()) => {
                write!(f, "{reason}; it is tried again")
            }
            Self::BoardLost { board, reason } => write!(f, "'{board}': {reason}; it is tried again"),
            Self::BoardBack { board } => write!(f, "'{board}' is there again"),
        }
    }
}
