//! The frames that a client has sent itself: programs with a protocol of their own expect the others' frames only.

use std::collections::HashMap;

use cantap_trace::TraceFrame;
use cantap_wire::{Frame, Id};

/// What one client has sent on one channel.
#[derive(Default)]
pub struct OwnFrames {
    /// By tag, until they are on the bus.
    single: HashMap<u32, TraceFrame>,
    /// Those sent for it repeatedly.
    repeated: HashMap<Id, Frame>,
}

impl OwnFrames {
    /// A frame is about to be sent.
    pub fn sends(&mut self, tag: u32, frame: impl Into<TraceFrame>) {
        self.single.insert(tag, frame.into());
    }

    /// It is not.
    pub fn failed(&mut self, tag: u32) {
        self.single.remove(&tag);
    }

    /// A frame is sent repeatedly from now on, or no longer. Returns the one with the same identifier before.
    pub fn repeats(&mut self, id: Id, frame: Option<Frame>) -> Option<Frame> {
        match frame {
            Some(frame) => self.repeated.insert(id, frame),
            None => self.repeated.remove(&id),
        }
    }

    /// Whether the client sent a frame that was on the bus itself; if so, that is now complete.
    pub fn take(&mut self, frame: impl Into<TraceFrame>) -> bool {
        let frame = frame.into();
        if self.repeated.get(&frame.id()).is_some_and(|own| Some(own) == frame.classic()) {
            return true;
        }
        let tag = self.single.iter().find(|(_, own)| **own == frame).map(|(tag, _)| *tag);
        tag.is_some_and(|tag| self.single.remove(&tag).is_some())
    }
}
