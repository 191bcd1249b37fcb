//! Frames that a maker's library has taken and not yet confirmed. It gives them back in the order in which they were on the bus, without a number.

use std::collections::VecDeque;

use cantap_trace::TraceFrame;

/// Frames under way of one channel, the oldest first.
#[derive(Default)]
pub(crate) struct UnderWay(VecDeque<(u8, TraceFrame)>);

impl UnderWay {
    /// A frame was taken.
    pub fn push(&mut self, mailbox: u8, frame: TraceFrame) {
        self.0.push_back((mailbox, frame));
    }

    /// A frame was on the bus: the mailbox of the oldest that is alike, since adapters with several send buffers need not keep the order.
    pub fn confirm(&mut self, frame: &TraceFrame) -> Option<u8> {
        let index = self.0.iter().position(|(_, sent)| are_alike(sent, frame))?;
        self.0.remove(index).map(|(mailbox, _)| mailbox)
    }

    /// Nothing will be confirmed any more.
    pub fn clear(&mut self) {
        self.0.clear();
    }
}

/// Whether a frame that was on the bus is the one that was sent. A controller that is error passive says so in a CAN FD frame, whatever it was
/// given.
pub(crate) fn are_alike(sent: &TraceFrame, seen: &TraceFrame) -> bool {
    match (sent, seen) {
        (TraceFrame::Fd(sent), TraceFrame::Fd(seen)) => {
            (sent.id(), sent.brs(), sent.data()) == (seen.id(), seen.brs(), seen.data())
        }
        _ => sent == seen,
    }
}
