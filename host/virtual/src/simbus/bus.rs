//! The bus: one frame at a time, the lowest identifier first.

use cantap_wire::record::BusErrorKind;
use cantap_wire::{Frame, Id};

use super::Traffic;
use super::waveform::{Edge, Waveform};
use cantap_trace::bits::{FrameBits, INTERMISSION_BITS};

/// Bits from an error to the next chance to send: six to twelve bits of error flags, eight of delimiter,
/// three of intermission (ISO 11898-1:2015, 10.4.4). This is the middle.
const ERROR_FRAME_BITS: u64 = 9 + 8 + 3;
/// Bits of a frame after the ACK slot: its delimiter and the end of frame.
const AFTER_ACK_BITS: u32 = 1 + 7;
/// The bit rate of a bus without a fixed one while it is only watched.
const WATCHED_BPS: u32 = 500_000;
/// "Never", for times.
const NEVER: u64 = u64::MAX;

/// A controller on the bus.
pub trait Node {
    /// Its bit rate in bit/s, while it takes part in the bus.
    fn bitrate_bps(&self) -> Option<u32>;
    /// The frame that it wants to send, if any.
    fn bid(&self) -> Option<Frame>;
    /// Whether it acknowledges other nodes' frames.
    fn acknowledges(&self) -> bool;
    /// Whether its error flags destroy other nodes' frames that it cannot read.
    fn destroys(&self) -> bool;
    /// Whether the frame that it sends is destroyed, whatever else happens.
    fn is_disturbed(&self) -> bool {
        false
    }
    /// Its frame has won arbitration: it cannot be withdrawn any more.
    fn on_start(&mut self);
    /// Its frame has lost to a lower identifier.
    fn on_lost(&mut self);
    /// A frame has ended well. `own` if this node sent it.
    fn on_frame(&mut self, frame: &Frame, own: bool);
    /// A frame was destroyed. `own` if this node sent it.
    fn on_error(&mut self, kind: BusErrorKind, own: bool);
    /// No frame is on the bus: nodes waiting to join or leave may do so.
    fn on_boundary(&mut self);
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// Free since this time, or from this time on.
    Free { from_ns: u64 },
    /// Busy with a frame that ends well or with this error.
    Busy { frame: Frame, sender: Option<usize>, error: Option<BusErrorKind>, end_ns: u64, free_ns: u64 },
}

/// A bus with simulated nodes that send [`Traffic`], and other nodes that are passed to each call.
pub struct SimBus {
    /// `None` for that of the first controller that joins.
    bitrate_bps: Option<u32>,
    traffic: Traffic,
    /// Whether the simulated nodes acknowledge.
    others_acknowledge: bool,
    /// Percentage of the simulated nodes' frames that are destroyed.
    error_percent: f64,
    /// How many of the controllers' next frames to destroy.
    disturbed: u32,
    /// Whatever begins before this time is destroyed.
    burst_until_ns: u64,
    random: fastrand::Rng,
    phase: Phase,
    /// Since when nobody has listened, so that the simulated nodes are silent.
    silent_from_ns: Option<u64>,
    /// Somebody watches the level, for which no controller needs to be on the bus.
    watched: bool,
    waveform: Waveform,
}

impl SimBus {
    /// A bus with a fixed bit rate or, without one, with that of the controller that joins it.
    pub fn new(bitrate_bps: Option<u32>, traffic: Traffic, seed: u64) -> Self {
        Self {
            bitrate_bps,
            traffic,
            others_acknowledge: true,
            error_percent: 0.0,
            disturbed: 0,
            burst_until_ns: 0,
            random: fastrand::Rng::with_seed(seed),
            phase: Phase::Free { from_ns: 0 },
            silent_from_ns: None,
            watched: false,
            waveform: Waveform::default(),
        }
    }

    /// Sets whether the level is watched: [`Self::pass_edge`] is then called often.
    pub fn watch(&mut self, watched: bool) {
        if self.watched != watched {
            self.watched = watched;
            self.waveform = Waveform::default();
        }
    }

    /// The next edge whose time has come; each is returned once.
    pub fn pass_edge(&mut self, now_ns: u64) -> Option<Edge> {
        self.waveform.pass(now_ns)
    }

    /// Sets whether the simulated nodes acknowledge others' frames. The default is that they do.
    #[must_use]
    pub fn acknowledging(self, others_acknowledge: bool) -> Self {
        Self { others_acknowledge, ..self }
    }

    /// Destroys a percentage of the simulated nodes' frames; they are sent again.
    #[must_use]
    pub fn with_errors(self, error_percent: f64) -> Self {
        Self { error_percent, ..self }
    }

    /// Destroys this many frames of the controllers passed to each call, starting with the first, counting retries: that
    /// many bit errors. 32 in a row make a controller bus-off.
    #[must_use]
    pub fn disturbing(self, frames: u32) -> Self {
        Self { disturbed: frames, ..self }
    }

    /// Destroys every frame that begins before this time, whoever sends it: an error burst.
    pub const fn destroy_until(&mut self, until_ns: u64) {
        if until_ns > self.burst_until_ns {
            self.burst_until_ns = until_ns;
        }
    }

    /// When something happens next; `u64::MAX` if nothing will before a node changes.
    pub fn next_event_ns(&mut self, now_ns: u64, nodes: &[&mut dyn Node]) -> u64 {
        match self.phase {
            Phase::Busy { end_ns, .. } => end_ns,
            Phase::Free { from_ns } => {
                let Some(bitrate_bps) = self.rate(nodes) else {
                    self.silent_from_ns.get_or_insert(now_ns);
                    return NEVER;
                };
                if let Some(from_ns) = self.silent_from_ns.take() {
                    self.traffic.postpone(now_ns.saturating_sub(from_ns));
                }
                if nodes.iter().any(|node| node.bid().is_some()) {
                    return from_ns.max(now_ns);
                }
                let due = self.traffic.due(from_ns.max(now_ns), bitrate_bps);
                due.map_or(NEVER, |at_ns| at_ns.max(from_ns))
            }
        }
    }

    /// Does what is due at `now_ns`.
    pub fn step(&mut self, now_ns: u64, nodes: &mut [&mut dyn Node]) {
        match self.phase {
            Phase::Busy { frame, sender, error, end_ns, free_ns } if end_ns <= now_ns => {
                self.phase = Phase::Free { from_ns: free_ns };
                self.end_frame(&frame, sender, error, now_ns, nodes);
                join_and_leave(nodes);
            }
            Phase::Free { from_ns } if from_ns <= now_ns => {
                join_and_leave(nodes);
                self.arbitrate(now_ns, nodes);
            }
            Phase::Busy { .. } | Phase::Free { .. } => {}
        }
    }

    /// Whether no frame is on the bus.
    pub const fn is_free(&self) -> bool {
        matches!(self.phase, Phase::Free { .. })
    }

    /// The bus's bit rate, once a node takes part. Simulated nodes are silent while none listens.
    fn rate(&self, nodes: &[&mut dyn Node]) -> Option<u32> {
        let watched = self.watched.then_some(WATCHED_BPS);
        let joined = nodes.iter().find_map(|node| node.bitrate_bps()).or(watched)?;
        Some(self.bitrate_bps.unwrap_or(joined))
    }

    fn arbitrate(&mut self, now_ns: u64, nodes: &mut [&mut dyn Node]) {
        let Some(bitrate_bps) = self.rate(nodes) else { return };
        let bids = nodes.iter().enumerate().filter_map(|(index, node)| Some((Some(index), node.bid()?)));
        let simulated = self.traffic.peek(now_ns, bitrate_bps).filter(|(due_ns, _)| *due_ns <= now_ns);
        let simulated = simulated.map(|(_, frame)| (None, frame));
        let Some((sender, frame)) =
            bids.chain(simulated).min_by_key(|(_, frame)| arbitration_field(frame.id(), frame.is_remote()))
        else {
            return;
        };
        if sender.is_none() {
            self.traffic.take(now_ns);
        }
        for (index, node) in nodes.iter_mut().enumerate().filter(|(_, node)| node.bid().is_some()) {
            if Some(index) == sender { node.on_start() } else { node.on_lost() }
        }
        let bits = FrameBits::of(&frame);
        let at = |bits: u64| now_ns + bits * 1_000_000_000 / u64::from(bitrate_bps.max(1));
        let whole = u64::from(bits.total() - INTERMISSION_BITS);
        let error = self.fate(sender, (now_ns, bitrate_bps), nodes);
        let (end, free) = match error {
            None => (whole, whole + u64::from(INTERMISSION_BITS)),
            Some(BusErrorKind::Acknowledgment) => {
                let end = whole - u64::from(AFTER_ACK_BITS);
                (end, end + ERROR_FRAME_BITS)
            }
            Some(_) => {
                let end = self.random.u64(10..whole);
                (end, end + ERROR_FRAME_BITS)
            }
        };
        if self.watched {
            self.waveform.frame(&frame, now_ns, bitrate_bps, error.map(|error| (error, end)));
        }
        self.phase = Phase::Busy { frame, sender, error, end_ns: at(end), free_ns: at(free) };
    }

    /// Decides how a frame will end.
    fn fate(
        &mut self,
        sender: Option<usize>,
        (now_ns, bitrate_bps): (u64, u32),
        nodes: &[&mut dyn Node],
    ) -> Option<BusErrorKind> {
        const SEEN_BY_OTHERS: [BusErrorKind; 3] =
            [BusErrorKind::Stuff, BusErrorKind::Form, BusErrorKind::Crc];
        const SEEN_BY_SENDERS: [BusErrorKind; 2] = [BusErrorKind::BitDominant, BusErrorKind::BitRecessive];
        if now_ns < self.burst_until_ns || sender.is_some_and(|index| nodes[index].is_disturbed()) {
            let kinds: &[BusErrorKind] = if sender.is_some() { &SEEN_BY_SENDERS } else { &SEEN_BY_OTHERS };
            return Some(kinds[self.random.usize(..kinds.len())]);
        }
        if sender.is_none() && self.error_percent > 0.0 && self.random.f64() * 100.0 < self.error_percent {
            return Some(SEEN_BY_OTHERS[self.random.usize(..SEEN_BY_OTHERS.len())]);
        }
        if let (Some(_), Some(left)) = (sender, self.disturbed.checked_sub(1)) {
            self.disturbed = left;
            let kind = if left % 2 == 0 { BusErrorKind::BitDominant } else { BusErrorKind::BitRecessive };
            return Some(kind);
        }
        let in_step =
            |node: &&mut dyn Node| node.bitrate_bps().is_some_and(|own| same_rate(own, bitrate_bps));
        let out_of_step = |node: &&mut dyn Node| node.bitrate_bps().is_some() && !in_step(node);
        let mut others = nodes.iter().enumerate().filter(|(index, _)| Some(*index) != sender);
        if others.any(|(_, node)| node.destroys() && out_of_step(node)) {
            return Some(BusErrorKind::Stuff);
        }
        let node_acknowledges = nodes
            .iter()
            .enumerate()
            .any(|(index, node)| Some(index) != sender && in_step(node) && node.acknowledges());
        let sender_in_step = sender.is_none_or(|index| in_step(&nodes[index]));
        let acknowledged = sender_in_step && (node_acknowledges || self.others_acknowledge);
        (!acknowledged).then_some(BusErrorKind::Acknowledgment)
    }

    fn end_frame(
        &mut self,
        frame: &Frame,
        sender: Option<usize>,
        error: Option<BusErrorKind>,
        now_ns: u64,
        nodes: &mut [&mut dyn Node],
    ) {
        match (sender, error) {
            (None, Some(_)) => self.traffic.put_back(*frame, now_ns),
            (None, None) => self.traffic.delivered(),
            (Some(_), None) => self.traffic.hear(frame, now_ns),
            (Some(_), Some(_)) => {}
        }
        let bitrate_bps = self.rate(nodes);
        for (index, node) in nodes.iter_mut().enumerate() {
            let own = Some(index) == sender;
            match (node.bitrate_bps(), bitrate_bps) {
                (Some(own_rate), Some(rate)) if own || same_rate(own_rate, rate) => match error {
                    None => node.on_frame(frame, own),
                    // A receiver sees the sender's error flag in place of the end of frame.
                    Some(BusErrorKind::Acknowledgment) if !own => node.on_error(BusErrorKind::Form, false),
                    Some(kind) => node.on_error(kind, own),
                },
                // Bits of a different length look like stuff errors.
                (Some(_), Some(_)) => node.on_error(BusErrorKind::Stuff, false),
                _ => {}
            }
        }
    }
}

fn join_and_leave(nodes: &mut [&mut dyn Node]) {
    for node in nodes {
        node.on_boundary();
    }
}

/// Whether the rates are within the tolerance of any two controllers: 1 %.
fn same_rate(a: u32, b: u32) -> bool {
    u64::from(a.abs_diff(b)) * 100 <= u64::from(b)
}

/// The value that arbitration compares, bit by bit; 0 wins.
pub(crate) fn arbitration_field(id: Id, remote: bool) -> u32 {
    let remote = u32::from(remote);
    let raw = id.raw();
    if id.is_extended() {
        const SRR_AND_IDE: u32 = 0b11;
        (raw >> 18) << 21 | SRR_AND_IDE << 19 | (raw & 0x3_FFFF) << 1 | remote
    } else {
        raw << 21 | remote << 20
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simbus::{FrameSource, Frames, Schedule};

    struct FakeNode {
        bitrate_bps: u32,
        bid: Option<Frame>,
        acknowledges: bool,
        seen: Vec<(Frame, bool)>,
        errors: Vec<(BusErrorKind, bool)>,
    }

    impl FakeNode {
        fn new(bid: Option<&str>) -> Self {
            let bid = bid.map(|text| text.parse().unwrap());
            Self { bitrate_bps: 1_000_000, bid, acknowledges: false, seen: vec![], errors: vec![] }
        }
    }

    impl Node for FakeNode {
        fn bitrate_bps(&self) -> Option<u32> {
            Some(self.bitrate_bps)
        }
        fn bid(&self) -> Option<Frame> {
            self.bid
        }
        fn acknowledges(&self) -> bool {
            self.acknowledges
        }
        fn destroys(&self) -> bool {
            self.acknowledges
        }
        fn on_start(&mut self) {}
        fn on_lost(&mut self) {}
        fn on_frame(&mut self, frame: &Frame, own: bool) {
            self.seen.push((*frame, own));
            if own {
                self.bid = None;
            }
        }
        fn on_error(&mut self, kind: BusErrorKind, own: bool) {
            self.errors.push((kind, own));
        }
        fn on_boundary(&mut self) {}
    }

    /// Runs to `until_ns` and returns the times at which frames ended.
    fn run(bus: &mut SimBus, until_ns: u64, nodes: &mut [&mut dyn Node]) {
        let mut now_ns = 0;
        loop {
            now_ns = bus.next_event_ns(now_ns, nodes);
            if now_ns > until_ns {
                return;
            }
            bus.step(now_ns, nodes);
        }
    }

    fn load(frames: Frames, percent: f64) -> Traffic {
        Traffic::new(Schedule::Load { source: FrameSource::new(frames, 1), percent })
    }

    #[test]
    fn a_saturated_bus_carries_exactly_what_fits() {
        let mut bus = SimBus::new(Some(1_000_000), load(Frames::Std0, 100.0), 1);
        let mut node = FakeNode::new(None);
        run(&mut bus, 1_000_000_000, &mut [&mut node]);
        assert_eq!(node.seen.len(), 20_833);
        let expected: Vec<Frame> = FrameSource::new(Frames::Std0, 1).take(20_833).collect();
        assert!(node.seen.iter().map(|(frame, _)| *frame).eq(expected));
    }

    #[test]
    fn a_given_load_is_met() {
        let mut bus = SimBus::new(Some(500_000), load(Frames::Mix, 37.0), 1);
        let mut node = FakeNode { bitrate_bps: 500_000, ..FakeNode::new(None) };
        run(&mut bus, 10_000_000_000, &mut [&mut node]);
        let bits: u64 = node.seen.iter().map(|(frame, _)| u64::from(FrameBits::of(frame).total())).sum();
        let percent = bits as f64 / 5_000_000.0 * 100.0;
        assert!((percent - 37.0).abs() < 0.01, "{percent} %");
    }

    /// Frames that had become due meanwhile once came back to back, so that a bus with a load of 30 % had one of 100 %
    /// for as long as it had slept.
    #[test]
    fn who_comes_back_after_a_while_finds_the_bus_as_it_was() {
        let traffic = [
            load(Frames::Mix, 37.0),
            Traffic::new(Schedule::Bursts {
                source: FrameSource::new(Frames::Std8, 1),
                length: 3,
                period_ns: 10_000_000,
            }),
        ];
        for traffic in traffic {
            let mut bus = SimBus::new(Some(500_000), traffic, 1);
            let mut node = FakeNode { bitrate_bps: 500_000, ..FakeNode::new(None) };
            run(&mut bus, 1_000_000_000, &mut [&mut node]);
            let before = node.seen.len();
            // The frame on the bus ends, and then there is nobody.
            let end_ns = bus.next_event_ns(1_000_000_000, &[]);
            bus.step(end_ns, &mut []);
            assert_eq!(bus.next_event_ns(1_001_000_000, &[]), NEVER);
            assert_eq!(bus.next_event_ns(5_000_000_000, &[]), NEVER);
            let mut now_ns = 8_000_000_000;
            let mut again = FakeNode { bitrate_bps: 500_000, ..FakeNode::new(None) };
            while now_ns < 9_000_000_000 {
                let mut nodes: [&mut dyn Node; 1] = [&mut again];
                now_ns = bus.next_event_ns(now_ns, &nodes);
                bus.step(now_ns, &mut nodes);
            }
            let after = again.seen.len();
            assert!(after.abs_diff(before) < before / 20, "{before} {after}");
        }
    }

    #[test]
    fn bursts_of_ten_take_the_time_that_the_earlier_analyser_measured() {
        let frames = vec!["000#55".parse::<Frame>().unwrap(); 20].into_iter();
        let entries: Vec<(u64, Frame)> =
            frames.enumerate().map(|(n, frame)| (n as u64 / 10 * 960_375, frame)).collect();
        let mut bus =
            SimBus::new(Some(1_000_000), Traffic::new(Schedule::Log { entries: entries.into_iter() }), 1);
        let mut node = FakeNode::new(None);
        // Frame 11 begins 960.375 µs after frame 1; its 55 + 3 bits without intermission take 55 µs.
        run(&mut bus, 960_375 + 54_999, &mut [&mut node]);
        assert_eq!(node.seen.len(), 10);
        run(&mut bus, 960_375 + 55_000, &mut [&mut node]);
        assert_eq!(node.seen.len(), 11);
    }

    #[test]
    fn the_lowest_identifier_wins_and_a_standard_one_beats_its_extended_namesake() {
        let mut bus = SimBus::new(None, Traffic::new(Schedule::Silent), 1);
        let mut nodes = ["101#", "04000000#", "100#R", "100#", "0FF#"].map(|text| FakeNode::new(Some(text)));
        let mut listener = FakeNode::new(None);
        let [a, b, c, d, e] = &mut nodes;
        run(&mut bus, 1_000_000, &mut [a, b, c, d, e, &mut listener]);
        let order: Vec<String> = listener.seen.iter().map(|(frame, _)| frame.to_string()).collect();
        assert_eq!(order, ["0FF#", "100#", "100#R", "04000000#", "101#"]);
    }

    #[test]
    fn without_an_acknowledge_a_sender_tries_on_and_a_listener_sees_form_errors() {
        let mut bus = SimBus::new(None, Traffic::new(Schedule::Silent), 1).acknowledging(false);
        let mut sender = FakeNode::new(Some("100#"));
        let mut listener = FakeNode::new(None);
        run(&mut bus, 1_000_000, &mut [&mut sender, &mut listener]);
        assert!(sender.errors.len() > 10 && sender.seen.is_empty());
        assert!(sender.errors.iter().all(|error| *error == (BusErrorKind::Acknowledgment, true)));
        assert!(listener.errors.iter().all(|error| *error == (BusErrorKind::Form, false)));
        listener.acknowledges = true;
        run(&mut bus, 2_000_000, &mut [&mut sender, &mut listener]);
        assert_eq!((sender.seen.len(), listener.seen.len()), (1, 1));
    }

    #[test]
    fn another_bit_rate_gives_errors_and_no_frame() {
        let mut bus = SimBus::new(Some(250_000), load(Frames::Std8, 50.0), 1);
        let mut node = FakeNode { bitrate_bps: 500_000, ..FakeNode::new(None) };
        run(&mut bus, 100_000_000, &mut [&mut node]);
        assert!(node.seen.is_empty() && node.errors.len() > 50);
    }

    #[test]
    fn who_takes_part_at_another_bit_rate_destroys_what_others_send() {
        let mut bus = SimBus::new(Some(500_000), load(Frames::Std8, 50.0), 1);
        let mut listener = FakeNode { bitrate_bps: 500_000, ..FakeNode::new(None) };
        let mut wrong = FakeNode { bitrate_bps: 250_000, ..FakeNode::new(None) };
        run(&mut bus, 50_000_000, &mut [&mut listener, &mut wrong]);
        let good = listener.seen.len();
        assert!(good > 90 && listener.errors.is_empty(), "one that only listens disturbs nobody: {good}");
        wrong.acknowledges = true;
        run(&mut bus, 100_000_000, &mut [&mut listener, &mut wrong]);
        assert!(listener.seen.len() <= good + 1 && listener.errors.len() > 50);
    }

    #[test]
    fn destroyed_frames_are_sent_again() {
        let mut bus = SimBus::new(Some(1_000_000), load(Frames::Std0, 100.0), 1).with_errors(10.0);
        let mut node = FakeNode::new(None);
        run(&mut bus, 100_000_000, &mut [&mut node]);
        let share = node.errors.len() as f64 / (node.errors.len() + node.seen.len()) as f64;
        assert!((0.07..0.13).contains(&share), "{share}");
        let expected: Vec<Frame> = FrameSource::new(Frames::Std0, 1).take(node.seen.len()).collect();
        assert!(node.seen.iter().map(|(frame, _)| *frame).eq(expected));
    }
}
