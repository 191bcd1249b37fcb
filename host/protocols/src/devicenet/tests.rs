use super::*;
use crate::testing::{self, at, hex, lost};

fn event_lines(frames: &[(f64, &str)]) -> Vec<String> {
    testing::event_lines(DeviceNet::new(), frames)
}

/// Slave 5, master 0.
#[test]
fn requests_and_responses_are_one_event() {
    for (frames, expected) in [
        (
            &[(0.0, "42C#000E010107"), (4.0, "42B#008E0564656D6F")][..],
            "devicenet 0 > 5 Get_Attribute_Single: service 0x0E, class 0x01 (Identity), instance 1, attribute 7, \
             value 05 64 65 6D 6F, after 4 ms",
        ),
        (
            &[(0.0, "42E#004B03010300"), (2.0, "42B#00CB00")],
            "devicenet 0 > 5 Allocate_Master/Slave_Connection_Set: service 0x4B, class 0x03 (DeviceNet), instance 1, \
             allocation 0x03 (explicit, polled), master 0, value 00, after 2 ms",
        ),
        (
            &[(0.0, "42C#0010050209E803"), (1.0, "42B#009409FF")],
            "devicenet 0 > 5 Set_Attribute_Single: service 0x10, class 0x05 (Connection), instance 2, attribute 9, set_to E8 03, \
             error 0x09 (invalid attribute value), additional 0xFF, after 1 ms",
        ),
        (
            &[(0.0, "42C#0005010100"), (3000.0, "000#")],
            "devicenet 0 > 5 Reset: service 0x05, class 0x01 (Identity), instance 1, parameters 00, response \"none\"; \
             nothing came for 2500 ms",
        ),
        (
            &[(0.0, "42F#00010078563412")],
            "devicenet 5 duplicate MAC ID check: physical_port 0, vendor 0x0001, serial_number 0x12345678",
        ),
        (
            &[(0.0, "42F#80010078563412")],
            "devicenet 5 the MAC ID is in use: physical_port 0, vendor 0x0001, serial_number 0x12345678",
        ),
        (&[(0.0, "42D#AA55")], "devicenet ? > 5 poll command: data AA 55"),
        (&[(0.0, "3C5#01")], "devicenet 5 poll response: data 01"),
        (
            &[(0.0, "42B#008E05")],
            "devicenet 5 > 0 Get_Attribute_Single: service 0x0E, value 05, request \"not heard\"",
        ),
    ] {
        assert_eq!(event_lines(frames), [expected], "{frames:?}");
    }
}

#[test]
fn fragments_are_put_together_and_what_is_missing_is_said() {
    let long: Vec<u8> = (0..30).collect();
    let mut frames = vec!["42C#0001020A".to_owned(), format!("42B#80008E{}", hex(&long[..5]))];
    for (at, chunk) in long[5..].chunks(6).enumerate() {
        let kind = if at == 4 { 0x80 } else { 0x40 };
        frames.push("42C#80C000".to_owned());
        frames.push(format!("42B#80{:02X}{}", kind | (at + 1), hex(chunk)));
    }
    let frames: Vec<String> = frames.iter().map(|frame| frame.replace("80008E", "800081")).collect();
    let records = |frames: &[String]| -> Vec<_> {
        frames.iter().enumerate().map(|(ms, frame)| at(ms as f64, frame)).collect()
    };
    let events = testing::events(DeviceNet::new(), &records(&frames));
    assert_eq!(events.len(), 1, "{events:?}");
    assert_eq!((&events[0].data[1..], events[0].trouble), (&long[..], None));
    let mut short = frames.clone();
    short.remove(5);
    let events = testing::events(DeviceNet::new(), &records(&short));
    assert_eq!(events[0].trouble, Some(Trouble::Sequence { expected: 2, got: 3 }), "{events:?}");
    let mut gap = records(&frames);
    gap.insert(4, lost(3.5));
    assert!(testing::events(DeviceNet::new(), &gap)[0].frames_lost);
}

/// Any frames are accepted without a panic.
#[test]
fn any_frames_are_taken() {
    let mut random = fastrand::Rng::with_seed(62_026);
    let mut assembler = DeviceNet::new();
    let mut events = Vec::new();
    for number in 0..300_000_u32 {
        let id = random.choice([0x42B, 0x42C, 0x42E, 0x42F, 0x42D, 0x3C5, 0x605, 0x7EF, 0x645]).unwrap();
        let mut bytes: Vec<u8> = (0..random.usize(0..=8)).map(|_| random.u8(..)).collect();
        if let Some(first) = bytes.first_mut() {
            *first &= 0x87;
        }
        assembler.take(&at(f64::from(number) / 20.0, &format!("{id:03X}#{}", hex(&bytes))), &mut events);
        for event in events.drain(..) {
            let _ = event.to_string();
        }
    }
    assembler.finish(&mut events);
}
