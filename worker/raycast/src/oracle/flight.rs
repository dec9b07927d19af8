//! A flight of a thousand frames by `lod`: no pixel is off by more than the tolerance.
//!
//! Pixels of every frame, chosen by a seed, are compared with the surface of level 0 and
//! with the ground in front of it. The short form flies the same way in fifty frames.

use super::{Dice, Land, bare, count};
use crate::meter::{STEP_PX, measure};
use crate::tests_support::{Plan, mountains};
use crate::{View, depths};
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::Earth;

const SIZE: (u32, u32) = (160, 90);
const FRAMES: u64 = 50;
const PIXELS_A_FRAME: u64 = 200;
/// What single precision may add, pixels.
const ROUNDING_PX: f64 = 0.02;

fn land() -> Land {
    let height = |i, j| mountains(i, j, 512, 400.0, 33) * 0.7;
    Land::new("flight", vec![Plan::heights([0.0; 2], [12.0; 2], [1300, 1300], height)])
}

/// A spiral over the land, low and high by turns, banked in the turns; `t` from 0 to 1.
fn camera(land: &Land, t: f64) -> Camera {
    let turn = 12.0 * t;
    let (sine, cosine) = (libm::sin(turn), libm::cos(turn));
    let radius = 2000.0 + 4000.0 * t;
    let [x, y] = [7800.0 + radius * cosine, 7800.0 + radius * sine];
    let ground = land.height(x, y, 1e5).expect("the spiral stays over the land");
    let above = 60.0 + 900.0 * (0.5 + 0.5 * libm::sin(31.0 * t));
    let heading = 180.0 - turn.to_degrees();
    let pitch = -12.0 - 20.0 * (0.5 + 0.5 * libm::sin(17.0 * t));
    let roll = 25.0 * libm::sin(23.0 * t);
    let eye = DVec3::new(x, y, ground + above);
    Camera::from_angles(eye, heading, pitch, roll, 60.0, SIZE)
}

#[test]
fn no_pixel_of_a_flight_is_off_by_more_than_the_tolerance() {
    let land = land();
    let earth = Some(Earth { radius_m: 6_371_000.0, refraction: 0.13 });
    let frames = count(FRAMES);
    for tolerance_px in [0.5, 1.0] {
        let mut dice = Dice::new(77);
        let mut errors = Vec::new();
        for frame in 0..frames {
            let camera = camera(&land, frame as f64 / frames as f64);
            let quality = Quality { method: Method::Lod, samples_per_side: 1, tolerance_px };
            let view = View { camera, shading: bare(earth), quality };
            let whole = Region::whole(SIZE.0, SIZE.1);
            let (resident, pyramid) = (&land.resident, &land.pyramid);
            let seen = depths(resident, pyramid, &view, whole).expect("lod fits");
            for _ in 0..PIXELS_A_FRAME {
                let [x, y] = [SIZE.0, SIZE.1].map(|side| dice.below(u64::from(side)) as u32);
                let claimed = seen.distance_m(&view, x, y);
                let error = measure(resident, pyramid, &view, x, y, claimed).expect("all is there");
                let said = format!("frame {frame} of {frames}, pixel {x} {y}: {error:?}");
                let allowed = tolerance_px + ROUNDING_PX + STEP_PX;
                assert!(error.error_px() <= allowed, "{said}");
                errors.push(error.error_px());
            }
        }
        errors.sort_by(f64::total_cmp);
        let p99 = errors[errors.len() * 99 / 100];
        let max = errors[errors.len() - 1];
        println!(
            "lod at {tolerance_px} px, {frames} frames, {} pixels: p99 {p99:.3}, max {max:.3} px",
            errors.len()
        );
        assert!(p99 > 0.1 * tolerance_px, "coarser levels are in use: {p99}");
    }
}
