//! The signal databases of a command.

use anyhow::Context;
use cantap_address::Address;
use cantap_signals::{Decoder, Selection};
use cantap_work::databases::{DatabaseOptions, DatabasePath};

use crate::{completion, stderr};

/// Which databases; commands flatten this into their arguments.
#[derive(Clone, clap::Args)]
pub struct DatabaseArgs {
    /// A database: DBC, KCD, SYM, ARXML or a .toml signal file; with a channel before it (2:FILE), it is used only
    /// for that channel, otherwise for all others. FILE#BUS selects one bus of a KCD or ARXML file. Can be repeated.
    #[arg(long = "db", value_name = "[CHANNEL:]FILE", add = completion::databases())]
    databases: Vec<DatabasePath>,
    /// Treat all 29-bit messages as J1939 parameter groups, even if the database does not say so.
    #[arg(long)]
    j1939: bool,
}

impl DatabaseArgs {
    /// The same without clap.
    pub fn options(&self) -> DatabaseOptions {
        DatabaseOptions { paths: self.databases.clone(), j1939: self.j1939, car: false }
    }

    /// See [`DatabaseOptions::or_of`].
    pub fn or_of<'a>(&self, devices: impl IntoIterator<Item = &'a Address>) -> DatabaseOptions {
        self.options().or_of(devices)
    }

    /// The first of the options that was given.
    pub fn given(&self) -> Option<&'static str> {
        if self.databases.is_empty() { self.j1939.then_some("--j1939") } else { Some("--db") }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.databases.is_empty()
    }

    /// See [`load`].
    pub fn load(&self, strict: bool, quiet: bool) -> anyhow::Result<Decoder> {
        load(&self.options(), strict, quiet)
    }
}

/// Loads databases. Warnings go to standard error, unless `quiet`; with `strict` they are errors.
pub fn load(options: &DatabaseOptions, strict: bool, quiet: bool) -> anyhow::Result<Decoder> {
    options.load(strict, quiet, &stderr::reporter())
}

/// Like [`load`], for commands that are useless without a database.
pub fn load_selected(
    options: &DatabaseOptions,
    strict: bool,
    quiet: bool,
    patterns: &[String],
) -> anyhow::Result<Decoder> {
    let mut decoder = load(options, strict, quiet)?;
    decoder.select(&Selection::new(patterns)?).context("--signal")?;
    Ok(decoder)
}
