//! Which tiles a picture will need, from a few rays: for whoever fetches terrain early.
//!
//! [`scout`] looks through a camera with few, large pixels, but at the levels that the
//! picture itself would be made of: its tolerance shrinks with its pixels, and its colours
//! are filtered for the pixels of the picture. Where a tile is not loaded it goes on over
//! coarser ground. So it names most of what is missing at once, where the picture itself
//! would name what hides the rest first. It may miss what is narrower than its pixels, and
//! may name what a hill hides that is not loaded: it is a guess, and no pixel depends on it.

use crate::View;
use crate::fast::{self, Look};
use crate::field::Field;
use crate::pyramid::Pyramid;
use crate::shade::{At, Far, Places, Shader};
use crate::sight::{Unseen, depths, depths_at_hand};
use std::collections::BTreeSet;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::Resident;

/// Most rays across the picture. A tile is hundreds of pixels wide wherever it is seen, as
/// levels follow distance; what is narrow is far away and seen at a grazing angle.
const RAYS_ACROSS: u32 = 160;

/// Tolerance that no coarser level meets, pixels: for methods that see level 0 alone.
const FINEST_PX: f64 = 1e-9;

/// The tiles that a region of a view will probably need and that are not loaded, sorted.
/// Empty also if the method is not made for the view. Loaded tiles that it looks at count
/// as used.
pub fn scout(resident: &Resident, pyramid: &Pyramid, view: &View, region: Region) -> Vec<TileKey> {
    let field = Field { resident, pyramid };
    if field.is_below(view.camera.position) == Ok(true) {
        return Vec::new();
    }
    let times = view.camera.width.div_ceil(RAYS_ACROSS).max(1);
    let method = match Look::of(field, view) {
        Ok(Look::Fast(fast::Method::Column)) => Method::Column,
        _ => Method::Lod,
    };
    let (coarse, part) = coarsened(view, method, region, times);
    let seen = match depths_at_hand(resident, pyramid, &coarse, part) {
        // Insets are for the methods that wait for each tile.
        Err(Unseen::Unfit(_)) => {
            let quality = Quality { method: Method::Exact, ..coarse.quality };
            let coarse = View { quality, ..coarse.clone() };
            depths(resident, pyramid, &coarse, part).map(|depths| (depths, Vec::new()))
        }
        seen => seen.map(|seen| (seen.depths, seen.wanted)),
    };
    let (depths, wanted) = match seen {
        Ok(seen) => seen,
        Err(Unseen::Missing(tiles)) => return tiles,
        Err(Unseen::Unfit(_)) => return Vec::new(),
    };
    let mut wanted = BTreeSet::from_iter(wanted);
    let mut shader = Shader::new(field, &coarse.camera, &view.shading, 1);
    // Colours are those of the picture's samples.
    let samples = view.quality.samples_per_side.clamp(1, Quality::MAX_SAMPLES_PER_SIDE);
    shader.widen(1.0 / (times * samples) as f32);
    let x: Vec<f32> = (part.x..part.x + part.width).map(|x| x as f32 + 0.5).collect();
    let mut light = [0, 1, 2].map(|_| vec![0.0; x.len()]);
    for (row, inverse) in depths.inverse_depth.chunks_exact(x.len().max(1)).enumerate() {
        let y = (part.y + row as u32) as f32 + 0.5;
        let [red, green, blue] = &mut light;
        let places = Places { at: At::Net(&x, &[y]), far: Far::Inverse(inverse) };
        shader.shade(places, [red, green, blue]);
    }
    shader.wanted.drain_into(&mut wanted);
    wanted.into_iter().collect()
}

/// The same picture of pixels that are so many times as wide, made of the same levels by a
/// method that goes on over coarser ones, and the region of it that covers a region.
fn coarsened(view: &View, method: Method, region: Region, times: u32) -> (View, Region) {
    let mut coarse = view.clone();
    let camera = &mut coarse.camera;
    // The pixels beyond the right and lower edge of the picture belong to its last ones.
    let widened = f64::from(camera.width.div_ceil(times) * times) / f64::from(camera.width);
    camera.tan_half_hfov *= widened;
    camera.width = camera.width.div_ceil(times);
    camera.height = camera.height.div_ceil(times);
    let tolerance_px = match view.quality.method {
        asked if asked.reads_tolerance() => view.quality.tolerance_px / f64::from(times),
        _ => FINEST_PX,
    };
    coarse.quality = Quality { method, samples_per_side: 1, tolerance_px };
    let (left, top) = (region.x / times, region.y / times);
    let right = (region.x + region.width).div_ceil(times).min(camera.width);
    let bottom = (region.y + region.height).div_ceil(times).min(camera.height);
    (coarse, Region { x: left, y: top, width: right - left, height: bottom - top })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Progress;
    use crate::tests_support::{Plan, mountains, store};
    use glam::DVec3;
    use terrafarm_common::camera::Camera;
    use terrafarm_common::shading::{Shading, Sky, Sun};

    /// 8 x 8 tiles of mountains, a photo over them.
    fn plans() -> Vec<Plan> {
        let side = 2049;
        let heights =
            Plan::heights([0.0; 2], [10.0; 2], [side, side], |i, j| mountains(i, j, 512, 900.0, 3));
        let photo = Plan::photo([0.0; 2], [20.0; 2], [1025, 1025], |i, j| {
            [(i % 7) as f32 / 7.0, (j % 5) as f32 / 5.0, 0.5, 1.0]
        });
        vec![heights, photo]
    }

    fn view(method: Method) -> View {
        let position = DVec3::new(9000.0, 3000.0, 1600.0);
        let camera = Camera::from_angles(position, 20.0, -14.0, 5.0, 60.0, (640, 360));
        let shading = Shading {
            sun: Some(Sun::at(120.0, 40.0, 0.3, 1.0)),
            haze: None,
            sky: Sky::default(),
            earth: None,
            below_ground: [0.1; 3],
            bare_ground: None,
        };
        View { camera, shading, quality: Quality { method, ..Quality::default() } }
    }

    /// Tiles that a picture asks for until it is done.
    fn needed(
        tiles: &[(TileKey, terrafarm_terrain::resident::Tile)],
        resident: &mut Resident,
        pyramid: &Pyramid,
        view: &View,
    ) -> BTreeSet<TileKey> {
        let mut progress = Progress::new(Region::whole(640, 360));
        let mut needed = BTreeSet::new();
        loop {
            let missing = progress.advance(resident, pyramid, view).expect("it fits");
            if missing.is_empty() {
                return needed;
            }
            load(tiles, resident, &missing);
            needed.extend(missing);
        }
    }

    fn load(
        tiles: &[(TileKey, terrafarm_terrain::resident::Tile)],
        resident: &mut Resident,
        keys: &[TileKey],
    ) {
        for key in keys {
            let (_, tile) = tiles.iter().find(|(other, _)| other == key).expect("a tile");
            assert!(resident.insert(*key, tile.clone()));
        }
    }

    #[test]
    fn it_names_most_of_what_the_picture_will_need_and_little_else() {
        let (empty, tiles) = store(plans());
        let pyramid = Pyramid::new(empty.index());
        for method in [Method::Auto, Method::Lod, Method::Column, Method::Exact] {
            let view = view(method);
            let mut alone = empty.clone();
            load(&tiles, &mut alone, &empty.index().roots());
            let mut scouted = alone.clone();
            let needed = needed(&tiles, &mut alone, &pyramid, &view);
            let mut named = BTreeSet::new();
            loop {
                let more = scout(&scouted, &pyramid, &view, Region::whole(640, 360));
                if more.is_empty() {
                    break;
                }
                load(&tiles, &mut scouted, &more);
                named.extend(more);
            }
            let found = needed.intersection(&named).count();
            println!("{method}: {} needed, {} named, {found} right", needed.len(), named.len());
            assert!(found * 10 >= needed.len() * 9, "{method}: {found} of {}", needed.len());
            assert!(named.len() * 2 <= needed.len() * 3 + 8, "{method}: {}", named.len());
        }
    }

    #[test]
    fn a_part_names_what_the_part_needs() {
        let (mut resident, tiles) = store(plans());
        let pyramid = Pyramid::new(resident.index());
        let roots = resident.index().roots();
        load(&tiles, &mut resident, &roots);
        let view = view(Method::Auto);
        let whole = scout(&resident, &pyramid, &view, Region::whole(640, 360));
        let part = Region { x: 0, y: 0, width: 80, height: 360 };
        let part = scout(&resident, &pyramid, &view, part);
        assert!(!part.is_empty() && part.len() * 2 < whole.len());
        assert!(part.iter().filter(|key| !whole.contains(key)).count() <= part.len() / 4);
    }

    #[test]
    fn without_any_tile_it_names_what_to_begin_with() {
        let (resident, _) = store(plans());
        let pyramid = Pyramid::new(resident.index());
        let named = scout(&resident, &pyramid, &view(Method::Auto), Region::whole(640, 360));
        assert!(!named.is_empty());
    }
}
