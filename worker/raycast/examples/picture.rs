//! Renders a made-up landscape to a PNG: `picture OUT.png [heading pitch height samples]`.

#[allow(dead_code)]
#[path = "../src/tests_support.rs"]
mod tests_support;

use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Earth, Haze, Shading, Sky, Sun};
use terrafarm_raycast::{Pyramid, View, render};
use tests_support::{Plan, mountains, noise, resident};

const POSTS: u64 = 1500;
const SPACING_M: f64 = 20.0;
const SIZE: (u32, u32) = (960, 540);

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let path = arguments.get(1).expect("the first argument is the picture to write");
    let number = |at: usize, default: f64| {
        arguments.get(at).map_or(default, |text| text.parse().expect("a number"))
    };
    let (heading, pitch, above) = (number(2, 45.0), number(3, -10.0), number(4, 600.0));
    let height = |i, j| 1500.0 + mountains(i, j, 512, 700.0, 7);
    let photo = |i: u64, j: u64| {
        let meadow = mountains(i, j, 64, 0.06, 90) + 0.02 * noise(i, j, 3);
        let snow = f32::from(u8::from(height(i, j) > 2100.0 + 200.0 * noise(i / 8, j / 8, 5)));
        let color = [0.16 + meadow, 0.20 + meadow, 0.07 + 0.5 * meadow];
        let [r, g, b] = color.map(|c| (c + (0.75 - c) * snow).clamp(0.0, 1.0));
        [r, g, b, 1.0]
    };
    let place = [0.0; 2];
    let heights = Plan::heights(place, [SPACING_M; 2], [POSTS; 2], height);
    let side = POSTS * 2 / 3;
    let colors = Plan::photo(place, [SPACING_M; 2], [side; 2], photo);
    let resident = resident(vec![heights, colors]);
    let pyramid = Pyramid::new(resident.index());
    let at = 200.0 * SPACING_M;
    let eye = DVec3::new(at, at, f64::from(height(200, 200)) + above);
    let view = View {
        camera: Camera::from_angles(eye, heading, pitch, number(6, 0.0), 60.0, SIZE),
        shading: Shading {
            sun: Some(Sun::at(100.0, 25.0, 0.25, 0.9)),
            haze: Some(Haze {
                visibility_m: 40_000.0,
                scale_height_m: 1500.0,
                color: [0.60, 0.70, 0.82],
            }),
            sky: Sky::default(),
            earth: Some(Earth { radius_m: 6_371_000.0, refraction: 0.13 }),
            below_ground: [0.05, 0.03, 0.02],
            bare_ground: None,
        },
        quality: Quality { samples_per_side: number(5, 1.0) as u32, ..Quality::default() },
    };
    let rendered =
        render(&resident, &pyramid, &view, Region::whole(SIZE.0, SIZE.1)).expect("exact fits");
    assert!(rendered.missing.is_empty());
    println!("{:?}", rendered.stats);
    let file = std::fs::File::create(path).expect("the picture can be created");
    let mut encoder = png::Encoder::new(std::io::BufWriter::new(file), SIZE.0, SIZE.1);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().expect("the header can be written");
    writer.write_image_data(&rendered.pixels).expect("the pixels can be written");
}
