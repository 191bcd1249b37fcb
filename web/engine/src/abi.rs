//! What WebAssembly exports: functions on addresses, for a worker that knows nothing of Rust.
//!
//! The worker calls [`cantap_allocate`], writes a request there, and calls [`cantap_ask`], which returns the address of the answer's length
//! (4 bytes, little-endian) and, 8 bytes behind it, of the answer. Then it calls [`cantap_free`] for the answer. There is one engine, in one thread.

use std::cell::RefCell;

use crate::Engine;

thread_local! {
    static ENGINE: RefCell<Engine> = RefCell::new(Engine::default());
}

/// The answer's length stands so far before it, so that its sections are aligned.
const BEFORE_ANSWER: usize = 8;

/// Gives room for a request of `length` bytes.
#[unsafe(no_mangle)]
pub extern "C" fn cantap_allocate(length: usize) -> *mut u8 {
    Box::into_raw(vec![0_u8; length].into_boxed_slice()).cast()
}

/// Answers the request at `address`, whose room is freed.
///
/// # Safety
///
/// `address` and `length` must be those of a [`cantap_allocate`] that has not been used for a request before.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cantap_ask(address: *mut u8, length: usize) -> *mut u8 {
    // SAFETY: the caller passes what `cantap_allocate` made, once.
    let request = unsafe { Box::from_raw(std::ptr::slice_from_raw_parts_mut(address, length)) };
    let answer = ENGINE.with_borrow_mut(|engine| engine.ask(&request));
    drop(request);
    let mut out = Vec::with_capacity(BEFORE_ANSWER + answer.len());
    out.extend_from_slice(&(answer.len() as u32).to_le_bytes());
    out.resize(BEFORE_ANSWER, 0);
    out.extend_from_slice(&answer);
    Box::into_raw(out.into_boxed_slice()).cast()
}

/// Frees an answer.
///
/// # Safety
///
/// `address` must be that of an answer of [`cantap_ask`] that has not been freed, and `length` the answer's.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn cantap_free(address: *mut u8, length: usize) {
    // SAFETY: the caller passes what `cantap_ask` made, once; its room is this much longer than the answer.
    drop(unsafe { Box::from_raw(std::ptr::slice_from_raw_parts_mut(address, BEFORE_ANSWER + length)) });
}
