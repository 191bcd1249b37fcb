//! The signal databases with which frames are decoded.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::bail;
use cantap_address::Address;
use cantap_signals::{Database, DatabaseError, Decoder, Override, Source};
use cantap_trace::counted;

use crate::report::Reporter;

/// Reported when the vehicle's own database is used.
pub const CAR: &str = "signals are shown by the vehicle's own database; `cantap virtual car --dbc` prints it";

/// A database file and its channel, as `car.dbc` or `2:car.dbc`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DatabasePath {
    /// From 1; `None` for all that have none of their own.
    pub channel: Option<u8>,
    /// The file; `FILE#BUS` selects one bus of it.
    pub path: PathBuf,
}

impl FromStr for DatabasePath {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        // A drive letter is not a number, so Windows paths are accepted.
        let numbered = text
            .split_once(':')
            .filter(|(number, _)| !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit()));
        let Some((number, path)) = numbered else {
            return Ok(Self { channel: None, path: text.into() });
        };
        match number.parse() {
            Ok(channel @ 1..) if !path.is_empty() => Ok(Self { channel: Some(channel), path: path.into() }),
            _ => Err("write it as FILE or CHANNEL:FILE, with channels from 1".to_owned()),
        }
    }
}

/// Which databases, and how to use them.
#[derive(Clone, Debug, Default)]
pub struct DatabaseOptions {
    /// Their files.
    pub paths: Vec<DatabasePath>,
    /// Treat all 29-bit messages as J1939 parameter groups, even if the database does not say so.
    pub j1939: bool,
    /// Use the virtual vehicle's own database, too.
    pub car: bool,
}

impl DatabaseOptions {
    /// These, or, if there are none and it listens to a virtual vehicle, the vehicle's own, for all channels.
    #[must_use]
    pub fn or_of<'a>(mut self, devices: impl IntoIterator<Item = &'a Address>) -> Self {
        self.car = self.paths.is_empty() && devices.into_iter().any(Address::is_car);
        self
    }

    /// Whether there are none.
    pub const fn is_empty(&self) -> bool {
        self.paths.is_empty() && !self.car
    }

    /// The virtual vehicle's own, if it should be used.
    fn own(&self) -> Result<Option<Source>, DatabaseError> {
        let database = self.car.then(cantap_virtual::car::database).transpose()?;
        Ok(database.map(|database| Source { channel: None, database }))
    }

    /// Loads the databases. Warnings are reported, unless `quiet`; with `strict` they are errors.
    pub fn load(&self, strict: bool, quiet: bool, reporter: &Reporter) -> anyhow::Result<Decoder> {
        let mut sources: Vec<_> = self.own()?.into_iter().collect();
        if self.car && !quiet {
            reporter.note(CAR);
        }
        for DatabasePath { channel, path } in &self.paths {
            let database = cantap_signals::load(path)?;
            if !quiet || strict {
                warn(&database, reporter);
            }
            // In which encoding a file is read is no fault of it.
            let is_fault = |warning: &cantap_signals::Fault| {
                !matches!(warning.kind, cantap_signals::FaultKind::Encoding(_))
            };
            if strict && database.warnings.iter().any(is_fault) {
                bail!("{} has faults; see above", database.file);
            }
            sources.push(Source { channel: *channel, database });
        }
        let decoder = Databases { sources, j1939: self.j1939 }.decoder();
        if !quiet {
            overrides(&decoder).for_each(|text| reporter.note(text));
        }
        Ok(decoder)
    }

    /// The initial databases, for programs that also run without any and can load more.
    pub fn load_available(&self, report: &mut LoadReport) -> Databases {
        let sources = self.own().ok().flatten().into_iter().collect();
        let mut databases = Databases { sources, j1939: self.j1939 };
        if self.car {
            report.remarks.push(CAR.to_owned());
        }
        for path in &self.paths {
            databases.add_path(path, report);
        }
        databases
    }
}

/// What to tell the user about databases and settings that were loaded.
#[derive(Clone, Debug, Default)]
pub struct LoadReport {
    /// What was requested but could not be loaded.
    pub faults: Vec<String>,
    /// What else is worth knowing.
    pub remarks: Vec<String>,
}

/// Databases to which more can be added.
#[derive(Clone, Debug, Default)]
pub struct Databases {
    sources: Vec<Source>,
    j1939: bool,
}

impl Databases {
    /// Adds one, as typed after `--db`; a relative path is relative to `folder`.
    pub fn add(&mut self, text: &str, folder: &Path, report: &mut LoadReport) {
        match text.parse::<DatabasePath>() {
            Ok(DatabasePath { channel, path }) => {
                self.add_path(&DatabasePath { channel, path: folder.join(path) }, report);
            }
            Err(reason) => report.faults.push(format!("database {text}: {reason}")),
        }
    }

    fn add_path(&mut self, DatabasePath { channel, path }: &DatabasePath, report: &mut LoadReport) {
        match cantap_signals::load(path) {
            Ok(database) => {
                let faults = database.warnings.iter();
                report.remarks.extend(faults.map(|fault| format!("{}: {fault}", database.file)));
                self.sources.push(Source { channel: *channel, database });
            }
            Err(error) => report.faults.push(error.to_string()),
        }
    }

    /// Adds the virtual vehicle's own, for all channels.
    pub fn add_car(&mut self, report: &mut LoadReport) {
        if let Ok(database) = cantap_virtual::car::database() {
            self.sources.push(Source { channel: None, database });
            report.remarks.push(CAR.to_owned());
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.sources.is_empty()
    }

    /// The decoder for them.
    pub fn decoder(&self) -> Decoder {
        let mut decoder = Decoder::new(self.sources.clone());
        if self.j1939 {
            decoder.assume_j1939();
        }
        decoder
    }

    /// Like [`Self::decoder`], also reporting which messages replace others.
    pub fn decoder_reporting(&self, report: &mut LoadReport) -> Decoder {
        let decoder = self.decoder();
        report.remarks.extend(overrides(&decoder));
        decoder
    }
}

/// Reports what is wrong with a usable database.
fn warn(database: &Database, reporter: &Reporter) {
    /// More would scroll the command's results off the screen.
    const SHOWN: usize = 10;
    for warning in database.warnings.iter().take(SHOWN) {
        reporter.note(format!("{}: {warning}", database.file));
    }
    let more = database.warnings.len().saturating_sub(SHOWN);
    if more > 0 {
        let file = &database.file;
        reporter.note(format!(
            "{file}: and {more}; `cantap db {file} --warnings` lists all, --quiet hides them",
            more = counted(more, "more warning")
        ));
    }
}

/// Which databases replace messages of others, one sentence each.
fn overrides(decoder: &Decoder) -> impl Iterator<Item = String> {
    decoder.overrides().iter().map(|Override { file, by, messages }| {
        let count = messages.len();
        let identifiers = if count == 1 { "identifier" } else { "identifiers" };
        let first = messages.first().map_or("", String::as_str);
        let such_as = if count == 1 { "" } else { "such as " };
        let messages = counted(count, "message");
        format!("{by} replaces {messages} of {file} with the same {identifiers}, {such_as}{first}")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_before_a_colon_is_a_channel() {
        let parse = |text: &str| text.parse::<DatabasePath>().map(|path| (path.channel, path.path));
        assert_eq!(parse("2:car.dbc"), Ok((Some(2), "car.dbc".into())));
        assert_eq!(parse("car.dbc"), Ok((None, "car.dbc".into())));
        assert_eq!(parse(r"C:\car.dbc"), Ok((None, r"C:\car.dbc".into())));
        for wrong in ["0:car.dbc", "256:car.dbc", "1:"] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }
}
