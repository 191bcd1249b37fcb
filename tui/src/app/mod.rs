//! The user's choices: page, position, sorting, input lines. The files beside this one handle keys.

mod column;
mod completion;
mod device;
mod entry;
mod graph;
mod keys;
mod line;
mod open;
mod player;
mod prompt;
mod request;
mod scripts;
mod scroll;
mod search;
mod sending;
mod signals;
mod state;
mod vehicle;

use std::sync::Arc;

use super::model::Model;
use cantap_work::channels::place_of;
use cantap_work::databases::LoadReport;

pub use column::Column;
pub use entry::{SendEntry, parse_entry};
pub use graph::Drawn;
pub use line::{Prompt, PromptKind};
pub use request::Request;
pub use scroll::first_row;
pub use signals::SignalColumn;
pub use state::{App, Flow, TimeMode, View};

impl App {
    /// Decodes with the current databases; a frozen display is updated too.
    pub(super) fn use_databases(&mut self, model: &mut Model) {
        model.set_decoder(Arc::new(self.databases.decoder()));
        self.frozen = None;
    }

    /// Takes over what the source has found out, and continues a search. Call it before each drawing.
    pub fn catch_up(&mut self, model: &mut Model) {
        self.search_on(model);
        if let Some(plan) = model.found.take() {
            self.plan = Some(plan);
        }
        if self.sessions != model.sessions {
            let known = std::mem::replace(&mut self.sessions, model.sessions.clone());
            let is_new = |board: usize| known.get(board) != model.sessions.get(board);
            // A device forgets periodic frames when its session ends.
            let entries = self.send.iter_mut().filter(|entry| is_new(place_of(entry.channel).0));
            let were_on = entries.filter_map(|entry| entry.slot.take()).count();
            if were_on > 0 {
                let said = std::mem::take(&mut model.notice);
                let before = if said.is_empty() { "a new session" } else { &said };
                model.notice = format!("{before}; nothing is sent periodically any more");
            }
        }
        if std::mem::take(&mut model.met_car) && self.databases.is_empty() {
            let mut said = LoadReport::default();
            self.databases.add_car(&mut said);
            self.use_databases(model);
            model.notice = said.remarks.join("; ");
        }
        for (channel, slot) in model.refused.drain(..) {
            for entry in &mut self.send {
                entry.slot = entry.slot.filter(|own| (entry.channel, *own) != (channel, slot));
            }
        }
    }
}
