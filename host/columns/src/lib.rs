#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod bad;
mod events;
mod foreign;
mod frames;
mod messages;
mod names;
#[cfg(feature = "parquet")]
pub mod parquet;
mod records;
mod signals;
mod tables;
mod texts;
mod wide;

pub use bad::BadColumns;
pub use frames::FrameColumns;
pub use messages::MessageColumns;
pub use records::records;
pub use signals::SignalColumns;
pub use tables::MessageTables;
pub use wide::WideColumns;

/// The default limit of rows in a batch: a few megabytes, and what a Parquet reader takes at once.
pub const BATCH_ROWS: usize = 1 << 16;
