//! Rasters on one grid, read as one.
//!
//! Tiles of a survey share spacing and phase; cut apart they would leave a gap of one
//! cell wherever they do not share a row of samples. So all inputs of one reference
//! system, spacing and phase are put on one lattice and read together: later inputs on
//! top, voids of one filled by another. A geographic lattice whose step divides the full
//! circle is periodic: 180° W and 180° E are the same column.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use terrafarm_geo::Crs;
use terrafarm_raster::info::{Raster, RasterError, Window};

use crate::grid::Affine;

/// Heights beyond this are not terrain, metres.
pub(crate) const MAX_HEIGHT_M: f32 = 100_000.0;
/// How far samples of one mosaic may lie beside its lattice, in samples.
const PHASE_SLACK: f64 = 1e-3;

/// A raster with a place on the map.
#[derive(Clone)]
pub(crate) struct Placed {
    pub(crate) raster: Arc<dyn Raster>,
    pub(crate) crs: Crs,
    /// Of sample centres, in the raster's own order.
    pub(crate) frame: Affine,
    /// Place in the user's list; later ones lie on top.
    pub(crate) rank: usize,
}

impl Placed {
    pub(crate) fn size(&self) -> [u64; 2] {
        let info = self.raster.info();
        [info.width, info.height]
    }
}

/// Rasters on one lattice.
pub(crate) struct Mosaic {
    pub(crate) crs: Crs,
    /// Position of lattice columns and rows.
    pub(crate) frame: Affine,
    /// Columns around the whole Earth, if the lattice closes.
    period: Option<i64>,
    /// Topmost first.
    members: Vec<Member>,
    /// First column and row, and those after the last.
    pub(crate) extent: [i64; 4],
    /// Rank of the topmost member.
    pub(crate) rank: usize,
    /// Whether heights beyond [`MAX_HEIGHT_M`] were met.
    wild: AtomicBool,
}

struct Member {
    placed: Placed,
    column: i64,
    row: i64,
}

impl Mosaic {
    /// Sorts rasters into mosaics, the one with the topmost raster last.
    pub(crate) fn group(rasters: Vec<Placed>) -> Vec<Mosaic> {
        let mut mosaics: Vec<Mosaic> = Vec::new();
        for placed in rasters {
            let home = mosaics.iter().position(|mosaic| mosaic.place_of(&placed).is_some());
            match home {
                Some(at) => mosaics[at].add(placed),
                None => mosaics.push(Mosaic::of(placed)),
            }
        }
        mosaics.sort_by_key(|mosaic| mosaic.rank);
        mosaics
    }

    fn of(placed: Placed) -> Mosaic {
        let step = placed.frame.column[0];
        let round = 360.0 / step.abs();
        let closes = placed.crs.is_geographic()
            && placed.frame.is_upright()
            && round < 1e9
            && (round - round.round()).abs() < 1e-2;
        let mut mosaic = Mosaic {
            crs: placed.crs.clone(),
            frame: placed.frame,
            period: closes.then_some(round.round() as i64),
            members: Vec::new(),
            extent: [i64::MAX, i64::MAX, i64::MIN, i64::MIN],
            rank: placed.rank,
            wild: AtomicBool::new(false),
        };
        mosaic.add(placed);
        mosaic
    }

    /// Column and row of the lattice at which a raster's first sample lies, if it fits.
    fn place_of(&self, placed: &Placed) -> Option<[i64; 2]> {
        if !self.crs.is_same_grid(&placed.crs) {
            return None;
        }
        let size = placed.size();
        for (ours, theirs, count) in [
            (self.frame.column, placed.frame.column, size[0]),
            (self.frame.row, placed.frame.row, size[1]),
        ] {
            let step = ours[0].abs() + ours[1].abs();
            let drift = (0..2).map(|axis| (ours[axis] - theirs[axis]).abs()).fold(0.0, f64::max);
            if drift * count as f64 > PHASE_SLACK * step {
                return None;
            }
        }
        let [mut u, v] = self.frame.invert(placed.frame.origin);
        if self.crs.is_geographic() && self.frame.is_upright() {
            // The same meridian, as near to the first member as it can be counted.
            let middle = (self.extent[0].min(0) + self.extent[2].max(0)) as f64 / 2.0;
            let round = self.period.map_or(360.0 / self.frame.column[0].abs(), |n| n as f64);
            let own_middle = u + size[0] as f64 / 2.0;
            u -= round * ((own_middle - middle) / round).round();
        }
        let near = |value: f64| (value - value.round()).abs() <= PHASE_SLACK && value.abs() < 1e15;
        (near(u) && near(v)).then(|| [u.round() as i64, v.round() as i64])
    }

    fn add(&mut self, placed: Placed) {
        let first = self.members.is_empty();
        let place = if first { Some([0, 0]) } else { self.place_of(&placed) };
        let Some([column, row]) = place else { return };
        let [width, height] = placed.size().map(|n| n as i64);
        let [c0, r0, c1, r1] = self.extent;
        self.extent = [c0.min(column), r0.min(row), c1.max(column + width), r1.max(row + height)];
        self.rank = self.rank.max(placed.rank);
        self.members.push(Member { placed, column, row });
        self.members.sort_by_key(|member| std::cmp::Reverse(member.placed.rank));
    }

    /// Longitude of the middle, if the lattice is geographic.
    pub(crate) fn longitude_centre(&self) -> Option<f64> {
        self.crs.is_geographic().then(|| self.frame.at(self.middle())[0])
    }

    /// Column and row of the middle.
    pub(crate) fn middle(&self) -> [f64; 2] {
        [0, 1].map(|axis| (self.extent[axis] + self.extent[axis + 2] - 1) as f64 / 2.0)
    }

    /// Column and row of the middle of the first raster given.
    pub(crate) fn first_middle(&self) -> [f64; 2] {
        let first = self.members.iter().min_by_key(|member| member.placed.rank);
        first.map_or([0.0; 2], |member| {
            let [width, height] = member.placed.size().map(|n| (n as f64 - 1.0) / 2.0);
            [member.column as f64 + width, member.row as f64 + height]
        })
    }

    /// The rasters, topmost first.
    pub(crate) fn rasters(&self) -> impl Iterator<Item = &Placed> {
        self.members.iter().map(|member| &member.placed)
    }

    /// Whether heights that cannot be terrain were met and taken as void.
    pub(crate) fn met_wild_heights(&self) -> bool {
        self.wild.load(Ordering::Relaxed)
    }

    /// Whether the lattice goes around the whole Earth, its data too.
    pub(crate) fn is_ring(&self) -> bool {
        self.period.is_some_and(|period| self.extent[2] - self.extent[0] >= period)
    }

    /// Heights of a window of the lattice, row by row; NaN where there are none.
    ///
    /// # Errors
    /// If an input is damaged.
    pub(crate) fn heights(&self, window: LatticeWindow) -> Result<Vec<f32>, RasterError> {
        let mut into = vec![f32::NAN; window.len()];
        let mut part = Vec::new();
        self.each_part(window, |member, part_window, at| {
            let wanted = part_window.width * part_window.height;
            part.clear();
            part.resize(wanted, f32::NAN);
            member.placed.raster.read_heights(part_window, &mut part)?;
            for (row, line) in part.chunks_exact(part_window.width).enumerate() {
                let start = (at[1] + row) * window.width + at[0];
                for (post, &height) in into[start..start + line.len()].iter_mut().zip(line) {
                    if !post.is_nan() || height.is_nan() {
                        continue;
                    }
                    if height.abs() <= MAX_HEIGHT_M {
                        *post = height;
                    } else {
                        self.wild.store(true, Ordering::Relaxed);
                    }
                }
            }
            Ok(())
        })?;
        Ok(into)
    }

    /// Colours of a window of the lattice, the upper laid over the lower ones.
    ///
    /// # Errors
    /// If an input is damaged.
    pub(crate) fn colors(&self, window: LatticeWindow) -> Result<Vec<[u8; 4]>, RasterError> {
        let mut into = vec![[0; 4]; window.len()];
        let mut part = Vec::new();
        self.each_part(window, |member, part_window, at| {
            part.clear();
            part.resize(part_window.width * part_window.height, [0; 4]);
            member.placed.raster.read_colors(part_window, &mut part)?;
            for (row, line) in part.chunks_exact(part_window.width).enumerate() {
                let start = (at[1] + row) * window.width + at[0];
                for (texel, &below) in into[start..start + line.len()].iter_mut().zip(line) {
                    *texel = crate::color::over(*texel, below);
                }
            }
            Ok(())
        })?;
        Ok(into)
    }

    /// Calls with each member that meets a window, topmost first: the member, the part
    /// of its samples, and where that part lies in the window.
    fn each_part(
        &self,
        window: LatticeWindow,
        mut visit: impl FnMut(&Member, Window, [usize; 2]) -> Result<(), RasterError>,
    ) -> Result<(), RasterError> {
        for member in &self.members {
            let [width, height] = member.placed.size().map(|n| n as i64);
            let rows = cut(window.row, window.height, member.row, height);
            let Some((row, row_at, row_count)) = rows else { continue };
            let shifts = self.shifts(window, member.column, width);
            for shift in shifts {
                let columns = cut(window.column, window.width, member.column + shift, width);
                let Some((column, column_at, column_count)) = columns else { continue };
                let part = Window {
                    column: column as u64,
                    row: row as u64,
                    width: column_count,
                    height: row_count,
                };
                visit(member, part, [column_at, row_at])?;
            }
        }
        Ok(())
    }

    /// By how many columns a member has to be moved, whole circles, to meet a window.
    fn shifts(&self, window: LatticeWindow, column: i64, width: i64) -> Vec<i64> {
        let Some(period) = self.period else { return vec![0] };
        let first = (window.column - column - width).div_euclid(period);
        let last = (window.column + window.width as i64 - column).div_euclid(period);
        (first..=last).map(|turn| turn * period).collect()
    }
}

/// A rectangle of lattice samples; it may reach beyond all members.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LatticeWindow {
    pub(crate) column: i64,
    pub(crate) row: i64,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl LatticeWindow {
    pub(crate) fn len(&self) -> usize {
        self.width * self.height
    }
}

/// Where a window of `count` from `start` meets a run of `length` from `origin`: first
/// sample of the run, its place in the window, and how many.
fn cut(start: i64, count: usize, origin: i64, length: i64) -> Option<(i64, usize, usize)> {
    let first = start.max(origin);
    let end = (start + count as i64).min(origin + length);
    (first < end).then(|| (first - origin, (first - start) as usize, (end - first) as usize))
}
