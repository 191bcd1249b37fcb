//! A device's channels.

/// One of the device's two CAN channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Channel {
    /// CAN1, called 1 in every user interface.
    Can1,
    /// CAN2, called 2 in every user interface.
    Can2,
}

/// Channels of a device.
pub const CHANNELS: usize = 2;

impl Channel {
    /// Both channels, in order.
    pub const ALL: [Channel; CHANNELS] = [Channel::Can1, Channel::Can2];

    /// 0 or 1, for indexing.
    pub const fn index(self) -> usize {
        self as usize
    }

    /// 1 or 2, as users count.
    pub const fn number(self) -> u8 {
        self as u8 + 1
    }

    /// The channel that users call `number`.
    pub const fn from_number(number: u8) -> Option<Self> {
        match number {
            1 => Some(Channel::Can1),
            2 => Some(Channel::Can2),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn users_count_from_one_and_tables_from_zero() {
        assert_eq!(Channel::ALL.map(Channel::number), [1, 2]);
        assert_eq!(Channel::ALL.map(Channel::index), [0, 1]);
        assert_eq!(
            [0, 1, 2, 3].map(Channel::from_number),
            [None, Some(Channel::Can1), Some(Channel::Can2), None]
        );
    }
}
