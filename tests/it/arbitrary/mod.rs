//! Commands as a careless program sends them: mostly valid, often not.

use cantap_firmware::CAN_CLOCK_HZ;
use cantap_wire::message::{
    ChannelConfig, Checksum, Filter, FrameKind, GatewayRule, Mode, Modifier, Pass, Periodic, Trigger, TxFrame,
};
use cantap_wire::{BitTiming, Channel, Command, Frame, Id};
use proptest::prelude::*;

pub fn channel() -> impl Strategy<Value = Channel> {
    prop::sample::select(Channel::ALL.to_vec())
}

fn frame() -> impl Strategy<Value = Frame> {
    (any::<u32>(), any::<bool>(), any::<bool>(), 0..16_u8, any::<[u8; 8]>()).prop_map(
        |(id, extended, remote, dlc, data)| {
            let id = if extended { Id::extended_truncated(id) } else { Id::standard_truncated(id) };
            Frame::from_bus(id, remote, dlc, data)
        },
    )
}

pub fn channel_config() -> impl Strategy<Value = ChannelConfig> {
    let mode =
        prop::sample::select(vec![Mode::ListenOnly, Mode::Normal, Mode::Loopback, Mode::SilentLoopback]);
    // Cannot fail: both rates divide the clock.
    let timing = prop::sample::select(vec![500_000, 1_000_000])
        .prop_filter_map("a rate", |rate| BitTiming::choose(CAN_CLOCK_HZ, rate, None).ok());
    let good = (mode, timing, any::<[bool; 4]>()).prop_map(|(mode, timing, flags)| ChannelConfig {
        mode,
        one_shot: flags[0],
        manual_recovery: flags[1],
        omit_data: flags[2],
        omit_stamps: flags[3],
        ..ChannelConfig::listen_only(timing)
    });
    let wild = any::<(u16, u8, u8, u8)>().prop_map(|(prescaler, segment1, segment2, jump_width)| {
        ChannelConfig::listen_only(BitTiming { prescaler, segment1, segment2, jump_width })
    });
    prop_oneof![6 => good, 1 => wild]
}

fn filter() -> impl Strategy<Value = Filter> {
    let kind = prop::sample::select(vec![FrameKind::Data, FrameKind::Remote, FrameKind::Any]);
    let number = prop_oneof![4 => 0..0x800_u32, 1 => any::<u32>()];
    (any::<bool>(), kind, number.clone(), number).prop_map(|(extended, kind, id, mask)| Filter {
        extended,
        kind,
        id,
        mask,
    })
}

fn modifier() -> impl Strategy<Value = Modifier> {
    prop_oneof![
        (0..9_u8, 0..9_u8, 0..10_u8).prop_map(|(byte, low_bit, bits)| Modifier::Counter {
            byte,
            low_bit,
            bits
        }),
        (0..9_u8).prop_map(|byte| Modifier::Checksum { byte, algorithm: Checksum::Crc8J1850 }),
        any::<u8>().prop_map(|byte| Modifier::Random { byte }),
    ]
}

fn rule() -> impl Strategy<Value = GatewayRule> {
    let times = prop_oneof![3 => Just(0), 2 => 0..200_000_u32, 1 => any::<u32>()];
    let bits = (any::<bool>(), any::<[u32; 2]>(), 0..20_u8, any::<[[u8; 8]; 2]>());
    let modifiers = || prop::collection::vec(modifier(), 0..3);
    let wild = (bits, modifiers(), times.clone(), times.clone()).prop_map(
        |(
            (extended, [id_and, id_xor], dlc_xor, [data_and, data_xor]),
            modifiers,
            period_ticks,
            delay_ticks,
        )| Pass {
            extended,
            id_and,
            id_xor,
            dlc_xor,
            data_and,
            data_xor,
            modifiers: modifiers.into_iter().collect(),
            period_ticks,
            delay_ticks,
            ..Pass::unchanged(extended)
        },
    );
    let tame = (modifiers(), times.clone(), times).prop_map(|(modifiers, period_ticks, delay_ticks)| Pass {
        modifiers: modifiers.into_iter().collect(),
        period_ticks,
        delay_ticks,
        ..Pass::unchanged(false)
    });
    let all = Filter { extended: false, kind: FrameKind::Any, id: 0, mask: 0 };
    prop_oneof![
        4 => tame.prop_map(move |pass| GatewayRule { filter: all, pass: Some(pass) }),
        1 => (filter(), prop::option::of(wild)).prop_map(|(filter, pass)| GatewayRule { filter, pass }),
    ]
}

/// What makes a device a gateway, now or from its next start on, if none of it is refused.
pub fn gateway() -> impl Strategy<Value = Vec<Command>> {
    let rules = [(); 2].map(|()| prop::collection::vec(rule(), 0..4));
    (rules, [channel_config(), channel_config()], any::<bool>()).prop_map(|(rules, configs, save)| {
        let mut commands: Vec<_> = Channel::ALL.map(|channel| Command::Close { channel }).into();
        for (channel, config) in Channel::ALL.into_iter().zip(configs) {
            let config = ChannelConfig { mode: Mode::Normal, ..config };
            commands.push(if save {
                Command::Configure { channel, config }
            } else {
                Command::Open { channel, config: Some(config) }
            });
        }
        for (from, rules) in Channel::ALL.into_iter().zip(rules) {
            let rules = (0..).zip(rules);
            commands.extend(rules.map(|(slot, rule)| Command::SetGatewayRule {
                from,
                slot,
                rule: Some(rule),
            }));
        }
        commands.push(if save { Command::SaveGateway } else { Command::StartGateway });
        commands
    })
}

pub fn command() -> impl Strategy<Value = Command> {
    let sent = |tags: std::ops::RangeInclusive<u32>, at: std::ops::RangeInclusive<u64>| {
        let frame = (tags, frame(), prop::option::of(at));
        let frame = frame.prop_map(|(tag, frame, at_ticks)| TxFrame { tag, frame, at_ticks });
        prop::collection::vec(frame, 0..=8)
    };
    let sent = prop_oneof![4 => sent(0..=1000, 0..=2_000_000), 1 => sent(0..=u32::MAX, 0..=u64::MAX)];
    let periodic = (
        frame(),
        prop_oneof![500..100_000_u32, any::<u32>()],
        0..5_u32,
        prop::collection::vec(modifier(), 0..4),
    )
        .prop_map(|(frame, period_ticks, count, modifiers)| Periodic {
            frame,
            period_ticks,
            count,
            modifiers: modifiers.into_iter().collect(),
        });
    let trigger =
        (filter(), frame(), 0..4_u32).prop_map(|(filter, reply, count)| Trigger { filter, reply, count });
    let simple = prop::sample::select(vec![
        Command::Status,
        Command::Failures,
        Command::Edges,
        Command::MeasureEdges { channel: None },
        Command::MeasureEdges { channel: Some(Channel::Can1) },
        Command::MeasureEdges { channel: Some(Channel::Can2) },
        Command::Time,
        Command::Identify { seconds: 1 },
        Command::SaveDefaults,
        Command::ClearDefaults,
        Command::Hello { protocol: 99 },
        Command::StartGateway,
        Command::StopGateway,
        Command::SaveGateway,
    ]);
    prop_oneof![
        4 => (channel(), prop::option::weighted(0.8, channel_config()))
            .prop_map(|(channel, config)| Command::Open { channel, config }),
        1 => (channel(), channel_config())
            .prop_map(|(channel, config)| Command::Configure { channel, config }),
        1 => channel().prop_map(|channel| Command::Defaults { channel }),
        2 => channel().prop_map(|channel| Command::Close { channel }),
        1 => channel().prop_map(|channel| Command::Abort { channel }),
        1 => channel().prop_map(|channel| Command::Recover { channel }),
        1 => channel().prop_map(|channel| Command::Registers { channel }),
        2 => (channel(), prop::collection::vec(filter(), 0..40))
            .prop_map(|(channel, filters)| Command::SetFilters { channel, filters: filters.into_iter().collect() }),
        6 => (channel(), sent)
            .prop_map(|(channel, frames)| Command::Send { channel, frames: frames.into_iter().collect() }),
        2 => (channel(), 0..40_u8, prop::option::of(periodic))
            .prop_map(|(channel, slot, entry)| Command::SetPeriodic { channel, slot, entry }),
        2 => (channel(), 0..10_u8, prop::option::of(trigger))
            .prop_map(|(channel, slot, entry)| Command::SetTrigger { channel, slot, entry }),
        2 => (channel(), 0..34_u8, prop::option::of(rule()))
            .prop_map(|(from, slot, rule)| Command::SetGatewayRule { from, slot, rule }),
        1 => (channel(), any::<u8>()).prop_map(|(from, first)| Command::GatewayStatus { from, first }),
        1 => (channel(), 0..34_u8).prop_map(|(from, slot)| Command::GatewayRule { from, slot }),
        2 => simple,
    ]
}
