//! Two pictures: how far are they apart.
//!
//! All measures take sRGB values as they are shown, in *levels* of 8 bits: 0 to 255, with
//! fractions where a picture has 16 bits.
//!
//! - **PSNR**: `10 log10(255^2 / mse)`, mse over all pixels and the three channels.
//! - **SSIM** (Wang, Bovik, Sheikh, Simoncelli 2004): of luma (Rec. 709 weights), means,
//!   variances and covariance weighted by a Gaussian of sigma 1.5 over 11 x 11 pixels,
//!   K1 = 0.01, K2 = 0.03; averaged over all pixels. At the border the window is cut and
//!   its weights are normalised again.
//! - **Silhouette displacement**: edges as by Canny's method: luma smoothed by a Gaussian
//!   of sigma 1, Sobel's gradient, and of its magnitude the maxima across the edge. Edges
//!   of [`STRONG_EDGE`] levels a pixel and more are strong. Of every strong edge pixel of
//!   either picture, the distance to the nearest edge pixel of the other that has
//!   [`WEAK_EDGE`] levels at least, not above [`DISPLACEMENT_MAX_PX`]. The lower bar of
//!   the other side keeps an edge whose contrast changes a little from vanishing.
//! - **Differences** of single channels: 99th percentile and maximum.
//!
//! Nothing here knows a file.

use crate::accuracy::Spread;
use crate::image::Rgb8;
use crate::stats::quantile;

/// Gradient of a strong edge, levels a pixel: a sharp step of about 23 levels.
pub const STRONG_EDGE: f64 = 8.0;
/// Gradient that counts as an edge opposite a strong one, levels a pixel.
pub const WEAK_EDGE: f64 = 4.0;
/// Displacements beyond this are not told apart, pixels.
pub const DISPLACEMENT_MAX_PX: f64 = 64.0;
/// Parts of a level in a value of 16 bits.
const LEVEL: f64 = 257.0;
/// Weights of red, green and blue in luma.
const LUMA: [f64; 3] = [0.2126, 0.7152, 0.0722];

/// A picture of 16 bits a channel, sRGB, rows from the top, three values a pixel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rgb16 {
    width: usize,
    height: usize,
    values: Vec<u16>,
}

impl Rgb16 {
    /// Wraps values that already exist; `None` if there are none, or their number does
    /// not fit the size.
    pub fn from_values(width: u32, height: u32, values: Vec<u16>) -> Option<Self> {
        let (width, height) = (width as usize, height as usize);
        let expected = width.checked_mul(height)?.checked_mul(3)?;
        (expected > 0 && values.len() == expected).then_some(Rgb16 { width, height, values })
    }

    /// Width and height, pixels.
    pub fn size(&self) -> (u32, u32) {
        (self.width as u32, self.height as u32)
    }

    /// Luma of a row, levels.
    fn luma(&self, row: usize) -> impl Iterator<Item = f64> + '_ {
        let values = &self.values[row * self.width * 3..(row + 1) * self.width * 3];
        values.chunks_exact(3).map(|rgb| {
            let sum: f64 = rgb.iter().zip(LUMA).map(|(value, w)| f64::from(*value) * w).sum();
            sum / LEVEL
        })
    }
}

/// How far two pictures are apart.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Comparison {
    /// Mean squared difference, levels squared; 0 for equal pictures.
    pub mse: f64,
    /// Structural similarity, 1 for equal pictures.
    pub ssim: f64,
    /// Displacement of silhouettes, pixels; `None` if neither picture has a strong edge.
    pub silhouette_px: Option<Spread>,
    /// 99th percentile of the differences of single channels, levels.
    pub difference_p99: f64,
    /// The largest difference of a channel, levels.
    pub difference_max: f64,
}

/// The sizes of two pictures that cannot be compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "one picture has {} x {} pixels, the other {} x {}; only pictures of one size can be compared",
    .0.0, .0.1, .1.0, .1.1
)]
pub struct SizesDiffer(pub (u32, u32), pub (u32, u32));

/// Compares two pictures.
///
/// # Errors
/// If their sizes differ.
pub fn compare(one: &Rgb16, other: &Rgb16) -> Result<Comparison, SizesDiffer> {
    if one.size() != other.size() {
        return Err(SizesDiffer(one.size(), other.size()));
    }
    let mut counts = vec![0u64; 1 << 16];
    for (a, b) in one.values.iter().zip(&other.values) {
        counts[usize::from(a.abs_diff(*b))] += 1;
    }
    let total = one.values.len() as u64;
    let squares = counts.iter().enumerate().map(|(off, n)| (off * off) as f64 * *n as f64);
    // By nearest rank, as everywhere.
    let rank = (0.99 * (total - 1) as f64).round() as u64;
    let mut seen = 0;
    let p99 = counts.iter().position(|n| {
        seen += n;
        seen > rank
    });
    let max = counts.iter().rposition(|n| *n > 0);
    let levels = |off: Option<usize>| off.unwrap_or(0) as f64 / LEVEL;
    Ok(Comparison {
        mse: squares.sum::<f64>() / (LEVEL * LEVEL * total as f64),
        ssim: ssim(one, other),
        silhouette_px: silhouette(one, other),
        difference_p99: levels(p99),
        difference_max: levels(max),
    })
}

/// Peak signal to noise ratio of a mean squared difference in levels, decibels; infinite
/// for none.
pub fn psnr_db(mse: f64) -> f64 {
    if mse > 0.0 { 10.0 * libm::log10(255.0 * 255.0 / mse) } else { f64::INFINITY }
}

/// The differences of two pictures of one size, times a whole number, cut off at white.
///
/// # Errors
/// If their sizes differ.
pub fn difference(one: &Rgb16, other: &Rgb16, gain: u32) -> Result<Rgb8, SizesDiffer> {
    let (width, height) = one.size();
    if one.size() != other.size() {
        return Err(SizesDiffer(one.size(), other.size()));
    }
    let mut picture = Rgb8::new(width, height);
    let pairs = one.values.iter().zip(&other.values);
    for (shown, (a, b)) in picture.pixels_mut().iter_mut().zip(pairs) {
        let off = f64::from(a.abs_diff(*b)) / LEVEL * f64::from(gain);
        *shown = (off + 0.5).min(255.0) as u8;
    }
    Ok(picture)
}

/// The gain at which the largest difference is just not cut off, at least 1 and at most
/// 128.
pub fn gain_for(difference_max: f64) -> u32 {
    if difference_max <= 0.0 { 1 } else { (255.0 / difference_max).clamp(1.0, 128.0) as u32 }
}

/// Weights of a Gaussian from its centre on one side.
fn gaussian(sigma: f64, radius: usize) -> Vec<f64> {
    (0..=radius).map(|d| libm::exp(-0.5 * (d as f64 / sigma) * (d as f64 / sigma))).collect()
}

/// The weighted mean around a place of a line, cut at its ends.
fn weighted<const N: usize>(
    weights: &[f64],
    at: usize,
    length: usize,
    value: impl Fn(usize) -> [f64; N],
) -> [f64; N] {
    let radius = weights.len() - 1;
    let (mut sum, mut mass) = ([0.0; N], 0.0);
    for place in at.saturating_sub(radius)..(at + radius + 1).min(length) {
        let weight = weights[place.abs_diff(at)];
        let value = value(place);
        (0..N).for_each(|n| sum[n] += weight * value[n]);
        mass += weight;
    }
    sum.map(|sum| sum / mass)
}

fn ssim(one: &Rgb16, other: &Rgb16) -> f64 {
    const RADIUS: usize = 5;
    let (width, height) = (one.width, one.height);
    let weights = gaussian(1.5, RADIUS);
    let square = |k: f64| (k * 255.0) * (k * 255.0);
    let (c1, c2) = (square(0.01), square(0.03));
    // The rows that a window reaches, smoothed along x: means, squares and product.
    let mut rows: Vec<Vec<[f64; 5]>> = vec![Vec::new(); 2 * RADIUS + 1];
    let mut ready = 0;
    let mut sum = 0.0;
    for y in 0..height {
        while ready < (y + RADIUS + 1).min(height) {
            let pairs: Vec<_> = one.luma(ready).zip(other.luma(ready)).collect();
            let moments = |x: usize| {
                let (a, b) = pairs[x];
                [a, b, a * a, b * b, a * b]
            };
            let row = (0..width).map(|x| weighted(&weights, x, width, moments)).collect();
            rows[ready % (2 * RADIUS + 1)] = row;
            ready += 1;
        }
        for x in 0..width {
            let [a, b, aa, bb, ab] =
                weighted(&weights, y, height, |row| rows[row % (2 * RADIUS + 1)][x]);
            let (spread, shared) = ((aa - a * a) + (bb - b * b), ab - a * b);
            sum +=
                (2.0 * a * b + c1) * (2.0 * shared + c2) / ((a * a + b * b + c1) * (spread + c2));
        }
    }
    sum / (width * height) as f64
}

fn silhouette(one: &Rgb16, other: &Rgb16) -> Option<Spread> {
    let maps = [one, other].map(Edges::of);
    let [to_one, to_other] = [&maps[0], &maps[1]].map(Edges::heights);
    let mut distances = Vec::new();
    for (edges, heights) in [(&maps[0], &to_other), (&maps[1], &to_one)] {
        let strong = edges.strengths.iter().enumerate().filter(|(_, s)| **s >= STRONG_EDGE as f32);
        distances.extend(strong.map(|(at, _)| nearest(heights, edges.width, at)));
    }
    distances.sort_unstable_by(f64::total_cmp);
    let part = |share| quantile(&distances, share);
    Some(Spread { p50: part(0.5)?, p99: part(0.99)?, max: part(1.0)? })
}

/// The edges of a picture.
struct Edges {
    width: usize,
    /// Gradient where it is largest across the edge, levels a pixel; else 0.
    strengths: Vec<f32>,
}

impl Edges {
    fn of(picture: &Rgb16) -> Self {
        let (width, height) = (picture.width, picture.height);
        let smooth = smoothed(picture);
        let at = |x: isize, y: isize| {
            let inside = |k: isize, n: usize| k.clamp(0, n as isize - 1) as usize;
            f64::from(smooth[inside(y, height) * width + inside(x, width)])
        };
        let slope = |x: isize, y: isize| {
            let side = |d: isize| at(x + d, y - 1) + 2.0 * at(x + d, y) + at(x + d, y + 1);
            let level = |d: isize| at(x - 1, y + d) + 2.0 * at(x, y + d) + at(x + 1, y + d);
            [(side(1) - side(-1)) / 8.0, (level(1) - level(-1)) / 8.0]
        };
        let size = |[x, y]: [f64; 2]| (x * x + y * y).sqrt();
        let mut strengths = vec![0.0; width * height];
        for y in 0..height as isize {
            for x in 0..width as isize {
                let here = slope(x, y);
                let strength = size(here);
                if strength < WEAK_EDGE {
                    continue;
                }
                let [dx, dy] = across(here);
                // Of two equal neighbours, one is the edge.
                let before = size(slope(x - dx, y - dy));
                let after = size(slope(x + dx, y + dy));
                if strength > before && strength >= after {
                    strengths[y as usize * width + x as usize] = strength as f32;
                }
            }
        }
        Edges { width, strengths }
    }

    /// For each pixel, the distance to the nearest edge in its column, pixels.
    fn heights(&self) -> Vec<f32> {
        let limit = DISPLACEMENT_MAX_PX as f32;
        let mut heights: Vec<f32> =
            self.strengths.iter().map(|&s| if s > 0.0 { 0.0 } else { limit }).collect();
        for at in self.width..heights.len() {
            heights[at] = heights[at].min(heights[at - self.width] + 1.0);
        }
        for at in (self.width..heights.len()).rev() {
            heights[at - self.width] = heights[at - self.width].min(heights[at] + 1.0);
        }
        heights
    }
}

/// The nearest of the eight directions to a gradient.
fn across([x, y]: [f64; 2]) -> [isize; 2] {
    // tan(22.5 degrees)
    const NARROW: f64 = 0.414_213_562_373_095_03;
    let step = |along: f64, other: f64| {
        if along.abs() <= NARROW * other.abs() { 0 } else { along.signum() as isize }
    };
    [step(x, y), step(y, x)]
}

/// Luma smoothed by a Gaussian of sigma 1, levels.
fn smoothed(picture: &Rgb16) -> Vec<f32> {
    let (width, height) = (picture.width, picture.height);
    let weights = gaussian(1.0, 3);
    let mut rows = Vec::with_capacity(width * height);
    for y in 0..height {
        let luma: Vec<f64> = picture.luma(y).collect();
        rows.extend((0..width).map(|x| weighted(&weights, x, width, |k| [luma[k]])[0] as f32));
    }
    let place = |x: usize| {
        let rows = &rows;
        move |k: usize| [f64::from(rows[k * width + x])]
    };
    let all = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    all.map(|(x, y)| weighted(&weights, y, height, place(x))[0] as f32).collect()
}

/// Distance from a pixel to the nearest edge, given the distances within columns.
fn nearest(heights: &[f32], width: usize, at: usize) -> f64 {
    let (column, row) = (at % width, at - at % width);
    let mut best = DISPLACEMENT_MAX_PX * DISPLACEMENT_MAX_PX;
    for aside in 0..width {
        let square = (aside * aside) as f64;
        if square >= best {
            break;
        }
        let columns = [column.checked_sub(aside), Some(column + aside).filter(|x| *x < width)];
        for x in columns.into_iter().flatten() {
            let height = f64::from(heights[row + x]);
            best = best.min(square + height * height);
        }
    }
    best.sqrt()
}

#[cfg(test)]
mod tests;
