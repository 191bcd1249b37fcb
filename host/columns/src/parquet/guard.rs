//! The crate that reads Parquet checks less of a damaged file than it would have to, and panics: such a file is damaged, and nothing more.

use std::cell::Cell;
use std::panic::{self, AssertUnwindSafe};
use std::sync::Once;

use parquet::errors::ParquetError;

thread_local! {
    static READS: Cell<bool> = const { Cell::new(false) };
}

static HOOK: Once = Once::new();

/// Does it; a panic in it is an error. Nothing that it has changed may be used after one.
pub fn guarded<T>(read: impl FnOnce() -> Result<T, ParquetError>) -> Result<T, ParquetError> {
    // What the program does about other panics stays as it is.
    HOOK.call_once(|| {
        let others = panic::take_hook();
        panic::set_hook(Box::new(move |about| {
            if !READS.get() {
                others(about);
            }
        }));
    });
    READS.set(true);
    let result = panic::catch_unwind(AssertUnwindSafe(read));
    READS.set(false);
    result.unwrap_or_else(|_| Err(ParquetError::General("its content contradicts itself".to_owned())))
}
