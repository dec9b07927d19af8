//! The flight file: CSV keyframes.
//!
//! The first line names the columns, in any order and case:
//!
//! | column | also | meaning |
//! |---|---|---|
//! | `t` | `time`, `seconds`, `time_s`, `t_s` | time, seconds |
//! | `lon`, `lat` | `longitude`, `latitude`, `lng` | position, degrees WGS 84 ... |
//! | `x`, `y` | `easting`, `northing` | ... or metres in the system of the terrain |
//! | `height` | `h`, `alt`, `altitude`, `h_m`, `height_m`, `z` | metres, in the datum of the terrain ... |
//! | `agl` | `agl_m` | ... or metres above the ground there |
//! | `heading` | `yaw`, `azimuth` | degrees clockwise from true north |
//! | `pitch` | `tilt` | degrees up from the horizon; down is negative |
//! | `roll` | `bank` | degrees, right side down; 0 if absent |
//! | `hfov` | `fov` | horizontal field of view, degrees; the scene's if absent |
//! | `heading_ref` | | `true`, or `grid` if the heading counts from grid north |
//!
//! A comment `# heading: grid` says the last for the whole file. An empty field of `roll`,
//! `hfov` or `heading_ref` has the value of an absent column.

use super::csv::{Row, Table};
use super::{InputError, nearest, read_text};
use glam::DVec3;
use std::path::Path;
use terrafarm_common::camera::{MAX_HFOV_DEG, MIN_HFOV_DEG};
use terrafarm_common::flight::{
    Flight, FlightError, Keyframe, MAX_KEYFRAMES, MAX_POSITION_M, MAX_TIME_S,
};

/// The largest flight file, bytes.
const MAX_BYTES: u64 = 256 << 20;
/// Headings and rolls beyond ten turns are a mistake.
const MAX_TURN_DEG: f64 = 3600.0;
/// After so many warnings of a kind, the rest is a number.
const NAMED_WARNINGS: usize = 3;

/// The terrain as far as a flight needs it.
pub trait Place {
    /// Position on the grid, metres, of a longitude and latitude, degrees; or why not.
    fn to_grid(&self, lon_deg: f64, lat_deg: f64) -> Result<[f64; 2], String>;
    /// Bearing of true north on the grid, degrees clockwise from grid north: a grid
    /// heading is a true heading plus this. 0 where the terrain lies nowhere on Earth.
    fn convergence_deg(&self, x: f64, y: f64) -> f64;
    /// Height of the ground, metres; `None` over a void or outside.
    fn ground(&self, x: f64, y: f64) -> Option<f64>;
    /// What the terrain covers.
    fn bounds(&self) -> Bounds;
}

/// A rectangle on the grid, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Smallest x and y.
    pub min: [f64; 2],
    /// Largest x and y.
    pub max: [f64; 2],
}

impl Bounds {
    fn contains(&self, at: DVec3) -> bool {
        (self.min[0]..=self.max[0]).contains(&at.x) && (self.min[1]..=self.max[1]).contains(&at.y)
    }

    fn meets(&self, other: &Bounds) -> bool {
        (0..2).all(|axis| self.min[axis] <= other.max[axis] && other.min[axis] <= self.max[axis])
    }

    fn around(keyframes: &[Keyframe]) -> Bounds {
        let start = Bounds { min: [f64::INFINITY; 2], max: [f64::NEG_INFINITY; 2] };
        keyframes.iter().fold(start, |bounds, keyframe| {
            let at = keyframe.position;
            Bounds {
                min: [bounds.min[0].min(at.x), bounds.min[1].min(at.y)],
                max: [bounds.max[0].max(at.x), bounds.max[1].max(at.y)],
            }
        })
    }

    fn text(&self) -> String {
        let [west, south] = self.min;
        let [east, north] = self.max;
        format!("x {west:.0} to {east:.0}, y {south:.0} to {north:.0}")
    }
}

/// A flight, and what is odd about it.
#[derive(Debug, Clone)]
pub struct FlightFile {
    /// The path in the grid frame of the terrain.
    pub flight: Flight,
    /// To be shown to the user; the flight can be flown all the same.
    pub warnings: Vec<String>,
}

/// Reads a flight file. `hfov_deg` is the field of view where the file gives none.
pub fn read(file: &Path, place: &dyn Place, hfov_deg: f64) -> Result<FlightFile, InputError> {
    parse(file, &read_text(file, MAX_BYTES)?, place, hfov_deg)
}

/// Reads the text of a flight file; `file` is for messages.
pub fn parse(
    file: &Path,
    text: &str,
    place: &dyn Place,
    hfov_deg: f64,
) -> Result<FlightFile, InputError> {
    let table = Table::parse(file, text, MAX_KEYFRAMES)?;
    let mut reader = Reader::new(file, &table, place, hfov_deg)?;
    let keyframes: Vec<Keyframe> =
        table.rows.iter().map(|row| reader.keyframe(row)).collect::<Result<_, _>>()?;
    reader.warn_of_places(&keyframes)?;
    let flight = Flight::new(keyframes).map_err(|error| match error {
        FlightError::NotAscending { index, .. } | FlightError::OutOfRange { index, .. } => {
            InputError::on_line(file, table.rows[index].line, error.to_string())
        }
        _ => InputError::in_file(file, error.to_string()),
    })?;
    Ok(FlightFile { flight, warnings: reader.warnings })
}

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Column {
    Time,
    Lon,
    Lat,
    X,
    Y,
    Height,
    Agl,
    Heading,
    Pitch,
    Roll,
    Hfov,
    HeadingRef,
}

const NAMES: [(Column, &[&str]); 12] = [
    (Column::Time, &["t", "time", "seconds", "time_s", "t_s"]),
    (Column::Lon, &["lon", "longitude", "lng"]),
    (Column::Lat, &["lat", "latitude"]),
    (Column::X, &["x", "easting"]),
    (Column::Y, &["y", "northing"]),
    (Column::Height, &["height", "h", "alt", "altitude", "h_m", "height_m", "z"]),
    (Column::Agl, &["agl", "agl_m"]),
    (Column::Heading, &["heading", "yaw", "azimuth"]),
    (Column::Pitch, &["pitch", "tilt"]),
    (Column::Roll, &["roll", "bank"]),
    (Column::Hfov, &["hfov", "fov"]),
    (Column::HeadingRef, &["heading_ref"]),
];

struct Reader<'a> {
    file: &'a Path,
    table: &'a Table,
    place: &'a dyn Place,
    /// Column of each field.
    columns: Vec<Column>,
    hfov_deg: f64,
    is_grid_heading: bool,
    warnings: Vec<String>,
}

impl<'a> Reader<'a> {
    fn new(
        file: &'a Path,
        table: &'a Table,
        place: &'a dyn Place,
        hfov_deg: f64,
    ) -> Result<Self, InputError> {
        let columns = columns(&table.header.fields)
            .map_err(|message| InputError::on_line(file, table.header.line, message))?;
        let mut is_grid_heading = false;
        for comment in &table.comments {
            let text = comment.fields.concat().to_lowercase();
            let Some(value) = text.strip_prefix("heading:") else { continue };
            is_grid_heading = is_grid(value.trim())
                .map_err(|message| InputError::on_line(file, comment.line, message))?;
        }
        Ok(Reader { file, table, place, columns, hfov_deg, is_grid_heading, warnings: vec![] })
    }

    fn has(&self, column: Column) -> bool {
        self.columns.contains(&column)
    }

    fn field<'r>(&self, row: &'r Row, column: Column) -> Option<&'r str> {
        let at = self.columns.iter().position(|other| *other == column)?;
        row.fields.get(at).map(String::as_str).filter(|text| !text.is_empty())
    }

    fn wrong(&self, row: &Row, column: Column, message: &str) -> InputError {
        let at = self.columns.iter().position(|other| *other == column);
        let name = at.and_then(|at| self.table.header.fields.get(at));
        let name = name.map_or("", String::as_str);
        InputError::on_line(self.file, row.line, format!("column \"{name}\": {message}"))
    }

    /// A number within `low` to `high`; `default` for an absent or empty field.
    fn number(
        &self,
        row: &Row,
        column: Column,
        (low, high): (f64, f64),
        default: Option<f64>,
    ) -> Result<f64, InputError> {
        let Some(text) = self.field(row, column) else {
            return default.ok_or_else(|| self.wrong(row, column, "there is no value"));
        };
        let point = if self.table.decimal_comma { text.replace(',', ".") } else { text.into() };
        let Ok(value) = point.parse::<f64>() else {
            return Err(self.wrong(row, column, &format!("\"{text}\" is not a number")));
        };
        if (low..=high).contains(&value) {
            return Ok(value);
        }
        Err(self.wrong(row, column, &format!("{text} is out of range; it may be {low} to {high}")))
    }

    fn keyframe(&self, row: &Row) -> Result<Keyframe, InputError> {
        let t_s = self.number(row, Column::Time, (-MAX_TIME_S, MAX_TIME_S), None)?;
        let [x, y] = self.level_position(row)?;
        let far = (-MAX_POSITION_M, MAX_POSITION_M);
        let z = if self.has(Column::Agl) {
            let above = self.number(row, Column::Agl, far, None)?;
            let no_ground = "there is no ground to be above, a void or outside the terrain";
            let ground = self.place.ground(x, y);
            ground.ok_or_else(|| self.wrong(row, Column::Agl, no_ground))? + above
        } else {
            self.number(row, Column::Height, far, None)?
        };
        let turn = (-MAX_TURN_DEG, MAX_TURN_DEG);
        let mut heading = self.number(row, Column::Heading, turn, None)?;
        if !self.is_grid_heading_in(row)? {
            heading += self.place.convergence_deg(x, y);
        }
        let pitch = self.number(row, Column::Pitch, (-90.0, 90.0), None)?;
        let roll = self.number(row, Column::Roll, turn, Some(0.0))?;
        let fov = (MIN_HFOV_DEG, MAX_HFOV_DEG);
        let hfov = self.number(row, Column::Hfov, fov, Some(self.hfov_deg))?;
        Ok(Keyframe::from_angles(t_s, DVec3::new(x, y, z), heading, pitch, roll, hfov))
    }

    fn level_position(&self, row: &Row) -> Result<[f64; 2], InputError> {
        let far = (-MAX_POSITION_M, MAX_POSITION_M);
        if self.has(Column::X) {
            let x = self.number(row, Column::X, far, None)?;
            return Ok([x, self.number(row, Column::Y, far, None)?]);
        }
        let lon = self.number(row, Column::Lon, (-180.0, 360.0), None)?;
        let lat = self.number(row, Column::Lat, (-90.0, 90.0), None)?;
        let lon = if lon > 180.0 { lon - 360.0 } else { lon };
        let place = self.place.to_grid(lon, lat);
        place.map_err(|why| self.wrong(row, Column::Lon, &format!("{lon}, {lat}: {why}")))
    }

    fn is_grid_heading_in(&self, row: &Row) -> Result<bool, InputError> {
        match self.field(row, Column::HeadingRef) {
            None => Ok(self.is_grid_heading),
            Some(text) => is_grid(&text.to_lowercase())
                .map_err(|message| self.wrong(row, Column::HeadingRef, &message)),
        }
    }

    /// Refuses a flight that never comes near the terrain; notes keyframes outside and
    /// under the ground.
    fn warn_of_places(&mut self, keyframes: &[Keyframe]) -> Result<(), InputError> {
        let (ground, flight) = (self.place.bounds(), Bounds::around(keyframes));
        if !keyframes.is_empty() && !ground.meets(&flight) {
            let message = format!(
                "the flight lies wholly outside the terrain: it covers {}, the terrain {} (metres); is it the right terrain, and are longitude and latitude in their columns?",
                flight.text(),
                ground.text()
            );
            return Err(InputError::in_file(self.file, message));
        }
        let below = |keyframe: &Keyframe| {
            let at = keyframe.position;
            self.place.ground(at.x, at.y).is_some_and(|ground| at.z < ground)
        };
        let outside = self.lines(keyframes, |keyframe| !ground.contains(keyframe.position));
        let under = self.lines(keyframes, below);
        self.warnings.extend(outside.map(|lines| format!("outside the terrain on {lines}")));
        self.warnings.extend(under.map(|lines| format!("below the ground on {lines}")));
        Ok(())
    }

    /// "line 3, 4, 5 and 12 more" for the keyframes of a kind.
    fn lines(&self, all: &[Keyframe], is_odd: impl Fn(&Keyframe) -> bool) -> Option<String> {
        let odd = self.table.rows.iter().zip(all).filter(|(_, keyframe)| is_odd(keyframe));
        let lines: Vec<String> = odd.map(|(row, _)| row.line.to_string()).collect();
        let named = lines.get(..NAMED_WARNINGS).unwrap_or(&lines).join(", ");
        match lines.len() {
            0 => None,
            count if count <= NAMED_WARNINGS => Some(format!("line {named}")),
            count => Some(format!("line {named} and {} more", count - NAMED_WARNINGS)),
        }
    }
}

/// The columns that a header names, one for each field.
fn columns(header: &[String]) -> Result<Vec<Column>, String> {
    let known: Vec<&str> = NAMES.iter().flat_map(|(_, names)| names.iter().copied()).collect();
    let mut columns = Vec::with_capacity(header.len());
    for name in header {
        let lower = name.to_lowercase();
        let found = NAMES.iter().find(|(_, names)| names.contains(&lower.as_str()));
        let Some((column, names)) = found else {
            let first: Vec<&str> = NAMES.iter().map(|(_, names)| names[0]).collect();
            let hint = nearest(&lower, &known).map(|near| format!(" did you mean \"{near}\"?"));
            let (hint, all) = (hint.unwrap_or_default(), first.join(", "));
            return Err(format!("unknown column \"{name}\";{hint} known are {all}"));
        };
        if columns.contains(column) {
            return Err(format!("two columns hold the {}", names[0]));
        }
        columns.push(*column);
    }
    complete(&columns)?;
    Ok(columns)
}

/// Whether the columns say everything once.
fn complete(columns: &[Column]) -> Result<(), String> {
    let has = |column| columns.contains(&column);
    let metres = has(Column::X) || has(Column::Y);
    let degrees = has(Column::Lon) || has(Column::Lat);
    if metres && degrees {
        return Err("positions are given twice; keep lon and lat, or x and y".to_string());
    }
    if has(Column::Height) && has(Column::Agl) {
        return Err("heights are given twice; keep height, or agl".to_string());
    }
    let missing = [
        (has(Column::Time), "t"),
        (metres && has(Column::X) || has(Column::Lon), if metres { "x" } else { "lon" }),
        (metres && has(Column::Y) || has(Column::Lat), if metres { "y" } else { "lat" }),
        (has(Column::Height) || has(Column::Agl), "height (or agl)"),
        (has(Column::Heading), "heading"),
        (has(Column::Pitch), "pitch"),
    ];
    let names: Vec<&str> = missing.iter().filter(|(is, _)| !is).map(|(_, name)| *name).collect();
    if names.is_empty() {
        return Ok(());
    }
    Err(format!("these columns are missing: {}", names.join(", ")))
}

fn is_grid(word: &str) -> Result<bool, String> {
    match word {
        "grid" => Ok(true),
        "true" => Ok(false),
        _ => Err(format!("\"{word}\" is no north to count from; write true or grid")),
    }
}

#[cfg(test)]
mod tests;
