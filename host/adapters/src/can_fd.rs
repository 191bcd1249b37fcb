//! Whether a device has CAN FD, and who says so.

use std::fmt;

use cantap_wire::Hello;
use cantap_wire::message::capability;

use crate::rows::{Confirmation, row};

/// What a device does with CAN FD frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CanFd {
    /// Whether it receives them; `None` if nobody tells.
    pub receives: Option<bool>,
    /// Whether it sends them.
    pub sends: bool,
    /// The bit rate of their data phases, in bit/s, if it is known here.
    pub data_bitrate_bps: Option<u32>,
    /// Who says so.
    pub source: &'static str,
}

/// What a device does with CAN FD frames, by what it says of itself and by the data bit rate that its address or its interface has, if that is known
/// here.
pub fn can_fd(hello: &Hello, data_bitrate_bps: Option<u32>) -> CanFd {
    of(&hello.board, hello.capabilities & capability::ADAPTER != 0, hello.sends_fd(), data_bitrate_bps)
}

fn of(board: &str, is_adapter: bool, sends: bool, data_bitrate_bps: Option<u32>) -> CanFd {
    let none = |source| CanFd { receives: Some(false), sends: false, data_bitrate_bps: None, source };
    match board {
        _ if !is_adapter => none("its controllers, which are classical"),
        "socketcand" => none("the protocol, which has no message for them"),
        board if board.starts_with("socketcan") => {
            let cannot_send = row(board).is_some_and(|row| row.confirmation == Confirmation::CannotSend);
            // One that cannot send says nothing of what it receives, but with a data bit rate CAN FD is on.
            let receives = if sends || data_bitrate_bps.is_some() {
                Some(true)
            } else {
                (!cannot_send).then_some(false)
            };
            CanFd { receives, sends, data_bitrate_bps, source: "the interface, as its owner has set it" }
        }
        board if board.starts_with("gs_usb") || board == "pcan" || board == "kvaser" => {
            let source =
                if sends { "the address and the adapter" } else { "the address, which has no ?data-bitrate" };
            CanFd { receives: Some(sends), sends, data_bitrate_bps, source }
        }
        "gvret-fd" => {
            CanFd { receives: Some(true), sends: false, data_bitrate_bps, source: "the address alone" }
        }
        "gvret" => none("the address, which has no ?data-bitrate"),
        "cannelloni" | "cannelloni-tcp" => CanFd {
            receives: Some(true),
            sends,
            data_bitrate_bps,
            source: "the protocol; it does not tell whether the bus at the other end has it",
        },
        "trace-pipe" => {
            CanFd { receives: Some(true), sends: false, data_bitrate_bps, source: "the trace's format" }
        }
        _ => none("the protocol, which has no message for them that is read"),
    }
}

impl fmt::Display for CanFd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match (self.receives, self.sends) {
            (Some(true), true) => "received and sent",
            (Some(true), false) => "received, not sent",
            (Some(false), true) => "sent, not received",
            (Some(false), false) => "none",
            (None, true) => "sent; not known whether received",
            (None, false) => "not sent; not known whether received",
        })?;
        match self.data_bitrate_bps {
            Some(rate) => write!(f, ", data phases at {rate} bit/s")?,
            None if self.receives == Some(false) && !self.sends => {}
            None => f.write_str(", data bit rate not known")?,
        }
        write!(f, " ({})", self.source)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ROWS;

    #[test]
    fn every_kind_says_whether_it_has_can_fd_and_who_says_so() {
        let text = |board: &str, sends, rate| of(board, true, sends, rate).to_string();
        assert_eq!(
            of("STM32-P405", false, false, None).to_string(),
            "none (its controllers, which are classical)"
        );
        assert_eq!(
            text("gs_usb-normal", true, Some(2_000_000)),
            "received and sent, data phases at 2000000 bit/s (the address and the adapter)"
        );
        assert_eq!(text("pcan", false, None), "none (the address, which has no ?data-bitrate)");
        // Of a shared adapter the rate is known where it is, and not here.
        assert_eq!(
            text("kvaser", true, None),
            "received and sent, data bit rate not known (the address and the adapter)"
        );
        assert_eq!(text("socketcan-hw", false, None), "none (the interface, as its owner has set it)");
        assert!(text("socketcan-silent", false, None).starts_with("not sent; not known whether received"));
        assert!(
            text("socketcan-silent", false, Some(5_000_000))
                .starts_with("received, not sent, data phases at 5000000")
        );
        assert!(
            text("socketcan-virtual", true, None).starts_with("received and sent, data bit rate not known")
        );
        assert!(text("trace-pipe", false, None).starts_with("received, not sent"));
        assert!(
            text("gvret-fd", false, Some(2_000_000))
                .starts_with("received, not sent, data phases at 2000000")
        );
        let with_none = ["slcan", "gvret", "socketcand", "elm327", "stn"];
        for row in ROWS.iter().filter(|row| with_none.contains(&row.board)) {
            assert!(text(row.board, false, None).starts_with("none ("), "{}", row.board);
        }
    }
}
