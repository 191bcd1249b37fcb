//! What crosses USB: Linux's `drivers/net/can/usb/gs_usb.c` and candleLight's `include/gs_usb.h`. Numbers have the lowest byte first.

use cantap_trace::TraceFrame;
use cantap_trace::fd::{FD_LENGTHS, FD_MAX_BYTES};
use cantap_trace::socketcan::{ERROR_FLAG, ErrorFrame};
use cantap_wire::record::ErrorState;
use cantap_wire::{FdFrame, Frame, Id};

use crate::bit_limits::{Limits, Timing};

/// Vendor requests to the interface.
pub(super) mod request {
    pub const HOST_FORMAT: u8 = 0;
    pub const BIT_TIMING: u8 = 1;
    pub const MODE: u8 = 2;
    pub const CONSTANTS: u8 = 4;
    pub const DEVICE_CONFIG: u8 = 5;
    pub const IDENTIFY: u8 = 7;
    pub const DATA_BIT_TIMING: u8 = 10;
    pub const EXTENDED_CONSTANTS: u8 = 11;
    pub const SET_TERMINATION: u8 = 12;
    pub const STATE: u8 = 14;
}

/// What a channel can do. The same bits switch most of it on with [`request::MODE`].
pub(super) mod feature {
    pub const LISTEN_ONLY: u32 = 1 << 0;
    pub const STAMPS: u32 = 1 << 4;
    pub const IDENTIFY: u32 = 1 << 5;
    pub const FD: u32 = 1 << 8;
    /// A transfer must not end with a packet of a certain length: one byte is added (an erratum of LPC546xx).
    pub const LPC546XX: u32 = 1 << 9;
    /// It answers [`super::request::EXTENDED_CONSTANTS`].
    pub const EXTENDED_CONSTANTS: u32 = 1 << 10;
    pub const TERMINATION: u32 = 1 << 11;
    pub const BUS_ERRORS: u32 = 1 << 12;
    pub const STATE: u32 = 1 << 13;
}

/// With this number the adapter learns in which order the host sends bytes; most ignore it.
pub(super) const HOST_FORMAT: [u8; 4] = 0x0000_BEEF_u32.to_le_bytes();
/// The echo's number of a frame that was received.
pub(super) const RECEIVED: u32 = u32::MAX;

const FLAG_OVERFLOW: u8 = 1;
const FLAG_FD: u8 = 2;
const FLAG_BRS: u8 = 4;
const FLAG_ESI: u8 = 8;
const EXTENDED: u32 = 1 << 31;
const REMOTE: u32 = 1 << 30;
/// Bytes before the data.
const HEADER: usize = 12;

/// Numbers of 32 bits.
pub(super) fn words(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

fn word(bytes: &[u8], index: usize) -> Option<u32> {
    bytes.get(4 * index..)?.first_chunk().map(|bytes| u32::from_le_bytes(*bytes))
}

/// The answer to [`request::DEVICE_CONFIG`]: the number of channels, and the firmware's version.
pub(super) fn device(bytes: &[u8]) -> Option<(u16, u32)> {
    Some((u16::from(*bytes.get(3)?) + 1, word(bytes, 1)?))
}

/// The answer to [`request::CONSTANTS`], and to [`request::EXTENDED_CONSTANTS`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Constants {
    pub features: u32,
    clock_hz: u32,
    nominal: Limits,
    data: Option<Limits>,
}

impl Constants {
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        Some(Self {
            features: word(bytes, 0)?,
            clock_hz: word(bytes, 1)?,
            nominal: limits(bytes, 2)?,
            data: limits(bytes, 10),
        })
    }

    pub const fn has(&self, feature: u32) -> bool {
        self.features & feature != 0
    }

    /// The request's data for a bit rate; `None` if this channel's clock cannot be divided to it. A sample point within what is possible.
    pub fn timing(&self, bitrate_bps: u32, sample_point_permille: u32) -> Option<Vec<u8>> {
        self.nominal.nominal(self.clock_hz, bitrate_bps, sample_point_permille).map(request_of)
    }

    /// The same for the data phases of CAN FD frames; `None` also if the channel has no CAN FD.
    pub fn data_timing(&self, bitrate_bps: u32) -> Option<Vec<u8>> {
        let limits = self.data.as_ref().filter(|_| self.has(feature::FD))?;
        limits.data(self.clock_hz, bitrate_bps).map(request_of)
    }
}

/// The limits that begin at the number with this index.
fn limits(bytes: &[u8], first: usize) -> Option<Limits> {
    let word = |index| word(bytes, first + index);
    Some(Limits {
        segment1: word(0)?..=word(1)?,
        segment2: word(2)?..=word(3)?,
        jump_width_max: word(4)?,
        prescaler: word(5)?..=word(6)?,
        prescaler_step: word(7)?,
    })
}

/// A request's data.
fn request_of(timing: Timing) -> Vec<u8> {
    let Timing { prescaler, segment1, segment2, jump_width } = timing;
    // The propagation segment is only a part of the first, and the adapter adds them up; neither may be 0.
    let propagation = segment1 / 2;
    words(&[propagation, segment1 - propagation, segment2, jump_width, prescaler])
}

/// The answer to [`request::STATE`]: the state, if the channel is started, and the transmit and the receive error counter.
pub(super) fn state(bytes: &[u8]) -> Option<(Option<ErrorState>, (u8, u8))> {
    let counter = |index| word(bytes, index).map(|count| count.min(255) as u8);
    let state = match word(bytes, 0)? {
        0 => Some(ErrorState::Active),
        1 => Some(ErrorState::Warning),
        2 => Some(ErrorState::Passive),
        3 => Some(ErrorState::BusOff),
        _ => None,
    };
    Some((state, (counter(2)?, counter(1)?)))
}

/// What a transfer contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Content {
    Frame(TraceFrame),
    Error(ErrorFrame),
    /// An identifier or a length that no frame has.
    Impossible,
}

/// A transfer from the adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Transfer {
    pub echo: u32,
    pub channel: u8,
    /// Frames before it are missing.
    pub overflow: bool,
    pub stamp_us: Option<u32>,
    pub content: Content,
}

/// Reads a transfer; `None` if it is too short for what it says to contain. `stamps`: they were asked for.
pub(super) fn transfer(bytes: &[u8], stamps: bool) -> Option<Transfer> {
    let (echo, id) = (word(bytes, 0)?, word(bytes, 1)?);
    let &[dlc, channel, flags, _] = bytes.get(8..HEADER)? else { return None };
    let is_fd = flags & FLAG_FD != 0;
    let data_len = if is_fd { 64 } else { 8 };
    let data = bytes.get(HEADER..HEADER + data_len)?;
    let stamp = bytes.get(HEADER + data_len..).and_then(|rest| word(rest, 0));
    let mut eight = [0; 8];
    eight.copy_from_slice(&data[..8]);
    let content = if id & ERROR_FLAG != 0 {
        Content::Error(ErrorFrame { classes: id & (ERROR_FLAG - 1), data: eight })
    } else {
        let raw = id & !(EXTENDED | REMOTE);
        let is_remote = id & REMOTE != 0;
        let id_of = if id & EXTENDED != 0 { Id::extended(raw) } else { Id::standard(raw) };
        let frame = match id_of {
            Some(id) if dlc < 16 && is_fd && !is_remote => {
                let (brs, esi) = (flags & FLAG_BRS != 0, flags & FLAG_ESI != 0);
                let len = usize::from(FD_LENGTHS[usize::from(dlc)]);
                FdFrame::new(id, brs, esi, &data[..len]).map(TraceFrame::Fd)
            }
            Some(id) if dlc < 16 && !is_fd => Some(Frame::from_bus(id, is_remote, dlc, eight).into()),
            _ => None,
        };
        frame.map_or(Content::Impossible, Content::Frame)
    };
    let overflow = flags & FLAG_OVERFLOW != 0;
    Some(Transfer { echo, channel, overflow, stamp_us: stamp.filter(|_| stamps), content })
}

/// A frame to be sent, whose echo will have this number.
pub(super) fn frame(frame: &Frame, channel: u8, echo: u32) -> Vec<u8> {
    let id = frame.id();
    let raw = id.raw() | u32::from(id.is_extended()) << 31 | u32::from(frame.is_remote()) << 30;
    let mut bytes = words(&[echo, raw]);
    bytes.extend_from_slice(&[frame.dlc(), channel, 0, 0]);
    bytes.extend_from_slice(&frame.padded_data());
    bytes
}

/// A CAN FD frame to be sent. It has room for all of its data, whatever its length.
pub(super) fn fd_frame(frame: &FdFrame, channel: u8, echo: u32) -> Vec<u8> {
    let id = frame.id();
    let flag = |is: bool, bit: u8| if is { bit } else { 0 };
    let flags = FLAG_FD | flag(frame.brs(), FLAG_BRS) | flag(frame.esi(), FLAG_ESI);
    let mut bytes = words(&[echo, id.raw() | if id.is_extended() { EXTENDED } else { 0 }]);
    bytes.extend_from_slice(&[frame.dlc(), channel, flags, 0]);
    bytes.extend_from_slice(frame.data());
    bytes.resize(HEADER + FD_MAX_BYTES, 0);
    bytes
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// candleLight's bxCAN at 48 MHz (`can_btconst` of `src/can/bxcan.c`).
    pub fn constants(features: u32) -> Vec<u8> {
        words(&[features, 48_000_000, 1, 16, 1, 8, 4, 1, 1024, 1])
    }

    #[test]
    fn a_bit_rate_is_reached_within_the_adapter_s_limits() {
        let can = Constants::parse(&constants(0)).unwrap();
        // 48 MHz by 6 is 16 quanta: 1 + 13 + 2, sampled at 87.5 %.
        assert_eq!(can.timing(500_000, 875), Some(words(&[6, 7, 2, 2, 6])));
        assert_eq!(can.timing(700_000, 875), None);
        // One whose prescalers are even, and whose segments are shorter.
        let narrow = words(&[0, 48_000_000, 1, 8, 1, 4, 1, 2, 64, 2]);
        let narrow = Constants::parse(&narrow).unwrap();
        let timing = narrow.timing(500_000, 875).unwrap();
        let word = |index| word(&timing, index).unwrap();
        let (segment1, prescaler) = (word(0) + word(1), word(4));
        assert_eq!(48_000_000 / prescaler / (1 + segment1 + word(2)), 500_000);
        assert!(prescaler % 2 == 0 && segment1 <= 8 && word(2) <= 4 && word(3) == 1);
        assert_eq!(Constants::parse(&constants(0)[..39]), None);
    }

    #[test]
    fn transfers_have_stamps_only_where_they_were_asked_for() {
        let mut bytes = words(&[RECEIVED, 0x9ABC_DEF0]);
        bytes.extend_from_slice(&[3, 1, FLAG_OVERFLOW, 0, 1, 2, 3, 0, 0, 0, 0, 0]);
        bytes.extend(words(&[77]));
        let frame = Content::Frame("1ABCDEF0#010203".parse().unwrap());
        let wanted =
            Transfer { echo: RECEIVED, channel: 1, overflow: true, stamp_us: Some(77), content: frame };
        assert_eq!(transfer(&bytes, true), Some(wanted));
        assert_eq!(transfer(&bytes, false), Some(Transfer { stamp_us: None, ..wanted }));
        for cut in 0..20 {
            assert_eq!(transfer(&bytes[..cut], true), None, "{cut}");
        }
        // A length that nothing has, an identifier that is too large, and CAN FD in as many bytes as a classic frame.
        let content = |at: usize, byte: u8| {
            let mut bytes = bytes.clone();
            bytes[at] = byte;
            transfer(&bytes, true).map(|transfer| transfer.content)
        };
        assert_eq!(content(8, 16), Some(Content::Impossible));
        assert_eq!(content(7, 0x1A), Some(Content::Impossible));
        assert_eq!(content(10, FLAG_FD), None);
    }

    #[test]
    fn a_frame_to_be_sent_comes_back_as_it_was() {
        for text in ["123#1122", "1ABCDEF0#R4", "000#"] {
            let sent: Frame = text.parse().unwrap();
            let bytes = frame(&sent, 1, 2);
            let back = transfer(&bytes, true).unwrap();
            assert_eq!((back.echo, back.channel, back.content), (2, 1, Content::Frame(sent.into())));
        }
    }

    #[test]
    fn a_can_fd_frame_to_be_sent_comes_back_as_it_was() {
        let id = Id::extended(0x1ABC_DEF0).unwrap();
        for len in FD_LENGTHS {
            let sent = FdFrame::new(id, len > 8, len == 64, &[0xA5; 64][..usize::from(len)]).unwrap();
            let bytes = fd_frame(&sent, 1, 2);
            assert_eq!(bytes.len(), 76);
            let back = transfer(&bytes, true).unwrap();
            assert_eq!((back.echo, back.channel, back.content), (2, 1, Content::Frame(sent.into())));
        }
    }

    proptest::proptest! {
        #[test]
        fn any_bytes_are_a_transfer_or_refused(bytes in proptest::collection::vec(0_u8.., 0..90), stamps: bool) {
            let _ = (transfer(&bytes, stamps), device(&bytes), state(&bytes));
            if let Some(constants) = Constants::parse(&bytes) {
                let _ = (constants.timing(500_000, 875), constants.data_timing(2_000_000));
            }
        }
    }
}
