#![allow(clippy::unwrap_used)]
use super::patch::STEPS;
use super::*;
use crate::lanes::One;
use crate::oracle::{Dice, Land, bare, count};
use crate::tests_support::{Plan, mountains, store};
use crate::{Pyramid, View};
use glam::DVec3;
use terrafarm_common::quality::Quality;
use terrafarm_terrain::layout::Level;
use terrafarm_terrain::resident::Resident;

const POSTS: [u64; 2] = [1100, 700];

fn height(i: u64, j: u64) -> f32 {
    mountains(i, j, 512, 200.0, 21) * 0.3
}

fn plan(holes: bool) -> Plan {
    let holed = move |i, j| {
        let hole = holes && i / 300 == 1 && j / 40 == 3;
        if hole { f32::NAN } else { height(i, j) }
    };
    Plan::heights([1000.0, -500.0], [9.0, 10.0], POSTS, holed)
}

fn view(dice: &mut Dice, highest: f64) -> View {
    let eye = [dice.between(-5000.0, 15_000.0), dice.between(-9000.0, 9000.0)];
    let position = DVec3::new(eye[0], eye[1], highest + dice.between(10.0, 3000.0));
    let camera = Camera::from_angles(position, 10.0, -20.0, 0.0, 60.0, (320, 180));
    View { camera, shading: bare(None), quality: Quality::default() }
}

/// Heights that a plot is seen at over the posts of level 0 in it, row by row; NaN for none.
fn heights(relief: &Relief, number: i32) -> Vec<f64> {
    let plot = relief.plot(number);
    let Soil::Loaded(loaded) = &plot.ground else { panic!("a plot without ground") };
    let first = [number % relief.plots[0], number / relief.plots[0]].map(|at| at * 256);
    let mut heights = Vec::new();
    for j in first[1]..=(first[1] + 256).min(relief.cells[1]) {
        for i in first[0]..=(first[0] + 256).min(relief.cells[0]) {
            // The last posts belong to the cells before them.
            let cell = [(i, 0), (j, 1)].map(|(at, axis)| {
                at.min(first[axis] + 255).min(relief.cells[axis] - 1) >> plot.level
            });
            let side = f64::from(1 << plot.level);
            let [u, v] = [f64::from(i), f64::from(j)];
            let (u, v) = (u / side - f64::from(cell[0]), v / side - f64::from(cell[1]));
            let cell = cell.map(<One as Lanes>::I::splat);
            let all = !<One as Lanes>::M::none();
            let (solid, corners) = loaded.posts().corners::<One>(0.0, cell, all);
            let corners = corners.map(|corner| {
                let mut out = [0.0; MOST];
                corner.store(&mut out);
                f64::from(out[0])
            });
            let [sw, se, nw, ne] = corners;
            let (south, north) = (sw + (se - sw) * u, nw + (ne - nw) * u);
            heights.push(if solid.any() { south + (north - south) * v } else { f64::NAN });
        }
    }
    heights
}

/// What single precision adds, metres.
const SINGLE_M: f64 = 1e-3;

#[test]
fn no_plot_is_seen_further_from_level_0_than_is_allowed_there() {
    let mut blended = 0;
    for (number, holes) in [(0, false), (1, true)] {
        let land = Land::new("land", vec![plan(holes)]);
        let field = Field { resident: &land.resident, pyramid: &land.pyramid };
        let mut dice = Dice::new(number);
        for _ in 0..count(8) {
            let view = view(&mut dice, land.pyramid.highest());
            let tolerance_px = libm::exp2(dice.between(-7.0, 0.0));
            let relief = Relief::new(field, &view, tolerance_px, Lack::Open);
            let finest = Relief::new(field, &view, 0.0, Lack::Open);
            for number in 0..relief.plots[0] * relief.plots[1] {
                let at = [number % relief.plots[0], number / relief.plots[0]];
                let allowed = relief.tolerance * relief.distance(at);
                let Soil::Loaded(loaded) = &relief.plot(number).ground else { panic!("{at:?}") };
                blended += u32::from(loaded.patch.is_some());
                let truth = heights(&finest, number);
                assert_eq!(finest.plot(number).level, 0);
                for (seen, truth) in heights(&relief, number).iter().zip(&truth) {
                    assert_eq!(seen.is_nan(), truth.is_nan());
                    let off = (seen - truth).abs();
                    assert!(off.is_nan() || off <= allowed + SINGLE_M, "{off} of {allowed}");
                }
            }
        }
    }
    assert!(blended > 20, "{blended} plots were between levels");
}

#[test]
fn a_plot_changes_by_a_step_of_the_weight_where_its_level_does() {
    let land = Land::new("land", vec![plan(false)]);
    let field = Field { resident: &land.resident, pyramid: &land.pyramid };
    let view = view(&mut Dice::new(5), land.pyramid.highest());
    let with = |tolerance| {
        let mut relief = Relief::new(field, &view, 1.0, Lack::Open);
        relief.tolerance = tolerance;
        relief
    };
    let layer = &land.resident.index().layers[0];
    let mut switches = 0;
    for level in 0..layer.root_level() {
        let relief = with(1.0);
        for number in 0..relief.plots[0] * relief.plots[1] {
            let at = [number % relief.plots[0], number / relief.plots[0]];
            let deviation = |level: usize| {
                let [tx, ty] = at.map(|at| at as u32 >> level);
                f64::from(layer.entry(level, tx, ty).unwrap().deviation)
            };
            let (fine, coarse) = (deviation(level), deviation(level + 1));
            let tolerance = coarse / relief.distance(at);
            let (before, after) = (with(tolerance * (1.0 - 1e-4)), with(tolerance * (1.0 + 1e-9)));
            assert_eq!(before.plot(number).level as usize, level);
            if after.plot(number).level as usize != level + 1 {
                continue;
            }
            switches += 1;
            // Rounding may cost one step more.
            let most = (fine + coarse) * 2.0 / f64::from(STEPS) + SINGLE_M;
            for (before, after) in heights(&before, number).iter().zip(heights(&after, number)) {
                let apart = (before - after).abs();
                assert!(apart <= most, "{apart} m, {most}: level {level} of {at:?}");
            }
        }
    }
    assert!(switches > 10, "{switches}");
}

#[test]
fn a_plot_whose_coarser_tile_is_late_waits_for_it_or_is_seen_as_it_is() {
    let (mut some, tiles) = store(vec![plan(false)]);
    let pyramid = Pyramid::new(some.index());
    for (key, tile) in &tiles {
        some.insert(*key, tile.clone());
    }
    let view = view(&mut Dice::new(5), pyramid.highest());
    let relief = |resident, lack| {
        let field = Field { resident, pyramid: &pyramid };
        Relief::new(field, &view, 0.05, lack)
    };
    let whole: Resident = some.clone();
    let first = relief(&whole, Lack::Open);
    let blended = |number: &i32| matches!(&first.plot(*number).ground, Soil::Loaded(loaded) if loaded.patch.is_some());
    let number = (0..first.plots[0] * first.plots[1]).find(blended).unwrap();
    let level = first.plot(number).level as usize;
    let key = first.key([number % first.plots[0], number / first.plots[0]], level + 1);
    some.remove(key);
    let open = relief(&some, Lack::Open);
    assert!(matches!(open.plot(number).ground, Soil::Absent));
    assert_eq!(open.wanted(), [key]);
    let coarser = relief(&some, Lack::Coarser);
    let plot = coarser.plot(number);
    assert!(matches!(&plot.ground, Soil::Loaded(loaded) if loaded.patch.is_none()));
    assert_eq!((plot.level as usize, plot.coarser), (level, false));
    assert_eq!(coarser.wanted(), [key]);
}

#[test]
fn patches_are_shared_by_all_that_look_at_a_store_and_by_no_other() {
    let lands = [Land::new("one", vec![plan(false)]), Land::new("two", vec![plan(false)])];
    let view = view(&mut Dice::new(5), lands[0].pyramid.highest());
    let pyramids = [&lands[0].pyramid, &lands[0].pyramid.clone(), &lands[1].pyramid];
    let residents = [&lands[0].resident, &lands[0].resident, &lands[1].resident];
    let reliefs = [0, 1, 2].map(|n| {
        let field = Field { resident: residents[n], pyramid: pyramids[n] };
        Relief::new(field, &view, 0.05, Lack::Open)
    });
    let mut shared = 0;
    for number in 0..reliefs[0].plots[0] * reliefs[0].plots[1] {
        let patches = reliefs.each_ref().map(|relief| match &relief.plot(number).ground {
            Soil::Loaded(loaded) => loaded.patch.clone(),
            _ => panic!("a plot without ground"),
        });
        let [Some(first), Some(again), Some(other)] = patches else { continue };
        assert!(std::sync::Arc::ptr_eq(&first, &again));
        assert!(!std::sync::Arc::ptr_eq(&first, &other));
        assert_eq!(first.codes, other.codes);
        shared += 1;
    }
    assert!(shared > 0);
}

#[test]
fn plots_of_a_vast_store_are_known_as_rays_come_to_them() {
    let land = Land::new("land", vec![plan(false)]);
    let field = Field { resident: &land.resident, pyramid: &land.pyramid };
    let view = view(&mut Dice::new(5), land.pyramid.highest());
    let relief = Relief::new(field, &view, 0.05, Lack::Open);
    let count = (relief.plots[0] * relief.plots[1]) as usize;
    let Level { tiles, .. } = &land.resident.index().layers[0].levels[0];
    assert_eq!(count, tiles[0] as usize * tiles[1] as usize);
    assert!(relief.known.iter().all(|group| group.get().is_none()));
    let last = relief.plot(count as i32 - 1);
    assert!(std::ptr::eq(last, relief.plot(count as i32 - 1)));
}
