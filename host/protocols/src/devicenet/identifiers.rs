//! The meaning of an identifier in the predefined master/slave connection set.

/// The use of an identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Use {
    /// I/O of the slave with this MAC ID: its kind, and whether the slave sends it.
    Io(u8, &'static str, bool),
    /// An explicit request to this slave.
    Request(u8),
    /// An explicit response from this slave.
    Response(u8),
    /// An explicit message of group 3 from this node.
    Peer(u8),
    /// A check whether another node has this MAC ID.
    DuplicateCheck(u8),
    /// Group 4, by message.
    Offline(u8),
}

/// Volume III of the CIP networks library, chapter 3.
pub const fn use_of(id: u16) -> Option<Use> {
    let low = (id & 0x3F) as u8;
    Some(match id {
        0..=0x3FF => match id >> 6 {
            0xC => Use::Io(low, "multicast poll response", true),
            0xD => Use::Io(low, "change of state or cyclic", true),
            0xE => Use::Io(low, "bit-strobe response", true),
            0xF => Use::Io(low, "poll response", true),
            _ => return None,
        },
        0x400..=0x5FF => {
            let node = (id >> 3 & 0x3F) as u8;
            match id & 7 {
                0 => Use::Io(node, "bit-strobe command", false),
                1 => Use::Io(node, "multicast poll command", false),
                2 => Use::Io(node, "acknowledgement of change of state", false),
                3 => Use::Response(node),
                4 | 6 => Use::Request(node),
                5 => Use::Io(node, "poll command", false),
                _ => Use::DuplicateCheck(node),
            }
        }
        0x600..=0x7BF => Use::Peer(low),
        0x7EC..=0x7EF => Use::Offline(low),
        _ => return None,
    })
}
