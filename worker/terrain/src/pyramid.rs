//! From one level of a layer to the next coarser one.
//!
//! A coarse post is the tent filter (1 2 1, along x and y) over the posts of the finer
//! level around its place. Voids do not count and the weights are renormalised: a coarse
//! post is void only if all nine are. At the edge of the grid the tent keeps to the edge
//! (so that a plane stays a plane), unless all is void there; coarse posts beyond the
//! edge, by less than a coarse cell, take the value of the edge.
//!
//! **Where the fine surface is, the coarse one is, too.** The four fine cells within a
//! coarse cell share its central post; if a corner of the coarse cell is void, that
//! central post was among the nine voids, so none of the four fine cells is valid. The
//! coarse surface may reach further than the fine one: there the two are incomparable.
//!
//! **The deviation is a bound.** Within a fine cell both surfaces are bilinear (the
//! coarse one is bilinear on the whole coarse cell), hence so is their difference, and a
//! bilinear function is largest at a corner. The largest difference at fine posts is
//! therefore the largest anywhere: exact between neighbouring levels. Added to the
//! largest deviation of the finer tiles below it bounds the distance to level 0. Coarse
//! posts are rounded (see [`crate::rounding`]) before anything is compared with them.

use crate::build::{LayerSource, SourceError};
use crate::codec::{self, CodecError};
use crate::color::{LINEAR_OF_SRGB, srgb_of_linear};
use crate::layout::{LayerKind, MAX_HEIGHT_M, PostWindow, TILE_CELLS, TILE_POSTS, TILE_RING};
use crate::rounding::rounded;

/// Fine posts beyond the ground of a row of coarse tiles that their rings depend on: a
/// ring post is two fine posts out, its tent three.
pub(crate) const FINE_REACH: u64 = 3;

impl PostWindow {
    /// The posts from `first` to `last`, both included, that lie in a grid.
    pub(crate) fn clipped(first: [i64; 2], last: [i64; 2], posts: [u64; 2]) -> PostWindow {
        let low = |axis: usize| (first[axis].max(0) as u64).min(posts[axis] - 1);
        let high = |axis: usize| (last[axis].max(0) as u64).min(posts[axis] - 1);
        PostWindow {
            i0: low(0),
            j0: low(1),
            width: (high(0) - low(0) + 1) as usize,
            height: (high(1) - low(1) + 1) as usize,
        }
    }

    /// The posts of a tile, ring included, that lie in a grid.
    pub(crate) fn of_tile(tx: u32, ty: u32, posts: [u64; 2]) -> PostWindow {
        let first = [tx, ty].map(|t| i64::from(t) * TILE_CELLS as i64 - TILE_RING as i64);
        PostWindow::clipped(first, first.map(|post| post + TILE_POSTS as i64 - 1), posts)
    }

    /// Fills a buffer of the window with a function of column and row.
    pub fn fill<T>(&self, into: &mut [T], post: impl Fn(u64, u64) -> T) {
        for (row, j) in into.chunks_exact_mut(self.width.max(1)).zip(self.j0..) {
            for (place, i) in row.iter_mut().zip(self.i0..) {
                *place = post(i, j);
            }
        }
    }

    pub(crate) fn area(&self) -> usize {
        self.width * self.height
    }
}

/// What a layer is made of: heights or colours.
pub(crate) trait Post: Copy + Send + Sync + 'static {
    const KIND: LayerKind;
    const VOID: Self;

    fn is_void(self) -> bool;

    /// What of a source's post is stored.
    fn cleaned(self) -> Self;

    fn read(
        source: &dyn LayerSource,
        window: PostWindow,
        into: &mut [Self],
    ) -> Result<(), SourceError>;

    fn encode(posts: &[Self], step_m: Option<f64>) -> Vec<u8>;

    fn decode(bytes: &[u8]) -> Result<Vec<Self>, CodecError>;

    /// The tent over 3 x 3 posts; heights are rounded to whole steps.
    fn tent(square: [[Self; 3]; 3], step_m: Option<f64>) -> Self;

    /// Lowest and highest, voids left out.
    fn extent(posts: impl Iterator<Item = Self>) -> (f32, f32);

    /// The largest distance between the bilinear surface of a coarse cell and that of
    /// the up to four fine cells within (`None` beyond the grid); see the module's
    /// documentation. Infinite if one of those is void, 0 if the coarse one is.
    fn cell_deviation(coarse: [Self; 4], fine: [[Option<Self>; 3]; 3]) -> f64;
}

const TENT: [u32; 3] = [1, 2, 1];

/// The posts of a square with their weights.
fn weighted<P: Copy>(square: [[P; 3]; 3]) -> impl Iterator<Item = (P, u32)> {
    (0..9).map(move |at| (square[at / 3][at % 3], TENT[at / 3] * TENT[at % 3]))
}

impl Post for f32 {
    const KIND: LayerKind = LayerKind::Height;
    const VOID: f32 = f32::NAN;

    fn is_void(self) -> bool {
        self.is_nan()
    }

    fn cleaned(self) -> f32 {
        // Adding zero makes −0 a plain 0.
        if self.abs() <= MAX_HEIGHT_M { self + 0.0 } else { f32::NAN }
    }

    fn read(source: &dyn LayerSource, w: PostWindow, into: &mut [f32]) -> Result<(), SourceError> {
        source.heights(w, into)
    }

    fn encode(posts: &[f32], step_m: Option<f64>) -> Vec<u8> {
        codec::encode_heights(posts, step_m)
    }

    fn decode(bytes: &[u8]) -> Result<Vec<f32>, CodecError> {
        codec::decode_posts(bytes)
    }

    fn tent(square: [[f32; 3]; 3], step_m: Option<f64>) -> f32 {
        let (mut sum, mut weights) = (0.0, 0);
        for (height, weight) in weighted(square).filter(|(height, _)| !height.is_nan()) {
            sum += f64::from(height) * f64::from(weight);
            weights += weight;
        }
        if weights == 0 {
            return f32::NAN;
        }
        let mean = sum / f64::from(weights);
        rounded(mean, step_m).clamp(-MAX_HEIGHT_M, MAX_HEIGHT_M)
    }

    fn extent(posts: impl Iterator<Item = f32>) -> (f32, f32) {
        posts
            .filter(|height| !height.is_nan())
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), h| (low.min(h), high.max(h)))
    }

    fn cell_deviation(coarse: [f32; 4], fine: [[Option<f32>; 3]; 3]) -> f64 {
        if coarse.iter().any(|height| height.is_nan()) {
            return 0.0;
        }
        let [sw, se, nw, ne] = coarse.map(f64::from);
        let [west, east] = [[sw, (sw + nw) / 2.0, nw], [se, (se + ne) / 2.0, ne]];
        let mut deviation: f64 = 0.0;
        for (row, fine) in fine.iter().enumerate() {
            let across = [west[row], (west[row] + east[row]) / 2.0, east[row]];
            for (coarse, fine) in across.into_iter().zip(fine) {
                // A coarse cell begins before the last fine post, so that every fine post
                // here is the corner of a fine cell here: if it is void, so is the cell.
                let apart = fine.map_or(0.0, |fine| (coarse - f64::from(fine)).abs());
                deviation = if apart.is_nan() { f64::INFINITY } else { deviation.max(apart) };
                if deviation.is_infinite() {
                    return deviation;
                }
            }
        }
        deviation
    }
}

impl Post for [u8; 4] {
    const KIND: LayerKind = LayerKind::Photo;
    const VOID: [u8; 4] = [0; 4];

    fn is_void(self) -> bool {
        self[3] == 0
    }

    fn cleaned(self) -> [u8; 4] {
        if self[3] == 0 { [0; 4] } else { self }
    }

    fn read(
        source: &dyn LayerSource,
        w: PostWindow,
        into: &mut [[u8; 4]],
    ) -> Result<(), SourceError> {
        source.colors(w, into)
    }

    fn encode(posts: &[[u8; 4]], _step_m: Option<f64>) -> Vec<u8> {
        codec::encode_colors(posts)
    }

    fn decode(bytes: &[u8]) -> Result<Vec<[u8; 4]>, CodecError> {
        codec::decode_colors(bytes)
    }

    /// The mean in linear light, each colour weighted by its coverage; coverage is the
    /// plain mean. In whole numbers.
    fn tent(square: [[[u8; 4]; 3]; 3], _step_m: Option<f64>) -> [u8; 4] {
        let mut light = [0u32; 3];
        let mut coverage = 0;
        for (color, weight) in weighted(square) {
            let weight = weight * u32::from(color[3]);
            coverage += weight;
            for (sum, code) in light.iter_mut().zip(color) {
                *sum += weight * u32::from(LINEAR_OF_SRGB[usize::from(code)]);
            }
        }
        let mean_coverage = ((coverage + 8) / 16) as u8;
        if mean_coverage == 0 {
            return [0; 4];
        }
        let [red, green, blue] =
            light.map(|sum| srgb_of_linear(((sum + coverage / 2) / coverage) as u16));
        [red, green, blue, mean_coverage]
    }

    fn extent(_posts: impl Iterator<Item = [u8; 4]>) -> (f32, f32) {
        (0.0, 0.0)
    }

    fn cell_deviation(_coarse: [[u8; 4]; 4], _fine: [[Option<[u8; 4]>; 3]; 3]) -> f64 {
        0.0
    }
}

/// Part of a level, as the source of the next coarser one.
pub(crate) struct FinePosts<P> {
    /// Number of posts of the whole level.
    pub(crate) grid: [u64; 2],
    pub(crate) window: PostWindow,
    pub(crate) posts: Vec<P>,
}

impl<P: Post> FinePosts<P> {
    /// A post of the window.
    fn at(&self, [i, j]: [u64; 2]) -> P {
        let column = (i - self.window.i0) as usize;
        let row = (j - self.window.j0) as usize;
        self.posts[row * self.window.width + column]
    }

    /// The coarse post over fine post `center`, which may lie beyond the far edge.
    fn coarse_post(&self, center: [u64; 2], step_m: Option<f64>) -> P {
        let last = self.grid.map(|n| n - 1);
        let center = [center[0].min(last[0]), center[1].min(last[1])];
        let around = |axis: usize| {
            let center = center[axis];
            [center.saturating_sub(1), center, (center + 1).min(last[axis])]
        };
        let (columns, rows) = (around(0), around(1));
        let square = |columns: [u64; 3], rows: [u64; 3]| {
            rows.map(|row| columns.map(|column| self.at([column, row])))
        };
        let inner = |axis: usize, around: [u64; 3]| {
            let at_edge = center[axis] == 0 || center[axis] == last[axis];
            if at_edge { [center[axis]; 3] } else { around }
        };
        let post = P::tent(square(inner(0, columns), inner(1, rows)), step_m);
        if post.is_void() { P::tent(square(columns, rows), step_m) } else { post }
    }

    /// The posts of a coarse tile, ring included; `posts` is the size of its level.
    pub(crate) fn coarse_tile(
        &self,
        tx: u32,
        ty: u32,
        posts: [u64; 2],
        step_m: Option<f64>,
    ) -> Vec<P> {
        let inside = PostWindow::of_tile(tx, ty, posts);
        let mut tile = vec![P::VOID; codec::TILE_AREA];
        for j in inside.j0..inside.j0 + inside.height as u64 {
            for i in inside.i0..inside.i0 + inside.width as u64 {
                tile[post_in_tile([tx, ty], [i, j])] = self.coarse_post([2 * i, 2 * j], step_m);
            }
        }
        tile
    }

    /// The largest distance between a coarse tile's surface and this level's; 0 for
    /// photos.
    pub(crate) fn deviation(&self, tx: u32, ty: u32, tile: &[P]) -> f64 {
        if P::KIND == LayerKind::Photo {
            return 0.0;
        }
        let mut deviation: f64 = 0.0;
        for j in 0..TILE_CELLS {
            for i in 0..TILE_CELLS {
                let at = (j + TILE_RING) * TILE_POSTS + i + TILE_RING;
                let corners =
                    [tile[at], tile[at + 1], tile[at + TILE_POSTS], tile[at + TILE_POSTS + 1]];
                let west = 2 * (u64::from(tx) * TILE_CELLS as u64 + i as u64);
                let south = 2 * (u64::from(ty) * TILE_CELLS as u64 + j as u64);
                let fine = [0, 1, 2].map(|row| {
                    [0, 1, 2].map(|column| {
                        let place = [west + column, south + row];
                        let inside = place[0] < self.grid[0] && place[1] < self.grid[1];
                        inside.then(|| self.at(place))
                    })
                });
                deviation = deviation.max(P::cell_deviation(corners, fine));
                if deviation.is_infinite() {
                    return deviation;
                }
            }
        }
        deviation
    }
}

/// Place of a post of the grid within a tile that contains it.
pub(crate) fn post_in_tile(tile: [u32; 2], post: [u64; 2]) -> usize {
    let local = |axis: usize| {
        (post[axis] + TILE_RING as u64 - u64::from(tile[axis]) * TILE_CELLS as u64) as usize
    };
    local(1) * TILE_POSTS + local(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn colors_average_in_linear_light_and_by_coverage() {
        let [white, black, none] = [[255; 4], [0, 0, 0, 255], [0; 4]];
        let half = <[u8; 4]>::tent([[white, black, none]; 3], None);
        // A third of the covered light is white, and three quarters are covered.
        assert_eq!(half[3], 191);
        assert_eq!(half[0], srgb_of_linear(65535 / 3));
        assert_eq!(<[u8; 4]>::tent([[white, none, none]; 3], None), [255, 255, 255, 64]);
        assert_eq!(<[u8; 4]>::tent([[none; 3]; 3], None), none);
    }

    #[test]
    fn a_coarse_post_is_void_only_if_all_nine_are() {
        let void = f32::NAN;
        let lone = f32::tent([[void, void, void], [void, void, 7.0], [void; 3]], None);
        assert_eq!(lone, 7.0);
        assert!(f32::tent([[void; 3]; 3], None).is_nan());
    }

    /// A level of so many posts from a rule.
    fn level(grid: [u64; 2], rule: impl Fn(u64, u64) -> f32) -> FinePosts<f32> {
        let window = PostWindow { i0: 0, j0: 0, width: grid[0] as usize, height: grid[1] as usize };
        let posts = (0..window.area() as u64).map(|at| rule(at % grid[0], at / grid[0])).collect();
        FinePosts { grid, window, posts }
    }

    fn coarse_size(grid: [u64; 2]) -> [u64; 2] {
        grid.map(|n| (n - 1).div_ceil(2) + 1)
    }

    #[test]
    fn a_plane_stays_the_plane() {
        let grid = [41, 13];
        let fine = level(grid, |i, j| 3.0 * i as f32 - 2.0 * j as f32);
        let tile = fine.coarse_tile(0, 0, coarse_size(grid), None);
        assert_eq!(tile[post_in_tile([0, 0], [5, 4])], 30.0 - 16.0);
        assert_eq!(fine.deviation(0, 0, &tile), 0.0);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]

        #[test]
        fn no_point_of_the_coarse_surface_is_further_than_the_deviation(
            width in 2u64..12, height in 2u64..12, seed: u64, holes in 0u64..3,
            relief in prop::sample::select(vec![1000.0f32, 3.0, 0.05]),
            step in prop::sample::select(vec![None, Some(1.0 / 64.0), Some(1.0 / 8.0)]),
        ) {
            let value = |i: u64, j: u64| {
                let mixed = (seed ^ i << 8 ^ j).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
                if mixed % 16 < holes { f32::NAN } else { (mixed % 1000) as f32 * (relief / 1000.0) }
            };
            let grid = [width, height];
            let fine = level(grid, value);
            let tile = fine.coarse_tile(0, 0, coarse_size(grid), step);
            let deviation = fine.deviation(0, 0, &tile);
            let mut largest: f64 = 0.0;
            for step_j in 0..=(height - 1) * 5 {
                for step_i in 0..=(width - 1) * 5 {
                    let [x, y] = [step_i, step_j].map(|step| step as f64 / 5.0);
                    let fine = bilinear(x, y, width, height, |i, j| fine.at([i, j]));
                    let [w, h] = coarse_size(grid);
                    let coarse =
                        bilinear(x / 2.0, y / 2.0, w, h, |i, j| tile[post_in_tile([0, 0], [i, j])]);
                    prop_assert!(!coarse.is_nan() || fine.is_nan(), "the coarse surface covers the fine one");
                    if deviation.is_finite() && !fine.is_nan() {
                        largest = largest.max((fine - coarse).abs());
                    }
                }
            }
            prop_assert!(largest <= deviation + 1e-9, "{largest} > {deviation}");
            if deviation.is_finite() {
                prop_assert!(deviation <= largest + 1e-9, "the deviation is reached at a fine post");
            }
        }
    }

    fn bilinear(x: f64, y: f64, w: u64, h: u64, post: impl Fn(u64, u64) -> f32) -> f64 {
        let (i, j) = ((x as u64).min(w - 2), (y as u64).min(h - 2));
        let (u, v) = (x - i as f64, y - j as f64);
        let row = |j| f64::from(post(i, j)) * (1.0 - u) + f64::from(post(i + 1, j)) * u;
        row(j) * (1.0 - v) + row(j + 1) * v
    }
}
