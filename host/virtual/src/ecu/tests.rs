//! The ECU as a master finds it.

use super::*;
use cantap_protocols::a2l::Description;

fn ask(bus: &mut EcuBus, now_ns: &mut u64, data: &[u8]) -> Vec<u8> {
    bus.hear(&frame(XCP[0], data), *now_ns);
    *now_ns += MS_NS;
    let answer = bus.bid(*now_ns).expect("an answer");
    bus.take(*now_ns);
    answer.data().to_vec()
}

#[test]
fn the_description_is_that_of_the_memory() {
    let description = Description::parse(DESCRIPTION).unwrap().remove(0);
    assert_eq!(description.issues, [""; 0]);
    let mut ecu = Ecu::new();
    ecu.measure(3 * HALF_PERIOD_MS / 2 * MS_NS);
    let fields = |at, length| {
        let bytes = ecu.read(0, at, length).unwrap();
        let fields = description.fields(0, at, &bytes, None);
        fields.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    assert_eq!(
        fields(MEASURED_AT, 14),
        [
            "EngineSpeed 3800 rpm",
            "CoolantTemperature 100 degC",
            "Gear 3 (third)",
            "Torque 180 Nm",
            "Uptime 3000 ms",
            "FanOn 1 (on)",
            "LampOn 1 (on)",
            "PedalVoltage 4.5 V"
        ]
    );
    assert_eq!(
        fields(PARAMETERS_AT, 16),
        ["IdleSpeed 800 rpm", "FanThreshold 90 degC", "TorqueFactor 1", "Program \"CANTAP01\""]
    );
    assert_eq!(
        fields(PARAMETERS_AT + 40, 8),
        [
            "Cylinder[0].Offset -1 deg",
            "Cylinder[0].Limits[0] 10 %",
            "Cylinder[0].Limits[1] 20 %",
            "Cylinder[1].Offset 1.5 deg",
            "Cylinder[1].Limits[0] 30 %",
            "Cylinder[1].Limits[1] 40 %"
        ]
    );
    // Of the map, what is where it is however many points its axes have.
    let known =
        ["TorqueMap.NO_AXIS_PTS_X 3", "TorqueMap.NO_AXIS_PTS_Y 2", "TorqueMap.AXIS_PTS_X[0] 1000 rpm"];
    assert_eq!(fields(PARAMETERS_AT + 16, 4), known);
    for object in description.objects() {
        assert!(ecu.read(0, object.address, object.size()).is_some(), "{}", object.name);
    }
}

#[test]
fn it_answers_and_samples_until_it_is_disconnected() {
    let (mut bus, mut now_ns) = (EcuBus::in_use(), MS_NS);
    bus.hear(&frame(XCP[0], &[0xFD]), now_ns);
    assert_eq!(bus.due(now_ns), None, "nobody is connected");
    assert_eq!(ask(&mut bus, &mut now_ns, &[0xFF, 0]), [0xFF, 0x05, 0xC0, 8, 8, 0, 1, 1]);
    assert_eq!(ask(&mut bus, &mut now_ns, &[0xF4, 2, 0, 0, 0, 0, 0, 0x30]), [0xFF, 0x80, 0x0C]);
    assert_eq!(ask(&mut bus, &mut now_ns, &[0xF6, 0, 0, 0, 0, 0, 0, 0x30]), [0xFF]);
    assert_eq!(ask(&mut bus, &mut now_ns, &[0xF0, 2, 0xA0, 0x0F]), [0xFF]);
    assert_eq!(ask(&mut bus, &mut now_ns, &[0xF4, 2, 0, 0, 0, 0, 0, 0x30]), [0xFF, 0xA0, 0x0F]);
    let commands: [&[u8]; 8] = [
        &[0xD6],
        &[0xD5, 0, 1, 0],
        &[0xD4, 0, 0, 0, 1],
        &[0xD3, 0, 0, 0, 0, 1],
        &[0xE2, 0, 0, 0, 0, 0],
        &[0xE1, 0xFF, 2, 0, 0, 0, 0, 0x20],
        &[0xE0, 0x10, 0, 0, 0, 0, 1, 0],
        &[0xDE, 2, 0, 0],
    ];
    for command in commands {
        assert_eq!(ask(&mut bus, &mut now_ns, command)[0], 0xFF, "{command:02X?}");
    }
    assert_eq!(bus.due(now_ns), None);
    assert_eq!(ask(&mut bus, &mut now_ns, &[0xDD, 1]), [0xFF]);
    let due_ns = bus.due(now_ns).unwrap();
    let packet = bus.bid(due_ns).unwrap();
    assert_eq!(
        (packet.data().len(), packet.data()[0], packet.data()[5..].to_vec()),
        (7, 0, vec![0xA0, 0x0F])
    );
    bus.take(due_ns);
    now_ns = due_ns + MS_NS;
    assert_eq!(ask(&mut bus, &mut now_ns, &[0xFE]), [0xFF]);
    assert_eq!(bus.due(now_ns + 50 * MS_NS), None);
}
