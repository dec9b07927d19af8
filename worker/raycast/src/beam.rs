//! Beams: how far all rays through a square of pixels are free, found once for all.
//!
//! ```text
//! square <- 64 x 64 pixels; free <- 0
//! loop
//!   ground <- the rectangle of the map below the beam from `free` to `free + step`
//!   if the beam's lowest ray stays above the maximum of the ground
//!     free <- free + step; double the step
//!   else if the step is longer than the beam is wide
//!     halve the step
//!   else
//!     stop: quarter the square and go on with each part, or cast its rays from `free`
//! ```
//!
//! Beams leave out ground, they never decide on a contact: the bounds below are loose on
//! the safe side by [`CLEARANCE_M`], so no ray meets a cell before the beam's `free`, and
//! a caster that begins there finds what it would have found from the camera on.
//!
//! All lengths along a beam are *depths*: multiples t of [`Camera::ray`], which is linear
//! in the pixel. So the bounds of the directions in a square are those at its corners.
//! Height grows both with the square of the map distance and with the straight rise (see
//! `path`), so it is bounded from below over an interval of depths by the least of both.

mod abreast;

use crate::exact::{Globe, Tiles};
use crate::field::{Cursor, Field, Ground, tile_key};
use crate::grid::cells_of;
use crate::lanes;
use crate::path;
use crate::pyramid::Pyramid;
use abreast::{Layer, Narrow, Squares};
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;
use terrafarm_terrain::layout::{LayerKind, TILE_CELLS};
use terrafarm_terrain::tile::MAXIMA_LEVELS;

/// Side of the squares that beams begin with, pixels.
pub(crate) const WIDEST_PX: u32 = 64;
/// Side of the squares whose rays are cast one by one, pixels.
const NARROWEST_PX: u32 = 8;
/// How far above the ground a beam must stay, metres. The parabolas of a path are within
/// 1e-4 m of the curve that beams follow, rounding is far less.
const CLEARANCE_M: f64 = 1e-2;
/// Share by which lengths and cells are widened against rounding.
const ROUNDING: f64 = 1e-9;
/// The first step of a beam, as a share of the side of the largest layer.
const FIRST_STEP: f64 = 0.125;
/// The shortest step, in widths of the beam.
const SHORTEST_STEP: f64 = 1.0;
/// The longest way of a beam over flat ground, metres.
const FLAT_REACH_M: f64 = 1e8;
/// The same over the Earth, radians: within what `path` is made for.
const REACH_RAD: f64 = 0.19;

/// The beams of one view.
pub(crate) struct Beams<'a> {
    field: Field<'a>,
    camera: &'a Camera,
    ground: path::Ground,
    layers: Vec<Grid>,
    tiles: Cursor<'a>,
    first_step: f64,
    /// Room to be kept above the ground, metres for each metre away.
    slack: f64,
    /// The only height layer, if there is but one.
    only: Option<Layer<'a>>,
    squares: Squares,
    /// Intervals of depth looked at.
    pub steps: u64,
}

/// A height layer.
struct Grid {
    number: usize,
    /// Position of the camera, in cells from post (0, 0).
    eye: [f64; 2],
    /// Cells per metre.
    scale: [f64; 2],
    cells: [i32; 2],
}

/// A beam that is free up to a depth.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Front {
    pub free: f64,
    step: f64,
}

/// Bounds of the directions in a square.
struct Bounds {
    low: DVec3,
    high: DVec3,
    /// Least squared length of their parts along the map.
    across_squared: f64,
    /// The depth to which the bounds hold.
    reach: f64,
    /// Length of the longest ray at depth 1.
    longest: f64,
    /// Width of the beam at depth 1.
    width: f64,
}

impl<'a> Beams<'a> {
    pub(crate) fn new(field: Field<'a>, camera: &'a Camera, ground: path::Ground) -> Self {
        Beams::with_slack(field, camera, ground, 0.0)
    }

    /// Beams over ground that may be higher than level 0 by so much for each metre away.
    pub(crate) fn with_slack(
        field: Field<'a>,
        camera: &'a Camera,
        ground: path::Ground,
        slack: f64,
    ) -> Self {
        let eye = camera.position;
        let mut first_step = 0.0f64;
        let layers = field.index().layers_of(LayerKind::Height).map(|(number, layer)| {
            let scale = layer.spacing.map(|spacing| 1.0 / spacing);
            let cells = cells_of(layer);
            for (count, spacing) in cells.into_iter().zip(layer.spacing) {
                // A step of 0 would never end: a single post counts as a cell.
                first_step = first_step.max(f64::from(count.max(1)) * spacing * FIRST_STEP);
            }
            let eye = [0, 1].map(|axis| (eye[axis] - layer.origin[axis]) * scale[axis]);
            Grid { number, eye, scale, cells }
        });
        let layers: Vec<Grid> = layers.collect();
        let only = match &layers[..] {
            [grid] if !grid.cells.contains(&0) => Some(Layer {
                camera,
                globe: (ground.curvature() != 0.0).then(|| Globe::new(&ground, eye.z)),
                eye: grid.eye,
                scale: grid.scale,
                cells: grid.cells,
                highest: field.pyramid.highest(),
                finest_step: 1.0 / grid.scale[0].max(grid.scale[1]),
                slack,
                tiles: Tiles::new(field, grid.number),
            }),
            _ => None,
        };
        let (tiles, squares) = (Cursor::new(field), Squares::new());
        Beams { field, camera, ground, layers, tiles, first_step, slack, only, squares, steps: 0 }
    }

    /// Cuts a square of pixels into parts that have no side longer than [`NARROWEST_PX`],
    /// and calls `see` for each with the depth up to which every ray through it is free.
    pub(crate) fn narrow(&mut self, square: Region, see: &mut impl FnMut(Region, f64)) {
        let front = Front { free: 0.0, step: self.first_step };
        if self.only.is_none() {
            return self.quarter(square, WIDEST_PX, front, see);
        }
        let front = self.advance(&self.bounds(square), front);
        let Some(layer) = &mut self.only else { return };
        // Quarters are counted from the corner of the square, which a region may cut.
        let squares = &mut self.squares;
        squares.set(square.x, square.y, front.free, front.step);
        let narrow = Narrow { layer, region: square, squares };
        self.steps += lanes::run(narrow, lanes::widest());
        let (right, bottom) = (square.x + square.width, square.y + square.height);
        for at in 0..self.squares.count {
            let (x, y) = (self.squares.left[at] as u32, self.squares.top[at] as u32);
            let (width, height) = (NARROWEST_PX.min(right - x), NARROWEST_PX.min(bottom - y));
            see(Region { x, y, width, height }, self.squares.free[at]);
        }
    }

    fn quarter(
        &mut self,
        square: Region,
        side: u32,
        front: Front,
        see: &mut impl FnMut(Region, f64),
    ) {
        let front = self.advance(&self.bounds(square), front);
        let Region { x, y, width, height } = square;
        if side <= NARROWEST_PX {
            return see(square, front.free);
        }
        let half = side / 2;
        let halves = |length: u32| [(0, length.min(half)), (half, length.saturating_sub(half))];
        for (top, height) in halves(height).into_iter().filter(|part| part.1 > 0) {
            for (left, width) in halves(width).into_iter().filter(|part| part.1 > 0) {
                let part = Region { x: x + left, y: y + top, width, height };
                self.quarter(part, half, front, see);
            }
        }
    }

    /// Bounds of the rays through all points of a square of pixels.
    fn bounds(&self, square: Region) -> Bounds {
        let camera = self.camera;
        let left_top = [f64::from(square.x), f64::from(square.y)];
        let right_bottom =
            [left_top[0] + f64::from(square.width), left_top[1] + f64::from(square.height)];
        let corners = [
            camera.ray(left_top[0], left_top[1]),
            camera.ray(right_bottom[0], left_top[1]),
            camera.ray(left_top[0], right_bottom[1]),
            camera.ray(right_bottom[0], right_bottom[1]),
        ];
        let (mut low, mut high) = (corners[0], corners[0]);
        let mut longest = 0.0f64;
        for corner in corners {
            (low, high) = (low.min(corner), high.max(corner));
            longest = longest.max(corner.length_squared());
        }
        let margin = DVec3::splat(longest * ROUNDING);
        (low, high) = (low - margin, high + margin);
        let nearest = |axis: usize| low[axis].max(-high[axis]).max(0.0);
        let curvature = self.ground.curvature();
        let longest = longest.sqrt();
        Bounds {
            low,
            high,
            across_squared: nearest(0) * nearest(0) + nearest(1) * nearest(1),
            reach: if curvature > 0.0 {
                REACH_RAD / (curvature * longest)
            } else {
                FLAT_REACH_M / longest
            },
            longest,
            width: f64::from(square.width.max(square.height)) / camera.focal_px(),
        }
    }

    /// Where every beam begins.
    pub(crate) fn start(&self) -> Front {
        Front { free: 0.0, step: self.first_step }
    }

    /// Goes on with the beam of a square of pixels, from where one that holds the square
    /// is known to be free. `free` is infinite if no ray of it meets the ground.
    pub(crate) fn follow(&mut self, square: Region, front: Front) -> Front {
        self.advance(&self.bounds(square), front)
    }

    fn advance(&mut self, bounds: &Bounds, mut front: Front) -> Front {
        let eye_z = self.camera.position.z;
        loop {
            let Front { free, step } = front;
            if free >= bounds.reach {
                return front;
            }
            self.steps += 1;
            let end = (free + step).min(bounds.reach);
            let rise = (bounds.low.z * free).min(bounds.low.z * end);
            let z = eye_z + self.ground.rise(eye_z, bounds.across_squared * free * free, rise);
            let lowest = z - CLEARANCE_M - self.slack * end * bounds.longest;
            if bounds.low.z >= 0.0 && lowest > self.field.pyramid.highest() {
                return Front { free: f64::INFINITY, step };
            }
            if self.is_clear(bounds, free, end, lowest) {
                front = Front { free: end, step: 2.0 * step };
            } else if step > bounds.width * end * SHORTEST_STEP + self.finest_step() {
                front.step = 0.5 * step;
            } else {
                return front;
            }
        }
    }

    fn finest_step(&self) -> f64 {
        self.layers.iter().map(|grid| 1.0 / grid.scale[0]).fold(f64::INFINITY, f64::min)
    }

    /// Whether all ground below a beam from depth `start` to `end` is lower than `lowest`.
    fn is_clear(&mut self, bounds: &Bounds, start: f64, end: f64, lowest: f64) -> bool {
        let pyramid = self.field.pyramid;
        let tiles = &mut self.tiles;
        self.layers.iter().all(|grid| {
            let mut first = [0; 2];
            let mut last = [0; 2];
            for axis in 0..2 {
                let (slow, fast) = (bounds.low[axis], bounds.high[axis]);
                let low = grid.eye[axis] + grid.scale[axis] * (slow * start).min(slow * end);
                let high = grid.eye[axis] + grid.scale[axis] * (fast * start).max(fast * end);
                let count = f64::from(grid.cells[axis]);
                let margin = ROUNDING * (1.0 + count + low.abs().max(high.abs()));
                if high + margin < 0.0 || low - margin > count {
                    return true;
                }
                first[axis] = ((low - margin) as i32).max(0);
                last[axis] = ((high + margin) as i32).min(grid.cells[axis] - 1);
            }
            grid.is_below(pyramid, tiles, first, last, lowest)
        })
    }
}

impl Grid {
    /// Whether the cells from `first` to `last` are lower than `lowest`: by at most four
    /// blocks that cover them.
    fn is_below(
        &self,
        pyramid: &Pyramid,
        tiles: &mut Cursor,
        first: [i32; 2],
        last: [i32; 2],
        lowest: f64,
    ) -> bool {
        if self.cells.contains(&0) {
            return true;
        }
        let maxima = pyramid.layer(self.number);
        let side = (last[0] - first[0]).max(last[1] - first[1]).max(1) as u32;
        let level = (side.ilog2() as usize + usize::from(!side.is_power_of_two())).max(1);
        let level = level.min(maxima.top());
        let [west, south] = first.map(|cell| cell >> level);
        let [east, north] = last.map(|cell| cell >> level);
        for bj in south..=north {
            for bi in west..=east {
                let max = if level >= MAXIMA_LEVELS {
                    maxima.block_max(level, bi as usize, bj as usize)
                } else {
                    let cell = [bi << level, bj << level];
                    let tile = |index: i32| index as usize >> MAXIMA_LEVELS;
                    match tiles.ground(tile_key(self.number, cell)) {
                        Ground::Loaded(loaded) => {
                            let within = |index: i32| (index as usize & (TILE_CELLS - 1)) >> level;
                            loaded.block_max(level, within(cell[0]), within(cell[1]))
                        }
                        Ground::Void => f32::NEG_INFINITY,
                        Ground::Absent => {
                            maxima.block_max(MAXIMA_LEVELS, tile(cell[0]), tile(cell[1]))
                        }
                    }
                };
                if f64::from(max) >= lowest {
                    return false;
                }
            }
        }
        true
    }
}

#[cfg(test)]
mod tests;
