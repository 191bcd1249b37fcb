//! CAN FD, against a stand-in that does what firmwares with CAN FD do (candleLightFD, CANnectivity's `subsys/usb/gs_usb`).

use super::*;

const FD: u32 = EVERYTHING | feature::FD | feature::EXTENDED_CONSTANTS;
const FLAGS: (u8, u8, u8) = (2, 4, 8);

fn at(data_bitrate_bps: u32) -> Options {
    Options { data_bitrate_bps: Some(data_bitrate_bps), ..Options::default() }
}

/// A CAN FD frame from the bus.
fn transfer(stand_in: &StandIn, id: u32, dlc: u8, flags: u8, data: &[u8]) {
    let mut bytes = words(&[RECEIVED, id]);
    bytes.extend_from_slice(&[dlc, 0, flags, 0]);
    bytes.extend_from_slice(data);
    bytes.resize(12 + 64, 0xEE);
    let bytes = stand_in.stamped(bytes);
    stand_in.transfer(bytes);
}

#[test]
fn frames_of_all_lengths_arrive_with_their_flags_beside_classical_ones() {
    let (fd, brs, esi) = FLAGS;
    let stand_in = StandIn::new(FD, 1);
    let driver = connect(&stand_in, at(2_000_000)).unwrap();
    let device = Device::over(crate::engine::start(Box::new(driver)).unwrap(), "gs_usb:").unwrap();
    device.listen(Channel::Can1, 500_000).unwrap();
    assert_eq!(stand_in.requests(request::BIT_TIMING), [(0, words(&[6, 7, 2, 2, 6]))]);
    // 48 MHz is 24 quanta: 1 + 17 + 6, sampled at 75 %.
    assert_eq!(stand_in.requests(request::DATA_BIT_TIMING), [(0, words(&[8, 9, 6, 6, 1]))]);
    let flags = feature::LISTEN_ONLY | feature::STAMPS | feature::BUS_ERRORS | feature::FD;
    assert_eq!(stand_in.lock().started, [Some(flags), None]);
    let mut wanted = Vec::new();
    for (dlc, len) in cantap_trace::fd::FD_LENGTHS.into_iter().enumerate() {
        let data = vec![dlc as u8; len.into()];
        let digits = format!("{dlc:02X}").repeat(len.into());
        let (id, name) = if dlc % 2 == 0 { (0x123, "123") } else { (0x98DA_F110, "18DAF110") };
        transfer(&stand_in, id, dlc as u8, fd | if dlc % 2 == 0 { brs } else { esi }, &data);
        wanted.push((1, format!("{name}##{}{digits}", if dlc % 2 == 0 { 1 } else { 2 })));
    }
    stand_in.receive(0, "7FF#0102030405060708");
    wanted.push((1, "7FF#0102030405060708".to_owned()));
    let records = until(&device, "7FF#0102030405060708");
    assert_eq!(frames(&records), wanted);
    assert_eq!((losses(&records), device.counters().channels[0].received), (Vec::new(), 17));
}

#[test]
fn what_is_no_fd_frame_is_a_loss() {
    let (fd, ..) = FLAGS;
    let stand_in = StandIn::new(FD, 1);
    let driver = connect(&stand_in, at(2_000_000)).unwrap();
    let device = Device::over(crate::engine::start(Box::new(driver)).unwrap(), "gs_usb:").unwrap();
    device.listen(Channel::Can1, 500_000).unwrap();
    // A length code above 15, a remote frame, an identifier that is too large.
    transfer(&stand_in, 0x123, 16, fd, &[]);
    transfer(&stand_in, 0x4000_0123, 0, fd, &[]);
    transfer(&stand_in, 0x800, 0, fd, &[]);
    stand_in.receive(0, "7FF#");
    assert_eq!(losses(&until(&device, "7FF#")), [("link", 1); 3]);
}

#[test]
fn an_adapter_without_fd_or_without_that_data_bit_rate_is_refused_before_it_is_opened() {
    for (features, rate) in [(EVERYTHING, 2_000_000), (FD, 7_000_000)] {
        let stand_in = StandIn::new(features, 1);
        let Err(error) = connect(&stand_in, at(rate)) else { panic!("it was opened") };
        assert!(matches!(error, OpenError::NoDataBitRate { .. }), "{error}");
        assert!(stand_in.requests(request::MODE).iter().all(|(_, data)| data[..4] == [0; 4]));
    }
}

#[test]
fn without_a_data_bit_rate_fd_stays_off() {
    let stand_in = StandIn::new(FD, 1);
    let device = session(&stand_in);
    device.listen(Channel::Can1, 500_000).unwrap();
    let flags = feature::LISTEN_ONLY | feature::STAMPS | feature::BUS_ERRORS;
    assert_eq!(stand_in.lock().started, [Some(flags), None]);
    assert_eq!(stand_in.requests(request::DATA_BIT_TIMING), []);
}

#[test]
fn fd_frames_are_sent_with_their_flags_and_confirmed_by_their_echo() {
    let stand_in = StandIn::new(FD, 1);
    let driver = connect(&stand_in, at(2_000_000)).unwrap();
    let device = Device::over(crate::engine::start(Box::new(driver)).unwrap(), "gs_usb:").unwrap();
    device.join(Channel::Can1, 500_000).unwrap();
    let mut stream = cantap::transmit::Stream::new(&device);
    let long = format!("18DAF110##3{}", "A5".repeat(64));
    let texts = ["123##0", "123#11", "123##111223344556677889900AABB", &long, "7FF#R2"];
    for text in texts {
        let frame: cantap_trace::TraceFrame = text.parse().unwrap();
        stream.push(Channel::Can1, frame, None, |_| true).unwrap();
    }
    assert!(stream.finish(|_| true).unwrap());
    let ended: Vec<_> = stream.take_ended().iter().map(|end| end.result.unwrap().to_string()).collect();
    assert_eq!(ended, texts);
    // The stamp is the adapter's, as of a received frame.
    let records = until(&device, "7FF#R2");
    assert_eq!(frames(&records).into_iter().map(|(_, text)| text).collect::<Vec<_>>(), texts);
}

#[test]
fn without_a_data_bit_rate_no_fd_frame_is_sent() {
    let stand_in = StandIn::new(FD, 1);
    let device = session(&stand_in);
    assert!(!device.hello().sends_fd());
    device.join(Channel::Can1, 500_000).unwrap();
    let frame: cantap_trace::TraceFrame = "123##1AA".parse().unwrap();
    let mut stream = cantap::transmit::Stream::new(&device);
    let pushed = stream.push(Channel::Can1, frame, None, |_| true);
    assert!(matches!(pushed, Err(cantap::DeviceError::NoFd)), "{pushed:?}");
}
