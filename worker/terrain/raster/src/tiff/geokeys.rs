//! The GeoTIFF keys: reference system, vertical reference, and what a sample stands for.
//!
//! Codes are from the GeoTIFF 1.1 standard (OGC 19-008). A registered system is handed
//! on as its EPSG code. A user-defined one is rebuilt as a proj string from its
//! projection keys; where that fails, a warning says so and the system stays unknown.

use crate::info::{RasterError, Vertical};
use crate::options::HeightUnit;
use crate::source::Source;
use crate::tiff::directory::Directory;
use std::collections::BTreeMap;

const USER_DEFINED: u64 = 32767;

/// The keys of a file.
#[derive(Default)]
pub struct GeoKeys {
    codes: BTreeMap<u16, u64>,
    doubles: BTreeMap<u16, f64>,
    lists: BTreeMap<u16, Vec<f64>>,
    texts: BTreeMap<u16, String>,
}

impl GeoKeys {
    /// Reads the three tags of keys; no keys if there are none.
    pub fn read(source: &Source, directory: &Directory) -> Result<Self, RasterError> {
        let table = directory.numbers(source, 34735, 1 << 16)?.unwrap_or_default();
        let doubles = directory.doubles(source, 34736)?;
        let text = directory.text(source, 34737)?.unwrap_or_default();
        let mut keys = GeoKeys::default();
        for entry in table.chunks_exact(4).skip(1) {
            let [key, place, count, value] =
                [entry[0] as u16, entry[1] as u16, entry[2] as u16, entry[3] as u16];
            let range = usize::from(value)..usize::from(value) + usize::from(count);
            match place {
                0 => {
                    keys.codes.insert(key, u64::from(value));
                }
                34736 => {
                    let values = doubles.get(range).unwrap_or_default();
                    if let Some(first) = values.first().filter(|value| value.is_finite()) {
                        keys.doubles.insert(key, *first);
                        keys.lists.insert(key, values.to_vec());
                    }
                }
                34737 => {
                    let words = text.get(range).unwrap_or_default();
                    keys.texts.insert(key, words.trim_end_matches('|').to_owned());
                }
                _ => {}
            }
        }
        Ok(keys)
    }

    fn code(&self, key: u16) -> Option<u64> {
        self.codes.get(&key).copied().filter(|&code| code != 0)
    }

    /// A registered code, not 0 and not "user-defined".
    fn registered(&self, key: u16) -> Option<u64> {
        self.code(key).filter(|&code| code != USER_DEFINED)
    }

    fn first_double(&self, keys: &[u16]) -> Option<f64> {
        keys.iter().find_map(|key| self.doubles.get(key).copied())
    }

    /// Whether a sample is a post, not an area (key 1025).
    pub fn is_point(&self) -> bool {
        self.code(1025) == Some(2)
    }

    /// Whether positions are longitudes and latitudes.
    pub fn is_geographic(&self) -> bool {
        self.code(1024) == Some(2)
            || self.code(1024).is_none() && self.code(3072).is_none() && self.code(2048).is_some()
    }

    /// What heights are measured from. Every vertical system of the EPSG register is
    /// related to gravity; ellipsoidal heights occur as the third axis of a geographic
    /// system, or under the codes 5001 to 5033 of the first GeoTIFF standard.
    pub fn vertical(&self) -> Vertical {
        match self.registered(4096).or_else(|| self.registered(4098)) {
            Some(5001..=5033) => Vertical::Ellipsoid,
            Some(_) => Vertical::Geoid,
            None if self.code(2048) == Some(4979) => Vertical::Ellipsoid,
            None => Vertical::Unknown,
        }
    }

    /// The unit of heights: the key for it, or the unit of a vertical system in feet.
    pub fn vertical_unit(&self) -> Option<HeightUnit> {
        match (self.code(4099), self.code(4096)) {
            (Some(9001), _) => Some(HeightUnit::Metre),
            (Some(9002), _) | (None, Some(8228)) => Some(HeightUnit::Foot),
            (Some(9003), _) | (None, Some(5702 | 6360)) => Some(HeightUnit::UsSurveyFoot),
            _ => None,
        }
    }

    /// The reference system as text, or why there is none.
    pub fn crs(&self) -> Result<Option<String>, String> {
        if self.codes.is_empty() {
            return Ok(None);
        }
        match self.code(1024) {
            Some(3) => Err("its positions are geocentric, which a raster cannot use".into()),
            _ if self.is_geographic() => self.geographic().map(Some),
            _ => self.projected().map(Some),
        }
    }

    fn geographic(&self) -> Result<String, String> {
        match self.registered(2048) {
            // The height axis is told by `vertical`.
            Some(4979) => Ok("EPSG:4326".into()),
            Some(code) => Ok(format!("EPSG:{code}")),
            None => Ok(format!("+proj=longlat {} +no_defs", self.datum_terms()?)),
        }
    }

    fn projected(&self) -> Result<String, String> {
        if let Some(code) = self.registered(3072) {
            return Ok(format!("EPSG:{code}"));
        }
        let wkt = [1026, 3073]
            .iter()
            .filter_map(|key| self.texts.get(key))
            .find_map(|text| text.strip_prefix("ESRI PE String = ").map(str::to_owned));
        match (self.projection_terms(), wkt) {
            (Ok(terms), _) => {
                Ok(format!("{terms} {} {} +no_defs", self.datum_terms()?, self.unit_term()?))
            }
            (Err(_), Some(wkt)) => Ok(wkt),
            (Err(why), None) => Err(why),
        }
    }

    /// Metres in a linear unit of the projected system.
    fn metres(&self) -> Result<f64, String> {
        match self.code(3076) {
            None | Some(9001) => Ok(1.0),
            Some(9002) => Ok(0.3048),
            Some(9003) => Ok(1200.0 / 3937.0),
            code => self.first_double(&[3077]).filter(|&size| size > 0.0).ok_or_else(|| {
                format!(
                    "its linear unit has the code {}, which is not known here",
                    code.unwrap_or(0)
                )
            }),
        }
    }

    fn unit_term(&self) -> Result<String, String> {
        Ok(match self.code(3076) {
            None | Some(9001) => "+units=m".into(),
            Some(9002) => "+units=ft".into(),
            Some(9003) => "+units=us-ft".into(),
            _ => format!("+to_meter={}", self.metres()?),
        })
    }

    /// Degrees in an angular unit.
    fn degrees(&self) -> Result<f64, String> {
        match self.code(2054) {
            None | Some(9102 | 9122) => Ok(1.0),
            Some(9101) => Ok(180.0 / std::f64::consts::PI),
            Some(9105) => Ok(0.9),
            Some(code) => {
                Err(format!("its angular unit has the code {code}, which is not known here"))
            }
        }
    }

    /// Ellipsoid, datum and prime meridian as proj terms.
    fn datum_terms(&self) -> Result<String, String> {
        // Datums 6xxx of the register belong to the geographic systems 4xxx.
        let datum = self.registered(2050).filter(|code| (6000..7000).contains(code));
        let geographic = self.registered(2048).or(datum.map(|code| code - 2000));
        let known = geographic
            .and_then(|code| u16::try_from(code).ok())
            .and_then(crs_definitions::from_code);
        if let Some(definition) = known {
            let terms = definition.proj4.split_whitespace();
            let terms: Vec<&str> = terms
                .filter(|term| {
                    ["+datum", "+ellps", "+towgs84", "+pm", "+a=", "+b=", "+rf"]
                        .iter()
                        .any(|wanted| term.starts_with(wanted))
                })
                .collect();
            return Ok(terms.join(" "));
        }
        let mut terms = match (self.first_double(&[2057]), self.registered(2056)) {
            (_, Some(7030)) => "+ellps=WGS84".to_owned(),
            (_, Some(7019)) => "+ellps=GRS80".to_owned(),
            (_, Some(7008)) => "+ellps=clrk66".to_owned(),
            (_, Some(7004)) => "+ellps=bessel".to_owned(),
            (_, Some(7022)) => "+ellps=intl".to_owned(),
            (_, Some(7001)) => "+ellps=airy".to_owned(),
            (_, Some(7024)) => "+ellps=krass".to_owned(),
            (Some(a), _) => {
                let flattening = self.first_double(&[2059]).filter(|&inverse| inverse > 0.0);
                let b = match (flattening, self.first_double(&[2058])) {
                    (Some(inverse), _) => a - a / inverse,
                    (None, Some(b)) => b,
                    (None, None) => a,
                };
                format!("+a={a} +b={b}")
            }
            (None, _) => return Err("its ellipsoid is not given by a code or by numbers".into()),
        };
        if let Some(shift) = self.lists.get(&2062).filter(|shift| matches!(shift.len(), 3 | 7)) {
            let shift: Vec<String> = shift.iter().map(f64::to_string).collect();
            terms += &format!(" +towgs84={}", shift.join(","));
        }
        match self.first_double(&[2061]) {
            Some(meridian) if meridian != 0.0 => {
                terms += &format!(" +pm={}", meridian * self.degrees()?)
            }
            _ => {}
        }
        Ok(terms)
    }

    /// The projection and its parameters as proj terms.
    fn projection_terms(&self) -> Result<String, String> {
        if let Some(code @ (16001..=16060 | 16101..=16160)) = self.registered(3074) {
            let south = if code > 16100 { " +south" } else { "" };
            return Ok(format!("+proj=utm +zone={}{south}", code % 100));
        }
        let (degrees, metres) = (self.degrees()?, self.metres()?);
        let angle = |keys: &[u16]| self.first_double(keys).unwrap_or(0.0) * degrees;
        let longitude = angle(&[3080, 3088, 3084, 3095]);
        let latitude = angle(&[3081, 3089, 3085]);
        let scale = self.first_double(&[3092, 3093]).unwrap_or(1.0);
        let shift = format!(
            "+x_0={} +y_0={}",
            self.first_double(&[3082, 3086, 3090]).unwrap_or(0.0) * metres,
            self.first_double(&[3083, 3087, 3091]).unwrap_or(0.0) * metres
        );
        let parallels = || format!("+lat_1={} +lat_2={}", angle(&[3078]), angle(&[3079]));
        let terms = match self.code(3075) {
            Some(1) => format!("+proj=tmerc +lat_0={latitude} +lon_0={longitude} +k={scale}"),
            Some(7) => match self.first_double(&[3078]) {
                Some(parallel) => {
                    format!("+proj=merc +lat_ts={} +lon_0={longitude}", parallel * degrees)
                }
                None => format!("+proj=merc +lon_0={longitude} +k={scale}"),
            },
            Some(8) => {
                let latitude = angle(&[3085, 3081]);
                let longitude = angle(&[3084, 3080]);
                format!("+proj=lcc {} +lat_0={latitude} +lon_0={longitude}", parallels())
            }
            Some(9) => format!(
                "+proj=lcc +lat_1={latitude} +lat_0={latitude} +lon_0={longitude} +k_0={scale}"
            ),
            Some(10) => format!("+proj=laea +lat_0={latitude} +lon_0={longitude}"),
            Some(11) => format!("+proj=aea {} +lat_0={latitude} +lon_0={longitude}", parallels()),
            Some(15) => {
                let pole = if latitude < 0.0 { -90 } else { 90 };
                let longitude = angle(&[3095, 3080]);
                let true_scale = if latitude.abs() == 90.0 {
                    format!("+k_0={scale}")
                } else {
                    format!("+lat_ts={latitude}")
                };
                format!("+proj=stere +lat_0={pole} {true_scale} +lon_0={longitude}")
            }
            Some(code) => {
                return Err(format!(
                    "its projection (method {code}) is not rebuilt here; reproject it with: \
                     gdalwarp -t_srs EPSG:CODE in.tif out.tif"
                ));
            }
            None => return Err("it names neither a registered system nor a projection".into()),
        };
        Ok(format!("{terms} {shift}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys(codes: &[(u16, u64)], doubles: &[(u16, f64)]) -> GeoKeys {
        GeoKeys {
            codes: codes.iter().copied().collect(),
            doubles: doubles.iter().copied().collect(),
            ..Default::default()
        }
    }

    #[test]
    fn registered_systems_are_their_epsg_codes() {
        let utm = keys(&[(1024, 1), (3072, 32612)], &[]);
        assert_eq!(utm.crs(), Ok(Some("EPSG:32612".into())));
        let geographic = keys(&[(1024, 2), (2048, 4269)], &[]);
        assert_eq!(geographic.crs(), Ok(Some("EPSG:4269".into())));
        assert_eq!(keys(&[], &[]).crs(), Ok(None));
    }

    #[test]
    fn false_eastings_in_feet_become_metres_and_the_unit_is_named() {
        let state_plane = keys(
            &[(1024, 1), (3072, 32767), (3075, 8), (2048, 4269), (3076, 9003)],
            &[(3078, 40.0), (3079, 41.0), (3085, 39.5), (3084, -105.0), (3086, 3937.0)],
        );
        let expected = "+proj=lcc +lat_1=40 +lat_2=41 +lat_0=39.5 +lon_0=-105 +x_0=1200 +y_0=0 \
                        +datum=NAD83 +units=us-ft +no_defs";
        assert_eq!(state_plane.crs(), Ok(Some(expected.into())));
    }

    #[test]
    fn a_projection_that_is_not_known_is_refused_in_words() {
        let oblique = keys(&[(1024, 1), (3072, 32767), (3075, 3), (2048, 4326)], &[]);
        assert!(oblique.crs().is_err_and(|why| why.contains("method 3")));
        assert!(keys(&[(1024, 3)], &[]).crs().is_err());
    }

    #[test]
    fn vertical_keys_tell_geoid_ellipsoid_and_feet() {
        assert_eq!(keys(&[(4096, 5773)], &[]).vertical(), Vertical::Geoid);
        assert_eq!(keys(&[(4096, 5030)], &[]).vertical(), Vertical::Ellipsoid);
        assert_eq!(keys(&[(2048, 4979)], &[]).vertical(), Vertical::Ellipsoid);
        assert_eq!(keys(&[(4096, 32767)], &[]).vertical(), Vertical::Unknown);
        assert_eq!(keys(&[(4099, 9002)], &[]).vertical_unit(), Some(HeightUnit::Foot));
        assert_eq!(keys(&[(4096, 6360)], &[]).vertical_unit(), Some(HeightUnit::UsSurveyFoot));
    }
}
