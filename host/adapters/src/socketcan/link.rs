//! What Linux says about a network interface (rtnetlink): `linux/rtnetlink.h`, `linux/if_link.h`, `linux/can/netlink.h`.

use std::io;

use cantap_wire::record::ErrorState;

/// `ARPHRD_CAN` of `linux/if_arp.h`.
const ARPHRD_CAN: u16 = 280;
/// Flags of an interface (`linux/if.h`).
pub(super) const IFF_UP: u32 = 1;
const IFF_ECHO: u32 = 1 << 18;

// Messages and flags of `linux/netlink.h` and `linux/rtnetlink.h`.
pub(super) const NLMSG_ERROR: u16 = 2;
pub(super) const RTM_NEWLINK: u16 = 16;
const RTM_GETLINK: u16 = 18;
pub(super) const NLM_F_REQUEST: u16 = 1;
/// Bytes of a message's header, and of `struct ifinfomsg` after it.
pub(super) const HEADER: usize = 16;
const INFO: usize = 16;
/// Bytes of a CAN FD frame: an interface that takes them has at least this MTU (`linux/can.h`).
const CANFD_MTU: u32 = 72;
/// What the two flags in an attribute's type leave.
const TYPE_MASK: u16 = 0x3FFF;

const IFLA_IFNAME: u16 = 3;
const IFLA_MTU: u16 = 4;
pub(super) const IFLA_LINKINFO: u16 = 18;
const IFLA_STATS64: u16 = 23;
pub(super) const IFLA_INFO_KIND: u16 = 1;
pub(super) const IFLA_INFO_DATA: u16 = 2;
pub(super) const IFLA_CAN_BITTIMING: u16 = 1;
const IFLA_CAN_STATE: u16 = 4;
pub(super) const IFLA_CAN_CTRLMODE: u16 = 5;
pub(super) const IFLA_CAN_RESTART_MS: u16 = 6;
pub(super) const IFLA_CAN_RESTART: u16 = 7;
const IFLA_CAN_BERR_COUNTER: u16 = 8;
pub(super) const IFLA_CAN_DATA_BITTIMING: u16 = 9;
pub(super) const CAN_CTRLMODE_LOOPBACK: u32 = 1;
pub(super) const CAN_CTRLMODE_LISTENONLY: u32 = 2;
pub(super) const CAN_CTRLMODE_FD: u32 = 0x20;

/// Places in `struct rtnl_link_stats64`, in 64-bit numbers.
const RX_DROPPED: usize = 6;
const RX_OVER_ERRORS: usize = 11;
const RX_FIFO_ERRORS: usize = 14;
const RX_MISSED_ERRORS: usize = 15;

/// An interface.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Link {
    /// It is a CAN interface.
    pub is_can: bool,
    pub is_up: bool,
    /// Its driver shows a frame to its sender once it was on the bus.
    pub echoes: bool,
    /// Its kind as `ip link` has it: `can` for one with a controller, `vcan`, `vxcan`; empty if there is none.
    pub kind: String,
    /// In bit/s, if it is set and known.
    pub bitrate_bps: Option<u32>,
    /// Of the data phases of CAN FD frames, in bit/s, if CAN FD is on.
    pub data_bitrate_bps: Option<u32>,
    /// It takes CAN FD frames: with a controller, if its owner has switched that on.
    pub takes_fd: bool,
    pub listen_only: bool,
    /// `None` for a controller that is stopped, and where there is none.
    pub state: Option<ErrorState>,
    /// Transmit and receive error counter.
    pub counters: Option<(u8, u8)>,
    /// Overruns in the controller and the driver, each of at least one frame.
    pub overruns: u64,
    /// Frames that the driver or the kernel has dropped on the way to all programs.
    pub dropped: u64,
    pub set_up: SetUp,
}

/// `struct can_bittiming` of `linux/can/netlink.h`: bit rate, sample point in thousandths, the quantum in ns, three segments, jump width, prescaler.
pub(crate) type Timing = [u32; 8];

/// How an interface is set up, in the kernel's own terms: what it takes to put that back.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct SetUp {
    /// The kernel's number of the interface.
    pub index: u32,
    /// Zeros if it was never set.
    pub timing: Timing,
    /// Of data phases; zeros if it was never set.
    pub data_timing: Timing,
    /// `CAN_CTRLMODE_`…
    pub mode: u32,
    /// Milliseconds from bus-off to a restart; 0 if there is none.
    pub restart_ms: u32,
}

/// A message about an interface: `struct ifinfomsg` with number, flags and which of them are meant; and attributes.
pub(super) fn message(kind: u16, flags: u16, info: [u32; 3], attributes: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(HEADER + INFO + attributes.len());
    bytes.extend_from_slice(&((HEADER + INFO + attributes.len()) as u32).to_ne_bytes());
    bytes.extend_from_slice(&kind.to_ne_bytes());
    bytes.extend_from_slice(&flags.to_ne_bytes());
    // The message's number and its sender's port, and what is left open of the kind of the interface.
    bytes.extend_from_slice(&[0; 8 + 4]);
    bytes.extend(info.into_iter().flat_map(u32::to_ne_bytes));
    bytes.extend_from_slice(attributes);
    bytes
}

/// An attribute: length, type, content, padded to four bytes.
pub(super) fn attribute(kind: u16, content: &[u8]) -> Vec<u8> {
    let mut bytes = ((4 + content.len()) as u16).to_ne_bytes().to_vec();
    bytes.extend_from_slice(&kind.to_ne_bytes());
    bytes.extend_from_slice(content);
    bytes.resize(bytes.len().next_multiple_of(4), 0);
    bytes
}

/// The request for an interface of this name.
pub(crate) fn request(name: &str) -> Vec<u8> {
    let name = attribute(IFLA_IFNAME, &[name.as_bytes(), &[0]].concat());
    message(RTM_GETLINK, NLM_F_REQUEST, [0; 3], &name)
}

/// The answer. An error is the kernel's (ENODEV: there is no such interface), or that the bytes are no answer.
pub(crate) fn answer(bytes: &[u8]) -> io::Result<Link> {
    parse(bytes).unwrap_or_else(|| Err(io::ErrorKind::InvalidData.into()))
}

fn parse(bytes: &[u8]) -> Option<io::Result<Link>> {
    let len = u32_at(bytes, 0)? as usize;
    let message = bytes.get(HEADER..len)?;
    match u16_at(bytes, 4)? {
        NLMSG_ERROR => {
            let code = u32_at(message, 0)? as i32;
            Some(Err(io::Error::from_raw_os_error(code.checked_neg()?)))
        }
        RTM_NEWLINK => {
            let flags = u32_at(message, 8)?;
            let mut link = Link {
                is_can: u16_at(message, 2)? == ARPHRD_CAN,
                is_up: flags & IFF_UP != 0,
                echoes: flags & IFF_ECHO != 0,
                set_up: SetUp { index: u32_at(message, 4)?, ..SetUp::default() },
                ..Link::default()
            };
            for (kind, content) in Attributes(message.get(INFO..)?) {
                match kind {
                    IFLA_LINKINFO => link.info(content),
                    IFLA_MTU => link.takes_fd = u32_at(content, 0).is_some_and(|mtu| mtu >= CANFD_MTU),
                    IFLA_STATS64 => {
                        let figure = |at| u64_at(content, at).unwrap_or(0);
                        link.dropped = figure(RX_DROPPED);
                        link.overruns = [RX_OVER_ERRORS, RX_FIFO_ERRORS, RX_MISSED_ERRORS]
                            .into_iter()
                            .fold(0, |sum, at| sum.saturating_add(figure(at)));
                    }
                    _ => {}
                }
            }
            Some(Ok(link))
        }
        _ => None,
    }
}

impl Link {
    fn info(&mut self, bytes: &[u8]) {
        for (kind, content) in Attributes(bytes) {
            match kind {
                IFLA_INFO_KIND => {
                    String::from_utf8_lossy(content).trim_end_matches('\0').clone_into(&mut self.kind);
                }
                IFLA_INFO_DATA => self.controller(content),
                _ => {}
            }
        }
    }

    fn controller(&mut self, bytes: &[u8]) {
        let rate = |content| u32_at(content, 0).filter(|rate| (1..u32::MAX).contains(rate));
        let timing = |content| std::array::from_fn(|at| u32_at(content, 4 * at).unwrap_or(0));
        let (mut data_bitrate_bps, mut has_fd) = (None, false);
        for (kind, content) in Attributes(bytes) {
            match kind {
                IFLA_CAN_BITTIMING => {
                    self.bitrate_bps = rate(content);
                    self.set_up.timing = timing(content);
                }
                IFLA_CAN_DATA_BITTIMING => {
                    data_bitrate_bps = rate(content);
                    self.set_up.data_timing = timing(content);
                }
                IFLA_CAN_RESTART_MS => self.set_up.restart_ms = u32_at(content, 0).unwrap_or(0),
                IFLA_CAN_STATE => {
                    self.state = match u32_at(content, 0) {
                        Some(0) => Some(ErrorState::Active),
                        Some(1) => Some(ErrorState::Warning),
                        Some(2) => Some(ErrorState::Passive),
                        Some(3) => Some(ErrorState::BusOff),
                        _ => None,
                    };
                }
                // The mask, and the flags.
                IFLA_CAN_CTRLMODE => {
                    let flags = u32_at(content, 4).unwrap_or(0);
                    self.listen_only = flags & CAN_CTRLMODE_LISTENONLY != 0;
                    has_fd = flags & CAN_CTRLMODE_FD != 0;
                    self.set_up.mode = flags;
                }
                IFLA_CAN_BERR_COUNTER => {
                    let counter = |at| u16_at(content, at).map(|count| count.min(255) as u8);
                    self.counters = counter(0).zip(counter(2));
                }
                _ => {}
            }
        }
        self.data_bitrate_bps = data_bitrate_bps.filter(|_| has_fd);
    }
}

/// Attributes one after the other: length, type, content, padded to four bytes.
struct Attributes<'b>(&'b [u8]);

impl<'b> Iterator for Attributes<'b> {
    type Item = (u16, &'b [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        let len = usize::from(u16_at(self.0, 0)?);
        let kind = u16_at(self.0, 2)? & TYPE_MASK;
        let content = self.0.get(4..len)?;
        self.0 = self.0.get(len.next_multiple_of(4)..).unwrap_or_default();
        Some((kind, content))
    }
}

pub(super) fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    bytes.get(at..)?.first_chunk().map(|bytes| u16::from_ne_bytes(*bytes))
}

pub(super) fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..)?.first_chunk().map(|bytes| u32::from_ne_bytes(*bytes))
}

fn u64_at(bytes: &[u8], index: usize) -> Option<u64> {
    bytes.get(8 * index..)?.first_chunk().map(|bytes| u64::from_ne_bytes(*bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A message with any content.
    fn raw(kind: u16, content: &[u8]) -> Vec<u8> {
        let mut bytes = ((HEADER + content.len()) as u32).to_ne_bytes().to_vec();
        bytes.extend_from_slice(&kind.to_ne_bytes());
        bytes.extend_from_slice(&[0; 10]);
        bytes.extend_from_slice(content);
        bytes
    }

    fn words(words: &[u32]) -> Vec<u8> {
        words.iter().flat_map(|word| word.to_ne_bytes()).collect()
    }

    /// An interface with these flags and attributes.
    fn link(flags: u32, attributes: &[Vec<u8>]) -> Vec<u8> {
        let mut content = vec![0, 0];
        content.extend_from_slice(&ARPHRD_CAN.to_ne_bytes());
        content.extend_from_slice(&words(&[7, flags, 0]));
        content.extend(attributes.concat());
        raw(RTM_NEWLINK, &content)
    }

    /// A controller's interface that only listens, with everything that `ip -details -statistics link` prints.
    fn controller(fd: u32) -> Vec<u8> {
        let nested = |kind: u16, parts: &[Vec<u8>]| attribute(kind | 0x8000, &parts.concat());
        let mut stats = vec![0_u8; 25 * 8];
        for (at, figure) in [(RX_DROPPED, 5_u64), (RX_OVER_ERRORS, 7), (RX_FIFO_ERRORS, 1)] {
            stats[8 * at..8 * at + 8].copy_from_slice(&figure.to_ne_bytes());
        }
        let counters: Vec<u8> = [130_u16, 300].iter().flat_map(|count| count.to_ne_bytes()).collect();
        let data = nested(
            IFLA_INFO_DATA,
            &[
                attribute(IFLA_CAN_BITTIMING, &words(&[500_000, 875, 125, 6, 7, 2, 1, 6])),
                attribute(IFLA_CAN_CTRLMODE, &words(&[0, CAN_CTRLMODE_LISTENONLY | 0x10 | fd])),
                attribute(IFLA_CAN_DATA_BITTIMING, &words(&[2_000_000, 750, 25, 7, 7, 5, 1, 1])),
                attribute(IFLA_CAN_STATE, &words(&[2])),
                attribute(IFLA_CAN_RESTART_MS, &words(&[100])),
                attribute(IFLA_CAN_BERR_COUNTER, &counters),
            ],
        );
        link(
            IFF_UP | IFF_ECHO,
            &[
                attribute(IFLA_IFNAME, b"can0\0"),
                // `CAN_MTU`, or `CANFD_MTU` as the driver sets it.
                attribute(IFLA_MTU, &words(&[if fd == 0 { 16 } else { 72 }])),
                attribute(IFLA_STATS64, &stats),
                nested(IFLA_LINKINFO, &[attribute(IFLA_INFO_KIND, b"can\0"), data]),
            ],
        )
    }

    #[test]
    fn a_controller_s_rate_mode_state_counters_and_losses_are_read() {
        let read = answer(&controller(CAN_CTRLMODE_FD)).unwrap();
        let wanted = Link {
            is_can: true,
            is_up: true,
            echoes: true,
            kind: "can".to_owned(),
            bitrate_bps: Some(500_000),
            data_bitrate_bps: Some(2_000_000),
            takes_fd: true,
            listen_only: true,
            state: Some(ErrorState::Passive),
            counters: Some((130, 255)),
            overruns: 8,
            dropped: 5,
            set_up: SetUp {
                index: 7,
                timing: [500_000, 875, 125, 6, 7, 2, 1, 6],
                data_timing: [2_000_000, 750, 25, 7, 7, 5, 1, 1],
                mode: 0x32,
                restart_ms: 100,
            },
        };
        assert_eq!(read, wanted);
        // A data bit rate that was set once says nothing while CAN FD is off.
        let classical = answer(&controller(0)).unwrap();
        let set_up = SetUp { mode: 0x12, ..wanted.set_up };
        assert_eq!(classical, Link { data_bitrate_bps: None, takes_fd: false, set_up, ..wanted });
    }

    #[test]
    fn a_virtual_interface_has_neither_rate_nor_state() {
        let kind = attribute(IFLA_INFO_KIND, b"vcan\0");
        let read = answer(&link(0, &[attribute(IFLA_LINKINFO, &kind)])).unwrap();
        let set_up = SetUp { index: 7, ..SetUp::default() };
        let wanted = Link { is_can: true, kind: "vcan".to_owned(), set_up, ..Link::default() };
        assert_eq!(read, wanted);
    }

    #[test]
    fn an_interface_that_is_not_there_is_the_kernel_s_error() {
        const ENODEV: i32 = 19;
        let error = answer(&raw(NLMSG_ERROR, &(-ENODEV).to_ne_bytes())).unwrap_err();
        assert_eq!(error.raw_os_error(), Some(ENODEV));
    }

    #[test]
    fn a_request_names_the_interface() {
        let bytes = request("can0");
        assert_eq!(bytes.len(), 44);
        assert_eq!(bytes[..8], *[&words(&[44])[..], &18_u16.to_ne_bytes(), &1_u16.to_ne_bytes()].concat());
        assert_eq!(bytes[32..], *[&9_u16.to_ne_bytes()[..], &3_u16.to_ne_bytes(), b"can0\0\0\0\0"].concat());
    }

    proptest::proptest! {
        #[test]
        fn an_answer_that_is_cut_or_garbled_is_read_or_refused(cut in 0_usize..600, at in 0_usize..600, byte: u8) {
            let mut bytes = controller(0);
            bytes.truncate(cut);
            if let Some(there) = bytes.get_mut(at) {
                *there = byte;
            }
            let _ = answer(&bytes);
        }
    }
}
