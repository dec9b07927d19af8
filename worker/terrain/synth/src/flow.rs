//! Where water goes on a grid: a flood from the outlets gives every cell a receiver, an
//! order in which receivers come before donors, the level to which pits fill, and the
//! area that drains through each cell.
//!
//! The flood is a priority flood (Barnes, Lehman and Mulla 2014) with buckets in place
//! of a heap: O(cells) a pass. Within a bucket the order is first come, first served,
//! which sends water through flats the short way.

use crate::grid::Grid;
use rayon::prelude::*;

/// Number of buckets of the flood; the height range of a terrain is cut into so many.
const BUCKETS: usize = 1 << 15;
/// Marks the end of a chain, and a cell that the flood has not reached.
const NONE: u32 = u32::MAX;
/// The eight neighbours: columns, rows, distance in cells.
pub(crate) const NEIGHBOURS: [(isize, isize, f32); 8] = [
    (1, 0, 1.0),
    (0, 1, 1.0),
    (-1, 0, 1.0),
    (0, -1, 1.0),
    (1, 1, std::f32::consts::SQRT_2),
    (-1, 1, std::f32::consts::SQRT_2),
    (-1, -1, std::f32::consts::SQRT_2),
    (1, -1, std::f32::consts::SQRT_2),
];

/// The drainage of a grid of heights.
pub(crate) struct Flow {
    /// All cells, receivers before their donors.
    pub order: Vec<u32>,
    /// Where each cell drains to; an outlet drains to itself.
    pub receiver: Vec<u32>,
    /// Distance to the receiver, cells; 1 for an outlet.
    pub distance: Vec<f32>,
    /// Height after pits are filled to their spill point.
    pub filled: Vec<f32>,
    /// Number of cells that drain through each cell, itself included.
    pub area: Vec<f32>,
    rank: Vec<u32>,
}

impl Flow {
    /// The drainage of `heights` towards `outlets`. `roughness` of a cell, 0..1 per cell
    /// and direction, sways the choice between receivers of nearly equal slope: without
    /// it all valleys run in the eight directions of the grid.
    pub fn new(heights: &Grid, outlets: &[u32], sway: impl Fn(usize, usize) -> f32 + Sync) -> Self {
        let (order, filled) = flood(heights, outlets);
        let mut rank = vec![NONE; order.len()];
        for (place, &cell) in order.iter().enumerate() {
            rank[cell as usize] = place as u32;
        }
        let mut flow = Flow {
            receiver: vec![0; order.len()],
            distance: vec![1.0; order.len()],
            area: vec![1.0; order.len()],
            order,
            filled,
            rank,
        };
        flow.choose_receivers(heights, outlets, sway);
        for &cell in flow.order.iter().rev() {
            let receiver = flow.receiver[cell as usize];
            if receiver != cell {
                flow.area[receiver as usize] += flow.area[cell as usize];
            }
        }
        flow
    }

    /// Every cell drains to the steepest neighbour that the flood reached before it; there
    /// always is one, because the flood reached the cell from a neighbour.
    fn choose_receivers(
        &mut self,
        heights: &Grid,
        outlets: &[u32],
        sway: impl Fn(usize, usize) -> f32 + Sync,
    ) {
        let side = heights.side();
        let rank = &self.rank;
        let rows = self.receiver.par_chunks_mut(side).zip(self.distance.par_chunks_mut(side));
        rows.enumerate().for_each(|(y, (receivers, distances))| {
            for x in 0..side {
                let cell = y * side + x;
                let height = heights.values()[cell];
                let mut best = (f32::NEG_INFINITY, cell, 1.0);
                for (direction, &(dx, dy, distance)) in NEIGHBOURS.iter().enumerate() {
                    let (nx, ny) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
                    if nx >= side || ny >= side || rank[ny * side + nx] >= rank[cell] {
                        continue;
                    }
                    let drop = (height - heights.values()[ny * side + nx]) / distance;
                    let slope = if drop > 0.0 { drop * sway(cell, direction) } else { drop };
                    if slope > best.0 {
                        best = (slope, ny * side + nx, distance);
                    }
                }
                receivers[x] = best.1 as u32;
                distances[x] = best.2;
            }
        });
        for &outlet in outlets {
            self.receiver[outlet as usize] = outlet;
            self.distance[outlet as usize] = 1.0;
        }
    }
}

/// Floods a grid from its outlets, lowest first. Returns the cells in the order in which
/// the water reached them, and the level at which it stood.
fn flood(heights: &Grid, outlets: &[u32]) -> (Vec<u32>, Vec<f32>) {
    let side = heights.side();
    let values = heights.values();
    let (low, high) = heights.range();
    let scale = (BUCKETS - 1) as f32 / (high - low).max(1e-3);
    let bucket_of = |height: f32| ((height - low) * scale) as usize;
    let mut first = vec![NONE; BUCKETS];
    let mut last = vec![NONE; BUCKETS];
    let mut next = vec![NONE; values.len()];
    let mut filled = vec![f32::NAN; values.len()];
    let mut append = |first: &mut [u32], next: &mut [u32], bucket: usize, cell: u32| {
        if first[bucket] == NONE {
            first[bucket] = cell;
        } else {
            next[last[bucket] as usize] = cell;
        }
        last[bucket] = cell;
    };
    for &outlet in outlets {
        if filled[outlet as usize].is_nan() {
            filled[outlet as usize] = values[outlet as usize];
            append(&mut first, &mut next, bucket_of(values[outlet as usize]), outlet);
        }
    }
    let mut order = Vec::with_capacity(values.len());
    let mut bucket = first.iter().position(|&cell| cell != NONE).unwrap_or(BUCKETS);
    while bucket < BUCKETS {
        let cell = first[bucket];
        if cell == NONE {
            bucket += 1;
            continue;
        }
        first[bucket] = next[cell as usize];
        order.push(cell);
        let (x, y) = (cell as usize % side, cell as usize / side);
        for (dx, dy, _) in NEIGHBOURS {
            let (nx, ny) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
            if nx >= side || ny >= side || !filled[ny * side + nx].is_nan() {
                continue;
            }
            let neighbour = ny * side + nx;
            filled[neighbour] = values[neighbour].max(filled[cell as usize]);
            let target = bucket_of(filled[neighbour]).max(bucket);
            append(&mut first, &mut next, target, neighbour as u32);
        }
    }
    (order, filled)
}
