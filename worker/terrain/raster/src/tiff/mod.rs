//! GeoTIFF: heights and photos, read strip by strip or tile by tile.
//!
//! Directory and tags are in [`directory`], storage and decoding in [`layout`] and
//! [`codec`], reference systems in [`geokeys`]. Here: which picture of the file is read,
//! where it lies, and the two rasters, [`heights`] and [`photo`].

mod codec;
mod directory;
mod geokeys;
mod heights;
mod layout;
mod photo;

use crate::info::{Content, GeoTransform, Raster, RasterError, RasterInfo};
use crate::options::OpenOptions;
use crate::sidecar::{Placement, invertible};
use crate::source::Source;
use directory::Directory;
use geokeys::GeoKeys;
use layout::{Layout, SampleKind};

/// Opens a TIFF.
///
/// # Errors
/// If the file is damaged, or uses something that is not read here.
pub fn open(source: Source, options: &OpenOptions) -> Result<Box<dyn Raster>, RasterError> {
    let (directory, masks, others) = directory::find_image(&source)?;
    let layout = Layout::read(&source, &directory)?;
    let keys = GeoKeys::read(&source, &directory)?;
    let content = options.content.unwrap_or_else(|| guess_content(&layout));
    let mut info = RasterInfo {
        path: source.path().to_owned(),
        format: format!("GeoTIFF, {}", layout.describe()),
        width: layout.size[0],
        height: layout.size[1],
        transform: None,
        crs: None,
        vertical: keys.vertical(),
        content,
        quantum_m: None,
        warnings: Vec::new(),
    };
    place(&source, &directory, &keys, &mut info)?;
    if others > 0 {
        let what = format!("the file holds {others} further pictures; only the first is read");
        info.warnings.push(what);
    }
    if masks > 0 && content == Content::Photo {
        info.warnings.push(
            "a transparency mask inside the file is not used; make it a band with: \
             gdal_translate -b 1 -b 2 -b 3 -b mask -colorinterp_4 alpha in.tif out.tif"
                .into(),
        );
    }
    match content {
        Content::Heights => heights::open(source, &directory, layout, &keys, info, options),
        Content::Photo => photo::open(source, &directory, layout, info, options),
    }
}

/// Three bands, a palette or a single band of 8 bits make a photo.
fn guess_content(layout: &Layout) -> Content {
    let colors = layout.bands >= 3 && matches!(layout.kind, SampleKind::U8 | SampleKind::U16);
    if colors || layout.photometric == 3 || layout.kind == SampleKind::U8 {
        Content::Photo
    } else {
        Content::Heights
    }
}

/// Transform and reference system: the file's own tags, then what lies beside it.
fn place(
    source: &Source,
    directory: &Directory,
    keys: &GeoKeys,
    info: &mut RasterInfo,
) -> Result<(), RasterError> {
    info.transform = transform(source, directory, keys, &mut info.warnings)?;
    match keys.crs() {
        Ok(crs) => info.crs = crs,
        Err(why) => info.warnings.push(format!("the reference system is not used: {why}")),
    }
    let beside = Placement::from_sidecars(source.sidecars());
    if info.transform.is_none() {
        info.transform = beside.transform;
        info.warnings.extend(beside.warnings);
    }
    info.crs = info.crs.take().or(beside.crs);
    if let Some(transform) = info.transform.filter(|_| keys.is_geographic()) {
        let right = transform.origin[0] + transform.step_column[0] * (info.width - 1) as f64;
        if transform.origin[0].max(right) > 181.0 {
            let what = "longitudes run beyond 180 degrees (0 to 360)";
            info.warnings.push(what.into());
        }
    }
    Ok(())
}

/// The place of sample centres from ModelTransformation, or tie point and pixel scale.
fn transform(
    source: &Source,
    directory: &Directory,
    keys: &GeoKeys,
    warnings: &mut Vec<String>,
) -> Result<Option<GeoTransform>, RasterError> {
    let matrix = directory.doubles(source, 34264)?;
    let ties = directory.doubles(source, 33922)?;
    let scale = directory.doubles(source, 33550)?;
    let raster = if let [a, b, _, d, e, f, _, h, ..] = matrix[..] {
        GeoTransform { origin: [d, h], step_column: [a, e], step_row: [b, f] }
    } else if let ([column, row, _, x, y, ..], [dx, dy, ..]) = (&ties[..], &scale[..]) {
        if *dy < 0.0 {
            warnings.push("the pixel scale is negative; it is read as its amount".into());
        }
        let dy = dy.abs();
        GeoTransform {
            origin: [x - column * dx, y + row * dy],
            step_column: [*dx, 0.0],
            step_row: [0.0, -dy],
        }
    } else {
        if ties.len() > 6 {
            warnings.push(
                "the file has ground control points, no transform; apply them with: gdalwarp \
                 in.tif out.tif"
                    .into(),
            );
        }
        return Ok(None);
    };
    // Raster space begins at the corner of the first pixel, or at the first post.
    let half = if keys.is_point() { 0.0 } else { 0.5 };
    let origin = [0, 1].map(|axis| {
        raster.origin[axis] + half * (raster.step_column[axis] + raster.step_row[axis])
    });
    let transform = GeoTransform { origin, ..raster };
    if !invertible(&transform) {
        warnings.push("the transform of the file is not invertible; it is not used".into());
        return Ok(None);
    }
    Ok(Some(transform))
}
