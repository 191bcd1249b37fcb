//! BUSMASTER's databases: as its own programs write them, and as canmatrix does, which writes the same database as DBC too.

use super::signals_agree_with_cantools::{own_files, peer_or_skip};
use cantap_signals::{ByteOrder, Database, Message, Signal, dbf, load};
use std::path::Path;

pub const FILE: &str = "//******************************BUSMASTER Messages and signals Database ******************************//\n\n\
[DATABASE_VERSION] 1.3\n\n[PROTOCOL] CAN\n\n[BUSMASTER_VERSION] [3.2.2]\n[NUMBER_OF_MESSAGES] 3\n\n\
[START_MSG] Engine,291,8,4,1,S,Ecu\n\
[START_SIGNALS] Mode,2,1,0,U,3,0,1,0.000000,1.000000,,M,\n\
[VALUE_DESCRIPTION] \"Off, or asleep\",0\n[VALUE_DESCRIPTION] on,1\n\
[START_SIGNALS] Speed,12,3,4,U,4000,0,0,-40.000000,0.100000,km/h,m1,\n\
[START_SIGNALS] Torque,16,4,0,I,32767,-32768,1,0.000000,0.500000,Nm,m2,\n\
[START_SIGNALS] Ready,1,8,7,B,1,0,1,0.000000,1.000000,,,\n[END_MSG]\n\n\
[START_MSG] Far,419361024,8,1,1,X\n[START_SIGNALS] All,64,1,0,U,-1,0,1,0.000000,1.000000,,\n[END_MSG]\n\n\
[START_MSG] Lost,5000000000,8,0,1,X\n[END_MSG]\n\n\
[START_DESC]\n[START_DESC_MSG]\n291 S \"What the engine says\";\n[END_DESC_MSG]\n\
[START_DESC_SIG]\n291 S Speed \"Over ground\";\n999 S X \"nobody\";\n[END_DESC_SIG]\n[END_DESC]\n\
[START_PARAM]\n[START_PARAM_MSG_VAL]\n291,S,\"GenMsgCycleTime\",100\n[END_PARAM_MSG_VAL]\n[END_PARAM]\n";

#[test]
fn a_database_of_busmaster_is_read() {
    let database = dbf::parse("x.dbf", FILE.as_bytes()).unwrap();
    let names: Vec<_> = database.messages.iter().map(|message| message.name.as_str()).collect();
    assert_eq!(names, ["Engine", "Far"]);
    let [engine, far] = &database.messages[..] else { panic!("{names:?}") };
    assert_eq!((engine.id.to_string(), far.id.to_string()), ("123".to_owned(), "18FEF100".to_owned()));
    assert_eq!((engine.cycle_ms, engine.description.as_str()), (Some(100), "What the engine says"));
    let [mode, speed, torque, ready] = &engine.signals[..] else { panic!("{engine:?}") };
    assert!(mode.is_switch);
    assert_eq!(mode.values.iter().collect::<Vec<_>>(), [(0, "Off, or asleep"), (1, "on")]);
    // Its lowest bit is bit 4 of the third byte, and its highest bit 7 of the second.
    assert_eq!((speed.order, speed.start, speed.offset, speed.max), (ByteOrder::Big, 15, -40.0, Some(360.0)));
    assert_eq!(speed.description, "Over ground");
    assert_eq!((torque.order, torque.start, torque.min), (ByteOrder::Little, 24, Some(-16384.0)));
    assert_eq!((ready.start, ready.multiplexed.is_some(), torque.multiplexed.is_some()), (63, false, true));
    assert_eq!((far.signals[0].length, far.signals[0].max), (64, None));
    let warnings: Vec<_> = database.warnings.iter().map(ToString::to_string).collect();
    assert!(
        warnings.len() == 2
            && warnings[0].contains("Lost")
            && warnings[1].contains("there is no such message"),
        "{warnings:?}"
    );
}

#[test]
fn a_number_of_a_group_stands_for_the_identifier_in_one_for_j1939() {
    let file = "[PROTOCOL] J1939\n[NUMBER_OF_MESSAGES] 1\n[START_MSG] EEC1,61444,8,1,1,X\n\
                [START_SIGNALS] Rpm,16,4,0,U,64255,0,1,0.000000,0.125000,rpm,\n[END_MSG]\n";
    let database = dbf::parse("x.dbf", file.as_bytes()).unwrap();
    let message = &database.messages[0];
    assert_eq!((message.id.raw() >> 8 & 0x3FFFF, message.j1939), (61444, true));
}

#[test]
fn what_is_no_such_database_or_has_faults_says_so() {
    for (text, reason) in [
        ("", "there is no [NUMBER_OF_MESSAGES]"),
        ("\u{3}\0\0dBase", "there is no [NUMBER_OF_MESSAGES]"),
        ("[START_MSG] A,x,8,0,1,S\n", "has no valid identifier"),
        ("[START_MSG] A,1,8,1,1,S\n[START_SIGNALS] S,8,0,0,U,1,0,1,0,1,,\n[END_MSG]\n", "a byte from 1"),
        (
            "[START_MSG] A,1,8,1,1,S\n[START_SIGNALS] S,16,1,0,U,1,0,0,0,1,,\n[END_MSG]\n",
            "before the message",
        ),
        ("[START_MSG] A,1,8,1,1,S\n[START_SIGNALS] S,8,1,0,Q,1,0,1,0,1,,\n[END_MSG]\n", "type"),
        ("[START_MSG] A,1,8,1,1,S\n[START_SIGNALS] S\n[END_MSG]\n", "length"),
    ] {
        let error = dbf::parse("x.dbf", text.as_bytes()).unwrap_err().to_string();
        assert!(error.contains(reason), "{text}: {error}");
    }
}

/// Everything that values depend on. canmatrix's limits are not ours: it leaves the offset out of them.
fn content(database: &Database) -> Vec<String> {
    let signal = |message: &Message, signal: &Signal| {
        let Signal { name, start, length, order, kind, factor, offset, unit, multiplexed, .. } = signal;
        let values: Vec<_> = signal.values.iter().collect();
        let present =
            multiplexed.as_ref().map(|present| (&message.signals[present.switch].name, &present.values));
        format!(
            "{name} {start} {length} {order:?} {kind:?} {factor} {offset} {unit:?} {values:?} {present:?}"
        )
    };
    let mut all: Vec<_> = database
        .messages
        .iter()
        .map(|message| {
            let mut signals: Vec<_> = message.signals.iter().map(|one| signal(message, one)).collect();
            signals.sort();
            format!(
                "{} {} {} {:?}: {}",
                message.id,
                message.name,
                message.length,
                message.cycle_ms,
                signals.join("; ")
            )
        })
        .collect();
    all.sort();
    all
}

#[test]
fn what_canmatrix_writes_as_dbf_is_what_it_writes_as_dbc() {
    let cache = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cantools");
    std::fs::create_dir_all(&cache).unwrap();
    let files = own_files();
    let arguments =
        [Path::new("dbf"), &cache].into_iter().chain(files.iter().map(std::path::PathBuf::as_path));
    let Some(list) = peer_or_skip(&arguments.collect::<Vec<_>>(), 0) else { return };
    let mut compared = 0;
    for line in list.lines() {
        let (dbf, dbc) = line.split_once('\t').unwrap();
        let [Ok(dbf), Ok(dbc)] = [dbf, dbc].map(|path| load(Path::new(path))) else { continue };
        let mut dbc = dbc;
        // It leaves out messages with several multiplexers.
        dbc.messages.retain(|message| dbf.messages.iter().any(|other| other.id == message.id));
        assert_eq!(content(&dbf), content(&dbc), "{line}");
        compared += dbc.messages.len();
    }
    assert!(compared > 10, "{compared} of {list}");
}
