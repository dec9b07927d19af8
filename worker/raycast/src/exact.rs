//! The `exact` method: a walk over blocks of cells that passes by what the ray clears.
//!
//! ```text
//! level <- first guess; cell <- the one at the start
//! loop
//!   block <- the block of `level` that holds the cell
//!   if the ray stays above the block's maximum until it leaves it
//!     go to the cell behind the block; one level up if that lies in another parent
//!   else if level > 0
//!     one level down
//!   else
//!     test the cell; stop at a contact; else go to the next cell
//! ```
//!
//! Skipping compares a lower bound of the ray with the maximum of the block and asks for
//! [`CLEARANCE_M`] between them, far more than all rounding; so it can leave out only
//! cells whose own test would have found nothing, and a contact is a function of the ray
//! and of the cell that it lies in.

mod abreast;
mod arc;
mod many;
mod nearby;
mod rays;
mod tiles;
mod window;

pub(crate) use arc::Globe;
pub(crate) use many::Many;
pub(crate) use tiles::Tiles;

use crate::cell::{first_contact, place_in_cell};
use crate::field::{
    Contact, Cursor, Field, Ground, Outcome, Stretch, Wanted, corners_in, next_stretch, tile_key,
};
use crate::grid::GridRay;
use crate::path::{Path, Span};
use crate::pyramid::LayerMaxima;
use terrafarm_terrain::layout::TILE_CELLS;
use terrafarm_terrain::tile::{HeightTile, MAXIMA_LEVELS};

/// How far above a block's maximum a ray must stay for the block to be skipped, metres.
/// Rounding in heights and positions is below 1e-8 m; a skip lost to it costs nothing.
const CLEARANCE_M: f64 = 1e-6;
/// Level at which a walk begins, and the blocks of an approach. Measured with
/// `examples/bench.rs`: beams come close to the ground, and 4 takes a quarter longer over a
/// steep view. Abreast, where most of those that have to walk pass far over the ground, 0 takes
/// a twentieth longer over a low view.
const FIRST_LEVEL: usize = 2;

/// Casts rays, one after another.
pub(crate) struct Exact<'a> {
    field: Field<'a>,
    rays: Vec<(usize, GridRay)>,
    tiles: Cursor<'a>,
    /// Tiles that were needed but not loaded.
    pub wanted: Wanted,
    /// Blocks and cells looked at.
    pub steps: u64,
}

/// A ray within one span and one stretch: what stays the same from step to step.
struct Course<'c> {
    ray: &'c GridRay,
    layer: usize,
    top: usize,
    /// 1 along an axis on which the index of the cell grows, else 0.
    ahead: [i32; 2],
    span: Span,
    /// Where the span or the stretch begins, whichever is last ...
    first: f64,
    /// ... and where one of them ends.
    last: f64,
}

/// How far a walk has come.
#[derive(Clone, Copy)]
struct Front {
    cell: [i32; 2],
    /// How far the ray is known to be free ...
    u: f64,
    /// ... and its height there.
    z: f64,
    level: usize,
}

/// The end of the way through a block.
#[derive(Clone, Copy)]
struct Exit {
    /// Where the ray leaves the block, or the course ends.
    u: f64,
    z: f64,
    /// The axis whose line is crossed.
    axis: usize,
    /// The course ends before a line is crossed.
    ends: bool,
}

/// Why a walk pauses.
enum Halt {
    Contact(Contact),
    /// It comes to another tile, or has climbed above the tiles.
    Tile,
    /// It leaves the layer.
    Edge,
    /// The course ends.
    End,
}

impl<'a> Exact<'a> {
    pub(crate) fn new(field: Field<'a>) -> Self {
        Exact {
            field,
            rays: Vec::new(),
            tiles: Cursor::new(field),
            wanted: Wanted::default(),
            steps: 0,
        }
    }

    /// Finds where a ray meets the surface. The caller knows that it does not before
    /// `free_u`.
    pub(crate) fn cast(&mut self, path: &Path, free_u: f64) -> Outcome {
        if free_u == f64::INFINITY {
            return Outcome::Miss;
        }
        let mut rays = std::mem::take(&mut self.rays);
        self.field.grid_rays(path, &mut rays);
        let mut finished = true;
        let mut outcome = Outcome::Miss;
        let mut u = 0.0;
        while let Some(stretch) = next_stretch(&rays, u) {
            u = stretch.end_u;
            if stretch.end_u <= free_u {
                continue;
            }
            let (layer, ray) = &rays[stretch.ray];
            match self.walk(path, *layer, ray, stretch, free_u) {
                Outcome::Miss => {}
                Outcome::Unfinished => finished = false,
                hit => {
                    outcome = hit;
                    break;
                }
            }
        }
        self.rays = rays;
        if finished { outcome } else { Outcome::Unfinished }
    }

    fn walk(
        &mut self,
        path: &Path,
        layer: usize,
        ray: &GridRay,
        stretch: Stretch,
        free_u: f64,
    ) -> Outcome {
        let maxima = self.field.pyramid.layer(layer);
        let highest = self.field.pyramid.highest();
        let u = stretch.start_u.max(free_u);
        let mut course = Course::new(layer, ray, maxima.top(), path.span_at(u), stretch);
        let mut front = course.front(u, FIRST_LEVEL);
        let mut finished = true;
        while !course.span.leaves_above(highest) {
            let halt = if front.level >= MAXIMA_LEVELS {
                course.cross_tiles(maxima, &mut front, &mut self.steps)
            } else {
                match self.tiles.ground(tile_key(layer, front.cell)) {
                    Ground::Loaded(tile) => course.cross_tile(tile, &mut front, &mut self.steps),
                    Ground::Void => {
                        let exit = course.exit(&front, front.level);
                        course.pass(&mut front, exit)
                    }
                    Ground::Absent => {
                        finished = false;
                        Some(self.pass_absent(&course, &mut front))
                    }
                }
                .unwrap_or(Halt::Tile)
            };
            match halt {
                Halt::Contact(contact) if finished => return Outcome::Hit(contact),
                Halt::Tile => {}
                Halt::End if course.last < stretch.end_u => {
                    course = Course::new(
                        layer,
                        ray,
                        maxima.top(),
                        path.next_span(&course.span),
                        stretch,
                    );
                    front = course.front(front.u, front.level);
                }
                Halt::Contact(_) | Halt::Edge | Halt::End => break,
            }
        }
        if finished { Outcome::Miss } else { Outcome::Unfinished }
    }

    /// Goes on behind a tile that is not loaded, if the ray may see what lies there.
    #[cold]
    fn pass_absent(&mut self, course: &Course, front: &mut Front) -> Halt {
        let key = tile_key(course.layer, front.cell);
        self.steps += 1;
        self.wanted.add(key);
        let exit = course.exit(front, MAXIMA_LEVELS);
        // Below everything that the tile holds, the ray most likely ends in it.
        let lowest = self.field.index().entry(key).map(|entry| f64::from(entry.min));
        if lowest.is_none_or(|lowest| exit.z < lowest) {
            return Halt::Edge;
        }
        front.level = MAXIMA_LEVELS;
        course.pass(front, exit).unwrap_or(Halt::Tile)
    }
}

impl<'c> Course<'c> {
    fn new(layer: usize, ray: &'c GridRay, top: usize, span: Span, stretch: Stretch) -> Self {
        Course {
            ray,
            layer,
            top,
            ahead: [i32::from(ray.forward[0]), i32::from(ray.forward[1])],
            span,
            first: stretch.start_u.max(span.start_u),
            last: stretch.end_u.min(span.end_u),
        }
    }

    /// The beginning of a walk.
    fn front(&self, u: f64, level: usize) -> Front {
        let cell = [self.ray.cell_after(0, u), self.ray.cell_after(1, u)];
        Front { cell, u, z: self.span.z(u), level: level.min(self.top) }
    }

    /// Walks over one tile.
    #[inline(always)]
    fn cross_tile(&self, tile: &HeightTile, place: &mut Front, steps: &mut u64) -> Option<Halt> {
        // Kept apart from `place`, so that it may live in registers.
        let mut front = *place;
        let mut taken = 0;
        let halt = loop {
            taken += 1;
            let exit = self.exit(&front, front.level);
            if front.level > 0 {
                let block =
                    |axis: usize| (front.cell[axis] as usize & (TILE_CELLS - 1)) >> front.level;
                let (bi, bj) = (block(0), block(1));
                if !self.clears(&front, &exit, tile.block_max(front.level, bi, bj)) {
                    front.level -= 1;
                    continue;
                }
            } else if let Some(contact) = self.contact(tile, front.cell) {
                break Some(Halt::Contact(contact));
            }
            let before = front.cell;
            let halt = self.pass(&mut front, exit);
            let other = (before[0] ^ front.cell[0]) | (before[1] ^ front.cell[1]);
            if halt.is_some() || other >> MAXIMA_LEVELS != 0 || front.level == MAXIMA_LEVELS {
                break halt;
            }
        };
        *place = front;
        *steps += taken;
        halt
    }

    /// Walks over whole tiles until one must be looked into.
    fn cross_tiles(&self, maxima: &LayerMaxima, front: &mut Front, steps: &mut u64) -> Halt {
        while front.level >= MAXIMA_LEVELS {
            *steps += 1;
            let [bi, bj] = front.cell.map(|index| index as usize >> front.level);
            let exit = self.exit(front, front.level);
            if !self.clears(front, &exit, maxima.block_max(front.level, bi, bj)) {
                front.level -= 1;
            } else if let Some(halt) = self.pass(front, exit) {
                return halt;
            }
        }
        Halt::Tile
    }

    /// Where the ray leaves the block of a level that holds the cell.
    #[inline(always)]
    fn exit(&self, front: &Front, level: usize) -> Exit {
        let line_u = |axis: usize| {
            let line = ((front.cell[axis] >> level) + self.ahead[axis]) << level;
            self.ray.line_u(axis, line)
        };
        let (x_u, y_u) = (line_u(0), line_u(1));
        let axis = usize::from(y_u < x_u);
        let line_u = if y_u < x_u { y_u } else { x_u };
        let ends = line_u >= self.last;
        let u = if ends { self.last } else { line_u };
        Exit { u, z: self.span.z(u), axis, ends }
    }

    /// Whether the ray stays above a height until it leaves a block.
    #[inline(always)]
    fn clears(&self, front: &Front, exit: &Exit, max: f32) -> bool {
        let length = exit.u - front.u;
        let end = if exit.z < front.z { exit.z } else { front.z };
        end - 0.25 * self.span.bend * (length * length) > f64::from(max) + CLEARANCE_M
    }

    /// Goes on behind a block of the present level.
    #[inline(always)]
    fn pass(&self, front: &mut Front, exit: Exit) -> Option<Halt> {
        front.u = exit.u;
        front.z = exit.z;
        if exit.ends {
            return Some(Halt::End);
        }
        let (axis, along) = (exit.axis, 1 - exit.axis);
        let before = front.cell[axis];
        // Behind the exit line: the cell that begins there, or the one that ends there.
        let line = ((before >> front.level) + self.ahead[axis]) << front.level;
        let after = line - 1 + self.ahead[axis];
        if after < 0 || after >= self.ray.cells[axis] {
            return Some(Halt::Edge);
        }
        if front.level > 0 {
            front.cell[along] = self.ray.cell_after(along, exit.u);
        }
        front.cell[axis] = after;
        if (before ^ after) >> (front.level + 1) != 0 && front.level < self.top {
            front.level += 1;
        }
        None
    }

    /// Where the ray meets a cell, from the first to the last of the course.
    #[inline(always)]
    fn contact(&self, tile: &HeightTile, cell: [i32; 2]) -> Option<Contact> {
        let ray = self.ray;
        let corners = corners_in(tile, cell)?;
        let in_u = |axis| ray.line_u(axis, ray.entry_line(axis, cell[axis]));
        let out_u = |axis| ray.line_u(axis, ray.exit_line(axis, cell[axis]));
        let ([in_x, in_y], [out_x, out_y]) = ([in_u(0), in_u(1)], [out_u(0), out_u(1)]);
        let (first, last) = (self.first, self.last);
        let (in_axis, in_u) = if in_x > in_y { (0, in_x) } else { (1, in_y) };
        let (out_axis, out_u) = if out_x <= out_y { (0, out_x) } else { (1, out_y) };
        let (start_u, end_u) = (in_u.max(first), out_u.min(last));
        if start_u >= end_u {
            return None;
        }
        let start_height = if in_u >= first {
            corners.edge_height(ray, cell, in_axis, !ray.forward[in_axis], in_u)
        } else {
            corners.height_under(ray, cell, first)
        };
        let end_height = if out_u <= last {
            corners.edge_height(ray, cell, out_axis, ray.forward[out_axis], out_u)
        } else {
            corners.height_under(ray, cell, last)
        };
        let length = end_u - start_u;
        let bend = self.span.bend * length * length - corners.bend(ray, length);
        let s = first_contact(
            self.span.z(start_u) - start_height,
            self.span.z(end_u) - end_height,
            bend,
        )?;
        let u = if s >= 1.0 { end_u } else { start_u + s * length };
        Some(Contact {
            layer: self.layer,
            cell,
            u,
            z: self.span.z(u),
            place: place_in_cell(ray, cell, u),
            corners,
        })
    }
}

#[cfg(test)]
mod tests;
