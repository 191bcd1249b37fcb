//! usbredir, version 0.7, as QEMU's `usb-redir` device speaks it (`usbredirproto.h`): all fields little-endian. The device is then on a
//! host controller that QEMU emulates, such as xHCI, and driven by the guest's own driver for that controller.

use std::collections::HashMap;
use std::io::{self, Read};

use super::exported::Exported;
use super::urb::{Completion, Urb};
use super::urbs::{EOVERFLOW, EPIPE};

const HELLO: u32 = 0;
const DEVICE_CONNECT: u32 = 1;
const RESET: u32 = 3;
const INTERFACE_INFO: u32 = 4;
const ENDPOINT_INFO: u32 = 5;
const SET_CONFIGURATION: u32 = 6;
const GET_CONFIGURATION: u32 = 7;
const CONFIGURATION_STATUS: u32 = 8;
const SET_ALT_SETTING: u32 = 9;
const GET_ALT_SETTING: u32 = 10;
const ALT_SETTING_STATUS: u32 = 11;
const START_INTERRUPTS: u32 = 15;
const STOP_INTERRUPTS: u32 = 16;
const INTERRUPTS_STATUS: u32 = 17;
const CANCEL: u32 = 21;
const CONTROL: u32 = 100;
const BULK: u32 = 101;
const INTERRUPT: u32 = 103;

const SUCCESS: u8 = 0;
const CANCELLED: u8 = 1;
const IO_ERROR: u8 = 3;
const STALL: u8 = 4;
const BABBLE: u8 = 6;

/// `device_connect` has a release, `ep_info` has sizes of packets, ids have 64 bits in all but the greeting, and lengths of bulk
/// transfers have 32. QEMU's xHCI accepts no device without the last three.
const CAPABILITIES: u32 = 1 << 1 | 1 << 4 | 1 << 5 | 1 << 6;
const FULL_SPEED: u8 = 1;
/// No endpoint in this place.
const NO_ENDPOINT: u8 = 255;
/// Places for interfaces and endpoints.
const PLACES: usize = 32;
/// Longest packet accepted. The kernel's drivers for serial ports ask for a few kilobytes.
const MAX_PACKET: usize = 1 << 17;

/// A packet from QEMU.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Packet {
    kind: u32,
    id: u64,
    body: Vec<u8>,
}

impl Packet {
    /// Reads one.
    pub fn read(from: &mut impl Read) -> io::Result<Self> {
        let mut head = [0; 8];
        from.read_exact(&mut head)?;
        let [k0, k1, k2, k3, l0, l1, l2, l3] = head;
        let (kind, length) =
            (u32::from_le_bytes([k0, k1, k2, k3]), u32::from_le_bytes([l0, l1, l2, l3]) as usize);
        let mut id = [0; 8];
        from.read_exact(if kind == HELLO { &mut id[..4] } else { &mut id })?;
        if length > MAX_PACKET {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "a packet of more than 128 KiB"));
        }
        let mut body = vec![0; length];
        from.read_exact(&mut body)?;
        Ok(Self { kind, id: u64::from_le_bytes(id), body })
    }
}

fn packet(kind: u32, id: u64, head: &[u8], data: &[u8]) -> Vec<u8> {
    let length = (head.len() + data.len()) as u32;
    let id = id.to_le_bytes();
    let id = if kind == HELLO { &id[..4] } else { &id };
    [&kind.to_le_bytes(), &length.to_le_bytes(), id, head, data].concat()
}

/// What a packet asks for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Action {
    /// A transfer.
    Submit(Urb),
    /// A transfer is withdrawn; if it is still pending, [`Redir::cancelled`] gives the answer.
    Unlink(u32),
    /// A reset of the port.
    Reset,
}

/// How a transfer was requested; its end is reported in the same way.
#[derive(Clone, Copy, Debug)]
enum Asked {
    Control([u8; 10]),
    Bulk { endpoint: u8, stream: [u8; 4] },
    Interrupts { endpoint: u8 },
    SetConfiguration(u8),
    GetConfiguration,
    SetAlt { interface: u8, alt: u8 },
    GetAlt { interface: u8 },
}

/// One connection.
#[derive(Debug)]
pub struct Redir {
    exported: Exported,
    last: u32,
    pending: HashMap<u32, (u64, Asked)>,
}

impl Redir {
    /// For a device.
    pub fn new(exported: Exported) -> Self {
        Self { exported, last: 0, pending: HashMap::new() }
    }

    /// How the device appears: a greeting, its interfaces and endpoints, and its connection.
    pub fn greeting(&self) -> Vec<u8> {
        let mut version = [0; 64];
        version[..10].copy_from_slice(b"cantap-sim");
        let mut classes = [[0; PLACES]; 4];
        let interfaces = self.exported.interfaces().as_chunks::<4>().0;
        for (n, interface) in interfaces.iter().take(PLACES).enumerate() {
            (classes[0][n], classes[1][n]) = (n as u8, interface[0]);
            (classes[2][n], classes[3][n]) = (interface[1], interface[2]);
        }
        let (mut kinds, mut intervals, mut owners) = ([NO_ENDPOINT; PLACES], [0; PLACES], [0; PLACES]);
        let mut sizes = [0_u8; 2 * PLACES];
        // Endpoint 0 is a control endpoint in both directions; IN endpoints are in the upper half.
        (kinds[0], kinds[PLACES / 2]) = (0, 0);
        for endpoint in self.exported.endpoints() {
            let at = usize::from(endpoint.address >> 3 & 0x10 | endpoint.address & 15);
            (kinds[at], intervals[at], owners[at]) = (endpoint.kind, endpoint.interval, endpoint.interface);
            sizes[2 * at..2 * at + 2].copy_from_slice(&(endpoint.packet as u16).to_le_bytes());
        }
        let device = self.exported.device();
        let identity = [FULL_SPEED, device[4], device[5], device[6]];
        [
            packet(HELLO, 0, &version, &CAPABILITIES.to_le_bytes()),
            packet(INTERFACE_INFO, 0, &(interfaces.len() as u32).to_le_bytes(), classes.as_flattened()),
            packet(ENDPOINT_INFO, 0, [kinds, intervals, owners].as_flattened(), &sizes),
            // Vendor, product and release, as the descriptor has them.
            packet(DEVICE_CONNECT, 0, &identity, &device[8..14]),
        ]
        .concat()
    }

    /// The transfer, with a number of this side's.
    fn numbered(&mut self, id: u64, asked: Asked, urb: Urb) -> Urb {
        self.last = self.last.wrapping_add(1);
        self.pending.insert(self.last, (id, asked));
        Urb { seq: self.last, ..urb }
    }

    fn request(&mut self, id: u64, asked: Asked, setup: [u8; 8]) -> Urb {
        let length = u16::from_le_bytes([setup[6], setup[7]]).into();
        self.numbered(id, asked, Urb { endpoint: setup[0] & 0x80, length, setup, ..Urb::default() })
    }

    fn poll(&mut self, id: u64, endpoint: u8) -> Option<Urb> {
        let known = self.exported.endpoints().iter().find(|known| known.address == endpoint)?;
        let urb =
            Urb { endpoint, length: known.packet, interval: known.interval.max(1).into(), ..Urb::default() };
        Some(self.numbered(id, Asked::Interrupts { endpoint }, urb))
    }

    /// What a packet asks for; `None` if it needs no answer or is not understood.
    pub fn take(&mut self, packet: Packet) -> Option<Action> {
        let Packet { kind, id, body } = packet;
        let urb = match (kind, &body[..]) {
            (RESET, _) => return Some(Action::Reset),
            (SET_CONFIGURATION, &[value, ..]) => {
                self.request(id, Asked::SetConfiguration(value), [0, 9, value, 0, 0, 0, 0, 0])
            }
            (GET_CONFIGURATION, _) => self.request(id, Asked::GetConfiguration, [0x80, 8, 0, 0, 0, 0, 1, 0]),
            (SET_ALT_SETTING, &[interface, alt, ..]) => {
                self.request(id, Asked::SetAlt { interface, alt }, [1, 11, alt, 0, interface, 0, 0, 0])
            }
            (GET_ALT_SETTING, &[interface, ..]) => {
                self.request(id, Asked::GetAlt { interface }, [0x81, 10, 0, 0, interface, 0, 1, 0])
            }
            (CONTROL, &[e, request, kind, s, v0, v1, i0, i1, l0, l1, ref data @ ..]) => {
                let setup = [kind, request, v0, v1, i0, i1, l0, l1];
                let length = u16::from_le_bytes([l0, l1]).into();
                let asked = Asked::Control([e, request, kind, s, v0, v1, i0, i1, l0, l1]);
                let data = data.to_vec();
                self.numbered(id, asked, Urb { endpoint: kind & 0x80, length, setup, data, ..Urb::default() })
            }
            // The upper half of the length comes after the stream.
            (BULK, &[endpoint, _, l0, l1, t0, t1, t2, t3, l2, l3, ref data @ ..]) => {
                let length = (u32::from_le_bytes([l0, l1, l2, l3]) as usize).min(MAX_PACKET);
                let asked = Asked::Bulk { endpoint, stream: [t0, t1, t2, t3] };
                self.numbered(id, asked, Urb { endpoint, length, data: data.to_vec(), ..Urb::default() })
            }
            (START_INTERRUPTS, &[endpoint, ..]) => self.poll(id, endpoint)?,
            (STOP_INTERRUPTS, &[endpoint, ..]) => {
                let polls =
                    |asked: &Asked| matches!(asked, Asked::Interrupts { endpoint: e } if *e == endpoint);
                let seq = self.pending.iter().find(|(_, (_, asked))| polls(asked)).map(|(seq, _)| *seq)?;
                self.pending.remove(&seq);
                return Some(Action::Unlink(seq));
            }
            (CANCEL, _) => {
                let found = self.pending.iter().find(|(_, (of, _))| *of == id);
                return found.map(|(seq, _)| Action::Unlink(*seq));
            }
            _ => return None,
        };
        Some(Action::Submit(urb))
    }

    /// The immediate answer to a packet that starts or stops interrupts.
    pub fn acknowledge(packet: &Packet) -> Option<Vec<u8>> {
        let answered = matches!(packet.kind, START_INTERRUPTS | STOP_INTERRUPTS);
        let endpoint = *packet.body.first().filter(|_| answered)?;
        Some(self::packet(INTERRUPTS_STATUS, packet.id, &[SUCCESS, endpoint], &[]))
    }

    /// A transfer was withdrawn before it ended.
    pub fn cancelled(&mut self, seq: u32) -> Vec<u8> {
        let Some((id, asked)) = self.pending.remove(&seq) else { return Vec::new() };
        answer(id, asked, CANCELLED, 0, &[])
    }

    /// A transfer has ended: what to send, and what to submit again.
    pub fn ended(&mut self, completion: &Completion) -> (Vec<u8>, Option<Urb>) {
        let Completion { seq, status, actual, data } = completion;
        let Some((id, asked)) = self.pending.remove(seq) else { return (Vec::new(), None) };
        let status = match *status {
            0 => SUCCESS,
            EPIPE => STALL,
            EOVERFLOW => BABBLE,
            _ => IO_ERROR,
        };
        let again = match asked {
            Asked::Interrupts { endpoint } if status == SUCCESS => self.poll(id.wrapping_add(1), endpoint),
            _ => None,
        };
        (answer(id, asked, status, *actual, data), again)
    }
}

fn answer(id: u64, asked: Asked, status: u8, actual: usize, data: &[u8]) -> Vec<u8> {
    let [l0, l1, l2, l3] = (actual as u32).to_le_bytes();
    let value = data.first().copied().unwrap_or(0);
    match asked {
        Asked::Control([e, request, kind, _, v0, v1, i0, i1, ..]) => {
            packet(CONTROL, id, &[e, request, kind, status, v0, v1, i0, i1, l0, l1], data)
        }
        Asked::Bulk { endpoint, stream: [t0, t1, t2, t3] } => {
            packet(BULK, id, &[endpoint, status, l0, l1, t0, t1, t2, t3, l2, l3], data)
        }
        Asked::Interrupts { endpoint } => packet(INTERRUPT, id, &[endpoint, status, l0, l1], data),
        Asked::SetConfiguration(set) => packet(CONFIGURATION_STATUS, id, &[status, set], &[]),
        Asked::GetConfiguration => packet(CONFIGURATION_STATUS, id, &[status, value], &[]),
        Asked::SetAlt { interface, alt } => packet(ALT_SETTING_STATUS, id, &[status, interface, alt], &[]),
        Asked::GetAlt { interface } => packet(ALT_SETTING_STATUS, id, &[status, interface, value], &[]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn redir() -> Redir {
        let device = [18, 1, 0, 2, 0xEF, 2, 1, 64, 9, 0x12, 1, 0, 3, 4, 1, 2, 3, 1];
        let configuration =
            [9, 2, 25, 0, 1, 1, 0, 0x80, 50, 9, 4, 0, 0, 1, 2, 2, 0, 0, 7, 5, 0x81, 3, 8, 0, 16];
        Redir::new(Exported::new(&device, &configuration).unwrap())
    }

    fn read(bytes: &[u8]) -> Packet {
        Packet::read(&mut &bytes[..]).unwrap()
    }

    #[test]
    fn a_device_is_introduced_in_the_order_that_qemu_needs() {
        let greeting = redir().greeting();
        let mut rest = &greeting[..];
        let packets: Vec<Packet> = (0..4).map(|_| Packet::read(&mut rest).unwrap()).collect();
        assert!(rest.is_empty());
        let kinds: Vec<(u32, usize)> =
            packets.iter().map(|packet| (packet.kind, packet.body.len())).collect();
        assert_eq!(kinds, [(0, 68), (4, 132), (5, 160), (1, 10)]);
        // Endpoint 81 is the 17th: interrupt, every 16 frames, of interface 0, 8 bytes.
        let info = &packets[2].body;
        assert_eq!((info[17], info[32 + 17], info[64 + 17], info[96 + 34], info[96 + 35]), (3, 16, 0, 8, 0));
        assert_eq!((info[0], info[1], info[16]), (0, NO_ENDPOINT, 0));
        assert_eq!(packets[3].body, [1, 0xEF, 2, 1, 9, 0x12, 1, 0, 3, 4]);
    }

    #[test]
    fn a_bulk_read_is_answered_under_its_number() {
        let mut redir = redir();
        let asked = packet(BULK, 77, &[0x82, 0, 128, 0, 0, 0, 0, 0, 0, 0], &[]);
        let Some(Action::Submit(urb)) = redir.take(read(&asked)) else { panic!() };
        assert_eq!((urb.endpoint, urb.length, urb.interval), (0x82, 128, 0));
        let end = Completion { seq: urb.seq, status: 0, actual: 3, data: vec![1, 2, 3] };
        let (answer, again) = redir.ended(&end);
        assert_eq!(answer, packet(BULK, 77, &[0x82, 0, 3, 0, 0, 0, 0, 0, 0, 0], &[1, 2, 3]));
        assert_eq!(again, None);
        assert!(redir.ended(&end).0.is_empty());
    }

    #[test]
    fn a_transfer_is_taken_back_by_its_number() {
        let mut redir = redir();
        let asked = packet(BULK, 78, &[0x82, 0, 128, 0, 0, 0, 0, 0, 0, 0], &[]);
        let Some(Action::Submit(urb)) = redir.take(read(&asked)) else { panic!() };
        assert_eq!(redir.take(read(&packet(CANCEL, 78, &[], &[]))), Some(Action::Unlink(urb.seq)));
        assert_eq!(
            redir.cancelled(urb.seq),
            packet(BULK, 78, &[0x82, CANCELLED, 0, 0, 0, 0, 0, 0, 0, 0], &[])
        );
        assert_eq!(redir.take(read(&packet(CANCEL, 79, &[], &[]))), None);
    }

    #[test]
    fn interrupts_are_polled_until_they_are_stopped() {
        let mut redir = redir();
        let start = read(&packet(START_INTERRUPTS, 5, &[0x81], &[]));
        assert_eq!(Redir::acknowledge(&start), Some(packet(INTERRUPTS_STATUS, 5, &[SUCCESS, 0x81], &[])));
        let Some(Action::Submit(urb)) = redir.take(start) else { panic!() };
        assert_eq!((urb.endpoint, urb.length, urb.interval), (0x81, 8, 16));
        let end = Completion { seq: urb.seq, status: 0, actual: 1, data: vec![9] };
        let (answer, again) = redir.ended(&end);
        assert_eq!(answer, packet(INTERRUPT, 5, &[0x81, SUCCESS, 1, 0], &[9]));
        let again = again.unwrap().seq;
        assert_eq!(redir.take(read(&packet(STOP_INTERRUPTS, 6, &[0x81], &[]))), Some(Action::Unlink(again)));
        assert!(redir.cancelled(again).is_empty());
    }

    #[test]
    fn a_refused_request_is_a_stall_and_a_configuration_is_a_request() {
        let mut redir = redir();
        let asked = packet(CONTROL, 8, &[0x80, 1, 0xC0, 0, 0, 0, 0, 0, 8, 0], &[]);
        let Some(Action::Submit(urb)) = redir.take(read(&asked)) else { panic!() };
        assert_eq!((urb.setup, urb.endpoint), ([0xC0, 1, 0, 0, 0, 0, 8, 0], 0x80));
        let (answer, _) = redir.ended(&Completion { seq: urb.seq, status: EPIPE, actual: 0, data: vec![] });
        assert_eq!(answer, packet(CONTROL, 8, &[0x80, 1, 0xC0, STALL, 0, 0, 0, 0, 0, 0], &[]));
        let Some(Action::Submit(urb)) = redir.take(read(&packet(SET_CONFIGURATION, 9, &[1], &[]))) else {
            panic!()
        };
        assert_eq!(urb.setup, [0, 9, 1, 0, 0, 0, 0, 0]);
        let (answer, _) = redir.ended(&Completion { seq: urb.seq, status: 0, actual: 0, data: vec![] });
        assert_eq!(answer, packet(CONFIGURATION_STATUS, 9, &[SUCCESS, 1], &[]));
    }
}
