#![allow(clippy::unwrap_used)]
use super::*;
use crate::tests_support::noise;
use proptest::prelude::*;

/// A tile of noise, on whole steps or not, with voids one post in `holes`.
fn tile(relief: f32, step: f32, holes: u32, seed: u64) -> HeightTile {
    let posts = (0..TILE_POSTS * TILE_POSTS).map(|at| {
        let value = noise(at as u64, 0, seed);
        let height = 700.0 + relief * value;
        let void = holes > 0 && noise(at as u64, 1, seed) > 1.0 - 2.0 / holes as f32;
        match step {
            _ if void => f32::NAN,
            0.0 => height,
            step => (height / step).round() * step,
        }
    });
    HeightTile::new(posts.collect()).unwrap()
}

/// A post of a plot, by its tile's level, from its south-west.
fn post(tile: &HeightTile, plot: [i32; 2], level: u32, [i, j]: [usize; 2]) -> f64 {
    let corner = plot.map(|at| ((at % (1 << level)) << (8 - level)) as isize);
    f64::from(tile.post(corner[0] + i as isize, corner[1] + j as isize))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn every_post_is_the_mean_of_both_levels_and_void_where_one_is(
        level in 0u32..8, weight in 1..STEPS, plot in [0i32..300, 0i32..300], seed: u64,
        relief in prop::sample::select(vec![2000.0f32, 30.0, 0.05, 0.0]),
        steps in prop::sample::select(vec![[0.0f32, 0.0], [1.0, 0.125], [0.0, 1.0], [0.1, 0.0]]),
        holes in prop::sample::select(vec![[0u32, 0], [0, 9], [40, 0], [30, 50], [2, 2]]),
    ) {
        let fine = tile(relief, steps[0], holes[0], seed);
        let coarse = tile(relief, steps[1], holes[1], seed ^ 1);
        let patch = Patch::new(plot, level, weight, &fine, &coarse);
        let side = (TILE_CELLS >> level) + 1;
        prop_assert_eq!((patch.side, patch.codes.len()), (side, side * side + 1));
        prop_assert_eq!(patch.codes.last(), Some(&VOID));
        let share = f64::from(weight) / f64::from(STEPS);
        let extent = 2.0 * f64::from(relief) + f64::from(steps[0].max(steps[1]));
        let off = ROUNDING * extent + ROUNDING_M;
        let mut voids = 0;
        for j in 0..side {
            for i in 0..side {
                let own = post(&fine, plot, level, [i, j]);
                // Of a post between two, i / 2 and (i + 1) / 2 are its neighbours.
                let up = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(di, dj)| {
                    post(&coarse, plot, level + 1, [(i + di) / 2, (j + dj) / 2])
                });
                let up = up.iter().sum::<f64>() / 4.0;
                let mean = own + share * (up - own);
                let code = patch.codes[j * side + i];
                if mean.is_nan() {
                    prop_assert_eq!(code, VOID);
                    voids += 1;
                    continue;
                }
                prop_assert!((1..VOID).contains(&code));
                let height = patch.base + f64::from(code) * patch.step;
                prop_assert!((height - mean).abs() <= off, "{height} {mean} {off}");
                prop_assert!(height <= own + f64::from(patch.lift) + 1e-4, "lifted by {}", patch.lift);
            }
        }
        // Of 33 x 33 posts at level 3, one in 40 is a void at least: none at all is e^-27.
        prop_assert!(voids > 0 || holes == [0, 0] || level > 3);
        prop_assert!(f64::from(patch.lift) <= share * extent + patch.step + 1e-3);
    }

    #[test]
    fn a_weighted_mean_of_the_deviations_is_never_more_than_what_is_allowed(
        fine in 0.0f64..100.0, more in 0.0f64..100.0, share in 0.0f64..1.0, extent in 0.0f64..9000.0,
    ) {
        let coarse = fine + more;
        let allowed = fine + share * more;
        let weight = weight(allowed, [fine, coarse], extent);
        prop_assert!(weight < STEPS);
        if weight > 0 {
            let share = f64::from(weight) / f64::from(STEPS);
            let mean = (1.0 - share) * fine + share * coarse;
            let off = mean + ROUNDING * extent + ROUNDING_M;
            prop_assert!(off <= allowed * (1.0 + 1e-12), "{weight}: {off} of {allowed}");
        }
    }
}

#[test]
fn the_weight_grows_to_the_coarser_level_and_begins_at_none() {
    let steps = |allowed| weight(allowed, [1.0, 4.0], 100.0);
    let weights: Vec<u32> =
        (0..=1000).map(|n| steps(1.0 + 2.999 * f64::from(n) / 1000.0)).collect();
    assert!(weights.is_sorted_by(|a, b| *b == *a || *b == a + 1), "{weights:?}");
    assert_eq!((weights[0], weights[300], weights[1000]), (0, 0, STEPS - 1));
    assert!(weights[400] > 0);
}

#[test]
fn levels_that_cannot_be_compared_do_not_count() {
    for coarse in [f64::INFINITY, f64::NAN] {
        assert_eq!(weight(2.0, [1.0, coarse], 10.0), 0, "{coarse}");
    }
    assert_eq!(weight(2.0, [1.0, 3.0], f64::INFINITY), 0);
    assert_eq!(weight(f64::NAN, [1.0, 3.0], 10.0), 0);
}

#[test]
fn a_patch_of_nothing_but_voids_has_no_ground() {
    let tile = |void| {
        let posts = vec![if void { f32::NAN } else { 3.0 }; TILE_POSTS * TILE_POSTS];
        HeightTile::new(posts.into()).unwrap()
    };
    for [fine, coarse] in [[true, false], [false, true], [true, true]] {
        let patch = Patch::new([1, 2], 2, 5, &tile(fine), &tile(coarse));
        assert!(patch.codes.iter().all(|&code| code == VOID));
        assert!(patch.base.is_finite() && patch.step > 0.0);
    }
    let flat = Patch::new([1, 2], 2, 5, &tile(false), &tile(false));
    let height = flat.base + f64::from(flat.codes[0]) * flat.step;
    assert!((height - 3.0).abs() < 1e-9, "{height}");
}
