//! What a script may use up: a bus must not wait for one that never ends, and a computer must not run out of memory.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rhai::Engine;

use crate::memory;

/// Operations of a script between two waits. A simple loop with ten million takes a few seconds, far longer than any node may be silent.
const MAX_OPERATIONS: u64 = 10_000_000;
/// How long a script may compute between two waits, by the computer's clock. Operations on large arrays take long each, and longer the deeper
/// these are nested, so that their number alone is no bound. No script that ends within both bounds depends on this one.
const MAX_TIME: Duration = Duration::from_secs(5);
/// The deepest nesting of calls; each takes space on the thread's stack.
const MAX_CALLS: usize = 48;
/// Values in an array with everything in it.
const MAX_ARRAY: usize = 1 << 19;
/// Entries in a map with everything in it.
const MAX_MAP: usize = 1 << 16;
/// Bytes of a text, or of all texts in an array or a map.
const MAX_STRING: usize = 1 << 24;
/// Bytes of everything that a script keeps besides its text: many values that are each within their limits are too many.
const MAX_MEMORY: usize = if cfg!(target_pointer_width = "64") { 64 << 20 } else { 16 << 20 };
/// The stack of a script's thread, of which only what is used takes memory. Values that hold each other in a chain as long as the memory allows
/// are freed one within the other: that takes up to 7.6 times their own bytes without optimisation. The deepest calls with functions of the bus in
/// between take a fraction of it.
pub const STACK_BYTES: usize = 8 * MAX_MEMORY;
/// Variables at the same time.
const MAX_VARIABLES: usize = 4096;

/// Counts a script's operations, and its time, since its last wait.
#[derive(Clone, Debug, Default)]
pub struct Operations {
    used: Rc<Cell<Used>>,
    stop: Arc<AtomicBool>,
    /// Bytes that the script had before it ran.
    text_bytes: Rc<Cell<usize>>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Used {
    operations: u64,
    /// When the first one began.
    since: Option<Instant>,
}

impl Operations {
    /// Of a script that ends when this becomes true, also in the middle of a computation.
    pub fn until(stop: Arc<AtomicBool>) -> Self {
        Self { stop, ..Self::default() }
    }

    /// The script's text has been read, and it begins: what it has by now is not its values'.
    pub fn begin(&self) {
        self.text_bytes.set(memory::used());
    }

    /// The script waits: it may use as many again.
    pub fn reset(&self) {
        self.used.set(Used::default());
    }

    /// Counts as so many operations: what a script hands over is kept until it waits. If that is too much, its next operation is its last.
    pub fn spend(&self, cost: usize) {
        let Used { operations, since } = self.used.get();
        self.used.set(Used { operations: operations.saturating_add(cost as u64), since });
    }

    /// One more; why the script ends here, if it does.
    fn count(&self) -> Option<&'static str> {
        if self.stop.load(Ordering::Relaxed) {
            return Some(ENDED);
        }
        if memory::used() > self.text_bytes.get() + MAX_MEMORY {
            return Some(TOO_LARGE);
        }
        self.spend(1);
        let Used { operations, since } = self.used.get();
        let since = since.unwrap_or_else(Instant::now);
        self.used.set(Used { operations, since: Some(since) });
        let is_too_long =
            operations > MAX_OPERATIONS || (operations.is_multiple_of(8) && since.elapsed() > MAX_TIME);
        is_too_long.then_some(TOO_LONG)
    }
}

/// An engine in which a script can reach nothing but what is registered, and use no more than the limits.
pub fn engine(operations: &Operations) -> Engine {
    let mut engine = Engine::new();
    engine
        .set_max_call_levels(MAX_CALLS)
        .set_max_expr_depths(64, 64)
        .set_max_array_size(MAX_ARRAY)
        .set_max_map_size(MAX_MAP)
        .set_max_string_size(MAX_STRING)
        .set_max_variables(MAX_VARIABLES)
        .disable_symbol("eval");
    let count = operations.clone();
    engine.on_progress(move |_| count.count().map(Into::into));
    engine
}

/// Ends a script from outside: an error that it cannot catch.
pub const ENDED: &str = "ended";

/// Why a script was ended that did not wait.
pub const TOO_LONG: &str = "it computed for too long, or logged too much, without waiting; put a wait(\"1ms\") into its loop, or react to frames with on_frame";

/// Why a script was ended that kept too much.
pub const TOO_LARGE: &str = "it uses too much memory; keep less in its variables, lists and functions";
