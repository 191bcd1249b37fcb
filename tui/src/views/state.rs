//! The second line: source, mode, each channel's activity, losses, recording, anything that hides records; for a file, the
//! position.

use std::time::Instant;

use cantap::wire::message::Mode;
use cantap::wire::record::ErrorState;
use cantap_analysis::stats::Window;
use cantap_work::bus_hints::BusHint;
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::app::{App, View};
use super::super::cut::draw_lines;
use super::super::model::{Model, Playing, SourceState};
use super::super::theme::Theme;
use super::super::times::duration;
use super::list::bytes;

/// Maximum number of characters of an address, on a wide screen and on a narrow one.
const MOST_ADDRESS: [usize; 2] = [32, 16];
/// Number of windows over which the displayed rate is averaged: a second.
const RATE_WINDOWS: usize = 4;
/// With fewer columns than this, there is no bar.
const LEAST_BAR: usize = 10;

/// How much is shown of each channel, depending on the room.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Detail {
    Nothing,
    Load,
    BitRate,
    Frames,
}

/// Draws it.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model) {
    let room = usize::from(area.width);
    let ways = [Detail::Frames, Detail::BitRate, Detail::Load, Detail::Nothing];
    let mut lines = ways.iter().flat_map(|detail| MOST_ADDRESS.map(|most| line(app, model, *detail, most)));
    let mut spans =
        lines.find(|spans| width(spans) <= room).unwrap_or_else(|| line(app, model, Detail::Nothing, 8));
    app.bar = None;
    if let SourceState::Playing(playing) = model.source {
        let start = width(&spans) + 2;
        let columns = room.saturating_sub(start + 1);
        if columns >= LEAST_BAR
            && let Some(end_ns) = playing.end_ns
        {
            spans.push(Span::raw("  "));
            spans.push(Span::raw(bar(playing, end_ns, &app.bookmarks, columns)));
            app.bar = Some(Rect { x: area.x + start as u16, width: columns as u16, ..area });
        }
    }
    draw_lines(frame, area, vec![Line::from(spans)]);
}

fn width(spans: &[Span<'_>]) -> usize {
    spans.iter().map(|span| span.content.chars().count()).sum()
}

/// The line, with this much of each channel and this many characters of an address.
fn line(app: &App, model: &Model, detail: Detail, most_address: usize) -> Vec<Span<'static>> {
    let theme = app.theme;
    let style = match model.source {
        SourceState::Gone(_) => theme.error(),
        _ => theme.label(),
    };
    let mut spans = match &app.plan {
        None => {
            let name = app.file.as_deref().unwrap_or("file");
            vec![Span::styled(format!(" {}", end_of(name, most_address)), style)]
        }
        Some(plan) => {
            let (mode, mode_style) = mode(plan.mode(), theme, style);
            vec![
                Span::styled(format!(" {} ", end_of(&plan.name(), most_address)), style),
                Span::styled(mode, mode_style),
            ]
        }
    };
    spans.push(Span::styled(format!(": {}", source_text(app, model)), style));
    spans.extend(errors_only(model).map(|text| Span::styled(format!("  {text}"), theme.error())));
    let channels = model.seen.statistics.channels();
    let mut off: Vec<u8> = channels
        .iter()
        .filter(|channel| channel.state == Some(ErrorState::BusOff))
        .map(|channel| channel.number)
        .collect();
    if app.plan.is_some() && !off.is_empty() {
        off.sort_unstable();
        let off: Vec<String> = off.iter().map(u8::to_string).collect();
        spans.push(Span::styled(format!("  {}: BUS-OFF, R recovers", off.join(", ")), theme.error()));
    }
    if let (Some(from_ns), SourceState::Playing(playing)) = (model.counted_from_ns, &model.source) {
        let from = duration(from_ns.saturating_sub(playing.first_ns));
        spans.push(Span::styled(format!("  COUNTED FROM {from}"), Theme::heading()));
    }
    if let Some((count, _)) = &model.unread {
        spans.push(Span::styled(format!("  {count} unreadable"), theme.error()));
    }
    for (channel, windows) in &model.seen.loads {
        if let Some(latest) = windows.back() {
            let recent = windows.iter().rev().take(RATE_WINDOWS);
            spans.extend(channel_text(*channel, latest, recent, model, theme, detail));
        }
    }
    let errors: u64 = channels.iter().map(|channel| channel.errors.total()).sum();
    if errors > 0 {
        spans.push(Span::styled(format!("  errors {errors}"), theme.error()));
    }
    let (lost, or_more) = model.seen.lost();
    if lost > 0 || or_more {
        let lost = match (lost, or_more) {
            // As while the device was off the bus.
            (0, _) => "?".to_owned(),
            (lost, or_more) => format!("{lost}{}", if or_more { "+" } else { "" }),
        };
        spans.push(Span::styled(format!("  lost {lost}"), theme.loss()));
    }
    if let Some(recording) = &model.recording {
        spans.push(match &recording.condition {
            Some(_) if recording.events == 0 => Span::styled("  ARMED", theme.loss()),
            _ => Span::styled(format!("  REC {}", bytes(recording.bytes)), theme.error()),
        });
    }
    if app.frozen.is_some() {
        spans.push(Span::styled("  PAUSED", Theme::heading()));
    } else if (app.view == View::Trace && app.cursor.is_some())
        || (app.view == View::Graph && app.graph.end_ns.is_some())
    {
        spans.push(Span::styled("  NOT FOLLOWING", Theme::heading()));
    }
    if model.history.is_narrowed() {
        spans.push(Span::styled("  FILTER", Theme::heading()));
    }
    if app.view == View::Signals && !app.signals.filter.text().is_empty() {
        spans.push(Span::styled(format!("  {}", app.signals.filter.text()), Theme::heading()));
    }
    spans
}

/// What is said of the channels that receive errors and no frame, those of the same kind together.
fn errors_only(model: &Model) -> impl Iterator<Item = String> {
    let mut kinds: Vec<(&str, Vec<String>)> = Vec::new();
    for number in model.reception.errors_only(Instant::now()) {
        let kind = model.reception.hint(number, false).unwrap_or(BusHint::WrongBitRate).short();
        match kinds.iter_mut().find(|(known, _)| *known == kind) {
            Some((_, numbers)) => numbers.push(number.to_string()),
            None => kinds.push((kind, vec![number.to_string()])),
        }
    }
    kinds.into_iter().map(|(kind, numbers)| {
        let press = if kind == BusHint::WrongBitRate.short() { ", press A" } else { "" };
        format!("{}: {kind}{press}", numbers.join(", "))
    })
}

/// A mode that acknowledges and sends must not be overlooked.
fn mode(mode: Mode, theme: Theme, quiet: Style) -> (&'static str, Style) {
    match mode {
        Mode::ListenOnly => ("listen-only", quiet),
        Mode::Normal => ("NORMAL", theme.error()),
        Mode::Loopback => ("loopback", quiet),
        Mode::SilentLoopback => ("silent loopback", quiet),
    }
}

fn channel_text<'a>(
    channel: u8,
    latest: &Window,
    recent: impl Iterator<Item = &'a Window> + Clone,
    model: &Model,
    theme: Theme,
    detail: Detail,
) -> Vec<Span<'static>> {
    let mut spans = Vec::new();
    let load = latest.load_pct;
    if detail == Detail::Nothing || (load.is_none() && detail < Detail::Frames) {
        return spans;
    }
    spans.push(Span::raw(format!("  {channel}")));
    if let Some(rate) = model.options().bitrate_of(channel).filter(|_| detail >= Detail::BitRate) {
        spans.push(Span::raw(format!(" {}k", f64::from(rate) / 1000.0)));
    }
    if let Some(load) = load {
        spans.push(Span::styled(format!(" {load:.1} %"), theme.load(load)));
    }
    if detail >= Detail::Frames {
        let count = recent.clone().count().max(1);
        let per_s = recent.map(Window::frames_per_s).sum::<f64>() / count as f64;
        spans.push(Span::raw(format!(" {per_s:.0}/s")));
    }
    spans
}

/// The end of a long address, which contains its name.
fn end_of(address: &str, most: usize) -> String {
    let hidden = address.chars().count().saturating_sub(most);
    if hidden == 0 {
        return address.to_owned();
    }
    std::iter::once('…').chain(address.chars().skip(hidden + 1)).collect()
}

/// The state of the source, as text.
fn source_text(app: &App, model: &Model) -> String {
    match &model.source {
        SourceState::Starting => "connecting".to_owned(),
        SourceState::Running => "running".to_owned(),
        SourceState::Searching => "finding the bit rate".to_owned(),
        SourceState::Gone(_) if app.plan.is_some() => "GONE, trying again".to_owned(),
        SourceState::Gone(_) => "cannot be played".to_owned(),
        SourceState::Playing(playing) => playing_text(*playing),
    }
}

fn playing_text(playing: Playing) -> String {
    let state = match (playing.seeking, playing.paused, playing.ended) {
        (true, ..) => "going there",
        (_, _, true) => "ended",
        (_, true, _) => "stopped",
        _ => "playing",
    };
    // The engine's factor is the delay: above 1, speed is its inverse.
    let speed = match playing.factor {
        0.0 => "as fast as possible".to_owned(),
        factor => format!("×{}", (1e4 / factor).round() / 1e4),
    };
    let at = duration(playing.position_ns.saturating_sub(playing.first_ns));
    let of =
        playing.end_ns.map_or("…".to_owned(), |end_ns| duration(end_ns.saturating_sub(playing.first_ns)));
    format!("{state} {speed}{} {at} / {of}", if playing.looped { ", loop" } else { "" })
}

/// The position in the file, with the bookmarks.
fn bar(playing: Playing, end_ns: i64, bookmarks: &[i64], columns: usize) -> String {
    let span = (end_ns as f64 - playing.first_ns as f64).max(1.0);
    let place = |time_ns: i64| {
        let share = (time_ns as f64 - playing.first_ns as f64) / span;
        (0.0..=1.0).contains(&share).then(|| (share * (columns - 1) as f64).round() as usize)
    };
    let at = place(playing.position_ns).unwrap_or(columns - 1);
    let mut bar: Vec<char> = (0..columns).map(|column| if column < at { '━' } else { '─' }).collect();
    for place in bookmarks.iter().filter_map(|time_ns| place(*time_ns)) {
        bar[place] = '◆';
    }
    bar[at] = '●';
    bar.into_iter().collect()
}
