//! The scene file.
//!
//! Every key with its range and its default, as [`Scene::example`] gives it:
//!
//! ```toml
#![doc = include_str!("scene/example.toml")]
//! ```

use super::{InputError, parse_method, read_text};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use terrafarm_common::camera::{MAX_HFOV_DEG, MAX_SIDE_PX, MIN_HFOV_DEG};
use terrafarm_common::quality::{Method, Quality};
use terrafarm_common::shading::{Earth, Haze, LinearRgb, Shading, Sky, Sun};
use toml::Spanned;

/// The largest scene file, bytes.
const MAX_BYTES: u64 = 1 << 20;

/// A scene as the program uses it.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// The terrain store, from the working directory.
    pub terrain: PathBuf,
    /// Width and height of the pictures, pixels.
    pub size: (u32, u32),
    /// Horizontal field of view where the flight gives none, degrees.
    pub hfov_deg: f64,
    /// Frames per second.
    pub fps: f64,
    /// Method, tolerance and samples.
    pub quality: Quality,
    /// Direct light, its azimuth still from true north.
    pub sun: Option<SunAngles>,
    /// Haze.
    pub haze: Option<Haze>,
    /// Sky.
    pub sky: Sky,
    /// Whether the Earth is round; `None` if it is where the terrain has a place on it.
    pub curvature: Option<bool>,
    /// Coefficient of refraction.
    pub refraction: f64,
    /// Colour of ground without a photo; tints by height if `None`.
    pub bare_ground: Option<LinearRgb>,
    /// Colour of everything seen from below the ground.
    pub below_ground: LinearRgb,
}

/// A sun as people give it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SunAngles {
    /// Clockwise from true north, degrees.
    pub azimuth_deg: f64,
    /// Above the horizon, degrees.
    pub elevation_deg: f64,
    /// Light from all of the sky, as a share of full sunlight.
    pub ambient: f32,
    /// How strongly the sun shades the photo.
    pub strength: f32,
}

impl Scene {
    /// Reads a scene file.
    pub fn read(file: &Path) -> Result<Scene, InputError> {
        Self::parse(file, &read_text(file, MAX_BYTES)?)
    }

    /// Reads the text of a scene file; `file` is for messages, and for the folder that
    /// the terrain is looked for in.
    pub fn parse(file: &Path, text: &str) -> Result<Scene, InputError> {
        let typed: SceneFile = toml::from_str(text).map_err(|error| {
            let line = error.span().map(|span| line_of(text, span.start));
            InputError { line, ..InputError::in_file(file, error.message()) }
        })?;
        typed.resolve(&Source { file, text })
    }

    /// A scene file with every key, its range and its default.
    pub fn example() -> &'static str {
        include_str!("scene/example.toml")
    }

    /// Everything about the picture that is neither terrain nor camera.
    ///
    /// `earth_radius_m` is the store's radius of the Earth, `None` for terrain without a
    /// place on it; `convergence_deg` the bearing of true north on the grid at the middle
    /// of the terrain, clockwise from grid north.
    pub fn shading(
        &self,
        earth_radius_m: Option<f64>,
        convergence_deg: f64,
    ) -> Result<Shading, String> {
        let earth = match (self.curvature, earth_radius_m) {
            (Some(false), _) | (None, None) => None,
            (_, Some(radius_m)) => Some(Earth { radius_m, refraction: self.refraction }),
            (Some(true), None) => {
                return Err("[earth] curvature = true needs terrain with a place on Earth, and this one has none; remove the key".to_string());
            }
        };
        let sun = self.sun.map(|sun| {
            let azimuth = sun.azimuth_deg + convergence_deg;
            Sun::at(azimuth, sun.elevation_deg, sun.ambient, sun.strength)
        });
        Ok(Shading {
            sun,
            haze: self.haze,
            sky: self.sky,
            earth,
            below_ground: self.below_ground,
            bare_ground: self.bare_ground,
        })
    }
}

/// A width and height as people write them: `1280x720`.
pub fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let side = |text: &str| text.trim().parse().ok().filter(|n| (1..=MAX_SIDE_PX).contains(n));
    let sides = text.split_once(['x', 'X', '×']);
    let size = sides.and_then(|(width, height)| Some((side(width)?, side(height)?)));
    size.ok_or_else(|| {
        format!("\"{text}\" is no size; write WIDTHxHEIGHT, each 1 to {MAX_SIDE_PX}, as 1280x720")
    })
}

/// The file as it is typed.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneFile {
    terrain: Spanned<PathBuf>,
    #[serde(default)]
    camera: CameraTable,
    sun: Option<SunTable>,
    haze: Option<HazeTable>,
    #[serde(default)]
    sky: SkyTable,
    #[serde(default)]
    earth: EarthTable,
    #[serde(default)]
    ground: GroundTable,
    #[serde(default)]
    output: OutputTable,
}

type Number = Option<Spanned<f64>>;
type Color = Option<Spanned<ColorValue>>;

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct CameraTable {
    size: Option<Spanned<String>>,
    hfov: Number,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SunTable {
    azimuth: Number,
    elevation: Number,
    ambient: Number,
    strength: Number,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct HazeTable {
    visibility_km: Number,
    scale_height_m: Number,
    color: Color,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct SkyTable {
    horizon: Color,
    zenith: Color,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct EarthTable {
    curvature: Option<bool>,
    refraction: Number,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct GroundTable {
    color: Color,
    below: Color,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct OutputTable {
    fps: Number,
    samples: Number,
    method: Option<Spanned<String>>,
    tolerance: Number,
}

#[derive(Deserialize)]
#[serde(untagged, expecting = "a color is \"#rrggbb\" or three numbers 0 to 1 in linear light")]
enum ColorValue {
    Screen(String),
    Linear([f32; 3]),
}

impl SceneFile {
    fn resolve(self, source: &Source) -> Result<Scene, InputError> {
        let number = |value, key, default, low, high| source.number(value, key, default, low, high);
        if self.terrain.get_ref().as_os_str().is_empty() {
            return Err(source.wrong(&self.terrain, "terrain is empty; name a .terrain file"));
        }
        let folder = source.file.parent().unwrap_or(Path::new(""));
        let terrain = folder.join(self.terrain.get_ref());
        let size = source.read_as(self.camera.size, (1280, 720), parse_size)?;
        let hfov_deg = number(self.camera.hfov, "[camera] hfov", 60.0, MIN_HFOV_DEG, MAX_HFOV_DEG)?;
        let sun = self.sun.map(|sun| sun.resolve(source)).transpose()?;
        let sky = Sky {
            horizon: source.color(self.sky.horizon)?.unwrap_or(Sky::default().horizon),
            zenith: source.color(self.sky.zenith)?.unwrap_or(Sky::default().zenith),
        };
        let haze = self.haze.map(|haze| haze.resolve(source, sky.horizon)).transpose()?;
        let samples = self.output.samples.as_ref().map(|samples| *samples.get_ref());
        if samples.is_some_and(|samples| samples.fract() != 0.0) {
            let message = "[output] samples is a whole number: samples along a side of a pixel";
            return Err(self.output.samples.map_or_else(
                || InputError::in_file(source.file, message),
                |samples| source.wrong(&samples, message),
            ));
        }
        let most = f64::from(Quality::MAX_SAMPLES_PER_SIDE);
        let samples = number(self.output.samples, "[output] samples", 1.0, 1.0, most)?;
        let method = source.read_as(self.output.method, Method::Auto, parse_method)?;
        let tolerance_px = number(
            self.output.tolerance,
            "[output] tolerance",
            Quality::DEFAULT_TOLERANCE_PX,
            Quality::MIN_TOLERANCE_PX,
            Quality::MAX_TOLERANCE_PX,
        )?;
        Ok(Scene {
            terrain,
            size,
            hfov_deg,
            fps: number(self.output.fps, "[output] fps", 30.0, 0.001, 1000.0)?,
            quality: Quality { method, samples_per_side: samples as u32, tolerance_px },
            sun,
            haze,
            sky,
            curvature: self.earth.curvature,
            refraction: number(
                self.earth.refraction,
                "[earth] refraction",
                0.13,
                *Earth::REFRACTIONS.start(),
                *Earth::REFRACTIONS.end(),
            )?,
            bare_ground: source.color(self.ground.color)?,
            below_ground: source.color(self.ground.below)?.unwrap_or([0.03, 0.02, 0.02]),
        })
    }
}

impl SunTable {
    fn resolve(self, source: &Source) -> Result<SunAngles, InputError> {
        let number = |value, key, default, low, high| source.number(value, key, default, low, high);
        Ok(SunAngles {
            azimuth_deg: number(self.azimuth, "[sun] azimuth", 315.0, -360.0, 360.0)?,
            elevation_deg: number(self.elevation, "[sun] elevation", 45.0, -90.0, 90.0)?,
            ambient: number(self.ambient, "[sun] ambient", 0.35, 0.0, 1.0)? as f32,
            strength: number(self.strength, "[sun] strength", 0.5, 0.0, 1.0)? as f32,
        })
    }
}

impl HazeTable {
    fn resolve(self, source: &Source, horizon: LinearRgb) -> Result<Haze, InputError> {
        let number = |value, key, default, low, high| source.number(value, key, default, low, high);
        let visibility = number(self.visibility_km, "[haze] visibility_km", 60.0, 0.001, 1e6)?;
        Ok(Haze {
            visibility_m: visibility * 1000.0,
            scale_height_m: number(self.scale_height_m, "[haze] scale_height_m", 0.0, 0.0, 1e6)?,
            color: source.color(self.color)?.unwrap_or(horizon),
        })
    }
}

/// The text that values come from: it knows their lines.
struct Source<'a> {
    file: &'a Path,
    text: &'a str,
}

impl Source<'_> {
    fn wrong<T>(&self, value: &Spanned<T>, message: impl Into<String>) -> InputError {
        InputError::on_line(self.file, line_of(self.text, value.span().start), message)
    }

    fn number(
        &self,
        value: Number,
        key: &str,
        default: f64,
        low: f64,
        high: f64,
    ) -> Result<f64, InputError> {
        let Some(value) = value else { return Ok(default) };
        let number = *value.get_ref();
        if (low..=high).contains(&number) {
            return Ok(number);
        }
        let message = format!("{key} = {number} is out of range; it may be {low} to {high}");
        Err(self.wrong(&value, message))
    }

    fn read_as<T>(
        &self,
        value: Option<Spanned<String>>,
        default: T,
        read: impl Fn(&str) -> Result<T, String>,
    ) -> Result<T, InputError> {
        let Some(value) = value else { return Ok(default) };
        read(value.get_ref()).map_err(|message| self.wrong(&value, message))
    }

    fn color(&self, value: Color) -> Result<Option<LinearRgb>, InputError> {
        let Some(value) = value else { return Ok(None) };
        let read = match value.get_ref() {
            ColorValue::Screen(text) => screen_color(text),
            ColorValue::Linear(parts) => {
                let fits = parts.iter().all(|part| (0.0..=1.0).contains(part));
                if fits {
                    Ok(*parts)
                } else {
                    Err(format!("the color {parts:?} has numbers beyond 0 to 1"))
                }
            }
        };
        read.map(Some).map_err(|message| self.wrong(&value, message))
    }
}

/// Line of a byte of a text, from 1.
fn line_of(text: &str, byte: usize) -> usize {
    text.bytes().take(byte).filter(|byte| *byte == b'\n').count() + 1
}

/// `#rrggbb` in linear light.
fn screen_color(text: &str) -> Result<LinearRgb, String> {
    let wrong = || format!("\"{text}\" is no color; write \"#rrggbb\", as \"#d2e3f3\"");
    let digits = text.strip_prefix('#').filter(|digits| {
        digits.len() == 6 && digits.bytes().all(|digit| digit.is_ascii_hexdigit())
    });
    let number = u32::from_str_radix(digits.ok_or_else(wrong)?, 16).map_err(|_| wrong())?;
    Ok([16, 8, 0].map(|shift| linear((number >> shift & 0xff) as u8)))
}

/// The curve of IEC 61966-2-1.
fn linear(level: u8) -> f32 {
    let level = f64::from(level) / 255.0;
    if level <= 0.040_45 {
        return (level / 12.92) as f32;
    }
    libm::pow((level + 0.055) / 1.055, 2.4) as f32
}

#[cfg(test)]
mod tests;
