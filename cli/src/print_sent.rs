//! Prints the frames that were sent, like candump.

use std::io::{self, Write as _};

use cantap::TraceFrame;
use cantap::device::Transmission;
use cantap_work::sending::OnSent;

/// Prints each on standard output.
pub fn print_sent() -> OnSent<'static> {
    Box::new(print)
}

fn print(end: &Transmission, frame: TraceFrame) -> io::Result<()> {
    let (seconds, us) = (end.time_ns / 1_000_000_000, end.time_ns / 1000 % 1_000_000);
    writeln!(std::io::stdout().lock(), "({seconds}.{us:06}) can{} {frame} T", end.channel.index())
}
