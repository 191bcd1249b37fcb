//! One client's connection: where it is read and written, and what it wants to hear.

use std::io;
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use cantap::device::{is_idle, write_patiently};
use cantap_wire::Channel;
use cantap_wire::message::Role;

use super::hearing::Hearing;
use crate::listen::patience;
use crate::lock::lock;
use crate::writer::took_nothing;
use crate::{Board, News};

/// A channel that can be opened.
pub struct Bus {
    pub name: String,
    pub board: Arc<Board>,
    pub channel: Channel,
}

/// One client.
pub struct Connection {
    pub output: Mutex<TcpStream>,
    pub name: String,
    pub buses: Arc<[Bus]>,
    pub role: Role,
    pub hearing: Mutex<Hearing>,
    /// When something was last sent to it.
    pub told_at: Mutex<Instant>,
    pub is_over: AtomicBool,
}

impl Connection {
    pub fn new(output: TcpStream, name: String, buses: Arc<[Bus]>, role: Role) -> Arc<Self> {
        Arc::new(Self {
            output: Mutex::new(output),
            name,
            buses,
            role,
            hearing: Mutex::default(),
            told_at: Mutex::new(Instant::now()),
            is_over: AtomicBool::new(false),
        })
    }

    /// Sends it text. One that takes nothing for too long is let go.
    pub fn write(&self, text: &str) -> io::Result<()> {
        if text.is_empty() {
            return Ok(());
        }
        *lock(&self.told_at) = Instant::now();
        let patience = patience(self.role);
        let written = write_patiently(&mut *lock(&self.output), text.as_bytes(), patience);
        if written.as_ref().is_err_and(is_idle) && !self.is_over.swap(true, Ordering::Relaxed) {
            let (client, reason) = (self.name.clone(), Some(took_nothing(patience)));
            self.buses[0].board.tell(News::ClientLeft { client, reason });
        }
        written
    }

    /// The client has missed what was on the bus for a moment.
    pub fn missed(&self) {
        lock(&self.hearing).has_gap = true;
    }
}
