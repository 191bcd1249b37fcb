//! The meaning of a message from a raw socket.

use cantap_trace::TraceFrame;
use cantap_trace::socketcan::{ERROR_FLAG, ErrorFrame};

use crate::raw_can::{RawFdFrame, RawFrame, fd_frame_of, frame_of};

/// What a raw socket delivers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Content {
    Frame(TraceFrame),
    Error(ErrorFrame),
    /// Of CAN XL, or of a length that nothing has.
    Other,
}

/// The meaning of a message, whose length says what it is.
pub(super) fn content(bytes: &[u8]) -> Content {
    if let Ok(raw) = <&RawFdFrame>::try_from(bytes) {
        return fd_frame_of(raw).map_or(Content::Other, |frame| Content::Frame(frame.into()));
    }
    let Ok(raw) = <&RawFrame>::try_from(bytes) else { return Content::Other };
    let [a, b, c, d, ..] = *raw;
    let id = u32::from_ne_bytes([a, b, c, d]);
    if id & ERROR_FLAG != 0 {
        let data = std::array::from_fn(|at| raw[8 + at]);
        return Content::Error(ErrorFrame { classes: id & (ERROR_FLAG - 1), data });
    }
    frame_of(raw).map_or(Content::Other, |frame| Content::Frame(frame.into()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raw_can::raw_frame;
    use cantap_wire::Frame;

    #[test]
    fn a_message_is_what_its_length_says() {
        let frame: Frame = "123#11".parse().unwrap();
        let classic = raw_frame(&frame);
        assert_eq!(content(&classic), Content::Frame(frame.into()));
        let mut fd = [0; 72];
        (fd[4], fd[5]) = (12, 1);
        assert_eq!(content(&fd), Content::Frame("000##1000000000000000000000000".parse().unwrap()));
        // CAN FD has no code for nine bytes.
        fd[4] = 9;
        assert_eq!(content(&fd), Content::Other);
        assert_eq!(content(&classic[..15]), Content::Other);
        assert_eq!(content(&[0; 2060]), Content::Other);
        // Nine bytes in sixteen.
        let mut nine = classic;
        nine[4] = 9;
        assert_eq!(content(&nine), Content::Other);
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_have_a_meaning(bytes in proptest::collection::vec(0_u8.., 0..80)) {
            content(&bytes);
        }
    }
}
