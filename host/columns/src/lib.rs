#![doc = include_str!("../README.md")]
#![forbid(unsafe_code)]

mod bad;
mod cells;
mod events;
mod foreign;
mod frames;
#[cfg(feature = "mcap")]
mod mcap;
mod messages;
mod names;
#[cfg(feature = "parquet")]
pub mod parquet;
mod records;
mod rows;
mod signals;
mod tables;
mod texts;
mod wide;

/// A batch of rows, as Arrow has it.
pub use arrow_array::RecordBatch;
pub use bad::BadColumns;
pub use cells::{CellKind, cells};
pub use frames::FrameColumns;
#[cfg(feature = "mcap")]
pub use mcap::McapFile;
pub use messages::MessageColumns;
pub use records::records;
pub use rows::{Row, rows};
pub use signals::SignalColumns;
pub use tables::MessageTables;
pub use wide::WideColumns;

/// The default limit of rows in a batch: a few megabytes, and what a Parquet reader takes at once.
pub const BATCH_ROWS: usize = 1 << 16;
