//! Our own heartbeat (CiA 301) beside another client: a node that consumes it notices when this computer, or the cable to it, is gone.

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

use super::{Machine, earlier};

/// The state of network management that the heartbeat reports.
const OPERATIONAL: u8 = 5;

/// When a heartbeat is due. It outlives the clients beside which it is sent.
#[derive(Clone, Debug)]
pub struct HeartbeatProducer {
    frame: Frame,
    period_ns: u64,
    /// The first is due at once.
    next_ns: u64,
}

impl HeartbeatProducer {
    /// Of the node with this number, 1 to 127, every so many nanoseconds; `None` for another number.
    pub fn new(node: u8, period_ns: u64) -> Option<Self> {
        let id = (1..=127).contains(&node).then(|| Id::standard(0x700 + u32::from(node)))??;
        Some(Self { frame: Frame::data_frame(id, &[OPERATIONAL])?, period_ns, next_ns: 0 })
    }
}

/// A client with a heartbeat beside it, for as long as the client runs.
pub struct WithHeartbeat<'a> {
    client: &'a mut dyn Machine,
    producer: &'a mut HeartbeatProducer,
    /// Whether each of the frames in flight is a heartbeat.
    in_flight: VecDeque<bool>,
}

impl<'a> WithHeartbeat<'a> {
    /// Runs the client.
    pub fn new(client: &'a mut dyn Machine, producer: &'a mut HeartbeatProducer) -> Self {
        Self { client, producer, in_flight: VecDeque::new() }
    }
}

impl Machine for WithHeartbeat<'_> {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        // The client first: how it takes the time is its own affair.
        let frame = self.client.next(now_ns);
        let is_due = frame.is_none() && !self.client.is_done() && now_ns >= self.producer.next_ns;
        if is_due {
            self.producer.next_ns = now_ns.saturating_add(self.producer.period_ns);
        }
        let frame = frame.or(is_due.then_some(self.producer.frame));
        self.in_flight.extend(frame.map(|_| is_due));
        frame
    }

    fn sent(&mut self, now_ns: u64) {
        if self.in_flight.pop_front() == Some(false) {
            self.client.sent(now_ns);
        }
    }

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        self.client.hear(now_ns, id, data);
    }

    fn gap(&mut self, now_ns: u64) {
        self.client.gap(now_ns);
    }

    fn due_ns(&self) -> Option<u64> {
        earlier(self.client.due_ns(), Some(self.producer.next_ns))
    }

    fn is_done(&self) -> bool {
        self.client.is_done()
    }

    fn cancel(&mut self) -> Option<Frame> {
        self.client.cancel()
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{FRAME_NS, Say, arrives, run};
    use super::*;
    use crate::active::sdo::{SdoClient, SdoError, SdoIds, SdoJob};

    const MS: u64 = 1_000_000;

    /// The frames that are sent while an object is read from a node that never answers.
    #[test]
    fn heartbeats_go_on_beside_a_client_and_do_not_make_it_wait_longer() {
        let mut client = SdoClient::new(SdoIds::of(5), 0x6041, 0, SdoJob::Read, false, 1000 * MS);
        let mut producer = HeartbeatProducer::new(127, 100 * MS).unwrap();
        let mut both = WithHeartbeat::new(&mut client, &mut producer);
        let mut silent = |_: Id, _: &[u8], _: &mut Say| {};
        let (took_ns, sent) = run(&mut both, &mut silent, arrives);
        let beats = sent.iter().filter(|frame| frame.id().raw() == 0x77F);
        assert!((10..=11).contains(&beats.clone().count()), "{sent:?}");
        assert!(beats.clone().all(|frame| frame.data() == [5]));
        assert!((1000 * MS..1000 * MS + 20 * FRAME_NS).contains(&took_ns), "{took_ns}");
        assert!(matches!(client.finish(), Err(SdoError::NoAnswer { .. })));
    }

    #[test]
    fn there_are_127_nodes() {
        assert!(HeartbeatProducer::new(0, MS).is_none() && HeartbeatProducer::new(128, MS).is_none());
    }
}
