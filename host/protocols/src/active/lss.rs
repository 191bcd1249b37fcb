//! Layer setting services (CiA 305) as the master: finds nodes without a number, and sets numbers and bit
//! rates.

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

use super::Machine;
use crate::canopen::codec::lss::{LssRequest, LssResponse, Part, REQUEST, RESPONSE, WHOLE_SCAN};

const WHOLE: i16 = WHOLE_SCAN as i16;
/// The time after an answer for other slaves to send the same one.
const SETTLE_NS: u64 = 10_000_000;

/// A node's identity: object 1018.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LssAddress {
    /// The manufacturer's number from CiA.
    pub vendor: u32,
    /// The manufacturer's product number.
    pub product: u32,
    /// Its revision.
    pub revision: u32,
    /// Its serial number.
    pub serial: u32,
}

/// Why an operation failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LssError {
    /// There is no node without a number.
    #[error("no node without a number answers the fast scan")]
    Nobody,
    /// It answered at first, but not when it should have.
    #[error(
        "the node answered the fast scan, and then did not confirm part {part} of its address; try again with a longer --timeout"
    )]
    Unsteady {
        /// Which of vendor, product, revision, serial number, from 1.
        part: u8,
    },
    /// Another master is at work, so answers may be to its commands.
    #[error("another LSS master sends commands at the same time; there must be only one")]
    OtherMaster,
    /// No answer to a command.
    #[error("no answer to the command {command:02X} within {after_ms} ms")]
    NoAnswer {
        /// The command specifier.
        command: u8,
        /// How long we waited.
        after_ms: u64,
    },
    /// The node refused.
    #[error("the node refused the command {command:02X}: {}", refusal(*command, *error))]
    Refused {
        /// The command specifier.
        command: u8,
        /// Its error code.
        error: u8,
    },
}

const fn refusal(command: u8, error: u8) -> &'static str {
    match (command, error) {
        (0x11, 1) => "the number is out of range",
        (0x13, 1) => "it has no such bit rate",
        (0x17, 1) => "it cannot store",
        (0x17, 2) => "it cannot reach its storage",
        (_, 0xFF) => "a reason specific to the manufacturer",
        _ => "a reserved reason",
    }
}

fn frame(request: LssRequest) -> Frame {
    Frame::from_bus(REQUEST, false, 8, request.encode())
}

/// The state of a question.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Asking {
    /// Not sent yet.
    Pending,
    /// The frame was handed over.
    Sent,
    /// An answer counts until this time.
    Waits { until_ns: u64 },
    /// It was answered; others may answer the same until this time.
    Settles { until_ns: u64 },
}

/// Finds one node without a number, by bisection (CiA 305).
#[derive(Debug)]
pub struct FastScan {
    timeout_ns: u64,
    asking: Asking,
    found: [u32; 4],
    /// [`WHOLE`] asks whether there is any node; then 31 to 0; -1 confirms the part.
    bit: i16,
    part: u8,
    has_answer: bool,
    end: Option<Result<(), LssError>>,
}

impl FastScan {
    /// Waits this long for the answer to each question. There are up to 133.
    pub const fn new(timeout_ns: u64) -> Self {
        Self {
            timeout_ns,
            asking: Asking::Pending,
            found: [0; 4],
            bit: WHOLE,
            part: 0,
            has_answer: false,
            end: None,
        }
    }

    /// The node that was found; it is now the only one in configuration mode. Call it when the scan is done.
    pub fn finish(self) -> Result<LssAddress, LssError> {
        let [vendor, product, revision, serial] = self.found;
        self.end.unwrap_or(Err(LssError::Nobody)).map(|()| LssAddress { vendor, product, revision, serial })
    }

    fn question(&self) -> LssRequest {
        let (unchecked, next) = match self.bit {
            -1 => (0, (self.part + 1) & 3),
            bit => (bit as u8, self.part),
        };
        LssRequest::FastScan { value: self.found[usize::from(self.part)], unchecked, part: self.part, next }
    }

    /// Interprets the answer, or its absence.
    fn conclude(&mut self) {
        let answered = std::mem::take(&mut self.has_answer);
        self.asking = Asking::Pending;
        match self.bit {
            WHOLE if answered => self.bit = 31,
            WHOLE => self.end = Some(Err(LssError::Nobody)),
            -1 if !answered => self.end = Some(Err(LssError::Unsteady { part: self.part + 1 })),
            -1 if self.part == 3 => self.end = Some(Ok(())),
            -1 => (self.part, self.bit) = (self.part + 1, 31),
            bit => {
                if !answered {
                    self.found[usize::from(self.part)] |= 1 << bit;
                }
                self.bit -= 1;
            }
        }
    }
}

impl Machine for FastScan {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        match self.asking {
            Asking::Waits { until_ns } | Asking::Settles { until_ns } if now_ns >= until_ns => {
                self.conclude();
            }
            _ => {}
        }
        if self.is_done() || self.asking != Asking::Pending {
            return None;
        }
        self.asking = Asking::Sent;
        Some(frame(self.question()))
    }

    fn sent(&mut self, now_ns: u64) {
        if self.asking == Asking::Sent {
            self.asking = Asking::Waits { until_ns: now_ns + self.timeout_ns };
        }
    }

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        if id == REQUEST && (self.asking != Asking::Pending || self.bit != WHOLE) {
            self.end.get_or_insert(Err(LssError::OtherMaster));
        }
        let is_answer = id == RESPONSE && LssResponse::decode(data) == Some(LssResponse::Identified);
        if is_answer && matches!(self.asking, Asking::Waits { .. }) {
            self.has_answer = true;
            self.asking = Asking::Settles { until_ns: now_ns + SETTLE_NS };
        }
    }

    fn gap(&mut self, _now_ns: u64) {
        // A lost answer gives a wrong bit, which the confirmation of the part detects.
    }

    fn due_ns(&self) -> Option<u64> {
        match self.asking {
            Asking::Waits { until_ns } | Asking::Settles { until_ns } => Some(until_ns),
            Asking::Pending | Asking::Sent => None,
        }
    }

    fn is_done(&self) -> bool {
        self.end.is_some()
    }
}

/// A command to nodes in configuration mode, or to get there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LssOrder {
    /// All nodes: enter configuration mode (true), or work as usual.
    SwitchAll(bool),
    /// The node with this address: enter configuration mode.
    Switch(LssAddress),
    /// Use this number, 1 to 127; 255 for none.
    SetNode(u8),
    /// Use this bit rate, by its index in CiA's table.
    SetBitRate(u8),
    /// Keep both across a restart.
    Store,
}

/// The index of a bit rate in CiA's table (CiA 305).
pub const fn bit_rate_index(bitrate_bps: u32) -> Option<u8> {
    Some(match bitrate_bps {
        1_000_000 => 0,
        800_000 => 1,
        500_000 => 2,
        250_000 => 3,
        125_000 => 4,
        50_000 => 6,
        20_000 => 7,
        10_000 => 8,
        _ => return None,
    })
}

/// Gives a single command.
#[derive(Debug)]
pub struct LssMaster {
    timeout_ns: u64,
    out: VecDeque<LssRequest>,
    under_way: usize,
    /// The last request, if it has an answer.
    asked: Option<LssRequest>,
    until_ns: Option<u64>,
    end: Option<Result<(), LssError>>,
}

impl LssMaster {
    /// Waits this long for the answer, if the command has one.
    pub fn new(order: LssOrder, timeout_ns: u64) -> Self {
        let out = match order {
            LssOrder::SwitchAll(waits) => vec![LssRequest::SwitchGlobal(waits.into())],
            LssOrder::Switch(LssAddress { vendor, product, revision, serial }) => {
                let values = [vendor, product, revision, serial];
                let parts = Part::ALL.into_iter().zip(values);
                parts.map(|(part, value)| LssRequest::SwitchSelective(part, value)).collect()
            }
            LssOrder::SetNode(node) => vec![LssRequest::ConfigureNode(node)],
            LssOrder::SetBitRate(index) => vec![LssRequest::ConfigureBitTiming { table: 0, index }],
            LssOrder::Store => vec![LssRequest::Store],
        };
        let asked = out.last().copied().filter(|_| !matches!(order, LssOrder::SwitchAll(_)));
        Self { timeout_ns, out: out.into(), under_way: 0, asked, until_ns: None, end: None }
    }

    /// The result. Call it when it is done.
    pub fn finish(self) -> Result<(), LssError> {
        self.end.unwrap_or(Ok(()))
    }
}

impl Machine for LssMaster {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        if let (Some(until_ns), Some(asked)) = (self.until_ns, self.asked)
            && now_ns >= until_ns
        {
            // What the answer would have begun with: that of the selection is 44.
            let command = match asked {
                LssRequest::SwitchSelective(..) => LssResponse::Selected.encode()[0],
                asked => asked.encode()[0],
            };
            self.end
                .get_or_insert(Err(LssError::NoAnswer { command, after_ms: self.timeout_ns / 1_000_000 }));
        }
        if self.is_done() {
            return None;
        }
        let request = self.out.pop_front()?;
        self.under_way += 1;
        Some(frame(request))
    }

    fn sent(&mut self, now_ns: u64) {
        self.under_way = self.under_way.saturating_sub(1);
        if self.under_way == 0 && self.out.is_empty() {
            match self.asked {
                Some(_) => self.until_ns = Some(now_ns + self.timeout_ns),
                None => self.end = Some(Ok(())),
            }
        }
    }

    fn hear(&mut self, _now_ns: u64, id: Id, data: &[u8]) {
        if id == REQUEST && (self.under_way > 0 || self.until_ns.is_some()) {
            self.end.get_or_insert(Err(LssError::OtherMaster));
        }
        let response = LssResponse::decode(data).filter(|_| id == RESPONSE);
        let Some((response, asked)) = response.zip(self.asked) else { return };
        if !response.answers(&asked) {
            return;
        }
        self.end.get_or_insert(match response {
            LssResponse::Outcome { service, error, .. } if error != 0 => {
                Err(LssError::Refused { command: service.command(), error })
            }
            _ => Ok(()),
        });
    }

    fn gap(&mut self, _now_ns: u64) {}

    fn due_ns(&self) -> Option<u64> {
        self.until_ns
    }

    fn is_done(&self) -> bool {
        self.end.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::active::testing::{Fate, Say, arrives, disturbed, run};

    const MS: u64 = 1_000_000;

    /// Slaves according to CiA 305: each keeps its position in the scan, or has dropped out.
    fn slaves(addresses: &[[u32; 4]]) -> impl FnMut(Id, &[u8], &mut Say) {
        let mut slaves: Vec<([u32; 4], u8)> = addresses.iter().map(|address| (*address, 0)).collect();
        move |id, data, say| {
            assert_eq!(id, REQUEST);
            let &[0x51, a, b, c, d, bit, part, next] = data else { return };
            let asked = u32::from_le_bytes([a, b, c, d]);
            for (after, (address, at)) in (1..).zip(&mut slaves) {
                let is_it = if bit == 0x80 {
                    *at = 0;
                    true
                } else {
                    part == *at && (address[usize::from(part)] ^ asked) >> bit == 0
                };
                if is_it {
                    *at = if bit == 0 && next != part { next } else { *at };
                    let answer = LssResponse::Identified.encode();
                    say.push((after * MS, Frame::from_bus(RESPONSE, false, 8, answer)));
                }
            }
        }
    }

    fn scan(addresses: &[[u32; 4]]) -> Result<LssAddress, LssError> {
        let mut scan = FastScan::new(50 * MS);
        let (_, sent) = run(&mut scan, &mut slaves(addresses), arrives);
        assert!(sent.len() <= 133, "{}", sent.len());
        scan.finish()
    }

    #[test]
    fn a_node_is_found_by_halving() {
        let address =
            |[vendor, product, revision, serial]: [u32; 4]| LssAddress { vendor, product, revision, serial };
        let one = [0x1234_5678, 0, 0xFFFF_FFFF, 0x8000_0001];
        assert_eq!(scan(&[one]), Ok(address(one)));
        assert_eq!(scan(&[[0; 4]]), Ok(address([0; 4])));
        // Of several, the one with the lowest address.
        let two = [0x1234_5678, 0, 0xFFFF_FFFF, 0x8000_0000];
        assert_eq!(scan(&[one, two]), Ok(address(two)));
        assert_eq!(scan(&[]), Err(LssError::Nobody));
    }

    /// A lost answer must not result in a different address.
    #[test]
    fn what_is_disturbed_is_not_found_wrong() {
        let mut random = fastrand::Rng::with_seed(305);
        let mut failed = 0;
        for _ in 0..200 {
            let address = [random.u32(..), random.u32(..), random.u32(..), random.u32(..)];
            let mut scan = FastScan::new(50 * MS);
            let mut disturb = disturbed(&mut random, 40);
            // Doubled and late answers arrive within the time in which others may send the same.
            let fate = || match disturb() {
                Fate::Lost => Fate::Lost,
                _ => Fate::Arrives,
            };
            run(&mut scan, &mut slaves(&[address]), fate);
            match scan.finish() {
                Ok(found) => {
                    assert_eq!([found.vendor, found.product, found.revision, found.serial], address);
                }
                Err(_) => failed += 1,
            }
        }
        assert!((20..190).contains(&failed), "{failed}");
    }

    #[test]
    fn another_master_ends_it() {
        let theirs = [0x04, 1, 0, 0, 0, 0, 0, 0];
        let mut scan = FastScan::new(50 * MS);
        scan.hear(0, REQUEST, &theirs);
        assert!(scan.next(1).is_some() && !scan.is_done());
        scan.sent(2);
        scan.hear(3, REQUEST, &theirs);
        assert_eq!((scan.next(4), scan.finish()), (None, Err(LssError::OtherMaster)));
        let mut master = LssMaster::new(LssOrder::SetNode(5), 50 * MS);
        assert!(master.next(1).is_some());
        master.sent(2);
        master.hear(3, REQUEST, &theirs);
        assert_eq!(master.finish(), Err(LssError::OtherMaster));
    }

    #[test]
    fn orders_are_answered_refused_or_not_answered() {
        let order = |order: LssOrder, answer: Option<[u8; 8]>| {
            let mut master = LssMaster::new(order, 100 * MS);
            let mut sent_last = 0;
            let mut peer = |_: Id, data: &[u8], say: &mut Say| {
                sent_last = data[0];
                if let Some(answer) = answer.filter(|_| matches!(data[0], 0x11 | 0x13 | 0x17 | 0x43)) {
                    say.push((MS, Frame::from_bus(RESPONSE, false, 8, answer)));
                }
            };
            let (_, sent) = run(&mut master, &mut peer, arrives);
            (master.finish(), sent.iter().map(ToString::to_string).collect::<Vec<_>>())
        };
        let (ended, sent) = order(LssOrder::SetNode(5), Some([0x11, 0, 0, 0, 0, 0, 0, 0]));
        assert_eq!((ended, &sent[..]), (Ok(()), &["7E5#1105000000000000".to_owned()][..]));
        let (ended, _) = order(LssOrder::SetBitRate(2), Some([0x13, 1, 0, 0, 0, 0, 0, 0]));
        assert_eq!(
            ended.unwrap_err().to_string(),
            "the node refused the command 13: it has no such bit rate"
        );
        let (ended, _) = order(LssOrder::Store, None);
        assert_eq!(ended, Err(LssError::NoAnswer { command: 0x17, after_ms: 100 }));
        let (ended, sent) = order(LssOrder::SwitchAll(false), None);
        assert_eq!((ended, &sent[..]), (Ok(()), &["7E5#0400000000000000".to_owned()][..]));
        let address = LssAddress { vendor: 1, product: 2, revision: 3, serial: 4 };
        let (ended, sent) = order(LssOrder::Switch(address), Some([0x44, 0, 0, 0, 0, 0, 0, 0]));
        assert_eq!((ended, sent.len()), (Ok(()), 4));
    }
}
