//! Place and reference system from the files beside a picture: world file, .prj, .aux.xml.

use crate::info::GeoTransform;
use crate::source::Sidecars;

/// What the files beside a raster say of its place.
#[derive(Debug, Default, PartialEq)]
pub struct Placement {
    /// The transform, if one is given.
    pub transform: Option<GeoTransform>,
    /// The reference system as text, if one is given.
    pub crs: Option<String>,
    /// Files that are there but could not be understood.
    pub warnings: Vec<String>,
}

impl Placement {
    /// The world file counts before the .aux.xml, the .prj before the .aux.xml.
    pub fn from_sidecars(sidecars: &Sidecars) -> Self {
        let mut placement = Placement::default();
        if let Some(text) = &sidecars.world {
            placement.transform = world_file(text);
            if placement.transform.is_none() {
                let what = "the world file beside it does not hold six numbers; it is not used";
                placement.warnings.push(what.to_owned());
            }
        }
        let prj = sidecars.prj.as_deref().map(|text| text.trim_start_matches('\u{feff}').trim());
        placement.crs = prj.filter(|text| !text.is_empty()).map(str::to_owned);
        if let Some(text) = &sidecars.aux {
            placement.transform = placement
                .transform
                .or_else(|| element(text, "GeoTransform").and_then(|inner| gdal_transform(&inner)));
            placement.crs = placement.crs.or_else(|| element(text, "SRS"));
        }
        placement
    }
}

/// A transform from six numbers on lines of their own: x step per column, y step per
/// column, x step per row, y step per row, x and y of the centre of the first pixel.
fn world_file(text: &str) -> Option<GeoTransform> {
    let numbers = finite_numbers(text.split_ascii_whitespace())?;
    let [a, d, b, e, c, f] = numbers[..] else { return None };
    let transform = GeoTransform { origin: [c, f], step_column: [a, d], step_row: [b, e] };
    invertible(&transform).then_some(transform)
}

/// GDAL's six numbers, which speak of the corner of the first pixel.
fn gdal_transform(text: &str) -> Option<GeoTransform> {
    let numbers = finite_numbers(text.split(',').map(str::trim))?;
    let [c, a, b, f, d, e] = numbers[..] else { return None };
    let origin = [c + 0.5 * (a + b), f + 0.5 * (d + e)];
    let transform = GeoTransform { origin, step_column: [a, d], step_row: [b, e] };
    invertible(&transform).then_some(transform)
}

fn finite_numbers<'a>(words: impl Iterator<Item = &'a str>) -> Option<Vec<f64>> {
    let numbers: Option<Vec<f64>> = words.take(7).map(|word| word.parse().ok()).collect();
    numbers.filter(|numbers| numbers.iter().all(|number| number.is_finite()))
}

/// Whether different samples lie at different places.
pub fn invertible(transform: &GeoTransform) -> bool {
    let [a, d] = transform.step_column;
    let [b, e] = transform.step_row;
    let determinant = a * e - b * d;
    transform.origin.iter().all(|value| value.is_finite())
        && determinant.is_finite()
        && determinant != 0.0
}

/// The text of the first element of that name, entities resolved.
pub fn element(xml: &str, name: &str) -> Option<String> {
    let open = xml.match_indices(&format!("<{name}")).find(|(at, found)| {
        matches!(xml.as_bytes().get(at + found.len()), Some(b'>' | b' ' | b'\t' | b'\n' | b'\r'))
    })?;
    let start = open.0 + xml[open.0..].find('>')? + 1;
    let end = start + xml[start..].find(&format!("</{name}>"))?;
    let text = unescape(xml[start..end].trim());
    (!text.is_empty()).then_some(text)
}

/// Resolves the five entities of XML.
pub fn unescape(text: &str) -> String {
    text.replace("&quot;", "\"")
        .replace("&apos;", "'")
        .replace("&lt;", "<")
        .replace("&gt;", ">")
        .replace("&amp;", "&")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_world_file_speaks_of_pixel_centres_and_gdal_of_corners() {
        let world = "30.0\r\n0\r\n0\r\n-30.0\r\n301920.0\r\n4154070.0\r\n";
        let aux = "<PAMDataset>\n<SRS dataAxisToSRSAxisMapping=\"2,1\">GEOGCS[&quot;WGS 84&quot;]\
                   </SRS><GeoTransform> 301905.0, 30, 0, 4154085, 0, -30</GeoTransform>\
                   </PAMDataset>";
        let world =
            Placement::from_sidecars(&Sidecars { world: Some(world.into()), ..Default::default() });
        let aux =
            Placement::from_sidecars(&Sidecars { aux: Some(aux.into()), ..Default::default() });
        let expected = GeoTransform {
            origin: [301920.0, 4154070.0],
            step_column: [30.0, 0.0],
            step_row: [0.0, -30.0],
        };
        assert_eq!(world.transform, Some(expected));
        assert_eq!(aux.transform, Some(expected));
        assert_eq!(aux.crs.as_deref(), Some("GEOGCS[\"WGS 84\"]"));
    }

    #[test]
    fn a_world_file_that_makes_no_sense_is_named_and_not_used() {
        for text in ["", "1 2 3", "a b c d e f", "1 0 0 nan 0 0", "1 1 1 1 0 0", "1 2 3 4 5 6 7"] {
            let sidecars = Sidecars { world: Some(text.into()), ..Default::default() };
            let placement = Placement::from_sidecars(&sidecars);
            assert_eq!(placement.transform, None, "{text}");
            assert_eq!(placement.warnings.len(), 1, "{text}");
        }
    }
}
