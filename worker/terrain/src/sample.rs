//! How high is it here: the one written definition of the surface.
//!
//! # The surface
//!
//! 1. **Within a layer** the surface is the bilinear interpolant of the posts of level 0.
//!    It exists on the cells of the grid, the closed rectangle from post (0, 0) to the
//!    north-east one; nothing exists beyond, not even half a cell.
//! 2. **Voids.** A point has a height if every post with a nonzero weight there is valid.
//!    So a cell with a void corner is void inside; on an edge of the grid lines only its
//!    two posts count, on a post only that one.
//! 3. **Layers.** Height layers lie on top of each other in the order of the index, the
//!    coarsest at the bottom. The height of a point is that of the last layer that has
//!    one there; where an inset is void, what lies below shows through.
//! 4. **Walls.** Nothing blends layers: where the topmost layer changes, along the border
//!    of an inset or of its voids, the surface jumps, and for a ray the jump is a
//!    vertical wall. On the border itself the upper layer counts, since rectangles are
//!    closed.
//! 5. **Ties.** A coordinate belongs to grid line i if it equals
//!    `origin + i * spacing` as computed in f64; its fraction is then exactly 0. At posts
//!    the height is the post's own, to the last bit.
//!
//! Everything is computed in f64 from the stored f32 posts: along x first, then along y,
//! each as `a + (b - a) * fraction`. Coarser levels, maxima and photos approximate or
//! bound this surface; they never define it.

use crate::layout::{Layer, LayerKind, TILE_CELLS, TileKey};
use crate::resident::Tile;
use crate::store::{StoreError, StoreReader};
use crate::tile::HeightTile;
use std::sync::Arc;

/// Tiles that a sampler keeps: 16 of level 0 are about 6 MB.
const KEPT_TILES: usize = 16;

/// Answers for one point; for many use a [`Sampler`]. `None` over a void and outside.
///
/// # Errors
/// If a tile cannot be read.
pub fn height_at(store: &StoreReader, x: f64, y: f64) -> Result<Option<f64>, StoreError> {
    Sampler::new(store).height_at(x, y)
}

/// Answers for many points, keeping the tiles last used.
pub struct Sampler<'a> {
    store: &'a StoreReader,
    /// Most recently used last; `None` for a tile in which nothing is valid.
    tiles: Vec<(TileKey, Option<Arc<HeightTile>>)>,
}

/// A coordinate in a grid: the post at or before it, and the fraction to the next one.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Place {
    post: u64,
    fraction: f64,
}

impl<'a> Sampler<'a> {
    /// A sampler of an open store.
    pub fn new(store: &'a StoreReader) -> Self {
        Sampler { store, tiles: Vec::with_capacity(KEPT_TILES) }
    }

    /// Height of the surface at a position in the store's CRS, metres; `None` over a void
    /// and outside all layers.
    ///
    /// # Errors
    /// If a tile cannot be read.
    pub fn height_at(&mut self, x: f64, y: f64) -> Result<Option<f64>, StoreError> {
        let index = self.store.index().clone();
        for (number, layer) in index.layers.iter().enumerate().rev() {
            if layer.kind != LayerKind::Height {
                continue;
            }
            if let Some(height) = self.height_in_layer(number as u16, layer, x, y)? {
                return Ok(Some(height));
            }
        }
        Ok(None)
    }

    fn height_in_layer(
        &mut self,
        number: u16,
        layer: &Layer,
        x: f64,
        y: f64,
    ) -> Result<Option<f64>, StoreError> {
        let (Some(column), Some(row)) = (place(layer, 0, x), place(layer, 1, y)) else {
            return Ok(None);
        };
        let tiles = layer.levels[0].tiles;
        let tile_of =
            |place: Place, count: u32| ((place.post / TILE_CELLS as u64) as u32).min(count - 1);
        let (tx, ty) = (tile_of(column, tiles[0]), tile_of(row, tiles[1]));
        let Some(tile) = self.tile(TileKey { layer: number, level: 0, tx, ty })? else {
            return Ok(None);
        };
        let local = |place: Place, t: u32| (place.post - u64::from(t) * TILE_CELLS as u64) as isize;
        let (i, j) = (local(column, tx), local(row, ty));
        let along_x = |j: isize| {
            between(tile.post(i, j).into(), || tile.post(i + 1, j).into(), column.fraction)
        };
        let height = between(along_x(j), || along_x(j + 1), row.fraction);
        Ok((!height.is_nan()).then_some(height))
    }

    fn tile(&mut self, key: TileKey) -> Result<Option<Arc<HeightTile>>, StoreError> {
        if let Some(at) = self.tiles.iter().position(|(kept, _)| *kept == key) {
            self.tiles[at..].rotate_left(1);
        } else {
            let tile = match self.store.read_tile(key)? {
                Some(Tile::Height(tile)) => Some(tile),
                _ => None,
            };
            if self.tiles.len() == KEPT_TILES {
                self.tiles.remove(0);
            }
            self.tiles.push((key, tile));
        }
        Ok(self.tiles.last().and_then(|(_, tile)| tile.clone()))
    }
}

/// Where a coordinate lies along an axis of a layer; `None` outside, and for NaN.
fn place(layer: &Layer, axis: usize, coordinate: f64) -> Option<Place> {
    let (origin, spacing) = (layer.origin[axis], layer.spacing[axis]);
    let last = layer.posts[axis] - 1;
    let steps = (coordinate - origin) / spacing;
    let line = steps.round();
    if line >= 0.0 && line <= last as f64 && origin + line * spacing == coordinate {
        return Some(Place { post: line as u64, fraction: 0.0 });
    }
    if !(steps > 0.0 && steps < last as f64) {
        return None;
    }
    let post = steps as u64;
    Some(Place { post, fraction: steps - post as f64 })
}

/// Linear interpolation; the second value is not looked at if its weight is 0.
fn between(a: f64, b: impl FnOnce() -> f64, fraction: f64) -> f64 {
    if fraction == 0.0 { a } else { a + (b() - a) * fraction }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::build::LayerSpec;
    use crate::fixture::{Ground, height_layer, hills};
    use proptest::prelude::*;

    fn with_store(ground: Ground, check: impl FnOnce(&StoreReader)) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.terrain");
        ground.build(&path).unwrap();
        check(&StoreReader::open(&path).unwrap());
    }

    #[test]
    fn posts_are_exact_wherever_the_grid_lies() {
        let spec = LayerSpec {
            origin: [333_333.3, 4_500_000.1],
            spacing: [0.1, 29.7],
            ..height_layer([600, 300])
        };
        with_store(Ground::new().heights(spec, hills), |store| {
            let mut sampler = Sampler::new(store);
            for j in (0..300).step_by(13).chain([299]) {
                for i in (0..600).step_by(7).chain([256, 599]) {
                    let x = spec.origin[0] + i as f64 * spec.spacing[0];
                    let y = spec.origin[1] + j as f64 * spec.spacing[1];
                    let height = sampler.height_at(x, y).unwrap();
                    assert_eq!(height, Some(hills(i, j).into()), "post ({i}, {j})");
                }
            }
        });
    }

    #[test]
    fn between_posts_the_surface_is_bilinear_and_ends_at_the_last_one() {
        let ground =
            Ground::new().heights(height_layer([3, 2]), |i, j| (i * 10 + j * 7 * i) as f32);
        with_store(ground, |store| {
            let at = |x, y| height_at(store, x, y).unwrap();
            assert_eq!(at(5.0, 5.0), Some(6.75));
            assert_eq!(at(20.0, 10.0), Some(34.0));
            assert_eq!(at(20.000_001, 10.0), None);
            assert_eq!(at(-1e-9, 0.0), None);
            assert_eq!(at(f64::NAN, 0.0), None);
            assert_eq!(at(0.0, f64::INFINITY), None);
            assert_eq!(at(f64::MAX, f64::MIN), None);
        });
    }

    #[test]
    fn a_void_takes_the_cells_around_it_but_not_their_other_edges() {
        let ground = Ground::new()
            .heights(height_layer([4, 4]), |i, j| if (i, j) == (1, 1) { f32::NAN } else { 5.0 });
        with_store(ground, |store| {
            let at = |x, y| height_at(store, x, y).unwrap();
            assert_eq!(at(10.0, 10.0), None, "the void itself");
            assert_eq!(at(19.9, 19.9), None, "inside a cell of it");
            assert_eq!(at(10.0, 5.0), None, "on an edge to it");
            assert_eq!(at(0.0, 5.0), Some(5.0), "on the far edge of such a cell");
            assert_eq!(at(20.0, 10.0), Some(5.0), "on its neighbour");
            assert_eq!(at(20.0, 15.0), Some(5.0), "on an edge that does not touch it");
            assert_eq!(at(25.0, 25.0), Some(5.0), "in a cell that does not touch it");
        });
    }

    #[test]
    fn insets_lie_on_top_and_their_voids_show_what_is_below() {
        let inset = LayerSpec { origin: [20.0, 20.0], spacing: [1.0; 2], ..height_layer([11, 11]) };
        let ground = Ground::new()
            .heights(inset, |i, j| if i > 7 && j > 7 { f32::NAN } else { 50.0 })
            .heights(height_layer([9, 9]), |_, _| 1.0);
        with_store(ground, |store| {
            let at = |x, y| height_at(store, x, y).unwrap();
            assert_eq!(at(25.5, 25.5), Some(50.0));
            assert_eq!(at(20.0, 25.0), Some(50.0), "the border belongs to the inset");
            assert_eq!(at(19.999, 25.0), Some(1.0));
            assert_eq!(at(29.5, 29.5), Some(1.0), "through the void");
        });
    }

    #[test]
    fn a_line_of_posts_has_heights_on_the_line_alone() {
        with_store(Ground::new().heights(height_layer([1, 300]), hills), |store| {
            let at = |x, y| height_at(store, x, y).unwrap();
            let middle = (f64::from(hills(0, 260)) + f64::from(hills(0, 261))) / 2.0;
            assert_eq!(at(0.0, 2605.0), Some(middle));
            assert_eq!(at(0.1, 2605.0), None);
        });
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(8))]

        #[test]
        fn heights_are_continuous_across_tiles(points in prop::collection::vec((0.0..5990.0f64, 0.0..2990.0f64), 50)) {
            with_store(Ground::new().heights(height_layer([600, 300]), hills), |store| {
                let mut sampler = Sampler::new(store);
                for (x, y) in points {
                    for [x, y] in [[x, y], [2560.0 - 1e-7, y], [2560.0, y]] {
                        let (i, j) = ((x / 10.0) as u64, (y / 10.0) as u64);
                        let (u, v) = (x / 10.0 - i as f64, y / 10.0 - j as f64);
                        let post = |i, j| f64::from(hills(i, j));
                        let expected = (post(i, j) * (1.0 - u) + post(i + 1, j) * u) * (1.0 - v)
                            + (post(i, j + 1) * (1.0 - u) + post(i + 1, j + 1) * u) * v;
                        let height = sampler.height_at(x, y).unwrap().unwrap();
                        assert!((height - expected).abs() < 1e-9);
                    }
                }
            });
        }
    }
}
