//! The chart of speed against accuracy: numbers to shapes. That of more workers is `stack`.
//!
//! Two panels, both logarithmic: time to the right, error upward, so that better is lower
//! left. One colour and one marker a method; the settings of a method are joined, what is
//! not dominated is filled and lies on the step line of the Pareto front. Names stand at
//! the curves. A [`Drawing`] is a list of shapes; `svg` writes them as text, `pixels` fills
//! them in: both show the same picture, and neither needs a font or a library.

mod pixels;
pub mod stack;
mod strokes;
mod svg;

use std::path::Path;
use terrafarm_coordinator::sink::poster;

/// Screen errors below this are drawn at it, pixels: nobody sees them.
pub const SCREEN_FLOOR_PX: f64 = 0.01;
/// Image errors below this are drawn at it, 8-bit levels.
pub const IMAGE_FLOOR: f64 = 0.05;

/// Size of the drawing, units of the SVG, pixels of the PNG.
const SIZE: [f64; 2] = [1600.0, 860.0];
const PANEL_WIDTH: f64 = 640.0;
const PANEL_HEIGHT: f64 = 600.0;
const PANEL_LEFT: [f64; 2] = [110.0, 890.0];
const PANEL_TOP: f64 = 150.0;
const MARKER: f64 = 6.5;
const TEXT: f64 = 15.0;
const SMALL: f64 = 12.0;

const PAPER: Color = [252, 252, 249];
const INK: Color = [34, 34, 34];
const GREY: Color = [110, 110, 110];
const GRID: Color = [224, 224, 218];
const FRONT: Color = [150, 150, 150];

/// sRGB.
pub type Color = [u8; 3];

/// The texts above the panels.
pub struct Title {
    /// What the chart shows.
    pub main: String,
    /// For what it was measured.
    pub sub: String,
}

/// Curves over a pair of axes.
pub struct Panel {
    /// What the error is, with its unit.
    pub axis: &'static str,
    /// Errors below are drawn here.
    pub floor: f64,
    /// One a method.
    pub curves: Vec<Curve>,
}

/// The settings of a method, in order.
pub struct Curve {
    /// Its name.
    pub method: &'static str,
    /// Its points.
    pub spots: Vec<Spot>,
}

/// One setting.
pub struct Spot {
    /// Time a frame, milliseconds.
    pub ms: f64,
    /// Error in the unit of the panel.
    pub error: f64,
    /// Another one beats it.
    pub dominated: bool,
    /// What the setting is.
    pub label: String,
}

/// Where a text lies about its place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Anchor {
    /// Its left end is there.
    Start,
    /// Its middle is there.
    Middle,
    /// Its right end is there.
    End,
}

/// A part of a drawing. Coordinates from the top left, y downward.
pub enum Shape {
    /// A line through points.
    Line { points: Vec<[f64; 2]>, width: f64, color: Color },
    /// A convex polygon, its corners clockwise on the screen.
    Polygon { corners: Vec<[f64; 2]>, fill: Color, edge: Color, width: f64 },
    /// A text on its baseline; turned to read upward if `upright`.
    Text { at: [f64; 2], size: f64, anchor: Anchor, upright: bool, color: Color, text: String },
}

/// Shapes, the first at the bottom.
pub struct Drawing {
    /// Width and height.
    pub size: [f64; 2],
    /// What lies behind everything.
    pub paper: Color,
    /// The shapes.
    pub shapes: Vec<Shape>,
    /// What the drawing shows, for those who do not see it.
    pub title: String,
}

/// Writes a drawing as SVG, as PNG, or both.
pub fn save(drawing: &Drawing, svg: Option<&Path>, png: Option<&Path>) -> anyhow::Result<()> {
    use anyhow::Context;
    if let Some(path) = svg {
        std::fs::write(path, svg::text(drawing))
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    if let Some(path) = png {
        poster::save(path, &pixels::fill(drawing))?;
    }
    Ok(())
}

/// Colour and marker of a method. The colours are those of Okabe and Ito, which people
/// with impaired colour vision tell apart, darkened where they are too light for paper.
fn look(method: &str) -> (Color, Vec<[f64; 2]>) {
    let regular = |corners: u32, turn: f64| {
        let corner = |n: u32| {
            let angle = (f64::from(n) + turn) / f64::from(corners) * std::f64::consts::TAU;
            [libm::sin(angle), -libm::cos(angle)]
        };
        (0..corners).map(corner).collect::<Vec<_>>()
    };
    match method {
        "exact" => ([0, 114, 178], regular(24, 0.0)),
        "lod" => ([0, 138, 100], regular(4, 0.5)),
        "column" => ([196, 120, 0], regular(3, 0.0)),
        "frustum" => ([176, 82, 140], regular(4, 0.0)),
        "voxel" => ([201, 76, 0], regular(3, 0.5)),
        "reference" => ([70, 70, 70], regular(6, 0.0)),
        _ => ([40, 130, 190], regular(5, 0.0)),
    }
}

/// Makes the drawing.
pub fn draw(title: &Title, panels: &[Panel; 2]) -> Drawing {
    let mut drawing = Drawing {
        size: SIZE,
        paper: PAPER,
        shapes: Vec::new(),
        title: format!("{}. {}", title.main, title.sub),
    };
    drawing.text([PANEL_LEFT[0] - 70.0, 50.0], 26.0, Anchor::Start, INK, &title.main);
    drawing.text([PANEL_LEFT[0] - 70.0, 82.0], TEXT, Anchor::Start, GREY, &title.sub);
    for (panel, left) in panels.iter().zip(PANEL_LEFT) {
        drawing.panel(panel, left);
    }
    drawing
}

/// From so many decades on, only decades have a number.
const MANY_DECADES: f64 = 2.5;

/// A logarithmic axis between two values.
#[derive(Clone, Copy)]
struct Axis {
    low: f64,
    high: f64,
}

impl Axis {
    /// An axis with room around some values, all positive.
    fn around(values: impl Iterator<Item = f64>) -> Self {
        let (low, high) =
            values.fold((f64::INFINITY, 0.0f64), |(low, high), v| (low.min(v), high.max(v)));
        if !(low > 0.0 && high.is_finite() && low <= high) {
            return Axis { low: 0.1, high: 10.0 };
        }
        Axis { low: low / 1.8, high: high * 2.4 }
    }

    /// Place of a value, 0 to 1.
    fn share(&self, value: f64) -> f64 {
        (libm::log(value) - libm::log(self.low)) / (libm::log(self.high) - libm::log(self.low))
    }

    /// How many decades it spans.
    fn decades(&self) -> f64 {
        libm::log10(self.high) - libm::log10(self.low)
    }

    /// 1, 2 and 5 of every decade in range, and whether it is a 1.
    fn ticks(&self) -> Vec<(f64, bool)> {
        let first = libm::floor(libm::log10(self.low)) as i32;
        let last = libm::ceil(libm::log10(self.high)) as i32;
        let decades = (first..=last).flat_map(|decade| [1, 2, 5].map(|step| (step, decade)));
        let ticks = decades.map(|(step, decade)| {
            let value = f64::from(step) * libm::pow(10.0, f64::from(decade));
            (value, step == 1)
        });
        ticks.filter(|(value, _)| (self.low..=self.high).contains(value)).collect()
    }
}

/// A rectangle that a text or a marker takes: left, top, right, bottom.
type Area = [f64; 4];

fn overlap(a: &Area, b: &Area) -> bool {
    a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3]
}

impl Drawing {
    fn text(&mut self, at: [f64; 2], size: f64, anchor: Anchor, color: Color, text: &str) {
        let text = text.to_owned();
        self.shapes.push(Shape::Text { at, size, anchor, upright: false, color, text });
    }

    fn line(&mut self, points: Vec<[f64; 2]>, width: f64, color: Color) {
        self.shapes.push(Shape::Line { points, width, color });
    }

    fn panel(&mut self, panel: &Panel, left: f64) {
        let spots = || panel.curves.iter().flat_map(|curve| &curve.spots);
        let across = Axis::around(spots().map(|spot| spot.ms));
        let up = Axis::around(spots().map(|spot| spot.error.max(panel.floor)));
        let place = |spot: &Spot| {
            let error = spot.error.max(panel.floor);
            [
                left + across.share(spot.ms) * PANEL_WIDTH,
                PANEL_TOP + (1.0 - up.share(error)) * PANEL_HEIGHT,
            ]
        };
        self.axes(panel, left, across, up);
        self.front(panel, left, &place);
        let mut taken: Vec<Area> = Vec::new();
        for spot in spots() {
            let [x, y] = place(spot);
            taken.push([x - MARKER, y - MARKER, x + MARKER, y + MARKER]);
        }
        for curve in &panel.curves {
            let (color, _) = look(curve.method);
            self.line(curve.spots.iter().map(&place).collect(), 1.6, color);
        }
        for curve in &panel.curves {
            let (color, marker) = look(curve.method);
            for spot in &curve.spots {
                let [x, y] = place(spot);
                let corner = |c: &[f64; 2]| [x + c[0] * MARKER, y + c[1] * MARKER];
                let corners = marker.iter().map(corner).collect();
                let fill = if spot.dominated { PAPER } else { color };
                self.shapes.push(Shape::Polygon { corners, fill, edge: color, width: 1.8 });
            }
        }
        self.names(panel, left, &place, &mut taken);
    }

    fn axes(&mut self, panel: &Panel, left: f64, across: Axis, up: Axis) {
        let (right, bottom) = (left + PANEL_WIDTH, PANEL_TOP + PANEL_HEIGHT);
        for (value, is_decade) in across.ticks() {
            let x = left + across.share(value) * PANEL_WIDTH;
            self.line(vec![[x, PANEL_TOP], [x, bottom]], if is_decade { 1.4 } else { 0.7 }, GRID);
            if is_decade || across.decades() < MANY_DECADES {
                self.text([x, bottom + 20.0], SMALL, Anchor::Middle, INK, &time(value));
            }
        }
        for (value, is_decade) in up.ticks() {
            let y = PANEL_TOP + (1.0 - up.share(value)) * PANEL_HEIGHT;
            self.line(vec![[left, y], [right, y]], if is_decade { 1.4 } else { 0.7 }, GRID);
            self.text([left - 8.0, y + 4.0], SMALL, Anchor::End, INK, &tick(value));
        }
        self.line(vec![[left, PANEL_TOP], [left, bottom], [right, bottom]], 1.4, INK);
        let name = "time per frame, on one core";
        self.text([left + PANEL_WIDTH / 2.0, bottom + 46.0], TEXT, Anchor::Middle, INK, name);
        self.shapes.push(Shape::Text {
            at: [left - 58.0, PANEL_TOP + PANEL_HEIGHT / 2.0],
            size: TEXT,
            anchor: Anchor::Middle,
            upright: true,
            color: INK,
            text: panel.axis.to_owned(),
        });
        if panel.curves.iter().flat_map(|curve| &curve.spots).any(|s| s.error < panel.floor) {
            let note = format!("errors below {} are drawn there", tick(panel.floor));
            self.text([left, bottom + 72.0], SMALL, Anchor::Start, GREY, &note);
        }
        // The arrow to the better.
        let tip = [left + 0.55 * PANEL_WIDTH, PANEL_TOP + 0.45 * PANEL_HEIGHT];
        self.line(vec![[tip[0] + 46.0, tip[1] - 46.0], tip], 2.2, GREY);
        self.line(vec![[tip[0] + 14.0, tip[1]], tip, [tip[0], tip[1] - 14.0]], 2.2, GREY);
        self.text([tip[0] + 52.0, tip[1] - 48.0], TEXT, Anchor::Start, GREY, "better");
    }

    /// The step line below which nothing was measured.
    fn front(&mut self, panel: &Panel, left: f64, place: &dyn Fn(&Spot) -> [f64; 2]) {
        let all = panel.curves.iter().flat_map(|curve| &curve.spots);
        let mut best: Vec<[f64; 2]> = all.filter(|spot| !spot.dominated).map(place).collect();
        best.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let Some(first) = best.first() else { return };
        let mut points = vec![[first[0], PANEL_TOP]];
        for spot in &best {
            let level = points[points.len() - 1][1];
            if level != PANEL_TOP {
                points.push([spot[0], level]);
            }
            points.push(*spot);
        }
        let last = points[points.len() - 1];
        points.push([left + PANEL_WIDTH, last[1]]);
        self.line(points, 5.0, GRID);
        self.line(best, 0.8, FRONT);
    }

    /// Names of the curves and of their settings, where there is room.
    fn names(
        &mut self,
        panel: &Panel,
        left: f64,
        place: &dyn Fn(&Spot) -> [f64; 2],
        taken: &mut Vec<Area>,
    ) {
        let frame = [left + 2.0, PANEL_TOP, left + PANEL_WIDTH, PANEL_TOP + PANEL_HEIGHT - 2.0];
        for curve in &panel.curves {
            let (color, _) = look(curve.method);
            // From the middle outward: the ends are where curves meet.
            let middle = curve.spots.len() / 2;
            let mut order: Vec<usize> = (0..curve.spots.len()).collect();
            order.sort_by_key(|&at| at.abs_diff(middle));
            let spots = order.iter().map(|&at| place(&curve.spots[at]));
            for spot in spots {
                if self.label(curve.method, spot, TEXT, color, frame, taken) {
                    break;
                }
            }
        }
        for curve in &panel.curves {
            let (color, _) = look(curve.method);
            for spot in &curve.spots {
                self.label(&spot.label, place(spot), SMALL, color, frame, taken);
            }
        }
    }

    /// Puts a text beside a marker if one of eight places is free.
    fn label(
        &mut self,
        text: &str,
        [x, y]: [f64; 2],
        size: f64,
        color: Color,
        frame: Area,
        taken: &mut Vec<Area>,
    ) -> bool {
        let width = strokes::width(text, size);
        let gap = MARKER + 4.0;
        let (above, below, level) = (y - gap, y + gap + 0.7 * size, y + 0.35 * size);
        let (after, before, about) = (x + gap, x - gap - width, x - 0.5 * width);
        let places = [
            [after, level],
            [before, level],
            [about, above],
            [about, below],
            [after, above],
            [before, above],
            [after, below],
            [before, below],
        ];
        for [left, base] in places {
            let area = [left - 1.0, base - 0.8 * size, left + width + 1.0, base + 0.25 * size];
            let inside = frame[0] <= area[0]
                && frame[1] <= area[1]
                && area[2] <= frame[2]
                && area[3] <= frame[3];
            if inside && !taken.iter().any(|other| overlap(&area, other)) {
                taken.push(area);
                self.text([left, base], size, Anchor::Start, color, text);
                return true;
            }
        }
        false
    }
}

/// A time of an axis, milliseconds.
fn time(ms: f64) -> String {
    if ms < 1000.0 { format!("{} ms", tick(ms)) } else { format!("{} s", tick(ms / 1000.0)) }
}

/// A number of an axis without needless zeros.
fn tick(value: f64) -> String {
    let decimals = (-libm::floor(libm::log10(value) + 1e-9)).clamp(0.0, 9.0) as usize;
    format!("{value:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Drawing {
        let spot = |ms: f64, error: f64, dominated| Spot {
            ms,
            error,
            dominated,
            label: format!("{error} px"),
        };
        let panel = || Panel {
            axis: "error (px) <&>",
            floor: 0.01,
            curves: vec![
                Curve {
                    method: "lod",
                    spots: vec![spot(50.0, 0.1, false), spot(20.0, 1.0, false)],
                },
                Curve { method: "exact", spots: vec![spot(200.0, 0.0, false)] },
                Curve { method: "voxel", spots: vec![spot(60.0, 5.0, true)] },
            ],
        };
        draw(&Title { main: "A".into(), sub: "b".into() }, &[panel(), panel()])
    }

    #[test]
    fn every_shape_lies_on_the_paper() {
        let drawing = sample();
        for shape in &drawing.shapes {
            let points = match shape {
                Shape::Line { points, .. } => points.clone(),
                Shape::Polygon { corners, .. } => corners.clone(),
                Shape::Text { at, .. } => vec![*at],
            };
            for [x, y] in points {
                assert!((0.0..=SIZE[0]).contains(&x) && (0.0..=SIZE[1]).contains(&y), "{x} {y}");
            }
        }
    }

    #[test]
    fn both_forms_show_colours_names_and_hollow_markers() {
        let drawing = sample();
        let svg = svg::text(&drawing);
        for word in ["lod", "exact", "voxel", "better", "&lt;&amp;&gt;", "#008a64"] {
            assert!(svg.contains(word), "{word}");
        }
        let picture = pixels::fill(&drawing);
        let count = |color: Color| picture.pixels().chunks_exact(3).filter(|p| *p == color).count();
        let area = SIZE[0] * SIZE[1];
        assert!(count(PAPER) as f64 > 0.8 * area);
        // Filled markers cover more than the rim of a hollow one.
        assert!(count([0, 138, 100]) > 200 && count([201, 76, 0]) > 20);
        assert!(count(INK) > 500, "texts are drawn");
    }

    #[test]
    fn ticks_are_ones_twos_and_fives() {
        let axis = Axis { low: 0.15, high: 12.0 };
        let values: Vec<String> = axis.ticks().iter().map(|(value, _)| tick(*value)).collect();
        assert_eq!(values, ["0.2", "0.5", "1", "2", "5", "10"]);
        assert!((axis.share(0.15), axis.share(12.0)) == (0.0, 1.0));
        assert_eq!(Axis::around([f64::INFINITY].into_iter()).low, 0.1);
    }
}
