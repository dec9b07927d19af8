//! Which heights of a layer are rounded, and to what step.
//!
//! Posts that are samples of a file are never touched. Resampled ones, filled voids and
//! what an inset borrows from below are computed: they are rounded, so that tiles fit two
//! bytes a post in memory; see [`terrafarm_terrain::rounding`].

use terrafarm_terrain::rounding;

use crate::grid::Grid;
use crate::surface::StackedMosaic;

/// The step that all heights of a layer's untouched mosaics share, metres.
pub(crate) fn quantum_m(mosaics: &[StackedMosaic]) -> Option<f64> {
    let mut steps = mosaics
        .iter()
        .filter(|stacked| stacked.way.is_untouched())
        .flat_map(|stacked| stacked.mosaic.rasters())
        .map(|placed| placed.raster.info().quantum_m);
    let first = steps.next().flatten()?;
    steps.all(|step| step == Some(first)).then_some(first)
}

/// Bits of an f64 before its fraction: sign and exponent.
const BITS_BEFORE_FRACTION: u32 = u64::BITS - (f64::MANTISSA_DIGITS - 1);

/// The step of a layer's computed heights, metres. Beside untouched tenths or feet it is
/// theirs: nothing else fits the same tile.
pub(crate) fn computed_step_m(grid: &Grid, mosaics: &[StackedMosaic]) -> Option<f64> {
    let is_binary = |step: f64| step.to_bits() << BITS_BEFORE_FRACTION == 0;
    let foreign = quantum_m(mosaics).filter(|&step| !is_binary(step));
    foreign.or_else(|| rounding::step_m(grid.spacing))
}
