//! From a region to rays, and from colours to pixels; what is done and what is not.

use crate::View;
use crate::beam::{Beams, WIDEST_PX};
use crate::column::Columns;
use crate::exact::{Exact, Many};
use crate::field::{Contact, Field, Outcome};
use crate::lanes;
use crate::path::{Ground, Path};
use crate::pyramid::Pyramid;
use crate::reference::Reference;
use crate::relief::Relief;
use crate::shade::Shader;
use crate::srgb;
use glam::DVec3;
use std::collections::BTreeSet;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::LinearRgb;
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::Resident;

/// Share by which a depth is shortened where it becomes a parameter, against rounding.
pub(crate) const ROUNDING: f64 = 1e-9;

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
    pub fn advance(&mut self, resident: &Resident, pyramid: &Pyramid, view: &View) -> Vec<TileKey> {
        let field = Field { resident, pyramid };
        if let Ok(true) = field.is_below(view.camera.position) {
            self.stats.below_ground = true;
            self.fill(srgb::encode(view.shading.below_ground));
            return Vec::new();
        }
        let mut missing = BTreeSet::new();
        let mut painter = Painter::new(field, view);
        let mut beams = Beams::new(field, &view.camera, painter.ground);
        for square in squares(self.region) {
            beams.narrow(square, &mut |x, y, free| {
                if !self.done[self.at(x, y)] {
                    if !painter.has_room() {
                        painter.cast(&mut |x, y, color| self.paint(x, y, color));
                    }
                    painter.add(x, y, free);
                }
            });
            painter.cast(&mut |x, y, color| self.paint(x, y, color));
        }
        self.stats.steps += beams.steps;
        painter.finish(&mut self.stats, &mut missing);
        missing.into_iter().collect()
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

    fn paint(&mut self, x: u32, y: u32, color: LinearRgb) {
        let at = self.at(x, y);
        self.pixels[3 * at..3 * at + 3].copy_from_slice(&srgb::encode(color));
        self.done[at] = true;
        self.left -= 1;
    }

    fn fill(&mut self, color: [u8; 3]) {
        for pixel in self.pixels.chunks_exact_mut(3) {
            pixel.copy_from_slice(&color);
        }
        self.done.fill(true);
        self.left = 0;
    }
}

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

/// Casts and shades the samples of pixels.
struct Painter<'a> {
    view: &'a View,
    ground: Ground,
    many: Many<'a>,
    /// The pixels to which the rays belong, each with all of its samples.
    pixels: Vec<[u32; 2]>,
    shader: Shader<'a>,
    samples: u32,
    rays: u64,
    hits: u64,
}

/// One of the methods.
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

impl<'a> Painter<'a> {
    fn new(field: Field<'a>, view: &'a View) -> Self {
        let samples = view.quality.samples_per_side.clamp(1, Quality::MAX_SAMPLES_PER_SIDE);
        let ground = Ground::new(view.shading.earth);
        let method = view.quality.method;
        Painter {
            view,
            ground,
            many: Many::new(field, &view.camera, ground, method, lanes::widest()),
            pixels: Vec::new(),
            shader: Shader::new(field, &view.camera, &view.shading, samples),
            samples,
            rays: 0,
            hits: 0,
        }
    }

    /// Whether all samples of one more pixel find room.
    fn has_room(&self) -> bool {
        self.many.room() >= (self.samples * self.samples) as usize
    }

    fn add(&mut self, x: u32, y: u32, free: f64) {
        self.pixels.push([x, y]);
        for row in 0..self.samples {
            for column in 0..self.samples {
                self.many.push(self.place(x, y, column, row), free);
            }
        }
    }

    /// Casts all rays. Tells of each pixel the mean of its samples, unless a tile is
    /// missing. All samples are tried in any case, so that all missing tiles become known.
    fn cast(&mut self, paint: &mut impl FnMut(u32, u32, LinearRgb)) {
        self.many.cast();
        self.rays += self.many.len() as u64;
        let samples = (self.samples * self.samples) as usize;
        let share = 1.0 / samples as f32;
        let mut pixels = std::mem::take(&mut self.pixels);
        for (number, &[x, y]) in pixels.iter().enumerate() {
            let mut sum = [0.0f32; 3];
            let mut complete = true;
            for ray in number * samples..(number + 1) * samples {
                match self.sample(ray) {
                    Some(color) => (0..3).for_each(|c| sum[c] += color[c].min(1.0)),
                    None => complete = false,
                }
            }
            if complete {
                paint(x, y, sum.map(|channel| channel * share));
            }
        }
        self.many.clear();
        pixels.clear();
        self.pixels = pixels;
    }

    fn sample(&mut self, ray: usize) -> Option<LinearRgb> {
        let direction = self.many.direction(ray);
        match self.many.outcome(ray) {
            Outcome::Hit(contact) => {
                self.hits += 1;
                self.shader.ground(&contact, direction, self.many.distance(ray))
            }
            Outcome::Miss => Some(self.shader.sky(direction)),
            Outcome::Unfinished => None,
        }
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

    fn finish(mut self, stats: &mut Stats, missing: &mut BTreeSet<TileKey>) {
        self.shader.wanted.drain_into(missing);
        stats.rays += self.rays;
        stats.hits += self.hits;
        stats.steps += self.many.steps + self.many.slow.finish(missing);
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

/// What a point of the picture shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Index of the height layer.
    pub layer: usize,
    /// Column of the cell of level 0.
    pub i: u64,
    /// Row of the cell of level 0.
    pub j: u64,
    /// Place within the cell along x, 0 to 1.
    pub u: f64,
    /// Place within the cell along y, 0 to 1.
    pub v: f64,
    /// The point of the ray that touches the ground, grid frame.
    pub position: DVec3,
    /// Height of the surface there, metres: above `position.z` if the ray ran into a
    /// wall.
    pub height: f64,
    /// Distance from the camera, metres.
    pub distance_m: f64,
}

/// Tiles that a question depends on but that are not loaded, sorted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Missing(pub Vec<TileKey>);

/// What is seen at a point of the picture, in pixels from the top left corner; `None` for
/// no ground. A camera at or below the ground hits it at once.
pub fn cast(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    x_px: f64,
    y_px: f64,
) -> Result<Option<Hit>, Missing> {
    let field = Field { resident, pyramid };
    let ground = Ground::new(view.shading.earth);
    let (path, _) = path(&view.camera, ground, [x_px, y_px], 0.0);
    let mut caster = Caster::new(field, view.quality.method);
    match caster.cast(&path, 0.0) {
        Outcome::Hit(contact) => Ok(Some(Hit::new(&path, &contact))),
        Outcome::Miss => Ok(None),
        Outcome::Unfinished => {
            let mut missing = BTreeSet::new();
            caster.finish(&mut missing);
            Err(Missing(missing.into_iter().collect()))
        }
    }
}

/// What is seen through the centres of the pixels of a region: `see` is told of each
/// pixel, by column and row, whether and where its ray meets the ground. The counters
/// are those of a rendered picture with one sample a pixel.
///
/// # Errors
/// If tiles are missing; `see` is not told of the pixels that need them.
pub fn trace(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    region: Region,
    mut see: impl FnMut(u32, u32, Option<Hit>),
) -> Result<Stats, Missing> {
    sweep(resident, pyramid, view, region, |many, ray, [x, y]| match many.outcome(ray) {
        Outcome::Hit(contact) => see(x, y, Some(Hit::new(&many.path(ray).0, &contact))),
        Outcome::Miss => see(x, y, None),
        Outcome::Unfinished => {}
    })
}

/// Casts the rays through the centres of the pixels of a region and shows each.
fn sweep(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    region: Region,
    mut see: impl FnMut(&mut Many, usize, [u32; 2]),
) -> Result<Stats, Missing> {
    let mut stats = Stats::default();
    let mut missing = BTreeSet::new();
    let field = Field { resident, pyramid };
    let ground = Ground::new(view.shading.earth);
    let method = view.quality.method;
    let mut many = Many::new(field, &view.camera, ground, method, lanes::widest());
    let mut beams = Beams::new(field, &view.camera, ground);
    let mut pixels = Vec::new();
    for square in squares(region) {
        pixels.clear();
        many.clear();
        beams.narrow(square, &mut |x, y, free| {
            pixels.push([x, y]);
            many.push([f64::from(x) + 0.5, f64::from(y) + 0.5], free);
        });
        many.cast();
        stats.rays += many.len() as u64;
        for (ray, &pixel) in pixels.iter().enumerate() {
            stats.hits += u64::from(many.is_hit(ray) == Some(true));
            see(&mut many, ray, pixel);
        }
    }
    stats.steps = beams.steps + many.steps + many.slow.finish(&mut missing);
    if missing.is_empty() { Ok(stats) } else { Err(Missing(missing.into_iter().collect())) }
}

/// Straight distances from the camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Depths {
    /// Distance of what is seen through the centre of each pixel, metres, rows from the
    /// top; infinite for the sky.
    pub distance_m: Vec<f32>,
    /// What it took.
    pub stats: Stats,
}

/// How far away is what is seen through the centres of the pixels of a region.
///
/// # Errors
/// If tiles are missing.
pub fn depths(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    region: Region,
) -> Result<Depths, Missing> {
    let field = Field { resident, pyramid };
    if view.quality.method == Method::Column {
        if let Some(relief) = Relief::new(field, view) {
            let columns = Columns {
                relief: &relief,
                camera: &view.camera,
                tolerance_px: view.quality.tolerance_px,
                region,
            };
            let seen = lanes::run(
                columns,
                std::env::var("WIDTH").map_or(lanes::widest(), |w| {
                    if w == "8" {
                        lanes::Width::Eight
                    } else if w == "1" {
                        lanes::Width::One
                    } else {
                        lanes::widest()
                    }
                }),
            );
            let stats =
                Stats { hits: seen.fallen, rays: seen.rays, steps: seen.steps, ..Stats::default() };
            let wanted = relief.wanted();
            if !wanted.is_empty() {
                return Err(Missing(wanted));
            }
            return Ok(Depths { distance_m: seen.distance, stats });
        }
    }
    let mut distance_m = vec![f32::INFINITY; region.area() as usize];
    let stats = sweep(resident, pyramid, view, region, |many, ray, [x, y]| {
        let at = (y - region.y) as usize * region.width as usize + (x - region.x) as usize;
        if many.is_hit(ray) == Some(true) {
            distance_m[at] = many.distance(ray) as f32;
        }
    })?;
    Ok(Depths { distance_m, stats })
}

impl Hit {
    fn new(path: &Path, contact: &Contact) -> Self {
        let along = path.direction * contact.u;
        let [u, v] = contact.place;
        Hit {
            layer: contact.layer,
            i: contact.cell[0] as u64,
            j: contact.cell[1] as u64,
            u,
            v,
            position: DVec3::new(path.origin.x + along.x, path.origin.y + along.y, contact.z),
            height: contact.corners.height(u, v),
            distance_m: path.distance(contact.u, contact.z),
        }
    }
}
