//! Frames that a maker's library has taken and not yet confirmed. It gives them back in the order in which they were on the bus, without a number.

use std::collections::VecDeque;

use cantap_wire::Frame;

/// Frames under way of one channel, the oldest first.
#[derive(Default)]
pub(crate) struct UnderWay(VecDeque<(u8, Frame)>);

impl UnderWay {
    /// A frame was taken.
    pub fn push(&mut self, mailbox: u8, frame: Frame) {
        self.0.push_back((mailbox, frame));
    }

    /// A frame was on the bus: the mailbox of the oldest that is alike, since adapters with several send buffers need not keep the order.
    pub fn confirm(&mut self, frame: &Frame) -> Option<u8> {
        let index = self.0.iter().position(|(_, sent)| sent == frame)?;
        self.0.remove(index).map(|(mailbox, _)| mailbox)
    }

    /// Nothing will be confirmed any more.
    pub fn clear(&mut self) {
        self.0.clear();
    }
}
