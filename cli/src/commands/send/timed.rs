//! Periodic frames that a device does not repeat by itself, because some are of CAN FD or have values that change: they are handed to it one by one, each
//! with its time, which its timer keeps.

use std::time::Duration;

use cantap::periodic::period_ticks;
use cantap::transmit::Stream;
use cantap::{Channel, Device, TraceFrame};
use cantap_work::sending::{LOOK_EVERY, Sending};

use crate::usage_error::usage;

/// From now to the first frame.
const LEAD_MS: u64 = 20;
/// Frames are handed over no earlier than this before their time: what is ended early has no more to be taken back.
const AHEAD_MS: u64 = 500;

/// What is repeated.
pub struct Repeated<'f> {
    /// How many there are at each time.
    pub count: usize,
    /// Makes those of a round, from 0, that is due so many seconds after the first, in this order.
    pub frames: &'f dyn Fn(u32, f64) -> anyhow::Result<Vec<TraceFrame>>,
    /// From one time to the next.
    pub period: Duration,
    /// How many times; without it, until the end.
    pub rounds: Option<u32>,
    /// Nothing is due later than this after the first.
    pub time: Option<Duration>,
}

/// Sends them until the end, or until `is_over`. Returns how many frames were requested.
pub fn send(
    device: &Device,
    channel: Channel,
    what: &Repeated<'_>,
    sending: &mut Sending<'_>,
    is_over: impl Fn() -> bool,
) -> anyhow::Result<u64> {
    let tick_hz = u64::from(device.hello().tick_hz);
    let period =
        period_ticks(what.period, device.hello().tick_hz).map_err(|error| usage(error.to_string()))?;
    let last = what.time.map(|time| (time.as_secs_f64() * tick_hz as f64) as u64);
    let mut stream = Stream::new(device);
    let first = device.time()? + tick_hz * LEAD_MS / 1000;
    let mut handed_over_until = 0;
    let mut goes_on =
        |stream: &mut Stream<'_>| sending.goes_on(&stream.take_ended(), stream.oldest_due()) && !is_over();
    let mut asked = 0;
    'rounds: for round in
        (0_u64..).take_while(|round| what.rounds.is_none_or(|rounds| *round < rounds.into()))
    {
        let after = round * u64::from(period);
        if last.is_some_and(|last| after >= last) {
            break;
        }
        let due = first + after;
        while due > handed_over_until {
            stream.flush()?;
            handed_over_until = device.time()? + tick_hz * AHEAD_MS / 1000;
            if due > handed_over_until {
                stream.wait(LOOK_EVERY)?;
            }
            if !goes_on(&mut stream) {
                break 'rounds;
            }
        }
        for frame in (what.frames)(round as u32, after as f64 / tick_hz as f64)? {
            asked += 1;
            if stream.push(channel, frame, Some(due), &mut goes_on)?.is_none() {
                break 'rounds;
            }
        }
        if !goes_on(&mut stream) {
            break;
        }
    }
    sending.finish(&mut stream)?;
    let all = what.rounds.map_or(asked, |rounds| u64::from(rounds) * what.count as u64);
    Ok(if sending.stands_still() { all } else { sending.ended() })
}
