//! The thread that reads a device's stream, and what it notices itself: that the session is over, or that nothing is answered any more.

use std::io::Read;
use std::ops::ControlFlow;
use std::time::Instant;

use cantap_wire::{Command, Refusal, Reply, Response};

use super::error::{DeviceError, Gone, SessionOver};
use super::link::is_idle;
use super::requests::{Requests, Waiting};
use super::watch::{Next, SilenceWatch};

/// Bytes read at a time; an operating system's serial buffer is smaller.
const READ_BYTES: usize = 64 * 1024;

/// Takes a device's stream. It is called by the session's thread and must not wait for anything.
pub trait Sink: Send + 'static {
    /// What is noted with a request, for when its answer comes in the stream; the default is for requests that need nothing.
    type Note: Default + Send + 'static;

    /// Takes what one read brought, which may be nothing. It decodes the bytes and reports to `pass` what they say of the session. The
    /// session ends if it returns [`ControlFlow::Break`].
    fn take(&mut self, bytes: &[u8], pass: &mut Pass<'_, Self::Note>) -> ControlFlow<()>;

    /// What is noted with the thread's own requests for the device's time.
    fn time_note(&self) -> Self::Note {
        Self::Note::default()
    }

    /// Nothing follows: for this reason, or because nobody needs the session any more. Whoever waits for an answer learns that none will
    /// come only after this.
    fn over(&mut self, reason: Option<DeviceError>);
}

/// What one read says of the session.
pub struct Pass<'s, N> {
    requests: &'s Requests<N>,
    /// `Hello` was answered; anything earlier belongs to another program's session.
    in_session: &'s mut bool,
    answered: bool,
    end: Option<SessionOver>,
}

impl<N> Pass<'_, N> {
    /// Whether `Hello` was answered; anything earlier belongs to another program's session.
    pub const fn is_in_session(&self) -> bool {
        *self.in_session
    }

    /// Notes an answer. Returns the request, if it is one of ours and still waits. Whoever is refused because the session is over learns why,
    /// once the read that shows it was taken.
    pub fn response(&mut self, response: &Response) -> Option<Waiting<N>> {
        self.answered = true;
        if *self.in_session
            && let Some(over) = over_by(response, self.requests.is_ours(response.id))
        {
            self.end(over);
            if over == SessionOver::Refused {
                return None;
            }
        }
        *self.in_session |= matches!(response.result, Ok(Reply::Hello(_)));
        self.requests.take(response.id)
    }

    /// Notes that the device speaks another protocol version.
    pub fn other_protocol(&mut self, device: u16) {
        self.requests.answer_all(&Err(Refusal::Protocol { device }));
    }

    /// Notes that the device has ended the session: its own reason says more than what else shows it.
    pub fn end_by_device(&mut self, reason: SessionOver) {
        self.end = Some(reason);
    }

    /// Notes that the session is over; the first reason counts.
    pub fn end(&mut self, reason: SessionOver) {
        self.end.get_or_insert(reason);
    }
}

/// Whether an answer shows that our session is over. `is_ours`: whether one of our requests had its number.
pub fn over_by(response: &Response, is_ours: bool) -> Option<SessionOver> {
    match response.result {
        Err(Refusal::NoSession) => Some(SessionOver::Refused),
        Ok(Reply::Hello(_)) if !is_ours => Some(SessionOver::Greeted),
        _ => None,
    }
}

/// The thread's body.
pub(super) fn run<S: Sink>(mut reader: Box<dyn Read + Send>, requests: &Requests<S::Note>, sink: &mut S) {
    let mut bytes = vec![0; READ_BYTES];
    let mut watch = SilenceWatch::default();
    let mut passed_at = Instant::now();
    let mut in_session = false;
    let gone = loop {
        let len = match reader.read(&mut bytes) {
            Ok(0) => break Gone::Vanished("the connection was closed".to_owned()),
            Ok(len) => len,
            Err(error) if is_idle(&error) => 0,
            Err(error) => break Gone::Vanished(error.to_string()),
        };
        if let Some(is_waiting) = requests.quits() {
            if is_waiting {
                // Closing the port at once may discard what is still to be written.
                let _ = reader.read(&mut bytes);
            }
            return sink.over(None);
        }
        let mut pass = Pass { requests, in_session: &mut in_session, answered: false, end: None };
        let flow = sink.take(&bytes[..len], &mut pass);
        let Pass { answered, end, .. } = pass;
        if flow.is_break() {
            return sink.over(None);
        }
        if let Some(reason) = requests.must_end() {
            break Gone::Vanished(reason);
        }
        if let Some(end) = end {
            break Gone::Ended(end);
        }
        let now = Instant::now();
        let passed = now.duration_since(std::mem::replace(&mut passed_at, now));
        if in_session {
            match watch.pass(passed, answered) {
                Next::Listen => {}
                Next::Ask => requests.send_at_once(Command::Time, sink.time_note()),
                Next::GiveUp(silent) => break Gone::Silent(silent),
            }
        }
    };
    requests.gone_for(gone, |error| sink.over(Some(error)));
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    /// A server that ends says so, and refuses what was asked meanwhile: both may be in one read.
    #[test]
    fn a_request_at_the_end_of_a_session_is_answered_with_why_it_ended() {
        let requests = Requests::<()>::new("board", Box::new(std::io::sink()));
        let pending = requests.send(Command::Status, ()).unwrap();
        let refused = Response { id: pending.id(), result: Err(Refusal::NoSession) };
        let mut in_session = true;
        let mut pass = Pass { requests: &requests, in_session: &mut in_session, answered: false, end: None };
        pass.end_by_device(SessionOver::ServerEnded);
        assert!(pass.response(&refused).is_none());
        let end = pass.end.unwrap();
        requests.gone_for(Gone::Ended(end), |_| {});
        let answer = pending.reply_within(Duration::ZERO);
        assert!(
            matches!(answer, Err(DeviceError::SessionEnded { reason: SessionOver::ServerEnded, .. })),
            "{answer:?}"
        );
    }
}
