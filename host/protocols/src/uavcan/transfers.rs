//! Transfers from their frames.

use rustc_hash::FxHashMap;

use super::header::{Header, Tail, first_toggle};
use crate::dsdl::Generation;
use crate::{Bytes, Party, Trouble};

/// How many identifiers are followed at once.
const MOST_SESSIONS: usize = 1024;
/// The most bytes that are kept of a transfer.
const MOST_BYTES: usize = 65_536;
/// After so long without its next frame, a transfer has ended; both specifications propose two seconds.
const GAP_NS: i64 = 2_000_000_000;

/// A transfer that has ended.
#[derive(Clone, Debug)]
pub(crate) struct Transfer {
    pub channel: u8,
    pub header: Header,
    /// Of its first and its last frame.
    pub start_ns: i64,
    pub time_ns: i64,
    pub id: u8,
    /// Without the last bytes of frames; with the CRC if it took several.
    pub payload: Bytes,
    pub frames: u32,
    pub is_fd: bool,
    pub trouble: Option<Trouble>,
    pub frames_lost: bool,
}

/// One identifier's last transfer.
#[derive(Clone, Debug)]
enum Session {
    Open(Transfer, Last),
    /// It has ended, but its last frame may come again.
    Done(i64, Last),
    /// Frames of a transfer come whose beginning is missing, which has been said.
    Headless(i64),
}

/// The frame before.
#[derive(Clone, Debug)]
struct Last {
    tail: Tail,
    data: Bytes,
}

/// A frame of a transfer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Part<'a> {
    pub channel: u8,
    pub time_ns: i64,
    pub id: u32,
    pub header: Header,
    pub tail: Tail,
    pub payload: &'a [u8],
    pub is_fd: bool,
}

/// Puts frames together.
#[derive(Debug)]
pub(crate) struct Transfers {
    generation: Generation,
    sessions: FxHashMap<(u8, u32), Session>,
}

impl Transfers {
    pub fn new(generation: Generation) -> Self {
        Self { generation, sessions: FxHashMap::default() }
    }

    /// Takes a frame and passes on what ends with it.
    pub fn take(&mut self, part: Part<'_>, out: &mut dyn FnMut(Transfer)) {
        let Part { channel, time_ns, id, tail, .. } = part;
        let key = (channel, id);
        if tail.starts {
            // First frames of the other language are not ours.
            if tail.toggle != first_toggle(self.generation) {
                return;
            }
            match self.sessions.remove(&key) {
                // Sent again because its acknowledgement was not seen.
                Some(Session::Open(open, last)) if last.is_same(&part) => {
                    self.sessions.insert(key, Session::Open(open, last));
                    return;
                }
                Some(Session::Open(open, _)) => out(open.broken(Trouble::Overlapped)),
                Some(Session::Done(..) | Session::Headless(_)) | None => {}
            }
            if tail.ends {
                out(Transfer::of(&part));
                return;
            }
            self.make_room(out);
            self.sessions.insert(key, Session::Open(Transfer::of(&part), Last::of(&part)));
            return;
        }
        if let Some(Session::Done(_, last)) = self.sessions.get(&key)
            && last.is_same(&part)
        {
            return;
        }
        let Some(Session::Open(open, last)) = self.sessions.get_mut(&key) else {
            if !matches!(self.sessions.get(&key), Some(Session::Headless(_))) {
                self.make_room(out);
                out(Transfer::of(&part).broken(Trouble::Headless));
            }
            self.sessions.insert(key, Session::Headless(time_ns));
            return;
        };
        if last.is_same(&part) {
            return;
        }
        if tail.transfer != last.tail.transfer || tail.toggle == last.tail.toggle {
            let trouble = if tail.transfer == last.tail.transfer {
                Trouble::Sequence { expected: open.frames, got: open.frames + 1 }
            } else {
                Trouble::Malformed("its end is missing, and the beginning of the next")
            };
            // What follows belongs to what has just been said to be broken.
            if let Some(Session::Open(open, _)) = self.sessions.insert(key, Session::Headless(time_ns)) {
                out(open.broken(trouble));
            }
            return;
        }
        open.time_ns = time_ns;
        open.frames += 1;
        open.is_fd |= part.is_fd;
        let room = MOST_BYTES.saturating_sub(open.payload.len());
        if part.payload.len() > room {
            open.trouble = Some(Trouble::Cut);
        }
        open.payload.extend_from_slice(&part.payload[..part.payload.len().min(room)]);
        *last = Last::of(&part);
        if tail.ends
            && let Some(Session::Open(done, last)) = self.sessions.remove(&key)
        {
            self.sessions.insert(key, Session::Done(time_ns, last));
            out(done);
        }
    }

    /// Ends what has waited too long.
    pub fn sweep(&mut self, now_ns: i64, out: &mut Vec<Transfer>) {
        let before = out.len();
        self.sessions.retain(|_, session| match session {
            Session::Open(open, _) if now_ns.saturating_sub(open.time_ns) > GAP_NS => {
                let mut late =
                    open.clone().broken(Trouble::Timeout { after_ms: (GAP_NS / 1_000_000) as u32 });
                late.time_ns = late.time_ns.saturating_add(GAP_NS);
                out.push(late);
                false
            }
            Session::Done(since_ns, _) | Session::Headless(since_ns) => {
                now_ns.saturating_sub(*since_ns) <= GAP_NS
            }
            Session::Open(..) => true,
        });
        out[before..].sort_by_key(|one| (one.time_ns, one.channel, one.header.port));
    }

    /// Frames of the channel may be missing.
    pub fn gap(&mut self, channel: u8) {
        for ((of, _), session) in &mut self.sessions {
            if let Session::Open(open, _) = session
                && *of == channel
            {
                open.frames_lost = true;
            }
        }
    }

    /// The trace has ended.
    pub fn finish(&mut self, out: &mut Vec<Transfer>) {
        let open = self.sessions.drain().filter_map(|(_, session)| match session {
            Session::Open(open, _) => Some(open.broken(Trouble::Unfinished)),
            Session::Done(..) | Session::Headless(_) => None,
        });
        out.extend(open);
        out.sort_by_key(|one| (one.start_ns, one.channel, one.header.port));
    }

    /// Those that have begun.
    pub fn open(&self) -> impl Iterator<Item = &Transfer> {
        self.sessions.values().filter_map(|session| match session {
            Session::Open(open, _) => Some(open),
            Session::Done(..) | Session::Headless(_) => None,
        })
    }

    /// Gives up the oldest.
    fn make_room(&mut self, out: &mut dyn FnMut(Transfer)) {
        if self.sessions.len() < MOST_SESSIONS {
            return;
        }
        let since = |session: &Session| match session {
            Session::Open(open, _) => open.time_ns,
            Session::Done(time_ns, _) | Session::Headless(time_ns) => *time_ns,
        };
        let oldest = self.sessions.iter().min_by_key(|(key, session)| (since(session), **key));
        if let Some(key) = oldest.map(|(key, _)| *key)
            && let Some(Session::Open(open, _)) = self.sessions.remove(&key)
        {
            out(open.broken(Trouble::GivenUp));
        }
    }
}

impl Transfer {
    fn of(part: &Part<'_>) -> Self {
        Self {
            channel: part.channel,
            header: part.header,
            start_ns: part.time_ns,
            time_ns: part.time_ns,
            id: part.tail.transfer,
            payload: Bytes::from_slice(part.payload),
            frames: 1,
            is_fd: part.is_fd,
            trouble: None,
            frames_lost: false,
        }
    }

    fn broken(mut self, trouble: Trouble) -> Self {
        self.trouble = Some(trouble);
        self
    }

    /// Who sent it to whom.
    pub fn parties(&self) -> (Party, Party) {
        (self.header.from(), self.header.to())
    }
}

impl Last {
    fn of(part: &Part<'_>) -> Self {
        Self { tail: part.tail, data: Bytes::from_slice(part.payload) }
    }

    fn is_same(&self, part: &Part<'_>) -> bool {
        self.tail == part.tail && self.data[..] == *part.payload
    }
}
