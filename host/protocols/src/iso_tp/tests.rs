use cantap_trace::{Direction, FdFrame, Id, TraceEvent, TraceFrame, TraceRecord};

use super::*;
use crate::testing::{self, at, hex, lost};

fn transfers(pairs: &[&str], records: &[TraceRecord]) -> Vec<Transfer> {
    let pairs: Vec<KnownPairs> = pairs.iter().map(|pair| pair.parse().unwrap()).collect();
    let mut transport = Transport::new(&pairs, true);
    let mut all = Vec::new();
    for record in records {
        transport.take(record, &mut |transfer| all.push(transfer));
    }
    transport.finish(&mut |transfer| all.push(transfer));
    all
}

fn event_lines(pairs: &[&str], records: &[TraceRecord]) -> Vec<String> {
    transfers(pairs, records).into_iter().map(|transfer| Event::from(transfer).to_string()).collect()
}

const VIN: [&str; 4] =
    ["7E8#1014620F19057565", "7E0#3000000000000000", "7E8#21575A5A5A314B5A", "7E8#2241573030303031"];

fn vin() -> Vec<TraceRecord> {
    VIN.iter().enumerate().map(|(at_ms, frame)| at(at_ms as f64, frame)).collect()
}

#[test]
fn frames_become_one_transfer() {
    let all = transfers(&[], &vin());
    assert_eq!(all.len(), 1);
    let transfer = &all[0];
    assert!(transfer.is_whole() && !transfer.frames_lost, "{transfer:?}");
    assert_eq!((transfer.length, transfer.data.len(), transfer.frames), (20, 20, 4));
    assert_eq!((transfer.start_ns, transfer.time_ns), (0, 3_000_000));
    assert_eq!((transfer.block_size, transfer.separation_us), (Some(0), Some(0)));
}

#[test]
fn a_loss_in_the_middle_is_said_even_if_the_numbers_fit() {
    let mut records = vin();
    records.insert(2, lost(1.5));
    let all = transfers(&[], &records);
    assert!(all.len() == 1 && all[0].is_whole() && all[0].frames_lost, "{all:?}");
    // On another channel it means nothing.
    records[2].channel = 2;
    assert!(!transfers(&[], &records)[0].frames_lost);
}

#[test]
fn a_missing_frame_breaks_the_transfer_once() {
    let mut records = vin();
    records.remove(2);
    records.push(at(4.0, "7E8#23FFFFFFFFFFFFFF"));
    assert_eq!(
        event_lines(&[], &records),
        [
            "isotp 7E8 > 7E0 broken transfer: length 20 bytes, received 6 bytes, block_size 0, separation_us 0, \
          data 62 0F 19 05 75 65; frame 2 came instead of 1"
        ]
    );
}

#[test]
fn what_ends_a_transfer_early_is_named() {
    let first = &vin()[..1];
    for (then, trouble) in [
        (at(1.0, "7E0#320000"), Trouble::Overflow),
        (at(1.0, "7E8#021011"), Trouble::Overlapped),
        (at(1200.0, "123#"), Trouble::Timeout { after_ms: 1000 }),
        (at(1.0, "123#"), Trouble::Unfinished),
        (at(1.0, "7E8#23"), Trouble::Sequence { expected: 1, got: 3 }),
    ] {
        let all = transfers(&[], &[first, &[then]].concat());
        assert_eq!(all[0].trouble, Some(trouble), "{all:?}");
    }
    assert_eq!(transfers(&[], &vin()[2..])[0].trouble, Some(Trouble::Headless));
    assert_eq!(transfers(&[], &vin()[2..]).len(), 1, "a run without its beginning is told once");
    assert_eq!(
        transfers(&[], &[at(0.0, "7E0#0911")])[0].trouble.map(|trouble| trouble.code()),
        Some("malformed")
    );
}

#[test]
fn flow_control_is_kept_to_or_said() {
    let records = [
        at(0.0, "7E0#1014000102030405"),
        at(1.0, "7E8#31"),
        at(1.1, "7E8#310000"),
        at(2.0, "7E8#300A14"),
        at(5.0, "7E0#2106070809101112"),
        at(10.0, "7E0#2213141516171819"),
    ];
    let all = transfers(&[], &records);
    assert_eq!(all[0].trouble.map(|trouble| trouble.code()), Some("malformed"), "a flow control of one byte");
    let transfer = &all[1];
    assert!(transfer.is_whole(), "{transfer:?}");
    assert_eq!((transfer.waits, transfer.too_early, transfer.separation_us), (1, 1, Some(20_000)));
}

#[test]
fn pairs_are_found_by_what_they_do_in_every_addressing() {
    // In between, other frames that look like parts of a transfer.
    let noise = [at(0.1, "111#1008AABBCCDDEEFF"), at(0.2, "222#3000"), at(1.5, "333#2100")];
    for frames in [
        ["6A0#1009010203040506", "6B0#300000", "6A0#21070809", "6B0#027E00"],
        ["6F1#1210090102030405", "612#F1300000", "6F1#122106070809", "612#F1027E00"],
        ["18DAF110#1009010203040506", "18DA10F1#300000", "18DAF110#21070809", "18DA10F1#027E00"],
        ["18CEF110#5510090102030405", "18CE10F1#55300000", "18CEF110#552106070809", "18CE10F1#55027E00"],
        ["0CFE1234#1009010203040506", "0CFE4321#300000", "0CFE1234#21070809", "0CFE4321#027E00"],
    ] {
        let mut records: Vec<_> = frames.iter().enumerate().map(|(ms, frame)| at(ms as f64, frame)).collect();
        records.splice(1..1, noise);
        let all = transfers(&[], &records);
        assert_eq!(all.len(), 2, "{frames:?}: {all:?}");
        assert_eq!(all[0].data[..], [1, 2, 3, 4, 5, 6, 7, 8, 9]);
        assert_eq!(all[1].data[..], [0x7E, 0], "the answer by the pair that was found");
        assert_eq!(all[1].to, Some(all[0].from));
    }
}

#[test]
fn pairs_can_be_given() {
    let single = [at(0.0, "123#023E00"), at(1.0, "124#027E00")];
    assert_eq!(transfers(&[], &single), []);
    assert_eq!(transfers(&["123:124"], &single).len(), 2);
    assert_eq!(
        event_lines(&["6F1/12:612/F1"], &[at(0.0, "6F1#12023E00")]),
        ["isotp 6F1/12 > 612/F1 transfer: length 2 bytes, data 3E 00"]
    );
    for bad in ["", "123", "123:1234", "123/1:124", "123:123", "123/123:124/1", "123/:124/"] {
        assert!(bad.parse::<Pair>().is_err(), "{bad}");
    }
}

#[test]
fn fd_frames_carry_more() {
    let fd = |ms: f64, id: u32, bytes: &[u8]| {
        let frame = TraceFrame::Fd(FdFrame::new(Id::standard(id).unwrap(), true, false, bytes).unwrap());
        let event = TraceEvent::Frame { frame, direction: Direction::Rx, late: false };
        TraceRecord { time_ns: (ms * 1e6) as i64, device_ns: None, channel: 1, event }
    };
    let mut single = vec![0x00, 0x16];
    single.extend(1..=22);
    let mut first = vec![0x10, 0x00, 0, 0, 0x13, 0x88];
    first.extend([7; 58]);
    let mut records = vec![fd(0.0, 0x7E0, &single), fd(1.0, 0x7E0, &first), fd(2.0, 0x7E8, &[0x30, 0, 0])];
    for number in 1..=79_u8 {
        let mut next = vec![0x20 | number & 15];
        next.extend([7; 63]);
        records.push(fd(2.0 + f64::from(number), 0x7E0, &next));
    }
    let all = transfers(&[], &records);
    assert_eq!(all[0].data[..], (1..=22).collect::<Vec<u8>>());
    assert!(all[1].is_whole(), "{:?}", all[1].trouble);
    assert_eq!(all[1].data[..], [7; 5000]);
}

/// Memory stays bounded, and whatever is abandoned is reported.
#[test]
fn a_flood_of_first_frames_is_given_up_one_by_one() {
    let mut transport = Transport::new(&[], true);
    let mut given_up = 0;
    for number in 0..100_000_u32 {
        let record = at(f64::from(number) / 1000.0, &format!("18DA{:04X}#1FFF010203040506", number & 0xFFFF));
        transport.take(&record, &mut |transfer| {
            given_up += u32::from(matches!(transfer.trouble, Some(Trouble::GivenUp | Trouble::Overlapped)));
        });
        assert!(transport.open.len() <= MOST_OPEN);
    }
    assert_eq!(given_up, 100_000 - MOST_OPEN as u32);
}

/// Several senders at once, with frames dropped, repeated and swapped: what is complete is what was sent, and the
/// rest is reported.
#[test]
fn transfers_at_random_are_whole_and_right_or_said_to_be_broken() {
    let mut random = fastrand::Rng::with_seed(15_765);
    for round in 0..300 {
        let mut lines: Vec<Vec<String>> = Vec::new();
        let mut sent: Vec<Vec<Vec<u8>>> = Vec::new();
        for sender in 0..4_u32 {
            let (mut frames, mut messages) = (Vec::new(), Vec::new());
            for _ in 0..5 {
                let data: Vec<u8> = (0..random.usize(1..200)).map(|_| random.u8(..)).collect();
                let id = 0x7E0 + sender;
                if data.len() <= 7 {
                    frames.push(format!("{id:03X}#{:02X}{}", data.len(), hex(&data)));
                } else {
                    frames.push(format!("{id:03X}#{:04X}{}", 0x1000 | data.len(), hex(&data[..6])));
                    frames.push(format!("{:03X}#300000", id + 8));
                    for (at, chunk) in data[6..].chunks(7).enumerate() {
                        frames.push(format!("{id:03X}#2{:X}{}", (at + 1) & 15, hex(chunk)));
                    }
                }
                messages.push(data);
            }
            lines.push(frames);
            sent.push(messages);
        }
        let mut order = Vec::new();
        for (sender, frames) in lines.iter().enumerate() {
            order.extend(std::iter::repeat_n(sender, frames.len()));
        }
        random.shuffle(&mut order);
        let mut iterators: Vec<_> = lines.into_iter().map(Vec::into_iter).collect();
        let mut frames: Vec<String> =
            order.into_iter().map(|sender| iterators[sender].next().unwrap()).collect();
        let disturbed = round % 3 > 0;
        if disturbed {
            testing::disturb(&mut frames, &mut random);
        }
        let records: Vec<_> =
            frames.iter().enumerate().map(|(ms, frame)| at(ms as f64 / 10.0, frame)).collect();
        let all = transfers(&[], &records);
        let mut whole = 0;
        for transfer in all.iter().filter(|transfer| transfer.is_whole()) {
            let sender = (transfer.from.id.raw() & 7) as usize;
            assert!(
                sent[sender].contains(&transfer.data.to_vec()),
                "round {round}: never sent: {transfer:?}"
            );
            whole += 1;
        }
        if disturbed {
            let heard = whole + all.iter().filter(|transfer| !transfer.is_whole()).count();
            assert!(whole > 0 && heard >= 14, "round {round}: {whole} of 20 whole, {heard} heard of");
        } else {
            assert_eq!((whole, all.len()), (20, 20), "round {round}");
        }
    }
}

/// Its bytes would end up in the wrong position.
#[test]
fn a_short_frame_in_the_middle_is_not_glued_over() {
    let frames =
        ["7E8#1014620F19057565", "7E0#300000", "7E8#21575A5A", "7E8#225A314B5A415730", "7E8#2330303031"];
    let records: Vec<_> = frames.iter().enumerate().map(|(ms, frame)| at(ms as f64, frame)).collect();
    let all = transfers(&[], &records);
    assert_eq!(all.len(), 1, "{all:?}");
    assert!(matches!(all[0].trouble, Some(Trouble::Malformed(_))), "{all:?}");
    // In CAN FD, only the last one may be shorter, and the first one shows how long the others are.
    let fd = |ms: i64, bytes: Vec<u8>| {
        let frame = FdFrame::new(Id::standard_truncated(0x7E8), true, false, &bytes).unwrap();
        let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
        TraceRecord { time_ns: ms * 1_000_000, device_ns: None, channel: 1, event }
    };
    let first = [&[0x10, 100][..], &[1; 62]].concat();
    let whole = transfers(&[], &[fd(0, first.clone()), fd(1, [&[0x21][..], &[2; 47]].concat())]);
    assert!(whole[0].is_whole(), "{whole:?}");
    let short =
        transfers(&[], &[fd(0, first), fd(1, [&[0x21][..], &[2; 7]].concat()), fd(2, vec![0x22; 48])]);
    assert!(matches!(short[0].trouble, Some(Trouble::Malformed(_))), "{short:?}");
}

/// CAN FD has messages of more than 4095 bytes, on any identifiers.
#[test]
fn a_pair_is_found_by_a_message_of_any_length() {
    let data: Vec<u8> = (0..5000_u32).map(|byte| byte as u8).collect();
    let frame = |number: usize, id: &str, control: &[u8], part: &[u8]| {
        let mut bytes = [control, part].concat();
        let full = [8, 12, 16, 20, 24, 32, 48, 64].into_iter().find(|full| *full >= bytes.len()).unwrap();
        bytes.resize(full, 0xCC);
        at(number as f64, &format!("{id}##1{}", hex(&bytes)))
    };
    let mut frames =
        vec![frame(0, "123", &[0x10, 0, 0, 0, 0x13, 0x88], &data[..58]), frame(1, "321", &[0x30, 0, 0], &[])];
    for (number, part) in (1..).zip(data[58..].chunks(63)) {
        frames.push(frame(number + 1, "123", &[0x20 | number as u8 & 15], part));
    }
    let found = transfers(&[], &frames);
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(found[0].is_whole() && found[0].data[..] == data[..], "{found:?}");
}
