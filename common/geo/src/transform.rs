//! Points from one system to another.

use proj4rs::Proj;
use proj4rs::transform::{Transform, TransformClosure, transform};

use crate::crs::{Crs, CrsError};

/// Carries points from one system to another.
///
/// The way is: undo the projection, shift the datum to WGS84 and on to the other one
/// (nothing if both agree), project again.
#[derive(Clone)]
pub struct Transformer {
    from: Crs,
    to: Crs,
    identical: bool,
}

impl Transformer {
    /// A way from one system to another. `LOCAL` leads to `LOCAL` only.
    ///
    /// # Errors
    /// If exactly one of the two is `LOCAL`: it lies nowhere.
    pub fn new(from: &Crs, to: &Crs) -> Result<Self, CrsError> {
        if from.is_local() != to.is_local() {
            return Err(CrsError::Nowhere);
        }
        let identical = from.is_same_grid(to);
        Ok(Transformer { from: from.clone(), to: to.clone(), identical })
    }

    /// Whether points come out as they went in.
    pub fn is_identity(&self) -> bool {
        self.identical
    }

    /// Transforms all points in place. A point outside the domain of a system, or one
    /// that is not finite, becomes NaN. Longitudes come out in −180 ..= 180.
    pub fn apply(&self, points: &mut [[f64; 2]]) {
        if self.identical {
            return;
        }
        let (Some(from), Some(to)) = (self.from.system(), self.to.system()) else { return };
        from.unproject(points);
        if from.datum_text != to.datum_text {
            if let Some(shifted) = &from.shifted {
                run(shifted, &from.wgs84, points);
            }
            if let Some(shifted) = &to.shifted {
                run(&to.wgs84, shifted, points);
            }
        }
        to.project(points);
    }

    /// Transforms one point; NaN as [`Transformer::apply`] says.
    pub fn apply_one(&self, point: [f64; 2]) -> [f64; 2] {
        let mut points = [point];
        self.apply(&mut points);
        points[0]
    }
}

/// A system that lies on Earth, ready for use.
#[derive(Clone)]
pub(crate) struct System {
    /// The projection, without datum shift, prime meridian (geographic only) and axes.
    pub(crate) proj: Proj,
    /// Longitude and latitude in radians on the same ellipsoid, without shift.
    pub(crate) geographic: Proj,
    /// The same with the shift to WGS84; `None` if it counts as WGS84.
    pub(crate) shifted: Option<Proj>,
    /// Longitude and latitude in radians on WGS84, the hub of all shifts.
    pub(crate) wgs84: Proj,
    /// The datum in words; equal text means that no shift is needed.
    pub(crate) datum_text: String,
    /// Prime meridian of a geographic system, degrees east of Greenwich.
    pub(crate) prime_meridian_deg: f64,
    /// Which way the first and second coordinate point.
    pub(crate) axes: Axes,
}

/// Directions of the two coordinates.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Axes {
    EastNorth,
    WestSouth,
    SouthWest,
}

impl Axes {
    /// Between these axes and east, north: the operation is its own inverse.
    fn swap(self, [x, y]: [f64; 2]) -> [f64; 2] {
        match self {
            Axes::EastNorth => [x, y],
            Axes::WestSouth => [-x, -y],
            Axes::SouthWest => [-y, -x],
        }
    }
}

impl System {
    /// To longitude and latitude in radians on the system's own datum.
    fn unproject(&self, points: &mut [[f64; 2]]) {
        for point in points.iter_mut() {
            *point = self.axes.swap(*point);
        }
        if self.proj.is_latlong() {
            for point in points.iter_mut() {
                *point = if point[1].abs() <= 90.0 + 1e-9 {
                    let latitude = point[1].clamp(-90.0, 90.0);
                    [(point[0] + self.prime_meridian_deg).to_radians(), latitude.to_radians()]
                } else {
                    [f64::NAN; 2]
                };
            }
        } else {
            run(&self.proj, &self.geographic, points);
        }
    }

    /// From longitude and latitude in radians on the system's own datum.
    fn project(&self, points: &mut [[f64; 2]]) {
        if self.proj.is_latlong() {
            for point in points.iter_mut() {
                let longitude = point[0].to_degrees() - self.prime_meridian_deg;
                *point = [wrap_longitude(longitude), point[1].to_degrees()];
            }
        } else {
            for point in points.iter_mut() {
                point[0] = wrap_longitude(point[0].to_degrees()).to_radians();
            }
            run(&self.geographic, &self.proj, points);
        }
        for point in points.iter_mut() {
            *point = self.axes.swap(*point);
        }
    }
}

/// A longitude brought to −180 ..= 180 degrees; untouched if it is there already.
pub(crate) fn wrap_longitude(longitude_deg: f64) -> f64 {
    if longitude_deg.abs() <= 180.0 {
        longitude_deg
    } else {
        (longitude_deg + 180.0).rem_euclid(360.0) - 180.0
    }
}

fn run(from: &Proj, to: &Proj, points: &mut [[f64; 2]]) {
    if transform(from, to, &mut Points(points)).is_err() {
        // Only a projection without an inverse ends here.
        points.fill([f64::NAN; 2]);
    }
}

/// Points for proj4rs: those that fail become NaN and do not stop the others.
struct Points<'a>(&'a mut [[f64; 2]]);

impl Transform for Points<'_> {
    fn transform_coordinates<F: TransformClosure>(
        &mut self,
        step: &mut F,
    ) -> proj4rs::errors::Result<()> {
        for point in self.0.iter_mut() {
            let [x, y] = *point;
            *point = [f64::NAN; 2];
            if x.is_finite()
                && y.is_finite()
                && let Ok((x, y, _)) = step(x, y, 0.0)
                && x.is_finite()
                && y.is_finite()
            {
                *point = [x, y];
            }
        }
        Ok(())
    }
}
