//! Several devices as one: their records in a single time order, on channels numbered consecutively.
//!
//! Channel `c` of device `k`, both from 0, is channel `2k + c`, numbered from 1 in records and words as everywhere. The
//! first device's clock is the common one: the other devices' records are put on it by the USB frames that all of them
//! have marked ([`Follower`](super::clock::Follower)), or by each device's own UTC if they are not on one USB host
//! controller.
//!
//! A record is handed out once none can come before it: each other device has sent a later one, is gone, or has sent nothing
//! for [`PATIENCE`] since. Anything that comes even later keeps its true time.

use std::borrow::Borrow;
use std::collections::VecDeque;
use std::time::{Duration, Instant};

use cantap_wire::{CHANNELS, Channel};

use super::clock::{Follower, FollowerReport};
use super::{Device, DeviceError, Happening, Reconnecting};
use crate::TraceRecord;

/// How long a record waits for those of a silent device. On the way to the host they take some milliseconds; a delayed
/// thread of the computer adds some tens.
const PATIENCE: Duration = Duration::from_millis(100);
/// How long to sleep while nothing comes.
const NAP: Duration = Duration::from_millis(2);

/// The number (from 1, as in records and words) of a channel of one of several devices (counted from 0).
pub const fn channel_number(device: usize, channel: Channel) -> u8 {
    (device * CHANNELS) as u8 + channel.number()
}

/// Several devices that may each go and come back. A single one behaves as if it were alone.
pub struct Several<D, E> {
    members: Vec<Member<D, E>>,
    /// Which device is asked first, so that none has to wait behind the others.
    turn: usize,
}

struct Member<D, E> {
    line: Reconnecting<D, E>,
    number: usize,
    follower: Follower,
    waiting: VecDeque<TraceRecord>,
    /// When batches arrived, each with the time of its last record.
    arrivals: VecDeque<(Instant, i64)>,
    /// No record before this time will follow in this session.
    horizon_ns: i64,
    /// It had nothing to hand out when it was last asked.
    is_silent: bool,
    /// It is there and has more to send.
    goes_on: bool,
    ended: bool,
}

impl<D, E> Several<D, E>
where
    D: Borrow<Device> + Send + 'static,
    E: From<DeviceError> + std::fmt::Display + Send + 'static,
{
    /// Combines devices, the first of which has the clock.
    pub fn new(lines: Vec<Reconnecting<D, E>>) -> Self {
        let member = |(number, line)| Member {
            line,
            number,
            follower: Follower::default(),
            waiting: VecDeque::new(),
            arrivals: VecDeque::new(),
            horizon_ns: i64::MIN,
            is_silent: false,
            goes_on: true,
            ended: false,
        };
        Self { members: lines.into_iter().enumerate().map(member).collect(), turn: 0 }
    }

    /// Connects now; all devices must be there.
    pub fn connect(&mut self) -> Result<(), E> {
        self.members.iter_mut().try_for_each(|member| member.line.connect())
    }

    /// Each of the devices.
    pub fn lines(&self) -> impl ExactSizeIterator<Item = &Reconnecting<D, E>> {
        self.members.iter().map(|member| &member.line)
    }

    /// The devices that are there, each with its index.
    pub fn devices(&self) -> impl Iterator<Item = (usize, &Device)> {
        self.lines().enumerate().filter_map(|(number, line)| Some((number, line.device()?)))
    }

    /// How well the times of each device but the first match the first one's clock.
    pub fn clocks(&self) -> impl Iterator<Item = FollowerReport> {
        self.members.iter().skip(1).map(|member| member.follower.report())
    }

    /// Waits for the next happening, at most `timeout`, and returns it with the index of its device (from 0); records are of all
    /// devices. [`Happening::Ended`] comes once, when all have ended.
    pub fn next(&mut self, timeout: Duration) -> (usize, Happening<E>) {
        if let [only] = self.members.as_mut_slice() {
            return (0, only.line.next(timeout));
        }
        let deadline = Instant::now() + timeout;
        loop {
            for offset in 0..self.members.len() {
                let number = (self.turn + offset) % self.members.len();
                if let Some(happening) = self.ask(number) {
                    self.turn = number + 1;
                    return (number, happening);
                }
            }
            let now = Instant::now();
            let records = self.take_ready(now);
            if !records.is_empty() {
                return (0, Happening::Records(records));
            }
            if self.members.iter().all(|member| member.ended) {
                return (0, Happening::Ended);
            }
            if now >= deadline {
                return (0, Happening::Records(Vec::new()));
            }
            if self.members.iter().all(|member| member.is_silent || member.ended) {
                std::thread::sleep(NAP.min(deadline - now));
            }
        }
    }

    /// Takes back the memory of a batch if it can be used again.
    pub fn recycle(&self, batch: Vec<TraceRecord>) {
        if let [only] = self.members.as_slice() {
            only.line.recycle(batch);
        }
    }

    /// Ends the capture on every device, like [`Reconnecting::stop`]. Returns the errors of those that did not end
    /// properly.
    pub fn stop(&mut self) -> Vec<E> {
        self.members.iter_mut().filter_map(|member| member.line.stop().err()).collect()
    }

    /// Takes what a device has. Returns what happened to it, if anything.
    fn ask(&mut self, number: usize) -> Option<Happening<E>> {
        let first = match &self.members[0].line.device() {
            Some(device) if number > 0 => Some(device.clock_map()),
            _ => None,
        };
        let member = &mut self.members[number];
        if member.ended {
            return None;
        }
        match member.line.next(Duration::ZERO) {
            Happening::Records(batch) => {
                member.is_silent = batch.is_empty();
                if let (Some(first), Some(device)) = (first, member.line.device())
                    && !batch.is_empty()
                {
                    member.follower.update(first, device.clock_map());
                }
                member.take(batch);
                None
            }
            Happening::Gone(error) => {
                (member.goes_on, member.is_silent) = (false, true);
                Some(Happening::Gone(error))
            }
            Happening::Back(back) => {
                (member.goes_on, member.is_silent) = (true, false);
                member.follower.begin_session();
                Some(Happening::Back(back))
            }
            Happening::Ended => {
                (member.goes_on, member.ended) = (false, true);
                None
            }
        }
    }

    /// Takes the records that nothing can precede any more, in order.
    fn take_ready(&mut self, now: Instant) -> Vec<TraceRecord> {
        let live = || self.members.iter().filter(|member| member.goes_on);
        let horizon = |members: &mut dyn Iterator<Item = &Member<D, E>>| {
            members.map(|member| member.horizon_ns).min().unwrap_or(i64::MAX)
        };
        let safe_ns = horizon(&mut live());
        // A device with more to hand out is waited for, however long that takes.
        let busy_ns = horizon(&mut live().filter(|member| !member.is_silent));
        let ripe_ns = self.members.iter_mut().filter_map(|member| member.ripe_ns(now)).max();
        let limit_ns = ripe_ns.map_or(safe_ns, |ripe_ns| safe_ns.max(ripe_ns.min(busy_ns)));
        let mut records = Vec::new();
        while let Some(next) = self
            .members
            .iter_mut()
            .filter_map(|member| Some((member.waiting.front()?.time_ns, member)))
            .min_by_key(|(time_ns, _)| *time_ns)
            .filter(|(time_ns, _)| *time_ns <= limit_ns)
            .and_then(|(_, member)| member.waiting.pop_front())
        {
            records.push(next);
        }
        records
    }
}

impl<D, E> Member<D, E> {
    fn take(&mut self, batch: Vec<TraceRecord>) {
        for mut record in batch {
            if self.number > 0 {
                record.time_ns = self.follower.place(record.time_ns);
                record.channel += (self.number * CHANNELS) as u8;
            }
            // The gap at the end of a session is timed by another clock than the records before it.
            record.time_ns = record.time_ns.max(self.horizon_ns);
            self.horizon_ns = record.time_ns;
            self.waiting.push_back(record);
        }
        if let Some(last) = self.waiting.back()
            && self.arrivals.back().is_none_or(|(_, time_ns)| *time_ns < last.time_ns)
        {
            self.arrivals.push_back((Instant::now(), last.time_ns));
        }
    }

    /// The time of the last record that has waited for [`PATIENCE`].
    fn ripe_ns(&mut self, now: Instant) -> Option<i64> {
        let is_ripe = |(came, _): &(Instant, i64)| now.duration_since(*came) >= PATIENCE;
        while self.arrivals.get(1).is_some_and(is_ripe) {
            self.arrivals.pop_front();
        }
        self.arrivals.front().filter(|arrival| is_ripe(arrival)).map(|(_, time_ns)| *time_ns)
    }
}
