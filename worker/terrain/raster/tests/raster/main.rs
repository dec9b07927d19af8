//! Whole files, read through the public door.
//!
//! `damage`: nothing in a file may panic. `by_gdal`: files that GDAL writes in every
//! variant hold the samples that GDAL reads. `shared_data`: real files against GDAL. The
//! last two say that they skip where GDAL or the data are absent.
#![allow(clippy::unwrap_used)]

mod by_gdal;
mod damage;
mod shared_data;
mod support;
