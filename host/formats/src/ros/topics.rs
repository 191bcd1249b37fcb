//! Topics as channels.

use cantap_trace::Direction;

use super::super::interfaces::Interfaces;

/// What a topic says about its frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Topic {
    pub channel: u8,
    pub direction: Direction,
}

/// Gives each bus a channel: the topics of what it received and of what is to be sent share it.
#[derive(Default)]
pub(crate) struct Topics(Interfaces);

impl Topics {
    /// By a topic's name, such as `/can1/received_messages` or `/from_can_bus`.
    pub(crate) fn topic(&mut self, name: &[u8]) -> Topic {
        let (bus, last) = match memchr::memrchr(b'/', name) {
            Some(at) => (&name[..at], &name[at + 1..]),
            None => (&name[..0], name),
        };
        let (bus, direction) = match last {
            b"received_messages" | b"from_can_bus" | b"from_can_bus_fd" => (bus, Direction::Rx),
            b"sent_messages" | b"to_can_bus" | b"to_can_bus_fd" => (bus, Direction::Tx),
            _ => (name, Direction::Rx),
        };
        Topic { channel: self.0.channel(bus), direction }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_topics_of_a_bus_share_its_channel() {
        let mut topics = Topics::default();
        for (name, channel, direction) in [
            ("/can1/received_messages", 2, Direction::Rx),
            ("/can1/sent_messages", 2, Direction::Tx),
            ("/can0/from_can_bus", 1, Direction::Rx),
            ("/to_can_bus", 3, Direction::Tx),
            ("from_can_bus_fd", 3, Direction::Rx),
            ("/vehicle/can_tx", 4, Direction::Rx),
        ] {
            assert_eq!(topics.topic(name.as_bytes()), Topic { channel, direction }, "{name}");
        }
    }
}
