//! The posts of a plot between two levels.
//!
//! A plot at level L whose tolerance is on its way from the deviation of L to that of L + 1
//! is seen at `(1 - w) h + w up(g)`: h the heights of L, g those of L + 1, `up` bilinear
//! between the posts of L + 1. On a cell of L both are bilinear, so the mean of the posts is
//! the mean of the surfaces, and no further from level 0 than the mean of the deviations.
//! With [`weight`] that is at most what is allowed; and where w comes to 1, L + 1 is allowed
//! and the plot is seen at it: no surface jumps when levels change, but for a `1 / STEPS` of
//! the way between them.

use terrafarm_terrain::layout::{TILE_CELLS, TILE_POSTS, TILE_RING};
use terrafarm_terrain::tile::{HeightTile, Heights, VOID};

/// Steps of the weight from one level to the next.
pub(crate) const STEPS: u32 = 32;
/// The coarser level begins to count at this share of its deviation: closer by, where most
/// of a tile is seen at once, plots are seen as they are in their tiles.
const BEGINS: f64 = 0.5;
/// What rounding may add to the deviation: a share of the heights' extent (half of a
/// 65532nd for the codes, the rest for single precision on the way), and metres.
const ROUNDING: f64 = 1.0 / 120_000.0;
const ROUNDING_M: f64 = 1e-5;
/// The highest code of a post; the lowest is 1.
const HIGHEST: f64 = 65_533.0;
/// The least step between codes, metres.
const LEAST_STEP_M: f64 = 1.0 / 65_536.0;

/// Blended posts of a plot, `side` rows of `side` from the south-west.
pub(crate) struct Patch {
    /// Codes as those of a tile, and one pad.
    pub codes: Box<[u16]>,
    /// Height of code 0 and what a code adds, metres.
    pub base: f64,
    pub step: f64,
    /// Posts along a side.
    pub side: usize,
    /// How far a post may be above that of the finer tile, metres.
    pub lift: f32,
}

/// How much of the coarser level a plot is seen at, in [`STEPS`], from what its distance
/// allows, the deviations of its level and of the coarser one, and the extent of the heights
/// of both tiles; all metres. Rounded down: the deviation of the mean is at most `allowed`.
pub(crate) fn weight(allowed: f64, [fine, coarse]: [f64; 2], extent: f64) -> u32 {
    let begin = fine.max(BEGINS * coarse);
    let rounding = ROUNDING * extent + ROUNDING_M;
    let share = (allowed - rounding - begin) / (coarse - begin);
    // A coarser level that cannot be compared has an infinite deviation and no share.
    if share > 0.0 { ((share * f64::from(STEPS)) as u32).min(STEPS - 1) } else { 0 }
}

impl Patch {
    /// The posts of a plot of which `fine` is the tile at `level` and `coarse` the next
    /// coarser one, with so many [`STEPS`] of the latter. The level is at most
    /// `MAXIMA_LEVELS - 1`. Where either is void, so is the patch.
    pub(crate) fn new(
        plot: [i32; 2],
        level: u32,
        weight: u32,
        fine: &HeightTile,
        coarse: &HeightTile,
    ) -> Patch {
        let cells = TILE_CELLS >> level;
        let (side, half) = (cells + 1, cells / 2 + 1);
        // Place of the plot's south-west post among those of its tile.
        let corner = |level: u32| {
            plot.map(|at| (at as usize & ((1 << level) - 1)) * (TILE_CELLS >> level) + TILE_RING)
        };
        let (at, below) = (corner(level), corner(level + 1));
        let origin = origin(fine);
        let share = weight as f32 / STEPS as f32;
        let mut heights = vec![0.0f32; side * side];
        let mut extents = Extents::new(side);
        let (mut own, mut up) = (vec![0.0f32; side], vec![0.0f32; side]);
        let [mut south, mut north, mut middle] = [(); 3].map(|()| vec![0.0f32; half]);
        read(coarse, below, origin, &mut north);
        for (row, heights) in heights.chunks_exact_mut(side).enumerate() {
            read(fine, [at[0], at[1] + row], origin, &mut own);
            if row % 2 == 0 {
                std::mem::swap(&mut south, &mut north);
                if row + 1 < side {
                    read(coarse, [below[0], below[1] + row / 2 + 1], origin, &mut north);
                }
                spread(&south, &mut up);
            } else {
                for ((middle, south), north) in middle.iter_mut().zip(&south).zip(&north) {
                    *middle = 0.5 * (south + north);
                }
                spread(&middle, &mut up);
            }
            for ((height, own), up) in heights.iter_mut().zip(&own).zip(&up) {
                *height = own + share * (up - own);
            }
            extents.add(heights, &own);
        }
        coded(&heights, &extents.whole(), origin, side)
    }

    /// Bytes that it takes in memory.
    pub(crate) fn memory_bytes(&self) -> usize {
        size_of_val(&*self.codes) + size_of::<Patch>()
    }
}

/// The lowest and the highest post, and by how much the highest above that of the tile is;
/// column by column, so that columns are done at once.
struct Extents {
    columns: [Vec<f32>; 3],
}

impl Extents {
    fn new(side: usize) -> Self {
        Extents { columns: [f32::INFINITY, f32::NEG_INFINITY, 0.0].map(|none| vec![none; side]) }
    }

    /// Voids are NaN, which no comparison finds to be beyond anything.
    fn add(&mut self, heights: &[f32], own: &[f32]) {
        let [lows, highs, lifts] = &mut self.columns;
        for (low, &height) in lows.iter_mut().zip(heights) {
            *low = if height < *low { height } else { *low };
        }
        for (high, &height) in highs.iter_mut().zip(heights) {
            *high = if height > *high { height } else { *high };
        }
        for ((lift, height), own) in lifts.iter_mut().zip(heights).zip(own) {
            let above = height - own;
            *lift = if above > *lift { above } else { *lift };
        }
    }

    fn whole(&self) -> [f32; 3] {
        let [lows, highs, lifts] = &self.columns;
        [
            lows.iter().copied().fold(f32::INFINITY, f32::min),
            highs.iter().copied().fold(f32::NEG_INFINITY, f32::max),
            lifts.iter().copied().fold(0.0, f32::max),
        ]
    }
}

/// A height close to those of a tile, from which they are counted in single precision.
fn origin(tile: &HeightTile) -> f64 {
    match tile.heights() {
        Heights::Codes(codes) => f64::from(codes.base) * codes.step,
        Heights::Floats(floats) => {
            floats.posts.iter().find(|post| !post.is_nan()).map_or(0.0, |post| f64::from(*post))
        }
    }
}

/// Posts of a row of a tile, by column and row with the ring, from a place eastwards;
/// NaN for a void.
fn read(tile: &HeightTile, [column, row]: [usize; 2], origin: f64, into: &mut [f32]) {
    let at = row * TILE_POSTS + column;
    match tile.heights() {
        Heights::Codes(codes) => {
            let base = (f64::from(codes.base) * codes.step - origin) as f32;
            let step = codes.step as f32;
            for (post, &code) in into.iter_mut().zip(&codes.posts[at..]) {
                let height = base + f32::from(code) * step;
                *post = if code == VOID { f32::NAN } else { height };
            }
        }
        Heights::Floats(floats) => {
            for (post, &height) in into.iter_mut().zip(&floats.posts[at..]) {
                *post = (f64::from(height) - origin) as f32;
            }
        }
    }
}

/// A row of coarse posts with the means of neighbours between them.
fn spread(coarse: &[f32], fine: &mut [f32]) {
    for (pair, posts) in fine.chunks_exact_mut(2).zip(coarse.windows(2)) {
        pair[0] = posts[0];
        pair[1] = 0.5 * (posts[0] + posts[1]);
    }
    if let (Some(last), Some(post)) = (fine.last_mut(), coarse.last()) {
        *last = *post;
    }
}

/// Heights as codes of the finest step that their extent has.
fn coded(heights: &[f32], &[low, high, lift]: &[f32; 3], origin: f64, side: usize) -> Patch {
    // Nothing but voids: any extent does.
    let (low, high) = if low <= high { (low, high) } else { (0.0, 0.0) };
    let step = ((f64::from(high) - f64::from(low)) / (HIGHEST - 1.0)).max(LEAST_STEP_M);
    let inverse = (1.0 / step) as f32;
    let mut codes = vec![VOID; heights.len() + 1];
    for (code, &height) in codes.iter_mut().zip(heights) {
        let value = ((height - low) * inverse + 1.5) as i32 as u16;
        *code = if height.is_nan() { VOID } else { value };
    }
    Patch {
        codes: codes.into_boxed_slice(),
        base: origin + f64::from(low) - step,
        step,
        side,
        // Codes are rounded by half a step.
        lift: lift + step as f32,
    }
}

#[cfg(test)]
mod tests;
