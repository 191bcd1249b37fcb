//! The device's own time is kept beside UTC, in each format that has a place for it, so that an interval is the device's.

use std::path::{Path, PathBuf};

use crate::in_folder::cantap;

/// Frames of the log, one every ten milliseconds.
const FRAMES: usize = 100;
const PERIOD_NS: f64 = 10e6;
/// The stamp timer's rate.
const TICK_HZ: u128 = 12_000_000;
/// Formats that keep the device's time, each made from the one before. Parquet needs a feature.
#[cfg(feature = "parquet")]
const CHAIN: [&str; 5] = ["a.pcapng", "b.mf4", "c.csv", "d.parquet", "e.pcapng"];
#[cfg(not(feature = "parquet"))]
const CHAIN: [&str; 4] = ["a.pcapng", "b.mf4", "c.csv", "e.pcapng"];

/// An empty folder with the log.
fn folder(test: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("device_time").join(test);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    let lines = (0..=FRAMES).map(|n| format!("({}.{:06}) can0 123#{n:04X}\n", n / 100, n % 100 * 10_000));
    std::fs::write(folder.join("bus.log"), lines.collect::<String>()).unwrap();
    folder
}

fn run(folder: &Path, line: &str) -> String {
    let (code, out, err) = cantap(folder, line);
    assert_eq!(code, Some(0), "{line}: {err}");
    out
}

/// The frames' times by UTC and by the device, as `csv-full` writes them.
fn times(folder: &Path, file: &str) -> Vec<(String, u64)> {
    let table = run(folder, &format!("convert {file} - --format csv-full"));
    let mut rows = table.lines().map(|row| row.split(',').collect::<Vec<_>>());
    assert_eq!(rows.next().unwrap().last(), Some(&"device_ns"));
    let frames = rows.filter(|row| row[3] == "data");
    frames.map(|row| (row[0].to_owned(), row[8].parse().unwrap())).collect()
}

/// Captures the log in the first format, converts it to the others in turn, and returns the frames' device times, which all have.
fn through_every_format(folder: &Path, device: &str) -> Vec<u64> {
    run(folder, &format!("capture -d {device} -c 1 -b 500k -n 90 -o {}", CHAIN[0]));
    let captured = times(folder, CHAIN[0]);
    assert_eq!(captured.len(), 90);
    for (from, to) in CHAIN.iter().zip(&CHAIN[1..]) {
        let dialect = if Path::new(to).extension().is_some_and(|extension| extension == "csv") {
            " --format csv-full"
        } else {
            ""
        };
        run(folder, &format!("convert {from} {to}{dialect}"));
        assert_eq!(times(folder, to), captured, "{to}");
    }
    // Each is a tick of the timer, rounded down to a nanosecond, and not UTC's idea of it.
    for (_, device_ns) in &captured {
        let ticks = (u128::from(*device_ns) * TICK_HZ).div_ceil(1_000_000_000);
        assert_eq!(u128::from(*device_ns), ticks * 1_000_000_000 / TICK_HZ);
    }
    captured.into_iter().map(|(_, device_ns)| device_ns).collect()
}

#[test]
fn every_format_with_a_place_for_it_keeps_the_devices_time() {
    let folder = folder("virtual");
    let device = through_every_format(&folder, "virtual:load=0,log=bus.log");
    let found = run(&folder, "search b.mf4 --json byte[0]>=0");
    let of_json: Vec<u64> = found
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap()["device_ns"].as_u64())
        .collect();
    assert_eq!(of_json, device);
    // A format without a place keeps the frames.
    run(&folder, "convert a.pcapng f.log");
    assert_eq!(run(&folder, "convert f.log - --format csv-full").matches(",Rx,data,").count(), 90);
}

/// A gateway's delays by a board that is 400 ppm fast; and by two boards, where only UTC can tell.
#[test]
fn a_gateways_delay_is_the_devices() {
    let folder = folder("delay");
    let table = |of_second: fn(u64) -> u64| {
        let rows = (0..20_u64).flat_map(|n| {
            let row = |ms: u64, channel: u8, device_ns: u64| {
                format!("{}.{:03},{channel},Rx,data,123,2,{n:04X},,{device_ns}\n", ms / 1000, ms % 1000)
            };
            let (from, to) = (n * 200, n * 200 + 50);
            [row(from, 1, 7_000_000_000 + from * 1_000_400), row(to, 2, of_second(to))]
        });
        format!("time,channel,direction,type,id,dlc,data,event,device_ns\n{}", rows.collect::<String>())
    };
    let delay = |name: &str, text: String| -> serde_json::Value {
        std::fs::write(folder.join(name), text).unwrap();
        serde_json::from_str(&run(&folder, &format!("delay {name} --from 1 --to 2 --json"))).unwrap()
    };
    let one = delay("one.csv", table(|ms| 7_000_000_000 + ms * 1_000_400));
    assert_eq!((one["total"]["by_device"].as_u64(), one["total"]["matched"].as_u64()), (Some(20), Some(20)));
    assert_eq!(one["total"]["delay_ms"]["max"].as_f64(), Some(50.02));
    let text = run(&folder, "delay one.csv --from 1 --to 2");
    assert!(text.contains("from end of frame to end of frame, by the device's clock\n"), "{text}");
    let two = delay("two.csv", table(|ms| 900_000_000_000 + ms * 1_000_000));
    assert_eq!(two["total"]["by_device"].as_u64(), Some(0));
    assert_eq!(two["total"]["delay_ms"]["max"].as_f64(), Some(50.0));
}

/// The board's crystal is 400 ppm fast. UTC is corrected for that, the board's own intervals are not; `stats` measures by these.
#[cfg(feature = "emu")]
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn intervals_are_those_of_a_drifting_board() {
    const FAST: f64 = 1.0 + 400e-6;
    let folder = folder("emulated");
    let elf = crate::common::elf();
    let device = through_every_format(&folder, &format!("emu:{},load=0,ppm=400,log=bus.log", elf.display()));
    let off: Vec<f64> = device.windows(2).map(|pair| (pair[1] - pair[0]) as f64 - PERIOD_NS * FAST).collect();
    // Frames of different content differ by some stuff bits of 2 us.
    assert!(off.iter().all(|off| off.abs() < 12_000.0), "{off:?}");
    let whole = (device[89] - device[0]) as f64;
    assert!((whole - 89.0 * PERIOD_NS * FAST).abs() < 12_000.0, "{whole}");
    for file in CHAIN {
        let stats: serde_json::Value =
            serde_json::from_str(&run(&folder, &format!("stats {file} --json"))).unwrap();
        let mean_ms = stats["channels"][0]["ids"][0]["period_mean_ms"].as_f64().unwrap();
        assert!((mean_ms - whole / 89.0 / 1e6).abs() < 2e-6, "{file}: {mean_ms}");
    }
}
