//! Searches the trace: a piece at a time, so that millions of records delay neither the source nor the display.

use std::fmt::{Display, Write};

use cantap::Id;

use super::super::event_text::{event_text, hex};
use super::super::model::Model;
use super::line::PromptKind;
use super::state::{App, Direction, Search, View};

/// How many records are searched between two drawings, which takes some twenty milliseconds.
const AT_ONCE: u64 = 100_000;

impl App {
    /// Whether this page can be searched; shows a message if not.
    pub(super) fn can_search(&mut self) -> bool {
        let can = matches!(self.view, View::Trace | View::Fixed | View::Signals | View::Send);
        if !can {
            "this page has nothing to search; Trace, Fixed, Signals and Send have"
                .clone_into(&mut self.message);
        }
        can
    }

    /// Finds the next record or row with the last search text. In the trace that is back in time, in a list downwards.
    pub(super) fn find(&mut self, model: &Model, direction: Direction) {
        if self.wanted.is_empty() {
            return self.ask(PromptKind::Search, "");
        }
        if self.view != View::Trace {
            return self.find_row(model, direction);
        }
        let from = self.cursor.unwrap_or(model.history.end());
        let at = match direction {
            Direction::Back => from,
            Direction::Forward => from.saturating_add(1),
        };
        self.search = Some(Search { direction, at });
        self.search_on(model);
    }

    /// In a list: from the row after the selected one, wrapping at the end.
    fn find_row(&mut self, model: &Model, direction: Direction) {
        let seen = self.frozen.as_deref().unwrap_or(&model.seen);
        let signals = &seen.signals;
        let rows: Vec<String> = match self.view {
            View::Fixed => {
                let text = |(channel, id): &(u8, Id)| {
                    let message = signals.decoder().find(*channel, *id);
                    let name = message.map_or("", |message| &signals.decoder().message(message).name);
                    let row = seen.table.row(*channel, *id);
                    let data = row.map_or(String::new(), |row| hex(row.frame.data()));
                    format!("{id} {name} {data} {}", compact(&data))
                };
                self.fixed_order.iter().map(text).collect()
            }
            View::Signals => {
                let text = |place: &Option<usize>| {
                    let row = place.and_then(|place| signals.rows().get(place));
                    row.map_or(String::new(), |row| {
                        format!("{} {}", signals.full_name(row), signals.text(row))
                    })
                };
                self.signal_order.iter().map(text).collect()
            }
            _ => self.send.iter().map(|entry| format!("{} {}", entry.text, entry.frame)).collect(),
        };
        let count = rows.len();
        let steps = (1..=count).map(|step| match direction {
            Direction::Back => (self.selected + step) % count,
            Direction::Forward => (self.selected + count - step % count) % count,
        });
        match steps.into_iter().find(|place| rows[*place].to_uppercase().contains(&self.wanted)) {
            Some(place) => self.selected = place,
            None => self.message = format!("'{}' was not found", self.wanted),
        }
    }

    /// Continues a search for a while.
    pub(super) fn search_on(&mut self, model: &Model) {
        let Some(search) = self.search.take() else {
            return;
        };
        let (first, end) = (model.history.first(), model.history.end());
        let (range, rest) = match search.direction {
            Direction::Back => {
                let until = search.at.min(end);
                let from = until.saturating_sub(AT_ONCE).max(first);
                (from..until, Some(from).filter(|from| *from > first))
            }
            Direction::Forward => {
                let from = search.at.max(first);
                let until = from.saturating_add(AT_ONCE).min(end);
                (from..until, Some(until).filter(|until| *until < end))
            }
        };
        let mut matcher = Matcher { text: &self.wanted, compact: compact(&self.wanted), line: String::new() };
        let found = match search.direction {
            Direction::Back => range.rev().find(|place| matcher.matches(model, *place)),
            Direction::Forward => range.into_iter().find(|place| matcher.matches(model, *place)),
        };
        match (found, rest) {
            (Some(place), _) => {
                self.cursor = Some(place);
                self.message.clear();
            }
            (None, Some(at)) => {
                self.search = Some(Search { at, ..search });
                self.message = format!("looking for '{}'; any key stops", self.wanted);
            }
            (None, None) => self.message = format!("'{}' was not found", self.wanted),
        }
    }
}

fn compact(text: &str) -> String {
    text.chars().filter(|character| !character.is_whitespace()).collect()
}

struct Matcher<'a> {
    /// In upper case.
    text: &'a str,
    /// The same without blanks, for bytes.
    compact: String,
    /// One buffer for all records.
    line: String,
}

impl Matcher<'_> {
    fn matches(&mut self, model: &Model, place: u64) -> bool {
        let Some(record) = model.history.get(place) else {
            return false;
        };
        let Some(frame) = record.frame() else {
            return self.is_in(&event_text(&record.event), false);
        };
        self.is_in(frame, true)
            || model.seen.signals.name_of(&record).is_some_and(|name| self.is_in(&name, false))
    }

    fn is_in(&mut self, what: &dyn Display, compact: bool) -> bool {
        self.line.clear();
        // Writing to a String cannot fail.
        let _ = write!(self.line, "{what}");
        self.line.make_ascii_uppercase();
        self.line.contains(if compact { &self.compact } else { self.text })
    }
}
