//! Shading against itself at other widths, and against the same in f64.

use super::*;
use crate::lanes::One;

fn light(sun: &Sun, slopes: [f32; 2]) -> f32 {
    let mut out = [0.0];
    Sunlight::new(sun).light::<One>(slopes.map(Floats::splat)).store(&mut out);
    out[0]
}

#[test]
fn flat_ground_keeps_the_brightness_of_the_photo() {
    for elevation in [5.0, 30.0, 90.0] {
        let sun = Sun::at(130.0, elevation, 0.25, 0.8);
        assert!((light(&sun, [0.0, 0.0]) - 1.0).abs() < 1e-6);
    }
}

#[test]
fn light_fades_to_the_ambient_share_when_the_sun_sets() {
    let at = |elevation| light(&Sun::at(90.0, elevation, 0.2, 1.0), [0.0, 0.0]);
    assert_eq!(at(-1.0), 0.2);
    assert!((at(0.01) - 0.2).abs() < 0.01);
    let sun = Sun::at(90.0, 10.0, 0.2, 1.0);
    assert!(light(&sun, [-0.5, 0.0]) > 1.0 && light(&sun, [0.5, 0.0]) < 0.5);
}
