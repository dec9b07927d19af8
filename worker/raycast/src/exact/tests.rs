//! Rays abreast meet what their slow twin meets, to the bit, at every width.

use super::{Exact, Many};
use crate::field::{Contact, Field, Outcome};
use crate::lanes::Width;
use crate::oracle::{Dice, Land, lands};
use crate::painter::path;
use crate::path::Ground;
use crate::tests_support::{Plan, mountains, noise};
use glam::DVec3;
use std::collections::BTreeSet;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Method;
use terrafarm_common::shading::Earth;

const SIZE: (u32, u32) = (64, 40);

/// Everything that a hit is, as bits.
fn bits(outcome: &Outcome) -> Option<(usize, [i32; 2], [u64; 4])> {
    let Outcome::Hit(contact) = outcome else { return None };
    let Contact { layer, cell, u, z, place, .. } = contact;
    Some((*layer, *cell, [*u, *z, place[0], place[1]].map(f64::to_bits)))
}

/// Land that one height layer covers: what can be cast abreast.
pub(super) fn more_lands() -> Vec<Land> {
    let hills = |i, j| 300.0 + mountains(i, j, 128, 80.0, 4);
    let quarters = |i: u64, j: u64| (hills(i, j) * 4.0).round() / 4.0;
    let holed = |i: u64, j: u64| {
        let hole = i.wrapping_mul(i) % 61 < 2
            || (i + j).is_multiple_of(83)
            || (i / 256, j / 256) == (1, 0);
        if hole { f32::NAN } else { quarters(i, j) }
    };
    let low = |i: u64, j: u64| 0.002 * noise(i, j, 3);
    let high = |i: u64, j: u64| 3e6 + 1e5 * noise(i / 2, j, 3);
    let one = |plan| vec![plan];
    vec![
        Land::new("floats", one(Plan::heights([-40.0, 7.5], [1.0, 1.0], [601, 530], hills))),
        Land::new("codes", one(Plan::heights([1e6, -3e6], [10.0, 7.0], [530, 700], quarters))),
        Land::new("holes", one(Plan::heights([0.0; 2], [0.3, 0.4], [771, 300], holed))),
        Land::new("tiny", one(Plan::heights([5e5, 5e6], [1e-3, 2e-3], [90, 300], low))),
        Land::new("vast", one(Plan::heights([-7e6, 1e7], [9e4, 5e4], [300, 70], high))),
        Land::new("one cell", one(Plan::heights([0.0; 2], [5.0; 2], [2, 2], quarters))),
        Land::new(
            "rough",
            one(Plan::heights([0.0; 2], [1.0; 2], [300, 40], |i, j| 9.0 * noise(i, j, 3))),
        ),
    ]
}

/// A camera of any kind in and around the land.
fn camera(land: &Land, dice: &mut Dice) -> Camera {
    let layer = &land.resident.index().layers[0];
    let far = layer.far_corner();
    let (low, high) = (land.pyramid.lowest(), land.pyramid.highest());
    let afar = [0.1, 0.1, 3.0, 3e4][dice.below(4) as usize];
    let mut eye = [0.0; 2];
    for (axis, eye) in eye.iter_mut().enumerate() {
        let room = afar * (far[axis] - layer.origin[axis]);
        *eye = dice.between(layer.origin[axis] - room, far[axis] + room);
        if dice.below(4) == 0 {
            let step = layer.spacing[axis];
            *eye = layer.origin[axis] + step * ((*eye - layer.origin[axis]) / step).floor();
        }
    }
    let over = [20.0, 400.0][dice.below(2) as usize];
    // As high above the land as it is wide, or rather close to it.
    let wide = far[0] - layer.origin[0];
    let over = if dice.below(4) == 0 { wide.max(layer.spacing[0]) } else { over };
    let z = dice.between(low - 5.0, high + over);
    let pitch = [-90.0, 0.0, dice.between(-90.0, 30.0), dice.between(-20.0, 5.0)];
    let pitch = pitch[dice.below(4) as usize];
    let heading = [0.0, 90.0, dice.between(0.0, 360.0)][dice.below(3) as usize];
    let roll = [0.0, dice.between(-180.0, 180.0)][dice.below(2) as usize];
    let fov = [2.0, 60.0, 150.0][dice.below(3) as usize];
    Camera::from_angles(DVec3::new(eye[0], eye[1], z), heading, pitch, roll, fov, SIZE)
}

/// None, one on which rays bend within metres, and the real one.
fn earth(dice: &mut Dice) -> Option<Earth> {
    match dice.below(4) {
        0 => Some(Earth { radius_m: 20_000.0, refraction: 0.1 }),
        1 => Some(Earth { radius_m: 6_371_000.0, refraction: 0.13 }),
        _ => None,
    }
}

#[test]
fn every_width_finds_the_same_bits_as_the_slow_twin() {
    let (mut hits, mut misses) = (0u64, 0u64);
    for (number, land) in lands().into_iter().chain(more_lands()).enumerate() {
        let field = Field { resident: &land.resident, pyramid: &land.pyramid };
        let mut dice = Dice::new(5 + 1000 * number as u64);
        for _ in 0..crate::oracle::count(24) {
            let camera = camera(&land, &mut dice);
            let ground = Ground::new(earth(&mut dice));
            // Each anywhere, or by squares of sixteen as far apart as pixels, or closer.
            let apart = [None, Some(1.0), Some(0.1)][dice.below(3) as usize];
            let mut places = Vec::new();
            let mut first = [0.0; 2];
            for ray in 0..500 {
                let along = |dice: &mut Dice, size: u32| match dice.below(3) {
                    0 => dice.below(u64::from(2 * size) + 1) as f64 * 0.5,
                    _ => dice.between(0.0, f64::from(size)),
                };
                if ray % 16 == 0 || apart.is_none() {
                    first = [along(&mut dice, SIZE.0), along(&mut dice, SIZE.1)];
                }
                let [column, row] = [ray % 4, ray / 4 % 4].map(f64::from);
                let apart = apart.unwrap_or(0.0);
                places.push([first[0] + apart * column, first[1] + apart * row]);
            }
            let mut exact = Exact::new(field);
            let truths: Vec<Outcome> = places
                .iter()
                .map(|&place| exact.cast(&path(&camera, ground, place, 0.0).0, 0.0))
                .collect();
            for width in Width::available() {
                let mut many = Many::new(field, &camera, ground, Method::Exact, width);
                for (&place, truth) in places.iter().zip(&truths) {
                    // Free up to somewhere before the contact.
                    let (ray, per_depth) = path(&camera, ground, place, 1.0);
                    let share = [0.0, 0.0, dice.unit(), 0.999_999][dice.below(4) as usize];
                    let depth = match truth {
                        Outcome::Hit(contact) => share * contact.u / per_depth,
                        _ => [0.0, f64::INFINITY][dice.below(2) as usize],
                    };
                    assert!(ray.direction.is_finite());
                    many.push(place, depth);
                }
                many.cast();
                for (ray, truth) in truths.iter().enumerate() {
                    let what = || format!("{} {width:?} {camera:?} {:?}", land.name, places[ray]);
                    let found = many.outcome(ray);
                    assert_eq!(bits(&found), bits(truth), "{}", what());
                    let (path, _) = many.path(ray);
                    if let Outcome::Hit(contact) = &found {
                        let depth = contact.u * path.direction.dot(camera.forward);
                        let inverse = (1.0 / depth) as f32;
                        assert_eq!(many.inverse_depths(ray, 1), [inverse], "{}", what());
                        assert_eq!(many.direction(ray), path.direction, "{}", what());
                        hits += 1;
                    } else {
                        assert_eq!(many.inverse_depths(ray, 1), [0.0], "{}", what());
                        misses += 1;
                    }
                }
                // As after beams that meet nothing, where rays have hit before: whole vectors
                // are left out, and some of the last one.
                many.clear();
                let (beyond, left) = places.split_at(dice.below(400) as usize);
                beyond.iter().for_each(|&place| many.push(place, f64::INFINITY));
                left.iter().take(20).for_each(|&place| many.push(place, 0.0));
                many.cast();
                for ray in 0..many.len() {
                    let truth = truths[ray..].first().filter(|_| ray >= beyond.len());
                    let is_hit = matches!(truth, Some(Outcome::Hit(_)));
                    assert_eq!(many.is_hit(ray), Some(is_hit), "{} {width:?}", land.name);
                }
            }
        }
    }
    println!("{hits} hits, {misses} misses: all the same");
    assert!(hits > 100_000 && misses > 50_000, "{hits} hits, {misses} misses");
}

#[test]
fn every_width_waits_for_the_same_tiles_as_the_slow_twin() {
    let (mut unfinished, mut finished) = (0, 0);
    for (number, land) in lands().into_iter().chain(more_lands()).enumerate() {
        let mut dice = Dice::new(99 + 1000 * number as u64);
        for _ in 0..crate::oracle::count(8) {
            let mut resident = land.resident.clone();
            let loaded: Vec<_> = land.resident.loaded().collect();
            for key in loaded.into_iter().filter(|_| dice.below(3) == 0) {
                resident.remove(key);
            }
            let field = Field { resident: &resident, pyramid: &land.pyramid };
            let camera = camera(&land, &mut dice);
            let ground = Ground::new(earth(&mut dice));
            let places: Vec<[f64; 2]> = (0..200)
                .map(|_| [f64::from(SIZE.0), f64::from(SIZE.1)].map(|size| size * dice.unit()))
                .collect();
            let mut exact = Exact::new(field);
            let truths: Vec<Outcome> = places
                .iter()
                .map(|&place| exact.cast(&path(&camera, ground, place, 0.0).0, 0.0))
                .collect();
            let mut expected = BTreeSet::new();
            exact.wanted.drain_into(&mut expected);
            for width in Width::available() {
                let mut many = Many::new(field, &camera, ground, Method::Exact, width);
                places.iter().for_each(|&place| many.push(place, 0.0));
                many.cast();
                for (ray, truth) in truths.iter().enumerate() {
                    let found = many.outcome(ray);
                    assert_eq!(bits(&found), bits(truth), "{} {width:?} {camera:?}", land.name);
                    let open = matches!(truth, Outcome::Unfinished);
                    assert_eq!(matches!(found, Outcome::Unfinished), open, "{}", land.name);
                    if open { unfinished += 1 } else { finished += 1 }
                }
                let mut missing = BTreeSet::new();
                many.slow.finish(&mut missing);
                assert_eq!(missing, expected, "{} {width:?} {camera:?}", land.name);
            }
        }
    }
    assert!(unfinished > 5_000 && finished > 20_000, "{unfinished} unfinished, {finished} not");
}
