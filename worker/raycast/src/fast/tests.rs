#![allow(clippy::unwrap_used)]
use super::*;
use crate::meter::measure;
use crate::oracle::{Dice, Land, bare, count, lands};
use crate::relief::Lack;
use crate::tests_support::{Plan, mountains, store};
use crate::{Pyramid, Unseen, depths};
use glam::DVec3;
use std::sync::Arc;
use terrafarm_common::camera::Camera;
use terrafarm_common::shading::Earth;
use terrafarm_terrain::layout::{Layer, Level, TileEntry};
use terrafarm_terrain::resident::Resident;

const SIZE: (u32, u32) = (80, 60);
const METHODS: [Method; 2] = [Method::Lod, Method::Column];

/// Ground of several levels that are smooth enough to be used, and of many tiles.
fn hills() -> Land {
    let height = |i, j| mountains(i, j, 512, 300.0, 21) * 0.6;
    let plan = Plan::heights([1000.0, -500.0], [9.0, 10.0], [1100, 900], height);
    Land::new("hills", vec![plan])
}

fn single_layered() -> Vec<Land> {
    let mut all = lands();
    all.push(hills());
    all.retain(|land| unfit(land.resident.index()).is_none());
    assert!(all.len() > 8);
    all
}

/// A camera above the ground somewhere in or beside a land, looking anywhere.
fn camera(land: &Land, dice: &mut Dice) -> Camera {
    let layer = &land.resident.index().layers[0];
    let far = layer.far_corner();
    let eye = [0, 1].map(|axis| {
        let side = far[axis] - layer.origin[axis];
        layer.origin[axis] + side * dice.between(-0.2, 1.2)
    });
    let above = [3.0, 40.0, 900.0][dice.below(3) as usize];
    let position = DVec3::new(eye[0], eye[1], land.pyramid.highest() + above);
    let pitch = [-90.0, -60.0, -30.0, dice.between(-20.0, 5.0)][dice.below(4) as usize];
    let roll = [0.0, 0.0, 90.0, dice.between(-180.0, 180.0)][dice.below(4) as usize];
    let fov = [30.0, 60.0, 140.0][dice.below(3) as usize];
    let heading = [0.0, 90.0, dice.between(0.0, 360.0)][dice.below(3) as usize];
    Camera::from_angles(position, heading, pitch, roll, fov, SIZE)
}

fn view(camera: Camera, dice: &mut Dice, method: quality::Method) -> View {
    let earth = Earth { radius_m: 6_371_000.0, refraction: 0.13 };
    let tolerance_px = [0.1, 0.25, 0.5, 1.0, 3.0][dice.below(5) as usize];
    let quality = Quality { method, tolerance_px, ..Quality::default() };
    View { camera, shading: bare((dice.below(2) == 0).then_some(earth)), quality }
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}

#[test]
fn every_width_and_every_split_see_the_same_bits() {
    for (number, land) in single_layered().iter().enumerate() {
        let field = Field { resident: &land.resident, pyramid: &land.pyramid };
        let mut dice = Dice::new(40 + number as u64);
        for _ in 0..count(6) {
            let camera = camera(land, &mut dice);
            let view = view(camera, &mut dice, quality::Method::Lod);
            let whole = Region::whole(SIZE.0, SIZE.1);
            for method in METHODS {
                let see = |region, width| {
                    let (seen, missing) = see(field, &view, region, method, width).unwrap();
                    assert_eq!(missing, []);
                    seen.inverse_depth
                };
                let scalar = see(whole, Width::One);
                assert!(scalar.iter().all(|inverse| *inverse >= 0.0), "{} {method:?}", land.name);
                for width in Width::available() {
                    let same = bits(&see(whole, width)) == bits(&scalar);
                    assert!(same, "{} {method:?} {width:?} {view:?}", land.name);
                }
                let (x, y) = (dice.below(70) as u32, dice.below(50) as u32);
                let part = Region { x, y, width: 9, height: 8 };
                for ([x, y], inverse) in part.pixels().zip(see(part, lanes::widest())) {
                    let truth = scalar[(y * SIZE.0 + x) as usize];
                    let said = format!("{} {method:?} {view:?} {x} {y}", land.name);
                    assert_eq!(inverse.to_bits(), truth.to_bits(), "{said}");
                }
            }
        }
    }
}

#[test]
fn strips_and_tiles_make_the_same_picture_as_the_whole() {
    let land = hills();
    let field = Field { resident: &land.resident, pyramid: &land.pyramid };
    let mut dice = Dice::new(9);
    for round in 0..count(12) {
        let mut camera = camera(&land, &mut dice);
        // One that is wider and higher than what `column` does at once.
        let size = if round % 4 == 3 { (600, 560) } else { (320, 180) };
        (camera.width, camera.height) = size;
        camera.position.z = land.pyramid.highest() + dice.between(20.0, 500.0);
        let view = view(camera, &mut dice, quality::Method::Lod);
        let whole = Region::whole(size.0, size.1);
        for method in METHODS {
            let see = |region| {
                let (seen, _) = see(field, &view, region, method, lanes::widest()).unwrap();
                (seen.inverse_depth, seen.alone)
            };
            let (truth, alone) = see(whole);
            let mut alone_in_parts = 0;
            let (width, height) = [(32, 180), (7, 180), (24, 24), (530, 64)][(round % 4) as usize];
            for y in (0..size.1).step_by(height as usize) {
                for x in (0..size.0).step_by(width as usize) {
                    let (width, height) = (width.min(size.0 - x), height.min(size.1 - y));
                    let part = Region { x, y, width, height };
                    let (seen, alone) = see(part);
                    alone_in_parts += alone;
                    for ([x, y], inverse) in part.pixels().zip(seen) {
                        let truth = truth[(y * size.0 + x) as usize];
                        let same = inverse.to_bits() == truth.to_bits();
                        assert!(same, "{method:?} {view:?} {part:?} {x} {y} {inverse} {truth}");
                    }
                }
            }
            assert_eq!(alone_in_parts, alone, "{method:?} {view:?}");
            assert!(alone == 0 || method == Method::Column);
        }
    }
}

/// Pixels that were compared with the true surface.
#[derive(Debug, Default)]
struct Compared {
    /// Those that claim to see ground, and those that claim the sky.
    ground: u64,
    sky: u64,
    /// Those that are further from the surface in height than in space.
    steep: u64,
    /// Those of `column` before which there is ground.
    hidden: u64,
}

impl Compared {
    /// Compares every so many pixels of a view.
    ///
    /// # Panics
    /// If one is further from the surface than the tolerance, or if a pixel of `lod` has
    /// ground before it.
    fn add(&mut self, land: &Land, view: &View, every: usize) {
        // Single precision adds a little of its own, ...
        const ADDED_PX: f64 = 0.02;
        // ... to a depth no more than this share, ...
        const OF_DEPTH: f64 = 1e-5;
        // ... and within this part of a cell of the camera more than pixels tell.
        const CLOSE: f64 = 0.25;
        // What stands at the rim of the land between two lines may be off by more.
        const COLUMN: f64 = 1.5;
        // To what an occlusion is found.
        const STEP_PX: f64 = 0.01;
        let (resident, pyramid) = (&land.resident, &land.pyramid);
        let whole = Region::whole(SIZE.0, SIZE.1);
        let seen = depths(resident, pyramid, view, whole).unwrap();
        let allowed = view.quality.tolerance_px + ADDED_PX;
        let [method, column] = [view.quality.method, quality::Method::Column];
        let close_m = CLOSE * resident.index().layers[0].spacing[0];
        for [x, y] in whole.pixels().step_by(every) {
            let claimed = seen.distance_m(view, x, y);
            *(if claimed.is_finite() { &mut self.ground } else { &mut self.sky }) += 1;
            if claimed < close_m {
                continue;
            }
            let error = measure(resident, pyramid, view, x, y, claimed).unwrap();
            let said = format!("{} {method} {view:?} {x} {y}: {claimed}, {error:?}", land.name);
            let rounded = error.depth_m.is_some_and(|depth| depth.abs() <= OF_DEPTH * claimed);
            if error.surface_px > allowed && !rounded {
                self.steep += 1;
                let within = if method == column { COLUMN * allowed } else { allowed };
                assert!(is_near_the_surface(land, view, [x, y], claimed, within), "{said}");
            }
            if error.occlusion_px > allowed.max(error.surface_px + STEP_PX) {
                assert_eq!(method, column, "{said}");
                self.hidden += 1;
            }
        }
    }

    /// Whether few pixels are exceptions.
    fn is_well(&self) {
        println!("{self:?}");
        let Compared { ground, sky, steep, hidden } = *self;
        assert!(ground > 5_000 && sky > 5_000, "{self:?}");
        assert!(steep * 500 <= ground && hidden * 500 <= ground + sky, "{self:?}");
    }
}

#[test]
fn what_is_seen_is_on_the_surface_to_the_tolerance() {
    let mut compared = Compared::default();
    for (number, land) in single_layered().iter().enumerate() {
        let mut dice = Dice::new(80 + number as u64);
        for round in 0..count(6) {
            let method = [quality::Method::Lod, quality::Method::Column][(round % 2) as usize];
            let camera = camera(land, &mut dice);
            compared.add(land, &view(camera, &mut dice, method), 7);
        }
    }
    compared.is_well();
}

#[test]
fn ground_close_to_the_camera_is_seen_whatever_way_it_looks() {
    let mut compared = Compared::default();
    for (number, land) in single_layered().iter().enumerate() {
        let layer = &land.resident.index().layers[0];
        let far = layer.far_corner();
        let mut dice = Dice::new(300 + number as u64);
        for round in 0..count(14) {
            let [x, y] = [0, 1].map(|n| {
                let side = far[n] - layer.origin[n];
                layer.origin[n] + side * dice.between(0.05, 0.95)
            });
            let Some(ground) = land.height(x, y, land.pyramid.highest() + 1.0) else { continue };
            let above = [2.0, 30.0, 1000.0][dice.below(3) as usize];
            let pitches = [-90.0, -89.9, -45.0, -10.0, 0.0, 5.0, 30.0, 60.0];
            let pitch = pitches[dice.below(8) as usize];
            let roll = [0.0, 90.0, dice.between(-180.0, 180.0)][dice.below(3) as usize];
            let eye = DVec3::new(x, y, ground + above);
            let camera =
                Camera::from_angles(eye, dice.between(0.0, 360.0), pitch, roll, 60.0, SIZE);
            let method = [quality::Method::Lod, quality::Method::Column][(round % 2) as usize];
            compared.add(land, &view(camera, &mut dice, method), 11);
        }
    }
    compared.is_well();
}

/// Whether the surface passes within so many pixels of what is claimed to be seen, in whatever
/// direction. A height is a stricter measure where the ground is steep: at a cliff rounding
/// is enough for a difference, and beyond the rim of the land or of a void there is none.
fn is_near_the_surface(
    land: &Land,
    view: &View,
    [x, y]: [u32; 2],
    claimed_m: f64,
    allowed_px: f64,
) -> bool {
    const STEPS: i32 = 8;
    let ray = view.camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5).normalize();
    let place = view.camera.position + ray * claimed_m;
    let across_m = ray.truncate().length() * claimed_m;
    let sunk_m = view.shading.earth.map_or(0.0, |earth| {
        across_m * across_m * (1.0 - earth.refraction) / (2.0 * earth.radius_m)
    });
    let top = land.pyramid.highest() + 1.0;
    let reach_m = allowed_px * claimed_m / view.camera.focal_px();
    let (mut above, mut below) = (false, false);
    for (i, j) in (-STEPS..=STEPS).flat_map(|j| (-STEPS..=STEPS).map(move |i| (i, j))) {
        if i * i + j * j > STEPS * STEPS {
            continue;
        }
        let [dx, dy] = [i, j].map(|step| f64::from(step) / f64::from(STEPS) * reach_m);
        match land.height(place.x + dx, place.y + dy, top) {
            Some(height) => {
                let gap = place.z + sunk_m - height;
                (above, below) = (above || gap >= -reach_m, below || gap <= reach_m);
            }
            None => above = true,
        }
    }
    above && below
}

#[test]
fn missing_tiles_are_named_until_the_picture_is_whole() {
    let height = |i, j| mountains(i, j, 512, 300.0, 21) * 0.6;
    let plan = || Plan::heights([0.0; 2], [10.0; 2], [1100, 900], height);
    let (empty, tiles) = store(vec![plan()]);
    let full = Land::new("full", vec![plan()]);
    let pyramid = Pyramid::new(empty.index());
    for method in [quality::Method::Lod, quality::Method::Column] {
        let eye = DVec3::new(2000.0, 300.0, full.pyramid.highest() + 100.0);
        let camera = Camera::from_angles(eye, 20.0, -15.0, 0.0, 60.0, SIZE);
        let view = view(camera, &mut Dice::new(3), method);
        let whole = Region::whole(SIZE.0, SIZE.1);
        let truth = depths(&full.resident, &full.pyramid, &view, whole).unwrap();
        let mut resident = empty.clone();
        let mut rounds = 0;
        let seen = loop {
            match depths(&resident, &pyramid, &view, whole) {
                Ok(seen) => break seen,
                Err(Unseen::Missing(keys)) => {
                    assert!(!keys.is_empty() && keys.is_sorted());
                    for (key, tile) in &tiles {
                        if keys.contains(key) {
                            resident.insert(*key, tile.clone());
                        }
                    }
                }
                Err(Unseen::Unfit(unfit)) => panic!("{unfit}"),
            }
            rounds += 1;
            assert!(rounds < 20, "{method}");
        };
        assert_eq!(bits(&seen.inverse_depth), bits(&truth.inverse_depth), "{method}");
        assert!(rounds > 0 && resident.loaded().count() < tiles.len());
    }
}

#[test]
fn insets_and_single_rows_are_refused_by_name_and_left_to_exact_by_auto() {
    let flat = |_, _| 1.0;
    let base = || Plan::heights([0.0; 2], [10.0; 2], [30, 30], flat);
    let inset = Plan::heights([50.0; 2], [5.0; 2], [10, 10], flat);
    let row = Plan::heights([0.0; 2], [10.0; 2], [30, 1], flat);
    for land in [Land::new("inset", vec![base(), inset]), Land::new("row", vec![row])] {
        let field = Field { resident: &land.resident, pyramid: &land.pyramid };
        let camera = Camera::from_angles(DVec3::splat(90.0), 0.0, -90.0, 0.0, 60.0, SIZE);
        let mut view = view(camera, &mut Dice::new(1), quality::Method::Column);
        let refused = Look::of(field, &view).unwrap_err();
        assert_eq!(refused.instead, quality::Method::Exact);
        assert!(refused.to_string().contains("column cannot do this"), "{refused}");
        view.quality.method = quality::Method::Auto;
        assert_eq!(Look::of(field, &view), Ok(Look::RayByRay(quality::Method::Exact)));
    }
    let land = Land::new("plain", vec![base()]);
    let field = Field { resident: &land.resident, pyramid: &land.pyramid };
    let camera = Camera::from_angles(DVec3::splat(90.0), 0.0, -90.0, 0.0, 60.0, SIZE);
    let mut view = view(camera, &mut Dice::new(1), quality::Method::Auto);
    for (tolerance_px, look) in [
        (0.01, Look::RayByRay(quality::Method::Exact)),
        (0.05, Look::RayByRay(quality::Method::Exact)),
        (0.5, Look::Fast(Method::Column)),
    ] {
        view.quality.tolerance_px = tolerance_px;
        assert_eq!(Look::of(field, &view), Ok(look));
    }
}

#[test]
fn auto_takes_lod_for_a_small_tolerance_over_terrain_too_large_for_exact() {
    let vast = |posts| {
        let mut index = StoreIndex::clone(hills().resident.index());
        let layer = &mut index.layers[0];
        layer.posts = [posts; 2];
        let level = |level: usize| {
            let tiles = Layer::tiles_for(layer.level_posts(level));
            Level { tiles, entries: vec![TileEntry::EMPTY; (tiles[0] * tiles[1]) as usize] }
        };
        layer.levels = (0..Layer::level_count(layer.posts)).map(level).collect();
        index.check().unwrap();
        Resident::new(Arc::new(index))
    };
    let camera = Camera::from_angles(DVec3::splat(900.0), 0.0, -40.0, 0.0, 60.0, SIZE);
    let mut view = view(camera, &mut Dice::new(1), quality::Method::Auto);
    view.quality.tolerance_px = 0.05;
    for (posts, look) in
        [(8192, Look::RayByRay(quality::Method::Exact)), (8193, Look::Fast(Method::Lod))]
    {
        let resident = vast(posts);
        let pyramid = Pyramid::new(resident.index());
        let field = Field { resident: &resident, pyramid: &pyramid };
        assert_eq!(Look::of(field, &view), Ok(look), "{posts}");
    }
}

/// Hills whose coarser levels say something else of their deviation.
fn claiming(deviation: f32) -> Land {
    let mut land = hills();
    let mut index = StoreIndex::clone(land.resident.index());
    for entry in index.layers[0].levels[1..].iter_mut().flat_map(|level| &mut level.entries) {
        entry.deviation = deviation;
    }
    index.check().unwrap();
    let mut resident = Resident::new(Arc::new(index));
    let height = |i, j| mountains(i, j, 512, 300.0, 21) * 0.6;
    let (_, tiles) = store(vec![Plan::heights([1000.0, -500.0], [9.0, 10.0], [1100, 900], height)]);
    for (key, tile) in tiles {
        assert!(resident.insert(key, tile));
    }
    land.pyramid = Pyramid::new(resident.index());
    land.resident = resident;
    land
}

#[test]
fn a_store_without_deviations_is_refused_and_the_refusal_says_how_to_make_it_again() {
    let land = claiming(0.0);
    let field = Field { resident: &land.resident, pyramid: &land.pyramid };
    let camera = Camera::from_angles(DVec3::splat(900.0), 0.0, -40.0, 0.0, 60.0, SIZE);
    for method in [quality::Method::Lod, quality::Method::Column, quality::Method::Auto] {
        let mut view = view(camera, &mut Dice::new(1), method);
        view.quality.tolerance_px = 0.5;
        let refused = depths(&land.resident, &land.pyramid, &view, Region::whole(80, 60));
        let Err(Unseen::Unfit(refused)) = refused else { panic!("{method} was not refused") };
        assert_eq!((refused.method, refused.instead), (method, quality::Method::Exact));
        let said = refused.to_string();
        assert!(said.contains("terrafarm terrain import"), "{said}");
        assert_eq!(said.ends_with("use exact"), method == quality::Method::Auto, "{said}");
        // What asks for no level of detail does not need the deviations.
        view.quality =
            Quality { tolerance_px: 0.01, method: quality::Method::Auto, ..view.quality };
        assert_eq!(Look::of(field, &view), Ok(Look::RayByRay(quality::Method::Exact)));
        view.quality.method = quality::Method::Frustum;
        assert_eq!(Look::of(field, &view), Ok(Look::Fast(Method::Frustum)));
    }
}

#[test]
fn levels_that_cannot_be_compared_are_not_used_and_the_finest_is() {
    let land = claiming(f32::INFINITY);
    let field = Field { resident: &land.resident, pyramid: &land.pyramid };
    let eye = DVec3::new(2000.0, 300.0, land.pyramid.highest() + 300.0);
    let camera = Camera::from_angles(eye, 20.0, -25.0, 0.0, 60.0, SIZE);
    for method in METHODS {
        let mut view = view(camera, &mut Dice::new(2), quality::Method::Lod);
        view.quality.tolerance_px = 8.0;
        let (seen, missing) = see(field, &view, Region::whole(80, 60), method, Width::One).unwrap();
        assert_eq!(missing, []);
        let relief = Relief::new(field, &view, 8.0, Lack::Open);
        let levels: Vec<u32> =
            (0..relief.plots[0] * relief.plots[1]).map(|plot| relief.plot(plot).level).collect();
        assert!(levels.iter().all(|level| *level == 0), "{levels:?}");
        assert!(seen.inverse_depth.iter().any(|inverse| *inverse > 0.0), "{method:?}");
    }
}
