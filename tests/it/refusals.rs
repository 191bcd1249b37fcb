//! Every refusal gives its reason and changes nothing: not the filters, not the controllers, not what is saved, not the
//! tables, not what the other channel does.

use crate::fakes;

use cantap_firmware::bus::gateway::Lane;
use cantap_firmware::bus::periodic::PERIODIC_SLOTS;
use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::bus::transmit::{TRIGGER_SLOTS, TX_QUEUE};
use cantap_wire::message::{
    ChannelConfig, Defaults, Filter, FrameKind, MAX_FILTERS, Mode, Modifier, Periodic, Trigger, TxFrame,
};
use cantap_wire::{BitTiming, Channel, Command, PROTOCOL_VERSION, Refusal, Reply};
use fakes::{Bench, SMALL_QUEUE, config, numbered};

const CAN1: Channel = Channel::Can1;
const CAN2: Channel = Channel::Can2;

/// Everything that a refused command might have touched.
#[derive(Debug, PartialEq)]
struct Snapshot {
    written: usize,
    started: [usize; 2],
    running: [bool; 2],
    saved: Vec<u8>,
    open: [Option<ChannelConfig>; 2],
    pending: [u16; 2],
    defaults: [Result<Reply, Refusal>; 2],
    sent: [usize; 2],
}

fn snapshot<const N: usize>(bench: &mut Bench<'_, N>) -> Snapshot {
    let Ok(Reply::Status(status)) = bench.ask(Command::Status) else { panic!("no status") };
    let defaults = Channel::ALL.map(|channel| bench.ask(Command::Defaults { channel }));
    let board = &bench.board;
    Snapshot {
        written: board.filters.written.len(),
        started: board.control.each_ref().map(|control| control.started.len()),
        running: board.control.each_ref().map(|control| control.running),
        saved: board.chip.saved.clone(),
        open: status.channels.map(|channel| channel.open),
        pending: status.channels.map(|channel| channel.tx_pending),
        defaults,
        sent: board.traffic.each_ref().map(|traffic| traffic.order.len()),
    }
}

/// Checks that each command is refused for the expected reason and that the board is unchanged.
fn refuse<const N: usize>(bench: &mut Bench<'_, N>, commands: Vec<(Command, Refusal)>) {
    let before = snapshot(bench);
    for (command, refusal) in commands {
        assert_eq!(bench.ask(command.clone()), Err(refusal), "{command:?}");
        assert_eq!(snapshot(bench), before, "{command:?}");
    }
}

fn filter(extended: bool, id: u32, mask: u32) -> Filter {
    Filter { extended, kind: FrameKind::Any, id, mask }
}

fn filters(channel: Channel, filters: impl IntoIterator<Item = Filter>) -> Command {
    Command::SetFilters { channel, filters: filters.into_iter().collect() }
}

fn timing(prescaler: u16, segment1: u8, segment2: u8, jump_width: u8) -> ChannelConfig {
    ChannelConfig::listen_only(BitTiming { prescaler, segment1, segment2, jump_width })
}

fn open(channel: Channel, config: ChannelConfig) -> Command {
    Command::Open { channel, config: Some(config) }
}

fn send(channel: Channel, tags: impl IntoIterator<Item = u32>, at_ticks: Option<u64>) -> Command {
    let frames = tags.into_iter().map(|tag| TxFrame { tag, frame: numbered(1), at_ticks });
    Command::Send { channel, frames: frames.collect() }
}

fn periodic(slot: u8, period_ticks: u32, modifiers: &[Modifier]) -> Command {
    let modifiers = modifiers.iter().copied().collect();
    let entry = Periodic { frame: numbered(1), period_ticks, count: 0, modifiers };
    Command::SetPeriodic { channel: CAN1, slot, entry: Some(entry) }
}

fn trigger(slot: u8, filter: Filter) -> Command {
    let entry = Trigger { filter, reply: numbered(1), count: 0 };
    Command::SetTrigger { channel: CAN1, slot, entry: Some(entry) }
}

type Settings = [(Option<ChannelConfig>, heapless::Vec<Filter, MAX_FILTERS>); 2];

/// Settings as the device keeps them.
fn stored(settings: &Settings) -> Vec<u8> {
    postcard::to_slice(settings, &mut [0; 2048]).unwrap().to_vec()
}

#[test]
fn while_a_channel_is_closed() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    let mut commands = vec![
        (Command::Hello { protocol: PROTOCOL_VERSION + 1 }, Refusal::Protocol { device: PROTOCOL_VERSION }),
        (Command::Open { channel: CAN1, config: None }, Refusal::NothingSaved),
        (Command::SaveDefaults, Refusal::NothingSaved),
        (Command::Recover { channel: CAN1 }, Refusal::ChannelClosed),
        (send(CAN1, [1], None), Refusal::ChannelClosed),
        (periodic(0, 12_000, &[]), Refusal::ChannelClosed),
        (trigger(0, filter(false, 1, 1)), Refusal::ChannelClosed),
        (filters(CAN1, [filter(false, 0x800, 0)]), Refusal::BadId),
        (filters(CAN1, [filter(false, 0, 0x800)]), Refusal::BadId),
        (filters(CAN1, [filter(false, 1, 1), filter(true, 1 << 29, 0)]), Refusal::BadId),
        (filters(CAN1, [filter(true, 0, 1 << 29)]), Refusal::BadId),
        (
            filters(CAN1, (0..28).map(|id| filter(true, id, 0x1FFF_FFFF))),
            Refusal::BanksExhausted { needed: 28, available: 27 },
        ),
        (
            filters(CAN2, (0..MAX_FILTERS as u32).map(|id| filter(true, id, 0x1FFF_FFFF))),
            Refusal::BanksExhausted { needed: MAX_FILTERS as u8, available: 27 },
        ),
    ];
    for bad in [
        timing(0, 13, 2, 1),
        timing(1025, 13, 2, 1),
        timing(4, 0, 2, 1),
        timing(4, 17, 2, 1),
        timing(4, 13, 0, 1),
        timing(4, 13, 9, 1),
        timing(4, 13, 2, 0),
        timing(4, 13, 8, 5),
        timing(4, 13, 2, 3),
        // 12 Mbit/s and 1.4 kbit/s.
        timing(1, 1, 1, 1),
        timing(1024, 16, 8, 1),
    ] {
        commands.push((open(CAN2, bad), Refusal::BadTiming));
        commands.push((Command::Configure { channel: CAN2, config: bad }, Refusal::BadTiming));
    }
    refuse(&mut bench, commands);
}

#[test]
fn while_both_channels_are_open() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::ListenOnly);
    refuse(
        &mut bench,
        vec![
            (open(CAN1, config(Mode::Normal)), Refusal::ChannelOpen),
            (Command::Open { channel: CAN1, config: None }, Refusal::ChannelOpen),
            (Command::Configure { channel: CAN1, config: config(Mode::Normal) }, Refusal::ChannelOpen),
            (filters(CAN1, []), Refusal::ChannelOpen),
            (Command::SaveDefaults, Refusal::ChannelOpen),
            (Command::ClearDefaults, Refusal::ChannelOpen),
            (Command::Recover { channel: CAN1 }, Refusal::NotBusOff),
            (send(CAN1, [1], None), Refusal::ListenOnly),
            (periodic(0, 12_000, &[]), Refusal::ListenOnly),
            (trigger(0, filter(false, 1, 1)), Refusal::ListenOnly),
        ],
    );
    bench.ask(Command::Close { channel: CAN1 }).unwrap();
    // The other one is still open: commands that would interrupt it, or stop the processor, are refused.
    refuse(
        &mut bench,
        vec![
            (filters(CAN1, [filter(false, 1, 1)]), Refusal::WouldDisturb),
            (Command::ClearDefaults, Refusal::ChannelOpen),
            (Command::SaveDefaults, Refusal::ChannelOpen),
        ],
    );
}

#[test]
fn while_a_channel_can_send() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::opened(&queue, Mode::Normal);
    let day = 24 * 3600 * u64::from(cantap_firmware::TICK_HZ);
    let random = |byte| [Modifier::Random { byte }];
    let counter = |byte, low_bit, bits| [Modifier::Counter { byte, low_bit, bits }];
    refuse(
        &mut bench,
        vec![
            (send(CAN1, [1, 0xFFFF_0000], None), Refusal::BadTag),
            (send(CAN1, [1], Some(day * 2)), Refusal::TooFarAhead),
            (send(CAN1, [1], Some(u64::MAX)), Refusal::TooFarAhead),
            (periodic(PERIODIC_SLOTS as u8, 12_000, &[]), Refusal::BadSlot),
            (Command::SetPeriodic { channel: CAN1, slot: 255, entry: None }, Refusal::BadSlot),
            (periodic(0, 0, &[]), Refusal::BadEntry),
            (periodic(0, 563, &[]), Refusal::BadEntry),
            // The frame has four bytes.
            (periodic(0, 12_000, &random(4)), Refusal::BadEntry),
            (periodic(0, 12_000, &counter(0, 8, 1)), Refusal::BadEntry),
            (periodic(0, 12_000, &counter(0, 4, 5)), Refusal::BadEntry),
            (periodic(0, 12_000, &counter(0, 0, 0)), Refusal::BadEntry),
            (trigger(TRIGGER_SLOTS as u8, filter(false, 1, 1)), Refusal::BadSlot),
            (Command::SetTrigger { channel: CAN1, slot: 255, entry: None }, Refusal::BadSlot),
            (trigger(0, filter(false, 0x800, 0x7FF)), Refusal::BadId),
            (trigger(0, filter(false, 1, 0x800)), Refusal::BadId),
            (trigger(0, filter(true, 1 << 29, 0)), Refusal::BadId),
        ],
    );
    // Three are in mailboxes; the queue is filled except for five places.
    for _ in 0..TX_QUEUE / 8 {
        bench.ask(send(CAN1, 0..8, None)).unwrap();
    }
    bench.ask(send(CAN1, 0..1, None)).unwrap();
    bench.ask(send(CAN1, 0..1, None)).unwrap();
    let free = (3 - 2) as u16;
    refuse(&mut bench, vec![(send(CAN1, 0..8, None), Refusal::QueueFull { free })]);
}

/// What was saved may not fit now, or may come from another firmware: then none of it is applied.
#[test]
fn saved_settings_that_cannot_be_applied() {
    let saved = |config, extended_ids: u32| {
        let filters = (0..extended_ids).map(|id| filter(true, id << 1, 0x1FFF_FFFE)).collect();
        stored(&[(Some(config), filters), (None, heapless::Vec::new())])
    };
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    bench.board.chip.saved = saved(timing(4, 17, 2, 1), 3);
    let stored = Command::Open { channel: CAN1, config: None };
    refuse(&mut bench, vec![(stored.clone(), Refusal::BadTiming)]);
    bench.board.chip.saved = saved(config(Mode::Normal), 28);
    let exhausted = Refusal::BanksExhausted { needed: 28, available: 27 };
    refuse(&mut bench, vec![(stored.clone(), exhausted)]);
    bench.ask(open(CAN2, config(Mode::ListenOnly))).unwrap();
    bench.board.chip.saved = saved(config(Mode::Normal), 3);
    refuse(&mut bench, vec![(stored.clone(), Refusal::WouldDisturb)]);
    bench.board.chip.saved = vec![0xFF; 40];
    refuse(&mut bench, vec![(stored, Refusal::NothingSaved)]);
}

#[test]
fn settings_are_saved_told_and_merged_without_a_channel_being_opened() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    let only = filter(true, 0x123, 0x1FFF_FFFF);
    bench.ask(filters(CAN2, [only])).unwrap();
    bench.ask(Command::Configure { channel: CAN2, config: config(Mode::Normal) }).unwrap();
    bench.ask(Command::SaveDefaults).unwrap();
    bench.greet();
    assert_eq!(bench.ask(Command::Defaults { channel: CAN1 }), Err(Refusal::NothingSaved));
    bench.ask(Command::Configure { channel: CAN1, config: config(Mode::Loopback) }).unwrap();
    bench.ask(Command::SaveDefaults).unwrap();
    let told = |config, filters: &[Filter]| {
        Ok(Reply::Defaults(Defaults { config, filters: filters.iter().copied().collect() }))
    };
    assert_eq!(bench.ask(Command::Defaults { channel: CAN1 }), told(config(Mode::Loopback), &[]));
    assert_eq!(bench.ask(Command::Defaults { channel: CAN2 }), told(config(Mode::Normal), &[only]));
    assert!(bench.board.control.iter().all(|control| control.started.is_empty()));
    bench.ask(Command::ClearDefaults).unwrap();
    assert_eq!(bench.ask(Command::Defaults { channel: CAN2 }), Err(Refusal::NothingSaved));
}

/// The longest possible answer: as many filters as there can be.
#[test]
fn the_longest_answer_is_readable() {
    let queue = RecordQueue::<SMALL_QUEUE>::new();
    let mut bench = Bench::new(&queue);
    bench.greet();
    let longest = filter(true, 0x1FFF_FFFF, 0x1FFF_FFFF);
    let settings = [
        (
            Some(timing(1024, 16, 8, 4)),
            heapless::Vec::<Filter, MAX_FILTERS>::from_iter([longest; MAX_FILTERS]),
        ),
        (None, heapless::Vec::new()),
    ];
    bench.board.chip.saved = stored(&settings);
    let Ok(Reply::Defaults(defaults)) = bench.ask(Command::Defaults { channel: CAN1 }) else { panic!() };
    assert_eq!(defaults.filters, [longest; MAX_FILTERS]);
}

/// A frame that comes between bus-off and the end of giving the queue up is given up and reported like the others.
#[test]
fn a_frame_that_comes_while_the_queue_is_given_up_is_told_of() {
    use cantap_firmware::bus::transmit::{Transmitter, TxQueue};
    use cantap_wire::record::TransmitFailure;
    let mut queue = TxQueue::new();
    let mut lane = Lane::new();
    let mut transmitter = Transmitter::new(CAN1, &mut queue, &mut lane);
    let mut traffic = fakes::FakeTraffic::default();
    let frame = |tag| TxFrame { tag, frame: numbered(1), at_ticks: None };
    assert!(transmitter.enqueue(&frame(1)));
    transmitter.drop_all(TransmitFailure::BusOff, &mut traffic);
    assert_eq!(transmitter.free(), 0);
    assert!(transmitter.enqueue(&frame(2)));
    assert_eq!(transmitter.pending(), 2);
}
