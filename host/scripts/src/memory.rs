//! How much memory a script uses. Its values do not say: they share, they nest, and functions and lists of steps hide others. So the program's
//! allocator counts, for each thread by itself, and a script has a thread of its own.

use std::alloc::{GlobalAlloc, Layout};
use std::cell::Cell;

thread_local! {
    /// Bytes that this thread has taken and not given back.
    static USED: Cell<isize> = const { Cell::new(0) };
}

/// An allocator that counts what each thread takes and gives back. A program that runs scripts makes it its global one: without it, a script's
/// memory has no limit but those of its single values.
///
/// ```
/// #[global_allocator]
/// static ALLOCATOR: cantap_scripts::Counting<std::alloc::System> = cantap_scripts::Counting(std::alloc::System);
/// ```
#[derive(Clone, Copy, Debug, Default)]
pub struct Counting<A>(pub A);

// SAFETY: every call goes to an allocator that keeps the contract, with what it was called with. Counting neither allocates nor panics: the
// counter needs no initialization and no destructor, and wraps.
unsafe impl<A: GlobalAlloc> GlobalAlloc for Counting<A> {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller's promises are the same.
        taken(unsafe { self.0.alloc(layout) }, layout.size())
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        // SAFETY: the caller's promises are the same.
        taken(unsafe { self.0.alloc_zeroed(layout) }, layout.size())
    }

    unsafe fn dealloc(&self, place: *mut u8, layout: Layout) {
        add(-size(layout.size()));
        // SAFETY: the caller's promises are the same.
        unsafe { self.0.dealloc(place, layout) }
    }

    unsafe fn realloc(&self, place: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        // SAFETY: the caller's promises are the same.
        let place = unsafe { self.0.realloc(place, layout, new_size) };
        if !place.is_null() {
            add(size(new_size) - size(layout.size()));
        }
        place
    }
}

/// Bytes that this thread has taken and not given back; 0 without [`Counting`].
pub fn used() -> usize {
    usize::try_from(USED.get()).unwrap_or(0)
}

/// So many bytes of this thread become another's, which gives them back.
pub fn hand_over(bytes: usize) {
    add(-size(bytes));
}

fn taken(place: *mut u8, bytes: usize) -> *mut u8 {
    if !place.is_null() {
        add(size(bytes));
    }
    place
}

/// No allocation has more bytes than this holds.
const fn size(bytes: usize) -> isize {
    bytes as isize
}

fn add(bytes: isize) {
    USED.set(USED.get().wrapping_add(bytes));
}
