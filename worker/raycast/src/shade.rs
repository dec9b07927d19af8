//! Colour of what a ray found: photo or tint, sun, haze, sky. Linear light throughout.
//!
//! A method says how far along the map the ray through a place of the picture meets the
//! ground; all else follows from that here, for as many places at once as the processor
//! has lanes. A place's colour depends on the place and its distance alone.
//!
//! Sunlight is shared out so that flat ground keeps the brightness that the photo gives
//! it: with n the normal and l the direction of the sun,
//!
//! `light = 1 + strength (min(ambient + (1 - ambient) max(0, n.l) / max(l.z, 0.05), 2) - 1)`.
//!
//! On flat ground n.l = l.z and the light is 1, until the sun is within 3 degrees of the
//! horizon; from there it fades to the ambient share, which is all there is at night.

mod air;
mod exp;
mod footprint;
mod level;
mod photo;
mod ray;
mod sheets;
mod slope;
#[cfg(test)]
mod tests;
mod tint;

use crate::field::{Field, Wanted};
use crate::lanes::{self, Floats, Kernel, Lanes, MOST, Mask, Width};
use crate::{Pyramid, View, srgb};
use air::Air;
use footprint::Footprint;
use glam::DVec3;
use ray::{End, Lens, Ray};
use sheets::Sheets;
use std::collections::BTreeSet;
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;
use terrafarm_common::shading::{LinearRgb, Shading, Sun};
use terrafarm_terrain::layout::{LayerKind, TileKey};
use terrafarm_terrain::resident::Resident;
use terrafarm_terrain::tile::{HeightTile, PhotoTile};

/// Sine of the sun's elevation below which flat ground grows dark: 2.9 degrees.
const LOW_SUN_SINE: f64 = 0.05;
/// The most light that a slope facing a low sun gets, flat ground being 1.
const MAX_LIGHT: f64 = 2.0;
/// Coverage from which on there is no bare ground to be seen.
const COVERED: f32 = 1.0 - 1e-6;

/// Map distance of a contact at parameter `u` of a ray along the unit vector `view`; see
/// [`Shader::shade`].
pub(crate) fn map_distance(view: DVec3, u: f64) -> f32 {
    (u * view.truncate().length().max(ray::STEEPEST)) as f32
}

/// Shades what the rays of one view found.
pub(crate) struct Shader<'a> {
    lens: Lens,
    air: Air,
    sun: Option<Sunlight>,
    bare_ground: Option<LinearRgb>,
    /// Width of a sample in the picture, as a tangent.
    sample_tangent: f32,
    /// Both from the lowest to the topmost.
    heights: Vec<Sheets<'a, HeightTile>>,
    photos: Vec<Sheets<'a, PhotoTile>>,
    width: Width,
    /// Tiles that were needed but not loaded.
    pub wanted: Wanted,
}

/// Shades the pixels of a region, one sample each, whose rays meet the ground at known
/// distances along the map, metres: rows from the top, infinite for the sky. Three bytes
/// of sRGB a pixel go to `pixels`. Returns the tiles that were missing, sorted; the pixels
/// that need them are black, as are those whose distance is NaN.
///
/// # Panics
/// If there are fewer distances than pixels, or fewer bytes than three a pixel.
pub fn shade(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    region: Region,
    distances_m: &[f32],
    pixels: &mut [u8],
) -> Vec<TileKey> {
    let mut shader = Shader::new(Field { resident, pyramid }, &view.camera, &view.shading, 1);
    let columns = region.width as usize;
    let x: Vec<f32> = (0..region.width).map(|x| (region.x + x) as f32 + 0.5).collect();
    let mut light = [0, 1, 2].map(|_| vec![0.0; columns]);
    for row in 0..region.height as usize {
        let y = vec![(region.y as usize + row) as f32 + 0.5; columns];
        let places = Places { x: &x, y: &y, s: &distances_m[row * columns..][..columns] };
        let [red, green, blue] = &mut light;
        shader.shade(places, [red, green, blue]);
        let pixels = &mut pixels[3 * row * columns..][..3 * columns];
        srgb::encode_all(light.each_ref().map(Vec::as_slice), pixels, shader.width);
    }
    let mut missing = BTreeSet::new();
    shader.wanted.drain_into(&mut missing);
    missing.into_iter().collect()
}

/// Places of the picture: pixels from its top left corner, and the map distance at which
/// their rays meet the ground.
#[derive(Clone, Copy)]
pub(crate) struct Places<'p> {
    pub x: &'p [f32],
    pub y: &'p [f32],
    /// Metres along the map; infinite for the sky, NaN where a tile is missing. The way of
    /// a ray that is steeper than one in a million counts as if it were that.
    pub s: &'p [f32],
}

/// Sunlight on ground: `min(ambient + direct max(0, n.l), most)`.
#[derive(Clone, Copy)]
struct Sunlight {
    direction: [f32; 3],
    ambient: f32,
    direct: f32,
    most: f32,
}

impl<'a> Shader<'a> {
    pub(crate) fn new(
        field: Field<'a>,
        camera: &Camera,
        shading: &Shading,
        samples_per_side: u32,
    ) -> Self {
        let eye = camera.position;
        let resident = field.resident;
        let index = field.index();
        let heights = index.layers_of(LayerKind::Height);
        let photos = index.layers_of(LayerKind::Photo);
        Shader {
            lens: Lens::new(camera, shading.earth),
            air: Air::new(shading, field.pyramid.lowest(), eye.z),
            sun: shading.sun.map(|sun| Sunlight::new(&sun)),
            bare_ground: shading.bare_ground,
            sample_tangent: (1.0 / (camera.focal_px() * f64::from(samples_per_side))) as f32,
            heights: heights
                .map(|(number, _)| Sheets::new(resident, number, eye, Resident::height))
                .collect(),
            photos: photos
                .map(|(number, _)| Sheets::new(resident, number, eye, Resident::photo))
                .collect(),
            width: lanes::widest(),
            wanted: Wanted::default(),
        }
    }

    /// The light of places, red, green and blue apart: NaN where a tile is missing. Some
    /// hundred places at a time make good use of it; all slices have one length.
    pub(crate) fn shade(&mut self, places: Places, light: [&mut [f32]; 3]) {
        let width = self.width;
        lanes::run(Run { shader: self, places, light }, width);
    }

    #[inline(always)]
    fn places<L: Lanes>(&mut self, x: L::F, y: L::F, s: L::F) -> [L::F; 3] {
        let ray = Ray::<L>::new(&self.lens, x, y);
        let ground = s.le(L::F::splat(f32::MAX));
        let sky = L::F::splat(f32::MAX).lt(s);
        let none = L::F::splat(f32::NAN);
        let mut color = [none; 3];
        if ground.any() {
            let end = ray.end(&self.lens, L::F::select(ground, s, L::F::splat(1.0)));
            let (lit, unsure) = self.ground::<L>(&end, ground);
            let seen = self.air.veil(lit, &ray, end.distance, end.over);
            for c in 0..3 {
                color[c] = L::F::select(ground & !unsure, seen[c], none);
            }
        }
        if sky.any() {
            let seen = self.air.sky(&ray);
            for c in 0..3 {
                color[c] = L::F::select(sky, seen[c], color[c]);
            }
        }
        color
    }

    /// Light from the ground, and where a tile is missing.
    #[inline(always)]
    fn ground<L: Lanes>(&mut self, end: &End<L>, lanes: L::M) -> ([L::F; 3], L::M) {
        let size_m = end.depth * L::F::splat(self.sample_tangent);
        let wanted = &mut self.wanted;
        let slopes = slope::slopes::<L>(&mut self.heights, end.along, size_m, lanes, wanted);
        let mut unsure = slopes.unsure;
        let slopes = slopes.slopes;
        let mut color = [L::F::splat(0.0); 3];
        let mut covered = L::F::splat(0.0);
        if !self.photos.is_empty() {
            let sides = [self.lens.right, self.lens.up];
            let footprint = Footprint::<L>::new(sides, size_m, end.view, slopes);
            let photo = photo::sample::<L>(&mut self.photos, end.along, &footprint, lanes, wanted);
            (color, covered) = (photo.light, photo.coverage);
            unsure = unsure | photo.unsure;
        }
        let open = lanes & covered.lt(L::F::splat(COVERED));
        if open.any() {
            let bare = match self.bare_ground {
                Some(color) => [
                    L::F::splat(color[0]),
                    L::F::splat(color[1]),
                    L::F::splat(color[2]),
                ],
                None => tint::tint::<L>(L::F::splat(self.lens.eye_z) + end.over, slopes),
            };
            let uncovered = (L::F::splat(1.0) - covered).max(L::F::splat(0.0));
            for c in 0..3 {
                color[c] = color[c] + L::F::select(open, uncovered * bare[c], L::F::splat(0.0));
            }
        }
        if let Some(sun) = &self.sun {
            let light = sun.light::<L>(slopes);
            for channel in &mut color {
                *channel = *channel * light;
            }
        }
        (color, unsure)
    }
}

/// A run of [`Shader::shade`].
struct Run<'s, 'a, 'p> {
    shader: &'s mut Shader<'a>,
    places: Places<'p>,
    light: [&'p mut [f32]; 3],
}

impl Kernel for Run<'_, '_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let Run { shader, places: Places { x, y, s }, light } = self;
        let mut at = 0;
        while at < s.len() {
            let count = L::N.min(s.len() - at);
            let whole = count == L::N;
            // At the end, with places beside it that need nothing.
            let mut part = [[0.0f32; MOST], [0.0; MOST], [f32::NAN; MOST]];
            if !whole {
                for (part, all) in part.iter_mut().zip([x, y, s]) {
                    part[..count].copy_from_slice(&all[at..at + count]);
                }
            }
            let [x, y, s] = if whole {
                [&x[at..], &y[at..], &s[at..]]
            } else {
                [&part[0][..], &part[1][..], &part[2][..]]
            };
            let color = shader.places::<L>(L::F::load(x), L::F::load(y), L::F::load(s));
            for c in 0..3 {
                if whole {
                    color[c].store(&mut light[c][at..]);
                } else {
                    color[c].store(&mut part[0]);
                    light[c][at..at + count].copy_from_slice(&part[0][..count]);
                }
            }
            at += count;
        }
    }
}

impl Sunlight {
    fn new(sun: &Sun) -> Self {
        let (ambient, strength) = (f64::from(sun.ambient), f64::from(sun.strength));
        let z = sun.direction.z;
        let direct = if z > 0.0 { (1.0 - ambient) / z.max(LOW_SUN_SINE) } else { 0.0 };
        let of = |share: f64| (1.0 + strength * (share - 1.0)) as f32;
        Sunlight {
            direction: sun.direction.as_vec3().to_array(),
            ambient: of(ambient),
            direct: (strength * direct) as f32,
            most: of(MAX_LIGHT),
        }
    }

    /// Light on ground of the given slopes; see the module's page.
    #[inline(always)]
    fn light<L: Lanes>(&self, slopes: [L::F; 2]) -> L::F {
        let [x, y, z] = self.direction;
        let steep = slopes[0] * slopes[0] + slopes[1] * slopes[1] + L::F::splat(1.0);
        let facing =
            L::F::splat(z) - slopes[0] * L::F::splat(x) - slopes[1] * L::F::splat(y);
        let facing = facing.max(L::F::splat(0.0)).div(steep.sqrt());
        let light = L::F::splat(self.ambient) + L::F::splat(self.direct) * facing;
        light.min(L::F::splat(self.most))
    }
}
