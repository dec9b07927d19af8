//! The macro map: everything that must be known of the whole terrain before any part of
//! it can be drawn.

use crate::erode::{Tectonics, mountains};
use crate::flow::Flow;
use crate::grid::Grid;
use crate::valley::{Rivers, dam, deposit, lakes, reach_of_lakes};
use crate::{Cancelled, MACRO_SIDE, SynthSpec, Watch};

/// Height of the lowest valley, metres.
const BASE_M: f32 = 480.0;
/// Relief of a terrain of [`FULL_EXTENT_M`] or more, metres.
const FULL_RELIEF_M: f32 = 2350.0;
const FULL_EXTENT_M: f32 = 30_000.0;

/// The macro map of one terrain. All grids have one cell per `cell_m`.
pub(crate) struct Landscape {
    /// Size of a cell, metres.
    pub cell_m: f32,
    /// Heights of the ground, metres; lake beds under lakes.
    pub heights: Grid,
    /// Level of the lake over or beside each cell, metres; minus infinity elsewhere.
    pub level: Grid,
    /// Share of the cell that is gravel floor or fan, 0..1.
    pub floor: Grid,
    /// Height above the mean of the surroundings, metres.
    pub openness: Grid,
    /// The rivers.
    pub rivers: Rivers,
    /// Relief over the full relief: 1 for a terrain of [`FULL_EXTENT_M`].
    pub relief: f32,
}

impl Landscape {
    /// Shapes the map.
    pub fn new(spec: &SynthSpec, watch: &Watch<'_>) -> Result<Landscape, Cancelled> {
        let cells = (spec.posts as usize - 1).next_power_of_two().clamp(128, MACRO_SIDE - 1);
        let side = cells + 1;
        let extent_m = spec.extent_m() as f32;
        let cell_m = extent_m / cells as f32;
        let tectonics = Tectonics::new(spec.seed, extent_m);
        let mut heights = mountains(&tectonics, side, watch)?;
        let relief = (extent_m / FULL_EXTENT_M).sqrt().clamp(0.0, 1.0);
        normalise(&mut heights, relief);

        let outlets = tectonics.outlets(side);
        let flow = Flow::new(&heights, &outlets, tectonics.sway());
        let deposited = deposit(&heights, &flow, cell_m, relief);
        let (mut heights, floor) = (deposited.heights, deposited.floor);
        watch.check()?;
        let flow = Flow::new(&heights, &outlets, tectonics.sway());
        dam(&mut heights, &flow, cell_m, relief);
        watch.check()?;
        let flow = Flow::new(&heights, &outlets, tectonics.sway());
        let level = lakes(&mut heights, &flow);
        let rivers = Rivers::new(&flow, &heights, cell_m);
        watch.check()?;

        let mut mean = heights.clone();
        for _ in 0..6 {
            mean = mean.smoothed();
        }
        let openness = Grid::from_fn(side, |x, y| {
            heights.at(x as i64, y as i64) - mean.at(x as i64, y as i64)
        });
        let level = reach_of_lakes(&level, &heights);
        Ok(Landscape { cell_m, heights, level, floor, openness, rivers, relief })
    }
}

/// Stretches heights to the relief that the extent asks for, between the lowest cell and
/// the height that one cell in 500 exceeds.
fn normalise(heights: &mut Grid, relief: f32) {
    let mut sorted = heights.values().to_vec();
    let high_place = sorted.len() - 1 - sorted.len() / 500;
    let (_, &mut high, _) = sorted.select_nth_unstable_by(high_place, f32::total_cmp);
    let (low, _) = heights.range();
    let stretch = relief * FULL_RELIEF_M / (high - low).max(1.0);
    heights.values_mut().iter_mut().for_each(|h| *h = BASE_M + (*h - low) * stretch);
}
