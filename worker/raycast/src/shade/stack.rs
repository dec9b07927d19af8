//! The levels of a layer, read at places of the map.
//!
//! Neighbouring pixels read the same tiles, of one level or of two neighbouring ones. So
//! the last tile of the even and of the odd levels is remembered, and what a level needs
//! for turning places into posts is worked out once.

use crate::field::{Field, Wanted};
use terrafarm_terrain::layout::{Layer, TILE_CELLS, TileKey};
use terrafarm_terrain::resident::{Lookup, Resident};

/// The levels of one layer of heights or of a photo.
pub(crate) struct Stack<'a, T> {
    resident: &'a Resident,
    number: usize,
    /// The layer itself.
    pub layer: &'a Layer,
    /// 1 / spacing of level 0, per metre.
    inverse_spacing: [f64; 2],
    sheets: Vec<Sheet>,
    find: fn(&'a Resident, TileKey) -> Lookup<'a, T>,
    /// Last tile of even and of odd levels; `None` for a tile that is empty.
    last: [Option<(TileKey, Option<&'a T>)>; 2],
}

/// One level.
struct Sheet {
    /// Posts of this level per post of level 0.
    shrink: f64,
    /// Index of the last post.
    end: [f64; 2],
    /// Index of the last tile.
    last_tile: [u32; 2],
}

/// A place within a tile.
pub(crate) struct Spot<'a, T> {
    pub tile: &'a T,
    /// Cell of the tile, 0 to 255 along x and y.
    pub cell: [isize; 2],
    /// Place within the cell, 0 to 1.
    pub share: [f32; 2],
}

impl<'a, T> Stack<'a, T> {
    /// `find` is how the resident is asked for such tiles.
    pub(crate) fn new(
        field: Field<'a>,
        number: usize,
        find: fn(&'a Resident, TileKey) -> Lookup<'a, T>,
    ) -> Self {
        let layer = &field.index().layers[number];
        let sheets = layer.levels.iter().enumerate().map(|(level, grid)| Sheet {
            shrink: 1.0 / (1u64 << level) as f64,
            end: layer.level_posts(level).map(|posts| (posts - 1) as f64),
            last_tile: grid.tiles.map(|tiles| tiles - 1),
        });
        Stack {
            resident: field.resident,
            number,
            layer,
            inverse_spacing: layer.spacing.map(|spacing| 1.0 / spacing),
            sheets: sheets.collect(),
            find,
            last: [None; 2],
        }
    }

    /// The coarsest level.
    pub(crate) fn top(&self) -> usize {
        self.sheets.len() - 1
    }

    /// 1 / spacing of a level, per metre.
    #[inline]
    pub(crate) fn level_scale(&self, level: usize) -> [f64; 2] {
        let shrink = self.sheets[level].shrink;
        [self.inverse_spacing[0] * shrink, self.inverse_spacing[1] * shrink]
    }

    /// A place of the map in posts of level 0.
    #[inline]
    pub(crate) fn posts_at(&self, place: [f64; 2]) -> [f64; 2] {
        let along =
            |axis: usize| (place[axis] - self.layer.origin[axis]) * self.inverse_spacing[axis];
        [along(0), along(1)]
    }

    /// Where a place, in posts of level 0, lies in a level; the nearest place of the layer
    /// if it is outside. `None` if the level has nothing there; a tile that is not loaded
    /// is added to `wanted`.
    #[inline]
    pub(crate) fn spot(
        &mut self,
        level: usize,
        posts: [f64; 2],
        wanted: &mut Wanted,
    ) -> Option<Spot<'a, T>> {
        let sheet = &self.sheets[level];
        let x = (posts[0] * sheet.shrink).clamp(0.0, sheet.end[0]);
        let y = (posts[1] * sheet.shrink).clamp(0.0, sheet.end[1]);
        let tx = (x as u32 / TILE_CELLS as u32).min(sheet.last_tile[0]);
        let ty = (y as u32 / TILE_CELLS as u32).min(sheet.last_tile[1]);
        let key = TileKey { layer: self.number as u16, level: level as u16, tx, ty };
        let tile = match self.last[level & 1] {
            Some((last, tile)) if last == key => tile,
            _ => self.turn_to(key, wanted),
        }?;
        let (x, y) = (x - f64::from(tx * TILE_CELLS as u32), y - f64::from(ty * TILE_CELLS as u32));
        let (i, j) = ((x as i32).min(TILE_CELLS as i32 - 1), (y as i32).min(TILE_CELLS as i32 - 1));
        let share = [(x - f64::from(i)) as f32, (y - f64::from(j)) as f32];
        Some(Spot { tile, cell: [i as isize, j as isize], share })
    }

    #[cold]
    fn turn_to(&mut self, key: TileKey, wanted: &mut Wanted) -> Option<&'a T> {
        let tile = match (self.find)(self.resident, key) {
            Lookup::Found(tile) => Some(tile),
            Lookup::Empty => None,
            Lookup::Absent => {
                wanted.add(key);
                return None;
            }
        };
        self.resident.touch(key);
        self.last[usize::from(key.level & 1)] = Some((key, tile));
        tile
    }
}
