//! A DeviceNet slave's explicit messages, in one or many frames: requests in, responses out.

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

use super::push_bounded;
use crate::active::Machine;
use crate::devicenet::codec::{ExplicitHeader, Fragment, SlaveMessage};

/// How long the other side may take to acknowledge a fragment, which is then sent once more (volume III of the CIP networks library, 4-4.3).
const ACKNOWLEDGE_NS: u64 = 1_000_000_000;
/// The longest request that is accepted, in bytes.
const MOST_BYTES: usize = 4096;
/// Bytes in a frame after the header, and after the byte of a fragment.
const WHOLE: usize = 7;
const PART: usize = 6;
/// The status of an acknowledgement: taken, and too much.
const TAKEN: u8 = 0;
const TOO_MUCH: u8 = 1;

/// A request to a slave.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExplicitRequest {
    /// The MAC ID of who asks.
    pub from: u8,
    /// Whether it came without a connection.
    pub unconnected: bool,
    /// The service and what follows it.
    pub data: Vec<u8>,
    transaction: bool,
}

#[derive(Debug)]
struct Sending {
    header: ExplicitHeader,
    data: Vec<u8>,
    at: usize,
    number: u8,
    /// Whether the fragment was sent, when its acknowledgement is missing, and how often it was.
    is_sent: bool,
    until_ns: Option<u64>,
    tries: u8,
}

/// Receives requests and sends responses, one at a time.
#[derive(Debug)]
pub struct DeviceNetServer {
    mac: u8,
    /// The request in progress: its sender's header, its bytes, the next number.
    receiving: Option<(ExplicitHeader, Vec<u8>, u8)>,
    requests: VecDeque<ExplicitRequest>,
    responses: VecDeque<(ExplicitHeader, Vec<u8>)>,
    acknowledgements: VecDeque<Frame>,
    sending: Option<Sending>,
    under_way: VecDeque<bool>,
}

impl DeviceNetServer {
    /// The slave with this MAC ID, 0 to 63.
    pub const fn new(mac: u8) -> Self {
        Self {
            mac,
            receiving: None,
            requests: VecDeque::new(),
            responses: VecDeque::new(),
            acknowledgements: VecDeque::new(),
            sending: None,
            under_way: VecDeque::new(),
        }
    }

    /// The next request that nobody has taken.
    pub fn take_request(&mut self) -> Option<ExplicitRequest> {
        self.requests.pop_front()
    }

    /// Sends a response: the service and what follows it. Nothing is sent for an empty one.
    pub fn answer(&mut self, to: &ExplicitRequest, data: Vec<u8>) {
        if !data.is_empty() {
            let header =
                ExplicitHeader { fragmented: data.len() > WHOLE, transaction: to.transaction, mac: to.from };
            push_bounded(&mut self.responses, (header, data));
        }
    }

    fn frame(&self, bytes: &[u8]) -> Frame {
        let mut data = [0; 8];
        data[..bytes.len()].copy_from_slice(bytes);
        let id = SlaveMessage::ExplicitResponse.id(self.mac);
        Frame::from_bus(id, false, bytes.len() as u8, data)
    }

    fn acknowledge(&mut self, header: ExplicitHeader, number: u8, status: u8) {
        let frame = self.frame(&[header.encode(), Fragment::Acknowledge(number).encode(), status]);
        push_bounded(&mut self.acknowledgements, frame);
    }

    fn request(&mut self, header: ExplicitHeader, unconnected: bool, data: Vec<u8>) {
        let ExplicitHeader { mac: from, transaction, .. } = header;
        push_bounded(&mut self.requests, ExplicitRequest { from, unconnected, data, transaction });
    }

    fn part(&mut self, header: ExplicitHeader, fragment: Fragment, unconnected: bool, data: &[u8]) {
        let (Fragment::Middle(number) | Fragment::Last(number)) = fragment else {
            self.receiving = Some((header, data.to_vec(), 1));
            return self.acknowledge(header, 0, TAKEN);
        };
        let Some((of, body, next)) = &mut self.receiving else { return };
        if of.mac != header.mac || of.transaction != header.transaction {
            return;
        }
        // It is sent again if its acknowledgement did not come.
        if number == next.wrapping_sub(1) & 0x3F {
            return self.acknowledge(header, number, TAKEN);
        }
        if number != *next {
            self.receiving = None;
            return;
        }
        body.extend_from_slice(data);
        *next = (number + 1) & 0x3F;
        if body.len() > MOST_BYTES {
            self.receiving = None;
            return self.acknowledge(header, number, TOO_MUCH);
        }
        self.acknowledge(header, number, TAKEN);
        if let Fragment::Last(_) = fragment
            && let Some((_, body, _)) = self.receiving.take()
        {
            self.request(header, unconnected, body);
        }
    }

    /// The other side has a fragment, or does not want it.
    fn acknowledged(&mut self, header: ExplicitHeader, number: u8, status: u8) {
        let Some(sending) = &mut self.sending else { return };
        if sending.header.mac != header.mac || sending.number != number || !sending.is_sent {
            return;
        }
        let end = sending.at + PART;
        if status != TAKEN || end >= sending.data.len() {
            self.sending = None;
            return;
        }
        (sending.at, sending.number, sending.is_sent) = (end, (number + 1) & 0x3F, false);
        (sending.until_ns, sending.tries) = (None, 0);
    }

    /// The next frame of the response in progress.
    fn next_part(&mut self, now_ns: u64) -> Option<Frame> {
        let sending = self.sending.as_mut()?;
        if sending.until_ns.is_some_and(|until_ns| now_ns >= until_ns) {
            (sending.is_sent, sending.until_ns) = (false, None);
            if sending.tries > 1 {
                self.sending = None;
                return None;
            }
        }
        if sending.is_sent {
            return None;
        }
        (sending.is_sent, sending.tries) = (true, sending.tries + 1);
        let end = sending.data.len().min(sending.at + PART);
        let fragment = match (sending.at, end == sending.data.len()) {
            (0, _) => Fragment::First,
            (_, false) => Fragment::Middle(sending.number),
            (_, true) => Fragment::Last(sending.number),
        };
        let bytes = [&[sending.header.encode(), fragment.encode()], &sending.data[sending.at..end]].concat();
        Some(self.frame(&bytes))
    }
}

impl Machine for DeviceNetServer {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        if let Some(frame) = self.acknowledgements.pop_front() {
            self.under_way.push_back(false);
            return Some(frame);
        }
        if let Some(frame) = self.next_part(now_ns) {
            self.under_way.push_back(true);
            return Some(frame);
        }
        if self.sending.is_some() {
            return None;
        }
        let (header, data) = self.responses.pop_front()?;
        if header.fragmented {
            let (at, number, is_sent, until_ns, tries) = (0, 0, false, None, 0);
            self.sending = Some(Sending { header, data, at, number, is_sent, until_ns, tries });
            return self.next(now_ns);
        }
        self.under_way.push_back(false);
        Some(self.frame(&[&[header.encode()], &data[..]].concat()))
    }

    fn sent(&mut self, now_ns: u64) {
        if self.under_way.pop_front() == Some(true)
            && let Some(sending) = self.sending.as_mut().filter(|sending| sending.is_sent)
        {
            sending.until_ns = Some(now_ns + ACKNOWLEDGE_NS);
        }
    }

    fn hear(&mut self, _now_ns: u64, id: Id, data: &[u8]) {
        let unconnected = id == SlaveMessage::UnconnectedRequest.id(self.mac);
        if !unconnected && id != SlaveMessage::ExplicitRequest.id(self.mac) {
            return;
        }
        let &[header, second, ref rest @ ..] = data else { return };
        let header = ExplicitHeader::decode(header);
        match (header.fragmented, Fragment::decode(second)) {
            (false, _) => self.request(header, unconnected, data[1..].to_vec()),
            (true, Fragment::Acknowledge(number)) => {
                self.acknowledged(header, number, rest.first().copied().unwrap_or(TAKEN));
            }
            (true, fragment) => self.part(header, fragment, unconnected, rest),
        }
    }

    fn gap(&mut self, _now_ns: u64) {
        // A missing fragment is noticed by its number, and sent again.
    }

    fn due_ns(&self) -> Option<u64> {
        self.sending.as_ref()?.until_ns
    }

    fn is_done(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drain(server: &mut DeviceNetServer, now_ns: u64) -> Vec<String> {
        let mut sent = Vec::new();
        while let Some(frame) = server.next(now_ns) {
            sent.push(frame.to_string());
            server.sent(now_ns);
        }
        sent
    }

    fn hear(server: &mut DeviceNetServer, message: SlaveMessage, data: &[u8]) {
        server.hear(0, message.id(5), data);
    }

    #[test]
    fn a_response_of_many_frames_goes_on_with_each_acknowledgement_and_ends_without() {
        let mut server = DeviceNetServer::new(5);
        hear(&mut server, SlaveMessage::UnconnectedRequest, &[0x41, 0x4B, 3, 1, 1, 1]);
        let request = server.take_request().unwrap();
        assert_eq!(
            (request.from, request.unconnected, &request.data[..]),
            (1, true, &[0x4B, 3, 1, 1, 1][..])
        );
        server.answer(&request, vec![0xCB, 0]);
        assert_eq!(drain(&mut server, 0), ["42B#41CB00"]);
        server.answer(&request, (0..14).collect());
        assert_eq!(drain(&mut server, 0), ["42B#C100000102030405"]);
        hear(&mut server, SlaveMessage::ExplicitRequest, &[0xC1, 0xC0, 0]);
        assert_eq!(drain(&mut server, 0), ["42B#C141060708090A0B"]);
        hear(&mut server, SlaveMessage::ExplicitRequest, &[0xC1, 0xC1, 0]);
        assert_eq!(drain(&mut server, 0), ["42B#C1820C0D"]);
        // The acknowledgement does not come: once more, then never.
        assert_eq!(drain(&mut server, ACKNOWLEDGE_NS), ["42B#C1820C0D"]);
        assert_eq!(drain(&mut server, 2 * ACKNOWLEDGE_NS), [""; 0]);
        assert_eq!(server.due_ns(), None);
    }

    #[test]
    fn a_request_of_many_frames_is_acknowledged_also_when_a_frame_comes_twice() {
        let mut server = DeviceNetServer::new(5);
        hear(&mut server, SlaveMessage::ExplicitRequest, &[0x81, 0x00, 0x10, 4, 1, 3, 1, 2]);
        hear(&mut server, SlaveMessage::ExplicitRequest, &[0x81, 0x41, 3, 4, 5, 6, 7, 8]);
        hear(&mut server, SlaveMessage::ExplicitRequest, &[0x81, 0x41, 3, 4, 5, 6, 7, 8]);
        hear(&mut server, SlaveMessage::ExplicitRequest, &[0x81, 0x82, 9]);
        assert_eq!(drain(&mut server, 0), ["42B#81C000", "42B#81C100", "42B#81C100", "42B#81C200"]);
        assert_eq!(server.take_request().unwrap().data, [0x10, 4, 1, 3, 1, 2, 3, 4, 5, 6, 7, 8, 9]);
        hear(&mut server, SlaveMessage::ExplicitRequest, &[0x81, 0x43, 9]);
        assert_eq!((server.take_request(), drain(&mut server, 0)), (None, vec![]));
    }
}
