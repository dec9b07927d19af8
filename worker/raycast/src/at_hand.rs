//! Pictures that cannot wait for their tiles, such as those of a live camera.
//!
//! The ground is that of [`depths_at_hand`]. Where a tile that shading needs is not loaded,
//! the place is shaded again as if its pixel were twice as wide, then four times, and so on:
//! wider pixels are filtered from coarser levels, until one is loaded. So a picture is
//! blurred where terrain is missing, and has no holes; it says how much of it is.

use crate::fast;
use crate::field::Field;
use crate::lanes;
use crate::pyramid::Pyramid;
use crate::shade::{Places, Shader};
use crate::sight::{Unseen, depths_at_hand};
use crate::{View, srgb};
use std::collections::BTreeSet;
use terrafarm_common::region::Region;
use terrafarm_terrain::layout::TileKey;
use terrafarm_terrain::resident::Resident;

/// How often a pixel is made twice as wide at most: a store has no more levels.
const MOST_DOUBLINGS: usize = 26;

/// A picture of what is at hand; see [`render_at_hand`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Glimpse {
    /// Rows from the top, three bytes of sRGB a pixel.
    pub pixels: Vec<u8>,
    /// Pixels that show ground at a coarser level than the tolerance asks for.
    pub coarser_ground: u64,
    /// Pixels whose colour or sunlight is of a coarser level than their size asks for.
    pub coarser_color: u64,
    /// Pixels that are black because no level at all is loaded there.
    pub holes: u64,
    /// The tiles that the whole picture needs and that are not loaded, sorted.
    pub wanted: Vec<TileKey>,
}

impl Glimpse {
    /// Whether a tile was missing: the picture is another than [`crate::render`] would make.
    pub fn is_degraded(&self) -> bool {
        !self.wanted.is_empty()
    }
}

/// Renders a region with the tiles at hand and waits for none: where a tile is missing, it
/// shows a coarser level. There is one sample a pixel. With nothing missing, `lod` and
/// `column` show what [`crate::render`] does.
///
/// A camera close to ground whose tile is not loaded is taken to be above it.
///
/// # Errors
/// As [`depths_at_hand`].
pub fn render_at_hand(
    resident: &Resident,
    pyramid: &Pyramid,
    view: &View,
    region: Region,
) -> Result<Glimpse, Unseen> {
    let field = Field { resident, pyramid };
    let mut pixels = vec![0; region.area() as usize * 3];
    if field.is_below(view.camera.position) == Ok(true) {
        let color = srgb::encode(view.shading.below_ground);
        pixels.chunks_exact_mut(3).for_each(|pixel| pixel.copy_from_slice(&color));
        let (coarser_ground, coarser_color, holes) = (0, 0, 0);
        return Ok(Glimpse { pixels, coarser_ground, coarser_color, holes, wanted: Vec::new() });
    }
    let seen = depths_at_hand(resident, pyramid, view, region)?;
    let mut colors = Colors::new(field, view);
    let columns = region.width as usize;
    let x: Vec<f32> = (0..region.width).map(|x| (region.x + x) as f32 + 0.5).collect();
    let mut s = vec![0.0; columns];
    let mut light = [0, 1, 2].map(|_| vec![0.0; columns]);
    let rows = pixels.chunks_exact_mut(3 * columns.max(1)).zip(0..region.height);
    for (pixels, row) in rows {
        let depths = &seen.depths.inverse_depth[row as usize * columns..][..columns];
        fast::map_distances(&view.camera, region, row, depths, &mut s);
        let y = vec![(region.y + row) as f32 + 0.5; columns];
        colors.row(Places { x: &x, y: &y, s: &s }, &mut light);
        srgb::encode_all(light.each_ref().map(Vec::as_slice), pixels, lanes::widest());
    }
    let mut wanted = BTreeSet::from_iter(seen.wanted);
    colors.shader.wanted.drain_into(&mut wanted);
    Ok(Glimpse {
        pixels,
        coarser_ground: seen.coarser,
        coarser_color: colors.coarser,
        holes: colors.holes,
        wanted: wanted.into_iter().collect(),
    })
}

/// Shades rows, and again what lacks a tile.
struct Colors<'a> {
    shader: Shader<'a>,
    /// For pixels that are 2, 4, ... times as wide; made when one is needed.
    wider: Vec<Shader<'a>>,
    field: Field<'a>,
    view: &'a View,
    coarser: u64,
    holes: u64,
}

impl<'a> Colors<'a> {
    fn new(field: Field<'a>, view: &'a View) -> Self {
        let shader = Shader::new(field, &view.camera, &view.shading, 1);
        Colors { shader, wider: Vec::new(), field, view, coarser: 0, holes: 0 }
    }

    fn row(&mut self, places: Places, light: &mut [Vec<f32>; 3]) {
        let [red, green, blue] = &mut *light;
        self.shader.shade(places, [red, green, blue]);
        let unknown = |light: &[Vec<f32>; 3]| -> Vec<usize> {
            (0..places.s.len()).filter(|&at| light[0][at].is_nan()).collect()
        };
        let mut open = unknown(light);
        let count = open.len();
        for doubling in 0..MOST_DOUBLINGS {
            if open.is_empty() {
                break;
            }
            if self.wider.len() == doubling {
                let mut shader = Shader::new(self.field, &self.view.camera, &self.view.shading, 1);
                shader.widen((2u32 << doubling) as f32);
                self.wider.push(shader);
            }
            let of = |values: &[f32]| -> Vec<f32> { open.iter().map(|&at| values[at]).collect() };
            let (x, y, s) = (of(places.x), of(places.y), of(places.s));
            let mut again = [0, 1, 2].map(|_| vec![0.0; open.len()]);
            let [red, green, blue] = &mut again;
            self.wider[doubling].shade(Places { x: &x, y: &y, s: &s }, [red, green, blue]);
            for (light, again) in light.iter_mut().zip(&again) {
                for (&at, &value) in open.iter().zip(again) {
                    light[at] = value;
                }
            }
            open = unknown(light);
        }
        self.holes += open.len() as u64;
        self.coarser += (count - open.len()) as u64;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::oracle::Dice;
    use crate::render;
    use crate::tests_support::{Plan, mountains, noise, store};
    use glam::DVec3;
    use terrafarm_common::camera::Camera;
    use terrafarm_common::quality::{Method, Quality};
    use terrafarm_common::shading::{Shading, Sky, Sun};

    const SIZE: (u32, u32) = (90, 60);

    /// Hills under a photo, lit from the side, seen to a wide horizon.
    fn view(pyramid: &Pyramid, method: Method) -> View {
        let eye = DVec3::new(900.0, 400.0, pyramid.highest() + 200.0);
        let shading = Shading {
            sun: Some(Sun::at(300.0, 30.0, 0.3, 0.8)),
            haze: None,
            sky: Sky::default(),
            earth: None,
            below_ground: [1.0, 0.0, 0.0],
            bare_ground: None,
        };
        let camera = Camera::from_angles(eye, 30.0, -20.0, 0.0, 60.0, SIZE);
        let quality = Quality { method, tolerance_px: 0.5, ..Quality::default() };
        View { camera, shading, quality }
    }

    fn plans() -> Vec<Plan> {
        let height = |i, j| mountains(i, j, 512, 300.0, 5) * 0.6;
        let color =
            |i, j| [0.2 + 0.5 * noise(i, j, 9), 0.4, 0.3 + 0.2 * noise(i / 9, j / 9, 2), 1.0];
        vec![
            Plan::heights([0.0; 2], [10.0; 2], [900, 800], height),
            Plan::photo([0.0; 2], [8.0; 2], [1120, 1000], color),
        ]
    }

    #[test]
    fn a_glimpse_has_no_holes_and_is_the_picture_when_nothing_is_missing() {
        let (empty, tiles) = store(plans());
        let pyramid = Pyramid::new(empty.index());
        let roots = empty.index().roots();
        assert_eq!(roots.len(), 2);
        let mut resident = empty.clone();
        for (key, tile) in &tiles {
            resident.insert(*key, tile.clone());
        }
        let whole = Region::whole(SIZE.0, SIZE.1);
        for method in [Method::Lod, Method::Column] {
            let view = view(&pyramid, method);
            let truth = render(&resident, &pyramid, &view, whole).unwrap();
            let full = render_at_hand(&resident, &pyramid, &view, whole).unwrap();
            assert!(truth.missing.is_empty() && !full.is_degraded());
            assert_eq!((full.coarser_ground, full.coarser_color, full.holes), (0, 0, 0));
            assert!(full.pixels == truth.pixels, "{method}: other pixels");
            let mut dice = Dice::new(4);
            let mut last = 0.0;
            for share in [0.2, 0.6, 1.0] {
                let mut some = resident.clone();
                for (key, _) in tiles.iter().filter(|(key, _)| !roots.contains(key)) {
                    if dice.between(0.0, 1.0) < share {
                        some.remove(*key);
                    }
                }
                let seen = render_at_hand(&some, &pyramid, &view, whole).unwrap();
                assert!(seen.is_degraded() && seen.holes == 0, "{method} {share}");
                assert!(seen.coarser_color > 0 && seen.wanted.is_sorted(), "{method} {share}");
                let off = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b)).powi(2);
                let sum: f64 = seen.pixels.iter().zip(&truth.pixels).map(off).sum();
                let error = (sum / truth.pixels.len() as f64).sqrt();
                assert!(error >= last && error < 60.0, "{method} {share}: {error} after {last}");
                last = error;
            }
            assert!(last > 1.0, "{method}: nothing was missing");
        }
    }

    #[test]
    fn what_has_no_level_at_all_is_told() {
        let (empty, tiles) = store(plans());
        let pyramid = Pyramid::new(empty.index());
        let view = view(&pyramid, Method::Lod);
        let whole = Region::whole(SIZE.0, SIZE.1);
        assert!(render_at_hand(&empty, &pyramid, &view, whole).is_err());
        let mut heights = empty.clone();
        for (key, tile) in tiles.iter().filter(|(key, _)| key.layer == 0) {
            heights.insert(*key, tile.clone());
        }
        let seen = render_at_hand(&heights, &pyramid, &view, whole).unwrap();
        assert_eq!(seen.coarser_ground, 0);
        assert!(seen.holes > 0 && seen.wanted.iter().all(|key| key.layer == 1), "{seen:?}");
    }

    #[test]
    fn a_camera_below_ground_sees_its_colour() {
        let (empty, tiles) = store(plans());
        let pyramid = Pyramid::new(empty.index());
        let mut resident = empty;
        for (key, tile) in tiles {
            resident.insert(key, tile);
        }
        let mut view = view(&pyramid, Method::Column);
        view.camera.position.z = pyramid.lowest() - 50.0;
        let whole = Region::whole(SIZE.0, SIZE.1);
        let seen = render_at_hand(&resident, &pyramid, &view, whole).unwrap();
        assert!(seen.pixels.chunks_exact(3).all(|pixel| pixel == [255, 0, 0]));
    }
}
