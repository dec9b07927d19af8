//! The photo under a pixel: filtered over its footprint.
//!
//! The level of the photo's pyramid follows from the short axis of the footprint; along
//! the long axis several samples are taken. So the photo neither swims at the horizon,
//! where footprints are long and narrow, nor blurs across.

use super::footprint::{Axes, Footprint, level_of};
use crate::field::{Field, Wanted};
use terrafarm_terrain::layout::{Layer, LayerKind, TILE_CELLS, TileKey};
use terrafarm_terrain::resident::Lookup;
use terrafarm_terrain::tile::PhotoTile;

/// The most samples along a footprint; longer ones take a coarser level.
const MAX_SAMPLES: f64 = 16.0;
/// Size of the footprint for which a level is used, in its texels.
const TEXELS_PER_FOOTPRINT: f64 = 1.0;
/// Coverage from which on a photo hides what lies below it.
const OPAQUE: f32 = 0.999;

/// Reads photos, and remembers the tiles that it used last.
pub(crate) struct Photos<'a> {
    field: Field<'a>,
    /// Topmost first.
    layers: Vec<(usize, &'a Layer)>,
    /// Last tile of even and of odd levels.
    tiles: [Option<(TileKey, Option<&'a PhotoTile>)>; 2],
}

impl<'a> Photos<'a> {
    pub(crate) fn new(field: Field<'a>) -> Self {
        let mut layers: Vec<_> = field.index().layers_of(LayerKind::Photo).collect();
        layers.reverse();
        Photos { field, layers, tiles: [None; 2] }
    }

    /// Colour (premultiplied) and coverage at a place of the map. Tiles that are not
    /// loaded are added to `wanted` and count as bare.
    pub(crate) fn sample(
        &mut self,
        place: [f64; 2],
        footprint: &Footprint,
        wanted: &mut Wanted,
    ) -> [f32; 4] {
        let mut sum = [0.0; 4];
        for at in 0..self.layers.len() {
            let (number, layer) = self.layers[at];
            let texel = [0, 1].map(|axis| (place[axis] - layer.origin[axis]) / layer.spacing[axis]);
            let inside = (0..2)
                .all(|axis| texel[axis] >= -0.5 && texel[axis] <= layer.posts[axis] as f64 - 0.5);
            if !inside {
                continue;
            }
            let axes = footprint.axes(layer.spacing);
            let below = self.filtered(number, layer, texel, &axes, wanted);
            let uncovered = 1.0 - sum[3];
            for channel in 0..4 {
                sum[channel] += uncovered * below[channel];
            }
            if sum[3] >= OPAQUE {
                break;
            }
        }
        sum
    }

    fn filtered(
        &mut self,
        number: usize,
        layer: &Layer,
        texel: [f64; 2],
        axes: &Axes,
        wanted: &mut Wanted,
    ) -> [f32; 4] {
        let width = (axes.minor_length.max(axes.major_length / MAX_SAMPLES)).max(1.0);
        let (level, share) = level_of(width / TEXELS_PER_FOOTPRINT, layer.levels.len() - 1);
        let samples = (axes.major_length / width).ceil().clamp(1.0, MAX_SAMPLES);
        let mut sum = [0.0; 4];
        for sample in 0..samples as u32 {
            let along = (f64::from(sample) + 0.5) / samples - 0.5;
            let place = [texel[0] + axes.major.x * along, texel[1] + axes.major.y * along];
            let fine = self.bilinear(number, layer, level, place, wanted);
            if share > 0.0 {
                let coarse = self.bilinear(number, layer, level + 1, place, wanted);
                for channel in 0..4 {
                    sum[channel] += fine[channel] + (coarse[channel] - fine[channel]) * share;
                }
            } else {
                for channel in 0..4 {
                    sum[channel] += fine[channel];
                }
            }
        }
        let scale = 1.0 / (65535.0 * samples as f32);
        sum.map(|channel| channel * scale)
    }

    /// Colour at a place of level 0, from a level of the pyramid, 65535 = 1.
    #[inline]
    fn bilinear(
        &mut self,
        number: usize,
        layer: &Layer,
        level: usize,
        place: [f64; 2],
        wanted: &mut Wanted,
    ) -> [f32; 4] {
        let posts = layer.level_posts(level);
        let shrink = 1.0 / (1u64 << level) as f64;
        let [x, y] = [0, 1].map(|axis| (place[axis] * shrink).clamp(0.0, (posts[axis] - 1) as f64));
        let [tx, ty] = [(x, 0), (y, 1)].map(|(value, axis)| {
            (value as u32 / TILE_CELLS as u32).min(layer.levels[level].tiles[axis] - 1)
        });
        let key = TileKey { layer: number as u16, level: level as u16, tx, ty };
        let Some(tile) = self.tile(key, wanted) else { return [0.0; 4] };
        let local_x = x - f64::from(tx * TILE_CELLS as u32);
        let local_y = y - f64::from(ty * TILE_CELLS as u32);
        let (i, j) = (local_x as isize, local_y as isize);
        let (fx, fy) = ((local_x - i as f64) as f32, (local_y - j as f64) as f32);
        let [sw, se, nw, ne] = [(0, 0), (1, 0), (0, 1), (1, 1)]
            .map(|(di, dj)| tile.texel(i + di, j + dj).map(f32::from));
        let mut color = [0.0; 4];
        for channel in 0..4 {
            let south = sw[channel] + (se[channel] - sw[channel]) * fx;
            let north = nw[channel] + (ne[channel] - nw[channel]) * fx;
            color[channel] = south + (north - south) * fy;
        }
        color
    }

    #[inline]
    fn tile(&mut self, key: TileKey, wanted: &mut Wanted) -> Option<&'a PhotoTile> {
        let slot = &mut self.tiles[usize::from(key.level & 1)];
        if let Some((last, tile)) = slot
            && *last == key
        {
            return *tile;
        }
        match self.field.resident.photo(key) {
            Lookup::Found(tile) => {
                *slot = Some((key, Some(tile)));
                Some(tile)
            }
            Lookup::Empty => {
                *slot = Some((key, None));
                None
            }
            Lookup::Absent => {
                wanted.add(key);
                None
            }
        }
    }
}
