//! Sends a client what is received on the bus that it has open.

use std::io;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use cantap::{TraceEvent, TraceRecord};

use super::connection::Connection;
use super::hearing::Hears;
use crate::feed::{self, Feed, Losses, Source};
use crate::left_out::{LOST, LeftOut};
use crate::lock::lock;

/// SavvyCAN reconnects after ten seconds without receiving anything, which loses what is on the bus meanwhile.
const KEEP_ALIVE_EVERY: Duration = Duration::from_secs(7);
/// What is then sent to the client: the protocol's own word for "still here". SavvyCAN and Kayak ignore it; so does python-can, with
/// a warning in its log. No client identifies itself, and a frame that SavvyCAN misses is worse than a warning.
const KEEP_ALIVE: &str = "< echo >";

/// What a client receives of the bus.
pub struct BusFeed {
    connection: Arc<Connection>,
    text: String,
    left_out: LeftOut,
}

impl BusFeed {
    pub fn new(connection: &Arc<Connection>) -> Self {
        Self { connection: Arc::clone(connection), text: String::new(), left_out: LeftOut::default() }
    }

    /// Sends it, until either side ends.
    pub fn run(mut self, source: Source) {
        let untold = feed::run(&mut [source], &mut self);
        self.connection.is_over.store(true, Ordering::Relaxed);
        self.left_out.count(LOST, untold);
        self.report_left_out(true);
    }

    fn report_left_out(&mut self, is_end: bool) {
        let Self { connection, left_out, .. } = self;
        left_out.report(is_end, &connection.buses[0].board, &connection.name);
    }

    /// Whether nothing has been sent for too long to a client that reads only frames.
    fn needs_keep_alive(&self) -> bool {
        let connection = &self.connection;
        lock(&connection.told_at).elapsed() >= KEEP_ALIVE_EVERY
            && lock(&connection.hearing).hears == Hears::All
    }
}

impl Feed for BusFeed {
    fn is_over(&mut self) -> bool {
        self.report_left_out(false);
        self.connection.is_over.load(Ordering::Relaxed)
    }

    fn take(&mut self, _: usize, records: &[TraceRecord]) -> Losses {
        let is_fd = |record: &&TraceRecord| matches!(&record.event, TraceEvent::Frame { frame, .. } if frame.classic().is_none());
        self.left_out.count("CAN FD frames", records.iter().filter(is_fd).count() as u64);
        let losses = loop {
            let mut hearing = lock(&self.connection.hearing);
            let Some(wait) = hearing.wait() else {
                hearing.take(records, &mut self.text);
                break if hearing.tells_errors() { Losses::ToldByWriting } else { Losses::NotTold };
            };
            drop(hearing);
            std::thread::sleep(wait);
        };
        if self.text.is_empty() && self.needs_keep_alive() {
            self.text.push_str(KEEP_ALIVE);
        }
        losses
    }

    fn is_empty(&self) -> bool {
        self.text.is_empty()
    }

    fn write(&mut self) -> io::Result<()> {
        self.connection.write(&self.text)?;
        self.text.clear();
        Ok(())
    }
}
