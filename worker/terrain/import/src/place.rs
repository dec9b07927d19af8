//! Opened rasters put on the map.

use std::path::Path;
use std::sync::Arc;

use terrafarm_geo::{Crs, Transformer};
use terrafarm_raster::info::{Content, Raster};

use crate::grid::{Affine, Grid, friendly_spacing, union};
use crate::mosaic::{Mosaic, Placed};
use crate::request::{ImportError, ImportSettings};

/// Samples along a side of the net that finds the bounds of a raster elsewhere.
const NET: u64 = 64;

/// Puts a raster on the map. `rank` is its place in the list of inputs.
///
/// # Errors
/// If it does not say where it lies, or holds the wrong kind of samples.
pub(crate) fn place(
    raster: Arc<dyn Raster>,
    wanted: Content,
    settings: &ImportSettings,
    rank: usize,
) -> Result<Placed, ImportError> {
    let info = raster.info();
    let path = info.path.clone();
    let refuse = |what: &str| ImportError::Place { path: path.clone(), what: what.to_owned() };
    if info.content != wanted {
        return Err(refuse(match wanted {
            Content::Heights => "this is a photo, not an elevation model; give it as a photo",
            Content::Photo => "this is an elevation model, not a photo; give it as elevation",
        }));
    }
    if info.width == 0 || info.height == 0 {
        return Err(refuse("it has no samples"));
    }
    let crs = match info.crs.as_ref().or(settings.source_crs.as_ref()) {
        None => {
            return Err(refuse(
                "the file does not name its reference system; give it with --source-crs, such \
                 as EPSG:32612, or LOCAL for terrain that lies nowhere",
            ));
        }
        Some(text) => Crs::parse(text)
            .map_err(|source| ImportError::InputCrs { path: path.clone(), source })?,
    };
    let frame = match info.transform {
        Some(t) => Affine { origin: t.origin, column: t.step_column, row: t.step_row },
        None => {
            return Err(refuse(
                "the file does not say where it lies; put a world file beside it (.tfw, .pgw, \
                 .jgw, .wld)",
            ));
        }
    };
    let numbers = [frame.origin, frame.column, frame.row];
    let finite = numbers.iter().flatten().all(|number| number.is_finite());
    if !finite || frame.determinant() == 0.0 || !frame.determinant().is_finite() {
        return Err(refuse("its samples have no extent on the map; check its world file"));
    }
    Ok(Placed { raster, crs, frame, rank })
}

/// West, south, east, north of a mosaic's samples in another system.
///
/// # Errors
/// If no part of it exists there.
pub(crate) fn bounds_in(mosaic: &Mosaic, crs: &Crs, name: &Path) -> Result<[f64; 4], ImportError> {
    let transformer = Transformer::new(&mosaic.crs, crs)?;
    let [c0, r0, c1, r1] = mosaic.extent;
    let (width, height) = ((c1 - c0 - 1) as f64, (r1 - r0 - 1) as f64);
    let net = if transformer.is_identity() { 1 } else { NET };
    let mut bounds: Option<[f64; 4]> = None;
    for row in 0..=net {
        let mut points: Vec<[f64; 2]> = (0..=net)
            .map(|column| {
                let u = c0 as f64 + width * column as f64 / net as f64;
                let v = r0 as f64 + height * row as f64 / net as f64;
                mosaic.frame.at([u, v])
            })
            .collect();
        transformer.apply(&mut points);
        for [x, y] in points.into_iter().filter(|p| p[0].is_finite() && p[1].is_finite()) {
            let point = [x, y, x, y];
            bounds = Some(bounds.map_or(point, |bounds| union(bounds, point)));
        }
    }
    bounds.ok_or_else(|| ImportError::Place {
        path: name.to_owned(),
        what: format!("no part of it lies within the domain of {crs}; choose another --crs"),
    })
}

/// Distance of neighbouring samples along columns and rows in the middle of a mosaic,
/// metres in the store's system.
pub(crate) fn native_spacing(mosaic: &Mosaic, crs: &Crs) -> Result<[f64; 2], ImportError> {
    let transformer = Transformer::new(&mosaic.crs, crs)?;
    let [u, v] = mosaic.middle();
    let half = 0.5;
    let mut ends = [[u - half, v], [u + half, v], [u, v - half], [u, v + half]]
        .map(|place| mosaic.frame.at(place));
    transformer.apply(&mut ends);
    let length = |a: [f64; 2], b: [f64; 2]| (b[0] - a[0]).hypot(b[1] - a[1]);
    Ok([length(ends[0], ends[1]), length(ends[2], ends[3])])
}

/// The grid of a layer that takes its posts from mosaics: the samples of the finest, if
/// they lie upright in the store's system; else a friendly spacing not above the finest
/// native one, or the one that is `wanted`, at multiples of it, so that neighbouring
/// imports line up.
///
/// # Errors
/// If the grid would be too large, or has no size.
pub(crate) fn plan_grid(
    mosaics: &[(Mosaic, [f64; 4])],
    crs: &Crs,
    clip: Option<[f64; 4]>,
    wanted: Option<f64>,
) -> Result<Grid, ImportError> {
    let mut finest: Option<(f64, &Mosaic)> = None;
    for (mosaic, _) in mosaics {
        let native = native_spacing(mosaic, crs)?;
        let least = native[0].min(native[1]);
        let upright = |mosaic: &Mosaic| mosaic.frame.is_upright() && mosaic.crs.is_same_grid(crs);
        let better = finest.is_none_or(|(best, other)| {
            let same = (least / best - 1.0).abs() < 1e-3;
            if same { upright(mosaic) && !upright(other) } else { least < best }
        });
        if better {
            finest = Some((least, mosaic));
        }
    }
    let Some((least, finest)) = finest.filter(|(least, _)| least.is_finite() && *least > 0.0)
    else {
        return Err(ImportError::Request(
            "the inputs have no spacing in the store's reference system; choose another --crs"
                .into(),
        ));
    };
    let mut bounds = mosaics.iter().map(|(_, bounds)| *bounds).reduce(union).unwrap_or([0.0; 4]);
    if let Some(clip) = clip {
        bounds = [
            bounds[0].max(clip[0]),
            bounds[1].max(clip[1]),
            bounds[2].min(clip[2]),
            bounds[3].min(clip[3]),
        ];
    }
    let kept = finest.frame.is_upright() && finest.crs.is_same_grid(crs);
    let own = [finest.frame.column[0].abs(), finest.frame.row[1].abs()];
    let (phase, spacing) = match wanted {
        Some(wanted) if !(kept && own == [wanted; 2]) => ([0.0; 2], [wanted; 2]),
        _ if kept => (finest.frame.origin, own),
        _ => ([0.0; 2], [friendly_spacing(least); 2]),
    };
    Grid::covering(phase, spacing, bounds).map_err(ImportError::Request)
}
