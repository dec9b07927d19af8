//! The surface that the fast methods see: for each place the coarsest level that is
//! within the tolerance.
//!
//! The ground is cut into *plots*, the squares of the tiles of level 0. A plot is seen at
//! one level: the coarsest whose deviation from level 0 (stored with each tile, an upper
//! bound) is at most `tolerance_px * distance / focal_px` at the point of the plot's box
//! that is closest to the camera. So no point of the surface is further than the tolerance
//! from level 0, in pixels across the line of sight. Which level a plot has depends on the
//! view alone, not on the ray.
//!
//! Where the tile of a plot is not loaded, a picture that can wait leaves the plot open and
//! names the tile. One that cannot ([`Lack::Coarser`]) sees the plot at the finest coarser
//! level whose tile is loaded: where the ground of level 0 is, that of every coarser level
//! is, too, so there is no hole. Such plots are counted.

use crate::View;
use crate::field::Field;
use crate::grid::cells_of;
use crate::lanes::{Floats, Ints, Lanes, MOST, Mask, as_bits};
use crate::path::Ground;
use crate::walk::post;
use std::cell::RefCell;
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;
use terrafarm_terrain::layout::{Layer, LayerKind, TILE_CELLS, TILE_POSTS, TileKey};
use terrafarm_terrain::resident::Lookup;
use terrafarm_terrain::tile::{HeightTile, Heights, MAXIMA_LEVELS, VOID};

/// A plot that nobody has asked for yet.
const UNKNOWN: u32 = u32::MAX;

/// What becomes of a plot whose tile is not loaded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Lack {
    /// It stays open until the tile is loaded.
    Open,
    /// It is seen at a coarser level, if one is loaded there.
    Coarser,
}

/// What the fast methods see of the only height layer of a store.
pub(crate) struct Relief<'a> {
    field: Field<'a>,
    number: usize,
    layer: &'a Layer,
    /// Vertical distance that the tolerance allows at a distance of 1 m.
    pub tolerance: f64,
    /// The camera: the cell it is over, its place in it, its height, metres.
    pub eye_cell: [i32; 2],
    pub eye_place: [f32; 2],
    pub eye_z: f64,
    /// Metres between posts of level 0.
    pub spacing: [f64; 2],
    /// Cells of level 0.
    pub cells: [i32; 2],
    /// 1 / effective radius of the Earth, per metre.
    pub curvature: f64,
    /// Plots along x and y.
    pub plots: [i32; 2],
    lack: Lack,
    known: RefCell<Known<'a>>,
}

/// The plots that rays have come to.
struct Known<'a> {
    /// By plot, row by row from the south-west, its place in `plots`.
    places: Vec<u32>,
    plots: Vec<Plot<'a>>,
    wanted: Vec<TileKey>,
    /// Some plot is seen at a coarser level than it should be.
    any_coarser: bool,
}

/// How a plot is seen.
#[derive(Clone, Copy)]
pub(crate) struct Plot<'a> {
    pub ground: Soil<'a>,
    /// Level, 0 the finest.
    pub level: u32,
    /// That level is coarser than it should be, for want of a tile.
    coarser: bool,
}

/// The tile under a plot.
#[derive(Clone, Copy)]
pub(crate) enum Soil<'a> {
    Tile(&'a HeightTile),
    /// Nothing to hit.
    Void,
    /// Not loaded.
    Absent,
}

impl<'a> Relief<'a> {
    /// The store must have one height layer, with at least one cell.
    pub(crate) fn new(field: Field<'a>, view: &View, tolerance_px: f64, lack: Lack) -> Self {
        let (number, layer) =
            field.index().layers_of(LayerKind::Height).next().expect("the store has heights");
        let cells = cells_of(layer);
        let camera = &view.camera;
        let place = [0, 1].map(|axis| {
            let place = (camera.position[axis] - layer.origin[axis]) / layer.spacing[axis];
            place.clamp(-1e9, 1e9)
        });
        let cell = place.map(f64::floor);
        let plots = cells.map(|count| (count - 1) / TILE_CELLS as i32 + 1);
        let known = Known {
            places: vec![UNKNOWN; plots[0] as usize * plots[1] as usize],
            plots: Vec::new(),
            wanted: Vec::new(),
            any_coarser: false,
        };
        Relief {
            field,
            number,
            layer,
            tolerance: tolerance_px / camera.focal_px(),
            eye_cell: cell.map(|cell| cell as i32),
            eye_place: [0, 1].map(|axis| (place[axis] - cell[axis]) as f32),
            eye_z: camera.position.z,
            spacing: layer.spacing,
            cells,
            curvature: Ground::new(view.shading.earth).curvature(),
            plots,
            lack,
            known: RefCell::new(known),
        }
    }

    /// The plot with a number: `row * plots[0] + column`.
    #[inline]
    pub(crate) fn plot(&self, number: i32) -> Plot<'a> {
        let known = self.known.borrow();
        let place = known.places[number as usize];
        if place != UNKNOWN {
            return known.plots[place as usize];
        }
        drop(known);
        self.meet(number)
    }

    /// The surface under places on the map, metres from the camera: whether there is any,
    /// whether that is unknown for lack of a tile, its height over the camera, and its slopes
    /// along x and y.
    #[inline(always)]
    pub(crate) fn surface<L: Lanes>(
        &self,
        place: [L::F; 2],
        lanes: L::M,
    ) -> (L::M, L::M, L::F, [L::F; 2]) {
        let zero = L::F::splat(0.0);
        let scale = [0, 1].map(|axis| (1.0 / self.spacing[axis]) as f32);
        let x = L::F::splat(self.eye_place[0]) + place[0] * L::F::splat(scale[0]);
        let y = L::F::splat(self.eye_place[1]) + place[1] * L::F::splat(scale[1]);
        let cell_x = x.floor() + L::I::splat(self.eye_cell[0]);
        let cell_y = y.floor() + L::I::splat(self.eye_cell[1]);
        let none = L::I::splat(-1);
        let inside = none.lt(cell_x)
            & none.lt(cell_y)
            & cell_x.lt(L::I::splat(self.cells[0]))
            & cell_y.lt(L::I::splat(self.cells[1]));
        let bits = L::I::splat(MAXIMA_LEVELS as i32);
        let plots = cell_y.shr(bits).times(L::I::splat(self.plots[0])) + cell_x.shr(bits);
        let (mut solid, mut absent) = (L::M::none(), L::M::none());
        let (mut height, mut slopes) = (zero, [zero; 2]);
        let mut left = lanes & inside;
        let mut numbers = [0; MOST];
        plots.store(&mut numbers);
        while left.any() {
            let number = numbers[left.bits().trailing_zeros() as usize % MOST];
            let here = left & plots.eq(L::I::splat(number));
            left = left & !here;
            let Plot { ground, level, .. } = self.plot(number);
            let tile = match ground {
                Soil::Tile(tile) => tile,
                Soil::Void => continue,
                Soil::Absent => {
                    absent = absent | here;
                    continue;
                }
            };
            let base = L::I::splat(level as i32);
            let shrink = L::F::splat(1.0 / (1u32 << level) as f32);
            let (i, j) = (cell_x.shr(base), cell_y.shr(base));
            let corner_x = (i.shl(base) - L::I::splat(self.eye_cell[0])).to_floats();
            let corner_y = (j.shl(base) - L::I::splat(self.eye_cell[1])).to_floats();
            let (u, v) = ((x - corner_x) * shrink, (y - corner_y) * shrink);
            let (there, [sw, se, nw, ne]) = corners::<L>(tile, self.eye_z, [i, j], here);
            let (south, north) = (se - sw, ne - nw);
            let (low, high) = (sw + south * u, nw + north * u);
            let found = low + (high - low) * v;
            let slope_x = (south + (north - south) * v) * (shrink * L::F::splat(scale[0]));
            let slope_y = (high - low) * (shrink * L::F::splat(scale[1]));
            height = L::F::select(here, found, height);
            slopes[0] = L::F::select(here, slope_x, slopes[0]);
            slopes[1] = L::F::select(here, slope_y, slopes[1]);
            solid = solid | (here & there);
        }
        (solid, absent, height, slopes)
    }

    /// Tiles that were needed but not loaded, sorted, each once.
    pub(crate) fn wanted(&self) -> Vec<TileKey> {
        let mut wanted = self.known.borrow().wanted.clone();
        wanted.sort_unstable();
        wanted.dedup();
        wanted
    }

    /// How many pixels of a region show ground of plots that are seen at a coarser level than
    /// they should be, from one over their depths.
    pub(crate) fn coarser_pixels(
        &self,
        camera: &Camera,
        region: Region,
        inverse_depth: &[f32],
    ) -> u64 {
        if !self.known.borrow().any_coarser {
            return 0;
        }
        let shown = region.pixels().zip(inverse_depth).filter(|(_, inverse)| **inverse > 0.0);
        let coarser = shown.filter(|([x, y], inverse)| {
            let ray = camera.ray(f64::from(*x) + 0.5, f64::from(*y) + 0.5);
            let along = [ray.x, ray.y].map(|part| part / f64::from(**inverse));
            let [x, y] = [0, 1].map(|axis| {
                let place = f64::from(self.eye_place[axis]) + along[axis] / self.spacing[axis];
                let cell = place.floor() + f64::from(self.eye_cell[axis]);
                (cell as i32).clamp(0, self.cells[axis] - 1) >> MAXIMA_LEVELS
            });
            self.plot(y * self.plots[0] + x).coarser
        });
        coarser.count() as u64
    }

    #[cold]
    fn meet(&self, number: i32) -> Plot<'a> {
        let at = [number % self.plots[0], number / self.plots[0]];
        let level = self.level(at);
        let key = self.key(at, level);
        let finest = self.layer.entry(0, at[0] as u32, at[1] as u32);
        let known = &mut *self.known.borrow_mut();
        let mut plot = Plot { ground: Soil::Void, level: level as u32, coarser: false };
        if finest.is_some_and(|entry| !entry.is_empty()) {
            plot.ground = self.soil(key);
            if matches!(plot.ground, Soil::Absent) {
                known.wanted.push(key);
                if self.lack == Lack::Coarser {
                    plot = self.coarser(at, level).unwrap_or(plot);
                    known.any_coarser |= plot.coarser;
                }
            }
        }
        known.places[number as usize] = known.plots.len() as u32;
        known.plots.push(plot);
        plot
    }

    fn soil(&self, key: TileKey) -> Soil<'a> {
        self.field.resident.touch(key);
        match self.field.resident.height(key) {
            Lookup::Found(tile) => Soil::Tile(tile),
            Lookup::Empty => Soil::Void,
            Lookup::Absent => Soil::Absent,
        }
    }

    /// A plot at the finest of the levels coarser than this one whose tile is loaded.
    fn coarser(&self, plot: [i32; 2], level: usize) -> Option<Plot<'a>> {
        (level + 1..=self.layer.root_level()).find_map(|level| {
            let ground = self.soil(self.key(plot, level));
            let loaded = matches!(ground, Soil::Tile(_));
            loaded.then_some(Plot { ground, level: level as u32, coarser: true })
        })
    }

    /// The tile of a level that a plot lies in.
    fn key(&self, plot: [i32; 2], level: usize) -> TileKey {
        let [tx, ty] = plot.map(|at| (at as u32) >> level);
        TileKey { layer: self.number as u16, level: level as u16, tx, ty }
    }

    /// The level at which a plot is seen.
    fn level(&self, plot: [i32; 2]) -> usize {
        let allowed = self.tolerance * self.distance(plot);
        let fits = |&level: &usize| {
            let key = self.key(plot, level);
            let entry = self.layer.entry(level, key.tx, key.ty);
            entry.is_some_and(|entry| f64::from(entry.deviation) <= allowed)
        };
        (1..=self.layer.root_level()).take_while(fits).last().unwrap_or(0)
    }

    /// Distance from the camera to the box of a plot, metres.
    fn distance(&self, plot: [i32; 2]) -> f64 {
        let mut across = 0.0;
        for axis in 0..2 {
            let first = f64::from(plot[axis] * TILE_CELLS as i32 - self.eye_cell[axis]);
            let apart = f64::from(self.eye_place[axis]) - first;
            let outside = (-apart).max(apart - TILE_CELLS as f64).max(0.0) * self.spacing[axis];
            across += outside * outside;
        }
        let key = self.key(plot, 0);
        let above = self.layer.entry(0, key.tx, key.ty).map_or(0.0, |entry| {
            // Over a round Earth the ground sinks away: what is far counts as level.
            let drop = 0.5 * self.curvature * across;
            let eye = self.eye_z + drop;
            (eye - f64::from(entry.max)).max(f64::from(entry.min) - eye).max(0.0)
        });
        (across + above * above).sqrt()
    }
}

/// Whether cells have ground, and the heights of their corners over the camera: south-west,
/// south-east, north-west, north-east.
#[inline(always)]
fn corners<L: Lanes>(
    tile: &HeightTile,
    eye_z: f64,
    cell: [L::I; 2],
    lanes: L::M,
) -> (L::M, [L::F; 4]) {
    let at = post::<L>(cell);
    let north = at + L::I::splat(TILE_POSTS as i32);
    match tile.heights() {
        Heights::Codes(codes) => {
            let base = L::F::splat((f64::from(codes.base) * codes.step - eye_z) as f32);
            let step = L::F::splat(codes.step as f32);
            let (low, sixteen) = (L::I::splat(0xFFFF), L::I::splat(16));
            let south = L::I::gather_pairs(codes.posts, at, lanes);
            let north = L::I::gather_pairs(codes.posts, north, lanes);
            let (sw, se) = (south & low, south.shr(sixteen) & low);
            let (nw, ne) = (north & low, north.shr(sixteen) & low);
            let there = sw.max(se).max(nw.max(ne)).lt(L::I::splat(i32::from(VOID)));
            let heights = [
                base + sw.to_floats() * step,
                base + se.to_floats() * step,
                base + nw.to_floats() * step,
                base + ne.to_floats() * step,
            ];
            (there, heights)
        }
        Heights::Floats(floats) => {
            let posts = as_bits(floats.posts);
            let high = eye_z as f32;
            let eye = [L::F::splat(high), L::F::splat((eye_z - f64::from(high)) as f32)];
            let one = L::I::splat(1);
            let [sw, se, nw, ne] = [
                L::I::gather(posts, at, lanes),
                L::I::gather(posts, at + one, lanes),
                L::I::gather(posts, north, lanes),
                L::I::gather(posts, north + one, lanes),
            ];
            let heights = [
                L::F::from_bits(sw) - eye[0] - eye[1],
                L::F::from_bits(se) - eye[0] - eye[1],
                L::F::from_bits(nw) - eye[0] - eye[1],
                L::F::from_bits(ne) - eye[0] - eye[1],
            ];
            // A void is NaN, and so is any sum with it.
            let sum = heights[0] + heights[1] + heights[2] + heights[3];
            (sum.eq(sum), heights)
        }
    }
}
