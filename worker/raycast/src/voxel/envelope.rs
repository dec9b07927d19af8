//! What `voxel` is made for; all else is refused, by the view and the store's index alone.
//!
//! - One height layer.
//! - A camera that does not roll, by more than [`MAX_ROLL_DEG`].
//! - No row of the picture steeper than [`MAX_STEEP_DEG`], and no column whose rays turn by
//!   more than [`MAX_TURN_DEG`] on the map (counted in cells): the steps of a column go along
//!   one axis. So the nadir is not in the picture.
//! - A camera within [`MAX_REACH`] cells of the terrain and so many metres of sea level.
//! - No post wider than a pixel on any ground in the picture. Ground no higher than `max` is
//!   at a depth of at least `(eye - max) / fall`, where `fall` is how much the lowest row
//!   falls for each metre of depth, and ground at a map distance `d` at least at `d / across`,
//!   with the largest part of a ray along the map. Of each tile that the picture may hold,
//!   with its highest post, the greater of the two counts; the least of all tiles decides.

use crate::View;
use crate::field::Field;
use crate::grid::cells_of;
use crate::seen::Unfit;
use glam::{DVec2, DVec3};
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Method;
use terrafarm_terrain::layout::{Layer, LayerKind};
use terrafarm_terrain::tile::MAXIMA_LEVELS;

/// The largest roll, degrees.
const MAX_ROLL_DEG: f64 = 0.5;
/// The steepest row, up or down, degrees.
const MAX_STEEP_DEG: f64 = 85.0;
/// The largest turn of a column, degrees: with the 45 of the axis that it goes along, less
/// than a right angle.
const MAX_TURN_DEG: f64 = 40.0;
/// The farthest camera, cells and metres: 2^30, which fixed point holds.
const MAX_REACH: f64 = (1u32 << 30) as f64;

/// The height layer of a store, if the view is one for the method; `None` if there is no
/// cell to see.
pub(super) fn fit<'a>(field: Field<'a>, view: &View) -> Result<Option<(usize, &'a Layer)>, Unfit> {
    let mut layers = field.index().layers_of(LayerKind::Height);
    let Some((number, layer)) = layers.next() else { return Ok(None) };
    let more = layers.count();
    if more > 0 {
        let why = format!("the terrain has {} height layers, it sees one", more + 1);
        return Err(Unfit { method: Method::Voxel, why, instead: Method::Exact });
    }
    let camera = &view.camera;
    let refuse = |why| Err(Unfit { method: Method::Voxel, why, instead: Method::Column });
    if let Some(why) = attitude(camera).or_else(|| turn(camera, layer)) {
        return refuse(why);
    }
    let eye = camera.position;
    let apart = |axis: usize| ((eye[axis] - layer.origin[axis]) / layer.spacing[axis]).abs();
    let reach = apart(0).max(apart(1)).max(eye.z.abs());
    if reach > MAX_REACH {
        return refuse(format!(
            "the camera is {reach:.0} cells from the terrain or metres from sea level, at most \
             {MAX_REACH:.0} are possible"
        ));
    }
    if cells_of(layer).contains(&0) {
        return Ok(None);
    }
    let (nearest, unit) = (nearest(field, camera, number, layer), unit_depth(camera, layer));
    if nearest < unit {
        return refuse(format!(
            "its posts are wider than a pixel up to a depth of {unit:.0} m, and ground in the \
             picture may be as near as {nearest:.0} m"
        ));
    }
    Ok(Some((number, layer)))
}

/// Depth at which a post of level 0 is a pixel wide, metres.
pub(super) fn unit_depth(camera: &Camera, layer: &Layer) -> f64 {
    layer.spacing[0].max(layer.spacing[1]) * camera.focal_px()
}

/// What is wrong with roll and pitch.
fn attitude(camera: &Camera) -> Option<String> {
    let pitch = libm::asin(camera.forward.z.clamp(-1.0, 1.0)).to_degrees();
    let half = libm::atan(0.5 * f64::from(camera.height) / camera.focal_px()).to_degrees();
    let steepest = pitch.abs() + half;
    if steepest > MAX_STEEP_DEG {
        return Some(format!(
            "rows of the picture are {steepest:.1} degrees from level, its columns reach \
             {MAX_STEEP_DEG:.0}"
        ));
    }
    let roll = libm::atan2(-camera.right.z, camera.up.z).to_degrees();
    (roll.abs() > MAX_ROLL_DEG).then(|| {
        format!("the camera is rolled by {roll:.1} degrees, at most {MAX_ROLL_DEG} are possible")
    })
}

/// What is wrong with the columns: the widest turn between the lowest and the highest row.
fn turn(camera: &Camera, layer: &Layer) -> Option<String> {
    let across = |x: u32, y: f64| {
        let ray = camera.ray(f64::from(x) + 0.5, y);
        DVec2::new(ray.x / layer.spacing[0], ray.y / layer.spacing[1])
    };
    let mut least = 1.0f64;
    for x in 0..camera.width {
        let (low, high) = (across(x, f64::from(camera.height) - 0.5), across(x, 0.5));
        least = least.min(low.dot(high) / (low.length() * high.length()));
    }
    let degrees = libm::acos(least.clamp(-1.0, 1.0)).to_degrees();
    // What is no number is no turn that is known to be small.
    (degrees.is_nan() || degrees > MAX_TURN_DEG).then(|| {
        format!(
            "a column of the picture turns by {degrees:.1} degrees on the map, at most \
             {MAX_TURN_DEG:.0} are possible: look less steeply or through a narrower field"
        )
    })
}

/// A lower bound of the depth of all ground in the picture, metres: see the module's page.
fn nearest(field: Field, camera: &Camera, number: usize, layer: &Layer) -> f64 {
    let sides = [0.0, f64::from(camera.width)];
    let rows = [0.0, f64::from(camera.height)];
    let corners = sides.map(|x| rows.map(|y| camera.ray(x, y)));
    let corners = corners.as_flattened();
    let fall = corners.iter().map(|ray| -ray.z).fold(f64::NEG_INFINITY, f64::max);
    let across = corners.iter().map(|ray| ray.truncate().length()).fold(0.0, f64::max);
    let planes = planes(camera, corners);
    let eye = camera.position;
    let depth = |south_west: DVec2, north_east: DVec2, max: f64| {
        // Ground is solid: if its top is outside of these planes, so is all of it.
        let outside = |plane: &DVec3| {
            let corner = DVec3::select(
                plane.cmpge(DVec3::ZERO),
                north_east.extend(max),
                south_west.extend(max),
            );
            plane.dot(corner - eye) < 0.0
        };
        let above = eye.z - max;
        if planes.iter().any(outside) || above > 0.0 && fall <= 0.0 {
            return f64::INFINITY;
        }
        let closest = eye.truncate().clamp(south_west, north_east);
        let down = if above > 0.0 { above / fall } else { 0.0 };
        down.max(closest.distance(eye.truncate()) / across)
    };
    let pyramid = BlockTree { field, number, layer, cells: cells_of(layer) };
    let mut nearest = f64::INFINITY;
    let mut blocks = vec![pyramid.top()];
    while let Some(block) = blocks.pop() {
        let Some((south_west, north_east, max)) = pyramid.bounds(block) else { continue };
        let bound = depth(south_west, north_east, max);
        if bound < nearest {
            if block.level == MAXIMA_LEVELS {
                nearest = bound;
            } else {
                blocks.extend(block.quarters());
            }
        }
    }
    nearest
}

/// The normals, inwards, of what bounds the ground in the picture: to the left and to the
/// right upright planes, because ground reaches down for ever, and that of the lowest row.
fn planes(camera: &Camera, corners: &[DVec3]) -> [DVec3; 3] {
    let ahead = camera.forward.truncate();
    let side = |ray: &&DVec3| ahead.perp_dot(ray.truncate()) / ahead.dot(ray.truncate());
    let by_side = |a: &&DVec3, b: &&DVec3| side(a).total_cmp(&side(b));
    let left = corners.iter().max_by(by_side).map_or(ahead, |ray| ray.truncate());
    let right = corners.iter().min_by(by_side).map_or(ahead, |ray| ray.truncate());
    let high = camera.tan_half_hfov * f64::from(camera.height) / f64::from(camera.width);
    [(-left.perp()).extend(0.0), right.perp().extend(0.0), camera.forward * high + camera.up]
}

/// Tiles, and blocks of them.
struct BlockTree<'a> {
    field: Field<'a>,
    number: usize,
    layer: &'a Layer,
    cells: [i32; 2],
}

/// `1 << level` cells a side.
#[derive(Clone, Copy)]
struct Block {
    level: usize,
    at: [usize; 2],
}

impl Block {
    fn quarters(self) -> impl Iterator<Item = Block> {
        let [bi, bj] = self.at.map(|at| 2 * at);
        let places = [[bi, bj], [bi + 1, bj], [bi, bj + 1], [bi + 1, bj + 1]];
        places.into_iter().map(move |at| Block { level: self.level - 1, at })
    }
}

impl BlockTree<'_> {
    fn top(&self) -> Block {
        Block { level: self.field.pyramid.layer(self.number).top(), at: [0; 2] }
    }

    /// The rectangle of a block and its highest post; `None` if it has none.
    fn bounds(&self, Block { level, at }: Block) -> Option<(DVec2, DVec2, f64)> {
        let cells = self.cells.map(|cells| cells as usize);
        if (0..2).any(|axis| at[axis] << level >= cells[axis]) {
            return None;
        }
        let max = self.field.pyramid.layer(self.number).block_max(level, at[0], at[1]);
        let corner = |more: usize| {
            let place = [0, 1].map(|axis| {
                let line = ((at[axis] + more) << level).min(cells[axis]);
                self.layer.origin[axis] + line as f64 * self.layer.spacing[axis]
            });
            DVec2::from_array(place)
        };
        (max > f32::NEG_INFINITY).then(|| (corner(0), corner(1), max.into()))
    }
}
