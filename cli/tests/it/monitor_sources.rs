//! Where the live view's records come from, and where they go: files with faults in them, the emulated board, conditional
//! recordings.
#![cfg(unix)]

use crate::firmware;
use crate::port;
use crate::terminal;

use std::fmt::Write as _;
use std::path::Path;

use cantap_formats::{ReadOptions, open_reader};
use terminal::Terminal;

fn write(folder: &Path, name: &str, text: &str) -> String {
    let path = folder.join(name);
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

#[test]
fn what_cannot_be_read_in_a_file_is_counted_and_the_first_of_it_shown() {
    let folder = tempfile::tempdir().unwrap();
    let file = write(
        folder.path(),
        "faulty.log",
        "(1.0) can0 123#11\n(1.1) can0 nonsense\n(1.2) can0 124#22\nand more of it\n(1.3) can0 125#33\n",
    );
    let mut view = Terminal::start(&format!("monitor {file} --view statistics"), (120, 24));
    view.wait_for("2 unreadable");
    let text = view.wait_for("2 places could not be read and are left out, the first: ");
    assert!(text.contains("faulty.log:2") || text.contains("line 2"), "{text}");
    view.keys("2");
    view.wait_until("the rest", |screen| ["123", "124", "125"].iter().all(|id| screen.contains(id)));
    // Once more from its beginning: counted from zero, not added.
    view.keys("l");
    view.wait_for("loop");
    view.keys("5");
    view.wait_for("2 unreadable");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

/// What is said in the first seconds waits until the protocols are known.
#[test]
fn what_a_short_file_says_is_there_at_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = String::new();
    for n in 0..4 {
        writeln!(log, "(1.{n}00000) can0 7E0#0322F19000000000\n(1.{n}10000) can0 7E8#0562F1904142").unwrap();
    }
    let file = write(folder.path(), "short.log", &log);
    let mut view = Terminal::start(&format!("monitor {file} --view nodes"), (120, 24));
    view.wait_for("ReadDataByIdentifier");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn a_file_is_played_slower_faster_stopped_and_by_steps_and_left_for_a_device() {
    let folder = tempfile::tempdir().unwrap();
    let mut log = String::new();
    for n in 0..1000 {
        writeln!(log, "({}.{:06}) can0 {:03X}#11", n / 10, n % 10 * 100_000, n % 8).unwrap();
    }
    let file = write(folder.path(), "long.log", &log);
    let mut view = Terminal::start(&format!("monitor {file} -b 500k --view trace"), (120, 24));
    view.wait_for("playing ×1 ");
    view.keys(",");
    view.wait_for("×0.5 ");
    view.keys("p");
    view.wait_for("stopped");
    let rows = |screen: &str| screen.lines().filter(|line| line.contains(" D 1 11")).count();
    let before = rows(&view.text());
    view.keys(">>");
    view.wait_until("two more", |screen| rows(screen) == before + 2);
    view.keys("p..........");
    view.wait_for("ended as fast as possible");
    // It sends nothing, and says what would be needed.
    view.keys("6a123#1122\r\r");
    view.wait_for("a file sends nothing; open a device with D");
    view.keys("D\x15virtual:load=30\r");
    view.wait_for("virtual:load=30 listen-only: running");
    view.keys("5");
    view.wait_for("Channel 1: 500000 bit/s");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn a_recording_on_a_condition_has_what_is_around_the_events_only() {
    let folder = tempfile::tempdir().unwrap();
    let database = write(
        folder.path(),
        "car.toml",
        "version = 1\n[[message]]\nname = \"Engine\"\nid = 0x123\nlength = 1\n[[message.signal]]\nname = \"Speed\"\nat = \"D1\"\n",
    );
    // A minute, ten frames a second, fast only at 30 s.
    let mut log = String::new();
    for n in 0..600 {
        let speed = if n == 300 { 100 } else { 10 };
        writeln!(log, "({}.{}) can0 123#{speed:02X}", n / 10, n % 10).unwrap();
    }
    let file = write(folder.path(), "drive.log", &log);
    let recording = folder.path().join("fast.asc");
    let mut view = Terminal::start(&format!("monitor {file} -b 500k --db {database}"), (120, 24));
    view.wait_for("playing");
    // An invalid condition is refused, and the message shows it; the line stays to be mended, here from its beginning.
    view.keys(&format!("r{} if Sped > 80\r", recording.display()));
    view.wait_for("nothing is recorded: ");
    view.keys(&format!("\u{15}{} if Speed > 80\r", recording.display()));
    view.wait_for("REC");
    view.keys("..........7");
    view.wait_for("ended");
    view.wait_for("Records   71");
    view.keys("r");
    view.wait_for("71 records are in");
    // A recording is not overwritten by accident.
    view.keys(&format!("r{}\r", recording.display()));
    view.wait_for("already exists; choose another name");
    view.keys("\x1b");
    // Escape immediately followed by a letter would be Alt and that letter.
    view.wait_until("no prompt", |screen| !screen.contains(" > /"));
    view.keys("q");
    assert_eq!(view.end(), 0);
    let records: Vec<_> =
        open_reader(&recording, &ReadOptions::default()).unwrap().map(Result::unwrap).collect();
    let seconds = |at: usize| (records[at].time_ns - records[0].time_ns) as f64 / 1e9;
    assert_eq!(records.len(), 71);
    assert!((seconds(20) - 2.0).abs() < 1e-3 && (seconds(70) - 7.0).abs() < 1e-3);
    assert_eq!(records[20].frame().unwrap().data(), [100]);
}

/// Ten records a second for a hundred seconds, each with its number.
fn hundred_seconds(folder: &Path) -> String {
    let mut log = String::new();
    for n in 0..=1000 {
        writeln!(log, "({}.{:06}) can0 {:03X}#{n:04X}", 5000 + n / 10, n % 10 * 100_000, 0x100 + n % 8)
            .unwrap();
    }
    write(folder, "drive.log", &log)
}

#[test]
fn in_a_file_one_goes_to_any_place_and_sees_what_it_has_up_to_there() {
    let folder = tempfile::tempdir().unwrap();
    let file = hundred_seconds(folder.path());
    let mut view = Terminal::start(&format!("monitor {file} -b 500k --view trace"), (120, 24));
    view.wait_for("drive.log: playing ×1 ");
    view.wait_for("/ 1:40");
    view.keys("pT50%\r");
    let text = view.wait_for("stopped ×1 0:50 / 1:40");
    // The last one before that position, and all before it, once each.
    assert!(text.contains("01 F3") && !text.contains("01 F5"), "{text}");
    view.keys("B5");
    view.wait_for("Frames           500");
    // Back: nothing is there twice.
    view.keys("[");
    view.wait_for("0:40 / 1:40");
    view.wait_for("Frames           400");
    view.keys("}");
    view.wait_for("Frames           500");
    view.keys("]T1:35\r");
    view.wait_for("1:35 / 1:40");
    view.keys(" ");
    view.wait_for("ended ×1 1:40 / 1:40");
    view.wait_for("Frames          1001");
    // At its end it restarts.
    view.keys(" ");
    view.wait_for("playing ×1 0:0");
    view.keys("...");
    view.wait_for("playing ×10 ");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn a_trace_opens_beside_a_device_that_goes_on_being_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let file = hundred_seconds(folder.path());
    let recording = folder.path().join("live.log");
    let line =
        format!("monitor virtual:load=30,frames=std8 -b 500k --view statistics -o {}", recording.display());
    let mut view = Terminal::start(&line, (140, 30));
    view.wait_for("REC");
    view.keys(&format!("D\x15{file}\r"));
    let text = view.wait_for("w 2 of 2");
    assert!(!text.contains("REC"), "{text}");
    view.wait_for("drive.log: playing");
    let size = || std::fs::metadata(&recording).unwrap().len();
    let before = size();
    std::thread::sleep(std::time::Duration::from_millis(1200));
    assert!(size() > before, "{before}");
    view.keys("w");
    let text = view.wait_for("w 1 of 2");
    assert!(
        text.contains("virtual:load=30,frames=std8 listen-only: running") && text.contains("REC"),
        "{text}"
    );
    view.keys("w");
    view.wait_for("w 2 of 2");
    view.keys("W");
    view.wait_until("one source", |screen| !screen.contains("of 2") && screen.contains("REC"));
    view.keys("W");
    view.wait_for("there is no other source; q leaves");
    view.keys("q");
    assert_eq!(view.end(), 0);
    assert!(view.text().contains("records are in"), "{}", view.text());
    let records: Vec<_> =
        open_reader(&recording, &ReadOptions::default()).unwrap().map(Result::unwrap).collect();
    assert!(
        records.len() > 1000 && records.iter().all(|record| record.frame().is_some()),
        "{}",
        records.len()
    );
}

#[test]
fn a_vehicle_at_a_serial_port_is_known_by_its_signals() {
    let mut port = port::Port::new();
    port.plug("car");
    let line = format!("monitor {} -b 500k -b 2:125k --view fixed", port.name());
    let mut view = Terminal::start(&line, (200, 60));
    view.wait_for("`cantap virtual car --dbc` prints it");
    view.wait_for("EngineSpeed");
    // A row opens, and a signal goes into the graph with its past.
    view.keys("3");
    view.wait_for("Last 8 s");
    view.keys("/.enginespeed\r");
    view.wait_until("no prompt", |screen| !screen.contains(" > "));
    view.keys("\r4");
    let is_whole =
        |screen: &str| ["rpm EngineSpeed ", " UTC", "10 s, steps"].iter().all(|part| screen.contains(part));
    view.wait_until("the graph with its time axis", is_whole);
    view.keys("xx");
    view.wait_for("Δt 0.000000 s");
    view.resize((80, 24));
    view.wait_for("Δt 0.000000 s");
    view.resize((1, 1));
    view.resize((80, 24));
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn a_channel_that_is_bus_off_is_brought_back_from_inside() {
    let line = "monitor virtual:load=0,disturb=32 -b 500k --normal --recovery manual --view send";
    let mut view = Terminal::start(line, (140, 24));
    view.wait_for("NORMAL: running");
    view.keys("R");
    view.wait_for("no channel is bus-off");
    view.keys("a123#11\r\r");
    view.wait_for("1: BUS-OFF, R recovers");
    view.keys("R");
    view.wait_for("channel 1 comes back onto its bus");
    view.wait_until("it is back", |screen| !screen.contains("BUS-OFF"));
    view.keys("q");
    assert_eq!(view.end(), 0);
    // On its own after a time, as in every other command.
    let line = "monitor virtual:load=0,disturb=32 -b 500k --normal --recovery 100ms --view send";
    let mut view = Terminal::start(line, (140, 24));
    view.wait_for("NORMAL: running");
    view.keys("a123#11\r\r");
    view.wait_for("channel 1 was bus-off and joins the bus again");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_emulated_board_is_watched_sent_with_and_recorded() {
    let elf = firmware::elf();
    let folder = tempfile::tempdir().unwrap();
    let recording = folder.path().join("board.blf");
    let line = format!(
        "monitor -d emu:{},load=20 -b 500k --view statistics -o {}",
        elf.display(),
        recording.display()
    );
    let mut view = Terminal::start(&line, (160, 40));
    view.wait_for("running");
    view.wait_for("Channel 2: 500000 bit/s");
    view.wait_for("Device olimex-p405");
    // Onto the bus with a mode, then with a frame.
    view.keys("my");
    view.wait_for("NORMAL: running");
    view.keys("6a6F7#DEADBEEF\r\r1f6F7:7FF\r");
    view.wait_for("T      6F7 D 4 DE AD BE EF");
    view.keys("q");
    assert_eq!(view.end(), 0);
    let records = open_reader(&recording, &ReadOptions::default()).unwrap().map(Result::unwrap);
    let sent = records.filter(|record| record.frame().is_some_and(|frame| frame.id().raw() == 0x6F7));
    assert_eq!(sent.count(), 1);
}

/// Two entries of a group, of which one's values follow a ramp and the other's a list, each with a counter, beside one that the device repeats by itself.
#[test]
fn values_that_change_are_sent_at_their_times_and_a_group_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let database = write(
        folder.path(),
        "car.dbc",
        "VERSION \"\"\nBO_ 291 Engine: 8 ECU\n SG_ Speed : 0|16@1+ (0.1,0) [0|200] \"\" X\nBO_ 292 Gear: 2 ECU\n SG_ Lever : 0|8@1+ (1,0) [0|5] \"\" X\n",
    );
    let list = write(
        folder.path(),
        "list.txt",
        "# What the bench sends.\nEngine:Speed=ramp(0,100,1s) 10ms counter=3.0:4 checksum=7:xor group=bench\n\
         Gear:Lever=values(1,3,2) 15ms counter=1 group=bench\n125#00 20ms counter=0 group=bench\n123#11 1s\n",
    );
    let recording = folder.path().join("sent.log");
    let line = format!(
        "monitor virtual:load=0 -b 500k --normal --view send --db {database} -o {}",
        recording.display()
    );
    let mut view = Terminal::start(&line, (160, 24));
    view.wait_for("NORMAL: running");
    view.keys(&format!("i{list}\r"));
    view.wait_for("4 entries added");
    view.keys("g");
    view.wait_until("three are on", |screen| {
        screen.matches(" on ").count() + screen.matches("on 1 ").count() >= 3
    });
    view.keys("1");
    view.wait_until("traffic", |screen| screen.matches(" 125 ").count() > 2);
    std::thread::sleep(std::time::Duration::from_secs(2));
    view.keys("6g");
    view.wait_until("none is on", |screen| !screen.contains("on 1 "));
    view.keys(&format!("x{}/out.txt\r", folder.path().display()));
    view.wait_for("4 entries written");
    view.keys("q");
    assert_eq!(view.end(), 0);
    let written = std::fs::read_to_string(folder.path().join("out.txt")).unwrap();
    assert_eq!(written.lines().count(), 4);
    let records = open_reader(&recording, &ReadOptions::default()).unwrap().map(Result::unwrap);
    let frames: Vec<_> =
        records.filter_map(|record| Some((record.time_ns, *record.frame()?.classic()?))).collect();
    let of = |id: u32| -> Vec<_> {
        frames
            .iter()
            .filter(|(_, frame)| frame.id().raw() == id)
            .map(|(at, frame)| (*at, frame.padded_data()))
            .collect()
    };
    let speeds = of(0x123);
    assert!(speeds.len() > 100, "{}", speeds.len());
    for (at, pair) in speeds.windows(2).enumerate() {
        let [(before_ns, before), (after_ns, after)] = pair else { unreachable!() };
        // The counter says which round it is: a busy computer may leave some out, but nothing comes at a wrong time or with a wrong value.
        let rounds = i64::from((after[3].wrapping_sub(before[3])) & 0xF);
        let apart_ms = (after_ns - before_ns) as f64 / 1e6;
        let off = (apart_ms / 10.0 - rounds as f64).rem_euclid(16.0);
        assert!(off.min(16.0 - off) < 0.1, "{at}: {apart_ms} ms, {rounds}");
        let speed = |data: &[u8; 8]| f64::from(u16::from_le_bytes([data[0], data[1]])) / 10.0;
        let gained = (speed(after) - speed(before)).rem_euclid(100.0);
        assert!(
            (gained - (apart_ms / 10.0).round().rem_euclid(100.0)).abs() < 0.2,
            "{at}: {gained} in {apart_ms} ms"
        );
        assert_eq!(after[7], after[..7].iter().fold(0, |sum, byte| sum ^ byte));
    }
    let levers = of(0x124);
    assert!(levers.len() > 60, "{}", levers.len());
    for pair in levers.windows(2) {
        let place = |data: &[u8; 8]| [1, 3, 2].iter().position(|lever| *lever == data[0]).unwrap();
        let rounds = usize::from(pair[1].1[1].wrapping_sub(pair[0].1[1]));
        assert_eq!(place(&pair[1].1), (place(&pair[0].1) + rounds) % 3, "{pair:?}");
    }
    let own = of(0x125);
    assert!(own.len() > 50 && own.windows(2).all(|pair| pair[1].1[0] == pair[0].1[0].wrapping_add(1)));
}
