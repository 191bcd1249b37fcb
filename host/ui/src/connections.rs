//! The connections that are open. Their number is limited, and whoever only connects keeps nobody out: if there is no place, the one that has
//! been there longest without showing the token is let go.

use std::io;
use std::net::{Shutdown, TcpStream};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Connections at a time. A browser needs a handful.
const MOST: usize = 64;

/// See the module's description.
#[derive(Default)]
pub struct Connections(Mutex<Table>);

#[derive(Default)]
struct Table {
    next: u64,
    /// In the order in which they came.
    open: Vec<Connection>,
}

struct Connection {
    number: u64,
    /// To end it; none once it has shown the token.
    stranger: Option<TcpStream>,
}

impl Connections {
    fn lock(&self) -> MutexGuard<'_, Table> {
        // Every holder leaves it consistent.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A connection comes, and gets a number.
    ///
    /// # Errors
    ///
    /// If there is no place, or the system gives no handle.
    pub fn enter(&self, stream: &TcpStream) -> io::Result<u64> {
        let stranger = Some(stream.try_clone()?);
        let mut table = self.lock();
        if table.open.len() >= MOST {
            let first = table.open.iter().position(|open| open.stranger.is_some());
            let first = first.ok_or(io::ErrorKind::ResourceBusy)?;
            if let Some(stream) = table.open.remove(first).stranger {
                // It may have ended by itself.
                let _ = stream.shutdown(Shutdown::Both);
            }
        }
        let number = table.next;
        table.next += 1;
        table.open.push(Connection { number, stranger });
        Ok(number)
    }

    /// It keeps its place until it leaves.
    pub fn has_shown_token(&self, number: u64) {
        if let Some(open) = self.lock().open.iter_mut().find(|open| open.number == number) {
            open.stranger = None;
        }
    }

    /// It has ended.
    pub fn leave(&self, number: u64) {
        self.lock().open.retain(|open| open.number != number);
    }

    /// Whether none is open.
    pub fn are_gone(&self) -> bool {
        self.lock().open.is_empty()
    }
}
