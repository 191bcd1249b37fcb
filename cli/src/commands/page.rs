//! `cantap page`: the page without a trace, for traces that are dropped onto it and for a board on the browser's own serial port.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use cantap_work::atomic_file;

use crate::page;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                cantap page\n  \
                cantap page -o /srv/www/cantap.html\n\n\
                One file, which opens by a double click or from any site, and loads nothing. Traces and databases are dropped onto it. In a \
                browser with Web Serial (Chrome, Edge, Opera), it opens a board that is plugged in, to listen: nothing needs to be installed.")]
pub struct Args {
    /// The page to write.
    #[arg(short, long, value_name = "FILE", default_value = "cantap.html")]
    output: PathBuf,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let page = page::find()?;
    let output = &args.output;
    if output.is_file() && !std::fs::read_to_string(output).is_ok_and(|text| text.contains(page::MARK)) {
        bail!(
            "{} is there already, and is no page without a trace; give another name with -o",
            output.display()
        );
    }
    atomic_file::write(output, page.as_bytes())
        .with_context(|| format!("cannot write {}", output.display()))?;
    eprintln!("cantap: {}: {:.1} MB; open it in a browser", output.display(), page.len() as f64 / 1e6);
    Ok(ExitCode::SUCCESS)
}
