//! The `column` method: coherent rays along lines through the nadir.
//!
//! All rays in a vertical plane through the camera appear on one line of the picture, and
//! along such a line each ray rises more steeply than the one before and begins where that
//! one ended, whatever the pitch and the roll (after Cohen-Or et al., section 2, whose
//! columns are those of a camera that does not roll). `lattice` says which lines and rays
//! there are: neighbours are about four pixels apart for each pixel of tolerance.
//!
//! What rays find is kept as inverse depth, which over a plane is linear in the picture. A
//! pixel is first guessed between the four rays around it, if they see neighbouring ground,
//! then compared with the surface at that very place: what is off by more than half the
//! tolerance is corrected along the pixel's own ray and compared again. Where the rays see
//! different ground, where the corrections do not settle, and close to V, the pixel has a
//! ray of its own, that of `lod`. So every pixel shows a point of the surface, to the
//! tolerance; what a pixel can miss is ground in front that is narrower than the distance
//! between rays.

use crate::lanes::{Floats, Ints, Kernel, Lanes, MOST, Mask, as_bits};
use crate::lattice::{Band, Fan, Frame};
use crate::lod::{Alone, cast_pixels};
use crate::relief::Relief;
use crate::seen::Seen;
use crate::walk::{Lines, Rows, Slopes, Walk};
use glam::DVec2;
use std::ops::Range;
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;

/// Distance between lines, pixels for each pixel of tolerance, and the least and the most.
/// Measured (`bench core`): more lines cost more, fewer leave more pixels to rays of their
/// own.
const SPACING: f64 = 5.0;
const SPACINGS: [f64; 2] = [0.5, 4.0];
/// Rays see neighbouring ground if their depths differ by no more than this share.
const NEIGHBOURS: f32 = 0.02;
/// How much closer than the nearest ground seen around a pixel its own ray begins to look:
/// a ridge may come closer between the rays around it.
const SHARE_FREE: f32 = 0.9;
/// Share of the tolerance by which a pixel may be off the surface without being corrected.
/// The other half is for the surface: see [`LEVELS`].
const ALLOWED: f64 = 0.5;
/// Share of the tolerance by which the levels of the surface may be off level 0.
pub(crate) const LEVELS: f64 = 0.5;
/// How often a pixel is compared with the surface at most ...
const CORRECTIONS: usize = 4;
/// ... and by what share of its depth it may be moved each time.
const FARTHEST: f32 = 0.05;
/// Lines a pixel up to which those between N pixels are no more than 2 N.
const DENSEST: f64 = 1.85;
/// The widest part of a region that is done at once, pixels: its rays fit a cache of 1 MB.
const WIDEST_PX: u32 = 256;

/// The method for a region of a view.
pub(crate) struct Columns<'r, 'a> {
    pub relief: &'r Relief<'a>,
    pub camera: &'r Camera,
    pub tolerance_px: f64,
    pub region: Region,
}

/// A row of pixels, and the lines around them.
struct Span {
    pixels: Range<u32>,
    lines: Range<i32>,
}

/// The rays of a part of a band, ray by ray from `first_ray`, in each line by line from
/// `first_line`.
struct Net {
    answers: Vec<f32>,
    /// By the first of the four answers around a cell of the net: 1 if here or in one of
    /// the eight cells around the four are not of neighbouring ground, else 0.
    breaks: Vec<f32>,
    /// The same without the cells around.
    own_breaks: Vec<f32>,
    width: usize,
    first_ray: usize,
    first_line: i32,
}

impl Kernel for Columns<'_, '_> {
    type Output = Seen;

    #[inline(always)]
    fn run<L: Lanes>(self) -> Seen {
        let area = self.region.area() as usize;
        let mut seen = Seen::new(self.region);
        let mut net = Net {
            answers: Vec::new(),
            breaks: Vec::new(),
            own_breaks: Vec::new(),
            width: 0,
            first_ray: 0,
            first_line: 0,
        };
        let mut alone = Vec::new();
        let spacing = (SPACING * self.tolerance_px).clamp(SPACINGS[0], SPACINGS[1]);
        let mut done = 0;
        for by_rows in [true, false] {
            let frame = Frame::new(self.camera, by_rows);
            for band in frame.bands() {
                let fan = frame.fan(&band, spacing);
                for part in parts(self.region, by_rows) {
                    let spans = spans(&frame, &band, &fan, &part);
                    if !spans.iter().all(|span| span.pixels.is_empty()) {
                        let first = band.rows.start.max(part[1].start);
                        self.cast::<L>(&frame, &fan, first, &spans, &mut net, &mut seen);
                        let filled = spans.iter().zip(first..);
                        for (span, row) in filled.filter(|(span, _)| !span.pixels.is_empty()) {
                            done += span.pixels.len() as u64;
                            let rows = (row, span.pixels.clone());
                            self.see::<L>(&frame, &fan, rows, &net, &mut seen, &mut alone);
                        }
                    }
                }
            }
        }
        if done < area as u64 {
            // What is close to V.
            let frames = [true, false].map(|by_rows| Frame::new(self.camera, by_rows));
            let [columns, rows] = frames[0].around_v().unwrap_or([0..0, 0..0]);
            for (at, [x, y]) in (0..).zip(self.region.pixels()) {
                if !columns.contains(&x) || !rows.contains(&y) {
                    continue;
                }
                let near = frames[0].owns(x, y) && frames[0].is_near(y)
                    || frames[1].owns(y, x) && frames[1].is_near(x);
                if near {
                    alone.push(Alone { at, free: 0.0 });
                }
            }
        }
        seen.alone = alone.len() as u64;
        seen.rays += seen.alone;
        seen.steps += cast_pixels::<L>(
            self.relief,
            self.camera,
            self.region,
            &alone,
            &mut seen.inverse_depth,
        );
        seen
    }
}

impl Net {
    /// Finds the cells where the picture breaks, and their neighbours.
    #[inline(always)]
    fn compare<L: Lanes>(&mut self) {
        let Net { answers, breaks, own_breaks, width, .. } = self;
        let (width, count) = (*width, answers.len());
        // A margin for the vectors beyond the end.
        answers.resize(count + width + 2 * MOST, 0.0);
        for list in [&mut *breaks, &mut *own_breaks] {
            list.clear();
            list.resize(count + width + 2 * MOST, 0.0);
        }
        let (zero, one) = (L::F::splat(0.0), L::F::splat(1.0));
        let neighbours = L::F::splat(1.0 - NEIGHBOURS);
        for at in (0..count).step_by(L::N) {
            let (a, b) = (L::F::load(&answers[at..]), L::F::load(&answers[at + 1..]));
            let next = if at + width < count { at + width } else { at };
            let (c, e) = (L::F::load(&answers[next..]), L::F::load(&answers[next + 1..]));
            let (low, high) = (a.min(b).min(c.min(e)), a.max(b).max(c.max(e)));
            let same = (high * neighbours).le(low);
            L::F::select(same, zero, one).store(&mut own_breaks[at..]);
        }
        for row in (0..count).step_by(width.max(1)) {
            let above = row.saturating_sub(width);
            // What a vector writes beyond the end of the row is written again by the next.
            for column in (1..width).step_by(L::N) {
                let mut worst = zero;
                for row in [above, row, row + width] {
                    for place in [row + column - 1, row + column, row + column + 1] {
                        worst = worst.max(L::F::load(&own_breaks[place..]));
                    }
                }
                worst.store(&mut breaks[row + column..]);
            }
        }
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
fn spans(frame: &Frame, band: &Band, fan: &Fan, [minors, majors]: &[Range<u32>; 2]) -> Vec<Span> {
    let rows = band.rows.start.max(majors.start)..band.rows.end.min(majors.end);
    let span = |row: u32| {
        let pixels = frame.owned(row, minors.clone());
        if pixels.is_empty() {
            return Span { pixels, lines: 0..0 };
        }
        let middle = f64::from(row) + 0.5;
        let line = |pixel: u32| fan.line(f64::from(pixel) + 0.5, middle);
        let (a, b) = (line(pixels.start), line(pixels.end - 1));
        // One more on each side to compare with, and one makes up for rounding.
        let lines = a.min(b).floor() as i32 - 2..a.max(b).floor() as i32 + 4;
        Span { pixels, lines }
    };
    rows.map(span).collect()
}

impl Columns<'_, '_> {
    /// Casts the rays that the pixels of some rows lie between.
    #[inline(always)]
    fn cast<L: Lanes>(
        &self,
        frame: &Frame,
        fan: &Fan,
        first_row: u32,
        spans: &[Span],
        net: &mut Net,
        seen: &mut Seen,
    ) {
        let filled = || spans.iter().zip(first_row..).filter(|(span, _)| !span.pixels.is_empty());
        let rays = |row: u32| {
            // The row is between ray n and ray n + 1; one more on each side to compare with.
            let (before, _) = fan.rays(row);
            before.saturating_sub(1)..before + 3
        };
        let first_ray = filled().map(|(_, row)| rays(row).start).min().unwrap_or(0);
        let end_ray = filled().map(|(_, row)| rays(row).end).max().unwrap_or(0);
        let first_line = filled().map(|(span, _)| span.lines.start).min().unwrap_or(0);
        let end_line = filled().map(|(span, _)| span.lines.end).max().unwrap_or(0);
        // Whole vectors are looked at, and twice as much.
        let width = (end_line - first_line) as usize + 2 * MOST;
        net.answers.clear();
        net.answers.resize(width * (end_ray - first_ray), 0.0);
        (net.width, net.first_ray, net.first_line) = (width, first_ray, first_line);
        for block in (first_line..end_line).step_by(L::N) {
            let end = block + L::N as i32;
            let meets = |(span, _): &(&Span, u32)| span.lines.start < end && span.lines.end > block;
            let low = filled().filter(meets).map(|(_, row)| rays(row).start).min();
            let high = filled().filter(meets).map(|(_, row)| rays(row).end).max();
            if let (Some(low), Some(high)) = (low, high) {
                seen.rays += ((high - low) * L::N) as u64;
                seen.steps += self.block::<L>(frame, fan, block, low..high, net);
            }
        }
        net.compare::<L>();
    }

    /// Casts rays of N lines. Returns the steps that it took.
    #[inline(always)]
    fn block<L: Lanes>(
        &self,
        frame: &Frame,
        fan: &Fan,
        first: i32,
        rays: Range<usize>,
        net: &mut Net,
    ) -> u64 {
        let mut values = [[0.0f32; MOST]; 6];
        for lane in 0..L::N {
            let line = (f64::from(first) + lane as f64 + 0.5) * fan.spacing;
            let start = frame.corner + frame.minor * line + frame.major * fan.reference;
            let change = frame.major + frame.minor * (line * fan.q - fan.r);
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
        let d = |ray: usize| (ray as f64 * fan.every) as f32;
        let tangent = |ray: usize| {
            let [_, _, length, longer, rise, higher] = values.map(|value| value[0]);
            (rise + d(ray) * higher) / (length + d(ray) * longer)
        };
        let (low, high) = (rays.start, rays.end - 1);
        let onwards = tangent(low) <= tangent(high);
        let (begin, step) = if onwards { (low, 1) } else { (high, -1) };
        let at = (begin - net.first_ray) * net.width + (first - net.first_line) as usize;
        let mut places = [0; MOST];
        for (place, lane) in places.iter_mut().zip(0..) {
            *place = at as i32 + lane;
        }
        let (x, y) = (L::F::load(&values[0]), L::F::load(&values[1]));
        let rows = Rows {
            length: L::F::load(&values[2]),
            longer: L::F::load(&values[3]),
            rise: L::F::load(&values[4]),
            higher: L::F::load(&values[5]),
            first: d(begin),
            step: fan.every as f32 * step as f32,
            count: rays.len() as i32,
            at: L::I::load(&places),
            pitch: net.width as i32 * step,
        };
        let lines = Lines::<L>::new(self.relief, [x, y]);
        let mut walk = Walk::new(self.relief, lines, rows, L::F::splat(0.0), 8);
        walk.run(&mut net.answers);
        walk.looked
    }

    /// Sees the pixels of a row between the rays around them. Those that cannot be seen so
    /// are added to `alone`, by their place in the region.
    #[inline(always)]
    fn see<L: Lanes>(
        &self,
        frame: &Frame,
        fan: &Fan,
        (row, pixels): (u32, Range<u32>),
        net: &Net,
        seen: &mut Seen,
        alone: &mut Vec<Alone>,
    ) {
        let d = f64::from(row) + 0.5 - fan.reference;
        let scale = 1.0 / (1.0 + d * fan.q) / fan.spacing;
        let start = L::F::splat((d * fan.r * scale - 0.5) as f32);
        let scale_f = L::F::splat(scale as f32);
        let begin = frame.corner + frame.major * (f64::from(row) + 0.5);
        let (ray, down) = fan.rays(row);
        let at = (ray - net.first_ray) * net.width;
        let before = &net.answers[at..at + net.width];
        let next = if down > 0.0 { at + net.width } else { at };
        let after = &net.answers[next..next + net.width];
        let breaks = &net.breaks[at..at + net.width];
        let down = L::F::splat(down);
        let numbers = L::F::load(&NUMBERS);
        let sparse = scale < DENSEST;
        let region = self.region;
        let mut places = [0; MOST];
        let mut out = [0.0f32; MOST];
        let mut nearest = [0.0f32; MOST];
        for pixel in pixels.clone().step_by(L::N) {
            let minor = numbers + L::F::splat(pixel as f32 + 0.5);
            let line = start + minor * scale_f;
            let left = line.floor();
            let share = line - left.to_floats();
            let left = left - L::I::splat(net.first_line);
            let ((a, b), (c, e), broken) = if sparse {
                left.store(&mut places);
                let base = places[0].max(0) as usize;
                let left = left - L::I::splat(base as i32);
                (
                    looked_up::<L>(&before[base..], left),
                    looked_up::<L>(&after[base..], left),
                    L::F::lookup(&breaks[base..], left),
                )
            } else {
                (
                    gathered::<L>(before, left),
                    gathered::<L>(after, left),
                    gathered::<L>(breaks, left).0,
                )
            };
            let high = a.max(b).max(c.max(e));
            let close = broken.eq(L::F::splat(0.0));
            let (above, below) = (a + (b - a) * share, c + (e - c) * share);
            let guess = above + (below - above) * down;
            let count = L::N.min((pixels.end - pixel) as usize);
            let all = L::M::from_bits(u32::MAX >> (32 - count));
            let sky = high.eq(L::F::splat(0.0));
            let mut ray = [minor; 3];
            for n in 0..3 {
                ray[n] = L::F::splat(begin[n] as f32) + minor * L::F::splat(frame.minor[n] as f32);
            }
            let (answer, sure) = self.settle::<L>(ray, guess, close & all & !sky);
            let close = sure | (sky & close);
            let mut strange = (!close).bits() & (u32::MAX >> (32 - count));
            if strange != 0 {
                high.store(&mut nearest);
            }
            if frame.by_rows {
                let at = (row - region.y) as usize * region.width as usize;
                let at = at + (pixel - region.x) as usize;
                if count == L::N {
                    answer.store(&mut seen.inverse_depth[at..]);
                } else {
                    answer.store(&mut out);
                    seen.inverse_depth[at..at + count].copy_from_slice(&out[..count]);
                }
                while strange != 0 {
                    let lane = strange.trailing_zeros();
                    let free = free_before(nearest[lane as usize % MOST]);
                    alone.push(Alone { at: at as u32 + lane, free });
                    strange &= strange - 1;
                }
            } else {
                answer.store(&mut out);
                let at = (pixel - region.y) as usize * region.width as usize;
                let column = (row - region.x) as usize;
                let rows = seen.inverse_depth[at..].chunks_mut(region.width as usize);
                for (pixels, &answer) in rows.zip(&out[..count]) {
                    pixels[column] = answer;
                }
                while strange != 0 {
                    let lane = strange.trailing_zeros();
                    let free = free_before(nearest[lane as usize % MOST]);
                    let at = (at + column) as u32 + lane * region.width;
                    alone.push(Alone { at, free });
                    strange &= strange - 1;
                }
            }
        }
    }
}

impl Columns<'_, '_> {
    /// Moves guesses along rays until they are on the surface. Returns which have got
    /// there.
    #[inline(always)]
    fn settle<L: Lanes>(&self, ray: [L::F; 3], guess: L::F, lanes: L::M) -> (L::F, L::M) {
        let one = L::F::splat(1.0);
        let [x, y, z] = ray;
        let across = x * x + y * y;
        // The tolerance as a length at depth 1: |ray| / focal.
        let allowed = ALLOWED * (self.tolerance_px / self.camera.focal_px());
        let allowed = L::F::splat((allowed * allowed) as f32) * (across + z * z);
        let (mut answer, mut sure, mut left) = (guess, L::M::none(), lanes);
        for _ in 0..CORRECTIONS {
            let depth = one.div(answer);
            let (solid, ground, slopes) = self.relief.surface::<L>([x * depth, y * depth], left);
            let (height, rise) = if self.relief.curvature == 0.0 {
                (z * depth, z)
            } else {
                let length = across.sqrt();
                let slopes = Slopes::<L>::new(self.relief, z.div(length));
                let bend = L::F::splat(self.relief.curvature as f32) * across * depth;
                (slopes.height(length * depth), z + bend)
            };
            let off = height - ground;
            let share = off * answer;
            sure = sure | (left & solid & (share * share).le(allowed));
            left = left & solid & !sure;
            if !left.any() {
                break;
            }
            let closing = rise - slopes[0] * x - slopes[1] * y;
            let corrected = one.div(depth - off.div(closing));
            let near = (corrected - answer).abs().lt(L::F::splat(FARTHEST) * answer);
            left = left & near;
            answer = L::F::select(left, corrected, answer);
        }
        (answer, sure)
    }
}

/// The depth from which a pixel's own ray looks for ground, if the nearest that is seen
/// around it has this inverse depth.
fn free_before(nearest: f32) -> f32 {
    if nearest > 0.0 { SHARE_FREE / nearest } else { 0.0 }
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

/// Elements of a row and those after them, the first less than 2 N further on.
#[inline(always)]
fn looked_up<L: Lanes>(row: &[f32], at: L::I) -> (L::F, L::F) {
    (L::F::lookup(row, at), L::F::lookup(&row[1..], at))
}

/// The same, however far on they are.
#[inline(always)]
fn gathered<L: Lanes>(row: &[f32], at: L::I) -> (L::F, L::F) {
    let (row, all) = (as_bits(row), !L::M::none());
    let next = at + L::I::splat(1);
    (L::F::from_bits(L::I::gather(row, at, all)), L::F::from_bits(L::I::gather(row, next, all)))
}
