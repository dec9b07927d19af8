//! Tests of the pictures against everything that knows better: the slow twin, rational
//! arithmetic, spherical trigonometry, and the same picture under another split.
//!
//! They use what the crate offers to others and nothing else. `TERRAFARM_LONG=20` casts
//! twenty times as many rays.

mod flight;
mod fractions;
mod horizons;
mod moire;
mod pictures;
mod same_cells;
mod watertight;

use crate::tests_support::{Plan, mountains, noise, resident};
use crate::{Hit, Pyramid, Rendered, View, cast, render};
use glam::DVec3;
use terrafarm_common::camera::Camera;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_common::shading::{Earth, Shading};
use terrafarm_terrain::resident::Resident;

/// A store with its pyramid.
pub(crate) struct Land {
    pub name: &'static str,
    pub resident: Resident,
    pub pyramid: Pyramid,
}

impl Land {
    pub(crate) fn new(name: &'static str, plans: Vec<Plan>) -> Self {
        let resident = resident(plans);
        let pyramid = Pyramid::new(resident.index());
        Land { name, resident, pyramid }
    }

    /// What a ray meets; its direction need not be of unit length.
    pub(crate) fn cast(
        &self,
        method: Method,
        earth: Option<Earth>,
        start: DVec3,
        direction: DVec3,
    ) -> Option<Hit> {
        // The ray through the middle of a picture of one pixel is `forward`, to the bit.
        let camera = Camera {
            position: start,
            right: DVec3::X,
            up: DVec3::Z,
            forward: direction,
            tan_half_hfov: 1.0,
            width: 1,
            height: 1,
        };
        let quality = Quality { method, ..Quality::default() };
        let view = View { camera, shading: bare(earth), quality };
        self.look(&view, [0.5, 0.5])
    }

    /// What is seen at a point of a picture.
    pub(crate) fn look(&self, view: &View, [x_px, y_px]: [f64; 2]) -> Option<Hit> {
        cast(&self.resident, &self.pyramid, view, x_px, y_px).expect("all tiles are loaded")
    }

    /// The surface right below or above a place, looked for from `top`.
    pub(crate) fn height(&self, x: f64, y: f64, top: f64) -> Option<f64> {
        let start = DVec3::new(x, y, top);
        self.cast(Method::Reference, None, start, DVec3::NEG_Z).map(|hit| hit.height)
    }

    pub(crate) fn render(&self, view: &View, region: Region) -> Rendered {
        let rendered =
            render(&self.resident, &self.pyramid, view, region).expect("the method fits");
        assert!(rendered.missing.is_empty(), "all tiles are loaded");
        rendered
    }
}

/// No sun and no haze.
pub(crate) fn bare(earth: Option<Earth>) -> Shading {
    Shading { earth, below_ground: [0.5, 0.0, 0.5], ..Shading::default() }
}

/// A number of rays or rounds, as many times as `TERRAFARM_LONG` says.
pub(crate) fn count(short: u64) -> u64 {
    let times = std::env::var("TERRAFARM_LONG").ok();
    short * times.map_or(1, |times| times.parse().expect("TERRAFARM_LONG is a number of times"))
}

/// Terrains of every sort, most with posts at whole metres.
pub(crate) fn lands() -> Vec<Land> {
    let rough = |i, j| 40.0 * noise(i, j, 1);
    let smooth = |i, j| mountains(i, j, 64, 60.0, 2);
    let spiky = |i: u64, j: u64| if noise(i, j, 3) > 0.95 { 30.0 } else { 0.0 };
    let cliffs = |i: u64, j: u64| {
        let high = noise(i / 7, j / 9, 4) > 0.0;
        if high { 1000.0 + noise(i, j, 5) } else { noise(i, j, 6) }
    };
    let voids = |i: u64, j: u64| {
        if noise(i / 3, j / 3, 7) > 0.4 { f32::NAN } else { 20.0 * noise(i, j, 8) }
    };
    let gap = |i: u64, j: u64| {
        let void = (250..530).contains(&i) && j < 270;
        if void { f32::NAN } else { smooth(i, j) }
    };
    let single = |spacing, posts, height: &dyn Fn(u64, u64) -> f32| {
        vec![Plan::heights([-20.0, -30.0], spacing, posts, height)]
    };
    let insets = vec![
        Plan::heights([-20.0, -30.0], [3.0, 3.0], [40, 40], smooth),
        Plan::heights([10.5, 10.25], [1.0, 1.0], [25, 30], |i, j| smooth(i / 3, j / 3) + 5.0),
        Plan::heights([25.0, -30.0], [0.5, 0.25], [20, 90], voids),
        Plan::heights([97.0, 0.0], [1.0, 1.0], [9, 9], rough),
    ];
    let utm = vec![
        Plan::heights([562_000.0, 5_117_000.0], [30.0, 30.0], [300, 280], smooth),
        Plan::heights([564_000.25, 5_119_000.5], [10.0, 10.0], [60, 60], smooth),
    ];
    vec![
        Land::new("rough", single([1.0, 1.0], [65, 65], &rough)),
        Land::new("smooth", single([1.0, 1.0], [65, 65], &smooth)),
        Land::new("spiky", single([1.0, 1.0], [65, 65], &spiky)),
        Land::new("cliffs", single([1.0, 1.0], [65, 65], &cliffs)),
        Land::new("voids", single([1.0, 1.0], [65, 65], &voids)),
        Land::new("stretched", single([3.0, 1.0], [30, 80], &rough)),
        Land::new("two by two", single([7.0, 5.0], [2, 2], &rough)),
        Land::new("one by many", single([2.0, 2.0], [1, 50], &rough)),
        Land::new("two by many", single([2.0, 2.0], [2, 90], &rough)),
        Land::new("strip", single([1.0, 1.0], [300, 5], &smooth)),
        Land::new("insets", insets),
        Land::new("utm", utm),
        Land::new("tiles", single([1.0, 1.0], [600, 530], &smooth)),
        Land::new("void tiles", single([1.0, 1.0], [600, 530], &gap)),
    ]
}

/// A sequence of numbers from a seed.
pub(crate) struct Dice(u64);

impl Dice {
    pub(crate) fn new(seed: u64) -> Self {
        Dice(seed)
    }

    /// From 0 to 1, 1 excluded.
    pub(crate) fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(1);
        let bits = f64::from(noise(self.0, 11, 13)) * 0.5 + 0.5;
        let more = f64::from(noise(self.0, 17, 19)) * 0.5 + 0.5;
        (bits + more / 16_777_216.0).min(1.0 - 1e-16)
    }

    pub(crate) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// A whole number from 0 to `n` - 1.
    pub(crate) fn below(&mut self, n: u64) -> u64 {
        ((self.unit() * n as f64) as u64).min(n - 1)
    }

    /// A whole number from `low` to `high`, both included.
    pub(crate) fn whole(&mut self, low: i64, high: i64) -> i64 {
        low + self.below((high - low + 1) as u64) as i64
    }
}
