//! What a shot is made of, as typed for `render`, `submit` and `demo`.

use crate::input::scene::parse_size;
use crate::input::{parse_method, parse_tolerance};
use clap::Args as ClapArgs;
use std::path::PathBuf;
use terrafarm_common::accuracy::Share;
use terrafarm_common::quality::Method;
use terrafarm_common::region::Split;

/// A flight over a scene, and how it is rendered: what `render` and `submit` have in common.
#[derive(Debug, ClapArgs)]
pub struct Shot {
    /// Scene file (TOML), or a .terrain store to render with the default light
    pub scene: PathBuf,
    /// Flight: CSV keyframes
    #[arg(long)]
    pub flight: PathBuf,
    /// Size of the picture [default: the scene's, else 1280x720]
    #[arg(long, value_parser = parse_size, value_name = "WxH")]
    pub size: Option<(u32, u32)>,
    /// Frames per second of flight [default: the scene's, else 30]
    #[arg(long)]
    pub fps: Option<f64>,
    /// Render these frames only, such as 0..24 (the end is not included)
    #[arg(long, value_parser = parse_range, value_name = "FIRST..END")]
    pub frames: Option<(u32, u32)>,
    /// How rays find the ground and what that may cost
    #[command(flatten)]
    pub casting: Casting,
    /// Samples along each side of a pixel: 2 means 4 a pixel
    #[arg(long)]
    pub samples: Option<u32>,
    /// Shape of the jobs: columns, tiles, or tiles:SIDE
    #[arg(long, value_parser = parse_split, default_value = "columns")]
    pub split: Split,
    /// Frames that may be under way at once [default: 3]
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub frames_in_flight: Option<u32>,
    /// Shots of a higher priority get every worker they can use; equals take turns
    #[arg(long, default_value_t = 0, allow_negative_numbers = true)]
    pub priority: i32,
}

/// How rays are cast, and measured.
#[derive(Debug, Clone, Copy, ClapArgs)]
pub struct Casting {
    /// How rays find the ground: auto, exact, lod, column, frustum, voxel or reference
    /// [default: the scene's, else auto]
    #[arg(long, value_parser = parse_method, value_name = "NAME")]
    pub method: Option<Method>,
    /// How far a method may displace what is seen, pixels, 0.01 to 64 [default: the
    /// scene's, else 0.5]
    #[arg(long, value_parser = parse_tolerance, value_name = "PX", allow_negative_numbers = true)]
    pub tolerance: Option<f64>,
    /// Measure a random share of the pixels against exact, such as 1%: error in pixels,
    /// per frame in the manifest
    #[arg(long, value_name = "PERCENT", default_value = "0", allow_negative_numbers = true)]
    pub check: Share,
}

/// The shortest side of a tile, pixels: smaller ones are all overhead.
const MIN_TILE_SIDE: u32 = 8;

fn parse_range(text: &str) -> Result<(u32, u32), String> {
    text.split_once("..")
        .and_then(|(first, end)| Some((first.parse().ok()?, end.parse().ok()?)))
        .filter(|(first, end)| first < end)
        .ok_or_else(|| "write FIRST..END with FIRST below END, such as 0..24".into())
}

fn parse_split(text: &str) -> Result<Split, String> {
    match text.split_once(':') {
        None if text == "columns" => Ok(Split::Columns),
        None if text == "tiles" => Ok(Split::Tiles(128)),
        Some(("tiles", side)) => match side.parse::<u32>() {
            Ok(side) if (MIN_TILE_SIDE..=Split::MAX_TILE_SIDE).contains(&side) => {
                Ok(Split::Tiles(side))
            }
            _ => Err(format!(
                "a tile has {MIN_TILE_SIDE} to {} pixels a side, such as tiles:128",
                Split::MAX_TILE_SIDE
            )),
        },
        _ => Err("choose columns, tiles or tiles:SIDE".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_and_splits_are_read() {
        assert_eq!(parse_range("3..9"), Ok((3, 9)));
        assert!(parse_range("9..3").is_err());
        assert_eq!(parse_split("tiles:64"), Ok(Split::Tiles(64)));
        assert!(parse_split("tiles:0").is_err());
        assert_eq!(parse_split("tiles:2048"), Ok(Split::Tiles(2048)));
        assert!(parse_split("tiles:2049").is_err());
        assert!(parse_split("rows").is_err());
    }
}
