//! python-can's dialect: it has no columns for channel and direction, and everything that is not a frame is an error row with
//! SocketCAN's classes and bytes. Its SQLite tables have the same columns.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use cantap_can::{Frame, Id};

use super::super::codec::{Encode, HeadLine};
use super::super::error_frames::ErrorFrames;
use super::super::found::Row;
use super::super::issue::Fault;
use super::super::left_out::LeftOut;
use super::super::text::{self, NS_PER_S};
use super::rows::{columns, push_time};
use cantap_trace::counted;
use cantap_trace::socketcan::ErrorFrame;
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

/// The names of the columns.
pub(super) const HEAD: &str = "timestamp,arbitration_id,extended,remote,error,dlc,data";

/// Parses a yes-or-no column.
fn flag(word: &[u8]) -> Result<bool, Fault> {
    match word {
        b"0" | b"False" | b"false" => Ok(false),
        b"1" | b"True" | b"true" => Ok(true),
        other => Err(Fault::malformed("0 or 1 as a flag", other)),
    }
}

/// A message's columns other than its bytes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Message {
    pub id: u32,
    pub extended: bool,
    pub remote: bool,
    pub error: bool,
    /// The length as python-can has it: the bus's length code for a classical frame, the number of bytes for a CAN FD
    /// one.
    pub len: u64,
}

impl Message {
    /// The event, and a second one if an error frame contains two. There is no column for FD: a frame of more than eight bytes is
    /// one, and nothing else is known about it.
    pub(crate) fn event(
        &self,
        bytes: &[u8],
        error_frames: &mut ErrorFrames,
    ) -> Result<(TraceEvent, Option<TraceEvent>), Fault> {
        let mut padded = [0; 8];
        let present = bytes.len().min(8);
        padded[..present].copy_from_slice(&bytes[..present]);
        if self.error {
            return Ok(error_frames.read(self.id, padded));
        }
        let id = if self.extended { Id::extended(self.id) } else { Id::standard(self.id) };
        let found = || format!("{:X}", self.id);
        let id =
            id.ok_or_else(|| Fault::malformed("an identifier that fits its format", found().as_bytes()))?;
        let of = |frame| (TraceEvent::Frame { frame, direction: Direction::Rx, late: false }, None);
        if bytes.len() > 8
            && !self.remote
            && self.len == bytes.len() as u64
            && let Some(frame) = FdFrame::new(id, false, false, bytes)
        {
            return Ok(of(TraceFrame::Fd(frame)));
        }
        if bytes.len() > 8 || self.len > 15 {
            let found = format!("{} and {}", self.len, counted(bytes.len(), "byte"));
            return Err(Fault::malformed(
                "a length that CAN or CAN FD has, and as many bytes",
                found.as_bytes(),
            ));
        }
        let expected = self.len.min(8) as usize;
        if !self.remote && present != expected {
            let found = format!("{present}");
            return Err(Fault::malformed(format!("{expected} data bytes"), found.as_bytes()));
        }
        Ok(of(Frame::from_bus(id, self.remote, self.len as u8, padded).into()))
    }
}

/// Whether a line is a row: with no names above them, its flags and its bytes in base64 look like other tables' lengths and labels.
pub(super) fn is_row(line: &[u8]) -> bool {
    let is_hex = columns(line).is_ok_and(|[_, id, ..]: [&[u8]; 7]| id.starts_with(b"0x"));
    is_hex && row(line, &mut ErrorFrames::default()).is_ok()
}

/// A row.
pub(super) fn row(line: &[u8], error_frames: &mut ErrorFrames) -> Result<Row, Fault> {
    /// 64 bytes in base64.
    const LONGEST: usize = 88;
    let [time, id, extended, remote, error, dlc, data] = columns(line)?;
    let time_ns = time_ns(time).ok_or_else(|| Fault::malformed("a time in seconds", time))?;
    let digits = id.strip_prefix(b"0x").unwrap_or(id);
    let raw = text::hex(digits).ok_or_else(|| Fault::malformed("an identifier such as 0x123", id))?;
    let bytes = Some(data).filter(|data| data.len() <= LONGEST).and_then(|data| STANDARD.decode(data).ok());
    let bytes = bytes.ok_or_else(|| Fault::malformed("up to 64 bytes in base64", data))?;
    let [extended, remote, error] = [flag(extended)?, flag(remote)?, flag(error)?];
    let len = text::decimal(dlc).filter(|_| !error).or(error.then_some(8));
    let len = len.ok_or_else(|| Fault::malformed("a length", dlc))?;
    let message = Message { id: raw, extended, remote, error, len };
    let (event, second) = message.event(&bytes, error_frames)?;
    Ok(Some((TraceRecord { time_ns, device_ns: None, channel: 1, event }, second)))
}

/// A time as Python writes a floating-point number: `1.5`, or for small numbers `9.7e-05`.
pub(crate) fn time_ns(time: &[u8]) -> Option<i64> {
    if let Some(ns) = text::time(time, NS_PER_S, b'.') {
        return Some(ns);
    }
    let seconds: f64 = std::str::from_utf8(time).ok()?.parse().ok()?;
    let ns = (seconds * 1e9).round();
    (ns.abs() < 9e18).then_some(ns as i64)
}

/// Writes the dialect.
pub(crate) struct Encoder(HeadLine);

impl Default for Encoder {
    fn default() -> Self {
        Self(HeadLine::of(HEAD))
    }
}

impl Encode for Encoder {
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, left_out: &mut LeftOut) {
        self.0.write(out);
        if record.channel != 1 {
            left_out.note("channels other than 1, which python-can's CSV has no column for");
        }
        push_time(out, record.time_ns);
        let mut row = |id: u32, flags: [bool; 3], dlc: u8, data: &[u8]| {
            out.extend_from_slice(b",0x");
            text::push_hex(out, id, text::hex_len(id));
            for flag in flags {
                out.extend_from_slice(if flag { b",1" } else { b",0" });
            }
            out.push(b',');
            text::push_decimal(out, u64::from(dlc));
            out.push(b',');
            out.extend_from_slice(STANDARD.encode(data).as_bytes());
            out.push(b'\n');
        };
        match &record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                let id = frame.id();
                let len = if frame.is_fd() { frame.data_len() as u8 } else { frame.dlc() };
                row(id.raw(), [id.is_extended(), frame.is_remote(), false], len, frame.data());
                if let TraceFrame::Fd(frame) = frame {
                    if frame.data_len() <= 8 {
                        left_out.note(
                            "that short CAN FD frames are such, which python-can's CSV has no column for",
                        );
                    }
                    if frame.flags() != 0 {
                        left_out.note("the flags of CAN FD frames, which python-can's CSV has no column for");
                    }
                }
                if *direction == Direction::Tx {
                    left_out.note("the direction of sent frames, which python-can's CSV has no column for");
                }
            }
            event => {
                if let Some(ErrorFrame { classes, data }) = ErrorFrame::of(event) {
                    row(classes, [true, false, true], 8, &data);
                }
            }
        }
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        self.0.write(out);
    }
}
