//! Load with its history, rates, errors, losses per stage, and the device's state.

use cantap::Channel;
use cantap::device::{ClockSource, channel_number};
use cantap::wire::record::{BusErrorKind, LossStage};
use cantap_analysis::stats::{ChannelStatistics, is_of_a_part};
use cantap_trace::counted;
use cantap_work::bus_hints::{BusHint, HintPlace};
use cantap_work::channels::place_of;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::text::{Line, Span};

use super::super::app::App;
use super::super::cut::draw_lines;
use super::super::model::{DeviceFigures, Model, Seen, SourceState};
use super::super::theme::Theme;
use super::super::times::duration;
use super::bottom::wrapped;
use super::list::bytes;

/// Number of columns of the gauge on a narrow and on a wide screen.
const GAUGE_COLUMNS: [usize; 2] = [12, 40];
/// Columns of a line's label.
const LABEL: usize = 10;

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model, seen: &Seen) {
    let mut lines = Vec::new();
    let width = usize::from(area.width);
    let mut channels: Vec<_> = seen.statistics.channels().iter().collect();
    channels.sort_by_key(|channel| channel.number);
    for channel in channels {
        channel_lines(channel, width, app, seen, &mut lines);
        hint_lines(channel.number, channel.frames > 0, model, app, width, &mut lines);
        lines.push(Line::default());
    }
    if lines.is_empty() {
        lines.push(Line::from("Nothing was received yet."));
        if let Some(first) = app.plan.as_ref().and_then(|plan| plan.channels.first()) {
            hint_lines(*first, false, model, app, width, &mut lines);
        }
        lines.push(Line::default());
    }
    for (board, device) in seen.devices.iter().enumerate() {
        device_lines(board, device, &mut lines);
    }
    let (used, most) = model.history.memory();
    lines.push(Line::from(format!(
        "Memory    {} of {}, {} of {}",
        model.history.len(),
        counted(seen.taken, "record"),
        bytes(used as u64),
        bytes(most as u64)
    )));
    let (values, used, most) = seen.signals.graph_memory();
    lines.push(Line::from(format!(
        "Graph     {values}, {} of {}",
        bytes(used as u64),
        bytes(most as u64),
        values = counted(values, "value")
    )));
    app.page_rows = usize::from(area.height);
    // Scrolled with the arrows if the screen is small.
    let most = lines.len().saturating_sub(app.page_rows);
    app.selected = app.selected.min(most);
    let first = app.selected;
    draw_lines(frame, area, lines.split_off(first));
}

fn channel_lines(
    channel: &ChannelStatistics,
    width: usize,
    app: &App,
    seen: &Seen,
    lines: &mut Vec<Line<'static>>,
) {
    let theme = app.theme;
    let from = if seen.statistics.is_learned(channel.number) { ", as the trace says" } else { "" };
    let rate =
        channel.bitrate_bps.map_or("bit rate unknown (-b)".to_owned(), |rate| format!("{rate} bit/s{from}"));
    let state = channel.state.map_or(String::new(), |state| format!(", {}", state.name()));
    let counters = channel.counters.map_or(String::new(), |(tec, rec)| format!(", counters {tec} / {rec}"));
    lines.push(
        Line::from(format!("Channel {}: {rate}{state}{counters}", channel.number)).style(Theme::heading()),
    );
    let windows = seen.loads.iter().find(|(number, _)| *number == channel.number).map(|(_, windows)| windows);
    let latest = windows.and_then(|windows| windows.back());
    if let Some(load) = latest.and_then(|window| window.load_pct) {
        let observed_ns = seen.statistics.observed_ns();
        lines.push(gauge(load, GAUGE_COLUMNS[usize::from(width >= 110)], channel, observed_ns, app));
    }
    let (frames_per_s, bits_per_s) =
        latest.map_or((0.0, 0.0), |window| (window.frames_per_s(), window.bits_per_s()));
    lines.push(Line::from(format!(
        "Frames    {:>10}   {frames_per_s:.0} frames/s, {bits_per_s:.0} bit/s; {} IDs",
        channel.frames,
        channel.id_count()
    )));
    let kinds = BusErrorKind::ALL.into_iter().filter_map(|kind| {
        let count = channel.errors.of(kind);
        (count > 0).then(|| format!("{count} {}", kind.name()))
    });
    let kinds: Vec<_> = kinds.collect();
    let errors = channel.errors.total();
    let style = if errors > 0 { theme.error() } else { theme.label() };
    lines.push(Line::styled(format!("Errors    {errors:>10}   {}", kinds.join(", ")), style));
    let losses = &channel.losses;
    // Few boards are a gateway.
    let shown = |stage: &LossStage| *stage != LossStage::Gateway || losses.of(*stage) > 0;
    let stages = LossStage::ALL.into_iter().filter(shown);
    let stages: Vec<_> = stages.map(|stage| format!("{} {}", stage.name(), losses.of(stage))).collect();
    let style = if losses.gaps > 0 { theme.loss() } else { theme.label() };
    // Where nothing was counted and something may be missing, zero would be a claim.
    let (total, least) = match (losses.total(), losses.at_least) {
        (0, true) => ("?".to_owned(), ""),
        (total, at_least) => (total.to_string(), if at_least { " at least" } else { "" }),
    };
    let uncounted = match losses.uncounted {
        0 => String::new(),
        1 => "; an unknown number".to_owned(),
        uncounted => format!("; an unknown number at {uncounted}", uncounted = counted(uncounted, "place")),
    };
    lines.push(Line::styled(
        format!("Lost      {total:>10}{least}   {}{uncounted}", stages.join(", ")),
        style,
    ));
    if let Some(windows) = windows.filter(|windows| windows.iter().any(|window| window.load_pct.is_some())) {
        let columns = width.saturating_sub(11).max(1);
        let first = windows.len().saturating_sub(columns);
        let levels: &[char] = if theme.unicode {
            &[' ', '▁', '▂', '▃', '▄', '▅', '▆', '▇', '█']
        } else {
            &[' ', '.', ':', '-', '=', '+', '*', '#', '@']
        };
        let bars: String = windows
            .iter()
            .skip(first)
            .map(|window| levels[((window.load_pct.unwrap_or(0.0) * 8.0 / 100.0).ceil() as usize).min(8)])
            .collect();
        lines.push(Line::from(vec![Span::raw("History   "), Span::styled(bars, theme.series(0))]));
    }
}

/// What is probably the matter with the bus of a device's channel, and what to do next. One that has had frames is
/// not silent because it was opened again.
fn hint_lines(
    number: u8,
    had_frames: bool,
    model: &Model,
    app: &App,
    width: usize,
    lines: &mut Vec<Line<'static>>,
) {
    let is_open = app.plan.is_some() && matches!(model.source, SourceState::Running);
    let hint = model
        .reception
        .hint(number, false)
        .filter(|hint| is_open && !(had_frames && *hint == BusHint::Silent));
    let Some(hint) = hint else { return };
    let (board, channel) = place_of(number);
    let addresses = app.plan.as_ref().map(|plan| &plan.addresses);
    let device =
        addresses.and_then(|addresses| addresses.get(board)).map(ToString::to_string).unwrap_or_default();
    let next = hint.next_step(&HintPlace { number, device: &device, channel_there: channel.number() });
    for (label, text, style) in
        [("Hint", hint.meaning(), app.theme.error()), ("Next", next.as_str(), app.theme.label())]
    {
        for (at, part) in wrapped(text, width.saturating_sub(LABEL)).into_iter().enumerate() {
            let label = if at == 0 { label } else { "" };
            lines.push(Line::styled(format!("{label:<LABEL$}{part}"), style));
        }
    }
}

/// A bar for the load, with current, mean and peak load as figures.
fn gauge(
    load: f64,
    columns: usize,
    channel: &ChannelStatistics,
    observed_ns: u64,
    app: &App,
) -> Line<'static> {
    let (full, empty) = if app.theme.unicode { ('█', '░') } else { ('#', '.') };
    let filled = ((load * columns as f64 / 100.0).round() as usize).min(columns);
    let bar: String = (0..columns).map(|column| if column < filled { full } else { empty }).collect();
    let percent = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.1} %"));
    let work = channel.load.as_ref();
    let peak = channel.window_largest_pct();
    // The mean of a bus that stopped is of the time before.
    let covered_ns = channel.covered_ns();
    let over = if is_of_a_part(covered_ns as f64, observed_ns as f64) {
        match covered_ns {
            ..60_000_000_000 => format!(" over {:.1} s", covered_ns as f64 / 1e9),
            _ => format!(" over {}", duration(covered_ns as i64)),
        }
    } else {
        String::new()
    };
    // It does not include lost frames.
    let bound = match (channel.losses.total(), app.theme.unicode) {
        (0, _) => "",
        (_, true) => "≥ ",
        (_, false) => ">= ",
    };
    Line::from(vec![
        Span::raw("Load      "),
        Span::styled(bar, app.theme.load(load)),
        Span::raw(format!(
            " {bound}{load:.1} %  instant {}  mean {}{over}  peak {}",
            percent(work.and_then(cantap_analysis::stats::WorkLoad::instant_pct)),
            percent(work.and_then(cantap_analysis::stats::WorkLoad::mean_pct)),
            percent(peak)
        )),
    ])
}

fn device_lines(board: usize, device: &DeviceFigures, lines: &mut Vec<Line<'static>>) {
    lines.push(Line::from(format!("Device {}", device.name)).style(Theme::heading()));
    let delivered: u64 = device.counters.channels.iter().map(|channel| channel.received).sum();
    if let Some(status) = &device.status {
        let share = |bytes: u32| f64::from(bytes) * 100.0 / f64::from(device.queue_bytes.max(1));
        lines.push(Line::from(format!(
            "Queue     {:.1} % of {} kB now, at most {:.1} %",
            share(status.queue_bytes),
            device.queue_bytes / 1024,
            share(status.queue_high_water_bytes)
        )));
        for (place, channel) in Channel::ALL.into_iter().zip(&status.channels) {
            let number = channel_number(board, place);
            if channel.open.is_some() {
                lines.push(Line::from(format!(
                    "Bus {number}     {}, counters {} / {}, sent {}, failed {}, waiting {}",
                    channel.state.name(),
                    channel.tec,
                    channel.rec,
                    channel.transmitted,
                    channel.transmit_failures,
                    channel.tx_pending
                )));
            }
        }
    }
    let per_frame = device.counters.bytes as f64 / delivered.max(1) as f64;
    lines.push(Line::from(format!(
        "Wire      {per_frame:.2} bytes/frame, {} damaged messages, {} reconnects",
        device.counters.corrupt, device.reconnects
    )));
    if let Some(clock) = &device.clock {
        let drift = clock.drift_ppm.map_or("not known yet".to_owned(), |ppm| format!("{ppm:+.2} ppm"));
        lines.push(Line::from(format!(
            "Clock     drift {drift}, round trip {} µs{}",
            clock.round_trip_ns / 1000,
            if clock.source == ClockSource::Frames { ", by USB frames" } else { "" }
        )));
    }
}
