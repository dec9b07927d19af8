//! Where the rays of `column` go through the picture.
//!
//! All vertical planes through the camera appear as lines through one point V of the
//! picture, the one straight below the camera or straight above (infinitely far if the
//! camera looks level). A pixel belongs to the rows of the picture or to its columns,
//! whichever its line crosses less slantingly. Rows are taken in *bands*, from the row
//! furthest from V towards it: lines are a given spacing apart in the first row of a band,
//! and by the last one have come so close that a new band with fewer of them begins.
//!
//! All of this follows from the camera alone, not from the region that is asked for. The
//! *major* axis is that across rows (or columns), the *minor* one is along them.

use glam::DVec3;
use std::ops::Range;
use terrafarm_common::camera::Camera;

/// Pixels closer to V than this belong to no band.
const NEAREST_PX: f64 = 8.0;
/// A band ends where its lines are closer than this share of the spacing. Measured: with 0.55
/// a rolled view needs more memory than a thread keeps, with 0.75 the largest error of
/// `column` grows from 0.45 to 0.73 px, and 0.85 takes a tenth longer over a steep view.
const CLOSEST: f64 = 0.65;

/// The picture with rows as the major axis, or columns.
pub(crate) struct Frame {
    pub by_rows: bool,
    /// Direction of the ray through the corner of the picture ...
    pub corner: DVec3,
    /// ... and how it changes from pixel to pixel along the minor and the major axis.
    pub minor: DVec3,
    pub major: DVec3,
    /// V: along minor, along major, and what both are to be divided by.
    v: [f64; 3],
    /// Pixels along the minor and the major axis.
    size: [u32; 2],
}

/// Rows of which the first has its lines at the spacing, and the others closer.
pub(crate) struct Band {
    pub rows: Range<u32>,
    /// The first row is the last of the range: the band goes up the picture.
    pub falling: bool,
}

/// The lines of a band and the rays on them. Line k goes through `K = (k + 1/2) spacing` in
/// the reference row, at its middle, and through `K + d (K q - r)` d rows further on. Ray j
/// of each line goes through the j-th row from the reference row towards V.
pub(crate) struct Fan {
    pub reference: f64,
    pub spacing: f64,
    /// 1 if V lies towards the end of the rows, else -1.
    pub towards: i32,
    pub q: f64,
    pub r: f64,
}

impl Frame {
    pub(crate) fn new(camera: &Camera, by_rows: bool) -> Self {
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

    /// The ray `d` rows behind the reference row of a fan, on the line that is so many pixels
    /// along it there.
    pub(crate) fn ray(&self, fan: &Fan, line: f64, d: f64) -> DVec3 {
        let minor = line + d * (line * fan.q - fan.r);
        self.corner + self.minor * minor + self.major * (fan.reference + d)
    }

    /// How far a row is from V, with a sign for the side; in units of V's last part.
    fn apart(&self, row: f64) -> f64 {
        row * self.v[2] - self.v[1]
    }

    /// Whether a pixel is seen along this frame's rows rather than its columns.
    pub(crate) fn owns(&self, minor: u32, major: u32) -> bool {
        let across = ((f64::from(minor) + 0.5) * self.v[2] - self.v[0]).abs();
        let along = self.apart(f64::from(major) + 0.5).abs();
        // A tie goes to the rows of the picture.
        if self.by_rows { along >= across } else { along > across }
    }

    /// The part of the picture in which pixels may be too close to V for any band: columns
    /// and rows of the picture, if V is in it.
    pub(crate) fn around_v(&self) -> Option<[Range<u32>; 2]> {
        let [minor, major, w] = self.v;
        let range = |at: f64, size: u32| {
            let (low, high) = (at / w - NEAREST_PX - 2.0, at / w + NEAREST_PX + 2.0);
            let range =
                low.clamp(0.0, f64::from(size)) as u32..high.clamp(0.0, f64::from(size)) as u32;
            (!range.is_empty()).then_some(range)
        };
        let (minor, major) = (range(minor, self.size[0])?, range(major, self.size[1])?);
        Some(if self.by_rows { [minor, major] } else { [major, minor] })
    }

    /// Whether a row is too close to V for any band.
    pub(crate) fn is_near(&self, row: u32) -> bool {
        self.apart(f64::from(row) + 0.5).abs() <= NEAREST_PX * self.v[2].abs()
    }

    /// The bands of the picture, each from the row furthest from V towards it.
    pub(crate) fn bands(&self) -> Vec<Band> {
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
            // Where these begin and end, if there are any: they lie together.
            let first = if on_side(0) { 0 } else { turn(0..last, |row| !on_side(row)) };
            let end = if first < last { turn(first..last, on_side) } else { last };
            let mut rest = first..end;
            while !rest.is_empty() {
                let reach = |row: u32| self.apart(middle(row)).abs();
                let (low, high) = (reach(rest.start), reach(rest.end - 1));
                let half = CLOSEST * low.max(high);
                if low >= high {
                    let cut = turn(rest.clone(), |row| reach(row) >= half).max(rest.start + 1);
                    bands.push(Band { rows: rest.start..cut, falling: false });
                    rest.start = cut;
                } else {
                    let cut = turn(rest.clone(), |row| reach(row) < half).min(rest.end - 1);
                    bands.push(Band { rows: cut..rest.end, falling: true });
                    rest.end = cut;
                }
            }
        }
        bands
    }

    /// The lines of a band, so many pixels apart, as the rays on them are.
    pub(crate) fn fan(&self, band: &Band, spacing: f64) -> Fan {
        let first = if band.falling { band.rows.end - 1 } else { band.rows.start };
        let reference = f64::from(first) + 0.5;
        let scale = 1.0 / self.apart(reference);
        Fan {
            reference,
            spacing,
            towards: if band.falling { -1 } else { 1 },
            q: self.v[2] * scale,
            r: self.v[0] * scale,
        }
    }

    /// The pixels of a row, of those from `minors`, that are seen along this frame's rows:
    /// those no further from V across than along.
    pub(crate) fn owned(&self, row: u32, minors: Range<u32>) -> Range<u32> {
        let none = minors.start..minors.start;
        if minors.is_empty() {
            return none;
        }
        let owns = |minor: u32| self.owns(minor, row);
        let (start, last) = (minors.start, minors.end - 1);
        if owns(start) && owns(last) {
            return minors;
        }
        // Those that are, if there are any, lie together around the closest to V. That is known
        // to a pixel; where V is so far away that it is not, it is one of the ends.
        let closest = (self.v[0] / self.v[2] - 0.5).clamp(0.0, f64::from(u32::MAX)) as u32;
        let beside = [closest.saturating_sub(1), closest, closest.saturating_add(1)];
        let [a, b, c] = beside.map(|minor| minor.clamp(start, last));
        let Some(inside) = [b, a, c, start, last].into_iter().find(|&minor| owns(minor)) else {
            return none;
        };
        turn(start..inside, |minor| !owns(minor))..turn(inside..minors.end, owns)
    }
}

/// The first of some numbers that is not as the ones before it are.
fn turn(numbers: Range<u32>, is: impl Fn(u32) -> bool) -> u32 {
    let (mut low, mut high) = (numbers.start, numbers.end);
    while low < high {
        let middle = low + (high - low) / 2;
        if is(middle) {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    low
}

impl Fan {
    /// The ray of each line that goes through a row.
    pub(crate) fn ray(&self, row: u32) -> i32 {
        let apart = f64::from(row) + 0.5 - self.reference;
        apart as i32 * self.towards
    }

    /// The lines through points of a row, as numbers that count from line 0.
    #[inline]
    pub(crate) fn lines(&self, minors: [f64; 2], row: f64) -> [f64; 2] {
        let d = row - self.reference;
        let scale = 1.0 / ((1.0 + d * self.q) * self.spacing);
        minors.map(|minor| (minor + d * self.r) * scale - 0.5)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::oracle::Dice;

    #[test]
    fn every_pixel_is_owned_by_one_frame_and_found_in_its_row() {
        const SIZE: (u32, u32) = (320, 180);
        let mut dice = Dice::new(31);
        let (mut level, mut parted) = (0, 0);
        for round in 0..400 {
            // Level but for rounding, where V is very far away, and rolled so that it lies
            // across the border between the frames.
            let pitch = match round % 4 {
                0 => 0.0,
                1 => [1e-14, -3e-14, 1e-13, 1e-12, -1e-11][round / 4 % 5],
                2 => [-90.0, 90.0, -89.999][round / 4 % 3],
                _ => dice.between(-90.0, 90.0),
            };
            let roll = [0.0, 45.0, -45.0, 135.0, 90.0, dice.between(-180.0, 180.0)][round % 6];
            let eye = DVec3::new(0.0, 0.0, 100.0);
            let camera = Camera::from_angles(eye, 0.0, pitch, roll, 60.0, SIZE);
            let frames = [true, false].map(|by_rows| Frame::new(&camera, by_rows));
            let mut owners = vec![0; (SIZE.0 * SIZE.1) as usize];
            for (frame, [minors, majors]) in frames.iter().zip([[SIZE.0, SIZE.1], [SIZE.1, SIZE.0]])
            {
                for major in 0..majors {
                    let from = dice.below(u64::from(minors)) as u32;
                    for part in [0..from, from..minors] {
                        let owned = frame.owned(major, part.clone());
                        for minor in part.clone() {
                            let is = frame.owns(minor, major);
                            let said = format!("{minor} {major} {part:?} {owned:?} {camera:?}");
                            assert_eq!(owned.contains(&minor), is, "{said}");
                            let at = if frame.by_rows { [minor, major] } else { [major, minor] };
                            owners[(at[1] * SIZE.0 + at[0]) as usize] += u32::from(is);
                        }
                        parted += u32::from(!owned.is_empty() && owned.len() < part.len());
                    }
                }
            }
            assert!(owners.iter().all(|&count| count == 1), "{camera:?}");
            level += u32::from(pitch.abs() < 1e-10);
        }
        assert!(level > 100 && parted > 1000, "{level} {parted}");
    }
}
