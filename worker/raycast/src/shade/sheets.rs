//! The levels of a layer, read at places of the map given relative to the camera.
//!
//! Coordinates of the size of UTM would jitter in f32. So a place is held as a cell of
//! level 0, an integer, and where in the cell it is.

use super::level::shrink;
use crate::field::Wanted;
use crate::lanes::{Floats, Ints, Lanes};
use glam::DVec3;
use terrafarm_terrain::layout::{Layer, TILE_CELLS, TileKey};
use terrafarm_terrain::resident::{Lookup, Resident};
use terrafarm_terrain::tile::MAXIMA_LEVELS;

/// Tiles that are remembered; a power of two.
const REMEMBERED: usize = 64;
/// log2 of the cells along a side of a tile.
pub(crate) const TILE_BITS: i32 = MAXIMA_LEVELS as i32;

/// The levels of one layer of heights or of a photo.
pub(crate) struct Sheets<'a, T> {
    resident: &'a Resident,
    number: u16,
    pub layer: &'a Layer,
    /// The camera: the cell of level 0 it is over, and its place in it.
    eye_cell: [i32; 2],
    eye_place: [f32; 2],
    /// Cells of level 0 per metre.
    pub rate: [f32; 2],
    levels: Vec<Sheet>,
    find: fn(&'a Resident, TileKey) -> Lookup<'a, T>,
    recent: Vec<(u64, Soil<'a, T>)>,
}

/// One level.
#[derive(Clone, Copy)]
pub(crate) struct Sheet {
    /// Index of the last post along x and y.
    pub end: [i32; 2],
    /// Index of the last tile along x and y.
    pub last_tile: [i32; 2],
}

/// A tile as it is found.
pub(crate) enum Soil<'a, T> {
    Tile(&'a T),
    /// Nothing valid in it.
    Empty,
    /// Not loaded.
    Absent,
}

impl<T> Clone for Soil<'_, T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Soil<'_, T> {}

/// Places of the map in posts of a level: the post to the south-west, and how far from it,
/// 0 to 1 and at the far border of the layer 1 itself.
pub(crate) struct Spot<L: Lanes> {
    pub cell: [L::I; 2],
    pub part: [L::F; 2],
}

impl<'a, T> Sheets<'a, T> {
    /// `find` is how the resident is asked for such tiles.
    pub(crate) fn new(
        resident: &'a Resident,
        number: usize,
        eye: DVec3,
        find: fn(&'a Resident, TileKey) -> Lookup<'a, T>,
    ) -> Self {
        let layer = &resident.index().layers[number];
        let place = [0, 1].map(|axis| {
            let place = (eye[axis] - layer.origin[axis]) / layer.spacing[axis];
            place.clamp(-1e9, 1e9)
        });
        let cell = place.map(f64::floor);
        let levels = layer.levels.iter().enumerate().map(|(level, grid)| Sheet {
            end: layer.level_posts(level).map(|posts| (posts - 1) as i32),
            last_tile: grid.tiles.map(|tiles| tiles as i32 - 1),
        });
        Sheets {
            resident,
            number: number as u16,
            layer,
            eye_cell: cell.map(|cell| cell as i32),
            eye_place: [0, 1].map(|axis| (place[axis] - cell[axis]) as f32),
            rate: layer.spacing.map(|spacing| (1.0 / spacing) as f32),
            levels: levels.collect(),
            find,
            recent: vec![(u64::MAX, Soil::Empty); REMEMBERED],
        }
    }

    /// The coarsest level.
    pub(crate) fn top(&self) -> usize {
        self.levels.len() - 1
    }

    #[inline(always)]
    pub(crate) fn sheet(&self, level: i32) -> Sheet {
        self.levels[level as usize]
    }

    /// Places so many metres east and north of the camera, and which of them are within
    /// `margin` posts of the layer's posts. The others become the nearest place that is.
    #[inline(always)]
    pub(crate) fn spot<L: Lanes>(&self, along: [L::F; 2], margin: f32) -> (L::M, Spot<L>) {
        let (x_inside, x, x_part) = self.along::<L>(0, along[0], margin);
        let (y_inside, y, y_part) = self.along::<L>(1, along[1], margin);
        (x_inside & y_inside, Spot { cell: [x, y], part: [x_part, y_part] })
    }

    #[inline(always)]
    fn along<L: Lanes>(&self, axis: usize, along: L::F, margin: f32) -> (L::M, L::I, L::F) {
        let place = L::F::splat(self.eye_place[axis]) + along * L::F::splat(self.rate[axis]);
        let floor = place.floor();
        let part = place - floor.to_floats();
        let cell = floor + L::I::splat(self.eye_cell[axis]);
        let end = L::I::splat(self.levels[0].end[axis]);
        let margin = L::F::splat(margin);
        let first = (part + margin).floor() + cell;
        let last = (part - margin).floor() + cell;
        let zero = L::I::splat(0);
        let inside = last.lt(end) & !first.lt(zero);
        let within = L::F::select(cell.lt(zero), L::F::splat(0.0), part);
        let within = L::F::select(cell.lt(end), within, L::F::splat(0.0));
        (inside, cell.max(zero).min(end), within)
    }

    /// The tile with a number, `row * columns + column`. If it is not loaded it is added
    /// to `wanted`.
    #[inline(always)]
    pub(crate) fn tile(&mut self, level: i32, number: i32, wanted: &mut Wanted) -> Soil<'a, T> {
        let name = (level as u64) << 32 | u64::from(number as u32);
        let at = (number as usize).wrapping_add(level as usize * 13) & (REMEMBERED - 1);
        let (known, soil) = self.recent[at];
        if known == name { soil } else { self.meet(name, at, wanted) }
    }

    #[cold]
    #[inline(never)]
    fn meet(&mut self, name: u64, at: usize, wanted: &mut Wanted) -> Soil<'a, T> {
        let (level, number) = ((name >> 32) as u16, name as u32);
        let columns = self.layer.levels[usize::from(level)].tiles[0];
        let (tx, ty) = (number % columns, number / columns);
        let key = TileKey { layer: self.number, level, tx, ty };
        let soil = match (self.find)(self.resident, key) {
            Lookup::Found(tile) => Soil::Tile(tile),
            Lookup::Empty => Soil::Empty,
            Lookup::Absent => {
                wanted.add(key);
                Soil::Absent
            }
        };
        self.resident.touch(key);
        self.recent[at] = (name, soil);
        soil
    }
}

impl<L: Lanes> Spot<L> {
    /// The same places in a coarser level.
    #[inline(always)]
    pub(crate) fn at_level(&self, level: L::I) -> Spot<L> {
        let (x, x_part) = self.coarse(0, level);
        let (y, y_part) = self.coarse(1, level);
        Spot { cell: [x, y], part: [x_part, y_part] }
    }

    #[inline(always)]
    fn coarse(&self, axis: usize, level: L::I) -> (L::I, L::F) {
        let one = L::I::splat(1);
        let rest = self.cell[axis] & (one.shl(level) - one);
        let part = (rest.to_floats() + self.part[axis]) * shrink::<L>(level);
        (self.cell[axis].shr(level), part)
    }
}

impl Sheet {
    /// The tile that a post lies in along an axis, and which post of it it is; the last
    /// tile has one post more.
    #[inline(always)]
    pub(crate) fn tile_of<L: Lanes>(last_tile: L::I, post: L::I) -> (L::I, L::I) {
        let bits = L::I::splat(TILE_BITS);
        let tile = post.shr(bits).min(last_tile);
        (tile, post - tile.shl(bits))
    }

    /// Number of a tile.
    #[inline(always)]
    pub(crate) fn number<L: Lanes>(&self, tx: L::I, ty: L::I) -> L::I {
        ty.times(L::I::splat(self.last_tile[0] + 1)) + tx
    }
}

const _: () = assert!(TILE_CELLS == 1 << TILE_BITS);
