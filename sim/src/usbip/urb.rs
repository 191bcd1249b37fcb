//! A transfer requested by the kernel, and its completion.

/// A transfer requested by the kernel.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Urb {
    /// Its number.
    pub seq: u32,
    /// bEndpointAddress; for endpoint 0, the data stage's direction.
    pub endpoint: u8,
    /// Bytes requested or carried.
    pub length: usize,
    /// Frames between two attempts on an interrupt endpoint; 0 on all others.
    pub interval: u32,
    /// A transfer that ends with a full packet is followed by an empty one.
    pub zero_packet: bool,
    /// The request, on endpoint 0.
    pub setup: [u8; 8],
    /// The data sent or received.
    pub data: Vec<u8>,
    /// How much of it has been sent.
    pub sent: usize,
    /// Unanswered attempts at the current packet.
    pub silences: u32,
}

impl Urb {
    /// Whether it is endpoint 0's.
    pub fn is_control(&self) -> bool {
        self.endpoint & !0x80 == 0
    }

    pub(super) fn is_input(&self) -> bool {
        self.endpoint & 0x80 != 0
    }
}

/// A transfer that has ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Completion {
    /// Its number.
    pub seq: u32,
    /// 0, or a negative error number.
    pub status: i32,
    /// Bytes moved.
    pub actual: usize,
    /// The bytes received.
    pub data: Vec<u8>,
}
