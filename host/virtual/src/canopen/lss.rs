//! A slave of the layer setting services (CiA 305).

/// The node has no number so far.
pub const NO_NODE: u8 = 255;

/// What a command from the master changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// The node takes part with its new number.
    Node,
}

/// The slave.
#[derive(Debug)]
pub struct Slave {
    /// Vendor, product, revision, serial number.
    identity: [u32; 4],
    /// Its current number, and the one it will have.
    pub node: u8,
    pending: u8,
    configured: bool,
    /// How many of the four parts the master has named correctly, one after the other.
    selected: usize,
    identified: usize,
    /// How far the fast scan has got.
    scanned: u8,
}

const fn answer(service: u8, rest: [u8; 4]) -> [u8; 8] {
    let [a, b, c, d] = rest;
    [service, a, b, c, d, 0, 0, 0]
}

impl Slave {
    pub const fn new(identity: [u32; 4], node: u8) -> Self {
        Self { identity, node, pending: node, configured: false, selected: 0, identified: 0, scanned: 0 }
    }

    /// Takes a frame from the master; returns the answer and what changes.
    pub fn take(&mut self, bytes: [u8; 8]) -> (Option<[u8; 8]>, Option<Change>) {
        let value = u32::from_le_bytes([bytes[1], bytes[2], bytes[3], bytes[4]]);
        let said = match bytes[0] {
            0x04 => {
                self.configured = bytes[1] == 1;
                // A node without a number takes part once it is released with one.
                if !self.configured && self.node == NO_NODE && self.pending != NO_NODE {
                    self.node = self.pending;
                    return (None, Some(Change::Node));
                }
                None
            }
            part @ 0x40..=0x43 => {
                let place = usize::from(part - 0x40);
                let is_right = self.selected == place && self.identity[place] == value;
                self.selected =
                    if is_right { place + 1 } else { usize::from(place == 0 && self.identity[0] == value) };
                if self.selected == 4 {
                    (self.selected, self.configured) = (0, true);
                    Some(answer(0x44, [0; 4]))
                } else {
                    None
                }
            }
            part @ 0x46..=0x4B => {
                let place = usize::from(part - 0x46);
                let [vendor, product, revision, serial] = self.identity;
                let is_right = match place {
                    0 => vendor == value,
                    1 => product == value,
                    2 => revision >= value,
                    3 => revision <= value,
                    4 => serial >= value,
                    _ => serial <= value,
                };
                self.identified =
                    if is_right && (place == 0 || self.identified == place) { place + 1 } else { 0 };
                if self.identified == 6 { Some(answer(0x4F, [0; 4])) } else { None }
            }
            0x4C if self.node == NO_NODE => Some(answer(0x50, [0; 4])),
            0x51 if self.node == NO_NODE && !self.configured => {
                self.scan(value, bytes[5], bytes[6], bytes[7])
            }
            _ if !self.configured => None,
            0x11 => {
                let is_right = matches!(bytes[1], 1..=127 | NO_NODE);
                if is_right {
                    self.pending = bytes[1];
                }
                Some(answer(0x11, [u8::from(!is_right), 0, 0, 0]))
            }
            // Table 0, without its reserved entry. The simulated bus keeps its bit rate.
            0x13 => {
                Some(answer(0x13, [u8::from(bytes[1] != 0 || !matches!(bytes[2], 0..=4 | 6..=8)), 0, 0, 0]))
            }
            0x17 => Some(answer(0x17, [0; 4])),
            part @ 0x5A..=0x5D => Some(answer(part, self.identity[usize::from(part - 0x5A)].to_le_bytes())),
            0x5E => Some(answer(0x5E, [self.node, 0, 0, 0])),
            _ => None,
        };
        (said, None)
    }

    fn scan(&mut self, value: u32, unchecked: u8, part: u8, next: u8) -> Option<[u8; 8]> {
        if unchecked == 0x80 {
            self.scanned = 0;
            return Some(answer(0x4F, [0; 4]));
        }
        let own = *self.identity.get(usize::from(part))?;
        if part != self.scanned || unchecked > 31 || own >> unchecked != value >> unchecked {
            return None;
        }
        self.scanned = next;
        self.configured = unchecked == 0 && next < part;
        Some(answer(0x4F, [0; 4]))
    }

    /// The new number applies from the next reset.
    pub const fn reset(&mut self) {
        self.node = self.pending;
        self.configured = false;
    }
}
