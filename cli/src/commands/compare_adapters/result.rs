//! What a comparison of two devices found: one object for scripts, lines for people.

use std::io::{self, Write};
use std::time::Duration;

use cantap::{TraceEvent, TraceRecord};
use cantap_analysis::align::Comparison;
use cantap_trace::counted;
use cantap_work::live::LiveRecords;
use cantap_work::{Losses, rounded};

/// A device that has nothing for this long at the end, while the other has frames, missed them. Both are stopped one after the other, so that a shorter
/// time says nothing.
const SILENT: Duration = Duration::from_secs(1);

/// One of the two.
#[derive(serde::Serialize)]
pub(super) struct Adapter {
    pub device: String,
    /// Of another maker; otherwise the board's name.
    kind: String,
    pub frames: u64,
    bus_errors: u64,
    /// Frames whose stamp is only an upper bound.
    late: u64,
    /// Frames that only the other has.
    missed: u64,
    /// Of these, remote frames.
    missed_remote: u64,
    /// How many frames more than the other it has of frames that both have.
    surplus: u64,
    /// Frames before both had begun and after one had ended, and those of a bus that the other is not on.
    not_compared: u64,
    /// Of these, those of a bus that the other is not on.
    other_bus: u64,
    /// What it knows of frames that it lost, from its opening on.
    lost: Losses,
    /// What it does not report.
    not_known: Option<&'static str>,
}

impl Adapter {
    /// The device with this index, before it has received anything.
    pub fn of(board: usize, live: &LiveRecords) -> Self {
        let device = live.lines().devices().find(|(index, _)| *index == board);
        let kind = device.map_or_else(String::new, |(_, device)| device.hello().board.to_string());
        let row = cantap_adapters::row(&kind);
        Self {
            device: live.addresses().get(board).map(ToString::to_string).unwrap_or_default(),
            frames: 0,
            bus_errors: 0,
            late: 0,
            missed: 0,
            missed_remote: 0,
            surplus: 0,
            not_compared: 0,
            other_bus: 0,
            lost: Losses::default(),
            not_known: row.filter(|row| !row.losses.are_counted()).map(cantap_adapters::Row::losses_before),
            kind,
        }
    }

    /// Takes what it has received, and what it knows to have lost.
    pub fn received(&mut self, board: usize, live: &LiveRecords, records: &[TraceRecord]) {
        for record in records {
            match record.event {
                TraceEvent::Frame { late, .. } => {
                    self.frames += 1;
                    self.late += u64::from(late);
                }
                TraceEvent::BusError { .. } => self.bus_errors += 1,
                TraceEvent::ErrorsSuppressed { count } => self.bus_errors += u64::from(count),
                _ => {}
            }
        }
        if let Some(line) = live.lines().lines().nth(board) {
            self.lost = Losses::of(&line.counters());
        }
    }

    /// Why there is nothing to compare, and what to do.
    pub fn nothing_received(&self) -> String {
        let errors = match self.bus_errors {
            0 => String::new(),
            errors => format!(", but {errors}", errors = counted(errors, "bus error")),
        };
        format!(
            "'{}' received no frame{errors}, so there is nothing to compare; check that it is on the same bus as the other, its channel (-c) and the bit \
             rate (-b), and that there is traffic",
            self.device
        )
    }

    fn line(&self, other: &str) -> String {
        let Self {
            device, frames, late, missed, missed_remote, surplus, not_compared, other_bus, lost, ..
        } = self;
        let bounds = match late {
            0 => String::new(),
            late if late == frames => ", all with stamps that are only upper bounds".to_owned(),
            late => format!(", {late} with stamps that are only upper bounds"),
        };
        let remote = match missed_remote {
            0 => String::new(),
            remote => format!(", {remote} of them remote frames"),
        };
        let more = match surplus {
            0 => String::new(),
            more => {
                format!("; has {more} more than it of frames that repeat: received twice, or missed there")
            }
        };
        let left = match not_compared {
            0 => String::new(),
            left => format!(
                "; {left} before or after what both recorded, or on another bus ({other_bus}), not compared"
            ),
        };
        format!(
            "'{device}': {frames}{bounds}; {missed} missed that '{other}' has{remote}{more}{left}; knows to have lost: {}",
            lost.line(),
            frames = counted(frames, "frame")
        )
    }
}

/// How far apart the stamps of a frame are, once offset and drift are taken out.
#[derive(serde::Serialize)]
struct Apart {
    median: f64,
    p99: f64,
    max: f64,
}

/// The whole result.
#[derive(serde::Serialize)]
pub(super) struct Outcome {
    adapters: [Adapter; 2],
    /// From the first to the last frame that both have.
    seconds: f64,
    frames_in_both: u64,
    ambiguous: u64,
    out_of_order: u64,
    /// How much later the second one's stamps are, on this computer's clock, at the beginning.
    delay_us: f64,
    drift_ppm: f64,
    clock_set: usize,
    apart_us: Option<Apart>,
    /// Equal frames that are nearer than this are one frame, or ambiguous.
    near_us: f64,
}

impl Outcome {
    /// `is_cut`: one of them ended before the other, so that what the other has after that means nothing.
    pub fn new(mut adapters: [Adapter; 2], found: &Comparison, is_cut: bool) -> Self {
        for (board, side) in found.sides.iter().enumerate() {
            let is_silent = !is_cut && side.after_ns >= SILENT.as_nanos() as i64;
            let missed_there = if is_silent { side.after } else { 0 };
            adapters[1 - board].missed += missed_there;
            let adapter = &mut adapters[board];
            adapter.missed += side.missed;
            adapter.missed_remote = side.missed_remote;
            adapter.surplus = side.surplus;
            adapter.other_bus = side.other_bus;
            adapter.not_compared = side.before + side.after - missed_there + side.other_bus;
        }
        let (begin_ns, end_ns) = found.common_ns;
        let us = |ns: u64| ns as f64 / 1e3;
        Self {
            adapters,
            seconds: rounded(end_ns.saturating_sub(begin_ns).max(0) as f64 / 1e9, 3),
            frames_in_both: found.both,
            ambiguous: found.ambiguous,
            out_of_order: found.out_of_order,
            delay_us: -(found.map.ahead_ns() as f64) / 1e3,
            drift_ppm: rounded(-found.map.drift_ppm(), 3),
            clock_set: found.map.steps(),
            apart_us: found.differences.map(|apart| Apart {
                median: us(apart.median_ns),
                p99: us(apart.p99_ns),
                max: us(apart.max_ns),
            }),
            near_us: found.near_ns as f64 / 1e3,
        }
    }

    /// Whether both have all frames, each as often, in the same order.
    pub fn is_equal(&self) -> bool {
        let is_whole =
            |adapter: &Adapter| adapter.missed == 0 && adapter.surplus == 0 && adapter.other_bus == 0;
        self.out_of_order == 0 && self.adapters.iter().all(is_whole)
    }

    pub fn print(&self, json: bool) -> anyhow::Result<()> {
        let mut out = io::stdout().lock();
        if json {
            writeln!(out, "{}", serde_json::to_string(self)?)?;
            return Ok(());
        }
        let [first, second] = &self.adapters;
        write!(
            out,
            "{} in both in {} s, {} of them in another order",
            counted(self.frames_in_both, "frame"),
            self.seconds,
            self.out_of_order
        )?;
        match self.ambiguous {
            0 => writeln!(out)?,
            some => writeln!(
                out,
                "; {some} repeat within {:.0} us, so that which is which is not known",
                self.near_us
            )?,
        }
        writeln!(out, "{}", first.line(&second.device))?;
        writeln!(out, "{}", second.line(&first.device))?;
        let set = match self.clock_set {
            0 => String::new(),
            times => format!("; a clock jumped {times} meanwhile", times = counted(times, "time")),
        };
        // A minus sign before zero says nothing.
        writeln!(
            out,
            "on this computer's clock, the second one's stamps are {:+.1} us from the first one's at the beginning, and gain {:+.3} ppm on them{set}",
            self.delay_us + 0.0,
            self.drift_ppm + 0.0,
        )?;
        if let Some(Apart { median, p99, max }) = self.apart_us {
            writeln!(
                out,
                "without that, the stamps of a frame are apart: {median:.1} us half of them, {p99:.1} us 99 %, {max:.1} us at most"
            )?;
        }
        for Adapter { device, not_known, .. } in &self.adapters {
            if let Some(not_known) = not_known {
                writeln!(out, "'{device}': {not_known}")?;
            }
        }
        Ok(())
    }
}
