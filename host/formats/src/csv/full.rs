//! Our own dialect, complete, for people and spreadsheets.

use cantap_can::{Frame, Id};

use super::super::codec::{Encode, HeadLine};
use super::super::event_text::EventText;
use super::super::issue::Fault;
use super::super::left_out::LeftOut;
use super::super::text::{self, NS_PER_S};
use super::rows::{columns, push_time};
use cantap_trace::fd::{FD_LENGTHS, FD_MAX_BYTES};
use cantap_trace::{DeviceNs, Direction, FdFrame, TraceEvent, TraceFrame, TraceRecord};

/// The names of the columns.
pub(super) const HEAD: &str = "time,channel,direction,type,id,dlc,data,event,device_ns";
/// Those of files that were written before there was the last one.
pub(super) const HEAD_WITHOUT_DEVICE: &str = "time,channel,direction,type,id,dlc,data,event";

/// Types of CAN FD frames, by their flags.
const FD_KINDS: [&str; 4] = ["fd", "fd-brs", "fd-esi", "fd-brs-esi"];

/// A row, with the device's time or without that column.
pub(super) fn row(line: &[u8], has_device: bool) -> Result<TraceRecord, Fault> {
    let ([time, channel, direction, kind, id, dlc, data, event], device_ns) = if has_device {
        let [time, channel, direction, kind, id, dlc, data, event, device_ns] = columns(line)?;
        ([time, channel, direction, kind, id, dlc, data, event], device_time(device_ns)?)
    } else {
        (columns(line)?, None)
    };
    let time_ns =
        text::time(time, NS_PER_S, b'.').ok_or_else(|| Fault::malformed("a time in seconds", time))?;
    let channel = text::decimal(channel)
        .and_then(|channel| u8::try_from(channel).ok())
        .ok_or_else(|| Fault::malformed("a channel of 1 to 255", channel))?;
    let event_text = std::str::from_utf8(event).unwrap_or_default();
    if kind == b"event" {
        let parsed = event_text.parse::<EventText>();
        let EventText(event) =
            parsed.map_err(|_| Fault::malformed("an event such as 'lost 5 queue'", event))?;
        return Ok(TraceRecord { time_ns, device_ns, channel, event });
    }
    let fd = FD_KINDS.iter().position(|known| known.as_bytes() == kind);
    let remote = match kind {
        b"data" => false,
        b"remote" => true,
        _ if fd.is_some() => false,
        other => {
            return Err(Fault::malformed(
                "a type: data, remote, fd, fd-brs, fd-esi, fd-brs-esi or event",
                other,
            ));
        }
    };
    let direction = match direction {
        b"Rx" => Direction::Rx,
        b"Tx" => Direction::Tx,
        other => return Err(Fault::malformed("'Rx' or 'Tx'", other)),
    };
    let fault = || Fault::malformed("an identifier of 3 digits up to 7FF or 8 up to 1FFFFFFF", id);
    let parsed = std::str::from_utf8(id).ok().and_then(|id| id.parse::<Id>().ok()).ok_or_else(fault)?;
    let number = text::decimal(dlc)
        .filter(|dlc| *dlc <= 15)
        .ok_or_else(|| Fault::malformed("a data length code of 0 to 15", dlc))? as u8;
    let expected = match fd {
        _ if remote => 0,
        Some(_) => usize::from(FD_LENGTHS[usize::from(number)]),
        None => usize::from(number.min(8)),
    };
    let mut bytes = [0; FD_MAX_BYTES];
    let pairs = data.chunks(2).map(|pair| match pair {
        [high, low] => text::hex_pair(*high, *low),
        _ => None,
    });
    let wrong = || Fault::malformed(format!("{expected} data bytes"), data);
    if data.len() != 2 * expected {
        return Err(wrong());
    }
    for (slot, byte) in bytes.iter_mut().zip(pairs) {
        *slot = byte.ok_or_else(wrong)?;
    }
    let frame = match fd {
        Some(flags) => {
            FdFrame::new(parsed, flags & 1 != 0, flags & 2 != 0, &bytes[..expected]).map(TraceFrame::Fd)
        }
        None => bytes.first_chunk().map(|data| Frame::from_bus(parsed, remote, number, *data).into()),
    };
    let frame = frame.ok_or_else(wrong)?;
    let event = TraceEvent::Frame { frame, direction, late: event == b"late" };
    Ok(TraceRecord { time_ns, device_ns, channel, event })
}

/// The device's time; empty where it is unknown.
fn device_time(text: &[u8]) -> Result<Option<DeviceNs>, Fault> {
    if text.is_empty() {
        return Ok(None);
    }
    let time = text::decimal(text).and_then(DeviceNs::new);
    time.map(Some).ok_or_else(|| Fault::malformed("a device's time in nanoseconds, or none", text))
}

/// Writes the dialect.
pub(crate) struct Encoder(HeadLine);

impl Default for Encoder {
    fn default() -> Self {
        Self(HeadLine::of(HEAD))
    }
}

impl Encode for Encoder {
    fn carries_late(&self) -> bool {
        true
    }

    fn carries_lin(&self) -> bool {
        true
    }

    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        self.0.write(out);
        push_time(out, record.time_ns);
        out.push(b',');
        text::push_decimal(out, u64::from(record.channel));
        match &record.event {
            TraceEvent::Frame { frame, direction, late } => {
                out.extend_from_slice(if *direction == Direction::Tx { b",Tx," } else { b",Rx," });
                out.extend_from_slice(match frame {
                    TraceFrame::Fd(frame) => FD_KINDS[usize::from(frame.flags() & 3)].as_bytes(),
                    TraceFrame::Classic(frame) if frame.is_remote() => b"remote",
                    TraceFrame::Classic(_) => b"data",
                });
                out.push(b',');
                let id = frame.id();
                text::push_hex(out, id.raw(), if id.is_extended() { 8 } else { 3 });
                out.push(b',');
                text::push_decimal(out, u64::from(frame.dlc()));
                out.push(b',');
                for byte in frame.data() {
                    text::push_hex_byte(out, *byte);
                }
                out.extend_from_slice(if *late { b",late," } else { b",," });
            }
            event => out.extend_from_slice(format!(",,event,,,,{},", EventText(*event)).as_bytes()),
        }
        if let Some(device_ns) = record.device_ns {
            text::push_decimal(out, device_ns.get());
        }
        out.push(b'\n');
    }

    fn finish(&mut self, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        self.0.write(out);
    }
}
