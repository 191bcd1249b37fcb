//! How messages look on standard error.

use std::io::IsTerminal;

/// Whether it supports colours, and its reader wants them (<https://no-color.org>).
pub fn is_coloured() -> bool {
    std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

/// Prints what must not be overlooked: in red, if there are colours.
pub fn warn(text: &str) {
    if is_coloured() { eprintln!("\x1b[1;31mcantap: {text}\x1b[0m") } else { eprintln!("cantap: {text}") }
}
