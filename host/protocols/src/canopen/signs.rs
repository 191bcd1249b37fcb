//! Signs that are specific to a CANopen bus.

use cantap_trace::TraceFrame;

/// Counts on one channel.
#[derive(Clone, Debug)]
pub(crate) struct CanOpenSigns {
    /// What the frames with the identifiers of each node's heartbeat are. Node 0 stands for network management.
    nodes: [Beats; 128],
    exchanges: u32,
    /// The last request of an SDO client: node, command, index and sub-index.
    asked: Option<(u8, [u8; 4])>,
}

/// The frames of one identifier.
#[derive(Clone, Copy, Debug, Default)]
struct Beats {
    /// Those that are what CANopen has there.
    good: u16,
    /// The others.
    other: u16,
    /// The last one was a boot-up message.
    boots: bool,
}

impl Default for CanOpenSigns {
    fn default() -> Self {
        Self { nodes: [Beats::default(); 128], exchanges: 0, asked: None }
    }
}

/// Whether the first byte of an SDO request may have this one for an answer.
const fn is_answered_by(request: u8, answer: u8) -> bool {
    const ABORT: u8 = 0x80;
    match request {
        // Reading: with a size or without, expedited or in segments.
        0x40 => matches!(answer, 0x41 | 0x42 | 0x43 | 0x47 | 0x4B | 0x4F | ABORT),
        0x20..=0x23 | 0x27 | 0x2B | 0x2F => matches!(answer, 0x60 | ABORT),
        // Blocks, both ways; a node without them falls back to reading in segments.
        0xA0 | 0xA4 => matches!(answer, 0x41 | 0x43 | 0x47 | 0x4B | 0x4F | 0xC0 | 0xC2 | 0xC4 | 0xC6 | ABORT),
        0xC0 | 0xC2 | 0xC4 | 0xC6 => matches!(answer, 0xA0 | 0xA4 | ABORT),
        _ => false,
    }
}

impl Beats {
    fn count(&mut self, is_good: bool) {
        let count = if is_good { &mut self.good } else { &mut self.other };
        *count = count.saturating_add(1);
    }
}

impl CanOpenSigns {
    /// Takes a frame, and returns whether its identifier is one of those that are examined.
    pub fn take(&mut self, frame: &TraceFrame) -> bool {
        let id = frame.id();
        if id.is_extended() || frame.is_remote() {
            return false;
        }
        let (node, data) = ((id.raw() & 0x7F) as u8, frame.data());
        match id.raw() {
            0 => {
                // Start, stop, pre-operational, reset of the node or of its communication.
                let is_command = matches!(data, [1 | 2 | 128..=130, 0..=127]);
                self.nodes[0].count(is_command);
            }
            0x701..=0x77F => {
                let beats = &mut self.nodes[usize::from(node)];
                match data {
                    [state] if matches!(state & 0x7F, 4 | 5 | 127) => {
                        beats.boots = false;
                        beats.count(true);
                    }
                    // A node boots, and then reports another state: what repeats this is other traffic.
                    [0 | 0x80] => {
                        let again = std::mem::replace(&mut beats.boots, true);
                        beats.count(!again);
                    }
                    _ => beats.count(false),
                }
            }
            0x601..=0x67F => {
                // Objects begin at 1000: what is all zeros is no request.
                if let &[command, low, high, sub, ..] = data
                    && data.len() == 8
                    && high >= 0x10
                {
                    self.asked = Some((node, [command, low, high, sub]));
                }
            }
            0x581..=0x5FF => {
                if let &[command, low, high, sub, ..] = data
                    && data.len() == 8
                    && let Some((asked, [request, object @ ..])) = self.asked
                    && (asked, object) == (node, [low, high, sub])
                    && is_answered_by(request, command)
                {
                    self.asked = None;
                    self.exchanges += 1;
                }
            }
            _ => return false,
        }
        true
    }

    /// The number of messages that indicate it; zero if others contradict it.
    pub fn count(&self) -> u32 {
        let (mut good, mut other) = (0, 0);
        for beats in &self.nodes {
            // An identifier with anything else is not a heartbeat's.
            match beats.other {
                0 => good += u32::from(beats.good),
                count => other += u32::from(count),
            }
        }
        if other > good && other > self.exchanges { 0 } else { good + self.exchanges }
    }
}
