//! Frames of the layer setting services (CiA 305).

use cantap_trace::Id;

/// The master's identifier.
pub const REQUEST: Id = Id::standard_truncated(0x7E5);
/// The slaves' identifier.
pub const RESPONSE: Id = Id::standard_truncated(0x7E4);
/// In place of a node's number: it has none.
pub const NO_NODE: u8 = 255;
/// In place of the number of bits in a fast scan: whoever has no number answers.
pub const WHOLE_SCAN: u8 = 0x80;

/// The four numbers of a node's address, which are those of its object 1018.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// The manufacturer's number.
    Vendor,
    /// The product code.
    Product,
    /// The revision.
    Revision,
    /// The serial number.
    Serial,
}

/// What an identification compares a part with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bound {
    /// The vendor must be this one.
    Vendor,
    /// The product must be this one.
    Product,
    /// The lowest revision.
    LowestRevision,
    /// The highest revision.
    HighestRevision,
    /// The lowest serial number.
    LowestSerial,
    /// The highest serial number.
    HighestSerial,
}

/// A frame from the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LssRequest {
    /// All slaves: 0 for the waiting state, 1 for configuration.
    SwitchGlobal(u8),
    /// The slave with this address, of which it names one part after the other.
    SwitchSelective(Part, u32),
    /// The node's number, 1 to 127, or [`NO_NODE`].
    ConfigureNode(u8),
    /// The bit rate by an index in a table; table 0 is CiA's.
    ConfigureBitTiming {
        /// The table.
        table: u8,
        /// The entry.
        index: u8,
    },
    /// All slaves change their bit rate: silent for this long before and after it, in milliseconds.
    ActivateBitTiming(u16),
    /// Keep number and bit rate.
    Store,
    /// Whoever is within all of these bounds answers.
    Identify(Bound, u32),
    /// Whoever has no number answers.
    IdentifyWithoutNumber,
    /// Whoever has no number and these bits in this part answers.
    FastScan {
        /// The part's value.
        value: u32,
        /// How many of its low bits are not compared, 0 to 31, or [`WHOLE_SCAN`].
        unchecked: u8,
        /// The part, 0 to 3.
        part: u8,
        /// The part that comes next.
        next: u8,
    },
    /// Asks for a part of the address.
    Inquire(Part),
    /// Asks for the number.
    InquireNode,
}

/// A frame from a slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LssResponse {
    /// It is the one that was selected.
    Selected,
    /// The outcome of a configuration.
    Outcome {
        /// What was asked for.
        service: Service,
        /// 0 for success.
        error: u8,
        /// The device's own reason, if `error` is FF.
        device_error: u8,
    },
    /// It is within the bounds, or has the bits of the fast scan.
    Identified,
    /// It has no number.
    WithoutNumber,
    /// A part of its address.
    Address(Part, u32),
    /// Its number.
    Node(u8),
}

/// Services with an outcome.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Service {
    /// Of the node's number.
    ConfigureNode = 0x11,
    /// Of the bit rate.
    ConfigureBitTiming = 0x13,
    /// Of storing both.
    Store = 0x17,
}

impl Service {
    /// The first byte of its request and of its outcome.
    pub const fn command(self) -> u8 {
        self as u8
    }
}

impl Part {
    /// In the order in which frames name them.
    pub const ALL: [Self; 4] = [Self::Vendor, Self::Product, Self::Revision, Self::Serial];

    fn of(command: u8, first: u8) -> Option<Self> {
        Self::ALL.get(usize::from(command.checked_sub(first)?)).copied()
    }
}

impl Bound {
    /// In the order in which frames name them.
    pub const ALL: [Self; 6] = [
        Self::Vendor,
        Self::Product,
        Self::LowestRevision,
        Self::HighestRevision,
        Self::LowestSerial,
        Self::HighestSerial,
    ];
}

const SELECT: u8 = 0x40;
const IDENTIFY: u8 = 0x46;
const INQUIRE: u8 = 0x5A;

impl LssRequest {
    /// The frame. Unused bytes are 0.
    pub fn encode(self) -> [u8; 8] {
        let word = |command: u8, value: u32| frame(command, &value.to_le_bytes());
        match self {
            Self::SwitchGlobal(mode) => frame(0x04, &[mode]),
            Self::SwitchSelective(part, value) => word(SELECT + part as u8, value),
            Self::ConfigureNode(node) => frame(0x11, &[node]),
            Self::ConfigureBitTiming { table, index } => frame(0x13, &[table, index]),
            Self::ActivateBitTiming(delay_ms) => frame(0x15, &delay_ms.to_le_bytes()),
            Self::Store => frame(0x17, &[]),
            Self::Identify(bound, value) => word(IDENTIFY + bound as u8, value),
            Self::IdentifyWithoutNumber => frame(0x4C, &[]),
            Self::FastScan { value, unchecked, part, next } => {
                let [a, b, c, d] = value.to_le_bytes();
                [0x51, a, b, c, d, unchecked, part, next]
            }
            Self::Inquire(part) => frame(INQUIRE + part as u8, &[]),
            Self::InquireNode => frame(0x5E, &[]),
        }
    }

    /// From a frame; `None` if its command is none of the master's, or if bytes are missing.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (&command, rest) = bytes.split_first()?;
        Some(match (command, rest) {
            (0x04, &[mode, ..]) => Self::SwitchGlobal(mode),
            (0x11, &[node, ..]) => Self::ConfigureNode(node),
            (0x13, &[table, index, ..]) => Self::ConfigureBitTiming { table, index },
            (0x15, &[low, high, ..]) => Self::ActivateBitTiming(u16::from_le_bytes([low, high])),
            (0x17, _) => Self::Store,
            (0x40..=0x43, _) => Self::SwitchSelective(Part::of(command, SELECT)?, word(rest)?),
            (0x46..=0x4B, _) => Self::Identify(Bound::ALL[usize::from(command - IDENTIFY)], word(rest)?),
            (0x4C, _) => Self::IdentifyWithoutNumber,
            (0x51, &[_, _, _, _, unchecked, part, next]) => {
                Self::FastScan { value: word(rest)?, unchecked, part, next }
            }
            (0x5A..=0x5D, _) => Self::Inquire(Part::of(command, INQUIRE)?),
            (0x5E, _) => Self::InquireNode,
            _ => return None,
        })
    }
}

impl LssResponse {
    /// The frame. Unused bytes are 0.
    pub fn encode(self) -> [u8; 8] {
        match self {
            Self::Selected => frame(0x44, &[]),
            Self::Outcome { service, error, device_error } => {
                frame(service.command(), &[error, device_error])
            }
            Self::Identified => frame(0x4F, &[]),
            Self::WithoutNumber => frame(0x50, &[]),
            Self::Address(part, value) => frame(INQUIRE + part as u8, &value.to_le_bytes()),
            Self::Node(node) => frame(0x5E, &[node]),
        }
    }

    /// From a frame; `None` if its command is none of the slaves', or if bytes are missing.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (&command, rest) = bytes.split_first()?;
        let outcome = |service: Service| match *rest {
            [error, device_error, ..] => Some(Self::Outcome { service, error, device_error }),
            _ => None,
        };
        Some(match (command, rest) {
            (0x11, _) => outcome(Service::ConfigureNode)?,
            (0x13, _) => outcome(Service::ConfigureBitTiming)?,
            (0x17, _) => outcome(Service::Store)?,
            (0x44, _) => Self::Selected,
            (0x4F, _) => Self::Identified,
            (0x50, _) => Self::WithoutNumber,
            (0x5A..=0x5D, _) => Self::Address(Part::of(command, INQUIRE)?, word(rest)?),
            (0x5E, &[node, ..]) => Self::Node(node),
            _ => return None,
        })
    }

    /// Whether it may be one to this request.
    pub fn answers(&self, request: &LssRequest) -> bool {
        match (self, request) {
            (Self::Selected, LssRequest::SwitchSelective(part, _)) => *part == Part::Serial,
            (Self::Identified, LssRequest::Identify(bound, _)) => *bound == Bound::HighestSerial,
            (Self::Identified, LssRequest::FastScan { .. } | LssRequest::IdentifyWithoutNumber)
            | (Self::WithoutNumber, LssRequest::IdentifyWithoutNumber)
            | (Self::Node(_), LssRequest::InquireNode) => true,
            (Self::Outcome { service, .. }, request) => matches!(
                (service, request),
                (Service::ConfigureNode, LssRequest::ConfigureNode(_))
                    | (Service::ConfigureBitTiming, LssRequest::ConfigureBitTiming { .. })
                    | (Service::Store, LssRequest::Store)
            ),
            (Self::Address(part, _), LssRequest::Inquire(asked)) => part == asked,
            _ => false,
        }
    }
}

fn frame(command: u8, rest: &[u8]) -> [u8; 8] {
    let mut frame = [0; 8];
    frame[0] = command;
    frame[1..=rest.len()].copy_from_slice(rest);
    frame
}

fn word(rest: &[u8]) -> Option<u32> {
    rest.first_chunk().map(|bytes| u32::from_le_bytes(*bytes))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn each_frame_has_its_bytes() {
        for (request, bytes) in [
            (LssRequest::SwitchGlobal(1), [0x04, 1, 0, 0, 0, 0, 0, 0]),
            (LssRequest::SwitchSelective(Part::Serial, 0x1234_5678), [0x43, 0x78, 0x56, 0x34, 0x12, 0, 0, 0]),
            (LssRequest::ConfigureNode(5), [0x11, 5, 0, 0, 0, 0, 0, 0]),
            (LssRequest::ConfigureBitTiming { table: 0, index: 2 }, [0x13, 0, 2, 0, 0, 0, 0, 0]),
            (LssRequest::ActivateBitTiming(300), [0x15, 0x2C, 1, 0, 0, 0, 0, 0]),
            (LssRequest::Store, [0x17, 0, 0, 0, 0, 0, 0, 0]),
            (LssRequest::Identify(Bound::HighestSerial, 1), [0x4B, 1, 0, 0, 0, 0, 0, 0]),
            (LssRequest::IdentifyWithoutNumber, [0x4C, 0, 0, 0, 0, 0, 0, 0]),
            (
                LssRequest::FastScan { value: 1, unchecked: 31, part: 2, next: 3 },
                [0x51, 1, 0, 0, 0, 31, 2, 3],
            ),
            (LssRequest::Inquire(Part::Product), [0x5B, 0, 0, 0, 0, 0, 0, 0]),
            (LssRequest::InquireNode, [0x5E, 0, 0, 0, 0, 0, 0, 0]),
        ] {
            assert_eq!(request.encode(), bytes);
            assert_eq!(LssRequest::decode(&bytes), Some(request));
        }
        let outcome = LssResponse::Outcome { service: Service::Store, error: 2, device_error: 0 };
        for (response, bytes) in [
            (LssResponse::Selected, [0x44, 0, 0, 0, 0, 0, 0, 0]),
            (outcome, [0x17, 2, 0, 0, 0, 0, 0, 0]),
            (LssResponse::Identified, [0x4F, 0, 0, 0, 0, 0, 0, 0]),
            (LssResponse::WithoutNumber, [0x50, 0, 0, 0, 0, 0, 0, 0]),
            (LssResponse::Address(Part::Vendor, 7), [0x5A, 7, 0, 0, 0, 0, 0, 0]),
            (LssResponse::Node(NO_NODE), [0x5E, 255, 0, 0, 0, 0, 0, 0]),
        ] {
            assert_eq!(response.encode(), bytes);
            assert_eq!(LssResponse::decode(&bytes), Some(response));
        }
        // What the master sends is nothing that a slave says, and the other way round.
        assert_eq!((LssResponse::decode(&[0x04, 1]), LssRequest::decode(&[0x4F])), (None, None));
        assert_eq!((LssRequest::decode(&[0x40, 1, 2, 3]), LssRequest::decode(&[])), (None, None));
    }

    #[test]
    fn answers_are_to_their_own_requests() {
        let scan = LssRequest::FastScan { value: 0, unchecked: WHOLE_SCAN, part: 0, next: 0 };
        assert!(LssResponse::Identified.answers(&scan));
        assert!(LssResponse::Selected.answers(&LssRequest::SwitchSelective(Part::Serial, 0)));
        assert!(!LssResponse::Selected.answers(&LssRequest::SwitchSelective(Part::Vendor, 0)));
        assert!(!LssResponse::Address(Part::Vendor, 0).answers(&LssRequest::Inquire(Part::Serial)));
        assert!(!LssResponse::Node(1).answers(&LssRequest::ConfigureNode(1)));
    }

    proptest! {
        #[test]
        fn what_was_decoded_is_encoded_with_the_same_meaning(bytes in proptest::collection::vec(any::<u8>(), 0..9)) {
            if let Some(request) = LssRequest::decode(&bytes) {
                prop_assert_eq!(LssRequest::decode(&request.encode()), Some(request));
            }
            if let Some(response) = LssResponse::decode(&bytes) {
                prop_assert_eq!(LssResponse::decode(&response.encode()), Some(response));
            }
        }
    }
}
