//! Whole pictures: the same for any split and any order of tiles, and from everywhere.

use super::{Dice, Land, bare};
use crate::tests_support::{Plan, keys, mountains, noise, store};
use crate::{Progress, View};
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::{Region, columns, tiles};
use terrafarm_common::shading::{Earth, Haze, Shading, Sun};
use terrafarm_terrain::layout::TileKey;

const SIZE: (u32, u32) = (96, 54);
/// Where the slow method has to cast every ray, too.
const SMALL: (u32, u32) = (40, 23);
/// South-west post of the land; UTM coordinates are as large.
const CORNER: [f64; 2] = [562_000.0, 5_117_000.0];
const STEP_M: f64 = 20.0;

fn height(i: u64, j: u64) -> f32 {
    800.0 + mountains(i, j, 128, 300.0, 7)
}

fn land(corner: [f64; 2]) -> Land {
    Land::new("hills", plans(corner))
}

/// Hills with a finer inset, a hole, and a photo over most of it.
fn plans(corner: [f64; 2]) -> Vec<Plan> {
    let hills = |i: u64, j: u64| {
        let hole = (300..320).contains(&i) && (300..310).contains(&j);
        if hole { f32::NAN } else { height(i, j) }
    };
    let inset = [corner[0] + 1500.0, corner[1] + 1500.0];
    let photo = |i: u64, j: u64| {
        let green = 0.3 + 0.25 * noise(i / 2, j / 2, 12);
        [0.5 * green, green, 0.3 * green, 1.0]
    };
    vec![
        Plan::heights(corner, [STEP_M; 2], [560, 540], hills),
        Plan::heights(inset, [5.0; 2], [200, 200], |i, j| {
            height(75 + i / 4, 75 + j / 4) + noise(i, j, 4)
        }),
        Plan::photo(corner, [10.0; 2], [900, 1000], photo),
    ]
}

fn shading() -> Shading {
    let haze = Haze { visibility_m: 30_000.0, scale_height_m: 1500.0, color: [0.6, 0.7, 0.8] };
    let earth = Earth { radius_m: 6_371_000.0, refraction: 0.13 };
    Shading { sun: Some(Sun::at(130.0, 30.0, 0.25, 0.8)), haze: Some(haze), ..bare(Some(earth)) }
}

/// A view over the land from `above` the highest point of it.
fn view(land: &Land, samples_per_side: u32) -> View {
    let at = DVec3::new(CORNER[0] + 900.0, CORNER[1] + 700.0, land.pyramid.highest() - 150.0);
    View {
        camera: Camera::from_angles(at, 40.0, -12.0, 5.0, 60.0, SIZE),
        shading: shading(),
        quality: Quality { samples_per_side, ..Quality::default() },
    }
}

/// Renders region by region and puts the frame together.
fn in_parts(land: &Land, view: &View, regions: &[Region]) -> Vec<u8> {
    let mut frame = vec![0; (SIZE.0 * SIZE.1 * 3) as usize];
    for &region in regions {
        let part = land.render(view, region).pixels;
        for (row, pixels) in part.chunks_exact(region.width as usize * 3).enumerate() {
            let at = ((region.y as usize + row) * SIZE.0 as usize + region.x as usize) * 3;
            frame[at..at + pixels.len()].copy_from_slice(pixels);
        }
    }
    frame
}

fn whole(land: &Land, view: &View) -> Vec<u8> {
    land.render(view, Region::whole(SIZE.0, SIZE.1)).pixels
}

#[test]
fn a_frame_is_the_same_for_any_split() {
    let land = land(CORNER);
    let view = view(&land, 2);
    let frame = whole(&land, &view);
    let (width, height) = SIZE;
    let single: Vec<u32> = (1..width).collect();
    let splits = [
        columns(width, height, &[1, 2, 17, 50]),
        columns(width, height, &single),
        tiles(width, height, 1),
        tiles(width, height, 7),
        tiles(width, height, 16),
        tiles(width, height, 33),
    ];
    for regions in splits {
        assert!(in_parts(&land, &view, &regions) == frame, "{} parts", regions.len());
    }
}

#[test]
fn a_frame_is_the_same_whatever_the_order_in_which_tiles_come() {
    let land = land(CORNER);
    let view = view(&land, 1);
    let frame = whole(&land, &view);
    let (bare, tiles) = store(plans(CORNER));
    assert!(tiles.iter().map(|(key, _)| *key).eq(keys(bare.index())));
    for order in 0..6 {
        let mut dice = Dice::new(77_000 + 1000 * order);
        let mut resident = bare.clone();
        let mut progress = Progress::new(Region::whole(SIZE.0, SIZE.1));
        let mut rounds = 0;
        let mut given: Vec<TileKey> = Vec::new();
        while !progress.is_done() {
            let missing = progress.advance(&resident, &land.pyramid, &view).expect("exact fits");
            assert_eq!(missing.is_empty(), progress.is_done());
            if missing.is_empty() {
                break;
            }
            // One of the missing, or each with a chance; and in some orders nothing stays
            // in memory for long, or what nobody asked for is there.
            let chosen = missing[dice.below(missing.len() as u64) as usize];
            let wanted = |dice: &mut Dice, key: &TileKey| {
                *key == chosen
                    || missing.contains(key) && order > 1 && dice.below(2) == 0
                    || order == 5 && dice.below(9) == 0
            };
            for (key, tile) in &tiles {
                if wanted(&mut dice, key) {
                    assert!(resident.insert(*key, tile.clone()));
                    given.push(*key);
                }
            }
            rounds += 1;
            assert!(rounds < 10_000, "does not come to an end");
        }
        assert!(rounds > 1);
        given.sort_unstable();
        given.dedup();
        assert!(given.len() < tiles.len() || order == 5, "tiles were asked for in vain");
        let rendered = progress.into_rendered(Vec::new());
        assert!(rendered.pixels == frame, "order {order}");
    }
}

/// Cameras of every awkward kind: what they are called, they themselves, and whether they
/// are below ground.
fn cameras(land: &Land) -> Vec<(&'static str, Camera, bool)> {
    let (i, j) = (40, 45);
    let post = DVec3::new(
        CORNER[0] + i as f64 * STEP_M,
        CORNER[1] + j as f64 * STEP_M,
        f64::from(height(i, j)),
    );
    let high = DVec3::Z * (land.pyramid.highest() + 400.0 - post.z);
    let camera = |position, heading, pitch, roll, hfov| {
        Camera::from_angles(position, heading, pitch, roll, hfov, SMALL)
    };
    let line = DVec3::new(7.25, 0.0, 0.0);
    vec![
        ("on a post", camera(post, 30.0, 0.0, 0.0, 60.0), true),
        ("a hair above a post", camera(post + DVec3::Z * 1e-6, 30.0, 0.0, 0.0, 60.0), false),
        ("a hair below a post", camera(post - DVec3::Z * 1e-6, 30.0, 0.0, 0.0, 60.0), true),
        ("over a post", camera(post + high, 0.0, -20.0, 0.0, 60.0), false),
        ("along a line", camera(post + high + line, 90.0, -30.0, 0.0, 60.0), false),
        ("straight down on a post", camera(post + high, 0.0, -90.0, 0.0, 90.0), false),
        ("straight down, turned", camera(post + high + line, 37.0, -90.0, 0.0, 60.0), false),
        ("straight up", camera(post + DVec3::Z, 0.0, 90.0, 0.0, 100.0), false),
        ("rolled by 45", camera(post + high, 20.0, -10.0, 45.0, 60.0), false),
        ("rolled by 90", camera(post + high, 20.0, -10.0, 90.0, 60.0), false),
        ("upside down", camera(post + high, 20.0, -10.0, 180.0, 60.0), false),
        ("a degree wide", camera(post + high, 20.0, -5.0, 0.0, 1.0), false),
        ("170 degrees wide", camera(post + high, 20.0, -5.0, 0.0, 170.0), false),
        ("deep below", camera(post - DVec3::Z * 5000.0, 20.0, 30.0, 0.0, 60.0), true),
        (
            "beside the land, below",
            camera(post - DVec3::new(2000.0, 0.0, 200.0), 90.0, 0.0, 0.0, 60.0),
            false,
        ),
        ("far away", camera(post + DVec3::new(-60e3, -60e3, 3000.0), 45.0, -1.0, 0.0, 20.0), false),
    ]
}

#[test]
fn pictures_are_sound_and_the_same_by_both_methods_from_everywhere() {
    let land = land(CORNER);
    for earth in [None, shading().earth] {
        for (what, camera, below) in cameras(&land) {
            assert!(camera.is_valid(), "{what}");
            let quality = |method| Quality { method, ..Quality::default() };
            let shading = Shading { earth, ..shading() };
            let exact = View { camera, shading, quality: quality(Method::Exact) };
            let slow = View { quality: quality(Method::Reference), ..exact.clone() };
            let all = Region::whole(SMALL.0, SMALL.1);
            let (frame, truth) = (land.render(&exact, all), land.render(&slow, all));
            assert_eq!(frame.stats.below_ground, below, "{what}");
            assert!(frame.pixels == truth.pixels, "{what}: not as the reference");
            let first = &frame.pixels[..3];
            let plain = frame.pixels.chunks_exact(3).all(|pixel| pixel == first);
            assert!(!below || plain, "{what}: below ground there is one colour");
            for y in 0..SMALL.1 {
                for x in 0..SMALL.0 {
                    let at = [f64::from(x) + 0.5, f64::from(y) + 0.5];
                    let Some(hit) = land.look(&exact, at) else { continue };
                    let sound = hit.position.is_finite()
                        && hit.height.is_finite()
                        && (0.0..1e6).contains(&hit.distance_m)
                        && (0.0..=1.0).contains(&hit.u)
                        && (0.0..=1.0).contains(&hit.v);
                    assert!(sound, "{what} {at:?}: {hit:?}");
                }
            }
        }
    }
}

#[test]
fn coordinates_of_utm_size_bring_no_jitter() {
    let (far, near) = (land(CORNER), land([0.0; 2]));
    let focal = 1920.0 / (2.0 * libm::tan(30f64.to_radians()));
    let (mut worst_px, mut compared, mut moved_px) = (0.0f64, 0, 0.0f64);
    for step in 0..40 {
        // Steps of a centimetre in all directions; what UTM coordinates can hold of them.
        let shift = DVec3::new(0.01, 0.007, 0.003) * f64::from(step);
        let place = DVec3::new(CORNER[0] + 2204.3, CORNER[1] + 2117.9, 0.0) + shift;
        let ground = f64::from(height(110, 105));
        let place = DVec3 { z: ground + 60.0 + shift.z, ..place };
        let local = place - DVec3::new(CORNER[0], CORNER[1], 0.0);
        let look = |land: &Land, position, pixel: [f64; 2]| {
            let camera = Camera::from_angles(position, 70.0, -15.0, 0.0, 60.0, (1920, 1080));
            let view = View { camera, shading: bare(None), quality: Quality::default() };
            land.look(&view, pixel).map(|hit| (hit, camera))
        };
        for at in 0..600 {
            let pixel = [f64::from(at % 30) * 64.0 + 0.5, f64::from(at / 30) * 54.0 + 0.5];
            let (a, b) = (look(&far, place, pixel), look(&near, local, pixel));
            assert_eq!(a.is_some(), b.is_some(), "{place} {pixel:?}");
            let (Some((a, camera)), Some((b, _))) = (a, b) else { continue };
            // The contact slides along its ray; what is seen there slides by less.
            let slid = a.position - DVec3::new(CORNER[0], CORNER[1], 0.0) - b.position;
            let depth = (b.position - local).dot(camera.forward);
            worst_px = worst_px.max(slid.length() * focal / depth);
            moved_px = moved_px.max(0.012 * focal / depth);
            compared += 1;
        }
    }
    println!(
        "{compared} points jitter by at most {worst_px:.1e} px; a step moves up to {moved_px:.2} px"
    );
    assert!(compared > 10_000 && worst_px < 1e-4, "{compared} {worst_px}");
}
