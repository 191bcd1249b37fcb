//! Locks.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Waits for a lock. Every holder leaves what it protects consistent, even if it panicked elsewhere.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
