//! A page's connection: one WebSocket.
//!
//! Binary messages go to the page: the numbers of the first record in it, of the record after it, and of all records so far (8 bytes each,
//! little-endian), then chunks of [packed records](cantap_trace::packed), each behind its length (4 bytes). Text messages are JSON, with a
//! `type`: `hello` (once, with the server's `run`), `state` ([`State`](crate::state::State)), `notice` and `answer`. The page sends
//! [`Message`]s: requests, and how far it has taken the records in. It gets no more than a window's worth of records ahead of that: a page
//! that is slow lags behind, and is not drowned.

use std::collections::VecDeque;
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tungstenite::protocol::{CloseFrame, WebSocketConfig, frame::coding::CloseCode};
use tungstenite::{Error, Message as Frame, WebSocket};

use crate::backlog::Cursor;
use crate::request::Message;
use crate::shared::{Answer, Shared};
use crate::stream::{Connection, is_idle};
use crate::visits::{Visit, Visitor, Visits};

/// How often what has arrived is passed on: as often as a screen is drawn.
const TICK: Duration = Duration::from_millis(15);
/// Bytes of records in a message, about.
const MESSAGE_BYTES: usize = 256 << 10;
/// Bytes on their way that the page has not taken in.
const WINDOW_BYTES: usize = 1 << 20;
/// Longest message of a page.
const MOST_FROM_PAGE: usize = 64 << 10;
/// Requests of one page that wait for an answer.
const MOST_WAITING: usize = 16;
/// How often to ask whether the page is there.
const PING_EVERY: Duration = Duration::from_secs(1);
/// A page that shows nothing for this long has gone.
const GONE_AFTER: Duration = Duration::from_secs(20);

/// The session with devices that a page wants to see.
pub struct Live<'a> {
    pub shared: &'a Shared,
    /// The name of its run, so that a page knows whether its place in the records is still one.
    pub run: &'a str,
    pub visits: &'a Visits,
    /// Whether the page may still be there; an error says why not.
    pub check: &'a dyn Fn() -> Result<(), String>,
}

/// A page that is served.
pub struct Session<'a> {
    socket: WebSocket<Connection>,
    shared: &'a Shared,
    page: Arc<Visitor>,
    visits: &'a Visits,
    /// Whether it may still be there.
    check: &'a dyn Fn() -> Result<(), String>,
    cursor: Cursor,
    /// The record after each message that is on its way, and the message's length.
    under_way: VecDeque<(u64, usize)>,
    waiting: Vec<(u64, Receiver<Answer>)>,
    state_version: u64,
    notices: u64,
    latest_activity: Instant,
    pinged: Instant,
}

/// The limits of a page's messages.
pub fn config() -> WebSocketConfig {
    WebSocketConfig::default()
        .max_message_size(Some(MOST_FROM_PAGE))
        .max_frame_size(Some(MOST_FROM_PAGE))
        .read_buffer_size(8 << 10)
        .write_buffer_size(0)
}

/// Ends a connection that is not served, with the reason.
pub fn refuse(mut socket: WebSocket<Connection>, reason: &str) {
    let _ = socket.close(Some(CloseFrame { code: CloseCode::Again, reason: reason.to_owned().into() }));
    let _ = socket.flush();
}

impl<'a> Session<'a> {
    /// Goes on after the records before `from`.
    pub fn new(socket: WebSocket<Connection>, live: &Live<'a>, page: Visitor, from: u64) -> io::Result<Self> {
        socket.get_ref().set_read_timeout(TICK)?;
        let now = Instant::now();
        Ok(Self {
            socket,
            shared: live.shared,
            page: Arc::new(page),
            visits: live.visits,
            check: live.check,
            cursor: if from == 0 { Cursor::default() } else { Cursor::at(from) },
            under_way: VecDeque::new(),
            waiting: Vec::new(),
            state_version: 0,
            notices: 0,
            latest_activity: now,
            pinged: now,
        })
    }

    /// Serves it until it leaves or the server ends.
    pub fn run(mut self, run: &str) {
        let hello = json!({ "type": "hello", "run": run, "version": env!("CARGO_PKG_VERSION") });
        let mut end = None;
        if let Ok(Some(reason)) = self.text(&hello).and_then(|()| self.serve()) {
            (self.visits)(&self.page.name, Visit::Refused(reason.clone()));
            // A close frame's reason has at most 123 bytes; ours are ASCII, and a longer one is cut.
            let reason: String = reason.chars().filter(char::is_ascii).take(120).collect();
            end = Some(CloseFrame { code: CloseCode::Policy, reason: reason.into() });
        } else if self.shared.is_over() {
            end = Some(CloseFrame { code: CloseCode::Away, reason: "the server has ended".into() });
        }
        let _ = self.socket.close(end);
        let _ = self.socket.flush();
    }

    fn text(&mut self, value: &Value) -> Result<(), Error> {
        self.socket.send(Frame::text(value.to_string()))
    }

    /// Returns why it is let go, if it is for a reason.
    fn serve(&mut self) -> Result<Option<String>, Error> {
        while !self.shared.is_over() {
            self.tell_news()?;
            self.pass_records()?;
            match self.socket.read() {
                Ok(Frame::Text(text)) => {
                    self.note_activity();
                    self.take(text.as_str())?;
                }
                Ok(Frame::Binary(_)) => return Ok(None),
                Ok(_) => self.note_activity(),
                Err(Error::Io(error)) if is_idle(&error) => {}
                Err(error) => return Err(error),
            }
            if self.latest_activity.elapsed() >= GONE_AFTER {
                return Ok(None);
            }
            if self.pinged.elapsed() >= PING_EVERY {
                self.pinged = Instant::now();
                if let Err(reason) = (self.check)() {
                    return Ok(Some(reason));
                }
                self.socket.send(Frame::Ping(tungstenite::Bytes::new()))?;
            }
        }
        Ok(None)
    }

    fn note_activity(&mut self) {
        self.latest_activity = Instant::now();
        self.shared.note_activity();
    }

    /// State, notices and answers.
    fn tell_news(&mut self) -> Result<(), Error> {
        if let Some((version, state)) = self.shared.state_after(self.state_version) {
            self.state_version = version;
            let mut value = serde_json::to_value(&state).unwrap_or_default();
            value["type"] = "state".into();
            self.text(&value)?;
        }
        for notice in self.shared.notices_after(self.notices) {
            self.notices = notice.number;
            self.text(&json!({ "type": "notice", "number": notice.number, "level": notice.level, "text": notice.text }))?;
        }
        let mut at = 0;
        while at < self.waiting.len() {
            let answer = match self.waiting[at].1.try_recv() {
                Err(TryRecvError::Empty) => {
                    at += 1;
                    continue;
                }
                Err(TryRecvError::Disconnected) => Err("the server is ending".to_owned()),
                Ok(answer) => answer,
            };
            let (number, _) = self.waiting.remove(at);
            self.answer(number, answer)?;
        }
        Ok(())
    }

    fn answer(&mut self, number: u64, answer: Answer) -> Result<(), Error> {
        self.text(&match answer {
            Ok(value) => json!({ "type": "answer", "number": number, "ok": value }),
            Err(reason) => json!({ "type": "answer", "number": number, "error": reason }),
        })
    }

    fn pass_records(&mut self) -> Result<(), Error> {
        while self.under_way.iter().map(|(_, len)| len).sum::<usize>() < WINDOW_BYTES {
            let Some(taken) = self.shared.backlog.take(&mut self.cursor, MESSAGE_BYTES) else {
                return Ok(());
            };
            if taken.gone > 0 {
                (self.visits)(&self.page.name, Visit::Missed(taken.gone));
            }
            let numbers = [taken.first, self.cursor.next, taken.latest];
            let mut message: Vec<u8> = numbers.into_iter().flat_map(u64::to_le_bytes).collect();
            message.extend(taken.chunks);
            self.under_way.push_back((self.cursor.next, message.len()));
            self.socket.send(Frame::binary(message))?;
        }
        Ok(())
    }

    fn take(&mut self, text: &str) -> Result<(), Error> {
        match serde_json::from_str(text) {
            Ok(Message::Received { received }) => self.under_way.retain(|(next, _)| *next > received),
            Ok(Message::Request { number, .. }) if self.waiting.len() >= MOST_WAITING => {
                self.answer(number, Err("too many requests at a time; wait for the answers".to_owned()))?;
            }
            Ok(Message::Request { number, request }) => {
                match self.shared.order(request, Arc::clone(&self.page)) {
                    Ok(answer) => self.waiting.push((number, answer)),
                    Err(reason) => self.answer(number, Err(reason))?,
                }
            }
            Err(_) => {
                // Without a number it cannot be answered otherwise. It concerns this page alone, so it has no number either.
                let text = "the server did not understand the page; load it anew";
                self.text(&json!({ "type": "notice", "number": null, "level": "warning", "text": text }))?;
            }
        }
        Ok(())
    }
}
