//! Beams change nothing, and the tiles that pictures need are known as used.

use super::{Beams, WIDEST_PX};
use crate::exact::Exact;
use crate::field::{Contact, Field, Outcome};
use crate::oracle::{Dice, Land, lands};
use crate::painter::{path, squares};
use crate::path::Ground;
use crate::tests_support::{Plan, mountains, noise};
use crate::{View, render};
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Earth, Haze, Shading, Sky, Sun};

const SIZE: (u32, u32) = (101, 67);

/// A view from somewhere in or around a land.
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
    let pitch = match dice.below(4) {
        0 => -90.0,
        1 => dice.between(-90.0, 60.0),
        _ => dice.between(-30.0, 5.0),
    };
    let heading = if dice.below(3) == 0 { 90.0 } else { dice.between(0.0, 360.0) };
    let fov = [4.0, 60.0, 150.0][dice.below(3) as usize];
    // A small sphere bends rays as much here as the Earth does over kilometres.
    let earth = (dice.below(2) == 0).then_some(Earth { radius_m: 20_000.0, refraction: 0.1 });
    View {
        camera: Camera::from_angles(eye, heading, pitch, dice.between(-30.0, 30.0), fov, SIZE),
        shading: Shading {
            sun: Some(Sun::at(100.0, 25.0, 0.25, 0.9)),
            haze: Some(Haze { visibility_m: 900.0, scale_height_m: 0.0, color: [0.6; 3] }),
            sky: Sky::default(),
            earth,
            below_ground: [0.05, 0.03, 0.02],
            bare_ground: None,
        },
        quality: Quality::default(),
    }
}

fn field(land: &Land) -> Field<'_> {
    Field { resident: &land.resident, pyramid: &land.pyramid }
}

fn bits(contact: Option<Contact>) -> Option<(usize, [i32; 2], [u64; 4])> {
    let contact = contact?;
    let [x, y] = contact.place.map(f64::to_bits);
    Some((contact.layer, contact.cell, [contact.u.to_bits(), contact.z.to_bits(), x, y]))
}

#[test]
fn beams_change_no_bit_of_any_hit() {
    let (mut ahead, mut hits) = (0, 0);
    for (number, land) in lands().iter().enumerate() {
        let mut dice = Dice::new(77 + 1000 * number as u64);
        for _ in 0..12 {
            let view = view(land, &mut dice);
            let ground = Ground::new(view.shading.earth);
            let mut beams = Beams::new(field(land), &view.camera, ground);
            let mut exact = Exact::new(field(land));
            let answer = |outcome| match outcome {
                Outcome::Hit(contact) => Some(contact),
                Outcome::Miss => None,
                Outcome::Unfinished => panic!("all tiles are loaded"),
            };
            for square in squares(Region::whole(SIZE.0, SIZE.1)) {
                assert!(square.width <= WIDEST_PX && square.height <= WIDEST_PX);
                beams.narrow(square, &mut |part, free| {
                    for [x, y] in part.pixels() {
                        // The corners of a pixel are the farthest from the middle of the beam.
                        for (dx, dy) in [(0.5, 0.5), (0.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
                            let place = [f64::from(x) + dx, f64::from(y) + dy];
                            let (path, free_u) = path(&view.camera, ground, place, free);
                            let found = answer(exact.cast(&path, free_u));
                            let alone = answer(exact.cast(&path, 0.0));
                            assert_eq!(bits(found), bits(alone), "{} {x} {y} {view:?}", land.name);
                            ahead += u64::from(free_u > 0.0);
                            hits += u64::from(found.is_some());
                        }
                    }
                });
            }
        }
    }
    assert!(ahead > 100_000 && hits > 100_000, "{ahead} ahead, {hits} hits");
}

/// Heights with an inset and voids, and a photo that covers a part.
fn land() -> Land {
    let hills = |i, j| 100.0 + mountains(i, j, 128, 60.0, 4);
    let holed =
        |i: u64, j: u64| if i.is_multiple_of(37) { f32::NAN } else { 130.0 + noise(i, j, 8) };
    let color = |i: u64, j: u64| [noise(i, j, 1).abs(), 0.3, 0.1, 1.0];
    let plans = vec![
        Plan::heights([0.0; 2], [1.0; 2], [700, 560], hills),
        Plan::heights([300.0, 200.0], [0.5; 2], [300, 280], holed),
        Plan::photo([20.0, 30.0], [0.75; 2], [600, 500], color),
    ];
    Land::new("photo", plans)
}

#[test]
fn the_tiles_that_a_picture_needs_count_as_used() {
    let land = land();
    let mut dice = Dice::new(9);
    let mut told_apart = 0;
    for _ in 0..12 {
        let view = view(&land, &mut dice);
        let frame = Region::whole(SIZE.0, SIZE.1);
        let mut resident = land.resident.clone();
        resident.next_round();
        let picture = render(&resident, &land.pyramid, &view, frame).expect("exact fits");
        // Tiles of one age go in the order of keys, unused ones before used ones.
        let order = resident.clone().evict_to(0);
        let Some(last_unused) = order.windows(2).position(|pair| pair[0] > pair[1]) else {
            continue;
        };
        for &unused in &order[..=last_unused] {
            resident.remove(unused);
        }
        let again = render(&resident, &land.pyramid, &view, frame).expect("exact fits");
        assert_eq!(again.missing, []);
        assert_eq!(again.pixels, picture.pixels);
        told_apart += 1;
    }
    assert!(told_apart >= 6, "{told_apart} views");
}

#[test]
fn beams_over_a_single_post_end() {
    let post = Plan::heights([0.0; 2], [10.0; 2], [1, 1], |_, _| 5.0);
    let land = Land::new("post", vec![post]);
    let mut view = view(&land, &mut Dice::new(1));
    view.camera.position = DVec3::new(0.0, -300.0, 700.0);
    view.shading.earth = None;
    let whole = Region::whole(SIZE.0, SIZE.1);
    let rendered = render(&land.resident, &land.pyramid, &view, whole).expect("exact fits");
    assert_eq!((rendered.stats.hits, rendered.missing.len()), (0, 0));
}
