//! Colour of what a ray found: photo or tint, sun, haze, sky. Linear light throughout.
//!
//! A method says how far along the map the ray through a place of the picture meets the
//! ground; all else follows from that here, for as many places at once as the processor
//! has lanes. A place's colour depends on the place and its distance alone.

mod air;
mod batch;
mod exp;
mod footprint;
mod level;
mod photo;
mod ray;
mod sheets;
mod slope;
mod square;
mod sun;
#[cfg(test)]
mod tests;
mod tint;

use crate::field::{Field, Wanted};
use crate::lanes::{self, Floats, Kernel, Lanes, Mask, Width};
use crate::{Pyramid, View};
pub(crate) use batch::{At, Far, Places};

use air::Air;
use batch::{Batch, Canvas, Each};
use footprint::{Footprint, steepness};
use glam::DVec3;
use photo::Sums;
use ray::{Lens, Ray};
use sheets::Sheets;
use std::collections::BTreeSet;
use sun::Sunlight;
use terrafarm_common::camera::Camera;
use terrafarm_common::region::Region;
use terrafarm_common::shading::{LinearRgb, Shading};
use terrafarm_terrain::layout::{LayerKind, TileKey};
use terrafarm_terrain::resident::Resident;
use terrafarm_terrain::tile::{HeightTile, PhotoTile};

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
    let middle = |pixel: u32| pixel as f32 + 0.5;
    let x: Vec<f32> = (region.x..region.x + region.width).map(middle).collect();
    let y: Vec<f32> = (region.y..region.y + region.height).map(middle).collect();
    let area = x.len() * y.len();
    let far = Far::Map(&distances_m[..area]);
    shader.paint(Places { at: At::Net(&x, &y), far }, &mut pixels[..3 * area], &mut Vec::new());
    let mut missing = BTreeSet::new();
    shader.wanted.drain_into(&mut missing);
    missing.into_iter().collect()
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

    /// Shades as if pixels were so many times as wide.
    pub(crate) fn widen(&mut self, times: f32) {
        self.sample_tangent *= times;
    }

    /// The light of places, red, green and blue apart: NaN where a tile is missing. Some
    /// hundred places at a time make good use of it; all slices have one length.
    pub(crate) fn shade(&mut self, places: Places, light: [&mut [f32]; 3]) {
        let width = self.width;
        lanes::run(Run { shader: self, places, canvas: Canvas::Light(light) }, width);
    }

    /// The bytes of places, three each: black where a tile is missing. The numbers of those
    /// places are added to `unknown`. As [`Shader::shade`], then [`srgb::encode_all`].
    pub(crate) fn paint(&mut self, places: Places, pixels: &mut [u8], unknown: &mut Vec<usize>) {
        let width = self.width;
        let canvas = Canvas::Bytes(pixels, unknown);
        lanes::run(Run { shader: self, places, canvas }, width);
    }

    /// Shades the places of a batch. Every step is done for all of them before the
    /// next is: within a step nothing waits for anything, while the steps of one place are
    /// a long chain.
    #[inline(always)]
    fn places<L: Lanes>(&mut self, batch: &mut Batch) {
        let vectors = batch.count.div_ceil(L::N);
        for n in 0..vectors {
            self.rays::<L>(batch, n);
        }
        if batch.ground[..vectors].iter().any(|&ground| ground != 0) {
            self.slopes::<L>(batch, vectors);
            self.photos::<L>(batch, vectors);
        }
        for n in 0..vectors {
            self.colors::<L>(batch, n);
        }
    }

    /// Where rays go and end.
    #[inline(always)]
    fn rays<L: Lanes>(&self, batch: &mut Batch, n: usize) {
        let at = n * L::N;
        let (x, y) = (L::F::load(&batch.x[at..]), L::F::load(&batch.y[at..]));
        let far = L::F::load(&batch.far[at..]);
        let ray = Ray::<L>::new(&self.lens, x, y);
        let depth = if batch.inverse { ray.depth_of_inverse(far) } else { ray.depth_of_map(far) };
        let ground = depth.le(L::F::splat(f32::MAX));
        batch.ground[n] = ground.bits();
        batch.sky[n] = L::F::splat(f32::MAX).lt(depth).bits();
        batch.unsure[n] = 0;
        for part in 0..3 {
            ray.view[part].store(&mut batch.view[part][at..]);
        }
        if ground.any() {
            let end = ray.end(&self.lens, L::F::select(ground, depth, L::F::splat(1.0)));
            end.along[0].store(&mut batch.along[0][at..]);
            end.along[1].store(&mut batch.along[1][at..]);
            end.over.store(&mut batch.over[at..]);
            end.distance.store(&mut batch.distance[at..]);
            end.falls.store(&mut batch.falls[at..]);
            let size = end.depth * L::F::splat(self.sample_tangent);
            size.store(&mut batch.size[at..]);
        }
    }

    /// Slopes of the ground: each place's by the uppermost layer that is there.
    #[inline(always)]
    fn slopes<L: Lanes>(&mut self, batch: &mut Batch, vectors: usize) {
        batch.slopes = [Each::new(0.0); 2];
        let mut left = batch.ground;
        for (number, sheets) in self.heights.iter_mut().enumerate().rev() {
            for n in 0..vectors {
                let at = n * L::N;
                if left[n] == 0 {
                    batch.cells.leave(n);
                    continue;
                }
                let size = L::F::load(&batch.size[at..]);
                let (along, lanes) = (batch.along::<L>(at), L::M::from_bits(left[n]));
                batch.cells.lay::<L>(sheets, n, along, size, lanes, number == 0);
                left[n] &= !batch.cells.lanes[n];
            }
            for is_coarser in [false, true] {
                for n in 0..vectors {
                    batch.cells.place::<L>(sheets, n, is_coarser);
                }
                for n in 0..vectors {
                    let (slopes, wanted) = (&mut batch.slopes, &mut self.wanted);
                    batch.cells.read::<L>(
                        sheets,
                        n,
                        is_coarser,
                        slopes,
                        &mut batch.unsure[n],
                        wanted,
                    );
                }
            }
        }
    }

    /// What the photos show, from the topmost down.
    #[inline(always)]
    fn photos<L: Lanes>(&mut self, batch: &mut Batch, vectors: usize) {
        for n in 0..vectors {
            let at = n * L::N;
            steepness::<L>(batch.slopes::<L>(at)).store(&mut batch.steepness[at..]);
        }
        batch.light = [Each::new(0.0); 3];
        batch.covered = Each::new(0.0);
        let sides = [self.lens.right, self.lens.up];
        for sheets in self.photos.iter_mut().rev() {
            for n in 0..vectors {
                let at = n * L::N;
                if batch.ground[n] == 0 {
                    batch.rows.leave(n);
                    continue;
                }
                let size = L::F::load(&batch.size[at..]);
                let [x, y, z] = batch.view::<L>(at);
                let arriving = [x, y, z + L::F::load(&batch.falls[at..])];
                let (slopes, steepness) =
                    (batch.slopes::<L>(at), L::F::load(&batch.steepness[at..]));
                let footprint = Footprint::<L>::new(sides, size, arriving, slopes, steepness);
                let (along, ground) = (batch.along::<L>(at), L::M::from_bits(batch.ground[n]));
                let covered = L::F::load(&batch.covered[at..]);
                batch.rows.lay::<L>(sheets, n, along, &footprint, ground, covered);
            }
            for is_coarser in [false, true] {
                for n in 0..vectors {
                    batch.rows.place::<L>(sheets, n, is_coarser, &mut self.wanted);
                }
                let mut sums = Sums {
                    light: &mut batch.light,
                    coverage: &mut batch.covered,
                    unsure: &mut batch.unsure,
                };
                for n in 0..vectors {
                    let wanted = &mut self.wanted;
                    batch.rows.read::<L>(sheets, n, is_coarser, &mut sums, wanted);
                }
            }
        }
    }

    /// The light that comes in.
    #[inline(always)]
    fn colors<L: Lanes>(&self, batch: &mut Batch, n: usize) {
        let at = n * L::N;
        let ray = batch.view::<L>(at);
        let none = L::F::splat(f32::NAN);
        let mut color = [none; 3];
        let ground = L::M::from_bits(batch.ground[n]);
        if ground.any() {
            let over = L::F::load(&batch.over[at..]);
            let lit = self.ground::<L>(batch, at, over);
            let distance = L::F::load(&batch.distance[at..]);
            let seen = self.air.veil::<L>(lit, ray, distance, over);
            let sure = ground & !L::M::from_bits(batch.unsure[n]);
            for c in 0..3 {
                color[c] = L::F::select(sure, seen[c], none);
            }
        }
        let sky = L::M::from_bits(batch.sky[n]);
        if sky.any() {
            let seen = self.air.sky::<L>(ray);
            for c in 0..3 {
                color[c] = L::F::select(sky, seen[c], color[c]);
            }
        }
        for c in 0..3 {
            color[c].store(&mut batch.light[c][at..]);
        }
    }

    /// Photo, and tint where there is none, in sunlight.
    #[inline(always)]
    fn ground<L: Lanes>(&self, batch: &Batch, at: usize, over: L::F) -> [L::F; 3] {
        let mut color = photo::light::<L>(batch.light::<L>(at));
        let slopes = batch.slopes::<L>(at);
        let covered = L::F::load(&batch.covered[at..]);
        let open = covered.lt(L::F::splat(COVERED));
        if open.any() {
            let bare = match self.bare_ground {
                Some(color) => {
                    [L::F::splat(color[0]), L::F::splat(color[1]), L::F::splat(color[2])]
                }
                None => tint::tint::<L>(L::F::splat(self.lens.eye_z) + over, slopes),
            };
            let uncovered = L::F::splat(1.0) - covered;
            let uncovered = L::F::select(open, uncovered, L::F::splat(0.0));
            for c in 0..3 {
                color[c] = color[c] + uncovered * bare[c];
            }
        }
        if let Some(sun) = &self.sun {
            let light = sun.light::<L>(slopes, L::F::load(&batch.steepness[at..]));
            for channel in &mut color {
                *channel = *channel * light;
            }
        }
        color
    }
}

/// A run of [`Shader::shade`] or [`Shader::paint`].
struct Run<'s, 'a, 'p> {
    shader: &'s mut Shader<'a>,
    places: Places<'p>,
    canvas: Canvas<'p>,
}

impl Kernel for Run<'_, '_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Lanes>(self) {
        let Run { shader, places, mut canvas } = self;
        let mut batch = Batch::new();
        let mut at = 0;
        while at < places.far.values().len() {
            batch.fill(places, at);
            shader.places::<L>(&mut batch);
            canvas.take::<L>(&batch, at);
            at += batch.count;
        }
    }
}
