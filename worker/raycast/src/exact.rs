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

use crate::cell::{first_contact, place_in_cell};
use crate::field::{
    Contact, Field, Ground, Outcome, Stretch, Wanted, corners_in, next_stretch, tile_key,
};
use crate::grid::GridRay;
use crate::path::{Path, Span};
use crate::pyramid::LayerMaxima;
use terrafarm_terrain::layout::{TILE_CELLS, TileKey};
use terrafarm_terrain::tile::{HeightTile, MAXIMA_LEVELS};

/// How far above a block's maximum a ray must stay for the block to be skipped, metres.
/// Rounding in heights and positions is below 1e-8 m; a skip lost to it costs nothing.
const CLEARANCE_M: f64 = 1e-6;
/// Level at which a walk begins. Measured on rough terrain; 3 and 5 are as good.
const FIRST_LEVEL: usize = 4;

/// Casts rays, one after another, and remembers the tile that the last one touched.
pub(crate) struct Exact<'a> {
    field: Field<'a>,
    rays: Vec<(usize, GridRay)>,
    tile: (TileKey, Ground<'a>),
    /// Tiles that were needed but not loaded.
    pub wanted: Wanted,
    /// Blocks and cells looked at.
    pub steps: u64,
}

/// A walk over one stretch.
struct Walk<'w> {
    path: &'w Path,
    ray: GridRay,
    maxima: &'w LayerMaxima,
    layer: usize,
    /// 1 along an axis on which the index of the cell grows, else 0.
    ahead: [i32; 2],
    stretch: Stretch,
    span: Span,
    /// Where the span or the stretch ends, whichever is first.
    limit: f64,
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
    /// Where the ray leaves the block, or the span or the stretch ends.
    u: f64,
    z: f64,
    /// The axis whose line is crossed.
    axis: usize,
    /// The span or the stretch ends before a line is crossed.
    ends: bool,
}

impl<'a> Exact<'a> {
    pub(crate) fn new(field: Field<'a>) -> Self {
        let nowhere = TileKey { layer: u16::MAX, level: 0, tx: 0, ty: 0 };
        Exact {
            field,
            rays: Vec::new(),
            tile: (nowhere, Ground::Void),
            wanted: Wanted::default(),
            steps: 0,
        }
    }

    /// Finds where a ray meets the surface. The caller knows that it does not before
    /// `free_u`.
    pub(crate) fn cast(&mut self, path: &Path, free_u: f64) -> Outcome {
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
            match self.walk(Walk::new(self.field, path, *layer, *ray, stretch, free_u)) {
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

    fn walk(&mut self, mut walk: Walk) -> Outcome {
        let highest = self.field.pyramid.highest();
        let mut finished = true;
        let mut steps = 0;
        while !walk.span.leaves_above(highest) {
            steps += 1;
            let ground = if walk.level < MAXIMA_LEVELS {
                self.ground(walk.layer, walk.cell)
            } else {
                Ground::Void
            };
            let going_on = match ground {
                Ground::Loaded(tile) if walk.level > 0 => {
                    let [bi, bj] =
                        walk.cell.map(|index| (index as usize & (TILE_CELLS - 1)) >> walk.level);
                    walk.pass_or_descend(tile.block_max(walk.level, bi, bj))
                }
                Ground::Loaded(tile) => match walk.contact(tile) {
                    Some(_) if !finished => break,
                    Some(contact) => {
                        self.steps += steps;
                        return Outcome::Hit(contact);
                    }
                    None => walk.pass(walk.exit(0)),
                },
                Ground::Void if walk.level < MAXIMA_LEVELS => walk.pass(walk.exit(walk.level)),
                Ground::Void => {
                    let [bi, bj] = walk.cell.map(|index| index as usize >> walk.level);
                    walk.pass_or_descend(walk.maxima.block_max(walk.level, bi, bj))
                }
                Ground::Absent => {
                    finished = false;
                    self.pass_absent(&mut walk)
                }
            };
            if !going_on {
                break;
            }
        }
        self.steps += steps;
        if finished { Outcome::Miss } else { Outcome::Unfinished }
    }

    /// Goes on behind a tile that is not loaded, if the ray may see what lies there.
    #[cold]
    fn pass_absent(&mut self, walk: &mut Walk) -> bool {
        let key = tile_key(walk.layer, walk.cell);
        self.wanted.add(key);
        let exit = walk.exit(MAXIMA_LEVELS);
        // Below everything that the tile holds, the ray most likely ends in it.
        let lowest = self.field.index().entry(key).map(|entry| f64::from(entry.min));
        if lowest.is_none_or(|lowest| exit.z < lowest) {
            return false;
        }
        walk.level = MAXIMA_LEVELS;
        walk.pass(exit)
    }

    #[inline]
    fn ground(&mut self, layer: usize, cell: [i32; 2]) -> Ground<'a> {
        let key = tile_key(layer, cell);
        if self.tile.0 != key {
            self.tile = (key, self.field.ground(key));
        }
        self.tile.1
    }
}

impl<'w> Walk<'w> {
    #[inline(always)]
    fn new(
        field: Field<'w>,
        path: &'w Path,
        layer: usize,
        ray: GridRay,
        stretch: Stretch,
        free_u: f64,
    ) -> Self {
        let maxima = field.pyramid.layer(layer);
        let u = stretch.start_u.max(free_u);
        let span = path.span_at(u);
        Walk {
            path,
            ray,
            maxima,
            layer,
            ahead: [i32::from(ray.forward[0]), i32::from(ray.forward[1])],
            stretch,
            span,
            limit: stretch.end_u.min(span.end_u),
            cell: [ray.cell_after(0, u), ray.cell_after(1, u)],
            u,
            z: span.z(u),
            level: FIRST_LEVEL.min(maxima.top()),
        }
    }

    /// Where the ray leaves the block of a level that holds the cell.
    #[inline(always)]
    fn exit(&self, level: usize) -> Exit {
        let line_u = |axis: usize| {
            let line = ((self.cell[axis] >> level) + self.ahead[axis]) << level;
            self.ray.line_u(axis, line)
        };
        let (x_u, y_u) = (line_u(0), line_u(1));
        let axis = usize::from(y_u < x_u);
        let line_u = if y_u < x_u { y_u } else { x_u };
        let ends = line_u >= self.limit;
        let u = if ends { self.limit } else { line_u };
        Exit { u, z: self.span.z(u), axis, ends }
    }

    /// Passes the block if the ray clears its maximum, else looks closer.
    #[inline(always)]
    fn pass_or_descend(&mut self, max: f32) -> bool {
        let exit = self.exit(self.level);
        if self.lowest(&exit) > f64::from(max) + CLEARANCE_M {
            self.pass(exit)
        } else {
            self.level -= 1;
            true
        }
    }

    /// A lower bound of the ray's height up to an exit.
    #[inline(always)]
    fn lowest(&self, exit: &Exit) -> f64 {
        let length = exit.u - self.u;
        let end = if exit.z < self.z { exit.z } else { self.z };
        end - 0.25 * self.span.bend * (length * length)
    }

    /// Goes on behind a block of the present level. `false` at the end of the stretch.
    #[inline(always)]
    fn pass(&mut self, exit: Exit) -> bool {
        self.u = exit.u;
        self.z = exit.z;
        if exit.ends {
            return self.next_span(exit.u);
        }
        let (axis, along) = (exit.axis, 1 - exit.axis);
        let before = self.cell[axis];
        // Behind the exit line: the cell that begins there, or the one that ends there.
        let after =
            (((before >> self.level) + self.ahead[axis]) << self.level) - 1 + self.ahead[axis];
        if after < 0 || after >= self.ray.cells[axis] {
            return false;
        }
        if self.level > 0 {
            self.cell[along] = self.ray.cell_after(along, exit.u);
        }
        self.cell[axis] = after;
        if (before ^ after) >> (self.level + 1) != 0 && self.level < self.maxima.top() {
            self.level += 1;
        }
        true
    }

    /// Goes on with the next span. `false` at the end of the stretch.
    #[cold]
    fn next_span(&mut self, u: f64) -> bool {
        if u >= self.stretch.end_u {
            return false;
        }
        self.span = self.path.next_span(&self.span);
        self.limit = self.stretch.end_u.min(self.span.end_u);
        self.cell = [self.ray.cell_after(0, u), self.ray.cell_after(1, u)];
        true
    }

    /// Where the ray meets the cell that it is in, within the present span and stretch.
    #[inline(always)]
    fn contact(&self, tile: &HeightTile) -> Option<Contact> {
        let (ray, cell) = (&self.ray, self.cell);
        let corners = corners_in(tile, cell)?;
        let in_u = |axis| ray.line_u(axis, ray.entry_line(axis, cell[axis]));
        let out_u = |axis| ray.line_u(axis, ray.exit_line(axis, cell[axis]));
        let ([in_x, in_y], [out_x, out_y]) = ([in_u(0), in_u(1)], [out_u(0), out_u(1)]);
        let first = self.stretch.start_u.max(self.span.start_u);
        let last = self.limit;
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
