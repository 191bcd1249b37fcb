//! The start of a frame: who sends, who wins, who takes part; from that follows everything that happens
//! until the bus is free again.

use cantap_can::BusErrorKind;
use cantap_can::Frame;

use super::bits::FrameBits;
use super::outcome::{self, FrameEnd, Participant};
use super::{BitTime, Disturbance, Flight, Member, SYNC_BITS, Step, Wire, driven, sampling};
use crate::can::{CanPair, Mode};

/// Those who start a frame at the same moment.
struct Contest {
    /// Who wins arbitration.
    sender: Member,
    frame: Frame,
    bits: FrameBits,
    bit: BitTime,
    /// Members that send the very same frame.
    twins: Vec<Member>,
    /// Members that lose arbitration, with the bit at which each does.
    losers: Vec<(Member, usize)>,
    /// Members with the same identifier but different contents, and the first bit that differs.
    collided: Vec<(Member, usize)>,
}

impl Contest {
    fn collides(&self, member: Member) -> bool {
        self.collided.iter().any(|(other, _)| *other == member)
    }

    fn sends(&self, member: Member) -> bool {
        self.sender == member
            || self.twins.contains(&member)
            || self.collides(member)
            || self.losers.iter().any(|(other, _)| *other == member)
    }
}

impl Wire {
    /// Starts a frame now.
    pub(super) fn start_frame(&mut self, can: &mut CanPair) {
        let start = self.now;
        let Some(contest) = self.contest(can) else { return };
        let Contest { sender, frame, ref bits, bit, ref twins, .. } = contest;
        self.count_recovery(can, start);
        for n in self.attached.clone() {
            let own = Member::Controller(n);
            can.controllers[n].start_of_frame(contest.sends(own), start);
        }

        // Every member that listens takes part: the sender, its twins, those who collide with it, receivers.
        let mut members = vec![sender];
        members.extend(twins);
        let senders = members.len();
        members.extend(contest.collided.iter().map(|(member, _)| *member));
        let receivers: Vec<Member> = self
            .members()
            .filter(|member| !members.contains(member))
            .filter(|member| listens(*member, can) && self.understands(*member, bit))
            .collect();
        members.extend(&receivers);
        let participants: Vec<Participant> = members
            .iter()
            .enumerate()
            .map(|(position, member)| {
                let collision = contest.collided.iter().find(|(other, _)| other == member);
                let own = match collision {
                    Some((_, at)) => Some((*at, BusErrorKind::BitRecessive)),
                    None if position < senders => None,
                    None => self.misreceived(*member, bits, bit, can),
                };
                let (acknowledges, flags) = self.abilities(*member, can);
                Participant { sender: position < senders, acknowledges, flags, own }
            })
            .collect();
        let disturbance = self.take_disturbance();
        let outcome = FrameEnd::of(bits, &participants, disturbance);
        let driven = count_dominant(&contest, &members, &participants, &outcome, can);
        self.waveform.frame(start, bit, bits, &participants, &outcome);

        let at = |bits: usize| start + bit.cycles(bits as u64);
        let mut steps: Vec<(u64, Step)> = contest
            .losers
            .iter()
            .map(|(member, bit)| (at(bit + 1), Step::LoseArbitration(*member)))
            .collect();
        for detection in &outcome.detections {
            let member = members[detection.who];
            let sends = detection.who < senders || contest.collides(member);
            steps.push((at(detection.bit + 1), Step::Error(member, sends, *detection)));
        }
        let error = outcome.of_participant(0).map(|detection| detection.kind);
        let good = |who: usize| outcome.of_participant(who).is_none();
        let takers: Vec<Member> = (0..members.len())
            .filter(|who| !participants[*who].sender && good(*who))
            .map(|who| members[who])
            .collect();
        let finish = if error.is_none() { bits.len() } else { outcome.free_after };
        steps.push((at(bits.valid_after()), Step::Receive));
        steps.push((at(finish), Step::Finish));
        steps.sort_by_key(|(time, _)| *time);
        self.flight = Some(Flight {
            sender: Some(sender),
            twins: twins.clone(),
            frame,
            bits: Some(bits.clone()),
            members,
            participants,
            driven,
            start,
            valid: at(bits.valid_after()),
            end: at(bits.len()),
            free: at(outcome.free_after),
            recessive: at(outcome.recessive_from),
            error,
            bit,
            receivers: takers,
            taken_by: 0,
            steps: steps.into(),
        });
        self.started += 1;
        if self.outside.is_active() {
            self.replan(can);
        }
    }

    /// A level from outside, on an idle bus, is a start of frame for all that listen.
    pub(super) fn start_driven(&mut self, at: u64, can: &mut CanPair) {
        self.count_recovery(can, at);
        let members: Vec<Member> = self.members().filter(|member| listens(*member, can)).collect();
        for member in &members {
            if let Member::Controller(n) = *member {
                can.controllers[n].start_of_frame(false, at);
            }
        }
        let part = |member: &Member| {
            let (acknowledges, flags) = self.abilities(*member, can);
            Participant { sender: false, acknowledges, flags, own: None }
        };
        self.flight = Some(Flight {
            sender: None,
            twins: Vec::new(),
            frame: Frame::data_frame(cantap_can::Id::standard_truncated(0), &[]).expect("no data fits"),
            bits: None,
            participants: members.iter().map(part).collect(),
            driven: vec![0; members.len()],
            members,
            start: at,
            valid: at,
            end: at,
            free: at,
            recessive: at,
            error: None,
            bit: self.listener_bit(can),
            receivers: Vec::new(),
            taken_by: 0,
            steps: std::collections::VecDeque::new(),
        });
        self.replan(can);
    }

    /// Works out anew what becomes of the frame under way, after a change of what comes from outside.
    pub(super) fn replan(&mut self, can: &mut CanPair) {
        let Some(mut flight) = self.flight.take() else { return };
        let (start, bit) = (flight.start, flight.bit);
        let at = |bits: usize| start + bit.cycles(bits as u64);
        // Three quarters of a bit, where most nodes sample.
        let sampled = |n: usize| u64::midpoint(at(n), at(n + 1)).midpoint(at(n + 1));
        let outside = &self.outside;
        let is_cut = |who: usize, n: usize| match flight.members[who] {
            Member::Controller(controller) => outside.cuts_at(controller, sampled(n)),
            Member::Node(_) => false,
        };
        let fate = driven::fate(
            flight.bits.as_ref(),
            &flight.participants,
            |n| outside.level_at(sampled(n)),
            is_cut,
        );
        for (who, member) in flight.members.iter().enumerate() {
            if let Member::Controller(n) = *member {
                can.controllers[n].drove_instead(flight.driven[who], fate.driven[who]);
            }
        }
        let mut steps: Vec<(u64, Step)> = Vec::new();
        for (who, lost_at) in &fate.lost {
            steps.push((at(lost_at + 1), Step::LoseArbitration(flight.members[*who])));
        }
        // Those who had lost to the winner before.
        steps.extend(flight.steps.iter().filter(|(_, step)| matches!(step, Step::LoseArbitration(_))));
        for (detection, sends) in &fate.errors {
            let member = flight.members[detection.who];
            steps.push((at(detection.bit + 1), Step::Error(member, *sends, *detection)));
        }
        let error = fate.errors.iter().find(|(detection, _)| detection.who == 0).map(|(one, _)| one.kind);
        flight.error = if fate.sent { None } else { error.or(Some(BusErrorKind::Stuff)) };
        let finish = match (&flight.bits, flight.error) {
            (Some(bits), None) => at(bits.len()),
            _ => at(fate.free_after),
        };
        steps.push((flight.valid, Step::Receive));
        steps.push((finish.max(self.now + 1), Step::Finish));
        steps.retain(|(time, _)| *time > self.now);
        steps.sort_by_key(|(time, _)| *time);
        flight.steps = steps.into();
        flight.receivers = fate.takers.iter().map(|who| flight.members[*who]).collect();
        flight.free = at(fate.free_after);
        flight.recessive = at(fate.recessive_from);
        flight.driven.clone_from(&fate.driven);
        let members = fate.levels.iter().enumerate().filter(|(_, dominant)| **dominant);
        let members = members.map(|(n, _)| (at(n), Some(at(n + 1))));
        self.waveform.redraw(self.now, members.chain(self.outside.levels()).collect());
        self.flight = Some(flight);
    }

    /// Who wants to send now, and who wins; `None` if nobody does.
    fn contest(&self, can: &CanPair) -> Option<Contest> {
        let mut contenders: Vec<(Member, Frame, FrameBits)> = self
            .members()
            .filter_map(|member| {
                let (due, frame) = self.wants(member, can)?;
                (due <= self.now).then(|| (member, frame, FrameBits::new(&frame)))
            })
            .collect();
        let bit = self.bit_of(contenders.first()?.0, can);
        contenders.retain(|(member, ..)| self.bit_of(*member, can).agrees_with(&bit));
        let winner = (1..contenders.len()).fold(0, |best, other| {
            if beats(&contenders[other].2, &contenders[best].2) { other } else { best }
        });
        let (sender, frame, bits) = contenders.swap_remove(winner);
        let bit = self.bit_of(sender, can);
        let mut contest =
            Contest { sender, frame, bits, bit, twins: Vec::new(), losers: Vec::new(), collided: Vec::new() };
        for (member, _, own) in &contenders {
            match first_difference(own, &contest.bits) {
                None => contest.twins.push(*member),
                Some(at) if at < own.arbitration_end() => contest.losers.push((*member, at)),
                Some(at) => contest.collided.push((*member, at)),
            }
        }
        Some(contest)
    }

    /// Simulated nodes of another bit rate than the frame's are left out of it: only the emulated controllers get
    /// to see what a wrong bit rate looks like.
    fn understands(&self, member: Member, bit: BitTime) -> bool {
        match member {
            Member::Controller(_) => true,
            Member::Node(n) => self.nodes[n].bit.agrees_with(&bit),
        }
    }

    /// Whether a member acknowledges, and whether it flags errors with dominant bits.
    pub(super) fn abilities(&self, member: Member, can: &CanPair) -> (bool, bool) {
        match member {
            Member::Controller(n) => {
                let controller = &can.controllers[n];
                (controller.answers(), controller.answers() && !controller.counters().passive())
            }
            Member::Node(n) => {
                let node = &self.nodes[n];
                let sends = node.wanted().is_some();
                (node.acknowledges, (node.acknowledges || sends) && !node.counters.passive())
            }
        }
    }

    /// The error that a receiver of another bit rate sees, and the sender's bit at which it sees it.
    fn misreceived(
        &self,
        member: Member,
        bits: &FrameBits,
        bit: BitTime,
        can: &CanPair,
    ) -> Option<(usize, BusErrorKind)> {
        let Member::Controller(n) = member else { return None };
        if self.bit_of(member, can).agrees_with(&bit) {
            return None;
        }
        let mut levels = bits.levels().to_vec();
        levels[bits.ack_slot()] = false;
        let timing = can.controllers[n].timing();
        match sampling::listen(&levels, |n| bit.cycles(n as u64), &timing) {
            sampling::Reception::Frame => None,
            sampling::Reception::Error { after, kind } => {
                let at = (0..bits.len()).take_while(|n| bit.cycles(*n as u64 + 1) < after).count();
                Some((at.min(bits.len() - 2), kind))
            }
        }
    }

    fn take_disturbance(&mut self) -> Option<Disturbance> {
        /// A bit of the identifier or the control field, which every frame has.
        const NOISY_BITS: std::ops::Range<usize> = 1..19;
        let planned = self.disturbances.pop_front_if(|(frame, _)| *frame <= self.started);
        let (share, random) = &mut self.noise;
        match planned {
            Some((_, disturbance)) => Some(disturbance),
            None if *share > 0.0 && random.f64() < *share => {
                Some(Disturbance::Bit { index: random.usize(NOISY_BITS) })
            }
            None => None,
        }
    }

    /// Sequences of eleven recessive bits since the last frame, for controllers in bus-off.
    fn count_recovery(&self, can: &mut CanPair, start: u64) {
        for n in &self.attached {
            let controller = &mut can.controllers[*n];
            if let Mode::BusOff { since, .. } = controller.mode() {
                let from = since.max(self.recessive);
                let sequences = start.saturating_sub(from) / (SYNC_BITS * controller.timing().bit());
                controller.recover(sequences as u32);
            }
        }
    }
}

fn first_difference(one: &FrameBits, other: &FrameBits) -> Option<usize> {
    let length = one.len().max(other.len());
    (0..length).find(|bit| one.levels().get(*bit) != other.levels().get(*bit))
}

/// Whether `one` is dominant in the first bit that differs.
fn beats(one: &FrameBits, other: &FrameBits) -> bool {
    first_difference(one, other).is_some_and(|bit| one.levels().get(bit) == Some(&false))
}

/// Whether a member takes part in what happens on the bus.
fn listens(member: Member, can: &CanPair) -> bool {
    match member {
        Member::Controller(n) => can.controllers[n].listens(),
        Member::Node(_) => true,
    }
}

/// Adds what each emulated controller puts on the bus in this frame. Returns it for each member.
fn count_dominant(
    contest: &Contest,
    members: &[Member],
    participants: &[Participant],
    outcome: &FrameEnd,
    can: &mut CanPair,
) -> Vec<u64> {
    let mut counted = vec![0; members.len()];
    for (who, member) in members.iter().enumerate() {
        let Member::Controller(n) = *member else { continue };
        let detection = outcome.of_participant(who);
        let sends = participants[who].sender || contest.collides(*member);
        let mut driven = 0;
        if sends {
            driven +=
                contest.bits.dominant_in(detection.map_or(contest.bits.len(), |detection| detection.bit + 1));
        }
        driven += u64::from(outcome.acknowledged_by.contains(&who));
        driven += if detection.is_some() && participants[who].flags { outcome::FLAG as u64 } else { 0 };
        can.controllers[n].drove(driven);
        counted[who] = driven;
    }
    for (member, lost_at) in &contest.losers {
        if let Member::Controller(n) = *member {
            can.controllers[n].drove(contest.bits.dominant_in(*lost_at));
        }
    }
    counted
}
