//! Slopes of the ground at the scale of a pixel.
//!
//! Central differences at the four posts around a place, bilinear between, from the
//! level of the height pyramid whose posts are as far apart as pixels are: shading from
//! finer posts than a pixel can show would glitter at the horizon.

use super::footprint::level_of;
use crate::field::{Contact, Field, Wanted};
use terrafarm_terrain::layout::{Layer, TILE_CELLS, TileKey};
use terrafarm_terrain::resident::Lookup;
use terrafarm_terrain::tile::HeightTile;

/// Slopes along x and y at a contact, for a pixel that is `size_m` across there. Tiles
/// that are not loaded are added to `wanted`.
pub(crate) fn slopes(
    field: &Field,
    contact: &Contact,
    place: [f64; 2],
    size_m: f64,
    wanted: &mut Wanted,
) -> [f64; 2] {
    let layer = &field.index().layers[contact.layer];
    let spacing = layer.spacing[0].max(layer.spacing[1]);
    let (level, share) = level_of(size_m / spacing, layer.levels.len() - 1);
    let mut at = |level| at_level(field, contact.layer, layer, level, place, wanted);
    let coarse = if share > 0.0 { at(level + 1) } else { None };
    let fine = at(level).unwrap_or_else(|| {
        let rise = contact.corners.slopes(contact.place[0], contact.place[1]);
        [0, 1].map(|axis| rise[axis] / layer.spacing[axis])
    });
    match coarse {
        Some(coarse) => {
            [0, 1].map(|axis| fine[axis] + (coarse[axis] - fine[axis]) * f64::from(share))
        }
        None => fine,
    }
}

/// `None` if the level knows nothing of the place.
fn at_level(
    field: &Field,
    number: usize,
    layer: &Layer,
    level: usize,
    place: [f64; 2],
    wanted: &mut Wanted,
) -> Option<[f64; 2]> {
    let spacing = layer.level_spacing(level);
    let posts = layer.level_posts(level);
    let [x, y] = [0, 1].map(|axis| {
        ((place[axis] - layer.origin[axis]) / spacing[axis]).clamp(0.0, (posts[axis] - 1) as f64)
    });
    let [tx, ty] = [(x, 0), (y, 1)].map(|(value, axis)| {
        (value as u32 / TILE_CELLS as u32).min(layer.levels[level].tiles[axis] - 1)
    });
    let key = TileKey { layer: number as u16, level: level as u16, tx, ty };
    let tile = match field.resident.height(key) {
        Lookup::Found(tile) => tile,
        Lookup::Empty => return None,
        Lookup::Absent => {
            wanted.add(key);
            return None;
        }
    };
    let local = [x - f64::from(tx * TILE_CELLS as u32), y - f64::from(ty * TILE_CELLS as u32)];
    let cell = local.map(|value| (value as isize).min(TILE_CELLS as isize - 1));
    blend(tile, cell, [0, 1].map(|axis| (local[axis] - cell[axis] as f64) as f32))
        .map(|rise| [0, 1].map(|axis| f64::from(rise[axis]) / spacing[axis]))
}

/// Differences a cell, blended from those posts around a place that have any.
fn blend(tile: &HeightTile, cell: [isize; 2], place: [f32; 2]) -> Option<[f32; 2]> {
    let mut sum = [0.0f32; 2];
    let mut weights = 0.0f32;
    for (di, dj) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let (i, j) = (cell[0] + di, cell[1] + dj);
        let post = tile.post(i, j);
        let along = |i0, j0, i1, j1| difference(tile.post(i0, j0), post, tile.post(i1, j1));
        let rise = [along(i - 1, j, i + 1, j), along(i, j - 1, i, j + 1)];
        let share = |d, t: f32| if d == 1 { t } else { 1.0 - t };
        let weight = share(di, place[0]) * share(dj, place[1]);
        if weight > 0.0 && rise[0].is_finite() && rise[1].is_finite() {
            sum[0] += weight * rise[0];
            sum[1] += weight * rise[1];
            weights += weight;
        }
    }
    (weights > 0.0).then(|| sum.map(|rise| rise / weights))
}

/// The rise per cell at a post between two others; one-sided beside a void.
fn difference(before: f32, post: f32, after: f32) -> f32 {
    match (before.is_nan(), after.is_nan()) {
        (false, false) => 0.5 * (after - before),
        (true, false) => after - post,
        (false, true) => post - before,
        (true, true) => f32::NAN,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use terrafarm_terrain::layout::TILE_POSTS;

    fn tile(height: impl Fn(f32, f32) -> f32) -> HeightTile {
        let posts = (0..TILE_POSTS * TILE_POSTS)
            .map(|at| height((at % TILE_POSTS) as f32 - 1.0, (at / TILE_POSTS) as f32 - 1.0));
        HeightTile::new(posts.collect()).expect("the number of posts fits")
    }

    #[test]
    fn a_plane_has_the_same_slope_everywhere_also_beside_voids() {
        let plane = tile(|x, y| 3.0 * x - 2.0 * y);
        assert_eq!(blend(&plane, [0, 255], [0.3, 0.9]), Some([3.0, -2.0]));
        let holed = tile(|x, y| if x == 5.0 && y == 5.0 { f32::NAN } else { 3.0 * x - 2.0 * y });
        assert_eq!(blend(&holed, [6, 5], [0.25, 0.5]), Some([3.0, -2.0]));
        assert_eq!(blend(&tile(|_, _| f32::NAN), [6, 5], [0.25, 0.5]), None);
    }
}
