//! The methods that trade accuracy for speed: which one a view gets, and what it sees.

use crate::View;
use crate::column::{self, Columns};
use crate::field::Field;
use crate::frustum;
use crate::lanes::{self, Width};
use crate::lod::Lod;
use crate::relief::{Lack, Relief};
use crate::seen::{Seen, Unfit};
use crate::voxel;
use terrafarm_common::quality::{self, Quality};
use terrafarm_common::region::Region;
use terrafarm_terrain::layout::{LayerKind, StoreIndex, TileKey};

/// The least tolerance for which lines a few pixels apart are worth their while; below it
/// every pixel has a ray of its own. Measured with `bench speed-accuracy`.
const LEAST_FOR_COLUMN_PX: f64 = 0.1;
/// The least tolerance that level of detail in single precision keeps.
const LEAST_FOR_LOD_PX: f64 = 0.02;
/// Posts of the finest level up to which `exact` is taken instead of `lod`. It is cheaper:
/// 1.3 to 2.7 times at the views of `bench core`, even at 1 px. But it looks at finest tiles
/// as far as it sees, and those of larger terrain would crowd a worker's cache.
const MOST_FOR_EXACT: u64 = 1 << 26;

/// How a view is looked at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Look {
    /// By `exact` or `reference`.
    RayByRay(quality::Method),
    Fast(Method),
}

/// One of the fast methods.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Method {
    Lod,
    Column,
    Frustum,
    Voxel,
}

impl Look {
    /// What a view asks for; `auto` takes the cheapest that its tolerance allows.
    pub(crate) fn of(field: Field, view: &View) -> Result<Look, Unfit> {
        let Quality { method, tolerance_px, .. } = view.quality;
        let why = unfit(field.index()).or(doubtful(field));
        let fast = |fast: Method| match why {
            None => Ok(Look::Fast(fast)),
            Some(why) => Err(Unfit { method, why: why.into(), instead: quality::Method::Exact }),
        };
        match method {
            quality::Method::Lod => fast(Method::Lod),
            quality::Method::Column => fast(Method::Column),
            quality::Method::Frustum => Ok(Look::Fast(Method::Frustum)),
            quality::Method::Voxel => Ok(Look::Fast(Method::Voxel)),
            quality::Method::Auto => match (cheapest(field.index(), tolerance_px), why) {
                (None, _) => Ok(Look::RayByRay(quality::Method::Exact)),
                (Some(method), None) => Ok(Look::Fast(method)),
                // Slow for ever is no answer to a store that can be mended.
                (Some(method), _) if why == doubtful(field) => fast(method),
                (Some(_), Some(_)) => Ok(Look::RayByRay(quality::Method::Exact)),
            },
            other => Ok(Look::RayByRay(other)),
        }
    }
}

/// The cheapest method that keeps a tolerance; `None` for `exact`.
fn cheapest(index: &StoreIndex, tolerance_px: f64) -> Option<Method> {
    let layers = index.layers_of(LayerKind::Height);
    let posts = layers.map(|(_, layer)| layer.posts[0].saturating_mul(layer.posts[1]));
    let posts = posts.fold(0, u64::saturating_add);
    if tolerance_px >= LEAST_FOR_COLUMN_PX {
        Some(Method::Column)
    } else if tolerance_px >= LEAST_FOR_LOD_PX && posts > MOST_FOR_EXACT {
        Some(Method::Lod)
    } else {
        None
    }
}

/// Why the fast methods cannot look at a store.
fn unfit(index: &StoreIndex) -> Option<&'static str> {
    let mut layers = index.layers_of(LayerKind::Height);
    match (layers.next(), layers.next()) {
        (None, _) => Some("the store has no heights"),
        (_, Some(_)) => Some("the store has insets, and it sees one height layer only"),
        (Some((_, layer)), None) if layer.posts.contains(&1) => {
            Some("the store has a single row of posts, so there is no ground to see")
        }
        _ => None,
    }
}

/// Why the levels of a store cannot be used.
fn doubtful(field: Field) -> Option<&'static str> {
    (!field.pyramid.deviations_hold).then_some(
        "the store does not say how far its coarser levels are from the finest, or says it \
         wrongly; make it again with \"terrafarm terrain import\" or \"terrafarm terrain synth\"",
    )
}

/// Sees a region. Also returns the tiles that were missing, sorted.
pub(crate) fn see(
    field: Field,
    view: &View,
    region: Region,
    method: Method,
    width: Width,
) -> Result<(Seen, Vec<TileKey>), Unfit> {
    see_with(field, view, region, method, width, Lack::Open)
}

/// The same, with a choice of what `lod` and `column` make of places without a tile. Of the
/// other methods they are open in any case.
pub(crate) fn see_with(
    field: Field,
    view: &View,
    region: Region,
    method: Method,
    width: Width,
    lack: Lack,
) -> Result<(Seen, Vec<TileKey>), Unfit> {
    match method {
        Method::Frustum => return frustum::see(field, view, region),
        Method::Voxel => return voxel::see(field, view, region),
        Method::Lod | Method::Column => {}
    }
    let tolerance_px = view.quality.tolerance_px;
    let share = if method == Method::Column { column::LEVELS } else { 1.0 };
    let relief = Relief::new(field, view, share * tolerance_px, lack);
    let (relief, camera) = (&relief, &view.camera);
    let mut seen = if method == Method::Column {
        lanes::run(Columns { relief, camera, tolerance_px, region }, width)
    } else {
        let slack = relief.tolerance;
        lanes::run(Lod { field, relief, view, region, slack }, width)
    };
    seen.coarser = relief.coarser_pixels(camera, region, &seen.inverse_depth);
    Ok((seen, relief.wanted()))
}

/// A view of which each pixel is one of so many samples along the side of a pixel, and
/// the region of it that covers a region.
pub(crate) fn supersampled(view: &View, region: Region, samples: u32) -> (View, Region) {
    let mut fine = view.clone();
    fine.camera.width *= samples;
    fine.camera.height *= samples;
    fine.quality.tolerance_px *= f64::from(samples);
    fine.quality.samples_per_side = 1;
    let Region { x, y, width, height } = region;
    let [x, y, width, height] = [x, y, width, height].map(|length| length * samples);
    (fine, Region { x, y, width, height })
}

#[cfg(test)]
mod tests;
