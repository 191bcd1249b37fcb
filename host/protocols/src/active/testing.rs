//! Runs machines against each other, on a bus on which every frame can be dropped, doubled or swapped.

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

use super::Machine;

/// Frames to send, each with its delay in nanoseconds.
pub type Say = Vec<(u64, Frame)>;

/// Duration of a frame.
pub const FRAME_NS: u64 = 250_000;
/// No machine may take longer than this, whatever happens on the bus.
const LONGEST_NS: u64 = 600_000_000_000;

/// The other side of the bus: takes frames and sends frames.
pub trait Peer {
    /// A frame from the machine; answers are appended, each with its delay.
    fn hear(&mut self, id: Id, data: &[u8], say: &mut Say);
}

impl<F: FnMut(Id, &[u8], &mut Say)> Peer for F {
    fn hear(&mut self, id: Id, data: &[u8], say: &mut Say) {
        self(id, data, say);
    }
}

/// What the bus does to the frames from the other side.
pub enum Fate {
    Arrives,
    Lost,
    Doubled,
    /// Arrives after the next one.
    Late,
}

/// Runs a machine until it ends; returns how long it took and everything that it sent.
pub fn run(
    machine: &mut (impl Machine + ?Sized),
    peer: &mut impl Peer,
    mut fate: impl FnMut() -> Fate,
) -> (u64, Vec<Frame>) {
    let mut now_ns = 1;
    let mut waiting: VecDeque<(u64, Frame)> = VecDeque::new();
    let mut held: Option<Frame> = None;
    let mut sent = Vec::new();
    loop {
        let mut mine = VecDeque::new();
        while let Some(frame) = machine.next(now_ns) {
            mine.push_back(frame);
        }
        let was_busy = !mine.is_empty();
        for frame in mine {
            now_ns += FRAME_NS;
            machine.sent(now_ns);
            sent.push(frame);
            let mut said = Vec::new();
            peer.hear(frame.id(), frame.data(), &mut said);
            waiting.extend(said.into_iter().map(|(after, frame)| (now_ns + after, frame)));
        }
        if machine.is_done() {
            return (now_ns, sent);
        }
        if was_busy {
            continue;
        }
        waiting.make_contiguous().sort_by_key(|(at_ns, _)| *at_ns);
        let due_ns = machine.due_ns();
        match waiting.front().copied() {
            Some((at_ns, frame)) if due_ns.is_none_or(|due_ns| at_ns < due_ns) => {
                waiting.pop_front();
                now_ns = now_ns.max(at_ns) + FRAME_NS;
                let mut arrive = |frame: Frame| machine.hear(now_ns, frame.id(), frame.data());
                match fate() {
                    Fate::Late if held.is_none() => {
                        held = Some(frame);
                        continue;
                    }
                    Fate::Arrives | Fate::Late => arrive(frame),
                    Fate::Lost => {}
                    Fate::Doubled => {
                        arrive(frame);
                        arrive(frame);
                    }
                }
                if let Some(frame) = held.take() {
                    arrive(frame);
                }
            }
            _ => now_ns = now_ns.max(due_ns.expect("it waits for something")),
        }
        assert!(now_ns < LONGEST_NS, "it does not end");
    }
}

/// A bus on which every frame arrives.
pub fn arrives() -> Fate {
    Fate::Arrives
}

/// A bus that disturbs some of the frames.
pub fn disturbed(random: &mut fastrand::Rng, one_in: u32) -> impl FnMut() -> Fate {
    let mut random = random.fork();
    move || match random.u32(0..one_in * 3) {
        0 => Fate::Lost,
        1 => Fate::Doubled,
        2 => Fate::Late,
        _ => Fate::Arrives,
    }
}
