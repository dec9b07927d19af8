//! The import from beginning to end.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use terrafarm_geo::{Crs, gaussian_radius_m};
use terrafarm_raster::info::{Content, Raster, Vertical};
use terrafarm_terrain::build::{LayerSpec, StoreBuilder};
use terrafarm_terrain::layout::{HeightDatum, ImportReport, LayerKind};

use crate::grid::{Grid, overlap, union};
use crate::measure::Measurement;
use crate::mosaic::{Mosaic, Placed};
use crate::photo::PhotoStack;
use crate::place::{bounds_in, native_spacing, place, plan_grid};
use crate::request::{ImportError, ImportRequest, ImportSettings, ImportSummary, Progress, Stage};
use crate::surface::{Filled, Heights, Inset, MAX_FILL_POSTS, Stack, StackedMosaic, Watched, Way};

/// Photos belong to one layer if their resolutions differ by no more than this factor.
const SAME_RESOLUTION: f64 = 1.5;
/// Largest departure from true scale that is accepted without being asked for.
const TRUE_SCALE: f64 = 0.02;
/// Memory for decoded blocks of all inputs together, bytes.
const CACHE_BYTES: usize = 256 << 20;
/// The least memory for decoded blocks of one input, bytes.
const LEAST_CACHE_BYTES: usize = 4 << 20;

/// Opened inputs; see [`ImportRequest`].
#[derive(Default)]
pub struct Sources {
    /// Elevation rasters.
    pub elevation: Vec<Arc<dyn Raster>>,
    /// Finer elevation rasters that keep their spacing.
    pub insets: Vec<Arc<dyn Raster>>,
    /// Photos.
    pub photos: Vec<Arc<dyn Raster>>,
}

/// Imports files into a store. `progress` is called often; `cancel` stops the work soon
/// after it is raised.
///
/// # Errors
/// [`ImportError`]; no store is left behind then, and an existing one stays.
pub fn import(
    request: &ImportRequest,
    progress: &dyn Fn(Progress),
    cancel: &AtomicBool,
) -> Result<ImportSummary, ImportError> {
    let count = request.elevation.len() + request.insets.len() + request.photos.len();
    let share = (CACHE_BYTES / count.max(1)).max(LEAST_CACHE_BYTES);
    let open_all = |paths: &[PathBuf], options: &terrafarm_raster::OpenOptions, content| {
        let mut options = options.clone();
        options.content.get_or_insert(content);
        options.block_cache_bytes = options.block_cache_bytes.min(share);
        paths
            .iter()
            .map(|path| Ok(Arc::from(terrafarm_raster::open(path, &options)?)))
            .collect::<Result<Vec<Arc<dyn Raster>>, ImportError>>()
    };
    let settings = &request.settings;
    let sources = Sources {
        elevation: open_all(&request.elevation, &settings.elevation_options, Content::Heights)?,
        insets: open_all(&request.insets, &settings.elevation_options, Content::Heights)?,
        photos: open_all(&request.photos, &settings.photo_options, Content::Photo)?,
    };
    import_rasters(sources, settings, &request.output, progress, cancel)
}

/// Imports rasters that are open already.
///
/// # Errors
/// As [`import`].
pub fn import_rasters(
    sources: Sources,
    settings: &ImportSettings,
    output: &Path,
    progress: &dyn Fn(Progress),
    cancel: &AtomicBool,
) -> Result<ImportSummary, ImportError> {
    let plan = Plan::new(sources, settings)?;
    plan.build(output, progress, cancel)
}

/// A layer of heights or photos before it is built.
struct PlannedLayer {
    grid: Grid,
    mosaics: Vec<StackedMosaic>,
}

/// Everything that is decided before the first tile.
struct Plan {
    crs: Crs,
    base: PlannedLayer,
    insets: Vec<PlannedLayer>,
    photos: Vec<PlannedLayer>,
    fill: Option<u32>,
    datum: HeightDatum,
    inputs: Vec<String>,
    warnings: Vec<String>,
}

impl Plan {
    fn new(sources: Sources, settings: &ImportSettings) -> Result<Plan, ImportError> {
        if sources.elevation.is_empty() {
            return Err(ImportError::Request(
                "an import needs at least one elevation raster".into(),
            ));
        }
        if settings.fill_voids.is_some_and(|reach| !(1..=MAX_FILL_POSTS).contains(&reach)) {
            return Err(ImportError::Request(format!(
                "voids can be filled over 1 to {MAX_FILL_POSTS} posts"
            )));
        }
        let elevation = place_all(sources.elevation, Content::Heights, settings)?;
        let insets = place_all(sources.insets, Content::Heights, settings)?;
        let photos = place_all(sources.photos, Content::Photo, settings)?;
        let all: Vec<Placed> = elevation.iter().chain(&insets).chain(&photos).cloned().collect();
        let mut warnings = Vec::new();
        let (datum, datum_warning) = height_datum(elevation.iter().chain(&insets));
        warnings.extend(datum_warning);
        let base = Mosaic::group(elevation);
        refuse_thin(&base)?;
        let crs = choose_crs(&base, settings, &mut warnings)?;
        for placed in &all {
            let info = placed.raster.info();
            let name = file_name(placed);
            let systems = placed.crs.warnings().iter().filter(|_| !placed.crs.is_same_grid(&crs));
            warnings.extend(info.warnings.iter().chain(systems).map(|w| format!("{name}: {w}")));
        }
        warnings.dedup();
        let base = plan_layer(base, &crs, None)?;
        warn_of_scale(&crs, base.grid, &mut warnings)?;
        let mut inset_layers = Vec::new();
        for mosaics in touching(insets, &crs)? {
            refuse_thin(&mosaics)?;
            let mut layer = plan_layer(mosaics, &crs, None)?;
            layer.grid = layer.grid.grown(1);
            refuse_apart(&layer, &base, &crs)?;
            inset_layers.push(layer);
        }
        inset_layers.sort_by(|a, b| {
            let area = |layer: &PlannedLayer| layer.grid.spacing[0] * layer.grid.spacing[1];
            area(b).total_cmp(&area(a))
        });
        let mut photo_layers = Vec::new();
        for mosaics in by_resolution(photos, &crs)? {
            for mosaic in &mosaics {
                refuse_photo_apart(mosaic, &base, &crs)?;
            }
            photo_layers.push(plan_layer(mosaics, &crs, Some(base.grid.bounds()))?);
        }
        let mut plan = Plan {
            crs,
            base,
            insets: inset_layers,
            photos: photo_layers,
            fill: settings.fill_voids,
            datum,
            inputs: Vec::new(),
            warnings,
        };
        plan.describe();
        Ok(plan)
    }

    /// Fills in the report's line for every input.
    fn describe(&mut self) {
        let base_bounds = self.base.grid.bounds();
        let kinds = [("elevation", 0), ("inset", 1), ("photo", 2)];
        let layers = std::iter::once((kinds[0], &self.base))
            .chain(self.insets.iter().map(|layer| (kinds[1], layer)))
            .chain(self.photos.iter().map(|layer| (kinds[2], layer)));
        let mut lines = Vec::new();
        for ((kind, order), layer) in layers {
            let [dx, dy] = layer.grid.spacing.map(|step| format!("{step:.6}"));
            let trim = |text: &str| text.trim_end_matches('0').trim_end_matches('.').to_owned();
            let spacing = format!("{} x {} m", trim(&dx), trim(&dy));
            for stacked in &layer.mosaics {
                let done = if stacked.way.is_untouched() {
                    format!("taken untouched, {spacing}")
                } else {
                    format!("resampled to {spacing}")
                };
                let b = stacked.bounds;
                let partly = kind == "photo"
                    && (b[0] > base_bounds[0]
                        || b[1] > base_bounds[1]
                        || b[2] < base_bounds[2]
                        || b[3] < base_bounds[3]);
                let partly = if partly { "; covers part of the terrain" } else { "" };
                for placed in stacked.mosaic.rasters() {
                    let info = placed.raster.info();
                    let line = format!(
                        "{}: {kind}, {}, {} x {}, {}, {done}{partly}",
                        file_name(placed),
                        info.format,
                        info.width,
                        info.height,
                        placed.crs
                    );
                    lines.push((order, placed.rank, line));
                }
            }
        }
        lines.sort();
        self.inputs = lines.into_iter().map(|(_, _, line)| line).collect();
    }

    fn build(
        self,
        output: &Path,
        progress: &dyn Fn(Progress),
        cancel: &AtomicBool,
    ) -> Result<ImportSummary, ImportError> {
        let centre = centre_of(self.base.grid.bounds());
        let radius = match self.crs.is_local() {
            true => None,
            false => Some(gaussian_radius_m(self.crs.to_lonlat(centre)?[1])),
        };
        let mut builder = StoreBuilder::create(output, self.crs.text(), self.datum, radius)?;
        let mut filled_posts = 0;
        let base = stack(self.base);
        let quantum = quantum(&base.mosaics);
        let names = base.mosaics.iter().flat_map(|stacked| stacked.mosaic.rasters());
        let names: Vec<String> = names.map(file_name).collect();
        let filled;
        let base: &dyn Heights = match self.fill {
            None => &base,
            Some(reach) => {
                filled = Filled { below: &base, reach: reach as usize };
                &filled
            }
        };
        let _ = (quantum, &mut builder, names, base, &mut filled_posts, progress, cancel);
        unimplemented!()
    }
}
