//! Mountains from uplift and rivers: the stream-power law, from a coarse grid to a fine.
//!
//! Rock rises at a rate that varies over the map; each cell is cut down towards its
//! receiver at a rate of slope times the square root of the area it drains. The step is
//! implicit (Braun and Willett 2013): receivers come first, so one pass over the cells
//! solves it for any length of step. Slopes steeper than the rock holds slide.
//!
//! Valleys form on a grid of a few dozen cells and are refined: each level doubles the
//! grid, and needs fewer steps than the one before.

use crate::flow::Flow;
use crate::grid::Grid;
use crate::noise::{Noise, mix, smoothstep};
use crate::{Cancelled, Watch};
use rayon::prelude::*;

/// Cells along a side of the coarsest grid, less one.
const COARSEST: usize = 64;
/// Steps at the coarsest grid; each finer one has [`STEP_SHARE`] of those before it.
const STEPS_COARSEST: f32 = 60.0;
const STEP_SHARE: f32 = 0.62;
/// Uplift over erodibility, metres: the slope of a valley that drains 1 m²; a valley that
/// drains 1 km² has a thousandth of it.
const STEEPNESS_M: f32 = 300.0;
/// Where less than this drains, soil creeps and no river cuts, km². It sets how far apart
/// valleys are.
const HILLSLOPE_KM2: f32 = 0.7;
/// How far soil creeps between two steps, metres.
const CREEP_M: f32 = 220.0;
/// Time step; erodibility is 1.
const STEP: f32 = 1.0;

/// What shapes the mountains of one terrain, as functions of the place (0..1 along x, y).
pub(crate) struct Tectonics {
    seed: u64,
    extent_m: f32,
    /// Outlets: places on the border and their heights, metres.
    outlets: Vec<([f32; 2], f32)>,
    axis: [f32; 2],
}

impl Tectonics {
    /// The tectonics of a seed for a terrain of so many metres a side.
    pub fn new(seed: u64, extent_m: f32) -> Self {
        let dice = Noise::new(seed, 1);
        let count = 5 + (dice.uniform(0, 0) * 3.0) as i64;
        let turn = dice.uniform(0, 3);
        let outlets = (0..count).map(|k| {
            let jitter = 0.6 * (dice.uniform(1, k) - 0.5);
            let along = 4.0 * (turn + (k as f32 + 0.5 + jitter) / count as f32);
            let along = along - (along * 0.25).floor() * 4.0;
            let t = along - along.floor();
            let place = match along as u32 {
                0 => [t, 0.0],
                1 => [1.0, t],
                2 => [1.0 - t, 1.0],
                _ => [0.0, 1.0 - t],
            };
            (place, 150.0 * dice.uniform(2, k) * (extent_m / 32_000.0).min(1.5))
        });
        let outlets = outlets.collect();
        let lean = 2.0 * dice.uniform(0, 5) - 1.0;
        let axis = if dice.uniform(0, 6) < 0.5 { [1.0, lean] } else { [lean, 1.0] };
        Tectonics { seed, extent_m, outlets, axis }
    }

    /// Rate of uplift, 0..1.
    fn uplift(&self, x: f32, y: f32) -> f32 {
        let scale = f64::from(self.extent_m / 24_000.0).max(0.4);
        let noise = Noise::new(self.seed, 2);
        let (px, py) = (f64::from(x) * scale, f64::from(y) * scale);
        let bend = 0.22 * noise.fbm(px * 1.3 + 5.0, py * 1.3, 3);
        let [ax, ay] = self.axis;
        let across = ((y - 0.5) * ax - (x - 0.5) * ay) / (ax * ax + ay * ay).sqrt();
        let belt = 1.0 - smoothstep(0.05, 0.62, (across + bend).abs());
        let blocks = 0.5 + 0.5 * noise.fbm(px * 2.6, py * 2.6 + 9.0, 3);
        (0.16 + 0.84 * belt) * mix(0.45, 1.25, blocks.clamp(0.0, 1.0))
    }

    /// The steepest slope that the rock of a place holds.
    fn repose(&self, x: f32, y: f32) -> f32 {
        let scale = f64::from(self.extent_m / 3_000.0);
        let noise = Noise::new(self.seed, 3);
        let hard = noise.fbm(f64::from(x) * scale, f64::from(y) * scale, 4);
        (0.52 + 0.32 * hard).clamp(0.26, 1.05)
    }

    fn outlet_cells(&self, side: usize) -> Vec<(u32, f32)> {
        let last = (side - 1) as f32;
        let cell = |[x, y]: [f32; 2]| {
            ((y * last + 0.5) as usize * side + (x * last + 0.5) as usize) as u32
        };
        self.outlets.iter().map(|&(place, height)| (cell(place), height)).collect()
    }

    /// The cells of a grid through which water leaves the map.
    pub fn outlets(&self, side: usize) -> Vec<u32> {
        self.outlet_cells(side).into_iter().map(|(cell, _)| cell).collect()
    }

    /// How much a cell prefers one of its neighbours: see [`Flow::new`].
    pub fn sway(&self) -> impl Fn(usize, usize) -> f32 + Sync + use<> {
        let noise = Noise::new(self.seed, 4);
        move |cell, direction| 0.7 + 0.6 * noise.uniform(cell as i64, direction as i64)
    }
}

/// Heights of mountains on a grid of `side` cells (2^k + 1), metres above the lowest
/// outlet, every cell on a slope that leads to an outlet or into a shallow pit.
pub(crate) fn mountains(
    tectonics: &Tectonics,
    side: usize,
    watch: &Watch<'_>,
) -> Result<Grid, Cancelled> {
    let mut level_side = COARSEST.min(side - 1) + 1;
    let start = Noise::new(tectonics.seed, 5);
    let mut heights = Grid::from_fn(level_side, |x, y| {
        let at = |v: usize| v as f64 * (12.0 / COARSEST as f64);
        60.0 + 50.0 * start.fbm(at(x), at(y), 5)
    });
    let mut steps = STEPS_COARSEST;
    loop {
        let ratio = (level_side - 1) as f32 / (side - 1) as f32;
        let share = 0.75 * ratio * ratio;
        erode(tectonics, &mut heights, steps as usize, watch, share)?;
        if level_side == side {
            return Ok(heights);
        }
        level_side = 2 * level_side - 1;
        steps = (steps * STEP_SHARE).max(6.0);
        heights = refined(&heights, level_side, &start);
    }
}

/// The grid at twice the resolution. Places are shifted a little, so that valleys that
/// followed the coarse grid's directions wind.
fn refined(coarse: &Grid, side: usize, noise: &Noise) -> Grid {
    Grid::from_fn(side, |x, y| {
        let (u, v) = (x as f64 * 0.5, y as f64 * 0.5);
        let shift_x = 0.55 * noise.at(u * 0.31 + 3.0, v * 0.31);
        let shift_y = 0.55 * noise.at(u * 0.31, v * 0.31 + 7.0);
        coarse.bilinear(u + f64::from(shift_x), v + f64::from(shift_y))
    })
}

fn erode(
    tectonics: &Tectonics,
    heights: &mut Grid,
    steps: usize,
    watch: &Watch<'_>,
    share: f32,
) -> Result<(), Cancelled> {
    let side = heights.side();
    let cell_m = tectonics.extent_m / (side - 1) as f32;
    let place = |v: usize| v as f32 / (side - 1) as f32;
    let uplift = Grid::from_fn(side, |x, y| tectonics.uplift(place(x), place(y)));
    let repose = Grid::from_fn(side, |x, y| tectonics.repose(place(x), place(y)) * cell_m);
    let outlets = tectonics.outlet_cells(side);
    let outlet_cells = tectonics.outlets(side);
    let hillslope = HILLSLOPE_KM2 * 1e6 / (cell_m * cell_m);
    let creeps = ((CREEP_M / cell_m) as usize).clamp(1, 8);
    for &(cell, height) in &outlets {
        heights.values_mut()[cell as usize] = height;
    }
    for _ in 0..steps {
        watch.check()?;
        let flow = Flow::new(heights, &outlet_cells, tectonics.sway());
        incise(heights, &flow, &uplift, &repose, hillslope);
        for _ in 0..creeps {
            creep(heights, &flow, &outlet_cells, hillslope);
        }
        watch.advance(share / steps as f32);
    }
    Ok(())
}

/// One implicit step of uplift, incision and sliding.
fn incise(heights: &mut Grid, flow: &Flow, uplift: &Grid, repose: &Grid, hillslope: f32) {
    let values = heights.values_mut();
    for &cell in &flow.order {
        let cell = cell as usize;
        let receiver = flow.receiver[cell] as usize;
        if receiver == cell {
            continue;
        }
        let base = values[receiver];
        let raised = values[cell] + STEP * STEEPNESS_M * uplift.values()[cell];
        // In cells: sqrt(area) * cell / (distance * cell).
        let area = flow.area[cell];
        let channel = area / (area + hillslope);
        let pull = STEP * channel * area.sqrt() / flow.distance[cell];
        let cut = if raised > base { (raised + pull * base) / (1.0 + pull) } else { raised };
        values[cell] = cut.min(base + repose.values()[cell] * flow.distance[cell]);
    }
}

/// Soil creep rounds what is not a channel.
fn creep(heights: &mut Grid, flow: &Flow, outlets: &[u32], hillslope: f32) {
    let before = heights.clone();
    let side = before.side();
    heights.values_mut().par_chunks_mut(side).enumerate().for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            let (cx, cy) = (x as i64, y as i64);
            let mean = 0.25
                * (before.at(cx - 1, cy)
                    + before.at(cx + 1, cy)
                    + before.at(cx, cy - 1)
                    + before.at(cx, cy + 1));
            let share = 0.5 / (1.0 + 4.0 * flow.area[y * side + x] / hillslope);
            *value += share * (mean - *value);
        }
    });
    for &cell in outlets {
        heights.values_mut()[cell as usize] = before.values()[cell as usize];
    }
}
