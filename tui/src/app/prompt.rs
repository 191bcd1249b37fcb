//! Handles what was typed into an input line.

use std::path::Path;

use cantap_signals::named::{NameError, NamedFilter};
use cantap_work::recording::Recording;
use ratatui::crossterm::event::KeyCode;

use super::super::model::{Model, While};
use super::super::order::Order;
use super::completion::{Completed, complete};
use super::entry::parse_entry;
use super::line::{Prompt, PromptKind};
use super::signals::SignalFilter;
use super::state::{App, Direction, View};

impl App {
    pub(super) fn prompt_key(&mut self, code: KeyCode, model: &mut Model) {
        match (code, &mut self.prompt) {
            (code, Some(Prompt { kind: PromptKind::Normal, .. })) => self.answer_normal(code),
            (code, Some(Prompt { kind: PromptKind::ScriptKey, .. })) => self.answer_script_key(code),
            (KeyCode::Esc, _) => self.prompt = None,
            (KeyCode::Tab, Some(Prompt { kind: PromptKind::Send, line, .. })) => {
                let (before, _) = line.halves();
                let Completed { text, choices } = complete(&before, model.seen.signals.decoder());
                line.replace_before(&text);
                self.message = choices.join("  ");
            }
            (KeyCode::Enter, prompt) => {
                if let Some(prompt) = prompt.take() {
                    self.answer(prompt, model);
                }
            }
            (code, Some(prompt)) => prompt.line.key(code),
            (_, None) => {}
        }
    }

    /// Handles a completed line. Errors are shown, and the line stays open.
    fn answer(&mut self, prompt: Prompt, model: &mut Model) {
        let line = prompt.line.text();
        let text = line.trim();
        let result = match prompt.kind {
            PromptKind::Search => {
                self.wanted = text.to_ascii_uppercase();
                if !text.is_empty() {
                    self.find(model, Direction::Back);
                }
                Ok(())
            }
            PromptKind::Record
            | PromptKind::Send
            | PromptKind::Time
            | PromptKind::Open
            | PromptKind::Export
            | PromptKind::Import
            | PromptKind::Script
                if text.is_empty() =>
            {
                Ok(())
            }
            PromptKind::Signals => SignalFilter::new(text).map(|filter| *self.signal_filter() = filter),
            PromptKind::Time => self.seek_to(text, model),
            PromptKind::Open => self.open_file(text, model),
            PromptKind::Device if Self::is_trace(text) => self.open_trace(Path::new(text)),
            PromptKind::Filter => self.set_filters(text, model),
            PromptKind::Record => self.record(Path::new(text), model),
            PromptKind::Send => parse_entry(text, model).map(|entry| self.put_entry(prompt.entry, entry)),
            PromptKind::Export => {
                self.export_list(Path::new(text));
                Ok(())
            }
            PromptKind::Import => self.import_list(Path::new(text), model),
            PromptKind::BitRate => self.set_bit_rates(text, model),
            PromptKind::Device => self.set_device(text, model),
            PromptKind::Script => self.add_script(text, model),
            // They are answered by one key.
            PromptKind::Normal | PromptKind::ScriptKey => Ok(()),
        };
        if let Err(reason) = result {
            self.message = reason;
            self.prompt = Some(prompt);
        }
    }

    fn record(&mut self, text: &Path, model: &Model) -> Result<(), String> {
        // While the line is open: what is refused later is no longer there to be mended.
        Recording::check_text(text, model.seen.signals.decoder()).map_err(|error| format!("{error:#}"))?;
        self.order(Order::Record(text.to_owned()));
        Ok(())
    }

    /// The filter for the signals that this page shows, or for its rows.
    pub(super) fn signal_filter(&mut self) -> &mut SignalFilter {
        if self.view == View::Fixed { &mut self.row_filter } else { &mut self.signals.filter }
    }

    fn set_filters(&mut self, text: &str, model: &mut Model) -> Result<(), String> {
        let decoder = model.seen.signals.decoder();
        let (text, condition) = match text.strip_prefix("if ") {
            Some(condition) => ("", Some(condition)),
            None => text.split_once(" if ").map_or((text, None), |(text, condition)| (text, Some(condition))),
        };
        let only_while = condition.map(|text| {
            let parsed = cantap_protocols::condition(text, decoder, model.conversations());
            parsed.map(|condition| While::new(text.trim().to_owned(), condition))
        });
        let only_while = only_while.transpose().map_err(|error| error.to_string())?;
        let resolve = |part: &str| {
            let filter = part.parse::<NamedFilter>().map_err(|error| error.to_string())?;
            filter.resolve(decoder).map_err(|error| match error {
                NameError::NoDatabase(_) => format!("{error}; O opens one"),
                error => error.to_string(),
            })
        };
        let filters = text.split_whitespace().map(resolve).collect::<Result<Vec<_>, _>>()?;
        self.cursor = model.history.narrow(filters, only_while, self.cursor);
        Ok(())
    }
}
