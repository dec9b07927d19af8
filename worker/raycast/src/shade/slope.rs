//! Slopes of the ground at the scale of a pixel.
//!
//! Central differences at the four posts around a place, bilinear between, from the
//! level of the height pyramid whose posts are as far apart as pixels are: shading from
//! finer posts than a pixel can show would glitter at the horizon.
//!
//! Step by step for some places at once, as in `photo`.

use super::batch::{Each, VECTORS};
use super::level::{Between, first, shrink};
use super::sheets::{Sheet, Sheets, Soil, Spot, TILE_BITS};
use super::square::{Square, first_of};
use crate::field::Wanted;
use crate::lanes::as_bits;
use crate::lanes::{Floats, Ints, Lanes, Mask};
use terrafarm_terrain::layout::TILE_POSTS;
use terrafarm_terrain::tile::{Codes, Floats as Floats32, HeightTile, Heights, VOID};

/// How far off a layer's posts, in posts, a contact may lie by rounding.
const ROUNDING_POSTS: f32 = 0.01;

/// Places of a batch in one layer, and the cells around them in one of its levels. Masks
/// are bits, one word a vector.
pub(crate) struct Cells {
    /// The places that the layer shows.
    pub lanes: [u32; VECTORS],
    cell: [Each<i32>; 2],
    part: [Each<f32>; 2],
    /// The finer level, and the share of the coarser one.
    level: Each<i32>,
    coarser: Each<f32>,
    /// The places whose cells are to be read.
    wanted: [u32; VECTORS],
    /// Of a cell in its level: the tile, the post in it before the cell's own along both
    /// axes, and the place in the cell.
    number: Each<i32>,
    post: Each<i32>,
    place: [Each<f32>; 2],
    /// The square that has the posts around all of them, if there is one.
    square: [Square; VECTORS],
}

impl Cells {
    pub(crate) fn new() -> Self {
        let (none, zero) = (Each::new(0.0), Each::new(0));
        Cells {
            lanes: [0; VECTORS],
            cell: [zero; 2],
            part: [none; 2],
            level: zero,
            coarser: none,
            wanted: [0; VECTORS],
            number: zero,
            post: zero,
            place: [none; 2],
            square: [Square::NONE; VECTORS],
        }
    }

    /// No place of vector `n` sees the layer.
    #[inline(always)]
    pub(crate) fn leave(&mut self, n: usize) {
        self.lanes[n] = 0;
    }

    /// Finds the places of vector `n`, so many metres east and north of the camera, for
    /// pixels `size_m` across there. The lowest layer takes what is beside all layers by
    /// rounding.
    #[inline(always)]
    pub(crate) fn lay<L: Lanes>(
        &mut self,
        sheets: &Sheets<HeightTile>,
        n: usize,
        along: [L::F; 2],
        size_m: L::F,
        lanes: L::M,
        is_lowest: bool,
    ) {
        let at = n * L::N;
        let (inside, spot) = sheets.spot::<L>(along, ROUNDING_POSTS);
        let here = if is_lowest { lanes } else { lanes & inside };
        self.lanes[n] = here.bits();
        let finest = sheets.rate[0].min(sheets.rate[1]);
        let between = Between::<L>::of(size_m * L::F::splat(finest), sheets.top());
        for axis in 0..2 {
            spot.cell[axis].store(&mut self.cell[axis][at..]);
            spot.part[axis].store(&mut self.part[axis][at..]);
        }
        between.level.store(&mut self.level[at..]);
        between.share.store(&mut self.coarser[at..]);
    }

    #[inline(always)]
    fn level<L: Lanes>(&self, at: usize, is_coarser: bool) -> L::I {
        L::I::load(&self.level[at..]) + L::I::splat(i32::from(is_coarser))
    }

    /// Finds the cells of vector `n` in the finer level, or in the coarser one.
    #[inline(always)]
    pub(crate) fn place<L: Lanes>(
        &mut self,
        sheets: &Sheets<HeightTile>,
        n: usize,
        is_coarser: bool,
    ) {
        let at = n * L::N;
        let coarser = L::F::load(&self.coarser[at..]);
        let shown =
            if is_coarser { L::F::splat(0.0).lt(coarser) } else { coarser.lt(L::F::splat(1.0)) };
        let wanted = L::M::from_bits(self.lanes[n]) & shown;
        self.wanted[n] = wanted.bits();
        if !wanted.any() {
            return;
        }
        let level = self.level::<L>(at, is_coarser);
        let mut known = first::<L>(level, wanted);
        let [x, y] = sheets.sheet(known).last_tile;
        let mut last = [L::I::splat(x), L::I::splat(y)];
        let mut left = wanted & !level.eq(L::I::splat(known));
        while left.any() {
            known = first::<L>(level, left);
            let here = left & level.eq(L::I::splat(known));
            let other = sheets.sheet(known).last_tile;
            for axis in 0..2 {
                last[axis] = L::I::select(here, L::I::splat(other[axis]), last[axis]);
            }
            left = left & !here;
        }
        let [x, y] = &self.cell;
        let [x_part, y_part] = &self.part;
        let spot: Spot<L> = Spot {
            cell: [L::I::load(&x[at..]), L::I::load(&y[at..])],
            part: [L::F::load(&x_part[at..]), L::F::load(&y_part[at..])],
        };
        let spot = spot.at_level(level);
        let (tx, i) = Sheet::tile_of::<L>(last[0], spot.cell[0]);
        let (ty, j) = Sheet::tile_of::<L>(last[1], spot.cell[1]);
        let number = ty.times(last[0] + L::I::splat(1)) + tx;
        number.store(&mut self.number[at..]);
        let (post, [x, y]) = post::<L>([i, j], spot.part);
        let around = L::I::splat(3 << 16 | 3);
        self.square[n] = Square::of::<L>([level, number], [post, post + around], wanted);
        post.store(&mut self.post[at..]);
        x.store(&mut self.place[0][at..]);
        y.store(&mut self.place[1][at..]);
    }

    /// The slopes along x and y of the cells of vector `n` that [`Cells::place`] has found:
    /// of the coarser level, they are blended with those of the finer one. Places whose
    /// tiles are not loaded are added to `unsure`, and the tiles to `missing`.
    #[inline(always)]
    pub(crate) fn read<L: Lanes>(
        &self,
        sheets: &mut Sheets<HeightTile>,
        n: usize,
        is_coarser: bool,
        slopes: &mut [Each<f32>; 2],
        unsure: &mut u32,
        missing: &mut Wanted,
    ) {
        let mut left = L::M::from_bits(self.wanted[n]);
        if !left.any() {
            return;
        }
        let at = n * L::N;
        let [x, y] = &self.place;
        let place = [L::F::load(&x[at..]), L::F::load(&y[at..])];
        let (number, post) = (L::I::load(&self.number[at..]), L::I::load(&self.post[at..]));
        let level = self.level::<L>(at, is_coarser);
        // What one level alone shows is not blended with the other.
        let share = if is_coarser { L::F::load(&self.coarser[at..]) } else { L::F::splat(1.0) };
        let [x, y] = &*slopes;
        let mut found = [L::F::load(&x[at..]), L::F::load(&y[at..])];
        while left.any() {
            let square = self.square[n];
            let ([known_level, known], here) = square.next::<L>([level, number], left);
            left = left & !here;
            let tile = match sheets.tile(known_level, known, missing) {
                Soil::Tile(tile) => tile,
                Soil::Empty => continue,
                Soil::Absent => {
                    *unsure |= here.bits();
                    continue;
                }
            };
            let (known, rise) = rises::<L>(tile, post, place, here, square.corner);
            let scale = shrink::<L>(L::I::splat(known_level));
            for axis in 0..2 {
                let slope = rise[axis] * (scale * L::F::splat(sheets.rate[axis]));
                let slope = lerp::<L>(found[axis], slope, share);
                found[axis] = L::F::select(here & known, slope, found[axis]);
            }
        }
        for axis in 0..2 {
            found[axis].store(&mut slopes[axis][at..]);
        }
    }
}

/// The post to the south-west of a cell's own, of which there is a ring: column, and from bit
/// 16 on the row. And the place in the cell.
#[inline(always)]
fn post<L: Lanes>(cell: [L::I; 2], part: [L::F; 2]) -> (L::I, [L::F; 2]) {
    // The last tile's last post is the end of a cell, too.
    let most = L::I::splat((1 << TILE_BITS) - 1);
    let (i, j) = (cell[0].min(most), cell[1].min(most));
    let x = part[0] + (cell[0] - i).to_floats();
    let y = part[1] + (cell[1] - j).to_floats();
    (j.shl(L::I::splat(16)) + i, [x, y])
}

/// Rise a cell along x and y, and whether any post around knows of one. If there is a corner,
/// its square has all posts around the lanes' cells.
#[inline(always)]
fn rises<L: Lanes>(
    tile: &HeightTile,
    at: L::I,
    [x, y]: [L::F; 2],
    lanes: L::M,
    corner: Option<i32>,
) -> (L::M, [L::F; 2]) {
    match tile.heights() {
        Heights::Codes(codes) if !tile.has_voids() => {
            let around = match corner {
                Some(corner) => {
                    let from = at - L::I::splat(corner);
                    L::I::around_in(codes.posts, first_of(corner), TILE_POSTS, from)
                }
                None => L::I::gather_around(codes.posts, at, TILE_POSTS, lanes),
            };
            let [dx, dy] = whole_codes::<L>(around, [x, y]);
            let half = L::F::splat((0.5 * codes.step) as f32);
            (!L::M::none(), [dx * half, dy * half])
        }
        Heights::Codes(codes) => holed::<L>(&coded::<L>(&codes, at, lanes), [x, y]),
        Heights::Floats(floats) => holed::<L>(&plain::<L>(&floats, at, lanes), [x, y]),
    }
}

/// Twice the rise a cell where no post is void, in steps of the codes, from the codes around.
#[inline(always)]
fn whole_codes<L: Lanes>(around: [L::I; 6], [x, y]: [L::F; 2]) -> [L::F; 2] {
    let (low, sixteen) = (L::I::splat(0xFFFF), L::I::splat(16));
    let [z12, a01, a23, b01, b23, y12] = around;
    let (a0, a1) = (a01 & low, a01.shr(sixteen) & low);
    let (a2, a3) = (a23 & low, a23.shr(sixteen) & low);
    let (b0, b1) = (b01 & low, b01.shr(sixteen) & low);
    let (b2, b3) = (b23 & low, b23.shr(sixteen) & low);
    let (z1, z2) = (z12 & low, z12.shr(sixteen) & low);
    let (y1, y2) = (y12 & low, y12.shr(sixteen) & low);
    let south = lerp::<L>((a2 - a0).to_floats(), (a3 - a1).to_floats(), x);
    let north = lerp::<L>((b2 - b0).to_floats(), (b3 - b1).to_floats(), x);
    let west = lerp::<L>((b1 - z1).to_floats(), (y1 - a1).to_floats(), y);
    let east = lerp::<L>((b2 - z2).to_floats(), (y2 - a2).to_floats(), y);
    [lerp::<L>(south, north, y), lerp::<L>(west, east, x)]
}

/// The twelve posts around a cell and beside these, by rows from the south: two, four,
/// four, two. NaN for a void.
type Posts<L> = [<L as Lanes>::F; 12];

#[inline(always)]
fn coded<L: Lanes>(codes: &Codes, at: L::I, lanes: L::M) -> Posts<L> {
    let [z12, a01, a23, b01, b23, y12] = L::I::gather_around(codes.posts, at, TILE_POSTS, lanes);
    let step = codes.step as f32;
    [
        height::<L>(z12, false, step),
        height::<L>(z12, true, step),
        height::<L>(a01, false, step),
        height::<L>(a01, true, step),
        height::<L>(a23, false, step),
        height::<L>(a23, true, step),
        height::<L>(b01, false, step),
        height::<L>(b01, true, step),
        height::<L>(b23, false, step),
        height::<L>(b23, true, step),
        height::<L>(y12, false, step),
        height::<L>(y12, true, step),
    ]
}

/// Height over the tile's base of the upper or lower of a pair of codes.
#[inline(always)]
fn height<L: Lanes>(pair: L::I, upper: bool, step: f32) -> L::F {
    let code = if upper { pair.shr(L::I::splat(16)) } else { pair } & L::I::splat(0xFFFF);
    let known = code.lt(L::I::splat(i32::from(VOID)));
    L::F::select(known, code.to_floats() * L::F::splat(step), L::F::splat(f32::NAN))
}

#[inline(always)]
fn plain<L: Lanes>(floats: &Floats32, at: L::I, lanes: L::M) -> Posts<L> {
    let width = L::I::splat(TILE_POSTS as i32);
    let at = at.shr(L::I::splat(16)).times(width) + (at & L::I::splat(0xFFFF));
    let two = L::I::splat(2);
    let posts = as_bits(floats.posts);
    let (south, middle, north) = (at + width, at + width + width, at + width + width + width);
    let (z1, z2) = L::I::gather_twos(posts, at + L::I::splat(1), lanes);
    let (a0, a1) = L::I::gather_twos(posts, south, lanes);
    let (a2, a3) = L::I::gather_twos(posts, south + two, lanes);
    let (b0, b1) = L::I::gather_twos(posts, middle, lanes);
    let (b2, b3) = L::I::gather_twos(posts, middle + two, lanes);
    let (y1, y2) = L::I::gather_twos(posts, north + L::I::splat(1), lanes);
    [
        L::F::from_bits(z1),
        L::F::from_bits(z2),
        L::F::from_bits(a0),
        L::F::from_bits(a1),
        L::F::from_bits(a2),
        L::F::from_bits(a3),
        L::F::from_bits(b0),
        L::F::from_bits(b1),
        L::F::from_bits(b2),
        L::F::from_bits(b3),
        L::F::from_bits(y1),
        L::F::from_bits(y2),
    ]
}

/// Rises blended from those posts of the cell that have any.
#[inline(always)]
fn holed<L: Lanes>(posts: &Posts<L>, [x, y]: [L::F; 2]) -> (L::M, [L::F; 2]) {
    let [z1, z2, a0, a1, a2, a3, b0, b1, b2, b3, y1, y2] = *posts;
    let one = L::F::splat(1.0);
    let (west, south) = (one - x, one - y);
    let zero = L::F::splat(0.0);
    let mut sum = [zero; 3];
    add::<L>(&mut sum, west * south, rise::<L>(a0, a1, a2), rise::<L>(z1, a1, b1));
    add::<L>(&mut sum, x * south, rise::<L>(a1, a2, a3), rise::<L>(z2, a2, b2));
    add::<L>(&mut sum, west * y, rise::<L>(b0, b1, b2), rise::<L>(a1, b1, y1));
    add::<L>(&mut sum, x * y, rise::<L>(b1, b2, b3), rise::<L>(a2, b2, y2));
    let share = one.div(sum[2]);
    (zero.lt(sum[2]), [sum[0] * share, sum[1] * share])
}

#[inline(always)]
fn add<L: Lanes>(sum: &mut [L::F; 3], weight: L::F, dx: L::F, dy: L::F) {
    let zero = L::F::splat(0.0);
    let known = dx.eq(dx) & dy.eq(dy);
    sum[0] = sum[0] + L::F::select(known, weight * dx, zero);
    sum[1] = sum[1] + L::F::select(known, weight * dy, zero);
    sum[2] = sum[2] + L::F::select(known, weight, zero);
}

/// The rise per cell at a post between two others; one-sided beside a void.
#[inline(always)]
fn rise<L: Lanes>(before: L::F, post: L::F, after: L::F) -> L::F {
    let (back, on) = (post - before, after - post);
    let both = (back + on) * L::F::splat(0.5);
    let either = L::F::select(on.eq(on), on, back);
    L::F::select(both.eq(both), both, either)
}

#[inline(always)]
pub(crate) fn lerp<L: Lanes>(a: L::F, b: L::F, t: L::F) -> L::F {
    a + (b - a) * t
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::{self, Kernel, MOST, One, Width};
    use proptest::prelude::*;

    /// Rises in a cell of a tile; `None` if no post knows of any.
    fn at(tile: &HeightTile, cell: [i32; 2], part: [f32; 2]) -> Option<[f32; 2]> {
        let lanes = <One as Lanes>::M::from_bits(1);
        let (post, place) = post::<One>(cell.map(Ints::splat), part.map(Floats::splat));
        let (known, rise) = rises::<One>(tile, post, place, lanes, None);
        let mut found = [[0.0f32; 1]; 2];
        rise[0].store(&mut found[0]);
        rise[1].store(&mut found[1]);
        known.any().then_some([found[0][0], found[1][0]])
    }

    /// Slopes at cells that are close together, out of a square and lane by lane.
    struct Squares<'t> {
        tile: &'t HeightTile,
        /// The first cell, and how far the others are from it at most.
        from: [i32; 2],
        reach: i32,
        seed: u32,
    }

    impl Kernel for Squares<'_> {
        /// Whether there was a square.
        type Output = bool;

        #[inline(always)]
        fn run<L: Lanes>(self) -> bool {
            let mut random = self.seed;
            let mut next = |most: i32| {
                random = random.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
                (random >> 16) as i32 % (most + 1)
            };
            let (mut cells, mut parts) = ([[0; MOST]; 2], [[0.0; MOST]; 2]);
            for lane in 0..MOST {
                for axis in 0..2 {
                    let cell = self.from[axis] + next(self.reach);
                    cells[axis][lane] = cell.min(1 << TILE_BITS);
                    let end = cell >= 1 << TILE_BITS;
                    parts[axis][lane] = if end { 0.0 } else { next(999) as f32 * 1e-3 };
                }
            }
            let lanes = L::M::from_bits((1 + next(0xFFFE) as u32) & ((1 << L::N) - 1) | 1);
            let cell = [L::I::load(&cells[0]), L::I::load(&cells[1])];
            let part = [L::F::load(&parts[0]), L::F::load(&parts[1])];
            let (post, place) = post::<L>(cell, part);
            let zero = L::I::splat(0);
            let end = post + L::I::splat(3 << 16 | 3);
            let square = Square::of::<L>([zero, zero], [post, end], lanes);
            let (known, rise) = rises::<L>(self.tile, post, place, lanes, square.corner);
            let mut found = [[0.0f32; MOST]; 2];
            rise[0].store(&mut found[0]);
            rise[1].store(&mut found[1]);
            for lane in (0..L::N).filter(|lane| lanes.bits() >> lane & 1 == 1) {
                let cell = [cells[0][lane], cells[1][lane]];
                let alone = at(self.tile, cell, [parts[0][lane], parts[1][lane]]);
                assert_eq!(alone.is_some(), known.bits() >> lane & 1 == 1);
                if let Some(alone) = alone {
                    let found = [found[0][lane], found[1][lane]];
                    assert_eq!(found.map(f32::to_bits), alone.map(f32::to_bits), "{cell:?}");
                }
            }
            square.corner.is_some()
        }
    }

    proptest! {
        #[test]
        fn a_square_of_posts_gives_the_slopes_of_each_place_alone(
            x in 0..=256,
            y in 0..=256,
            edges in 0..4,
            reach in 0..10,
            holes in 0u32..3,
            seed: u32,
        ) {
            let from = [if edges & 1 == 1 { 252 } else { x }, if edges & 2 == 2 { 252 } else { y }];
            let noise = |x: f32, y: f32| {
                ((x as i32 as u32).wrapping_mul(7919) ^ (y as i32 as u32).wrapping_mul(104_729))
                    .wrapping_add(seed).wrapping_mul(2_654_435_761) >> 16
            };
            let tile = tile(|x, y| match noise(x, y) {
                n if n % 64 < holes => f32::NAN,
                n => (n % 65_000) as f32,
            });
            for width in Width::available() {
                let squares = lanes::run(Squares { tile: &tile, from, reach, seed }, width);
                prop_assert!(!squares || width == Width::Sixteen);
                prop_assert!(squares || width != Width::Sixteen || reach > 4);
            }
        }
    }

    fn tile(height: impl Fn(f32, f32) -> f32) -> HeightTile {
        let posts = (0..TILE_POSTS * TILE_POSTS)
            .map(|at| height((at % TILE_POSTS) as f32 - 1.0, (at / TILE_POSTS) as f32 - 1.0));
        HeightTile::new(posts.collect()).expect("the number of posts fits")
    }

    #[test]
    fn a_plane_has_the_same_slope_everywhere_also_beside_voids() {
        let plane = tile(|x, y| 3.0 * x - 2.0 * y);
        assert_eq!(at(&plane, [0, 255], [0.3, 0.9]), Some([3.0, -2.0]));
        assert_eq!(at(&plane, [256, 256], [0.0, 0.0]), Some([3.0, -2.0]));
        let holed = tile(|x, y| if x == 5.0 && y == 5.0 { f32::NAN } else { 3.0 * x - 2.0 * y });
        assert_eq!(at(&holed, [6, 5], [0.25, 0.5]), Some([3.0, -2.0]));
        assert_eq!(at(&tile(|_, _| f32::NAN), [6, 5], [0.25, 0.5]), None);
    }

    #[test]
    fn all_forms_of_tiles_agree() {
        let rough = |x: f32, y: f32| ((x * 7919.0 + y * 104_729.0) % 1009.0) * 0.25;
        let codes = tile(rough);
        let holed = tile(|x, y| if x == 77.0 && y == 99.0 { f32::NAN } else { rough(x, y) });
        // No step fits both this and the rest.
        let odd = |x, y| if x == 77.0 && y == 99.0 { 1.234_567e-7 } else { rough(x, y) };
        let floats = tile(odd);
        assert!(matches!(codes.heights(), Heights::Codes(_)) && holed.has_voids());
        assert!(matches!(floats.heights(), Heights::Floats(_)));
        for cell in [[0, 0], [17, 200], [255, 255], [128, 3], [256, 7]] {
            for part in [[0.0, 0.0], [0.25, 0.75], [0.9, 0.1]] {
                let part = if cell[0] == 256 { [0.0, part[1]] } else { part };
                let [a, b, c] = [&codes, &holed, &floats]
                    .map(|tile| at(tile, cell, part).expect("no post near is void"));
                for axis in 0..2 {
                    assert!((a[axis] - b[axis]).abs() < 1e-3, "{a:?} {b:?}");
                    assert!((a[axis] - c[axis]).abs() < 1e-3, "{a:?} {c:?}");
                }
            }
        }
    }
}
