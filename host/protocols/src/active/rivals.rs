//! Other testers that ask the same servers while a request of ours is under way: an answer may then be to theirs.

use cantap_trace::Id;

use super::answer::is_answer;
use crate::iso_tp::{Endpoint, Pci, parse};

/// Most requests of others that are kept for comparison with the answers.
const MOST_KEPT: usize = 32;

/// What other testers have asked.
#[derive(Debug, Default)]
pub(super) struct Rivals {
    /// Requests, or their beginnings.
    asked: Vec<Vec<u8>>,
    count: u32,
    doubtful: u32,
}

impl Rivals {
    /// Takes a frame that was heard; true if it is another tester's request to those whom `to` asks.
    pub fn hear(&mut self, to: Endpoint, id: Id, data: &[u8]) -> bool {
        if !reaches_same(to, id, data) {
            return false;
        }
        let address = usize::from(id == to.id && to.address.is_some());
        if let Ok(Some(Pci::Single(request) | Pci::First { data: request, .. })) = parse(data, address) {
            self.count += 1;
            if self.asked.len() < MOST_KEPT {
                self.asked.push(request.to_vec());
            }
        }
        true
    }

    /// Compares an answer that was taken for ours.
    pub fn judge(&mut self, ours: &[u8], answer: &[u8]) {
        let could_be = |theirs: &Vec<u8>| is_answer(theirs, answer) && !(theirs == ours && only_reads(ours));
        // What was not kept could have been anything.
        let is_doubtful = self.asked.iter().any(could_be) || self.count as usize > self.asked.len();
        self.doubtful += u32::from(is_doubtful);
    }

    /// Requests of others so far.
    pub const fn count(&self) -> u32 {
        self.count
    }

    /// Answers that may be to a request of others.
    pub const fn doubtful(&self) -> u32 {
        self.doubtful
    }
}

/// Whether a request has the same answer whoever sends it.
fn only_reads(request: &[u8]) -> bool {
    matches!(request.first(), Some(0x01..=0x03 | 0x06 | 0x07 | 0x09 | 0x0A | 0x19 | 0x22 | 0x3E))
}

/// Whether a frame with this identifier asks a server that `to` also asks: the same one, or all of them (ISO 15765-4).
fn reaches_same(to: Endpoint, id: Id, data: &[u8]) -> bool {
    if id == to.id {
        return to.address.is_none_or(|address| data.first() == Some(&address));
    }
    if to.address.is_some() || id.is_extended() != to.id.is_extended() {
        return false;
    }
    let is_one = |raw: u32| (0x7E0..=0x7E7).contains(&raw);
    let is_one_29 = |raw: u32| raw >> 16 == 0x18DA;
    match (to.id.raw(), id.raw()) {
        (0x7DF, other) | (other, 0x7DF) if !id.is_extended() => is_one(other),
        (0x18DB_33F1, other) if id.is_extended() => is_one_29(other) && other & 0xFF == 0xF1,
        (own, 0x18DB_33F1) if id.is_extended() => is_one_29(own),
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn endpoint(text: &str) -> Endpoint {
        let other = if text.contains('/') { "612/F1" } else { "7FF" };
        format!("{text}:{other}").parse::<crate::iso_tp::Pair>().map(|pair| pair.a).unwrap()
    }

    #[test]
    fn requests_to_the_same_servers_are_told_from_all_other_frames() {
        let hears = |to: &str, id: Id| Rivals::default().hear(endpoint(to), id, &[2, 0x3E, 0]);
        let (standard, extended) = (Id::standard_truncated, Id::extended_truncated);
        for (to, id) in [
            ("7E0", standard(0x7E0)),
            ("7E0", standard(0x7DF)),
            ("7DF", standard(0x7E3)),
            ("123", standard(0x123)),
            ("18DA10F1", extended(0x18DA_10F1)),
            ("18DA10F1", extended(0x18DB_33F1)),
            ("18DB33F1", extended(0x18DA_10F1)),
        ] {
            assert!(hears(to, id), "{to} {id}");
        }
        for (to, id) in [
            ("7E0", standard(0x7E1)),
            ("7E0", standard(0x7E8)),
            ("7E0", extended(0x7E0)),
            ("123", standard(0x7DF)),
            ("18DA10F1", extended(0x18DA_11F1)),
            ("18DB33F1", extended(0x18DA_F110)),
        ] {
            assert!(!hears(to, id), "{to} {id}");
        }
        let mut rivals = Rivals::default();
        assert!(!rivals.hear(endpoint("6F1/12"), standard(0x6F1), &[0x13, 2, 0x3E, 0]));
        assert!(rivals.hear(endpoint("6F1/12"), standard(0x6F1), &[0x12, 2, 0x3E, 0]));
        assert_eq!((rivals.count(), &rivals.asked), (1, &vec![vec![0x3E, 0]]));
    }

    #[test]
    fn an_answer_is_doubtful_if_it_could_be_to_the_other_request() {
        let doubtful = |theirs: &[u8], ours: &[u8], answer: &[u8]| {
            let mut rivals = Rivals::default();
            let frame = [&[theirs.len() as u8], theirs].concat();
            rivals.hear(endpoint("7E0"), Id::standard_truncated(0x7E0), &frame);
            rivals.judge(ours, answer);
            rivals.doubtful() > 0
        };
        // Another service, or another identifier, is told from ours by the answer.
        assert!(!doubtful(&[0x3E, 0], &[0x22, 0xF1, 0x90], &[0x7F, 0x22, 0x31]));
        assert!(!doubtful(&[0x22, 1, 2], &[0x22, 0xF1, 0x90], &[0x62, 0xF1, 0x90, 1]));
        // A refusal does not say what it refuses.
        assert!(doubtful(&[0x22, 1, 2], &[0x22, 0xF1, 0x90], &[0x7F, 0x22, 0x31]));
        // The same question has the same answer, unless it changes something, or the answer is for one only.
        assert!(!doubtful(&[0x22, 0xF1, 0x90], &[0x22, 0xF1, 0x90], &[0x62, 0xF1, 0x90, 1]));
        assert!(doubtful(&[0x27, 1], &[0x27, 1], &[0x67, 1, 1, 2]));
        assert!(doubtful(&[4], &[4], &[0x44]));
    }
}
