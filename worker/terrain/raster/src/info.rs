//! What every raster file says of itself, and how its samples are read.

use std::path::{Path, PathBuf};

/// Where a raster lies. Positions of *sample centres*: sample (column, row), counted from
/// the first sample of the file, lies at
/// `x = origin[0] + column * step_column[0] + row * step_row[0]`, `y` likewise, in the
/// units of the CRS (degrees for a geographic one). North-up files have
/// `step_column = [dx, 0]` and `step_row = [0, -dy]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GeoTransform {
    /// Position of the centre of sample (0, 0).
    pub origin: [f64; 2],
    /// Change of position per column.
    pub step_column: [f64; 2],
    /// Change of position per row.
    pub step_row: [f64; 2],
}

/// What a raster's samples are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    /// One band of heights, already in metres (scale, offset and feet applied); NaN
    /// where the file has no data.
    Heights,
    /// Red, green, blue and coverage, 8 bits each, after any stretch; coverage 0 where
    /// the file has no data.
    Photo,
}

/// What a raster file says of itself.
#[derive(Debug, Clone)]
pub struct RasterInfo {
    /// The file.
    pub path: PathBuf,
    /// Format in words, for the report: "GeoTIFF, int16, DEFLATE, tiled".
    pub format: String,
    /// Samples along a row.
    pub width: u64,
    /// Rows.
    pub height: u64,
    /// Place on the map; `None` if the file does not say (a PNG without a world file).
    pub transform: Option<GeoTransform>,
    /// Reference system as text for `terrafarm_geo::Crs::parse` ("EPSG:32612" or a proj
    /// string); `None` if the file does not say.
    pub crs: Option<String>,
    /// What heights are measured from, where the format or its keys say so.
    pub vertical: Vertical,
    /// Heights or photo.
    pub content: Content,
    /// Whether every height is a whole multiple of this many metres (1 for int16 metres,
    /// 0.1 for Terrain-RGB); `None` for floating point.
    pub quantum_m: Option<f64>,
    /// Oddities found while opening, for the user.
    pub warnings: Vec<String>,
}

/// What heights are measured from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Vertical {
    /// The file does not say.
    #[default]
    Unknown,
    /// A geoid (SRTM: EGM96).
    Geoid,
    /// The ellipsoid.
    Ellipsoid,
}

/// A rectangle of samples, in the file's own order (row 0 is the file's first row).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    /// First column.
    pub column: u64,
    /// First row.
    pub row: u64,
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
}

/// An opened raster. Reading takes `&self` and may be called from several threads; the
/// implementation keeps a bounded cache of decoded blocks.
pub trait Raster: Send + Sync {
    /// What the file says of itself.
    fn info(&self) -> &RasterInfo;

    /// Heights of a window, metres, row by row; NaN where there is no data.
    ///
    /// # Errors
    /// If the window leaves the raster, the content is a photo, or the file is damaged.
    fn read_heights(&self, window: Window, into: &mut [f32]) -> Result<(), RasterError>;

    /// Colours of a window: red, green, blue, coverage, row by row.
    ///
    /// # Errors
    /// If the window leaves the raster, the content is heights, or the file is damaged.
    fn read_colors(&self, window: Window, into: &mut [[u8; 4]]) -> Result<(), RasterError>;
}

/// Why a raster could not be opened or read. Texts say what failed, on what, why, and
/// what to do.
#[derive(Debug, thiserror::Error)]
pub enum RasterError {
    /// The operating system refused.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The bytes are not what the format asks for.
    #[error("{}: {what}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong, where in the file, and what to do.
        what: String,
    },
    /// The file is sound, but uses something that is not read here.
    #[error("{}: {what}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What is not supported, and what to do instead.
        what: String,
    },
}

impl RasterError {
    /// A damaged file.
    pub fn damaged(path: &Path, what: impl Into<String>) -> Self {
        RasterError::Damaged { path: path.to_owned(), what: what.into() }
    }

    /// An unsupported feature.
    pub fn unsupported(path: &Path, what: impl Into<String>) -> Self {
        RasterError::Unsupported { path: path.to_owned(), what: what.into() }
    }

    /// A refusal of the operating system.
    pub fn io(path: &Path, source: std::io::Error) -> Self {
        RasterError::Io { path: path.to_owned(), source }
    }
}
