//! Linux's `struct can_frame` and `struct canfd_frame` (`linux/can.h`), and their meaning here.

use cantap_trace::TraceEvent;
use cantap_trace::fd::{FLAG_BRS, FLAG_ESI, FLAG_FDF};
use cantap_trace::socketcan::{ERROR_FLAG, ErrorFrame};
use cantap_wire::{FdFrame, Frame, Id};

/// The identifier with its flags in the machine's byte order, the length, two unused bytes, the DLC where it is above 8, the data.
pub type RawFrame = [u8; 16];
/// The identifier with its flags, the length, the flags of CAN FD, two unused bytes, the data.
pub type RawFdFrame = [u8; 72];

const EXTENDED_FLAG: u32 = 0x8000_0000;
const REMOTE_FLAG: u32 = 0x4000_0000;
/// Offsets in a raw frame.
const LEN: usize = 4;
const FLAGS: usize = 5;
const DLC_ABOVE_8: usize = 7;
const DATA: usize = 8;

/// A frame for programs.
pub fn raw_frame(frame: &Frame) -> RawFrame {
    let extended = if frame.id().is_extended() { EXTENDED_FLAG } else { 0 };
    let remote = if frame.is_remote() { REMOTE_FLAG } else { 0 };
    let mut raw = raw(frame.id().raw() | extended | remote, frame.padded_data());
    raw[LEN] = frame.dlc().min(8);
    if frame.dlc() > 8 {
        raw[DLC_ABOVE_8] = frame.dlc();
    }
    raw
}

/// An error, a state or a loss for programs; `None` for a frame.
pub fn raw_error(event: &TraceEvent) -> Option<RawFrame> {
    let ErrorFrame { classes, data } = ErrorFrame::of(event)?;
    let mut raw = raw(ERROR_FLAG | classes, data);
    raw[LEN] = 8;
    Some(raw)
}

fn raw(id: u32, data: [u8; 8]) -> RawFrame {
    let mut raw = [0; 16];
    raw[..LEN].copy_from_slice(&id.to_ne_bytes());
    raw[DATA..].copy_from_slice(&data);
    raw
}

/// A program's frame; `None` if no bus can carry it: an error frame, or one of more than eight bytes.
pub fn frame_of(raw: &RawFrame) -> Option<Frame> {
    let [a, b, c, d, len, _, _, above_8, data @ ..] = *raw;
    let id = u32::from_ne_bytes([a, b, c, d]);
    if id & ERROR_FLAG != 0 || len > 8 {
        return None;
    }
    let is_remote = id & REMOTE_FLAG != 0;
    let id = id_of(id)?;
    let dlc = if len == 8 && (9..=15).contains(&above_8) { above_8 } else { len };
    Some(Frame::from_bus(id, is_remote, dlc, data))
}

fn id_of(id: u32) -> Option<Id> {
    if id & EXTENDED_FLAG != 0 {
        Id::extended(id & Id::MAX_EXTENDED)
    } else {
        Id::standard(id & Id::MAX_STANDARD)
    }
}

/// A CAN FD frame; `None` if no bus can carry it: a remote or an error frame, or of a length that CAN FD has no code for.
pub fn fd_frame_of(raw: &RawFdFrame) -> Option<FdFrame> {
    let [a, b, c, d, len, flags, _, _, data @ ..] = raw;
    let id = u32::from_ne_bytes([*a, *b, *c, *d]);
    if id & (ERROR_FLAG | REMOTE_FLAG) != 0 {
        return None;
    }
    FdFrame::new(id_of(id)?, flags & FLAG_BRS != 0, flags & FLAG_ESI != 0, data.get(..usize::from(*len))?)
}

/// A CAN FD frame for programs.
pub fn raw_fd_frame(frame: &FdFrame) -> RawFdFrame {
    let extended = if frame.id().is_extended() { EXTENDED_FLAG } else { 0 };
    let mut raw = [0; 72];
    raw[..LEN].copy_from_slice(&(frame.id().raw() | extended).to_ne_bytes());
    raw[LEN] = frame.data_len() as u8;
    raw[FLAGS] = frame.flags() | FLAG_FDF;
    raw[DATA..DATA + frame.data_len()].copy_from_slice(frame.data());
    raw
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::{Direction, TraceFrame};
    use cantap_wire::record::{ErrorState, LossStage};

    fn bytes(id: u32, rest: [u8; 12]) -> RawFrame {
        let mut raw = [0; 16];
        raw[..4].copy_from_slice(&id.to_ne_bytes());
        raw[4..].copy_from_slice(&rest);
        raw
    }

    #[test]
    fn frames_are_can_frames_of_linux_and_come_back_as_they_were() {
        for (text, raw) in [
            ("123#1122", bytes(0x123, [2, 0, 0, 0, 0x11, 0x22, 0, 0, 0, 0, 0, 0])),
            ("123#", bytes(0x123, [0; 12])),
            ("1ABBCCDD#FF", bytes(0x9ABB_CCDD, [1, 0, 0, 0, 0xFF, 0, 0, 0, 0, 0, 0, 0])),
            ("7FF#R4", bytes(0x4000_07FF, [4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])),
            ("00000123#R", bytes(0xC000_0123, [0; 12])),
        ] {
            let frame: Frame = text.parse().unwrap();
            assert_eq!(raw_frame(&frame), raw, "{text}");
            assert_eq!(frame_of(&raw), Some(frame), "{text}");
        }
        for dlc in 0..16 {
            for is_remote in [false, true] {
                let frame = Frame::from_bus(Id::standard(1).unwrap(), is_remote, dlc, [7; 8]);
                assert_eq!(frame_of(&raw_frame(&frame)), Some(frame), "{dlc}");
            }
        }
    }

    /// Bytes that programs write beyond the length, and in unused places, are dropped.
    #[test]
    fn what_no_bus_carries_is_no_frame_and_bytes_beyond_the_length_are_left_out() {
        let beyond = bytes(0x123, [1, 9, 9, 9, 0x11, 9, 9, 9, 9, 9, 9, 9]);
        assert_eq!(frame_of(&beyond), Some("123#11".parse().unwrap()));
        assert_eq!(frame_of(&bytes(0x2000_0001, [8, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])), None);
        assert_eq!(frame_of(&bytes(0x123, [9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])), None);
    }

    #[test]
    fn fd_frames_are_canfd_frames_of_linux_and_bytes_beyond_the_length_are_left_out() {
        let raw = |id: u32, len: u8, flags: u8| {
            let mut raw: RawFdFrame = [7; 72];
            raw[..4].copy_from_slice(&id.to_ne_bytes());
            (raw[4], raw[5]) = (len, flags);
            fd_frame_of(&raw).map(|frame| frame.to_string())
        };
        assert_eq!(raw(0x123, 0, 0).as_deref(), Some("123##0"));
        assert_eq!(raw(0x98DA_F110, 2, 0x05).as_deref(), Some("18DAF110##10707"));
        assert_eq!(raw(0x7FF, 64, 2), Some(format!("7FF##2{}", "07".repeat(64))));
        for (id, len) in [(0x123, 9), (0x123, 65), (0x4000_0123, 0), (0x2000_0123, 8)] {
            assert_eq!(raw(id, len, 0), None, "{id:X} {len}");
        }
        let id = Id::extended(0x18DA_F110).unwrap();
        for len in cantap_trace::fd::FD_LENGTHS {
            let frame = FdFrame::new(id, len > 8, len < 8, &[0xA5; 64][..usize::from(len)]).unwrap();
            let raw = raw_fd_frame(&frame);
            assert_eq!((raw[4], raw[5] & 4), (len, 4));
            assert_eq!(fd_frame_of(&raw), Some(frame));
        }
    }

    #[test]
    fn errors_states_and_losses_are_error_frames_that_say_the_same() {
        for event in [
            TraceEvent::State { state: ErrorState::BusOff, counters: Some((255, 1)) },
            TraceEvent::BusError { kind: None, counters: None },
            TraceEvent::Lost { stage: Some(LossStage::Queue), count: 77, at_least: false },
        ] {
            let raw = raw_error(&event).unwrap();
            let id = u32::from_ne_bytes([raw[0], raw[1], raw[2], raw[3]]);
            assert_eq!((id & ERROR_FLAG, raw[4]), (ERROR_FLAG, 8));
            let data = std::array::from_fn(|at| raw[8 + at]);
            assert_eq!(ErrorFrame { classes: id & !ERROR_FLAG, data }.events(), (event, None));
        }
        let frame = TraceFrame::from("123#".parse::<Frame>().unwrap());
        let received = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        assert_eq!(raw_error(&received), None);
    }
}
