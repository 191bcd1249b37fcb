//! Parquet files of these tables.

mod dataset;
mod file;
mod guard;
mod reader;

pub use dataset::{BadKey, Dataset, Key};
pub use file::ParquetFile;
pub use parquet::errors::ParquetError;
pub use reader::{LostRows, ParquetReader};

use arrow_array::RecordBatch;
use arrow_schema::SchemaRef;

use crate::{FrameColumns, MessageColumns, SignalColumns, WideColumns};

/// Something that turns rows into batches.
pub trait Table {
    /// The columns of every batch.
    fn columns(&self) -> SchemaRef;
    /// The number of rows since the last batch.
    fn waiting(&self) -> usize;
    /// Returns the rows since the last batch as one.
    fn batch(&mut self) -> RecordBatch;
}

macro_rules! table {
    ($($table:ty),*) => {$(
        impl Table for $table {
            fn columns(&self) -> SchemaRef {
                self.schema()
            }

            fn waiting(&self) -> usize {
                self.rows()
            }

            fn batch(&mut self) -> RecordBatch {
                self.take()
            }
        }
    )*};
}

impl Table for FrameColumns {
    fn columns(&self) -> SchemaRef {
        Self::schema()
    }

    fn waiting(&self) -> usize {
        self.rows()
    }

    fn batch(&mut self) -> RecordBatch {
        self.take()
    }
}

table!(SignalColumns, MessageColumns, WideColumns);
