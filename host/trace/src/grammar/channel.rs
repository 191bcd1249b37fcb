//! Channels.

/// What an interface's name may begin with. The number after it counts from 0, a channel's from 1.
const INTERFACES: [&str; 4] = ["can", "vcan", "vxcan", "slcan"];

/// The number of a channel, from 1: as `1`, or as its interface, `can0`, which is channel 1 in every trace.
pub fn channel(text: &str) -> Option<u8> {
    let number =
        if text.bytes().all(|byte| byte.is_ascii_digit()) { text.parse().ok() } else { interface(text) };
    number.filter(|number| *number > 0)
}

/// The number of the channel that an interface's name means: `can0` is 1.
pub fn interface(text: &str) -> Option<u8> {
    let number = INTERFACES.iter().find_map(|letters| text.strip_prefix(letters))?;
    let plain = !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit());
    number.parse::<u8>().ok().filter(|_| plain)?.checked_add(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_is_a_number_or_an_interface() {
        assert_eq!(
            ["1", "255", "can0", "vcan1", "slcan9", "can254"].map(channel).map(Option::unwrap),
            [1, 255, 1, 2, 10, 255]
        );
        for text in ["", "0", "256", "can", "can255", "can-1", "can+1", "+1", "xcan0", "CAN", "both"] {
            assert_eq!(channel(text), None, "{text}");
        }
    }
}
