//! What will be seen soon: which views to look at for tiles, in the order of their turn.

use std::collections::BTreeMap;
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{FrameIndex, ShotId};
use terrafarm_common::region::Region;
use terrafarm_wire::message::{Ahead, Grant};

/// A view whose tiles are to be named, if they are not in memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Glance {
    /// The shot; its store is in memory.
    pub shot: ShotId,
    /// The frame from which on they are needed.
    pub due: FrameIndex,
    /// Where from.
    pub camera: Camera,
    /// Which part of the picture.
    pub region: Region,
}

/// Views to come.
#[derive(Debug, Default)]
pub(super) struct Outlook {
    courses: BTreeMap<ShotId, Course>,
    /// One is being looked at.
    glancing: bool,
}

/// Where the camera of a shot will be.
#[derive(Debug)]
struct Course {
    ahead: Ahead,
    /// Cameras that have been looked at.
    seen: usize,
}

impl Outlook {
    /// The coordinator says where a shot goes. What was looked at already, is not again.
    pub fn hear(&mut self, ahead: Ahead) {
        let covered = self.courses.get(&ahead.shot).and_then(Course::covered_until);
        let mut course = Course { ahead, seen: 0 };
        while covered.is_some_and(|until| course.next_frame().is_some_and(|next| next < until)) {
            course.seen += 1;
        }
        self.courses.insert(course.ahead.shot, course);
    }

    pub fn close(&mut self, shot: ShotId) {
        self.courses.remove(&shot);
    }

    /// A glance has been answered.
    pub fn answered(&mut self) {
        self.glancing = false;
    }

    /// What to look at next, if nothing is being looked at: first the grants that wait, in
    /// their order, unless a camera next to theirs has been; then the way ahead. A grant is
    /// given together with whether it has been looked at, and is marked. Only shots that
    /// are `ready` are looked at.
    pub fn next<'a>(
        &mut self,
        grants: impl Iterator<Item = (&'a Grant, &'a mut bool)>,
        ready: impl Fn(ShotId) -> bool,
    ) -> Option<Glance> {
        if self.glancing {
            return None;
        }
        for (grant, seen) in grants {
            if *seen || !ready(grant.shot) {
                continue;
            }
            *seen = true;
            let course = self.courses.get(&grant.shot);
            if course.is_some_and(|course| course.covers(grant.frame)) {
                continue;
            }
            self.glancing = true;
            let Grant { shot, frame: due, region, camera, .. } = *grant;
            return Some(Glance { shot, due, camera, region });
        }
        let mut ways = self.courses.iter_mut();
        let (&shot, course) =
            ways.find(|(shot, course)| ready(**shot) && course.next_frame().is_some())?;
        let frame = course.next_frame()?;
        let camera = course.ahead.cameras[course.seen];
        course.seen += 1;
        self.glancing = true;
        // The frames before it see most of the same ground.
        let due = frame.saturating_sub(course.ahead.stride);
        Some(Glance { shot, due, camera, region: Region::whole(camera.width, camera.height) })
    }
}

impl Course {
    fn frame(&self, number: usize) -> FrameIndex {
        self.ahead.first.saturating_add(self.ahead.stride.saturating_mul(number as u32))
    }

    /// The frame of the camera that is to be looked at next.
    fn next_frame(&self) -> Option<FrameIndex> {
        (self.seen < self.ahead.cameras.len()).then(|| self.frame(self.seen))
    }

    /// The frame after the last one next to a camera that has been looked at.
    fn covered_until(&self) -> Option<FrameIndex> {
        (self.seen > 0).then(|| self.frame(self.seen))
    }

    fn covers(&self, frame: FrameIndex) -> bool {
        self.ahead.first <= frame && self.covered_until().is_some_and(|until| frame < until)
    }
}
