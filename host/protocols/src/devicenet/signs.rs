//! Signs that are specific to a DeviceNet bus.

use cantap_trace::TraceFrame;

use super::identifiers::{Use, use_of};

/// A node repeats its check after a second, and then has its MAC ID: checks that follow sooner are other traffic.
const SOONEST_NS: i64 = 500_000_000;
/// A node that is switched on again checks again, but not at once: this many in a row are other traffic.
const MOST_IN_A_ROW: u8 = 4;
const ROW_NS: i64 = 3_000_000_000;

/// Counts on one channel.
#[derive(Clone, Debug)]
pub(crate) struct DeviceNetSigns {
    nodes: [Checks; 64],
    exchanges: u32,
    /// Frames that are not DeviceNet's.
    foreign: u32,
    /// The last explicit request: node, client and service.
    asked: Option<(u8, u8, u8)>,
}

/// A node's checks for duplicate MAC IDs.
#[derive(Clone, Copy, Debug, Default)]
struct Checks {
    good: u16,
    /// Frames with this identifier that are not checks: they always have seven bytes.
    other: u16,
    in_a_row: u8,
    last_ns: i64,
    /// Vendor and serial number.
    device: [u8; 6],
}

impl Default for DeviceNetSigns {
    fn default() -> Self {
        Self { nodes: [Checks::default(); 64], exchanges: 0, foreign: 0, asked: None }
    }
}

impl Checks {
    fn take(&mut self, time_ns: i64, data: &[u8]) {
        let is_check = match data {
            // Devices have one port, or a few.
            &[port, ref device @ ..] if device.len() == 6 && port & 0x7F < 4 && device[..2] != [0, 0] => {
                let is_answer = port & 0x80 != 0;
                let since_ns = time_ns.saturating_sub(self.last_ns);
                let is_first = self.good == 0;
                let is_other_device = !is_first && !is_answer && self.device != *device && since_ns < ROW_NS;
                if !is_answer {
                    self.in_a_row =
                        if is_first || since_ns >= ROW_NS { 1 } else { self.in_a_row.saturating_add(1) };
                    self.device.copy_from_slice(device);
                    self.last_ns = time_ns;
                }
                let too_soon = !is_first && !is_answer && since_ns < SOONEST_NS;
                !is_other_device && !too_soon && self.in_a_row < MOST_IN_A_ROW
            }
            _ => false,
        };
        let count = if is_check { &mut self.good } else { &mut self.other };
        *count = count.saturating_add(1);
    }
}

impl DeviceNetSigns {
    /// Takes a frame, and returns whether its identifier is one of those that are examined.
    pub fn take(&mut self, time_ns: i64, frame: &TraceFrame) -> bool {
        if frame.id().is_extended() || frame.is_remote() {
            self.foreign = self.foreign.saturating_add(1);
            return false;
        }
        match (use_of(frame.id().raw() as u16), frame.data()) {
            (Some(Use::DuplicateCheck(node)), data) => {
                self.nodes[usize::from(node & 0x3F)].take(time_ns, data);
            }
            (Some(Use::Request(node)), [client @ 0..=0x3F, service @ 1..=0x7F, _, ..]) => {
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
            (Some(Use::Request(_) | Use::Response(_)), _) => {}
            (used, _) => {
                self.foreign = self.foreign.saturating_add(u32::from(used.is_none()));
                return false;
            }
        }
        true
    }

    /// The number of messages that indicate it; zero if others contradict it.
    pub fn count(&self) -> u32 {
        let (mut good, mut other) = (0, 0);
        for checks in &self.nodes {
            match checks.other {
                0 => good += u32::from(checks.good),
                count => other += u32::from(count),
            }
        }
        // A single check shows it where there is nothing that is not DeviceNet's.
        let enough = good + self.exchanges > u32::from(self.foreign > 0);
        if enough && other <= good + self.exchanges { good + self.exchanges } else { 0 }
    }
}
