//! Related protocols that are recognised but not decoded: OSEK network management, CAN Kingdom and CAL, by their
//! identifiers and what their frames look like; and RV-C, which is then read with J1939.

mod rv_c;

use std::fmt;

use cantap_trace::TraceFrame;
use rustc_hash::FxHashMap;

use crate::j1939::rv_c_name;

/// A protocol that is recognised but not decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Relative {
    /// OSEK/VDX network management, direct monitoring: a token circulates in a ring of nodes.
    OsekNm {
        /// The ring's first identifier, that of node 0.
        base: u32,
        /// Its last identifier.
        last: u32,
    },
    /// CAN Kingdom: the king tells cities what to do, with identifier 0.
    CanKingdom,
    /// CAL (CiA 201 to 207), CANopen's predecessor: it guards nodes with identifiers that CANopen does not use for that.
    Cal,
    /// RV-C, J1939's relative in caravans and motor homes.
    RvC {
        /// Up to three of its groups that were seen.
        examples: [Option<u32>; 3],
        /// How many different ones were seen.
        groups: u32,
    },
}

impl fmt::Display for Relative {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OsekNm { base, last } => {
                write!(f, "OSEK network management with the identifiers {base:03X} to {last:03X}")
            }
            Self::CanKingdom => f.write_str("CAN Kingdom, whose king sends with identifier 000"),
            Self::Cal => f.write_str("CAL, whose master guards node N with identifier 6E0 + N"),
            Self::RvC { examples, groups } => {
                write!(f, "RV-C ({groups} of its groups")?;
                for (pgn, mark) in examples.iter().flatten().zip([": ", ", ", ", "]) {
                    write!(f, "{mark}{pgn:05X} {}", rv_c_name(*pgn).unwrap_or_default())?;
                }
                f.write_str(")")
            }
        }
    }
}

/// How often a sign must have been seen: a token passed on by the node it was meant for, a toggle bit that toggled.
const ENOUGH: u32 = 4;
/// How many identifiers a ring may have. The standard leaves it open; Volkswagen's have fewer than 256 (public
/// implementation: revag-nm).
const RINGS: [u32; 3] = [0x100, 0x40, 0x20];
/// All identifiers of 11 bits.
const IDENTIFIERS: u32 = 0x800;

/// Counts on one channel.
#[derive(Clone, Debug, Default)]
pub(crate) struct Relatives {
    /// For each size of `RINGS`, those that fit into 11 bits; empty until the first frame.
    rings: [Vec<Ring>; 3],
    king: King,
    guard: Guard,
    rv_c: rv_c::Signs,
}

/// The frames of one ring's identifiers, once for each of the codes that a ring message may have: 2, and 1 on Volkswagen's.
#[derive(Clone, Copy, Debug, Default)]
struct Ring {
    codes: [Token; 2],
}

/// Where the token is.
#[derive(Clone, Copy, Debug, Default)]
struct Token {
    /// The receiver of the last ring message.
    next: Option<u8>,
    handed_on: u32,
    /// Ring messages from other nodes, and frames that are not network management messages.
    other: u32,
}

/// Frames of a kingdom's king.
#[derive(Clone, Copy, Debug, Default)]
struct King {
    /// Which pages occurred with identifier 0, one bit each.
    pages: u32,
    /// The letter with which a king starts up his kingdom.
    default_letter: bool,
    other: u32,
}

/// CAL's node guarding: a remote frame, then one byte with the same identifier, whose highest bit toggles.
#[derive(Clone, Debug, Default)]
struct Guard {
    asked: Option<u32>,
    /// The last toggle bits; at most one for each identifier of node guarding.
    toggles: FxHashMap<u32, bool>,
    toggled: u32,
}

impl Relatives {
    /// Takes a frame.
    pub fn take(&mut self, frame: &TraceFrame) {
        if frame.id().is_extended() {
            self.rv_c.take(frame);
            return;
        }
        let (id, data) = (frame.id().raw(), frame.data());
        if frame.is_remote() {
            self.guard.asked = Some(id);
            return;
        }
        self.guard.take(id, data);
        self.king.take(id, data);
        if id == 0 {
            return;
        }
        for (rings, size) in self.rings.iter_mut().zip(RINGS) {
            if rings.is_empty() {
                rings.resize((IDENTIFIERS / size) as usize, Ring::default());
            }
            if let Some(ring) = rings.get_mut((id / size) as usize) {
                ring.take((id % size) as u8, data);
            }
        }
    }

    /// Up to three groups of RV-C, and how many there were, if it is that.
    pub fn rv_c(&self) -> Option<([Option<u32>; 3], u32)> {
        self.rv_c.found()
    }

    /// The protocols recognised.
    pub fn found(&self) -> Vec<Relative> {
        let mut found = Vec::new();
        for (rings, size) in self.rings.iter().zip(RINGS) {
            for (ring, number) in rings.iter().zip(0..) {
                let (base, last) = (number * size, number * size + size - 1);
                // A ring of few nodes is one of many as well.
                let contains = |known: &Relative| matches!(known, Relative::OsekNm { base: first, last: end } if (*first..=*end).contains(&base));
                if ring.is_one() && !found.iter().any(contains) {
                    found.push(Relative::OsekNm { base, last });
                }
            }
        }
        if self.king.is_one() {
            found.push(Relative::CanKingdom);
        }
        if self.guard.toggled >= ENOUGH {
            found.push(Relative::Cal);
        }
        found.extend(self.rv_c().map(|(examples, groups)| Relative::RvC { examples, groups }));
        found
    }
}

impl Ring {
    fn take(&mut self, node: u8, data: &[u8]) {
        // The receiver, then the kind of message: alive, ring or limp home, with sleep indication and acknowledgement.
        let (to, code) = match *data {
            [to, code, ..] if matches!(code & 0xCF, 1 | 2 | 4) => (to, code & 0x0F),
            _ => {
                for token in &mut self.codes {
                    token.other += 1;
                }
                return;
            }
        };
        let Some(token) = self.codes.get_mut(usize::from(code) - 1) else { return };
        match token.next.replace(to) {
            // A ring of one node sends to itself, as would any constant.
            Some(due) if due == node && to != node => token.handed_on += 1,
            Some(_) => token.other += 1,
            None => {}
        }
    }

    fn is_one(&self) -> bool {
        self.codes.iter().any(|token| token.handed_on >= ENOUGH && token.other * 4 <= token.handed_on)
    }
}

impl King {
    /// City, page, and the content of the page. The pages are those that public implementations have: Kvaser's, and
    /// that of the rover of the CAN education project.
    fn take(&mut self, id: u32, data: &[u8]) {
        match (id, data) {
            (0, [_, page @ (0..=5 | 8 | 9 | 16 | 17), ..]) if data.len() == 8 => self.pages |= 1 << page,
            (0, _) => self.other += 1,
            (2031, [0xAA, ..]) => self.default_letter |= *data == [0xAA; 8],
            _ => {}
        }
    }

    const fn is_one(&self) -> bool {
        let pages = self.pages.count_ones();
        self.other == 0 && (pages > 1 || pages == 1 && self.default_letter)
    }
}

impl Guard {
    fn take(&mut self, id: u32, data: &[u8]) {
        // Identifiers 1761 to 2015 (CiA 201 to 207), except for those that are CANopen's guarding as well, 701 to 77F.
        let is_asked = self.asked.take() == Some(id);
        match (id, data) {
            (1761..=1792 | 1920..=2015, &[state]) if is_asked => {
                let toggle = state & 0x80 != 0;
                if self.toggles.insert(id, toggle) == Some(!toggle) {
                    self.toggled += 1;
                }
            }
            _ => {}
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
        assert_eq!(
            found(&[&alive[..], &ring, &ring].concat()),
            [Relative::OsekNm { base: 0x400, last: 0x4FF }]
        );
        assert_eq!(found(&ring), [], "not handed on often enough");
        let wrong = ["403#0702000000000000", "412#0702000000000000"];
        assert_eq!(found(&[wrong, wrong, wrong, wrong].concat()), []);
        assert_eq!(
            Relative::OsekNm { base: 0x400, last: 0x4FF }.to_string(),
            "OSEK network management with the identifiers 400 to 4FF"
        );
    }

    /// Volkswagen's code for a ring message is 1, and its nodes have five bits (public implementation: revag-nm).
    #[test]
    fn a_ring_may_have_fewer_nodes_and_another_code() {
        let login = ["42B#0B02000000000000", "439#1902000000000000"];
        let ring = ["42B#1501000000000000", "435#1901000000000000", "439#0B01000000000000"];
        let others = ["44C#0102030405060708", "480#FF"];
        let frames = [&login[..], &ring, &others, &ring, &others, &ring].concat();
        assert_eq!(found(&frames), [Relative::OsekNm { base: 0x420, last: 0x43F }]);
    }

    #[test]
    fn a_king_sends_pages_and_a_canopen_master_does_not() {
        assert_eq!(
            found(&["000#0101FF0064000000", "000#0102000001000000", "000#0000000000000000"]),
            [Relative::CanKingdom]
        );
        assert_eq!(found(&["000#0101FF0064000000", "000#0105"]), []);
        assert_eq!(found(&["000#0000000000000000", "000#0000000000000000"]), []);
        assert_eq!(
            found(&["000#0108000000000000", "000#0111000000000000"]),
            [Relative::CanKingdom],
            "bit timing, and page 17"
        );
        let letter = "7EF#AAAAAAAAAAAAAAAA";
        assert_eq!(found(&[letter, "000#0001010300000000"]), [Relative::CanKingdom]);
        assert_eq!(found(&[letter, letter]), []);
    }

    #[test]
    fn cal_guards_nodes_with_identifiers_of_its_own() {
        let guarded =
            ["6E1#R", "6E1#04", "6E1#R", "6E1#84", "6E1#R", "6E1#05", "6E1#R", "6E1#85", "6E1#R", "6E1#05"];
        assert_eq!(found(&guarded), [Relative::Cal]);
        assert_eq!(Relative::Cal.to_string(), "CAL, whose master guards node N with identifier 6E0 + N");
        assert_eq!(found(&guarded[..8]), [], "not often enough");
        let unasked: Vec<_> = guarded.iter().copied().filter(|frame| !frame.ends_with('R')).collect();
        assert_eq!(found(&unasked), []);
        let canopen: Vec<_> = guarded.iter().map(|frame| frame.replace("6E1", "701")).collect();
        assert_eq!(found(&canopen.iter().map(String::as_str).collect::<Vec<_>>()), []);
    }

    #[test]
    fn other_traffic_is_none_of_them() {
        let mut random = fastrand::Rng::with_seed(1);
        // Bytes as they come, and a second byte that is a code of network management all the time.
        for code in [None, Some(1), Some(2)] {
            let mut relatives = Relatives::default();
            for _ in 0..20_000 {
                let (id, first) = (random.u16(1..0x800), random.u8(..));
                let second = code.unwrap_or_else(|| random.u8(..));
                relatives.take(&format!("{id:03X}#{first:02X}{second:02X}000000000000").parse().unwrap());
            }
            assert_eq!(relatives.found(), []);
        }
    }
}
