//! How clients are admitted at a TCP port.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

use cantap_serve::listen::{self, Listening};
use cantap_serve::{Board, Role};

/// See the module.
pub enum Way {
    /// Without authentication.
    Plain,
    /// By certificate.
    #[cfg(feature = "tls")]
    Encrypted(cantap_serve::tls::Server),
}

impl Way {
    /// What is read again at a hang-up.
    #[cfg(feature = "tls")]
    pub fn server(&self) -> Option<cantap_serve::tls::Server> {
        if let Self::Encrypted(server) = self { Some(server.clone()) } else { None }
    }

    /// The scheme in addresses.
    pub const fn scheme(&self) -> &'static str {
        match self {
            Self::Plain => "tcp",
            #[cfg(feature = "tls")]
            Self::Encrypted(_) => "tls",
        }
    }

    /// Admits them to a board, in a role of no more than `most`.
    pub fn listen(&self, board: &Arc<Board>, address: SocketAddr, most: Role) -> io::Result<Listening> {
        match self {
            Self::Plain => listen::tcp(board, address, most),
            #[cfg(feature = "tls")]
            Self::Encrypted(server) => cantap_serve::tls::listen(board, address, most, server),
        }
    }
}
