use super::library::Library;
use super::*;

fn of(generation: Generation, sources: &[(&str, &str)]) -> (Library, Vec<String>) {
    let sources: Vec<_> = sources
        .iter()
        .map(|(path, text)| DsdlSource { path: (*path).into(), text: (*text).into() })
        .collect();
    let mut problems = Vec::new();
    let library = Library::of(generation, &sources, &mut problems);
    (library, problems)
}

#[test]
fn all_that_is_built_in_is_understood() {
    let (types, problems) = DataTypes::with(&[]);
    assert_eq!(problems, [""; 0]);
    let counts = [Generation::DroneCan, Generation::Cyphal].map(|of| types.of(of).all().len());
    assert_eq!(counts, [147, 257]);
    // No two of DroneCAN's have the same number, so that nothing has to be guessed.
    let dronecan = types.of(Generation::DroneCan);
    for definition in dronecan.all() {
        let Some(port) = definition.port else { continue };
        let count = match definition.response {
            Some(_) => dronecan.services(port).count(),
            None => dronecan.messages(port).count(),
        };
        assert_eq!(count, 1, "{}", definition.name);
    }
}

/// Signatures as the Python package dronecan gives them; the peers' test shows that all of them fit.
#[test]
fn signatures_are_those_of_the_definitions() {
    let types = DataTypes::built_in();
    for (name, signature) in [
        ("uavcan.protocol.NodeStatus", 0x0F08_68D0_C1A7_C6F1),
        ("uavcan.protocol.GetNodeInfo", 0xEE46_8A81_21C4_6A9E),
        ("uavcan.protocol.param.GetSet", 0xA7B6_22F9_39D1_A4D5),
    ] {
        assert_eq!(types.of(Generation::DroneCan).named(name).unwrap().signature, signature, "{name}");
    }
}

#[test]
fn constants_are_what_values_mean() {
    let types = DataTypes::built_in();
    let meaning = |generation, name: &str, member: &str, value: i64| {
        let definition = types.of(generation).named(name).unwrap();
        let member = definition.request.members.iter().find(|one| one.name == member).unwrap();
        meaning::of(member, value)
    };
    let of = |name: &str, member: &str, value| meaning(Generation::DroneCan, name, member, value);
    assert_eq!(of("uavcan.protocol.NodeStatus", "mode", 3).as_deref(), Some("software_update"));
    assert_eq!(of("uavcan.protocol.NodeStatus", "mode", 4), None);
    assert_eq!(of("uavcan.protocol.NodeStatus", "uptime_sec", 1), None);
    assert_eq!(of("uavcan.protocol.debug.LogLevel", "value", 2).as_deref(), Some("warning"));
    let flags = "uavcan.equipment.power.BatteryInfo";
    assert_eq!(of(flags, "status_flags", 5).as_deref(), Some("in_use, charged"));
    assert_eq!(of(flags, "state_of_health_pct", 127).as_deref(), Some("unknown"));
    assert_eq!(of(flags, "state_of_health_pct", 100), None);
    let health = meaning(Generation::Cyphal, "uavcan.node.Health.1.0", "value", 3);
    assert_eq!(health.as_deref(), Some("warning"));
}

#[test]
fn a_users_types_come_first_and_what_is_wrong_is_said_with_its_place() {
    let own = [
        ("own/20999.Engine.uavcan", "uint8 gear\nOther[<=2] others\n"),
        ("own/Other.uavcan", "uint8 GEAR_X = 1\nuint4 a\nvoid4\n"),
        ("own/Broken.uavcan", "uint8\n"),
        ("own/Missing.uavcan", "Nothing nothing\n"),
        ("own/Huge.uavcan", "uint8[<=99999999] data\n"),
        ("own/Round.uavcan", "Trip trip\n"),
        ("own/Trip.uavcan", "Round round\n"),
        ("own/Line.uavcan", "uint8 a\n@pragma\n"),
    ];
    let (library, problems) = of(Generation::DroneCan, &own);
    assert!(library.named("own.Engine").is_some() && library.messages(20_999).count() == 1);
    assert_eq!(library.named("own.Other").unwrap().request.least_bits, 8);
    let expected = [
        "own/Broken.uavcan: line 1: neither a field nor a constant",
        "own/Line.uavcan: line 2: a directive that is not known",
        "own.Missing: line 1: there is no type own.Nothing",
        "own.Huge: line 1: an array of 99999999 elements",
    ];
    for problem in expected {
        assert!(problems.iter().any(|one| one == problem), "{problem}: {problems:?}");
    }
    assert!(problems.iter().any(|problem| problem.ends_with("its types contain each other")), "{problems:?}");
    assert!(library.named("own.Round").is_none() && library.named("own.Huge").is_none());
    let own = DsdlSource { path: "own/7509.Mine.2.0.dsdl".into(), text: "uint8 a\n@sealed\n".into() };
    let (mut types, problems) = DataTypes::with(&[own]);
    assert_eq!(problems, [""; 0]);
    let first = types.of(Generation::Cyphal).messages(7509).next().unwrap();
    assert_eq!(first.name, "own.Mine.2.0");
    assert_eq!(types.name_subject(5, "own.Mine.2.0"), Ok(()));
    assert!(
        types.name_subject(5, "own.Mine").is_err() && types.name_subject(5, "uavcan.file.List.0.2").is_err()
    );
}

/// What is condensed says the same, and condensing it again changes nothing.
#[test]
fn condensed_definitions_say_the_same() {
    let text = "# What it is.\nuint8 X = 2 ** 3  # [V] eight\n\nuint8[<=X]   data   # [Volt] of something\n@assert _offset_ % 8 == {0}\n---\n@sealed\n";
    let source = DsdlSource { path: "own/5.A.1.0.dsdl".into(), text: text.into() };
    let short = condensed(&[source]);
    assert_eq!(short, "=== own/5.A.1.0.dsdl\nuint8 X = 2 ** 3\nuint8[<=X] data # V\n---\n@sealed\n");
    let again: Vec<_> = condensed::split(&short).collect();
    assert_eq!(condensed(&again), short);
    for text in [include_str!("../../data/dronecan.dsdl"), include_str!("../../data/cyphal.dsdl")] {
        let all: Vec<_> = condensed::split(text).collect();
        assert!(text.ends_with(&condensed(&all)), "the files are condensed");
    }
}

/// Definitions and messages of random bytes: no panic, and an end.
#[test]
fn anything_is_taken() {
    let mut random = fastrand::Rng::with_seed(25);
    let words = [
        "uint8", "int3", "float16", "[<=", "[", "]", "A", "B.1.0", " ", "\n", "=", "2 ** 9", "@union", "---",
        "@sealed", "void3", "name", "'",
    ];
    for _ in 0..3000 {
        let text: String = (0..random.usize(0..30)).map(|_| words[random.usize(0..words.len())]).collect();
        let extension = ["uavcan", "1.0.dsdl"][random.usize(0..2)];
        let own = [
            DsdlSource { path: format!("own/{}.A.{extension}", random.u16(..)), text: text.clone() },
            DsdlSource { path: "own/B.1.0.dsdl".into(), text },
        ];
        let _ =
            of(own[0].generation().unwrap(), &[(&own[0].path, &own[0].text), (&own[1].path, &own[1].text)]);
    }
    let types = DataTypes::built_in();
    for generation in [Generation::DroneCan, Generation::Cyphal] {
        let library = types.of(generation);
        for definition in library.all() {
            for section in std::iter::once(&definition.request).chain(&definition.response) {
                for _ in 0..20 {
                    let data: Vec<u8> = (0..random.usize(0..300)).map(|_| random.u8(..)).collect();
                    let mut fields = Vec::new();
                    let _ = read(library, section, &data, random.bool(), "", &mut fields);
                    for field in fields {
                        let _ = field.to_string();
                    }
                }
            }
        }
    }
}

/// Files of a few kilobytes that come to more than any computer does: each of them took hours, or ended the program.
#[test]
fn definitions_of_strangers_are_read_in_a_time_that_grows_with_them() {
    // Each constant names the next one ten times.
    let next = |at: u32| vec![format!("A{}", at + 1); 10].join(" + ");
    let constants = (0..14).map(|at| format!("uint16 A{at} = {}\n", next(at))).collect::<Vec<_>>().concat();
    let (library, problems) =
        of(Generation::DroneCan, &[("a/100.B.uavcan", &format!("{constants}uint16 A14 = 1\nuint8[A9] x\n"))]);
    assert_eq!(problems, [""; 0]);
    assert_eq!(
        library.named("a.B").unwrap().request.members[0].kind,
        model::Kind::Array(model::Kind::Unsigned(8).into(), model::Size::Fixed(100_000))
    );
    // Arrays of arrays, in a union.
    let arrays = [
        ("a/A.uavcan", "uint64[1048576] x\n"),
        ("a/B.uavcan", "A[1048576] x\n"),
        ("a/100.C.uavcan", "@union\nB x\nB y\n"),
    ];
    assert_eq!(of(Generation::DroneCan, &arrays).1, [""; 0]);
    // Many constants beside many fields.
    let pair = |at| format!("uint16 F{at}_A = {at}\nuint16 f{at}\n");
    let many = (0..30_000).map(pair).collect::<Vec<_>>().concat();
    let (library, _) = of(Generation::DroneCan, &[("a/100.B.uavcan", &many)]);
    assert_eq!(library.named("a.B").unwrap().request.members[29_999].meanings, [(29_999, "a".to_owned())]);
    // Types in types, of which the innermost has no length.
    let inner = |at: u32| {
        let member = |field| format!("T{}.1.0 f{field}\n", at + 1);
        (0..30).map(member).collect::<Vec<_>>().concat() + "@sealed\n"
    };
    let mut sources: Vec<_> = (0..12).map(|at| (format!("a/T{at}.1.0.dsdl"), inner(at))).collect();
    sources.push(("a/T12.1.0.dsdl".to_owned(), "@sealed\n".to_owned()));
    let sources: Vec<_> = sources.iter().map(|(path, text)| (path.as_str(), text.as_str())).collect();
    let (library, problems) = of(Generation::Cyphal, &sources);
    assert_eq!(problems, [""; 0]);
    let outermost = &library.named("a.T0.1.0").unwrap().request;
    assert!(read::read(&library, outermost, &[0; 8], false, "", &mut Vec::new()).is_err());
}
