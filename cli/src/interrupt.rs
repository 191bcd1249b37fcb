//! Ctrl-C as a flag: a command that runs until it is stopped ends cleanly, with its summary.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

/// What shells report for a program that Ctrl-C ended.
const ENDED_BY_SIGNAL: i32 = 130;

static FLAG: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// From now on Ctrl-C (and the system's polite request to end) sets a flag instead of ending the program.
pub fn watch() -> anyhow::Result<()> {
    if FLAG.get().is_some() {
        return Ok(());
    }
    let flag = Arc::clone(FLAG.get_or_init(Arc::default));
    ctrlc::set_handler(move || {
        // Asked twice, it ends at once.
        if flag.swap(true, Ordering::Relaxed) {
            std::process::exit(ENDED_BY_SIGNAL);
        }
    })?;
    Ok(())
}

/// Whether it was pressed.
pub fn requested() -> bool {
    FLAG.get().is_some_and(|flag| flag.load(Ordering::Relaxed))
}
