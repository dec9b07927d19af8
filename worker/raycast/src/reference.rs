//! The `reference` method: every cell on the ray's way, one after the other.
//!
//! The slow twin of `exact`, kept so plain that it can be checked by reading. All lines
//! of all layers that the ray crosses are listed and sorted. Between two neighbours in
//! that list the ray is over a single cell of a single layer; there the height of the
//! ray above the surface is looked at where it can be least, and a bisection finds the
//! contact. The only things shared with `exact` are the path of the ray and the
//! expression for where it crosses a line; a difference in either would be a difference
//! of definition, not a mistake.

use crate::cell::Corners;
use crate::field::{Contact, Field, Ground, Outcome, Wanted, tile_key};
use crate::grid::GridRay;
use crate::path::{Path, Span};
use terrafarm_terrain::layout::TILE_CELLS;

/// Halvings of an interval that holds a contact: enough to reach neighbouring numbers.
const BISECTIONS: u32 = 80;

/// What happens at a value of u.
#[derive(Clone, Copy)]
enum Event {
    /// The line of an axis of the grid of a ray is crossed.
    Line { ray: usize, axis: usize, line: i32 },
    /// A span of the path ends, or the ray starts or ends.
    Joint,
}

/// Casts rays one cell at a time.
pub(crate) struct Reference<'a> {
    field: Field<'a>,
    rays: Vec<(usize, GridRay)>,
    events: Vec<(f64, Event)>,
    /// Tiles that were needed but not loaded.
    pub wanted: Wanted,
    /// Cells looked at.
    pub steps: u64,
}

impl<'a> Reference<'a> {
    pub(crate) fn new(field: Field<'a>) -> Self {
        Reference {
            field,
            rays: Vec::new(),
            events: Vec::new(),
            wanted: Wanted::default(),
            steps: 0,
        }
    }

    /// Finds where a ray meets the surface.
    pub(crate) fn cast(&mut self, path: &Path) -> Outcome {
        let mut rays = std::mem::take(&mut self.rays);
        self.field.grid_rays(path, &mut rays);
        self.list_events(path, &rays);
        let outcome = self.follow(path, &rays);
        self.rays = rays;
        outcome
    }

    fn list_events(&mut self, path: &Path, rays: &[(usize, GridRay)]) {
        self.events.clear();
        let over = |ray: &GridRay| ray.enter_u < ray.exit_u;
        let end = rays.iter().filter(|(_, ray)| over(ray)).map(|(_, ray)| ray.exit_u);
        let end = end.fold(0.0, f64::max);
        for (number, (_, ray)) in rays.iter().enumerate().filter(|(_, (_, ray))| over(ray)) {
            for axis in 0..2 {
                for line in 0..=ray.cells[axis] {
                    let line = if ray.forward[axis] { line } else { ray.cells[axis] - line };
                    let u = ray.line_u(axis, line);
                    if u >= 0.0 && u <= end {
                        self.events.push((u, Event::Line { ray: number, axis, line }));
                    }
                }
            }
        }
        let mut span = path.span(0);
        while span.end_u < end {
            self.events.push((span.end_u, Event::Joint));
            span = path.next_span(&span);
        }
        self.events.push((0.0, Event::Joint));
        self.events.push((end, Event::Joint));
        self.events.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    }

    fn follow(&mut self, path: &Path, rays: &[(usize, GridRay)]) -> Outcome {
        let mut cells: Vec<[i64; 2]> = rays.iter().map(|(_, ray)| first_cell(ray)).collect();
        let mut outcome = Outcome::Miss;
        for at in 0..self.events.len() {
            let (u0, event) = self.events[at];
            if let Event::Line { ray, axis, line } = event {
                let back = i64::from(!rays[ray].1.forward[axis]);
                cells[ray][axis] = i64::from(line) - back;
            }
            let Some(&(u1, _)) = self.events.get(at + 1) else { break };
            if u0 >= u1 {
                continue;
            }
            let owner = rays.iter().rposition(|(_, ray)| ray.enter_u <= u0 && u1 <= ray.exit_u);
            let Some(owner) = owner else { continue };
            let (layer, ray) = &rays[owner];
            let cell = cells[owner].map(|index| index as i32);
            self.steps += 1;
            match self.field.ground(tile_key(*layer, cell)) {
                Ground::Void => {}
                Ground::Absent => {
                    self.wanted.add(tile_key(*layer, cell));
                    outcome = Outcome::Unfinished;
                }
                Ground::Loaded(tile) => {
                    let [i, j] = cell.map(|index| index as usize % TILE_CELLS);
                    let posts = tile.corners(i, j);
                    let piece =
                        Piece { ray, cell, posts: posts.map(f64::from), span: path.span_at(u0) };
                    let Some(u) = piece.first_contact(u0, u1) else { continue };
                    if matches!(outcome, Outcome::Unfinished) {
                        break;
                    }
                    return piece.contact(*layer, posts, u);
                }
            }
        }
        outcome
    }
}

/// The cell that holds the start of a ray, as the grid's rule for lines has it.
fn first_cell(ray: &GridRay) -> [i64; 2] {
    [0, 1].map(|axis| {
        let last = i64::from(ray.cells[axis]);
        let index = ray.start[axis].floor() as i64;
        if ray.start[axis] == last as f64 { last - 1 } else { index }
    })
}

/// A part of a ray within one cell.
struct Piece<'p> {
    ray: &'p GridRay,
    cell: [i32; 2],
    posts: [f64; 4],
    span: Span,
}

impl Piece<'_> {
    /// Height of the ray above the surface. NaN in a cell that has none.
    fn gap(&self, u: f64) -> f64 {
        let [x, y] = self.place(u);
        let [sw, se, nw, ne] = self.posts;
        let surface = (1.0 - y) * ((1.0 - x) * sw + x * se) + y * ((1.0 - x) * nw + x * ne);
        self.span.z(u) - surface
    }

    fn place(&self, u: f64) -> [f64; 2] {
        [0, 1].map(|axis| {
            let position = self.ray.start[axis] + u * self.ray.rate[axis];
            (position - f64::from(self.cell[axis])).clamp(0.0, 1.0)
        })
    }

    fn first_contact(&self, u0: f64, u1: f64) -> Option<f64> {
        let (start, end) = (self.gap(u0), self.gap(u1));
        if start.is_nan() || start <= 0.0 {
            return start.is_finite().then_some(u0);
        }
        let below = if end <= 0.0 { Some(u1) } else { self.dip(u0, u1) };
        let (mut above, mut below) = (u0, below?);
        for _ in 0..BISECTIONS {
            let middle = 0.5 * (above + below);
            if self.gap(middle) <= 0.0 {
                below = middle;
            } else {
                above = middle;
            }
        }
        Some(below)
    }

    /// The lowest point between two ends that are above the surface, if it is not. The
    /// gap is a quadratic: three values give it.
    fn dip(&self, u0: f64, u1: f64) -> Option<f64> {
        let (g0, g1) = (self.gap(u0), self.gap(u1));
        let middle = self.gap(0.5 * (u0 + u1));
        let square = 2.0 * (g0 + g1 - 2.0 * middle);
        let linear = g1 - g0 - square;
        let lowest = -linear / (2.0 * square);
        if square > 0.0 && lowest > 0.0 && lowest < 1.0 {
            let u = u0 + lowest * (u1 - u0);
            return (self.gap(u) <= 0.0).then_some(u);
        }
        None
    }

    fn contact(&self, layer: usize, posts: [f32; 4], u: f64) -> Outcome {
        let Some(corners) = Corners::new(posts) else { return Outcome::Miss };
        let place = self.place(u);
        Outcome::Hit(Contact { layer, cell: self.cell, u, z: self.span.z(u), place, corners })
    }
}
