//! From a region to rays, and from colours to pixels; what is done and what is not.

use crate::View;
use crate::column::Columns;
use crate::lanes;
use crate::relief::Relief;
use crate::beam::{Beams, WIDEST_PX};
use crate::exact::Exact;
use crate::field::{Contact, Field, Outcome};
use crate::path::{Ground, Path};
use crate::pyramid::Pyramid;
use crate::reference::Reference;
use crate::shade::{Places, Shader, map_distance};
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
const ROUNDING: f64 = 1e-9;

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
                if !self.done[self.place(x, y)] {
                    painter.cast(x, y, free);
                }
            });
            painter.shade(&mut |x, y, color| self.paint(x, y, color));
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

    fn place(&self, x: u32, y: u32) -> usize {
        let (column, row) = (x - self.region.x, y - self.region.y);
        row as usize * self.region.width as usize + column as usize
    }

    fn paint(&mut self, x: u32, y: u32, color: LinearRgb) {
        let at = self.place(x, y);
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
    caster: Caster<'a>,
    shader: Shader<'a>,
    samples: u32,
    cast: Cast,
    rays: u64,
    hits: u64,
}

/// Pixels whose rays are cast but not shaded.
#[derive(Default)]
struct Cast {
    pixels: Vec<[u32; 2]>,
    /// Places of their samples, pixels, and the map distances of these; see [`Places`].
    x: Vec<f32>,
    y: Vec<f32>,
    s: Vec<f32>,
    /// Light of the samples.
    light: [Vec<f32>; 3],
}

/// One of the methods.
enum Caster<'a> {
    Exact(Exact<'a>),
    Reference(Reference<'a>),
}

impl<'a> Caster<'a> {
    fn new(field: Field<'a>, method: Method) -> Self {
        match method {
            Method::Reference => Caster::Reference(Reference::new(field)),
            _ => Caster::Exact(Exact::new(field)),
        }
    }

    /// Finds where a ray meets the surface. It is known not to before `free_u`.
    fn cast(&mut self, path: &Path, free_u: f64) -> Outcome {
        match self {
            Caster::Exact(caster) => caster.cast(path, free_u),
            Caster::Reference(caster) => caster.cast(path),
        }
    }

    /// Steps taken; the tiles that were missing go into the set.
    fn finish(self, missing: &mut BTreeSet<TileKey>) -> u64 {
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
        Painter {
            view,
            ground: Ground::new(view.shading.earth),
            caster: Caster::new(field, view.quality.method),
            shader: Shader::new(field, &view.camera, &view.shading, samples),
            samples,
            cast: Cast::default(),
            rays: 0,
            hits: 0,
        }
    }

    /// Casts the rays of a pixel.
    fn cast(&mut self, x: u32, y: u32, free: f64) {
        self.cast.pixels.push([x, y]);
        for row in 0..self.samples {
            for column in 0..self.samples {
                let place = self.place(x, y, column, row);
                let s = self.sample(place, free);
                self.cast.x.push(place[0] as f32);
                self.cast.y.push(place[1] as f32);
                self.cast.s.push(s);
            }
        }
    }

    /// Map distance to what is seen at a place of the picture; see [`Places`].
    fn sample(&mut self, place: [f64; 2], free: f64) -> f32 {
        self.rays += 1;
        let (path, free_u) = path(&self.view.camera, self.ground, place, free);
        match self.caster.cast(&path, free_u) {
            Outcome::Hit(contact) => {
                self.hits += 1;
                map_distance(path.direction, contact.u)
            }
            Outcome::Miss => f32::INFINITY,
            Outcome::Unfinished => f32::NAN,
        }
    }

    /// Shades the pixels that were cast; `see` is told of those for which no tile is
    /// missing, with the mean of their samples. All samples are tried in any case, so that
    /// all missing tiles become known.
    fn shade(&mut self, see: &mut impl FnMut(u32, u32, LinearRgb)) {
        let Cast { pixels, x, y, s, light } = &mut self.cast;
        for channel in light.iter_mut() {
            channel.resize(s.len(), 0.0);
        }
        let [red, green, blue] = light;
        self.shader.shade(Places { x, y, s }, [red, green, blue]);
        let count = (self.samples * self.samples) as usize;
        let share = 1.0 / count as f32;
        for (at, &[x, y]) in pixels.iter().enumerate() {
            let samples = at * count..(at + 1) * count;
            if light[0][samples.clone()].iter().all(|light| !light.is_nan()) {
                let sum = |c: usize| -> f32 {
                    light[c][samples.clone()].iter().map(|light| light.min(1.0)).sum()
                };
                see(x, y, [0, 1, 2].map(|c| sum(c) * share));
            }
        }
        pixels.clear();
        x.clear();
        y.clear();
        s.clear();
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
        stats.steps += self.caster.finish(missing);
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
    /// The same measured over the map and along the ray's start; over flat ground it is
    /// the distance.
    pub parameter_m: f64,
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
    let mut stats = Stats::default();
    let mut missing = BTreeSet::new();
    let field = Field { resident, pyramid };
    let ground = Ground::new(view.shading.earth);
    let mut caster = Caster::new(field, view.quality.method);
    let mut beams = Beams::new(field, &view.camera, ground);
    for square in squares(region) {
        beams.narrow(square, &mut |x, y, free| {
            let place = [f64::from(x) + 0.5, f64::from(y) + 0.5];
            let (path, free_u) = path(&view.camera, ground, place, free);
            stats.rays += 1;
            match caster.cast(&path, free_u) {
                Outcome::Hit(contact) => {
                    stats.hits += 1;
                    see(x, y, Some(Hit::new(&path, &contact)));
                }
                Outcome::Miss => see(x, y, None),
                Outcome::Unfinished => {}
            }
        });
    }
    stats.steps = beams.steps + caster.finish(&mut missing);
    if missing.is_empty() { Ok(stats) } else { Err(Missing(missing.into_iter().collect())) }
}

/// How far away is what is seen through the centres of the pixels of a region.
#[derive(Debug, Clone, PartialEq)]
pub struct Depths {
    /// The pixels.
    pub region: Region,
    /// One over the depth of each pixel, per metre, rows from the top; 0 for the sky. The
    /// depth is the distance along the axis of the camera: what is seen is at
    /// `ray / inverse_depth` from the camera, with the pixel's [`Camera::ray`]. Over a round
    /// Earth that holds along the map.
    pub inverse_depth: Vec<f32>,
    /// What it took.
    pub stats: Stats,
}

impl Depths {
    /// Straight distance from the camera of what a pixel of the region shows, metres;
    /// infinite for the sky. The view must be the same.
    pub fn distance_m(&self, view: &View, x: u32, y: u32) -> f64 {
        let (column, row) = (x - self.region.x, y - self.region.y);
        let at = row as usize * self.region.width as usize + column as usize;
        let inverse = f64::from(self.inverse_depth[at]);
        if inverse == 0.0 {
            return f64::INFINITY;
        }
        let ground = Ground::new(view.shading.earth);
        let place = [f64::from(x) + 0.5, f64::from(y) + 0.5];
        let length = view.camera.ray(place[0], place[1]).length();
        let (path, _) = path(&view.camera, ground, place, 0.0);
        path.distance_at(length / inverse)
    }
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
            let tolerance_px = view.quality.tolerance_px;
            let columns = Columns { relief: &relief, camera: &view.camera, tolerance_px, region };
            let seen = lanes::run(columns, lanes::widest());
            let stats =
                Stats { hits: seen.alone, rays: seen.rays, steps: seen.steps, ..Stats::default() };
            let wanted = relief.wanted();
            if !wanted.is_empty() {
                return Err(Missing(wanted));
            }
            return Ok(Depths { region, inverse_depth: seen.inverse_depth, stats });
        }
    }
    let mut inverse_depth = vec![0.0; region.area() as usize];
    let stats = trace(resident, pyramid, view, region, |x, y, hit| {
        let at = (y - region.y) as usize * region.width as usize + (x - region.x) as usize;
        if let Some(hit) = hit {
            let place = [f64::from(x) + 0.5, f64::from(y) + 0.5];
            let length = view.camera.ray(place[0], place[1]).length();
            inverse_depth[at] = (length / hit.parameter_m) as f32;
        }
    })?;
    Ok(Depths { region, inverse_depth, stats })
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
            parameter_m: contact.u,
        }
    }
}
