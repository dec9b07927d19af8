//! How a frame is divided, and what each part of it is expected to cost.
//!
//! A frame is a row of *atoms*, the smallest things that can be a job: strips of 8
//! columns, or whole tiles. A job is a run of strips or one tile. What an atom costs is
//! learned from the nearest frame in which it was rendered.

use terrafarm_common::id::FrameIndex;
use terrafarm_common::region::{Region, Split};

/// Width of the narrowest column job, pixels: 24 bytes of a row, and a whole lane group
/// of the kernels.
const STRIP_PX: u32 = 8;

/// What a pixel is expected to cost before anything is known, cost units. One unit is
/// what an average thread of the farm does in a microsecond.
const PRIOR_COST_PER_PX: f64 = 1.0;

/// How much of what is known about the level of costs is kept when a job comes in.
const LEVEL_MEMORY: f64 = 0.95;

/// The division of the frames of one shot.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Grid {
    width: u32,
    height: u32,
    split: Split,
}

impl Grid {
    /// Sides are at least 1 and at most [`terrafarm_common::camera::MAX_SIDE_PX`]; so is
    /// the side of a tile.
    pub(crate) fn new(width: u32, height: u32, split: Split) -> Self {
        Grid { width, height, split }
    }

    /// Number of atoms of a frame.
    pub(crate) fn atoms(&self) -> u32 {
        match self.split {
            Split::Columns => self.width.div_ceil(STRIP_PX),
            Split::Tiles(side) => self.width.div_ceil(side) * self.height.div_ceil(side),
        }
    }

    /// Whether several atoms can make one job.
    pub(crate) fn joins(&self) -> bool {
        self.split == Split::Columns
    }

    /// The pixels of a run of atoms; of the first one only if they do not join.
    pub(crate) fn region(&self, start: u32, end: u32) -> Region {
        match self.split {
            Split::Columns => {
                let left = start * STRIP_PX;
                let right = (end * STRIP_PX).min(self.width);
                Region { x: left, y: 0, width: right - left, height: self.height }
            }
            Split::Tiles(side) => {
                let across = self.width.div_ceil(side);
                let (x, y) = (start % across * side, start / across * side);
                let (width, height) = (side.min(self.width - x), side.min(self.height - y));
                Region { x, y, width, height }
            }
        }
    }

    /// Pixels of one atom.
    fn area(&self, atom: u32) -> u64 {
        self.region(atom, atom + 1).area()
    }
}

/// The expected cost of every atom of the next frame, cost units.
#[derive(Debug)]
pub(crate) struct CostMap {
    grid: Grid,
    /// Cost of each atom and the frame it was measured in; empty until the first result.
    atoms: Vec<Option<(FrameIndex, f64)>>,
    /// Decaying sums of cost and pixels: the level for atoms not yet measured.
    level: (f64, f64),
}

impl CostMap {
    /// Everything costs the same as far as is known.
    pub(crate) fn new(grid: Grid) -> Self {
        CostMap { grid, atoms: Vec::new(), level: (0.0, 0.0) }
    }

    /// Whether any result has come in.
    pub(crate) fn is_measured(&self) -> bool {
        !self.atoms.is_empty()
    }

    /// Expected cost of an atom, more than 0.
    pub(crate) fn atom(&self, atom: u32) -> f64 {
        match self.atoms.get(atom as usize) {
            Some(Some((_, cost))) => *cost,
            _ => self.grid.area(atom) as f64 * self.level_per_px(),
        }
    }

    /// Expected cost of a run of atoms.
    pub(crate) fn run(&self, start: u32, end: u32) -> f64 {
        (start..end).map(|atom| self.atom(atom)).sum()
    }

    fn level_per_px(&self) -> f64 {
        if self.is_measured() { self.level.0 / self.level.1 } else { PRIOR_COST_PER_PX }
    }

    /// Takes in what a run of atoms did cost. Inside the run the shape known before is
    /// kept; where nearer frames have reported already, they are believed.
    pub(crate) fn learn(&mut self, frame: FrameIndex, start: u32, end: u32, cost: f64) {
        let scale = cost.max(f64::MIN_POSITIVE) / self.run(start, end);
        let learned: Vec<f64> = (start..end).map(|atom| self.atom(atom) * scale).collect();
        if self.atoms.is_empty() {
            self.atoms = vec![None; self.grid.atoms() as usize];
        }
        for (slot, cost) in self.atoms[start as usize..end as usize].iter_mut().zip(learned) {
            if slot.is_none_or(|(measured_in, _)| measured_in <= frame) {
                *slot = Some((frame, cost.clamp(1e-3, 1e12)));
            }
        }
        let area: u64 = (start..end).map(|atom| self.grid.area(atom)).sum();
        self.level.0 = self.level.0 * LEVEL_MEMORY + cost.clamp(1e-3, 1e12);
        self.level.1 = self.level.1 * LEVEL_MEMORY + area as f64;
    }

    /// The atoms in the order in which they are best begun: strips from the left, so that
    /// neighbours make one job; tiles with the costly ones first, so that the last jobs of
    /// a frame are short.
    pub(crate) fn order(&self) -> Vec<u32> {
        let mut order: Vec<u32> = (0..self.grid.atoms()).collect();
        if !self.grid.joins() {
            order.sort_by(|&a, &b| self.atom(b).total_cmp(&self.atom(a)).then(a.cmp(&b)));
        }
        order
    }

    /// Where a job that begins at `start` ends, for a cost of about `target` and at most
    /// `max_px` pixels, in a run of strips that ends at `end`. The run is shared out
    /// evenly, so that no sliver stays behind. Tiles are jobs of their own.
    pub(crate) fn cut(&self, start: u32, end: u32, target: f64, max_px: u64) -> u32 {
        if !self.grid.joins() {
            return start + 1;
        }
        let strips = max_px / (u64::from(STRIP_PX) * u64::from(self.grid.height));
        let last_allowed =
            start.saturating_add(u32::try_from(strips.max(1)).unwrap_or(u32::MAX)).min(end);
        let rest = self.run(start, end);
        let pieces = (rest / target.max(f64::MIN_POSITIVE)).ceil().max(1.0);
        let goal = rest / pieces;
        let mut sum = self.atom(start);
        let mut cut = start + 1;
        while cut < last_allowed {
            let next = self.atom(cut);
            if pieces > 1.0 && sum + 0.5 * next > goal {
                break;
            }
            sum += next;
            cut += 1;
        }
        cut
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_split() -> impl Strategy<Value = Split> {
        prop_oneof![Just(Split::Columns), (1u32..90).prop_map(Split::Tiles)]
    }

    proptest! {
        #[test]
        fn atoms_cover_every_pixel_once(w in 1u32..300, h in 1u32..80, split in any_split()) {
            let grid = Grid::new(w, h, split);
            let mut seen = vec![0u8; (w * h) as usize];
            for atom in 0..grid.atoms() {
                let region = grid.region(atom, atom + 1);
                prop_assert!(region.fits(w, h));
                for y in region.y..region.y + region.height {
                    for x in region.x..region.x + region.width {
                        seen[(y * w + x) as usize] += 1;
                    }
                }
            }
            prop_assert!(seen.iter().all(|&count| count == 1));
        }

        #[test]
        fn a_cut_advances_and_keeps_to_its_limits(
            w in 1u32..3000, h in 1u32..300, target in 1e-9..1e9f64, max_px in 1u64..1_000_000,
            start_share in 0.0..1.0f64, costs in prop::collection::vec(0.0..1e6f64, 1..20),
        ) {
            let grid = Grid::new(w, h, Split::Columns);
            let mut map = CostMap::new(grid);
            for (i, cost) in costs.into_iter().enumerate() {
                let at = i as u32 % grid.atoms();
                map.learn(i as u32, at, at + 1, cost);
            }
            let start = (f64::from(grid.atoms()) * start_share) as u32;
            let cut = map.cut(start, grid.atoms(), target, max_px);
            prop_assert!(cut > start && cut <= grid.atoms());
            prop_assert!(cut == start + 1 || grid.region(start, cut).area() <= max_px);
        }

        #[test]
        fn the_map_stays_positive_whatever_is_learned(costs in prop::collection::vec(any::<f64>(), 1..50)) {
            let grid = Grid::new(64, 10, Split::Columns);
            let mut map = CostMap::new(grid);
            for (i, cost) in costs.into_iter().enumerate() {
                let cost = if cost.is_finite() { cost.abs() } else { 0.0 };
                map.learn(i as u32, i as u32 % 8, 8, cost);
                prop_assert!((0..8).all(|atom| map.atom(atom) > 0.0 && map.atom(atom).is_finite()));
            }
        }
    }

    #[test]
    fn jobs_are_narrow_where_the_picture_is_costly() {
        let grid = Grid::new(160, 10, Split::Columns);
        let mut map = CostMap::new(grid);
        map.learn(0, 0, 10, 1000.0);
        map.learn(0, 10, 20, 9000.0);
        assert_eq!(map.cut(0, 20, 1000.0, u64::MAX), 10);
        assert_eq!(map.cut(10, 20, 1000.0, u64::MAX), 11);
    }

    #[test]
    fn a_result_of_an_older_frame_does_not_replace_a_newer_one() {
        let mut map = CostMap::new(Grid::new(16, 10, Split::Columns));
        map.learn(5, 0, 1, 70.0);
        map.learn(3, 0, 1, 10.0);
        assert!((map.atom(0) - 70.0).abs() < 1e-9);
    }

    #[test]
    fn costly_tiles_come_first() {
        let mut map = CostMap::new(Grid::new(40, 20, Split::Tiles(20)));
        assert_eq!(map.order(), [0, 1]);
        map.learn(0, 0, 1, 1.0);
        map.learn(0, 1, 2, 2.0);
        assert_eq!(map.order(), [1, 0]);
    }
}
