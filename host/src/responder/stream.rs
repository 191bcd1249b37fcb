//! What a device sends: answers, batches of records, and the end of a session.

use cantap_wire::batch::BatchWriter;
use cantap_wire::framing::{CRC_LEN, MAX_ENCODED, MAX_MESSAGE, seal};
use cantap_wire::message::{EndReason, write_response};
use cantap_wire::record::{
    MAX_FD_RECORD, MAX_RECORD, Record, encode_event, encode_received, encode_received_fd,
    encode_transmitted_fd,
};
use cantap_wire::{Event, Refusal, Reply, Stamp};

/// An answer as it goes over the wire, with its zero byte.
pub fn encode_response(id: u16, result: &Result<Reply, Refusal>) -> Vec<u8> {
    let mut message = vec![0; MAX_MESSAGE + CRC_LEN];
    let mut out = vec![0; MAX_ENCODED];
    // This cannot fail: the longest answer is shorter than the longest message.
    let len = write_response(id, result, &mut message[..MAX_MESSAGE])
        .and_then(|len| seal(&mut message, len, &mut out))
        .unwrap_or(0);
    out.truncate(len);
    out
}

/// Encodes a device's stream, in the order in which it is sent. The bytes collect until they are taken out with [`Self::clear_bytes`].
pub struct StreamEncoder {
    batch: Box<BatchWriter>,
    /// Time of the last record with a stamp, or of the session's beginning.
    last_ticks: u64,
    out: Vec<u8>,
}

impl StreamEncoder {
    /// An encoder that waits for a session.
    pub fn new() -> Self {
        Self { batch: Box::new(BatchWriter::new()), last_ticks: 0, out: Vec::new() }
    }

    /// Begins a session at this device time: the answer to `Hello`, as from [`encode_response`], then batches from number 0. Records of an
    /// earlier session that are not in a finished batch are dropped.
    pub fn begin(&mut self, answer: &[u8], ticks: u64) {
        self.batch.restart();
        self.last_ticks = ticks;
        self.answer(answer);
    }

    /// Adds an answer, as from [`encode_response`], in front of records that are not in a finished batch: call [`Self::finish`] first if it
    /// must not overtake them.
    pub fn answer(&mut self, answer: &[u8]) {
        // An earlier message may have been read only in part.
        self.out.push(0);
        self.out.extend_from_slice(answer);
    }

    /// Device time of the last record with a stamp, or of the session's beginning, in ticks.
    pub const fn last_ticks(&self) -> u64 {
        self.last_ticks
    }

    /// Adds an event at this device time, in ticks.
    pub fn event(&mut self, ticks: u64, event: Event) {
        self.record(ticks, &Record::Event(event));
    }

    /// Adds a record at this device time, in ticks. It is sent when the batch is full or [`Self::finish`] is called; a device does that a
    /// millisecond after a batch's first record.
    pub fn record(&mut self, ticks: u64, record: &Record) {
        let difference = ticks.wrapping_sub(self.last_ticks) as i64;
        let (mut short, mut long) = ([0; MAX_RECORD], [0; MAX_FD_RECORD]);
        let (bytes, is_stamped) = match record {
            Record::Received(received) => {
                let len = encode_received(received, difference, &mut short);
                (&short[..len], received.stamp != Stamp::Omitted)
            }
            Record::ReceivedFd(received) => {
                let len = encode_received_fd(received, difference, &mut long);
                (&long[..len], received.stamp != Stamp::Omitted)
            }
            Record::TransmittedFd(sent) => {
                let len = encode_transmitted_fd(sent, difference, &mut long);
                (&long[..len], true)
            }
            Record::Event(event) => {
                let len = encode_event(event, difference, &mut short);
                (&short[..len], true)
            }
        };
        let frame_of = record.received_on();
        if !self.batch.push(bytes, self.last_ticks, frame_of) {
            self.finish();
            // This cannot fail: any record fits in an empty batch.
            let _ = self.batch.push(bytes, self.last_ticks, frame_of);
        }
        if is_stamped {
            self.last_ticks = ticks;
        }
    }

    /// Finishes the current batch.
    pub fn finish(&mut self) {
        self.put(BatchWriter::finish);
    }

    /// Ends the session at this device time, in ticks: nothing was captured after it.
    pub fn end(&mut self, reason: EndReason, ticks: u64) {
        self.finish();
        let at = ticks.max(self.last_ticks);
        self.put(|batch, out| batch.end(reason, at, out));
    }

    fn put(&mut self, write: impl FnOnce(&mut BatchWriter, &mut [u8]) -> usize) {
        let at = self.out.len();
        self.out.resize(at + MAX_ENCODED, 0);
        let len = write(&mut self.batch, &mut self.out[at..]);
        self.out.truncate(at + len);
    }

    /// What is to be sent.
    pub fn bytes(&self) -> &[u8] {
        &self.out
    }

    /// Empties what is to be sent.
    pub fn clear_bytes(&mut self) {
        self.out.clear();
    }
}

impl Default for StreamEncoder {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_wire::record::{LossStage, Received};
    use cantap_wire::{Channel, Command, Decoded, Decoder, Frame, Request};

    use crate::device::encode;
    use crate::responder::{Inbox, Incoming};

    /// A host's requests reach the device's side, and its stream reaches the host's decoder, whole and in order.
    #[test]
    fn a_session_passes_between_both_sides() {
        let mut inbox = Inbox::default();
        let mut stream = StreamEncoder::new();
        let mut requests = Vec::new();
        for (id, command) in [(7, Command::Time), (8, Command::Status)] {
            inbox.push(&encode(&Request { id, command }).unwrap(), |incoming| match incoming {
                Incoming::Request(request) => requests.push(request.id),
                other => panic!("{other:?}"),
            });
        }
        assert_eq!(requests, [7, 8]);
        stream.record(5, &Record::Event(Event::Stopped { channel: Channel::Can1 }));
        stream.begin(&encode_response(7, &Err(Refusal::Unsupported)), 1000);
        let channel = Channel::Can2;
        let frame: Frame = "123#1122334455667788".parse().unwrap();
        let received = Received { channel, frame, stamp: Stamp::Exact, data_omitted: false };
        // Several batches.
        let times: Vec<u64> = (0..500).map(|number| 1000 + 70 * number).collect();
        for ticks in &times {
            stream.record(*ticks, &Record::Received(received));
        }
        let lost = Event::Lost { channel, stage: LossStage::Host, count: 3, at_least: false };
        stream.event(40_000, lost);
        stream.finish();
        stream.answer(&encode_response(8, &Ok(Reply::Time(9))));
        stream.end(EndReason::Suspended, 1);
        let (mut seen, mut answers, mut ended) = (Vec::new(), Vec::new(), None);
        Decoder::new().push(stream.bytes(), |decoded| match decoded {
            Decoded::Record { ticks, record: Record::Received(_) } => seen.push(ticks),
            Decoded::Record { ticks, record } => assert_eq!((ticks, record), (40_000, Record::Event(lost))),
            Decoded::Response(response) => answers.push((response.id, response.result.is_ok())),
            Decoded::Ended { ticks, reason } => ended = Some((ticks, reason)),
            other => panic!("{other:?}"),
        });
        assert_eq!(seen, times);
        assert_eq!(answers, [(7, false), (8, true)]);
        assert_eq!(ended, Some((40_000, EndReason::Suspended)));
        stream.clear_bytes();
        stream.finish();
        assert!(stream.bytes().is_empty());
    }
}
