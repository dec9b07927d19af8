//! Everything that is decided before the first tile: systems, grids, layers.

use std::path::PathBuf;
use std::sync::Arc;

use terrafarm_geo::Crs;
use terrafarm_raster::info::{Content, Raster, Vertical};
use terrafarm_terrain::layout::{HeightDatum, MAX_LAYERS};
use terrafarm_terrain::rounding::in_words;

use crate::grid::{Grid, overlap, union};
use crate::mosaic::{Mosaic, Placed};
use crate::place::{bounds_in, native_spacing, place, plan_grid};
use crate::request::{ImportError, ImportSettings};
use crate::run::Sources;
use crate::step::computed_step_m;
use crate::surface::{MAX_FILL_POSTS, StackedMosaic, Way};

/// Photos belong to one layer if their resolutions differ by no more than this factor.
const SAME_RESOLUTION: f64 = 1.5;
/// Largest departure from true scale that is accepted without being asked for.
const TRUE_SCALE: f64 = 0.02;
/// The nearest and the farthest that posts may be asked to be, metres.
const MIN_SPACING_M: f64 = 0.001;
const MAX_SPACING_M: f64 = 100_000.0;
/// Sides of insets that are nearer than this, in samples, belong to one layer.
const TOUCHING: f64 = 1.5;

/// A layer of heights or photos before it is built.
pub(crate) struct PlannedLayer {
    pub(crate) grid: Grid,
    /// Topmost last.
    pub(crate) mosaics: Vec<StackedMosaic>,
}

/// Everything that is decided before the first tile.
pub(crate) struct Plan {
    pub(crate) crs: Crs,
    pub(crate) base: PlannedLayer,
    pub(crate) insets: Vec<PlannedLayer>,
    pub(crate) photos: Vec<PlannedLayer>,
    pub(crate) fill: Option<u32>,
    pub(crate) datum: HeightDatum,
    pub(crate) inputs: Vec<String>,
    pub(crate) warnings: Vec<String>,
}

impl Plan {
    pub(crate) fn new(sources: Sources, settings: &ImportSettings) -> Result<Plan, ImportError> {
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
        let layer_count = 1 + insets.len() + photos.len();
        if layer_count > MAX_LAYERS && !insets.is_empty() {
            return Err(ImportError::Request(format!(
                "{} insets and {} photos may need {layer_count} layers; at most {MAX_LAYERS} are \
                 allowed; merge some of them first",
                insets.len(),
                photos.len()
            )));
        }
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
        let base = plan_layer(base, &crs, None, 0, wanted_spacing(settings)?)?;
        warn_of_scale(&crs, base.grid, &mut warnings)?;
        let mut inset_layers = Vec::new();
        for mosaics in touching(insets, &crs)? {
            refuse_thin(&mosaics)?;
            let layer = plan_layer(mosaics, &crs, None, 1, None)?;
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
            photo_layers.push(plan_layer(mosaics, &crs, Some(base.grid.bounds()), 0, None)?);
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
            let step = computed_step_m(&layer.grid, &layer.mosaics).filter(|_| kind != "photo");
            let rounding =
                step.map(|step| format!(", rounded to {}", in_words(step))).unwrap_or_default();
            for stacked in &layer.mosaics {
                let done = if stacked.way.is_untouched() {
                    format!("taken untouched, {spacing}")
                } else {
                    format!("resampled to {spacing}{rounding}")
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
}

fn place_all(
    rasters: Vec<Arc<dyn Raster>>,
    content: Content,
    settings: &ImportSettings,
) -> Result<Vec<Placed>, ImportError> {
    let numbered = rasters.into_iter().enumerate();
    numbered.map(|(rank, raster)| place(raster, content, settings, rank)).collect()
}

/// The file's name without its folder.
pub(crate) fn file_name(placed: &Placed) -> String {
    let path = &placed.raster.info().path;
    path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into())
}

fn path_of(mosaic: &Mosaic) -> PathBuf {
    mosaic.rasters().next().map(|placed| placed.raster.info().path.clone()).unwrap_or_default()
}

/// What heights are measured from, if all inputs agree; else a warning.
fn height_datum<'a>(inputs: impl Iterator<Item = &'a Placed>) -> (HeightDatum, Option<String>) {
    let mut said: Vec<Vertical> = inputs.map(|placed| placed.raster.info().vertical).collect();
    said.dedup();
    match said[..] {
        [Vertical::Geoid] => (HeightDatum::Geoid, None),
        [Vertical::Ellipsoid] => (HeightDatum::Ellipsoid, None),
        [Vertical::Unknown] | [] => (HeightDatum::Unknown, None),
        _ => {
            let warning = "the elevation rasters do not say, or do not agree, what their heights \
                 are measured from; geoid and ellipsoid differ by up to 100 m, and seams may show";
            (HeightDatum::Unknown, Some(warning.into()))
        }
    }
}

/// A surface needs a cell.
fn refuse_thin(mosaics: &[Mosaic]) -> Result<(), ImportError> {
    for mosaic in mosaics {
        let [c0, r0, c1, r1] = mosaic.extent;
        if c1 - c0 < 2 || r1 - r0 < 2 {
            let what = format!(
                "{} x {} samples make no surface; at least 2 x 2 are needed",
                c1 - c0,
                r1 - r0
            );
            return Err(ImportError::Place { path: path_of(mosaic), what });
        }
    }
    Ok(())
}

/// The system of the store; see [`ImportSettings::crs`].
fn choose_crs(
    base: &[Mosaic],
    settings: &ImportSettings,
    warnings: &mut Vec<String>,
) -> Result<Crs, ImportError> {
    if let Some(text) = &settings.crs {
        let crs = Crs::parse(text)?;
        if !crs.is_metric_projected() && !crs.is_local() {
            return Err(ImportError::Request(format!(
                "{crs} does not count in metres to the east and north, so no store can use it; \
                 choose another --crs, such as a UTM zone, or leave it out"
            )));
        }
        return Ok(crs);
    }
    let mut first: Vec<&Mosaic> = base.iter().collect();
    first.sort_by_key(|mosaic| mosaic.rasters().map(|placed| placed.rank).min());
    for mosaic in &first {
        if mosaic.crs.is_local() {
            return Ok(mosaic.crs.clone());
        }
        if mosaic.crs.is_metric_projected() {
            let scale = mosaic.crs.scale(mosaic.frame.at(mosaic.first_middle()))?;
            if (scale - 1.0).abs() <= TRUE_SCALE {
                return Ok(mosaic.crs.clone());
            }
        }
    }
    let [west, south, east, north] = lonlat_bounds(&first)?;
    if south > 60.0 && (north > 89.0 || east - west > 90.0) {
        return Ok(Crs::suggest_metric(0.0, 90.0));
    }
    if north < -60.0 && (south < -89.0 || east - west > 90.0) {
        return Ok(Crs::suggest_metric(0.0, -90.0));
    }
    let [longitude, latitude] = centre_of([west, south, east, north]);
    let crs = Crs::suggest_metric(longitude, latitude);
    if let Some(mosaic) = first.first().filter(|mosaic| mosaic.crs.is_metric_projected()) {
        warnings.push(format!(
            "{} stretches the ground by more than {} %, so the terrain is reprojected to {crs}; \
             give --crs to keep it",
            mosaic.crs,
            TRUE_SCALE * 100.0
        ));
    }
    Ok(crs)
}

/// West, south, east, north of mosaics in degrees; east may lie beyond 180.
fn lonlat_bounds(mosaics: &[&Mosaic]) -> Result<[f64; 4], ImportError> {
    let geographic = Crs::parse("EPSG:4326")?;
    let mut all: Option<[f64; 4]> = None;
    for mosaic in mosaics {
        let mut bounds = if mosaic.crs.is_geographic() {
            let [c0, r0, c1, r1] = mosaic.extent.map(|n| n as f64);
            let [a, b] = [[c0, r0], [c1 - 1.0, r1 - 1.0]].map(|place| mosaic.frame.at(place));
            [a[0].min(b[0]), a[1].min(b[1]), a[0].max(b[0]), a[1].max(b[1])]
        } else {
            bounds_in(mosaic, &geographic, &path_of(mosaic))?
        };
        if let Some(all) = all {
            let turns = ((centre_of(bounds)[0] - centre_of(all)[0]) / 360.0).round() * 360.0;
            bounds[0] -= turns;
            bounds[2] -= turns;
        }
        all = Some(all.map_or(bounds, |all| union(all, bounds)));
    }
    all.ok_or_else(|| ImportError::Request("no elevation raster was given".into()))
}

/// The middle of a rectangle.
pub(crate) fn centre_of(bounds: [f64; 4]) -> [f64; 2] {
    [(bounds[0] + bounds[2]) / 2.0, (bounds[1] + bounds[3]) / 2.0]
}

fn warn_of_scale(crs: &Crs, grid: Grid, warnings: &mut Vec<String>) -> Result<(), ImportError> {
    if crs.is_local() {
        return Ok(());
    }
    let [west, south, east, north] = grid.bounds();
    let corners = [[west, south], [east, south], [west, north], [east, north]];
    // A corner may lie outside the system's domain although the terrain does not.
    let scales = corners.iter().filter_map(|&corner| crs.scale(corner).ok());
    let worst = scales.map(|scale| (scale - 1.0).abs()).fold(0.0, f64::max);
    if worst > TRUE_SCALE {
        warnings.push(format!(
            "distances in {crs} are wrong by up to {:.0} % at the border of this terrain; \
             import a smaller area or choose another --crs",
            worst * 100.0
        ));
    }
    Ok(())
}

/// The distance between posts that the user asks for.
fn wanted_spacing(settings: &ImportSettings) -> Result<Option<f64>, ImportError> {
    match settings.spacing_m {
        Some(spacing) if !(MIN_SPACING_M..=MAX_SPACING_M).contains(&spacing) => {
            Err(ImportError::Request(format!(
                "posts {spacing} m apart make no terrain; choose {MIN_SPACING_M} to {MAX_SPACING_M}"
            )))
        }
        wanted => Ok(wanted),
    }
}

/// Puts mosaics over one another on a common grid, cut to `clip` and grown by a ring of
/// so many posts.
fn plan_layer(
    mosaics: Vec<Mosaic>,
    crs: &Crs,
    clip: Option<[f64; 4]>,
    ring: u64,
    wanted: Option<f64>,
) -> Result<PlannedLayer, ImportError> {
    let mut bounded = Vec::with_capacity(mosaics.len());
    for mosaic in mosaics {
        let bounds = bounds_in(&mosaic, crs, &path_of(&mosaic))?;
        bounded.push((mosaic, bounds));
    }
    let grid = plan_grid(&bounded, crs, clip, wanted)?.grown(ring);
    stack_on(grid, bounded, crs)
}

fn stack_on(
    grid: Grid,
    bounded: Vec<(Mosaic, [f64; 4])>,
    crs: &Crs,
) -> Result<PlannedLayer, ImportError> {
    let mut mosaics = Vec::with_capacity(bounded.len());
    for (mosaic, bounds) in bounded {
        let way = Way::new(&grid, crs, &mosaic)?;
        mosaics.push(StackedMosaic { mosaic, way, bounds });
    }
    Ok(PlannedLayer { grid, mosaics })
}

/// Insets cut into layers: those on one lattice that touch belong together.
fn touching(insets: Vec<Placed>, crs: &Crs) -> Result<Vec<Vec<Mosaic>>, ImportError> {
    let mut groups: Vec<(Vec<Placed>, [f64; 4])> = Vec::new();
    for inset in insets {
        let alone = Mosaic::group(vec![inset.clone()]).remove(0);
        let mut bounds = bounds_in(&alone, crs, &inset.raster.info().path)?;
        let reach = native_spacing(&alone, crs)?.map(|step| step * TOUCHING);
        let wide = [
            bounds[0] - reach[0].max(reach[1]),
            bounds[1] - reach[0].max(reach[1]),
            bounds[2] + reach[0].max(reach[1]),
            bounds[3] + reach[0].max(reach[1]),
        ];
        let mut members = vec![inset];
        let mut apart = Vec::new();
        for (group, group_bounds) in groups {
            let mut together = group.clone();
            together.extend(members.iter().cloned());
            if overlap(wide, group_bounds) && Mosaic::group(together.clone()).len() == 1 {
                bounds = union(bounds, group_bounds);
                members = together;
            } else {
                apart.push((group, group_bounds));
            }
        }
        apart.push((members, bounds));
        groups = apart;
    }
    Ok(groups.into_iter().map(|(members, _)| Mosaic::group(members)).collect())
}

/// Photos cut into layers of about one resolution, coarsest first.
fn by_resolution(photos: Vec<Placed>, crs: &Crs) -> Result<Vec<Vec<Mosaic>>, ImportError> {
    let mut mosaics = Vec::new();
    for mosaic in Mosaic::group(photos) {
        let native = native_spacing(&mosaic, crs)?;
        mosaics.push((native[0].min(native[1]), mosaic));
    }
    mosaics.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut layers: Vec<(f64, Vec<Mosaic>)> = Vec::new();
    for (spacing, mosaic) in mosaics {
        match layers.last_mut() {
            Some((coarsest, layer)) if *coarsest <= spacing * SAME_RESOLUTION => layer.push(mosaic),
            _ => layers.push((spacing, vec![mosaic])),
        }
    }
    for (_, layer) in &mut layers {
        layer.sort_by_key(|mosaic| mosaic.rank);
    }
    Ok(layers.into_iter().map(|(_, layer)| layer).collect())
}

fn refuse_apart(layer: &PlannedLayer, base: &PlannedLayer, crs: &Crs) -> Result<(), ImportError> {
    for stacked in &layer.mosaics {
        refuse_outside(&stacked.mosaic, stacked.bounds, base, crs)?;
    }
    Ok(())
}

fn refuse_photo_apart(mosaic: &Mosaic, base: &PlannedLayer, crs: &Crs) -> Result<(), ImportError> {
    let bounds = bounds_in(mosaic, crs, &path_of(mosaic))?;
    refuse_outside(mosaic, bounds, base, crs)
}

fn refuse_outside(
    mosaic: &Mosaic,
    bounds: [f64; 4],
    base: &PlannedLayer,
    crs: &Crs,
) -> Result<(), ImportError> {
    let terrain = base.grid.bounds();
    if overlap(bounds, terrain) {
        return Ok(());
    }
    let words = |b: [f64; 4]| format!("x {:.0} to {:.0}, y {:.0} to {:.0}", b[0], b[2], b[1], b[3]);
    let what = format!(
        "it does not overlap the terrain: it covers {}, the terrain {} ({crs}); \
         is its reference system or world file right?",
        words(bounds),
        words(terrain)
    );
    Err(ImportError::Place { path: path_of(mosaic), what })
}
