//! The surface as a whole: which layer holds at each place, and how tiles are reached.
//!
//! Later height layers lie on top of earlier ones over the rectangle of their posts. A
//! ray's way is cut at the borders of these rectangles into *stretches*; over each a
//! single layer, its owner, is the surface.

use crate::cell::Corners;
use crate::grid::{GridRay, cells_of};
use crate::path::Path;
use crate::pyramid::Pyramid;
use glam::DVec3;
use std::collections::BTreeSet;
use terrafarm_terrain::layout::{Layer, LayerKind, StoreIndex, TILE_CELLS, TileKey};
use terrafarm_terrain::resident::{Lookup, Resident};
use terrafarm_terrain::tile::{HeightTile, MAXIMA_LEVELS};

/// The height layers of a store and the tiles at hand.
#[derive(Clone, Copy)]
pub(crate) struct Field<'a> {
    pub resident: &'a Resident,
    pub pyramid: &'a Pyramid,
}

/// Tiles that were needed but not loaded.
#[derive(Debug, Default)]
pub(crate) struct Wanted {
    keys: BTreeSet<TileKey>,
    /// How often a tile was wanted: tells whether one was since it was looked at last.
    pub count: u64,
}

impl Wanted {
    pub(crate) fn add(&mut self, key: TileKey) {
        self.count += 1;
        self.keys.insert(key);
    }

    /// Moves the keys into another set.
    pub(crate) fn drain_into(&mut self, keys: &mut BTreeSet<TileKey>) {
        keys.append(&mut self.keys);
    }
}

/// Where a ray meets the surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Contact {
    /// Index into the layers of the store.
    pub layer: usize,
    /// Cell of level 0.
    pub cell: [i32; 2],
    /// Parameter of the ray.
    pub u: f64,
    /// Height of the ray there, metres.
    pub z: f64,
    /// Where in the cell, 0 to 1 along x and y.
    pub place: [f64; 2],
    /// The posts of the cell.
    pub corners: Corners,
}

/// What became of a ray.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Outcome {
    Hit(Contact),
    Miss,
    /// A tile that the answer depends on is not loaded.
    Unfinished,
}

/// A part of a ray over which one layer is the surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Stretch {
    /// Position in the list of rays.
    pub ray: usize,
    pub start_u: f64,
    pub end_u: f64,
}

/// A tile of level 0 as a ray finds it.
#[derive(Clone, Copy)]
pub(crate) enum Ground<'a> {
    Loaded(&'a HeightTile),
    Void,
    Absent,
}

impl<'a> Field<'a> {
    pub(crate) fn index(&self) -> &'a StoreIndex {
        self.resident.index()
    }

    /// A ray in the grids of all height layers, in their order.
    pub(crate) fn grid_rays(&self, path: &Path, rays: &mut Vec<(usize, GridRay)>) {
        rays.clear();
        for (number, layer) in self.index().layers_of(LayerKind::Height) {
            rays.push((number, GridRay::new(layer, path)));
        }
    }

    pub(crate) fn ground(&self, key: TileKey) -> Ground<'a> {
        match self.resident.height(key) {
            Lookup::Found(tile) => Ground::Loaded(tile),
            Lookup::Empty => Ground::Void,
            Lookup::Absent => Ground::Absent,
        }
    }

    /// Whether a place is at or below the surface; the key of the tile that is needed to
    /// tell if it is not loaded.
    pub(crate) fn is_below(&self, position: DVec3) -> Result<bool, TileKey> {
        let Some((number, cell, _)) = self.cell_at([position.x, position.y]) else {
            return Ok(false);
        };
        let highest = self.index().entry(tile_key(number, cell)).map(|entry| entry.max);
        if highest.is_some_and(|highest| position.z > f64::from(highest)) {
            return Ok(false);
        }
        let height = self.height_at([position.x, position.y])?;
        Ok(height.is_some_and(|height| position.z <= height))
    }

    /// Height of the surface at a place, metres, `None` over a void and outside; the key
    /// of the tile that is needed to tell if it is not loaded.
    pub(crate) fn height_at(&self, at: [f64; 2]) -> Result<Option<f64>, TileKey> {
        let Some((number, cell, [x, y])) = self.cell_at(at) else { return Ok(None) };
        let key = tile_key(number, cell);
        match self.ground(key) {
            Ground::Absent => Err(key),
            Ground::Void => Ok(None),
            Ground::Loaded(tile) => Ok(corners_in(tile, cell).map(|corners| corners.height(x, y))),
        }
    }

    /// The layer that holds at a place, its cell there, and where in the cell.
    pub(crate) fn cell_at(&self, at: [f64; 2]) -> Option<(usize, [i32; 2], [f64; 2])> {
        let holds = |layer: &Layer| {
            let far = layer.far_corner();
            let within = |axis: usize| (layer.origin[axis]..=far[axis]).contains(&at[axis]);
            !cells_of(layer).contains(&0) && within(0) && within(1)
        };
        let layers = self.index().layers_of(LayerKind::Height);
        let (number, layer) = layers.filter(|(_, layer)| holds(layer)).last()?;
        let cells = cells_of(layer);
        let place =
            [0, 1].map(|axis| (at[axis] - layer.origin[axis]) * (1.0 / layer.spacing[axis]));
        let cell = [0, 1].map(|axis| (place[axis].floor() as i32).clamp(0, cells[axis] - 1));
        Some((number, cell, [0, 1].map(|axis| place[axis] - f64::from(cell[axis]))))
    }
}

/// Looks tiles of level 0 up and remembers the last one.
pub(crate) struct Cursor<'a> {
    field: Field<'a>,
    last: (TileKey, Ground<'a>),
}

impl<'a> Cursor<'a> {
    pub(crate) fn new(field: Field<'a>) -> Self {
        let nowhere = TileKey { layer: u16::MAX, level: 0, tx: 0, ty: 0 };
        Cursor { field, last: (nowhere, Ground::Void) }
    }

    /// The tile with a key.
    #[inline]
    pub(crate) fn ground(&mut self, key: TileKey) -> Ground<'a> {
        if self.last.0 != key {
            self.last = (key, self.field.ground(key));
            self.field.resident.touch(key);
        }
        self.last.1
    }
}

/// The tile of level 0 that holds a cell.
#[inline]
pub(crate) fn tile_key(layer: usize, cell: [i32; 2]) -> TileKey {
    TileKey {
        layer: layer as u16,
        level: 0,
        tx: (cell[0] >> MAXIMA_LEVELS) as u32,
        ty: (cell[1] >> MAXIMA_LEVELS) as u32,
    }
}

/// The corners of a cell, if it has a surface.
#[inline(always)]
pub(crate) fn corners_in(tile: &HeightTile, cell: [i32; 2]) -> Option<Corners> {
    let within = |axis: usize| cell[axis] as usize & (TILE_CELLS - 1);
    let (i, j) = (within(0), within(1));
    Corners::new(tile.corners(i, j))
}

/// The first stretch that begins at or after `u`.
pub(crate) fn next_stretch(rays: &[(usize, GridRay)], u: f64) -> Option<Stretch> {
    let over = |ray: &GridRay| ray.enter_u <= u && u < ray.exit_u;
    let later = |rays: &[(usize, GridRay)]| {
        let starts = rays.iter().map(|(_, ray)| ray).filter(|ray| ray.enter_u < ray.exit_u);
        starts.map(|ray| ray.enter_u).filter(|&enter_u| enter_u > u).fold(f64::INFINITY, f64::min)
    };
    match rays.iter().rposition(|(_, ray)| over(ray)) {
        Some(owner) => {
            let end_u = rays[owner].1.exit_u.min(later(&rays[owner + 1..]));
            Some(Stretch { ray: owner, start_u: u, end_u })
        }
        None => {
            let start_u = later(rays);
            if start_u.is_finite() { next_stretch(rays, start_u) } else { None }
        }
    }
}
