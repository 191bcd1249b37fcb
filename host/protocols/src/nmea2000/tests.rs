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

/// A field's value as a text, if a value can be given for it: by number, or by name.
fn text_of(field: &crate::Field, by_name: bool) -> Option<String> {
    use crate::Value;
    let meaning = field.text.as_deref();
    if matches!(meaning, Some("out of range" | "error" | "cut")) {
        return None;
    }
    match &field.value {
        Value::Missing => None,
        Value::Text(text) => Some(text.to_string()).filter(|text| !text.contains('\u{FFFD}')),
        Value::Bytes(bytes) => Some(hex(bytes)),
        Value::Hex(number, _) => Some(format!("0x{number:X}")),
        Value::Number(number) => Some(match meaning.filter(|_| by_name) {
            Some(name) if values::whole(name).is_none() => name.to_owned(),
            _ if *number < 0 => number.to_string(),
            _ => format!("0x{number:X}"),
        }),
        Value::Real(number) => Some(match meaning.filter(|_| by_name) {
            // A date or a time of day, of which there are none from 24 o'clock on.
            Some(text) if field.unit == "d" || *number < 86400.0 => text.to_owned(),
            _ => format!("{number} {}", field.unit),
        }),
    }
}

/// Each field with how many of its name there were before, from 1.
fn numbered(fields: &[crate::Field]) -> Vec<((String, usize), &crate::Field)> {
    let mut seen = std::collections::HashMap::<String, usize>::new();
    let mut numbered = Vec::new();
    for field in fields {
        let name = values::plain(&field.name);
        let count = seen.entry(name.clone()).or_default();
        *count += 1;
        numbered.push(((name, *count), field));
    }
    numbered
}

/// Encodes what random bytes mean, and reads it back. `None` if it does not fit into a message.
fn comes_back(group: &'static database::Group, data: &[u8], by_name: bool) -> Option<Vec<u8>> {
    let mut read = Vec::new();
    fields::read(group, data, &mut read);
    let counts: Vec<_> = (1..=group.fields.len())
        .filter(|order| {
            [group.set_1_count, group.set_2_count].contains(order)
                || group.fields.iter().any(|field| field.bit_length_field == Some(*order))
                || group.fields[order - 1].field_type == Kind::DynamicFieldLength
                || group.fields[order - 1].wanted.is_some()
        })
        .map(|order| values::plain(&group.fields[order - 1].name))
        .collect();
    let (mut given, mut cut) = (Vec::new(), false);
    for ((name, number), field) in numbered(&read) {
        if !counts.contains(&name)
            && let Some(text) = text_of(field, by_name)
        {
            given.push((format!("{name}_{number}"), text));
        }
    }
    let written = loop {
        let pairs: Vec<_> = given.iter().map(|(name, text)| (name.as_str(), text.as_str())).collect();
        match encode::encode_as(group, &pairs) {
            Ok(written) => break written,
            Err(EncodeError::TooLong { .. }) => return None,
            // Random bytes may say that a key's value is longer than the key has it.
            Err(EncodeError::Value { .. })
                if group.fields.iter().any(|field| field.field_type == Kind::DynamicFieldValue) =>
            {
                return None;
            }
            Err(EncodeError::Needed { fields }) => {
                given.splice(0..0, fields.into_iter().map(|name| (name, "0".to_owned())));
            }
            // Bytes that the end of the data has cut.
            Err(EncodeError::Value { text, .. }) if given.last().is_some_and(|(_, last)| *last == text) => {
                given.pop();
                cut = true;
            }
            Err(error) => panic!("{} {}: {error}; {given:?}", group.pgn, group.description),
        }
    };
    let mut back = Vec::new();
    fields::read(group, &written, &mut back);
    let back = numbered(&back);
    let last = read.len() - usize::from(cut);
    for (place, field) in numbered(&read[..last]) {
        if counts.contains(&place.0) || text_of(field, by_name).is_none() {
            continue;
        }
        let same = back.iter().find(|(other, _)| *other == place);
        let is_same =
            same.is_some_and(|(_, other)| match (field.value.as_number(), other.value.as_number()) {
                (Some(one), Some(other)) if (one - other).abs() > 0.0 => {
                    (one - other).abs() <= 1e-9 * one.abs() || by_name
                }
                _ => {
                    field.text == other.text
                        && (field.value == other.value || by_name || field.value.as_number().is_some())
                }
            });
        assert!(is_same, "{} {}: {field} came back as {same:?}", group.pgn, group.description);
    }
    Some(written)
}

/// A position as canboat's own sample of it, values by name with and without units, and what is not given.
#[test]
fn values_by_name_become_the_bytes_of_their_group() {
    let made =
        encode("position, rapid update", &[("latitude", "37.9220534"), ("Longitude", "23.016909 deg")]);
    assert_eq!(
        made,
        Ok(EncodedGroup {
            pgn: 129_025,
            name: "Position, Rapid Update",
            priority: Some(2),
            data: vec![0x36, 0x72, 0x9A, 0x16, 0x02, 0x1A, 0xB8, 0x0D],
        })
    );
    let bytes = |group: &str, values: &[(&str, &str)]| encode(group, values).map(|made| hex(&made.data));
    assert_eq!(
        bytes("130306", &[("wind_speed", "6.0 m/s"), ("Reference", "apparent")]).as_deref(),
        Ok("FF5802FFFFFAFFFF")
    );
    // Repeated fields are counted, a date is a date, a time a time.
    let values = [
        ("Date", "2026-11-30"),
        ("Time", "12:00:00.5"),
        ("GNSS type", "GPS"),
        ("Method", "GNSS fix"),
        ("Integrity", "0"),
        ("Reference Station ID_2", "7"),
    ];
    let position = encode("GNSS Position Data", &values).unwrap();
    let mut fields = Vec::new();
    describe(position.pgn, &position.data, &mut fields);
    let fields: Vec<_> = fields.iter().map(ToString::to_string).collect();
    let said = fields.join(", ");
    assert!(
        said.starts_with("SID not available, Date 20787 d (2026-11-30), Time 43200.5 s (12:00:00.5), Latitude not available, "),
        "{said}"
    );
    assert!(
        said.contains("GNSS type 0 (GPS), Method 1 (GNSS fix), ")
            && said.contains("Reference Stations 2, ")
            && said.ends_with("Reference Station ID 7, Age of DGNSS Corrections not available"),
        "{said}"
    );
    assert_eq!(position.data.len(), 43 + 8);
    // The length of a key's value is the key's.
    let keys = encode(
        "B&G: key-value data",
        &[("Key", "Wind Direction"), ("Value", "1.5 rad"), ("Key_2", "0xFFF"), ("Value_2", "0102")],
    );
    let keys = keys.unwrap();
    let mut fields = Vec::new();
    describe(keys.pgn, &keys.data, &mut fields);
    let said: Vec<_> = fields.iter().skip(2).map(ToString::to_string).collect();
    assert!(said[0].ends_with("(Wind Direction)"), "{said:?}");
    assert_eq!(said[1..3], ["Length 2 bytes", "Value 1.5 rad"]);
    assert_eq!(said[3..], ["Key 4095", "Length 2 bytes", "Value 01 02"]);
    let text = |group: &str, values: &[(&str, &str)]| encode(group, values).unwrap_err().to_string();
    for (group, values, expected) in [
        ("whereabouts", &[][..], "CANboat's database has no group 'whereabouts'"),
        ("Rapid Update", &[], "CANboat's database has no group 'Rapid Update'; there are "),
        (
            "129025",
            &[("depth", "1")],
            "Position, Rapid Update has no field 'depth'; it has Latitude, Longitude",
        ),
        ("129025", &[("latitude", "90.1")], "Latitude cannot be '90.1': it is from -90 to 90 deg"),
        ("129025", &[("latitude", "1 rad")], "Latitude cannot be '1 rad': it is a number in deg"),
        ("129025", &[("latitude_2", "1")], "Position, Rapid Update has no field 'latitude_2'"),
        ("130306", &[("reference", "north")], "Reference cannot be 'north': it is a number, or one of: "),
        ("129029", &[("number_of_svs", "253")], "Number of SVs cannot be '253': it is from 0 to 252"),
        ("129029", &[("date", "1969-12-31")], "Date cannot be '1969-12-31': it is from 0 to 65532 d"),
        ("126720", &[], "'126720' is one of several groups; name one: "),
    ] {
        let said = text(group, values);
        assert!(said.starts_with(expected), "{said}");
    }
    let needed = text("GNSS Position Data", &[]);
    assert!(
        needed.starts_with("GNSS type, Method, Integrity have no value for")
            || needed.starts_with("Integrity has no value for"),
        "{needed}"
    );
}

/// Whatever a user writes for a field is a value, or refused with a reason.
#[test]
fn any_texts_are_taken_as_values() {
    let mut random = fastrand::Rng::with_seed(2003);
    let words = [
        "",
        "-",
        "0x",
        "0xFFFFFFFFFFFFFFFF",
        "-1",
        "1e300",
        "NaN",
        "inf",
        "99999999999999999999",
        "2026-02-30",
        "25:00",
        "12:60",
        ":",
        "9999-12-31",
        "bit 70",
        "bit 3, bit 63",
        "00",
        "0G",
        "é",
        "On",
        "1.5 rad",
        "0102",
        "_",
        "\u{0}",
    ];
    let (mut made, mut refused) = (0, 0);
    for group in Database::get().all() {
        for _ in 0..10 {
            let fields: Vec<_> = group.fields.iter().filter(|_| random.u8(..) < 90).collect();
            let values: Vec<_> =
                fields.iter().map(|field| (field.name.as_str(), random.choice(words).unwrap())).collect();
            match encode::encode_as(group, &values) {
                Ok(data) => {
                    made += 1;
                    fields::read(group, &data, &mut Vec::new());
                }
                Err(error) => {
                    refused += 1;
                    assert!(error.to_string().len() > 10);
                }
            }
        }
    }
    assert!(made > 100 && refused > 100, "{made} {refused}");
}

/// What random bytes mean in every group of the database, given as texts, is read back the same.
#[test]
fn random_values_of_every_group_come_back() {
    let mut random = fastrand::Rng::with_seed(2002);
    let (mut groups, mut messages) = (0, 0);
    for group in Database::get().all().iter().filter(|group| !group.fallback) {
        let mut whole = 0;
        for round in 0..40 {
            let length = random.usize(0..if round % 2 == 0 { 60 } else { 200 });
            let byte = |random: &mut fastrand::Rng| {
                if random.bool() { random.u8(b' '..b'~') } else { random.u8(..) }
            };
            let data: Vec<u8> = (0..length).map(|_| byte(&mut random)).collect();
            whole += usize::from(comes_back(group, &data, round % 3 == 0).is_some());
        }
        assert!(whole > 0, "{} {}", group.pgn, group.description);
        groups += 1;
        messages += whole;
    }
    assert!(groups == 535 && messages > 20_000, "{groups} {messages}");
}
