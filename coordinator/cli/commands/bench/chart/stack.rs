//! The chart of more workers: speed-up on the left, where the time went on the right.
//!
//! Both panels have a place for each crew. On the left a marker is a crew's speed-up and
//! the grey line one without any loss; on the right a bar is the crew's time, its parts
//! from the bottom in the order of their names.

use super::{
    Anchor, Color, Drawing, FRONT, GREY, GRID, INK, MARKER, PANEL_HEIGHT, PANEL_LEFT, PANEL_TOP,
    PANEL_WIDTH, PAPER, SIZE, SMALL, Shape, TEXT, Title,
};

/// Width of the names to the right of the bars.
const LEGEND_WIDTH: f64 = 130.0;
/// Share of its place that a bar takes.
const BAR_SHARE: f64 = 0.7;
/// A part below this share has no number written into it.
const WRITTEN_SHARE: f64 = 0.04;
/// What a marker is drawn in.
const BLUE: Color = [0, 114, 178];

/// Colours of the parts: those of Okabe and Ito and shades of grey, used again after the
/// last.
const COLORS: [Color; 12] = [
    [0, 138, 100],
    [150, 150, 150],
    [86, 180, 233],
    [0, 114, 178],
    [176, 82, 140],
    [240, 228, 66],
    [120, 94, 240],
    [201, 76, 0],
    [230, 159, 0],
    [150, 0, 40],
    [110, 110, 110],
    [40, 40, 40],
];

/// A crew.
pub struct Crew {
    /// What stands below it.
    pub label: String,
    /// Its speed-up ...
    pub speed_up: f64,
    /// ... and what it would be without any loss.
    pub perfect: f64,
    /// Shares of its time, 0 to 1, as many as there are names.
    pub parts: Vec<f64>,
}

/// Makes the drawing.
pub fn draw(title: &Title, names: &[&str], crews: &[Crew]) -> Drawing {
    let mut drawing = Drawing {
        size: SIZE,
        paper: PAPER,
        shapes: Vec::new(),
        title: format!("{}. {}", title.main, title.sub),
    };
    drawing.text([PANEL_LEFT[0] - 70.0, 50.0], 26.0, Anchor::Start, INK, &title.main);
    drawing.text([PANEL_LEFT[0] - 70.0, 82.0], TEXT, Anchor::Start, GREY, &title.sub);
    speed_up(&mut drawing, crews);
    bars(&mut drawing, names, crews);
    drawing
}

/// The middle of a crew's place, of so many across a width.
fn place(left: f64, width: f64, crews: usize, at: usize) -> f64 {
    left + (at as f64 + 0.5) / crews.max(1) as f64 * width
}

fn speed_up(drawing: &mut Drawing, crews: &[Crew]) {
    let left = PANEL_LEFT[0];
    let (right, bottom) = (left + PANEL_WIDTH, PANEL_TOP + PANEL_HEIGHT);
    let most = crews.iter().flat_map(|crew| [crew.speed_up, crew.perfect]).fold(1.0, f64::max);
    let y = |value: f64| bottom - (value / (1.1 * most)).clamp(0.0, 1.0) * PANEL_HEIGHT;
    let step = libm::ceil(most / 8.0).max(0.5);
    let ticks = (0..=16).map(|n| f64::from(n) * step).take_while(|&value| value <= 1.1 * most);
    for value in ticks {
        drawing.line(vec![[left, y(value)], [right, y(value)]], 0.7, GRID);
        let text = format!("{value}");
        drawing.text([left - 8.0, y(value) + 4.0], SMALL, Anchor::End, INK, &text);
    }
    drawing.line(vec![[left, PANEL_TOP], [left, bottom], [right, bottom]], 1.4, INK);
    let x = |at: usize| place(left, PANEL_WIDTH, crews.len(), at);
    for (at, crew) in crews.iter().enumerate() {
        let (from, to) = (x(at) - 30.0, x(at) + 30.0);
        drawing.line(vec![[from, y(crew.perfect)], [to, y(crew.perfect)]], 3.0, FRONT);
        let corners = [[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]];
        let corner = |c: &[f64; 2]| [x(at) + c[0] * MARKER, y(crew.speed_up) + c[1] * MARKER];
        let corners = corners.iter().map(corner).collect();
        drawing.shapes.push(Shape::Polygon { corners, fill: BLUE, edge: BLUE, width: 1.8 });
        let text = format!("{:.2}", crew.speed_up);
        drawing.text([x(at), y(crew.speed_up) + 26.0], SMALL, Anchor::Middle, BLUE, &text);
        drawing.text([x(at), bottom + 20.0], SMALL, Anchor::Middle, INK, &crew.label);
    }
    let middle = [left + PANEL_WIDTH / 2.0, bottom + 46.0];
    drawing.text(middle, TEXT, Anchor::Middle, INK, "worker processes");
    let text = "speed-up (grey: without loss, as far as there are cores)".to_owned();
    let at = [left - 58.0, PANEL_TOP + PANEL_HEIGHT / 2.0];
    let (anchor, color) = (Anchor::Middle, INK);
    drawing.shapes.push(Shape::Text { at, size: TEXT, anchor, upright: true, color, text });
}

fn bars(drawing: &mut Drawing, names: &[&str], crews: &[Crew]) {
    let (left, width) = (PANEL_LEFT[1], PANEL_WIDTH - LEGEND_WIDTH);
    let bottom = PANEL_TOP + PANEL_HEIGHT;
    let half = 0.5 * BAR_SHARE * width / crews.len().max(1) as f64;
    for (at, crew) in crews.iter().enumerate() {
        let x = place(left, width, crews.len(), at);
        let mut base = 0.0;
        for (part, fill) in crew.parts.iter().zip(COLORS.iter().cycle()) {
            let share = part.clamp(0.0, 1.0 - base);
            let (low, high) =
                (bottom - base * PANEL_HEIGHT, bottom - (base + share) * PANEL_HEIGHT);
            base += share;
            if share <= 0.0 {
                continue;
            }
            let corners =
                vec![[x - half, high], [x + half, high], [x + half, low], [x - half, low]];
            drawing.shapes.push(Shape::Polygon { corners, fill: *fill, edge: PAPER, width: 0.6 });
            if share >= WRITTEN_SHARE {
                let text = format!("{:.0}", 100.0 * share);
                drawing.text([x, 0.5 * (low + high) + 4.0], SMALL, Anchor::Middle, PAPER, &text);
            }
        }
        drawing.text([x, bottom + 20.0], SMALL, Anchor::Middle, INK, &crew.label);
    }
    for (at, (name, fill)) in names.iter().zip(COLORS.iter().cycle()).enumerate() {
        let (x, y) = (left + width + 16.0, bottom - 26.0 * at as f64 - 16.0);
        let corners = vec![[x, y - 12.0], [x + 14.0, y - 12.0], [x + 14.0, y + 2.0], [x, y + 2.0]];
        drawing.shapes.push(Shape::Polygon { corners, fill: *fill, edge: PAPER, width: 0.6 });
        drawing.text([x + 22.0, y], SMALL, Anchor::Start, INK, name);
    }
    drawing.line(vec![[left, bottom], [left + width, bottom]], 1.4, INK);
    let middle = [left + width / 2.0, bottom + 46.0];
    drawing.text(middle, TEXT, Anchor::Middle, INK, "where the workers' time went (%)");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bar_is_as_high_as_its_parts_and_nothing_leaves_the_paper() {
        let crew = |parts: Vec<f64>| Crew { label: "2".into(), speed_up: 1.9, perfect: 2.0, parts };
        let title = Title { main: "A".into(), sub: "b".into() };
        let crews = [crew(vec![0.75, 0.25]), crew(vec![1.5, -0.5])];
        let drawing = draw(&title, &["render", "tail"], &crews);
        let mut areas = Vec::new();
        for shape in &drawing.shapes {
            let points = match shape {
                Shape::Line { points, .. } => points.clone(),
                Shape::Polygon { corners, fill, .. } => {
                    if *fill == COLORS[0] || *fill == COLORS[1] {
                        areas.push(corners[2][1] - corners[0][1]);
                    }
                    corners.clone()
                }
                Shape::Text { at, .. } => vec![*at],
            };
            for [x, y] in points {
                assert!((0.0..=SIZE[0]).contains(&x) && (0.0..=SIZE[1]).contains(&y), "{x} {y}");
            }
        }
        let bars: Vec<f64> = areas.into_iter().filter(|&height| height > 20.0).collect();
        assert_eq!(bars, [0.75 * PANEL_HEIGHT, 0.25 * PANEL_HEIGHT, PANEL_HEIGHT]);
    }
}
