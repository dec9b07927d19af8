//! The surface that the fast methods see: for each place the coarsest level that is
//! within the tolerance.
//!
//! The ground is cut into *plots*, the squares of the tiles of level 0. A plot is seen at
//! one level: the coarsest whose deviation from level 0 (stored with each tile, an upper
//! bound) is at most `tolerance_px * distance / focal_px` at the point of the plot's box
//! that is closest to the camera. So no point of the surface is further than the tolerance
//! from level 0, in pixels across the line of sight. Which level a plot has depends on the
//! view alone, not on the ray.

use crate::View;
use crate::field::Field;
use crate::grid::cells_of;
use crate::path::Ground;
use std::cell::RefCell;
use terrafarm_terrain::layout::{Layer, LayerKind, TILE_CELLS, TileKey};
use terrafarm_terrain::resident::Lookup;
use terrafarm_terrain::tile::{HeightTile, MAXIMA_LEVELS};

/// The coarsest level of a plot: a plot then is one cell.
const COARSEST: usize = MAXIMA_LEVELS;
/// A plot that nobody has asked for yet.
const UNKNOWN: u32 = u32::MAX;

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
    known: RefCell<Known<'a>>,
}

/// The plots that rays have come to.
struct Known<'a> {
    /// By plot, row by row from the south-west, its place in `plots`.
    places: Vec<u32>,
    plots: Vec<Plot<'a>>,
    wanted: Vec<TileKey>,
}

/// How a plot is seen.
#[derive(Clone, Copy)]
pub(crate) struct Plot<'a> {
    pub ground: Soil<'a>,
    /// Level, 0 the finest.
    pub level: u32,
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
    pub(crate) fn new(field: Field<'a>, view: &View) -> Self {
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
        };
        Relief {
            field,
            number,
            layer,
            tolerance: view.quality.tolerance_px / camera.focal_px(),
            eye_cell: cell.map(|cell| cell as i32),
            eye_place: [0, 1].map(|axis| (place[axis] - cell[axis]) as f32),
            eye_z: camera.position.z,
            spacing: layer.spacing,
            cells,
            curvature: Ground::new(view.shading.earth).curvature(),
            plots,
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

    /// Tiles that were needed but not loaded, sorted, each once.
    pub(crate) fn wanted(&self) -> Vec<TileKey> {
        let mut wanted = self.known.borrow().wanted.clone();
        wanted.sort_unstable();
        wanted.dedup();
        wanted
    }

    #[cold]
    fn meet(&self, number: i32) -> Plot<'a> {
        let at = [number % self.plots[0], number / self.plots[0]];
        let level = self.level(at);
        let key = self.key(at, level);
        let finest = self.layer.entry(0, at[0] as u32, at[1] as u32);
        let ground = if finest.is_none_or(|entry| entry.is_empty()) {
            Soil::Void
        } else {
            self.field.resident.touch(key);
            match self.field.resident.height(key) {
                Lookup::Found(tile) => Soil::Tile(tile),
                Lookup::Empty => Soil::Void,
                Lookup::Absent => Soil::Absent,
            }
        };
        let plot = Plot { ground, level: level as u32 };
        let known = &mut *self.known.borrow_mut();
        if matches!(ground, Soil::Absent) {
            known.wanted.push(key);
        }
        known.places[number as usize] = known.plots.len() as u32;
        known.plots.push(plot);
        plot
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
        let last = COARSEST.min(self.layer.levels.len() - 1);
        (1..=last).take_while(fits).last().unwrap_or(0)
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
