//! Opens traces and databases from inside, and selects which of several sources is shown.

use std::path::Path;

use cantap_address::Address;
use cantap_formats::Format;

use super::super::model::Model;
use super::request::Request;
use super::state::App;
use cantap_work::databases::LoadReport;

impl App {
    /// Uses a database from now on, in addition to the others; a trace is opened beside what is running.
    pub(super) fn open_file(&mut self, text: &str, model: &mut Model) -> Result<(), String> {
        let path = Path::new(text);
        if !is_database(path) {
            return self.open_trace(path);
        }
        let mut said = LoadReport::default();
        let mut databases = self.databases.clone();
        databases.add(text, Path::new(""), &mut said);
        if let Some(fault) = said.faults.first() {
            return Err(fault.clone());
        }
        databases.decoder_reporting(&mut said);
        self.databases = databases;
        self.use_databases(model);
        self.message = if said.remarks.is_empty() {
            format!("{text} decodes from now on, and what was seen before")
        } else {
            said.remarks.join("; ")
        };
        Ok(())
    }

    /// Whether a text typed as a device is the name of a trace, existing or not: a slip must not close the device.
    pub(super) fn is_trace(text: &str) -> bool {
        let path = Path::new(text);
        !Address::is_meant_by(path) && (path.is_file() || Format::of_path(path).is_ok())
    }

    pub(super) fn open_trace(&mut self, path: &Path) -> Result<(), String> {
        if !path.is_file() {
            return Err(format!("there is no file {}", path.display()));
        }
        self.request = Some(Request::Open(path.to_owned()));
        Ok(())
    }
}

/// Whether a file is a signal database, judging by its name, which may have a channel before it.
fn is_database(path: &Path) -> bool {
    let suffix = path.extension().and_then(|suffix| suffix.to_str()).unwrap_or_default();
    // A text with commas is a trace here.
    let mut known = cantap_signals::SUFFIXES.iter().filter(|known| **known != "csv");
    known.any(|known| suffix.eq_ignore_ascii_case(known))
}
