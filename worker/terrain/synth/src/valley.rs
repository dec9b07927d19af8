//! What water leaves behind: gravel floors and fans in the valleys, lakes behind dams of
//! debris, and the rivers themselves.

use crate::flow::{Flow, NEIGHBOURS};
use crate::grid::Grid;
use crate::noise::smoothstep;
use rayon::prelude::*;

/// Heights after deposition, and how much of each cell is deposit (0..1).
pub(crate) struct Deposit {
    pub heights: Grid,
    pub floor: Grid,
}

/// Fills valleys with what rivers cannot carry away: along each river the floor rises by
/// a thickness that grows with its area, and to both sides of it at a slope that shrinks
/// with the area, which makes fans where side valleys end. `relief` scales thicknesses
/// (1 = 2300 m of relief); `cell_m` is the size of a cell.
pub(crate) fn deposit(heights: &Grid, flow: &Flow, cell_m: f32, relief: f32) -> Deposit {
    let side = heights.side();
    let cell_km2 = cell_m * cell_m * 1e-6;
    let mut surface = heights.clone();
    let values = surface.values_mut();
    for &cell in &flow.order {
        let cell = cell as usize;
        let receiver = flow.receiver[cell] as usize;
        let area_km2 = flow.area[cell] * cell_km2;
        let thickness =
            relief * (13.0 * area_km2.sqrt()).min(125.0) * smoothstep(0.8, 6.0, area_km2);
        let slope = (0.05 / (0.15 + area_km2).sqrt()).clamp(0.004, 0.11);
        let graded = values[receiver] + slope * flow.distance[cell] * cell_m;
        values[cell] = (values[cell] + thickness).max(graded);
        if receiver == cell {
            values[cell] = heights.values()[cell] + thickness;
        }
    }
    let depth = |cell: usize, surface: &Grid| surface.values()[cell] - heights.values()[cell];
    for _ in 0..6 {
        let smooth = surface.smoothed();
        let before = surface.clone();
        surface.values_mut().par_chunks_mut(side).enumerate().for_each(|(y, row)| {
            for (x, value) in row.iter_mut().enumerate() {
                let cell = y * side + x;
                let share = smoothstep(0.0, 6.0, depth(cell, &before));
                *value += share * (smooth.values()[cell] - *value);
            }
        });
    }
    let floor = Grid::from_fn(side, |x, y| smoothstep(0.0, 5.0, depth(y * side + x, &surface)));
    Deposit { heights: surface, floor }
}

/// A place for a lake: the cell of its spillway, its level, and what it would flood.
struct Site {
    spill: u32,
    level: f32,
    flooded: Vec<u32>,
    gap: Vec<u32>,
    score: f32,
}

/// What sort of lake to look for; shares are of all cells of the grid.
struct LakeKind {
    count: usize,
    drains: (f32, f32),
    /// Share flooded, at best.
    size: f32,
    /// Heights of the dam, metres at a relief of 2300 m.
    dams_m: [f32; 3],
}

const KINDS: [LakeKind; 2] = [
    LakeKind { count: 2, drains: (0.012, 0.30), size: 0.0030, dams_m: [35.0, 50.0, 70.0] },
    LakeKind { count: 5, drains: (0.0006, 0.006), size: 0.00028, dams_m: [10.0, 16.0, 24.0] },
];

/// Dams valleys where a short dam makes a good lake. Heights change only where debris
/// is piled up; the lakes show as pits of the new heights.
pub(crate) fn dam(heights: &mut Grid, flow: &Flow, cell_m: f32, relief: f32) {
    let side = heights.side();
    let cells = (side * side) as f32;
    let mut donors = vec![Vec::new(); side * side];
    for &cell in &flow.order {
        let receiver = flow.receiver[cell as usize];
        if receiver != cell {
            donors[receiver as usize].push(cell);
        }
    }
    let mut taken: Vec<u32> = Vec::new();
    for kind in &KINDS {
        let (low, high) = (kind.drains.0 * cells, kind.drains.1 * cells);
        let candidates = (0..side * side).filter(|&cell| {
            let (x, y) = (cell % side, cell / side);
            let margin = side / 12;
            (low..high).contains(&flow.area[cell])
                && (cell % 3 == 0 || side < 200)
                && x.min(y) >= margin
                && x.max(y) + margin < side
        });
        let candidates: Vec<usize> = candidates.collect();
        let sites = candidates.par_iter().flat_map_iter(|&cell| {
            kind.dams_m.iter().filter_map({
                let donors = &donors;
                let heights = &*heights;
                move |&dam_m| site(heights, donors, cell as u32, dam_m * relief, kind.size * cells)
            })
        });
        let mut sites: Vec<Site> = sites.collect();
        sites.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.spill.cmp(&b.spill)));
        let mut built = 0;
        for site in sites {
            let apart = taken.iter().all(|&other| {
                let dx = (other as usize % side).abs_diff(site.spill as usize % side);
                let dy = (other as usize / side).abs_diff(site.spill as usize / side);
                dx.max(dy) > side / 7
            });
            if built < kind.count && apart {
                pile_up(heights, &site, cell_m);
                taken.push(site.spill);
                built += 1;
            }
        }
    }
}

/// What a dam at a cell would flood, and how good a lake that makes; `None` for a puddle
/// or a flood.
fn site(heights: &Grid, donors: &[Vec<u32>], spill: u32, dam_m: f32, wanted: f32) -> Option<Site> {
    let side = heights.side();
    let values = heights.values();
    let level = values[spill as usize] + dam_m;
    let limit = (wanted * 2.5) as usize + 8;
    let mut flooded = vec![];
    let mut front = vec![spill];
    while let Some(cell) = front.pop() {
        for &donor in &donors[cell as usize] {
            if values[donor as usize] < level {
                flooded.push(donor);
                front.push(donor);
            }
        }
        if flooded.len() > limit {
            return None;
        }
    }
    if (flooded.len() as f32) < 0.25 * wanted || flooded.len() < 6 {
        return None;
    }
    flooded.sort_unstable();
    let mut gap = vec![];
    for &cell in &flooded {
        let (x, y) = (cell as usize % side, cell as usize / side);
        for (dx, dy, _) in NEIGHBOURS {
            let (nx, ny) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
            if nx >= side || ny >= side {
                return None;
            }
            let neighbour = (ny * side + nx) as u32;
            let below = values[neighbour as usize] < level + 1.0;
            if below && flooded.binary_search(&neighbour).is_err() {
                gap.push(neighbour);
            }
        }
    }
    gap.sort_unstable();
    gap.dedup();
    let size = flooded.len() as f32 / wanted;
    let score = size.min(1.5) * wanted.sqrt() / (gap.len() as f32 + 3.0);
    Some(Site { spill, level, flooded, gap, score })
}

/// Piles debris into the gap of a site, with a spillway at its cell.
fn pile_up(heights: &mut Grid, site: &Site, cell_m: f32) {
    let side = heights.side();
    let reach = (((site.level - heights.values()[site.spill as usize]) / (0.14 * cell_m)) as isize)
        .clamp(2, 40);
    for &cell in site.gap.iter().chain([&site.spill]) {
        let (x, y) = (cell as usize % side, cell as usize / side);
        let crest = site.level + if cell == site.spill { 0.0 } else { 3.0 };
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let (nx, ny) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
                if nx >= side || ny >= side {
                    continue;
                }
                let target = ny * side + nx;
                if site.flooded.binary_search(&(target as u32)).is_ok() {
                    continue;
                }
                let distance = ((dx * dx + dy * dy) as f32).sqrt() * cell_m;
                let debris = crest - 0.14 * distance;
                let value = &mut heights.values_mut()[target];
                if target as u32 != site.spill || cell == site.spill {
                    *value = value.max(debris);
                }
            }
        }
    }
    heights.values_mut()[site.spill as usize] = site.level;
}

/// Level of the lake over each cell, minus infinity on land. Pits too small or too
/// shallow for a lake are filled.
pub(crate) fn lakes(heights: &mut Grid, flow: &Flow) -> Grid {
    let side = heights.side();
    let mut level = Grid::from_fn(side, |_, _| f32::NEG_INFINITY);
    let smallest = (side * side / 25_000).max(6);
    let wet = |heights: &Grid, cell: usize| flow.filled[cell] - heights.values()[cell] > 0.05;
    let mut seen = vec![false; side * side];
    for start in 0..side * side {
        if seen[start] || !wet(heights, start) {
            continue;
        }
        seen[start] = true;
        let mut lake = vec![start];
        let mut next = 0;
        while let Some(&cell) = lake.get(next) {
            next += 1;
            let (x, y) = (cell % side, cell / side);
            for (dx, dy, _) in NEIGHBOURS {
                let (nx, ny) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
                let neighbour = ny.wrapping_mul(side).wrapping_add(nx);
                if nx < side && ny < side && !seen[neighbour] && wet(heights, neighbour) {
                    seen[neighbour] = true;
                    lake.push(neighbour);
                }
            }
        }
        let top = lake.iter().map(|&cell| flow.filled[cell]).fold(f32::NEG_INFINITY, f32::max);
        let depth = lake.iter().map(|&cell| top - heights.values()[cell]).fold(0.0, f32::max);
        if lake.len() >= smallest && depth >= 4.0 {
            // A level that survives quantisation to 1/32 m unchanged.
            let top = (top * 32.0).floor() / 32.0;
            lake.iter().for_each(|&cell| level.values_mut()[cell] = top);
        }
    }
    // Land rises towards its source everywhere, by a little at least.
    for &cell in &flow.order {
        let cell = cell as usize;
        let receiver = flow.receiver[cell] as usize;
        if level.values()[cell] == f32::NEG_INFINITY && receiver != cell {
            let base = heights.values()[receiver].max(level.values()[receiver]);
            let value = &mut heights.values_mut()[cell];
            *value = value.max(base + 0.02 * flow.distance[cell]);
        }
    }
    level
}

/// The level of each lake carried two cells beyond its shore, but not down its outlet:
/// ground between cells finds its water there.
pub(crate) fn reach_of_lakes(level: &Grid, heights: &Grid) -> Grid {
    let spread = |level: &Grid| {
        Grid::from_fn(level.side(), |x, y| {
            let here = level.at(x as i64, y as i64);
            if here > f32::NEG_INFINITY {
                return here;
            }
            let around = NEIGHBOURS
                .iter()
                .map(|&(dx, dy, _)| level.at(x as i64 + dx as i64, y as i64 + dy as i64));
            let best = around.fold(f32::NEG_INFINITY, f32::max);
            if heights.at(x as i64, y as i64) >= best { best } else { f32::NEG_INFINITY }
        })
    };
    spread(&spread(level))
}

/// One piece of a river: a place, in cells, and where it goes on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Reach {
    pub x: f32,
    pub y: f32,
    /// Width of the water, metres.
    pub width_m: f32,
    /// Width of the gravel bed, metres.
    pub bed_m: f32,
    /// Cell of the next reach downstream.
    pub next: u32,
}

/// The rivers of a terrain, by cell.
pub(crate) struct Rivers {
    reaches: Vec<Reach>,
    /// Index of the reach of each cell; `NO_REACH` where no river starts.
    by_cell: Vec<u32>,
    /// Whether a river may be within reach of a search around the cell.
    near: Vec<bool>,
    side: usize,
}

const NO_REACH: u32 = u32::MAX;
/// Cells to search around a place for a river; also the widest that a bed can be.
const SEARCH: isize = 3;

impl Rivers {
    /// Follows the flow; a river begins where it drains 1 km².
    pub fn new(flow: &Flow, heights: &Grid, cell_m: f32) -> Rivers {
        let side = heights.side();
        let cell_km2 = cell_m * cell_m * 1e-6;
        let source = (1.0 / cell_km2).max(40.0);
        let mut by_cell = vec![NO_REACH; side * side];
        let mut reaches = vec![];
        let mut main_donor = vec![NO_REACH; side * side];
        for &cell in &flow.order {
            let at = cell as usize;
            if flow.area[at] < source {
                continue;
            }
            let receiver = flow.receiver[at] as usize;
            let area_km2 = flow.area[at] * cell_km2;
            let drop = (heights.values()[at] - heights.values()[receiver]).max(0.0);
            let slope = drop / (flow.distance[at] * cell_m);
            let width_m = (2.6 * area_km2.sqrt()).clamp(2.5, 90.0);
            let gentle = smoothstep(0.09, 0.012, slope);
            let bed_m = width_m * (1.5 + 4.5 * gentle);
            by_cell[at] = reaches.len() as u32;
            reaches.push(Reach {
                x: (at % side) as f32,
                y: (at / side) as f32,
                width_m,
                bed_m: bed_m.min(SEARCH as f32 * 1.6 * cell_m),
                next: receiver as u32,
            });
            let donor = &mut main_donor[receiver];
            if *donor == NO_REACH || flow.area[*donor as usize] < flow.area[at] {
                *donor = cell;
            }
        }
        let mut rivers = Rivers { reaches, by_cell, near: vec![], side };
        rivers.smooth(&main_donor);
        rivers.mark_near();
        rivers
    }

    /// Rounds the corners that the grid gave the rivers.
    fn smooth(&mut self, main_donor: &[u32]) {
        let side = self.side;
        for _ in 0..4 {
            let before: Vec<_> = self.reaches.iter().map(|r| (r.x, r.y, r.bed_m)).collect();
            for cell in 0..side * side {
                let index = self.by_cell[cell];
                let donor = main_donor[cell];
                if index == NO_REACH || donor == NO_REACH || donor as usize == cell {
                    continue;
                }
                let down = self.by_cell[self.reaches[index as usize].next as usize];
                let up = self.by_cell[donor as usize];
                let (a, b) = (before[down as usize], before[up as usize]);
                let own = before[index as usize];
                let reach = &mut self.reaches[index as usize];
                reach.x = 0.5 * own.0 + 0.25 * (a.0 + b.0);
                reach.y = 0.5 * own.1 + 0.25 * (a.1 + b.1);
                reach.bed_m = 0.5 * own.2 + 0.25 * (a.2 + b.2);
            }
        }
    }

    fn mark_near(&mut self) {
        let (side, reach) = (self.side, SEARCH + 1);
        let mut near = vec![false; side * side];
        for cell in (0..side * side).filter(|&cell| self.by_cell[cell] != NO_REACH) {
            let (x, y) = ((cell % side) as isize, (cell / side) as isize);
            for ny in (y - reach).max(0)..=(y + reach).min(side as isize - 1) {
                for nx in (x - reach).max(0)..=(x + reach).min(side as isize - 1) {
                    near[ny as usize * side + nx as usize] = true;
                }
            }
        }
        self.near = near;
    }

    /// The river nearest to a place in cells, in units of its bed's half width: signed
    /// distance across (left positive) in cells, and the reach. `None` where there is
    /// none within reach.
    pub fn nearest(&self, x: f32, y: f32) -> Option<(f32, Reach)> {
        let last = self.side as isize - 1;
        let cell_x = ((x + 0.5) as isize).clamp(0, last);
        let cell_y = ((y + 0.5) as isize).clamp(0, last);
        if !self.near[cell_y as usize * self.side + cell_x as usize] {
            return None;
        }
        let mut best: Option<(f32, f32, Reach)> = None;
        for ny in (cell_y - SEARCH).max(0)..=(cell_y + SEARCH).min(last) {
            for nx in (cell_x - SEARCH).max(0)..=(cell_x + SEARCH).min(last) {
                let index = self.by_cell[ny as usize * self.side + nx as usize];
                if index == NO_REACH {
                    continue;
                }
                let from = self.reaches[index as usize];
                let next = self.by_cell[from.next as usize];
                if next == NO_REACH {
                    continue;
                }
                let to = self.reaches[next as usize];
                let (dx, dy) = (to.x - from.x, to.y - from.y);
                let (px, py) = (x - from.x, y - from.y);
                let length2 = (dx * dx + dy * dy).max(1e-6);
                let along = ((px * dx + py * dy) / length2).clamp(0.0, 1.0);
                let (ox, oy) = (px - along * dx, py - along * dy);
                let distance = (ox * ox + oy * oy).sqrt();
                let rank = distance / from.bed_m;
                if best.is_none_or(|(least, ..)| rank < least) {
                    let left = dx * py - dy * px;
                    let signed = if left < 0.0 { -distance } else { distance };
                    best = Some((rank, signed, from));
                }
            }
        }
        best.map(|(_, signed, reach)| (signed, reach))
    }
}
