//! The `column` method: coherent rays along lines through the nadir.
//!
//! All rays in a vertical plane through the camera appear on one line of the picture, and
//! along such a line each ray rises more steeply than the one before and begins where that
//! one ended, whatever the pitch and the roll (after Cohen-Or et al., section 2, whose
//! columns are those of a camera that does not roll). `lattice` says which lines and rays
//! there are: neighbours are six pixels apart for each pixel of tolerance, but at most four.
//!
//! What rays find is kept as inverse depth, which over a plane is linear in the picture: the
//! rays of a line that see the same plane are answered together (`planes`). There is a ray in
//! each row for each line, so a pixel lies between two rays. Where the rays around these bend
//! no more than the tolerance allows, and the posts of the ground are further apart than
//! lines, the pixel is between the two (`net`). Where they bend more it is compared with the
//! surface at that very place, and moved along its own ray until it is there; where the two
//! see different ground it is looked for on the nearer, then on the other (`doubts`). Closer
//! ground that ends a few rows below may come to a peak between the lines: there it is tried
//! first. What is not found so, and what is close to V, has a ray of its own, that of `lod`.
//! What a pixel can miss is ground in front that is narrower than the distance between lines.

mod doubts;
mod net;
mod planes;
mod turned;

use crate::lanes::{Floats, Ints, Kernel, Lanes, MOST, Mask, as_bits};
use crate::lattice::{Band, Fan, Frame};
use crate::lod::{Alone, cast_pixels};
use crate::relief::Relief;
use crate::seen::Seen;
use crate::walk::{Fineness, Lines, Rows, Walk};
use doubts::{Doubts, GUESSES, SKY};
use glam::DVec2;
use net::{BEHIND, BENT, BROKEN, Bends, Net, OPEN, Rules, Verdict};
pub(crate) use net::{TOLD, WHOLE};
use planes::Planes;
use std::cell::Cell;
use std::ops::Range;
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;
use turned::Turned;

/// Distance between lines, pixels for each pixel of tolerance, and the least and the most.
/// Measured (`bench core`): more lines cost more, fewer leave more pixels in doubt.
const SPACING: f64 = 6.0;
const SPACINGS: [f64; 2] = [0.5, 4.0];
/// How much neighbouring answers may bend for each pixel of tolerance, pixels. Measured: up
/// to this the largest error stays what it is without.
const BENDS: f64 = 2.0;
/// How many rows lower, for each pixel between lines, ground is looked for that may come up
/// between them: that is how steep a peak may be.
const REACH: f64 = 1.5;
/// Share of the tolerance by which the ground may be off the straight lines that rays see.
const STRAIGHT: f64 = 0.25;
/// A bound of the sum of the parts of a ray, up and along the map, of length 1.
const PARTS: f64 = 1.42;
/// Share of the tolerance by which a pixel may be off the surface without being corrected.
/// The other half is for the surface: see [`LEVELS`].
const ALLOWED: f64 = 0.5;
/// Share of the tolerance by which the levels of the surface may be off level 0.
pub(crate) const LEVELS: f64 = 0.5;
/// Blocks of `1 << FIRST_BLOCK` cells are looked at first. Measured: 3 and 8 cost 2 % more.
const FIRST_BLOCK: i32 = 5;
/// Lines a pixel up to which those between N pixels are no more than 2 N.
const DENSEST: f64 = 1.85;
/// The widest part of a region that is done at once, pixels. Measured with a cache of 1 MB a
/// core: parts of 256 share fewer lines, which costs 8 % of a steep view; those of 1024 gain
/// nothing more.
const WIDEST_PX: u32 = 512;

/// The most that a thread keeps from region to region: 1920 by 1080 pixels of a camera that
/// is rolled by 45 degrees need more than half of it, the pieces of a worker far less.
const KEPT_BYTES: usize = 32 << 20;

/// The method for a region of a view.
pub(crate) struct Columns<'r, 'a> {
    pub relief: &'r Relief<'a>,
    pub camera: &'r Camera,
    pub tolerance_px: f64,
    pub region: Region,
}

/// What a region needs while it is looked at. A thread keeps it for the next one: fresh
/// memory would cost a tenth of the time.
#[derive(Default)]
struct Room {
    planes: Planes,
    net: Net,
    verdict: Verdict,
    turned: Turned,
    doubts: Doubts,
    rest: Doubts,
    alone: Vec<Alone>,
}

thread_local! {
    static ROOM: Cell<Option<Box<Room>>> = const { Cell::new(None) };
}

impl Room {
    fn take() -> Box<Room> {
        ROOM.take().unwrap_or_default()
    }

    /// Keeps it, unless the region was so large that it holds more than [`KEPT_BYTES`].
    fn give_back(mut self: Box<Room>) {
        self.alone.clear();
        let own = self.alone.capacity() * size_of::<Alone>();
        let lists = self.planes.bytes() + self.doubts.bytes() + self.rest.bytes();
        if self.net.bytes() + lists + own <= KEPT_BYTES {
            ROOM.set(Some(self));
        }
    }
}

/// A row of pixels, and the lines around them.
struct Span {
    pixels: Range<u32>,
    lines: Range<i32>,
}

impl Kernel for Columns<'_, '_> {
    type Output = Seen;

    #[inline(always)]
    fn run<L: Lanes>(self) -> Seen {
        let area = self.region.area() as usize;
        let mut seen = Seen::sky(self.region);
        let mut room = Room::take();
        let Room { planes, net, verdict, turned, doubts, rest, alone } = &mut *room;
        let spacing = (SPACING * self.tolerance_px).clamp(SPACINGS[0], SPACINGS[1]);
        let mut done = 0;
        for by_rows in [true, false] {
            let frame = Frame::new(self.camera, by_rows);
            for band in frame.bands() {
                let fan = frame.fan(&band, spacing);
                for part in parts(self.region, by_rows) {
                    let Some(spans) = spans(&frame, &band, &fan, &part) else { continue };
                    let first = band.rows.start.max(part[1].start);
                    let rules =
                        self.cast::<L>(&frame, &fan, first, &spans, (planes, net), &mut seen);
                    let depths = &mut seen.inverse_depth;
                    let filled = spans.iter().zip(first..);
                    for (span, row) in filled.filter(|(span, _)| !span.pixels.is_empty()) {
                        let pixels = span.pixels.clone();
                        done += pixels.len() as u64;
                        net.judge::<L>(fan.ray(row), rules, verdict);
                        let out = if by_rows {
                            let row = (row - self.region.y) as usize * self.region.width as usize;
                            let at = row + (pixels.start - self.region.x) as usize;
                            &mut depths[at..at + pixels.len()]
                        } else {
                            if !turned.takes(row) {
                                turned.write(self.region, depths);
                            }
                            turned.add(row, part[0].start, pixels.clone())
                        };
                        self.see::<L>(&fan, (row, pixels), (&*net, &*verdict), out, doubts);
                    }
                    turned.write(self.region, depths);
                    self.decide::<L>(&frame, doubts, rest, depths, alone);
                }
            }
        }
        if done < area as u64 {
            // What is close to V.
            let frames = [true, false].map(|by_rows| Frame::new(self.camera, by_rows));
            let [columns, rows] = frames[0].around_v().unwrap_or([0..0, 0..0]);
            let (left, top) = (self.region.x, self.region.y);
            let (right, bottom) = (left + self.region.width, top + self.region.height);
            for y in rows.start.max(top)..rows.end.min(bottom) {
                for x in columns.start.max(left)..columns.end.min(right) {
                    let near = frames[0].owns(x, y) && frames[0].is_near(y)
                        || frames[1].owns(y, x) && frames[1].is_near(x);
                    if near {
                        let at = (y - top) * self.region.width + (x - left);
                        alone.push(Alone { at, free: 0.0 });
                        done += 1;
                    }
                }
            }
        }
        debug_assert_eq!(done, area as u64, "every pixel is seen, and once");
        seen.alone = alone.len() as u64;
        seen.rays += seen.alone;
        seen.steps +=
            cast_pixels::<L>(self.relief, self.camera, self.region, alone, &mut seen.inverse_depth);
        room.give_back();
        seen
    }
}

/// A region in parts that are not too wide along the minor axis: minors and majors.
fn parts(region: Region, by_rows: bool) -> impl Iterator<Item = [Range<u32>; 2]> {
    let columns = region.x..region.x + region.width;
    let rows = region.y..region.y + region.height;
    let (minors, majors) = if by_rows { (columns, rows) } else { (rows, columns) };
    minors
        .clone()
        .step_by(WIDEST_PX as usize)
        .map(move |start| [start..(start + WIDEST_PX).min(minors.end), majors.clone()])
}

/// For each row of a band within a part its pixels, and the lines that they lie between.
/// None if there are no pixels.
#[inline(always)]
fn spans(
    frame: &Frame,
    band: &Band,
    fan: &Fan,
    [minors, majors]: &[Range<u32>; 2],
) -> Option<Vec<Span>> {
    let rows = band.rows.start.max(majors.start)..band.rows.end.min(majors.end);
    // The further from V, the more of a row belongs to the frame.
    let furthest = if band.falling { rows.end.checked_sub(1)? } else { rows.start };
    if rows.is_empty() || frame.owned(furthest, minors.clone()).is_empty() {
        return None;
    }
    let span = |row: u32| {
        let pixels = frame.owned(row, minors.clone());
        if pixels.is_empty() {
            return Span { pixels, lines: 0..0 };
        }
        let middle = f64::from(row) + 0.5;
        let [a, b] =
            fan.lines([pixels.start, pixels.end - 1].map(|at| f64::from(at) + 0.5), middle);
        // One more on each side to compare with, and one makes up for rounding.
        let lines = a.min(b).floor() as i32 - 2..a.max(b).floor() as i32 + 4;
        Span { pixels, lines }
    };
    Some(rows.map(span).collect())
}

impl Columns<'_, '_> {
    /// Casts the rays that the pixels of some rows lie between. Returns by what these are
    /// to be judged.
    #[inline(always)]
    fn cast<L: Lanes>(
        &self,
        frame: &Frame,
        fan: &Fan,
        first_row: u32,
        spans: &[Span],
        (planes, net): (&mut Planes, &mut Net),
        seen: &mut Seen,
    ) -> Rules {
        // One more on each side to compare with, and what may come up from below.
        let rising = self.rises(frame, fan);
        let reach = (REACH * fan.spacing).ceil() as i32;
        let (before, after) = if rising { (reach + 1, 1) } else { (1, reach + 1) };
        let rays = |row: u32| fan.ray(row) - before..fan.ray(row) + after + 1;
        // From row to row it is the next ray, so the first and the last row tell.
        let rays_of = |meets: &dyn Fn(&Span) -> bool| {
            let (first, last) = (spans.iter().position(meets)?, spans.iter().rposition(meets)?);
            let [a, b] = [first, last].map(|at| rays(first_row + at as u32));
            Some(a.start.min(b.start)..a.end.max(b.end))
        };
        let filled = || spans.iter().filter(|span| !span.pixels.is_empty());
        let all_rays = rays_of(&|span| !span.pixels.is_empty()).unwrap_or(0..0);
        let first_line = filled().map(|span| span.lines.start).min().unwrap_or(0);
        let end_line = filled().map(|span| span.lines.end).max().unwrap_or(0);
        net.clear(all_rays.start, all_rays.len(), first_line..end_line);
        for block in (first_line..end_line).step_by(L::N) {
            let end = block + L::N as i32;
            let meets = |span: &Span| {
                !span.pixels.is_empty() && span.lines.start < end && span.lines.end > block
            };
            if let Some(rays) = rays_of(&meets) {
                seen.rays += rays.len() as u64 * L::N as u64;
                seen.steps += self.block::<L>(frame, fan, block, rays, (planes, net));
            }
        }
        let bends = BENDS * self.tolerance_px;
        let bends = Bends {
            of_change: bends as f32,
            of_depth: (bends / (PARTS * self.camera.focal_px())) as f32,
        };
        net.find_tips::<L>(rising);
        Rules { bends, rising, reach: reach as usize }
    }

    /// Whether the rays of a line rise from row to row of a band.
    fn rises(&self, frame: &Frame, fan: &Fan) -> bool {
        let tangent = |ray: i32| {
            let [x, y, z] = frame.ray(fan, 0.0, f64::from(ray * fan.towards)).to_array();
            z / DVec2::new(x, y).length()
        };
        tangent(0) < tangent(1)
    }

    /// Casts rays of N lines. Returns the steps that it took.
    #[inline(always)]
    fn block<L: Lanes>(
        &self,
        frame: &Frame,
        fan: &Fan,
        first: i32,
        rays: Range<i32>,
        (planes, net): (&mut Planes, &mut Net),
    ) -> u64 {
        let mut values = [[0.0f32; MOST]; 6];
        for lane in 0..L::N {
            let line = (f64::from(first) + lane as f64 + 0.5) * fan.spacing;
            let start = frame.ray(fan, line, 0.0);
            let change = frame.ray(fan, line, 1.0) - start;
            let across = DVec2::new(start.x, start.y);
            let length = across.length();
            let along = across / length;
            let longer = change.x * along.x + change.y * along.y;
            let parts = [along.x, along.y, length, longer, start.z, change.z];
            for (value, part) in values.iter_mut().zip(parts) {
                value[lane] = part as f32;
            }
        }
        // Rays in the order in which they rise.
        let d = |ray: i32| (ray * fan.towards) as f32;
        let tangent = |ray: i32| {
            let [_, _, length, longer, rise, higher] = values.map(|value| value[0]);
            (rise + d(ray) * higher) / (length + d(ray) * longer)
        };
        let (low, high) = (rays.start, rays.end - 1);
        let step = if tangent(low) <= tangent(high) { 1 } else { -1 };
        let (from, to) = if step == 1 { (low, high) } else { (-high, -low) };
        let onwards = L::F::splat((fan.towards * step) as f32);
        let [x, y, length, longer, rise, higher] = &values;
        let [x, y] = [L::F::load(x), L::F::load(y)];
        let rise = [L::F::load(rise), L::F::load(higher) * onwards];
        let length = [L::F::load(length), L::F::load(longer) * onwards];
        let rows = Rows::new(rise, length, from, to);
        planes.clear::<L>(rays.len());
        let lines = Lines::<L>::new(self.relief, [x, y]);
        let focal = self.camera.focal_px();
        let fineness = Fineness {
            straight: (STRAIGHT * self.tolerance_px / focal) as f32,
            apart: (fan.spacing / focal) as f32,
        };
        let free = L::F::splat(0.0);
        let mut walk =
            Walk::new(self.relief, lines, rows, planes.places::<L>(), free, FIRST_BLOCK, fineness);
        walk.run(planes.found());
        let at = net.place(from * step, first) as usize;
        planes.fill::<L>(from, &mut net.answers, at, net.width as isize * step as isize);
        walk.looked
    }

    /// Sees the pixels of a row between the rays around them: one over their depths. Those of
    /// which these do not tell enough are added to `doubts`.
    #[inline(always)]
    fn see<L: Lanes>(
        &self,
        fan: &Fan,
        (row, pixels): (u32, Range<u32>),
        (net, verdict): (&Net, &Verdict),
        depths: &mut [f32],
        doubts: &mut Doubts,
    ) {
        let d = f64::from(row) + 0.5 - fan.reference;
        let scale = 1.0 / (1.0 + d * fan.q) / fan.spacing;
        let start = L::F::splat((d * fan.r * scale - 0.5) as f32);
        let answers = net.row(fan.ray(row));
        let (states, tips) = (&verdict.states[..net.width], &verdict.tips[..net.width]);
        let numbers = L::F::load(&NUMBERS);
        let first_line = L::I::splat(net.first_line);
        let sparse = scale < DENSEST;
        let mut places = [0; MOST];
        for (pixel, depths) in pixels.clone().step_by(L::N).zip(depths.chunks_mut(L::N)) {
            let minor = numbers + L::F::splat(pixel as f32 + 0.5);
            let line = start + minor * L::F::splat(scale as f32);
            let left = line.floor();
            let share = line - left.to_floats();
            let left = left - first_line;
            let (a, b, state) = if sparse {
                left.store(&mut places);
                let base = places[0].max(0) as usize;
                let left = left - L::I::splat(base as i32);
                let (answers, states) = (&answers[base..], &states[base..]);
                let (a, b) = (L::F::lookup(answers, left), L::F::lookup(&answers[1..], left));
                (a, b, L::F::lookup(states, left))
            } else {
                let (a, b) = gathered::<L>(answers, left);
                (a, b, gathered::<L>(states, left).0)
            };
            let open = L::F::splat(OPEN).eq(state);
            let answer = L::F::select(open, L::F::splat(f32::NAN), a + (b - a) * share);
            let count = depths.len();
            let within = L::M::from_bits(u32::MAX >> (32 - count));
            let doubtful = L::F::splat(BENT).le(state) & !open & within;
            if count == L::N {
                answer.store(depths);
            } else {
                let mut last = [0.0f32; MOST];
                answer.store(&mut last);
                depths.copy_from_slice(&last[..count]);
            }
            if doubtful.any() {
                let (mut guess, mut others) = (answer, None);
                if (doubtful & L::F::splat(BROKEN).le(state)).any() {
                    let (tip, beside) = gathered::<L>(tips, left);
                    let guesses = torn::<L>([a, b], answer, tip.max(beside), state);
                    (guess, others) = (guesses[0], Some([guesses[1], guesses[2]]));
                }
                let place = [minor.truncate(), L::I::splat(row as i32)];
                doubts.push::<L>(place, guess, others, doubtful);
            }
        }
    }
}

/// Where pixels may see ground, in the order in which it is to be tried, by the state between
/// their rays `a` and `b`. Where these see different ground, it is on either of the two;
/// where closer ground ends a little lower, it may be on that.
#[inline(always)]
fn torn<L: Lanes>([a, b]: [L::F; 2], between: L::F, tip: L::F, state: L::F) -> [L::F; GUESSES] {
    let zero = L::F::splat(0.0);
    let (low, high) = (a.min(b), a.max(b));
    // Behind voids there may be any ground, not just one of the two.
    let whole = L::I::splat(WHOLE);
    let whole = (a.to_bits() & b.to_bits() & whole).eq(whole);
    let far = L::F::select(whole, low, zero);
    let or_sky = L::F::select(zero.lt(between), between, L::F::splat(SKY));
    let same = net::same::<L>(a, b);
    let (bent, behind) = (state.eq(L::F::splat(BENT)), state.eq(L::F::splat(BEHIND)));
    let third = L::F::select(behind & !same, far, zero);
    let second = L::F::select(same, or_sky, high);
    let second = L::F::select(behind, second, far);
    let first = L::F::select(behind, tip, high);
    [
        L::F::select(bent, between, first),
        L::F::select(bent, zero, second),
        L::F::select(bent, zero, third),
    ]
}

/// The numbers of the lanes.
const NUMBERS: [f32; MOST] = {
    let mut numbers = [0.0; MOST];
    let mut lane = 0;
    while lane < MOST {
        numbers[lane] = lane as f32;
        lane += 1;
    }
    numbers
};

/// Elements of a row and those after them.
#[inline(always)]
fn gathered<L: Lanes>(row: &[f32], at: L::I) -> (L::F, L::F) {
    let (row, all) = (as_bits(row), !L::M::none());
    let next = at + L::I::splat(1);
    (L::F::from_bits(L::I::gather(row, at, all)), L::F::from_bits(L::I::gather(row, next, all)))
}
