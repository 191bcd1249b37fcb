//! `cantap xcp` with the simulated ECU, and what a listener makes of it; pyxcp as its master.
//!
//! Python is `CANTAP_PYTHON`, otherwise `python3`; if it or a package is missing, the test says so and passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use crate::in_folder::cantap;

/// A folder with the ECU's description.
fn directory(test: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("xcp").join(test);
    fs::create_dir_all(&directory).unwrap();
    let (code, printed, err) = cantap(&directory, "virtual --print-a2l");
    assert_eq!(code, Some(0), "{err}");
    fs::write(directory.join("ecu.a2l"), printed).unwrap();
    directory
}

const ECU: &str = "-d virtual:ecu -b 500k --a2l ecu.a2l";

#[test]
fn values_are_read_by_their_names_and_by_addresses() {
    let directory = directory("read");
    for protocol in ["xcp", "ccp"] {
        let (code, out, err) = cantap(
            &directory,
            &format!("xcp {ECU} --protocol {protocol} read IdleSpeed Program fanthreshold"),
        );
        assert_eq!(code, Some(0), "{protocol}: {err}");
        assert_eq!(out, "IdleSpeed 800 rpm\nProgram \"CANTAP01\"\nFanThreshold 90 degC\n");
    }
    let (code, out, err) = cantap(&directory, "xcp -d virtual:ecu -b 500k --pair 7F0:7F1 read 30000000:16");
    assert_eq!(code, Some(0), "{err}");
    assert_eq!(out, "30000000 80 0C 82 00 00 00 80 3F 43 41 4E 54 41 50 30 31\n");
}

/// Its axes have fewer points than there is room for; what is where depends on that.
#[test]
fn maps_and_structures_are_read_by_their_names() {
    let directory = directory("maps");
    let read = |what: &str| {
        let (code, out, err) = cantap(&directory, &format!("xcp {ECU} read {what}"));
        assert_eq!(code, Some(0), "{what}: {err}");
        out
    };
    assert_eq!(
        read("TorqueMap"),
        "TorqueMap[0][0] 0 Nm\nTorqueMap[0][1] 120 Nm\nTorqueMap[1][0] 50 Nm\nTorqueMap[1][1] 180 Nm\n\
         TorqueMap[2][0] 100 Nm\nTorqueMap[2][1] 160 Nm\n\
         TorqueMap.AXIS_PTS_X[0] 1000 rpm\nTorqueMap.AXIS_PTS_X[1] 3000 rpm\nTorqueMap.AXIS_PTS_X[2] 6000 rpm\n\
         TorqueMap.AXIS_PTS_Y[0] 0 %\nTorqueMap.AXIS_PTS_Y[1] 100 %\n"
    );
    let some = read("TorqueMap[2][1] Cylinder[1].Limits[0] Cylinder[0].Offset");
    assert_eq!(some, "TorqueMap[2][1] 160 Nm\nCylinder[1].Limits[0] 30 %\nCylinder[0].Offset -1 deg\n");
    let (code, out, err) = cantap(&directory, &format!("xcp {ECU} write TorqueMap[1][1] 200 --yes"));
    assert_eq!((code, out.as_str()), (Some(0), "TorqueMap[1][1]: 180 Nm -> 200 Nm\n"), "{err}");
    let line = format!("xcp {ECU} daq TorqueMap[1][1] Cylinder[1].Limits EngineSpeed -n 2 --csv");
    let (code, out, err) = cantap(&directory, &line);
    assert_eq!(code, Some(0), "{err}");
    let lines: Vec<_> = out.lines().collect();
    assert!(
        lines[0]
            .ends_with("stamp_us,TorqueMap[1][1],Cylinder[1].Limits[0],Cylinder[1].Limits[1],EngineSpeed"),
        "{out}"
    );
    assert!(lines.len() == 3 && lines[1].contains(",180,30,40,"), "{out}");
    for (what, expected) in [
        ("read TorqueMap[9][9]", "'TorqueMap[9][9]': the last of TorqueMap is TorqueMap[3][2]"),
        ("read Cylinder[0]", "'Cylinder[0]' is a structure; it has Cylinder[0].Offset, Cylinder[0].Limits"),
        ("read EngineSped", "did you mean EngineSpeed?"),
        ("write TorqueMap 5 --yes", "only single, whole numbers can be written by name"),
    ] {
        let (code, _, err) = cantap(&directory, &format!("xcp {ECU} {what}"));
        assert!(code == Some(2) && err.contains(expected), "{what}: {err}");
    }
    let (code, _, err) = cantap(&directory, &format!("xcp {ECU} read TorqueMap[3][1]"));
    assert!(code == Some(1) && err.contains("the ECU has fewer points now"), "{err}");
}

#[test]
fn what_the_ecu_refuses_is_an_error_that_says_why() {
    let directory = directory("refused");
    for (line, expected) in [
        ("read 1000:4", "the ECU refused SHORT_UPLOAD: ERR_ACCESS_DENIED (24); the ECU has nothing there"),
        ("write 20000000 01 --yes", "the ECU refused DOWNLOAD: ERR_WRITE_PROTECTED (23)"),
        ("daq 20000000:2 --event 9", "the ECU has the events 0 to 1"),
    ] {
        let (code, out, err) =
            cantap(&directory, &format!("xcp -d virtual:ecu -b 500k --pair 7F0:7F1 {line}"));
        assert!(code == Some(1) && out.is_empty() && err.contains(expected), "{line}: {err}");
    }
    for (line, expected) in [
        ("read Nothing", "'Nothing' is neither in --a2l nor an address"),
        ("write IdleSpeed 850", "if that is meant, add --yes"),
        ("write IdleSpeed 9000 --yes", "it has to be from 500 to 1500"),
        ("write EngineSpeed 900 --yes", "EngineSpeed is not to be written"),
        ("--protocol ccp --unlock stim --key-command x read Gear", "CCP has no stimulation"),
    ] {
        let (code, _, err) = cantap(&directory, &format!("xcp {ECU} {line}"));
        assert!(code == Some(2) && err.contains(expected), "{line}: {err}");
    }
    let (code, _, err) =
        cantap(&directory, "xcp -d virtual:load=0 -b 500k --pair 7F0:7F1 --timeout 50ms read 1000");
    assert!(code == Some(1) && err.contains("CONNECT to 7F0:7F1: no answer within 50 ms"), "{err}");
}

#[test]
fn a_parameter_is_written_and_read_back() {
    let directory = directory("write");
    for protocol in ["xcp", "ccp"] {
        let line = format!("xcp {ECU} --protocol {protocol} write IdleSpeed 850 --yes");
        let (code, out, err) = cantap(&directory, &line);
        assert_eq!((code, out.as_str()), (Some(0), "IdleSpeed: 800 rpm -> 850 rpm\n"), "{err}");
    }
}

#[test]
fn a_list_is_sent_by_the_ecu_itself_as_long_as_it_is_wanted() {
    let directory = directory("daq");
    let (code, out, err) =
        cantap(&directory, &format!("xcp {ECU} daq EngineSpeed Uptime Gear Torque --event 0 -n 20 --csv"));
    assert_eq!(code, Some(0), "{err}");
    let mut lines = out.lines();
    assert_eq!(lines.next(), Some("time_s,stamp_us,EngineSpeed,Uptime,Gear,Torque"));
    // In millionths; the gear is a text.
    let number = |cell: &str| (cell.parse::<f64>().unwrap_or_else(|_| panic!("{cell}")) * 1e6).round() as i64;
    let cells = |line: &str| {
        let cells = line.split(',').enumerate().filter(|(at, _)| *at != 4);
        cells.map(|(_, cell)| number(cell)).collect::<Vec<_>>()
    };
    let rows: Vec<_> = lines.map(cells).collect();
    assert_eq!(rows.len(), 20);
    for two in rows.windows(2) {
        // Its own clock, and what it measures of it, go on by its event's period.
        let [time, stamp, speed, uptime] = [0, 1, 2, 3].map(|at| two[1][at] - two[0][at]);
        assert!(stamp > 0 && stamp % 10_000_000_000 == 0 && stamp == uptime * 1000, "{out}");
        assert!(time > 0 && speed.abs() < 4_000_000_000 && two[0][2] >= 800_000_000, "{out}");
    }
    let (code, out, err) = cantap(&directory, &format!("xcp {ECU} poll EngineSpeed Gear --every 20ms -n 3"));
    assert_eq!(code, Some(0), "{err}");
    assert!(out.starts_with("time_s") && out.lines().count() == 4, "{out}");
}

/// It had to be polled: lists were started by XCP only.
#[test]
fn a_list_of_ccp_is_sent_by_the_ecu_itself() {
    let directory = directory("ccp_daq");
    let line = format!("xcp {ECU} --protocol ccp daq EngineSpeed Uptime Gear Torque --event 0 -n 20 --csv");
    let (code, out, err) = cantap(&directory, &line);
    assert_eq!(code, Some(0), "{err}");
    let mut lines = out.lines();
    assert_eq!(lines.next(), Some("time_s,EngineSpeed,Uptime,Gear,Torque"));
    let uptimes: Vec<f64> = lines.map(|line| line.split(',').nth(2).unwrap().parse().unwrap()).collect();
    assert_eq!(uptimes.len(), 20);
    // Its own clock goes on by its event's period.
    assert!(uptimes.windows(2).all(|two| two[1] > two[0] && (two[1] - two[0]) % 10.0 == 0.0), "{out}");
    let many = "30000000:4 ".repeat(6);
    let (code, _, err) = cantap(&directory, &format!("xcp {ECU} --protocol ccp daq {}", many.trim_end()));
    assert!(code == Some(1) && err.contains("have up to 3 packets, and 6 are needed"), "{err}");
}

/// A session as a listener on the bus has it, whatever the master: connected, a list set up, measured, stopped.
#[test]
fn a_trace_of_it_is_found_named_and_searched() {
    let directory = directory("trace");
    let log = directory.join("bench.log");
    let mut lines = String::new();
    let mut at_us = 0;
    let mut add = |frame: &str| {
        at_us += 500;
        writeln!(lines, "({}.{:06}) can0 {frame}", at_us / 1_000_000, at_us % 1_000_000).unwrap();
    };
    for command in [
        "FF00",
        "DA",
        "D9",
        "D6",
        "D5000100",
        "D400000001",
        "D30000000001",
        "E20000000000",
        "E1FF020000000020",
        "E010000000000100",
        "DE020000",
        "DD01",
    ] {
        add(&format!("7F0#{command}"));
        add(match command {
            "FF00" => "7F1#FF05C00808000101",
            "DA" => "7F1#FF11000002000000",
            "D9" => "7F1#FF01070107340100",
            "DE020000" => "7F1#FF00",
            _ => "7F1#FF",
        });
    }
    for speed in (3200..15_200_u32).step_by(400) {
        let [low, high, ..] = speed.to_le_bytes();
        add(&format!("7F1#00{:08X}{low:02X}{high:02X}", (speed * 10).swap_bytes()));
    }
    fs::write(&log, lines).unwrap();
    let (code, out, err) = cantap(&directory, "conversations bench.log --a2l ecu.a2l");
    assert!(code == Some(0) && err.contains("channel 1 speaks xcp"), "{err}");
    let last = out.lines().last().unwrap();
    assert!(
        last.ends_with("xcp 7F1 > 7F0 DAQ: daq 0, odt 0, stamp 148000 us, EngineSpeed 3700 rpm"),
        "{last}"
    );
    let (_, out, err) = cantap(&directory, "search bench.log xcp.EngineSpeed>3000 --a2l ecu.a2l --count");
    assert_eq!(out.trim(), "7", "{err}");
    let (_, out, err) =
        cantap(&directory, "monitor bench.log --a2l ecu.a2l --once --view nodes --size 120x30");
    assert!(out.contains("EngineSpeed 3700 rpm"), "{out}{err}");
    let (_, out, err) =
        cantap(&directory, "plot bench.log --signal xcp.EngineSpeed --a2l ecu.a2l --json -o speed.svg");
    assert!(out.contains(r#""curves":["xcp.enginespeed"]"#), "{out}{err}");
    let (_, out, err) = cantap(&directory, "decode bench.log --protocols --a2l ecu.a2l --csv");
    assert!(out.lines().filter(|line| line.contains("enginespeed")).count() == 30, "{out} {err}");
    let (_, out, _) = cantap(&directory, "conversations bench.log --quiet");
    assert!(out.lines().last().unwrap().ends_with("stamp 148000 us, 20000000 D0 39"), "{out}");
}

#[cfg(unix)]
mod shared {
    use super::*;
    use crate::served::Served;
    use cantap_testing::peers;

    use std::io::{BufRead, BufReader};
    use std::process::{Child, Command, Stdio};

    const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

    fn interrupt(child: &Child) {
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    }

    /// What a listener heard of the master's frames while `talk` ran.
    fn heard(served: &mut Served, talk: impl FnOnce(&Served)) -> String {
        let mut words = BufReader::new(served.server.stderr.take().unwrap()).lines();
        let mut listener = Command::new(CANTAP)
            .args(["capture", "-d", &served.at, "-b", "500k", "-t", "2m", "-o", "heard.log"])
            .current_dir(served.folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        assert!(words.any(|line| line.unwrap().contains("is in and may")));
        let rest = std::thread::spawn(move || words.count());
        std::thread::sleep(std::time::Duration::from_millis(500));
        talk(served);
        interrupt(&listener);
        listener.wait().unwrap();
        served.server.kill().unwrap();
        served.server.wait().unwrap();
        rest.join().unwrap();
        fs::read_to_string(served.folder.path().join("heard.log")).unwrap()
    }

    /// An ECU that gives nothing without a key.
    const LOCKED: &str = r#"
        let ecu = #{ open: false };
        on_frame("700", |f| {
            let d = f.data;
            let answer = if d[0] == 0x1B { [0, d[1], 2, 1] }
                else if d[0] == 0x12 { [0, d[1], if d[2] == 0x40 { 1 } else { 0 }, 0x11, 0x22, 0x33, 0x44] }
                else if d[0] == 0x13 {
                    ecu.open = d[2] == 0xEE && d[3] == 0xDD && d[4] == 0xCC && d[5] == 0xBB;
                    [if ecu.open { 0 } else { 0x35 }, d[1], 0x40]
                } else if d[0] == 0x0F && !ecu.open { [0x35, d[1]] }
                else { [0, d[1], 0x2A, 0x07] };
            send(frame(0x701, [0xFF] + answer));
        });
    "#;

    /// An ECU whose addresses count words, with one list whose contents do not change and one of two packets of two values.
    const WORDS: &str = r#"
        on_frame("7F0", |f| {
            let d = f.data;
            let ok = |more| send(frame(0x7F1, [0xFF] + more));
            if d[0] == 0xFF { ok.call([0x05, 0x02, 8, 8, 0, 1, 1]) }
            else if d[0] == 0xF4 {
                let bytes = [0];
                for at in 0..d[1] { bytes += [(d[4] + at) & 0xFF, 0x10] }
                ok.call(bytes)
            }
            else if d[0] == 0xDA { ok.call([0, 2, 0, 1, 0, 1, 0]) }
            else if d[0] == 0xD9 { ok.call([2, 6, 2, 6, 0, 0, 0]) }
            else if d[0] == 0xD8 { ok.call(if d[2] == 0 { [5, 1, 1, 0, 0] } else { [4, 2, 2, 0, 0] }) }
            else if d[0] == 0xDF { ok.call([0, 0, 0, 0, 0, 1, 0]) }
            else if d[0] == 0xE1 && d[2] != 1 { send(frame(0x7F1, [0xFE, 0x22])) }
            else if d[0] == 0xDE { ok.call([0x10]) }
            else {
                ok.call([]);
                if d[0] == 0xDD && d[1] == 1 {
                    for sample in 0..3 {
                        send(frame(0x7F1, [0x10, 1, sample, 2, sample]));
                        send(frame(0x7F1, [0x11, 3, sample]));
                    }
                }
            }
        });
    "#;

    /// Both were refused: only lists that are made anew, and addresses that count bytes, were spoken.
    #[test]
    fn lists_that_are_ready_and_addresses_of_words_are_spoken() {
        let served = Served::start("virtual:load=0", Stdio::null());
        fs::write(served.folder.path().join("ecu.rhai"), WORDS).unwrap();
        let mut node = served.run_node("ecu.rhai", &[]);
        let ask = |more: &str| {
            let mut command = Command::new(CANTAP);
            command.args(["xcp", "-d", &served.at, "-b", "500k", "--pair", "7F0:7F1", "--timeout", "20s"]);
            let output = command.args(more.split(' ')).output().unwrap();
            let text = |bytes| String::from_utf8(bytes).unwrap();
            (output.status.code(), text(output.stdout), text(output.stderr))
        };
        let (code, out, err) = ask("read 40:9");
        assert_eq!((code, out.as_str()), (Some(0), "00000040 40 10 41 10 42 10 43 10 44\n"), "{err}");
        let (code, out, err) = ask("daq 40:2 41:2 42:2 -n 3 --csv");
        assert_eq!(code, Some(0), "{err}");
        let rows: Vec<_> =
            out.lines().map(|line| line.split(',').skip(2).collect::<Vec<_>>().join(",")).collect();
        assert_eq!(
            rows,
            ["00000040,00000041,00000042", "01 00,02 00,03 00", "01 01,02 01,03 01", "01 02,02 02,03 02"]
        );
        let (code, _, err) = ask("daq 40:2 41:2 42:2 43:2 44:2");
        let expected =
            "list 0 has contents that do not change, list 1 has 2 packets of 2 values, and 3 are needed";
        assert!(code == Some(1) && err.contains(expected), "{err}");
        let (code, _, err) = ask("daq 40:1");
        assert!(code == Some(1) && err.contains("the ECU measures multiples of 2"), "{err}");
        let (code, _, err) = ask("write 40 01 --yes");
        assert!(code == Some(1) && err.contains("count units of 2 bytes"), "{err}");
        node.kill().unwrap();
        node.wait().unwrap();
    }

    /// Keys were sent by XCP only.
    #[test]
    fn a_key_is_sent_by_ccp() {
        let served = Served::start("virtual:load=0", Stdio::null());
        fs::write(served.folder.path().join("ecu.rhai"), LOCKED).unwrap();
        let mut node = served.run_node("ecu.rhai", &[]);
        let ask = |more: &[&str]| {
            let mut command = Command::new(CANTAP);
            command.args([
                "xcp",
                "-d",
                &served.at,
                "-b",
                "500k",
                "--pair",
                "700:701",
                "--protocol",
                "ccp",
                "--order",
                "little",
            ]);
            command.args(["--timeout", "20s", "--patience", "60s"]);
            let output = command.args(more).args(["read", "20000000:2"]).output().unwrap();
            (
                output.status.code(),
                String::from_utf8(output.stdout).unwrap(),
                String::from_utf8(output.stderr).unwrap(),
            )
        };
        let (code, _, err) = ask(&[]);
        assert!(code == Some(1) && err.contains("the ECU wants a key: unlock it with --unlock"), "{err}");
        let (code, _, err) = ask(&["--unlock", "programming", "--key-command", "printf 00000000"]);
        assert!(code == Some(1) && err.contains("UNLOCK"), "{err}");
        let (code, out, err) = ask(&["--unlock", "programming", "--key-command", "printf EEDDCCBB"]);
        assert_eq!((code, out.as_str()), (Some(0), "20000000 2A 07\n"), "{err}");
        node.kill().unwrap();
        node.wait().unwrap();
    }

    /// An ECU whose master vanishes would go on sending.
    #[test]
    fn ctrl_c_stops_the_list_and_disconnects() {
        let mut served = Served::start("virtual:ecu", Stdio::piped());
        let log = heard(&mut served, |served| {
            let mut measuring = Command::new(CANTAP)
                .args(["xcp", "-d", &served.at, "-b", "500k", "--pair", "7F0:7F1", "daq", "20000000:2"])
                .stdin(Stdio::null())
                .stdout(Stdio::piped())
                .stderr(Stdio::null())
                .spawn()
                .unwrap();
            let mut rows = BufReader::new(measuring.stdout.take().unwrap()).lines();
            assert!(rows.by_ref().take(5).count() == 5);
            interrupt(&measuring);
            rows.count();
            measuring.wait().unwrap();
        });
        let frames: Vec<_> = log.lines().filter_map(|line| line.split(' ').nth(2)).collect();
        let sent: Vec<_> = frames.iter().filter(|frame| frame.starts_with("7F0#")).collect();
        assert_eq!(sent[sent.len() - 2..], [&"7F0#DD00", &"7F0#FE"], "{log}");
        let end = frames.iter().rposition(|frame| *frame == "7F0#FE").unwrap();
        assert!(frames[end + 1..].len() <= 2, "it goes on: {log}");
    }

    #[test]
    fn pyxcp_masters_the_ecu_and_a_listener_hears_the_same() {
        let Some(python) = peers::python_with("can, pyxcp") else { return };
        let mut served = Served::start("virtual:ecu", Stdio::piped());
        let [host, port] = served.socketcand.clone();
        let mut said = None;
        let log = heard(&mut served, |_| {
            let peer = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/xcp_master_peer.py");
            let output = Command::new(&python).args([peer, &host, &port]).output().unwrap();
            let text = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(output.status.success(), "{text}");
            said = serde_json::from_slice::<serde_json::Value>(&output.stdout).ok();
        });
        let said = said.unwrap();
        for (name, expected) in [
            ("max_cto", serde_json::json!(8)),
            ("max_dto", serde_json::json!(8)),
            ("status", serde_json::json!(false)),
            ("name", serde_json::json!("cantap_virtual_ecu")),
            ("idle", serde_json::json!([0x80, 0x0C])),
            ("block", serde_json::json!(14)),
            ("written", serde_json::json!([0xA0, 0x0F])),
            ("refused", serde_json::json!(["ERR_ACCESS_DENIED", "ERR_OUT_OF_RANGE"])),
            ("events", serde_json::json!(["10 ms", "100 ms"])),
            ("first_pid", serde_json::json!(0)),
        ] {
            assert_eq!(said[name], expected, "{name}: {said}");
        }
        // What the listener made of the same packets.
        let directory = directory("pyxcp");
        fs::write(directory.join("heard.log"), log).unwrap();
        let (_, out, err) = cantap(&directory, "conversations heard.log --a2l ecu.a2l --json --quiet");
        let events = out.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
        let packets = events.filter(|event| event["title"] == "DAQ").collect::<Vec<_>>();
        let theirs = said["packets"].as_array().unwrap();
        assert!(theirs.len() == 20 && packets.len() >= 20, "{err} {said}");
        for (ours, theirs) in packets.iter().zip(theirs) {
            let bytes = theirs.as_str().unwrap();
            assert_eq!(ours["data"].as_str().unwrap().to_lowercase().replace(' ', ""), bytes);
            let byte = |at: usize| u64::from_str_radix(&bytes[2 * at..2 * at + 2], 16).unwrap();
            let fields = &ours["fields"];
            assert_eq!(fields["odt"], byte(0));
            if byte(0) == 0 {
                let speed = (byte(5) | byte(6) << 8) as f64 / 4.0;
                assert_eq!(fields["EngineSpeed"].as_f64(), Some(speed), "{ours}");
            } else {
                let uptime = (1..5).rev().fold(0, |number, at| number << 8 | byte(at));
                assert_eq!((&fields["Uptime"], &fields["Gear"]), (&uptime.into(), &byte(5).into()), "{ours}");
            }
        }
    }
}
