//! The board's stream on its way to each client: once in memory, however many clients wait for it.

use cantap_wire::message::{ChannelConfig, DEVICE_TAG, Filter, OTHERS_TAG};
use cantap_wire::record::{LossStage, Record, Stamp, TransmitFailure};
use cantap_wire::{CHANNELS, Channel, Event, Frame, Received, ReceivedFd, TransmittedFd};

/// A client's number, never used twice.
pub type ClientId = u64;

/// The client that requested a transmission, and its tag there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Owner {
    pub client: ClientId,
    pub tag: u32,
}

/// A record with its absolute device time.
#[derive(Clone, Copy, Debug)]
pub struct Entry {
    pub ticks: u64,
    pub record: Record,
    /// For the end of a transmission, if a client requested it.
    pub owner: Option<Owner>,
}

impl Entry {
    /// An event without an owner.
    pub const fn event(ticks: u64, event: Event) -> Self {
        Self { ticks, record: Record::Event(event), owner: None }
    }
}

/// A client's view of a channel.
#[derive(Clone, Debug, Default)]
pub struct View {
    /// Its configuration, if it is open.
    pub config: Option<ChannelConfig>,
    /// What passes; if empty, everything.
    pub filters: Vec<Filter>,
}

/// A client's view of both channels.
pub type Views = [View; CHANNELS];

impl View {
    /// Whether the client may send on it.
    pub fn transmits(&self) -> bool {
        self.config.is_some_and(|config| config.mode.transmits())
    }

    fn accepts(&self, frame: &Frame) -> bool {
        self.filters.is_empty() || self.filters.iter().any(|filter| filter.matches(frame))
    }
}

/// What a client sees of an entry, if anything.
pub fn shown(entry: &Entry, client: ClientId, views: &Views) -> Option<Record> {
    let of = |channel: Channel| &views[channel.index()];
    let is_open = |channel: Channel| of(channel).config.is_some();
    let own_tag = entry.owner.filter(|owner| owner.client == client).map(|owner| owner.tag);
    match entry.record {
        Record::Received(mut received) => {
            let view = of(received.channel);
            let config = view.config.filter(|_| view.accepts(&received.frame))?;
            received.data_omitted |= config.omit_data;
            if config.omit_stamps {
                received.stamp = Stamp::Omitted;
            }
            Some(Record::Received(received))
        }
        Record::ReceivedFd(mut received) => {
            let view = of(received.channel);
            let config = view.config.filter(|_| view.accepts(&received.frame.identifier_frame()))?;
            received.data_omitted |= config.omit_data;
            if config.omit_stamps {
                received.stamp = Stamp::Omitted;
            }
            Some(Record::ReceivedFd(received))
        }
        Record::TransmittedFd(sent) => is_open(sent.channel)
            .then(|| Record::TransmittedFd(TransmittedFd { tag: own_tag.unwrap_or(OTHERS_TAG), ..sent })),
        Record::Event(event) => {
            let event = match event {
                    Event::SofMark { .. } => Some(event),
                    Event::Transmitted { channel, frame, .. } => is_open(channel)
                        .then(|| Event::Transmitted { channel, tag: own_tag.unwrap_or(OTHERS_TAG), frame }),
                    // It means nothing to other clients: no frame was on the bus.
                    Event::TransmitFailed { channel, reason, .. } => own_tag
                        .filter(|_| is_open(channel))
                        .map(|tag| Event::TransmitFailed { channel, tag, reason }),
                    Event::Lost { channel, .. }
                    | Event::BusError { channel, .. }
                    | Event::ErrorsSuppressed { channel, .. }
                    | Event::State { channel, .. }
                    | Event::Disturbed { channel, .. }
                    // The end of a gap.
                    | Event::Started { channel } => is_open(channel).then_some(event),
                    // Each client's channels stop on their own.
                    Event::Stopped { .. } => None,
                };
            event.map(Record::Event)
        }
    }
}

/// What a client received on one channel, as counted in a board's status.
#[derive(Clone, Copy, Debug, Default)]
pub struct Counts {
    /// Frames received, including those lost after the controller.
    pub frames: u32,
    pub lost_controller: u32,
    pub lost_queue: u32,
    pub transmitted: u32,
    pub transmit_failures: u32,
}

/// Counts what is passed to a client.
pub fn count(counts: &mut [Counts; CHANNELS], record: &Record, is_own: bool) {
    match *record {
        Record::Received(Received { channel, .. }) | Record::ReceivedFd(ReceivedFd { channel, .. }) => {
            add(&mut counts[channel.index()].frames, 1);
        }
        Record::Event(Event::Lost { channel, stage, count, .. }) => {
            let counts = &mut counts[channel.index()];
            match stage {
                LossStage::Controller => add(&mut counts.lost_controller, count),
                LossStage::Queue => {
                    add(&mut counts.lost_queue, count);
                    add(&mut counts.frames, count);
                }
                LossStage::Link | LossStage::Host => add(&mut counts.frames, count),
                LossStage::Gateway => {}
            }
        }
        Record::Event(Event::Transmitted { channel, .. })
        | Record::TransmittedFd(TransmittedFd { channel, .. })
            if is_own =>
        {
            add(&mut counts[channel.index()].transmitted, 1);
        }
        Record::Event(Event::TransmitFailed { channel, reason, .. }) => {
            let failures = if let TransmitFailure::Overtaken { periods } = reason { periods } else { 1 };
            add(&mut counts[channel.index()].transmit_failures, failures);
        }
        Record::Event(_) | Record::TransmittedFd(_) => {}
    }
}

/// Counters wrap, like those of a board.
fn add(counter: &mut u32, count: u32) {
    *counter = counter.wrapping_add(count);
}

/// Where a client was too slow: what it lost, and what is too important to lose.
#[derive(Debug, Default)]
pub struct Gap {
    /// In order, as the client sees it.
    kept: Vec<(u64, Record)>,
    lost: [u32; CHANNELS],
    errors: [u32; CHANNELS],
    /// Of its last record.
    ticks: u64,
}

impl Gap {
    /// Takes a record that the client would have seen. Returns the channel of a frame that is lost as a
    /// result.
    pub fn absorb(&mut self, ticks: u64, record: &Record) -> Option<Channel> {
        self.ticks = ticks;
        match *record {
            Record::Received(Received { channel, .. }) | Record::ReceivedFd(ReceivedFd { channel, .. }) => {
                self.lost[channel.index()] += 1;
                return Some(channel);
            }
            // Bounded by the number in flight.
            Record::TransmittedFd(sent) if sent.tag < DEVICE_TAG => self.kept.push((ticks, *record)),
            Record::TransmittedFd(sent) => {
                self.lost[sent.channel.index()] += 1;
                return Some(sent.channel);
            }
            Record::Event(event) => match event {
                // The same.
                Event::Transmitted { tag, .. } if tag < DEVICE_TAG => self.kept.push((ticks, *record)),
                Event::Transmitted { channel, .. } => {
                    self.lost[channel.index()] += 1;
                    return Some(channel);
                }
                Event::TransmitFailed { .. }
                | Event::Lost { .. }
                | Event::State { .. }
                | Event::Disturbed { .. } => {
                    self.keep(ticks, event);
                }
                Event::BusError { channel, .. } => self.errors[channel.index()] += 1,
                Event::ErrorsSuppressed { channel, count } => self.errors[channel.index()] += count,
                // Marks are left out if there is no room, as on a board.
                Event::Started { .. } | Event::Stopped { .. } | Event::SofMark { .. } => {}
            },
        }
        None
    }

    /// Appends the gap that follows this one.
    pub fn join(&mut self, next: Self) {
        for (ticks, record) in next.kept {
            match record {
                Record::Event(event) => self.keep(ticks, event),
                record => self.kept.push((ticks, record)),
            }
        }
        for (sum, more) in self.lost.iter_mut().zip(next.lost) {
            *sum += more;
        }
        for (sum, more) in self.errors.iter_mut().zip(next.errors) {
            *sum += more;
        }
        self.ticks = self.ticks.max(next.ticks);
    }

    /// Keeps an event, or merges it with one of its kind: the number kept is bounded.
    fn keep(&mut self, ticks: u64, event: Event) {
        let place = self.kept.iter_mut().rev().find_map(|(at, kept)| match kept {
            Record::Event(kept) => merge(kept, &event).then_some(at),
            _ => None,
        });
        match place {
            Some(at) => *at = ticks,
            None => self.kept.push((ticks, Record::Event(event))),
        }
    }

    /// What appears in the stream instead.
    pub fn records(mut self) -> Vec<(u64, Record)> {
        self.kept.sort_by_key(|(ticks, _)| *ticks);
        let ticks = self.ticks;
        for channel in Channel::ALL {
            let (lost, errors) = (self.lost[channel.index()], self.errors[channel.index()]);
            if errors > 0 {
                let event = Event::ErrorsSuppressed { channel, count: errors };
                self.kept.push((ticks, Record::Event(event)));
            }
            if lost > 0 {
                let event = Event::Lost { channel, stage: LossStage::Host, count: lost, at_least: false };
                self.kept.push((ticks, Record::Event(event)));
            }
        }
        self.kept
    }
}

/// Merges two events of one kind. Returns whether that was possible.
fn merge(kept: &mut Event, next: &Event) -> bool {
    match (kept, next) {
        (
            Event::Lost { channel, stage, count, at_least },
            Event::Lost { channel: next, stage: next_stage, count: more, at_least: next_at_least },
        ) if channel == next && stage == next_stage && (*count == 0) == (*more == 0) => {
            *count = count.saturating_add(*more);
            *at_least |= next_at_least;
            true
        }
        (
            Event::State { channel, state, tec, rec },
            Event::State { channel: next, state: next_state, tec: next_tec, rec: next_rec },
        ) if channel == next => {
            (*state, *tec, *rec) = (*next_state, *next_tec, *next_rec);
            true
        }
        (
            Event::TransmitFailed { channel, tag, reason: TransmitFailure::Overtaken { periods } },
            Event::TransmitFailed {
                channel: next,
                tag: next_tag,
                reason: TransmitFailure::Overtaken { periods: more },
            },
        ) if channel == next && tag == next_tag => {
            *periods = periods.saturating_add(*more);
            true
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_wire::record::ErrorState;

    fn lost(channel: Channel, stage: LossStage, count: u32, at_least: bool) -> Event {
        Event::Lost { channel, stage, count, at_least }
    }

    #[test]
    fn an_fd_frame_passes_filters_as_a_data_frame_of_its_identifier_and_loses_what_is_omitted() {
        use cantap_wire::message::FrameKind;
        use cantap_wire::{BitTiming, FdFrame, Id, Stamp};
        let channel = Channel::Can2;
        let id = Id::standard(0x123).unwrap();
        let frame = FdFrame::new(id, true, false, &[7; 12]).unwrap();
        let received = ReceivedFd { channel, frame, stamp: Stamp::Exact, data_omitted: false };
        let entry = Entry { ticks: 1, record: Record::ReceivedFd(received), owner: None };
        let timing = BitTiming::choose(36_000_000, 500_000, None).unwrap();
        let mut views = Views::default();
        assert_eq!(shown(&entry, 1, &views), None);
        let mut config = ChannelConfig::listen_only(timing);
        views[1].config = Some(config);
        assert_eq!(shown(&entry, 1, &views), Some(entry.record));
        let filter = |id, kind| Filter { extended: false, id, mask: 0x7FF, kind };
        for (filter, passes) in [
            (filter(0x123, FrameKind::Data), true),
            (filter(0x123, FrameKind::Any), true),
            (filter(0x123, FrameKind::Remote), false),
            (filter(0x124, FrameKind::Any), false),
        ] {
            views[1].filters = vec![filter];
            assert_eq!(shown(&entry, 1, &views).is_some(), passes, "{filter:?}");
        }
        views[1].filters.clear();
        (config.omit_data, config.omit_stamps) = (true, true);
        views[1].config = Some(config);
        let wanted = ReceivedFd { stamp: Stamp::Omitted, data_omitted: true, ..received };
        assert_eq!(shown(&entry, 1, &views), Some(Record::ReceivedFd(wanted)));
        let mut gap = Gap::default();
        assert_eq!(gap.absorb(5, &entry.record), Some(channel));
        let lost = Record::Event(lost(channel, LossStage::Host, 1, false));
        assert_eq!(gap.records(), [(5, lost)]);
    }

    /// As [`crate::outbox::MOST_RECORDS`] says.
    #[test]
    fn a_record_takes_no_more_memory_than_a_server_reckons_with() {
        assert_eq!(size_of::<Entry>(), 112);
    }

    #[test]
    fn a_gap_counts_frames_keeps_what_matters_and_does_not_grow_with_what_repeats() {
        let frame: Frame = "123#11".parse().unwrap();
        let mut gap = Gap::default();
        let channel = Channel::Can2;
        let received = Received { channel, frame, stamp: cantap_wire::Stamp::Exact, data_omitted: false };
        for ticks in 0..1000 {
            gap.absorb(ticks, &Record::Received(received));
            for event in [
                Event::Transmitted { channel, tag: OTHERS_TAG, frame },
                lost(Channel::Can1, LossStage::Controller, 1, true),
                Event::State { channel, state: ErrorState::Passive, tec: 128, rec: ticks as u8 },
                Event::BusError { channel, kind: cantap_wire::record::BusErrorKind::Stuff, tec: 0, rec: 0 },
                Event::TransmitFailed {
                    channel,
                    tag: DEVICE_TAG,
                    reason: TransmitFailure::Overtaken { periods: 2 },
                },
                Event::SofMark { frame: 1, doubled: 0 },
            ] {
                gap.absorb(ticks, &Record::Event(event));
            }
        }
        let own = Event::Transmitted { channel, tag: 7, frame };
        gap.absorb(1000, &Record::Event(own));
        let state = Event::State { channel, state: ErrorState::Passive, tec: 128, rec: 999u16 as u8 };
        let overtaken = TransmitFailure::Overtaken { periods: 2000 };
        let id = cantap_wire::Id::standard(0x123).unwrap();
        let fd = cantap_wire::FdFrame::new(id, true, false, &[7; 12]).unwrap();
        let own_fd = Record::TransmittedFd(TransmittedFd { channel, tag: 8, frame: fd });
        assert_eq!(gap.absorb(1000, &own_fd), None);
        let others = Record::TransmittedFd(TransmittedFd { channel, tag: OTHERS_TAG, frame: fd });
        assert_eq!(gap.absorb(1000, &others), Some(channel));
        let events = gap.records();
        assert_eq!(
            events,
            [
                (999, lost(Channel::Can1, LossStage::Controller, 1000, true)),
                (999, state),
                (999, Event::TransmitFailed { channel, tag: DEVICE_TAG, reason: overtaken }),
                (1000, own),
            ]
            .map(|(ticks, event)| (ticks, Record::Event(event)))
            .into_iter()
            .chain([
                (1000, own_fd),
                (1000, Record::Event(Event::ErrorsSuppressed { channel, count: 1000 })),
                (1000, Record::Event(lost(channel, LossStage::Host, 2001, false))),
            ])
            .collect::<Vec<_>>()
        );
    }
}
