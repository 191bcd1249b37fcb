//! Writing candump's log.

use cantap_can::{Frame, Id};

use super::super::codec::Encode;
use super::super::left_out::LeftOut;
use super::super::line::{Line, Seconds};
use super::super::text::{self, NS_PER_S};
use cantap_trace::socketcan::{BUS_ERROR, ERROR_FLAG, ErrorFrame};
use cantap_trace::{Direction, TraceEvent, TraceFrame, TraceRecord};

/// Writes the format.
pub(crate) struct Encoder {
    seconds: Seconds<0>,
}

impl Default for Encoder {
    fn default() -> Self {
        Self { seconds: Seconds::new() }
    }
}

impl Encode for Encoder {
    #[inline]
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, _left_out: &mut LeftOut) {
        let mut line = Line::new();
        if record.time_ns >= 0 {
            line.put(b"(");
            self.seconds.put(&mut line, record.time_ns as u64 / 1000);
        } else {
            out.push(b'(');
            text::push_time(out, record.time_ns, NS_PER_S, 6, b'.');
        }
        if record.channel == 0 {
            line.put(b") channel0");
        } else {
            line.put(b") can");
            line.put_small(record.channel - 1);
        }
        line.put(b" ");
        match &record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                match frame {
                    TraceFrame::Classic(frame) => put_frame(&mut line, frame),
                    TraceFrame::Fd(frame) => {
                        put_id(&mut line, frame.id());
                        line.put(b"##");
                        line.put_hex(u32::from(frame.flags()));
                        // Longer than a line that fits the inline buffer.
                        std::mem::replace(&mut line, Line::new()).end(out);
                        frame.data().iter().for_each(|byte| text::push_hex_byte(out, *byte));
                    }
                }
                if *direction == Direction::Tx {
                    line.put(b" T");
                }
            }
            event => {
                // Every event but a frame has an error frame. python-can takes one without this class for a
                // frame on the bus; bus-off stays as in the kernel.
                if let Some(ErrorFrame { classes, data }) = ErrorFrame::of(event) {
                    let is_bus_off = classes & cantap_trace::socketcan::BUS_OFF != 0;
                    let class = if is_bus_off { 0 } else { BUS_ERROR };
                    line.put(&text::hex_digits_of(ERROR_FLAG | class | classes));
                    line.put(b"#");
                    line.put(&text::hex_digits_of_eight(data));
                }
            }
        }
        line.put(b"\n");
        line.end(out);
    }

    fn finish(&mut self, _out: &mut Vec<u8>, _left_out: &mut LeftOut) {}
}

/// `123#DEADBEEF`.
#[inline]
fn put_frame(line: &mut Line, frame: &Frame) {
    put_id(line, frame.id());
    line.put(b"#");
    if frame.is_remote() {
        line.put(b"R");
        if frame.dlc() > 0 {
            line.put(&[b'0' + frame.dlc().min(8)]);
        }
    }
    line.put_start(&text::hex_digits_of_eight(frame.padded_data()), 2 * frame.data_len());
    if frame.dlc() > 8 {
        line.put(b"_");
        line.put_hex(u32::from(frame.dlc()));
    }
}

/// Three digits or eight.
#[inline]
fn put_id(line: &mut Line, id: Id) {
    let digits = text::hex_digits_of(id.raw());
    if id.is_extended() {
        line.put(&digits);
    } else {
        line.put(&[digits[5], digits[6], digits[7]]);
    }
}
