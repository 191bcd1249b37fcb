//! Signs that are specific to a CANopen bus.

use cantap_trace::TraceFrame;

/// Counts on one channel.
#[derive(Clone, Debug, Default)]
pub(crate) struct CanOpenSigns {
    heartbeats: u32,
    /// Frames that no node sends with a heartbeat's identifier.
    other: u32,
    exchanges: u32,
    /// The last request of an SDO client: node, index and sub-index.
    asked: Option<(u8, [u8; 3])>,
}

impl CanOpenSigns {
    /// Takes a frame.
    pub fn take(&mut self, frame: &TraceFrame) {
        let id = frame.id();
        if id.is_extended() || frame.is_remote() {
            return;
        }
        let (node, data) = ((id.raw() & 0x7F) as u8, frame.data());
        match id.raw() {
            0x701..=0x77F => match data {
                [state] if matches!(state & 0x7F, 0 | 4 | 5 | 127) => self.heartbeats += 1,
                _ => self.other += 1,
            },
            0x601..=0x67F => {
                if let &[command, low, high, sub, ..] = data
                    && data.len() == 8
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
            _ => {}
        }
    }

    /// The number of messages that indicate it; zero if others contradict it.
    pub fn count(&self) -> u32 {
        if self.other > self.heartbeats { 0 } else { self.heartbeats + self.exchanges }
    }
}
