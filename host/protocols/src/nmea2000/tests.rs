use super::database::{Condition, Database, Kind};
use super::*;
use crate::Event;
use crate::j1939::J1939;
use crate::testing::{self, at, hex};

fn marine(frames: &[(f64, &str)]) -> Vec<String> {
    testing::event_lines(J1939::nmea2000(None), frames)
}

#[test]
fn the_database_is_whole_and_all_of_it_is_understood() {
    let database = Database::get();
    assert!(database.entries > 540, "{}", database.entries);
    for group in database.all() {
        assert!(["Single", "Fast", "ISO", "Mixed"].contains(&group.kind.as_str()), "{}", group.kind);
        for field in &group.fields {
            assert_ne!(field.field_type, Kind::Unknown, "{}: {}", group.pgn, field.name);
            assert_ne!(field.condition, Some(Condition::Unknown), "{}: {}", group.pgn, field.name);
            let known =
                |name: &Option<String>, there: &dyn Fn(&str) -> bool| name.as_deref().is_none_or(there);
            assert!(
                known(&field.lookup_enumeration, &|name| database.lookups.contains_key(name)),
                "{}",
                field.name
            );
            assert!(
                known(&field.lookup_bit_enumeration, &|name| database.bits.contains_key(name)),
                "{}",
                field.name
            );
            assert!(
                known(&field.lookup_field_type_enumeration, &|name| database.kinds.contains_key(name)),
                "{}",
                field.name
            );
        }
    }
}

#[test]
fn single_frames_and_fast_packets_have_their_values() {
    assert_eq!(
        marine(&[(0.0, "09F80102#36729A16021AB80D")]),
        [
            "nmea2000 2 > all Position, Rapid Update: pgn 129025, priority 2, Latitude 37.9220534 deg, Longitude 23.016909 deg"
        ]
    );
    let said = marine(&[
        (0.0, "0DF80503#402B01B73CA0DC92"),
        (1.0, "0DF80503#4116004286A6E742"),
        (2.0, "0DF80503#4205008AC87C0F10"),
        (3.0, "0DF80503#4332030000000000"),
        (4.0, "0DF80503#4400000010FC0A5A"),
        (5.0, "0DF80503#4500B40000000000"),
        (6.0, "0DF80503#4600FFFFFFFFFFFF"),
    ]);
    assert_eq!(said.len(), 1, "{said:?}");
    assert!(
        said[0].contains("GNSS Position Data") && said[0].contains("Date 15543 d (2012-07-22)"),
        "{said:?}"
    );
}

/// A manufacturer's code is there only if the group is a manufacturer's own; canboatjs reads the same.
#[test]
fn fields_that_are_not_always_there_are_read_where_they_are() {
    let event_lines = |data: &[u8]| {
        let mut fields = Vec::new();
        describe(126_208, data, &mut fields);
        fields.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
    };
    // Reading fields of a position: unique number 7, no selection, one parameter.
    let position = event_lines(&[3, 0x01, 0xF8, 0x01, 7, 0, 1, 2]);
    assert!(
        position.contains("Unique ID 7, Number of Selection Pairs 0, Number of Parameters 1"),
        "{position}"
    );
    assert!(!position.contains("Manufacturer Code"), "{position}");
    let own = event_lines(&[3, 0x00, 0xFF, 0x01, 0x89, 0x98, 7, 0, 1, 2]);
    assert!(own.contains("Manufacturer Code 137 (Maretron)") && own.contains("Unique ID 7, "), "{own}");
}

/// A heading of more than a whole turn, and a number of two bits whose highest value is one.
#[test]
fn values_are_said_to_be_out_of_their_range() {
    let said = marine(&[(0.0, "09F11203#00FEFEFF7FFF7FFC"), (1.0, "09F11203#00FFFFFF7FFF7FFC")]);
    assert!(said[0].contains("Heading 6.5278 rad (out of range)"), "{said:?}");
    assert!(said[1].contains("Heading not available"), "{said:?}");
    let mut fields = Vec::new();
    describe(129_795, &[6, 0x15, 0xCD, 0x5B, 0x07, 0xC0, 0, 0, 0, 0, 0], &mut fields);
    let sequence = fields.iter().find(|field| field.name == "Sequence Number").unwrap();
    assert_eq!(sequence.value.as_number(), Some(3.0), "{fields:?}");
}

#[test]
fn a_missing_frame_of_a_packet_is_said_once() {
    let said = marine(&[
        (0.0, "0DF80503#402B01B73CA0DC92"),
        (2.0, "0DF80503#4205008AC87C0F10"),
        (3.0, "0DF80503#4332030000000000"),
    ]);
    assert_eq!(said.len(), 1);
    assert!(said[0].ends_with("received 6 bytes; frame 2 came instead of 1"), "{said:?}");
}

/// Every group of the database with random bytes: no panic, and no field reads beyond the data.
#[test]
fn any_bytes_are_taken() {
    let mut random = fastrand::Rng::with_seed(2000);
    for group in Database::get().all() {
        for _ in 0..40 {
            let data: Vec<u8> = (0..random.usize(0..224)).map(|_| random.u8(..)).collect();
            let mut said = Vec::new();
            fields::read(group, &data, &mut said);
            let mut said = Vec::new();
            let _ = describe(group.pgn, &data, &mut said);
            for field in said {
                let _ = field.to_string();
            }
        }
    }
}

/// Packets from several senders at the same time, with some frames dropped, repeated or swapped.
#[test]
fn packets_at_random_are_whole_and_right_or_said_to_be_broken() {
    let mut random = fastrand::Rng::with_seed(2001);
    for round in 0..200 {
        let (mut queues, mut sent) = (Vec::new(), Vec::new());
        for source in 0..4_u8 {
            let mut queue = Vec::new();
            for counter in 0..5_u8 {
                let data: Vec<u8> = (0..random.usize(9..224)).map(|_| random.u8(..)).collect();
                let mut first = vec![counter << 5, data.len() as u8];
                first.extend(&data[..6]);
                queue.push(format!("0DF805{source:02X}#{}", hex(&first)));
                for (at, chunk) in data[6..].chunks(7).enumerate() {
                    let mut bytes = vec![counter << 5 | (at + 1) as u8];
                    bytes.extend(chunk);
                    bytes.resize(8, 0xFF);
                    queue.push(format!("0DF805{source:02X}#{}", hex(&bytes)));
                }
                sent.push((source, data));
            }
            queue.reverse();
            queues.push(queue);
        }
        let mut lines = Vec::new();
        while queues.iter().any(|queue| !queue.is_empty()) {
            let source = random.usize(0..queues.len());
            lines.extend(queues[source].pop());
        }
        let disturbed = round % 3 > 0;
        if disturbed {
            testing::disturb(&mut lines, &mut random);
        }
        let records: Vec<_> = lines.iter().enumerate().map(|(ms, frame)| at(ms as f64, frame)).collect();
        let events: Vec<Event> = testing::events(J1939::nmea2000(None), &records);
        let whole: Vec<_> = events.iter().filter(|event| event.trouble.is_none()).collect();
        for event in &whole {
            let source = event.from.node().unwrap();
            assert!(sent.contains(&(source, event.data.to_vec())), "round {round}: never sent: {event}");
        }
        assert!(
            if disturbed { whole.len() >= 10 } else { events.len() == 20 && whole.len() == 20 },
            "round {round}"
        );
    }
}
