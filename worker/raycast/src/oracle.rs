//! Tests of `exact` against everything that knows better: its slow twin, rational
//! arithmetic, spherical trigonometry, and itself under another split.

mod same_cells;

use crate::exact::Exact;
use crate::field::{Contact, Field, Outcome};
use crate::path::Path;
use crate::pyramid::Pyramid;
use crate::reference::Reference;
use crate::tests_support::{Plan, mountains, noise, resident};
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

    pub(crate) fn field(&self) -> Field<'_> {
        Field { resident: &self.resident, pyramid: &self.pyramid }
    }
}

/// Terrains of every sort, with posts at whole metres.
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
    let single = |spacing, posts, height: &dyn Fn(u64, u64) -> f32| {
        vec![Plan::heights([-20.0, -30.0], spacing, posts, height)]
    };
    let insets = vec![
        Plan::heights([-20.0, -30.0], [3.0, 3.0], [40, 40], smooth),
        Plan::heights([10.5, 10.25], [1.0, 1.0], [25, 30], |i, j| smooth(i / 3, j / 3) + 5.0),
        Plan::heights([25.0, -30.0], [0.5, 0.25], [20, 90], voids),
        Plan::heights([97.0, 0.0], [1.0, 1.0], [9, 9], rough),
    ];
    vec![
        Land::new("rough", single([1.0, 1.0], [65, 65], &rough)),
        Land::new("smooth", single([1.0, 1.0], [65, 65], &smooth)),
        Land::new("spiky", single([1.0, 1.0], [65, 65], &spiky)),
        Land::new("cliffs", single([1.0, 1.0], [65, 65], &cliffs)),
        Land::new("voids", single([1.0, 1.0], [65, 65], &voids)),
        Land::new("stretched", single([3.0, 1.0], [30, 80], &rough)),
        Land::new("two by two", single([7.0, 5.0], [2, 2], &rough)),
        Land::new("strip", single([1.0, 1.0], [300, 5], &smooth)),
        Land::new("insets", insets),
        Land::new("tiles", single([1.0, 1.0], [600, 530], &smooth)),
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
}

pub(crate) fn exact(land: &Land, path: &Path) -> Option<Contact> {
    answer(Exact::new(land.field()).cast(path, 0.0))
}

pub(crate) fn answer(outcome: Outcome) -> Option<Contact> {
    match outcome {
        Outcome::Hit(contact) => Some(contact),
        Outcome::Miss => None,
        Outcome::Unfinished => panic!("all tiles are loaded"),
    }
}

/// Casts one ray by both methods and compares cells and places.
pub(crate) fn compare(
    exact: &mut Exact,
    reference: &mut Reference,
    path: &Path,
) -> Result<bool, String> {
    let (found, truth) = (answer(exact.cast(path, 0.0)), answer(reference.cast(path)));
    let same = match (&found, &truth) {
        (None, None) => true,
        (Some(a), Some(b)) => {
            (a.layer, a.cell) == (b.layer, b.cell) && (a.u - b.u).abs() <= 1e-6 * (1.0 + b.u)
        }
        _ => false,
    };
    if same {
        Ok(found.is_some())
    } else {
        Err(format!("{:?} {:?}: {found:?} instead of {truth:?}", path.origin, path.direction))
    }
}
