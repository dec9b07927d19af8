//! Colour of what a ray found: photo or tint, sun, haze, sky. Linear light throughout.
//!
//! Sunlight is shared out so that flat ground keeps the brightness that the photo gives
//! it: with n the normal and l the direction of the sun,
//!
//! `light = 1 + strength (min(ambient + (1 - ambient) max(0, n.l) / max(l.z, 0.05), 2) - 1)`.
//!
//! On flat ground n.l = l.z and the light is 1, until the sun is within 3 degrees of the
//! horizon; from there it fades to the ambient share, which is all there is at night.

mod air;
mod footprint;
mod photo;
mod slope;
mod stack;
mod tint;

use crate::field::{Contact, Field, Wanted};
use crate::path::Ground;
use air::Air;
use footprint::Footprint;
use glam::DVec3;
use photo::Photos;
use stack::Stack;
use terrafarm_common::camera::Camera;
use terrafarm_common::shading::{LinearRgb, Shading, Sun};
use terrafarm_terrain::resident::Resident;
use terrafarm_terrain::tile::HeightTile;

/// Sine of the sun's elevation below which flat ground grows dark: 2.9 degrees.
const LOW_SUN_SINE: f64 = 0.05;
/// The most light that a slope facing a low sun gets, flat ground being 1.
const MAX_LIGHT: f64 = 2.0;

/// Shades contacts of one view.
pub(crate) struct Shader<'a> {
    camera: &'a Camera,
    shading: &'a Shading,
    air: Air<'a>,
    photos: Photos<'a>,
    /// By number of the layer.
    heights: Vec<Stack<'a, HeightTile>>,
    /// 1 / effective radius of the Earth, per metre.
    curvature: f64,
    /// Width of a sample in the picture, as a tangent.
    sample_tangent: f64,
    /// Tiles that were needed but not loaded.
    pub wanted: Wanted,
}

impl<'a> Shader<'a> {
    pub(crate) fn new(
        field: Field<'a>,
        camera: &'a Camera,
        shading: &'a Shading,
        samples_per_side: u32,
    ) -> Self {
        Shader {
            camera,
            shading,
            air: Air::new(shading, field.pyramid.lowest(), camera.position.z),
            photos: Photos::new(field),
            heights: (0..field.index().layers.len())
                .map(|number| Stack::new(field, number, Resident::height))
                .collect(),
            curvature: Ground::new(shading.earth).curvature(),
            sample_tangent: 1.0 / (camera.focal_px() * f64::from(samples_per_side)),
            wanted: Wanted::default(),
        }
    }

    /// Colour in a direction in which there is no ground.
    pub(crate) fn sky(&self, view: DVec3) -> LinearRgb {
        self.air.sky(view)
    }

    /// Colour of a contact seen along the unit vector `view`; `None` if a tile is
    /// missing.
    pub(crate) fn ground(
        &mut self,
        contact: &Contact,
        view: DVec3,
        distance_m: f64,
    ) -> Option<LinearRgb> {
        let position = self.camera.position;
        let place = [position.x + contact.u * view.x, position.y + contact.u * view.y];
        let wanted_before = self.wanted.count;
        let depth = distance_m * view.dot(self.camera.forward);
        let size_m = depth * self.sample_tangent;
        let heights = &mut self.heights[contact.layer];
        let slopes = slope::slopes(heights, contact, place, size_m, &mut self.wanted);
        let sides = [self.camera.right * size_m, self.camera.up * size_m];
        // Over a round Earth the ray comes in flatter than it set out.
        let turn = (view.x * view.x + view.y * view.y) * contact.u * self.curvature;
        let arriving = DVec3::new(view.x, view.y, view.z + turn);
        let footprint = Footprint::new(sides, arriving, slopes);
        let photo = self.photos.sample(place, &footprint, &mut self.wanted);
        if self.wanted.count > wanted_before {
            return None;
        }
        let bare = match self.shading.bare_ground {
            Some(color) => color,
            None => tint::tint(contact.z, slopes),
        };
        let light = self.shading.sun.map_or(1.0, |sun| light(&sun, slopes));
        let uncovered = 1.0 - photo[3];
        let lit = |c: usize| (photo[c] + uncovered * bare[c]) * light;
        let color = [lit(0), lit(1), lit(2)];
        Some(self.air.veil(color, view, distance_m, contact.z))
    }
}

/// Light on ground of the given slopes; see the module's page.
fn light(sun: &Sun, slopes: [f64; 2]) -> f32 {
    let ambient = f64::from(sun.ambient);
    let direction = sun.direction;
    let direct = if direction.z > 0.0 {
        let normal = DVec3::new(-slopes[0], -slopes[1], 1.0);
        normal.dot(direction).max(0.0) / (normal.length() * direction.z.max(LOW_SUN_SINE))
    } else {
        0.0
    };
    let share = (ambient + (1.0 - ambient) * direct).min(MAX_LIGHT);
    (1.0 + f64::from(sun.strength) * (share - 1.0)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flat_ground_keeps_the_brightness_of_the_photo() {
        for elevation in [5.0, 30.0, 90.0] {
            let sun = Sun::at(130.0, elevation, 0.25, 0.8);
            assert!((light(&sun, [0.0, 0.0]) - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn light_fades_to_the_ambient_share_when_the_sun_sets() {
        let at = |elevation| light(&Sun::at(90.0, elevation, 0.2, 1.0), [0.0, 0.0]);
        assert_eq!(at(-1.0), 0.2);
        assert!((at(0.01) - 0.2).abs() < 0.01);
        let sun = Sun::at(90.0, 10.0, 0.2, 1.0);
        assert!(light(&sun, [-0.5, 0.0]) > 1.0 && light(&sun, [0.5, 0.0]) < 0.5);
    }
}
