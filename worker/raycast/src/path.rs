//! The path of a ray: a straight line, or a straight line seen over a round Earth.
//!
//! A ray starts at `o` with unit direction `d` and is followed by a parameter `u`. Its
//! place on the map is `o.xy + u * d.xy` in every case, so that grid lines are crossed
//! at values of `u` that a division gives. Over flat ground its height is `o.z + u * d.z`
//! and `u` is the distance in metres.
//!
//! Over a sphere of the effective radius R' (see [`Earth`]) the ray is a straight line
//! in space and map distance is an arc on the sphere. With phi = u |d.xy| / R' and
//! e = d.z u / R', the law of sines in the triangle of the sphere's centre gives
//!
//! `z(u) = o.z + (R' + o.z) (e sinc(phi) + 1 - cos(phi)) / (cos(phi) - e sinc(phi))`,
//!
//! regular in every direction, straight up and down included. z is convex in u, since it
//! is a secant of a linear function of u.
//!
//! So that the ray meets a bilinear cell in a quadratic, z is replaced by a parabola over
//! each *span* of u, through the values at its start, middle and end. Spans start at
//! fixed multiples of one length, hence depend on nothing but the ray; neighbours share
//! the value at their common end. The third derivative of z by u is at most about
//! 6 / R'^2 (reached by rays close to vertical), so a parabola over the length U is off
//! by at most 6 / R'^2 (U/2)^3 / (9 sqrt 3) = 0.048 U^3 / R'^2. With U^3 = 1e-3 R'^2 that
//! is 5e-5 m; on Earth U is about 3.8 km.

use glam::DVec3;
use terrafarm_common::shading::Earth;

/// The longest way of a ray over flat ground, metres.
pub(crate) const FLAT_REACH_M: f64 = 1e9;
/// The longest arc of a ray over the Earth, radians: 1460 km with refraction. From 10 km
/// up the horizon is 360 km away, and a peak as high as that shows at 720 km.
pub(crate) const REACH_RAD: f64 = 0.2;

/// The ground under a ray: flat, or a sphere.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ground {
    /// 1 / R', 0 for flat ground.
    curvature: f64,
    /// Length of a span in u; infinite for flat ground.
    span_u: f64,
}

impl Ground {
    /// Flat ground if there is no Earth, or one whose effective radius is no radius.
    pub(crate) fn new(earth: Option<Earth>) -> Self {
        let radius = earth.map(|earth| earth.effective_radius_m());
        match radius.filter(|radius| (1.0..1e15).contains(radius)) {
            Some(radius) => {
                Ground { curvature: 1.0 / radius, span_u: libm::cbrt(1e-3 * radius * radius) }
            }
            None => Ground { curvature: 0.0, span_u: f64::INFINITY },
        }
    }

    /// 1 / R', per metre; 0 for flat ground.
    pub(crate) fn curvature(&self) -> f64 {
        self.curvature
    }

    /// Length of a span of u; infinite for flat ground.
    pub(crate) fn span_u(&self) -> f64 {
        self.span_u
    }

    /// Height above the start, at map distance `across` and straight rise `rise`
    /// (|d.xy| u and d.z u), for a start at height `z0`. Grows with both.
    pub(crate) fn rise(&self, z0: f64, across_squared: f64, rise: f64) -> f64 {
        if self.curvature == 0.0 {
            return rise;
        }
        let k = self.curvature;
        let (sinc, versine) = sinc_versine(across_squared * k * k);
        let lift = rise * k * sinc;
        (1.0 / k + z0) * (lift + versine) / (1.0 - versine - lift)
    }
}

/// Squared angle below which the series of [`sinc_versine`] may end early: 64 km.
pub(crate) const SHORT_ARC: f64 = 1e-4;

/// sinc(phi) and 1 - cos(phi) of a squared angle up to 0.04, by their series; the terms
/// left out are below 1e-17 of the first.
#[inline]
fn sinc_versine(q: f64) -> (f64, f64) {
    if q < SHORT_ARC {
        let sinc = 1.0 + q * (-1.0 / 6.0 + q * (1.0 / 120.0 + q * (-1.0 / 5040.0)));
        let versine = q * (0.5 + q * (-1.0 / 24.0 + q * (1.0 / 720.0 + q * (-1.0 / 40_320.0))));
        return (sinc, versine);
    }
    let sinc = 1.0
        + q * (-1.0 / 6.0
            + q * (1.0 / 120.0
                + q * (-1.0 / 5040.0 + q * (1.0 / 362_880.0 + q * (-1.0 / 39_916_800.0)))));
    let versine = q
        * (0.5
            + q * (-1.0 / 24.0
                + q * (1.0 / 720.0
                    + q * (-1.0 / 40_320.0
                        + q * (1.0 / 3_628_800.0 + q * (-1.0 / 479_001_600.0))))));
    (sinc, versine)
}

/// One ray.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Path {
    /// Where it starts, grid frame.
    pub origin: DVec3,
    /// Unit vector of its direction at the start.
    pub direction: DVec3,
    /// The parameter at which it ends.
    pub reach_u: f64,
    ground: Ground,
}

/// A piece of a path with its parabola.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Span {
    /// Number of the span along the path.
    pub index: u64,
    /// Parameter at the start.
    pub start_u: f64,
    /// Parameter at the end; the next span starts there.
    pub end_u: f64,
    /// Height at the start.
    start_z: f64,
    /// Height at the end.
    end_z: f64,
    slope: f64,
    /// Coefficient of the square, never negative but for rounding.
    pub bend: f64,
}

impl Span {
    /// Height at a parameter within the span.
    #[inline(always)]
    pub(crate) fn z(&self, u: f64) -> f64 {
        if u >= self.end_u {
            return self.end_z;
        }
        let t = u - self.start_u;
        self.start_z + t * (self.slope + t * self.bend)
    }

    /// Whether the ray is above `height` at the start and rises from there on.
    pub(crate) fn leaves_above(&self, height: f64) -> bool {
        self.start_z > height && self.slope >= 0.0
    }
}

impl Path {
    pub(crate) fn new(ground: Ground, origin: DVec3, direction: DVec3) -> Self {
        let reach_u = if ground.curvature == 0.0 {
            FLAT_REACH_M
        } else {
            let radius = 1.0 / ground.curvature;
            let across = (direction.x * direction.x + direction.y * direction.y).sqrt();
            let arc = REACH_RAD * radius / across;
            arc.min(if direction.z > 0.0 {
                0.5 * radius
            } else {
                0.5 * radius + 2.0 * origin.z.abs()
            })
        };
        Path { origin, direction, reach_u, ground }
    }

    /// Height by the formula of the module's page, without spans.
    fn exact_z(&self, u: f64) -> f64 {
        let d = self.direction;
        let across_squared = (d.x * d.x + d.y * d.y) * (u * u);
        self.origin.z + self.ground.rise(self.origin.z, across_squared, d.z * u)
    }

    /// The span with a number.
    pub(crate) fn span(&self, index: u64) -> Span {
        if self.ground.curvature == 0.0 {
            let (start_z, slope) = (self.origin.z, self.direction.z);
            return Span {
                index: 0,
                start_u: 0.0,
                end_u: f64::INFINITY,
                start_z,
                end_z: start_z,
                slope,
                bend: 0.0,
            };
        }
        self.span_from(index, self.exact_z(index as f64 * self.ground.span_u))
    }

    fn span_from(&self, index: u64, start_z: f64) -> Span {
        let length = self.ground.span_u;
        let start_u = index as f64 * length;
        let end_u = (index + 1) as f64 * length;
        let middle = self.exact_z(start_u + 0.5 * length) - start_z;
        let end_z = self.exact_z(end_u);
        let end = end_z - start_z;
        let bend = (2.0 * end - 4.0 * middle) / (length * length);
        let slope = (4.0 * middle - end) / length;
        Span { index, start_u, end_u, start_z, end_z, slope, bend }
    }

    /// The span after this one.
    pub(crate) fn next_span(&self, span: &Span) -> Span {
        self.span_from(span.index + 1, span.end_z)
    }

    /// The span that holds a parameter; the later one at a common end.
    pub(crate) fn span_at(&self, u: f64) -> Span {
        if self.ground.curvature == 0.0 || u <= 0.0 {
            return self.span(0);
        }
        let length = self.ground.span_u;
        let mut index = (u / length) as u64;
        if index as f64 * length > u {
            index -= 1;
        } else if (index + 1) as f64 * length <= u {
            index += 1;
        }
        self.span(index)
    }

    /// Straight distance in space from the start to the ray's point at `u`, metres.
    pub(crate) fn distance_at(&self, u: f64) -> f64 {
        self.distance(u, self.exact_z(u))
    }

    /// Straight distance in space from the start to the point at `u`, metres.
    pub(crate) fn distance(&self, u: f64, z: f64) -> f64 {
        let k = self.ground.curvature;
        if k == 0.0 {
            return u;
        }
        let d = self.direction;
        let (_, versine) = sinc_versine((d.x * d.x + d.y * d.y) * (u * k) * (u * k));
        let (r0, r1) = (1.0 / k + self.origin.z, 1.0 / k + z);
        ((z - self.origin.z) * (z - self.origin.z) + 2.0 * r0 * r1 * versine).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn earth(refraction: f64) -> Ground {
        Ground::new(Some(Earth { radius_m: 6_371_000.0, refraction }))
    }

    fn unit(elevation: f64) -> DVec3 {
        DVec3::new(libm::cos(elevation), 0.0, libm::sin(elevation))
    }

    #[test]
    fn height_over_a_sphere_equals_the_triangle_in_space() {
        for refraction in [0.0, 0.13] {
            let ground = earth(refraction);
            let radius = 1.0 / ground.curvature();
            for elevation in [-1.5, -0.7, -0.2, -0.01, 0.0, 0.003, 0.3, 1.2] {
                let path = Path::new(ground, DVec3::new(0.0, 0.0, 2500.0), unit(elevation));
                for share in [1e-6, 1e-4, 1e-3, 0.01, 0.03] {
                    let u = path.reach_u * share;
                    let phi = u * path.direction.x / radius;
                    let r = (radius + 2500.0) * libm::cos(elevation) / libm::cos(elevation + phi);
                    let error = path.exact_z(u) - (r - radius);
                    assert!(error.abs() < 1e-7, "{elevation} {u}: {error}");
                }
            }
        }
    }

    #[test]
    fn vertical_rays_are_regular() {
        let ground = earth(0.0);
        let down = Path::new(ground, DVec3::new(0.0, 0.0, 1000.0), DVec3::new(0.0, 0.0, -1.0));
        assert!((down.exact_z(1000.0)).abs() < 1e-6);
        let span = down.span_at(500.0);
        assert!((down.distance(500.0, span.z(500.0)) - (1000.0 - span.z(500.0))).abs() < 1e-6);
    }

    #[test]
    fn spans_meet_and_stay_within_a_tenth_of_a_millimetre() {
        for refraction in [0.0, 0.13] {
            let ground = earth(refraction);
            for elevation in [-1.57, -1.2, -0.8, -0.3, -0.05, 0.0, 0.02] {
                let path = Path::new(ground, DVec3::new(0.0, 0.0, 9000.0), unit(elevation));
                let mut span = path.span(0);
                let mut worst = 0.0f64;
                while span.end_u < path.reach_u.min(1.2e6) && span.index < 500 {
                    for part in 0..32 {
                        let u = span.start_u + (span.end_u - span.start_u) * f64::from(part) / 32.0;
                        worst = worst.max((span.z(u) - path.exact_z(u)).abs());
                    }
                    let next = path.next_span(&span);
                    assert_eq!(span.z(span.end_u), next.z(next.start_u));
                    assert_eq!(next.z(next.start_u), path.span(next.index).z(next.start_u));
                    assert_eq!(path.span_at(next.start_u).index, next.index);
                    assert!(span.bend >= -1e-18);
                    span = next;
                }
                assert!(worst < 1e-4, "{elevation}: {worst}");
            }
        }
    }

    #[test]
    fn the_drop_by_curvature_is_the_known_one() {
        for (refraction, expected) in [(0.13, 683.0), (0.0, 785.0)] {
            let path = Path::new(earth(refraction), DVec3::ZERO, unit(0.0));
            assert!((path.exact_z(100_000.0) - expected).abs() < 1.0);
        }
    }
}
