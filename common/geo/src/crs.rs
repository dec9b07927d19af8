//! One coordinate reference system: reading it, asking it, and single points.

use std::fmt;
use std::sync::Arc;

use proj4rs::Proj;

use crate::datum;
use crate::proj_string::ProjString;
use crate::transform::{Axes, System, Transformer, wrap_longitude};
use crate::wkt;
use crate::zones::metric_zone;

/// The longest definition that is read, bytes.
const MAX_TEXT_BYTES: usize = 64 * 1024;
/// Text of terrain that lies nowhere on Earth.
const LOCAL: &str = "LOCAL";
/// Degrees of latitude to either side when a direction or a scale is measured: 11 m.
const PROBE_DEG: f64 = 1e-4;

/// A coordinate reference system. Cheap to clone; may be used from several threads.
#[derive(Clone)]
pub struct Crs {
    inner: Arc<Inner>,
}

struct Inner {
    text: String,
    name: String,
    warnings: Vec<String>,
    /// `None` for `LOCAL`.
    system: Option<System>,
    /// Equal for systems whose coordinates are the same.
    grid_text: String,
    /// Metres per unit of a projected system.
    unit_m: f64,
}

/// Why a system could not be read, or a point not be placed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CrsError {
    /// The text names no system that is known here.
    #[error(
        "cannot read the reference system \"{text}\": {why}; write it like \"EPSG:32612\", \
         \"+proj=utm +zone=12 +datum=WGS84\", or LOCAL for terrain that lies nowhere"
    )]
    Unknown {
        /// The text, shortened.
        text: String,
        /// What is wrong with it.
        why: String,
    },
    /// The point does not exist in the system, such as a pole in a Mercator grid.
    #[error("the position {x}, {y} lies outside the domain of {system}")]
    OutOfDomain {
        /// First coordinate as given.
        x: f64,
        /// Second coordinate as given.
        y: f64,
        /// Name of the system.
        system: String,
    },
    /// The system is `LOCAL`.
    #[error(
        "terrain with the reference system LOCAL lies nowhere on Earth; \
         give positions as x, y in metres, or give the terrain a reference system"
    )]
    Nowhere,
}

impl Crs {
    /// Reads "EPSG:32612" (also as a URN or URL), a proj string, `LOCAL`, or WKT 1 as in
    /// `.prj` files. Upper and lower case are the same.
    ///
    /// # Errors
    /// [`CrsError::Unknown`], if the text is none of these or names something unknown.
    pub fn parse(text: &str) -> Result<Crs, CrsError> {
        let trimmed =
            text.trim_matches(|c: char| c.is_whitespace() || c == '\0' || c == '\u{feff}');
        Self::parse_trimmed(trimmed).map_err(|why| {
            let short: String = trimmed.chars().take(80).collect();
            CrsError::Unknown { text: short, why }
        })
    }

    fn parse_trimmed(text: &str) -> Result<Crs, String> {
        if text.is_empty() {
            return Err("it is empty".into());
        }
        if text.len() > MAX_TEXT_BYTES {
            return Err(format!("it is longer than {MAX_TEXT_BYTES} bytes"));
        }
        let lower = text.to_ascii_lowercase();
        if lower == "local" {
            return Ok(Self::local());
        }
        if ["wgs84", "crs84", "ogc:crs84"].contains(&lower.as_str()) {
            return Self::from_epsg(4326);
        }
        if let Some(code) = epsg_code(&lower) {
            return Self::from_epsg(code?);
        }
        if lower.starts_with('+') || lower.contains("proj=") && !lower.contains('[') {
            let definition = ProjString::parse(text);
            let canonical = definition.to_string();
            return Self::from_definition(definition, canonical.clone(), canonical);
        }
        if lower.contains('[') || lower.contains('(') {
            return match wkt::read(text)? {
                wkt::Meaning::Local => Ok(Self::local()),
                wkt::Meaning::Epsg(code) => Self::from_epsg(code),
                wkt::Meaning::Definition { definition, name } => {
                    let canonical = definition.to_string();
                    Self::from_definition(definition, canonical, name)
                }
            };
        }
        Err("it is neither a code nor a definition".into())
    }

    fn local() -> Crs {
        let inner = Inner {
            text: LOCAL.into(),
            name: "a local grid that lies nowhere on Earth".into(),
            warnings: Vec::new(),
            system: None,
            grid_text: LOCAL.into(),
            unit_m: 1.0,
        };
        Crs { inner: Arc::new(inner) }
    }

    fn from_epsg(code: u16) -> Result<Crs, String> {
        let known = crs_definitions::from_code(code)
            .ok_or_else(|| format!("EPSG has no system {code} that is known here"))?;
        let name = known.wkt.split('"').nth(1).unwrap_or("unnamed").to_owned();
        let geographic = known.wkt.starts_with("GEOGCS");
        if geographic && !known.wkt.contains("UNIT[\"degree\"") {
            return Err(format!("{name} does not count in degrees, which is not supported"));
        }
        Self::from_definition(ProjString::parse(known.proj4), format!("EPSG:{code}"), name)
    }

    fn from_definition(
        mut definition: ProjString,
        text: String,
        name: String,
    ) -> Result<Crs, String> {
        let warnings = datum::make_explicit(&mut definition)?;
        let (system, grid_text) = build_system(definition)?;
        let unit_m = system.proj.to_meter();
        if !(1e-6..1e6).contains(&unit_m) {
            return Err(format!("a unit of {unit_m} m is out of range"));
        }
        let inner = Inner { text, name, warnings, system: Some(system), grid_text, unit_m };
        Ok(Crs { inner: Arc::new(inner) })
    }

    /// The metric grid that suits a place best: its UTM zone on WGS84, or a polar
    /// stereographic grid beyond 84° N and 80° S. Degrees; longitudes may lie beyond 180.
    pub fn suggest_metric(longitude_deg: f64, latitude_deg: f64) -> Crs {
        Self::from_epsg(metric_zone(longitude_deg, latitude_deg))
            .expect("every UTM zone and both polar grids are among the definitions")
    }

    /// The system as text that [`Crs::parse`] reads: "EPSG:32612", a proj string, or
    /// `LOCAL`.
    pub fn text(&self) -> &str {
        &self.inner.text
    }

    /// The system's name for people, such as "WGS 84 / UTM zone 12N".
    pub fn name(&self) -> &str {
        &self.inner.name
    }

    /// What a user should know of the accuracy of positions.
    pub fn warnings(&self) -> &[String] {
        &self.inner.warnings
    }

    /// Whether coordinates are longitude and latitude in degrees.
    pub fn is_geographic(&self) -> bool {
        self.system().is_some_and(|system| system.proj.is_latlong())
    }

    /// Whether this is terrain that lies nowhere on Earth.
    pub fn is_local(&self) -> bool {
        self.system().is_none()
    }

    /// Whether coordinates are metres to the east and to the north: the condition for a
    /// terrain store. False for feet, degrees and grids that count to the south. `LOCAL`
    /// is metric but not projected: false.
    pub fn is_metric_projected(&self) -> bool {
        let metric = self.inner.unit_m == 1.0 && !self.is_geographic();
        metric && self.system().is_some_and(|system| system.axes == Axes::EastNorth)
    }

    /// Metres per unit of the coordinates; `None` for a geographic system.
    pub fn unit_m(&self) -> Option<f64> {
        (!self.is_geographic()).then_some(self.inner.unit_m)
    }

    /// Whether coordinates in both systems mean the same place, however the systems were
    /// written. NAD83 and WGS84 count as one datum.
    pub fn is_same_grid(&self, other: &Crs) -> bool {
        self.inner.grid_text == other.inner.grid_text
    }

    /// Longitude and latitude of a point, degrees on WGS84.
    ///
    /// # Errors
    /// [`CrsError::OutOfDomain`], or [`CrsError::Nowhere`] for `LOCAL`.
    pub fn to_lonlat(&self, xy: [f64; 2]) -> Result<[f64; 2], CrsError> {
        let transformer = Transformer::new(self, &Self::wgs84())?;
        if self.is_geographic() && xy[1].abs() > 90.0 {
            return self.checked(xy, [f64::NAN; 2]);
        }
        let [longitude, latitude] = self.checked(xy, transformer.apply_one(xy))?;
        Ok([wrap_longitude(longitude), latitude])
    }

    /// The point at a longitude and latitude in degrees on WGS84. Longitudes may lie in
    /// −180 ..= 180 or 0 ..= 360.
    ///
    /// # Errors
    /// [`CrsError::OutOfDomain`], or [`CrsError::Nowhere`] for `LOCAL`.
    #[allow(clippy::wrong_self_convention, reason = "the pair of to_lonlat")]
    pub fn from_lonlat(&self, lonlat: [f64; 2]) -> Result<[f64; 2], CrsError> {
        let transformer = Transformer::new(&Self::wgs84(), self)?;
        self.checked(lonlat, transformer.apply_one(lonlat))
    }

    /// Grid convergence at a point: the bearing of true north on the grid, degrees
    /// clockwise from grid north, −180 to 180. So
    ///
    /// `heading on the grid = true heading + convergence`.
    ///
    /// In the northern half of a UTM zone it is negative east of the central meridian.
    /// (Surveyors tabulate the opposite sign.) Zero for geographic systems.
    ///
    /// # Errors
    /// [`CrsError::OutOfDomain`], or [`CrsError::Nowhere`] for `LOCAL`.
    pub fn convergence_deg(&self, xy: [f64; 2]) -> Result<f64, CrsError> {
        if self.is_geographic() {
            return Ok(0.0);
        }
        let north = self.northward(xy)?;
        Ok(north[0].atan2(north[1]).to_degrees())
    }

    /// Scale at a point, measured along the meridian: metres on the grid per metre on
    /// the ground. 0.9996 in the middle of a UTM zone, 1.25 at 37° in a web map. Geographic
    /// systems: metres per metre is meaningless, 1.
    ///
    /// # Errors
    /// [`CrsError::OutOfDomain`], or [`CrsError::Nowhere`] for `LOCAL`.
    pub fn scale(&self, xy: [f64; 2]) -> Result<f64, CrsError> {
        if self.is_geographic() {
            return Ok(1.0);
        }
        let latitude = self.to_lonlat(xy)?[1];
        let north = self.northward(xy)?;
        let grid_m = (north[0] * north[0] + north[1] * north[1]).sqrt() * self.inner.unit_m;
        Ok(grid_m / meridian_radius_m(latitude).to_radians())
    }

    /// Change of position on the grid per degree of latitude.
    fn northward(&self, xy: [f64; 2]) -> Result<[f64; 2], CrsError> {
        let [longitude, latitude] = self.to_lonlat(xy)?;
        let high = (latitude + PROBE_DEG).min(90.0);
        let low = (latitude - PROBE_DEG).max(-90.0);
        let a = self.from_lonlat([longitude, low])?;
        let b = self.from_lonlat([longitude, high])?;
        Ok([0, 1].map(|axis| (b[axis] - a[axis]) / (high - low)))
    }

    fn wgs84() -> Crs {
        Self::from_epsg(4326).expect("WGS84 is among the definitions")
    }

    fn checked(&self, given: [f64; 2], result: [f64; 2]) -> Result<[f64; 2], CrsError> {
        if result.iter().all(|value| value.is_finite()) {
            return Ok(result);
        }
        let system = self.name().to_owned();
        Err(CrsError::OutOfDomain { x: given[0], y: given[1], system })
    }

    pub(crate) fn system(&self) -> Option<&System> {
        self.inner.system.as_ref()
    }
}

impl fmt::Debug for Crs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Crs({})", self.text())
    }
}

impl fmt::Display for Crs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.name() == self.text() {
            f.write_str(self.text())
        } else {
            write!(f, "{} ({})", self.text(), self.name())
        }
    }
}

/// Mean radius of curvature of the WGS84 ellipsoid at a latitude (Gaussian radius: the
/// geometric mean of those along the meridian and across it), metres.
pub fn gaussian_radius_m(latitude_deg: f64) -> f64 {
    let sine = latitude_deg.to_radians().sin();
    WGS84_A * (1.0 - WGS84_E2).sqrt() / (1.0 - WGS84_E2 * sine * sine)
}

/// Radius of curvature of the WGS84 ellipsoid along the meridian, metres.
fn meridian_radius_m(latitude_deg: f64) -> f64 {
    let sine = latitude_deg.to_radians().sin();
    let w = 1.0 - WGS84_E2 * sine * sine;
    WGS84_A * (1.0 - WGS84_E2) / (w * w.sqrt())
}

/// Semi-major axis of WGS84, metres.
const WGS84_A: f64 = 6_378_137.0;
/// First eccentricity of WGS84, squared.
const WGS84_E2: f64 = 0.006_694_379_990_141_317;

/// The code of "epsg:n", "urn:ogc:def:crs:epsg::n", ".../crs/epsg/0/n"; of a compound
/// "epsg:n+m" the first. `None` if the text is not of this kind.
fn epsg_code(lower: &str) -> Option<Result<u16, String>> {
    let rest = ["epsg:", "urn:ogc:def:crs:epsg:", "http://www.opengis.net/def/crs/epsg/"]
        .iter()
        .find_map(|start| lower.strip_prefix(start))?;
    let code = rest.rsplit([':', '/']).next().unwrap_or(rest);
    let code = code.split('+').next().unwrap_or(code).trim();
    Some(code.parse().map_err(|_| format!("\"{code}\" is not an EPSG code")))
}

/// A system from a definition whose datum is explicit, and its text for comparison.
fn build_system(mut definition: ProjString) -> Result<(System, String), String> {
    if let Some(value) = definition.remove("k_0") {
        definition.set("k0", value);
    }
    let axes = match definition.remove("axis").as_deref() {
        None | Some("enu") => Axes::EastNorth,
        Some("wsu") => Axes::WestSouth,
        Some("swu") => Axes::SouthWest,
        Some(other) => return Err(format!("axes in the order {other} are not supported")),
    };
    let kind = definition.get("proj").ok_or("it has no +proj")?.to_lowercase();
    if kind == "geocent" {
        return Err("it counts from the centre of the Earth; use its geographic system".into());
    }
    definition.set("proj", kind.as_str());
    let shift = definition.remove("towgs84");
    let ellipsoid = ellipsoid_of(&definition);
    let geographic = build(&format!("+proj=longlat {ellipsoid}"))?;
    let longlat = ["longlat", "latlong", "lonlat", "latlon"].contains(&kind.as_str());
    let mut prime_meridian_deg = 0.0;
    let proj = if longlat {
        definition.set("proj", "longlat");
        if let Some(meridian) = definition.get("pm") {
            let probe = build(&format!("+proj=merc {ellipsoid} +pm={meridian}"))?;
            prime_meridian_deg = probe.from_greenwich().to_degrees();
            if definition.number("pm").is_some_and(|degrees| degrees.abs() <= 360.0) {
                prime_meridian_deg = definition.number("pm").unwrap_or_default();
            }
        }
        geographic.clone()
    } else {
        build(&definition.to_string())?
    };
    if !proj.has_inverse() || !proj.has_forward() {
        return Err(format!("the projection {kind} cannot be undone"));
    }
    let datum_text = shift.map(|shift| format!("{ellipsoid} +towgs84={shift}"));
    let shifted = match &datum_text {
        Some(text) => Some(build(&format!("+proj=longlat {text}"))?),
        None => None,
    };
    let wgs84 = build("+proj=longlat +datum=WGS84")?;
    let datum_text = datum_text.unwrap_or_default();
    let grid_text = grid_text(&definition, axes, &datum_text);
    let system = System { proj, geographic, shifted, wgs84, datum_text, prime_meridian_deg, axes };
    Ok((system, grid_text))
}

/// The same text for systems that give the same coordinates: `utm` is written out, and
/// GRS80 counts as WGS84, from which it differs by 0.1 mm at the poles.
fn grid_text(definition: &ProjString, axes: Axes, datum_text: &str) -> String {
    let mut definition = definition.clone();
    if definition.get("proj") == Some("longlat") {
        definition.remove("k");
        definition.remove("units");
    }
    if definition.get("ellps") == Some("GRS80") || definition.get("ellps").is_none() {
        let bare = definition.get("a").is_none() && definition.get("R").is_none();
        if bare || definition.get("ellps").is_some() {
            definition.set("ellps", "WGS84");
        }
    }
    let zone = definition.number("zone").filter(|_| definition.get("proj") == Some("utm"));
    if let Some(zone) = zone {
        let south = definition.to_string().contains("+south");
        definition.remove("zone");
        definition.remove("south");
        definition.set("proj", "tmerc");
        definition.set_number("lon_0", zone * 6.0 - 183.0);
        definition.set_number("k", 0.9996);
        definition.set_number("x_0", 500_000.0);
        definition.set_number("y_0", if south { 1e7 } else { 0.0 });
    }
    let datum_text = datum_text.replace("GRS80", "WGS84");
    format!("{} {} {datum_text}", definition.sorted(), axes as u8)
}

/// The words of a definition that shape the ellipsoid.
fn ellipsoid_of(definition: &ProjString) -> String {
    const WORDS: [&str; 8] = ["ellps", "a", "b", "rf", "f", "es", "e", "R"];
    let words: Vec<String> = WORDS
        .iter()
        .filter_map(|word| definition.get(word).map(|value| format!("+{word}={value}")))
        .collect();
    if words.is_empty() { "+ellps=WGS84".into() } else { words.join(" ") }
}

fn build(text: &str) -> Result<Proj, String> {
    Proj::from_proj_string(text).map_err(|error| error.to_string())
}
