use super::*;
use crate::oracle::{Dice, Land, bare, count, lands};
use crate::tests_support::{Plan, mountains, store};
use crate::{Hit, Pyramid, trace};
use terrafarm_common::quality::Method;
use terrafarm_common::shading::Earth;

fn field(land: &Land) -> Field<'_> {
    Field { resident: &land.resident, pyramid: &land.pyramid }
}

fn view(camera: Camera, earth: Option<Earth>, samples_per_side: u32) -> View {
    let quality = Quality { method: Method::Voxel, samples_per_side, ..Quality::default() };
    View { camera, shading: bare(earth), quality }
}

fn whole(view: &View) -> Region {
    Region::whole(view.camera.width, view.camera.height)
}

fn single(name: &'static str, posts: u64, height: impl Fn(u64, u64) -> f32) -> Land {
    Land::new(name, vec![Plan::heights([0.0; 2], [1.0; 2], [posts, posts], height)])
}

/// Waves of 60 to 150 posts.
fn waves(i: u64, j: u64) -> f32 {
    let wave = |place: f64, length: f64| libm::sin(place * core::f64::consts::TAU / length);
    let (x, y) = (i as f64, j as f64);
    (20.0 * wave(x + 0.5 * y, 150.0) + 8.0 * wave(y - 0.3 * x, 90.0) + 3.0 * wave(x, 60.0)) as f32
}

/// The slow twin: the same rules in f64, nothing carried from step to step but x, y and the
/// level.
fn twin(land: &Land, view: &View) -> Vec<f32> {
    let (camera, layer) = (&view.camera, &land.resident.index().layers[0]);
    let cells = cells_of(layer).map(f64::from);
    let eye = [0, 1].map(|a| (camera.position[a] - layer.origin[a]) / layer.spacing[a]);
    let advance = |ray: DVec3| [ray.x / layer.spacing[0], ray.y / layer.spacing[1]];
    let curvature = path::Ground::new(view.shading.earth).curvature();
    let unit = layer.spacing[0].max(layer.spacing[1]) * camera.focal_px();
    let top = layer.levels.len() - 1;
    let post = |level: usize, place: [i64; 2]| -> f64 {
        let tiles = layer.levels[level].tiles;
        let tile = [0, 1].map(|a| (place[a] / 256).min(i64::from(tiles[a]) - 1));
        let key = TileKey { layer: 0, level: level as u16, tx: tile[0] as u32, ty: tile[1] as u32 };
        match field(land).ground(key) {
            Ground::Loaded(found) => {
                let [i, j] = [0, 1].map(|a| (place[a] - 256 * tile[a]) as isize);
                found.post(i, j).into()
            }
            _ => f64::NAN,
        }
    };
    let samples = view.quality.samples_per_side;
    let mut seen = vec![0.0; whole(view).area() as usize];
    for column in 0..camera.width {
        let middle = f64::from(column) + 0.5;
        let bottom = advance(camera.ray(middle, f64::from(camera.height) - 0.5));
        let major = usize::from(bottom[1].abs() > bottom[0].abs());
        let minor = 1 - major;
        let sign = bottom[major].signum();
        let surface = |level: usize, x: f64, y: f64| -> f64 {
            let size = f64::from(1u32 << level);
            let (line, along) = (x / size, y / size);
            let mut before = along.floor();
            if before * size >= cells[minor] {
                before -= 1.0;
            }
            let mut place = [0; 2];
            (place[major], place[minor]) = (line as i64, before as i64);
            let first = post(level, place);
            place[minor] += 1;
            first + (post(level, place) - first) * (along - before)
        };
        // The first line ahead over the layer, and not above the highest post.
        let edge = camera.ray(middle, f64::from(camera.height));
        let fall = -edge.z / advance(edge)[major].abs();
        let above = camera.position.z - land.pyramid.highest();
        let mut x = if sign > 0.0 {
            (eye[major].floor() + 1.0).max(0.0)
        } else {
            (eye[major].ceil() - 1.0).min(cells[major])
        };
        if above > 0.0 && fall <= 0.0 {
            continue;
        }
        if above > 0.0 {
            let dip = (eye[major] * sign + above / fall).floor() * sign;
            x = if sign > 0.0 { x.max(dip) } else { x.min(dip) };
        }
        let mut y = eye[minor] + (x - eye[major]) * bottom[minor] / bottom[major];
        let mut level = 0;
        let mut out = !(0.0..=cells[major]).contains(&x);
        for row in (0..camera.height).rev() {
            let ray = camera.ray(middle, f64::from(row) + 0.5);
            let [along, across] = [advance(ray)[major].abs(), advance(ray)[minor]];
            let mut met = Vec::new();
            for sample in 0..samples {
                let share = (f64::from(sample) + 0.5) / f64::from(samples) - 0.5;
                let reach = |x: f64| (x - eye[major]) * sign;
                let shift = reach(x) / along * share * camera.up.z / camera.focal_px();
                while !out {
                    let depth = reach(x) / along;
                    let z = camera.position.z + depth * ray.z + shift;
                    let far = depth / unit / f64::from(1u32 << level);
                    let mut ground = f64::NAN;
                    if (0.0..=cells[minor]).contains(&y) {
                        let weight = (2.0 * far - 1.0).clamp(0.0, 1.0);
                        ground = if level == 0 || weight == 1.0 {
                            surface(level, x, y)
                        } else if weight == 0.0 {
                            surface(level - 1, x, y)
                        } else {
                            let fine = surface(level - 1, x, y);
                            let coarse = surface(level, x, y);
                            if coarse.is_nan() { fine } else { fine + (coarse - fine) * weight }
                        };
                    }
                    let map = depth * DVec3::new(ray.x, ray.y, 0.0).length();
                    if z <= ground - 0.5 * curvature * map * map {
                        met.push(1.0 / depth);
                        break;
                    }
                    if ray.z >= 0.0 && z > land.pyramid.highest() {
                        out = true;
                    }
                    let mut narrow = far >= 1.0;
                    while level < top && narrow && x % f64::from(2u32 << level) == 0.0 {
                        level += 1;
                        narrow = depth / unit >= f64::from(1u32 << level);
                    }
                    x += sign * f64::from(1u32 << level);
                    y += across / along * f64::from(1u32 << level);
                    out |= !(0.0..=cells[major]).contains(&x);
                }
            }
            if let Some(&middle) = met.get(samples as usize / 2) {
                met.retain(|inverse: &f64| (inverse / middle - 1.0).abs() <= 0.02);
                let mean = met.iter().sum::<f64>() / met.len() as f64;
                seen[(row * camera.width + column) as usize] = mean as f32;
            }
        }
    }
    seen
}

/// A view that may or may not suit the method.
fn any_view(land: &Land, dice: &mut Dice) -> View {
    let layer = &land.resident.index().layers[0];
    let far = layer.far_corner();
    let along = |dice: &mut Dice, axis: usize| {
        let room = 0.8 * (far[axis] - layer.origin[axis]);
        dice.between(layer.origin[axis] - room, far[axis] + room)
    };
    let (x, y) = (along(dice, 0), along(dice, 1));
    let z = land.pyramid.highest() + dice.between(-20.0, 200.0);
    let middle = [0, 1].map(|axis| 0.5 * (layer.origin[axis] + far[axis]));
    let heading = libm::atan2(middle[0] - x, middle[1] - y).to_degrees();
    let heading = heading + dice.between(-20.0, 20.0);
    let (pitch, roll) = (dice.between(-70.0, 5.0), dice.between(-0.4, 0.4));
    let fov = [10.0, 40.0, 80.0][dice.below(3) as usize];
    let size = (12 + dice.below(30) as u32, 9 + dice.below(30) as u32);
    let camera = Camera::from_angles(DVec3::new(x, y, z), heading, pitch, roll, fov, size);
    let earth = (dice.below(2) == 0).then_some(Earth { radius_m: 20_000.0, refraction: 0.1 });
    view(camera, earth, 1 + dice.below(3) as u32)
}

fn all_lands() -> Vec<Land> {
    let mut lands = lands();
    lands.push(single("waves", 700, waves));
    lands.push(single("plane", 300, |i, j| 0.25 * i as f32 - 0.125 * j as f32));
    lands.retain(|land| land.name != "insets" && land.name != "utm");
    lands
}

#[test]
fn fixed_point_sees_what_its_twin_in_f64_sees() {
    let (mut ground, mut other, mut views) = (0u64, 0u64, 0);
    for (number, land) in all_lands().iter().enumerate() {
        let mut dice = Dice::new(31 + 1000 * number as u64);
        for _ in 0..count(120) {
            let view = any_view(land, &mut dice);
            let Ok((seen, missing)) = see(field(land), &view, whole(&view)) else { continue };
            assert!(missing.is_empty());
            views += 1;
            if cells_of(&land.resident.index().layers[0]).contains(&0) {
                assert!(seen.inverse_depth.iter().all(|&inverse| inverse == 0.0));
                continue;
            }
            for (found, expected) in seen.inverse_depth.iter().zip(twin(land, &view)) {
                ground += u64::from(expected > 0.0);
                // A contact that rounding decides shifts the rest of its column a little.
                other += u64::from((found - expected).abs() > 1e-5 * expected);
            }
        }
    }
    println!("{views} views, {ground} pixels of ground, {other} differ");
    assert!(views > 400 && ground > 100_000, "{views} views, {ground} pixels");
    assert!(2000 * other < ground, "{other} of {ground} differ");
}

#[test]
fn a_pixel_does_not_depend_on_the_region() {
    let land = single("waves", 700, waves);
    let mut dice = Dice::new(5);
    let mut parts = 0;
    while parts < 40 {
        let view = any_view(&land, &mut dice);
        let Ok((seen, _)) = see(field(&land), &view, whole(&view)) else { continue };
        let size = whole(&view);
        let (x, y) = (dice.below(size.width.into()) as u32, dice.below(size.height.into()) as u32);
        let width = 1 + dice.below(u64::from(size.width - x)) as u32;
        let height = 1 + dice.below(u64::from(size.height - y)) as u32;
        let part = Region { x, y, width, height };
        let (found, _) = see(field(&land), &view, part).expect("the whole view was fit");
        for ([x, y], inverse) in part.pixels().zip(found.inverse_depth) {
            let expected = seen.inverse_depth[(y * size.width + x) as usize];
            assert_eq!(inverse.to_bits(), expected.to_bits(), "{part:?}");
        }
        parts += 1;
    }
}

/// Vertical distance between what pixels see and the surface, pixels: the median, the 99th
/// percentile and the largest, over ground that `exact` sees, too; and the share of pixels
/// on which the two do not agree whether there is ground.
fn errors(land: &Land, view: &View) -> [f64; 4] {
    let (seen, _) = see(field(land), view, whole(view)).expect("the view is fit");
    let curvature = path::Ground::new(view.shading.earth).curvature();
    let camera = &view.camera;
    let mut errors = Vec::new();
    let mut mismatches = 0;
    let exact = View { quality: Quality::default(), ..view.clone() };
    let compare = |x: u32, y: u32, hit: Option<Hit>| {
        let inverse = f64::from(seen.inverse_depth[(y * camera.width + x) as usize]);
        if (inverse > 0.0) != hit.is_some() {
            mismatches += 1;
        } else if inverse > 0.0 {
            let ray = camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5) / inverse;
            let at = camera.position + ray;
            let surface = field(land).height_at([at.x, at.y]).expect("all tiles are loaded");
            let z = at.z + 0.5 * curvature * (ray.x * ray.x + ray.y * ray.y);
            if let Some(surface) = surface {
                errors.push((z - surface).abs() * camera.focal_px() / ray.length());
            }
        }
    };
    trace(&land.resident, &land.pyramid, &exact, whole(view), compare).expect("all are loaded");
    errors.sort_by(f64::total_cmp);
    assert!(errors.len() > 1000, "{} pixels of ground", errors.len());
    let share = |share: f64| errors[((errors.len() - 1) as f64 * share) as usize];
    [share(0.5), share(0.99), share(1.0), f64::from(mismatches) / whole(view).area() as f64]
}

#[test]
fn in_a_narrow_field_the_error_stays_within_what_was_measured() {
    let plane = single("plane", 1500, |i, j| 0.125 * i as f32 - 0.0625 * j as f32);
    let waves = single("waves", 1500, waves);
    let earth = Some(Earth { radius_m: 200_000.0, refraction: 0.0 });
    // Limits: pitch, heading, and of the plane and of the waves the median, the 99th
    // percentile and the largest; a tenth more than was measured. A step is one to two pixels
    // on the map, on average half of one too late, times the slope between ray and ground.
    // At 60 degrees of pitch columns turn most: there the drift of y counts, too.
    let cases = [
        (-35.0, 0.0, None, [0.45, 1.05, 1.15], [0.70, 2.80, 3.45]),
        (-35.0, 30.0, None, [0.60, 1.30, 1.50], [0.95, 3.50, 4.15]),
        (-20.0, 10.0, earth, [0.25, 0.65, 0.75], [0.65, 2.70, 3.30]),
        (-60.0, 200.0, None, [1.30, 3.20, 3.65], [2.20, 9.90, 13.8]),
    ];
    for (pitch, heading, earth, on_plane, on_waves) in cases {
        let (sin, cos) = libm::sincos(f64::to_radians(heading));
        let (up, back) = libm::sincos(f64::to_radians(-pitch));
        let eye = DVec3::new(-back * sin, -back * cos, up) * 900.0;
        let eye = eye + DVec3::new(750.0, 750.0, 60.0);
        let camera = Camera::from_angles(eye, heading, pitch, 0.0, 10.0, (100, 70));
        for (land, limits) in [(&plane, on_plane), (&waves, on_waves)] {
            for samples in [1, 4] {
                let [median, most, largest, mismatches] =
                    errors(land, &view(camera, earth, samples));
                let found = [median, most, largest];
                let what = format!("{} {pitch} {samples}: {found:.2?}", land.name);
                println!("{what}");
                assert!(found.iter().zip(limits).all(|(found, limit)| *found <= limit), "{what}");
                assert_eq!(mismatches, 0.0, "{what}");
            }
        }
    }
}

#[test]
fn no_ground_is_nearer_than_the_envelope_says() {
    let (mut fit, mut refused) = (0, 0);
    for (number, land) in all_lands().iter().enumerate() {
        let layer = &land.resident.index().layers[0];
        let mut dice = Dice::new(8 + 1000 * number as u64);
        for _ in 0..count(60) {
            let mut view = any_view(land, &mut dice);
            if see(field(land), &view, Region::whole(1, 1)).is_err() {
                refused += 1;
                continue;
            }
            fit += 1;
            view.quality = Quality::default();
            let unit = envelope::unit_depth(&view.camera, layer);
            let check = |x: u32, y: u32, hit: Option<Hit>| {
                let ray = view.camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let depth = hit.map(|hit| hit.parameter_m / ray.length());
                assert!(depth.is_none_or(|depth| depth >= unit), "{} {view:?}", land.name);
            };
            trace(&land.resident, &land.pyramid, &view, whole(&view), check).expect("loaded");
        }
    }
    assert!(fit > 200 && refused > 200, "{fit} fit, {refused} refused");
}

#[test]
fn what_it_is_not_made_for_is_refused_in_words() {
    let land = single("waves", 300, waves);
    let eye = DVec3::new(150.0, -600.0, 500.0);
    let camera = |pitch, roll, fov, width| {
        Camera::from_angles(eye, 0.0, pitch, roll, fov, (width, width / 2))
    };
    let ask = |camera| see(field(&land), &view(camera, None, 1), Region::whole(1, 1));
    let refusal = |camera| ask(camera).expect_err("outside of the envelope");
    assert!(ask(camera(-30.0, 0.0, 20.0, 100)).is_ok());
    assert!(ask(camera(-30.0, 0.4, 20.0, 100)).is_ok());
    let cases = [
        (camera(-30.0, 0.6, 20.0, 100), "rolled by 0.6 degrees"),
        (camera(-30.0, 180.0, 20.0, 100), "rolled by 180.0 degrees"),
        (camera(-90.0, 0.0, 20.0, 100), "95.0 degrees from level"),
        (camera(-80.0, 0.0, 20.0, 100), "85.0 degrees from level"),
        (camera(-60.0, 0.0, 80.0, 100), "turns by"),
        (camera(-30.0, 0.0, 20.0, 400), "wider than a pixel up to a depth of 1134 m"),
        (Camera { position: DVec3::new(1e12, 0.0, 0.0), ..camera(-30.0, 0.0, 20.0, 100) }, "cells"),
        (
            Camera { position: DVec3::new(150.0, 150.0, -5.0), ..camera(-5.0, 0.0, 20.0, 100) },
            "0 m",
        ),
    ];
    for (camera, words) in cases {
        let unfit = refusal(camera);
        assert_eq!((unfit.method, unfit.instead), (Method::Voxel, Method::Column));
        assert!(unfit.why.contains(words), "{words}: {unfit}");
    }
    let inset = vec![
        Plan::heights([0.0; 2], [1.0; 2], [40, 40], waves),
        Plan::heights([9.0; 2], [0.5; 2], [10, 10], waves),
    ];
    let inset = Land::new("inset", inset);
    let view = view(camera(-30.0, 0.0, 20.0, 100), None, 1);
    let unfit = see(field(&inset), &view, whole(&view)).expect_err("it has two layers");
    assert_eq!(unfit.instead, Method::Exact);
    assert!(unfit.why.contains("2 height layers"), "{unfit}");
}

#[test]
fn each_crossing_of_a_column_is_looked_at_once_by_all_of_its_rays() {
    let land = single("waves", 1500, waves);
    let eye = DVec3::new(750.0, -400.0, 500.0);
    let view = view(Camera::from_angles(eye, 0.0, -20.0, 0.0, 30.0, (100, 60)), None, 1);
    let (seen, _) = see(field(&land), &view, whole(&view)).expect("the view is fit");
    let ground = seen.inverse_depth.iter().filter(|&&inverse| inverse > 0.0).count() as u64;
    assert!(ground > 4000, "{ground} pixels of ground");
    assert!(seen.rays <= whole(&view).area());
    // A look a ray, and one a crossing: at most 1500 of them in a column, far fewer where
    // steps are of two cells and more.
    assert!(seen.steps <= seen.rays + 100 * 750, "{} steps, {} rays", seen.steps, seen.rays);
}

#[test]
fn missing_tiles_are_named_and_hide_only_what_lies_above_them() {
    let hills = |i, j| mountains(i, j, 128, 20.0, 4);
    let (mut resident, tiles) = store(vec![Plan::heights([0.0; 2], [1.0; 2], [900, 900], hills)]);
    let pyramid = Pyramid::new(resident.index());
    let eye = DVec3::new(450.0, -300.0, 400.0);
    let view = view(Camera::from_angles(eye, 5.0, -25.0, 0.0, 30.0, (60, 60)), None, 2);
    let mut known: Vec<f32> = vec![f32::NAN; whole(&view).area() as usize];
    let mut loaded = 0;
    loop {
        let field = Field { resident: &resident, pyramid: &pyramid };
        let (seen, missing) = see(field, &view, whole(&view)).expect("the view is fit");
        for (at, (known, &inverse)) in known.iter_mut().zip(&seen.inverse_depth).enumerate() {
            assert!(known.is_nan() || known.to_bits() == inverse.to_bits());
            *known = inverse;
            let above = at.checked_sub(60).map(|above| seen.inverse_depth[above]);
            assert!(!inverse.is_nan() || above.is_none_or(f32::is_nan));
        }
        assert_eq!(missing.is_empty(), known.iter().all(|inverse| !inverse.is_nan()));
        if missing.is_empty() {
            break;
        }
        for (key, tile) in &tiles {
            if missing.contains(key) {
                assert!(resident.insert(*key, tile.clone()));
                loaded += 1;
            }
        }
    }
    assert!((2..tiles.len()).contains(&loaded), "{loaded} of {} tiles", tiles.len());
}
