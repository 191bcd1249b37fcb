//! Exit codes other than 0 (success). Documented in `cantap --help`.

/// Something failed; the message on stderr says what happened and what to do next.
pub const FAILURE: u8 = 1;
/// The command line is wrong; clap also uses this code.
pub const WRONG_COMMAND_LINE: u8 = 2;
/// A check failed.
pub const CHECK_FAILED: u8 = 3;
