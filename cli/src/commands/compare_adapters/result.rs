//! What a comparison of two devices found: one object for scripts, lines for people.

use std::io::{self, Write};

use cantap::{TraceEvent, TraceRecord};
use cantap_analysis::align::{Agreement, Alignment};
use cantap_work::live::LiveRecords;
use cantap_work::{Losses, rounded};

/// One of the two.
#[derive(serde::Serialize)]
pub(super) struct Adapter {
    pub device: String,
    /// Of another maker; otherwise the board's name.
    kind: String,
    pub frames: u64,
    /// Frames whose stamp is only an upper bound.
    late: u64,
    /// Frames of the common time that only the other has.
    missed: u64,
    /// What it knows of frames that it lost, from its opening on.
    lost: Losses,
    /// What it does not report.
    not_known: Option<&'static str>,
}

impl Adapter {
    /// The device with this index; what it missed is not known yet.
    pub fn of(board: usize, live: &LiveRecords, records: &[TraceRecord]) -> Self {
        let name = live.lines().devices().find(|(index, _)| *index == board);
        let kind = name.map_or_else(String::new, |(_, device)| device.hello().board.to_string());
        let row = cantap_adapters::row(&kind);
        let frames = records.iter().filter_map(|record| match record.event {
            TraceEvent::Frame { late, .. } => Some(late),
            _ => None,
        });
        let (frames, late) = frames.fold((0, 0), |(all, late), is_late| (all + 1, late + u64::from(is_late)));
        Self {
            device: live.addresses().get(board).map(ToString::to_string).unwrap_or_default(),
            kind,
            frames,
            late,
            missed: 0,
            lost: live
                .lines()
                .lines()
                .nth(board)
                .map_or_else(Losses::default, |line| Losses::of(&line.counters())),
            not_known: row.filter(|row| !row.losses.are_counted()).map(cantap_adapters::Row::losses_before),
        }
    }

    fn line(&self, other: &str) -> String {
        let Self { device, frames, late, missed, lost, .. } = self;
        let bounds = match late {
            0 => String::new(),
            late if late == frames => ", all with stamps that are only upper bounds".to_owned(),
            late => format!(", {late} with stamps that are only upper bounds"),
        };
        format!(
            "'{device}': {frames} frames{bounds}; {missed} missed that '{other}' has; knows to have lost: {}",
            lost.line()
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
pub(super) struct Comparison {
    adapters: [Adapter; 2],
    /// The time that both recorded.
    seconds: f64,
    frames_in_both: u64,
    out_of_order: u64,
    /// How much later the second one's stamps are, on this computer's clock, at the beginning.
    delay_us: f64,
    drift_ppm: f64,
    clock_set: usize,
    apart_us: Apart,
    /// A frame whose stamps are farther apart counts as missed by both.
    tolerance_us: f64,
}

impl Comparison {
    pub fn new(mut adapters: [Adapter; 2], alignment: &Alignment, agreement: Agreement) -> Self {
        adapters[0].missed = agreement.only_second;
        adapters[1].missed = agreement.only_first;
        let (begin, end) = alignment.common_ns;
        let us = |ns: u64| ns as f64 / 1e3;
        Self {
            adapters,
            seconds: rounded((end - begin) as f64 / 1e9, 3),
            frames_in_both: agreement.both,
            out_of_order: agreement.out_of_order,
            delay_us: -(alignment.map.ahead_ns() as f64) / 1e3,
            drift_ppm: rounded(-alignment.map.drift_ppm(), 3),
            clock_set: alignment.map.steps(),
            apart_us: Apart {
                median: us(agreement.median_ns),
                p99: us(agreement.most_ns),
                max: us(agreement.worst_ns),
            },
            tolerance_us: alignment.tolerance_ns() as f64 / 1e3,
        }
    }

    /// Whether both have all frames, in the same order.
    pub fn is_equal(&self) -> bool {
        self.out_of_order == 0 && self.adapters.iter().all(|adapter| adapter.missed == 0)
    }

    pub fn print(&self, json: bool) -> anyhow::Result<()> {
        let mut out = io::stdout().lock();
        if json {
            writeln!(out, "{}", serde_json::to_string(self)?)?;
            return Ok(());
        }
        let [first, second] = &self.adapters;
        writeln!(
            out,
            "{} frames in both in {} s, {} of them in another order",
            self.frames_in_both, self.seconds, self.out_of_order
        )?;
        writeln!(out, "{}", first.line(&second.device))?;
        writeln!(out, "{}", second.line(&first.device))?;
        let set = if self.clock_set > 0 { ", and a clock was set meanwhile" } else { "" };
        // A minus sign before zero says nothing.
        writeln!(
            out,
            "the second one's stamps are {:+.1} us from the first one's at the beginning, and gain {:+.3} ppm on them{set}",
            self.delay_us + 0.0,
            self.drift_ppm + 0.0,
        )?;
        let Apart { median, p99, max } = self.apart_us;
        writeln!(
            out,
            "apart from that: {median:.1} us half of them, {p99:.1} us 99 %, {max:.1} us at most; a frame whose stamps are more than \
             {:.0} us apart counts as missed by both",
            self.tolerance_us
        )?;
        for Adapter { device, not_known, .. } in &self.adapters {
            if let Some(not_known) = not_known {
                writeln!(out, "'{device}': {not_known}")?;
            }
        }
        Ok(())
    }
}
