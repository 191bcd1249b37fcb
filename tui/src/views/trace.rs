//! Every record in order, scrolling back through the history.

use std::fmt::Write as _;

use cantap::wire::record::ErrorState;
use cantap::{TraceEvent, TraceRecord};
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::Style;
use ratatui::text::{Line, Span};

use super::super::app::{App, TimeMode};
use super::super::cut::draw_lines;
use super::super::event_text::{event_text, hex, lost, printable};
use super::super::model::Model;
use super::super::theme::Theme;
use super::super::times::{clock, seconds};
use super::list::bytes;
use super::signals::{alarm, in_line};

/// With at least this many columns, there is room for a frame's signals beside the data.
const LEAST_WITH_SIGNALS: u16 = 120;

/// Draws the page.
pub fn draw(frame: &mut Frame<'_>, area: Rect, app: &mut App, model: &Model) {
    let history = &model.history;
    let area = if app.record_opened { opened(frame, area, app, model) } else { area };
    let rows = usize::from(area.height).saturating_sub(1) as u64;
    app.page_rows = rows as usize;
    let (first, end) = (history.first(), history.end());
    if let Some(cursor) = app.cursor
        && cursor < first
        && end > first
    {
        // The record being viewed has been dropped.
        app.cursor = Some(first);
    }
    app.bottom = match app.cursor {
        None => end,
        // The page does not move until the selected record leaves it.
        Some(cursor) if (app.bottom.saturating_sub(rows)..app.bottom).contains(&cursor) => app.bottom,
        Some(cursor) if cursor + 1 == app.bottom.saturating_sub(rows) => cursor + rows,
        Some(cursor) if cursor == app.bottom => cursor + 1,
        // Far away: move it to the middle, so that there is something to see on both sides.
        Some(cursor) => cursor + rows / 2 + 1,
    };
    app.bottom = app.bottom.clamp(end.min(first + rows), end);
    let bottom = app.bottom;
    let top = bottom.saturating_sub(rows).max(first);
    let (used, most) = history.memory();
    let width = usize::from(area.width);
    let columns = Columns::of(width);
    let heading = match columns.time {
        0 => String::new(),
        time => format!("{:>time$} ", time_heading(app.time_mode)),
    };
    let characters = if columns.characters { format!("{:<8} ", "ASCII") } else { String::new() };
    let heading = format!("{heading}C   {:>8} T L {:<23} {characters}Name", "ID", "Data");
    let memory = format!("{} of {}", bytes(used as u64), bytes(most as u64));
    let room = width.saturating_sub(heading.chars().count() + memory.chars().count());
    let heading = if room > 1 { format!("{heading}{:room$}{memory}", "") } else { heading };
    let mut lines = vec![Line::styled(heading, Theme::heading())];
    for number in top..bottom {
        let Some(record) = history.get(number) else {
            continue;
        };
        let before = number.checked_sub(1).and_then(|number| history.get(number));
        let mut line = line(&record, before.as_ref(), columns, app, model);
        if area.width >= LEAST_WITH_SIGNALS
            && let Some(frame) = record.frame()
        {
            line.spans.extend(in_line(&model.seen.signals.in_frame(record.channel, frame), app.theme));
        }
        lines.push(if app.cursor == Some(number) { line.style(Theme::bar()) } else { line });
    }
    draw_lines(frame, area, lines);
}

/// The signals of the selected record, or of the newest, below the page; returns the rest of the area.
fn opened(frame: &mut Frame<'_>, area: Rect, app: &App, model: &Model) -> Rect {
    let place = app.cursor.or(model.history.end().checked_sub(1));
    let record = place.and_then(|place| model.history.get(place));
    let of_frame = record.and_then(|record| Some((record, *record.frame()?)));
    let mut lines = vec![
        match (&of_frame, record) {
            (Some((record, frame)), _) => {
                let name = model.seen.signals.name_of(record).unwrap_or("in no database");
                Line::from(format!("{} {}  {name}  {}", record.channel, frame.id(), clock(record.time_ns, 6)))
            }
            (None, Some(record)) => Line::from(event_text(&record.event)),
            (None, None) => Line::from("nothing is selected"),
        }
        .style(Theme::bar()),
    ];
    for signal in of_frame
        .map(|(record, frame)| model.seen.signals.in_frame(record.channel, &frame))
        .unwrap_or_default()
    {
        let (arrow, style) = alarm(signal.alarm, app.theme);
        lines.push(Line::from(vec![
            Span::styled(format!("  {:<30} ", signal.name), app.theme.label()),
            Span::styled(format!("{} {arrow}", signal.text), style),
        ]));
    }
    let height = (lines.len() as u16).min(area.height / 2);
    let [rest, place] = Layout::vertical([Constraint::Min(1), Constraint::Length(height)]).areas(area);
    draw_lines(frame, place, lines);
    rest
}

/// What there is room for: on a narrow screen the data are more important than the time.
#[derive(Clone, Copy)]
struct Columns {
    /// For times; none if it is 0.
    time: usize,
    /// Whether data are also shown as characters.
    characters: bool,
}

impl Columns {
    /// Columns up to the end of eight data bytes, without a time.
    const WITH_DATA: usize = 40;
    /// Columns for a time with microseconds, and with milliseconds.
    const TIMES: [usize; 2] = [17, 10];

    fn of(width: usize) -> Self {
        let time = Self::TIMES.into_iter().find(|time| width > Self::WITH_DATA + time).unwrap_or(0);
        Self { time, characters: width >= Self::WITH_DATA + Self::TIMES[0] + 10 }
    }

    /// A time with a blank after it.
    fn time_text(self, time: &str) -> String {
        let columns = self.time;
        match columns {
            0 => String::new(),
            _ if columns == Self::TIMES[0] => format!("{time:>columns$} "),
            // Without the microseconds.
            _ => format!("{:>columns$} ", &time[..time.len() - 3]),
        }
    }
}

fn time_heading(mode: TimeMode) -> &'static str {
    match mode {
        TimeMode::Absolute => "Time (UTC)",
        TimeMode::Relative => "Time (s)",
        TimeMode::Delta => "Delta (s)",
    }
}

fn line(
    record: &TraceRecord,
    before: Option<&TraceRecord>,
    columns: Columns,
    app: &App,
    model: &Model,
) -> Line<'static> {
    let theme = app.theme;
    let time = match app.time_mode {
        TimeMode::Absolute => clock(record.time_ns, 6),
        TimeMode::Relative => seconds(record.time_ns.saturating_sub(model.first_ns.unwrap_or(0))),
        TimeMode::Delta => seconds(before.map_or(0, |before| record.moment().since_ns(before.moment()))),
    };
    let start = format!("{}{} ", columns.time_text(&time), record.channel);
    let TraceEvent::Frame { frame, direction, late } = record.event else {
        let text = format!("{start}{}", event_text(&record.event));
        return Line::styled(text, event_style(&record.event, theme));
    };
    let sent = direction == cantap::Direction::Tx;
    let mut text = format!(
        "{start}{} {:>8} {} {} {:<23} ",
        if sent { 'T' } else { 'R' },
        frame.id().to_string(),
        if frame.is_remote() { 'R' } else { 'D' },
        frame.dlc(),
        hex(frame.data()),
    );
    if columns.characters {
        let _ = write!(text, "{:<8} ", printable(frame.data()));
    }
    text.push_str(model.seen.signals.name_of(record).unwrap_or_default());
    if late {
        text.push_str(" (or earlier)");
    }
    match before.map(|before| before.event) {
        Some(TraceEvent::Lost { count, at_least, .. }) => {
            let _ = write!(text, " {} lost before", lost(count, at_least));
            Line::styled(text, theme.loss())
        }
        _ => Line::from(Span::styled(text, if sent { theme.sent() } else { Style::new() })),
    }
}

/// The style of records that are not frames.
fn event_style(event: &TraceEvent, theme: Theme) -> Style {
    match event {
        TraceEvent::Lost { .. } => theme.loss(),
        TraceEvent::State { state: ErrorState::Active, .. } => theme.label(),
        TraceEvent::Lin { frame, .. } if frame.fault.is_none() => Style::new(),
        _ => theme.error(),
    }
}
