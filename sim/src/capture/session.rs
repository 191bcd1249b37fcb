//! One side of the conversation: requests out, responses and records in. No I/O and no time.

use cantap_wire::framing::{self, CRC_LEN, MAX_ENCODED, MAX_MESSAGE};
use cantap_wire::message::{EndReason, Response};
use cantap_wire::{CHANNELS, Command, Corruption, Decoded, Decoder, PROTOCOL_VERSION, Record, Request};

/// What the device sent, apart from responses.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SessionEvent {
    /// A record at its device time in ticks.
    Record(u64, Record),
    /// Batches are missing here, with this many frames of each channel.
    BatchesLost([u32; CHANNELS]),
    /// The device has ended the session, at this device time.
    Ended(u64, EndReason),
}

/// The conversation.
pub struct Session {
    decoder: Decoder,
    next_id: u16,
    responses: Vec<Response>,
    corruptions: Vec<Corruption>,
    bytes: u64,
}

impl Session {
    /// Before the first request.
    pub fn new() -> Self {
        Self { decoder: Decoder::new(), next_id: 1, responses: Vec::new(), corruptions: Vec::new(), bytes: 0 }
    }

    /// The bytes of a request, and its id. A zero goes first: it ends whatever another program may
    /// have left in the device's input, and chooses the native protocol.
    pub fn request(&mut self, command: Command) -> (u16, Vec<u8>) {
        let id = self.next_id;
        self.next_id = self.next_id.wrapping_add(1);
        let mut message = [0; MAX_MESSAGE + CRC_LEN];
        let mut out = vec![0; 1 + MAX_ENCODED];
        // Cannot fail: every command is shorter than the longest message, and the buffers fit it.
        let encoded = framing::encode(&Request { id, command }, &mut message, &mut out[1..]).unwrap_or(0);
        out.truncate(1 + encoded);
        (id, out)
    }

    /// `Hello` of this protocol version.
    pub fn hello(&mut self) -> (u16, Vec<u8>) {
        self.request(Command::Hello { protocol: PROTOCOL_VERSION })
    }

    /// Expects a new conversation on a port that was opened again: an unfinished message of the old
    /// one is thrown away.
    pub fn restart(&mut self) {
        self.decoder = Decoder::new();
    }

    /// Takes bytes from the device and reports records in their order.
    pub fn take(&mut self, bytes: &[u8], mut report: impl FnMut(SessionEvent)) {
        self.bytes += bytes.len() as u64;
        let Self { decoder, responses, corruptions, .. } = self;
        decoder.push(bytes, |decoded| match decoded {
            Decoded::Record { ticks, record } => report(SessionEvent::Record(ticks, record)),
            Decoded::BatchesLost { frames, .. } => report(SessionEvent::BatchesLost(frames)),
            Decoded::Response(response) => responses.push(response.clone()),
            Decoded::Corrupt(corruption) => corruptions.push(corruption),
            Decoded::Ended { ticks, reason } => report(SessionEvent::Ended(ticks, reason)),
            Decoded::OtherProtocol(_) => corruptions.push(Corruption::Unknown),
        });
    }

    /// Takes the response to request `id`, if it has come.
    pub fn response(&mut self, id: u16) -> Option<Response> {
        let at = self.responses.iter().position(|response| response.id == id)?;
        Some(self.responses.remove(at))
    }

    /// Responses that have not been taken.
    pub fn responses(&self) -> &[Response] {
        &self.responses
    }

    /// What could not be read. Empty on a healthy link.
    pub fn corruptions(&self) -> &[Corruption] {
        &self.corruptions
    }

    /// Bytes received so far, in total.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }
}

impl Default for Session {
    fn default() -> Self {
        Self::new()
    }
}
