//! Shaded relief of a height layer, the classic grey picture of a map.
//!
//! Slopes after Horn ("Hill shading and the reflectance map", Proceedings of the IEEE
//! 69(1), 1981): differences over 3 x 3 posts, weights 1 2 1. Grey is
//! `1 + 254 max(0, cos)` of the angle between the ground and the light, rounded to the
//! nearest; 0 where one of the nine posts is void or missing, which includes the border
//! of the layer. These are the rules of `gdaldem hillshade` with z-factor and scale 1, so
//! that anyone can check a store against a second program.

use crate::layout::{Layer, LayerKind, PostWindow, TILE_CELLS, TileKey};
use crate::resident::Tile;
use crate::store::{StoreError, StoreReader};
use crate::tile::HeightTile;

/// The largest picture, posts: 1 GiB.
pub const MAX_PICTURE_POSTS: u64 = 1 << 30;

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum HillshadeError {
    /// A tile cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The layer has no heights, or does not exist.
    #[error("layer {layer} is no height layer; \"terrafarm terrain info\" lists the layers")]
    Layer {
        /// Number of the layer.
        layer: u16,
    },
    /// The window leaves the layer, is empty, or is too large.
    #[error(
        "the window of {width} x {height} posts does not lie within the layer's {} x {}, or has more than {MAX_PICTURE_POSTS} posts; choose another",
        posts[0], posts[1]
    )]
    Window {
        /// Columns asked for.
        width: usize,
        /// Rows asked for.
        height: usize,
        /// Size of the layer.
        posts: [u64; 2],
    },
}

/// Shades level 0 of a height layer: one byte a post, rows from the north as in a picture.
/// `azimuth_deg` of the light is clockwise from grid north, `altitude_deg` above the
/// horizon; maps have 315 and 45.
///
/// # Errors
/// If the layer has no heights, the window does not fit, or a tile cannot be read.
pub fn hillshade(
    store: &StoreReader,
    layer_number: u16,
    window: PostWindow,
    azimuth_deg: f64,
    altitude_deg: f64,
) -> Result<Vec<u8>, HillshadeError> {
    let index = store.index();
    let layer = index
        .layers
        .get(usize::from(layer_number))
        .filter(|layer| layer.kind == LayerKind::Height)
        .ok_or(HillshadeError::Layer { layer: layer_number })?;
    let PostWindow { i0, j0, width, height } = window;
    let area = (width as u64).checked_mul(height as u64);
    let inside = i0.checked_add(width as u64).is_some_and(|end| end <= layer.posts[0])
        && j0.checked_add(height as u64).is_some_and(|end| end <= layer.posts[1]);
    if !inside || !area.is_some_and(|area| (1..=MAX_PICTURE_POSTS).contains(&area)) {
        return Err(HillshadeError::Window { width, height, posts: layer.posts });
    }
    let light = Light::new(layer, azimuth_deg, altitude_deg);
    let mut picture = vec![0; width * height];
    let tiles = |first: u64, count: usize| {
        let tile_of = |post: u64| (post / TILE_CELLS as u64) as u32;
        tile_of(first)..=tile_of(first + count as u64 - 1)
    };
    for ty in tiles(j0, height) {
        for tx in tiles(i0, width) {
            // The last post of a grid may be the first of a tile that does not exist: it
            // lies on the border and stays 0.
            let key = TileKey { layer: layer_number, level: 0, tx, ty };
            if index.entry(key).is_none() {
                continue;
            }
            if let Some(Tile::Height(tile)) = store.read_tile(key)? {
                shade_tile(&tile, [tx, ty], window, &light, &mut picture);
            }
        }
    }
    Ok(picture)
}

/// Shades the posts 0 ..= 255 of a tile that lie in the window.
fn shade_tile(
    tile: &HeightTile,
    [tx, ty]: [u32; 2],
    window: PostWindow,
    light: &Light,
    picture: &mut [u8],
) {
    let side = TILE_CELLS as u64;
    let overlap = |t: u32, first: u64, count: usize| {
        let start = u64::from(t) * side;
        start.max(first)..(start + side).min(first + count as u64)
    };
    for j in overlap(ty, window.j0, window.height) {
        let row = window.height - 1 - (j - window.j0) as usize;
        for i in overlap(tx, window.i0, window.width) {
            let column = (i - window.i0) as usize;
            let post = [i, j].map(|n| (n % side) as isize);
            picture[row * window.width + column] = light.grey(tile, post);
        }
    }
}

/// Direction of the light, and the distance between posts.
struct Light {
    east: f64,
    north: f64,
    up: f64,
    per_cell: [f64; 2],
}

impl Light {
    fn new(layer: &Layer, azimuth_deg: f64, altitude_deg: f64) -> Light {
        let (azimuth, altitude) = (azimuth_deg.to_radians(), altitude_deg.to_radians());
        Light {
            east: libm::sin(azimuth) * libm::cos(altitude),
            north: libm::cos(azimuth) * libm::cos(altitude),
            up: libm::sin(altitude),
            per_cell: layer.spacing.map(|spacing| 1.0 / (8.0 * spacing)),
        }
    }

    fn grey(&self, tile: &HeightTile, [i, j]: [isize; 2]) -> u8 {
        let post = |di: isize, dj: isize| f64::from(tile.post(i + di, j + dj));
        let column = |di: isize| post(di, -1) + 2.0 * post(di, 0) + post(di, 1);
        let row = |dj: isize| post(-1, dj) + 2.0 * post(0, dj) + post(1, dj);
        let rise_east = (column(1) - column(-1)) * self.per_cell[0];
        let rise_north = (row(1) - row(-1)) * self.per_cell[1];
        if (rise_east + rise_north + post(0, 0)).is_nan() {
            return 0;
        }
        let toward = self.up - self.east * rise_east - self.north * rise_north;
        let cosine = toward / (1.0 + rise_east * rise_east + rise_north * rise_north).sqrt();
        (1.5 + 254.0 * cosine.max(0.0)) as u8
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::build::LayerSpec;
    use crate::fixture::{Ground, height_layer};
    use std::fmt::Write as _;
    use std::fs;
    use std::path::Path;
    use std::process::Command;

    /// A grid as a picture: rows from the north.
    struct Grid {
        width: usize,
        height: usize,
        rows: Vec<f32>,
    }

    impl Grid {
        fn from_rule(width: usize, height: usize, rule: impl Fn(f64, f64) -> f32) -> Grid {
            let rows = (0..width * height)
                .map(|at| rule((at % width) as f64, (height - 1 - at / width) as f64))
                .collect();
            Grid { width, height, rows }
        }

        fn shade(&self, folder: &Path, spacing: [f64; 2], light: [f64; 2]) -> Vec<u8> {
            let (width, height, rows) = (self.width, self.height, self.rows.clone());
            let posts = [width as u64, height as u64];
            let path = folder.join("shade.terrain");
            Ground::new()
                .heights(LayerSpec { spacing, ..height_layer(posts) }, move |i, j| {
                    rows[(height - 1 - j as usize) * width + i as usize]
                })
                .build(&path)
                .unwrap();
            let store = StoreReader::open(&path).unwrap();
            let whole = PostWindow { i0: 0, j0: 0, width, height };
            let picture = hillshade(&store, 0, whole, light[0], light[1]).unwrap();
            let part = PostWindow { i0: 3, j0: 5, width: width - 7, height: height - 9 };
            let cut = hillshade(&store, 0, part, light[0], light[1]).unwrap();
            for (row, cut) in cut.chunks(part.width).enumerate() {
                let start = (row + 4) * width + 3;
                assert_eq!(cut, &picture[start..start + part.width], "a part equals the whole");
            }
            picture
        }

        /// The same by `gdaldem`; `None` if there is none.
        fn shade_by_gdal(
            &self,
            folder: &Path,
            spacing: [f64; 2],
            light: [f64; 2],
        ) -> Option<Vec<u8>> {
            let mut text = format!(
                "ncols {}\nnrows {}\nxllcorner 0\nyllcorner 0\ndx {}\ndy {}\nNODATA_value -9999\n",
                self.width, self.height, spacing[0], spacing[1]
            );
            for row in self.rows.chunks(self.width) {
                for height in row {
                    let height = if height.is_nan() { -9999.0 } else { *height };
                    write!(text, "{height} ").unwrap();
                }
                text.push('\n');
            }
            fs::write(folder.join("grid.asc"), text).unwrap();
            let done = Command::new("gdaldem")
                .current_dir(folder)
                .args(["hillshade", "-q", "-of", "ENVI", "grid.asc", "shade.raw"])
                .args(["-az", &light[0].to_string(), "-alt", &light[1].to_string()])
                .status();
            match done {
                Ok(status) => {
                    assert!(status.success(), "gdaldem failed");
                    Some(fs::read(folder.join("shade.raw")).unwrap())
                }
                Err(_) => {
                    println!("skipped: gdaldem is not on the path");
                    None
                }
            }
        }

        #[track_caller]
        fn check_against_gdal(&self, spacing: [f64; 2], light: [f64; 2]) {
            let folder = tempfile::tempdir().unwrap();
            let ours = self.shade(folder.path(), spacing, light);
            let Some(theirs) = self.shade_by_gdal(folder.path(), spacing, light) else { return };
            assert_eq!(ours.len(), theirs.len());
            let apart = |(a, b): (&u8, &u8)| a.abs_diff(*b);
            let worst = ours.iter().zip(&theirs).map(apart).max().unwrap();
            let unequal = ours.iter().zip(&theirs).filter(|&pair| apart(pair) > 0).count();
            println!("{unequal} of {} posts differ from gdaldem, by at most {worst}", ours.len());
            assert!(worst <= 1, "off by {worst}");
            assert!(unequal * 10_000 <= ours.len(), "{unequal} of {} differ", ours.len());
        }
    }

    fn waves(x: f64, y: f64) -> f32 {
        let long = 300.0 * libm::sin(x / 31.0) * libm::cos(y / 47.0);
        (long + 40.0 * libm::sin(x / 3.7 + y / 5.1) + 12.0 * libm::cos(x * y / 900.0)) as f32
    }

    #[test]
    fn waves_are_shaded_as_gdaldem_does() {
        Grid::from_rule(517, 300, waves).check_against_gdal([30.0, 30.0], [315.0, 45.0]);
    }

    #[test]
    fn other_lights_and_oblong_cells_are_shaded_as_gdaldem_does() {
        Grid::from_rule(270, 260, waves).check_against_gdal([30.0, 12.5], [100.0, 20.0]);
    }

    #[test]
    fn voids_are_shaded_as_gdaldem_does() {
        let holed =
            |x: f64, y: f64| if (x * 7.0 + y * 3.0) % 101.0 < 1.0 { f32::NAN } else { waves(x, y) };
        Grid::from_rule(300, 280, holed).check_against_gdal([30.0, 30.0], [315.0, 45.0]);
    }

    #[test]
    fn srtm_is_shaded_as_gdaldem_does() {
        let tif = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/zion/srtm.tif");
        let folder = tempfile::tempdir().unwrap();
        let asc = folder.path().join("srtm.asc");
        let done = Command::new("gdal_translate")
            .args(["-q", "-of", "AAIGrid"])
            .args([&tif, &asc])
            .status();
        if !tif.exists() || !done.is_ok_and(|status| status.success()) {
            println!("skipped: no {} or no gdal_translate", tif.display());
            return;
        }
        let text = fs::read_to_string(&asc).unwrap();
        let rows: Vec<Vec<f32>> = text
            .lines()
            .skip_while(|line| line.starts_with(|c: char| c.is_alphabetic()))
            .map(|line| line.split_whitespace().map(|word| word.parse().unwrap()).collect())
            .collect();
        let grid = Grid { width: rows[0].len(), height: rows.len(), rows: rows.concat() };
        assert_eq!((grid.width, grid.height), (465, 457));
        grid.check_against_gdal([90.0, 90.0], [315.0, 45.0]);
    }

    #[test]
    fn flat_ground_has_the_sine_of_the_altitude_and_the_border_is_0() {
        let folder = tempfile::tempdir().unwrap();
        let picture =
            Grid::from_rule(20, 20, |_, _| 5.0).shade(folder.path(), [1.0; 2], [0.0, 30.0]);
        assert_eq!(picture[20 * 7 + 7], 128);
        assert!(picture[..20].iter().chain(&picture[380..]).all(|&grey| grey == 0));
        assert!((0..20).all(|row| picture[row * 20] == 0 && picture[row * 20 + 19] == 0));
    }

    #[test]
    fn a_slope_that_faces_away_is_1_and_windows_outside_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let steep = Grid::from_rule(20, 20, |x, _| 9.0 * x as f32);
        assert_eq!(steep.shade(folder.path(), [1.0; 2], [90.0, 30.0])[20 * 7 + 7], 1);
        let store = StoreReader::open(&folder.path().join("shade.terrain")).unwrap();
        let at = |i0: u64, width: usize| {
            hillshade(&store, 0, PostWindow { i0, j0: 0, width, height: 1 }, 315.0, 45.0)
        };
        assert!(at(0, 20).is_ok());
        for (i0, width) in [(0, 21), (20, 1), (0, 0), (u64::MAX, 2), (0, usize::MAX)] {
            assert!(matches!(at(i0, width), Err(HillshadeError::Window { .. })), "{i0} {width}");
        }
        let window = PostWindow { i0: 0, j0: 0, width: 1, height: 1 };
        assert!(matches!(
            hillshade(&store, 7, window, 315.0, 45.0),
            Err(HillshadeError::Layer { layer: 7 })
        ));
    }
}
