//! Writes records into the queue: each with its time since the last one, and a loss record in place
//! of what did not fit.

use cantap_wire::record::{LossStage, encode_event, encode_received_fd};
use cantap_wire::{CHANNELS, Channel, Event, Received, ReceivedFd, Stamp};
#[cfg(not(target_os = "none"))]
use cantap_wire::{TransmittedFd, record::encode_transmitted_fd};

use crate::QUEUE_BYTES;
use crate::bus::queue::Producer;
use crate::bus::time::Timebase;

/// Records that one call of anything that writes many of them writes at most. Most such calls hold the lock, and the transmission alarm is
/// only 14 µs early (`docs/architecture.md`, "Capture is never the victim of transmission").
pub const RECORDS_PER_CALL: usize = 4;

/// The only writer of the queue. Belongs to the tasks of priority 4.
pub struct Recorder<'q, const N: usize = QUEUE_BYTES> {
    producer: Producer<'q, N>,
    time: Timebase,
    /// Time of the last record, from which the next difference counts.
    last_ticks: u64,
    /// Frames that did not fit and that no loss record reports yet.
    unreported: [u32; CHANNELS],
    /// All frames that did not fit.
    lost: [u32; CHANNELS],
    /// Those of them that this device had sent.
    lost_sent: [u32; CHANNELS],
}

impl<'q, const N: usize> Recorder<'q, N> {
    /// A recorder at time zero.
    pub const fn new(producer: Producer<'q, N>) -> Self {
        Self {
            producer,
            time: Timebase::new(),
            last_ticks: 0,
            unreported: [0; CHANNELS],
            lost: [0; CHANNELS],
            lost_sent: [0; CHANNELS],
        }
    }

    /// The 64-bit time of a stamp.
    #[inline]
    pub fn time(&mut self, stamp: u32) -> u64 {
        self.time.extend(stamp)
    }

    /// Starts a session at `now`: the first record's difference counts from there. The queue must be empty.
    pub fn restart(&mut self, now: u64) {
        self.last_ticks = now;
        self.unreported = [0; CHANNELS];
        self.lost = [0; CHANNELS];
        self.lost_sent = [0; CHANNELS];
        self.producer.reset_high_water();
    }

    /// Writes a received frame, or counts it as lost.
    #[inline(always)]
    #[expect(clippy::inline_always, reason = "measured: a tenth of the time for a frame")]
    pub fn frame(&mut self, received: &Received, at: u64) {
        self.push(received.channel, received.stamp, at, |producer, difference| {
            producer.push_frame(received, difference)
        });
    }

    /// The same for a CAN FD frame.
    pub fn fd_frame(&mut self, received: &ReceivedFd, at: u64) {
        self.push(received.channel, received.stamp, at, |producer, difference| {
            producer.push_fd(false, |room| encode_received_fd(received, difference, room))
        });
    }

    #[inline(always)]
    #[expect(clippy::inline_always, reason = "as for `Self::frame`")]
    fn push(
        &mut self,
        channel: Channel,
        stamp: Stamp,
        at: u64,
        push: impl FnOnce(&mut Producer<'q, N>, i64) -> bool,
    ) {
        if self.unreported != [0; CHANNELS] {
            self.report_losses(at);
        }
        let index = channel.index();
        let difference = self.difference(at);
        // If the reader has just made room, the loss record gets it first: it belongs before the next frame.
        let in_turn = self.unreported == [0; CHANNELS];
        if in_turn && push(&mut self.producer, difference) {
            if stamp != Stamp::Omitted {
                self.last_ticks = at;
            }
        } else {
            self.unreported[index] = self.unreported[index].wrapping_add(1);
            self.lost[index] = self.lost[index].wrapping_add(1);
        }
    }

    /// Writes the confirmation of a frame that is not held up by a full queue, or counts it as lost: it was on the bus.
    pub fn confirm(&mut self, event: &Event, channel: Channel, at: u64) {
        if self.producer.takes_frames() && self.event(event, at) {
            return;
        }
        for count in [&mut self.unreported, &mut self.lost, &mut self.lost_sent] {
            let count = &mut count[channel.index()];
            *count = count.wrapping_add(1);
        }
    }

    /// Frames that this device had sent, among [`Self::lost`].
    pub const fn lost_sent(&self, channel: Channel) -> u32 {
        self.lost_sent[channel.index()]
    }

    /// Writes an event and returns whether there was room for it.
    pub fn event(&mut self, event: &Event, at: u64) -> bool {
        if self.unreported != [0; CHANNELS] {
            self.report_losses(at);
        }
        self.write(event, at)
    }

    /// Writes the confirmation of a CAN FD frame, which no board sends, and returns whether there was room for it.
    #[cfg(not(target_os = "none"))]
    pub fn fd_confirmation(&mut self, sent: &TransmittedFd, at: u64) -> bool {
        if self.unreported != [0; CHANNELS] {
            self.report_losses(at);
        }
        let difference = self.difference(at);
        let written = self.producer.push_fd(true, |room| encode_transmitted_fd(sent, difference, room));
        if written {
            self.last_ticks = at;
        }
        written
    }

    /// Writes an event that can be left out: it is dropped while the queue accepts no frames.
    pub fn aside(&mut self, event: &Event, at: u64) {
        if self.producer.takes_frames() {
            self.event(event, at);
        }
    }

    #[inline(never)]
    fn write(&mut self, event: &Event, at: u64) -> bool {
        let difference = self.difference(at);
        let written = self.producer.push_event(|room| encode_event(event, difference, room));
        if written {
            self.last_ticks = at;
        }
        written
    }

    /// Ticks from the last record to `at`, however long ago that was.
    #[inline]
    fn difference(&self, at: u64) -> i64 {
        at.wrapping_sub(self.last_ticks) as i64
    }

    /// Writes a loss record for each channel that lost frames, once the queue accepts frames again. The record
    /// then stands exactly where they are missing.
    #[cold]
    #[inline(never)]
    fn report_losses(&mut self, at: u64) {
        if !self.producer.takes_frames() {
            return;
        }
        self.flush_losses(at);
    }

    /// Writes a loss record for each channel that lost frames, now.
    pub fn flush_losses(&mut self, at: u64) {
        for channel in Channel::ALL {
            let count = self.unreported[channel.index()];
            let event = Event::Lost { channel, stage: LossStage::Queue, count, at_least: false };
            if count > 0 && self.write(&event, at) {
                self.unreported[channel.index()] = 0;
            }
        }
    }

    /// Once a millisecond: reports losses that no later frame has reported.
    pub fn tick(&mut self, now: u64) {
        if self.unreported != [0; CHANNELS] {
            self.report_losses(now);
        }
    }

    /// Whether the queue has room beyond the reserve for records that explain missing frames.
    pub fn takes_frames(&mut self) -> bool {
        self.producer.takes_frames()
    }

    /// Frames of a channel that the queue lost since [`Self::restart`].
    pub const fn lost(&self, channel: Channel) -> u32 {
        self.lost[channel.index()]
    }

    /// Bytes in the queue, and the most there ever were.
    pub fn fill(&self) -> (u32, u32) {
        (self.producer.fill(), self.producer.high_water())
    }
}
