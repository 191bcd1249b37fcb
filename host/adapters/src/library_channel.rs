//! What adapters behind their makers' libraries have in common: one channel, messages that are asked for, and sent frames that come back without
//! a number.

use std::time::{Duration, Instant};

use cantap_trace::{TraceFrame, clean};
use cantap_wire::Channel;
use cantap_wire::record::{ErrorState, LossStage};

use crate::driver::{At, Incoming, Oddities};
use crate::error_frames::ErrorFrames;
use crate::under_way::UnderWay;

/// How often the library is asked for messages while there are none, and for the state of the bus.
const ASK_EVERY: Duration = Duration::from_millis(1);
const STATUS_EVERY: Duration = Duration::from_millis(100);
/// Messages that one call of [`crate::driver::Driver::poll`] takes.
pub(crate) const MESSAGES: usize = 1024;
/// Messages that are read when a channel leaves its bus: more than any library keeps.
pub(crate) const MESSAGES_AT_THE_END: usize = 1 << 16;
/// The adapter's only one.
const CHANNEL: Channel = Channel::Can1;

/// The channel of such an adapter.
pub(crate) struct LibraryChannel {
    under_way: UnderWay,
    errors: ErrorFrames,
    /// Bits of the status that report losses and have been reported.
    reported: u32,
    asked: Instant,
    backlog: Vec<Incoming>,
    /// What makes no sense.
    pub oddities: Oddities,
    ended: Option<String>,
}

impl LibraryChannel {
    /// On no bus.
    pub fn new() -> Self {
        Self {
            under_way: UnderWay::default(),
            errors: ErrorFrames::default(),
            reported: 0,
            asked: Instant::now(),
            backlog: Vec::new(),
            oddities: Oddities::default(),
            ended: None,
        }
    }

    /// It is on its bus.
    pub fn begin(&mut self) {
        (self.reported, self.asked) = (0, Instant::now());
    }

    /// It has left its bus: nothing will be confirmed any more.
    pub fn leave(&mut self) {
        self.under_way.clear();
        self.errors = ErrorFrames::default();
    }

    /// The adapter's end, in its driver's words; the first of several is the reason.
    pub fn end(&mut self, words: &str) {
        self.ended.get_or_insert_with(|| format!("its driver says: {}", clean::line(words)));
    }

    /// Whether it is time to ask for the state of the bus.
    pub fn asks_now(&mut self, now: Instant) -> bool {
        let asks = now.duration_since(self.asked) >= STATUS_EVERY;
        if asks {
            self.asked = now;
        }
        asks
    }

    /// What is to be reported as it is.
    pub fn report(&mut self, incoming: Incoming) {
        self.backlog.push(incoming);
    }

    /// At least one frame is missing here.
    pub fn lost(&mut self, stage: LossStage, at: At) {
        self.report(Incoming::Lost { channel: CHANNEL, stage, count: 1, at_least: true, at });
    }

    /// A message came: a frame, if it can be one, of this computer's if `is_ours`. Returns what was sent by somebody else here.
    pub fn take(&mut self, frame: Option<TraceFrame>, is_ours: bool, at: At) -> Option<TraceFrame> {
        let channel = CHANNEL;
        let Some(frame) = frame else {
            self.oddities.count("messages that are no frames");
            self.lost(LossStage::Link, at);
            return None;
        };
        if !is_ours {
            self.report(Incoming::Received { channel, frame, at });
            return None;
        }
        let Some(mailbox) = self.under_way.confirm(&frame) else { return Some(frame) };
        self.report(Incoming::Sent { channel, mailbox, at });
        None
    }

    /// Reports losses before a message, by its flags. The status that tells of them, too, does not make more of them.
    pub fn losses_before(&mut self, flags: u32, bits: [(u32, LossStage); 2], at: At) {
        for (bit, stage) in bits {
            if flags & bit != 0 {
                self.reported |= bit;
                self.lost(stage, at);
            }
        }
    }

    /// Reports losses that a status tells, and not again for as long as it does: bits may stay set.
    pub fn losses(&mut self, status: u32, bits: [(u32, LossStage); 2], at: At) {
        for (bit, stage) in bits {
            if status & bit & !self.reported != 0 {
                self.reported |= bit;
                self.lost(stage, at);
            }
        }
    }

    /// The status is this: losses that it no longer tells are new ones when it tells them again.
    pub const fn forget_losses(&mut self, status: u32) {
        self.reported &= status;
    }

    /// The state of fault confinement, which is reported if it is news.
    pub fn state(&mut self, state: ErrorState, counters: Option<(u8, u8)>, at: At) {
        self.errors.set(state, counters, CHANNEL, at, &mut self.backlog);
    }

    /// The error counters, in the state as it was.
    pub fn counters(&mut self, counters: (u8, u8), at: At) {
        if let Some(state) = self.errors.state() {
            self.state(state, Some(counters), at);
        }
    }

    /// A frame was taken, to be confirmed later.
    pub fn sent(&mut self, mailbox: u8, frame: TraceFrame) {
        self.under_way.push(mailbox, frame);
    }

    /// A frame cannot be sent, for this reason.
    pub fn not_sent(&mut self, mailbox: u8, why: &'static str) {
        self.oddities.count(why);
        self.report(Incoming::NotSent { channel: CHANNEL, mailbox, at: At::arrival(Instant::now()) });
    }
}

/// Why a frame is not sent.
pub(crate) const TOO_LONG: &str = "frames with length codes above 8, which cannot be sent";
pub(crate) const REFUSED: &str = "frames that were refused";

/// An adapter behind its maker's library.
pub(crate) trait Asked {
    /// Its channel.
    fn channel(&mut self) -> &mut LibraryChannel;
    /// Asks for messages, and for what is due beside them.
    fn ask(&mut self);
}

/// [`crate::driver::Driver::poll`] of such an adapter.
pub(crate) fn poll_asked(
    adapter: &mut impl Asked,
    wait: Duration,
    reports: &mut Vec<Incoming>,
) -> Result<(), String> {
    let deadline = Instant::now() + wait;
    while adapter.channel().ended.is_none() {
        adapter.ask();
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() || !adapter.channel().backlog.is_empty() {
            break;
        }
        std::thread::sleep(left.min(ASK_EVERY));
    }
    let channel = adapter.channel();
    reports.append(&mut channel.backlog);
    channel.ended.clone().map_or(Ok(()), Err)
}
