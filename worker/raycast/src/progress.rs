//! From a region to pixels; what is done and what is not.

use crate::View;
use crate::fast::{self, Look};
use crate::field::Field;
use crate::lanes;
use crate::painter::Painter;
use crate::pyramid::Pyramid;
use crate::seen::Unfit;
use crate::shade::{At, Far, Places, Shader};
use crate::srgb;
use std::collections::BTreeSet;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Region;
use terrafarm_common::shading::LinearRgb;
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::Resident;

/// Pixels that are shaded at once, about: their bytes stay close to the processor.
const STRIP_PX: u32 = 4096;

/// A region with its pixels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rendered {
    /// Rows from the top, three bytes of sRGB a pixel.
    pub pixels: Vec<u8>,
    /// Tiles without which some pixels could not be finished, sorted, each once. Empty
    /// when the region is done.
    pub missing: Vec<TileKey>,
    /// What it took.
    pub stats: Stats,
}

/// Counters of a region.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Stats {
    /// Rays cast, those in vain for want of a tile included.
    pub rays: u64,
    /// Blocks and cells that these rays looked at.
    pub steps: u64,
    /// Rays that met the ground.
    pub hits: u64,
    /// Samples that the method could not do its own way and gave a ray of their own: a
    /// property of the picture, however it was split and often it was tried.
    pub fallbacks: u64,
    /// The camera is at or below the surface.
    pub below_ground: bool,
}

/// A region that is being rendered, perhaps in several goes.
#[derive(Debug, Clone)]
pub struct Progress {
    region: Region,
    pixels: Vec<u8>,
    done: Vec<bool>,
    left: u64,
    stats: Stats,
}

impl Progress {
    /// A region of which nothing is done. It takes four bytes a pixel: check sizes from
    /// outside with [`Region::fits`] first.
    pub fn new(region: Region) -> Self {
        let area = region.area();
        Progress {
            region,
            pixels: vec![0; area as usize * 3],
            done: vec![false; area as usize],
            left: area,
            stats: Stats::default(),
        }
    }

    /// Renders every pixel that is not done yet and can be. Returns the tiles that the
    /// others wait for, sorted; empty if none is left. The view must be the same each
    /// time.
    ///
    /// # Errors
    /// If the method is not made for the view.
    pub fn advance(
        &mut self,
        resident: &Resident,
        pyramid: &Pyramid,
        view: &View,
    ) -> Result<Vec<TileKey>, Unfit> {
        let field = Field { resident, pyramid };
        let below = field.is_below(view.camera.position);
        if let Ok(true) = below {
            self.stats.below_ground = true;
            self.fill(srgb::encode(view.shading.below_ground));
            return Ok(Vec::new());
        }
        let mut missing = BTreeSet::new();
        match Look::of(field, view)? {
            Look::RayByRay(_) => self.paint_rays(field, view, &mut missing),
            Look::Fast(method) => {
                if let Err(tile) = below {
                    return Ok(vec![tile]);
                }
                self.paint_fast(field, view, method, &mut missing)?;
            }
        }
        Ok(missing.into_iter().collect())
    }

    fn paint_rays(&mut self, field: Field, view: &View, missing: &mut BTreeSet<TileKey>) {
        let mut painter = Painter::new(field, view);
        painter.region(self.region, self);
        painter.finish(&mut self.stats, missing);
    }

    /// Depths for all samples at once, then their light, some rows at a time.
    fn paint_fast(
        &mut self,
        field: Field,
        view: &View,
        method: fast::Method,
        missing: &mut BTreeSet<TileKey>,
    ) -> Result<(), Unfit> {
        let samples = view.quality.samples_per_side.clamp(1, Quality::MAX_SAMPLES_PER_SIDE);
        let (fine, region) = fast::supersampled(view, self.region, samples);
        let (seen, wanted) = fast::see(field, &fine, region, method, lanes::widest())?;
        missing.extend(wanted);
        self.stats.rays += seen.rays;
        self.stats.steps += seen.steps;
        // Each go looks at the whole region: the last one counts.
        self.stats.fallbacks = seen.alone;
        self.stats.hits += number(&seen.inverse_depth, |&inverse| inverse > 0.0);
        let mut shader = Shader::new(field, &view.camera, &view.shading, samples);
        let share = 1.0 / samples as f32;
        let middle = |sample: u32| (sample as f32 + 0.5) * share;
        let x: Vec<f32> = (region.x..region.x + region.width).map(middle).collect();
        let y: Vec<f32> = (region.y..region.y + region.height).map(middle).collect();
        let mut strip = Strip::default();
        let mut from = 0;
        let rows = (STRIP_PX / region.width.max(1)).max(samples).next_multiple_of(samples) as usize;
        let depths = seen.inverse_depth.chunks(rows * x.len().max(1));
        for (depths, y) in depths.zip(y.chunks(rows)) {
            let places = Places { at: At::Net(&x, y), far: Far::Inverse(depths) };
            strip.shade(&mut shader, places, samples as usize);
            self.take(from, &strip);
            from += strip.pixels.len() / 3;
        }
        shader.wanted.drain_into(missing);
        Ok(())
    }

    /// Whether every pixel is done.
    pub fn is_done(&self) -> bool {
        self.left == 0
    }

    /// The pixels as they are, with the tiles that [`Progress::advance`] named last.
    pub fn into_rendered(self, missing: Vec<TileKey>) -> Rendered {
        Rendered { pixels: self.pixels, missing, stats: self.stats }
    }

    /// Place of a pixel of the frame among those of the region.
    fn at(&self, x: u32, y: u32) -> usize {
        let (column, row) = (x - self.region.x, y - self.region.y);
        row as usize * self.region.width as usize + column as usize
    }

    /// Whether a pixel of the frame is done.
    pub(crate) fn has(&self, x: u32, y: u32) -> bool {
        self.done[self.at(x, y)]
    }

    pub(crate) fn paint(&mut self, x: u32, y: u32, color: LinearRgb) {
        let at = self.at(x, y);
        self.pixels[3 * at..3 * at + 3].copy_from_slice(&srgb::encode(color));
        self.left -= u64::from(!self.done[at]);
        self.done[at] = true;
    }

    /// Takes the pixels of a strip, but for those that are unknown: from the one with the
    /// number `from` on.
    fn take(&mut self, from: usize, strip: &Strip) {
        let mut start = 0;
        let count = strip.pixels.len() / 3;
        for &stop in strip.unknown.iter().chain([&count]) {
            let known = from + start..from + stop;
            self.pixels[3 * known.start..3 * known.end]
                .copy_from_slice(&strip.pixels[3 * start..3 * stop]);
            self.left -= number(&self.done[known.clone()], |&done| !done);
            self.done[known].fill(true);
            start = stop + 1;
        }
    }

    fn fill(&mut self, color: [u8; 3]) {
        for pixel in self.pixels.chunks_exact_mut(3) {
            pixel.copy_from_slice(&color);
        }
        self.done.fill(true);
        self.left = 0;
    }
}

/// How many of some values are as asked. In small sums, which fit many to a vector.
fn number<T>(values: &[T], is: impl Fn(&T) -> bool) -> u64 {
    let few = |values: &[T]| values.iter().map(|value| u8::from(is(value))).sum::<u8>();
    values.chunks(usize::from(u8::MAX)).map(|values| u64::from(few(values))).sum()
}

/// Some rows of pixels, shaded.
#[derive(Default)]
struct Strip {
    /// Three bytes a pixel.
    pixels: Vec<u8>,
    /// Numbers of the pixels that wait for a tile, growing.
    unknown: Vec<usize>,
    /// Light of the samples, and its mean over a pixel: red, green and blue.
    samples: [Vec<f32>; 3],
    means: [Vec<f32>; 3],
}

impl Strip {
    /// Shades pixels of so many samples a side; the places are a net of whole pixels.
    fn shade(&mut self, shader: &mut Shader, places: Places, side: usize) {
        let (At::Net(x, y) | At::Each(x, y)) = places.at;
        let count = x.len() / side * (y.len() / side);
        self.pixels.resize(3 * count, 0);
        self.unknown.clear();
        if side == 1 {
            shader.paint(places, &mut self.pixels, &mut self.unknown);
            return;
        }
        for light in &mut self.samples {
            light.resize(x.len() * y.len(), 0.0);
        }
        let [red, green, blue] = &mut self.samples;
        shader.shade(places, [red, green, blue]);
        let weight = 1.0 / (side * side) as f32;
        for (means, samples) in self.means.iter_mut().zip(&self.samples) {
            means.clear();
            for rows in samples.chunks(side * x.len()) {
                means.extend((0..x.len()).step_by(side).map(|at| {
                    let pixel = rows.chunks(x.len()).flat_map(|row| &row[at..at + side]);
                    // A NaN stays one: `min` would lose it.
                    pixel.map(|&light| if light > 1.0 { 1.0 } else { light }).sum::<f32>() * weight
                }));
            }
        }
        let [red, green, blue] = &self.means;
        srgb::encode_all([red, green, blue], &mut self.pixels, lanes::widest());
        let unknown = red.iter().enumerate().filter(|(_, light)| light.is_nan());
        self.unknown.extend(unknown.map(|(number, _)| number));
    }
}
