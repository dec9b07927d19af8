#![allow(clippy::unwrap_used)]
use super::*;
use crate::meter::measure;
use crate::oracle::{Dice, bare, count};
use crate::tests_support::{Plan, mountains, noise, store};
use crate::{cast, depths, render};
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::shading::{Shading, Sky, Sun};
use terrafarm_terrain::resident::Tile;

const SIZE: (u32, u32) = (90, 60);

/// Hills under a photo, lit from the side, seen to a wide horizon.
fn view(pyramid: &Pyramid, method: Method) -> View {
    let eye = DVec3::new(900.0, 400.0, pyramid.highest() + 200.0);
    let shading = Shading {
        sun: Some(Sun::at(300.0, 30.0, 0.3, 0.8)),
        haze: None,
        sky: Sky::default(),
        earth: None,
        below_ground: [1.0, 0.0, 0.0],
        bare_ground: None,
    };
    let camera = Camera::from_angles(eye, 30.0, -20.0, 0.0, 60.0, SIZE);
    let quality = Quality { method, tolerance_px: 0.5, ..Quality::default() };
    View { camera, shading, quality }
}

fn plans() -> Vec<Plan> {
    let height = |i, j| mountains(i, j, 512, 300.0, 5) * 0.6;
    let color = |i, j| [0.2 + 0.5 * noise(i, j, 9), 0.4, 0.3 + 0.2 * noise(i / 9, j / 9, 2), 1.0];
    vec![
        Plan::heights([0.0; 2], [10.0; 2], [900, 800], height),
        Plan::photo([0.0; 2], [8.0; 2], [1120, 1000], color),
    ]
}

#[test]
fn a_glimpse_has_no_holes_and_is_the_picture_when_nothing_is_missing() {
    let (empty, tiles) = store(plans());
    let pyramid = Pyramid::new(empty.index());
    let roots = empty.index().roots();
    assert_eq!(roots.len(), 2);
    let mut resident = empty.clone();
    for (key, tile) in &tiles {
        resident.insert(*key, tile.clone());
    }
    let whole = Region::whole(SIZE.0, SIZE.1);
    for method in [Method::Lod, Method::Column] {
        let view = view(&pyramid, method);
        let truth = render(&resident, &pyramid, &view, whole).unwrap();
        let full = render_at_hand(&resident, &pyramid, &view, whole).unwrap();
        assert!(truth.missing.is_empty() && !full.is_degraded());
        assert_eq!((full.coarser_ground, full.coarser_color, full.holes), (0, 0, 0));
        assert!(full.pixels == truth.pixels, "{method}: other pixels");
        let mut dice = Dice::new(4);
        let mut last = 0.0;
        for share in [0.2, 0.6, 1.0] {
            let mut some = resident.clone();
            for (key, _) in tiles.iter().filter(|(key, _)| !roots.contains(key)) {
                if dice.between(0.0, 1.0) < share {
                    some.remove(*key);
                }
            }
            let seen = render_at_hand(&some, &pyramid, &view, whole).unwrap();
            assert!(seen.is_degraded() && seen.holes == 0, "{method} {share}");
            assert!(seen.coarser_color > 0 && seen.wanted.is_sorted(), "{method} {share}");
            let off = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b)).powi(2);
            let sum: f64 = seen.pixels.iter().zip(&truth.pixels).map(off).sum();
            let error = (sum / truth.pixels.len() as f64).sqrt();
            assert!(error >= last && error < 60.0, "{method} {share}: {error} after {last}");
            last = error;
        }
        assert!(last > 1.0, "{method}: nothing was missing");
    }
}

#[test]
fn what_has_no_level_at_all_is_told() {
    let (empty, tiles) = store(plans());
    let pyramid = Pyramid::new(empty.index());
    let view = view(&pyramid, Method::Lod);
    let whole = Region::whole(SIZE.0, SIZE.1);
    assert!(render_at_hand(&empty, &pyramid, &view, whole).is_err());
    let mut heights = empty.clone();
    for (key, tile) in tiles.iter().filter(|(key, _)| key.layer == 0) {
        heights.insert(*key, tile.clone());
    }
    let seen = render_at_hand(&heights, &pyramid, &view, whole).unwrap();
    assert_eq!(seen.coarser_ground, 0);
    assert!(seen.holes > 0 && seen.wanted.iter().all(|key| key.layer == 1), "{seen:?}");
}

#[test]
fn a_camera_below_ground_sees_its_colour() {
    let (empty, tiles) = store(plans());
    let pyramid = Pyramid::new(empty.index());
    let mut resident = empty;
    for (key, tile) in tiles {
        resident.insert(key, tile);
    }
    let mut view = view(&pyramid, Method::Column);
    view.camera.position.z = pyramid.lowest() - 50.0;
    let whole = Region::whole(SIZE.0, SIZE.1);
    let seen = render_at_hand(&resident, &pyramid, &view, whole).unwrap();
    assert!(seen.pixels.chunks_exact(3).all(|pixel| pixel == [255, 0, 0]));
}

/// A land of hills without its tiles, these, and its maxima.
fn unloaded() -> (Resident, Vec<(TileKey, Tile)>, Pyramid) {
    let height = |i, j| mountains(i, j, 512, 300.0, 21) * 0.6;
    let (empty, tiles) = store(vec![Plan::heights([0.0; 2], [10.0; 2], [1100, 900], height)]);
    let pyramid = Pyramid::new(empty.index());
    (empty, tiles, pyramid)
}

/// A view over it, at half a pixel and without light.
fn view_over(pyramid: &Pyramid, method: Method) -> View {
    let eye = DVec3::new(2000.0, 300.0, pyramid.highest() + 100.0);
    let camera = Camera::from_angles(eye, 20.0, -15.0, 0.0, 60.0, SIZE);
    let quality = Quality { method, tolerance_px: 0.5, ..Quality::default() };
    View { camera, shading: bare(None), quality }
}

#[test]
fn a_picture_that_cannot_wait_has_no_holes_and_tells_what_is_coarser() {
    let (empty, tiles, pyramid) = unloaded();
    let roots = empty.index().roots();
    let whole = Region::whole(SIZE.0, SIZE.1);
    for method in [Method::Lod, Method::Column] {
        let view = view_over(&pyramid, method);
        let mut resident = empty.clone();
        let nothing = depths_at_hand(&resident, &pyramid, &view, whole);
        assert!(matches!(nothing, Err(Unseen::Missing(keys)) if !keys.is_empty()), "{method}");
        for (key, tile) in &tiles {
            resident.insert(*key, tile.clone());
        }
        let truth = depths(&resident, &pyramid, &view, whole).unwrap();
        let full = depths_at_hand(&resident, &pyramid, &view, whole).unwrap();
        assert!(!full.is_degraded() && full.coarser == 0, "{method}");
        assert_eq!(bits(&full.depths.inverse_depth), bits(&truth.inverse_depth), "{method}");
        assert_eq!(full.depths, truth);

        let mut dice = Dice::new(77);
        let mut degraded = 0;
        for round in 0..count(30) {
            let mut some = resident.clone();
            let share = round as f64 / count(30) as f64;
            for (key, _) in tiles.iter().filter(|(key, _)| !roots.contains(key)) {
                if dice.between(0.0, 1.0) < share {
                    some.remove(*key);
                }
            }
            let seen = depths_at_hand(&some, &pyramid, &view, whole).unwrap();
            let said = format!("{method}, {share} of the tiles are missing");
            assert!(seen.depths.inverse_depth.iter().all(|inverse| *inverse >= 0.0), "{said}");
            match depths(&some, &pyramid, &view, whole) {
                Ok(waited) => {
                    assert!(!seen.is_degraded() && seen.coarser == 0, "{said}");
                    assert_eq!(seen.depths, waited, "{said}");
                }
                Err(Unseen::Missing(_)) => {
                    degraded += 1;
                    assert!(seen.is_degraded(), "{said}");
                    // A plot that lacks no more than the tile it is blended with is seen as it
                    // is: otherwise, and not coarser.
                    let differing = bits(&seen.depths.inverse_depth)
                        .into_iter()
                        .zip(bits(&truth.inverse_depth))
                        .zip(whole.pixels())
                        .filter(|((a, b), _)| a != b && seen.coarser == 0);
                    for (_, [x, y]) in differing {
                        let claimed = seen.depths.distance_m(&view, x, y);
                        let error = measure(&resident, &pyramid, &view, x, y, claimed).unwrap();
                        let allowed = view.quality.tolerance_px + 0.02;
                        assert!(error.surface_px <= allowed, "{said}: {x} {y} {error:?}");
                    }
                }
                Err(Unseen::Unfit(unfit)) => panic!("{unfit}"),
            }
        }
        assert!(degraded > count(30) / 2, "{method}: {degraded}");
    }
}

#[test]
fn the_error_grows_with_the_levels_that_are_missing_and_stays_within_theirs() {
    let (empty, tiles, pyramid) = unloaded();
    let whole = Region::whole(SIZE.0, SIZE.1);
    let mut resident = empty.clone();
    for (key, tile) in &tiles {
        resident.insert(*key, tile.clone());
    }
    let layer = &empty.index().layers[0];
    for method in [Method::Lod, Method::Column] {
        let view = view_over(&pyramid, method);
        let mut some = resident.clone();
        let mut means: Vec<f64> = Vec::new();
        for level in 0..=layer.root_level() {
            let seen = depths_at_hand(&some, &pyramid, &view, whole).unwrap();
            assert_eq!(seen.coarser > 0, level > 0, "{method}, level {level}");
            let entries = layer.levels[..=level].iter().flat_map(|level| &level.entries);
            let deviation = entries.map(|entry| f64::from(entry.deviation)).fold(0.0, f64::max);
            let mut sum = 0.0;
            let mut pixels = 0;
            for [x, y] in whole.pixels().step_by(7) {
                let claimed = seen.depths.distance_m(&view, x, y);
                if claimed.is_infinite() || on_a_wall(&resident, &pyramid, &view, x, y) {
                    continue;
                }
                let error = measure(&resident, &pyramid, &view, x, y, claimed).unwrap();
                // The level's own deviation where that is more than was asked for.
                let most = deviation / claimed * view.camera.focal_px();
                let allowed = most.max(view.quality.tolerance_px) + 0.02;
                let said = format!("{method}, level {level}, {x} {y}: {error:?}, {allowed}");
                assert!(error.surface_px <= allowed, "{said}");
                sum += error.surface_px;
                pixels += 1;
            }
            assert!(pixels > 100, "{method} {level}: {pixels}");
            means.push(sum / f64::from(pixels));
            for (key, _) in tiles.iter().filter(|(key, _)| usize::from(key.level) == level) {
                some.remove(*key);
            }
        }
        let grows = means.windows(2).all(|pair| pair[1] > 0.9 * pair[0]);
        assert!(grows && means.last() > means.first(), "{method}: {means:?}");
    }
}

/// Whether the exact ray meets a wall: the rim of the land, which is no height above any
/// place.
fn on_a_wall(resident: &Resident, pyramid: &Pyramid, view: &View, x: u32, y: u32) -> bool {
    let quality = Quality { method: Method::Exact, ..view.quality };
    let exact = View { quality, ..view.clone() };
    let hit = cast(resident, pyramid, &exact, f64::from(x) + 0.5, f64::from(y) + 0.5).unwrap();
    hit.is_some_and(|hit| hit.height > hit.position.z + 1e-6)
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}
