//! Exit codes beside 0 (success). Documented in `cantap --help`.

/// Something failed; the message on stderr says what and what to do next.
pub const FAILURE: u8 = 1;
/// A wrong command line; clap uses it by itself.
pub const WRONG_COMMAND_LINE: u8 = 2;
/// A check did not hold.
pub const CHECK_FAILED: u8 = 3;
