//! Compiled filter banks against a model of the hardware's matching: what must pass passes, everything else does not.

use cantap_firmware::bus::filters::{BANKS, Bank, Layout, Shape};
use cantap_wire::message::{Filter, FrameKind};
use cantap_wire::{Channel, Frame, Id, Refusal};
use proptest::prelude::*;

/// A frame as bxCAN compares it (RM0090, "Filter bank scale and mode configuration"): STID EXID IDE RTR in 32 bits, STID RTR IDE EXID[17:15] in 16.
fn registers(frame: &Frame) -> (u32, u16) {
    let (id, remote) = (frame.id(), u32::from(frame.is_remote()));
    let (stid, exid) = if id.is_extended() { (id.raw() >> 18, id.raw() & 0x3_FFFF) } else { (id.raw(), 0) };
    let ide = u32::from(id.is_extended());
    let wide = stid << 21 | exid << 3 | ide << 2 | remote << 1;
    let narrow = stid << 5 | remote << 4 | ide << 3 | exid >> 15;
    (wide, narrow as u16)
}

fn bank_passes(bank: &Bank, frame: &Frame) -> bool {
    let (wide, narrow) = registers(frame);
    let halves = |register: u32| [register as u16, (register >> 16) as u16];
    match bank.shape {
        Shape::Mask32 => (wide ^ bank.first) & bank.second == 0,
        Shape::List32 => wide == bank.first || wide == bank.second,
        Shape::Mask16 => [bank.first, bank.second].iter().any(|register| {
            let [id, mask] = halves(*register);
            (narrow ^ id) & mask == 0
        }),
        Shape::List16 => {
            [halves(bank.first), halves(bank.second)].concat().contains(&narrow)
                // A list of 16 bits compares EXID[17:15] too: for a standard frame they are zero.
                && (!frame.id().is_extended())
        }
    }
}

fn passes(layout: &Layout, channel: Channel, frame: &Frame) -> bool {
    let split = usize::from(layout.split);
    let banks = if channel == Channel::Can1 { &layout.banks[..split] } else { &layout.banks[split..] };
    banks.iter().flatten().any(|bank| bank_passes(bank, frame))
}

fn filter() -> impl Strategy<Value = Filter> {
    let kind = prop_oneof![Just(FrameKind::Data), Just(FrameKind::Remote), Just(FrameKind::Any)];
    (any::<bool>(), kind, any::<u32>(), prop_oneof![any::<u32>(), Just(u32::MAX), Just(0), Just(7)]).prop_map(
        |(extended, kind, id, mask)| {
            let widest = if extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
            Filter { extended, kind, id: id & widest & 0x1000_00FF, mask: mask & widest }
        },
    )
}

fn frame() -> impl Strategy<Value = Frame> {
    (any::<bool>(), any::<bool>(), any::<u32>(), any::<bool>()).prop_map(|(extended, remote, id, near)| {
        let id = if near { id & 0x1000_00FF } else { id };
        let id = if extended { Id::extended_truncated(id) } else { Id::standard_truncated(id) };
        Frame::from_bus(id, remote, 0, [0; 8])
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(20_000))]
    #[test]
    fn banks_pass_exactly_what_the_filters_say(
        filters in prop::collection::vec(filter(), 1..12), others in prop::collection::vec(filter(), 0..6),
        frames in prop::collection::vec(frame(), 20), second: bool,
    ) {
        let [channel, other] = if second { [Channel::Can2, Channel::Can1] } else { Channel::ALL };
        let layout = Layout::open().with(other, &others).unwrap().with(channel, &filters).unwrap();
        for frame in frames.iter().chain(&filters.iter().map(matching).collect::<Vec<_>>()) {
            let wanted = filters.iter().any(|filter| filter.matches(frame));
            prop_assert_eq!(passes(&layout, channel, frame), wanted, "{} on {:?}", frame, layout);
            let wanted = others.is_empty() || others.iter().any(|filter| filter.matches(frame));
            prop_assert_eq!(passes(&layout, other, frame), wanted, "{} on the other channel", frame);
        }
    }
}

/// A frame that a filter accepts.
fn matching(filter: &Filter) -> Frame {
    let id =
        if filter.extended { Id::extended_truncated(filter.id) } else { Id::standard_truncated(filter.id) };
    Frame::from_bus(id, filter.kind == FrameKind::Remote, 0, [0; 8])
}

const fn id_filter(id: u32, extended: bool) -> Filter {
    let mask = if extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
    Filter { extended, kind: FrameKind::Data, id, mask }
}

#[test]
fn identifiers_share_banks_four_standard_or_two_extended_ones_in_each() {
    let used = |filters: &[Filter]| Layout::open().with(Channel::Can1, filters).unwrap().used(Channel::Can1);
    let standard: Vec<Filter> = (0..9).map(|id| id_filter(id, false)).collect();
    assert_eq!([used(&standard[..4]), used(&standard[..5]), used(&standard)], [1, 2, 3]);
    let extended: Vec<Filter> = (0..3).map(|id| id_filter(id, true)).collect();
    assert_eq!([used(&extended[..2]), used(&extended)], [1, 2]);
    let masked = |mask| Filter { mask, ..id_filter(0, false) };
    assert_eq!(used(&[masked(1), masked(2), masked(3)]), 2);
}

#[test]
fn one_channel_takes_what_the_other_leaves_and_no_more() {
    let wide = |id| Filter { mask: 0x1FFF_0000, ..id_filter(id, true) };
    let many: Vec<Filter> = (0..28).map(|id| wide(id << 16)).collect();
    let layout = Layout::open().with(Channel::Can1, &many[..27]).unwrap();
    assert_eq!((layout.split, layout.used(Channel::Can1), layout.used(Channel::Can2)), (27, 27, 1));
    assert_eq!(
        Layout::open().with(Channel::Can1, &many),
        Err(Refusal::BanksExhausted { needed: BANKS as u8, available: BANKS as u8 - 1 })
    );
    assert_eq!(
        layout.with(Channel::Can2, &many[..2]),
        Err(Refusal::BanksExhausted { needed: 2, available: 1 })
    );
    let layout = Layout::open().with(Channel::Can2, &many[..27]).unwrap();
    assert_eq!((layout.split, layout.used(Channel::Can2)), (1, 27));
}

#[test]
fn only_another_shape_disturbs_the_other_channel() {
    let open = Layout::open();
    let narrow = open.with(Channel::Can1, &[id_filter(1, false)]).unwrap();
    assert!(open.disturbs(&narrow), "another shape");
    let other = narrow.with(Channel::Can1, &[id_filter(2, false)]).unwrap();
    assert!(!narrow.disturbs(&other), "other contents only");
}
