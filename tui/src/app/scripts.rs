//! The list of scripts: started, stopped and edited.

use std::path::{Path, PathBuf};

use cantap_scripts::library;
use ratatui::crossterm::event::KeyCode;

use super::super::model::Model;
use super::super::order::Order;
use super::line::PromptKind;
use super::request::Request;
use super::state::App;

impl App {
    /// Whether scripts can run; shows a message if not.
    fn can_run(&mut self) -> bool {
        let reason = match &self.plan {
            None => "a file runs no scripts; open a device with D",
            Some(plan) if !plan.mode().transmits() => {
                "listen-only: scripts send and answer, so none is started; press m to take part in the bus"
            }
            Some(_) => return true,
        };
        reason.clone_into(&mut self.message);
        false
    }

    /// Adds a script to the list, if it can be read and is in the language.
    pub fn add_script(&mut self, text: &str, model: &mut Model) -> Result<(), String> {
        if model.scripts.row(text).is_some() {
            return Err(format!("{text} is in the list already"));
        }
        let script = library::read(Path::new(text)).map_err(|error| error.to_string())?;
        script.tests().map_err(|error| error.to_string())?;
        model.scripts.add(text);
        self.selected = model.scripts.rows.len() - 1;
        Ok(())
    }

    /// Starts the selected script, or stops it.
    pub(super) fn toggle_script(&mut self, model: &mut Model) {
        let Some(name) = self.selected_script(model) else { return };
        if model.scripts.is_running(&name) {
            self.order(Order::StopScript(name));
        } else if self.can_run() {
            self.start_script(&name, model);
        }
    }

    /// Starts a script as it is now.
    fn start_script(&mut self, name: &str, model: &mut Model) {
        let script = library::read(Path::new(name)).map_err(|error| error.to_string());
        let script = script.and_then(|script| match script.tests() {
            Ok(_) => Ok(cantap_scripts::Script { name: name.to_owned(), ..script }),
            Err(error) => Err(error.to_string()),
        });
        match script {
            Ok(script) => self.order(Order::StartScript(script)),
            Err(reason) => model.scripts.fail(name, &reason),
        }
    }

    /// Has the selected script edited.
    pub(super) fn edit_script(&mut self, model: &Model) {
        let Some(name) = self.selected_script(model) else { return };
        if name.starts_with(library::PREFIX) {
            let node = name.split('?').next().unwrap_or_default();
            self.message = format!(
                "{node} comes with the program; `cantap run --print {node} > mine.rhai` writes a copy"
            );
        } else {
            self.request = Some(Request::Edit(PathBuf::from(name)));
        }
    }

    /// A script was edited: if it runs, it begins anew.
    pub fn reload_script(&mut self, path: &Path, model: &mut Model) {
        let Some(name) = path.to_str().map(str::to_owned) else { return };
        if model.scripts.is_running(&name) {
            self.order(Order::StopScript(name.clone()));
            self.start_script(&name, model);
            return;
        }
        let script = library::read(path).map_err(|error| error.to_string());
        if let Err(reason) = script.and_then(|script| script.tests().map_err(|error| error.to_string())) {
            model.scripts.fail(&name, &reason);
        } else {
            self.message = format!("{name} is read again when it is started");
        }
    }

    /// Stops the selected script and takes it from the list.
    pub(super) fn remove_script(&mut self, model: &mut Model) {
        let Some(name) = self.selected_script(model) else { return };
        if model.scripts.is_running(&name) {
            self.order(Order::StopScript(name));
        }
        model.scripts.rows.remove(self.selected);
    }

    /// Asks for a key for the scripts.
    pub(super) fn ask_script_key(&mut self, model: &Model) {
        if model.scripts.rows.iter().any(|row| model.scripts.is_running(&row.name)) {
            self.ask(PromptKind::ScriptKey, "");
        } else {
            "no script runs that could take a key".clone_into(&mut self.message);
        }
    }

    /// The key for the scripts.
    pub(super) fn answer_script_key(&mut self, code: KeyCode) {
        self.prompt = None;
        if let KeyCode::Char(key) = code {
            self.order(Order::ScriptKey(key));
        }
    }

    fn selected_script(&self, model: &Model) -> Option<String> {
        model.scripts.rows.get(self.selected).map(|row| row.name.clone())
    }

    /// Moves through the list, or with the larger steps through the output.
    pub(super) fn scroll_scripts(&mut self, code: KeyCode) {
        let page = self.output_rows.max(1);
        match code {
            KeyCode::PageUp => self.output_above += page,
            KeyCode::PageDown => self.output_above = self.output_above.saturating_sub(page),
            KeyCode::End => self.output_above = 0,
            KeyCode::Home => self.output_above = usize::MAX / 2,
            code => self.scroll(code),
        }
    }
}
