//! How messages look on standard error. Everything that is printed there goes through this file, which lets no text from outside reach the
//! terminal as it is.

use std::io::{IsTerminal, Write};

use cantap_trace::clean;
use cantap_work::report::{Reporter, Severity};

/// Whether it supports colours, and its reader wants them (<https://no-color.org>).
pub fn is_coloured() -> bool {
    std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

/// Prints what must not be overlooked: in red, if there are colours.
pub fn warn(text: &str) {
    let text = clean::lines(text);
    if is_coloured() {
        write(&format!("\x1b[1;31mcantap: {text}\x1b[0m\n"));
    } else {
        write(&format!("cantap: {text}\n"));
    }
}

/// Prints a text, without what a terminal would obey.
pub fn tell(text: &str) {
    write(&clean::lines(text));
}

/// Prints a text in place of the line on which the cursor is, and stays on it.
pub fn replace_line(text: &str) {
    write(&format!("\r\x1b[K{}", clean::line(text)));
}

/// Nobody may be reading: then the text is lost, and the command goes on.
fn write(text: &str) {
    crate::progress::aside(|| {
        let _ = std::io::stderr().write_all(text.as_bytes());
    });
}

/// Prints what the libraries report.
pub fn reporter() -> Reporter {
    Reporter::new(|severity, text| match severity {
        Severity::Note => tell(&format!("cantap: {text}\n")),
        Severity::Warning => warn(text),
    })
}
