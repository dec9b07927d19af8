//! The `column` method: coherent rays along lines through the nadir.
//!
//! All rays in a vertical plane through the camera appear on one line of the picture, and
//! all these lines pass through the point V straight below the camera (or straight above;
//! where the camera looks level it is infinitely far). Along such a line each ray rises
//! more steeply than the one before and begins where that one ended, whatever the pitch
//! and the roll (after Cohen-Or et al., section 2, whose columns are those of a camera
//! that does not roll).
//!
//! A pixel is seen along rows or along columns of the picture, whichever its line crosses
//! less slantingly. Take rows: a *band* of rows has lines a pixel apart at its row furthest
//! from V, and closer than that elsewhere, by half at most; the next band begins there.
//! Each line has one ray through each row. A pixel then lies between two neighbouring rays
//! of its own row, and is seen where they see: in between if they see neighbouring
//! ground, else where the nearer one does, which is at most half a pixel aside.

use crate::lanes::{Floats, Ints, Kernel, Lanes, MOST, Mask};
use crate::relief::Relief;
use crate::walk::{Lines, Rows, Walk, as_bits};
use glam::{DVec2, DVec3};
use std::ops::Range;
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;

/// Pixels closer to V than this are left to `lod`.
const NEAREST_PX: f64 = 8.0;
/// Two rays see neighbouring ground if their distances differ by less than this share.
const NEIGHBOURS: f32 = 0.02;
/// Distance between lines at the reference row of a band, pixels: per pixel of tolerance,
/// least and most. Measured (`bench core`): the error's 99th percentile stays below the
/// tolerance by a third.
const SPACING: f64 = 4.0;
const SPACINGS: [f64; 2] = [0.5, 4.0];
/// A band ends where its lines are closer than this share of the spacing ...
const CLOSEST: f64 = 0.55;
/// ... so that N pixels lie between at most 2 N lines, unless there are more lines than
/// this a pixel.
const DENSEST: f64 = 1.85;
/// The widest part of a region that is done at once, pixels: its rays fit a cache of 1 MB.
const WIDEST_PX: u32 = 256;

/// What the method needs to know of a view.
pub(crate) struct Columns<'r, 'a> {
    pub relief: &'r Relief<'a>,
    pub camera: &'r Camera,
    pub tolerance_px: f64,
    pub region: Region,
}

/// Distances, pixel by pixel, and what they took.
pub(crate) struct Seen {
    /// Straight distances from the camera, metres; infinite for the sky, NaN where a tile
    /// is missing and where the method does not apply.
    pub distance: Vec<f32>,
    pub steps: u64,
    pub rays: u64,
    pub fallen: u64,
    /// Pixels that the method does not apply to.
    pub left: u64,
}

/// The picture with rows as the major axis, or columns.
struct Frame {
    by_rows: bool,
    /// Direction of the ray through the corner of the picture ...
    corner: DVec3,
    /// ... and how it changes from pixel to pixel along the minor and the major axis.
    minor: DVec3,
    major: DVec3,
    /// V: along minor, along major, and what both are to be divided by.
    v: [f64; 3],
    /// Pixels along the minor and the major axis.
    size: [u32; 2],
}

/// Rows whose lines are a pixel apart in the first of them.
struct Band {
    /// The row, at its middle.
    reference: f64,
    rows: Range<u32>,
}

/// The lines of a band: line K goes through K in the reference row and through
/// `K + d (K q - r)` in the row d further on.
struct Fan {
    reference: f64,
    q: f64,
    r: f64,
    spacing: f64,
}

impl Frame {
    fn new(camera: &Camera, by_rows: bool) -> Self {
        let scale = 1.0 / camera.focal_px();
        let (across, down) = (camera.right * scale, -camera.up * scale);
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let corner = camera.forward - across * (0.5 * width) - down * (0.5 * height);
        let w = -camera.forward.z;
        let focal = camera.focal_px();
        let x = 0.5 * width * w - focal * camera.right.z;
        let y = 0.5 * height * w + focal * camera.up.z;
        if by_rows {
            let size = [camera.width, camera.height];
            Frame { by_rows, corner, minor: across, major: down, v: [x, y, w], size }
        } else {
            let size = [camera.height, camera.width];
            Frame { by_rows, corner, minor: down, major: across, v: [y, x, w], size }
        }
    }

    /// How far a row is from V, with a sign for the side; in units of V's last part.
    fn apart(&self, row: f64) -> f64 {
        row * self.v[2] - self.v[1]
    }

    /// Whether a pixel is seen along this frame's rows rather than its columns.
    fn owns(&self, minor: u32, major: u32) -> bool {
        let across = ((f64::from(minor) + 0.5) * self.v[2] - self.v[0]).abs();
        let along = self.apart(f64::from(major) + 0.5).abs();
        // A tie goes to the rows of the picture.
        if self.by_rows { along >= across } else { along > across }
    }

    /// The bands of the picture, each from its reference row towards V.
    fn bands(&self) -> Vec<Band> {
        let mut bands = Vec::new();
        let last = self.size[1];
        let middle = |row: u32| f64::from(row) + 0.5;
        for positive in [false, true] {
            // Rows on this side of V that are not too close to it.
            let near = NEAREST_PX * self.v[2].abs();
            let on_side = |row: u32| {
                let apart = self.apart(middle(row));
                if positive { apart > near } else { apart < -near }
            };
            let (first, end) = match ((0..last).find(|&row| on_side(row)), (0..last).rfind(|&row| on_side(row))) {
                (Some(first), Some(end)) => (first, end + 1),
                _ => continue,
            };
            let mut rest = first..end;
            while !rest.is_empty() {
                let (low, high) =
                    (self.apart(middle(rest.start)).abs(), self.apart(middle(rest.end - 1)).abs());
                let half = CLOSEST * low.max(high);
                let far_first = low >= high;
                let inside = |row: &u32| self.apart(middle(*row)).abs() >= half;
                if far_first {
                    let cut = rest.clone().take_while(inside).last().map_or(rest.start, |row| row) + 1;
                    bands.push(Band { reference: middle(rest.start), rows: rest.start..cut });
                    rest.start = cut;
                } else {
                    let cut = rest.clone().rev().take_while(inside).last().map_or(rest.end - 1, |row| row);
                    bands.push(Band { reference: middle(rest.end - 1), rows: cut..rest.end });
                    rest.end = cut;
                }
            }
        }
        bands
    }

    fn fan(&self, band: &Band, spacing: f64) -> Fan {
        let scale = 1.0 / self.apart(band.reference);
        Fan { reference: band.reference, q: self.v[2] * scale, r: self.v[0] * scale, spacing }
    }

    /// The pixels of a row, of those from `minors`, that are seen along this frame's rows:
    /// those no further from V across than along.
    fn owned(&self, row: u32, minors: Range<u32>) -> Range<u32> {
        let none = minors.start..minors.start;
        if minors.is_empty() {
            return none;
        }
        let owns = |minor: u32| self.owns(minor, row);
        if owns(minors.start) && owns(minors.end - 1) {
            return minors;
        }
        let reach = self.apart(f64::from(row) + 0.5).abs();
        let (a, b) = ((self.v[0] - reach) / self.v[2], (self.v[0] + reach) / self.v[2]);
        let pixel = |place: f64| (place - 0.5).clamp(-1.0, f64::from(u32::MAX)) as u32;
        let (mut first, mut last) = (pixel(a.min(b)), pixel(a.max(b)) + 1);
        first = first.saturating_sub(1).clamp(minors.start, minors.end - 1);
        last = (last + 1).clamp(minors.start, minors.end - 1);
        // What is left of rounding.
        while first < last && !owns(first) {
            first += 1;
        }
        while last > first && !owns(last) {
            last -= 1;
        }
        if owns(first) { first..last + 1 } else { none }
    }
}

impl Fan {
    /// The line through a point of a row.
    fn line(&self, minor: f64, row: f64) -> f64 {
        let d = row - self.reference;
        (minor + d * self.r) / (1.0 + d * self.q) / self.spacing
    }
}

impl Kernel for Columns<'_, '_> {
    type Output = Seen;

    #[inline(always)]
    fn run<L: Lanes>(self) -> Seen {
        let area = self.region.area() as usize;
        let mut seen = Seen { distance: vec![f32::NAN; area], steps: 0, rays: 0, fallen: 0, left: area as u64 };
        let mut rays = Vec::new();
        for by_rows in [true, false] {
            let frame = Frame::new(self.camera, by_rows);
            for band in frame.bands() {
                for part in parts(self.region, by_rows) {
                    self.band::<L>(&frame, &band, part, &mut rays, &mut seen);
                }
            }
        }
        seen
    }
}

/// A region in parts that are not too wide along the minor axis.
fn parts(region: Region, by_rows: bool) -> impl Iterator<Item = [Range<u32>; 2]> {
    let columns = region.x..region.x + region.width;
    let rows = region.y..region.y + region.height;
    let (minors, majors) = if by_rows { (columns, rows) } else { (rows, columns) };
    minors.clone().step_by(WIDEST_PX as usize).map(move |start| {
        [start..(start + WIDEST_PX).min(minors.end), majors.clone()]
    })
}

impl Columns<'_, '_> {
    #[inline(always)]
    fn band<L: Lanes>(
        &self,
        frame: &Frame,
        band: &Band,
        [minors, majors]: [Range<u32>; 2],
        rays: &mut Vec<f32>,
        seen: &mut Seen,
    ) {
        let rows = band.rows.start.max(majors.start)..band.rows.end.min(majors.end);
        let spacing = (SPACING * self.tolerance_px).clamp(SPACINGS[0], SPACINGS[1]);
        let fan = frame.fan(band, spacing);
        // For each row its pixels, and the lines that they lie between.
        let mut spans = Vec::new();
        let (mut first, mut last) = (i32::MAX, i32::MIN);
        for row in rows.clone() {
            let pixels = frame.owned(row, minors.clone());
            if pixels.is_empty() {
                spans.push((pixels, 0, -1));
                continue;
            }
            let middle = f64::from(row) + 0.5;
            let line = |pixel: u32| fan.line(f64::from(pixel) + 0.5, middle);
            let (a, b) = (line(pixels.start), line(pixels.end - 1));
            // Line k goes through k + 1/2. One more on each side makes up for rounding.
            let low = (a.min(b) - 0.5).floor() as i32 - 1;
            let high = (a.max(b) - 0.5).floor() as i32 + 2;
            (first, last) = (first.min(low), last.max(high));
            spans.push((pixels, low, high));
        }
        if first > last {
            return;
        }
        // Whole vectors are looked at, and twice as much.
        let width = (last - first + 1) as usize + 2 * MOST;
        rays.clear();
        rays.resize(width * spans.len(), 0.0);
        let mut block = first;
        while block <= last {
            let end = block + L::N as i32 - 1;
            let meets = |span: &(Range<u32>, i32, i32)| span.1 <= end && span.2 >= block;
            if let (Some(low), Some(high)) =
                (spans.iter().position(meets), spans.iter().rposition(meets))
            {
                let at = (block - first) as usize;
                let rows = (rows.start + low as u32)..(rows.start + high as u32 + 1);
                let rays = &mut rays[low * width..(high + 1) * width];
                seen.rays += rows.len() as u64 * L::N as u64;
                seen.steps += self.block::<L>(frame, &fan, block, rows, rays, width, at);
            }
            block += L::N as i32;
        }
        for (at, (pixels, _, _)) in spans.iter().enumerate() {
            let row = rows.start + at as u32;
            let rays = &rays[at * width..(at + 1) * width];
            self.resample::<L>(frame, &fan, row, pixels.clone(), rays, first, seen);
        }
    }

    /// Casts the rays of N lines through some rows. Returns the steps that it took.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    fn block<L: Lanes>(
        &self,
        frame: &Frame,
        fan: &Fan,
        first: i32,
        rows: Range<u32>,
        rays: &mut [f32],
        width: usize,
        at: usize,
    ) -> u64 {
        let mut values = [[0.0f32; MOST]; 6];
        for lane in 0..L::N {
            let line = (f64::from(first) + lane as f64 + 0.5) * fan.spacing;
            let start = frame.corner + frame.minor * line + frame.major * fan.reference;
            let change = frame.major + frame.minor * (line * fan.q - fan.r);
            let across = DVec2::new(start.x, start.y);
            let length = across.length();
            let along = across / length;
            let parts = [
                along.x,
                along.y,
                length,
                change.x * along.x + change.y * along.y,
                start.z,
                change.z,
            ];
            for (value, part) in values.iter_mut().zip(parts) {
                value[lane] = part as f32;
            }
        }
        let (x, y) = (L::F::load(&values[0]), L::F::load(&values[1]));
        let (length, longer) = (L::F::load(&values[2]), L::F::load(&values[3]));
        let (rise, higher) = (L::F::load(&values[4]), L::F::load(&values[5]));
        // Rows in the order of rising rays.
        let d = |row: u32| (f64::from(row) + 0.5 - fan.reference) as f32;
        let tangent = |row: u32| {
            let [_, _, length, longer, rise, higher] = values.map(|value| value[0]);
            (rise + d(row) * higher) / (length + d(row) * longer)
        };
        let upwards = tangent(rows.start) <= tangent(rows.end - 1);
        let mut lane = [0; MOST];
        let last = (rows.len() - 1) * width;
        for (number, place) in lane.iter_mut().enumerate() {
            *place = (at + number + if upwards { 0 } else { last }) as i32;
        }
        let rows = Rows {
            rise,
            higher,
            length,
            longer,
            first: if upwards { d(rows.start) } else { d(rows.end - 1) },
            step: if upwards { 1.0 } else { -1.0 },
            count: rows.len() as i32,
            at: L::I::load(&lane),
            pitch: if upwards { width as i32 } else { -(width as i32) },
        };
        let lines = Lines::<L>::new(self.relief, [x, y]);
        let mut walk = Walk::new(self.relief, lines, rows, L::F::splat(0.0));
        walk.run(rays);
        walk.steps
    }

    /// Sees the pixels of a row between the rays of its lines.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    fn resample<L: Lanes>(
        &self,
        frame: &Frame,
        fan: &Fan,
        row: u32,
        pixels: Range<u32>,
        rays: &[f32],
        first: i32,
        seen: &mut Seen,
    ) {
        let middle = f64::from(row) + 0.5;
        let d = middle - fan.reference;
        let scale = 1.0 / (1.0 + d * fan.q) / fan.spacing;
        // Line k goes through k + 1/2.
        let start = (d * fan.r * scale - 0.5) as f32;
        let begin = frame.corner + frame.major * middle;
        let mut numbers = [0.0f32; MOST];
        for (lane, number) in numbers.iter_mut().enumerate() {
            *number = lane as f32;
        }
        let numbers = L::F::load(&numbers);
        // The same bits, for gathers.
        let table = as_bits(rays);
        let mut out = [0.0f32; MOST];
        let mut places = [0; MOST];
        let sparse = scale.abs() < DENSEST;
        let mut pixel = pixels.start;
        while pixel < pixels.end {
            let minor = numbers + L::F::splat(pixel as f32 + 0.5);
            let line = L::F::splat(start) + minor * L::F::splat(scale as f32);
            let left = line.floor();
            let share = line - left.to_floats();
            let left = left - L::I::splat(first);
            let (a, b) = if sparse {
                left.store(&mut places);
                let base = places[0].max(0) as usize;
                let left = left - L::I::splat(base as i32);
                (L::F::lookup(&rays[base..], left), L::F::lookup(&rays[base + 1..], left))
            } else {
                (gathered::<L>(table, left), gathered::<L>(table, left + L::I::splat(1)))
            };
            let nearer = L::F::select(share.lt(L::F::splat(0.5)), a, b);
            let close = (b - a).abs().le(L::F::splat(NEIGHBOURS) * a.min(b));
            let inverse = L::F::select(close, a + (b - a) * share, nearer);
            let part = |n: usize| {
                L::F::splat(begin[n] as f32) + minor * L::F::splat(frame.minor[n] as f32)
            };
            let (x, y, z) = (part(0), part(1), part(2));
            let across = x * x + y * y;
            let stretch = (across + z * z).div(across * inverse * inverse).sqrt();
            let distance = stretch;
            seen.fallen += u64::from((!close).count());
            let count = L::N.min((pixels.end - pixel) as usize);
            let region = self.region;
            if frame.by_rows {
                let at = (row - region.y) as usize * region.width as usize;
                let at = at + (pixel - region.x) as usize;
                if count == L::N {
                    distance.store(&mut seen.distance[at..]);
                } else {
                    distance.store(&mut out);
                    seen.distance[at..at + count].copy_from_slice(&out[..count]);
                }
            } else {
                distance.store(&mut out);
                let at = (pixel - region.y) as usize * region.width as usize;
                let column = (row - region.x) as usize;
                let rows = seen.distance[at..].chunks_mut(region.width as usize);
                for (pixels, &distance) in rows.zip(&out[..count]) {
                    pixels[column] = distance;
                }
            }
            seen.left -= count as u64;
            pixel += L::N as u32;
        }
    }
}

#[inline(always)]
fn gathered<L: Lanes>(table: &[u32], at: L::I) -> L::F {
    L::F::from_bits(L::I::gather(table, at, !L::M::none()))
}
