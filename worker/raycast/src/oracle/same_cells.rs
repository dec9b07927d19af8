//! `exact` and `reference` find the same cells.

use super::{Dice, Land, compare, lands};
use crate::exact::Exact;
use crate::path::{Ground, Path};
use crate::reference::Reference;
use glam::DVec3;
use terrafarm_common::shading::Earth;

/// Rays of the short form of the test; `TERRAFARM_RAYS` asks for another number.
const RAYS: u64 = 1_000_000;

fn rays() -> u64 {
    std::env::var("TERRAFARM_RAYS").ok().and_then(|text| text.parse().ok()).unwrap_or(RAYS)
}

/// A start in and around the land, and a direction of any of the awkward kinds.
fn ray(land: &Land, dice: &mut Dice) -> (DVec3, DVec3) {
    let layer = &land.resident.index().layers[0];
    let far = layer.far_corner();
    let high = land.pyramid.highest() + 20.0;
    let along = |dice: &mut Dice, axis: usize| {
        let room = 0.2 * (far[axis] - layer.origin[axis]);
        let place = dice.between(layer.origin[axis] - room, far[axis] + room);
        match dice.below(4) {
            // Exactly on a line of the grid.
            0 => layer.origin[axis] + layer.spacing[axis] * (place / layer.spacing[axis]).floor(),
            1 => (place * 2.0).round() / 2.0,
            _ => place,
        }
    };
    let start = DVec3::new(
        along(dice, 0),
        along(dice, 1),
        dice.between(0.5 * (land.pyramid.lowest() + high), high),
    );
    let whole = |dice: &mut Dice| dice.below(7) as f64 - 3.0;
    let mut direction = match dice.below(8) {
        0 => DVec3::new(whole(dice), whole(dice), whole(dice)),
        1 => DVec3::new(whole(dice), 0.0, -dice.unit()),
        2 => DVec3::new(0.0, whole(dice), -dice.unit()),
        3 => DVec3::NEG_Z,
        4 => DVec3::new(dice.unit() - 0.5, dice.unit() - 0.5, 0.02 * (dice.unit() - 0.7)),
        _ => DVec3::new(dice.unit() - 0.5, dice.unit() - 0.5, 0.6 * (dice.unit() - 0.7)),
    };
    if direction == DVec3::ZERO {
        direction = DVec3::NEG_Z;
    }
    (start, direction.normalize())
}

#[test]
fn exact_and_reference_find_the_same_cells() {
    let lands = lands();
    let mut hits = 0;
    let mut cast = 0;
    for (number, land) in lands.iter().enumerate() {
        let mut exact = Exact::new(land.field());
        let mut reference = Reference::new(land.field());
        let mut dice = Dice::new(1000 * number as u64);
        // A ray of the largest land costs its twin as much as five others.
        let share = if land.name == "tiles" { 40 } else { 9 };
        for round in 0..rays() / share {
            // A small sphere bends rays as much here as the Earth does over kilometres.
            let earth = (round % 3 == 0).then_some(Earth { radius_m: 20_000.0, refraction: 0.1 });
            let (start, direction) = ray(land, &mut dice);
            let path = Path::new(Ground::new(earth), start, direction);
            match compare(&mut exact, &mut reference, &path) {
                Ok(hit) => hits += u64::from(hit),
                Err(why) => panic!("{}: {why}", land.name),
            }
            cast += 1;
        }
    }
    assert!(cast >= rays() && hits > cast / 4 && hits < cast, "{hits} of {cast}");
}
