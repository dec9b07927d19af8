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
//!
//! Some places are sampled at once, step by step: where a row lies follows from a long
//! chain of roots and quotients, and reading it is a loop of a length that the processor
//! cannot foresee. One after the other for each place, either would wait for the other.

use super::batch::{Each, VECTORS};
use super::footprint::{Footprint, Strip};
use super::level::{Between, first, shrink};
use super::sheets::{Sheet, Sheets, Soil, Spot, TILE_BITS};
use crate::field::Wanted;
use crate::lanes::{Floats, Ints, Lanes, MOST, Mask, prefetch_rows};
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

/// Places of a batch in one photo, and the rows of texels that they see in one of its
/// levels. Masks are bits, one word a vector.
pub(crate) struct Rows {
    /// Those that see the photo, and of these the ones for which a tile was missing.
    lanes: [u32; VECTORS],
    cell: [Each<i32>; 2],
    part: [Each<f32>; 2],
    /// The strip.
    along_x: [u32; VECTORS],
    slant: Each<f32>,
    extent: Each<f32>,
    /// The finer level, the share of the coarser one, and what the photos above leave.
    level: Each<i32>,
    coarser: Each<f32>,
    uncovered: Each<f32>,
    /// The rows that are to be read, and those of them that one tile has as a whole.
    wanted: [u32; VECTORS],
    inside: [u32; VECTORS],
    /// Of the latter: the tile, the first texel in it were it not for the slant, and how
    /// far across from there it is at the middle.
    number: Each<i32>,
    first: Each<i32>,
    side: Each<f32>,
    /// See [`Track`].
    begin: Each<f32>,
    start: Each<f32>,
    stop: Each<f32>,
    scale: Each<f32>,
}

/// What is summed up over the photos: light in squares of the texels' steps, premultiplied
/// by coverage; see [`light`].
pub(crate) struct Sums<'b> {
    pub light: &'b mut [Each<f32>; 3],
    pub coverage: &'b mut Each<f32>,
    /// Places for which a tile was missing.
    pub unsure: &'b mut [u32; VECTORS],
}

/// Light, 0 to 1, of a sum.
#[inline(always)]
pub(crate) fn light<L: Lanes>(sum: [L::F; 3]) -> [L::F; 3] {
    let mut light = sum;
    for c in 0..3 {
        let most = 1.0 / FIELDS[c] as f32;
        light[c] = sum[c] * L::F::splat(most * most);
    }
    light
}

impl Rows {
    pub(crate) fn new() -> Self {
        let (none, zero) = (Each::new(0.0), Each::new(0));
        Rows {
            lanes: [0; VECTORS],
            cell: [zero; 2],
            part: [none; 2],
            along_x: [0; VECTORS],
            slant: none,
            extent: none,
            level: zero,
            coarser: none,
            uncovered: none,
            wanted: [0; VECTORS],
            inside: [0; VECTORS],
            number: zero,
            first: zero,
            side: none,
            begin: none,
            start: none,
            stop: none,
            scale: none,
        }
    }

    /// Lays the footprints of vector `n`, at places so many metres east and north of the
    /// camera, on a photo. Those that it or the photos above do not show are left out.
    #[inline(always)]
    pub(crate) fn lay<L: Lanes>(
        &mut self,
        sheets: &Sheets<PhotoTile>,
        n: usize,
        along: [L::F; 2],
        footprint: &Footprint<L>,
        lanes: L::M,
        covered: L::F,
    ) {
        let at = n * L::N;
        let (inside, spot) = sheets.spot::<L>(along, RIM);
        let here = lanes & inside & covered.lt(L::F::splat(OPAQUE));
        self.lanes[n] = here.bits();
        let strip: Strip<L> = footprint.strip(sheets.rate);
        let width = strip.minor.max(strip.major * L::F::splat(1.0 / MAX_STRETCH));
        let between = Between::<L>::of(width, sheets.top());
        for axis in 0..2 {
            spot.cell[axis].store(&mut self.cell[axis][at..]);
            spot.part[axis].store(&mut self.part[axis][at..]);
        }
        self.along_x[n] = strip.along_x.bits();
        strip.slant.store(&mut self.slant[at..]);
        strip.length.store(&mut self.extent[at..]);
        between.level.store(&mut self.level[at..]);
        between.share.store(&mut self.coarser[at..]);
        (L::F::splat(1.0) - covered).store(&mut self.uncovered[at..]);
    }

    /// No place of vector `n` sees anything.
    #[inline(always)]
    pub(crate) fn leave(&mut self, n: usize) {
        self.lanes[n] = 0;
    }

    /// Finds the rows of vector `n` in the finer level, or in the coarser one, and asks for
    /// their first texels. Tiles that are not loaded are added to `missing`.
    #[inline(always)]
    pub(crate) fn place<L: Lanes>(
        &mut self,
        sheets: &mut Sheets<PhotoTile>,
        n: usize,
        is_coarser: bool,
        missing: &mut Wanted,
    ) {
        let at = n * L::N;
        let share = self.share::<L>(at, is_coarser);
        let wanted = L::M::from_bits(self.lanes[n]) & L::F::splat(0.0).lt(share);
        self.wanted[n] = wanted.bits();
        self.inside[n] = 0;
        if !wanted.any() {
            return;
        }
        let level = self.level::<L>(at, is_coarser);
        let mut grid: Grid<L> = Grid::of(sheets.sheet(first::<L>(level, wanted)));
        let mut left = wanted & !level.eq(L::I::splat(first::<L>(level, wanted)));
        while left.any() {
            let other = first::<L>(level, left);
            let here = left & level.eq(L::I::splat(other));
            grid = grid.or(here, Grid::of(sheets.sheet(other)));
            left = left & !here;
        }
        let row = self.row::<L>(n, level);
        let track = Track::new(&row, &grid, share);
        let none = L::I::splat(0);
        let bits = L::I::splat(TILE_BITS);
        let (begin, [[low, high], [near, far]]) = row.ends();
        // The middle's tile. It has its neighbours' outermost texels, too.
        let along = row.cell[0].shr(bits).min(track.last[0]);
        let across = row.cell[1].shr(bits).min(track.last[1]);
        let (corner_along, corner_across) = (along.shl(bits), across.shl(bits));
        let ring = L::I::splat(TILE_RING as i32);
        let most = L::I::splat((TILE_POSTS - TILE_RING - 1) as i32);
        let first_along = (corner_along - ring).max(none);
        let first_across = (corner_across - ring).max(none);
        let last_along = (corner_along + most).min(track.end[0]);
        let last_across = (corner_across + most).min(track.end[1]);
        let outside = low.lt(first_along)
            | last_along.lt(high)
            | near.lt(first_across)
            | !far.lt(last_across);
        self.inside[n] = (wanted & !outside).bits();
        let tx = L::I::select(row.along_x, along, across);
        let ty = L::I::select(row.along_x, across, along);
        let number = ty.times(grid.last[0] + L::I::splat(1)) + tx;
        // From a texel of the middle's cell in the tile.
        let wide = L::I::splat(TILE_POSTS as i32);
        let corner = (low - corner_along).times(wide) + track.copy;
        number.store(&mut self.number[at..]);
        (corner + row.cell[1] - corner_across).store(&mut self.first[at..]);
        row.side.store(&mut self.side[at..]);
        begin.to_floats().store(&mut self.begin[at..]);
        track.start.store(&mut self.start[at..]);
        track.stop.store(&mut self.stop[at..]);
        track.scale.store(&mut self.scale[at..]);
        let inside = wanted & !outside;
        if !inside.any() {
            return;
        }
        // Neighbours mostly share lines of the cache, and most rows of a vector are in one tile.
        let (level, number) = (first::<L>(level, inside), first::<L>(number, inside));
        if let Soil::Tile(tile) = sheets.tile(level, number, missing) {
            let (across, _) = row.across(begin.to_floats());
            let mut places = [0; MOST];
            (L::I::load(&self.first[at..]) + across).store(&mut places);
            prefetch_rows(tile.texels().light, &places[..L::N], TILE_POSTS);
        }
    }

    /// Adds the means of the rows of vector `n` that [`Rows::place`] has found to the sums.
    /// Tiles that are not loaded are added to `missing`.
    #[inline(always)]
    pub(crate) fn read<L: Lanes>(
        &self,
        sheets: &mut Sheets<PhotoTile>,
        n: usize,
        is_coarser: bool,
        sums: &mut Sums,
        missing: &mut Wanted,
    ) {
        if self.wanted[n] == 0 {
            return;
        }
        let at = n * L::N;
        let [red, green, blue] = &*sums.light;
        let mut sum: Sum<L> = Sum {
            light: [L::F::load(&red[at..]), L::F::load(&green[at..]), L::F::load(&blue[at..])],
            coverage: L::F::load(&sums.coverage[at..]),
            unsure: L::M::from_bits(sums.unsure[n]),
        };
        let level = self.level::<L>(at, is_coarser);
        let mut rest = L::M::from_bits(self.wanted[n] & !self.inside[n]);
        rest = rest | self.inner::<L>(sheets, n, level, &mut sum, missing);
        while rest.any() {
            let known = first::<L>(level, rest);
            let here = rest & level.eq(L::I::splat(known));
            rest = rest & !here;
            let row = self.row::<L>(n, level);
            let grid = Grid::of(sheets.sheet(known));
            let track = Track::new(&row, &grid, self.share::<L>(at, is_coarser));
            outer::<L>(sheets, known, &row, &track, here, &mut sum, missing);
        }
        for c in 0..3 {
            sum.light[c].store(&mut sums.light[c][at..]);
        }
        sum.coverage.store(&mut sums.coverage[at..]);
        sums.unsure[n] = sum.unsure.bits();
    }

    /// Those rows that one tile has as a whole. Returns those of them that go on beyond a
    /// tile that is empty, and so does not have its neighbours' texels.
    #[inline(always)]
    fn inner<L: Lanes>(
        &self,
        sheets: &mut Sheets<PhotoTile>,
        n: usize,
        level: L::I,
        sum: &mut Sum<L>,
        missing: &mut Wanted,
    ) -> L::M {
        let at = n * L::N;
        let (wide, number) = (L::I::splat(TILE_POSTS as i32), L::I::load(&self.number[at..]));
        let mut left = L::M::from_bits(self.inside[n]);
        let mut beyond = L::M::none();
        while left.any() {
            let (known_level, known) = (first::<L>(level, left), first::<L>(number, left));
            let here = left & level.eq(L::I::splat(known_level)) & number.eq(L::I::splat(known));
            left = left & !here;
            let texels = match sheets.tile(known_level, known, missing) {
                Soil::Tile(tile) => tile.texels(),
                Soil::Empty => {
                    beyond = beyond | (here & !self.row::<L>(n, level).is_in_its_tile());
                    continue;
                }
                Soil::Absent => {
                    sum.unsure = sum.unsure | here;
                    continue;
                }
            };
            let zero = L::F::splat(0.0);
            let (side, slant) = (L::F::load(&self.side[at..]), L::F::load(&self.slant[at..]));
            let (start, stop) = (L::F::load(&self.start[at..]), L::F::load(&self.stop[at..]));
            let scale = L::F::select(here, L::F::load(&self.scale[at..]), zero);
            let mut texel = L::I::load(&self.first[at..]);
            let mut step = L::F::load(&self.begin[at..]);
            let mut going = here;
            while going.any() {
                let across = side + step * slant;
                let floor = across.floor();
                let part = across - floor.to_floats();
                let weight = weight::<L>(step, start, stop).max(zero) * scale;
                add::<L>(texels, texel + floor, part, weight, here, sum);
                step = step + L::F::splat(1.0);
                texel = texel + wide;
                going = going & step.lt(stop);
            }
        }
        beyond
    }

    #[inline(always)]
    fn level<L: Lanes>(&self, at: usize, is_coarser: bool) -> L::I {
        L::I::load(&self.level[at..]) + L::I::splat(i32::from(is_coarser))
    }

    /// The share of a level in the sums.
    #[inline(always)]
    fn share<L: Lanes>(&self, at: usize, is_coarser: bool) -> L::F {
        let coarser = L::F::load(&self.coarser[at..]);
        let share = if is_coarser { coarser } else { L::F::splat(1.0) - coarser };
        share * L::F::load(&self.uncovered[at..])
    }

    /// The strips of vector `n` in a level.
    #[inline(always)]
    fn row<L: Lanes>(&self, n: usize, level: L::I) -> Row<L> {
        let at = n * L::N;
        let [i, j] = &self.cell;
        let [x, y] = &self.part;
        let spot: Spot<L> = Spot {
            cell: [L::I::load(&i[at..]), L::I::load(&j[at..])],
            part: [L::F::load(&x[at..]), L::F::load(&y[at..])],
        };
        let Spot { cell: [i, j], part: [x, y] } = spot.at_level(level);
        let along_x = L::M::from_bits(self.along_x[n]);
        let extent = L::F::load(&self.extent[at..]) * shrink::<L>(level);
        let slant = L::F::load(&self.slant[at..]);
        let middle = L::F::select(along_x, x, y);
        Row {
            along_x,
            cell: [L::I::select(along_x, i, j), L::I::select(along_x, j, i)],
            middle,
            side: L::F::select(along_x, y, x) - middle * slant,
            slant,
            length: extent.max(L::F::splat(1.0)).min(L::F::splat(LONGEST)),
        }
    }
}

/// A vector of [`Sums`].
struct Sum<L: Lanes> {
    light: [L::F; 3],
    coverage: L::F,
    unsure: L::M,
}

/// A strip in a level.
struct Row<L: Lanes> {
    along_x: L::M,
    /// The middle's texel along the row and across, and how far along from it the middle is.
    cell: [L::I; 2],
    middle: L::F,
    /// How far across from that texel the row is beside it.
    side: L::F,
    slant: L::F,
    /// In texels of the level, 1 at least.
    length: L::F,
}

/// The sizes of levels along x and y: last post and last tile.
struct Grid<L: Lanes> {
    end: [L::I; 2],
    last: [L::I; 2],
}

impl<L: Lanes> Grid<L> {
    #[inline(always)]
    fn of(sheet: Sheet) -> Self {
        let Sheet { end, last_tile } = sheet;
        Grid {
            end: [L::I::splat(end[0]), L::I::splat(end[1])],
            last: [L::I::splat(last_tile[0]), L::I::splat(last_tile[1])],
        }
    }

    #[inline(always)]
    fn or(self, lanes: L::M, other: Grid<L>) -> Self {
        let (end, last) = (other.end, other.last);
        Grid {
            end: [
                L::I::select(lanes, end[0], self.end[0]),
                L::I::select(lanes, end[1], self.end[1]),
            ],
            last: [
                L::I::select(lanes, last[0], self.last[0]),
                L::I::select(lanes, last[1], self.last[1]),
            ],
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

impl<L: Lanes> Track<L> {
    #[inline(always)]
    fn new(row: &Row<L>, grid: &Grid<L>, share: L::F) -> Self {
        let along_x = row.along_x;
        let ring = L::I::splat((TILE_RING * TILE_POSTS + TILE_RING) as i32);
        let turned = L::I::splat((TILE_RING * TILE_POSTS + TILE_RING + TURNED) as i32);
        let ([x_end, y_end], [x_last, y_last]) = (grid.end, grid.last);
        let [start, stop] = row.reach();
        Track {
            end: [L::I::select(along_x, x_end, y_end), L::I::select(along_x, y_end, x_end)],
            last: [L::I::select(along_x, x_last, y_last), L::I::select(along_x, y_last, x_last)],
            copy: L::I::select(along_x, turned, ring),
            start,
            stop,
            scale: share.div(row.length),
        }
    }
}

/// Rows texel by texel, from tile to tile. Beside the layer its outermost texels go on.
#[inline(always)]
fn outer<L: Lanes>(
    sheets: &mut Sheets<PhotoTile>,
    level: i32,
    row: &Row<L>,
    track: &Track<L>,
    lanes: L::M,
    sum: &mut Sum<L>,
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
        let other = row.cell[1] + other;
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
            let weight = weight::<L>(step, track.start, track.stop) * track.scale;
            let weight = L::F::select(here, weight, zero);
            add::<L>(texels, at, part, weight, here, sum);
        }
        texel = L::I::select(here, texel + L::I::splat(1), texel);
        left = left & (!here | texel.to_floats().lt(track.stop));
    }
}

impl<L: Lanes> Row<L> {
    /// Where it begins and ends along itself; see [`Track`].
    #[inline(always)]
    fn reach(&self) -> [L::F; 2] {
        let reach = self.length * L::F::splat(0.5);
        let middle = self.middle + L::F::splat(0.5);
        [middle - reach, middle + reach]
    }

    /// How far from the middle's its first texel is, and the first and last one along the
    /// row and across, where there is one more that these are blended with.
    #[inline(always)]
    fn ends(&self) -> (L::I, [[L::I; 2]; 2]) {
        let [start, stop] = self.reach();
        let (begin, end) = (start.floor(), stop.floor());
        let (one_end, _) = self.across(begin.to_floats());
        let (other_end, _) = self.across(end.to_floats());
        let [along, across] = self.cell;
        let (near, far) = (one_end.min(other_end), one_end.max(other_end));
        (begin, [[along + begin, along + end], [across + near, across + far]])
    }

    /// Whether it needs nothing of the tiles beside its middle's.
    #[inline(always)]
    fn is_in_its_tile(&self) -> L::M {
        let (_, ends) = self.ends();
        let bits = L::I::splat(TILE_BITS);
        let mut inside = !L::M::none();
        for axis in 0..2 {
            let tile = self.cell[axis].shr(bits);
            for n in 0..2 {
                inside = inside & ends[axis][n].shr(bits).eq(tile);
            }
        }
        inside
    }

    /// How far across a row is beside a texel along it, from the middle's: the texel, and
    /// the way from there to the next.
    #[inline(always)]
    fn across(&self, step: L::F) -> (L::I, L::F) {
        let side = self.side + step * self.slant;
        let floor = side.floor();
        (floor, side - floor.to_floats())
    }
}

/// How much of a texel a row covers: below zero beside the row.
#[inline(always)]
fn weight<L: Lanes>(step: L::F, start: L::F, stop: L::F) -> L::F {
    let one = L::F::splat(1.0);
    (stop - step).min(step + one - start).min(one)
}

/// Adds a texel, blended with the next one, to `sum`. The weight of lanes not in `lanes`
/// is 0.
#[inline(always)]
fn add<L: Lanes>(
    texels: Texels,
    at: L::I,
    part: L::F,
    weight: L::F,
    lanes: L::M,
    sum: &mut Sum<L>,
) {
    let (a, b) = L::I::gather_twos(texels.light, at, lanes);
    let of_b = part * weight;
    let of_a = weight - of_b;
    for c in 0..3 {
        let field = L::I::splat(FIELDS[c] as i32);
        let (a, b) = ((a & field).to_floats(), (b & field).to_floats());
        sum.light[c] = sum.light[c] + (a * a * of_a + b * b * of_b);
    }
    let Some(coverage) = texels.coverage else {
        sum.coverage = sum.coverage + weight;
        return;
    };
    let pair = L::I::gather_pairs(coverage, at, lanes);
    let low = L::I::splat(0xFFFF);
    let (a, b) = ((pair & low).to_floats(), (pair.shr(L::I::splat(16)) & low).to_floats());
    sum.coverage = sum.coverage + (a * of_a + b * of_b) * L::F::splat(1.0 / 65535.0);
}
