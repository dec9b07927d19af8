//! A ceiling on memory. libFuzzer's own limits see only pages that were touched, once a
//! second; a buffer that was asked for and not filled would pass.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Memory that a target may hold at once, bytes.
pub const LIMIT_BYTES: usize = 512 << 20;

struct Ceiling;

#[global_allocator]
static CEILING: Ceiling = Ceiling;

static HELD_BYTES: AtomicUsize = AtomicUsize::new(0);

/// Counts memory; ends the process, which makes the input a finding, above the limit.
fn hold(bytes: usize) {
    let before = HELD_BYTES.fetch_add(bytes, Ordering::Relaxed);
    if before.saturating_add(bytes) > LIMIT_BYTES {
        // Back to zero, so that the report itself has memory.
        HELD_BYTES.store(0, Ordering::Relaxed);
        eprintln!("asked for {bytes} bytes with {before} in use; the limit is {LIMIT_BYTES}");
        eprintln!("{}", std::backtrace::Backtrace::force_capture());
        std::process::abort();
    }
}

fn release(bytes: usize) {
    let smaller = |held: usize| Some(held.saturating_sub(bytes));
    let _ = HELD_BYTES.fetch_update(Ordering::Relaxed, Ordering::Relaxed, smaller);
}

// SAFETY: every call is passed on unchanged to the allocator of the system, which keeps
// the contract; counting touches no memory of the caller.
unsafe impl GlobalAlloc for Ceiling {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        hold(layout.size());
        // SAFETY: as the caller promised.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        hold(layout.size());
        // SAFETY: as the caller promised.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        release(layout.size());
        // SAFETY: as the caller promised.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        hold(size);
        release(layout.size());
        // SAFETY: as the caller promised.
        unsafe { System.realloc(pointer, layout, size) }
    }
}
