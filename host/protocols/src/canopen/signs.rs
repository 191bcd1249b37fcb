//! Signs that are specific to a CANopen bus.

use cantap_trace::TraceFrame;

/// Counts on one channel.
#[derive(Clone, Debug)]
pub(crate) struct CanOpenSigns {
    /// What the frames with the identifiers of each node's heartbeat are. Node 0 stands for network management.
    nodes: [Beats; 128],
    exchanges: u32,
    /// The last request of an SDO client: node, index and sub-index.
    asked: Option<(u8, [u8; 3])>,
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
                    && matches!(command >> 5, 1 | 2)
                {
                    self.asked = Some((node, [low, high, sub]));
                }
            }
            0x581..=0x5FF => {
                if let &[command, low, high, sub, ..] = data
                    && data.len() == 8
                    && matches!(command >> 5, 2..=4)
                    && self.asked == Some((node, [low, high, sub]))
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
