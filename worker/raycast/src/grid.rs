//! A ray in the grid of one layer: which lines it crosses, and where.
//!
//! The ray meets line i of an axis at `u = (i - o) * (1 / d)`, with `o` and `d` its start
//! and direction in cells. Every part of the crate asks this one expression, never adds
//! up steps, so all agree to the last bit on where a cell begins and ends, and a line is
//! left at the very `u` at which the neighbour is entered.
//!
//! A ray is *in* a cell between the last line that it crosses to reach it and the first
//! that it crosses to leave it, if that is a positive length. Along a grid line it is in
//! the cell to the east or north; along the last line of the layer, in the cell inside.

use crate::path::Path;
use terrafarm_terrain::layout::Layer;

/// A ray in the units of a layer's grid.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GridRay {
    /// Start, in cells from post (0, 0).
    pub start: [f64; 2],
    /// Cells per unit of u.
    pub rate: [f64; 2],
    /// As `start`, but off the lines if the ray runs along them.
    line_start: [f64; 2],
    /// 1 / rate; infinite along the lines.
    inverse: [f64; 2],
    /// Whether the index of the cell grows along the ray.
    pub forward: [bool; 2],
    /// Cells along x and y.
    pub cells: [i32; 2],
    /// Where the ray is over the layer: from ...
    pub enter_u: f64,
    /// ... to. Not over it at all if this is not beyond `enter_u`.
    pub exit_u: f64,
}

/// Cells along x and y of level 0 of a layer; 0 where it has but one post.
pub(crate) fn cells_of(layer: &Layer) -> [i32; 2] {
    layer.posts.map(|posts| (posts.saturating_sub(1)).min(i32::MAX as u64 / 2) as i32)
}

impl GridRay {
    pub(crate) fn new(layer: &Layer, path: &Path) -> Self {
        let cells = cells_of(layer);
        let mut ray = GridRay {
            start: [0.0; 2],
            rate: [0.0; 2],
            line_start: [0.0; 2],
            inverse: [0.0; 2],
            forward: [true; 2],
            cells,
            enter_u: 0.0,
            exit_u: path.reach_u,
        };
        for (axis, &count) in cells.iter().enumerate() {
            let scale = 1.0 / layer.spacing[axis];
            let start = (path.origin[axis] - layer.origin[axis]) * scale;
            let rate = path.direction[axis] * scale;
            ray.start[axis] = start;
            ray.rate[axis] = rate;
            ray.inverse[axis] = 1.0 / rate;
            ray.line_start[axis] = start;
            let last = f64::from(count);
            if ray.inverse[axis].is_finite() {
                ray.forward[axis] = rate > 0.0;
                let (first, second) = (ray.line_u(axis, 0), ray.line_u(axis, count));
                ray.enter_u = ray.enter_u.max(first.min(second));
                ray.exit_u = ray.exit_u.min(first.max(second));
            } else {
                ray.rate[axis] = 0.0;
                ray.inverse[axis] = f64::INFINITY;
                let within = start.floor().clamp(0.0, (last - 1.0).max(0.0));
                ray.line_start[axis] = within + 0.5;
                if !(0.0..=last).contains(&start) {
                    ray.exit_u = f64::NEG_INFINITY;
                }
            }
        }
        if cells.contains(&0) {
            ray.exit_u = f64::NEG_INFINITY;
        }
        ray
    }

    /// Where the ray crosses a line of an axis.
    #[inline(always)]
    pub(crate) fn line_u(&self, axis: usize, line: i32) -> f64 {
        (f64::from(line) - self.line_start[axis]) * self.inverse[axis]
    }

    /// Position at `u` along an axis, in cells.
    #[inline(always)]
    pub(crate) fn position(&self, axis: usize, u: f64) -> f64 {
        self.start[axis] + u * self.rate[axis]
    }

    /// The line by which the ray leaves cell `index` of an axis.
    #[inline(always)]
    pub(crate) fn exit_line(&self, axis: usize, index: i32) -> i32 {
        index + i32::from(self.forward[axis])
    }

    /// The line by which the ray enters cell `index` of an axis.
    #[inline(always)]
    pub(crate) fn entry_line(&self, axis: usize, index: i32) -> i32 {
        index + i32::from(!self.forward[axis])
    }

    /// The cell of an axis in which the ray is just after `u`, agreeing with `line_u`.
    #[inline(always)]
    pub(crate) fn cell_after(&self, axis: usize, u: f64) -> i32 {
        let last = self.cells[axis] - 1;
        // Cut off, not rounded down: the same once what is below 0 is raised to it.
        let index = (self.position(axis, u) as i32).clamp(0, last);
        let step = if self.forward[axis] { 1 } else { -1 };
        if self.line_u(axis, self.exit_line(axis, index)) <= u {
            (index + step).clamp(0, last)
        } else if self.line_u(axis, self.entry_line(axis, index)) > u {
            (index - step).clamp(0, last)
        } else {
            index
        }
    }
}
