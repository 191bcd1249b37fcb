//! How much is in transit to a client at a time.
//!
//! What ssh, a tunnel or a modem holds between server and client delays answers, too: two megabytes are half a minute on a slow line, and
//! a client that waits half a minute for an answer gives the board up. So a client reports now and then how many bytes it has read, and
//! the server keeps no more in transit than arrives in a fraction of a second. The rest waits in the client's outbox, where answers go
//! first and what does not fit is counted. To a client that never reports, the server writes as fast as the connection takes it.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap::device::Link;
use cantap_wire::framing::{CRC_LEN, max_encoded_len, seal};

use crate::places::REFUSAL;

/// What begins an acknowledgement: no request does, for no number of 16 bits is written so. A server that does not know it takes it for
/// garbage, which is not answered.
const MARK: [u8; 3] = [0xFF; 3];
/// The mark, and the bytes that were read since the connection began, little-endian.
const ACK_LEN: usize = MARK.len() + size_of::<u64>();

/// A client reports after reading this many bytes,
const ACK_BYTES: u64 = 8 * 1024;
/// or after this time.
const ACK_AFTER: Duration = Duration::from_millis(50);

/// What is in transit should arrive within this time: far less than the 1.4 s after which a device that answers nothing is given up.
const TARGET: Duration = Duration::from_millis(400);
/// Bytes in transit at first: less than that time of a line of 20 kB/s.
const FIRST_WINDOW: u64 = 8 * 1024;
/// The least window, in bytes.
const LEAST_WINDOW: u64 = 2 * 1024;
/// The largest: two saturated channels over a line with a round trip of a second.
const MOST_WINDOW: u64 = 256 * 1024;

/// The number of bytes read that a message tells, if it is an acknowledgement.
pub fn read_ack(message: &[u8]) -> Option<u64> {
    let count = message.strip_prefix(&MARK)?;
    count.try_into().ok().map(u64::from_le_bytes)
}

fn ack(read: u64) -> Vec<u8> {
    let mut message = [0; ACK_LEN + CRC_LEN];
    message[..MARK.len()].copy_from_slice(&MARK);
    message[MARK.len()..ACK_LEN].copy_from_slice(&read.to_le_bytes());
    let mut out = vec![0; max_encoded_len(ACK_LEN)];
    // Cannot fail: there is room for both.
    let len = seal(&mut message, ACK_LEN, &mut out).unwrap_or(0);
    out.truncate(len);
    out
}

/// The server's side: what is in transit to one client.
#[derive(Debug)]
pub struct Flow {
    sent: u64,
    acked: u64,
    window: u64,
    /// Where each write ended, and when it was.
    writes: VecDeque<(u64, Instant)>,
    /// What was written before says nothing about the window as it is now.
    changed_at: u64,
    /// The client reports what it reads.
    is_told: bool,
}

impl Default for Flow {
    fn default() -> Self {
        Self {
            sent: 0,
            acked: 0,
            window: FIRST_WINDOW,
            writes: VecDeque::new(),
            changed_at: 0,
            is_told: false,
        }
    }
}

impl Flow {
    /// Bytes that may be sent now.
    pub fn room(&self) -> u64 {
        if self.is_told { self.window.saturating_sub(self.sent - self.acked) } else { u64::MAX }
    }

    /// So many bytes were written.
    pub fn wrote(&mut self, len: usize, now: Instant) {
        self.sent += len as u64;
        if self.is_told && len > 0 {
            self.writes.push_back((self.sent, now));
        }
    }

    /// The client has read so many bytes since the connection began.
    pub fn acknowledge(&mut self, read: u64, now: Instant) {
        self.is_told = true;
        // It may count a byte that came before the first of ours.
        let read = read.min(self.sent);
        let new = read.saturating_sub(self.acked);
        let was_limited = (self.sent - self.acked) * 2 >= self.window;
        self.acked = self.acked.max(read);
        let mut latest = None;
        while let Some((end, at)) = self.writes.front().copied().filter(|(end, _)| *end <= read) {
            latest = Some((end, at));
            self.writes.pop_front();
        }
        let Some((_, at)) = latest.filter(|(end, _)| *end > self.changed_at) else { return };
        let took = now.saturating_duration_since(at);
        if took > TARGET {
            let window = u128::from(self.window) * TARGET.as_millis() / took.as_millis().max(1);
            self.window = (window as u64).max(LEAST_WINDOW);
            self.changed_at = self.sent;
        } else if was_limited && took < TARGET / 2 {
            self.window = (self.window + new).min(MOST_WINDOW);
        }
    }
}

/// The client's side: a link that says what was read from it.
pub fn acknowledging(link: Link) -> Link {
    let Link { reader, writer, keep_alive } = link;
    let output = Output { writer, unsent: Vec::new(), in_message: false };
    let output = Arc::new(Mutex::new(output));
    let reader = AckReader {
        reader,
        output: Arc::clone(&output),
        read: 0,
        told: 0,
        told_at: Instant::now(),
        refusal: None,
    };
    Link { reader: Box::new(reader), writer: Box::new(AckWriter(output)), keep_alive }
}

struct Output {
    writer: Box<dyn Write + Send>,
    /// Of an acknowledgement.
    unsent: Vec<u8>,
    /// A request is half written.
    in_message: bool,
}

impl Output {
    fn send_unsent(&mut self) -> io::Result<()> {
        while !self.unsent.is_empty() {
            let len = self.writer.write(&self.unsent)?;
            if len == 0 {
                return Err(io::ErrorKind::WriteZero.into());
            }
            self.unsent.drain(..len);
        }
        Ok(())
    }
}

fn lock(output: &Mutex<Output>) -> MutexGuard<'_, Output> {
    // Every holder leaves it whole.
    output.lock().unwrap_or_else(PoisonError::into_inner)
}

struct AckReader {
    reader: Box<dyn Read + Send>,
    output: Arc<Mutex<Output>>,
    read: u64,
    told: u64,
    told_at: Instant,
    /// Why the server does not serve, as far as it has arrived.
    refusal: Option<Vec<u8>>,
}

/// The longest reason that a server may give, in bytes.
const LONGEST_REFUSAL: usize = 300;

impl Read for AckReader {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let result = self.reader.read(out);
        // Our own protocol begins with a zero.
        let begins_refusal = self.read == 0 && matches!(&result, Ok(1..) if out[0] == REFUSAL[0]);
        if begins_refusal || self.refusal.is_some() {
            return self.read_refusal(result, out);
        }
        if let Ok(len) = &result {
            self.read += *len as u64;
        }
        let untold = self.read - self.told;
        if untold >= ACK_BYTES || untold > 0 && self.told_at.elapsed() >= ACK_AFTER {
            self.tell();
        }
        result
    }
}

impl AckReader {
    /// Collects the text in which a server says why it does not serve, and fails with it.
    fn read_refusal(&mut self, result: io::Result<usize>, out: &[u8]) -> io::Result<usize> {
        let len = result?;
        let text = self.refusal.get_or_insert_default();
        text.extend(&out[..len]);
        if len > 0 && text.len() < LONGEST_REFUSAL && !text.contains(&b'\n') {
            return Err(io::ErrorKind::WouldBlock.into());
        }
        text.truncate(LONGEST_REFUSAL);
        Err(match text.strip_prefix(REFUSAL) {
            Some(reason) => {
                let reason = String::from_utf8_lossy(reason);
                let shown = cantap_trace::clean::line(reason.trim_end());
                io::Error::new(io::ErrorKind::ConnectionRefused, format!("its server refuses: {shown}"))
            }
            None => io::Error::new(io::ErrorKind::InvalidData, "what is there is no server of cantap's"),
        })
    }

    fn tell(&mut self) {
        // While somebody writes, the next read tells.
        let Ok(mut output) = self.output.try_lock() else { return };
        if output.in_message || !output.unsent.is_empty() {
            return;
        }
        output.unsent = ack(self.read);
        (self.told, self.told_at) = (self.read, Instant::now());
        // What cannot be sent now goes before the next request; that the connection is gone, reading shows.
        let _ = output.send_unsent().and_then(|()| output.writer.flush());
    }
}

struct AckWriter(Arc<Mutex<Output>>);

impl Write for AckWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut output = lock(&self.0);
        if !output.in_message {
            output.send_unsent()?;
        }
        let len = output.writer.write(bytes)?;
        if let Some(last) = bytes[..len].last() {
            output.in_message = *last != 0;
        }
        Ok(len)
    }

    fn flush(&mut self) -> io::Result<()> {
        lock(&self.0).writer.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line with a queue that holds everything: how long what is written is on its way, at the worst, and how much got through.
    fn over_line(bytes_per_s: u64, round_trip: Duration, seconds: u64) -> (Duration, u64) {
        const STEP: Duration = Duration::from_millis(5);
        let began = Instant::now();
        let mut flow = Flow::default();
        flow.acknowledge(0, began);
        let mut queue: VecDeque<(u64, Instant)> = VecDeque::new();
        let mut acks: VecDeque<(u64, Instant)> = VecDeque::new();
        let (mut worst, mut arrived, mut budget) = (Duration::ZERO, 0, 0);
        for step in 1..=seconds * 200 {
            let now = began + STEP * step as u32;
            while flow.room() > 0 {
                flow.wrote(1000, now);
                queue.push_back((1000, now));
            }
            budget += bytes_per_s / 200;
            while let Some((len, at)) = queue.front().copied().filter(|(len, _)| *len <= budget) {
                budget -= len;
                arrived += len;
                queue.pop_front();
                if step > 400 {
                    worst = worst.max(now - at + round_trip);
                }
                acks.push_back((arrived, now + round_trip));
            }
            if queue.is_empty() {
                budget = 0;
            }
            while let Some((read, _)) = acks.front().filter(|(_, at)| *at <= now) {
                flow.acknowledge(*read, now);
                acks.pop_front();
            }
        }
        (worst, arrived / seconds)
    }

    #[test]
    fn little_is_on_its_way_on_a_slow_line_and_a_fast_one_is_used() {
        for (bytes_per_s, round_trip_ms) in [(10_000, 40), (60_000, 5), (100_000, 100), (200_000, 150)] {
            let (worst, through) = over_line(bytes_per_s, Duration::from_millis(round_trip_ms), 20);
            assert!(worst < Duration::from_secs(1), "{worst:?} at {bytes_per_s} B/s");
            assert!(through > bytes_per_s * 85 / 100, "{through} of {bytes_per_s} B/s");
        }
        let (_, through) = over_line(10_000_000, Duration::from_millis(50), 20);
        assert!(through > 250_000, "{through} B/s: two saturated channels take 210 000");
    }

    #[test]
    fn a_client_that_says_nothing_is_not_held_up_and_one_that_says_too_much_gains_nothing() {
        let now = Instant::now();
        let mut flow = Flow::default();
        flow.wrote(10_000_000, now);
        assert_eq!(flow.room(), u64::MAX);
        flow.acknowledge(u64::MAX, now);
        assert_eq!(flow.room(), FIRST_WINDOW);
        flow.wrote(FIRST_WINDOW as usize, now);
        assert_eq!(flow.room(), 0);
        flow.acknowledge(5, now);
        assert_eq!(flow.room(), 0);
    }

    /// What a writer was given, a few bytes at a time.
    #[derive(Clone, Default)]
    struct Taken(Arc<Mutex<Vec<u8>>>);

    impl Write for Taken {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let mut taken = self.0.lock().unwrap();
            let len = bytes.len().min(if taken.len() % 5 == 4 { 1 } else { 4 });
            taken.extend(&bytes[..len]);
            Ok(len)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    /// Acknowledgements stand between requests, whole, whatever the other end takes at a time.
    #[test]
    fn acknowledgements_never_cut_a_request() {
        let taken = Taken::default();
        let mut link = acknowledging(Link::new(io::repeat(7), taken.clone()));
        let mut bytes = vec![0; ACK_BYTES as usize];
        let request = [9, 9, 9, 9, 9, 9, 9, 0];
        for _ in 0..20 {
            let mut rest = &request[..];
            while !rest.is_empty() {
                link.reader.read_exact(&mut bytes).unwrap();
                let len = link.writer.write(rest).unwrap();
                rest = &rest[len..];
            }
        }
        let taken = taken.0.lock().unwrap();
        let mut acks = Vec::new();
        let mut requests = 0;
        for message in taken.split(|byte| *byte == 0).filter(|message| !message.is_empty()) {
            let mut out = [0; 64];
            if let Ok(message) = cantap_wire::framing::unseal(message, &mut out) {
                acks.push(read_ack(message).unwrap());
            } else {
                assert_eq!(message, &request[..7]);
                requests += 1;
            }
        }
        assert_eq!(requests, 20);
        assert!(acks.len() > 10 && acks.is_sorted(), "{acks:?}");
    }
}
