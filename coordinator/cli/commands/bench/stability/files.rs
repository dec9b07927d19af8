//! Grounds that come from files, by the way that those of a user take: holes of every
//! spelling, the antimeridian, a pole.

use super::scenes::{Scene, Truth, look, view};
use crate::commands::bench::land::Land;
use std::fmt::Write;

/// Their scenes at a size of the picture, pixels.
pub fn scenes(size: (u32, u32)) -> anyhow::Result<Vec<Scene>> {
    let scene = |name, land, pose, truth| Scene { name, land, view: view(pose, size, None), truth };
    let (holes, sea) = (holes()?, antimeridian()?);
    let pole = pole()?;
    let [x, y] = sea.at(0.5);
    let above_sea = look([x, y, sea.pyramid.highest() + 1500.0], 20.0, -60.0);
    let above_pole = look([POLE_M, POLE_M, 60_000.0], 20.0, -80.0);
    let over_holes = look([501_000.0, 5_000_200.0, 900.0], 10.0, -35.0);
    Ok(vec![
        scene("holes of a file: no data, nan, inf, 1e38", holes, over_holes, Truth::Surface),
        scene("antimeridian, two files side by side", sea, above_sea, Truth::Closed),
        scene("pole, longitudes all around", pole, above_pole, Truth::Closed),
    ])
}

/// Easting and northing of the poles on their grids, metres.
const POLE_M: f64 = 2e6;

/// An ESRI ASCII grid: the centre of its south-west sample, the distance between samples,
/// columns and rows, and a text for each sample by column and row from the south-west.
fn grid(
    corner: [f64; 2],
    step: f64,
    [columns, rows]: [u64; 2],
    sample: impl Fn(u64, u64) -> String,
) -> String {
    let [x, y] = corner;
    let mut text = format!(
        "ncols {columns}\nnrows {rows}\nxllcenter {x}\nyllcenter {y}\ncellsize {step}\n\
         NODATA_value -32768\n"
    );
    for j in (0..rows).rev() {
        for i in 0..columns {
            // Writing to a string never fails.
            let _ = write!(text, "{} ", sample(i, j));
        }
        text.push('\n');
    }
    text
}

fn hill(i: u64, j: u64) -> f64 {
    (300 + (i * 7919 + j * 104_729) % 61) as f64
}

/// Hills with holes of every spelling that files have.
fn holes() -> anyhow::Result<Land> {
    let sample = |i: u64, j: u64| match ((i / 9 + j / 7) % 5, (i / 45) % 5) {
        (0, 0) => "-32768".to_owned(),
        (0, 1) => "nan".to_owned(),
        (0, 2) => "inf".to_owned(),
        (0, 3) => "-inf".to_owned(),
        (0, _) => "1e38".to_owned(),
        _ => hill(i, j).to_string(),
    };
    let text = grid([500_000.0, 5_000_000.0], 10.0, [300; 2], sample);
    Land::imported("holes", &[("holes.asc", text)], "EPSG:32633")
}

/// Two files of 0.08 degrees that meet at 180 degrees east and west.
fn antimeridian() -> anyhow::Result<Land> {
    let step = 0.001;
    let half = |first: f64, from: u64| {
        let height = |i: u64, j: u64| (hill((from + i) / 8, j / 8) + (from + i) as f64).to_string();
        grid([first + 0.5 * step, 52.0 + 0.5 * step], step, [80, 120], height)
    };
    let files = [("west.asc", half(180.0 - 80.0 * step, 0)), ("east.asc", half(-180.0, 80))];
    Land::imported("antimeridian", &files, "EPSG:4326")
}

/// Two degrees around the north pole, samples at the pole itself.
fn pole() -> anyhow::Result<Land> {
    let height = |i: u64, j: u64| (2000.0 - 40.0 * j as f64 + (i % 90) as f64).to_string();
    let text = grid([-179.5, 88.0], 1.0, [360, 3], |i, j| match j {
        // All samples of the last row are one place.
        2 => "1900".to_owned(),
        _ => height(i, j),
    });
    Land::imported("pole", &[("pole.asc", text)], "EPSG:4326")
}
