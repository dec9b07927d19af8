//! Beams abreast: the quarters of a square, their quarters and theirs, a beam a lane.
//!
//! Does what `Beams::advance` does, over a single height layer. Bounds need not be the
//! same to the bit: a beam is loose on the safe side by far more.
//!
//! A step that is too long is not lost: the beam is free up to where it may have come down
//! to the highest ground below the step. Each metre lower takes it 1 / fall further at
//! least, where fall is the least by which its bound sinks for each unit of depth. Over flat
//! ground that is one number. Over a round Earth of radius R a bound of the height at depth
//! t is (R + eye) (l + v) / (1 - v - l), with l = t sinc(a) down / R, a the angle over the
//! map, up to `REACH_RAD`, and v >= 0 of no depth beyond the start of the step. Its slope is
//! (1 + eye / R) sinc(a) down / (1 - v - l)^2, of which sinc(a) is at least [`SLOWEST`] and
//! 1 - v - l at most 1 + |t down| / R.

use super::{
    CLEARANCE_M, FLAT_REACH_M, NARROWEST_PX, REACH_RAD, ROUNDING, SHORTEST_STEP, WIDEST_PX,
};
use crate::exact::{Globe, Tiles};
use crate::lanes::{Doubles, Ints, Kernel, Lanes, MOST, Mask};
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;
use terrafarm_terrain::tile::MAXIMA_LEVELS;

/// The most squares at once, and elements of their arrays.
const MOST_SQUARES: usize = ((WIDEST_PX / NARROWEST_PX) * (WIDEST_PX / NARROWEST_PX)) as usize;
const ROOM: usize = MOST_SQUARES + MOST;

/// What is left of a step that was too long.
const SHORTER: f64 = 0.25;
/// Less than sin(a) / a for an angle of `REACH_RAD`.
const SLOWEST: f64 = 0.99;

/// The only height layer of a store, as beams of one camera come over it.
pub(super) struct Layer<'a> {
    pub(super) camera: &'a Camera,
    /// `None` for flat ground.
    pub(super) globe: Option<Globe>,
    /// Position of the camera, in cells from post (0, 0).
    pub(super) eye: [f64; 2],
    /// Cells per metre.
    pub(super) scale: [f64; 2],
    pub(super) cells: [i32; 2],
    /// Highest height of the terrain, metres.
    pub(super) highest: f64,
    /// Shortest side of a cell, metres.
    pub(super) finest_step: f64,
    /// Room to be kept above the ground, metres for each metre away.
    pub(super) slack: f64,
    pub(super) tiles: Tiles<'a>,
}

/// Squares of one side, in the order of their parents.
pub(super) struct Squares {
    pub(super) count: usize,
    /// Column and row of the first pixel.
    pub(super) left: [f64; ROOM],
    pub(super) top: [f64; ROOM],
    /// Depth up to which the beam is free, and its step.
    pub(super) free: [f64; ROOM],
    pub(super) step: [f64; ROOM],
}

/// Narrows a square of pixels down to the narrowest. Returns the steps taken.
pub(super) struct Narrow<'n, 'a> {
    pub(super) layer: &'n mut Layer<'a>,
    pub(super) region: Region,
    /// The square, and afterwards the narrowest ones in it.
    pub(super) squares: &'n mut Squares,
}

/// Beams on their way.
struct Beam<L: Lanes> {
    bounds: Bounds<L>,
    active: L::M,
    free: L::D,
    step: L::D,
    /// Width of the beams at depth 1.
    width: L::D,
    /// How much further a beam comes for each metre that it may be lower, at least.
    inverse_fall: L::D,
}

/// Bounds of the directions in squares; see `Bounds` of the slow twin.
#[derive(Clone, Copy)]
struct Bounds<L: Lanes> {
    low: [L::D; 3],
    high: [L::D; 3],
    across_squared: L::D,
    reach: L::D,
    /// Length of the longest ray at depth 1.
    longest: L::D,
}

impl Squares {
    pub(super) fn new() -> Self {
        Squares {
            count: 0,
            left: [0.0; ROOM],
            top: [0.0; ROOM],
            free: [0.0; ROOM],
            step: [0.0; ROOM],
        }
    }

    /// Starts over with one square.
    pub(super) fn set(&mut self, left: u32, top: u32, free: f64, step: f64) {
        self.count = 0;
        self.push([f64::from(left), f64::from(top), free, step]);
    }

    fn push(&mut self, [left, top, free, step]: [f64; 4]) {
        let at = self.count;
        (self.left[at], self.top[at], self.free[at], self.step[at]) = (left, top, free, step);
        self.count = at + 1;
    }

    /// Quarters all squares; what is outside a region is dropped.
    fn quarter(&mut self, half: f64, region: Region) {
        let (right, bottom) = (
            f64::from(region.x) + f64::from(region.width),
            f64::from(region.y) + f64::from(region.height),
        );
        let mut quarters = Squares::new();
        for at in 0..self.count {
            for (across, down) in [(0.0, 0.0), (half, 0.0), (0.0, half), (half, half)] {
                let (left, top) = (self.left[at] + across, self.top[at] + down);
                if left < right && top < bottom {
                    quarters.push([left, top, self.free[at], self.step[at]]);
                }
            }
        }
        *self = quarters;
    }
}

impl Kernel for Narrow<'_, '_> {
    type Output = u64;

    #[inline(always)]
    fn run<L: Lanes>(self) -> u64 {
        let Narrow { layer, region, squares } = self;
        match layer.globe {
            None => layer.narrow::<L, false>(region, squares),
            Some(_) => layer.narrow::<L, true>(region, squares),
        }
    }
}

impl Layer<'_> {
    #[inline(always)]
    fn bounds<L: Lanes>(
        &self,
        squares: &Squares,
        region: Region,
        at: usize,
        side: f64,
    ) -> Bounds<L> {
        let camera = self.camera;
        let right = f64::from(region.x) + f64::from(region.width);
        let bottom = f64::from(region.y) + f64::from(region.height);
        let (left, top) = (L::D::load(&squares.left[at..]), L::D::load(&squares.top[at..]));
        let right = (left + L::D::splat(side)).min(L::D::splat(right));
        let bottom = (top + L::D::splat(side)).min(L::D::splat(bottom));
        let scale = L::D::splat(2.0 * camera.tan_half_hfov / f64::from(camera.width));
        let middle_x = L::D::splat(0.5 * f64::from(camera.width));
        let middle_y = L::D::splat(0.5 * f64::from(camera.height));
        let across = [(left - middle_x) * scale, (right - middle_x) * scale];
        let upward = [(middle_y - top) * scale, (middle_y - bottom) * scale];
        let zero = L::D::splat(0.0);
        let mut longest = zero;
        let mut low = [L::D::splat(f64::INFINITY); 3];
        let mut high = [L::D::splat(f64::NEG_INFINITY); 3];
        for corner in 0..4 {
            let mut square = zero;
            for axis in 0..3 {
                let part = L::D::splat(camera.forward[axis])
                    + L::D::splat(camera.right[axis]) * across[corner & 1]
                    + L::D::splat(camera.up[axis]) * upward[corner >> 1];
                square = square + part * part;
                low[axis] = part.min(low[axis]);
                high[axis] = part.max(high[axis]);
            }
            longest = longest.max(square);
        }
        let margin = longest * L::D::splat(ROUNDING);
        for axis in 0..3 {
            low[axis] = low[axis] - margin;
            high[axis] = high[axis] + margin;
        }
        let x = low[0].max(zero - high[0]).max(zero);
        let y = low[1].max(zero - high[1]).max(zero);
        let reach = match &self.globe {
            Some(globe) => REACH_RAD / globe.curvature,
            None => FLAT_REACH_M,
        };
        let longest = longest.sqrt();
        let reach = L::D::splat(reach).div(longest);
        Bounds { low, high, across_squared: x * x + y * y, reach, longest }
    }

    /// Halves squares until they are the narrowest. Returns the steps taken.
    #[inline(always)]
    fn narrow<L: Lanes, const ROUND: bool>(
        &mut self,
        region: Region,
        squares: &mut Squares,
    ) -> u64 {
        let mut steps = 0;
        let mut side = WIDEST_PX;
        let mut fleet: Vec<Beam<L>> = Vec::with_capacity(MOST_SQUARES.div_ceil(L::N));
        let mut under_way = [0; MOST_SQUARES];
        while side > NARROWEST_PX {
            side /= 2;
            squares.quarter(f64::from(side), region);
            fleet.clear();
            let mut at = 0;
            while at < squares.count {
                under_way[fleet.len()] = fleet.len();
                fleet.push(self.beams::<L>(squares, region, at, f64::from(side)));
                at += L::N;
            }
            let mut left = fleet.len();
            while left > 0 {
                let mut kept = 0;
                for n in 0..left {
                    let number = under_way[n];
                    let beam = &mut fleet[number];
                    steps += u64::from(beam.active.count());
                    self.step::<L, ROUND>(beam);
                    under_way[kept] = number;
                    kept += usize::from(beam.active.any());
                }
                left = kept;
            }
            for (number, beam) in fleet.iter().enumerate() {
                beam.free.store(&mut squares.free[number * L::N..]);
                beam.step.store(&mut squares.step[number * L::N..]);
            }
        }
        steps
    }

    /// The beams of the squares from one on, as far as they are free.
    #[inline(always)]
    fn beams<L: Lanes>(&self, squares: &Squares, region: Region, at: usize, side: f64) -> Beam<L> {
        let bounds = self.bounds::<L>(squares, region, at, side);
        let count = squares.count - at;
        let lanes = if count < L::N { L::M::from_bits((1 << count) - 1) } else { !L::M::none() };
        let free = L::D::load(&squares.free[at..]);
        let share = match &self.globe {
            None => 1.0,
            Some(globe) => SLOWEST * (1.0 + globe.eye_z.min(0.0) * globe.curvature).max(0.0),
        };
        let fall = (L::D::splat(0.0) - bounds.low[2]) * L::D::splat(share);
        Beam {
            active: lanes & free.lt(bounds.reach),
            free,
            step: L::D::load(&squares.step[at..]),
            width: L::D::splat(side / self.camera.focal_px() * SHORTEST_STEP),
            inverse_fall: L::D::splat(1.0).div(fall + L::D::splat(self.slack) * bounds.longest),
            bounds,
        }
    }

    /// Takes N beams a step further.
    #[inline(always)]
    fn step<L: Lanes, const ROUND: bool>(&mut self, beam: &mut Beam<L>) {
        let Beam { bounds, free, step, active, .. } = *beam;
        let zero = L::D::splat(0.0);
        let end = (free + step).min(bounds.reach);
        let level_or_up = zero.le(bounds.low[2]);
        let mut rise = (bounds.low[2] * free).min(bounds.low[2] * end);
        if let (true, Some(globe)) = (ROUND, &self.globe) {
            rise = globe.rise::<L>(bounds.across_squared * free * free, rise);
        }
        let room = L::D::splat(self.slack) * end * bounds.longest;
        let eye_z = L::D::splat(self.camera.position.z);
        let lowest = eye_z + rise - L::D::splat(CLEARANCE_M) - room;
        let away = active & level_or_up & L::D::splat(self.highest).lt(lowest);
        let active = active & !away;
        let highest = self.highest_below::<L>(&bounds, free, end, active);
        let clear = active & highest.lt(lowest);
        // Where the beam comes down to the highest ground below it.
        let mut back = (highest - lowest) * beam.inverse_fall;
        if let (true, Some(globe)) = (ROUND, &self.globe) {
            let stretch = L::D::splat(1.0) - bounds.low[2] * end * L::D::splat(globe.curvature);
            back = back * (stretch * stretch);
        }
        let falls = active & !clear & !level_or_up;
        let lower = end - back;
        let come = L::D::select(falls & free.lt(lower), lower, free);
        let come = L::D::select(clear, end, come);
        let long = (beam.width * end + L::D::splat(self.finest_step)).lt(step);
        let shorter = active & !clear & long;
        let next = L::D::select(clear, step + step, step);
        beam.step = L::D::select(shorter, L::D::splat(SHORTER) * step, next);
        beam.free = L::D::select(away, L::D::splat(f64::INFINITY), come);
        beam.active = (clear | shorter) & come.lt(bounds.reach);
    }

    /// Height that no ground below beams from one depth to another exceeds, by four blocks
    /// that cover it; infinite where these are larger than tiles.
    #[inline(always)]
    fn highest_below<L: Lanes>(
        &mut self,
        bounds: &Bounds<L>,
        start: L::D,
        end: L::D,
        lanes: L::M,
    ) -> L::D {
        let (zero, one) = (L::I::splat(0), L::I::splat(1));
        let mut outside = L::M::none();
        let (mut first, mut last) = ([zero; 2], [zero; 2]);
        for axis in 0..2 {
            let (slow, fast) = (bounds.low[axis], bounds.high[axis]);
            let (eye, scale) = (L::D::splat(self.eye[axis]), L::D::splat(self.scale[axis]));
            let low = eye + scale * (slow * start).min(slow * end);
            let high = eye + scale * (fast * start).max(fast * end);
            let count = f64::from(self.cells[axis]);
            let size = low.abs().max(high.abs()) + L::D::splat(1.0 + count);
            let margin = L::D::splat(ROUNDING) * size;
            let (low, high) = (low - margin, high + margin);
            outside = outside | high.lt(L::D::splat(0.0)) | L::D::splat(count).lt(low);
            // Within the layer, so that they are whole numbers of 32 bits.
            let end = L::D::splat(count - 1.0);
            first[axis] = low.max(L::D::splat(0.0)).min(end).truncate();
            last[axis] = high.max(L::D::splat(0.0)).min(end).truncate();
        }
        let inside = lanes & !outside;
        let side = (last[0] - first[0]).max(last[1] - first[1]);
        let mut level = one;
        for bits in 1..MAXIMA_LEVELS {
            let longer = L::I::splat(1 << bits).lt(side);
            level = L::I::select(longer, level + one, level);
        }
        let far = L::I::splat(1 << MAXIMA_LEVELS).lt(side);
        let none = L::D::splat(f64::NEG_INFINITY);
        let mut highest = L::D::select(far & inside, L::D::splat(f64::INFINITY), none);
        let near = inside & !far;
        for corner in
            [[first[0], first[1]], [last[0], last[1]], [last[0], first[1]], [first[0], last[1]]]
        {
            highest = highest.max(self.tiles.maxima::<L>(corner, level, near).0);
        }
        highest
    }
}
