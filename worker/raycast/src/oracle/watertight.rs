//! No ray goes through the surface.

use super::{Dice, Land, count};
use crate::tests_support::{Plan, mountains, noise};
use glam::DVec3;
use terrafarm_common::quality::Method;
use terrafarm_common::shading::Earth;

const RAYS: u64 = 200_000;

/// A terrain without voids, and its heights.
struct Sheet {
    land: Land,
    origin: [f64; 2],
    spacing: [f64; 2],
    posts: [u64; 2],
    height: fn(u64, u64) -> f32,
}

impl Sheet {
    fn new(
        name: &'static str,
        origin: [f64; 2],
        spacing: [f64; 2],
        posts: [u64; 2],
        height: fn(u64, u64) -> f32,
    ) -> Self {
        let land = Land::new(name, vec![Plan::heights(origin, spacing, posts, height)]);
        Sheet { land, origin, spacing, posts, height }
    }

    fn all() -> Vec<Sheet> {
        let (near, utm) = ([-20.0, -30.0], [562_000.0, 5_117_000.0]);
        vec![
            Sheet::new("rough", near, [1.0; 2], [40, 40], |i, j| 40.0 * noise(i, j, 1)),
            Sheet::new("smooth", utm, [30.0; 2], [300, 290], |i, j| mountains(i, j, 64, 300.0, 2)),
            Sheet::new("cliffs", near, [1.0; 2], [50, 50], |i, j| {
                if noise(i / 2, j / 3, 4) > 0.0 { 1000.0 + noise(i, j, 5) } else { noise(i, j, 6) }
            }),
            Sheet::new("stretched", near, [3.0, 1.0], [20, 60], |i, j| 10.0 * noise(i, j, 9)),
            Sheet::new("flat", near, [1.0; 2], [270, 270], |_, _| 7.0),
        ]
    }

    /// The surface by its definition, apart from the crate's own code.
    fn surface(&self, place: [f64; 2]) -> f64 {
        let at = [0, 1].map(|axis| (place[axis] - self.origin[axis]) / self.spacing[axis]);
        let cell = [0, 1].map(|axis| (at[axis].floor() as u64).min(self.posts[axis] - 2));
        let [x, y] = [0, 1].map(|axis| at[axis] - cell[axis] as f64);
        let post = |di, dj| f64::from((self.height)(cell[0] + di, cell[1] + dj));
        (1.0 - x) * (1.0 - y) * post(0, 0)
            + x * (1.0 - y) * post(1, 0)
            + (1.0 - x) * y * post(0, 1)
            + x * y * post(1, 1)
    }

    /// A place over the sheet: in one case of two on a line of the grid.
    fn place(&self, dice: &mut Dice) -> [f64; 2] {
        [0, 1].map(|axis| {
            let last = (self.posts[axis] - 1) as f64;
            let at = dice.between(0.0, last);
            let at = if dice.below(2) == 0 { at.round() } else { at };
            self.origin[axis] + self.spacing[axis] * at
        })
    }
}

#[test]
fn every_downward_ray_from_above_hits_at_the_surface() {
    let sheets = Sheet::all();
    let (mut rays, mut worst) = (0u64, 0.0f64);
    for (number, sheet) in sheets.iter().enumerate() {
        let (lowest, highest) = (sheet.land.pyramid.lowest(), sheet.land.pyramid.highest());
        let mut dice = Dice::new(7_000_000_000 + 1_000_000_000 * number as u64);
        for round in 0..count(RAYS) / sheets.len() as u64 {
            let (from, to) = (sheet.place(&mut dice), sheet.place(&mut dice));
            let start = DVec3::new(from[0], from[1], highest + dice.between(0.01, 20.0));
            // Ends below the ground and over the sheet: the way there leads through it.
            let end = DVec3::new(to[0], to[1], lowest - dice.between(0.01, 2.0));
            let earth =
                (round % 4 == 0).then_some(Earth { radius_m: 6_371_000.0, refraction: 0.13 });
            // Over the sphere the ray ends higher by the drop, at most 11 m on this sheet.
            let end = if earth.is_some() { end - DVec3::Z * 12.0 } else { end };
            let hit = sheet.land.cast(Method::Exact, earth, start, end - start);
            let hit = hit.unwrap_or_else(|| panic!("{}: {start} to {end}", sheet.land.name));
            let surface = sheet.surface([hit.position.x, hit.position.y]);
            let off = (hit.position.z - surface).abs().max((hit.height - surface).abs());
            // A position of UTM size is known to a nanometre; a cliff multiplies that.
            assert!(off < 1e-6, "{}: {start} to {end}: {hit:?}, {surface}", sheet.land.name);
            worst = worst.max(off);
            rays += 1;
        }
    }
    println!("{rays} rays, all hit; farthest from the surface: {worst:.1e} m");
}

/// Three layers without voids, the later ones over parts of the earlier.
fn layers() -> Land {
    let hills = |i: u64, j: u64| mountains(i, j, 16, 20.0, 3);
    let plans = vec![
        Plan::heights([0.0; 2], [3.0; 2], [40, 40], hills),
        Plan::heights([10.5, 9.0], [1.0; 2], [50, 40], |i, j| hills(i / 3, j / 3) + 3.0),
        Plan::heights([40.25, 30.5], [0.5, 0.25], [99, 130], |i, j| hills(i / 6, j / 12) - 4.0),
    ];
    Land::new("layers", plans)
}

#[test]
fn no_ray_slips_between_layers() {
    let land = layers();
    let (lowest, highest) = (land.pyramid.lowest(), land.pyramid.highest());
    let layers = &land.resident.index().layers;
    let on_border = |place: DVec3| {
        layers.iter().any(|layer| {
            let far = layer.far_corner();
            (0..2).any(|axis| {
                let near = |border: f64| (place[axis] - border).abs() < 1e-9;
                near(layer.origin[axis]) || near(far[axis])
            })
        })
    };
    let mut dice = Dice::new(91_000_000_000);
    let mut walls = 0;
    for _ in 0..count(RAYS) {
        // Half of the coordinates lie on lines of one layer or another.
        let place = |dice: &mut Dice| {
            let at = dice.between(0.0, 117.0);
            if dice.below(2) == 0 { (4.0 * at).round() / 4.0 } else { at }
        };
        let start = DVec3::new(place(&mut dice), place(&mut dice), highest + dice.unit());
        let end = DVec3::new(place(&mut dice), place(&mut dice), lowest - dice.unit());
        let hit = land.cast(Method::Exact, None, start, end - start);
        let hit = hit.unwrap_or_else(|| panic!("{start} to {end}"));
        let deep = hit.height - hit.position.z;
        // Only a wall is met below the surface.
        assert!(deep > -1e-9, "{start} to {end}: {hit:?}");
        assert!(deep < 1e-9 || on_border(hit.position), "{start} to {end}: {hit:?}");
        walls += u64::from(deep >= 1e-9);
    }
    println!("{} rays, all hit, {walls} of them a wall", count(RAYS));
    assert!(walls > count(RAYS) / 1000);
}
