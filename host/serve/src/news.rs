//! What a server reports to the program that runs it.

use std::fmt;

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

impl fmt::Display for News {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ClientCame { client, role } => write!(f, "{client} is in and may {role}"),
            Self::ClientLeft { client, reason: None } => write!(f, "{client} has left"),
            Self::ClientLeft { client, reason: Some(reason) } => write!(f, "{client} was let go: {reason}"),
            Self::Refused { client, reason } => write!(f, "{client} was not let in: {reason}"),
            // The reason names the board.
            Self::BoardLost { board, reason } if reason.contains(board.as_str()) => {
                write!(f, "{reason}; it is tried again")
            }
            Self::BoardLost { board, reason } => write!(f, "'{board}': {reason}; it is tried again"),
            Self::BoardBack { board } => write!(f, "'{board}' is there again"),
        }
    }
}
