//! Slopes of the ground at the scale of a pixel.
//!
//! Central differences at the four posts around a place, bilinear between, from the
//! level of the height pyramid whose posts are as far apart as pixels are: shading from
//! finer posts than a pixel can show would glitter at the horizon.

use super::level::{Between, first, shrink};
use super::sheets::{Sheet, Sheets, Soil, Spot, TILE_BITS};
use crate::field::Wanted;
use crate::lanes::as_bits;
use crate::lanes::{Floats, Ints, Lanes, Mask};
use terrafarm_terrain::layout::TILE_POSTS;
use terrafarm_terrain::tile::{Codes, Floats as Floats32, HeightTile, Heights, VOID};

/// How far off a layer's posts, in posts, a contact may lie by rounding.
const ROUNDING_POSTS: f32 = 0.01;

/// Slopes along x and y.
pub(crate) struct Slopes<L: Lanes> {
    pub slopes: [L::F; 2],
    /// A tile was missing.
    pub unsure: L::M,
}

/// Slopes of the uppermost layer at places so many metres east and north of the camera,
/// for pixels `size_m` across there.
#[inline(always)]
pub(crate) fn slopes<L: Lanes>(
    layers: &mut [Sheets<HeightTile>],
    along: [L::F; 2],
    size_m: L::F,
    lanes: L::M,
    wanted: &mut Wanted,
) -> Slopes<L> {
    let zero = L::F::splat(0.0);
    let mut found: Slopes<L> = Slopes { slopes: [zero; 2], unsure: L::M::none() };
    let mut left = lanes;
    let mut number = layers.len();
    while number > 0 && left.any() {
        number -= 1;
        let sheets = &mut layers[number];
        let (inside, spot) = sheets.spot::<L>(along, ROUNDING_POSTS);
        // The lowest takes what is beside all layers by rounding.
        let here = if number == 0 { left } else { left & inside };
        if here.any() {
            of_layer::<L>(sheets, &spot, size_m, here, &mut found, wanted);
        }
        left = left & !here;
    }
    found
}

#[inline(always)]
fn of_layer<L: Lanes>(
    sheets: &mut Sheets<HeightTile>,
    spot: &Spot<L>,
    size_m: L::F,
    lanes: L::M,
    found: &mut Slopes<L>,
    wanted: &mut Wanted,
) {
    let zero = L::F::splat(0.0);
    let finest = sheets.rate[0].min(sheets.rate[1]);
    let between = Between::<L>::of(size_m * L::F::splat(finest), sheets.top());
    let mut pass = 0;
    while pass < 2 {
        let level = between.level + L::I::splat(pass);
        let needed = if pass == 0 {
            lanes & between.share.lt(L::F::splat(1.0))
        } else {
            lanes & zero.lt(between.share)
        };
        // What one level alone shows is not blended with the other.
        let share = if pass == 0 { L::F::splat(1.0) } else { between.share };
        let place = spot.at_level(level);
        let mut left = needed;
        while left.any() {
            let here_level = first::<L>(level, left);
            let sheet = sheets.sheet(here_level);
            let last = sheet.last_tile;
            let (tx, i) = Sheet::tile_of::<L>(L::I::splat(last[0]), place.cell[0]);
            let (ty, j) = Sheet::tile_of::<L>(L::I::splat(last[1]), place.cell[1]);
            let tiles = sheet.number::<L>(tx, ty);
            let number = first::<L>(tiles, left);
            let here = left & level.eq(L::I::splat(here_level)) & tiles.eq(L::I::splat(number));
            left = left & !here;
            let tile = match sheets.tile(here_level, number, wanted) {
                Soil::Tile(tile) => tile,
                Soil::Empty => continue,
                Soil::Absent => {
                    found.unsure = found.unsure | here;
                    continue;
                }
            };
            let (known, rise) = rises::<L>(tile, [i, j], place.part, here);
            let scale = shrink::<L>(L::I::splat(here_level));
            for axis in 0..2 {
                let slope = rise[axis] * (scale * L::F::splat(sheets.rate[axis]));
                let before = found.slopes[axis];
                let slope = before + (slope - before) * share;
                found.slopes[axis] = L::F::select(here & known, slope, before);
            }
        }
        pass += 1;
    }
}

/// Rise a cell along x and y, and whether any post around knows of one.
#[inline(always)]
fn rises<L: Lanes>(
    tile: &HeightTile,
    cell: [L::I; 2],
    part: [L::F; 2],
    lanes: L::M,
) -> (L::M, [L::F; 2]) {
    // The last tile's last post is the end of a cell, too.
    let most = L::I::splat((1 << TILE_BITS) - 1);
    let (i, j) = (cell[0].min(most), cell[1].min(most));
    let x = part[0] + (cell[0] - i).to_floats();
    let y = part[1] + (cell[1] - j).to_floats();
    // The post to the south-west of the cell's own; there is a ring.
    let at = j.times(L::I::splat(TILE_POSTS as i32)) + i;
    match tile.heights() {
        Heights::Codes(codes) if !tile.has_voids() => {
            let [dx, dy] = whole_codes::<L>(&codes, at, [x, y], lanes);
            let half = L::F::splat((0.5 * codes.step) as f32);
            (!L::M::none(), [dx * half, dy * half])
        }
        Heights::Codes(codes) => holed::<L>(&coded::<L>(&codes, at, lanes), [x, y]),
        Heights::Floats(floats) => holed::<L>(&plain::<L>(&floats, at, lanes), [x, y]),
    }
}

/// Twice the rise a cell where no post is void, in steps of the codes.
#[inline(always)]
fn whole_codes<L: Lanes>(codes: &Codes, at: L::I, [x, y]: [L::F; 2], lanes: L::M) -> [L::F; 2] {
    let width = L::I::splat(TILE_POSTS as i32);
    let (low, sixteen) = (L::I::splat(0xFFFF), L::I::splat(16));
    let (z01, z23) = L::I::gather_fours(codes.posts, at, lanes);
    let (a01, a23) = L::I::gather_fours(codes.posts, at + width, lanes);
    let (b01, b23) = L::I::gather_fours(codes.posts, at + width + width, lanes);
    let (y01, y23) = L::I::gather_fours(codes.posts, at + width + width + width, lanes);
    let (a0, a1) = (a01 & low, a01.shr(sixteen) & low);
    let (a2, a3) = (a23 & low, a23.shr(sixteen) & low);
    let (b0, b1) = (b01 & low, b01.shr(sixteen) & low);
    let (b2, b3) = (b23 & low, b23.shr(sixteen) & low);
    let (z1, z2) = (z01.shr(sixteen) & low, z23 & low);
    let (y1, y2) = (y01.shr(sixteen) & low, y23 & low);
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
    let width = L::I::splat(TILE_POSTS as i32);
    let mut at = at;
    let mut rows = [L::I::splat(0); 8];
    let mut row = 0;
    while row < 4 {
        let (west, east) = L::I::gather_fours(codes.posts, at, lanes);
        (rows[2 * row], rows[2 * row + 1]) = (west, east);
        at = at + width;
        row += 1;
    }
    let step = codes.step as f32;
    [
        height::<L>(rows[0], true, step),
        height::<L>(rows[1], false, step),
        height::<L>(rows[2], false, step),
        height::<L>(rows[2], true, step),
        height::<L>(rows[3], false, step),
        height::<L>(rows[3], true, step),
        height::<L>(rows[4], false, step),
        height::<L>(rows[4], true, step),
        height::<L>(rows[5], false, step),
        height::<L>(rows[5], true, step),
        height::<L>(rows[6], true, step),
        height::<L>(rows[7], false, step),
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
    use crate::lanes::One;

    /// Rises in a cell of a tile; `None` if no post knows of any.
    fn at(tile: &HeightTile, cell: [i32; 2], part: [f32; 2]) -> Option<[f32; 2]> {
        let lanes = <One as Lanes>::M::from_bits(1);
        let (known, rise) =
            rises::<One>(tile, cell.map(Ints::splat), part.map(Floats::splat), lanes);
        let mut found = [[0.0f32; 1]; 2];
        rise[0].store(&mut found[0]);
        rise[1].store(&mut found[1]);
        known.any().then_some([found[0][0], found[1][0]])
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
