//! The import from beginning to end.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use terrafarm_geo::gaussian_radius_m;
use terrafarm_raster::OpenOptions;
use terrafarm_raster::info::{Content, Raster};
use terrafarm_terrain::build::{LayerSpec, StoreBuilder};
use terrafarm_terrain::layout::{ImportReport, LayerKind};

use crate::grid::Grid;
use crate::measure::Measurement;
use crate::photo::PhotoStack;
use crate::plan::{Plan, PlannedLayer, centre_of, file_name};
use crate::request::{ImportError, ImportRequest, ImportSettings, ImportSummary, Progress, Stage};
use crate::step::quantum_m;
use crate::surface::{Filled, Heights, Inset, Stack, StackedMosaic, Watched};
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
    let open_all = |paths: &[PathBuf], options: &OpenOptions, content| {
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
    build(plan, output, progress, cancel)
}

fn build(
    plan: Plan,
    output: &Path,
    progress: &dyn Fn(Progress),
    cancel: &AtomicBool,
) -> Result<ImportSummary, ImportError> {
    let Plan { crs, base, insets, photos, fill, datum, inputs, mut warnings } = plan;
    let radius = match crs.is_local() {
        true => None,
        false => Some(gaussian_radius_m(crs.to_lonlat(centre_of(base.grid.bounds()))?[1])),
    };
    let base = Arc::new(Stack::new(base.grid, base.mosaics));
    let surface: Arc<dyn Heights> = match fill {
        Some(reach) => Arc::new(Filled { below: base.clone(), reach: reach as usize }),
        None => base.clone(),
    };

    let mut builder = StoreBuilder::create(output, crs.text(), datum, radius)?;
    let unfilled = fill.map(|_| &*base as &dyn Heights);
    let watched = Watched::new(&*surface, unfilled);
    let spec = height_spec(&base);
    builder.add_layer(spec, &watched, &stage(progress, Stage::Heights), cancel)?;
    if !watched.any_valid.load(Ordering::Relaxed) {
        return Err(ImportError::AllVoid { inputs: names(&base.mosaics) });
    }

    let mut void_posts = watched.void.load(Ordering::Relaxed);
    let mut layers = vec![surface.clone()];
    let mut stacks = vec![base.clone()];
    for (number, PlannedLayer { grid, mosaics }) in insets.into_iter().enumerate() {
        let own = Arc::new(Stack::new(grid, mosaics));
        let inset = Inset { own: own.clone(), below: layers.clone() };
        let stage = stage(progress, Stage::Inset(number + 1));
        let source = Watched::new(&inset, None);
        builder.add_layer(height_spec(&own), &source, &stage, cancel)?;
        void_posts += source.void.load(Ordering::Relaxed);
        layers.push(Arc::new(inset));
        stacks.push(own);
    }
    for (number, PlannedLayer { grid, mosaics }) in photos.into_iter().enumerate() {
        let Grid { origin, spacing, posts } = grid;
        let photo = PhotoStack { grid, mosaics, any_covered: AtomicBool::new(false) };
        let spec = LayerSpec { kind: LayerKind::Photo, origin, spacing, posts, quantum_m: None };
        let stage = stage(progress, Stage::Photo(number + 1));
        builder.add_layer(spec, &photo, &stage, cancel)?;
        if !photo.any_covered.load(Ordering::Relaxed) {
            warnings.push(format!("nothing of {} covers the terrain", names(&photo.mosaics)));
        }
    }

    let mosaics: Vec<&StackedMosaic> = stacks.iter().flat_map(|stack| &stack.mosaics).collect();
    warnings.extend(mosaics.iter().filter(|stacked| stacked.mosaic.met_wild_heights()).map(
        |stacked| {
            let names = names(std::slice::from_ref(stacked));
            format!(
                "{names}: heights beyond 100 km were taken as voids; is a no-data value missing?"
            )
        },
    ));
    let measurement = Measurement { crs: &crs, layers: &layers, mosaics };
    let errors = if measurement.is_needed() {
        measurement.run(&stage(progress, Stage::Measuring), cancel)?
    } else {
        Default::default()
    };
    let report = ImportReport {
        inputs,
        warnings,
        max_resampling_error_m: errors.max_m,
        rms_resampling_error_m: errors.rms_m(),
        void_posts,
        made_by: concat!("terrafarm ", env!("CARGO_PKG_VERSION")).into(),
    };
    let store = builder.finish(report.clone())?;
    let filled_posts = watched.filled.load(Ordering::Relaxed);
    Ok(ImportSummary { store, report, crs: crs.text().to_owned(), filled_posts })
}

fn height_spec(stack: &Stack) -> LayerSpec {
    let Grid { origin, spacing, posts } = stack.grid;
    let quantum_m = quantum_m(&stack.mosaics).map(|step| step as f32);
    LayerSpec { kind: LayerKind::Height, origin, spacing, posts, quantum_m }
}

fn names(mosaics: &[impl std::borrow::Borrow<StackedMosaic>]) -> String {
    let rasters = mosaics.iter().flat_map(|stacked| stacked.borrow().mosaic.rasters());
    rasters.map(file_name).collect::<Vec<_>>().join(", ")
}

/// Progress of one stage.
fn stage(progress: &dyn Fn(Progress), stage: Stage) -> impl Fn(u64, u64) {
    move |done, total| progress(Progress { stage, done, total })
}
