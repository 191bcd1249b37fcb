//! The content of a group's record.

use super::super::event_text::EventText;
use super::super::frame_fields::{FdFields, FrameFields, Payload, fd_len, identifier};
use super::super::issue::Fault;
use super::ERROR_TYPES;
use super::channel::{Number, Row, Validity};
use super::layout::{BusGroup, Bytes, Events};
use cantap_trace::{DeviceNs, Direction, LinFault, LinFrame, TraceEvent, TraceRecord};

impl BusGroup {
    /// Whether its records alone say everything about their events.
    pub(super) fn says_everything(&self) -> bool {
        let flags = [&self.ide, &self.dir, &self.edl, &self.brs, &self.esi];
        let parts = flags.into_iter().chain([&self.bus_channel, &self.error_type, &self.checksum]);
        let parts = parts.flatten().map(Number::validity);
        let mut validities = parts.chain(self.needed.iter().chain(&self.lengths).copied());
        self.apart.is_empty()
            && self.times.is_none()
            && validities.all(|validity| validity == Validity::Always)
    }

    /// Whether the bits behind a record's values say that there is no event in it.
    pub(super) fn is_invalid(&self, invalid: &[u8]) -> bool {
        let holds = |validity: &Validity| validity.holds(invalid);
        !self.needed.iter().all(holds) || !self.lengths.is_empty() && !self.lengths.iter().any(holds)
    }

    /// The content of a record. `time`: the record with its time, which may be itself.
    pub(super) fn record(&self, row: &Row<'_>, time: &[u8], start_ns: i64) -> Result<TraceRecord, Fault> {
        let offset_ns = self.clock.ns(time, row.number);
        let offset_ns = offset_ns.ok_or_else(|| Fault::malformed("a time within 292 years", b"another"))?;
        let time_ns = start_ns.saturating_add(offset_ns);
        let channel = match &self.bus_channel {
            Some(number) if number.is_valid(row) => {
                let channel = number.get(row);
                let fault = || Fault::malformed("a channel of 0 to 255", format!("{channel:?}").as_bytes());
                channel.and_then(|channel| u8::try_from(channel).ok()).ok_or_else(fault)?
            }
            _ => self.bus,
        };
        let event = match self.events {
            Events::Frames => self.frame(row, false)?,
            Events::RemoteFrames => self.frame(row, true)?,
            Events::ErrorFrames => self.words(row.record).unwrap_or_else(|| {
                let number = self.error_type.as_ref().and_then(|number| number.get(row));
                let known = ERROR_TYPES.iter().find(|(known, _)| Some(*known) == number);
                TraceEvent::BusError { kind: known.map(|(_, kind)| *kind), counters: None }
            }),
            Events::Lin(fault) => self.lin(row, fault)?,
            Events::Words => {
                let fault = || Fault::malformed("an event such as 'lost 5 queue'", b"other words");
                self.words(row.record).ok_or_else(fault)?
            }
        };
        let device_time = self.device_time.as_ref().and_then(|number| number.get(row));
        Ok(TraceRecord { time_ns, device_ns: device_time.and_then(DeviceNs::new), channel, event })
    }

    /// A frame of LIN. Its length is that of the data that came.
    fn lin(&self, row: &Row<'_>, fault: Option<LinFault>) -> Result<TraceEvent, Fault> {
        let number = |number: &Option<Number>| number.as_ref().and_then(|number| number.get(row));
        let id = number(&self.id).and_then(|id| u8::try_from(id).ok());
        let here = self.bytes(row);
        let len =
            number(&self.data_length).map_or(here.len(), |len| usize::try_from(len).unwrap_or(usize::MAX));
        let data = if fault == Some(LinFault::NoResponse) { Some(&[][..]) } else { here.get(..len) };
        let frame = id.zip(data).and_then(|(id, data)| LinFrame::new(id, data));
        let frame = frame.ok_or_else(|| {
            let found = format!("{id:?} with {len} of {}", here.len());
            Fault::malformed("an identifier of LIN up to 3F with at most 8 bytes", found.as_bytes())
        })?;
        let checksum = number(&self.checksum).and_then(|sum| u8::try_from(sum).ok());
        let is_sent = number(&self.dir).is_some_and(|dir| dir != 0);
        let direction = if is_sent { Direction::Tx } else { Direction::Rx };
        Ok(TraceEvent::Lin { frame: frame.with(checksum, fault), direction })
    }

    fn words(&self, record: &[u8]) -> Option<TraceEvent> {
        let bytes = self.words?.bytes(record)?;
        let text = bytes.split(|byte| *byte == 0).next()?;
        let EventText(event) = std::str::from_utf8(text).ok()?.parse().ok()?;
        Some(event)
    }

    /// The bytes of a frame, as many as are stored for it.
    fn bytes<'a>(&self, row: &Row<'a>) -> &'a [u8] {
        let bytes = match &self.bytes {
            Some(Bytes::Here(field, size)) => {
                let size = size.as_ref().and_then(|size| size.get(row));
                let size = size.map_or(usize::MAX, |size| usize::try_from(size).unwrap_or(usize::MAX));
                field.bytes(row.record).map(|bytes| &bytes[..bytes.len().min(size)])
            }
            Some(Bytes::Apart(at)) => row.apart.get(*at).map(Vec::as_slice),
            None => None,
        };
        bytes.unwrap_or_default()
    }

    fn frame(&self, row: &Row<'_>, remote: bool) -> Result<TraceEvent, Fault> {
        const EXTENDED: u64 = 1 << 31;
        const IDENTIFIER: u64 = (1 << 29) - 1;
        let number = |number: &Option<Number>| number.as_ref().and_then(|number| number.get(row));
        let flag = |flag: &Option<Number>| number(flag).is_some_and(|flag| flag != 0);
        let raw = number(&self.id).ok_or_else(|| Fault::malformed("a frame's identifier", b"none"))?;
        let extended =
            number(&self.ide).map_or(raw & EXTENDED != 0, |flag| flag != 0) || raw & IDENTIFIER > 0x7FF;
        let id = (raw & IDENTIFIER) as u32;
        let id = identifier(id, extended, b"")
            .or_else(|_| identifier(id, extended, format!("{id:X}").as_bytes()))?;
        let code = number(&self.dlc);
        let data_length = number(&self.data_length);
        let here = self.bytes(row);
        // No classical frame has more, and there is nothing else that says which it is.
        let is_longer = |len: u64| len > 8 && len <= here.len() as u64;
        let is_fd = number(&self.edl).map_or(data_length.is_some_and(is_longer), |flag| flag != 0);
        let fd = is_fd.then(|| FdFields { brs: flag(&self.brs), esi: flag(&self.esi) });
        let direction = if flag(&self.dir) { Direction::Tx } else { Direction::Rx };
        let longest = if is_fd { 64 } else { 8 };
        let of_code = |code: u64| if is_fd { u64::from(fd_len(code as u8)) } else { code.min(8) };
        let fields = |len| FrameFields { id, remote, direction, len, fd };
        if remote {
            let code = code.filter(|code| *code <= 15);
            let code = code.ok_or_else(|| Fault::malformed("a data length code of 0 to 15", b"another"))?;
            return fields(code as u8).event(&Payload::EMPTY);
        }
        // A classical frame's length code can be above 8: its length is 8, which some tables of lengths do not say.
        let code_above_8 = code.filter(|code| !is_fd && (9..=15).contains(code));
        let len = match (code_above_8, data_length) {
            (Some(_), Some(len)) => len.min(8),
            (_, len) => len.or(code.map(of_code)).unwrap_or(here.len() as u64),
        };
        let data = here.get(..len as usize).filter(|_| len <= longest).and_then(Payload::of);
        let fault = || {
            let found = format!("{len} of {}", here.len());
            Fault::malformed(format!("up to {longest} data bytes"), found.as_bytes())
        };
        let data = data.ok_or_else(fault)?;
        let code = code_above_8.filter(|_| len == 8);
        fields(code.unwrap_or(len) as u8).event(&data)
    }
}
