//! The accuracy meter: how far an answer for a pixel is from that of `exact`.
//!
//! An answer is a straight distance from the camera along the ray through the centre of a
//! pixel, or sky. Everything is computed in f64 on the finest posts. The unit of every
//! error is the *pixel*: a height e at the distance d is `e * focal / d` pixels, focal
//! being the focal length in pixels. That is what e measures in the middle of a level
//! picture, and the unit in which methods state their bounds; towards the corners of a
//! wide picture, and looking down, the true displacement on screen differs from it by a
//! factor that the camera alone decides.
//!
//! **Precision.** A distance is taken for known to one part in 2^22, two units of single
//! precision: *at* a distance means within that.
//!
//! **`surface_px`**: P is the point of the ray at the claimed distance. The error is the
//! height between P and the true surface right above or below it, in pixels; 0 if the ray
//! passes through the surface, a wall included, at that distance. Where there is no ground
//! above or below P it is [`ERROR_MAX_PX`]. Sky has no such error.
//!
//! **`occlusion_px`**: the ray *raised by* k pixels goes through the point which is k
//! pixels straight above P; for sky, through the one that is so at an infinite distance.
//! It stays in the vertical plane of the ray, and a higher one is above a lower one
//! everywhere: on screen, it moves towards the world's up. A raised ray is *hindered* if
//! it meets the true surface clearly before it is above P: at a distance that is shorter
//! by more than the precision. For sky, any contact hinders. The error is 0 if the ray
//! raised by `surface_px` (and [`STEP_PX`], against rounding) is free: then what hides P
//! is no more than what P is off anyway. Otherwise it is the smallest k that frees the
//! ray, to [`STEP_PX`].
//!
//! An exactly right answer is 0 in both: the ray passes through the surface at the
//! distance, and is free before it, for its first contact is there. So an answer at the
//! true distance is not looked at any further. Conversely, the larger of both errors is about the smallest e such that the answer is within e pixels of the
//! surface and the ray raised by e pixels sees no other ground before. So a method whose
//! surface is nowhere further than e pixels from the true one has no error above e.
//!
//! Errors beyond [`ERROR_MAX_PX`] are not told apart. A camera at or below the surface
//! sees the ground at distance 0: that answer is right, every other as wrong as can be.

use crate::exact::Exact;
use crate::field::{Contact, Field, Outcome};
use crate::painter::path;
use crate::path::{Ground, Path};
use crate::pyramid::Pyramid;
use crate::{Missing, View};
use glam::DVec3;
use std::collections::BTreeSet;
use terrafarm_common::accuracy::{ERROR_MAX_PX, PixelError};
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::Resident;

/// What is known of a distance, as a share of it.
const PRECISION: f64 = 1.0 / 4_194_304.0;
/// To what an occlusion is determined, pixels.
pub const STEP_PX: f64 = 1.0 / 1024.0;

/// The error of a claimed answer for pixel (x, y): a straight distance from the camera in
/// metres, or infinity for sky. The view's own method plays no part.
///
/// # Errors
/// If tiles are missing.
pub fn measure(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    x: u32,
    y: u32,
    claimed_distance_m: f64,
) -> Result<PixelError, Missing> {
    let field = Field { resident, pyramid };
    let ground = Ground::new(view.shading.earth);
    let place = [f64::from(x) + 0.5, f64::from(y) + 0.5];
    let (path, _) = path(&view.camera, ground, place, 0.0);
    let mut gauge = Gauge {
        field,
        ground,
        path,
        focal_px: view.camera.focal_px(),
        exact: Exact::new(field),
        absent: BTreeSet::new(),
    };
    let error = gauge.error(claimed_distance_m);
    error.ok_or_else(|| {
        gauge.exact.wanted.drain_into(&mut gauge.absent);
        Missing(gauge.absent.into_iter().collect())
    })
}

/// One ray and the truth around it.
struct Gauge<'a> {
    field: Field<'a>,
    ground: Ground,
    path: Path,
    focal_px: f64,
    exact: Exact<'a>,
    /// Tiles that were asked for their height.
    absent: BTreeSet<TileKey>,
}

/// A point of the ray at a claimed distance.
#[derive(Debug, Clone, Copy)]
struct Claim {
    distance: f64,
    u: f64,
}

/// In all of these, `None` stands for a tile that is missing.
impl Gauge<'_> {
    fn error(&mut self, claimed: f64) -> Option<PixelError> {
        let truth = self.truth();
        let claim = (claimed > 0.0 && claimed < f64::INFINITY).then(|| self.claim(claimed));
        // Both questions are asked before either gives up, so that all tiles become known.
        let surface = claim.map_or(Some(Some(0.0)), |claim| self.surface(claim));
        let (truth, surface_px) = (truth?, surface?.unwrap_or(ERROR_MAX_PX));
        let true_distance = truth.map(|contact| self.path.distance(contact.u, contact.z));
        let depth_m = true_distance.map(|truth| claimed - truth).filter(|depth| depth.is_finite());
        let right = PixelError { surface_px: 0.0, occlusion_px: 0.0, depth_m, mismatch: false };
        if true_distance == Some(0.0) || claimed.is_nan() || claimed <= 0.0 {
            let [surface_px, occlusion_px] = [ERROR_MAX_PX; 2];
            let wrong = PixelError { surface_px, occlusion_px, depth_m, mismatch: true };
            return Some(if true_distance == Some(claimed) { right } else { wrong });
        }
        if depth_m.is_some_and(|depth| depth.abs() <= PRECISION * claimed) {
            return Some(right);
        }
        let occlusion_px = match true_distance {
            Some(truth) if truth < claimed && surface_px < ERROR_MAX_PX => {
                self.occlusion(claim, surface_px)?
            }
            _ => 0.0,
        };
        let mismatch = match (claim, truth) {
            (Some(claim), Some(contact)) => !self.in_cell(claim, &contact),
            (claim, truth) => claim.is_some() || truth.is_some(),
        };
        Some(PixelError { surface_px, occlusion_px, depth_m, mismatch })
    }

    /// Where the ray truly meets the ground, if it does.
    fn truth(&mut self) -> Option<Option<Contact>> {
        let path = self.path;
        match self.exact.cast(&path, 0.0) {
            Outcome::Hit(contact) => Some(Some(contact)),
            Outcome::Miss => Some(None),
            Outcome::Unfinished => None,
        }
    }

    /// The point of the ray at a distance. Distance grows with the parameter; over round
    /// ground the latter is found by halving, to the last bit.
    fn claim(&self, distance: f64) -> Claim {
        if self.ground.curvature() == 0.0 {
            return Claim { distance, u: distance };
        }
        let (mut near, mut far) = (0.0, self.path.reach_u);
        loop {
            let u = 0.5 * (near + far);
            if u <= near || u >= far {
                return Claim { distance, u };
            }
            let reached = self.path.distance(u, self.path.span_at(u).z(u));
            *(if reached < distance { &mut near } else { &mut far }) = u;
        }
    }

    /// Height between a claim and the surface, pixels, not above the limit; the inner
    /// `None` where there is no ground.
    fn surface(&mut self, claim: Claim) -> Option<Option<f64>> {
        let mut off = None;
        let (mut above, mut below) = (false, false);
        let mut known = true;
        for u in [1.0, 1.0 - PRECISION, 1.0 + PRECISION].map(|share| share * claim.u) {
            let at = self.path.origin + self.path.direction * u;
            match self.field.height_at([at.x, at.y]) {
                Ok(Some(height)) => {
                    let gap = self.path.span_at(u).z(u) - height;
                    above |= gap >= 0.0;
                    below |= gap <= 0.0;
                    off.get_or_insert(gap.abs());
                }
                // Over no ground, a ray is above it.
                Ok(None) => above = true,
                Err(key) => {
                    self.absent.insert(key);
                    known = false;
                }
            }
        }
        let through = above && below;
        let height = off.map(|off| if through { 0.0 } else { off });
        let pixels = |height| f64::min(height * self.focal_px / claim.distance, ERROR_MAX_PX);
        known.then_some(height.map(pixels))
    }

    /// Whether the cell of a contact is one that a claim lies in.
    fn in_cell(&self, claim: Claim, contact: &Contact) -> bool {
        let shares = [1.0 - PRECISION, 1.0, 1.0 + PRECISION];
        shares.into_iter().any(|share| {
            let at = self.path.origin + self.path.direction * (share * claim.u);
            let found = self.field.cell_at([at.x, at.y]);
            found.is_some_and(|(layer, cell, _)| (layer, cell) == (contact.layer, contact.cell))
        })
    }

    /// By how many pixels the ray must be raised to be free before the claim, unless
    /// `explained` is enough; sky if there is no claim.
    fn occlusion(&mut self, claim: Option<Claim>, explained: f64) -> Option<f64> {
        let mut hindered = explained + STEP_PX;
        if self.is_free(claim, hindered)? {
            return Some(0.0);
        }
        let mut free = 2.0 * hindered;
        while free < ERROR_MAX_PX && !self.is_free(claim, free)? {
            hindered = free;
            free *= 2.0;
        }
        if free >= ERROR_MAX_PX {
            free = ERROR_MAX_PX;
            if hindered >= free || !self.is_free(claim, free)? {
                return Some(ERROR_MAX_PX);
            }
        }
        while free - hindered > STEP_PX {
            let middle = 0.5 * (hindered + free);
            *(if self.is_free(claim, middle)? { &mut free } else { &mut hindered }) = middle;
        }
        Some(free)
    }

    /// Whether the ray raised by so many pixels meets nothing clearly before the claim.
    fn is_free(&mut self, claim: Option<Claim>, raised_px: f64) -> Option<bool> {
        let vertical = claim.map_or(DVec3::Z, |claim| self.vertical(claim.u));
        let toward = self.path.direction + vertical * (raised_px / self.focal_px);
        let length = toward.length();
        if length == 0.0 {
            return Some(true);
        }
        let raised = Path::new(self.ground, self.path.origin, toward / length);
        match self.exact.cast(&raised, 0.0) {
            Outcome::Hit(contact) => Some(claim.is_some_and(|claim| {
                let clearly = claim.distance * length * (1.0 - PRECISION);
                raised.distance(contact.u, contact.z) >= clearly
            })),
            Outcome::Miss => Some(true),
            Outcome::Unfinished => None,
        }
    }

    /// The vertical at a place along the ray, in the frame at its start: over round ground
    /// it leans away by the angle between both.
    fn vertical(&self, u: f64) -> DVec3 {
        let along = DVec3::new(self.path.direction.x, self.path.direction.y, 0.0);
        let across = along.length();
        let angle = u * across * self.ground.curvature();
        if angle == 0.0 {
            return DVec3::Z;
        }
        along * (libm::sin(angle) / across) + DVec3::Z * libm::cos(angle)
    }
}

#[cfg(test)]
mod tests;
