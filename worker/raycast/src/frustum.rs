//! The `frustum` method: frusta over squares of pixels, halved until rays decide.
//!
//! ```text
//! queue <- squares of 32 pixels, free from the camera on
//! loop
//!   frustum <- the next of the queue
//!   go on with it as far as it clears the maxima of the ground
//!   if it leaves above everything
//!     all of its pixels see the sky
//!   else
//!     its corner pixel sees what the ray from there on meets
//!     quarter it; the parts queue up behind all frusta of its size, free as far as it is
//! ```
//!
//! After Teller and Alex, Frustum casting for progressive, interactive rendering,
//! sections 3 and 5.2. Their spatial index is here the pyramid of maxima, and their
//! arrival in a cell the next step of a beam (see `beam`). The rays of the last frusta, which
//! are of [`NARROWEST_PX`], are cast one by one. A frustum leaves out ground and never decides
//! on a contact; that is done by the cells of `exact`. So each answer is that of `exact`, to
//! the bit, for any camera and any terrain.
//!
//! **It can stop after any step.** [`Frusta`] holds no tile and no time, [`Frusta::step`]
//! looks at a single frustum, and a pixel that is confirmed stays as it is. Large frusta
//! come first, and those of a size in an interleaved order: when all of a size are done,
//! every pixel is at most so far from a confirmed one.

use crate::View;
use crate::beam::{Beams, Front};
use crate::exact::Exact;
use crate::field::{Field, Outcome};
use crate::painter::{path, squares};
use crate::path::Ground;
use crate::seen::{Seen, Unfit};
use std::collections::{BTreeSet, VecDeque};
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;
use terrafarm_terrain::layout::TileKey;

/// Side of the squares whose rays are cast one by one, pixels. Measured over mountains,
/// 960 x 540 pixels, three pitches: 2, as published, takes a quarter longer; 1, twice as long.
const NARROWEST_PX: u32 = 4;
/// The order in which the quarters of frusta are looked at: top left, top right, bottom
/// left, bottom right. The last are diagonal to the pixels already confirmed.
const ORDER: [usize; 4] = [3, 1, 2, 0];

/// Sees a region.
///
/// # Errors
/// None: the method takes any view. The keys are of tiles that were needed but not loaded;
/// pixels that depend on them are NaN.
pub(crate) fn see(
    field: Field,
    view: &View,
    region: Region,
) -> Result<(Seen, Vec<TileKey>), Unfit> {
    let mut caster = Caster::new(field, view);
    let mut frusta = Frusta::new(&caster, region);
    while frusta.step(&mut caster) {}
    let mut missing = BTreeSet::new();
    caster.exact.wanted.drain_into(&mut missing);
    Ok((frusta.seen, missing.into_iter().collect()))
}

/// What frusta are cast with: the tiles at hand and the camera.
pub(crate) struct Caster<'a> {
    camera: &'a Camera,
    ground: Ground,
    beams: Beams<'a>,
    exact: Exact<'a>,
}

/// A region that is being seen. Takes up to 40 bytes a pixel: check sizes from outside
/// with [`Region::fits`] first.
#[derive(Debug, Clone)]
pub(crate) struct Frusta {
    region: Region,
    /// What is known. A pixel that is not confirmed is NaN; when no frustum is left, that
    /// means that a tile is missing.
    pub seen: Seen,
    /// The frusta of one size ...
    queue: VecDeque<Frustum>,
    /// ... and those of the next, by which quarter they are.
    quarters: [Vec<Frustum>; 4],
}

/// The frustum over a square of pixels, or what the region leaves of it.
#[derive(Debug, Clone, Copy)]
struct Frustum {
    x: u32,
    y: u32,
    width: u8,
    height: u8,
    /// Whether the ray of its first pixel has been cast.
    begun: bool,
    front: Front,
}

impl<'a> Caster<'a> {
    pub(crate) fn new(field: Field<'a>, view: &'a View) -> Self {
        let camera = &view.camera;
        let ground = Ground::new(view.shading.earth);
        let beams = Beams::new(field, camera, ground);
        Caster { camera, ground, beams, exact: Exact::new(field) }
    }

    /// One over the depth of what a pixel sees, by a ray that is free up to a depth.
    fn cast(&mut self, x: u32, y: u32, free: f64) -> f32 {
        let place = [f64::from(x) + 0.5, f64::from(y) + 0.5];
        let (path, free_u) = path(self.camera, self.ground, place, free);
        match self.exact.cast(&path, free_u) {
            Outcome::Hit(contact) => {
                (self.camera.ray(place[0], place[1]).length() / contact.u) as f32
            }
            Outcome::Miss => 0.0,
            Outcome::Unfinished => f32::NAN,
        }
    }

    fn steps(&self) -> u64 {
        self.beams.steps + self.exact.steps
    }
}

impl Frusta {
    /// A region of which nothing is known.
    pub(crate) fn new(caster: &Caster, region: Region) -> Self {
        let front = caster.beams.start();
        let roots = squares(region).map(|square| Frustum {
            x: square.x,
            y: square.y,
            width: square.width as u8,
            height: square.height as u8,
            begun: false,
            front,
        });
        let mut numbered: Vec<(u32, Frustum)> = (0..).zip(roots).collect();
        // Far apart one after the other.
        numbered.sort_by_key(|(number, _)| number.reverse_bits());
        Frusta {
            region,
            seen: Seen::new(region),
            queue: numbered.into_iter().map(|(_, root)| root).collect(),
            quarters: [const { Vec::new() }; 4],
        }
    }

    /// Looks at one frustum; `false` if none is left. The view must be the same each time.
    pub(crate) fn step(&mut self, caster: &mut Caster) -> bool {
        let Some(mut frustum) = self.next() else { return false };
        let before = caster.steps();
        frustum.front = caster.beams.follow(frustum.square(), frustum.front);
        if frustum.front.free == f64::INFINITY {
            for [x, y] in frustum.square().pixels() {
                self.confirm(x, y, 0.0);
            }
        } else if u32::from(frustum.width.max(frustum.height)) <= NARROWEST_PX {
            for [x, y] in frustum.square().pixels().skip(usize::from(frustum.begun)) {
                self.cast(caster, x, y, frustum.front.free);
            }
        } else {
            if !frustum.begun {
                self.cast(caster, frustum.x, frustum.y, frustum.front.free);
                frustum.begun = true;
            }
            for (quarter, part) in frustum.quarters() {
                self.quarters[quarter].push(part);
            }
        }
        self.seen.steps += caster.steps() - before;
        true
    }

    fn next(&mut self) -> Option<Frustum> {
        if self.queue.is_empty() {
            for quarter in ORDER {
                self.queue.extend(std::mem::take(&mut self.quarters[quarter]));
            }
        }
        self.queue.pop_front()
    }

    fn cast(&mut self, caster: &mut Caster, x: u32, y: u32, free: f64) {
        self.seen.rays += 1;
        let inverse_depth = caster.cast(x, y, free);
        self.confirm(x, y, inverse_depth);
    }

    /// Writes what a pixel sees; NaN leaves it unconfirmed.
    fn confirm(&mut self, x: u32, y: u32, inverse_depth: f32) {
        let (column, row) = (x - self.region.x, y - self.region.y);
        let at = row as usize * self.region.width as usize + column as usize;
        self.seen.inverse_depth[at] = inverse_depth;
    }
}

impl Frustum {
    fn square(&self) -> Region {
        let Frustum { x, y, width, height, .. } = *self;
        Region { x, y, width: width.into(), height: height.into() }
    }

    /// The quarters that have pixels, with their places in [`ORDER`]'s numbers.
    fn quarters(self) -> impl Iterator<Item = (usize, Frustum)> {
        let half = self.width.max(self.height).next_power_of_two() / 2;
        let halves = |length: u8| [(0, length.min(half)), (half, length.saturating_sub(half))];
        let (columns, rows) = (halves(self.width), halves(self.height));
        (0..4).filter_map(move |quarter| {
            let ((left, width), (top, height)) = (columns[quarter % 2], rows[quarter / 2]);
            let part = Frustum {
                x: self.x + u32::from(left),
                y: self.y + u32::from(top),
                width,
                height,
                begun: self.begun && quarter == 0,
                front: self.front,
            };
            (width > 0 && height > 0).then_some((quarter, part))
        })
    }
}

#[cfg(test)]
mod tests;
