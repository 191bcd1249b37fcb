//! The first page's figures.

use cantap_analysis::stats::WorkLoad;
use serde::Serialize;

use crate::trace::Trace;

/// Times before 1980 are no dates but times since a trace's start.
const FIRST_DATE_NS: i64 = 315_532_800_000_000_000;

/// `Summary` in `api.ts`.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub struct Summary {
    name: String,
    format: String,
    start_utc_ns: Option<String>,
    /// Of the first record that is kept, in seconds.
    begin: f64,
    duration: f64,
    frames: u64,
    records: usize,
    forgotten: usize,
    channels: Vec<ChannelSummary>,
    losses: Vec<Loss>,
    issues: Vec<Issue>,
    growing: bool,
    progress: Option<f64>,
    device_times: bool,
}

#[derive(Serialize)]
struct ChannelSummary {
    channel: u8,
    frames: u64,
    sent: u64,
    remote: u64,
    errors: u64,
    bitrate: Option<u32>,
    load: Option<f64>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Loss {
    stage: &'static str,
    channel: Option<u8>,
    count: u64,
    at_least: bool,
}

#[derive(Serialize)]
struct Issue {
    text: String,
    count: u64,
}

impl Summary {
    /// Of a trace, as far as it was read.
    pub fn of(trace: &Trace) -> Self {
        let content = &trace.content;
        let statistics = &content.statistics;
        let mut channels: Vec<_> = statistics
            .channels()
            .iter()
            .map(|channel| ChannelSummary {
                channel: channel.number,
                frames: channel.frames,
                sent: channel.sent,
                remote: channel.remote,
                errors: channel.errors.total(),
                bitrate: channel.bitrate_bps,
                load: channel.load.as_ref().and_then(WorkLoad::mean_pct).map(|load| load / 100.0),
            })
            .collect();
        channels.sort_by_key(|channel| channel.channel);
        let origin_ns = content.origin_ns();
        let has_records = content.store.len() > 0;
        let progress = trace.progress();
        Self {
            name: trace.name().to_owned(),
            format: trace.format().map_or(String::new(), |format| format.to_string()),
            start_utc_ns: (has_records && origin_ns >= FIRST_DATE_NS).then(|| origin_ns.to_string()),
            begin: if has_records { content.seconds(content.begin_kept_ns()) } else { 0.0 },
            duration: if has_records { content.seconds(content.end_ns()).max(0.0) } else { 0.0 },
            frames: statistics.channels().iter().map(|channel| channel.frames).sum(),
            records: content.store.len(),
            forgotten: content.forgotten(),
            channels,
            losses: losses(trace),
            issues: content.unread().into_iter().map(|(text, count)| Issue { text, count }).collect(),
            growing: progress.growing,
            progress: progress.part,
            device_times: content.store.has_device_times(),
        }
    }
}

/// By channel and stage.
fn losses(trace: &Trace) -> Vec<Loss> {
    let mut losses: Vec<Loss> = Vec::new();
    for gap in trace.content.gaps.all(trace.content.end_ns()) {
        if gap.stage == crate::gaps::BUS_OFF {
            continue;
        }
        let known =
            losses.iter_mut().find(|loss| loss.channel == Some(gap.channel) && loss.stage == gap.stage);
        if let Some(loss) = known {
            loss.count += gap.count;
            loss.at_least |= gap.at_least;
        } else {
            let channel = Some(gap.channel);
            losses.push(Loss { stage: gap.stage, channel, count: gap.count, at_least: gap.at_least });
        }
    }
    losses.sort_by_key(|loss| (loss.channel, loss.stage));
    losses
}
