//! The second line: source, load per channel, losses, recording, what hides something.

use std::time::Instant;

use cantap::wire::message::Mode;
use ratatui::text::{Line, Span};

use super::super::app::App;
use super::super::model::{Model, SourceState};
use super::super::theme::Theme;
use super::list::bytes;

/// Characters of an address that there is room for beside the rest.
const MOST_ADDRESS: usize = 32;

/// Source, load per channel, recording, filters.
pub fn line(app: &App, model: &Model) -> Line<'static> {
    let theme = app.theme;
    let source = app.plan.as_ref().map_or("file".to_owned(), |plan| {
        let mode = match plan.mode() {
            Mode::ListenOnly => "listen-only",
            Mode::Normal => "normal",
            Mode::Loopback => "loopback",
            Mode::SilentLoopback => "silent loopback",
        };
        format!("{} {mode}", end_of(&plan.name()))
    });
    let style = match model.source {
        SourceState::Gone(_) => theme.error(),
        _ => theme.label(),
    };
    let mut spans = vec![Span::styled(format!(" {source}: {}", source_text(app, model)), style)];
    let deaf: Vec<String> =
        model.hearing.errors_only(Instant::now()).map(|number| number.to_string()).collect();
    if !deaf.is_empty() {
        spans.push(Span::styled(
            format!("  {}: ONLY ERRORS, A finds the bit rate", deaf.join(", ")),
            theme.error(),
        ));
    }
    if let Some((count, _)) = &model.unread {
        spans.push(Span::styled(format!("  {count} unreadable"), theme.error()));
    }
    for (channel, windows) in &model.seen.loads {
        if let Some(load) = windows.back().and_then(|window| window.load_pct) {
            spans.push(Span::raw(format!("  {channel} ")));
            spans.push(Span::styled(format!("{load:.1} %"), theme.load(load)));
        }
    }
    let (lost, or_more) = model.seen.lost();
    if lost > 0 || or_more {
        let more = if or_more { "+" } else { "" };
        spans.push(Span::styled(format!("  lost {lost}{more}"), theme.loss()));
    }
    if let Some(recording) = &model.recording {
        spans.push(Span::styled(format!("  REC {}", bytes(recording.bytes)), theme.error()));
    }
    if app.frozen.is_some() {
        spans.push(Span::styled("  PAUSED", Theme::heading()));
    }
    if !model.history.filters().is_empty() {
        spans.push(Span::styled("  FILTER", Theme::heading()));
    }
    Line::from(spans)
}

/// The end of a long address, where its name is.
fn end_of(address: &str) -> String {
    let hidden = address.chars().count().saturating_sub(MOST_ADDRESS);
    if hidden == 0 {
        return address.to_owned();
    }
    std::iter::once('…').chain(address.chars().skip(hidden + 1)).collect()
}

/// How the source is, in words for the second line.
fn source_text(app: &App, model: &Model) -> String {
    match &model.source {
        SourceState::Starting => "connecting".to_owned(),
        SourceState::Running => "running".to_owned(),
        SourceState::Searching => "finding the bit rate".to_owned(),
        SourceState::Gone(_) if app.plan.is_some() => "GONE, trying again".to_owned(),
        SourceState::Gone(_) => "cannot be played".to_owned(),
        SourceState::Playing { factor, paused, looped, ended } => {
            let state = match (paused, ended) {
                (_, true) => "ended",
                (true, _) => "stopped",
                _ => "playing",
            };
            let looped = if *looped { ", loop" } else { "" };
            let speed =
                if *factor == 0.0 { "as fast as can be".to_owned() } else { format!("delay ×{factor}") };
            format!("{state}, {speed}{looped}")
        }
    }
}
