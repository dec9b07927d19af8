//! Colours of a photo layer's texels, on demand and for any window.

use std::sync::atomic::{AtomicBool, Ordering};

use terrafarm_terrain::build::{LayerSource, SourceError};
use terrafarm_terrain::layout;

use crate::color::over;
use crate::grid::{Grid, PostWindow, overlap};
use crate::mosaic::LatticeWindow;
use crate::request::ImportError;
use crate::surface::{StackedMosaic, window_bounds};

/// Photos over one another. A layer is as fine as its finest photo and holds photos of
/// about one resolution only, so texels never stand for many pixels and bilinear
/// interpolation is enough.
pub(crate) struct PhotoStack {
    pub(crate) grid: Grid,
    /// Topmost last.
    pub(crate) mosaics: Vec<StackedMosaic>,
    /// Whether any texel had coverage so far.
    pub(crate) any_covered: AtomicBool,
}

impl PhotoStack {
    pub(crate) fn texels(&self, window: PostWindow) -> Result<Vec<[u8; 4]>, ImportError> {
        let mut found = vec![[0; 4]; window.len()];
        let bounds = window_bounds(&self.grid, window);
        for stacked in self.mosaics.iter().rev() {
            if !overlap(bounds, stacked.bounds) {
                continue;
            }
            let mosaic = &stacked.mosaic;
            let read = |window: LatticeWindow| mosaic.colors(window).map_err(ImportError::from);
            let own: Vec<[u8; 4]> = stacked.way.samples(window, mosaic, &read)?;
            for (texel, own) in found.iter_mut().zip(own) {
                *texel = over(*texel, own);
            }
        }
        Ok(found)
    }
}

impl LayerSource for PhotoStack {
    fn colors(&self, window: layout::PostWindow, into: &mut [[u8; 4]]) -> Result<(), SourceError> {
        let texels = self.texels(window.into()).map_err(Box::new)?;
        if texels.iter().any(|texel| texel[3] > 0) {
            self.any_covered.store(true, Ordering::Relaxed);
        }
        into.copy_from_slice(&texels);
        Ok(())
    }
}
