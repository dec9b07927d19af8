//! The parabolas of `path` for N rays: the same operations in the same order, so the same
//! bits.

use crate::lanes::{Doubles, Ints, Lanes, Mask};
use crate::path::{Ground, SHORT_ARC};

/// How a ray's height follows from its parameter over a round Earth.
#[derive(Clone, Copy)]
pub(super) struct Rise<L: Lanes> {
    /// Squared part of the direction along the map.
    pub across: L::D,
    /// Its part upwards.
    pub up: L::D,
}

/// Spans of N rays; see `path`.
#[derive(Clone, Copy)]
pub(super) struct Spans<L: Lanes> {
    /// Number of the span along the path.
    pub number: L::D,
    pub start_u: L::D,
    pub end_u: L::D,
    pub start_z: L::D,
    pub end_z: L::D,
    pub slope: L::D,
    pub bend: L::D,
}

/// The sphere as the camera sees it.
#[derive(Clone, Copy)]
pub(crate) struct Globe {
    pub eye_z: f64,
    /// 1 / effective radius, per metre.
    pub curvature: f64,
    /// Length of a span.
    pub span_u: f64,
}

impl Globe {
    pub(crate) fn new(ground: &Ground, eye_z: f64) -> Self {
        Globe { eye_z, curvature: ground.curvature(), span_u: ground.span_u() }
    }

    #[inline(always)]
    fn height<L: Lanes>(&self, rise: &Rise<L>, u: L::D) -> L::D {
        let across_squared = rise.across * (u * u);
        L::D::splat(self.eye_z) + self.rise::<L>(across_squared, rise.up * u)
    }

    /// `Ground::rise` from the height of the camera.
    #[inline(always)]
    pub(crate) fn rise<L: Lanes>(&self, across_squared: L::D, rise: L::D) -> L::D {
        let k = L::D::splat(self.curvature);
        let (sinc, versine) = sinc_versine::<L>(across_squared * k * k);
        let lift = rise * k * sinc;
        let radius = L::D::splat(1.0 / self.curvature + self.eye_z);
        (radius * (lift + versine)).div(L::D::splat(1.0) - versine - lift)
    }

    /// The spans that hold a parameter; the later one at a common end. Also where there
    /// are too many before it to count.
    #[inline(always)]
    pub(super) fn spans_at<L: Lanes>(&self, rise: &Rise<L>, u: L::D) -> (Spans<L>, L::M) {
        let (length, one) = (L::D::splat(self.span_u), L::D::splat(1.0));
        let share = u.div(length);
        let countable = share.lt(L::D::splat(1e9));
        let guess = L::D::from_ints(share.truncate().max(L::I::splat(0)));
        let earlier = u.lt(guess * length);
        let later = ((guess + one) * length).le(u) & !earlier;
        let number = L::D::select(earlier, guess - one, guess);
        let number = L::D::select(later, guess + one, number);
        let start_z = self.height(rise, number * length);
        (self.spans_from(rise, number, start_z), !countable)
    }

    #[inline(always)]
    pub(super) fn spans_from<L: Lanes>(
        &self,
        rise: &Rise<L>,
        number: L::D,
        start_z: L::D,
    ) -> Spans<L> {
        let length = L::D::splat(self.span_u);
        let start_u = number * length;
        let end_u = (number + L::D::splat(1.0)) * length;
        let middle = self.height(rise, start_u + L::D::splat(0.5) * length) - start_z;
        let end_z = self.height(rise, end_u);
        let end = end_z - start_z;
        let bend = (L::D::splat(2.0) * end - L::D::splat(4.0) * middle).div(length * length);
        let slope = (L::D::splat(4.0) * middle - end).div(length);
        Spans { number, start_u, end_u, start_z, end_z, slope, bend }
    }
}

impl<L: Lanes> Spans<L> {
    /// Height at a parameter within the span.
    #[inline(always)]
    pub(super) fn z(&self, u: L::D) -> L::D {
        let t = u - self.start_u;
        let z = self.start_z + t * (self.slope + t * self.bend);
        L::D::select(self.end_u.le(u), self.end_z, z)
    }

    #[inline(always)]
    pub(super) fn select(mask: L::M, yes: &Self, no: &Self) -> Self {
        Spans {
            number: L::D::select(mask, yes.number, no.number),
            start_u: L::D::select(mask, yes.start_u, no.start_u),
            end_u: L::D::select(mask, yes.end_u, no.end_u),
            start_z: L::D::select(mask, yes.start_z, no.start_z),
            end_z: L::D::select(mask, yes.end_z, no.end_z),
            slope: L::D::select(mask, yes.slope, no.slope),
            bend: L::D::select(mask, yes.bend, no.bend),
        }
    }
}

/// The series of `path`: short ones up to [`SHORT_ARC`], long ones from there on.
#[inline(always)]
fn sinc_versine<L: Lanes>(q: L::D) -> (L::D, L::D) {
    let sinc = series::<L>(q, -1.0 / 5040.0, &[1.0 / 120.0, -1.0 / 6.0, 1.0]);
    let versine = q * series::<L>(q, -1.0 / 40_320.0, &[1.0 / 720.0, -1.0 / 24.0, 0.5]);
    let short = q.lt(L::D::splat(SHORT_ARC));
    if !(!short).any() {
        return (sinc, versine);
    }
    let terms = [1.0 / 362_880.0, -1.0 / 5040.0, 1.0 / 120.0, -1.0 / 6.0, 1.0];
    let long_sinc = series::<L>(q, -1.0 / 39_916_800.0, &terms);
    let terms = [1.0 / 3_628_800.0, -1.0 / 40_320.0, 1.0 / 720.0, -1.0 / 24.0, 0.5];
    let long_versine = q * series::<L>(q, -1.0 / 479_001_600.0, &terms);
    (L::D::select(short, sinc, long_sinc), L::D::select(short, versine, long_versine))
}

/// A polynomial of `q`, from the last coefficient to the first.
#[inline(always)]
fn series<L: Lanes>(q: L::D, last: f64, rest: &[f64]) -> L::D {
    let mut sum = L::D::splat(last);
    for &term in rest {
        sum = L::D::splat(term) + q * sum;
    }
    sum
}
