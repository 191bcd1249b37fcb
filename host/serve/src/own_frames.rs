//! The frames that a client has sent itself: programs with a protocol of their own expect the others' frames only.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use cantap_trace::{TraceEvent, TraceFrame};
use cantap_wire::{Frame, Id};

/// After a loss, frames sent before it are taken for finished: their records may be among those that were lost. One that is still not on the bus then
/// is shown to its sender, which is better than to hide another's.
const FINISHED_WITHIN: Duration = Duration::from_secs(2);

/// What one client has sent on one channel.
#[derive(Default)]
pub struct OwnFrames {
    /// By tag, until they are on the bus.
    single: HashMap<u32, Sent>,
    /// Those sent for it repeatedly.
    repeated: HashMap<Id, Frame>,
}

struct Sent {
    frame: TraceFrame,
    /// Since when its record may be among those that were lost.
    uncertain: Option<Instant>,
}

impl OwnFrames {
    /// A frame is about to be sent.
    pub fn sends(&mut self, tag: u32, frame: impl Into<TraceFrame>) {
        self.single.insert(tag, Sent { frame: frame.into(), uncertain: None });
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

    /// Something else than a frame is in the channel's records.
    pub fn event(&mut self, event: &TraceEvent) {
        match event {
            TraceEvent::TransmitFailed { tag, .. } => self.failed(*tag),
            TraceEvent::Lost { .. } => {
                for sent in self.single.values_mut() {
                    sent.uncertain.get_or_insert_with(Instant::now);
                }
            }
            _ => {}
        }
    }

    /// Whether the client sent a frame that was on the bus itself; if so, that is now complete.
    pub fn take(&mut self, frame: impl Into<TraceFrame>) -> bool {
        self.take_at(frame.into(), Instant::now())
    }

    fn take_at(&mut self, frame: TraceFrame, now: Instant) -> bool {
        self.single.retain(|_, sent| {
            sent.uncertain.is_none_or(|since| now.saturating_duration_since(since) <= FINISHED_WITHIN)
        });
        if self.repeated.get(&frame.id()).is_some_and(|own| Some(own) == frame.classic()) {
            return true;
        }
        let tag = self.single.iter().find(|(_, own)| own.frame == frame).map(|(tag, _)| *tag);
        tag.is_some_and(|tag| self.single.remove(&tag).is_some())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(text: &str) -> TraceFrame {
        text.parse().unwrap()
    }

    #[test]
    fn a_frame_whose_record_was_lost_hides_no_other_client_s() {
        let mut own = OwnFrames::default();
        own.sends(1, frame("123#11"));
        own.event(&TraceEvent::UNCOUNTED);
        // It may still come.
        assert!(own.take_at(frame("123#11"), Instant::now()));
        own.sends(2, frame("123#11"));
        own.event(&TraceEvent::UNCOUNTED);
        let later = Instant::now() + 2 * FINISHED_WITHIN;
        // What was sent after the loss is its own as before.
        own.sends(3, frame("124#11"));
        assert!(!own.take_at(frame("123#11"), later));
        assert!(own.take_at(frame("124#11"), later));
        assert!(own.single.is_empty());
    }
}
