//! A program that reads one bus through socketcand, in raw mode.

use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, ensure};

/// Most ages that are kept: those of three minutes of a full bus.
const MOST_AGES: usize = 1 << 22;

/// What it received.
pub struct Outcome {
    pub frames: u64,
    /// How old each frame was on arrival, in seconds: the current time minus its own.
    pub ages: Vec<f64>,
}

/// Reads until `is_over`.
pub fn read(place: &str, is_over: &AtomicBool) -> Result<Outcome> {
    let mut stream = TcpStream::connect(place)?;
    stream.set_read_timeout(Some(Duration::from_secs(5)))?;
    let mut expect = |wanted: &str, command: &str| -> Result<()> {
        let mut text = vec![0; wanted.len()];
        stream.read_exact(&mut text)?;
        ensure!(text == wanted.as_bytes(), "{}", String::from_utf8_lossy(&text));
        Ok(stream.write_all(command.as_bytes())?)
    };
    expect("< hi >", "< open can0 >")?;
    expect("< ok >", "< rawmode >")?;
    expect("< ok >", "")?;
    let mut outcome = Outcome { frames: 0, ages: Vec::new() };
    let began = Instant::now();
    let mut bytes = vec![0; 64 * 1024];
    let mut kept = 0;
    while !is_over.load(Ordering::Relaxed) {
        let len = match stream.read(&mut bytes[kept..]) {
            Ok(0) => break,
            Ok(len) => kept + len,
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => continue,
            Err(error) => return Err(error.into()),
        };
        let now_s = SystemTime::now().duration_since(UNIX_EPOCH)?.as_secs_f64();
        let end = bytes[..len].iter().rposition(|byte| *byte == b'>').map_or(0, |at| at + 1);
        let text = std::str::from_utf8(&bytes[..end])?;
        outcome.frames += text.matches("< frame ").count() as u64;
        // The server's clock is not determined until after the first seconds.
        if began.elapsed() > Duration::from_secs(3) {
            for frame in text.split("< frame ").skip(1) {
                let time = frame.split(' ').nth(1).and_then(|time| time.parse::<f64>().ok());
                let age = now_s - time.context("a frame without a time")?;
                if outcome.ages.len() < MOST_AGES {
                    outcome.ages.push(age);
                }
            }
        }
        bytes.copy_within(end..len, 0);
        kept = len - end;
    }
    Ok(outcome)
}
