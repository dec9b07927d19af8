#![allow(clippy::unwrap_used)]
use super::*;
use crate::oracle::{Dice, Land, bare, count, lands};
use crate::tests_support::{Plan, store};
use crate::{cast, depths};
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Region;
use terrafarm_common::shading::Earth;

const EARTH: Earth = Earth { radius_m: 6_371_000.0, refraction: 0.13 };
/// Width and height, odd: a pixel's centre is that of the picture.
const SIZE: (u32, u32) = (1921, 1081);
const MIDDLE: (u32, u32) = (960, 540);

fn view(camera: Camera, earth: Option<Earth>) -> View {
    View { camera, shading: bare(earth), quality: Quality::default() }
}

/// Looks north from a height, down by an angle.
fn looking(height: f64, down_deg: f64) -> Camera {
    Camera::from_angles(DVec3::new(500.0, 0.5, height), 0.0, -down_deg, 0.0, 60.0, SIZE)
}

fn gauge(land: &Land, view: &View, (x, y): (u32, u32), claimed: f64) -> PixelError {
    measure(&land.resident, &land.pyramid, view, x, y, claimed).expect("all tiles are loaded")
}

/// Ground 1 km wide and 4 km long, at 0 but for a ridge `top` high 1 km to the north. Ends
/// at the ridge if nothing is `behind`.
fn ridge(top: f32, behind: bool) -> Land {
    let posts = [101, if behind { 401 } else { 102 }];
    let height = move |_, j| if j == 100 { top } else { 0.0 };
    Land::new("ridge", vec![Plan::heights([0.0, 0.0], [10.0, 10.0], posts, height)])
}

/// By how many pixels the middle ray is to be raised to touch the ridge's top.
fn below_top(camera: &Camera, top: f64) -> f64 {
    let slope = (top - camera.position.z) / (1000.0 - camera.position.y);
    let forward = camera.forward;
    camera.focal_px() * (slope * forward.y - forward.z)
}

#[test]
fn answers_of_exact_itself_have_no_error() {
    let mut dice = Dice::new(5);
    let (mut ground, mut sky) = (0, 0);
    for land in lands() {
        let layer = &land.resident.index().layers[0];
        let (low, far) = (layer.origin, layer.far_corner());
        for round in 0..count(12) {
            let at = |dice: &mut Dice, axis: usize| {
                let room = 0.3 * (far[axis] - low[axis]);
                dice.between(low[axis] - room, far[axis] + room)
            };
            let height = dice.between(land.pyramid.lowest(), land.pyramid.highest() + 30.0);
            let position = DVec3::new(at(&mut dice, 0), at(&mut dice, 1), height);
            let pitch = [0.0, -3.0, -25.0, -90.0][dice.below(4) as usize];
            let (heading, roll) = (90.0 * dice.below(8) as f64 / 2.0, dice.between(-180.0, 180.0));
            let camera = Camera::from_angles(position, heading, pitch, roll, 75.0, (48, 36));
            let view = view(camera, (round % 2 == 1).then_some(EARTH));
            let region = Region::whole(48, 36);
            let single = depths(&land.resident, &land.pyramid, &view, region).unwrap();
            for [x, y] in region.pixels() {
                let centre = [f64::from(x) + 0.5, f64::from(y) + 0.5];
                let hit = land.look(&view, centre);
                let double = hit.map_or(f64::INFINITY, |hit| hit.distance_m);
                *(if hit.is_some() { &mut ground } else { &mut sky }) += 1;
                for claimed in [double, single.distance_m(&view, x, y)] {
                    let error = gauge(&land, &view, (x, y), claimed);
                    let said = format!("{} {camera:?} {x} {y} {claimed}: {error:?}", land.name);
                    assert!(error.error_px() <= 1e-6 && !error.mismatch, "{said}");
                    let depth = error.depth_m.unwrap_or(0.0).abs();
                    // One over it in single precision, and what a span's parabola is off.
                    assert!(depth <= 2.4e-7 * double.min(1e9) + 1e-6, "{said}");
                    assert_eq!(error.depth_m.is_some(), hit.is_some(), "{said}");
                }
            }
        }
    }
    assert!(ground > 20_000 && sky > 20_000, "{ground} {sky}");
}

#[test]
fn a_little_off_is_a_little_wrong() {
    let mut dice = Dice::new(6);
    let mut measured = 0;
    for land in lands().iter().filter(|land| ["smooth", "tiles"].contains(&land.name)) {
        for _ in 0..count(30) {
            let [x, y] = [0, 1].map(|_| dice.between(0.0, 30.0));
            let position = DVec3::new(x, y, land.pyramid.highest() + dice.between(0.1, 30.0));
            let camera = Camera::from_angles(position, 45.0, -30.0, 0.0, 60.0, (48, 36));
            let view = view(camera, Some(EARTH));
            let (x, y) = (dice.below(48) as u32, dice.below(36) as u32);
            let Some(hit) = land.look(&view, [f64::from(x) + 0.5, f64::from(y) + 0.5]) else {
                continue;
            };
            for share in [-1e-5, -1e-6, 1e-6, 1e-5] {
                let error = gauge(land, &view, (x, y), hit.distance_m * (1.0 + share));
                // A slope of 60 at most.
                assert!(error.error_px() < camera.focal_px() * share.abs() * 60.0, "{error:?}");
                assert!(error.surface_px > 0.0, "{error:?}");
                measured += 1;
            }
        }
    }
    assert!(measured > 100, "{measured}");
}

#[test]
fn a_known_error_in_height_is_that_many_pixels() {
    let land = ridge(0.0, true);
    let camera = looking(100.0, 7.0);
    let view = view(camera, None);
    for (x, y) in [MIDDLE, (960, 700), (700, 1000)] {
        let ray = camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let sine = -ray.z / ray.length();
        for off in [-30.0, -1.0, 1e-3, 1.0, 30.0] {
            let claimed = (100.0 - off) / sine;
            let expected = (f64::abs(off) * camera.focal_px() / claimed).min(ERROR_MAX_PX);
            let error = gauge(&land, &view, (x, y), claimed);
            assert!((error.surface_px - expected).abs() < 1e-6, "{off}: {error:?}, {expected}");
            assert_eq!(error.occlusion_px, 0.0);
            assert!((error.depth_m.unwrap() + off / sine).abs() < 1e-6);
            assert!(error.mismatch || off.abs() < 10.0);
        }
    }
}

#[test]
fn over_a_round_earth_the_height_is_that_of_the_triangle_in_space() {
    let sea = Plan::heights([-1e5, -1e4], [1e4, 1e4], [21, 41], |_, _| 0.0);
    let land = Land::new("sea", vec![sea]);
    let camera = Camera::from_angles(DVec3::Z * 3000.0, 0.0, -1.75, 0.0, 60.0, SIZE);
    let view = view(camera, Some(EARTH));
    let hit = land.look(&view, [960.5, 540.5]).unwrap();
    assert!(hit.distance_m > 100_000.0);
    for share in [0.9, 0.99, 1.01, 1.1] {
        let claimed = hit.distance_m * share;
        let to_centre = EARTH.effective_radius_m() + 3000.0;
        let square = to_centre * to_centre
            + claimed * claimed
            + 2.0 * to_centre * claimed * camera.forward.z;
        let height = square.sqrt() - EARTH.effective_radius_m();
        let expected = height.abs() * camera.focal_px() / claimed;
        let error = gauge(&land, &view, MIDDLE, claimed);
        assert!((error.surface_px - expected).abs() < 1e-5, "{share}: {error:?}, {expected}");
        assert_eq!(error.occlusion_px, 0.0, "{share}");
    }
}

#[test]
fn a_ridge_that_is_ignored_counts_by_what_it_hides() {
    let camera = looking(100.0, 2.6);
    let through = 100.0 / 2.6f64.to_radians().sin();
    for earth in [None, Some(EARTH)] {
        for roll in [0.0, 90.0, 217.0] {
            let camera = Camera::from_angles(camera.position, 0.0, -2.6, roll, 60.0, SIZE);
            for top in [55.0f32, 57.0, 60.0, 75.0] {
                let land = ridge(top, true);
                let flat = ridge(0.0, true);
                let view = view(camera, earth);
                let claimed = flat.look(&view, [960.5, 540.5]).unwrap().distance_m;
                assert!((claimed - through).abs() < 50.0);
                let drop = earth.map_or(0.0, |earth| 0.5e6 / earth.effective_radius_m());
                let expected = below_top(&camera, f64::from(top) - drop);
                let error = gauge(&land, &view, MIDDLE, claimed);
                let off = error.occlusion_px - expected;
                let slack = if earth.is_some() { 0.01 } else { 1e-9 };
                assert!((-slack..=STEP_PX + slack).contains(&off), "{error:?}, not {expected}");
                assert_eq!(error.surface_px, 0.0);
                assert!(error.mismatch && error.depth_m.unwrap() > 1000.0);
            }
        }
    }
}

#[test]
fn what_the_error_in_height_explains_is_no_occlusion() {
    let land = ridge(0.0, true);
    // Nearly along the ground: a little too deep is far too distant.
    let view = view(looking(10.0, 0.4), None);
    let truth = land.look(&view, [960.5, 540.5]).unwrap().distance_m;
    let error = gauge(&land, &view, MIDDLE, truth * 1.3);
    assert!(error.surface_px > 1.0 && error.occlusion_px == 0.0, "{error:?}");
}

#[test]
fn sky_in_place_of_ground_counts_to_the_horizon() {
    for top in [55.0f32, 57.0, 60.0, 75.0] {
        let land = ridge(top, false);
        let camera = looking(100.0, 2.6);
        let error = gauge(&land, &view(camera, None), MIDDLE, f64::INFINITY);
        let off = error.occlusion_px - below_top(&camera, f64::from(top));
        assert!((-1e-9..=STEP_PX + 1e-9).contains(&off), "{error:?}");
        assert_eq!((error.surface_px, error.depth_m, error.mismatch), (0.0, None, true));
    }
    let land = ridge(5000.0, false);
    let error = gauge(&land, &view(looking(100.0, 2.6), None), MIDDLE, f64::INFINITY);
    assert_eq!(error.occlusion_px, ERROR_MAX_PX);
}

#[test]
fn ground_in_place_of_sky_counts_by_its_height_above_the_ground() {
    let land = ridge(0.0, true);
    let camera = looking(20.0, 0.0);
    let error = gauge(&land, &view(camera, None), MIDDLE, 2000.0);
    assert!((error.surface_px - 20.0 * camera.focal_px() / 2000.0).abs() < 1e-6, "{error:?}");
    assert_eq!((error.occlusion_px, error.depth_m, error.mismatch), (0.0, None, true));
}

#[test]
fn answers_that_make_no_sense_are_as_wrong_as_can_be() {
    let land = ridge(0.0, true);
    let seen = view(looking(100.0, 7.0), None);
    for claimed in [f64::NAN, -1.0, 0.0, 1e8, 1e300] {
        let error = gauge(&land, &seen, MIDDLE, claimed);
        assert_eq!((error.error_px(), error.mismatch), (ERROR_MAX_PX, true), "{claimed}");
    }
    let buried = view(looking(-5.0, 7.0), None);
    assert_eq!(gauge(&land, &buried, MIDDLE, 0.0).error_px(), 0.0);
    assert_eq!(gauge(&land, &buried, MIDDLE, 7.0).error_px(), ERROR_MAX_PX);
    assert_eq!(gauge(&land, &buried, MIDDLE, f64::INFINITY).error_px(), ERROR_MAX_PX);
    let straight_down = view(looking(100.0, 90.0), None);
    let error = gauge(&land, &straight_down, MIDDLE, 101.0);
    assert!((error.error_px() - straight_down.camera.focal_px() / 101.0).abs() < 1e-6);
}

#[test]
fn a_measurement_names_the_tiles_it_waits_for_until_it_has_them() {
    let plan = Plan::heights([0.0, 0.0], [10.0, 10.0], [601, 601], |i, j| ((i + j) % 7) as f32);
    let (mut resident, tiles) = store(vec![plan]);
    let pyramid = Pyramid::new(resident.index());
    let view = view(looking(100.0, 1.5), None);
    let mut rounds = 0;
    let error = loop {
        match measure(&resident, &pyramid, &view, MIDDLE.0, MIDDLE.1, 5000.0) {
            Ok(error) => break error,
            Err(Missing(keys)) => {
                assert!(!keys.is_empty() && rounds < 20);
                rounds += 1;
                for (key, tile) in &tiles {
                    if keys.contains(key) {
                        assert!(resident.insert(*key, tile.clone()));
                    }
                }
            }
        }
    };
    assert!(rounds > 0 && error.error_px() > 0.0);
    let hit = cast(&resident, &pyramid, &view, 960.5, 540.5).unwrap().unwrap();
    assert!((error.depth_m.unwrap() - (5000.0 - hit.distance_m)).abs() < 1e-9);
}
