//! Losses, errors and states as separate lines, if a host asks for them (`K1`), in the form that Linux's slcan driver
//! has understood since 6.0 (`drivers/net/can/slcan/slcan-core.c`), so that they reach `ip -details -statistics
//! link`.
//!
//! `e`, a digit and that many letters are errors; each line counts an error once, however often it names it. The driver ignores
//! lines shorter than five characters, so an error is named three times. `s`, a letter and two counters of three decimal digits,
//! receive and transmit, are a new state.

use core::fmt::Write;

use cantap_wire::Event;
use heapless::String;

/// The longest line: `s`, state, two counters, CR.
const MAX_LINE: usize = 1 + 1 + 3 + 3 + 1;

/// A line.
pub type Line = String<MAX_LINE>;

/// A frame was refused because the transmit queue was full.
pub fn transmit_overrun() -> Line {
    error('O')
}

/// An event's line, if it has one. Errors beyond the number that the device reports one by one have no kind, and so no line.
pub fn line(event: &Event) -> Option<Line> {
    match event {
        Event::Lost { .. } => Some(error('o')),
        Event::BusError { kind, .. } => Some(error(kind.slcan_letter().into())),
        Event::State { state, tec, rec, .. } => {
            let letter = char::from(state.slcan_letter());
            Some(written(format_args!("s{letter}{rec:03}{tec:03}\r")))
        }
        _ => None,
    }
}

fn error(letter: char) -> Line {
    written(format_args!("e3{letter}{letter}{letter}\r"))
}

fn written(text: core::fmt::Arguments<'_>) -> Line {
    let mut line = Line::new();
    // It cannot fail: counters have at most three digits.
    let _ = line.write_fmt(text);
    line
}
