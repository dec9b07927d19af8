//! Horizons as spherical trigonometry has them: sea, wall and cone, to 300 km away.
//!
//! The picture is 1920 pixels wide and 60 degrees across; the row of the horizon is found
//! by halving between ground and sky. On the map, distance from the camera is an arc on
//! the sphere of the effective radius R' and azimuths are true, so a point of height z at
//! the distance d from a camera of height h shows at an elevation of
//! `atan(((R' + z) cos(d / R') - R' - h) / ((R' + z) sin(d / R')))`.

use super::{Land, bare};
use crate::View;
use crate::tests_support::Plan;
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::Quality;
use terrafarm_common::shading::Earth;

/// What a horizon may be off by, pixels.
const TOLERANCE_PX: f64 = 0.01;
const SIZE: (u32, u32) = (1920, 1080);
/// Columns of the picture that are looked at.
const COLUMNS: [f64; 5] = [0.0, 311.5, 960.0, 1200.0, 1920.0];
const EARTHS: [Earth; 2] = [
    Earth { radius_m: 6_371_000.0, refraction: 0.0 },
    Earth { radius_m: 6_371_000.0, refraction: 0.13 },
];

/// Looks north from `height` above the map's origin.
fn view(earth: Earth, height: f64) -> View {
    let camera = Camera::from_angles(DVec3::Z * height, 0.0, 0.0, 0.0, 60.0, SIZE);
    View { camera, shading: bare(Some(earth)), quality: Quality::default() }
}

/// Where ground turns to sky in a column, pixels from the top.
fn horizon(land: &Land, view: &View, column: f64) -> f64 {
    let (mut sky, mut ground) = (0.0, f64::from(SIZE.1));
    assert!(land.look(view, [column, sky]).is_none());
    assert!(land.look(view, [column, ground]).is_some());
    for _ in 0..48 {
        let middle = 0.5 * (sky + ground);
        match land.look(view, [column, middle]) {
            Some(_) => ground = middle,
            None => sky = middle,
        }
    }
    ground
}

/// The row of a direction of a given slope, the tangent of its elevation, in a column of
/// a picture that is level.
fn row(view: &View, column: f64, slope: f64) -> f64 {
    let across = (column - 960.0) / view.camera.focal_px();
    540.0 - view.camera.focal_px() * slope * (1.0 + across * across).sqrt()
}

/// Tangent of the elevation of a point of height `z` at the distance `d`.
fn slope(earth: Earth, height: f64, z: f64, d: f64) -> f64 {
    let radius = earth.effective_radius_m();
    let (top, phi) = (radius + z, d / radius);
    let sine = phi.sin();
    let half = (0.5 * phi).sin();
    // cos(phi) = 1 - 2 sin^2(phi / 2), to lose nothing at small angles.
    ((z - height) - 2.0 * top * half * half) / (top * sine)
}

#[track_caller]
fn check(what: &str, found: f64, expected: f64, worst: &mut f64) {
    let off = (found - expected).abs();
    assert!(off < TOLERANCE_PX, "{what}: row {found}, not {expected}");
    *worst = worst.max(off);
}

#[test]
fn the_sea_horizon_is_where_the_line_of_sight_touches_the_sphere() {
    let plan = Plan::heights([-400_000.0, -10_000.0], [2000.0; 2], [401, 251], |_, _| 0.0);
    let sea = Land::new("sea", vec![plan]);
    let mut worst = 0.0;
    for earth in EARTHS {
        let radius = earth.effective_radius_m();
        for height in [2.0, 30.0, 500.0, 3000.0, 6500.0f64] {
            let dip = (radius / (radius + height)).acos();
            let view = view(earth, height);
            for column in COLUMNS {
                let expected = row(&view, column, -dip.tan());
                let found = horizon(&sea, &view, column);
                check(&format!("{earth:?} {height} m"), found, expected, &mut worst);
            }
        }
    }
    println!("sea horizons are off by at most {worst:.1e} px");
}

#[test]
fn a_wall_stands_as_high_over_the_sphere_as_it_should() {
    let mut worst = 0.0;
    for (distance, wall_height) in [(10_000.0, 300.0), (60_000.0, 1200.0), (300_000.0, 8000.0)] {
        let step = distance / 50.0;
        // Posts of 0 m, and one row of the wall's height `distance` to the north.
        let plan = Plan::heights([-60.0 * step, -2.0 * step], [step; 2], [121, 56], |_, j| {
            if j == 52 { wall_height as f32 } else { 0.0 }
        });
        let wall = Land::new("wall", vec![plan]);
        for earth in EARTHS {
            for height in [0.002, 0.02, 0.04].map(|share| share * distance) {
                let view = view(earth, height);
                for column in COLUMNS {
                    let across = (column - 960.0) / view.camera.focal_px();
                    let away = distance * (1.0 + across * across).sqrt();
                    let top = slope(earth, height, wall_height, away);
                    let expected = row(&view, column, top);
                    let found = horizon(&wall, &view, column);
                    let what = format!("{earth:?} {distance} m, from {height} m, {column}");
                    check(&what, found, expected, &mut worst);
                }
            }
        }
    }
    println!("wall horizons are off by at most {worst:.1e} px");
}

/// A cone on the sphere: height falls along the map from the tip at (0, `distance`).
struct Cone {
    distance: f64,
    height: f64,
    fall: f64,
}

impl Cone {
    fn z(&self, x: f64, y: f64) -> f64 {
        let away = (x * x + (y - self.distance) * (y - self.distance)).sqrt();
        (self.height - self.fall * away).max(0.0)
    }

    /// The greatest slope from the camera to the cone in a direction of the map, whose
    /// tangent is `across`.
    fn silhouette(&self, earth: Earth, height: f64, across: f64) -> f64 {
        let length = (1.0 + across * across).sqrt();
        let seen = |d: f64| slope(earth, height, self.z(d * across / length, d / length), d);
        let (near, far) = (0.75 * self.distance, 1.25 * self.distance);
        let steps = 20_000;
        let at = |n: i32| near + (far - near) * f64::from(n) / f64::from(steps);
        let best = (0..=steps).max_by(|&a, &b| seen(at(a)).total_cmp(&seen(at(b))));
        let best = best.expect("there are steps");
        let (mut low, mut high) = (at(best - 1), at(best + 1));
        for _ in 0..80 {
            let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
            if seen(a) < seen(b) { low = a } else { high = b }
        }
        seen(low)
    }
}

#[test]
fn a_cone_shows_its_tip_and_its_flanks_over_the_sphere() {
    let mut worst = 0.0;
    for (distance, height, fall) in [(40_000.0, 2000.0, 0.2), (300_000.0, 9000.0, 0.15)] {
        let cone = Cone { distance, height, fall };
        // Bilinear cells cut a cone's flank short by step^2 fall / 8 r at r from its tip:
        // with steps of a 1500th of the distance that is a 200th of a pixel ten pixels
        // beside the tip.
        let step = distance / 1500.0;
        let south = distance - 250.0 * step;
        let sea =
            Plan::heights([-distance, -distance / 3.0], [distance / 3.0; 2], [7, 6], |_, _| 0.0);
        let inset = Plan::heights([-300.0 * step, south], [step; 2], [601, 501], |i, j| {
            cone.z((i as f64 - 300.0) * step, south + j as f64 * step) as f32
        });
        let land = Land::new("cone", vec![sea, inset]);
        for earth in EARTHS {
            for height in [100.0, 2500.0] {
                let view = view(earth, height);
                for column in [960.0, 970.0, 985.0, 925.0, 1010.0] {
                    let across = (column - 960.0) / view.camera.focal_px();
                    let top = cone.silhouette(earth, height, across);
                    let dip =
                        (earth.effective_radius_m() / (earth.effective_radius_m() + height)).acos();
                    assert!(top > -dip.tan() + 1e-3, "{column} shows the sea");
                    let expected = row(&view, column, top);
                    let found = horizon(&land, &view, column);
                    let what = format!("{earth:?} {distance} m, from {height} m, {column}");
                    check(&what, found, expected, &mut worst);
                }
            }
        }
    }
    println!("cone horizons are off by at most {worst:.1e} px");
}
