//! Which shift carries a datum to WGS84, decided here and nowhere else.
//!
//! proj4rs would drop the whole shift when one side has none, and would look for grid
//! files that nobody has. So every definition is rewritten: the ellipsoid stays, the
//! datum becomes an explicit `+towgs84`, or nothing if it counts as WGS84.

use crate::proj_string::ProjString;

/// A named datum of PROJ: its ellipsoid and its parameters to WGS84 (metres, arc
/// seconds, parts per million; position vector convention), as EPSG and PROJ list them.
struct Datum {
    name: &'static str,
    ellipsoid: &'static str,
    /// Empty for those that count as WGS84.
    to_wgs84: &'static str,
}

const DATUMS: [Datum; 10] = [
    Datum { name: "WGS84", ellipsoid: "WGS84", to_wgs84: "" },
    Datum { name: "NAD83", ellipsoid: "GRS80", to_wgs84: "" },
    Datum { name: "NAD27", ellipsoid: "clrk66", to_wgs84: "-8,160,176" },
    Datum { name: "GGRS87", ellipsoid: "GRS80", to_wgs84: "-199.87,74.79,246.62" },
    Datum {
        name: "OSGB36",
        ellipsoid: "airy",
        to_wgs84: "446.448,-125.157,542.060,0.1502,0.2470,0.8421,-20.4894",
    },
    Datum {
        name: "potsdam",
        ellipsoid: "bessel",
        to_wgs84: "598.1,73.7,418.2,0.202,0.045,-2.455,6.7",
    },
    Datum { name: "carthage", ellipsoid: "clrk80ign", to_wgs84: "-263.0,6.0,431.0" },
    Datum {
        name: "hermannskogel",
        ellipsoid: "bessel",
        to_wgs84: "577.326,90.129,463.919,5.137,1.474,5.297,2.4232",
    },
    Datum {
        name: "ire65",
        ellipsoid: "mod_airy",
        to_wgs84: "482.530,-130.596,564.557,-1.042,-0.214,-0.631,8.15",
    },
    Datum {
        name: "nzgd49",
        ellipsoid: "intl",
        to_wgs84: "59.47,-5.04,187.44,0.47,-0.1,1.024,-4.5993",
    },
];

/// Ellipsoids whose owners, without further words, are meant to be WGS84.
const MODERN: [&str; 2] = ["WGS84", "GRS80"];

/// Rewrites a definition as described above. Returns what the user should know.
///
/// # Errors
/// In words, if the datum or the shift cannot be understood.
pub(crate) fn make_explicit(definition: &mut ProjString) -> Result<Vec<String>, String> {
    let mut warnings = Vec::new();
    let grids = definition.remove("nadgrids");
    let grids_are_null = grids.as_deref() == Some("@null");
    let mut shift = definition.remove("towgs84");
    if let Some(name) = definition.remove("datum") {
        let datum = DATUMS.iter().find(|datum| datum.name.eq_ignore_ascii_case(&name));
        let datum = datum.ok_or_else(|| format!("the datum \"{name}\" is not known"))?;
        if definition.get("ellps").is_none() && definition.get("a").is_none() {
            definition.set("ellps", datum.ellipsoid);
        }
        shift.get_or_insert_with(|| datum.to_wgs84.to_owned());
        if datum.name == "NAD27" {
            warnings.push(
                "NAD27 is shifted to WGS84 by the mean of the conterminous USA (-8, 160, 176 m): \
                 positions are good to about 10 m there, and may be off by 50 m elsewhere"
                    .into(),
            );
        }
    } else if shift.is_none() && !grids_are_null {
        let ellipsoid = definition.get("ellps");
        let bare = definition.get("a").is_none() && definition.get("R").is_none();
        let modern = MODERN.iter().any(|name| ellipsoid.is_some_and(|e| e == *name));
        let unsaid = ellipsoid.is_none() && bare;
        if !modern && !unsaid {
            warnings.push(
                "the definition does not say how its datum lies to WGS84; latitude and longitude \
                 are taken as they are, and positions may be off by some 100 m: \
                 give the system as a proj string with +towgs84"
                    .into(),
            );
        }
    }
    if let Some(grids) = grids.filter(|_| !grids_are_null) {
        warnings.push(format!("the datum grid {grids} is not used; positions may be off by 10 m"));
    }
    if grids_are_null {
        shift = None;
    }
    if let Some(shift) = shift.filter(|shift| !shift.is_empty()) {
        let numbers = parse_shift(&shift)?;
        let zero = numbers.iter().all(|&value| value == 0.0);
        let modern = definition.get("ellps").is_some_and(|name| MODERN.contains(&name));
        if !(zero && modern) {
            definition.set("towgs84", shift);
            if warnings.is_empty() && !zero {
                let count = numbers.len();
                warnings.push(format!(
                    "the datum is shifted to WGS84 by {count} parameters: \
                     longitudes and latitudes are good to 1 to 20 m"
                ));
            }
        }
    }
    Ok(warnings)
}

fn parse_shift(text: &str) -> Result<Vec<f64>, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse()).collect();
    match numbers {
        Ok(numbers) if [3, 7].contains(&numbers.len()) && numbers.iter().all(|n| n.is_finite()) => {
            Ok(numbers)
        }
        _ => Err(format!("+towgs84={text} must have three or seven numbers")),
    }
}
