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
//! On the way from one level to the next a plot is seen at a mean of both (`patch`), which
//! keeps the same bound, so that it changes little by little as the camera moves.
//!
//! Where the tile of a plot is not loaded, a picture that can wait leaves the plot open and
//! names the tile. One that cannot ([`Lack::Coarser`]) sees the plot at the finest coarser
//! level whose tile is loaded: where the ground of level 0 is, that of every coarser level
//! is, too, so there is no hole. Such plots are counted. Where no more than the coarser tile
//! of a mean is not loaded, it sees the finer one as it is.

mod patch;
pub(crate) mod patches;
mod posts;

pub(crate) use posts::{Kept, Loaded};

use crate::View;
use crate::field::Field;
use crate::grid::cells_of;
use crate::lanes::{Floats, Ints, Lanes, MOST, Mask};
use crate::path::Ground;
use patch::Patch;
use patches::{Blend, Patches};
use std::cell::{Cell, OnceCell, RefCell};
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;
use terrafarm_terrain::layout::{Layer, LayerKind, TILE_CELLS, TileKey};
use terrafarm_terrain::resident::Lookup;
use terrafarm_terrain::tile::MAXIMA_LEVELS;

/// Plots that are known together: of large stores only a few are ever asked for.
const GROUP: usize = 64;

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
    /// By number, [`GROUP`] at a time.
    known: Vec<OnceCell<Group<'a>>>,
    patches: &'a Patches,
    wanted: RefCell<Vec<TileKey>>,
    /// Some plot is seen at a coarser level than it should be.
    any_coarser: Cell<bool>,
}

/// Plots, those known that rays have come to.
type Group<'a> = Box<[OnceCell<Plot<'a>>; GROUP]>;

/// How a plot is seen.
#[derive(Clone)]
pub(crate) struct Plot<'a> {
    pub ground: Soil<'a>,
    /// Level, 0 the finest.
    pub level: u32,
    /// That level is coarser than it should be, for want of a tile.
    coarser: bool,
}

/// What is under a plot.
#[derive(Clone)]
pub(crate) enum Soil<'a> {
    Loaded(Loaded<'a>),
    /// Nothing to hit.
    Void,
    /// Not loaded.
    Absent,
}

/// The surface under N places, which is bilinear within a cell.
pub(crate) struct Surface<L: Lanes> {
    /// Whether there is any, and whether that is unknown for lack of a tile.
    pub solid: L::M,
    pub absent: L::M,
    /// Height over the camera, metres.
    pub height: L::F,
    /// Slopes along x and y.
    pub slopes: [L::F; 2],
    /// Where in its cell a place is along x and y, from 0 to 1 ...
    pub part: [L::F; 2],
    /// ... and by how much that grows, per metre.
    pub pace: [L::F; 2],
    /// How much more the cell rises along one side than along the other, metres.
    pub twist: L::F,
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
        let groups = (plots[0] as usize * plots[1] as usize).div_ceil(GROUP);
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
            known: std::iter::repeat_with(OnceCell::new).take(groups).collect(),
            patches: field.pyramid.patches(),
            wanted: RefCell::default(),
            any_coarser: Cell::new(false),
        }
    }

    /// The plot with a number: `row * plots[0] + column`.
    #[inline]
    pub(crate) fn plot(&self, number: i32) -> &Plot<'a> {
        let (group, place) = (number as usize / GROUP, number as usize % GROUP);
        let group = self.known[group].get_or_init(|| Box::new([const { OnceCell::new() }; GROUP]));
        group[place].get_or_init(|| self.meet(number))
    }

    /// The surface under places on the map, metres from the camera.
    #[inline(always)]
    pub(crate) fn surface<L: Lanes>(&self, place: [L::F; 2], lanes: L::M) -> Surface<L> {
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
        let mut found = Surface {
            solid: L::M::none(),
            absent: L::M::none(),
            height: zero,
            slopes: [zero; 2],
            part: [zero; 2],
            pace: [zero; 2],
            twist: zero,
        };
        let mut left = lanes & inside;
        let mut numbers = [0; MOST];
        plots.store(&mut numbers);
        while left.any() {
            let number = numbers[left.bits().trailing_zeros() as usize % MOST];
            let here = left & plots.eq(L::I::splat(number));
            left = left & !here;
            let plot = self.plot(number);
            let loaded = match &plot.ground {
                Soil::Loaded(loaded) => loaded,
                Soil::Void => continue,
                Soil::Absent => {
                    found.absent = found.absent | here;
                    continue;
                }
            };
            let base = L::I::splat(plot.level as i32);
            let shrink = 1.0 / (1u32 << plot.level) as f32;
            let (i, j) = (cell_x.shr(base), cell_y.shr(base));
            let corner_x = (i.shl(base) - L::I::splat(self.eye_cell[0])).to_floats();
            let corner_y = (j.shl(base) - L::I::splat(self.eye_cell[1])).to_floats();
            let side = L::F::splat(shrink);
            let part = [(x - corner_x) * side, (y - corner_y) * side];
            let (there, [sw, se, nw, ne]) = loaded.posts().corners::<L>(self.eye_z, [i, j], here);
            let (south, north) = (se - sw, ne - nw);
            let (low, high) = (sw + south * part[0], nw + north * part[0]);
            let pace = [L::F::splat(shrink * scale[0]), L::F::splat(shrink * scale[1])];
            let twist = north - south;
            let height = low + (high - low) * part[1];
            found.height = L::F::select(here, height, found.height);
            found.twist = L::F::select(here, twist, found.twist);
            let slopes = [(south + twist * part[1]) * pace[0], (high - low) * pace[1]];
            for axis in 0..2 {
                found.slopes[axis] = L::F::select(here, slopes[axis], found.slopes[axis]);
                found.part[axis] = L::F::select(here, part[axis], found.part[axis]);
                found.pace[axis] = L::F::select(here, pace[axis], found.pace[axis]);
            }
            found.solid = found.solid | (here & there);
        }
        found
    }

    /// Tiles that were needed but not loaded, sorted, each once.
    pub(crate) fn wanted(&self) -> Vec<TileKey> {
        let mut wanted = self.wanted.borrow().clone();
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
        if !self.any_coarser.get() {
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
        let (level, weight) = self.level(at);
        let mut plot = Plot { ground: Soil::Void, level: level as u32, coarser: false };
        let finest = self.layer.entry(0, at[0] as u32, at[1] as u32);
        if finest.is_none_or(|entry| entry.is_empty()) {
            return plot;
        }
        plot.ground = self.soil(self.key(at, level));
        if weight > 0 {
            self.blend(number, &mut plot, weight);
        }
        if matches!(plot.ground, Soil::Absent) && self.lack == Lack::Coarser {
            plot = self.coarser(at, level).unwrap_or(plot);
            self.any_coarser.set(self.any_coarser.get() | plot.coarser);
        }
        plot
    }

    /// Blends a plot with the next coarser level. Where its tile is not loaded, the plot
    /// stays open, or as it is.
    fn blend(&self, number: i32, plot: &mut Plot<'a>, weight: u32) {
        let at = [number % self.plots[0], number / self.plots[0]];
        let coarse = self.soil(self.key(at, plot.level as usize + 1));
        let Soil::Loaded(own) = &mut plot.ground else { return };
        match coarse {
            Soil::Loaded(coarse) => {
                let blend = Blend { plot: number, level: plot.level, weight };
                let make = || Patch::new(at, plot.level, weight, own.tile, coarse.tile);
                own.patch = Some(self.patches.get(blend, make));
            }
            Soil::Absent if self.lack == Lack::Open => plot.ground = Soil::Absent,
            Soil::Absent | Soil::Void => {}
        }
    }

    /// What is loaded of a tile, which is wanted if it is not.
    fn soil(&self, key: TileKey) -> Soil<'a> {
        let soil = self.at_hand(key);
        if matches!(soil, Soil::Absent) {
            self.wanted.borrow_mut().push(key);
        }
        soil
    }

    fn at_hand(&self, key: TileKey) -> Soil<'a> {
        self.field.resident.touch(key);
        match self.field.resident.height(key) {
            Lookup::Found(tile) => Soil::Loaded(Loaded { tile, patch: None }),
            Lookup::Empty => Soil::Void,
            Lookup::Absent => Soil::Absent,
        }
    }

    /// A plot at the finest of the levels coarser than this one whose tile is loaded.
    fn coarser(&self, plot: [i32; 2], level: usize) -> Option<Plot<'a>> {
        (level + 1..=self.layer.root_level()).find_map(|level| {
            let ground = self.at_hand(self.key(plot, level));
            let loaded = matches!(ground, Soil::Loaded(_));
            loaded.then_some(Plot { ground, level: level as u32, coarser: true })
        })
    }

    /// The tile of a level that a plot lies in.
    fn key(&self, plot: [i32; 2], level: usize) -> TileKey {
        let [tx, ty] = plot.map(|at| (at as u32) >> level);
        TileKey { layer: self.number as u16, level: level as u16, tx, ty }
    }

    /// The level at which a plot is seen, and the weight of the next coarser one.
    fn level(&self, plot: [i32; 2]) -> (usize, u32) {
        let allowed = self.tolerance * self.distance(plot);
        let entry = |level: usize| {
            let key = self.key(plot, level);
            self.layer.entry(level, key.tx, key.ty)
        };
        let fits = |&level: &usize| {
            entry(level).is_some_and(|entry| f64::from(entry.deviation) <= allowed)
        };
        let root = self.layer.root_level();
        let level = (1..=root).take_while(fits).last().unwrap_or(0);
        let pair = entry(level).zip((level < root).then(|| entry(level + 1)).flatten());
        let weight = pair.map_or(0, |(fine, coarse)| {
            let extent = f64::from(fine.max.max(coarse.max)) - f64::from(fine.min.min(coarse.min));
            let deviations = [fine.deviation, coarse.deviation].map(f64::from);
            patch::weight(allowed, deviations, extent)
        });
        (level, weight)
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

#[cfg(test)]
mod tests;
