//! `exact` and `reference` find the same cells.

use super::{Dice, Land, count, lands};
use glam::DVec3;
use terrafarm_common::quality::Method;
use terrafarm_common::shading::Earth;

/// Rays of the short form of the test.
const RAYS: u64 = 1_000_000;
/// How far above or below the surface rays are aimed that nearly touch it, metres: far
/// more than rounding, far less than anything else.
const NEAR_M: f64 = 1e-6;

/// A start in and around the land, and a direction of any of the awkward kinds.
fn ray(land: &Land, dice: &mut Dice) -> (DVec3, DVec3) {
    let (low, high) = (land.pyramid.lowest() - 5.0, land.pyramid.highest() + 20.0);
    let deep = if dice.below(8) == 0 { low } else { 0.5 * (low + high) };
    let start = DVec3::new(along(land, dice, 0), along(land, dice, 1), dice.between(deep, high));
    let whole = |dice: &mut Dice| dice.whole(-3, 3) as f64;
    let mut direction = match dice.below(11) {
        0 => DVec3::new(whole(dice), whole(dice), whole(dice)),
        1 => DVec3::new(whole(dice), 0.0, -dice.unit()),
        2 => DVec3::new(0.0, whole(dice), -dice.unit()),
        3 => DVec3::NEG_Z,
        4 => DVec3::new(dice.unit() - 0.5, dice.unit() - 0.5, 0.02 * (dice.unit() - 0.7)),
        // Nearly along a line of the grid, and nearly straight down.
        5 => {
            let little = [1e-320, 1e-200, 1e-15, 1e-9][dice.below(4) as usize];
            let tilt = DVec3::new(whole(dice), whole(dice), 0.0) * little;
            tilt + [DVec3::X, DVec3::NEG_Y, DVec3::ZERO][dice.below(3) as usize]
                + DVec3::NEG_Z * dice.unit()
        }
        6 | 7 => {
            let (x, y) = (along(land, dice, 0), along(land, dice, 1));
            let side = if dice.below(2) == 0 { NEAR_M } else { -NEAR_M };
            let z = land.height(x, y, high).unwrap_or(low) + side;
            DVec3::new(x, y, z) - start
        }
        _ => DVec3::new(dice.unit() - 0.5, dice.unit() - 0.5, 0.6 * (dice.unit() - 0.7)),
    };
    if direction.length() < 0.5 * NEAR_M {
        direction = DVec3::NEG_Z;
    }
    (start, direction)
}

/// A coordinate in and around the land: on a line of the grid, at a whole or half metre,
/// or anywhere.
fn along(land: &Land, dice: &mut Dice, axis: usize) -> f64 {
    let layer = &land.resident.index().layers[0];
    let (first, last, step) = (layer.origin[axis], layer.far_corner()[axis], layer.spacing[axis]);
    let room = 0.2 * (last - first) + step;
    let place = dice.between(first - room, last + room);
    match dice.below(4) {
        0 => first + step * ((place - first) / step).floor(),
        1 => (place * 2.0).round() / 2.0,
        _ => place,
    }
}

/// Casts one ray by both methods; `Ok` tells whether it hit.
fn compare(
    land: &Land,
    earth: Option<Earth>,
    start: DVec3,
    direction: DVec3,
) -> Result<bool, String> {
    let found = land.cast(Method::Exact, earth, start, direction);
    let truth = land.cast(Method::Reference, earth, start, direction);
    let same = match (&found, &truth) {
        (None, None) => true,
        (Some(a), Some(b)) => {
            (a.layer, a.i, a.j) == (b.layer, b.i, b.j)
                && (a.distance_m - b.distance_m).abs() <= 1e-6 * (1.0 + b.distance_m)
        }
        _ => false,
    };
    if same {
        Ok(found.is_some())
    } else {
        Err(format!("{start:?} {direction:?} {earth:?}: {found:?} instead of {truth:?}"))
    }
}

#[test]
fn exact_and_reference_find_the_same_cells() {
    let lands = lands();
    let (mut hits, mut cast) = (0, 0);
    for (number, land) in lands.iter().enumerate() {
        let mut dice = Dice::new(1_000_000_000 * number as u64);
        // A ray of a large land costs its twin as much as five others.
        let share = if land.name.contains("tiles") { 60 } else { 11 };
        let mut hits_here = 0;
        for round in 0..count(RAYS) / share {
            // A small sphere bends rays as much here as the Earth does over kilometres.
            let earth = match round % 6 {
                0 | 3 => Some(Earth { radius_m: 20_000.0, refraction: 0.1 }),
                5 => Some(Earth { radius_m: 6_371_000.0, refraction: 0.13 }),
                _ => None,
            };
            let (start, direction) = ray(land, &mut dice);
            match compare(land, earth, start, direction) {
                Ok(hit) => hits_here += u64::from(hit),
                Err(why) => panic!("{}: {why}", land.name),
            }
            cast += 1;
        }
        // A single row of posts has no cells, hence no surface.
        assert_eq!(hits_here == 0, land.name == "one by many", "{}: {hits_here}", land.name);
        hits += hits_here;
    }
    println!("{cast} rays, {hits} hits: all the same");
    assert!(cast >= count(RAYS) && hits > cast / 4 && hits < cast, "{hits} of {cast}");
}
