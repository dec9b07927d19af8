//! Rasters to a terrain store: mosaic, reproject, fill, report.
