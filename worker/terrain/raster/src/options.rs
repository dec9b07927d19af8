//! What the user says about a file that the file does not say itself.

use crate::info::Content;

/// How to read a file. [`OpenOptions::default`] believes the file.
#[derive(Debug, Clone)]
pub struct OpenOptions {
    /// Heights or photo. `None`: three or more bands, a palette, or a single band of
    /// 8 bits is a photo, everything else is heights.
    pub content: Option<Content>,
    /// How a PNG stores heights.
    pub png_encoding: PngEncoding,
    /// Unit of the heights in the file, where it does not say or says it wrong.
    pub unit: Option<HeightUnit>,
    /// Metres (or [`OpenOptions::unit`]) per step of a 16-bit grey PNG.
    pub height_scale: f64,
    /// Height of value 0 of a 16-bit grey PNG, same unit.
    pub height_offset: f64,
    /// The web-mercator tile (zoom, x, y) that a PNG without a world file covers.
    pub web_tile: Option<(u8, u32, u32)>,
    /// A colour of a photo that means no data, wherever in the picture it occurs exactly.
    pub collar: Option<[u8; 3]>,
    /// Memory for decoded blocks of one raster, bytes. A block in use is kept even when
    /// it alone is larger.
    pub block_cache_bytes: usize,
}

impl Default for OpenOptions {
    fn default() -> Self {
        OpenOptions {
            content: None,
            png_encoding: PngEncoding::Auto,
            unit: None,
            height_scale: 1.0,
            height_offset: 0.0,
            web_tile: None,
            collar: None,
            block_cache_bytes: 64 << 20,
        }
    }
}

/// How a PNG stores heights.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PngEncoding {
    /// 16-bit grey is [`PngEncoding::Grey16`]; of the colour encodings Terrain-RGB and
    /// Terrarium are told apart by which one gives heights that exist on Earth.
    #[default]
    Auto,
    /// Mapbox Terrain-RGB: −10000 + 0.1 (65536 R + 256 G + B) metres.
    TerrainRgb,
    /// Terrarium (Mapzen): 256 R + G + B / 256 − 32768 metres.
    Terrarium,
    /// 16-bit grey: `height_offset + height_scale * value`.
    Grey16,
    /// SRTM metres in a picture: R low byte, G high byte, B 255 for negative heights,
    /// which are stored one too high. −32768 is void.
    SrtmRgba,
}

/// A unit of height.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HeightUnit {
    /// The metre.
    Metre,
    /// The international foot, 0.3048 m.
    Foot,
    /// The US survey foot, 1200/3937 m.
    UsSurveyFoot,
}

impl HeightUnit {
    /// Metres in one unit.
    pub fn metres(self) -> f64 {
        match self {
            HeightUnit::Metre => 1.0,
            HeightUnit::Foot => 0.3048,
            HeightUnit::UsSurveyFoot => 1200.0 / 3937.0,
        }
    }

    /// The unit as words in a file name it; `None` for other words.
    pub(crate) fn from_words(words: &str) -> Option<Self> {
        match words.trim().to_ascii_lowercase().as_str() {
            "m" | "metre" | "meter" | "metres" | "meters" => Some(HeightUnit::Metre),
            "ft" | "foot" | "feet" => Some(HeightUnit::Foot),
            "us-ft" | "ftus" | "us survey foot" | "us survey feet" | "us_survey_foot" => {
                Some(HeightUnit::UsSurveyFoot)
            }
            _ => None,
        }
    }
}
