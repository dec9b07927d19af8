//! Photos seen at a slant show neither moire nor blur.
//!
//! A checkerboard is the hardest photo, the horizon the place where it is seen at the
//! most slanting angle. The measure is the picture by 64 samples a pixel of the slow
//! method. A picture that takes the photo's colour at the centre of each pixel (moire),
//! and the picture itself smoothed over 3 x 3 pixels (blur), must both fail.

use super::{Land, bare};
use crate::View;
use crate::tests_support::Plan;
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::Earth;

/// Measured: 29.5 to 36.3 dB; 12.1 to 15.0 pointwise, 18.4 to 21.8 blurred.
const LEAST_DB: f64 = 28.0;
const SIZE: (u32, u32) = (112, 63);
const STEP_M: f64 = 10.0;
const POSTS: u64 = 1500;
/// Posts along a side of a field of the checkerboard.
const FIELD: u64 = 8;
const DARK: f32 = 0.05;
const BRIGHT: f32 = 0.8;

fn is_bright(x: f64, y: f64) -> bool {
    let field = |value: f64| ((value / STEP_M + 0.5).floor() as u64) / FIELD;
    (field(x) + field(y)).is_multiple_of(2)
}

fn land() -> Land {
    let side = (POSTS - 1) as f64 * STEP_M;
    let photo = |i: u64, j: u64| {
        let bright = is_bright(i as f64 * STEP_M, j as f64 * STEP_M);
        let light = if bright { BRIGHT } else { DARK };
        [light, light, light, 1.0]
    };
    let plans = vec![
        Plan::heights([0.0; 2], [side; 2], [2, 2], |_, _| 0.0),
        Plan::photo([0.0; 2], [STEP_M; 2], [POSTS; 2], photo),
    ];
    Land::new("checkerboard", plans)
}

fn psnr(a: &[u8], b: &[u8]) -> f64 {
    let square = |(a, b): (&u8, &u8)| {
        let off = f64::from(*a) - f64::from(*b);
        off * off
    };
    let mean = a.iter().zip(b).map(square).sum::<f64>() / a.len() as f64;
    10.0 * libm::log10(255.0 * 255.0 / mean.max(1e-9))
}

fn smoothed(pixels: &[u8]) -> Vec<u8> {
    let (width, height) = (SIZE.0 as i64, SIZE.1 as i64);
    let at = |x: i64, y: i64, c: i64| {
        let (x, y) = (x.clamp(0, width - 1), y.clamp(0, height - 1));
        u32::from(pixels[((y * width + x) * 3 + c) as usize])
    };
    let mean = |index: i64| {
        let (x, y, c) = (index / 3 % width, index / 3 / width, index % 3);
        let sum: u32 = (-1..=1)
            .flat_map(|dy| (-1..=1).map(move |dx| (dx, dy)))
            .map(|(dx, dy)| at(x + dx, y + dy, c))
            .sum();
        (sum / 9) as u8
    };
    (0..width * height * 3).map(mean).collect()
}

/// The picture that takes the photo's colour at the centre of each pixel.
fn pointwise(land: &Land, view: &View, frame: &[u8]) -> Vec<u8> {
    let byte = |light: f32| crate::srgb::encode([light; 3])[0];
    let mut pixels = frame.to_vec();
    for (at, pixel) in pixels.chunks_exact_mut(3).enumerate() {
        let (x, y) = (at as u32 % SIZE.0, at as u32 / SIZE.0);
        let place = [f64::from(x) + 0.5, f64::from(y) + 0.5];
        if let Some(hit) = land.look(view, place) {
            let bright = is_bright(hit.position.x, hit.position.y);
            pixel.fill(byte(if bright { BRIGHT } else { DARK }));
        }
    }
    pixels
}

#[test]
fn a_checkerboard_at_the_horizon_is_neither_moire_nor_blur() {
    let land = land();
    let earth = Some(Earth { radius_m: 6_371_000.0, refraction: 0.13 });
    for (heading, pitch, height) in [(0.0, -2.0, 120.0), (33.0, -4.0, 300.0), (45.0, -15.0, 900.0)]
    {
        let place = DVec3::new(1203.0, 1207.0, height);
        let camera = Camera::from_angles(place, heading, pitch, 0.0, 50.0, SIZE);
        let quality =
            |method, samples_per_side| Quality { method, samples_per_side, ..Quality::default() };
        let view = View { camera, shading: bare(earth), quality: quality(Method::Exact, 1) };
        let truth = View { quality: quality(Method::Reference, 8), ..view.clone() };
        let all = Region::whole(SIZE.0, SIZE.1);
        let (frame, truth) = (land.render(&view, all).pixels, land.render(&truth, all).pixels);
        let found = psnr(&frame, &truth);
        let moire = psnr(&pointwise(&land, &view, &frame), &truth);
        let blur = psnr(&smoothed(&frame), &truth);
        let measured = format!(
            "{heading} {pitch}: {found:.1} dB; pointwise {moire:.1} dB, blurred {blur:.1} dB"
        );
        println!("{measured}");
        assert!(found > LEAST_DB && moire < LEAST_DB - 5.0 && blur < LEAST_DB - 5.0, "{measured}");
    }
}
