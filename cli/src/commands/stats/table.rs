//! Statistics as text for people.

use cantap_trace::counted;
use cantap_trace::{BusErrorKind, LossStage};
use std::fmt::Write as _;

use cantap_analysis::stats::{ChannelSummary, IdSummary, PeakSummary, Summary, is_of_a_part};

use cantap_work::lost_frames;
use cantap_work::missing::Missing;

/// The whole text, for a terminal of at least eighty columns.
pub(super) fn text(summary: &Summary, missing: &Missing, per_id: bool) -> String {
    let mut out = String::new();
    // Writing to a String cannot fail.
    let _ = writeln!(
        out,
        "{} in {:.6} s on {} {}, {} lost, {}",
        counted(summary.frames, "frame"),
        summary.duration_s,
        summary.channels.len(),
        if summary.channels.len() == 1 { "channel" } else { "channels" },
        lost_frames(summary.lost, summary.lost_at_least),
        counted(summary.errors, "error"),
    );
    if summary.lin_frames > 0 {
        let _ = writeln!(
            out,
            "beside them {}, which are in no other figure",
            counted(summary.lin_frames, "LIN frame")
        );
    }
    if let Some(text) = missing.description() {
        let _ = writeln!(out, "not in these figures: {text}");
    }
    for channel in &summary.channels {
        channel_text(channel, summary, &mut out);
        if per_id {
            ids_text(&channel.ids, &mut out);
        }
    }
    out
}

/// What else can be shown, after everything else.
pub(super) fn hint(summary: &Summary, per_id: bool) -> &'static str {
    let has_ids = summary.channels.iter().any(|channel| !channel.ids.is_empty());
    if has_ids && !per_id { "\nperiods and jitter of each identifier: --per-id\n" } else { "" }
}

fn channel_text(channel: &ChannelSummary, summary: &Summary, out: &mut String) {
    let _ = match channel.bitrate {
        Some(bitrate) => {
            let data = channel.data_bitrate.map_or(String::new(), |data| format!(", data at {data} bit/s"));
            let from = if channel.bitrate_from_trace { ", as the trace says" } else { "" };
            writeln!(out, "\nChannel {} at {bitrate} bit/s{from}{data}", channel.channel)
        }
        None => {
            writeln!(out, "\nChannel {}, bit rate unknown: give it with -b for the load", channel.channel)
        }
    };
    let _ = writeln!(
        out,
        "  frames    {} ({} standard, {} extended, {} remote, {} sent), {:.1} frames/s",
        channel.frames,
        channel.standard,
        channel.extended,
        channel.remote,
        channel.sent,
        channel.frames_per_s,
    );
    if channel.fd > 0 {
        let _ = writeln!(
            out,
            "  CAN FD    {} ({} with a switched bit rate, {} of an error passive sender)",
            counted(channel.fd, "frame"),
            channel.brs,
            channel.esi,
        );
    }
    let _ = writeln!(
        out,
        "  bits      {} with stuff bits and intermission, {:.0} bit/s",
        channel.bits, channel.bits_per_s
    );
    if channel.bitrate.is_some() && channel.brs > 0 && channel.data_bitrate.is_none() {
        let _ = writeln!(
            out,
            "  load      unknown: frames switch to a data bit rate, which --data-bitrate gives (such as 2M)",
        );
    } else if let (Some(_), None, Some(reason)) =
        (channel.bitrate, &channel.load, channel.no_bus_load_because)
    {
        let _ = writeln!(out, "  load      –: {reason}");
    }
    if let Some(load) = &channel.load {
        let percent = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3} %"));
        let bound =
            if channel.lost.total > 0 { ", without the windows from which frames are missing" } else { "" };
        // A bus that stopped was not as busy all the time.
        let over = if is_of_a_part(channel.duration_s, summary.observed_s) {
            format!(" over {:.3} s of {:.3} s", channel.duration_s, summary.observed_s)
        } else {
            String::new()
        };
        let _ = writeln!(
            out,
            "  load      mean {}{over}, last {}, highest between two frames {}",
            percent(load.mean_pct),
            percent(load.instant_pct),
            percent(load.instant_max_pct),
        );
        if load.window_max_pct.is_none() && load.window_min_pct.is_none() && channel.lost.total == 0 {
            let _ = writeln!(
                out,
                "  windows   {} s: the trace is too short for one; choose shorter ones with --window",
                summary.window_s
            );
        } else {
            let _ = writeln!(
                out,
                "  windows   {} s: least {}, mean {}, most {}{bound}",
                summary.window_s,
                percent(load.window_min_pct),
                percent(load.window_mean_pct),
                percent(load.window_max_pct),
            );
        }
    }
    let errors = &channel.errors;
    if errors.total > 0 {
        let kinds = [
            (errors.stuff, BusErrorKind::Stuff.name()),
            (errors.form, BusErrorKind::Form.name()),
            (errors.acknowledgment, BusErrorKind::Acknowledgment.name()),
            (errors.bit_recessive, BusErrorKind::BitRecessive.name()),
            (errors.bit_dominant, BusErrorKind::BitDominant.name()),
            (errors.crc, BusErrorKind::Crc.name()),
            (errors.unknown, "unknown"),
            (errors.suppressed, "not reported one by one"),
        ];
        let _ = writeln!(out, "  errors    {}: {}", errors.total, listed(&kinds));
    }
    let lost = &channel.lost;
    if lost.gaps > 0 {
        let stages = [
            (lost.controller, LossStage::Controller.name()),
            (lost.queue, LossStage::Queue.name()),
            (lost.link, LossStage::Link.name()),
            (lost.host, LossStage::Host.name()),
            (lost.gateway, LossStage::Gateway.name()),
            (lost.unknown, "unknown"),
        ];
        let places = counted(lost.gaps, "place");
        let _ = match (lost.total, lost.at_least) {
            // For example while a device was gone.
            (0, _) => writeln!(out, "  lost      an unknown number at {places}"),
            (total, true) => {
                let _ = write!(out, "  lost      at least {total} at {places}: {}", listed(&stages));
                match lost.uncounted {
                    0 => writeln!(out),
                    1 => writeln!(out, ", and an unknown number at one of them"),
                    uncounted => writeln!(out, ", and an unknown number at {uncounted} of them"),
                }
            }
            (total, false) => writeln!(out, "  lost      {total} at {places}: {}", listed(&stages)),
        };
    }
    if let Some(state) = channel.state {
        let counters = channel.error_counters;
        let counters = counters.map_or(String::new(), |(tec, rec)| format!(", counters {tec} / {rec}"));
        let _ = writeln!(out, "  state     {state}{counters}");
    }
    if channel.out_of_order > 0 {
        let _ = writeln!(
            out,
            "  times     {} older than the one before",
            counted(channel.out_of_order, "record")
        );
    }
    if let Some(step_s) = channel.stamp_step_s {
        let _ = writeln!(
            out,
            "  times     the stamps are multiples of {step_s} s, coarser than the frames: shorter periods and windows say nothing"
        );
    }
    if channel.late > 0 {
        let _ = writeln!(out, "  times     {} with only an upper bound", counted(channel.late, "frame"));
    }
    if channel.transmit_failures > 0 {
        let _ = writeln!(out, "  sending   {} not sent", counted(channel.transmit_failures, "frame"));
    }
    // Of a channel of which only states are known, no window is busy.
    if channel.peaks.iter().any(|window| window.frames_per_s > 0.0) {
        out.push_str("  busiest windows\n");
        let zero_s = summary.origin_s.unwrap_or(0.0);
        for window in &channel.peaks {
            let _ = writeln!(out, "{}", window_line(window, zero_s));
        }
    }
}

/// The counts above zero with their names.
fn listed(counts: &[(u64, &str)]) -> String {
    let some: Vec<_> = counts
        .iter()
        .filter(|(count, _)| *count > 0)
        .map(|(count, name)| format!("{count} {name}"))
        .collect();
    some.join(", ")
}

/// A window with its start relative to `zero_s`.
pub(super) fn window_line(window: &PeakSummary, zero_s: f64) -> String {
    let load = window.load_pct.map_or(String::new(), |load| format!("{load:>8.3} %"));
    // A value that rounds to zero has no sign.
    let since_s = window.start_s - zero_s;
    let since_s = if since_s.abs() < 0.000_5 { 0.0 } else { since_s };
    let line = format!(
        "    {} {:>+12.3} s {load} {:>9.1} frames/s {:>9.0} bit/s",
        window.channel, since_s, window.frames_per_s, window.bits_per_s
    );
    line + remarks(window.errors, window.lost, window.incomplete).as_str()
}

/// Remarks about a window, to be appended to its figures.
pub(super) fn remarks(errors: u64, lost: u64, incomplete: bool) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    if errors > 0 {
        let _ = write!(text, " {}", counted(errors, "error"));
    }
    if lost > 0 {
        let _ = write!(text, " {lost} lost");
    }
    if incomplete {
        text.push_str(", frames are missing");
    }
    text
}

fn ids_text(ids: &[IdSummary], out: &mut String) {
    let _ = writeln!(
        out,
        "  {:<8} {:>9} {:>10} {:>10} {:>10} {:>10} {:>7}  DLC",
        "ID", "count", "min ms", "mean ms", "max ms", "jitter ms", "share"
    );
    for id in ids {
        let ms = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
        let dlcs: Vec<_> = id.dlcs.iter().map(ToString::to_string).collect();
        let changes = match id.dlc_changes {
            0 => String::new(),
            1 => " (1 change)".to_owned(),
            changes => format!(" ({changes} changes)"),
        };
        let _ = writeln!(
            out,
            "  {:<8} {:>9} {:>10} {:>10} {:>10} {:>10} {:>6.2}%  {}{changes}",
            id.id,
            id.count,
            ms(id.period_min_ms),
            ms(id.period_mean_ms),
            ms(id.period_max_ms),
            ms(id.jitter_ms),
            id.share_pct,
            dlcs.join(",")
        );
    }
}
