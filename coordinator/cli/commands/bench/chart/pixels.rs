//! A drawing as pixels.
//!
//! Lines are capsules and polygons are convex, so the distance of a pixel to a shape is a
//! short formula, and the share of the pixel that the shape covers follows from it:
//! `0.5 - distance`, clamped. Texts are lines, see `strokes`.

use super::{Anchor, Color, Drawing, Shape, strokes};
use terrafarm_common::image::Rgb8;

/// Fills all shapes in, the first at the bottom.
pub fn fill(drawing: &Drawing) -> Rgb8 {
    let [width, height] = drawing.size.map(|side| side as u32);
    let mut picture = Rgb8::new(width, height);
    for pixel in picture.pixels_mut().chunks_exact_mut(3) {
        pixel.copy_from_slice(&drawing.paper);
    }
    for shape in &drawing.shapes {
        match shape {
            Shape::Line { points, width, color } => line(&mut picture, points, *width, *color),
            Shape::Polygon { corners, fill, edge, width } => {
                let inside = |at: [f64; 2]| inside(corners, at);
                cover(&mut picture, corners, 1.0, *fill, inside);
                let mut around = corners.clone();
                around.extend(corners.first());
                line(&mut picture, &around, *width, *edge);
            }
            Shape::Text { at, size, anchor, upright, color, text } => {
                let width = strokes::width(text, *size);
                let shift = match anchor {
                    Anchor::Start => 0.0,
                    Anchor::Middle => -0.5 * width,
                    Anchor::End => -width,
                };
                for stroke in strokes::lines(text, *size) {
                    let turned = |[x, y]: [f64; 2]| match upright {
                        true => [at[0] + y, at[1] - (x + shift)],
                        false => [at[0] + x + shift, at[1] + y],
                    };
                    let stroke: Vec<[f64; 2]> = stroke.into_iter().map(turned).collect();
                    line(&mut picture, &stroke, strokes::WEIGHT * size, *color);
                }
            }
        }
    }
    picture
}

fn line(picture: &mut Rgb8, points: &[[f64; 2]], width: f64, color: Color) {
    // As one shape: where its pieces meet, no pixel is covered twice.
    let distance = |at: [f64; 2]| {
        let pieces = points.windows(2).map(|ends| to_segment(ends[0], ends[1], at));
        pieces.fold(f64::INFINITY, f64::min) - 0.5 * width
    };
    cover(picture, points, 0.5 * width + 1.0, color, distance);
}

/// Distance from a point to a piece of a line.
fn to_segment(a: [f64; 2], b: [f64; 2], at: [f64; 2]) -> f64 {
    let (along, from) = ([b[0] - a[0], b[1] - a[1]], [at[0] - a[0], at[1] - a[1]]);
    let length = along[0] * along[0] + along[1] * along[1];
    let dot = along[0] * from[0] + along[1] * from[1];
    let share = if length > 0.0 { (dot / length).clamp(0.0, 1.0) } else { 0.0 };
    let off = [from[0] - share * along[0], from[1] - share * along[1]];
    (off[0] * off[0] + off[1] * off[1]).sqrt()
}

/// Distance from a point to a convex polygon, negative inside; too small beyond corners,
/// which its edge covers anyhow.
fn inside(corners: &[[f64; 2]], at: [f64; 2]) -> f64 {
    let next = corners.iter().cycle().skip(1);
    let sides = corners.iter().zip(next).map(|(a, b)| {
        let along = [b[0] - a[0], b[1] - a[1]];
        let length = (along[0] * along[0] + along[1] * along[1]).sqrt().max(1e-9);
        (along[1] * (at[0] - a[0]) - along[0] * (at[1] - a[1])) / length
    });
    sides.fold(f64::NEG_INFINITY, f64::max)
}

/// Mixes a colour into the pixels near some points by the distance of their centres.
fn cover(
    picture: &mut Rgb8,
    points: &[[f64; 2]],
    reach: f64,
    color: Color,
    distance: impl Fn([f64; 2]) -> f64,
) {
    let size = [picture.width(), picture.height()];
    let [columns, rows] = [0, 1].map(|axis| {
        let values = || points.iter().map(|point| point[axis]);
        let low = values().fold(f64::INFINITY, f64::min) - reach;
        let high = values().fold(f64::NEG_INFINITY, f64::max) + reach;
        (low.max(0.0) as u32)..(high.ceil().max(0.0) as u32).min(size[axis])
    });
    let stride = 3 * size[0] as usize;
    let pixels = picture.pixels_mut();
    for y in rows {
        for x in columns.clone() {
            let share = (0.5 - distance([f64::from(x) + 0.5, f64::from(y) + 0.5])).clamp(0.0, 1.0);
            if share > 0.0 {
                let at = y as usize * stride + 3 * x as usize;
                for (old, new) in pixels[at..at + 3].iter_mut().zip(color) {
                    let mixed = f64::from(*old) + (f64::from(new) - f64::from(*old)) * share;
                    *old = (mixed + 0.5) as u8;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_cover_their_width_and_polygons_their_inside() {
        let square = vec![[2.0, 2.0], [8.0, 2.0], [8.0, 8.0], [2.0, 8.0]];
        let drawing = Drawing {
            size: [20.0, 10.0],
            paper: [255; 3],
            title: String::new(),
            shapes: vec![
                Shape::Polygon { corners: square, fill: [9; 3], edge: [9; 3], width: 0.0 },
                Shape::Line { points: vec![[12.0, 5.0], [18.0, 5.0]], width: 2.0, color: [0; 3] },
            ],
        };
        let picture = fill(&drawing);
        let dark = |x: usize, y: usize| picture.pixels()[3 * (y * 20 + x)] < 128;
        for y in 0..10 {
            for x in 0..11 {
                assert_eq!(dark(x, y), (2..8).contains(&x) && (2..8).contains(&y), "{x} {y}");
            }
            assert_eq!(dark(15, y), (4..6).contains(&y), "{y}");
        }
    }
}
