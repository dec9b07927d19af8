//! A list of rays, and what they meet: one array for each number.

use crate::lanes::MOST;

/// The most rays of a list.
pub(crate) const MOST_RAYS: usize = 1024;
/// Elements of an array: vectors may reach beyond the last ray, and begin anywhere.
const ROOM: usize = MOST_RAYS + 2 * MOST;

/// What is kept of each ray as f64.
#[derive(Debug, Clone, Copy)]
pub(super) enum Part {
    /// Place in the picture, pixels ...
    PlaceX,
    PlaceY,
    /// ... and the depth up to which the ray is known to be free.
    Depth,
    DirectionX,
    DirectionY,
    DirectionZ,
    /// Parameter at which the walk begins, and then that of the contact.
    U,
    /// Height there.
    Z,
    RateX,
    RateY,
    InverseX,
    InverseY,
    /// Where the stretch or the span begins, whichever is last ...
    First,
    /// ... and where one of them ends; -infinity if there is nothing to walk over.
    Last,
    /// Where the stretch ends.
    End,
    /// Over a round Earth: the span in which the walk begins.
    Across,
    Number,
    StartU,
    EndU,
    StartZ,
    EndZ,
    Slope,
    Bend,
    /// The cell in which the walk begins.
    CellX,
    CellY,
}

const PARTS: usize = Part::CellY as usize + 1;

/// What became of a ray.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(i32)]
pub(super) enum Verdict {
    Miss,
    Hit,
    /// It is for the slow twin to say.
    Open,
}

const HIT: i32 = Verdict::Hit as i32;
const MISS: i32 = Verdict::Miss as i32;

/// Rays of one view over one layer.
pub(super) struct Rays {
    parts: Vec<[f64; ROOM]>,
    pub(super) cells: [Vec<i32>; 2],
    /// Verdicts, as numbers that lanes can hold.
    pub(super) verdicts: Vec<i32>,
    /// One over the depths of contacts, per metre; 0 where there is none.
    pub(super) inverse_depths: Vec<f32>,
    /// Of rays that were taken from another list: their numbers there.
    pub(super) origins: Vec<u32>,
    pub(super) count: usize,
}

impl Rays {
    pub(super) fn new() -> Self {
        Rays {
            parts: vec![[0.0; ROOM]; PARTS],
            cells: [vec![0; ROOM], vec![0; ROOM]],
            origins: vec![0; ROOM],
            verdicts: vec![Verdict::Miss as i32; ROOM],
            inverse_depths: vec![0.0; ROOM],
            count: 0,
        }
    }

    /// Adds a ray of another list.
    pub(super) fn take(&mut self, other: &Rays, ray: usize) {
        let at = self.count;
        for (part, others) in self.parts.iter_mut().zip(&other.parts) {
            part[at] = others[ray];
        }
        self.origins[at] = ray as u32;
        self.count = at + 1;
    }

    #[inline(always)]
    pub(super) fn verdict(&self, ray: usize) -> Verdict {
        match self.verdicts[ray] {
            HIT => Verdict::Hit,
            MISS => Verdict::Miss,
            _ => Verdict::Open,
        }
    }

    #[inline(always)]
    pub(super) fn part(&self, part: Part) -> &[f64; ROOM] {
        &self.parts[part as usize]
    }

    #[inline(always)]
    pub(super) fn part_mut(&mut self, part: Part) -> &mut [f64; ROOM] {
        &mut self.parts[part as usize]
    }
}
