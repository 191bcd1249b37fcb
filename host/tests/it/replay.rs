//! A trace replayed on the virtual device.

use std::time::Duration;

use cantap::replay::{Accuracy, Pace, Replay};
use cantap::wire::message::{ChannelConfig, Mode};
use cantap::{Channel, Frame};

const CAN1: Channel = Channel::Can1;

#[test]
fn lateness_of_a_trace_out_of_order_is_measured_on_the_traces_own_schedule() {
    let device = cantap_virtual::open("load=0".parse().unwrap()).unwrap();
    let config =
        ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(device.timing(500_000).unwrap()) };
    device.open_channel(CAN1, Some(config)).unwrap();
    let mut replay = Replay::new(&device, Pace::default(), [500_000; 2]).unwrap();
    let frame: Frame = "123#11".parse().unwrap();
    for end_ms in [1_000, 500, 1_100, 1_050, 1_200] {
        assert!(replay.push(end_ms * 1_000_000, CAN1, frame, |_| true).unwrap());
    }
    assert!(replay.finish(|since| since < Duration::from_secs(10)).unwrap());
    assert!(replay.take_ended().iter().all(|end| end.result.is_ok()));
    let Accuracy { frames, early_us, late_us } = replay.accuracy();
    // The second starts after the first ends: half a second and a frame (57 bits and the intermission) late.
    assert_eq!(frames, 5);
    assert!((500_100.0..500_140.0).contains(&late_us) && early_us < 1.0, "{late_us} {early_us}");
}
