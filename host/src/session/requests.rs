//! Requests to a device: numbering them, sending them, and matching answers to them.

use std::collections::HashMap;
use std::io::Write;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap_wire::framing::{self, CRC_LEN, MAX_REQUEST, max_encoded_len};
use cantap_wire::{Command, Refusal, Reply, Request};

use super::error::{DeviceError, Gone};
use super::link::is_idle;
use super::plausible::believe;
use super::watch::LONGEST_PASS;

/// A device makes the host wait while it has no room; one that accepts nothing for this long is stuck.
const WRITE_PATIENCE: Duration = Duration::from_secs(2);
/// How long a failed write waits for what reading says of the end.
const END_PATIENCE: Duration = Duration::from_millis(300);

/// What a device answers.
type Answer = Result<Reply, Refusal>;

/// The requests of one session. `N` is what their sender notes with each, for when its answer comes in the device's stream.
pub struct Requests<N> {
    name: String,
    output: Mutex<Output>,
    table: Mutex<Table<N>>,
    ended: Condvar,
}

/// The direction towards the device.
struct Output {
    /// `None` when the session is over.
    port: Option<Box<dyn Write + Send>>,
    /// The last message was cut short: the next one must not be read as its end.
    is_cut: bool,
}

impl Output {
    fn write(&mut self, bytes: &[u8], patience: Duration) -> std::io::Result<()> {
        let port = self.port.as_mut().ok_or(std::io::ErrorKind::NotConnected)?;
        if self.is_cut {
            write_patiently(port, &[0], patience)?;
        }
        self.is_cut = true;
        write_patiently(port, bytes, patience)?;
        self.is_cut = false;
        port.flush()
    }
}

struct Table<N> {
    /// Our first request number.
    first_id: u16,
    next_id: u16,
    waiting: HashMap<u16, Waiting<N>>,
    /// Nobody needs the session any more.
    quits: bool,
    /// The session must end, for this reason.
    must_end: Option<String>,
    gone: Option<Gone>,
}

/// A request that was not answered yet.
pub struct Waiting<N> {
    /// What its sender noted.
    pub note: N,
    answer: Option<SyncSender<Answer>>,
}

impl<N> Waiting<N> {
    /// Passes the answer to whoever waits for it.
    pub fn answer(self, result: Answer) {
        if let Some(answer) = self.answer {
            // The channel has room for one; it does not matter if nobody waits any more.
            let _ = answer.try_send(result);
        }
    }
}

impl<N> Requests<N> {
    pub(super) fn new(name: &str, port: Box<dyn Write + Send>) -> Self {
        // Answers to an earlier host must not be mistaken for ours, so begin at an arbitrary number.
        let start = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let first_id = start.map_or(1, |since| (since.as_micros() >> 4) as u16);
        let waiting = HashMap::new();
        let table = Table { first_id, next_id: first_id, waiting, quits: false, must_end: None, gone: None };
        Self {
            name: name.to_owned(),
            output: Mutex::new(Output { port: Some(port), is_cut: false }),
            table: Mutex::new(table),
            ended: Condvar::new(),
        }
    }

    fn table(&self) -> MutexGuard<'_, Table<N>> {
        lock(&self.table)
    }

    /// The device's name in messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Why the session is over, if it is.
    pub fn gone(&self) -> Option<DeviceError> {
        self.table().gone.as_ref().map(|gone| gone.error(&self.name))
    }

    /// Waits until the session is over, at most `timeout`. Returns why.
    pub fn wait_until_gone(&self, timeout: Duration) -> Option<DeviceError> {
        let is_there = |table: &mut Table<N>| table.gone.is_none();
        let waited = self.ended.wait_timeout_while(self.table(), timeout, is_there);
        let table = waited.unwrap_or_else(PoisonError::into_inner).0;
        table.gone.as_ref().map(|gone| gone.error(&self.name))
    }

    /// Sends a request. Its answer is waited for with what this returns, so several can be in flight: a device handles them in order.
    pub fn send(&self, command: Command, note: N) -> Result<InFlight<'_, N>, DeviceError> {
        let (sender, answers) = sync_channel(1);
        let id = self.send_to(command, note, Some(sender))?;
        Ok(InFlight { requests: self, id, answers })
    }

    /// Sends a request for whose answer nobody waits; it only comes in the stream.
    pub fn send_unattended(&self, command: Command, note: N) -> Result<(), DeviceError> {
        self.send_to(command, note, None).map(|_| ())
    }

    fn send_to(
        &self,
        command: Command,
        note: N,
        answer: Option<SyncSender<Answer>>,
    ) -> Result<u16, DeviceError> {
        let id = self.note(Waiting { note, answer })?;
        let sent = encode(&Request { id, command }).and_then(|bytes| self.write(&bytes));
        sent.inspect_err(|_| self.forget(id))?;
        Ok(id)
    }

    /// Sends a request unless that would have to wait: for the thread that reads, for which nothing may wait.
    pub(super) fn send_at_once(&self, command: Command, note: N) {
        let Ok(mut output) = self.output.try_lock() else { return };
        let Ok(id) = self.note(Waiting { note, answer: None }) else { return };
        if let Ok(bytes) = encode(&Request { id, command }) {
            // If it fails, reading fails too and says why, or the missing answer is noticed.
            let _ = output.write(&bytes, Duration::ZERO);
        }
    }

    /// Notes a request. Returns its number.
    fn note(&self, waiting: Waiting<N>) -> Result<u16, DeviceError> {
        let mut table = self.table();
        if let Some(gone) = &table.gone {
            return Err(gone.error(&self.name));
        }
        let id = table.next_id;
        table.next_id = id.wrapping_add(1);
        table.waiting.insert(id, waiting);
        Ok(id)
    }

    fn forget(&self, id: u16) {
        self.table().waiting.remove(&id);
    }

    /// Writes bytes as they are.
    pub(super) fn write(&self, bytes: &[u8]) -> Result<(), DeviceError> {
        let written = lock(&self.output).write(bytes, WRITE_PATIENCE);
        written.map_err(|error| {
            if is_idle(&error) {
                return self.gone().unwrap_or(DeviceError::Timeout { seconds: WRITE_PATIENCE.as_secs_f32() });
            }
            // A server says why before it closes, which the reading thread sees.
            let gone = self.wait_until_gone(END_PATIENCE);
            gone.unwrap_or_else(|| Gone::Vanished(error.to_string()).error(&self.name))
        })
    }

    /// Ends the session for this reason: the thread that reads does so at once.
    pub fn end(&self, reason: &str) {
        self.table().must_end.get_or_insert_with(|| reason.to_owned());
    }

    pub(super) fn must_end(&self) -> Option<String> {
        self.table().must_end.clone()
    }

    /// Nobody needs the session any more.
    pub(super) fn quit(&self) {
        self.table().quits = true;
    }

    /// Whether to stop, and if so, whether a request is unanswered.
    pub(super) fn quits(&self) -> Option<bool> {
        let table = self.table();
        table.quits.then_some(!table.waiting.is_empty())
    }

    /// Whether one of our requests had this number. (After 65,536 requests, every number was ours.)
    pub(super) fn is_ours(&self, id: u16) -> bool {
        let table = self.table();
        id.wrapping_sub(table.first_id) < table.next_id.wrapping_sub(table.first_id)
    }

    /// The request that is answered.
    pub(super) fn take(&self, id: u16) -> Option<Waiting<N>> {
        self.table().waiting.remove(&id)
    }

    /// Gives every request the same answer.
    pub(super) fn answer_all(&self, result: &Answer) {
        for (_, waiting) in self.table().waiting.drain() {
            waiting.answer(result.clone());
        }
    }

    /// The session is over: `then` is done before anybody who waits for an answer learns that none will come.
    pub(super) fn gone_for(&self, gone: Gone, then: impl FnOnce(DeviceError)) {
        let error = gone.error(&self.name);
        self.table().gone = Some(gone);
        then(error);
        self.table().waiting.clear();
        self.ended.notify_all();
    }

    /// Closes the direction towards the device.
    pub(super) fn close(&self) {
        lock(&self.output).port = None;
    }
}

/// A request under way. Dropping it ignores the answer.
#[must_use = "the answer may be a refusal"]
pub struct InFlight<'r, N> {
    requests: &'r Requests<N>,
    id: u16,
    answers: Receiver<Answer>,
}

impl<N> InFlight<'_, N> {
    #[cfg(test)]
    pub(super) const fn id(&self) -> u16 {
        self.id
    }

    /// Waits for the answer, at most `timeout`: a value that is possible, or an error.
    pub fn reply_within(self, timeout: Duration) -> Result<Reply, DeviceError> {
        match self.answer_within(timeout)? {
            Ok(reply) => believe(reply),
            Err(Refusal::Protocol { device }) => Err(DeviceError::Protocol { device }),
            Err(refusal) => Err(DeviceError::Refused { refusal }),
        }
    }

    /// The same, but the answer as it comes. An error says why there is none.
    pub fn answer_within(self, timeout: Duration) -> Result<Answer, DeviceError> {
        while_listening(timeout, |piece| self.answers.recv_timeout(piece)).map_err(|_| {
            self.requests.gone().unwrap_or(DeviceError::Timeout { seconds: timeout.as_secs_f32() })
        })
    }
}

impl<N> Drop for InFlight<'_, N> {
    fn drop(&mut self) {
        self.requests.forget(self.id);
    }
}

/// Receives something, waiting for this long by pieces, however long each takes: while this program stood still, as after Ctrl-Z, nobody was listening to
/// the device, which may have answered long ago.
fn while_listening<T>(
    mut left: Duration,
    mut receive: impl FnMut(Duration) -> Result<T, RecvTimeoutError>,
) -> Result<T, RecvTimeoutError> {
    loop {
        let piece = left.min(LONGEST_PASS);
        match receive(piece) {
            Err(RecvTimeoutError::Timeout) if left > piece => left -= piece,
            received => return received,
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every holder leaves the state consistent, even if it panicked elsewhere.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Writes everything, waiting as long as the other end accepts something at least every `patience`.
pub fn write_patiently(
    port: &mut (impl Write + ?Sized),
    mut bytes: &[u8],
    patience: Duration,
) -> std::io::Result<()> {
    let mut moved = Instant::now();
    while !bytes.is_empty() {
        match port.write(bytes) {
            Ok(0) => return Err(std::io::ErrorKind::WriteZero.into()),
            Ok(len) => {
                bytes = &bytes[len..];
                moved = Instant::now();
            }
            Err(error) if is_idle(&error) && moved.elapsed() < patience => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Encodes a request as it goes over the wire.
pub fn encode(request: &Request) -> Result<Vec<u8>, DeviceError> {
    let mut message = [0; MAX_REQUEST + CRC_LEN];
    let mut out = vec![0; max_encoded_len(MAX_REQUEST)];
    let encoded = framing::encode(request, &mut message, &mut out).ok_or(DeviceError::RequestTooLong)?;
    out.truncate(encoded);
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// After Ctrl-Z and three seconds, a device that was there was not to have answered.
    #[test]
    fn the_time_in_which_the_program_stood_still_is_not_the_devices() {
        let after = |pieces: u32, timeout: Duration| {
            let (mut count, mut listened) = (0, Duration::ZERO);
            let received = while_listening(timeout, |piece| {
                listened += piece;
                count += 1;
                // However long this piece really took.
                if count > pieces { Ok(()) } else { Err(RecvTimeoutError::Timeout) }
            });
            (received, listened)
        };
        let two = Duration::from_secs(2);
        assert_eq!(after(0, two), (Ok(()), LONGEST_PASS));
        assert_eq!(after(19, two), (Ok(()), two));
        assert_eq!(after(20, two), (Err(RecvTimeoutError::Timeout), two));
        let short = LONGEST_PASS + Duration::from_millis(7);
        assert_eq!(after(9, short), (Err(RecvTimeoutError::Timeout), short));
        let gone = while_listening(two, |_| Err::<(), _>(RecvTimeoutError::Disconnected));
        assert_eq!(gone, Err(RecvTimeoutError::Disconnected));
    }
}
