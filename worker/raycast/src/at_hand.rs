//! Pictures that cannot wait for their tiles, such as those of a live camera.
//!
//! The ground is that of [`depths_at_hand`]. Where a tile that shading needs is not loaded,
//! the place is shaded again as if its pixel were twice as wide, then four times, and so on:
//! wider pixels are filtered from coarser levels, until one is loaded. So a picture is
//! blurred where terrain is missing, and has no holes; it says how much of it is.

use crate::field::Field;
use crate::lanes;
use crate::pyramid::Pyramid;
use crate::shade::{At, Far, Places, Shader};
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
    let mut light = [0, 1, 2].map(|_| vec![0.0; columns]);
    let rows = pixels.chunks_exact_mut(3 * columns.max(1)).zip(0..region.height);
    for (pixels, row) in rows {
        let depths = &seen.depths.inverse_depth[row as usize * columns..][..columns];
        colors.row(&x, (region.y + row) as f32 + 0.5, depths, &mut light);
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

    /// Shades places of a row of pixels, with one over their depths.
    fn row(&mut self, x: &[f32], y: f32, inverse_depth: &[f32], light: &mut [Vec<f32>; 3]) {
        let [red, green, blue] = &mut *light;
        let places = Places { at: At::Net(x, &[y]), far: Far::Inverse(inverse_depth) };
        self.shader.shade(places, [red, green, blue]);
        let unknown = |light: &[Vec<f32>; 3]| -> Vec<usize> {
            (0..x.len()).filter(|&at| light[0][at].is_nan()).collect()
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
            let (x, inverse) = (of(x), of(inverse_depth));
            let mut again = [0, 1, 2].map(|_| vec![0.0; open.len()]);
            let [red, green, blue] = &mut again;
            let places = Places { at: At::Net(&x, &[y]), far: Far::Inverse(&inverse) };
            self.wider[doubling].shade(places, [red, green, blue]);
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
mod tests;
