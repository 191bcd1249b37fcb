//! A server of diagnostics: requests over ISO-TP in, responses out (ISO 15765-2, normal addressing).

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

use super::push_bounded;
use crate::active::transfer::{TransferError, TransferReceiver, TransferSender, TransferSettings};
use crate::active::{Machine, earlier};
use crate::iso_tp::{Endpoint, Pci, parse};

/// The negative response's service.
const NEGATIVE: u8 = 0x7F;
/// Reasons that nobody gives to a request that went to all (ISO 14229-1:2020, 8.7.2): service, sub-function or identifier not supported,
/// also in the active session.
const SILENT_TO_ALL: [u8; 5] = [0x11, 0x12, 0x31, 0x7E, 0x7F];

/// A request to a server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServerRequest {
    /// The service and what follows it.
    pub data: Vec<u8>,
    /// Whether it went to all servers, by the functional identifier.
    pub to_all: bool,
}

/// Receives requests and sends responses, one at a time.
#[derive(Debug)]
pub struct IsoTpServer {
    request: Id,
    functional: Option<Id>,
    response: Endpoint,
    settings: TransferSettings,
    receiver: TransferReceiver,
    requests: VecDeque<ServerRequest>,
    responses: VecDeque<Vec<u8>>,
    sender: Option<TransferSender>,
    /// Whose frame is on its way: the response's, or flow control.
    under_way: VecDeque<bool>,
    trouble: Option<TransferError>,
}

impl IsoTpServer {
    /// A server that is asked by `request`, or by `functional` together with others, and answers by `response`.
    pub fn new(request: Id, functional: Option<Id>, response: Id, settings: TransferSettings) -> Self {
        let response = Endpoint { id: response, address: None };
        Self {
            request,
            functional,
            response,
            settings,
            receiver: TransferReceiver::new(response, settings, false),
            requests: VecDeque::new(),
            responses: VecDeque::new(),
            sender: None,
            under_way: VecDeque::new(),
            trouble: None,
        }
    }

    /// The next request that nobody has taken.
    pub fn take_request(&mut self) -> Option<ServerRequest> {
        self.requests.pop_front()
    }

    /// Sends a response, after those before it. Nothing is sent for an empty one, nor for a refusal that a request to all does not get.
    pub fn answer(&mut self, to: &ServerRequest, data: Vec<u8>) {
        let is_silent =
            to.to_all && matches!(data[..], [NEGATIVE, _, reason] if SILENT_TO_ALL.contains(&reason));
        if !data.is_empty() && !is_silent {
            push_bounded(&mut self.responses, data);
        }
    }

    /// Why the last transfer ended early, if nobody has asked yet.
    pub fn take_trouble(&mut self) -> Option<TransferError> {
        self.trouble.take()
    }

    fn hear_pci(&mut self, now_ns: u64, pci: Pci<'_>) {
        let result = match pci {
            Pci::Flow { status, block_size, separation_us } => {
                let sender = self.sender.as_mut();
                sender.map_or(Ok(()), |sender| sender.flow(now_ns, status, block_size, separation_us))
            }
            pci => self.receiver.take(now_ns, pci).map(|message| {
                if let Some(data) = message {
                    push_bounded(&mut self.requests, ServerRequest { data, to_all: false });
                }
            }),
        };
        if let Err(error) = result {
            if matches!(pci, Pci::Flow { .. }) {
                self.give_up_response();
            }
            self.trouble = Some(error);
        }
    }

    /// Its frames that are still on their way are nobody's when they have been on the bus.
    fn give_up_response(&mut self) {
        self.sender = None;
        self.under_way.iter_mut().for_each(|of_response| *of_response = false);
    }
}

impl Machine for IsoTpServer {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        match self.receiver.next(now_ns) {
            Ok(Some(flow)) => {
                self.under_way.push_back(false);
                return Some(flow);
            }
            Ok(None) => {}
            Err(error) => self.trouble = Some(error),
        }
        self.sender.take_if(|sender| sender.is_done());
        if self.sender.is_none()
            && let Some(data) = self.responses.pop_front()
        {
            self.sender = Some(TransferSender::new(self.response, data, self.settings));
        }
        match self.sender.as_mut()?.next(now_ns) {
            Ok(frame) => {
                self.under_way.extend(frame.map(|_| true));
                frame
            }
            Err(error) => {
                self.trouble = Some(error);
                self.give_up_response();
                None
            }
        }
    }

    fn sent(&mut self, now_ns: u64) {
        if self.under_way.pop_front() == Some(true)
            && let Some(sender) = &mut self.sender
        {
            sender.sent(now_ns);
        }
    }

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        let is_functional = self.functional == Some(id);
        if id != self.request && !is_functional {
            return;
        }
        match parse(data, 0) {
            // A request to all has one frame: nobody could say to all when to go on (ISO 15765-2:2016, 9.1).
            Ok(Some(Pci::Single(data))) if is_functional => {
                push_bounded(&mut self.requests, ServerRequest { data: data.to_vec(), to_all: true });
            }
            Ok(Some(pci)) if !is_functional => self.hear_pci(now_ns, pci),
            Err(fault) => self.trouble = Some(TransferError::Malformed(fault)),
            Ok(_) => {}
        }
    }

    fn gap(&mut self, _now_ns: u64) {
        if let Err(error) = self.receiver.gap() {
            self.trouble = Some(error);
        }
    }

    fn due_ns(&self) -> Option<u64> {
        earlier(self.receiver.due_ns(), self.sender.as_ref().and_then(TransferSender::due_ns))
    }

    fn is_done(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(raw: u32) -> Id {
        Id::standard_truncated(raw)
    }

    fn server() -> IsoTpServer {
        IsoTpServer::new(id(0x7E0), Some(id(0x7DF)), id(0x7E8), TransferSettings::default())
    }

    /// Everything that it has to send now, confirmed at once.
    fn drain(server: &mut IsoTpServer, now_ns: u64) -> Vec<String> {
        let mut sent = Vec::new();
        while let Some(frame) = server.next(now_ns) {
            sent.push(frame.to_string());
            server.sent(now_ns);
        }
        sent
    }

    /// The frames of ISO 15765-2's example of a segmented response: first frame, flow control, consecutive frames.
    #[test]
    fn a_long_response_waits_for_flow_control_and_keeps_its_gap() {
        let mut server = server();
        server.hear(0, id(0x7E0), &[0x03, 0x22, 0xF1, 0x90, 0, 0, 0, 0]);
        let request = server.take_request().unwrap();
        assert_eq!((&request.data[..], request.to_all), (&[0x22, 0xF1, 0x90][..], false));
        server.answer(&request, (0..15).collect());
        assert_eq!(drain(&mut server, 1), ["7E8#100F000102030405"]);
        server.hear(2, id(0x7E0), &[0x30, 0, 5]);
        assert_eq!(drain(&mut server, 2), ["7E8#21060708090A0B0C"]);
        assert_eq!(server.due_ns(), Some(5_000_002));
        assert_eq!(drain(&mut server, 5_000_002), ["7E8#220D0ECCCCCCCCCC"]);
        assert_eq!((server.due_ns(), server.take_trouble()), (None, None));
    }

    #[test]
    fn a_tester_that_sends_no_flow_control_does_not_hold_up_the_next_response() {
        let mut server = server();
        let request = ServerRequest { data: vec![0x22], to_all: false };
        server.answer(&request, vec![1; 20]);
        server.answer(&request, vec![2]);
        assert_eq!(drain(&mut server, 0).len(), 1);
        assert_eq!(drain(&mut server, 1_000_000_000), [""; 0]);
        assert!(matches!(server.take_trouble(), Some(TransferError::NoFlowControl { .. })));
        assert_eq!(drain(&mut server, 1_000_000_001), ["7E8#0102CCCCCCCCCCCC"]);
    }

    #[test]
    fn a_request_to_all_gets_no_refusal_that_says_not_supported() {
        let mut server = server();
        server.hear(0, id(0x7DF), &[0x02, 0x01, 0xFE]);
        let request = server.take_request().unwrap();
        assert!(request.to_all);
        server.answer(&request, vec![0x7F, 0x01, 0x12]);
        assert_eq!(drain(&mut server, 0), [""; 0]);
        server.answer(&request, vec![0x7F, 0x01, 0x22]);
        assert_eq!(drain(&mut server, 0), ["7E8#037F0122CCCCCCCC"]);
        // Frames of a long request to all, and those of others, are nobody's.
        server.hear(0, id(0x7DF), &[0x10, 0x0F, 0, 0, 0, 0, 0, 0]);
        server.hear(0, id(0x7E1), &[0x02, 0x01, 0x00]);
        assert_eq!((server.take_request(), drain(&mut server, 0)), (None, vec![]));
    }

    #[test]
    fn a_long_request_gets_flow_control_and_is_dropped_after_a_loss() {
        let mut server = server();
        let first = [0x10, 0x08, 1, 2, 3, 4, 5, 6];
        server.hear(0, id(0x7E0), &first);
        assert_eq!(drain(&mut server, 0), ["7E8#300000CCCCCCCCCC"]);
        server.hear(1, id(0x7E0), &[0x21, 7, 8]);
        assert_eq!(server.take_request().unwrap().data, [1, 2, 3, 4, 5, 6, 7, 8]);
        server.hear(2, id(0x7E0), &first);
        server.gap(3);
        server.hear(4, id(0x7E0), &[0x21, 7, 8]);
        assert_eq!((server.take_request(), server.take_trouble()), (None, Some(TransferError::FramesLost)));
    }
}
