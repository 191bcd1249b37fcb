//! The cantap command.
fn main() {}
