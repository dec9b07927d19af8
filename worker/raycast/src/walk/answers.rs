//! What rays find that meet the ground.

use super::profile::first_behind;
use super::soils::Soils;
use super::{NOWHERE, Places, Walk};
use crate::column::{TOLD, WHOLE};
use crate::lanes::{Floats, Ints, Lanes, Mask};

impl<L: Lanes> Walk<'_, '_, L> {
    /// Answers the rays that meet their stretches: the next one of each lane, and those
    /// behind it that do, too.
    #[inline(always)]
    pub(super) fn answer(&mut self, soil: &Soils, met: &mut [f32]) {
        let mut ready = self.ready;
        self.ready = L::M::none();
        self.steps.passed = L::I::select(ready, L::I::splat(0), self.steps.passed);
        let below = ready & self.stretch.is_below(self.ray);
        if below.any() {
            let above = self.stretch.above();
            let wall = self.stretch.wall(&self.rows);
            self.find(soil, met, wall, below);
            self.ray = L::F::select(below, above, self.ray);
            ready = ready & self.stretch.is_met(self.ray) & self.ray.le(self.rows.last());
        }
        let plane = self.stretch.plane();
        self.find(soil, met, plane, ready);
        let mut next = self.stretch.next();
        let mut done = L::M::none();
        // Coarse cells may reach beyond the layer, where there is nothing to meet.
        let beyond = ready & self.beyond;
        if beyond.any() {
            let out = first_behind::<L>(&self.rows, plane, self.lines.leave).max(self.ray);
            done = beyond & out.lt(next);
            next = L::F::select(done, out, next);
        }
        self.ray = L::F::select(ready, next, self.ray);
        done = done | self.rows.last().lt(self.ray);
        if done.any() {
            self.plot = L::I::select(done, L::I::splat(NOWHERE), self.plot);
            self.split = self.split & !done;
        }
    }

    /// Answers for the next ray of lanes and those that see the same plane.
    #[inline(always)]
    fn find(&self, soil: &Soils, met: &mut [f32], [start, change]: [L::F; 2], lanes: L::M) {
        let start = L::F::select(self.unsure, L::F::splat(f32::NAN), start);
        if self.fineness.apart == 0.0 {
            return self.put(met, [start, change], lanes);
        }
        let marks = soil.marks::<L>(self.stretch.least());
        let bits = change.to_bits() & L::I::splat(!(WHOLE | TOLD));
        self.put(met, [start, L::F::from_bits(bits + marks)], lanes);
    }

    #[inline(always)]
    pub(super) fn put(&self, met: &mut [f32], [start, change]: [L::F; 2], lanes: L::M) {
        let Places { at, pitch, behind } = self.places;
        let rays = self.ray.truncate() - L::I::splat(self.rows.first);
        let at = at + rays.times(L::I::splat(pitch));
        start.scatter(met, at, lanes);
        if let Some(behind) = behind {
            change.scatter(met, at + L::I::splat(behind), lanes);
        }
    }
}
