//! What a server tells whoever runs it.

use std::fmt;

use cantap_wire::message::Role;

/// Something happened.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum News {
    /// A client is in.
    ClientCame {
        /// As it is called.
        client: String,
        /// What it may do at most.
        role: Role,
    },
    /// A client has left, or was let go.
    ClientLeft {
        /// As it is called.
        client: String,
        /// Why, if not by itself.
        reason: Option<String>,
    },
    /// Somebody was not let in.
    Refused {
        /// Who.
        client: String,
        /// Why not.
        reason: String,
    },
    /// The board is gone. It is tried again.
    BoardLost {
        /// As it is called.
        board: String,
        /// What shows it.
        reason: String,
    },
    /// The board is there again.
    BoardBack {
        /// As it is called.
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
