//! `terrafarm bench stability`: is any method silently wrong where it is known to be hard?
//!
//! A scene is a small store and a camera at which some method is expected to fail: grazing
//! rays, roll, cliffs, spikes, voids, seams, large coordinates, round ground. Every method
//! renders every scene. A cell is in bound if its number keeps the method's promise, and
//! refused if the method said so; anything else is silent, the one forbidden outcome, and
//! makes the exit code 1.
//!
//! Where a formula tells the truth, it does: distances to a plane, the dip of a horizon, the
//! elevation of a peak (`scenes`). Elsewhere `exact` is the truth, and `reference` that of
//! `exact`. Flights, hillshades and missing tiles have scenes of their own (`systems`).

mod judge;
mod popping;
mod scenes;
mod systems;

use super::report::{digits, save, table};
use crate::{Outcome, args};
use serde::Serialize;
use terrafarm_common::quality::{Method, Quality};

/// What is written as JSON. Keys are promises.
#[derive(Debug, Serialize)]
struct Report {
    program: String,
    short: bool,
    cells: Vec<Cell>,
}

/// One scene by one method.
#[derive(Debug, Clone, Serialize)]
struct Cell {
    scene: String,
    /// A method, or the part of the program that the scene is about.
    method: String,
    /// `in-bound`, `refused`, `outside` or `silent`.
    outcome: &'static str,
    value: Option<f64>,
    bound: f64,
    unit: &'static str,
    /// Why it was refused.
    why: Option<String>,
    /// What else was measured.
    note: Option<String>,
}

impl Cell {
    /// A cell with a number, to be within its bound.
    fn measured(scene: &str, method: &str, value: f64, bound: f64, unit: &'static str) -> Self {
        Cell {
            scene: scene.to_owned(),
            method: method.to_owned(),
            // NaN is within no bound.
            outcome: if value <= bound { "in-bound" } else { "silent" },
            value: Some(value),
            bound,
            unit,
            why: None,
            note: None,
        }
    }

    /// A cell with a number that is no error of a picture but a claim about films.
    fn claimed(scene: &str, method: &str, value: f64, bound: f64, unit: &'static str) -> Self {
        let measured = Cell::measured(scene, method, value, bound, unit);
        let outcome = if measured.outcome == "silent" { "outside" } else { measured.outcome };
        Cell { outcome, ..measured }
    }

    /// Says what else was measured.
    fn with_note(self, note: String) -> Self {
        Cell { note: Some(note), ..self }
    }

    /// A cell without one: the method said why.
    fn refused(scene: &str, method: &str, why: String) -> Self {
        let measured = Cell::measured(scene, method, 0.0, 0.0, "");
        Cell { outcome: "refused", value: None, why: Some(why), ..measured }
    }
}

/// Plays every scene and prints the numbers.
pub fn run(args: &args::BenchStability) -> anyhow::Result<Outcome> {
    let size = if args.short { (97, 55) } else { (641, 361) };
    let mut report = Report {
        program: format!("terrafarm {}", env!("CARGO_PKG_VERSION")),
        short: args.short,
        cells: systems::cells()?,
    };
    report.cells.extend(popping::cells(size, args.short)?);
    for scene in scenes::all(size)? {
        for method in Method::ALL {
            let tolerance_px = Quality::DEFAULT_TOLERANCE_PX;
            let quality = Quality { method, samples_per_side: 1, tolerance_px };
            tracing::info!(scene = scene.name, method = method.name(), "next");
            report.cells.push(judge::cell(&scene, quality));
        }
        // What is done stays known, whatever happens to the rest.
        save(args.json.as_deref(), &report)?;
    }
    save(args.json.as_deref(), &report)?;
    print!("{}", text(&report));
    let silent = report.cells.iter().filter(|cell| cell.outcome == "silent").count();
    if silent > 0 {
        eprintln!("terrafarm: {silent} of {} cells are silently wrong", report.cells.len());
    }
    Ok(if silent == 0 { Outcome::Done } else { Outcome::BrokenPromise })
}

/// The outcome of a cell in words.
fn said(cell: &Cell) -> String {
    let outcome = match cell.outcome {
        "silent" => "SILENT",
        outcome => outcome,
    };
    let more = cell.why.iter().chain(&cell.note).map(|text| format!(": {text}"));
    outcome.to_owned() + &more.collect::<String>()
}

fn text(report: &Report) -> String {
    let head = ["scene", "method", "value", "bound", "unit", "outcome"];
    let rows: Vec<Vec<String>> = report
        .cells
        .iter()
        .map(|cell| {
            vec![
                cell.scene.clone(),
                cell.method.clone(),
                cell.value.map_or_else(|| "-".to_owned(), digits),
                digits(cell.bound),
                cell.unit.to_owned(),
                said(cell),
            ]
        })
        .collect();
    table(&head, &rows)
}
