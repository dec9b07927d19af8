//! One scene by one method: the number, and whether it is within bound.

use super::Cell;
use super::scenes::{Scene, Truth};
use crate::commands::bench::kernel::{self, Depths};
use crate::commands::bench::report::{Promise, Spread};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::Region;
use terrafarm_raycast::View;

/// Renders a scene by a method and compares it with the scene's truth. Tells how many
/// pixels the method could not do its own way.
pub fn cell(scene: &Scene, quality: Quality) -> Cell {
    let view = View { quality, ..scene.view.clone() };
    let method = quality.method.name();
    if let Truth::Below(color) = scene.truth {
        return below(scene, &view, color);
    }
    let answer = match kernel::answer(&scene.land, &view) {
        Ok(answer) => answer,
        Err(kernel::Refusal(why)) => return Cell::refused(scene.name, method, why),
    };
    let odd =
        answer.inverse_depth.iter().filter(|inverse| inverse.is_nan() || **inverse < 0.0).count();
    if odd > 0 {
        return Cell::measured(scene.name, method, odd as f64, 0.0, "pixels not a distance");
    }
    compared(scene, &view, &answer).with_fallbacks(&answer)
}

/// Compares an answer with the scene's truth.
fn compared(scene: &Scene, view: &View, answer: &Depths) -> Cell {
    let method = view.quality.method.name();
    let promise = Promise::of(view.quality.method, view.quality.tolerance_px);
    match &scene.truth {
        Truth::Plane(plane) => {
            let spread = Spread::of(plane_errors(view, answer, *plane));
            let value = promise.value(&spread);
            Cell::measured(scene.name, method, value, promise.bound_px, unit(&promise))
        }
        Truth::Edge(row_px) => {
            let off = edge_error(view, answer, *row_px);
            Cell::measured(scene.name, method, off, promise.bound_px, "px of the edge")
        }
        Truth::Closed if answer.inverse_depth.contains(&0.0) => {
            let sky = answer.inverse_depth.iter().filter(|inverse| **inverse == 0.0).count();
            Cell::measured(scene.name, method, sky as f64, 0.0, "pixels of sky")
        }
        _ => match surface_spread(scene, view, answer) {
            Ok(spread) => {
                let value = promise.value(&spread);
                Cell::measured(scene.name, method, value, promise.bound_px, unit(&promise))
            }
            Err(kernel::Refusal(why)) => Cell::refused(scene.name, method, why),
        },
    }
}

fn unit(promise: &Promise) -> &'static str {
    if promise.figure == "max" { "px, max" } else { "px, p99" }
}

/// Pixels that do not have the colour of a camera below the ground.
fn below(scene: &Scene, view: &View, color: [u8; 3]) -> Cell {
    let method = view.quality.method.name();
    let frame = Region::whole(view.camera.width, view.camera.height);
    match kernel::picture(&scene.land, view, frame) {
        Ok(pixels) => {
            let others = pixels.chunks_exact(3).filter(|pixel| *pixel != color).count();
            Cell::measured(scene.name, method, others as f64, 0.0, "pixels of another colour")
        }
        Err(kernel::Refusal(why)) => Cell::refused(scene.name, method, why),
    }
}

/// Errors against the plane `z = a x + b y + c`, pixels; infinite where sky and ground
/// are confused. Pixels that see the rim of the land are left out.
fn plane_errors(view: &View, answer: &Depths, plane: Plane) -> Vec<f64> {
    let camera = &view.camera;
    let mut errors = Vec::with_capacity(answer.inverse_depth.len());
    for y in 0..camera.height {
        for x in 0..camera.width {
            let ray = camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5).normalize();
            let above = camera.position.z - plane.height(camera.position.x, camera.position.y);
            let sinks = plane.slope[0] * ray.x + plane.slope[1] * ray.y - ray.z;
            let distance = if sinks > 0.0 { above / sinks } else { f64::INFINITY };
            let at = camera.position + ray * distance;
            let claimed = answer.distance_m(view, x, y);
            if !distance.is_finite() || !plane.holds_well(at.x, at.y) {
                continue;
            }
            let off_m = (claimed - distance).abs() * sinks;
            errors.push(off_m * camera.focal_px() / distance);
        }
    }
    errors
}

/// How far the first ground of the middle column is from where it should begin, pixels: 0
/// if the edge runs through the pixel.
fn edge_error(view: &View, answer: &Depths, row_px: f64) -> f64 {
    let (width, height) = (view.camera.width, view.camera.height);
    let seen = |row: u32| answer.distance_m(view, width / 2, row).is_finite();
    let first = (0..height).find(|&row| seen(row)).unwrap_or(height);
    // Centres below the edge see ground: it lies within half a pixel of this row's top.
    ((f64::from(first) - row_px).abs() - 0.5).max(0.0)
}

/// Errors by the accuracy meter; those of `exact`, which the meter relies on, against the
/// reference.
fn surface_spread(scene: &Scene, view: &View, answer: &Depths) -> Result<Spread, kernel::Refusal> {
    let frame = Region::whole(view.camera.width, view.camera.height);
    let errors = match view.quality.method {
        Method::Exact => kernel::from_reference(&scene.land, view, answer)?,
        _ => kernel::errors(&scene.land, view, frame, answer)?.error_px,
    };
    Ok(Spread::of(errors))
}

/// A plane over a rectangle.
#[derive(Debug, Clone, Copy)]
pub struct Plane {
    /// Rise along x and y.
    pub slope: [f64; 2],
    /// Height at the south-west corner, metres.
    pub height_m: f64,
    /// South-west and north-east corner, metres.
    pub corners: [[f64; 2]; 2],
}

impl Plane {
    /// Height at a place, metres.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        let [near, _] = self.corners;
        self.height_m + self.slope[0] * (x - near[0]) + self.slope[1] * (y - near[1])
    }

    /// Whether a place lies within the rectangle, a thousandth of its side from the rim.
    fn holds_well(&self, x: f64, y: f64) -> bool {
        let [near, far] = self.corners;
        [x, y].into_iter().enumerate().all(|(axis, value)| {
            let rim = 1e-3 * (far[axis] - near[axis]);
            (near[axis] + rim..=far[axis] - rim).contains(&value)
        })
    }
}
