//! Questions about single points and whole regions, without colours.

use crate::View;
use crate::beam::Beams;
use crate::exact::Many;
use crate::fast::{self, Look};
use crate::field::{Contact, Field, Outcome};
use crate::lanes;
use crate::painter::{Caster, path, squares};
use crate::path::{Ground, Path};
use crate::progress::Stats;
use crate::pyramid::Pyramid;
use crate::relief::Lack;
use crate::seen::{Seen, Unfit};
use glam::DVec3;
use std::collections::BTreeSet;
use terrafarm_common::region::Region;
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::Resident;

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

/// Why a region was not seen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Unseen {
    /// These tiles are not loaded, sorted.
    Missing(Vec<TileKey>),
    /// The method is not made for the view.
    Unfit(Unfit),
}

impl From<Missing> for Unseen {
    fn from(Missing(tiles): Missing) -> Self {
        Unseen::Missing(tiles)
    }
}

impl From<Unfit> for Unseen {
    fn from(unfit: Unfit) -> Self {
        Unseen::Unfit(unfit)
    }
}

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
    sweep(resident, pyramid, view, region, |many, first, part| {
        for (ray, [x, y]) in (first..).zip(part.pixels()) {
            match many.outcome(ray) {
                Outcome::Hit(contact) => see(x, y, Some(Hit::new(&many.path(ray).0, &contact))),
                Outcome::Miss => see(x, y, None),
                Outcome::Unfinished => {}
            }
        }
    })
}

/// Casts the rays through the centres of the pixels of a region, and shows them by small
/// parts of it: with the number of the first ray of the part, others following row by row.
fn sweep(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    region: Region,
    mut see: impl FnMut(&mut Many<'_>, usize, Region),
) -> Result<Stats, Missing> {
    let mut stats = Stats::default();
    let mut missing = BTreeSet::new();
    let field = Field { resident, pyramid };
    let ground = Ground::new(view.shading.earth);
    let method = view.quality.method;
    let mut many = Many::new(field, &view.camera, ground, method, lanes::widest());
    let mut beams = Beams::new(field, &view.camera, ground);
    let mut parts: Vec<(usize, Region)> = Vec::new();
    let mut flush = |many: &mut Many, parts: &mut Vec<(usize, Region)>| {
        many.cast();
        stats.rays += many.len() as u64;
        stats.hits += many.hits();
        for (first, part) in parts.drain(..) {
            see(many, first, part);
        }
        many.clear();
    };
    for square in squares(region) {
        beams.narrow(square, &mut |part, free| {
            if many.room() < part.area() as usize {
                flush(&mut many, &mut parts);
            }
            parts.push((many.len(), part));
            many.push_centres(part, free);
        });
        flush(&mut many, &mut parts);
    }
    stats.steps = beams.steps + many.steps + many.slow.finish(&mut missing);
    if missing.is_empty() { Ok(stats) } else { Err(Missing(missing.into_iter().collect())) }
}

/// How far away is what is seen through the centres of the pixels of a region.
#[derive(Debug, Clone, PartialEq)]
pub struct Depths {
    /// The pixels.
    pub region: Region,
    /// One over the depth of each pixel, per metre, rows from the top; 0 for the sky. The
    /// depth is the distance along the axis of the camera: what is seen is at
    /// `ray / inverse_depth` from the camera, with the pixel's ray. Over a round
    /// Earth that holds along the map.
    pub inverse_depth: Vec<f32>,
    /// What it took.
    pub stats: Stats,
}

/// Depths with the tiles at hand; see [`depths_at_hand`].
#[derive(Debug, Clone, PartialEq)]
pub struct AtHand {
    /// What is seen: the same as [`depths`] finds if nothing is wanted.
    pub depths: Depths,
    /// Pixels that show ground at a coarser level than the tolerance asks for.
    pub coarser: u64,
    /// The tiles that a picture to the tolerance needs and that are not loaded, sorted.
    pub wanted: Vec<TileKey>,
}

impl AtHand {
    /// Whether a tile was missing: the picture may be off by more than the tolerance, also
    /// where it shows other ground than that of the missing tile.
    pub fn is_degraded(&self) -> bool {
        !self.wanted.is_empty()
    }
}

impl Depths {
    fn new(region: Region, seen: Seen) -> Self {
        let stats =
            Stats { rays: seen.rays, steps: seen.steps, fallbacks: seen.alone, ..Stats::default() };
        Depths { region, inverse_depth: seen.inverse_depth, stats }
    }

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
/// If tiles are missing, or the method is not made for the view.
pub fn depths(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    region: Region,
) -> Result<Depths, Unseen> {
    let field = Field { resident, pyramid };
    if let Look::Fast(method) = Look::of(field, view)? {
        if let Err(tile) = field.is_below(view.camera.position) {
            return Err(Unseen::Missing(vec![tile]));
        }
        let (seen, wanted) = fast::see(field, view, region, method, lanes::widest())?;
        if !wanted.is_empty() {
            return Err(Unseen::Missing(wanted));
        }
        return Ok(Depths::new(region, seen));
    }
    let mut inverse_depth = vec![0.0; region.area() as usize];
    let stats = sweep(resident, pyramid, view, region, |many, mut ray, part| {
        let width = part.width as usize;
        for y in part.y..part.y + part.height {
            let row = (y - region.y) as usize * region.width as usize;
            let at = row + (part.x - region.x) as usize;
            inverse_depth[at..at + width].copy_from_slice(many.inverse_depths(ray, width));
            ray += width;
        }
    })?;
    Ok(Depths { region, inverse_depth, stats })
}

/// How far away is what is seen, for a picture that cannot wait: where the tile that a
/// method needs is not loaded, it sees the finest coarser level whose tile is. The answer
/// says how many pixels show such ground, and which tiles would have been needed; load
/// these, and the next picture is better. Keep the
/// [roots](terrafarm_terrain::layout::StoreIndex::roots) loaded, and there is always some
/// ground to see.
///
/// `lod` and `column` do this. The other methods wait for their tiles: they give the same
/// answers as [`depths`].
///
/// # Errors
/// If not even a coarser tile is loaded, or the method waits for a tile, or it is not made
/// for the view.
pub fn depths_at_hand(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    region: Region,
) -> Result<AtHand, Unseen> {
    let field = Field { resident, pyramid };
    let method = match Look::of(field, view)? {
        Look::Fast(method @ (fast::Method::Lod | fast::Method::Column)) => method,
        _ => {
            let depths = depths(resident, pyramid, view, region)?;
            return Ok(AtHand { depths, coarser: 0, wanted: Vec::new() });
        }
    };
    let width = lanes::widest();
    let (seen, wanted) = fast::see_with(field, view, region, method, width, Lack::Coarser)?;
    if seen.inverse_depth.iter().any(|inverse| inverse.is_nan()) {
        return Err(Unseen::Missing(wanted));
    }
    let coarser = seen.coarser;
    Ok(AtHand { depths: Depths::new(region, seen), coarser, wanted })
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
