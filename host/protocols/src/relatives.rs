//! Related old protocols that are recognised but not decoded: OSEK network management and CAN Kingdom, by what their
//! frames look like.

use std::fmt;

use cantap_trace::TraceFrame;

/// A protocol that is recognised but not decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Relative {
    /// OSEK/VDX network management, direct monitoring: a token circulates in a ring of nodes.
    OsekNm {
        /// The identifiers of the ring without their low byte, which is the node number.
        base: u32,
    },
    /// CAN Kingdom: the king tells cities what to do, with identifier 0.
    CanKingdom,
}

impl fmt::Display for Relative {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OsekNm { base } => {
                write!(f, "OSEK network management with the identifiers {base:03X} to {:03X}", base | 0xFF)
            }
            Self::CanKingdom => f.write_str("CAN Kingdom, whose king sends with identifier 000"),
        }
    }
}

/// How often the token must have been passed on by the node it was meant for.
const HANDED_ON: u32 = 4;
/// How many rings are tracked: bases of 11-bit identifiers.
const BASES: usize = 8;

/// Counts on one channel.
#[derive(Clone, Debug, Default)]
pub(crate) struct Relatives {
    rings: [Ring; BASES],
    king: King,
}

/// The frames of one base.
#[derive(Clone, Copy, Debug, Default)]
struct Ring {
    /// The receiver of the last ring message.
    next: Option<u8>,
    handed_on: u32,
    /// Ring messages from other nodes, and frames that are not network management messages.
    other: u32,
}

/// Frames with identifier 0.
#[derive(Clone, Copy, Debug, Default)]
struct King {
    /// Which of the pages 0, 1, 2, 3, 4 and 16 occurred, one bit each.
    pages: u32,
    other: u32,
}

impl Relatives {
    /// Takes a frame.
    pub fn take(&mut self, frame: &TraceFrame) {
        if frame.id().is_extended() || frame.is_remote() {
            return;
        }
        let (id, data) = (frame.id().raw(), frame.data());
        if id == 0 {
            self.king.take(data);
            return;
        }
        let ring = &mut self.rings[(id >> 8) as usize & (BASES - 1)];
        // The receiver, then the kind of message: alive, ring or limp home, with sleep indication and
        // acknowledgement.
        let [to, code, ..] = data else {
            ring.other += 1;
            return;
        };
        match code & 0xCF {
            1 | 4 if data.len() == 8 => {}
            2 if data.len() == 8 => match ring.next.replace(*to) {
                // A ring of one node sends to itself, as would any constant.
                Some(due) if due == id as u8 && *to != id as u8 => ring.handed_on += 1,
                Some(_) => ring.other += 1,
                None => {}
            },
            _ => ring.other += 1,
        }
    }

    /// The protocols recognised.
    pub fn found(&self) -> Vec<Relative> {
        let rings = self
            .rings
            .iter()
            .zip(0..)
            .filter(|(ring, _)| ring.handed_on >= HANDED_ON && ring.other * 4 <= ring.handed_on);
        let mut found: Vec<_> = rings.map(|(_, base)| Relative::OsekNm { base: base << 8 }).collect();
        if self.king.other == 0 && self.king.pages.count_ones() > 1 {
            found.push(Relative::CanKingdom);
        }
        found
    }
}

impl King {
    /// City, page, and the content of the page.
    fn take(&mut self, data: &[u8]) {
        match data {
            [_, page @ (0..=4 | 16), ..] if data.len() == 8 => self.pages |= 1 << page,
            _ => self.other += 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(frames: &[&str]) -> Vec<Relative> {
        let mut relatives = Relatives::default();
        for frame in frames {
            relatives.take(&frame.parse().unwrap());
        }
        relatives.found()
    }

    #[test]
    fn a_token_that_goes_round_is_network_management() {
        let ring = ["403#0702000000000000", "407#1202000000000000", "412#0302000000000000"];
        let alive = ["403#0301000000000000"];
        assert_eq!(found(&[&alive[..], &ring, &ring].concat()), [Relative::OsekNm { base: 0x400 }]);
        assert_eq!(found(&ring), [], "not handed on often enough");
        let wrong = ["403#0702000000000000", "412#0702000000000000"];
        assert_eq!(found(&[wrong, wrong, wrong, wrong].concat()), []);
        assert_eq!(
            Relative::OsekNm { base: 0x400 }.to_string(),
            "OSEK network management with the identifiers 400 to 4FF"
        );
    }

    #[test]
    fn a_king_sends_pages_and_a_canopen_master_does_not() {
        assert_eq!(
            found(&["000#0101FF0064000000", "000#0102000001000000", "000#0000000000000000"]),
            [Relative::CanKingdom]
        );
        assert_eq!(found(&["000#0101FF0064000000", "000#0105"]), []);
        assert_eq!(found(&["000#0000000000000000", "000#0000000000000000"]), []);
    }
}
