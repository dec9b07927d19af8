//! From the posts of one grid to the samples of another, fast enough for every post.
//!
//! A projection costs some hundred nanoseconds a point. Over a few dozen posts it is
//! almost affine. So the exact transformation is taken at the corners of blocks, and
//! interpolated between them; at the middle of the block and of its sides the two are
//! compared, and a block in which they differ by more than [`TOLERANCE`] is quartered,
//! down to single posts. Blocks lie at fixed places of the grid, so that a post gets the
//! same position whichever window asks for it: neighbouring tiles agree on shared posts.

use terrafarm_geo::Transformer;

use crate::grid::{Affine, PostWindow};

/// Largest difference accepted at the points of comparison, in columns or rows. The true
/// maximum of a smooth error lies near them; half of the promised 0.001 is asked for.
const TOLERANCE: f64 = 0.5e-3;
/// Posts along a side of the largest block, a power of two.
const BLOCK: i64 = 64;

/// The way from posts of one frame to columns and rows of another.
pub(crate) struct Warp {
    from: Affine,
    transformer: Transformer,
    to: Affine,
    /// Longitude around which those of the target are counted, if it is geographic.
    longitude_centre: Option<f64>,
}

impl Warp {
    /// `transformer` leads from the system of `from` to that of `to`. Longitudes are
    /// brought to within 180 degrees of `longitude_centre`.
    pub(crate) fn new(
        from: Affine,
        transformer: Transformer,
        to: Affine,
        longitude_centre: Option<f64>,
    ) -> Self {
        Warp { from, transformer, to, longitude_centre }
    }

    /// Columns and rows of exact positions; NaN outside the domain.
    fn exact(&self, posts: &mut [[f64; 2]]) {
        for post in posts.iter_mut() {
            *post = self.from.at(*post);
        }
        self.transformer.apply(posts);
        for post in posts.iter_mut() {
            if let Some(centre) = self.longitude_centre {
                post[0] = centre + (post[0] - centre + 180.0).rem_euclid(360.0) - 180.0;
            }
            *post = self.to.invert(*post);
        }
    }

    /// Columns and rows of all posts of a window, row by row.
    pub(crate) fn window(&self, window: PostWindow) -> Vec<[f64; 2]> {
        let mut points = vec![[f64::NAN; 2]; window.len()];
        let (right, top) = (window.i + window.width as i64, window.j + window.height as i64);
        for j in window.j.div_euclid(BLOCK)..=(top - 1).div_euclid(BLOCK) {
            for i in window.i.div_euclid(BLOCK)..=(right - 1).div_euclid(BLOCK) {
                self.block(i * BLOCK, j * BLOCK, BLOCK, window, &mut points);
            }
        }
        points
    }

    /// Fills the posts of a window that lie in the block at (i, j).
    fn block(&self, i: i64, j: i64, size: i64, window: PostWindow, points: &mut [[f64; 2]]) {
        let columns = i.max(window.i)..(i + size).min(window.i + window.width as i64);
        let rows = j.max(window.j)..(j + size).min(window.j + window.height as i64);
        if columns.is_empty() || rows.is_empty() {
            return;
        }
        let index =
            |i: i64, j: i64| (j - window.j) as usize * window.width + (i - window.i) as usize;
        if size == 1 {
            let mut post = [[i as f64, j as f64]];
            self.exact(&mut post);
            points[index(i, j)] = post[0];
            return;
        }
        let half = size / 2;
        // South to north, west to east: corners 0, 2, 6, 8, middle 4.
        let mut probes: [[f64; 2]; 9] = std::array::from_fn(|n| {
            let (di, dj) = ((n % 3) as i64, (n / 3) as i64);
            [(i + di * half) as f64, (j + dj * half) as f64]
        });
        self.exact(&mut probes);
        if probes.iter().all(|probe| !probe[0].is_finite()) {
            return;
        }
        let corners = [probes[0], probes[2], probes[6], probes[8]];
        let close = (0..9).all(|n| {
            let guess = blend(corners, (n % 3) as f64 * 0.5, (n / 3) as f64 * 0.5);
            (0..2).all(|axis| (guess[axis] - probes[n][axis]).abs() <= TOLERANCE)
        });
        if !close {
            for (di, dj) in [(0, 0), (half, 0), (0, half), (half, half)] {
                self.block(i + di, j + dj, half, window, points);
            }
            return;
        }
        for row in rows {
            let t = (row - j) as f64 / size as f64;
            for column in columns.clone() {
                let s = (column - i) as f64 / size as f64;
                points[index(column, row)] = blend(corners, s, t);
            }
        }
    }
}

/// Bilinear interpolation between south-west, south-east, north-west, north-east.
fn blend(corners: [[f64; 2]; 4], s: f64, t: f64) -> [f64; 2] {
    [0, 1].map(|axis| {
        let south = corners[0][axis] + (corners[1][axis] - corners[0][axis]) * s;
        let north = corners[2][axis] + (corners[3][axis] - corners[2][axis]) * s;
        south + (north - south) * t
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::grid::Grid;
    use terrafarm_geo::Crs;

    fn warp(latitude: f64, longitude: f64, spacing: f64, arc_seconds: f64) -> Warp {
        let utm = Crs::suggest_metric(longitude, latitude);
        let geographic = Crs::parse("EPSG:4326").unwrap();
        let origin = utm.from_lonlat([longitude, latitude]).unwrap();
        let grid = Grid { origin, spacing: [spacing; 2], posts: [1000; 2] };
        let step = arc_seconds / 3600.0;
        let to = Affine { origin: [longitude, latitude], column: [step, 0.0], row: [0.0, -step] };
        let transformer = Transformer::new(&utm, &geographic).unwrap();
        Warp::new(grid.affine(), transformer, to, Some(longitude))
    }

    #[test]
    fn approximate_positions_stay_within_a_thousandth_of_a_sample() {
        for (latitude, longitude, spacing, seconds) in [
            (37.0, -113.0, 24.0, 1.0),
            (60.0, 5.0, 90.0, 3.0),
            (-77.0, 166.0, 2.0, 0.1),
            (88.0, 20.0, 100.0, 3.0),
            (10.0, 179.9, 900.0, 30.0),
            (89.9995, 0.0, 10.0, 3.0),
        ] {
            let warp = warp(latitude, longitude, spacing, seconds);
            let window = PostWindow { i: -37, j: -5, width: 150, height: 140 };
            let points = warp.window(window);
            let mut worst: f64 = 0.0;
            for (n, point) in points.iter().enumerate() {
                let i = window.i + (n % window.width) as i64;
                let j = window.j + (n / window.width) as i64;
                let mut exact = [[i as f64, j as f64]];
                warp.exact(&mut exact);
                for axis in 0..2 {
                    worst = worst.max((point[axis] - exact[0][axis]).abs());
                }
            }
            assert!(worst <= 1e-3, "{latitude}: {worst}");
        }
    }

    #[test]
    fn a_post_has_one_position_whichever_window_asks() {
        let warp = warp(47.0, 8.0, 25.0, 1.0);
        let large = PostWindow { i: -1, j: 255, width: 259, height: 259 };
        let small = PostWindow { i: 100, j: 300, width: 7, height: 9 };
        let (all, part) = (warp.window(large), warp.window(small));
        for j in 0..small.height {
            for i in 0..small.width {
                let at = (small.j - large.j) as usize + j;
                let in_large = at * large.width + (small.i - large.i) as usize + i;
                assert_eq!(all[in_large], part[j * small.width + i]);
            }
        }
    }
}
