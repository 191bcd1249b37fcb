//! One channel and its interface: what both directions have in common.

use std::collections::VecDeque;
use std::io;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use cantap::device::channel_number;
use cantap::wire::Channel;
use cantap::wire::record::{LossStage, TransmitFailure};
use cantap::{Direction, TraceEvent, TraceRecord};
use cantap_adapters::raw_can::raw_error;
use cantap_trace::TraceFrame;

use super::interface::{Known, Port};
use super::raw::Raw;
use crate::stderr;

/// A channel and its interface.
pub struct Lane {
    pub channel: Channel,
    pub name: String,
    pub port: Box<dyn Port>,
    known: Known,
    /// Programs' frames that are on their way to the bus.
    own: Mutex<VecDeque<TraceFrame>>,
    /// Frames and errors that the interface did not take, and that have not been reported.
    missing: Mutex<u32>,
    /// The user has been told that frames are not sent because the channel only listens.
    told_refusal: AtomicBool,
    /// The user has been told that CAN FD frames do not reach programs, and that programs' are not sent.
    told_no_fd: AtomicBool,
    told_fd_refusal: AtomicBool,
    pub counts: Counts,
}

/// Counts for both directions.
#[derive(Default)]
pub struct Counts {
    /// Frames passed to programs.
    pub heard: AtomicU64,
    /// Programs' frames that were on the bus.
    pub sent: AtomicU64,
    /// Programs' frames that were not, or whose fate is unknown.
    pub not_sent: AtomicU64,
    /// Frames that the interface did not take.
    pub undelivered: AtomicU64,
    /// Frames lost before they came here, and whether there may have been more.
    pub lost: AtomicU64,
    pub lost_more: AtomicBool,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every holder leaves the state consistent.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn add(count: &AtomicU64, number: usize) {
    count.fetch_add(number as u64, Ordering::Relaxed);
}

impl Lane {
    pub fn new(channel: Channel, name: &str, port: Box<dyn Port>, known: Known) -> Self {
        Self {
            channel,
            name: name.to_owned(),
            port,
            known,
            own: Mutex::default(),
            missing: Mutex::new(0),
            told_refusal: AtomicBool::new(false),
            told_no_fd: AtomicBool::new(false),
            told_fd_refusal: AtomicBool::new(false),
            counts: Counts::default(),
        }
    }

    /// A program's frame is on its way.
    pub fn sends(&self, frame: TraceFrame) {
        lock(&self.own).push_back(frame);
    }

    /// It has ended. Returns whether it was on its way.
    pub fn has_ended(&self, frame: &TraceFrame) -> bool {
        let mut own = lock(&self.own);
        let at = own.iter().position(|own| own == frame);
        at.is_some_and(|at| own.remove(at).is_some())
    }

    /// Counts a program's frame that was on the bus.
    pub fn count_sent(&self) {
        add(&self.counts.sent, 1);
    }

    /// Counts one that was not, of which programs are informed elsewhere.
    pub fn count_not_sent(&self) {
        add(&self.counts.not_sent, 1);
    }

    /// Passes this channel's records to programs.
    pub fn hear(&self, records: &[TraceRecord]) -> io::Result<()> {
        let number = channel_number(0, self.channel);
        let mut raw = Vec::new();
        for record in records.iter().filter(|record| record.channel == number) {
            match &record.event {
                TraceEvent::Frame { frame, direction, .. } => {
                    if frame.is_fd() && !self.known.has_fd {
                        // Programs are told that one is missing.
                        self.tell_no_fd();
                        add(&self.counts.lost, 1);
                        let missing =
                            TraceEvent::Lost { stage: Some(LossStage::Host), count: 1, at_least: false };
                        raw.extend(error(&missing));
                        continue;
                    }
                    // If the kernel has already shown it to the others, once is enough.
                    if *direction == Direction::Tx && self.has_ended(frame) && !self.known.echoes {
                        continue;
                    }
                    raw.push(Raw::of_frame(frame));
                }
                event => {
                    if let TraceEvent::Lost { count, at_least, .. } = event {
                        add(&self.counts.lost, *count as usize);
                        self.counts.lost_more.fetch_or(*at_least, Ordering::Relaxed);
                        // A confirmation may be among the lost records; do not wait for it for ever.
                        if *event != TraceEvent::UNCOUNTED {
                            lock(&self.own).clear();
                        }
                    }
                    raw.extend(error(event));
                }
            }
        }
        self.deliver(raw)
    }

    /// A program's frames were not sent, or their fate is unknown: the program gets an error frame for each.
    pub fn refuse(&self, number: usize) -> io::Result<()> {
        add(&self.counts.not_sent, number);
        let failed = TraceEvent::TransmitFailed { tag: 0, reason: TransmitFailure::Aborted };
        self.deliver(error(&failed).map_or_else(Vec::new, |raw| vec![raw; number]))
    }

    /// The same because the channel only listens, which is reported once.
    pub fn refuse_listening(&self, number: usize) -> io::Result<()> {
        if !self.told_refusal.swap(true, Ordering::Relaxed) {
            stderr::warn(&format!(
                "a program writes to {}, and channel {} only listens: nothing is sent; --mode normal lets programs send",
                self.name,
                channel_number(0, self.channel)
            ));
        }
        self.refuse(number)
    }

    /// The same because the device sends no CAN FD frames, with what to do, which is reported once.
    pub fn refuse_fd(&self, number: usize, advice: &str) -> io::Result<()> {
        if !self.told_fd_refusal.swap(true, Ordering::Relaxed) {
            stderr::warn(&format!(
                "a program writes CAN FD frames to {}, and none is sent: {advice}",
                self.name
            ));
        }
        self.refuse(number)
    }

    /// Says once that programs lack CAN FD frames, and what to do.
    fn tell_no_fd(&self) {
        if !self.told_no_fd.swap(true, Ordering::Relaxed) {
            let name = &self.name;
            stderr::warn(&format!(
                "there are CAN FD frames, and {name} takes none: each is counted as lost; as root, before the bridge is started: \
                 ip link set {name} down && ip link set {name} mtu 72 && ip link set {name} up"
            ));
        }
    }

    /// Counts frames that programs wrote and the kernel discarded before they were read.
    pub fn overflowed(&self, number: u32) -> io::Result<()> {
        stderr::warn(&format!(
            "{} takes frames faster than its bus: {number} were not sent, because the socket was full",
            self.name
        ));
        add(&self.counts.not_sent, number as usize);
        let failed = TraceEvent::TransmitFailed { tag: 0, reason: TransmitFailure::Aborted };
        self.deliver(error(&failed).into_iter().collect())
    }

    /// Passes raw frames to programs. What the interface does not take is counted, and reported in place once it accepts frames again.
    /// An error means that the interface is gone.
    fn deliver(&self, mut raw: Vec<Raw>) -> io::Result<()> {
        if raw.is_empty() {
            return Ok(());
        }
        let mut missing = lock(&self.missing);
        let before = *missing;
        if before > 0 {
            let lost = TraceEvent::Lost { stage: Some(LossStage::Host), count: before, at_least: false };
            raw.splice(..0, error(&lost));
        }
        let (taken, error) = match self.port.send(&raw) {
            Ok(taken) => (taken, None),
            Err(error) => (0, Some(error)),
        };
        let (delivered, not_delivered) = raw.split_at(taken);
        add(&self.counts.heard, count_frames(delivered));
        add(&self.counts.undelivered, count_frames(not_delivered));
        if taken > 0 {
            *missing = 0;
        }
        let told = usize::from(before > 0 && taken == 0);
        let left = (raw.len() - taken - told) as u32;
        if left == 0 && error.is_none() {
            return Ok(());
        }
        *missing = missing.saturating_add(left);
        if before == 0 {
            let why = error.as_ref().map_or_else(|| "its buffer is full".to_owned(), ToString::to_string);
            stderr::warn(&format!(
                "{} does not take what is heard ({why}): it is counted as lost",
                self.name
            ));
        }
        match error {
            // It has been deleted.
            Some(error) if matches!(error.raw_os_error(), Some(ENODEV | ENXIO)) => Err(error),
            _ => Ok(()),
        }
    }
}

/// An error, a state or a loss for programs.
fn error(event: &TraceEvent) -> Option<Raw> {
    raw_error(event).map(Raw::Classic)
}

/// The number of those that are bus frames rather than errors.
fn count_frames(raw: &[Raw]) -> usize {
    raw.iter().filter(|raw| raw.frame().is_some()).count()
}

const ENXIO: i32 = nix::errno::Errno::ENXIO as i32;
const ENODEV: i32 = nix::errno::Errno::ENODEV as i32;
