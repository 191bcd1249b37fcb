//! The commands that act on a device and its bus, as users run them, on the virtual device.

use std::process::{Command, Output};

fn cantap(arguments: &str) -> (Option<i32>, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments.split_whitespace()).output();
    let Output { status, stdout, stderr } = output.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// The frames printed by a command, without their times.
fn frames(out: &str) -> Vec<String> {
    out.lines().map(|line| line.split_once(") ").unwrap().1.to_owned()).collect()
}

/// The times printed by a command, in microseconds.
fn times_us(out: &str) -> Vec<i64> {
    out.lines().map(|line| line[1..line.find(')').unwrap()].replace('.', "").parse().unwrap()).collect()
}

/// Runs a sending command with `--json` until every frame kept its time within `at_most_us`, both ways, by the device's stamps, and
/// returns its object. A computer that stood still for longer than frames are handed over ahead sends them late whatever the
/// command does, so one run in time is what shows that times are kept.
fn in_time(line: &str, at_most_us: f64) -> serde_json::Value {
    let mut last = None;
    for _ in 0..10 {
        let (code, out, err) = cantap(&format!("{line} --json"));
        assert_eq!((code, err.as_str()), (Some(0), ""), "{line}");
        let object: serde_json::Value = serde_json::from_str(&out).unwrap();
        if ["early_us", "late_us"].iter().all(|key| object[key].as_f64().unwrap() <= at_most_us) {
            return object;
        }
        last = Some(object);
    }
    panic!("{line}: never in time; the last run: {}", last.unwrap());
}

/// The same for what the times of printed frames, in microseconds, show. They are the computer's, whose line through the device's moves a
/// little.
fn spaced(line: &str, is_right: impl Fn(&[i64]) -> bool) -> Vec<String> {
    let mut last = Vec::new();
    for _ in 0..10 {
        let (code, out, err) = cantap(&format!("{line} -v"));
        assert_eq!(code, Some(0), "{line}: {err}");
        last = times_us(&out);
        if is_right(&last) {
            return frames(&out);
        }
    }
    panic!("{line}: never in time; the last run: {last:?}");
}

#[test]
fn a_sent_frame_is_printed_with_its_time() {
    let (code, out, err) = cantap("send -d virtual can1 123#DEADBEEF 5A1#11.22 1F334455#R2");
    assert_eq!((code, err.as_str()), (Some(0), ""));
    assert_eq!(frames(&out), ["can1 123#DEADBEEF T", "can1 5A1#1122 T", "can1 1F334455#R2 T"]);
}

#[test]
fn a_frame_that_nobody_acknowledges_fails_and_says_what_to_check() {
    let (code, out, err) = cantap("send -d virtual:ack=no,load=0 can0 123#");
    assert_eq!((code, out.as_str()), (Some(1), ""));
    assert!(err.contains("nobody acknowledged 1 of 1 frame; check"), "{err}");
    let (code, _, err) = cantap("send -d virtual:ack=no,load=0 can0 123# --one-shot");
    assert!(code == Some(1) && err.contains("--one-shot"), "{err}");
}

#[test]
fn listen_only_refuses_to_send_and_says_how_to() {
    let (code, out, err) = cantap("send -d virtual can0 123# --mode listen");
    assert_eq!((code, out.as_str(), err.lines().count()), (Some(1), "", 1));
    assert!(err.contains("--mode normal"), "{err}");
}

#[test]
fn periodic_frames_count_and_carry_their_checksum() {
    let line =
        "send -d virtual:load=0 can0 123#0F22F000 --period 5ms --count 4 --counter 0.0:4 --checksum 3:xor";
    let (code, out, err) = cantap(line);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    let expected =
        ["can0 123#0F22F0DD T", "can0 123#0022F0D2 T", "can0 123#0122F0D3 T", "can0 123#0222F0D0 T"];
    assert_eq!(frames(&out), expected);
    let times = times_us(&out);
    for pair in times.windows(2) {
        assert!((pair[1] - pair[0] - 5000).abs() < 50, "{times:?}");
    }
}

#[test]
fn values_that_change_follow_their_time_with_counter_and_checksum() {
    let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("changing.dbc");
    std::fs::write(&path, "BO_ 291 Engine: 4 ECU\n SG_ Speed : 0|16@1+ (0.1,0) [0|200] \"\" X\n").unwrap();
    let send = |what: &str| {
        cantap(&format!(
            "send -d virtual:load=0 can0 {what} --db {} --counter 2 --checksum 3:xor",
            path.display()
        ))
    };
    let (code, out, err) = send("Engine:Speed=ramp(0,100,100ms) 124#0000FF00 --period 10ms --count 12");
    assert_eq!((code, err.as_str()), (Some(0), ""));
    let expected: Vec<String> = (0..12_u32)
        .flat_map(|round| {
            let speed = round % 10 * 100;
            let bytes = [speed as u8, (speed >> 8) as u8, round as u8];
            let sum = |bytes: &[u8]| bytes.iter().fold(0, |sum, byte| sum ^ byte);
            let hex = |bytes: [u8; 3]| {
                format!("{:02X}{:02X}{:02X}{:02X}", bytes[0], bytes[1], bytes[2], sum(&bytes))
            };
            let other = [0, 0, 0xFF_u8.wrapping_add(round as u8)];
            [format!("can0 123#{} T", hex(bytes)), format!("can0 124#{} T", hex(other))]
        })
        .collect();
    assert_eq!(frames(&out), expected);
    let (code, _, err) = send("Engine:Speed=ramp(0,100,100ms)");
    assert!(code == Some(2) && err.contains("--period"), "{err}");
    let (code, _, err) = send("Engine:Speed=ramp(0,300,100ms) --period 10ms");
    assert!(code == Some(1) && err.contains("Speed"), "{err}");
}

/// Every frame of a busy bus starts a reply; the count ends them.
#[test]
fn a_reply_follows_what_its_filter_accepts() {
    let _turn = cantap_testing::process::turn();
    let (code, out, err) = cantap("send -d virtual:load=100,frames=std8 can0 7FF#AA --on-rx 000:0 --count 3");
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("7FF#AA on 000:0: 3 matches, 3 sent"), "{err}");
    assert_eq!(frames(&out)[..3], ["can0 7FF#AA T"; 3]);
    let (code, _, err) = cantap("send -d virtual can0 7FF#AA --on-rx 123~7FF");
    assert!(code == Some(2) && err.contains("inverse"), "{err}");
}

#[test]
fn faulty_lines_are_refused_before_anything_is_sent() {
    for (line, code, part) in [
        ("send -d virtual can2 123#", 2, "can0"),
        ("send -d virtual can0 123", 2, "123#DEADBEEF"),
        ("send -d virtual can0 123#GG", 2, "'123#GG' is not a frame"),
        ("send -d virtual can0 800#", 2, "more than 11 bits; write 00000800"),
        ("send -d virtual can0 123# --counter 0", 2, "--period"),
        ("send -d virtual can0 123#00 --period 46us", 2, "46µs is too short: no frame is shorter than 47µs"),
        ("send -d virtual can0 123#00 --period 10m", 2, "too long; give at most 357s"),
        (
            "send -d virtual can0 123#00 --period 1ms --counter 1",
            2,
            "cantap: a modifier changes byte 1 of '123#00'",
        ),
        ("send -d virtual can0 123#00 --period 1ms --counter 0.4:5", 2, "cantap: a counter of 5 bits"),
        ("send -d virtual can0 123#00 --on-rx 000:000 --counter 0", 2, "--on-rx"),
        ("send -d virtual can0 123#00 --reply --random 0", 2, "--reply"),
        ("send -d virtual can0 123#00 --on-rx xyz:7FF", 2, "hexadecimal"),
        ("send -d virtual can0 123#00 -b 999999", 1, "947368"),
        ("send -d virtual can0 123#00 -b 500k --triple", 1, "samples each bit once"),
        ("send -d /dev/null/nothing can0 123#", 1, "cantap list"),
    ] {
        let (found, out, err) = cantap(line);
        assert_eq!((found, out.as_str()), (Some(code), ""), "{line}: {err}");
        assert!(err.contains(part), "{line}: {err}");
    }
}

#[test]
fn status_has_the_documented_keys() {
    let (code, out, _) = cantap("status -d virtual --registers --json");
    assert_eq!(code, Some(0));
    let object: serde_json::Value = serde_json::from_str(&out).unwrap();
    let keys =
        |value: &serde_json::Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>().join(" ");
    assert_eq!(
        keys(&object),
        "bad_requests channels clock failures last_failure queue_bytes queue_high_water_bytes queue_size_bytes supply_volts temperature_celsius uptime_s"
    );
    let channel = &object["channels"][1];
    assert_eq!((&channel["channel"], &channel["state"]), (&2.into(), &"active".into()));
    assert_eq!(
        keys(channel),
        "bitrate_bps bus_errors channel frames last_error lost_controller lost_queue mode open rec registers \
         registers_at_last_error state tec transmit_failures transmitted tx_pending"
    );
    assert!(channel["mode"].is_null() && channel["bitrate_bps"].is_null(), "{out}");
    assert_eq!(keys(&channel["registers"]), "btr esr ier mcr msr rf0r tsr");
    assert!(channel["registers_at_last_error"].is_null());
}

#[test]
fn status_tells_of_a_bus_that_it_listened_to() {
    let _turn = cantap_testing::process::turn();
    let line = "status -d virtual:errors=40,load=60,frames=std8 -b 500k --time 300ms --json";
    let (code, out, err) = cantap(line);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    let object: serde_json::Value = serde_json::from_str(&out).unwrap();
    for channel in object["channels"].as_array().unwrap() {
        assert_eq!(
            (&channel["open"], &channel["tec"], &channel["rec"]),
            (&true.into(), &0.into(), &0.into())
        );
        assert!(channel["frames"].as_u64() > Some(50) && channel["bus_errors"].as_u64() > Some(20), "{out}");
        assert!(channel["last_error"].is_string(), "{out}");
        assert_eq!((&channel["mode"], &channel["bitrate_bps"]), (&"listen-only".into(), &500_000.into()));
    }
    // In normal mode its counters count, and the registers at the last error are known.
    let line =
        "status -d virtual:errors=95,load=100,frames=std8 -c 1 -b 500k -t 300ms --mode normal --registers";
    let (code, out, err) = cantap(line);
    assert_eq!(code, Some(0), "{err}");
    assert!(
        out.contains("channel 1    open, normal, 500000 bit/s") && out.contains("channel 2    closed"),
        "{out}"
    );
    // One frame in twenty is good, and brings it back from passive for a moment.
    let passive_or_nearly = ["passive", "warning"].map(|state| format!("state      {state}, TEC 0, REC 1"));
    assert!(passive_or_nearly.iter().any(|line| out.contains(line)), "{out}");
    let registers = out.split("registers of channel 1").nth(1).unwrap();
    let esr = registers.lines().find(|line| line.contains("CAN_ESR")).unwrap();
    assert!(!esr.trim_end().ends_with('-'), "{out}");
    for without_time in
        ["-b 500k", "--mode normal", "--one-shot", "--recovery manual", "--no-data", "--sjw 1"]
    {
        let (code, out, err) = cantap(&format!("status -d virtual {without_time}"));
        assert!((code, out.as_str()) == (Some(2), "") && err.contains("add --time"), "{without_time}: {err}");
    }
}

#[test]
fn device_care_is_one_line_each() {
    for (line, out) in [
        ("identify -d virtual -t 2", "its LEDs blink for 2 s\n"),
        ("reset -d virtual", "restarting\n"),
        ("defaults save -d virtual -b 250k --mode normal", "saved on the device\n"),
        ("defaults clear -d virtual", "erased from the device\n"),
    ] {
        assert_eq!(cantap(line), (Some(0), out.to_owned(), String::new()), "{line}");
    }
    let (code, _, err) = cantap("update -d virtual Cargo.toml");
    assert!(code == Some(1) && err.contains("not a firmware image"), "{err}");
}

#[test]
fn autobaud_finds_the_rate_and_tells_silence_from_noise() {
    let (code, out, err) = cantap("autobaud -d virtual:bitrate=125k --json");
    assert_eq!((code, err.as_str()), (Some(0), ""));
    let object: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!((&object["bitrate_bps"], &object["channel"]), (&125_000.into(), &1.into()));
    assert!(object["frames"].as_u64() >= Some(4) && object["seconds"].as_f64() < Some(10.0), "{out}");
    let (code, _, err) = cantap("autobaud -d virtual:load=0 -t 200ms");
    assert!(code == Some(1) && err.contains("no traffic on channel 1"), "{err}");
}

#[test]
fn made_up_frames_come_at_their_gap() {
    let line = "gen -d virtual:load=0 can1 -g 10 -I 42A -L 1 -D i -n 5";
    let (code, out, err) = cantap(&format!("{line} -v"));
    assert!(code == Some(0) && err.starts_with("cantap: 5 frames sent"), "{err}");
    assert_eq!(frames(&out)[4], "can1 42A#04 T");
    assert!(cantap("gen -d virtual:load=0 can1 -g 0 -n 1").2.starts_with("cantap: 1 frame sent"));
    // The device's stamps: a tick's rounding.
    assert_eq!(in_time(line, 0.2)["sent"], 5);
    let (code, _, err) = cantap("gen -d virtual:ack=no,load=0 can0 -g 0 -n 10");
    assert!(code == Some(1) && err.contains("nobody acknowledged"), "{err}");
}

#[test]
fn a_replayed_trace_keeps_its_times_and_order() {
    let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("replay.log");
    let mut log = String::new();
    let mut expected = Vec::new();
    for n in 0..600_u32 {
        use std::fmt::Write;
        let (interface, length) = (n % 2, (n % 9) as usize);
        let frame = format!("{:03X}#{}", n % 0x700, "5A".repeat(length));
        writeln!(log, "(1.{:06}) can{interface} {frame}", n * 500).unwrap();
        expected.push(format!("can{interface} {frame} T"));
    }
    std::fs::write(&path, log).unwrap();
    // Both directions: a tick's rounding.
    let object = in_time(&format!("replay -d virtual:load=0 {}", path.display()), 0.2);
    assert_eq!((&object["sent"], &object["not_sent"]), (&600.into(), &0.into()));
    let (code, out, _) = cantap(&format!("replay -d virtual:load=0 {} --speed 4 -v", path.display()));
    assert_eq!((code, frames(&out)), (Some(0), expected));
    let (code, out, _) = cantap(&format!("replay -d virtual:load=0 {} can1=can0 -n 3 -t -v", path.display()));
    assert_eq!((code, frames(&out).len()), (Some(0), 3));
    assert!(out.lines().all(|line| line.contains("can1 ")), "{out}");
}

#[test]
fn a_capture_takes_filters_modes_and_timings() {
    let line = "capture -d virtual:frames=mix -c 1 --segments 3,8,3,1 -n 50 -t 5s -f can0,000:C0000400";
    let (code, out, _) = cantap(line);
    let ids: Vec<u32> =
        frames(&out).iter().map(|frame| u32::from_str_radix(&frame[5..8], 16).unwrap()).collect();
    assert_eq!((code, ids.len()), (Some(0), 50));
    assert!(ids.iter().all(|id| id & 0x400 == 0), "{out}");
    // What the hardware cannot express is reported, and still filtered.
    let line = "capture -d virtual:frames=std8 -c 1 -b 500k --mode normal -n 20 -t 5s -f can0,000~400";
    let (code, out, err) = cantap(line);
    assert!(code == Some(0) && err.contains("no inverse filters"), "{err}");
    assert!(frames(&out).iter().all(|frame| u32::from_str_radix(&frame[5..8], 16).unwrap() & 0x400 != 0));
    let (code, out, _) = cantap("capture -d virtual:frames=std8 -c 1 -b 500k --no-data -n 3 -t 5s");
    assert_eq!(code, Some(0));
    assert!(frames(&out).iter().all(|frame| frame.ends_with("#0000000000000000")), "{out}");
}

#[test]
fn a_channel_leaves_bus_off_by_itself_and_sends_what_waited() {
    // 32 errors of its own make a controller bus-off.
    let (code, out, err) = cantap("send -d virtual:load=0,disturb=32 can0 123#11 124#22");
    assert_eq!((code, err.as_str()), (Some(0), ""));
    assert_eq!(frames(&out), ["can0 123#11 T", "can0 124#22 T"]);
    // With one less, it never went off.
    let (code, out, _) = cantap("send -d virtual:load=0,disturb=31 can0 123#11");
    assert_eq!((code, frames(&out).len()), (Some(0), 1));
}

#[test]
fn with_manual_recovery_what_waits_fails_and_is_told_why() {
    let line = "send -d virtual:load=0,disturb=32 can0 123#11 124#22 --recovery manual";
    let (code, out, err) = cantap(line);
    assert_eq!((code, out.as_str()), (Some(1), ""));
    assert!(err.contains("2 of 2 frames were not sent: the controller went bus-off"), "{err}");
    assert!(err.contains("--recovery"), "{err}");
}

#[test]
fn after_a_time_the_command_brings_the_channel_back() {
    let line = "gen -d virtual:load=0,disturb=32 can1 -g 2 -I 42A -L 2 -D i -n 400 -v --recovery 100ms";
    let (code, out, err) = cantap(line);
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("channel 2 was bus-off and joins the bus again"), "{err}");
    // What was queued when it went off failed; what came when it was back was sent.
    let sent = frames(&out);
    assert!(!sent.is_empty() && sent.last().is_some_and(|frame| frame == "can1 42A#8F01 T"), "{out}{err}");
    assert!(err.contains(&format!("{} of 400 frames were not sent", 400 - sent.len())), "{err}");
    let (code, _, err) = cantap("send -d virtual can0 123# --recovery soon");
    assert!(code == Some(2) && err.contains("write auto, manual, or a time"), "{err}");
}

/// As in Linux's error frames: byte 2 has the kind, byte 3 the position.
#[test]
fn errors_are_captured_by_kind_and_a_broken_bus_does_not_flood_the_link() {
    let _turn = cantap_testing::process::turn();
    let capture = |bus: &str| {
        let (code, out, err) = cantap(&format!("capture -d virtual:{bus},frames=std8 -c 1 -b 500k -t 500ms"));
        // A capture with nothing but errors is a failure.
        assert_eq!(code, Some(i32::from(err.contains("channel 1: 0 frames"))), "{bus}: {err}");
        let details = |class: &str| -> Vec<String> {
            let lines =
                out.lines().filter_map(|line| line.split_once(class).map(|(_, data)| data.to_owned()));
            lines.collect()
        };
        // A protocol error with counters; and one without a kind: the suppressed ones, and their number.
        (details(" 20000288#"), details(" 20000080#"))
    };
    let (destroyed, _) = capture("errors=50,load=80");
    for (kind, part) in [("stuff", "00000400"), ("form", "00000200"), ("crc", "00000008")] {
        assert!(destroyed.iter().any(|data| data.starts_with(part)), "no {kind} error in {destroyed:?}");
    }
    // An unacknowledged frame ends in the sender's error flag, repeatedly.
    let (alone, suppressed) = capture("ack=no,load=100");
    assert!(!alone.is_empty() && alone.iter().all(|data| data.starts_with("00000200")), "{alone:?}");
    assert!(alone.len() < 500, "{} error records in half a second", alone.len());
    let count = |data: &String| u64::from_str_radix(&format!("{}{}", &data[6..8], &data[4..6]), 16).unwrap();
    let suppressed: u64 = suppressed.iter().filter(|data| data.starts_with("40")).map(count).sum();
    assert!(suppressed > 500, "{suppressed}");
}

/// Both channels are on one wire, and nobody else acknowledges: a frame gets across only if the other channel was
/// opened.
#[test]
fn a_replay_opens_only_the_channels_that_the_trace_sends_on() {
    let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("one_channel.log");
    let device = "virtual:wire=joined,ack=no,load=0";
    std::fs::write(&path, "(1.000000) can0 123#11\n").unwrap();
    let (code, _, err) = cantap(&format!("replay -d {device} {}", path.display()));
    assert!(code == Some(1) && err.contains("nobody acknowledged 1 of 1"), "{err}");
    std::fs::write(&path, "(1.000000) can1 123#11\n(1.200000) can0 124#22\n").unwrap();
    let (code, out, err) = cantap(&format!("replay -d {device} {} -v", path.display()));
    assert_eq!(
        (code, frames(&out)),
        (Some(0), vec!["can1 123#11 T".into(), "can0 124#22 T".into()]),
        "{err}"
    );
}

#[test]
fn a_replay_takes_canplayers_options() {
    let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("canplayer.log");
    std::fs::write(&path, "(1.000000) can0 001#\n(1.010000) can0 002#\n(9.000000) can0 003#\n").unwrap();
    let play = |options: &str, is_right: fn(&[i64]) -> bool| {
        spaced(&format!("replay -d virtual:load=0 {options}"), is_right)
    };
    // Pauses longer than a second are skipped: the next frame follows immediately.
    let sent = play(&format!("-I {} can1=can0 -s 1 -x", path.display()), |times| {
        (times[1] - times[0] - 10_000).abs() <= 500 && times[2] - times[1] < 1_000
    });
    assert_eq!(sent, ["can1 001# T", "can1 002# T", "can1 003# T"]);
    let sent = play(&format!("{} -t -l 2 -n 5", path.display()), |times| times[4] - times[0] < 5_000);
    assert_eq!(sent.len(), 5);
    play(&format!("{} -s 1 -g 30", path.display()), |times| {
        times.windows(2).all(|pair| pair[1] - pair[0] >= 29_500)
    });
    for (options, part) in [
        ("-l 0", "from 1, or i"),
        ("-n 0", "0"),
        ("stdout=can0", "a channel is 1 or 2"),
        // Without times there is nothing to keep apart, and canplayer sends a frame once.
        ("-t -g 50", "--gap"),
        ("-t --speed 2", "--speed"),
        ("-t -s 1", "--skip"),
        ("can0=can0 can1=can0", "can0 is mapped twice"),
    ] {
        let (code, _, err) = cantap(&format!("replay -d virtual {} {options}", path.display()));
        assert!(code == Some(2) && err.contains(part), "{options}: {err}");
    }
}

#[test]
fn made_up_frames_take_cangens_options() {
    // Bursts of four: 47 to 56 bits at 500 kbit/s from frame to frame, 50 ms from burst to burst.
    spaced("gen -d virtual:load=0 can0 -g 50 -c 4 -I i -L 0 -n 10 -p 10 -i -x", |times| {
        let gaps: Vec<i64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
        gaps.len() == 9
            && gaps.iter().enumerate().all(|(at, gap)| {
                if at % 4 == 3 { (*gap - 49_700).abs() <= 500 } else { (90..130).contains(gap) }
            })
    });
    for (options, code, part) in [
        ("-f", 1, "classical CAN"),
        ("-E", 1, "classical CAN"),
        ("-L 9", 2, "-8 allows"),
        ("-L 16", 2, "0 to 8 bytes; -8"),
        ("-L 65", 2, "a length from 0 to 8"),
        ("--brs -L 9", 2, "8, 12, 16"),
        ("--fd -m -L 12", 2, "0 to 8 bytes"),
        ("-I 20000000", 2, "up to 1FFFFFFF"),
        ("-D 112233445566778899", 2, "up to 8 bytes"),
        ("-n 0", 2, "0"),
        ("-c 0", 2, "0"),
    ] {
        let (found, _, err) = cantap(&format!("gen -d virtual can0 {options}"));
        assert!(found == Some(code) && err.contains(part), "{options}: {err}");
    }
}

/// As documented in `man candump`.
#[test]
fn filters_are_candumps() {
    let ids = |filter: &str| -> Vec<String> {
        let line = format!("capture -d virtual:frames=mix,errors=5 -c 1 -b 500k -n 60 -t 5s -f {filter}");
        let (code, out, err) = cantap(&line);
        assert_eq!(code, Some(0), "{filter}: {err}");
        let frames = frames(&out).into_iter().filter(|frame| frame.contains('#'));
        frames.map(|frame| frame[5..].to_owned()).collect()
    };
    let is_error = |frame: &String| frame.starts_with("200");
    let all = ids("any");
    assert!(
        all.iter().any(|frame| frame.find('#') == Some(8)) && all.iter().any(|frame| frame.contains("#R"))
    );
    // Eight digits are a 29-bit identifier; C-something selects standard data frames.
    assert!(ids("any,00000000:80000000").iter().all(|frame| frame.find('#') == Some(8) && !is_error(frame)));
    assert!(ids("can0,000:C0000000").iter().all(|frame| frame.find('#') == Some(3) && !frame.contains('R')));
    // Joined: both must hold.
    let joined = ids("can0,000:C0000400,001:001,j");
    let id = |frame: &String| u32::from_str_radix(&frame[..3], 16).unwrap();
    assert!(!joined.is_empty() && joined.iter().all(|frame| id(frame) & 0x401 == 1), "{joined:?}");
    // Only errors, no frames.
    let (code, out, err) = cantap("capture -d virtual:errors=30 -c 1 -b 500k -t 300ms -f any,0~0,#FFFFFFFF");
    assert_eq!(code, Some(0), "{err}");
    assert!(out.lines().count() > 5 && out.lines().all(|line| line.contains(" 200")), "{out}");
    for wrong in ["123:", "xyz:7FF", "can0,123:7FF,q", "20000000"] {
        let (code, _, err) = cantap(&format!("capture -d virtual -b 500k -f {wrong}"));
        assert!(code == Some(2) && err.contains("filter"), "{wrong}: {err}");
    }
}

#[test]
fn a_frame_is_told_when_it_was_sent_and_not_when_all_were() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("pause.log");
    // More than a day apart: no device accepts the second one now.
    std::fs::write(&log, "(0.000000) can0 123#01\n(90000.000000) can0 123#02\n").unwrap();
    let mut replay = std::process::Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(["replay", "-d", "virtual:load=0", "-b", "500k", "-v"])
        .arg(&log)
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let mut line = String::new();
    std::io::BufRead::read_line(&mut std::io::BufReader::new(replay.stdout.take().unwrap()), &mut line)
        .unwrap();
    let runs_on = replay.try_wait().unwrap().is_none();
    replay.kill().unwrap();
    replay.wait().unwrap();
    assert!(line.ends_with("can0 123#01 T\n"), "{line:?}");
    assert!(runs_on, "it was to wait for the second frame");
}
