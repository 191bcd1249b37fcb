use super::*;

const NAME: u64 = 5;

fn of(from: u8, pgn: u32, to: u8, data: &[u8]) -> Frame {
    frame(6, pgn, from, to, data)
}

fn hear(node: &mut J1939Node, now_ns: u64, frame: &Frame) {
    node.hear(now_ns, frame.id(), frame.data());
}

/// Everything that it has to send now, confirmed at once.
fn drain(node: &mut J1939Node, now_ns: u64) -> Vec<String> {
    let mut sent = Vec::new();
    while let Some(frame) = node.next(now_ns) {
        sent.push(frame.to_string());
        node.sent(now_ns);
    }
    sent
}

fn owner(name: u64, address: u8) -> J1939Node {
    let mut node = J1939Node::new(name, address);
    assert_eq!(drain(&mut node, 0).len(), 1);
    drain(&mut node, CLAIM_NS);
    assert_eq!(node.address(), Some(address));
    node
}

#[test]
fn an_address_that_any_node_may_use_is_settled_after_250_ms() {
    let mut node = J1939Node::new(NAME, 0x80);
    assert_eq!(drain(&mut node, 0), ["18EEFF80#0500000000000000"]);
    assert_eq!((node.address(), node.due_ns()), (None, Some(CLAIM_NS)));
    node.send(0xFEF6, 255, 6, vec![1]).unwrap();
    assert_eq!(drain(&mut node, CLAIM_NS - 1), [""; 0]);
    assert_eq!(drain(&mut node, CLAIM_NS), [""; 0]);
    assert_eq!(node.address(), Some(0x80));
}

#[test]
fn the_lower_name_keeps_the_address_and_the_other_takes_the_next_or_none() {
    let mut node = owner(NAME, 0);
    hear(&mut node, 1, &of(0, CLAIM, GLOBAL, &6_u64.to_le_bytes()));
    assert_eq!(drain(&mut node, 1), ["18EEFF00#0500000000000000"]);
    hear(&mut node, 2, &of(0, CLAIM, GLOBAL, &4_u64.to_le_bytes()));
    assert_eq!(drain(&mut node, 2), ["18EEFFFE#0500000000000000"]);
    assert_eq!(node.take_trouble(), Some(StationError::AddressTaken { address: 0, name: 4 }));
    // Without an address nothing is sent, but who asks is told.
    node.send(0xFEF6, 255, 6, vec![1]).unwrap();
    hear(&mut node, 3, &of(9, REQUEST, GLOBAL, &three(CLAIM)));
    assert_eq!(drain(&mut node, 3), ["18EEFFFE#0500000000000000"]);

    let mut node = owner(NAME | TAKES_ANY, 0);
    hear(&mut node, 1, &of(128, CLAIM, GLOBAL, &[0; 8]));
    hear(&mut node, 1, &of(0, CLAIM, GLOBAL, &[0; 8]));
    assert_eq!(drain(&mut node, 1), ["18EEFF81#0500000000000080"]);
    drain(&mut node, 1 + CLAIM_NS);
    assert_eq!(node.address(), Some(129));
}

#[test]
fn a_request_is_handed_over_and_one_for_an_unknown_group_refused_to_who_asked() {
    let mut node = owner(NAME, 0);
    hear(&mut node, 1, &of(0xF9, REQUEST, 0, &three(0xFEEC)));
    hear(&mut node, 1, &of(0xF9, REQUEST, GLOBAL, &three(0xFEEC)));
    hear(&mut node, 1, &of(0xF9, REQUEST, 7, &three(0xFEEC)));
    let asked = node.take_request().unwrap();
    assert_eq!(asked, GroupRequest { pgn: 0xFEEC, from: 0xF9, to_all: false });
    node.refuse(asked);
    assert_eq!(drain(&mut node, 2), ["18E8FF00#01FFFFFFF9ECFE00"]);
    node.acknowledge(asked);
    assert_eq!(drain(&mut node, 2), ["18E8FF00#00FFFFFFF9ECFE00"]);
    let asked = node.take_request().unwrap();
    assert!(asked.to_all);
    node.refuse(asked);
    node.acknowledge(asked);
    assert_eq!((drain(&mut node, 2), node.take_request()), (vec![], None));
}

#[test]
fn a_commanded_address_is_claimed_by_the_node_of_that_name_alone() {
    let command = |name: u64, address: u8| {
        let mut data = [0xFF; 16];
        data[..2].copy_from_slice(&[1, name as u8]);
        data[2..8].fill(0);
        (data[8], data[9], data[10]) = (2, 0, address);
        [
            of(0x30, CONTROL, GLOBAL, &[32, 9, 0, 2, 0xFF, 0xD8, 0xFE, 0]),
            of(0x30, DATA, GLOBAL, &data[..8]),
            of(0x30, DATA, GLOBAL, &data[8..]),
        ]
    };
    let mut node = owner(NAME, 0x80);
    for (name, address) in [(NAME + 1, 0x90), (NAME, NULL), (NAME, GLOBAL)] {
        for frame in command(name, address) {
            hear(&mut node, 1, &frame);
        }
        assert_eq!((drain(&mut node, 1), node.address()), (vec![], Some(0x80)), "{name} {address}");
    }
    for frame in command(NAME, 0x90) {
        hear(&mut node, 2, &frame);
    }
    assert_eq!((drain(&mut node, 2), node.address()), (vec!["18EEFF90#0500000000000000".to_owned()], None));
    drain(&mut node, 2 + CLAIM_NS);
    assert_eq!(node.address(), Some(0x90));
    assert_eq!(node.take_message(), None);
}

#[test]
fn messages_to_all_follow_each_other_and_one_to_a_silent_node_ends() {
    let mut node = owner(NAME, 0);
    node.send(0xFECA, GLOBAL, 6, vec![1; 9]).unwrap();
    node.send(0xFECA, GLOBAL, 6, vec![2; 9]).unwrap();
    node.send(0xFEEB, 0xF9, 6, vec![3; 9]).unwrap();
    let mut sent = Vec::new();
    let mut now_ns = 0;
    for _ in 0..20 {
        sent.extend(drain(&mut node, now_ns));
        let Some(due_ns) = node.due_ns() else { break };
        now_ns = due_ns;
    }
    assert_eq!(
        sent,
        [
            "1CECFF00#20090002FFCAFE00",
            "1CECF900#10090002FFEBFE00",
            "1CEBFF00#0101010101010101",
            "1CEBFF00#020101FFFFFFFFFF",
            "1CECFF00#20090002FFCAFE00",
            "1CEBFF00#0102020202020202",
            "1CEBFF00#020202FFFFFFFFFF",
            "1CECF900#FF03FFFFFFEBFE00",
        ]
    );
    assert!(matches!(node.take_trouble(), Some(StationError::Silent { from: 0xF9, .. })));
    let too_long = node.send(0xFECA, GLOBAL, 6, vec![0; 1786]);
    assert_eq!(too_long, Err(NotSent::TooLong { length: 1786, most: 1785 }));
}

#[test]
fn two_nodes_pass_a_long_message_by_clear_to_send() {
    let (mut a, mut b) = (owner(NAME, 0), owner(6, 1));
    let message: Vec<u8> = (0..200).map(|at| at as u8).collect();
    a.send(0xEF00, 1, 6, message.clone()).unwrap();
    for now_ns in 0..100 {
        while let Some(frame) = a.next(now_ns) {
            hear(&mut b, now_ns, &frame);
            a.sent(now_ns);
        }
        while let Some(frame) = b.next(now_ns) {
            hear(&mut a, now_ns, &frame);
            b.sent(now_ns);
        }
    }
    assert_eq!(b.take_message(), Some(GroupMessage { pgn: 0xEF00, from: 0, data: message }));
    assert_eq!((a.take_trouble(), a.to_one.is_empty()), (None, true));
}

#[test]
fn fast_packets_of_a_group_are_counted() {
    let mut node = owner(NAME, 35);
    for _ in 0..2 {
        node.send_fast(129_029, 3, &[7; 8]).unwrap();
    }
    let sent = drain(&mut node, 0);
    assert_eq!(sent[0], "0DF80523#0008070707070707");
    assert_eq!(sent[2], "0DF80523#2008070707070707");
    assert!(node.send_fast(129_029, 3, &[0; 224]).is_err());
}
