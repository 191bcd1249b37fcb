//! How users write identifiers, times, rates and channels: one grammar for every command, prompt and file of settings.
//!
//! `docs/grammar.md` is its page. Errors are sentences that say what to write instead.

mod channel;
mod identifier;
mod rate;
mod time;

pub(crate) use identifier::{hex, masked};

pub use channel::{channel, interface};
pub use identifier::{IdError, IdPattern, any_frame, frame, group_of, identifier, parameter_group};
pub use rate::{bit_rate, per_second};
pub use time::{duration, positive_duration};
