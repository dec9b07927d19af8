//! What the fuzz targets share. Each file in `targets/` is one target: its seeds, and a
//! function that decodes an input and says whether it was accepted.
//!
//! A target finds three kinds of fault: a panic (overflows and debug assertions
//! included), an input that takes longer than [`run`] allows, and memory beyond
//! [`memory::LIMIT_BYTES`]. Where a check sum would stop every mutated input at the door,
//! the target sets it right first, unless the input's first byte says not to.
//!
//! [`run`]: https://llvm.org/docs/LibFuzzer.html#options

pub mod memory;
pub mod raster;
pub mod seeds;
pub mod stores;

/// Declares a target from its seeds and its function from an input to whether it is
/// accepted.
#[macro_export]
macro_rules! target {
    ($seeds:expr, $accepts:path) => {
        libfuzzer_sys::fuzz_target!(init: $crate::seeds::plant(&$seeds, $accepts), |input: &[u8]| {
            $accepts(input);
        });
    };
}
