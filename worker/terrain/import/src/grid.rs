//! Regular grids: an affine frame of samples anywhere, and the store's own posts.

use terrafarm_terrain::layout::{self, Layer, MAX_POSTS, MAX_TILES};

/// A frame in which positions are counted in columns and rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Affine {
    /// Position of (0, 0).
    pub(crate) origin: [f64; 2],
    /// Change of position per column.
    pub(crate) column: [f64; 2],
    /// Change of position per row.
    pub(crate) row: [f64; 2],
}

impl Affine {
    /// Position of a column and row, fractions allowed.
    pub(crate) fn at(&self, [u, v]: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|axis| self.origin[axis] + u * self.column[axis] + v * self.row[axis])
    }

    /// Column and row of a position. NaN or infinite if the frame is degenerate.
    pub(crate) fn invert(&self, xy: [f64; 2]) -> [f64; 2] {
        let [x, y] = [0, 1].map(|axis| xy[axis] - self.origin[axis]);
        let determinant = self.determinant();
        let u = (x * self.row[1] - y * self.row[0]) / determinant;
        let v = (y * self.column[0] - x * self.column[1]) / determinant;
        [u, v]
    }

    /// Signed area of a cell; 0 for a frame in which positions cannot be found.
    pub(crate) fn determinant(&self) -> f64 {
        self.column[0] * self.row[1] - self.column[1] * self.row[0]
    }

    /// Whether columns run along x and rows along y.
    pub(crate) fn is_upright(&self) -> bool {
        self.column[1] == 0.0 && self.row[0] == 0.0
    }

    /// The same frame counted in parts of a column and row.
    pub(crate) fn subdivided(&self, parts: f64) -> Affine {
        Affine {
            origin: self.origin,
            column: self.column.map(|step| step / parts),
            row: self.row.map(|step| step / parts),
        }
    }
}

/// Level 0 of a layer: where its posts lie and how many there are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Grid {
    /// Position of the south-west post, metres.
    pub(crate) origin: [f64; 2],
    /// Distance between posts, metres, positive.
    pub(crate) spacing: [f64; 2],
    /// Number of posts.
    pub(crate) posts: [u64; 2],
}

/// A rectangle of posts; it may reach beyond the grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PostWindow {
    /// First column of posts.
    pub(crate) i: i64,
    /// First row of posts.
    pub(crate) j: i64,
    /// Columns.
    pub(crate) width: usize,
    /// Rows.
    pub(crate) height: usize,
}

impl Grid {
    /// The grid with this phase and spacing that covers a rectangle, snapped outwards.
    /// `bounds`: west, south, east, north.
    ///
    /// # Errors
    /// In words, if it has too many posts.
    pub(crate) fn covering(
        phase: [f64; 2],
        spacing: [f64; 2],
        bounds: [f64; 4],
    ) -> Result<Grid, String> {
        let mut origin = [0.0; 2];
        let mut posts = [0; 2];
        for axis in 0..2 {
            // A hundredth of a millimetre per kilometre is noise, not another post.
            let slack = 1e-6;
            let first = ((bounds[axis] - phase[axis]) / spacing[axis] + slack).floor();
            let last = ((bounds[axis + 2] - phase[axis]) / spacing[axis] - slack).ceil();
            let count = if last < first { 1.0 } else { last - first + 1.0 };
            if !count.is_finite() || count > MAX_POSTS as f64 {
                return Err(format!(
                    "the terrain would have {count:.0} posts of {} m along a side; at most \
                     {MAX_POSTS} are allowed; are the inputs far apart, or their positions wrong?",
                    spacing[axis]
                ));
            }
            origin[axis] = phase[axis] + first * spacing[axis];
            posts[axis] = count as u64;
        }
        let grid = Grid { origin, spacing, posts };
        let tiles = grid.tiles();
        if tiles > MAX_TILES {
            return Err(format!(
                "{} x {} posts need {tiles} tiles; at most {MAX_TILES} are allowed; \
                 import a smaller area or a coarser model",
                posts[0], posts[1]
            ));
        }
        Ok(grid)
    }

    /// Number of tiles of all levels.
    pub(crate) fn tiles(&self) -> u64 {
        (0..Layer::level_count(self.posts))
            .map(|level| {
                let posts = self.posts.map(|n| (n - 1).div_ceil(1 << level) + 1);
                Layer::tiles_for(posts).iter().map(|&n| u64::from(n)).product::<u64>()
            })
            .sum()
    }

    /// The grid as a frame: columns to the east, rows to the north.
    pub(crate) fn affine(&self) -> Affine {
        Affine { origin: self.origin, column: [self.spacing[0], 0.0], row: [0.0, self.spacing[1]] }
    }

    /// West, south, east, north of the outermost posts.
    pub(crate) fn bounds(&self) -> [f64; 4] {
        let far = [0, 1]
            .map(|axis| self.origin[axis] + (self.posts[axis] - 1) as f64 * self.spacing[axis]);
        [self.origin[0], self.origin[1], far[0], far[1]]
    }

    /// The grid with so many posts more on each side.
    pub(crate) fn grown(&self, by: u64) -> Grid {
        Grid {
            origin: [0, 1].map(|axis| self.origin[axis] - by as f64 * self.spacing[axis]),
            spacing: self.spacing,
            posts: self.posts.map(|n| n + 2 * by),
        }
    }
}

impl From<layout::PostWindow> for PostWindow {
    fn from(window: layout::PostWindow) -> Self {
        let layout::PostWindow { i0, j0, width, height } = window;
        PostWindow { i: i0 as i64, j: j0 as i64, width, height }
    }
}

impl PostWindow {
    /// Number of posts.
    pub(crate) fn len(&self) -> usize {
        self.width * self.height
    }

    /// The window with so many posts more on each side.
    pub(crate) fn grown(&self, by: usize) -> PostWindow {
        PostWindow {
            i: self.i - by as i64,
            j: self.j - by as i64,
            width: self.width + 2 * by,
            height: self.height + 2 * by,
        }
    }
}

/// Whether two rectangles (west, south, east, north) share more than nothing.
pub(crate) fn overlap(a: [f64; 4], b: [f64; 4]) -> bool {
    a[0] <= b[2] && b[0] <= a[2] && a[1] <= b[3] && b[1] <= a[3]
}

/// The smallest rectangle around two.
pub(crate) fn union(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])]
}

/// The largest spacing that people would choose, not above the given one, so that no
/// detail is lost: 1, 1.2, 1.5, 2, 2.4, 2.5, 3, 4, 5, 6, 7.5, 8, 9 times a power of ten.
/// One arc second at 37 degrees (30.9 m by 24.7 m) becomes 24 m.
pub(crate) fn friendly_spacing(at_most_m: f64) -> f64 {
    const STEPS: [f64; 13] = [1.0, 1.2, 1.5, 2.0, 2.4, 2.5, 3.0, 4.0, 5.0, 6.0, 7.5, 8.0, 9.0];
    let mut power = 1e-9;
    while power * 10.0 <= at_most_m * (1.0 + 1e-9) {
        power *= 10.0;
    }
    let limit = at_most_m * (1.0 + 1e-9);
    let step = STEPS.iter().rev().find(|&&step| step * power <= limit).unwrap_or(&1.0);
    // By way of text, so that 2.4 x 10 is 24 and not its neighbour.
    format!("{:.6e}", step * power).parse().unwrap_or(step * power)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn friendly_spacings_are_round_and_never_coarser() {
        let cases =
            [(24.7, 24.0), (30.9, 30.0), (30.0, 30.0), (1.0, 1.0), (0.99, 0.9), (74.1, 60.0)];
        for (native, friendly) in cases {
            assert_eq!(friendly_spacing(native), friendly);
        }
        for n in 1..2000 {
            let native = f64::from(n) * 0.0371;
            let friendly = friendly_spacing(native);
            assert!(friendly <= native * 1.000_001 && friendly > native * 0.75, "{native}");
        }
    }

    #[test]
    fn a_covering_grid_keeps_its_phase_and_takes_no_post_for_rounding_noise() {
        let grid = Grid::covering([0.0, 0.0], [30.0, 30.0], [29.9, 60.0, 90.000_000_1, 120.1]);
        assert_eq!(grid.unwrap(), Grid { origin: [0.0, 60.0], spacing: [30.0; 2], posts: [4, 4] });
    }

    #[test]
    fn a_grid_beyond_the_limits_is_refused_with_its_size() {
        let error = Grid::covering([0.0; 2], [1.0; 2], [0.0, 0.0, 1e9, 1.0]).unwrap_err();
        assert!(error.contains("1000000001"), "{error}");
        let error = Grid::covering([0.0; 2], [1.0; 2], [0.0, 0.0, 5e7, 5e7]).unwrap_err();
        assert!(error.contains("tiles"), "{error}");
        assert!(Grid::covering([0.0; 2], [1.0; 2], [0.0, f64::NAN, 1.0, f64::NAN]).is_err());
    }

    #[test]
    fn a_frame_and_its_inverse_cancel() {
        let frame = Affine { origin: [5e5, 4e6], column: [20.0, 5.0], row: [4.0, -25.0] };
        let [u, v] = frame.invert(frame.at([12.25, -3.5]));
        assert!((u - 12.25).abs() < 1e-9 && (v + 3.5).abs() < 1e-9);
    }
}
