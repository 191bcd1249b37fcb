//! Signs that are specific to a DeviceNet bus.

use cantap_trace::TraceFrame;

use super::identifiers::{Use, use_of};

/// Counts on one channel.
#[derive(Clone, Debug, Default)]
pub(crate) struct DeviceNetSigns {
    checks: u32,
    exchanges: u32,
    /// Frames with an identifier used otherwise: a duplicate check always has seven bytes.
    other: u32,
    /// The last explicit request: node, client and service.
    asked: Option<(u8, u8, u8)>,
}

impl DeviceNetSigns {
    /// Takes a frame.
    pub fn take(&mut self, frame: &TraceFrame) {
        if frame.id().is_extended() || frame.is_remote() {
            return;
        }
        match (use_of(frame.id().raw() as u16), frame.data()) {
            (Some(Use::DuplicateCheck(_)), data) if data.len() == 7 => self.checks += 1,
            (Some(Use::DuplicateCheck(_)), _) => self.other += 1,
            (Some(Use::Request(node)), [client @ 0..=0x3F, service @ 0..=0x7F, _, ..]) => {
                self.asked = Some((node, *client, *service));
            }
            (Some(Use::Response(node)), [client @ 0..=0x3F, service @ 0x80..=0xFF, ..]) => {
                let answers = |(asked_node, asked_client, asked_service)| {
                    (asked_node, asked_client) == (node, *client)
                        && (service & 0x7F == asked_service || *service == 0x94)
                };
                if self.asked.take().is_some_and(answers) {
                    self.exchanges += 1;
                }
            }
            _ => {}
        }
    }

    /// The number of messages that indicate it; zero if others contradict it.
    pub fn count(&self) -> u32 {
        let enough = self.checks + self.exchanges > 1;
        if enough && self.other <= self.checks { self.checks + self.exchanges } else { 0 }
    }
}
