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
use super::sheets::{Sheet, Sheets, Soil, Spot};
use super::slope::lerp;
use crate::field::Wanted;
use crate::lanes::{Floats, Ints, Lanes, Mask};
use terrafarm_terrain::layout::{TILE_POSTS, TILE_RING};
use terrafarm_terrain::tile::{FIELDS, PhotoTile, TURNED};

/// The longest footprint, in its widths; longer ones take a coarser level.
const MAX_STRETCH: f32 = 16.0;
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
    let mut sum: Sample<L> =
        Sample { light: [zero; 3], coverage: zero, unsure: L::M::none() };
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
    let mut sum: Sample<L> =
        Sample { light: [zero; 3], coverage: zero, unsure: L::M::none() };
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
            // Not more than the stretch allows, also where that is no number.
            length: length.min(L::F::splat(4.0 * MAX_STRETCH)),
        }
    }
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
    let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
    let (none, half) = (L::I::splat(0), L::F::splat(0.5));
    let sheet = sheets.sheet(level);
    let along_x = row.along_x;
    let (x_end, y_end) = (L::I::splat(sheet.end[0]), L::I::splat(sheet.end[1]));
    let (x_last, y_last) = (L::I::splat(sheet.last_tile[0]), L::I::splat(sheet.last_tile[1]));
    let end = [L::I::select(along_x, x_end, y_end), L::I::select(along_x, y_end, x_end)];
    let last = [L::I::select(along_x, x_last, y_last), L::I::select(along_x, y_last, x_last)];
    let turned = L::I::select(along_x, L::I::splat(TURNED as i32), none);
    // Texel n reaches from n - 1/2 to n + 1/2; all relative to the middle's.
    let reach = row.length * half;
    let start = row.part[0] - reach + half;
    let stop = row.part[0] + reach + half;
    let mut texel = start.floor();
    let scale = share.div(row.length);
    let mut left = lanes;
    let mut known = -1;
    let mut tile = None;
    loop {
        let step = texel.to_floats();
        let post = (row.cell[0] + texel).max(none).min(end[0]);
        let side = row.part[1] + (step - row.part[0]) * row.slant;
        let floor = side.floor();
        let part = side - floor.to_floats();
        let other = row.cell[1] + floor;
        // Beside the layer its outermost texels go on.
        let part = L::F::select(other.lt(none), zero, part);
        let part = L::F::select(other.lt(end[1]), part, zero);
        let other = other.max(none).min(end[1]);
        let (tile_along, along) = Sheet::tile_of::<L>(last[0], post);
        let (tile_across, across) = Sheet::tile_of::<L>(last[1], other);
        let tx = L::I::select(along_x, tile_along, tile_across);
        let ty = L::I::select(along_x, tile_across, tile_along);
        let number = sheet.number::<L>(tx, ty);
        let mut here = left & number.eq(L::I::splat(known));
        if !here.any() {
            if !left.any() {
                return;
            }
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
            let weight = (stop - step).min(step + one - start).min(one) * scale;
            let weight = L::F::select(here, weight, zero);
            let ring = L::I::splat(TILE_RING as i32);
            let at = (along + ring).times(L::I::splat(TILE_POSTS as i32)) + across + ring + turned;
            let (a, b) = L::I::gather_twos(texels.light, at, here);
            for c in 0..3 {
                let field = L::I::splat(FIELDS[c] as i32);
                let (a, b) = ((a & field).to_floats(), (b & field).to_floats());
                sum.light[c] = sum.light[c] + lerp::<L>(a * a, b * b, part) * weight;
            }
            let covered = match texels.coverage {
                None => one,
                Some(coverage) => {
                    let pair = L::I::gather_pairs(coverage, at, here);
                    let low = L::I::splat(0xFFFF);
                    let (a, b) = (pair & low, pair.shr(L::I::splat(16)) & low);
                    let full = L::F::splat(1.0 / 65535.0);
                    lerp::<L>(a.to_floats(), b.to_floats(), part) * full
                }
            };
            sum.coverage = sum.coverage + covered * weight;
        }
        texel = L::I::select(here, texel + L::I::splat(1), texel);
        left = left & (!here | texel.to_floats().lt(stop));
    }
}
