//! The books: what crossed a bus while its channel was open, compared with what the device delivered and
//! what it reported lost. The law: *frames on the bus = frames delivered + frames counted lost*, in
//! order, bit for bit, and each loss counted where the frames are missing.

use std::collections::VecDeque;

use cantap_wire::record::{LossStage, Stamp};
use cantap_wire::{CHANNELS, Channel, Event, Frame, Received, Record};

use super::session::SessionEvent;
use crate::CYCLES_PER_SECOND;

/// How many faults are kept word for word; the rest are only counted.
const KEPT_FAULTS: usize = 20;
/// Stamps are compared with the truth in nanoseconds.
const NS_PER_SECOND: i64 = 1_000_000_000;

/// Frames that one channel lost, by stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Losses {
    /// The controller's FIFO overran. The device can only say "at least"; this is the true number.
    pub controller: u64,
    /// The record queue was full.
    pub queue: u64,
    /// Batches went missing on USB.
    pub link: u64,
}

impl Losses {
    /// The sum of all stages.
    pub fn total(&self) -> u64 {
        self.controller + self.queue + self.link
    }
}

/// How late stamps are, in nanoseconds after the moment at which receivers take the frame (the end of the
/// last but one bit of the end of frame; the frame's own end is one bit later).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stamps {
    /// The earliest.
    pub min: i64,
    /// Half are no later.
    pub median: i64,
    /// The latest.
    pub max: i64,
    /// Stamps that claim to be exact.
    pub exact: u64,
    /// Stamps that say they are upper bounds.
    pub bounds: u64,
}

/// A frame on the bus that the device should have received.
#[derive(Clone, Copy, Debug)]
struct Truth {
    frame: Frame,
    valid: u64,
}

/// One channel's books.
#[derive(Debug, Default)]
struct Books {
    /// Not settled yet, oldest first.
    open: VecDeque<Truth>,
    on_bus: u64,
    delivered: u64,
    losses: Losses,
    /// Losses announced since the last delivered frame: stage and number, and whether there may be more.
    announced: Losses,
    at_least: bool,
    /// Never delivered and not announced, because the session was cut.
    cut: u64,
    latencies: Vec<i64>,
    bounds: u64,
}

/// The books of both channels.
#[derive(Debug, Default)]
pub struct Ledger {
    books: [Books; CHANNELS],
    /// Core cycle of the device's tick 0 and cycles per tick.
    clock: Option<(u64, u64)>,
    faults: Vec<String>,
    fault_count: u64,
}

impl Ledger {
    /// Empty books.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets when the device's clock was at zero and how many core cycles a tick has. Without this, stamps
    /// are not judged.
    pub fn set_clock(&mut self, origin: u64, cycles_per_tick: u64) {
        self.clock = Some((origin, cycles_per_tick));
    }

    /// A frame that a channel's controller received without error, valid at a core cycle.
    pub fn on_bus(&mut self, channel: Channel, frame: Frame, valid: u64) {
        let books = &mut self.books[channel.index()];
        books.on_bus += 1;
        books.open.push_back(Truth { frame, valid });
    }

    /// Something that the device reported.
    pub fn take(&mut self, event: &SessionEvent) {
        match event {
            SessionEvent::Record(ticks, Record::Received(received)) => self.delivered(*ticks, received),
            SessionEvent::Record(_, Record::Event(Event::Lost { channel, stage, count, at_least })) => {
                let books = &mut self.books[channel.index()];
                let count = u64::from(*count);
                match stage {
                    LossStage::Controller => books.announced.controller += count,
                    LossStage::Queue => books.announced.queue += count,
                    // The frame was delivered on the channel that received it.
                    LossStage::Gateway => return,
                    LossStage::Link | LossStage::Host => {
                        self.fault(format!(
                            "the device reports a loss of stage {stage:?}, which only a host can"
                        ));
                        return;
                    }
                }
                books.at_least |= at_least;
            }
            SessionEvent::Record(_, Record::ReceivedFd(received)) => {
                self.fault(format!(
                    "the device reports a CAN FD frame, which no board can receive: {received:?}"
                ));
            }
            SessionEvent::Record(_, Record::TransmittedFd(sent)) => {
                self.fault(format!("the device reports a CAN FD frame sent, which no board can: {sent:?}"));
            }
            SessionEvent::Record(_, Record::Event(_)) | SessionEvent::Ended(..) => {}
            SessionEvent::BatchesLost(frames) => {
                for (books, lost) in self.books.iter_mut().zip(frames) {
                    books.announced.link += u64::from(*lost);
                }
            }
        }
    }

    fn fault(&mut self, what: String) {
        self.fault_count += 1;
        if self.faults.len() < KEPT_FAULTS {
            self.faults.push(what);
        }
    }

    fn delivered(&mut self, ticks: u64, received: &Received) {
        let channel = received.channel;
        let at = self.clock.map(|(origin, per_tick)| origin + ticks * per_tick);
        let books = &mut self.books[channel.index()];
        books.delivered += 1;
        let announced = books.announced.total() as usize;
        let stamp = at.filter(|_| received.stamp == Stamp::Exact);
        let missing = if books.at_least {
            missing_at_least(&books.open, announced, &received.frame, stamp)
        } else {
            Some(announced)
        };
        let found = missing.and_then(|missing| books.open.get(missing).map(|truth| (missing, *truth)));
        match found {
            Some((missing, truth)) if truth.frame == received.frame => {
                books.settle_losses(missing as u64);
                books.open.drain(..=missing);
                self.stamped(channel, received.stamp, at, truth.valid);
            }
            Some((_, truth)) => {
                let (number, count) = (channel.number(), self.books[channel.index()].delivered);
                let (got, sent) = (received.frame, truth.frame);
                self.fault(format!(
                    "channel {number}: delivered frame {count} is {got}, on the bus it was {sent}"
                ));
                self.resynchronise(channel, received);
            }
            None => {
                let number = channel.number();
                let frame = received.frame;
                self.fault(format!("channel {number}: {frame} was delivered and never on the bus"));
                self.resynchronise(channel, received);
            }
        }
    }

    /// After a fault: continues after the next equal frame, so that one fault is not reported a thousand
    /// times.
    fn resynchronise(&mut self, channel: Channel, received: &Received) {
        let books = &mut self.books[channel.index()];
        if let Some(at) = books.open.iter().position(|truth| truth.frame == received.frame) {
            books.open.drain(..=at);
        }
        books.announced = Losses::default();
        books.at_least = false;
    }

    /// Compares a stamp with the truth.
    fn stamped(&mut self, channel: Channel, stamp: Stamp, at: Option<u64>, valid: u64) {
        let Some(at) = at else { return };
        let late_ns = (at as i64 - valid as i64) * NS_PER_SECOND / CYCLES_PER_SECOND as i64;
        match stamp {
            Stamp::Exact => self.books[channel.index()].latencies.push(late_ns),
            Stamp::UpperBound => self.books[channel.index()].bounds += 1,
            Stamp::Omitted => return,
        }
        // One tick of rounding.
        if late_ns < -100 {
            let number = channel.number();
            self.fault(format!("channel {number}: a stamp lies {} ns before its frame was valid", -late_ns));
        }
    }

    /// Ends a channel's session. `whole` says that the device had time to deliver everything: then every
    /// frame must have been delivered or announced as lost. Otherwise the rest are only counted.
    pub fn close(&mut self, channel: Channel, whole: bool) {
        let books = &mut self.books[channel.index()];
        let rest = books.open.len() as u64;
        let announced = books.announced.total();
        let holds = if books.at_least { announced <= rest } else { announced == rest };
        if whole {
            let at_least = if books.at_least { "at least " } else { "" };
            books.settle_losses(rest);
            if !holds {
                let number = channel.number();
                self.fault(format!(
                    "channel {number}: {rest} frames are missing at the end, {at_least}{announced} were announced"
                ));
            }
        } else {
            books.cut += rest - announced.min(rest);
            books.settle_losses(announced.min(rest));
        }
        self.books[channel.index()].open.clear();
    }

    /// Frames on the bus of a channel, so far.
    pub fn on_bus_count(&self, channel: Channel) -> u64 {
        self.books[channel.index()].on_bus
    }

    /// Frames delivered.
    pub fn delivered_count(&self, channel: Channel) -> u64 {
        self.books[channel.index()].delivered
    }

    /// Frames counted lost, including those announced at the end of the stream.
    pub fn losses(&self, channel: Channel) -> Losses {
        let books = &self.books[channel.index()];
        Losses {
            controller: books.losses.controller + books.announced.controller,
            queue: books.losses.queue + books.announced.queue,
            link: books.losses.link + books.announced.link,
        }
    }

    /// Frames that were still on their way when sessions were cut.
    pub fn cut_count(&self, channel: Channel) -> u64 {
        self.books[channel.index()].cut
    }

    /// How late the stamps were, over both channels.
    pub fn stamps(&self) -> Stamps {
        let mut all: Vec<i64> = self.books.iter().flat_map(|books| &books.latencies).copied().collect();
        all.sort_unstable();
        let (Some(min), Some(max)) = (all.first(), all.last()) else {
            return Stamps { bounds: self.books.iter().map(|books| books.bounds).sum(), ..Stamps::default() };
        };
        Stamps {
            min: *min,
            median: all[all.len() / 2],
            max: *max,
            exact: all.len() as u64,
            bounds: self.books.iter().map(|books| books.bounds).sum(),
        }
    }

    /// The same, and forgets them: a long run judges its stamps piece by piece.
    pub fn take_stamps(&mut self) -> Stamps {
        let stamps = self.stamps();
        for books in &mut self.books {
            books.latencies.clear();
            books.bounds = 0;
        }
        stamps
    }

    /// What broke the law, the first ones word for word.
    pub fn faults(&self) -> &[String] {
        &self.faults
    }

    /// How often the law was broken.
    pub fn fault_count(&self) -> u64 {
        self.fault_count
    }

    /// Whether the law holds, and for each channel *on bus = delivered + lost + cut*.
    pub fn holds(&self) -> bool {
        let balanced = Channel::ALL.iter().all(|channel| {
            let books = &self.books[channel.index()];
            let settled = books.delivered + self.losses(*channel).total() + books.cut;
            books.on_bus == settled
        });
        self.fault_count == 0 && balanced
    }
}

impl Books {
    /// Books `missing` frames as lost, at the stages announced; whatever an "at least" left open goes to
    /// the controller.
    fn settle_losses(&mut self, missing: u64) {
        self.losses.queue += self.announced.queue;
        self.losses.link += self.announced.link;
        let counted = self.announced.queue + self.announced.link;
        self.losses.controller += missing.saturating_sub(counted);
        self.announced = Losses::default();
        self.at_least = false;
    }
}

/// How many frames are missing before `frame` if the device could only say "at least `announced`": up to
/// the last equal frame that was valid when the stamp was taken, or, without a stamp, the first one.
fn missing_at_least(
    open: &VecDeque<Truth>,
    announced: usize,
    frame: &Frame,
    stamp: Option<u64>,
) -> Option<usize> {
    let mut equal = open
        .iter()
        .enumerate()
        .skip(announced)
        .filter(|(_, truth)| truth.frame == *frame)
        .map(|(at, truth)| (at, truth.valid));
    match stamp {
        Some(stamp) => equal.take_while(|(_, valid)| *valid <= stamp).last().map(|(at, _)| at),
        None => equal.next().map(|(at, _)| at),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_wire::Id;

    const CHANNEL: Channel = Channel::Can1;
    /// Cycles between frames, and cycles per tick, with tick 0 at cycle 1000.
    const GAP: u64 = 48 * 144;

    fn frame(n: u64) -> Frame {
        Frame::data_frame(Id::standard(0x100).unwrap(), &n.to_le_bytes()).unwrap()
    }

    /// Books with `frames` frames on the bus.
    fn books(frames: u64) -> Ledger {
        let mut ledger = Ledger::new();
        ledger.set_clock(1000, 12);
        (0..frames).for_each(|n| ledger.on_bus(CHANNEL, frame(n), 1000 + n * GAP));
        ledger
    }

    fn deliver(ledger: &mut Ledger, n: u64) {
        let received =
            Received { channel: CHANNEL, frame: frame(n), stamp: Stamp::Exact, data_omitted: false };
        ledger.take(&SessionEvent::Record(n * GAP / 12 + 6, Record::Received(received)));
    }

    fn lose(ledger: &mut Ledger, stage: LossStage, count: u32, at_least: bool) {
        let event = Event::Lost { channel: CHANNEL, stage, count, at_least };
        ledger.take(&SessionEvent::Record(0, Record::Event(event)));
    }

    #[test]
    fn a_whole_capture_balances() {
        let mut ledger = books(5);
        (0..5).for_each(|n| deliver(&mut ledger, n));
        ledger.close(CHANNEL, true);
        assert!(ledger.holds(), "{:?}", ledger.faults());
        assert_eq!((ledger.on_bus_count(CHANNEL), ledger.delivered_count(CHANNEL)), (5, 5));
        // Six ticks of 12 cycles at 144 MHz.
        assert_eq!(ledger.stamps(), Stamps { min: 500, median: 500, max: 500, exact: 5, bounds: 0 });
    }

    #[test]
    fn losses_count_where_they_are_announced() {
        let mut ledger = books(6);
        deliver(&mut ledger, 0);
        lose(&mut ledger, LossStage::Queue, 2, false);
        deliver(&mut ledger, 3);
        lose(&mut ledger, LossStage::Queue, 2, false);
        ledger.close(CHANNEL, true);
        assert!(ledger.holds(), "{:?}", ledger.faults());
        assert_eq!(ledger.losses(CHANNEL), Losses { queue: 4, ..Losses::default() });
    }

    #[test]
    fn a_loss_that_is_one_off_is_a_fault() {
        for (announced, next) in [(1, 3), (3, 3)] {
            let mut ledger = books(6);
            deliver(&mut ledger, 0);
            lose(&mut ledger, LossStage::Queue, announced, false);
            deliver(&mut ledger, next);
            assert!(!ledger.holds());
        }
        let mut ledger = books(2);
        deliver(&mut ledger, 0);
        ledger.close(CHANNEL, true);
        assert!(!ledger.holds(), "the last frame is missing and nobody said so");
    }

    #[test]
    fn an_overrun_counts_what_is_really_missing() {
        let mut ledger = books(9);
        deliver(&mut ledger, 0);
        lose(&mut ledger, LossStage::Controller, 1, true);
        deliver(&mut ledger, 6);
        deliver(&mut ledger, 7);
        deliver(&mut ledger, 8);
        ledger.close(CHANNEL, true);
        assert!(ledger.holds(), "{:?}", ledger.faults());
        assert_eq!(ledger.losses(CHANNEL), Losses { controller: 5, ..Losses::default() });
    }

    #[test]
    fn frames_out_of_order_changed_or_invented_are_faults() {
        let mut swapped = books(3);
        deliver(&mut swapped, 1);
        deliver(&mut swapped, 0);
        let mut changed = books(3);
        changed.take(&SessionEvent::Record(
            10,
            Record::Received(Received {
                channel: CHANNEL,
                frame: frame(77),
                stamp: Stamp::Exact,
                data_omitted: false,
            }),
        ));
        let mut invented = books(1);
        deliver(&mut invented, 0);
        deliver(&mut invented, 0);
        for ledger in [swapped, changed, invented] {
            assert!(!ledger.holds());
            assert!(!ledger.faults().is_empty());
        }
    }

    #[test]
    fn a_stamp_before_the_frame_is_a_fault() {
        let mut ledger = Ledger::new();
        ledger.set_clock(0, 12);
        ledger.on_bus(CHANNEL, frame(0), 10_000);
        deliver(&mut ledger, 0);
        assert_eq!(ledger.fault_count(), 1);
    }

    #[test]
    fn a_cut_session_leaves_a_rest_that_is_counted() {
        let mut ledger = books(4);
        deliver(&mut ledger, 0);
        ledger.close(CHANNEL, false);
        assert!(ledger.holds());
        assert_eq!(ledger.cut_count(CHANNEL), 3);
    }
}
