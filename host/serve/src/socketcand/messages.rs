//! The messages to a client: `< frame 123 23.424242 11223344 >`.
//!
//! The page has blanks between the bytes. The original server writes them without blanks in raw mode, which is what python-can and SavvyCAN read,
//! and with blanks in BCM mode. A frame without data has two blanks before its `>` in either mode. An identifier with 11 bits has three digits,
//! one with 29 has eight: python-can distinguishes them by that.

use std::fmt::Write;

use cantap::TraceEvent;
use cantap_wire::Frame;
use cantap_wire::record::TransmitFailure;

use crate::text::{Seconds, error_frame, now_ns, put_bytes};

/// Adds a frame. `is_raw` is false in BCM mode.
pub fn put_frame(out: &mut String, time_ns: i64, frame: &Frame, is_raw: bool) {
    let (id, time) = (frame.id(), Seconds(time_ns));
    // Writing to memory cannot fail.
    if frame.is_remote() {
        let _ = write!(out, "< rtr {id} {time} {} >", frame.dlc());
        return;
    }
    let _ = write!(out, "< frame {id} {time} ");
    put_bytes(out, frame.data(), if is_raw { "" } else { " " });
    out.push_str(" >");
}

/// Adds an error or a loss as a SocketCAN error frame: its classes as an identifier including the flag, the time, the data.
pub fn put_error(out: &mut String, time_ns: i64, event: &TraceEvent) {
    let Some((id, data)) = error_frame(event) else { return };
    let _ = write!(out, "< error {id:08X} {} ", Seconds(time_ns));
    put_bytes(out, &data, " ");
    out.push_str(" >");
}

/// The message for a refused frame, for which raw mode has none.
pub fn not_sent() -> String {
    let mut out = String::new();
    put_error(&mut out, now_ns(), &TraceEvent::TransmitFailed { tag: 0, reason: TransmitFailure::Aborted });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(text: &str, is_raw: bool) -> String {
        let mut out = String::new();
        put_frame(&mut out, 23_424_242_000, &text.parse().unwrap(), is_raw);
        out
    }

    #[test]
    fn frames_are_written_as_clients_read_them() {
        assert_eq!(frame("123#11223344", true), "< frame 123 23.424242 11223344 >");
        assert_eq!(frame("123#11223344", false), "< frame 123 23.424242 11 22 33 44  >");
        assert_eq!(frame("00000123#11", true), "< frame 00000123 23.424242 11 >");
        for is_raw in [true, false] {
            assert_eq!(frame("123#", is_raw), "< frame 123 23.424242  >");
            assert_eq!(frame("123#R4", is_raw), "< rtr 123 23.424242 4 >");
        }
    }

    #[test]
    fn a_loss_is_an_error_frame_with_the_count_in_it() {
        let mut out = String::new();
        let stage = Some(cantap_wire::record::LossStage::Host);
        put_error(&mut out, 1_000_000_000, &TraceEvent::Lost { stage, count: 7, at_least: false });
        assert_eq!(out, "< error 20000004 1.000000 04 01 07 00 00 00 00 00  >");
        assert!(not_sent().starts_with("< error 20000001 "));
    }
}
