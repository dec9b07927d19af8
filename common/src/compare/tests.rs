#![allow(clippy::unwrap_used)]
use super::*;
use proptest::prelude::*;

/// A grey picture in levels.
fn grey(width: u32, height: u32, level: impl Fn(u32, u32) -> f64) -> Rgb16 {
    let places = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let values = places.flat_map(|(x, y)| [(level(x, y) * LEVEL).round() as u16; 3]).collect();
    Rgb16::from_values(width, height, values).unwrap()
}

fn step(at: u32, low: f64, high: f64) -> Rgb16 {
    grey(64, 40, |x, _| if x < at { low } else { high })
}

#[test]
fn equal_pictures_are_equal_in_every_measure() {
    let picture = step(20, 50.0, 200.0);
    let equal = compare(&picture, &picture).unwrap();
    assert_eq!((equal.mse, equal.difference_p99, equal.difference_max), (0.0, 0.0, 0.0));
    assert!((equal.ssim - 1.0).abs() < 1e-12);
    assert_eq!(equal.silhouette_px, Some(Spread { p50: 0.0, p99: 0.0, max: 0.0 }));
    assert_eq!(psnr_db(equal.mse), f64::INFINITY);
}

#[test]
fn a_known_difference_has_a_known_psnr() {
    let (one, other) = (grey(9, 7, |_, _| 100.0), grey(9, 7, |_, _| 110.0));
    let found = compare(&one, &other).unwrap();
    assert!((found.mse - 100.0).abs() < 1e-9);
    assert!((psnr_db(found.mse) - 28.130_803_6).abs() < 1e-6);
    assert_eq!((found.difference_p99, found.difference_max), (10.0, 10.0));
    assert_eq!(found.silhouette_px, None, "there is no edge");
}

#[test]
fn sixteen_bits_see_half_a_level() {
    let one = Rgb16::from_values(1, 1, vec![1000, 1000, 1000]).unwrap();
    let other = Rgb16::from_values(1, 1, vec![1000, 1000, 1000 + 128]).unwrap();
    let found = compare(&one, &other).unwrap();
    assert!((found.difference_max - 128.0 / 257.0).abs() < 1e-12);
}

#[test]
fn rare_differences_show_in_the_maximum_alone() {
    let flat = grey(100, 100, |_, _| 10.0);
    let spot = grey(100, 100, |x, y| if (x, y) == (5, 5) { 90.0 } else { 10.0 });
    let found = compare(&flat, &spot).unwrap();
    assert_eq!((found.difference_p99, found.difference_max), (0.0, 80.0));
}

#[test]
fn a_silhouette_that_moves_is_displaced_by_that_much() {
    let spread = compare(&step(20, 50.0, 200.0), &step(23, 50.0, 200.0)).unwrap().silhouette_px;
    assert_eq!(spread, Some(Spread { p50: 3.0, p99: 3.0, max: 3.0 }));
    // Half the contrast is still the same edge; a strong one on one side is enough.
    let faint = step(20, 50.0, 64.0);
    let spread = compare(&step(20, 50.0, 80.0), &faint).unwrap().silhouette_px;
    assert_eq!(spread, Some(Spread { p50: 0.0, p99: 0.0, max: 0.0 }));
    assert_eq!(compare(&faint, &faint).unwrap().silhouette_px, None, "no edge is strong");
    let gone = compare(&step(20, 50.0, 200.0), &grey(64, 40, |_, _| 50.0)).unwrap();
    assert_eq!(gone.silhouette_px.map(|spread| spread.p50), Some(DISPLACEMENT_MAX_PX));
}

#[test]
fn pictures_of_two_sizes_are_refused_and_both_are_named() {
    let error = compare(&grey(4, 3, |_, _| 0.0), &grey(3, 4, |_, _| 0.0)).unwrap_err();
    assert!(error.to_string().contains("4 x 3 pixels, the other 3 x 4"), "{error}");
    assert!(difference(&grey(4, 3, |_, _| 0.0), &grey(3, 4, |_, _| 0.0), 1).is_err());
    assert_eq!(Rgb16::from_values(0, 5, Vec::new()), None);
    assert_eq!(Rgb16::from_values(2, 1, vec![0; 5]), None);
}

#[test]
fn differences_are_shown_as_large_as_they_fit() {
    let (one, other) = (grey(2, 1, |x, _| f64::from(x)), grey(2, 1, |x, _| 10.0 * f64::from(x)));
    assert_eq!(gain_for(9.0), 28);
    assert_eq!((gain_for(0.0), gain_for(255.0), gain_for(0.5)), (1, 1, 128));
    assert_eq!(difference(&one, &other, 28).unwrap().pixels(), [0, 0, 0, 252, 252, 252]);
    assert_eq!(difference(&one, &other, 99).unwrap().get(1, 0), [255; 3]);
}

/// SSIM as its definition has it, one window after the other.
fn slow_ssim(one: &Rgb16, other: &Rgb16) -> f64 {
    let (width, height) = (one.width as isize, one.height as isize);
    let lumas = [one, other].map(|p| (0..p.height).flat_map(|y| p.luma(y)).collect::<Vec<_>>());
    let mut sum = 0.0;
    for y in 0..height {
        for x in 0..width {
            let mut window = Vec::new();
            for j in (y - 5).max(0)..=(y + 5).min(height - 1) {
                for i in (x - 5).max(0)..=(x + 5).min(width - 1) {
                    let square = ((i - x) * (i - x) + (j - y) * (j - y)) as f64;
                    let at = (j * width + i) as usize;
                    window.push(((-square / 4.5).exp(), lumas[0][at], lumas[1][at]));
                }
            }
            let mass: f64 = window.iter().map(|w| w.0).sum();
            let mean = |of: &dyn Fn(f64, f64) -> f64| {
                window.iter().map(|w| w.0 * of(w.1, w.2)).sum::<f64>() / mass
            };
            let (a, b) = (mean(&|a, _| a), mean(&|_, b| b));
            let va = mean(&|p, _| (p - a) * (p - a));
            let vb = mean(&|_, q| (q - b) * (q - b));
            let vab = mean(&|p, q| (p - a) * (q - b));
            sum += (2.0 * a * b + 6.5025) * (2.0 * vab + 58.5225)
                / ((a * a + b * b + 6.5025) * (va + vb + 58.5225));
        }
    }
    sum / (width * height) as f64
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]
    #[test]
    fn any_two_pictures_compare_the_same_both_ways_and_as_the_slow_twin_says(
        (width, height, one, other) in (1u32..30, 1u32..30).prop_flat_map(|(width, height)| {
            let values = prop::collection::vec(any::<u16>(), (width * height * 3) as usize);
            (Just(width), Just(height), values.clone(), values)
        })
    ) {
        let [one, other] = [one, other].map(|values| Rgb16::from_values(width, height, values).unwrap());
        let (there, back) = (compare(&one, &other).unwrap(), compare(&other, &one).unwrap());
        prop_assert_eq!(there.silhouette_px, back.silhouette_px);
        prop_assert_eq!(there.mse, back.mse);
        prop_assert!((there.ssim - back.ssim).abs() < 1e-9);
        prop_assert!((there.ssim - slow_ssim(&one, &other)).abs() < 1e-9);
        prop_assert!(there.difference_p99 <= there.difference_max && there.difference_max <= 255.0);
    }

    #[test]
    fn the_nearest_edge_is_the_nearest(edges in prop::collection::vec(0u8..30, 20 * 15), at in 0usize..300) {
        let strengths = edges.iter().map(|e| if *e == 0 { 9.0 } else { 0.0 }).collect();
        let edges = Edges { width: 20, strengths };
        let found = nearest(&edges.heights(), 20, at);
        let truth = (0..300).filter(|i| edges.strengths[*i] > 0.0).map(|i| {
            let (dx, dy) = ((i % 20) as f64 - (at % 20) as f64, (i / 20) as f64 - (at / 20) as f64);
            (dx * dx + dy * dy).sqrt()
        });
        let truth = truth.fold(DISPLACEMENT_MAX_PX, f64::min);
        prop_assert!((found - truth).abs() < 1e-9, "{} {}", found, truth);
    }
}
