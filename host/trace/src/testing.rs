//! Records for tests: random ones, and simple numbered ones.

use cantap_can::{BusErrorKind, DEVICE_TAG, ErrorState, LossStage, TransmitFailure};
use cantap_can::{Frame, Id};
use proptest::prelude::*;

use crate::fd::FD_LENGTHS;
use crate::{DeviceNs, Direction, FdFrame, LinFault, LinFrame, TraceEvent, TraceFrame, TraceRecord};

fn id() -> impl Strategy<Value = Id> {
    prop_oneof![
        (0..=Id::MAX_STANDARD).prop_map(|raw| Id::standard(raw).unwrap()),
        (0..=Id::MAX_EXTENDED).prop_map(|raw| Id::extended(raw).unwrap()),
    ]
}

/// Any frame that is possible on a classical bus.
pub fn frame() -> impl Strategy<Value = Frame> {
    (id(), any::<bool>(), 0..16_u8, any::<[u8; 8]>())
        .prop_map(|(id, remote, dlc, data)| Frame::from_bus(id, remote, dlc, data))
}

/// Any CAN FD frame.
pub fn fd_frame() -> impl Strategy<Value = FdFrame> {
    let data = prop::sample::select(FD_LENGTHS.to_vec())
        .prop_flat_map(|len| prop::collection::vec(any::<u8>(), usize::from(len)));
    (id(), any::<bool>(), any::<bool>(), data)
        .prop_map(|(id, brs, esi, data)| FdFrame::new(id, brs, esi, &data).unwrap())
}

/// Any event but a frame, be it one of CAN or of LIN.
pub fn event() -> impl Strategy<Value = TraceEvent> {
    let reasons = TransmitFailure::ALL
        .into_iter()
        .filter(|reason| !matches!(reason, TransmitFailure::Overtaken { .. }));
    // Only the device's own frames are overtaken.
    let overtaken = (DEVICE_TAG..=u32::MAX, any::<u32>()).prop_map(|(tag, periods)| {
        TraceEvent::TransmitFailed { tag, reason: TransmitFailure::Overtaken { periods } }
    });
    let counters = prop::option::of(any::<(u8, u8)>());
    prop_oneof![
        (prop::option::of(prop::sample::select(LossStage::ALL.to_vec())), 1..=u32::MAX, any::<bool>())
            .prop_map(|(stage, count, at_least)| TraceEvent::Lost { stage, count, at_least }),
        Just(TraceEvent::GAP),
        Just(TraceEvent::UNCOUNTED),
        (prop::option::of(prop::sample::select(BusErrorKind::ALL.to_vec())), counters.clone())
            .prop_map(|(kind, counters)| TraceEvent::BusError { kind, counters }),
        (1..=u32::MAX).prop_map(|count| TraceEvent::ErrorsSuppressed { count }),
        (prop::sample::select(ErrorState::ALL.to_vec()), counters)
            .prop_map(|(state, counters)| TraceEvent::State { state, counters }),
        (any::<u32>(), prop::sample::select(reasons.collect::<Vec<_>>()))
            .prop_map(|(tag, reason)| TraceEvent::TransmitFailed { tag, reason }),
        overtaken,
        any::<u32>().prop_map(|length_ns| TraceEvent::Disturbed { length_ns }),
    ]
}

/// Any frame of a LIN bus.
pub fn lin() -> impl Strategy<Value = TraceEvent> {
    let data = prop::collection::vec(any::<u8>(), 0..=8);
    let fault = prop::option::of(prop::sample::select(LinFault::ALL.to_vec()));
    let direction = prop::sample::select(vec![Direction::Rx, Direction::Tx]);
    (0..=LinFrame::MAX_ID, data, any::<Option<u8>>(), fault, direction).prop_map(
        |(id, data, checksum, fault, direction)| {
            let frame = LinFrame::new(id, &data).unwrap().with(checksum, fault);
            TraceEvent::Lin { frame, direction }
        },
    )
}

/// A data frame at a given time.
pub fn data_record(time_ns: i64) -> TraceRecord {
    let frame = "123#DEADBEEF".parse().unwrap();
    let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
    TraceRecord { time_ns, device_ns: None, channel: 1, event }
}

/// Any record of a classical bus whose time is a multiple of `resolution_ns`, from 1937 to 2096.
pub fn record(resolution_ns: i64) -> impl Strategy<Value = TraceRecord> {
    record_of(frame().prop_map(TraceFrame::from), resolution_ns)
}

/// Like [`record`], but including FD frames.
pub fn record_or_fd(resolution_ns: i64) -> impl Strategy<Value = TraceRecord> {
    record_of(
        prop_oneof![frame().prop_map(TraceFrame::from), fd_frame().prop_map(TraceFrame::from)],
        resolution_ns,
    )
}

/// Like [`record_or_fd`], but including LIN frames.
pub fn record_lin_or_can(resolution_ns: i64) -> impl Strategy<Value = TraceRecord> {
    (record_or_fd(resolution_ns), prop::option::weighted(0.2, lin()))
        .prop_map(|(record, lin)| TraceRecord { event: lin.unwrap_or(record.event), ..record })
}

/// The same records, some of which have the device's own time.
pub fn with_device_time(records: impl Strategy<Value = TraceRecord>) -> impl Strategy<Value = TraceRecord> {
    (records, prop::option::of(1..=u64::MAX))
        .prop_map(|(record, ns)| TraceRecord { device_ns: ns.and_then(DeviceNs::new), ..record })
}

fn record_of(
    frame: impl Strategy<Value = TraceFrame>,
    resolution_ns: i64,
) -> impl Strategy<Value = TraceRecord> {
    let frame = (frame, prop::sample::select(vec![Direction::Rx, Direction::Tx]))
        .prop_map(|(frame, direction)| TraceEvent::Frame { frame, direction, late: false });
    let second = 1_000_000_000_i64;
    let time = -second * second..4 * second * second;
    (time, 1..=4_u8, prop_oneof![4 => frame, 1 => event()]).prop_map(
        move |(time_ns, channel, event): (i64, u8, TraceEvent)| TraceRecord {
            time_ns: time_ns.div_euclid(resolution_ns) * resolution_ns,
            device_ns: None,
            channel,
            event,
        },
    )
}
