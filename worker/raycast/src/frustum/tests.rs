use super::*;
use crate::oracle::{Dice, Land, bare, count, lands};
use crate::tests_support::{Plan, keys, mountains, store};
use crate::{Pyramid, trace};
use glam::DVec3;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::shading::Earth;

const SIZE: (u32, u32) = (101, 67);

fn field(land: &Land) -> Field<'_> {
    Field { resident: &land.resident, pyramid: &land.pyramid }
}

/// A view from somewhere in or around a land: rolled, level, straight down, wide, narrow,
/// over flat and over round ground.
fn view(land: &Land, dice: &mut Dice) -> View {
    let layer = &land.resident.index().layers[0];
    let far = layer.far_corner();
    let high = land.pyramid.highest() + 30.0;
    let along = |dice: &mut Dice, axis: usize| {
        let room = 0.2 * (far[axis] - layer.origin[axis]);
        dice.between(layer.origin[axis] - room, far[axis] + room)
    };
    let z = dice.between(0.5 * (land.pyramid.lowest() + high), high);
    let eye = DVec3::new(along(dice, 0), along(dice, 1), z);
    let pitch = [-90.0, 0.0, dice.between(-90.0, 60.0), dice.between(-30.0, 5.0)];
    let roll = [0.0, dice.between(-180.0, 180.0)][dice.below(2) as usize];
    let fov = [4.0, 60.0, 150.0][dice.below(3) as usize];
    let heading = dice.between(0.0, 360.0);
    let pitch = pitch[dice.below(4) as usize];
    // A small sphere bends rays as much here as the Earth does over kilometres.
    let earth = (dice.below(2) == 0).then_some(Earth { radius_m: 20_000.0, refraction: 0.1 });
    View {
        camera: Camera::from_angles(eye, heading, pitch, roll, fov, SIZE),
        shading: bare(earth),
        quality: Quality { method: Method::Exact, ..Quality::default() },
    }
}

/// What `exact` sees of a region, in the form of `Seen`.
fn exact(land: &Land, view: &View, region: Region) -> Vec<u32> {
    let mut bits = vec![0.0f32.to_bits(); region.area() as usize];
    let see = |x, y, hit: Option<crate::Hit>| {
        let at = (y - region.y) * region.width + (x - region.x);
        if let Some(hit) = hit {
            let length = view.camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5).length();
            bits[at as usize] = ((length / hit.parameter_m) as f32).to_bits();
        }
    };
    trace(&land.resident, &land.pyramid, view, region, see).expect("all tiles are loaded");
    bits
}

fn bits(seen: &Seen) -> Vec<u32> {
    seen.inverse_depth.iter().map(|inverse| inverse.to_bits()).collect()
}

#[test]
fn frusta_see_what_exact_sees_to_the_bit() {
    let (mut ground, mut sky) = (0, 0);
    for (number, land) in lands().iter().enumerate() {
        let mut dice = Dice::new(501 + 1000 * number as u64);
        for _ in 0..count(12) {
            let view = view(land, &mut dice);
            let whole = Region::whole(SIZE.0, SIZE.1);
            let (seen, missing) = see(field(land), &view, whole).expect("it takes any view");
            assert!(missing.is_empty());
            assert_eq!(bits(&seen), exact(land, &view, whole), "{} {view:?}", land.name);
            ground += seen.inverse_depth.iter().filter(|&&inverse| inverse > 0.0).count();
            sky += seen.inverse_depth.iter().filter(|&&inverse| inverse == 0.0).count();
        }
    }
    assert!(ground > 100_000 && sky > 100_000, "{ground} of ground, {sky} of sky");
}

#[test]
fn a_pixel_does_not_depend_on_the_region() {
    for (number, land) in lands().iter().enumerate() {
        let mut dice = Dice::new(77 + 1000 * number as u64);
        let view = view(land, &mut dice);
        let whole = Region::whole(SIZE.0, SIZE.1);
        let (seen, _) = see(field(land), &view, whole).expect("it takes any view");
        for _ in 0..6 {
            let (x, y) = (dice.below(101) as u32, dice.below(67) as u32);
            let width = 1 + dice.below(u64::from(101 - x)) as u32;
            let height = 1 + dice.below(u64::from(67 - y)) as u32;
            let part = Region { x, y, width, height };
            let (found, _) = see(field(land), &view, part).expect("it takes any view");
            for ([x, y], inverse) in part.pixels().zip(found.inverse_depth) {
                let expected = seen.inverse_depth[(y * SIZE.0 + x) as usize];
                assert_eq!(inverse.to_bits(), expected.to_bits(), "{} {part:?}", land.name);
            }
        }
    }
}

#[test]
fn it_may_be_interrupted_after_any_frustum_and_resumed_with_new_tools() {
    for (number, land) in lands().iter().enumerate() {
        let mut dice = Dice::new(9 + 1000 * number as u64);
        let view = view(land, &mut dice);
        let whole = Region::whole(SIZE.0, SIZE.1);
        let (expected, _) = see(field(land), &view, whole).expect("it takes any view");
        let mut frusta = Frusta::new(&Caster::new(field(land), &view), whole);
        let (mut more, mut before) = (true, 0);
        while more {
            frusta = frusta.clone();
            let mut caster = Caster::new(field(land), &view);
            for _ in 0..1 + dice.below(400) {
                more = frusta.step(&mut caster);
            }
            let known = frusta.seen.inverse_depth.iter().zip(&expected.inverse_depth);
            let known = known.filter(|(inverse, _)| !inverse.is_nan());
            let mut confirmed = 0;
            for (inverse, expected) in known {
                assert_eq!(inverse.to_bits(), expected.to_bits());
                confirmed += 1;
            }
            assert!(confirmed >= before, "what is confirmed stays");
            before = confirmed;
        }
        let done = (bits(&frusta.seen), frusta.seen.steps, frusta.seen.rays);
        assert_eq!(done, (bits(&expected), expected.steps, expected.rays));
    }
}

#[test]
fn every_pixel_soon_has_a_confirmed_one_near_it() {
    let hills = Plan::heights([0.0; 2], [1.0; 2], [300, 300], |i, j| mountains(i, j, 64, 20.0, 3));
    let land = Land::new("hills", vec![hills]);
    let size = (128, 96);
    let view = View {
        camera: Camera::from_angles(DVec3::new(150.0, 5.0, 90.0), 0.0, -40.0, 5.0, 60.0, size),
        shading: bare(None),
        quality: Quality::default(),
    };
    let mut caster = Caster::new(field(&land), &view);
    let mut frusta = Frusta::new(&caster, Region::whole(size.0, size.1));
    let mut side = 32;
    while side > NARROWEST_PX {
        // All frusta of a size: at most as many as fit.
        for _ in 0..(size.0 / side) * (size.1 / side) {
            frusta.step(&mut caster);
        }
        for y in (0..size.1).step_by(side as usize) {
            for x in (0..size.0).step_by(side as usize) {
                let inverse = frusta.seen.inverse_depth[(y * size.0 + x) as usize];
                assert!(!inverse.is_nan(), "{x} {y} at {side}");
            }
        }
        side /= 2;
    }
    // Within a size they are spread: a quarter of the next frusta serves all of the picture.
    let mut counts = [0u64; 4];
    let before: Vec<bool> = frusta.seen.inverse_depth.iter().map(|i| i.is_nan()).collect();
    for _ in 0..(size.0 / side) * (size.1 / side) / 4 {
        frusta.step(&mut caster);
    }
    for (at, &unknown) in before.iter().enumerate() {
        let (x, y) = (at as u32 % size.0, at as u32 / size.0);
        let quarter = usize::from(x >= size.0 / 2) + 2 * usize::from(y >= size.1 / 2);
        counts[quarter] += u64::from(unknown && !frusta.seen.inverse_depth[at].is_nan());
    }
    let (least, most) = (counts.iter().min(), counts.iter().max());
    assert!(least.is_some_and(|&least| least > 0), "{counts:?}");
    assert!(most.zip(least).is_some_and(|(most, least)| 10 * least >= 9 * most), "{counts:?}");
}

#[test]
fn missing_tiles_are_named_and_leave_their_pixels_unconfirmed() {
    let hills = |i, j| mountains(i, j, 128, 60.0, 4);
    let (mut resident, tiles) = store(vec![Plan::heights([0.0; 2], [1.0; 2], [700, 560], hills)]);
    let pyramid = Pyramid::new(resident.index());
    let view = View {
        camera: Camera::from_angles(DVec3::new(350.0, 5.0, 90.0), 10.0, -12.0, 3.0, 60.0, SIZE),
        shading: bare(None),
        quality: Quality::default(),
    };
    let whole = Region::whole(SIZE.0, SIZE.1);
    let mut known: Vec<f32> = vec![f32::NAN; whole.area() as usize];
    let mut rounds = 0;
    loop {
        let field = Field { resident: &resident, pyramid: &pyramid };
        let (seen, missing) = see(field, &view, whole).expect("it takes any view");
        for (known, &inverse) in known.iter_mut().zip(&seen.inverse_depth) {
            assert!(known.is_nan() || known.to_bits() == inverse.to_bits());
            *known = inverse;
        }
        assert_eq!(missing.is_empty(), known.iter().all(|inverse| !inverse.is_nan()));
        if missing.is_empty() {
            break;
        }
        for (key, tile) in &tiles {
            if missing.contains(key) {
                assert!(resident.insert(*key, tile.clone()));
            }
        }
        rounds += 1;
    }
    assert!((1..=keys(resident.index()).len()).contains(&rounds), "{rounds} rounds");
    assert!(resident.bytes() > 0);
}
