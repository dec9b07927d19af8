//! Slopes of the ground at the scale of a pixel.
//!
//! Central differences at the four posts around a place, bilinear between, from the
//! level of the height pyramid whose posts are as far apart as pixels are: shading from
//! finer posts than a pixel can show would glitter at the horizon.

use super::footprint::level_of;
use super::stack::Stack;
use crate::field::{Contact, Wanted};
use terrafarm_terrain::tile::HeightTile;

/// Slopes along x and y at a contact with the layer of a stack, for a pixel that is
/// `size_m` across there. Tiles that are not loaded are added to `wanted`.
pub(crate) fn slopes(
    stack: &mut Stack<HeightTile>,
    contact: &Contact,
    place: [f64; 2],
    size_m: f64,
    wanted: &mut Wanted,
) -> [f64; 2] {
    let spacing = stack.layer.spacing;
    let (level, share) = level_of(size_m / spacing[0].max(spacing[1]), stack.top());
    let posts = stack.posts_at(place);
    let coarse = if share > 0.0 { at_level(stack, level + 1, posts, wanted) } else { None };
    let fine = at_level(stack, level, posts, wanted).unwrap_or_else(|| {
        let rise = contact.corners.slopes(contact.place[0], contact.place[1]);
        [rise[0] / spacing[0], rise[1] / spacing[1]]
    });
    let Some(coarse) = coarse else { return fine };
    let share = f64::from(share);
    [fine[0] + (coarse[0] - fine[0]) * share, fine[1] + (coarse[1] - fine[1]) * share]
}

/// `None` if the level knows nothing of the place.
fn at_level(
    stack: &mut Stack<HeightTile>,
    level: usize,
    posts: [f64; 2],
    wanted: &mut Wanted,
) -> Option<[f64; 2]> {
    let spot = stack.spot(level, posts, wanted)?;
    let rise = if spot.tile.has_voids() {
        blend(spot.tile, spot.cell, spot.share)?
    } else {
        blend_whole(spot.tile, spot.cell, spot.share)
    };
    let scale = stack.level_scale(level);
    Some([f64::from(rise[0]) * scale[0], f64::from(rise[1]) * scale[1]])
}

/// As [`blend`] where no post is void: from the twelve posts around the cell.
#[inline]
fn blend_whole(tile: &HeightTile, [i, j]: [isize; 2], [x, y]: [f32; 2]) -> [f32; 2] {
    let post = |di, dj| tile.post(i + di, j + dj);
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let row = |dj| lerp(post(1, dj) - post(-1, dj), post(2, dj) - post(0, dj), x);
    let column = |di| lerp(post(di, 1) - post(di, -1), post(di, 2) - post(di, 0), y);
    [0.5 * lerp(row(0), row(1), y), 0.5 * lerp(column(0), column(1), x)]
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
        assert_eq!(blend_whole(&plane, [0, 255], [0.3, 0.9]), [3.0, -2.0]);
        let holed = tile(|x, y| if x == 5.0 && y == 5.0 { f32::NAN } else { 3.0 * x - 2.0 * y });
        assert_eq!(blend(&holed, [6, 5], [0.25, 0.5]), Some([3.0, -2.0]));
        assert_eq!(blend(&tile(|_, _| f32::NAN), [6, 5], [0.25, 0.5]), None);
    }

    #[test]
    fn the_short_form_for_ground_without_voids_agrees() {
        let rough = tile(|x, y| ((x * 7919.0 + y * 104_729.0) % 1009.0) * 0.25);
        for (i, j) in [(0, 0), (17, 200), (255, 255), (128, 3)] {
            for (x, y) in [(0.0, 0.0), (0.25, 0.75), (0.9, 0.1), (1.0, 1.0)] {
                let slow = blend(&rough, [i, j], [x, y]).expect("no post is void");
                let fast = blend_whole(&rough, [i, j], [x, y]);
                for axis in 0..2 {
                    assert!((slow[axis] - fast[axis]).abs() < 1e-3, "{slow:?} {fast:?}");
                }
            }
        }
    }
}
