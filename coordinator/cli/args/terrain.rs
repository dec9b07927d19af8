//! `terrafarm terrain ...`, as typed.

use clap::{Args as ClapArgs, Subcommand, ValueEnum};
use std::ops::RangeInclusive;
use std::path::PathBuf;

/// `terrafarm terrain ...`
#[derive(Debug, Subcommand)]
pub enum Terrain {
    /// Turn elevation files, photos and finer insets into one NAME.terrain
    Import(Box<Import>),
    /// Say what a store contains
    Info {
        /// The store
        store: PathBuf,
        /// Print as JSON
        #[arg(long)]
        json: bool,
    },
    /// Print the height at points: CSV in (`lon,lat` or `x,y`), CSV out with `height_m`
    Sample {
        /// The store
        store: PathBuf,
        /// CSV file of points with a header line; `-` for standard input
        #[arg(long)]
        points: PathBuf,
    },
    /// Make procedural terrain of any size and seed
    Synth(Synth),
    /// Write a hillshade of a store as a grey PNG, to look at it
    Hillshade {
        /// The store
        store: PathBuf,
        /// The PNG to write
        #[arg(short, long)]
        output: PathBuf,
        /// Direction of the light, degrees clockwise from grid north
        #[arg(long, default_value_t = 315.0, value_parser = parse_azimuth,
            allow_negative_numbers = true)]
        azimuth: f64,
        /// Height of the light above the horizon, degrees
        #[arg(long, default_value_t = 45.0, value_parser = parse_altitude,
            allow_negative_numbers = true)]
        altitude: f64,
    },
}

fn parse_azimuth(text: &str) -> Result<f64, String> {
    parse_degrees(text, -360.0..=360.0)
}

fn parse_altitude(text: &str) -> Result<f64, String> {
    parse_degrees(text, 0.0..=90.0)
}

fn parse_degrees(text: &str, range: RangeInclusive<f64>) -> Result<f64, String> {
    let degrees = text.parse().ok().filter(|degrees| range.contains(degrees));
    degrees.ok_or_else(|| format!("choose {} to {} degrees", range.start(), range.end()))
}

/// `terrafarm terrain import`
#[derive(Debug, ClapArgs)]
pub struct Import {
    /// Elevation files: GeoTIFF, .hgt, .hgt.zip, ESRI ASCII grid, USGS .dem, PNG
    #[arg(required = true)]
    pub elevation: Vec<PathBuf>,
    /// The store to write
    #[arg(short, long)]
    pub output: PathBuf,
    /// Aerial photo: GeoTIFF, or JPEG or PNG with a world file (may be given again)
    #[arg(long = "photo", value_name = "FILE")]
    pub photos: Vec<PathBuf>,
    /// Finer elevation for a part of the ground (may be given again)
    #[arg(long = "inset", value_name = "FILE")]
    pub insets: Vec<PathBuf>,
    /// Metric reference system of the store, such as EPSG:32612 [default: the inputs'
    /// own if metric, else the UTM zone of their centre]
    #[arg(long)]
    pub crs: Option<String>,
    /// Reference system of files that do not say theirs
    #[arg(long)]
    pub source_crs: Option<String>,
    /// Distance between posts, metres [default: that of the finest input, or a little
    /// less where it has to be resampled]
    #[arg(long, value_name = "METRES")]
    pub spacing: Option<f64>,
    /// Fill voids up to this many posts wide from their rim
    #[arg(long, value_name = "POSTS")]
    pub fill_voids: Option<u32>,
    /// How heights are packed into RGB of a PNG
    #[arg(long, value_enum, default_value_t = PngEncoding::Auto)]
    pub png_encoding: PngEncoding,
    /// Web Mercator tile that a PNG without a world file covers, as Z/X/Y
    #[arg(long, value_name = "Z/X/Y")]
    pub tile: Option<String>,
    /// Unit of heights where the file does not say, or says it wrong
    #[arg(long, value_enum)]
    pub height_unit: Option<HeightUnit>,
    /// Colour of a photo that means "no photo here", such as ffffff
    #[arg(long, value_name = "RRGGBB")]
    pub collar: Option<String>,
    /// Replace an existing store
    #[arg(long)]
    pub force: bool,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}

/// How heights are packed into the colours of a PNG.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum PngEncoding {
    /// Find out, or ask if it is not certain
    Auto,
    /// Mapbox: -10000 + 0.1 (65536 R + 256 G + B)
    TerrainRgb,
    /// Terrarium: 256 R + G + B / 256 - 32768
    Terrarium,
    /// R low byte, G high byte, B sign
    SrtmRgba,
    /// 16-bit grey, metres
    Grey16,
}

/// Unit of heights in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum HeightUnit {
    /// Metres
    Metres,
    /// International feet, 0.3048 m
    Feet,
    /// US survey feet, 1200/3937 m
    UsFeet,
}

/// `terrafarm terrain synth`
#[derive(Debug, ClapArgs)]
pub struct Synth {
    /// The store to write
    #[arg(short, long)]
    pub output: PathBuf,
    /// Posts along a side
    #[arg(long, default_value_t = 2049)]
    pub size: u32,
    /// Distance between posts, metres
    #[arg(long, default_value_t = 15.0)]
    pub spacing: f64,
    /// Same seed, same terrain
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Photo pixels per post along a side
    #[arg(long, default_value_t = 1)]
    pub photo_scale: u32,
    /// Replace an existing store
    #[arg(long)]
    pub force: bool,
    /// Print the result as JSON
    #[arg(long)]
    pub json: bool,
}
