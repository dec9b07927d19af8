//! A pinhole camera in the grid frame.
//!
//! Angles become vectors once, where the flight is read; what travels and what the
//! kernels use are f64 vectors, so that no worker needs a sine.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// The largest side of a frame, pixels.
pub const MAX_SIDE_PX: u32 = 16_384;
/// The narrowest horizontal field of view, degrees.
pub const MIN_HFOV_DEG: f64 = 1.0;
/// The widest horizontal field of view, degrees: beyond it a flat picture is all corner.
pub const MAX_HFOV_DEG: f64 = 170.0;

/// Where the camera is and where it looks. Columns of a right-handed frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Position, grid frame, metres.
    pub position: DVec3,
    /// Unit vector to the right of the picture.
    pub right: DVec3,
    /// Unit vector to the top of the picture.
    pub up: DVec3,
    /// Unit vector into the picture.
    pub forward: DVec3,
    /// Tangent of half the horizontal field of view.
    pub tan_half_hfov: f64,
    /// Size of the picture, pixels.
    pub width: u32,
    /// Size of the picture, pixels.
    pub height: u32,
}

impl Camera {
    /// A camera from flight angles. `heading_deg` is clockwise from grid north,
    /// `pitch_deg` is up from the horizon, `roll_deg` is the right side down.
    pub fn from_angles(
        position: DVec3,
        heading_deg: f64,
        pitch_deg: f64,
        roll_deg: f64,
        hfov_deg: f64,
        (width, height): (u32, u32),
    ) -> Self {
        let frame = attitude(heading_deg, pitch_deg, roll_deg);
        Camera {
            position,
            right: frame.x_axis,
            up: frame.z_axis,
            forward: frame.y_axis,
            tan_half_hfov: libm::tan(hfov_deg.to_radians() / 2.0),
            width,
            height,
        }
    }

    /// Direction of the ray through a point of the picture, not normalised: its
    /// component along `forward` is 1. Pixel (i, j) has its centre at (i + 0.5, j + 0.5).
    pub fn ray(&self, x_px: f64, y_px: f64) -> DVec3 {
        let scale = 2.0 * self.tan_half_hfov / f64::from(self.width);
        let across = (x_px - 0.5 * f64::from(self.width)) * scale;
        let upward = (0.5 * f64::from(self.height) - y_px) * scale;
        self.forward + self.right * across + self.up * upward
    }

    /// Pixels per unit of tangent: the focal length in pixels.
    pub fn focal_px(&self) -> f64 {
        f64::from(self.width) / (2.0 * self.tan_half_hfov)
    }

    /// Whether every number is finite, the axes are orthonormal to 1e-6, and the size and
    /// the field of view are within their limits: what anyone who receives one checks.
    pub fn is_valid(&self) -> bool {
        let axes = [self.right, self.up, self.forward];
        let orthonormal = (0..3).all(|i| {
            (0..3).all(|j| {
                let expected = if i == j { 1.0 } else { 0.0 };
                (axes[i].dot(axes[j]) - expected).abs() <= 1e-6
            })
        });
        let tan = |degrees: f64| libm::tan(degrees.to_radians() / 2.0);
        let fov = tan(MIN_HFOV_DEG) * (1.0 - 1e-9)..=tan(MAX_HFOV_DEG) * (1.0 + 1e-9);
        self.position.is_finite()
            && orthonormal
            && fov.contains(&self.tan_half_hfov)
            && (1..=MAX_SIDE_PX).contains(&self.width)
            && (1..=MAX_SIDE_PX).contains(&self.height)
    }
}

/// The rotation from camera axes (x right, y forward, z up) to the grid frame.
pub fn attitude(heading_deg: f64, pitch_deg: f64, roll_deg: f64) -> DMat3 {
    let sin_cos = |degrees: f64| {
        let radians = degrees.to_radians();
        (libm::sin(radians), libm::cos(radians))
    };
    let (sin_h, cos_h) = sin_cos(heading_deg);
    let (sin_p, cos_p) = sin_cos(pitch_deg);
    let (sin_r, cos_r) = sin_cos(roll_deg);
    let forward = DVec3::new(sin_h * cos_p, cos_h * cos_p, sin_p);
    let level_right = DVec3::new(cos_h, -sin_h, 0.0);
    let level_up = level_right.cross(forward);
    let right = level_right * cos_r - level_up * sin_r;
    let up = level_up * cos_r + level_right * sin_r;
    DMat3::from_cols(right, forward, up)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn north_is_up_the_map_and_east_is_to_the_right() {
        let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 90.0, (200, 100));
        assert!((camera.forward - DVec3::Y).length() < 1e-12);
        assert!((camera.right - DVec3::X).length() < 1e-12);
        assert!((camera.up - DVec3::Z).length() < 1e-12);
        let left_edge = camera.ray(0.0, 50.0);
        assert!((left_edge - DVec3::new(-1.0, 1.0, 0.0)).length() < 1e-12);
    }

    #[test]
    fn roll_puts_the_right_side_down() {
        let camera = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 90.0, 60.0, (2, 2));
        assert!((camera.right - -DVec3::Z).length() < 1e-12);
    }

    #[test]
    fn straight_down_keeps_the_heading_at_the_top_of_the_picture() {
        let camera = Camera::from_angles(DVec3::ZERO, 90.0, -90.0, 0.0, 60.0, (2, 2));
        assert!((camera.forward - -DVec3::Z).length() < 1e-12);
        assert!((camera.up - DVec3::X).length() < 1e-12);
    }

    proptest! {
        #[test]
        fn every_attitude_is_a_rotation(h in -720.0..720.0f64, p in -90.0..=90.0f64, r in -180.0..=180.0f64, fov in 1.0..=170.0f64) {
            let camera = Camera::from_angles(DVec3::ZERO, h, p, r, fov, (1920, 1080));
            prop_assert!(camera.is_valid());
            prop_assert!((attitude(h, p, r).determinant() - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn a_camera_with_nan_or_a_skewed_frame_is_not_valid() {
        let good = Camera::from_angles(DVec3::ZERO, 0.0, 0.0, 0.0, 60.0, (10, 10));
        assert!(!Camera { position: DVec3::new(f64::NAN, 0.0, 0.0), ..good }.is_valid());
        assert!(!Camera { right: DVec3::Y, ..good }.is_valid());
        assert!(!Camera { width: 0, ..good }.is_valid());
        assert!(!Camera { tan_half_hfov: 0.0, ..good }.is_valid());
    }
}
