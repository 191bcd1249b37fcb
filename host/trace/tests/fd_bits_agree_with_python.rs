//! Checks exact lengths of CAN FD frames against a model in another language, which builds the levels on the bus one
//! by one.
//!
//! The interpreter is `CANTAP_PYTHON`, otherwise `python3`. Without one, the test says so and passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.

use cantap_testing::peers;

use std::io::Write;
use std::process::{Command, Stdio};

use cantap_trace::fd::FD_LENGTHS;
use cantap_trace::{FdBits, FdFrame, Id};

const MODEL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fd_bits.py");

/// Every length with every flag, with data that cause many stuff bits and few.
fn frames() -> Vec<FdFrame> {
    let mut random = fastrand::Rng::with_seed(12);
    let mut frames = Vec::new();
    for at in 0..4000 {
        let len = usize::from(FD_LENGTHS[at % FD_LENGTHS.len()]);
        let id = if random.bool() {
            Id::standard(random.u32(..0x800))
        } else {
            Id::extended(random.u32(..0x2000_0000))
        };
        let mask = [0xFF, 0x81, 0x00, 0xF8, 0x0F][at / 16 % 5];
        let flip = if random.bool() { 0xFF } else { 0 };
        let data: Vec<u8> = (0..len).map(|_| random.u8(..) & mask ^ flip).collect();
        frames.extend(FdFrame::new(id.unwrap(), random.bool(), random.bool(), &data));
    }
    frames
}

#[test]
fn lengths_and_crcs_are_those_of_the_model() {
    let model = Command::new(peers::python()).arg(MODEL).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
    let Ok(mut model) = model else { return peers::skip("Python is not installed") };
    let frames = frames();
    let mut stdin = model.stdin.take().unwrap();
    let lines: Vec<String> = frames
        .iter()
        .map(|frame| {
            let data = frame.data().iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().concat();
            let (extended, data) =
                (if frame.id().is_extended() { "x" } else { "-" }, if data.is_empty() { "-" } else { &data });
            let (brs, esi) = (u8::from(frame.brs()), u8::from(frame.esi()));
            format!("{:x} {extended} {brs} {esi} {data}\n", frame.id().raw())
        })
        .collect();
    let writer = std::thread::spawn(move || stdin.write_all(lines.concat().as_bytes()));
    let output = model.wait_with_output().unwrap();
    writer.join().unwrap().unwrap();
    assert!(output.status.success());
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(text.lines().count(), frames.len());
    for (line, frame) in text.lines().zip(&frames) {
        let FdBits { nominal, data, stuff, fixed_stuff, crc } = FdBits::of(frame);
        assert_eq!(line, format!("{nominal} {data} {stuff} {fixed_stuff} {crc}"), "{frame}");
    }
}
