//! The photo under a pixel: filtered over its footprint.
//!
//! The level of the photo's pyramid follows from the short axis of the footprint; along
//! the long axis texels are averaged. So the photo neither swims at the horizon, where
//! footprints are long and narrow, nor blurs across.
//!
//! The average is that of a row of texels along x or y, whichever the footprint is longer
//! along: each counts by how much of it the footprint covers, and is interpolated across
//! between two neighbours. A footprint one texel long thus is bilinear interpolation, and
//! nothing jumps when it grows or moves.

use super::footprint::{Footprint, Strip};
use super::level::{Between, first, shrink};
use super::sheets::{Sheet, Sheets, Soil, Spot, TILE_BITS};
use super::slope::lerp;
use crate::field::Wanted;
use crate::lanes::{Floats, Ints, Lanes, Mask};
use terrafarm_terrain::layout::{TILE_POSTS, TILE_RING};
use terrafarm_terrain::tile::{FIELDS, PhotoTile, TURNED, Texels};

/// The longest footprint, in its widths; longer ones take a coarser level.
const MAX_STRETCH: f32 = 16.0;
/// The most texels of a row. Only in the coarsest level, where a pixel covers much of the
/// photo, are there more; those at the ends are left out.
const LONGEST: f32 = 64.0;
/// Coverage from which on a photo hides what lies below it.
const OPAQUE: f32 = 0.999;
/// How far beyond the centres of its outermost texels a photo reaches, in texels.
const RIM: f32 = 0.5;

/// Colour, premultiplied by coverage.
pub(crate) struct Sample<L: Lanes> {
    pub light: [L::F; 3],
    pub coverage: L::F,
    /// A tile was missing.
    pub unsure: L::M,
}

/// Colour and coverage at places so many metres east and north of the camera. `layers` are
/// from the lowest to the topmost. Tiles that are not loaded are added to `wanted`.
#[inline(always)]
pub(crate) fn sample<L: Lanes>(
    layers: &mut [Sheets<PhotoTile>],
    along: [L::F; 2],
    footprint: &Footprint<L>,
    lanes: L::M,
    wanted: &mut Wanted,
) -> Sample<L> {
    let zero = L::F::splat(0.0);
    let mut sum: Sample<L> = Sample { light: [zero; 3], coverage: zero, unsure: L::M::none() };
    let mut number = layers.len();
    while number > 0 {
        number -= 1;
        let sheets = &mut layers[number];
        let (inside, spot) = sheets.spot::<L>(along, RIM);
        let here = lanes & inside & sum.coverage.lt(L::F::splat(OPAQUE));
        if !here.any() {
            continue;
        }
        let strip: Strip<L> = footprint.strip(sheets.rate);
        let below = filtered::<L>(sheets, &spot, &strip, here, wanted);
        let uncovered = L::F::splat(1.0) - sum.coverage;
        for c in 0..3 {
            sum.light[c] = sum.light[c] + uncovered * below.light[c];
        }
        sum.coverage = sum.coverage + uncovered * below.coverage;
        sum.unsure = sum.unsure | below.unsure;
    }
    sum
}

/// The mean over a footprint, blended from the two levels whose texels are at most as
/// wide as it, and at least.
#[inline(always)]
fn filtered<L: Lanes>(
    sheets: &mut Sheets<PhotoTile>,
    spot: &Spot<L>,
    strip: &Strip<L>,
    lanes: L::M,
    wanted: &mut Wanted,
) -> Sample<L> {
    let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
    let width = strip.minor.max(strip.major * L::F::splat(1.0 / MAX_STRETCH));
    let between = Between::<L>::of(width, sheets.top());
    let mut sum: Sample<L> = Sample { light: [zero; 3], coverage: zero, unsure: L::M::none() };
    let mut pass = 0;
    while pass < 2 {
        let share = if pass == 0 { one - between.share } else { between.share };
        let level = between.level + L::I::splat(pass);
        let mut left = lanes & zero.lt(share);
        while left.any() {
            let here_level = first::<L>(level, left);
            let here = left & level.eq(L::I::splat(here_level));
            left = left & !here;
            let splat = L::I::splat(here_level);
            let row = Row::<L>::new(spot, strip, splat);
            mean::<L>(sheets, here_level, &row, share, here, &mut sum, wanted);
        }
        pass += 1;
    }
    for c in 0..3 {
        let most = 1.0 / (FIELDS[c] as f32);
        sum.light[c] = sum.light[c] * L::F::splat(most * most);
    }
    sum
}

/// A strip in a level.
struct Row<L: Lanes> {
    along_x: L::M,
    /// The middle: the texel, and how far from it, along the row and across.
    cell: [L::I; 2],
    part: [L::F; 2],
    slant: L::F,
    /// In texels of the level, 1 at least.
    length: L::F,
}

impl<L: Lanes> Row<L> {
    #[inline(always)]
    fn new(spot: &Spot<L>, strip: &Strip<L>, level: L::I) -> Self {
        let Spot { cell: [i, j], part: [x, y] } = spot.at_level(level);
        let along_x = strip.along_x;
        let length = (strip.length * shrink::<L>(level)).max(L::F::splat(1.0));
        Row {
            along_x,
            cell: [L::I::select(along_x, i, j), L::I::select(along_x, j, i)],
            part: [L::F::select(along_x, x, y), L::F::select(along_x, y, x)],
            slant: strip.slant,
            length: length.min(L::F::splat(LONGEST)),
        }
    }
}

/// What a row is in one level of a layer: all that does not change from texel to texel.
struct Track<L: Lanes> {
    /// Last post and last tile along the row and across.
    end: [L::I; 2],
    last: [L::I; 2],
    /// Where the copy of a tile begins whose texels lie in the order of the row.
    copy: L::I,
    /// Texel n reaches from n - 1/2 to n + 1/2, all relative to the middle's. This is where
    /// the row begins and ends, plus 1/2.
    start: L::F,
    stop: L::F,
    /// Weight of a whole texel.
    scale: L::F,
}

/// Adds the mean of the texels of a row to `sum`, by its share.
#[inline(always)]
fn mean<L: Lanes>(
    sheets: &mut Sheets<PhotoTile>,
    level: i32,
    row: &Row<L>,
    share: L::F,
    lanes: L::M,
    sum: &mut Sample<L>,
    wanted: &mut Wanted,
) {
    let sheet = sheets.sheet(level);
    let along_x = row.along_x;
    let (x_end, y_end) = (L::I::splat(sheet.end[0]), L::I::splat(sheet.end[1]));
    let (x_last, y_last) = (L::I::splat(sheet.last_tile[0]), L::I::splat(sheet.last_tile[1]));
    let ring = L::I::splat((TILE_RING * TILE_POSTS + TILE_RING) as i32);
    let turned = L::I::splat((TILE_RING * TILE_POSTS + TILE_RING + TURNED) as i32);
    let reach = row.length * L::F::splat(0.5);
    let middle = row.part[0] + L::F::splat(0.5);
    let track: Track<L> = Track {
        end: [L::I::select(along_x, x_end, y_end), L::I::select(along_x, y_end, x_end)],
        last: [L::I::select(along_x, x_last, y_last), L::I::select(along_x, y_last, x_last)],
        copy: L::I::select(along_x, turned, ring),
        start: middle - reach,
        stop: middle + reach,
        scale: share.div(row.length),
    };
    let rest = inner::<L>(sheets, level, row, &track, lanes, sum, wanted);
    if rest.any() {
        outer::<L>(sheets, level, row, &track, rest, sum, wanted);
    }
}

/// Those rows that lie in one tile as a whole. Returns the lanes whose rows do not.
#[inline(always)]
fn inner<L: Lanes>(
    sheets: &mut Sheets<PhotoTile>,
    level: i32,
    row: &Row<L>,
    track: &Track<L>,
    lanes: L::M,
    sum: &mut Sample<L>,
    wanted: &mut Wanted,
) -> L::M {
    let none = L::I::splat(0);
    let bits = L::I::splat(TILE_BITS);
    let start = track.start.floor();
    let stop = track.stop.floor();
    let (low, high) = (row.cell[0] + start, row.cell[0] + stop);
    let (one_end, _) = row.across(start.to_floats());
    let (other_end, _) = row.across(stop.to_floats());
    let (left, right) = (one_end.min(other_end), one_end.max(other_end));
    let (along, across) = (low.shr(bits), left.shr(bits));
    let outside = low.lt(none)
        | track.end[0].lt(high)
        | left.lt(none)
        | !right.lt(track.end[1])
        | track.last[0].lt(along)
        | track.last[1].lt(across);
    let inside = !outside & along.eq(high.shr(bits)) & across.eq(right.shr(bits));
    let tx = L::I::select(row.along_x, along, across);
    let ty = L::I::select(row.along_x, across, along);
    let number = sheets.sheet(level).number::<L>(tx, ty);
    // From a texel of the middle's cell in the tile.
    let wide = L::I::splat(TILE_POSTS as i32);
    let corner = (row.cell[0] - along.shl(bits)).times(wide) + track.copy - across.shl(bits);
    let mut left = lanes & inside;
    while left.any() {
        let known = first::<L>(number, left);
        let here = left & number.eq(L::I::splat(known));
        left = left & !here;
        let texels = match sheets.tile(level, known, wanted) {
            Soil::Tile(tile) => tile.texels(),
            Soil::Empty => continue,
            Soil::Absent => {
                sum.unsure = sum.unsure | here;
                continue;
            }
        };
        let mut at = corner + start.times(wide);
        let mut step = start.to_floats();
        let mut going = here;
        while going.any() {
            // A row has two texels at least.
            for _ in 0..2 {
                let (other, part) = row.across(step);
                let weight = track.weight(step).max(L::F::splat(0.0));
                add::<L>(texels, at + other, part, weight, going, sum);
                step = step + L::F::splat(1.0);
                at = at + wide;
            }
            going = going & step.lt(track.stop);
        }
    }
    lanes & !inside
}

/// Rows texel by texel, from tile to tile. Beside the layer its outermost texels go on.
#[inline(always)]
fn outer<L: Lanes>(
    sheets: &mut Sheets<PhotoTile>,
    level: i32,
    row: &Row<L>,
    track: &Track<L>,
    lanes: L::M,
    sum: &mut Sample<L>,
    wanted: &mut Wanted,
) {
    let (zero, none) = (L::F::splat(0.0), L::I::splat(0));
    let sheet = sheets.sheet(level);
    let mut texel = track.start.floor();
    let mut left = lanes;
    let mut known = -1;
    let mut tile = None;
    while left.any() {
        let step = texel.to_floats();
        let post = (row.cell[0] + texel).max(none).min(track.end[0]);
        let (other, part) = row.across(step);
        let part = L::F::select(other.lt(none), zero, part);
        let part = L::F::select(other.lt(track.end[1]), part, zero);
        let other = other.max(none).min(track.end[1]);
        let (tile_along, along) = Sheet::tile_of::<L>(track.last[0], post);
        let (tile_across, across) = Sheet::tile_of::<L>(track.last[1], other);
        let tx = L::I::select(row.along_x, tile_along, tile_across);
        let ty = L::I::select(row.along_x, tile_across, tile_along);
        let number = sheet.number::<L>(tx, ty);
        let mut here = left & number.eq(L::I::splat(known));
        if !here.any() {
            known = first::<L>(number, left);
            here = left & number.eq(L::I::splat(known));
            tile = match sheets.tile(level, known, wanted) {
                Soil::Tile(tile) => Some(tile.texels()),
                Soil::Empty => None,
                Soil::Absent => {
                    sum.unsure = sum.unsure | here;
                    None
                }
            };
        }
        if let Some(texels) = tile {
            let at = along.times(L::I::splat(TILE_POSTS as i32)) + across + track.copy;
            add::<L>(texels, at, part, track.weight(step), here, sum);
        }
        texel = L::I::select(here, texel + L::I::splat(1), texel);
        left = left & (!here | texel.to_floats().lt(track.stop));
    }
}

impl<L: Lanes> Row<L> {
    /// The texel across from one along the row, and how far it is to the next: both
    /// relative to the middle's.
    #[inline(always)]
    fn across(&self, step: L::F) -> (L::I, L::F) {
        let side = self.part[1] + (step - self.part[0]) * self.slant;
        let floor = side.floor();
        (self.cell[1] + floor, side - floor.to_floats())
    }
}

impl<L: Lanes> Track<L> {
    /// Weight of a texel of the row.
    #[inline(always)]
    fn weight(&self, step: L::F) -> L::F {
        let one = L::F::splat(1.0);
        (self.stop - step).min(step + one - self.start).min(one) * self.scale
    }
}

/// Adds a texel, blended with the next one, to `sum`.
#[inline(always)]
fn add<L: Lanes>(
    texels: Texels,
    at: L::I,
    part: L::F,
    weight: L::F,
    lanes: L::M,
    sum: &mut Sample<L>,
) {
    let weight = L::F::select(lanes, weight, L::F::splat(0.0));
    let (a, b) = L::I::gather_twos(texels.light, at, lanes);
    for c in 0..3 {
        let field = L::I::splat(FIELDS[c] as i32);
        let (a, b) = ((a & field).to_floats(), (b & field).to_floats());
        sum.light[c] = sum.light[c] + lerp::<L>(a * a, b * b, part) * weight;
    }
    let covered = match texels.coverage {
        None => L::F::splat(1.0),
        Some(coverage) => {
            let pair = L::I::gather_pairs(coverage, at, lanes);
            let low = L::I::splat(0xFFFF);
            let (a, b) = (pair & low, pair.shr(L::I::splat(16)) & low);
            lerp::<L>(a.to_floats(), b.to_floats(), part) * L::F::splat(1.0 / 65535.0)
        }
    };
    sum.coverage = sum.coverage + covered * weight;
}
