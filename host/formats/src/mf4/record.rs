//! The content of a group's record.

use super::super::event_text::EventText;
use super::super::frame_fields::{FdFields, FrameFields, Payload, fd_len, identifier};
use super::super::issue::Fault;
use super::ERROR_TYPES;
use super::layout::{BusGroup, Bytes, Events, Field};
use cantap_trace::{Direction, TraceEvent, TraceRecord};

impl BusGroup {
    /// Whether its records contain the bytes of their frames.
    pub(super) fn is_complete(&self) -> bool {
        matches!(self.bytes, None | Some(Bytes::Here(_))) && !matches!(self.events, Events::Other(_))
    }

    /// The content of a record. `apart`: its frame's bytes, if they are stored elsewhere.
    pub(super) fn record(
        &self,
        record: &[u8],
        number: u64,
        apart: Option<&[u8]>,
        start_ns: i64,
    ) -> Result<TraceRecord, Fault> {
        let offset_ns = self.clock.ns(record, number);
        let offset_ns = offset_ns.ok_or_else(|| Fault::malformed("a time within 292 years", b"another"))?;
        let time_ns = start_ns.saturating_add(offset_ns);
        let channel = match &self.bus_channel {
            None => self.bus,
            Some(field) => {
                let channel = field.unsigned(record);
                let fault = || Fault::malformed("a channel of 0 to 255", format!("{channel:?}").as_bytes());
                channel.and_then(|channel| u8::try_from(channel).ok()).ok_or_else(fault)?
            }
        };
        let event = match self.events {
            Events::Frames => self.frame(record, apart, false)?,
            Events::RemoteFrames => self.frame(record, None, true)?,
            Events::ErrorFrames => self.words(record).unwrap_or_else(|| {
                let number = self.error_type.and_then(|field| field.unsigned(record));
                let known = ERROR_TYPES.iter().find(|(known, _)| Some(*known) == number);
                TraceEvent::BusError { kind: known.map(|(_, kind)| *kind), counters: None }
            }),
            Events::Words => {
                let fault = || Fault::malformed("an event such as 'lost 5 queue'", b"other words");
                self.words(record).ok_or_else(fault)?
            }
            Events::Other(_) => return Err(Fault::malformed("an event of CAN", b"another")),
        };
        Ok(TraceRecord { time_ns, channel, event })
    }

    fn words(&self, record: &[u8]) -> Option<TraceEvent> {
        let bytes = self.words?.bytes(record)?;
        let text = bytes.split(|byte| *byte == 0).next()?;
        let EventText(event) = std::str::from_utf8(text).ok()?.parse().ok()?;
        Some(event)
    }

    fn frame(&self, record: &[u8], apart: Option<&[u8]>, remote: bool) -> Result<TraceEvent, Fault> {
        const EXTENDED: u64 = 1 << 31;
        const IDENTIFIER: u64 = (1 << 29) - 1;
        let number = |field: &Option<Field>| field.and_then(|field| field.unsigned(record));
        let flag = |field: &Option<Field>, text: &[u8]| field.is_some_and(|field| field.flag(record, text));
        let raw = number(&self.id).ok_or_else(|| Fault::malformed("a frame's identifier", b"none"))?;
        let extended = match &self.ide {
            Some(_) => flag(&self.ide, b"E"),
            None => raw & EXTENDED != 0 || raw & IDENTIFIER > 0x7FF,
        };
        let id = (raw & IDENTIFIER) as u32;
        let id = identifier(id, extended, b"")
            .or_else(|_| identifier(id, extended, format!("{id:X}").as_bytes()))?;
        let is_fd = flag(&self.edl, b"1");
        let code = number(&self.dlc);
        let fd = is_fd.then(|| FdFields { brs: flag(&self.brs, b"1"), esi: flag(&self.esi, b"1") });
        let direction = if flag(&self.dir, b"T") { Direction::Tx } else { Direction::Rx };
        let longest = if is_fd { 64 } else { 8 };
        let of_code = |code: u64| if is_fd { u64::from(fd_len(code as u8)) } else { code.min(8) };
        let fields = |len| FrameFields { id, remote, direction, len, fd };
        if remote {
            let code = code.filter(|code| *code <= 15);
            let code = code.ok_or_else(|| Fault::malformed("a data length code of 0 to 15", b"another"))?;
            return fields(code as u8).event(&Payload::EMPTY);
        }
        let here = match &self.bytes {
            Some(Bytes::Here(field)) => field.bytes(record),
            _ => apart,
        };
        let here = here.unwrap_or_default();
        let len = number(&self.data_length).or(code.map(of_code)).unwrap_or(here.len() as u64);
        let data = here.get(..len as usize).filter(|_| len <= longest).and_then(Payload::of);
        let fault = || {
            let found = format!("{len} of {}", here.len());
            Fault::malformed(format!("up to {longest} data bytes"), found.as_bytes())
        };
        let data = data.ok_or_else(fault)?;
        // A classical frame's length code can be above 8.
        let code = code.filter(|code| !is_fd && len == 8 && (9..=15).contains(code));
        fields(code.unwrap_or(len) as u8).event(&data)
    }
}
