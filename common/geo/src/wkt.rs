//! Well-known text, version 1, as OGC and ESRI write it in `.prj` files.
//!
//! A code in the text is believed first. Otherwise projection, parameters, datum and
//! units are carried over to a proj string. Version 2 is read for its code only.

use crate::proj_string::ProjString;

/// What a well-known text says.
pub(crate) enum Meaning {
    /// An engineering system that lies nowhere.
    Local,
    /// A system with an EPSG code.
    Epsg(u16),
    /// A system described by its parameters.
    Definition {
        /// The parameters.
        definition: ProjString,
        /// The name in the text.
        name: String,
    },
}

/// The deepest nesting that is read.
const MAX_DEPTH: usize = 16;

/// Reads a well-known text.
///
/// # Errors
/// In words, if it is malformed or uses something that is not known here.
pub(crate) fn read(text: &str) -> Result<Meaning, String> {
    let mut reader = Reader { text, at: 0 };
    let root = reader.node(0)?;
    let system = match root.keyword.as_str() {
        "COMPD_CS" | "COMPOUNDCRS" | "BOUNDCRS" | "SOURCECRS" => root
            .nodes
            .iter()
            .find(|node| HORIZONTAL.contains(&node.keyword.as_str()))
            .ok_or("it has no horizontal system")?,
        _ => &root,
    };
    match system.keyword.as_str() {
        "LOCAL_CS" | "ENGCRS" => return Ok(Meaning::Local),
        keyword if !HORIZONTAL.contains(&keyword) => {
            return Err(format!("{keyword} is not a horizontal system"));
        }
        _ => {}
    }
    if let Some(code) = system.epsg_code()
        && crs_definitions::from_code(code).is_some()
    {
        return Ok(Meaning::Epsg(code));
    }
    let name = system.text(0).unwrap_or("unnamed").to_owned();
    let definition = match system.keyword.as_str() {
        "PROJCS" => projected(system)?,
        "GEOGCS" => {
            let mut definition = geographic(system)?;
            definition.set("proj", "longlat");
            definition
        }
        _ => return Err("it is version 2 of well-known text without a known EPSG code".into()),
    };
    let definition = match utm_code(&definition) {
        Some(code) => return Ok(Meaning::Epsg(code)),
        None => definition,
    };
    Ok(Meaning::Definition { definition, name })
}

const HORIZONTAL: [&str; 8] =
    ["PROJCS", "GEOGCS", "PROJCRS", "PROJECTEDCRS", "GEOGCRS", "GEODCRS", "LOCAL_CS", "ENGCRS"];

/// Names of projections in lower case, and of PROJ.
const PROJECTIONS: [(&str, &str); 27] = [
    ("transverse_mercator", "tmerc"),
    ("gauss_kruger", "tmerc"),
    ("lambert_conformal_conic", "lcc"),
    ("lambert_conformal_conic_1sp", "lcc"),
    ("lambert_conformal_conic_2sp", "lcc"),
    ("albers", "aea"),
    ("albers_conic_equal_area", "aea"),
    ("lambert_azimuthal_equal_area", "laea"),
    ("polar_stereographic", "stere"),
    ("stereographic_north_pole", "stere"),
    ("stereographic_south_pole", "stere"),
    ("oblique_stereographic", "sterea"),
    ("double_stereographic", "sterea"),
    ("stereographic", "stere"),
    ("mercator", "merc"),
    ("mercator_1sp", "merc"),
    ("mercator_2sp", "merc"),
    ("mercator_auxiliary_sphere", "webmerc"),
    ("equirectangular", "eqc"),
    ("equidistant_cylindrical", "eqc"),
    ("plate_carree", "eqc"),
    ("cylindrical_equal_area", "cea"),
    ("sinusoidal", "sinu"),
    ("azimuthal_equidistant", "aeqd"),
    ("cassini_soldner", "cass"),
    ("polyconic", "poly"),
    ("equidistant_conic", "eqdc"),
];

/// Parameters in lower case, of PROJ, and whether they are lengths.
const PARAMETERS: [(&str, &str, bool); 14] = [
    ("false_easting", "x_0", true),
    ("false_northing", "y_0", true),
    ("central_meridian", "lon_0", false),
    ("longitude_of_center", "lon_0", false),
    ("longitude_of_origin", "lon_0", false),
    ("straight_vertical_longitude_from_pole", "lon_0", false),
    ("latitude_of_origin", "lat_0", false),
    ("latitude_of_center", "lat_0", false),
    ("central_parallel", "lat_0", false),
    ("standard_parallel_1", "lat_1", false),
    ("standard_parallel_2", "lat_2", false),
    ("pseudo_standard_parallel_1", "lat_1", false),
    ("scale_factor", "k", false),
    ("auxiliary_sphere_type", "", false),
];

fn projected(system: &Node) -> Result<ProjString, String> {
    if let Some(extension) = system.child("EXTENSION")
        && extension.text(0).is_some_and(|kind| kind.eq_ignore_ascii_case("PROJ4"))
    {
        return Ok(ProjString::parse(extension.text(1).unwrap_or_default()));
    }
    let geographic_system = system.child("GEOGCS").ok_or("it has no GEOGCS")?;
    let mut definition = geographic(geographic_system)?;
    let projection = system.child("PROJECTION").and_then(|node| node.text(0));
    let projection = projection.ok_or("it has no PROJECTION")?.to_lowercase().replace(' ', "_");
    let proj = PROJECTIONS.iter().find(|(name, _)| *name == projection);
    let (_, proj) = proj.ok_or_else(|| format!("the projection {projection} is not known here"))?;
    definition.set("proj", *proj);
    let unit_m = match system.child("UNIT") {
        Some(unit) => unit.number(0).ok_or("its UNIT has no size")?,
        None => 1.0,
    };
    if unit_m != 1.0 {
        definition.set_number("to_meter", unit_m);
    }
    for node in system.nodes.iter().filter(|node| node.keyword == "PARAMETER") {
        let name = node.text(0).unwrap_or_default().to_lowercase().replace(' ', "_");
        let value = node.number(0).ok_or_else(|| format!("parameter {name} has no value"))?;
        let known = PARAMETERS.iter().find(|(wkt, _, _)| *wkt == name);
        match known {
            Some((_, "", _)) => {}
            Some((_, proj, length)) => {
                definition.set_number(proj, if *length { value * unit_m } else { value });
            }
            // An azimuth or a second pole of zero changes nothing.
            None if value == 0.0 => {}
            None => return Err(format!("the parameter {name} is not known here")),
        }
    }
    adapt_parallels(&mut definition, &projection);
    Ok(definition)
}

/// The standard parallel means a latitude of true scale in cylindrical and polar
/// projections, and a single one of a cone stands for its origin.
fn adapt_parallels(definition: &mut ProjString, projection: &str) {
    match definition.get("proj") {
        Some("stere") => {
            let parallel = definition.remove("lat_1");
            let pole = match projection {
                "stereographic_north_pole" => Some(90.0),
                "stereographic_south_pole" => Some(-90.0),
                // OGC writes the parallel of true scale where others write the origin.
                "polar_stereographic" => definition.number("lat_0").map(|l| 90f64.copysign(l)),
                _ => None,
            };
            if let Some(pole) = pole {
                let true_scale = parallel.or_else(|| definition.get("lat_0").map(str::to_owned));
                if let Some(true_scale) = true_scale {
                    definition.set("lat_ts", true_scale);
                }
                definition.set_number("lat_0", pole);
            }
        }
        Some("merc" | "eqc" | "cea") => {
            if let Some(parallel) = definition.remove("lat_1") {
                definition.set("lat_ts", parallel);
            }
        }
        Some("webmerc") => {
            definition.remove("lat_1");
        }
        Some("lcc") if definition.get("lat_1").is_none() => {
            if let Some(origin) = definition.get("lat_0").map(str::to_owned) {
                definition.set("lat_1", origin);
            }
        }
        _ => {}
    }
}

/// Datums that count as WGS84: beginnings of names in lower case without "d_".
const MODERN: [&str; 22] = [
    "wgs_1984",
    "wgs84",
    "etrs",
    "european_terrestrial",
    "gda",
    "geocentric_datum_of_australia",
    "new_zealand_geodetic_datum_2000",
    "nzgd_2000",
    "jgd_20",
    "japanese_geodetic_datum_20",
    "rgf_1993",
    "reseau_geodesique_francais_1993",
    "sirgas",
    "sistema_de_referencia_geocentrico",
    "ch1903+",
    "itrf",
    "china_2000",
    "cgcs_2000",
    "csrs",
    "north_american_1983_csrs",
    "nad83",
    "world_geodetic_system_1984",
];

/// Other datums with a name that PROJ knows.
const NAMED: [(&str, &str); 9] = [
    ("north_american_1983", "NAD83"),
    ("north_american_datum_1983", "NAD83"),
    ("north_american_1927", "NAD27"),
    ("north_american_datum_1927", "NAD27"),
    ("osgb_1936", "OSGB36"),
    ("ordnance_survey_of_great_britain_1936", "OSGB36"),
    ("deutsches_hauptdreiecksnetz", "potsdam"),
    ("new_zealand_1949", "nzgd49"),
    ("new_zealand_geodetic_datum_1949", "nzgd49"),
];

/// Datums by their three parameters to WGS84, as EPSG lists them.
const SHIFTED: [(&str, &str); 6] = [
    ("ch1903", "674.374,15.056,405.346"),
    ("european_1950", "-87,-98,-121"),
    ("european_datum_1950", "-87,-98,-121"),
    ("tokyo", "-146.414,507.337,680.507"),
    ("nouvelle_triangulation_francaise", "-168,-60,320"),
    ("ntf", "-168,-60,320"),
];

/// Ellipsoid, datum and prime meridian of a geographic system.
fn geographic(system: &Node) -> Result<ProjString, String> {
    let mut definition = ProjString::default();
    let degree = std::f64::consts::PI / 180.0;
    let unit = system.child("UNIT").and_then(|unit| unit.number(0)).unwrap_or(degree);
    if (unit - degree).abs() > 1e-9 {
        return Err("it does not count in degrees, which is not supported".into());
    }
    let datum = system.child("DATUM").ok_or("it has no DATUM")?;
    let spheroid = datum.child("SPHEROID").or_else(|| datum.child("ELLIPSOID"));
    let spheroid = spheroid.ok_or("its DATUM has no SPHEROID")?;
    let (a, rf) = spheroid.number(0).zip(spheroid.number(1)).ok_or("its SPHEROID is incomplete")?;
    if !(1e6..1e8).contains(&a) || !(rf == 0.0 || rf > 10.0) {
        return Err("its SPHEROID is not that of the Earth".into());
    }
    if a == 6_378_137.0 && (rf - 298.257).abs() < 1e-3 {
        definition.set("ellps", if rf < 298.257_222_5 { "GRS80" } else { "WGS84" });
    } else if rf == 0.0 {
        definition.set_number("R", a);
    } else {
        definition.set_number("a", a);
        definition.set_number("rf", rf);
    }
    let name = datum.text(0).unwrap_or_default().to_lowercase().replace([' ', '-'], "_");
    let name = name.strip_prefix("d_").unwrap_or(&name);
    let shift = datum.child("TOWGS84").map(|node| node.numbers());
    if let Some(shift) = shift.filter(|numbers| !numbers.is_empty()) {
        let words: Vec<String> = shift.iter().map(f64::to_string).collect();
        definition.set("towgs84", words.join(","));
    } else if MODERN.iter().any(|start| name.starts_with(start)) {
        definition.set("towgs84", "0,0,0");
    } else if let Some((_, proj)) = NAMED.iter().find(|(wkt, _)| *wkt == name) {
        definition.set("datum", *proj);
    } else if let Some((_, shift)) = SHIFTED.iter().find(|(wkt, _)| *wkt == name) {
        definition.set("towgs84", *shift);
    }
    let meridian = system.child("PRIMEM").and_then(|node| node.number(0)).unwrap_or(0.0);
    if meridian != 0.0 {
        definition.set_number("pm", meridian);
    }
    Ok(definition)
}

/// The code of a UTM zone on WGS84, NAD83 or NAD27 that is written out in parameters.
fn utm_code(definition: &ProjString) -> Option<u16> {
    let is = |name: &str, value: f64| definition.number(name).unwrap_or(0.0) == value;
    let utm = definition.get("proj") == Some("tmerc")
        && definition.get("to_meter").is_none()
        && definition.get("pm").is_none()
        && is("k", 0.9996)
        && is("x_0", 500_000.0)
        && is("lat_0", 0.0);
    let zone = (definition.number("lon_0").filter(|_| utm)? + 183.0) / 6.0;
    if zone.fract() != 0.0 || !(1.0..=60.0).contains(&zone) {
        return None;
    }
    let south = is("y_0", 1e7);
    if !south && !is("y_0", 0.0) {
        return None;
    }
    let modern = definition.get("towgs84") == Some("0,0,0");
    let base = match (definition.get("datum"), definition.get("ellps"), south) {
        (None, Some("WGS84"), false) if modern => 32600,
        (None, Some("WGS84"), true) if modern => 32700,
        (Some("NAD83"), _, false) => 26900,
        (Some("NAD27"), _, false) => 26700,
        _ => return None,
    };
    let code = base + zone as u16;
    crs_definitions::from_code(code).map(|_| code)
}

/// `KEYWORD["text", 1.0, CHILD[...]]`; values are kept by kind, in order.
struct Node {
    keyword: String,
    values: Vec<String>,
    nodes: Vec<Node>,
}

impl Node {
    fn child(&self, keyword: &str) -> Option<&Node> {
        self.nodes.iter().find(|node| node.keyword == keyword)
    }

    /// A value that is not a number, counted among all values.
    fn text(&self, at: usize) -> Option<&str> {
        self.values.get(at).map(String::as_str)
    }

    /// The values that are numbers. A name that looks like a number comes first and is
    /// left out.
    fn numbers(&self) -> Vec<f64> {
        let skip = usize::from(self.keyword != "TOWGS84");
        let numbers = self.values.iter().skip(skip).filter_map(|text| text.trim().parse().ok());
        numbers.filter(|value: &f64| value.is_finite()).collect()
    }

    fn number(&self, at: usize) -> Option<f64> {
        self.numbers().get(at).copied()
    }

    fn epsg_code(&self) -> Option<u16> {
        let authority = self.child("AUTHORITY").or_else(|| self.child("ID"))?;
        let epsg = authority.text(0).is_some_and(|name| name.eq_ignore_ascii_case("EPSG"));
        authority.text(1).filter(|_| epsg)?.trim().parse().ok()
    }
}

struct Reader<'a> {
    text: &'a str,
    at: usize,
}

impl Reader<'_> {
    fn rest(&self) -> &str {
        &self.text[self.at..]
    }

    fn skip_space(&mut self) {
        self.at += self.rest().len() - self.rest().trim_start().len();
    }

    /// The next character that is not white space, taken.
    fn next(&mut self) -> Option<char> {
        self.skip_space();
        let next = self.rest().chars().next()?;
        self.at += next.len_utf8();
        Some(next)
    }

    fn word(&mut self) -> String {
        self.skip_space();
        let end = self.rest().find(['[', ']', '(', ')', ',', '"']).unwrap_or(self.rest().len());
        let word = self.rest()[..end].trim().to_owned();
        self.at += end;
        word
    }

    fn node(&mut self, depth: usize) -> Result<Node, String> {
        let keyword = self.word().to_uppercase();
        if !matches!(self.next(), Some('[' | '(')) {
            return Err(format!("an opening bracket is missing after {keyword}"));
        }
        self.body(keyword, depth)
    }

    /// What follows an opening bracket, up to the closing one.
    fn body(&mut self, keyword: String, depth: usize) -> Result<Node, String> {
        if depth > MAX_DEPTH {
            return Err(format!("it is nested deeper than {MAX_DEPTH}"));
        }
        let mut node = Node { keyword, values: Vec::new(), nodes: Vec::new() };
        loop {
            self.skip_space();
            if self.rest().starts_with('"') {
                let body = &self.rest()[1..];
                let end = body.find('"').ok_or("a quotation mark is missing")?;
                node.values.push(body[..end].to_owned());
                self.at += end + 2;
            } else {
                let word = self.word();
                self.skip_space();
                if self.rest().starts_with(['[', '(']) {
                    self.at += 1;
                    node.nodes.push(self.body(word.to_uppercase(), depth + 1)?);
                } else if !word.is_empty() {
                    node.values.push(word);
                }
            }
            match self.next() {
                Some(',') => {}
                Some(']' | ')') => return Ok(node),
                Some(other) => return Err(format!("\"{other}\" is out of place")),
                None => return Err("it ends before its last bracket".into()),
            }
        }
    }
}
