//! What Linux is asked to change about an interface (rtnetlink), as `ip link` writes it.

use std::io;

use super::link::{
    CAN_CTRLMODE_FD, CAN_CTRLMODE_LISTENONLY, CAN_CTRLMODE_LOOPBACK, HEADER, IFF_UP, IFLA_CAN_BITTIMING,
    IFLA_CAN_CTRLMODE, IFLA_CAN_DATA_BITTIMING, IFLA_CAN_RESTART, IFLA_CAN_RESTART_MS, IFLA_INFO_DATA,
    IFLA_INFO_KIND, IFLA_LINKINFO, NLM_F_REQUEST, NLMSG_ERROR, RTM_NEWLINK, SetUp, Timing, attribute,
    message, u16_at, u32_at,
};

const NLM_F_ACK: u16 = 4;
/// The modes that are set; others stay as their owner has set them.
pub(super) const MODES: u32 = CAN_CTRLMODE_LOOPBACK | CAN_CTRLMODE_LISTENONLY | CAN_CTRLMODE_FD;

/// Takes an interface up or down.
pub(super) fn up(index: u32, is_up: bool) -> Vec<u8> {
    let flags = if is_up { IFF_UP } else { 0 };
    message(RTM_NEWLINK, NLM_F_REQUEST | NLM_F_ACK, [index, flags, IFF_UP], &[])
}

/// Sets what a controller runs at; it must be down. Of `to.mode`, the [`MODES`] are set; a timing of zeros is left out.
pub(super) fn set(to: &SetUp, restart: bool) -> Vec<u8> {
    let mut data = Vec::new();
    for (kind, timing) in [(IFLA_CAN_BITTIMING, to.timing), (IFLA_CAN_DATA_BITTIMING, to.data_timing)] {
        if timing != Timing::default() {
            data.extend(attribute(kind, &bytes(&timing)));
        }
    }
    data.extend(attribute(IFLA_CAN_CTRLMODE, &bytes(&[MODES, to.mode & MODES])));
    if restart {
        data.extend(attribute(IFLA_CAN_RESTART_MS, &bytes(&[to.restart_ms])));
    }
    of_controller(to.index, &data)
}

/// Restarts a controller that is off its bus.
pub(super) fn restart(index: u32) -> Vec<u8> {
    of_controller(index, &attribute(IFLA_CAN_RESTART, &bytes(&[1])))
}

fn of_controller(index: u32, data: &[u8]) -> Vec<u8> {
    let kind = attribute(IFLA_INFO_KIND, b"can");
    let info = attribute(IFLA_LINKINFO, &[kind, attribute(IFLA_INFO_DATA, data)].concat());
    message(RTM_NEWLINK, NLM_F_REQUEST | NLM_F_ACK, [index, 0, 0], &info)
}

fn bytes(words: &[u32]) -> Vec<u8> {
    words.iter().copied().flat_map(u32::to_ne_bytes).collect()
}

/// What the kernel says of a change: its error, or that the bytes are no answer.
pub(super) fn acknowledged(answer: &[u8]) -> io::Result<()> {
    let code = u16_at(answer, 4).filter(|kind| *kind == NLMSG_ERROR).and_then(|_| u32_at(answer, HEADER));
    match code.map(|code| (code as i32).checked_neg()) {
        Some(Some(0)) => Ok(()),
        Some(Some(code)) => Err(io::Error::from_raw_os_error(code)),
        Some(None) | None => Err(io::ErrorKind::InvalidData.into()),
    }
}

#[cfg(all(test, target_endian = "little"))]
mod tests {
    use super::*;

    /// What `ip` of iproute2 6.1 sends for an interface with number 1 (read by a library before its `sendmsg`), without the number that it gives to the message.
    fn of_ip(hex: &str) -> Vec<u8> {
        let digits: Vec<u8> = hex.bytes().filter(|byte| !byte.is_ascii_whitespace()).collect();
        let byte = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
        let mut bytes: Vec<u8> = digits.chunks(2).map(byte).collect();
        bytes[8..12].fill(0);
        bytes
    }

    const ZEROS: &str = "00000000000000000000000000000000000000000000000000000000";

    #[test]
    fn an_interface_is_taken_up_as_ip_does() {
        let ip = of_ip("2000000010000500f6f80d6b0000000000000000010000000100000001000000");
        assert_eq!(up(1, true), ip);
        let down = up(1, false);
        assert_eq!(down[24..], *[&[0; 4][..], &[1, 0, 0, 0]].concat());
    }

    /// `ip link set lo type can bitrate 500000 listen-only on`. It leaves the other modes open, and this program does not.
    #[test]
    fn bit_rate_and_mode_are_set_as_by_ip() {
        let timing = [500_000, 0, 0, 0, 0, 0, 0, 0];
        let ours = set(&SetUp { index: 1, timing, mode: CAN_CTRLMODE_LISTENONLY, ..SetUp::default() }, false);
        let mut ip = of_ip(&format!(
            "6000000010000500f6f80d6b000000000000000001000000000000000000000040001200
             0700010063616e003400020024000100 20a10700 {ZEROS} 0c0005000200000002000000"
        ));
        let mask = ip.len() - 8;
        ip[mask] = MODES as u8;
        assert_eq!(ours, ip);
    }

    /// `ip link set lo type can bitrate 500000 sample-point 0.8 dbitrate 2000000 fd on`.
    #[test]
    fn a_sample_point_and_can_fd_are_set_as_by_ip() {
        let (mut timing, mut data_timing) = (Timing::default(), Timing::default());
        (timing[0], timing[1], data_timing[0]) = (500_000, 800, 2_000_000);
        let to = SetUp { index: 1, timing, data_timing, mode: CAN_CTRLMODE_FD, restart_ms: 0 };
        let mut ip = of_ip(&format!(
            "8400000010000500f6f80d6b000000000000000001000000000000000000000064001200
             0700010063616e005800020024000100 20a10700 20030000 {} 24000900 80841e00 {ZEROS} 0c0005002000000020000000",
            &ZEROS[8..]
        ));
        let mask = ip.len() - 8;
        ip[mask] = MODES as u8;
        assert_eq!(set(&to, false), ip);
    }

    /// `ip link set lo type can tq 125 prop-seg 6 phase-seg1 7 phase-seg2 2 sjw 1`, and with `restart-ms 100`.
    #[test]
    fn a_whole_timing_and_a_restart_are_set_as_by_ip() {
        let timing = [0, 0, 125, 6, 7, 2, 1, 0];
        let ours = set(&SetUp { index: 1, timing, restart_ms: 100, ..SetUp::default() }, true);
        let timing_of_ip = of_ip(
            "000000000000000000000000 2400010000000000000000007d0000000600000007000000020000000100000000000000",
        );
        assert!(ours.windows(36).any(|part| part == &timing_of_ip[12..]));
        let restart_of_ip = of_ip("000000000000000000000000 0800060064000000");
        assert!(ours.ends_with(&restart_of_ip[12..]));
    }

    #[test]
    fn a_restart_is_asked_for_as_by_ip() {
        let ip = of_ip(
            "3800000010000500f6f80d6b000000000000000001000000000000000000000018001200
             0700010063616e000c0002000800070001000000",
        );
        assert_eq!(restart(1), ip);
    }

    #[test]
    fn an_answer_is_the_kernel_s_word_or_none() {
        let answer = |code: i32| {
            let mut bytes = vec![0; 36];
            bytes[4..6].copy_from_slice(&NLMSG_ERROR.to_ne_bytes());
            bytes[16..20].copy_from_slice(&code.to_ne_bytes());
            acknowledged(&bytes)
        };
        assert!(answer(0).is_ok());
        assert_eq!(answer(-1).unwrap_err().raw_os_error(), Some(1));
        assert!(answer(i32::MIN).is_err());
        assert!(acknowledged(&[0; 36]).is_err() && acknowledged(&[]).is_err());
    }
}
