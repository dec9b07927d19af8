//! Shared values as they are written on the wire.
//!
//! Each type here is the serializable twin of a value of `terrafarm-common`, so that a
//! change there cannot silently change the protocol. Going out is always possible;
//! coming in is `TryFrom`, which refuses what no honest peer sends: numbers that are not
//! numbers, sizes of zero, colours outside 0 to 1, codes this version does not know.

use crate::message::Unfit;
use glam::DVec3;
use serde::{Deserialize, Serialize};
use terrafarm_common::accuracy::{Kept, Share, Summary};
use terrafarm_common::camera::{Camera, MAX_SIDE_PX};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::region::{Region, Split};
use terrafarm_common::shading::{Earth, Haze, LinearRgb, Shading, Sky, Sun};

/// Twin of [`Camera`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CameraTwin {
    position: [f64; 3],
    right: [f64; 3],
    up: [f64; 3],
    forward: [f64; 3],
    tan_half_hfov: f64,
    size: [u32; 2],
}

impl From<&Camera> for CameraTwin {
    fn from(camera: &Camera) -> Self {
        CameraTwin {
            position: camera.position.to_array(),
            right: camera.right.to_array(),
            up: camera.up.to_array(),
            forward: camera.forward.to_array(),
            tan_half_hfov: camera.tan_half_hfov,
            size: [camera.width, camera.height],
        }
    }
}

impl TryFrom<CameraTwin> for Camera {
    type Error = Unfit;

    fn try_from(twin: CameraTwin) -> Result<Self, Unfit> {
        let camera = Camera {
            position: DVec3::from_array(twin.position),
            right: DVec3::from_array(twin.right),
            up: DVec3::from_array(twin.up),
            forward: DVec3::from_array(twin.forward),
            tan_half_hfov: twin.tan_half_hfov,
            width: twin.size[0],
            height: twin.size[1],
        };
        fit_camera(&camera)?;
        Ok(camera)
    }
}

/// Twin of [`Region`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct RegionTwin {
    corner: [u32; 2],
    size: [u32; 2],
}

impl From<Region> for RegionTwin {
    fn from(region: Region) -> Self {
        RegionTwin { corner: [region.x, region.y], size: [region.width, region.height] }
    }
}

impl TryFrom<RegionTwin> for Region {
    type Error = Unfit;

    fn try_from(twin: RegionTwin) -> Result<Self, Unfit> {
        let ([x, y], [width, height]) = (twin.corner, twin.size);
        let region = Region { x, y, width, height };
        fit_region(&region, MAX_SIDE_PX, MAX_SIDE_PX)?;
        Ok(region)
    }
}

/// Twin of [`Quality`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct QualityTwin {
    method: u16,
    samples_per_side: u32,
    tolerance_px: f64,
}

impl From<Quality> for QualityTwin {
    fn from(quality: Quality) -> Self {
        let method = match quality.method {
            Method::Exact => 0,
            Method::Reference => 1,
            Method::Auto => 2,
            Method::Lod => 3,
            Method::Column => 4,
            Method::Frustum => 5,
            Method::Voxel => 6,
        };
        let Quality { samples_per_side, tolerance_px, .. } = quality;
        QualityTwin { method, samples_per_side, tolerance_px }
    }
}

impl TryFrom<QualityTwin> for Quality {
    type Error = Unfit;

    fn try_from(twin: QualityTwin) -> Result<Self, Unfit> {
        let method = match twin.method {
            0 => Method::Exact,
            1 => Method::Reference,
            2 => Method::Auto,
            3 => Method::Lod,
            4 => Method::Column,
            5 => Method::Frustum,
            6 => Method::Voxel,
            code => return Err(Unfit(format!("method number {code} is not known"))),
        };
        let QualityTwin { samples_per_side, tolerance_px, .. } = twin;
        let quality = Quality { method, samples_per_side, tolerance_px };
        fit_quality(quality)?;
        Ok(quality)
    }
}

/// Twin of [`Share`]: millionths.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ShareTwin(u32);

impl From<Share> for ShareTwin {
    fn from(share: Share) -> Self {
        ShareTwin(share.millionths())
    }
}

impl TryFrom<ShareTwin> for Share {
    type Error = Unfit;

    fn try_from(twin: ShareTwin) -> Result<Self, Unfit> {
        Share::from_millionths(twin.0).ok_or_else(|| Unfit("a share is larger than all".into()))
    }
}

/// Twin of [`Summary`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SummaryTwin {
    samples: u64,
    mismatches: u64,
    error_max_px: f64,
    depth_max_m: Option<f64>,
    kept: Vec<(u32, f32, Option<f32>)>,
}

impl From<&Summary> for SummaryTwin {
    fn from(summary: &Summary) -> Self {
        let kept = summary.kept().iter().map(|kept| (kept.number, kept.error_px, kept.depth_m));
        SummaryTwin {
            samples: summary.samples(),
            mismatches: summary.mismatches(),
            error_max_px: summary.error_max_px(),
            depth_max_m: summary.depth_max_m(),
            kept: kept.collect(),
        }
    }
}

impl TryFrom<SummaryTwin> for Summary {
    type Error = Unfit;

    fn try_from(twin: SummaryTwin) -> Result<Self, Unfit> {
        let kept = twin.kept.into_iter();
        let kept = kept.map(|(number, error_px, depth_m)| Kept { number, error_px, depth_m });
        let counts = [twin.samples, twin.mismatches];
        Summary::from_parts(counts, twin.error_max_px, twin.depth_max_m, kept.collect())
            .ok_or_else(|| Unfit("a summary of errors contradicts itself".into()))
    }
}

/// Twin of [`Split`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum SplitTwin {
    /// Strips of full height.
    Columns,
    /// Squares of this side, pixels.
    Tiles(u32),
}

impl From<Split> for SplitTwin {
    fn from(split: Split) -> Self {
        match split {
            Split::Columns => SplitTwin::Columns,
            Split::Tiles(side) => SplitTwin::Tiles(side),
        }
    }
}

impl TryFrom<SplitTwin> for Split {
    type Error = Unfit;

    fn try_from(twin: SplitTwin) -> Result<Self, Unfit> {
        let split = match twin {
            SplitTwin::Columns => Split::Columns,
            SplitTwin::Tiles(side) => Split::Tiles(side),
        };
        fit_split(split)?;
        Ok(split)
    }
}

/// Twin of [`Shading`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ShadingTwin {
    sun: Option<SunTwin>,
    haze: Option<HazeTwin>,
    sky_horizon: LinearRgb,
    sky_zenith: LinearRgb,
    earth: Option<EarthTwin>,
    below_ground: LinearRgb,
    bare_ground: Option<LinearRgb>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct SunTwin {
    direction: [f64; 3],
    ambient: f32,
    strength: f32,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct HazeTwin {
    visibility_m: f64,
    scale_height_m: f64,
    color: LinearRgb,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct EarthTwin {
    radius_m: f64,
    refraction: f64,
}

impl From<&Shading> for ShadingTwin {
    fn from(shading: &Shading) -> Self {
        ShadingTwin {
            sun: shading.sun.map(|sun| SunTwin {
                direction: sun.direction.to_array(),
                ambient: sun.ambient,
                strength: sun.strength,
            }),
            haze: shading.haze.map(|haze| HazeTwin {
                visibility_m: haze.visibility_m,
                scale_height_m: haze.scale_height_m,
                color: haze.color,
            }),
            sky_horizon: shading.sky.horizon,
            sky_zenith: shading.sky.zenith,
            earth: shading
                .earth
                .map(|earth| EarthTwin { radius_m: earth.radius_m, refraction: earth.refraction }),
            below_ground: shading.below_ground,
            bare_ground: shading.bare_ground,
        }
    }
}

impl TryFrom<ShadingTwin> for Shading {
    type Error = Unfit;

    fn try_from(twin: ShadingTwin) -> Result<Self, Unfit> {
        let shading = Shading {
            sun: twin.sun.map(|sun| Sun {
                direction: DVec3::from_array(sun.direction),
                ambient: sun.ambient,
                strength: sun.strength,
            }),
            haze: twin.haze.map(|haze| Haze {
                visibility_m: haze.visibility_m,
                scale_height_m: haze.scale_height_m,
                color: haze.color,
            }),
            sky: Sky { horizon: twin.sky_horizon, zenith: twin.sky_zenith },
            earth: twin
                .earth
                .map(|earth| Earth { radius_m: earth.radius_m, refraction: earth.refraction }),
            below_ground: twin.below_ground,
            bare_ground: twin.bare_ground,
        };
        fit_shading(&shading)?;
        Ok(shading)
    }
}

/// Refuses a camera that [`Camera::is_valid`] does.
pub(crate) fn fit_camera(camera: &Camera) -> Result<(), Unfit> {
    Unfit::unless(camera.is_valid(), "the camera has a number, an axis or a size out of range")
}

/// Refuses an empty region, or one outside a frame of this size.
pub(crate) fn fit_region(region: &Region, width: u32, height: u32) -> Result<(), Unfit> {
    Unfit::unless(region.fits(width, height), "the region is empty or outside the frame")
}

/// Refuses a frame without pixels, or one larger than [`MAX_SIDE_PX`].
pub(crate) fn fit_size(width: u32, height: u32) -> Result<(), Unfit> {
    let sides = 1..=MAX_SIDE_PX;
    Unfit::unless(sides.contains(&width) && sides.contains(&height), "the size is out of range")
}

/// Refuses a number of samples out of range.
pub(crate) fn fit_quality(quality: Quality) -> Result<(), Unfit> {
    Unfit::unless(quality.is_valid(), "the number of samples or the tolerance is out of range")
}

/// Refuses tiles without pixels, or larger than any frame.
pub(crate) fn fit_split(split: Split) -> Result<(), Unfit> {
    let fits = match split {
        Split::Columns => true,
        Split::Tiles(side) => (1..=Split::MAX_TILE_SIDE).contains(&side),
    };
    Unfit::unless(fits, "the side of the tiles is out of range")
}

/// Refuses colours outside 0 to 1, directions that are no unit vectors, lengths that are
/// no numbers.
pub(crate) fn fit_shading(shading: &Shading) -> Result<(), Unfit> {
    let color = |rgb: &LinearRgb| rgb.iter().all(|value| (0.0..=1.0).contains(value));
    let share = |value: f32| (0.0..=1.0).contains(&value);
    if let Some(sun) = &shading.sun {
        let unit = (sun.direction.length_squared() - 1.0).abs() <= 1e-6;
        let fits = unit && share(sun.ambient) && share(sun.strength);
        Unfit::unless(fits, "the sun has a direction or a share out of range")?;
    }
    if let Some(haze) = &shading.haze {
        let visible = haze.visibility_m.is_finite() && haze.visibility_m > 0.0;
        let scale = haze.scale_height_m.is_finite() && haze.scale_height_m >= 0.0;
        Unfit::unless(visible && scale && color(&haze.color), "the haze is out of range")?;
    }
    if let Some(earth) = &shading.earth {
        let fits = Earth::RADII_M.contains(&earth.radius_m)
            && Earth::REFRACTIONS.contains(&earth.refraction);
        Unfit::unless(fits, "the radius of the Earth or the refraction is out of range")?;
    }
    let colors = [shading.sky.horizon, shading.sky.zenith, shading.below_ground];
    let fits = colors.iter().chain(&shading.bare_ground).all(color);
    Unfit::unless(fits, "a colour is outside 0 to 1")
}

#[cfg(test)]
mod tests {
    use super::*;
    use terrafarm_common::accuracy::PixelError;

    fn shading() -> Shading {
        Shading {
            sun: Some(Sun::at(140.0, 35.0, 0.3, 0.5)),
            haze: Some(Haze { visibility_m: 4e4, scale_height_m: 0.0, color: [0.5; 3] }),
            sky: Sky::default(),
            earth: Some(Earth { radius_m: 6.37e6, refraction: 0.13 }),
            below_ground: [0.2; 3],
            bare_ground: None,
        }
    }

    fn refuses(change: impl FnOnce(&mut Shading)) {
        let mut changed = shading();
        change(&mut changed);
        assert!(Shading::try_from(ShadingTwin::from(&changed)).is_err(), "{changed:?}");
    }

    #[test]
    fn shading_survives_its_twin() {
        assert_eq!(Shading::try_from(ShadingTwin::from(&shading())), Ok(shading()));
    }

    #[test]
    fn shading_that_is_no_number_or_out_of_range_is_refused() {
        refuses(|s| s.sky.zenith[1] = f32::NAN);
        refuses(|s| s.bare_ground = Some([0.0, 1.1, 0.0]));
        refuses(|s| s.below_ground[0] = -0.1);
        refuses(|s| s.sun = Some(Sun { direction: DVec3::ZERO, ambient: 0.0, strength: 0.0 }));
        refuses(|s| s.sun = Some(Sun::at(f64::NAN, 0.0, 0.0, 0.0)));
        refuses(|s| s.sun = Some(Sun::at(0.0, 30.0, 2.0, 0.0)));
        refuses(|s| s.haze = s.haze.map(|haze| Haze { visibility_m: 0.0, ..haze }));
        refuses(|s| s.haze = s.haze.map(|haze| Haze { scale_height_m: f64::INFINITY, ..haze }));
        refuses(|s| s.earth = Some(Earth { radius_m: 6.37e6, refraction: 1.0 }));
        refuses(|s| s.earth = Some(Earth { radius_m: 0.0, refraction: 0.0 }));
    }

    #[test]
    fn regions_that_are_empty_or_run_over_are_refused() {
        let twin = |x, y, width, height| RegionTwin::from(Region { x, y, width, height });
        assert!(Region::try_from(twin(0, 0, 1, 1)).is_ok());
        assert!(Region::try_from(twin(0, 0, 0, 1)).is_err());
        assert!(Region::try_from(twin(5, 5, 1, 0)).is_err());
        assert!(Region::try_from(twin(u32::MAX, 0, 2, 1)).is_err());
        assert!(Region::try_from(twin(0, MAX_SIDE_PX, 1, 1)).is_err());
    }

    #[test]
    fn every_method_has_a_number_and_others_are_refused() {
        for method in Method::ALL {
            let quality = Quality { method, samples_per_side: 3, tolerance_px: 0.25 };
            assert_eq!(Quality::try_from(QualityTwin::from(quality)), Ok(quality));
        }
        let twin = QualityTwin::from(Quality::default());
        assert!(Quality::try_from(QualityTwin { method: 77, ..twin }).is_err());
        assert!(Quality::try_from(QualityTwin { samples_per_side: 0, ..twin }).is_err());
        assert!(Quality::try_from(QualityTwin { samples_per_side: 33, ..twin }).is_err());
        for tolerance_px in [0.0, -1.0, 65.0, f64::NAN, f64::INFINITY] {
            assert!(Quality::try_from(QualityTwin { tolerance_px, ..twin }).is_err());
        }
    }

    #[test]
    fn shares_and_summaries_come_back_and_others_are_refused() {
        let share = Share::from_millionths(1_000_000).expect("it is all");
        assert_eq!(Share::try_from(ShareTwin::from(share)), Ok(share));
        assert!(Share::try_from(ShareTwin(1_000_001)).is_err());
        let mut summary = Summary::default();
        let (surface_px, occlusion_px) = (0.5, 2.0);
        summary.add(5, &PixelError { surface_px, occlusion_px, depth_m: None, mismatch: true });
        let twin = SummaryTwin::from(&summary);
        assert_eq!(Summary::try_from(twin.clone()), Ok(summary));
        assert!(Summary::try_from(SummaryTwin { samples: 9, ..twin.clone() }).is_err());
        assert!(Summary::try_from(SummaryTwin { mismatches: 2, ..twin.clone() }).is_err());
        assert!(Summary::try_from(SummaryTwin { error_max_px: f64::NAN, ..twin }).is_err());
    }

    #[test]
    fn tiles_without_pixels_are_refused() {
        assert_eq!(Split::try_from(SplitTwin::Columns), Ok(Split::Columns));
        assert_eq!(Split::try_from(SplitTwin::Tiles(64)), Ok(Split::Tiles(64)));
        assert!(Split::try_from(SplitTwin::Tiles(0)).is_err());
    }
}
