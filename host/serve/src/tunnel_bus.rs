//! What the ends of cannelloni's tunnels have in common, over UDP and over TCP: a channel of a board, which is only listened to until the far end sends.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use cantap::{Direction, TraceEvent, TraceFrame};
use cantap_codecs::cannelloni::Item;
use cantap_trace::counted;
use cantap_wire::Channel;
use cantap_wire::message::{Mode, Role};

use crate::Board;
use crate::feed::Source;
use crate::left_out::LeftOut;
use crate::lines::device_of;
use crate::lock::lock;
use crate::open_bus::OpenBus;
use crate::own_frames::OwnFrames;
use crate::text::error_frame;

/// What a far end has sent and was not told.
#[derive(Default)]
pub struct TunnelBus {
    own: Mutex<OwnFrames>,
    /// The tunnel was off the bus for a moment.
    has_gap: AtomicBool,
    /// See [`LeftOut`].
    pub left_out: Mutex<LeftOut>,
}

/// What a far end is told.
pub enum Told<'e> {
    /// A frame that somebody else has sent.
    Frame(&'e TraceFrame),
    /// An error frame: its classes, and its data.
    Error(u32, [u8; 8]),
}

/// Opens a channel for a far end, with what is on the bus from then on.
pub fn open(
    board: &Arc<Board>,
    channel: Channel,
    name: &str,
    role: Role,
) -> Result<(OpenBus, Source), String> {
    let device = Arc::new(device_of(board, name, role)?);
    let config = device.open_channel(channel, None).map_err(|error| error.to_string())?;
    let source = Source::new(board, &device);
    let sends_in = (role >= Role::Send).then_some(Mode::Normal);
    Ok((OpenBus::new(device, channel, config, sends_in, board.idle_sender()), source))
}

impl TunnelBus {
    /// The tunnel was off the bus for a moment.
    pub fn missed(&self) {
        self.has_gap.store(true, Ordering::Relaxed);
    }

    /// Whether it was since the last time.
    pub fn take_gap(&self) -> bool {
        self.has_gap.swap(false, Ordering::Relaxed)
    }

    /// Has frames sent, in their order. What follows one that is refused is not sent either.
    pub fn send(&self, bus: Option<&mut OpenBus>, frames: &[TraceFrame]) -> Result<(), String> {
        if frames.is_empty() {
            return Ok(());
        }
        let not_sent =
            |reason: String, count: usize| format!("not sent: {}: {reason}", counted(count, "frame"));
        let Some(bus) = bus else {
            return Err(not_sent("the board is not there".to_owned(), frames.len()));
        };
        if bus.sends_in.is_none() {
            return Err(not_sent("it may only listen".to_owned(), frames.len()));
        }
        bus.may_send(|| self.missed()).map_err(|reason| not_sent(reason, frames.len()))?;
        for (done, frame) in frames.iter().enumerate() {
            let tag = bus.next_tag();
            lock(&self.own).sends(tag, *frame);
            bus.send(tag, *frame).map_err(|reason| {
                lock(&self.own).failed(tag);
                not_sent(reason, frames.len() - done)
            })?;
        }
        Ok(())
    }

    /// What the far end is told of an event; nothing of its own frames.
    pub fn told<'e>(&self, event: &'e TraceEvent) -> Option<Told<'e>> {
        match event {
            TraceEvent::Frame { frame, direction, .. } => {
                let is_own = *direction == Direction::Tx && lock(&self.own).take(*frame);
                (!is_own).then_some(Told::Frame(frame))
            }
            event => {
                lock(&self.own).event(event);
                error_frame(event).map(|(id, data)| Told::Error(id, data))
            }
        }
    }
}

/// What a far end has sent: the frames that can be sent on, and how many others of which kind.
#[derive(Default)]
pub struct Sorted {
    /// In their order.
    pub frames: Vec<TraceFrame>,
    errors: usize,
    fd: usize,
    impossible: usize,
}

impl Sorted {
    /// Adds an item; `sends_fd` says whether the board sends CAN FD frames.
    pub fn push(&mut self, item: Item, sends_fd: bool) {
        match item {
            Item::Frame(frame) => self.frames.push(frame.into()),
            Item::Error => self.errors += 1,
            Item::Fd(frame) if sends_fd => self.frames.push(frame.into()),
            Item::Fd(_) => self.fd += 1,
            Item::Impossible => self.impossible += 1,
        }
    }

    /// What is not sent on, in words.
    pub fn left_out(&self) -> impl Iterator<Item = String> {
        let kinds = [
            (self.errors, "error frames"),
            (self.fd, "CAN FD frames, which the board cannot send"),
            (self.impossible, "frames that are none"),
        ];
        kinds
            .into_iter()
            .filter(|(count, _)| *count > 0)
            .map(|(count, what)| format!("it sent {count} {what}"))
    }
}
