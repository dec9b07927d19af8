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
use footprint::{Footprint, steepness};
use glam::DVec3;
use photo::{Rows, Sums};
use ray::{Lens, Ray};
use sheets::Sheets;
use slope::Cells;
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

/// Places of the picture, and how far away the ground is that is seen there.
#[derive(Clone, Copy)]
pub(crate) struct Places<'p> {
    pub at: At<'p>,
    pub far: Far<'p>,
}

/// Places of the picture, x and y, pixels from its top left corner.
#[derive(Clone, Copy)]
pub(crate) enum At<'p> {
    /// One for each x, with the y of the same number.
    Each(&'p [f32], &'p [f32]),
    /// All of the columns at the first y, then all at the second, and so on.
    Net(&'p [f32], &'p [f32]),
}

/// How far away the ground is.
#[derive(Clone, Copy)]
pub(crate) enum Far<'p> {
    /// Metres along the map; infinite for the sky, NaN where a tile is missing. The way of
    /// a ray that is steeper than one in a million counts as if it were that.
    Map(&'p [f32]),
    /// One over the depth, as [`crate::seen::Seen`] has it.
    Inverse(&'p [f32]),
}

impl Far<'_> {
    fn values(&self) -> &[f32] {
        let (Far::Map(values) | Far::Inverse(values)) = self;
        values
    }
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

    /// Shades [`AT_ONCE`] places at most. Every step is done for all of them before the
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
        batch.slopes = [[0.0; AT_ONCE]; 2];
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
        batch.light = [[0.0; AT_ONCE]; 3];
        batch.covered = [0.0; AT_ONCE];
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
                    batch.rows.place::<L>(sheets, n, is_coarser);
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

/// Places that are shaded at once; a multiple of all numbers of lanes.
const AT_ONCE: usize = 128;
/// Vectors of them, at most.
const VECTORS: usize = AT_ONCE;

/// Some places on their way from step to step. Masks are bits, one word a vector.
struct Batch {
    count: usize,
    x: [f32; AT_ONCE],
    y: [f32; AT_ONCE],
    far: [f32; AT_ONCE],
    /// It is one over the depth.
    inverse: bool,
    ground: [u32; VECTORS],
    sky: [u32; VECTORS],
    unsure: [u32; VECTORS],
    view: [[f32; AT_ONCE]; 3],
    along: [[f32; AT_ONCE]; 2],
    over: [f32; AT_ONCE],
    distance: [f32; AT_ONCE],
    falls: [f32; AT_ONCE],
    size: [f32; AT_ONCE],
    slopes: [[f32; AT_ONCE]; 2],
    steepness: [f32; AT_ONCE],
    light: [[f32; AT_ONCE]; 3],
    covered: [f32; AT_ONCE],
    cells: Cells,
    rows: Rows,
}

impl Batch {
    fn new() -> Self {
        let none = [0.0; AT_ONCE];
        Batch {
            count: 0,
            x: none,
            y: none,
            far: none,
            inverse: false,
            ground: [0; VECTORS],
            sky: [0; VECTORS],
            unsure: [0; VECTORS],
            view: [none; 3],
            along: [none; 2],
            over: none,
            distance: none,
            falls: none,
            size: none,
            slopes: [none; 2],
            steepness: none,
            light: [none; 3],
            covered: none,
            cells: Cells::new(),
            rows: Rows::new(),
        }
    }

    /// Takes the places from `at` on, as many as fit. Those that fill the last vector up
    /// need nothing.
    #[inline(always)]
    fn fill(&mut self, places: Places, at: usize) {
        let far = places.far.values();
        self.count = AT_ONCE.min(far.len() - at);
        self.inverse = matches!(places.far, Far::Inverse(_));
        let end = at + self.count;
        self.far[..self.count].copy_from_slice(&far[at..end]);
        let last = (self.count + MOST).min(AT_ONCE);
        self.far[self.count..last].fill(f32::NAN);
        match places.at {
            At::Each(x, y) => {
                self.x[..self.count].copy_from_slice(&x[at..end]);
                self.y[..self.count].copy_from_slice(&y[at..end]);
            }
            At::Net(x, y) => {
                let mut filled = 0;
                while filled < self.count {
                    let (row, column) = ((at + filled) / x.len(), (at + filled) % x.len());
                    let run = (x.len() - column).min(self.count - filled);
                    self.x[filled..][..run].copy_from_slice(&x[column..][..run]);
                    self.y[filled..][..run].fill(y[row]);
                    filled += run;
                }
            }
        }
    }

    /// The places of vector `n` of which it is not known what they show.
    #[inline(always)]
    fn unknown<L: Lanes>(&self, n: usize) -> u32 {
        let filled = self.count - n * L::N;
        let all = (1 << filled.min(L::N)) - 1;
        all & !(self.sky[n] | (self.ground[n] & !self.unsure[n]))
    }

    #[inline(always)]
    fn light<L: Lanes>(&self, at: usize) -> [L::F; 3] {
        let [red, green, blue] = &self.light;
        [L::F::load(&red[at..]), L::F::load(&green[at..]), L::F::load(&blue[at..])]
    }

    #[inline(always)]
    fn view<L: Lanes>(&self, at: usize) -> [L::F; 3] {
        let [x, y, z] = &self.view;
        [L::F::load(&x[at..]), L::F::load(&y[at..]), L::F::load(&z[at..])]
    }

    #[inline(always)]
    fn along<L: Lanes>(&self, at: usize) -> [L::F; 2] {
        [L::F::load(&self.along[0][at..]), L::F::load(&self.along[1][at..])]
    }

    #[inline(always)]
    fn slopes<L: Lanes>(&self, at: usize) -> [L::F; 2] {
        [L::F::load(&self.slopes[0][at..]), L::F::load(&self.slopes[1][at..])]
    }
}

/// Where the light goes.
enum Canvas<'p> {
    /// Red, green and blue.
    Light([&'p mut [f32]; 3]),
    /// Three bytes a place, and the numbers of the places for which a tile is missing.
    Bytes(&'p mut [u8], &'p mut Vec<usize>),
}

impl Canvas<'_> {
    /// Takes the light of a batch, whose first place has the number `at`.
    #[inline(always)]
    fn take<L: Lanes>(&mut self, batch: &Batch, at: usize) {
        let count = batch.count;
        match self {
            Canvas::Light(light) => {
                for c in 0..3 {
                    light[c][at..at + count].copy_from_slice(&batch.light[c][..count]);
                }
            }
            Canvas::Bytes(pixels, unknown) => {
                let pixels = &mut pixels[3 * at..3 * (at + count)];
                for (n, pixels) in pixels.chunks_mut(3 * L::N).enumerate() {
                    srgb::store::<L>(batch.light::<L>(n * L::N), pixels);
                    let mut left = batch.unknown::<L>(n);
                    while left != 0 {
                        unknown.push(at + n * L::N + left.trailing_zeros() as usize);
                        left &= left - 1;
                    }
                }
            }
        }
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
    fn light<L: Lanes>(&self, slopes: [L::F; 2], steepness: L::F) -> L::F {
        let [x, y, z] = self.direction;
        let facing = L::F::splat(z) - slopes[0] * L::F::splat(x) - slopes[1] * L::F::splat(y);
        let facing = facing.max(L::F::splat(0.0)).div(steepness);
        let light = L::F::splat(self.ambient) + L::F::splat(self.direct) * facing;
        light.min(L::F::splat(self.most))
    }
}
