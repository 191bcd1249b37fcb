//! Traces and databases opened from inside, and which of several sources is looked at.

use std::path::Path;

use cantap_address::Address;
use cantap_formats::Format;

use super::super::model::Model;
use super::state::App;
use super::wish::Wish;
use crate::databases::Said;

impl App {
    /// A database is used from now on, besides the others; a trace is opened beside what runs.
    pub(super) fn open_file(&mut self, text: &str, model: &mut Model) -> Result<(), String> {
        let path = Path::new(text);
        if !is_database(path) {
            return self.open_beside(path);
        }
        let mut said = Said::default();
        let mut databases = self.databases.clone();
        databases.add(text, Path::new(""), &mut said);
        if let Some(fault) = said.faults.first() {
            return Err(fault.clone());
        }
        databases.decoder_saying(&mut said);
        self.databases = databases;
        self.use_databases(model);
        self.message = if said.remarks.is_empty() {
            format!("{text} decodes from now on, and what was seen before")
        } else {
            said.remarks.join("; ")
        };
        Ok(())
    }

    /// A trace's name where a device's could stand, though no such file may be there: a slip must not close the device.
    pub(super) fn is_trace(text: &str) -> bool {
        let path = Path::new(text);
        !Address::is_meant_by(path) && (path.is_file() || Format::of_path(path).is_ok())
    }

    pub(super) fn open_beside(&mut self, path: &Path) -> Result<(), String> {
        if !path.is_file() {
            return Err(format!("there is no file {}", path.display()));
        }
        self.wish = Some(Wish::Beside(path.to_owned()));
        Ok(())
    }
}

/// Whether a file is a signal database, by its name, which may have a channel before it.
fn is_database(path: &Path) -> bool {
    let suffix = path.extension().and_then(|suffix| suffix.to_str()).unwrap_or_default();
    ["dbc", "toml", "arxml", "kcd", "sym"].iter().any(|known| suffix.eq_ignore_ascii_case(known))
}
