//! How a connection of CCP shows: CONNECT answered with its counter, and the next command answered with the next one.

use cantap_trace::{Id, TraceRecord};

use super::codec::{COMMAND_RETURN, command, find};
use crate::calibration::connection::MasterSlave;
use crate::calibration::finding::{ConnectionFinder, Sign};

/// How long an answer may take, in nanoseconds.
const RESPONSE_NS: i64 = 1_000_000_000;
/// The most commands that are kept until it shows whether they are of CCP.
const MOST_KEPT: usize = 8;
/// The most candidates at a time.
const MOST_CANDIDATES: usize = 16;

/// Frames that look like a session that begins.
#[derive(Clone, Debug)]
struct Candidate {
    channel: u8,
    master: Id,
    slave: Option<Id>,
    /// The counter of the last command.
    counter: u8,
    is_answered: bool,
    /// Commands that were answered.
    answers: u32,
    records: Vec<TraceRecord>,
}

/// Finds out who is a master and who its slave.
#[derive(Clone, Debug, Default)]
pub struct SessionFinder {
    candidates: Vec<Candidate>,
}

impl ConnectionFinder for SessionFinder {
    fn look(&mut self, record: &TraceRecord, id: Id, data: &[u8]) -> Sign {
        // Both sides always send eight bytes.
        if data.len() != 8 || (self.candidates.is_empty() && data[0] != command::CONNECT) {
            return Sign::None;
        }
        let oldest_ns = record.time_ns.saturating_sub(RESPONSE_NS);
        self.candidates.retain(|one| one.records.last().is_some_and(|last| last.time_ns >= oldest_ns));
        let of_channel = |one: &Candidate| one.channel == record.channel;
        if data[0] == COMMAND_RETURN
            && let Some(place) = self.candidates.iter().position(|one| {
                of_channel(one)
                    && !one.is_answered
                    && one.counter == data[2]
                    && one.master != id
                    && one.slave.is_none_or(|slave| slave == id)
            })
        {
            let one = &mut self.candidates[place];
            // Only an agreement to CONNECT begins a session.
            if one.slave.is_none() && data[1] != 0 {
                self.candidates.remove(place);
                return Sign::None;
            }
            (one.slave, one.is_answered) = (Some(id), true);
            one.answers += 1;
            if one.answers >= 2 {
                let Candidate { master, records, .. } = self.candidates.remove(place);
                return Sign::Certain(MasterSlave { master, slave: id }, records);
            }
            one.records.push(*record);
            return Sign::Plausible;
        }
        if let Some(place) = self.candidates.iter().position(|one| of_channel(one) && one.master == id) {
            let one = &mut self.candidates[place];
            let is_next =
                one.is_answered && data[1] == one.counter.wrapping_add(1) && find(data[0]).is_some();
            if is_next && one.records.len() < MOST_KEPT {
                (one.counter, one.is_answered) = (data[1], false);
                one.records.push(*record);
                return Sign::Plausible;
            }
            // Whoever goes on otherwise is no master.
            self.candidates.remove(place);
        }
        if data[0] != command::CONNECT {
            return Sign::None;
        }
        if self.candidates.len() == MOST_CANDIDATES {
            self.candidates.remove(0);
        }
        self.candidates.push(Candidate {
            channel: record.channel,
            master: id,
            slave: None,
            counter: data[1],
            is_answered: false,
            answers: 0,
            records: vec![*record],
        });
        Sign::Plausible
    }
}
