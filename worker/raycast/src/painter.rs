//! The methods that cast ray after ray, and the pixels that these make.

use crate::View;
use crate::beam::{Beams, WIDEST_PX};
use crate::exact::{Exact, Many};
use crate::field::{Field, Outcome};
use crate::lanes;
use crate::path::{Ground, Path};
use crate::progress::{Progress, Stats};
use crate::reference::Reference;
use crate::shade::{At, Far, Places, Shader, map_distance};
use std::collections::BTreeSet;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_terrain::layout::TileKey;

/// Share by which a depth is shortened where it becomes a parameter, against rounding.
pub(crate) const ROUNDING: f64 = 1e-9;

/// The parts of a region in squares of the frame.
pub(crate) fn squares(region: Region) -> impl Iterator<Item = Region> {
    let cuts = |start: u32, length: u32| {
        let end = start.saturating_add(length);
        (start / WIDEST_PX..end.div_ceil(WIDEST_PX)).map(move |block| {
            let low = (block * WIDEST_PX).max(start);
            (low, ((block + 1) * WIDEST_PX).min(end) - low)
        })
    };
    cuts(region.y, region.height).flat_map(move |(y, height)| {
        cuts(region.x, region.width).map(move |(x, width)| Region { x, y, width, height })
    })
}

/// One of the methods that cast one ray after another.
pub(crate) enum Caster<'a> {
    Exact(Exact<'a>),
    Reference(Reference<'a>),
}

impl<'a> Caster<'a> {
    pub(crate) fn new(field: Field<'a>, method: Method) -> Self {
        match method {
            Method::Reference => Caster::Reference(Reference::new(field)),
            _ => Caster::Exact(Exact::new(field)),
        }
    }

    /// Finds where a ray meets the surface. It is known not to before `free_u`.
    pub(crate) fn cast(&mut self, path: &Path, free_u: f64) -> Outcome {
        match self {
            Caster::Exact(caster) => caster.cast(path, free_u),
            Caster::Reference(caster) => caster.cast(path),
        }
    }

    /// Steps taken; the tiles that were missing go into the set.
    pub(crate) fn finish(self, missing: &mut BTreeSet<TileKey>) -> u64 {
        let (mut wanted, steps) = match self {
            Caster::Exact(caster) => (caster.wanted, caster.steps),
            Caster::Reference(caster) => (caster.wanted, caster.steps),
        };
        wanted.drain_into(missing);
        steps
    }
}

/// Casts and shades the samples of pixels.
pub(crate) struct Painter<'a> {
    view: &'a View,
    many: Many<'a>,
    beams: Beams<'a>,
    /// The pixels to which the rays belong, each with all of its samples.
    pixels: Vec<[u32; 2]>,
    /// Places of the samples, pixels, and the map distances of what is seen there.
    x: Vec<f32>,
    y: Vec<f32>,
    s: Vec<f32>,
    light: [Vec<f32>; 3],
    shader: Shader<'a>,
    samples: u32,
    rays: u64,
    hits: u64,
}

impl<'a> Painter<'a> {
    pub(crate) fn new(field: Field<'a>, view: &'a View) -> Self {
        let samples = view.quality.samples_per_side.clamp(1, Quality::MAX_SAMPLES_PER_SIDE);
        let ground = Ground::new(view.shading.earth);
        let method = view.quality.method;
        Painter {
            view,
            many: Many::new(field, &view.camera, ground, method, lanes::widest()),
            beams: Beams::new(field, &view.camera, ground),
            pixels: Vec::new(),
            x: Vec::new(),
            y: Vec::new(),
            s: Vec::new(),
            light: Default::default(),
            shader: Shader::new(field, &view.camera, &view.shading, samples),
            samples,
            rays: 0,
            hits: 0,
        }
    }

    /// Paints the pixels of a region that are not done.
    pub(crate) fn region(&mut self, region: Region, progress: &mut Progress) {
        for square in squares(region) {
            let mut todo = Vec::new();
            self.beams.narrow(square, &mut |part, free| {
                let left = part.pixels().filter(|&[x, y]| !progress.has(x, y));
                todo.extend(left.map(|pixel| (pixel, free)));
            });
            for (pixel, free) in todo {
                if self.many.room() < (self.samples * self.samples) as usize {
                    self.flush(progress);
                }
                self.add(pixel, free);
            }
            self.flush(progress);
        }
    }

    fn add(&mut self, [x, y]: [u32; 2], free: f64) {
        self.pixels.push([x, y]);
        for row in 0..self.samples {
            for column in 0..self.samples {
                let place = self.place(x, y, column, row);
                self.x.push(place[0] as f32);
                self.y.push(place[1] as f32);
                self.many.push(place, free);
            }
        }
    }

    /// Casts all rays, and paints the pixels for which no tile is missing with the mean of
    /// their samples. All samples are tried in any case, so that all missing tiles become
    /// known.
    fn flush(&mut self, progress: &mut Progress) {
        self.many.cast();
        self.rays += self.many.len() as u64;
        for ray in 0..self.many.len() {
            let s = match self.many.is_hit(ray) {
                Some(true) => {
                    self.hits += 1;
                    map_distance(self.many.direction(ray), self.many.parameter(ray))
                }
                Some(false) => f32::INFINITY,
                None => f32::NAN,
            };
            self.s.push(s);
        }
        for channel in &mut self.light {
            channel.resize(self.s.len(), 0.0);
        }
        let [red, green, blue] = &mut self.light;
        let places = Places { at: At::Each(&self.x, &self.y), far: Far::Map(&self.s) };
        self.shader.shade(places, [red, green, blue]);
        let count = (self.samples * self.samples) as usize;
        let share = 1.0 / count as f32;
        for (at, &[x, y]) in self.pixels.iter().enumerate() {
            let samples = at * count..(at + 1) * count;
            if self.light[0][samples.clone()].iter().all(|light| !light.is_nan()) {
                let sum = |c: usize| -> f32 {
                    self.light[c][samples.clone()].iter().map(|light| light.min(1.0)).sum()
                };
                progress.paint(x, y, [0, 1, 2].map(|c| sum(c) * share));
            }
        }
        self.pixels.clear();
        self.x.clear();
        self.y.clear();
        self.s.clear();
        self.many.clear();
    }

    /// Where a sample lies in the picture: the centre of its share of the pixel, and for
    /// the reference a fixed but irregular place in it.
    fn place(&self, x: u32, y: u32, column: u32, row: u32) -> [f64; 2] {
        let share = 1.0 / f64::from(self.samples);
        let shift = match self.view.quality.method {
            Method::Reference if self.samples > 1 => scatter(x, y, row * self.samples + column),
            _ => [0.5; 2],
        };
        [
            f64::from(x) + (f64::from(column) + shift[0]) * share,
            f64::from(y) + (f64::from(row) + shift[1]) * share,
        ]
    }

    pub(crate) fn finish(mut self, stats: &mut Stats, missing: &mut BTreeSet<TileKey>) {
        self.shader.wanted.drain_into(missing);
        stats.rays += self.rays;
        stats.hits += self.hits;
        stats.steps += self.beams.steps + self.many.steps + self.many.slow.finish(missing);
    }
}

/// Two numbers from 0 to 1 out of a pixel and a sample, by the finaliser of splitmix64.
fn scatter(x: u32, y: u32, sample: u32) -> [f64; 2] {
    let mut bits = (u64::from(x) << 40) ^ (u64::from(y) << 16) ^ u64::from(sample);
    bits = bits.wrapping_add(0x9E37_79B9_7F4A_7C15);
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    bits ^= bits >> 31;
    let unit = |half: u32| f64::from(half) / 4_294_967_296.0;
    [unit(bits as u32), unit((bits >> 32) as u32)]
}

/// The ray through a point of the picture, and its parameter at a depth.
pub(crate) fn path(camera: &Camera, ground: Ground, place: [f64; 2], depth: f64) -> (Path, f64) {
    let ray = camera.ray(place[0], place[1]);
    let length = ray.length();
    (Path::new(ground, camera.position, ray / length), depth * (length * (1.0 - ROUNDING)))
}
