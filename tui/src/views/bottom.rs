//! The last line: keys, the latest message, or an input line. Longer text is drawn over the page.

use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Clear, Paragraph};

use super::super::app::{App, Prompt, PromptKind, View};
use super::super::cut::cut_line;
use super::super::model::{Model, SourceState};
use super::super::theme::Theme;

/// Draws it, and any text too long for it over the end of `body`.
pub fn draw(frame: &mut Frame<'_>, body: Rect, bottom: Rect, app: &mut App, model: &Model) {
    app.any_key_continues = false;
    let width = usize::from(bottom.width);
    let line = if let Some(prompt) = &app.prompt {
        let hint = if app.message.is_empty() { question(prompt.kind) } else { app.message.as_str() };
        over(frame, body, hint);
        input(prompt, width)
    } else {
        match message(app, model) {
            Some(Message { text, passes }) if text.chars().count() + 1 > width => {
                over(frame, body, &text);
                app.any_key_continues = passes;
                Line::from(if passes { " any key continues, h helps" } else { " h help  q quit" })
            }
            Some(Message { text, .. }) => Line::from(format!(" {text}")),
            None => Line::from(format!(" {}", keys(app, model, width.saturating_sub(1)))),
        }
    };
    frame.render_widget(Paragraph::new(cut_line(line, width)).style(Theme::bar()), bottom);
}

/// Draws a text over the page's last lines, using as many as it needs.
fn over(frame: &mut Frame<'_>, body: Rect, text: &str) {
    let lines = wrapped(text, usize::from(body.width).saturating_sub(1));
    let height = body.height.min(u16::try_from(lines.len()).unwrap_or(u16::MAX));
    let place = Rect { y: body.y + body.height - height, height, ..body };
    frame.render_widget(Clear, place);
    let lines: Vec<_> = lines.into_iter().map(|line| Line::from(format!(" {line}"))).collect();
    frame.render_widget(Paragraph::new(lines).style(Theme::bar()), place);
}

/// Lines no longer than the width in characters; only longer words are split.
pub fn wrapped(text: &str, width: usize) -> Vec<String> {
    let width = width.max(1);
    let mut lines = vec![String::new()];
    let mut room = width;
    for word in text.split_whitespace() {
        let mut word: Vec<char> = word.chars().collect();
        if room < width && word.len() + 1 > room {
            lines.push(String::new());
            room = width;
        }
        while word.len() > width {
            let rest = word.split_off(width);
            lines.push(word.into_iter().collect());
            word = rest;
            room = 0;
        }
        if room == 0 {
            lines.push(String::new());
            room = width;
        }
        if let Some(line) = lines.last_mut() {
            if room < width {
                line.push(' ');
                room -= 1;
            }
            line.extend(&word);
            room -= word.len();
        }
    }
    lines.retain(|line| !line.is_empty());
    lines
}

/// The input line, scrolled so that its cursor is visible.
fn input(prompt: &Prompt, width: usize) -> Line<'static> {
    let (before, behind) = prompt.line.halves();
    // As selected text looks elsewhere.
    let before_style = if prompt.line.is_suggested() {
        Style::new().remove_modifier(Modifier::REVERSED)
    } else {
        Style::new()
    };
    let hidden = (before.chars().count() + 4).saturating_sub(width);
    let before: String = before.chars().skip(hidden).collect();
    let mut behind = behind.chars();
    // The cursor is a block, or an underscore at the end.
    let cursor = behind.next().map_or("_".to_owned(), String::from);
    Line::from(vec![
        Span::raw(" > "),
        Span::styled(before, before_style),
        Span::styled(cursor, Style::new().add_modifier(Modifier::UNDERLINED | Modifier::BOLD)),
        Span::raw(behind.collect::<String>()),
    ])
}

fn question(kind: PromptKind) -> &'static str {
    match kind {
        PromptKind::Search => "search this page: bytes, identifiers, names, words of errors and losses",
        PromptKind::Filter => {
            "show only, in candump's syntax, such as 123:7FF; 123:7FF if Speed > 80; if Speed > 80 (empty: all)"
        }
        PromptKind::Signals => {
            "show only signals with this in their name (* is anything), as Wheel*Speed > 80, or alarm (empty: all)"
        }
        PromptKind::Time => {
            "go to: a time since the beginning, such as 90s, 1:30 or 1:02:03, or a share, such as 50%"
        }
        PromptKind::Open => {
            "open: a trace, beside what runs, or a database (.dbc .toml .arxml .kcd .sym .dbf .xlsx)"
        }
        PromptKind::Record => {
            "record to FILE, or FILE if CONDITION (.log .asc .blf .csv .trc .pcapng, each also .gz .zst)"
        }
        PromptKind::Send => {
            "[CHANNEL:]FRAME or Message:Signal=value,… (Tab completes) [PERIOD] [counter= checksum= random= group=]"
        }
        PromptKind::Export => "write the list to a new file, a line for each entry",
        PromptKind::Import => "add the entries of a file: a line for each, as typed here; # begins a comment",
        PromptKind::BitRate => "bit rates: 500k, one for each channel: 1:500k 2:250k, or auto",
        PromptKind::Device => {
            "device: a serial port, virtual, or emu:FIRMWARE.elf; several with \" + \" between them; a trace opens beside"
        }
        PromptKind::Script => {
            "add a script: its file, or a ready node such as node:obd?speed=60 (cantap run --nodes lists them)"
        }
        PromptKind::ScriptKey => "the next key goes to the scripts; Esc does not",
        PromptKind::Normal => "acknowledge other nodes' frames, and send on request, on this bus? y or n",
    }
}

/// A message.
struct Message {
    text: String,
    /// Whether the next key removes it; otherwise it stays as long as it is true.
    passes: bool,
}

/// The message to show, if any.
fn message(app: &App, model: &Model) -> Option<Message> {
    let (text, passes) = match (&model.source, &model.unread) {
        _ if !app.message.is_empty() => (app.message.clone(), true),
        (SourceState::Gone(reason), _) if model.notice.is_empty() => (reason.clone(), false),
        (SourceState::Gone(reason), _) => (format!("{}; {reason}", model.notice), false),
        _ if !model.notice.is_empty() => (model.notice.clone(), true),
        _ if let Some(text) = changes(app, model) => (text, false),
        (_, Some((count, first))) if app.view == View::Statistics => {
            let places = if *count == 1 { "place" } else { "places" };
            (format!("{count} {places} could not be read and are left out, the first: {first}"), false)
        }
        _ => return None,
    };
    Some(Message { text, passes })
}

/// While only what has changed is shown: that it is so, since when, and how much that is.
fn changes(app: &App, model: &Model) -> Option<String> {
    let seen = app.frozen.as_deref().unwrap_or(&model.seen);
    let since_ns = seen.table.compared_since_ns.filter(|_| app.view == View::Fixed)?;
    let rows = seen.table.rows();
    let changed = rows.iter().filter(|row| row.has_changed()).count();
    let seconds = seen.now_ns.saturating_sub(since_ns).max(0) / 1_000_000_000;
    Some(format!("changed in {seconds} s: {changed} of {}, z: all", rows.len()))
}

/// As many of the page's keys, which are two blanks apart, as fit.
fn keys(app: &App, model: &Model, width: usize) -> String {
    let keys = match app.view {
        View::Trace => "t time  / search  n N next  Enter signals  y copy  ↑↓ scroll  End newest  f filter",
        View::Fixed => {
            "Enter signals  s S sort  / search  g group  # * mute  z changes  H heat  x u hide  o colour  f filter"
        }
        View::Signals => "Enter into the graph  / search  s S sort  g group  F condition",
        View::Graph => "+ - zoom  ← → pan  x cursors  a all  s steps or lines  End follow",
        View::Statistics => "b bit rate  A find it  D device  m mode  R recover",
        View::Send => "a add  e edit  d delete  Enter once  Space on/off  m mode",
        View::Record => "r start or stop",
        View::Nodes => "↑↓ scroll",
        View::Obd => "Space ask or not  ↑↓ scroll  m mode",
        View::Scripts => "a add  e edit  d remove  Space start/stop  PgUp PgDn output  K key  m mode",
    };
    let playback = match model.source {
        SourceState::Playing(_) => {
            "Space stop  [ ] seek  , . speed  T go to  B { } bookmarks  > step  l loop  "
        }
        _ => "",
    };
    let is_file = !playback.is_empty();
    let pause = if matches!(app.view, View::Send | View::Scripts | View::Obd) || is_file {
        ""
    } else {
        "  Space pause"
    };
    let mut all = format!("h help  q quit  {playback}{keys}{pause}  c clear");
    if all.chars().count() > width {
        let ends = all.match_indices("  ").map(|(at, _)| at);
        let end = ends.filter(|end| all[..*end].chars().count() <= width).last().unwrap_or(0);
        all.truncate(end);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_texts_are_wrapped_between_words_and_long_words_are_cut() {
        assert_eq!(wrapped("one two three", 7), ["one two", "three"]);
        assert_eq!(wrapped("a /long/path/name is", 6), ["a", "/long/", "path/n", "ame is"]);
        assert_eq!(wrapped("", 5), [""; 0]);
        assert_eq!(wrapped("abc", 0), ["a", "b", "c"]);
        assert_eq!(wrapped("abcdef gh", 3), ["abc", "def", "gh"]);
    }
}
