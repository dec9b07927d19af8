//! Lines of sight over a grid, computed without the ray caster.
//!
//! A line between two posts crosses columns, rows and diagonals of the grid at fractions
//! of whole numbers, so places are exact and only heights are rounded.

use crate::oracles::grid::Grid;

/// How a cell is cut into two triangles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Diagonal {
    SouthWestToNorthEast,
    NorthWestToSouthEast,
}

/// Someone `up_m` above a post.
#[derive(Debug, Clone, Copy)]
pub struct Observer {
    pub i: i64,
    pub j: i64,
    pub up_m: f64,
}

/// The line from an observer to a post.
pub struct Line<'g> {
    grid: &'g Grid,
    from: [i64; 2],
    way: [i64; 2],
    start_z: f64,
    rise: f64,
    /// By how much it has to be above what it clears, metres.
    margin_m: f64,
}

/// A coordinate in posts: the whole number below, and what is left.
type Place = (i64, f64);

impl<'g> Line<'g> {
    pub fn new(grid: &'g Grid, observer: &Observer, target: [i64; 2], margin_m: f64) -> Self {
        let from = [observer.i, observer.j];
        let start_z = grid.post(from[0], from[1]) + observer.up_m;
        let rise = grid.post(target[0], target[1]) - start_z;
        let way = [target[0] - from[0], target[1] - from[1]];
        Line { grid, from, way, start_z, rise, margin_m }
    }

    /// Whether it is below no line of the grid: neither between two posts of a column nor
    /// between two of a row.
    pub fn clears_lines(&self) -> bool {
        self.clears_axis(0) && self.clears_axis(1)
    }

    /// As `clears_lines`, of the axis along which the way is longer alone.
    pub fn clears_dominant_axis(&self) -> bool {
        self.clears_axis(if self.way[0].abs() >= self.way[1].abs() { 0 } else { 1 })
    }

    /// Whether it is nowhere below the triangles.
    pub fn clears_triangles(&self, diagonal: Diagonal) -> bool {
        let [dx, dy] = self.way;
        self.clears_lines()
            && match diagonal {
                Diagonal::SouthWestToNorthEast => {
                    self.clears(dx - dy, |(i, x), (j, _)| self.edge([i, j], [1, 1], x))
                }
                // On a diagonal x + y is 1, at a post both are 0.
                Diagonal::NorthWestToSouthEast => self.clears(dx + dy, |(i, x), (j, _)| {
                    let north = if x > 0.0 { j + 1 } else { j };
                    self.edge([i, north], [1, -1], x)
                }),
            }
    }

    fn clears_axis(&self, axis: usize) -> bool {
        self.clears(self.way[axis], |(i, x), (j, y)| match axis {
            0 => self.edge([i, j], [0, 1], y),
            _ => self.edge([i, j], [1, 0], x),
        })
    }

    /// Whether it is not below any of the places that cut it into `parts`.
    fn clears(&self, parts: i64, height: impl Fn(Place, Place) -> f64) -> bool {
        let parts = parts.abs();
        (1..parts).all(|part| {
            let [x, y] = [0, 1].map(|axis| {
                let way = self.way[axis] * part;
                let rest = way.rem_euclid(parts) as f64 / parts as f64;
                (self.from[axis] + way.div_euclid(parts), rest)
            });
            self.start_z + self.rise * (part as f64 / parts as f64) >= height(x, y) + self.margin_m
        })
    }

    /// Height between two neighbouring posts.
    fn edge(&self, [i, j]: [i64; 2], [di, dj]: [i64; 2], share: f64) -> f64 {
        let first = self.grid.post(i, j);
        if share == 0.0 { first } else { first + (self.grid.post(i + di, j + dj) - first) * share }
    }
}
