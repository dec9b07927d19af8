//! `terrafarm bench stability`: is any method silently wrong where it is known to be hard?
//!
//! A scene is a small store and a camera at which some method is expected to fail: grazing
//! rays, roll, cliffs, spikes, voids, seams, large coordinates, round ground. Every method
//! renders every scene. A cell is in bound if its number keeps the method's promise, and
//! refused if the method said so. Where a method keeps its promise by another way, and
//! counts the pixels, that is a fallback. Anything else is silent, the one forbidden outcome,
//! and makes the exit code 1. `outside` is a claim about films that does not hold while no
//! picture is wrong.
//!
//! Where a formula tells the truth, it does: distances to a plane, the dip of a horizon, the
//! elevation of a peak (`scenes`). Elsewhere `exact` is the truth, and `reference` that of
//! `exact`. What is no scene has a file of its own: flights, hillshades and missing tiles
//! (`systems`), switches of levels (`popping`), light and photos (`light`), processors that
//! differ (`seams`), more posts than 32 bits count (`vast`).

mod files;
mod judge;
mod light;
mod popping;
mod scenes;
mod seams;
mod systems;
mod vast;

use super::kernel::Depths;
use super::land::Land;
use super::report::{digits, save, table};
use crate::{Outcome, args};
use serde::Serialize;
use terrafarm_common::quality::{Method, Quality};
use terrafarm_synth::SynthSpec;

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
    /// `in-bound`, `fallback`, `refused`, `outside` or `silent`.
    outcome: &'static str,
    value: Option<f64>,
    bound: f64,
    unit: &'static str,
    /// Why it was refused.
    why: Option<String>,
    /// What else was measured.
    note: Option<String>,
    /// Share of the pixels that the method could not do its own way and gave a ray of
    /// their own.
    fallback_share: Option<f64>,
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
            fallback_share: None,
        }
    }

    /// A cell with a number that is to reach its bound.
    fn reached(scene: &str, method: &str, value: f64, bound: f64, unit: &'static str) -> Self {
        let outcome = if value >= bound { "in-bound" } else { "silent" };
        Cell { outcome, ..Cell::measured(scene, method, value, bound, unit) }
    }

    /// A cell with a number that is no error of a picture but a claim about films.
    fn claimed(scene: &str, method: &str, value: f64, bound: f64, unit: &'static str) -> Self {
        let measured = Cell::measured(scene, method, value, bound, unit);
        let outcome = if measured.outcome == "silent" { "outside" } else { measured.outcome };
        Cell { outcome, ..measured }
    }

    /// Says that a method within its bound has kept it by rays of their own for some pixels.
    fn with_fallbacks(self, answer: &Depths) -> Self {
        if answer.stats.fallbacks == 0 {
            return self;
        }
        let share = answer.stats.fallbacks as f64 / answer.region.area() as f64;
        let outcome = if self.outcome == "in-bound" { "fallback" } else { self.outcome };
        Cell { outcome, fallback_share: Some(share), ..self }
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
pub fn run(args: &args::bench::BenchStability) -> anyhow::Result<Outcome> {
    let size = if args.short { (97, 55) } else { (641, 361) };
    let mut report = Report {
        program: format!("terrafarm {}", env!("CARGO_PKG_VERSION")),
        short: args.short,
        cells: systems::cells()?,
    };
    let posts = if args.short { 1025 } else { 2049 };
    let land = Land::synth(SynthSpec { posts, spacing_m: 15.0, seed: 3, photo_scale: 1 })?;
    report.cells.extend(popping::cells(&land, size)?);
    report.cells.extend(seams::cells(&land, size)?);
    report.cells.extend(light::cells(size)?);
    report.cells.extend(vast::cells(size, args.short)?);
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
    let alone = cell
        .fallback_share
        .map(|share| format!("{} % of the pixels by rays of their own", digits(100.0 * share)));
    let more = cell.why.iter().chain(&alone).chain(&cell.note).map(|text| format!(": {text}"));
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
