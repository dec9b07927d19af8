//! Reading whatever a raster file claims to be.

use terrafarm_geo::Crs;
use terrafarm_raster::{Content, OpenOptions, Raster, Source, Window, open_source};

/// Opens a source as heights and as a photo, and reads a window at the far corner, which
/// lies in the last block. Whether either could be opened and read.
pub fn is_readable(make: impl Fn() -> Source) -> bool {
    let contents = [Content::Heights, Content::Photo];
    let read = contents.map(|content| {
        let options = OpenOptions { content: Some(content), ..Default::default() };
        open_source(make(), &options).is_ok_and(|raster| corner_is_readable(&*raster))
    });
    read.contains(&true)
}

/// Reads a window at the far corner; also looks at what the raster says of itself.
pub fn corner_is_readable(raster: &dyn Raster) -> bool {
    let info = raster.info();
    assert!(info.width > 0 && info.height > 0, "a raster has samples");
    if let Some(transform) = info.transform {
        let numbers = [transform.origin, transform.step_column, transform.step_row].concat();
        assert!(numbers.iter().all(|number| number.is_finite()), "{transform:?}");
    }
    if let Some(crs) = &info.crs {
        let _ = Crs::parse(crs);
    }
    let (width, height) = (info.width.min(40), info.height.min(40));
    let (column, row) = (info.width - width, info.height - height);
    let (width, height) = (width as usize, height as usize);
    let window = Window { column, row, width, height };
    match info.content {
        Content::Heights => raster.read_heights(window, &mut vec![0.0; width * height]).is_ok(),
        Content::Photo => raster.read_colors(window, &mut vec![[0; 4]; width * height]).is_ok(),
    }
}
