//! The terrain of a store as a flight sees it: where a longitude lies, where north is,
//! how high the ground is.

use crate::input::flight::{Bounds, Place};
use anyhow::Context;
use std::cell::RefCell;
use terrafarm_geo::Crs;
use terrafarm_terrain::info::bounds;
use terrafarm_terrain::sample::height_at;
use terrafarm_terrain::store::{StoreError, StoreReader};

/// A store and its reference system.
pub struct StorePlace<'a> {
    store: &'a StoreReader,
    crs: Crs,
    bounds: Bounds,
    /// Why the ground could not be read, the first time.
    broken: RefCell<Option<StoreError>>,
}

impl<'a> StorePlace<'a> {
    /// Reads the reference system of a store.
    pub fn new(store: &'a StoreReader) -> anyhow::Result<Self> {
        let crs = Crs::parse(&store.index().crs).with_context(|| {
            format!("{}: cannot use its reference system", store.path().display())
        })?;
        let [min, max] = bounds(store.index());
        let bounds = Bounds { min, max };
        Ok(StorePlace { store, crs, bounds, broken: RefCell::new(None) })
    }

    /// Fails if the store could not be read where the flight asked for the ground.
    pub fn check(&self) -> anyhow::Result<()> {
        self.broken.take().map_or(Ok(()), |why| Err(why.into()))
    }

    /// Bearing of true north on the grid at the middle of the terrain, degrees.
    pub fn middle_convergence_deg(&self) -> f64 {
        let [x, y] = [0, 1].map(|axis| 0.5 * (self.bounds.min[axis] + self.bounds.max[axis]));
        self.convergence_deg(x, y)
    }
}

impl Place for StorePlace<'_> {
    fn to_grid(&self, lon_deg: f64, lat_deg: f64) -> Result<[f64; 2], String> {
        self.crs.from_lonlat([lon_deg, lat_deg]).map_err(|why| why.to_string())
    }

    fn convergence_deg(&self, x: f64, y: f64) -> f64 {
        if self.crs.is_local() {
            return 0.0;
        }
        // Far outside the system's domain there is no north; such a flight is refused
        // for lying outside the terrain.
        self.crs.convergence_deg([x, y]).unwrap_or(0.0)
    }

    fn ground(&self, x: f64, y: f64) -> Option<f64> {
        height_at(self.store, x, y).unwrap_or_else(|why| {
            self.broken.borrow_mut().get_or_insert(why);
            None
        })
    }

    fn bounds(&self) -> Bounds {
        self.bounds
    }
}
