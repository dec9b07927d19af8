//! A square grid of numbers that covers the whole terrain, and smooth samples of it.

use rayon::prelude::*;

/// A square grid; cell (x, y) counts from the south-west.
#[derive(Debug, Clone)]
pub(crate) struct Grid {
    side: usize,
    values: Vec<f32>,
}

/// A smooth sample: value and its slopes per cell.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sample {
    pub value: f32,
    pub slope_x: f32,
    pub slope_y: f32,
}

impl Grid {
    /// A grid from a function of column and row.
    pub fn from_fn(side: usize, value: impl Fn(usize, usize) -> f32 + Sync) -> Self {
        let mut values = vec![0.0; side * side];
        values.par_chunks_mut(side).enumerate().for_each(|(y, row)| {
            for (x, cell) in row.iter_mut().enumerate() {
                *cell = value(x, y);
            }
        });
        Grid { side, values }
    }

    /// Number of cells along a side.
    pub fn side(&self) -> usize {
        self.side
    }

    /// All values, row by row from the south-west.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// All values, to be written.
    pub fn values_mut(&mut self) -> &mut [f32] {
        &mut self.values
    }

    /// Lowest and highest value.
    pub fn range(&self) -> (f32, f32) {
        let start = (f32::INFINITY, f32::NEG_INFINITY);
        self.values.iter().fold(start, |(low, high), &v| (low.min(v), high.max(v)))
    }

    /// A value; places outside take that of the nearest cell.
    #[inline]
    pub fn at(&self, x: i64, y: i64) -> f32 {
        let last = self.side as i64 - 1;
        self.values[y.clamp(0, last) as usize * self.side + x.clamp(0, last) as usize]
    }

    /// Bilinear sample at a place in cells.
    #[inline]
    pub fn bilinear(&self, x: f64, y: f64) -> f32 {
        let (floor_x, floor_y) = (x.floor(), y.floor());
        let (fx, fy) = ((x - floor_x) as f32, (y - floor_y) as f32);
        let (ix, iy) = (floor_x as i64, floor_y as i64);
        let row = |y: i64| {
            let (west, east) = (self.at(ix, y), self.at(ix + 1, y));
            west + (east - west) * fx
        };
        let (south, north) = (row(iy), row(iy + 1));
        south + (north - south) * fy
    }

    /// Sample of the uniform cubic B-spline over the grid at a place in cells: twice
    /// smooth, so that no cell of the grid shows however far it is enlarged.
    #[inline]
    pub fn spline(&self, x: f64, y: f64) -> Sample {
        let (floor_x, floor_y) = (x.floor(), y.floor());
        let (wx, dx) = spline_weights((x - floor_x) as f32);
        let (wy, dy) = spline_weights((y - floor_y) as f32);
        let (ix, iy) = (floor_x as i64 - 1, floor_y as i64 - 1);
        let inside = ix >= 0 && iy >= 0 && ix + 3 < self.side as i64 && iy + 3 < self.side as i64;
        let mut sample = Sample { value: 0.0, slope_x: 0.0, slope_y: 0.0 };
        for j in 0..4 {
            let row = if inside {
                let at = (iy as usize + j) * self.side + ix as usize;
                [0, 1, 2, 3].map(|i| self.values[at + i])
            } else {
                [0, 1, 2, 3].map(|i| self.at(ix + i, iy + j as i64))
            };
            let dot = |w: &[f32; 4]| row[0] * w[0] + row[1] * w[1] + row[2] * w[2] + row[3] * w[3];
            let along = dot(&wx);
            sample.value += wy[j] * along;
            sample.slope_x += wy[j] * dot(&dx);
            sample.slope_y += dy[j] * along;
        }
        sample
    }

    /// One pass of a 1-2-1 filter along both axes.
    pub fn smoothed(&self) -> Grid {
        Grid::from_fn(self.side, |x, y| {
            let row = |y: i64| {
                let x = x as i64;
                0.25 * self.at(x - 1, y) + 0.5 * self.at(x, y) + 0.25 * self.at(x + 1, y)
            };
            let y = y as i64;
            0.25 * row(y - 1) + 0.5 * row(y) + 0.25 * row(y + 1)
        })
    }
}

/// Weights of the four cells around a place between the second and the third, and
/// their derivatives.
#[inline]
fn spline_weights(t: f32) -> ([f32; 4], [f32; 4]) {
    let s = 1.0 - t;
    let (t2, s2) = (t * t, s * s);
    let sixth = 1.0 / 6.0;
    let value = [
        s2 * s * sixth,
        (4.0 + 3.0 * t2 * (t - 2.0)) * sixth,
        (4.0 + 3.0 * s2 * (s - 2.0)) * sixth,
        t2 * t * sixth,
    ];
    let slope = [-0.5 * s2, t * (1.5 * t - 2.0), -s * (1.5 * s - 2.0), 0.5 * t2];
    (value, slope)
}
