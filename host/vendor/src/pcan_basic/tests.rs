use super::*;

#[test]
fn channels_have_the_numbers_of_the_header() {
    for (name, number) in [
        ("PCAN_USBBUS1", 0x51),
        ("PCAN_USBBUS8", 0x58),
        ("PCAN_USBBUS9", 0x509),
        ("PCAN_USBBUS16", 0x510),
        ("PCAN_PCIBUS1", 0x41),
        ("PCAN_PCIBUS9", 0x409),
        ("PCAN_PCIBUS16", 0x410),
        ("PCAN_LANBUS1", 0x801),
        ("PCAN_LANBUS16", 0x810),
    ] {
        let channel = Channel(number);
        assert_eq!(channel.to_string(), name);
        assert_eq!(name.parse(), Ok(channel));
        assert_eq!(name["PCAN_".len()..].to_lowercase().parse(), Ok(channel));
    }
    for text in ["", "PCAN_", "PCAN_USBBUS0", "PCAN_USBBUS17", "USB1"] {
        assert!(text.parse::<Channel>().is_err(), "{text}");
    }
}

#[test]
fn a_channel_s_information_is_laid_out_as_in_the_header() {
    use std::mem::offset_of;
    assert_eq!(size_of::<ChannelInformation>(), 52);
    assert_eq!(offset_of!(ChannelInformation, features), 4);
    assert_eq!(offset_of!(ChannelInformation, name), 8);
    assert_eq!(offset_of!(ChannelInformation, device_id), 44);
    assert_eq!(offset_of!(ChannelInformation, condition), 48);
}

#[test]
fn a_stamp_counts_its_milliseconds_rounds() {
    let stamp = ClassicStamp { millis: 7, millis_overflow: 2, micros: 999 };
    assert_eq!(stamp.micros(), (2 << 32) * 1000 + 7999);
}
