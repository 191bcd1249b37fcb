//! Reading a Parquet file batch by batch.

use std::io::{self, Read, Seek, SeekFrom};
use std::sync::{Arc, Mutex, MutexGuard};

use arrow_array::RecordBatch;
use arrow_schema::SchemaRef;
use bytes::Bytes;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReader, ParquetRecordBatchReaderBuilder,
};
use parquet::errors::ParquetError;
use parquet::file::reader::{ChunkReader, Length};

use super::guard::guarded;

/// Rows of a batch: few enough that their records take a megabyte at most.
const READ_ROWS: usize = 1 << 13;

/// The batches of a Parquet file, in its order. What is damaged in a group of rows does not cost the next group.
pub struct ParquetReader {
    source: Source,
    metadata: ArrowReaderMetadata,
    /// The group being read, and what is left of it.
    group: usize,
    batches: Option<ParquetRecordBatchReader>,
    /// Rows of the groups before, and rows of this one that were read.
    before: u64,
    read: u64,
}

/// Rows that could not be read.
#[derive(Debug, thiserror::Error)]
#[error("{rows} rows from row {from} on cannot be read: {error}")]
pub struct LostRows {
    /// The first of them, from 0.
    pub from: u64,
    /// How many, as the file's directory says.
    pub rows: u64,
    /// Why.
    #[source]
    pub error: ParquetError,
}

impl ParquetReader {
    /// Reads the directory at the end of the file.
    ///
    /// # Errors
    /// If the source cannot be read, or is not a Parquet file whose schema Arrow has types for.
    pub fn open(source: impl Read + Seek + Send + 'static) -> Result<Self, ParquetError> {
        let source = Source::of(source)?;
        let metadata = guarded(|| ArrowReaderMetadata::load(&source, ArrowReaderOptions::new()))?;
        Ok(Self { source, metadata, group: 0, batches: None, before: 0, read: 0 })
    }

    /// The columns of every batch.
    pub fn schema(&self) -> SchemaRef {
        Arc::clone(self.metadata.schema())
    }

    /// The next group of rows; `None` at the end.
    fn rows_of_group(&self) -> Option<u64> {
        let group = self.metadata.metadata().row_groups().get(self.group)?;
        Some(u64::try_from(group.num_rows()).unwrap_or(0))
    }

    fn batches(&self) -> Result<ParquetRecordBatchReader, ParquetError> {
        let builder =
            ParquetRecordBatchReaderBuilder::new_with_metadata(self.source.clone(), self.metadata.clone());
        builder.with_row_groups(vec![self.group]).with_batch_size(READ_ROWS).build()
    }

    /// The next batch of the group, or `None` if it has no more.
    fn batch(&mut self) -> Result<Option<RecordBatch>, ParquetError> {
        // After a panic there is none: what it was in the middle of is dropped.
        let mut batches = match self.batches.take() {
            Some(batches) => batches,
            None => guarded(|| self.batches())?,
        };
        let (next, batches) = guarded(move || Ok((batches.next().transpose()?, batches)))?;
        self.batches = Some(batches);
        Ok(next)
    }
}

impl Iterator for ParquetReader {
    type Item = Result<RecordBatch, LostRows>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let rows = self.rows_of_group()?;
            let error = match self.batch() {
                Ok(Some(batch)) => {
                    self.read += batch.num_rows() as u64;
                    return Some(Ok(batch));
                }
                Ok(None) if self.read >= rows => None,
                Ok(None) => Some(ParquetError::EOF("the group has fewer rows".to_owned())),
                Err(error) => Some(error),
            };
            let lost = error.map(|error| LostRows {
                from: self.before + self.read,
                rows: rows.saturating_sub(self.read),
                error,
            });
            self.before += rows;
            (self.group, self.read, self.batches) = (self.group + 1, 0, None);
            if let Some(lost) = lost {
                return Some(Err(lost));
            }
        }
    }
}

/// A file that is read at many places.
#[derive(Clone)]
struct Source {
    file: Arc<Mutex<dyn ReadSeek>>,
    len: u64,
}

trait ReadSeek: Read + Seek + Send {}

impl<T: Read + Seek + Send> ReadSeek for T {}

impl Source {
    fn of(mut source: impl Read + Seek + Send + 'static) -> io::Result<Self> {
        let len = source.seek(SeekFrom::End(0))?;
        Ok(Self { file: Arc::new(Mutex::new(source)), len })
    }
}

fn lock<'a>(file: &'a Mutex<dyn ReadSeek + 'static>) -> MutexGuard<'a, dyn ReadSeek + 'static> {
    file.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

impl Length for Source {
    fn len(&self) -> u64 {
        self.len
    }
}

impl ChunkReader for Source {
    type T = Chunk;

    fn get_read(&self, start: u64) -> parquet::errors::Result<Chunk> {
        Ok(Chunk { file: Arc::clone(&self.file), at: start })
    }

    fn get_bytes(&self, start: u64, length: usize) -> parquet::errors::Result<Bytes> {
        // A damaged directory may name any length: memory is taken for what is there only.
        let end = start.checked_add(length as u64).filter(|end| *end <= self.len);
        let end = end.ok_or_else(|| {
            ParquetError::EOF(format!("{length} bytes at {start}, but the file has {} bytes", self.len))
        })?;
        let mut bytes = Vec::with_capacity((end - start) as usize);
        let mut file = lock(&self.file);
        file.seek(SeekFrom::Start(start))?;
        let read = (&mut *file).take(length as u64).read_to_end(&mut bytes)?;
        if read < length {
            return Err(ParquetError::EOF(format!("{length} bytes at {start}, of which {read} were read")));
        }
        Ok(bytes.into())
    }
}

/// A part of a file, read in order. Others may read elsewhere meanwhile.
struct Chunk {
    file: Arc<Mutex<dyn ReadSeek>>,
    at: u64,
}

impl Read for Chunk {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let mut file = lock(&self.file);
        file.seek(SeekFrom::Start(self.at))?;
        let read = file.read(out)?;
        self.at += read as u64;
        Ok(read)
    }
}
