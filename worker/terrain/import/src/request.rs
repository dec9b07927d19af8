//! What is asked of an import, how it tells of itself, and why it fails.

use std::path::PathBuf;

use terrafarm_geo::CrsError;
use terrafarm_raster::info::RasterError;
use terrafarm_raster::options::OpenOptions;
use terrafarm_terrain::build::{BuildError, StoreSummary};
use terrafarm_terrain::layout::ImportReport;

/// What to import, and where to.
#[derive(Debug, Clone, Default)]
pub struct ImportRequest {
    /// Elevation rasters; later ones lie on top, voids of one are filled by another.
    pub elevation: Vec<PathBuf>,
    /// Finer elevation rasters, each of which keeps its own spacing.
    pub insets: Vec<PathBuf>,
    /// Aerial photos; later ones lie on top.
    pub photos: Vec<PathBuf>,
    /// The store to write. An existing one is replaced when the new one is whole.
    pub output: PathBuf,
    /// Everything else.
    pub settings: ImportSettings,
}

/// How to import.
#[derive(Debug, Clone, Default)]
pub struct ImportSettings {
    /// Reference system of the store, metric and projected. `None`: that of the first
    /// elevation raster which has such a one and is true to scale within 2 %, else the
    /// UTM zone (or polar grid) of the middle of the elevation rasters.
    pub crs: Option<String>,
    /// Reference system of rasters that do not name theirs.
    pub source_crs: Option<String>,
    /// Distance between posts of the base heights, metres. `None`: that of the finest
    /// input, or a little less where it has to be resampled.
    pub spacing_m: Option<f64>,
    /// Fills voids that have a valid post within so many posts; at most
    /// [`crate::MAX_FILL_POSTS`]. `None`: voids stay voids.
    pub fill_voids: Option<u32>,
    /// How elevation rasters and insets are opened.
    pub elevation_options: OpenOptions,
    /// How photos are opened.
    pub photo_options: OpenOptions,
}

/// How far an import is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// What is being done, for people: "heights", "inset 1", "photo 1", "measuring".
    pub stage: Stage,
    /// Steps done in this stage.
    pub done: u64,
    /// Steps of this stage.
    pub total: u64,
}

/// Parts of an import, in their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Tiles of the base heights.
    Heights,
    /// Tiles of the inset of this number, from 1.
    Inset(usize),
    /// Tiles of the photo layer of this number, from 1.
    Photo(usize),
    /// Blocks of input samples compared with the store.
    Measuring,
}

impl std::fmt::Display for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Stage::Heights => f.write_str("heights"),
            Stage::Inset(number) => write!(f, "inset {number}"),
            Stage::Photo(number) => write!(f, "photo {number}"),
            Stage::Measuring => f.write_str("measuring"),
        }
    }
}

/// What came of an import.
#[derive(Debug, Clone, PartialEq)]
pub struct ImportSummary {
    /// The file that was written.
    pub store: StoreSummary,
    /// The report that the store holds, too.
    pub report: ImportReport,
    /// Reference system of the store.
    pub crs: String,
    /// Number of level 0 posts that were void and have been filled.
    pub filled_posts: u64,
}

/// Why an import failed. Nothing is left behind.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// An input cannot be read.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// A reference system is not known.
    #[error(transparent)]
    Crs(#[from] CrsError),
    /// A reference system of an input is not known.
    #[error("{}: {source}; or override it with --source-crs", path.display())]
    InputCrs {
        /// The input.
        path: PathBuf,
        /// Why.
        source: CrsError,
    },
    /// An input does not say where it lies.
    #[error("{}: {what}", path.display())]
    Place {
        /// The input.
        path: PathBuf,
        /// What is missing or wrong, and what to do.
        what: String,
    },
    /// The request contradicts itself or asks for what cannot be stored.
    #[error("{0}")]
    Request(String),
    /// No input has a single valid height.
    #[error(
        "no valid height was found in {inputs}: every sample is void; \
         is the no-data value right, and the right band read?"
    )]
    AllVoid {
        /// The inputs.
        inputs: String,
    },
    /// The store cannot be written.
    #[error(transparent)]
    Store(BuildError),
    /// The caller asked to stop.
    #[error("stopped on request; no store was written")]
    Cancelled,
}

impl From<BuildError> for ImportError {
    fn from(error: BuildError) -> Self {
        match error {
            BuildError::Cancelled => ImportError::Cancelled,
            // Sources of layers are ours: give their own error back.
            BuildError::Source { layer, source } => match source.downcast::<ImportError>() {
                Ok(own) => *own,
                Err(source) => ImportError::Store(BuildError::Source { layer, source }),
            },
            other => ImportError::Store(other),
        }
    }
}
