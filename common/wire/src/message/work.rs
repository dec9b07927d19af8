//! Messages between the coordinator and a worker: jobs and their results.

use super::{Body, Unfit, fit_reason, own_twin};
use crate::limits::{AHEAD_CAMERAS_MAX, FRAMES_MAX, HAND_BACK_MAX};
use crate::pixels::Pixels;
use crate::twin::{
    CameraTwin, QualityTwin, RegionTwin, ShadingTwin, ShareTwin, SummaryTwin, fit_camera,
    fit_quality, fit_region, fit_shading, fit_size,
};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use terrafarm_common::accuracy::{Share, Summary};
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, FrameIndex, LeaseId, ShotId};
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Region;
use terrafarm_common::shading::Shading;

/// What all grants of a shot have in common. Sent once, before the first of them.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenShot {
    /// The shot.
    pub shot: ShotId,
    /// The index of its terrain store.
    pub index: BlobHash,
    /// Light, air and sky.
    pub shading: Shading,
    /// Method, tolerance and samples.
    pub quality: Quality,
    /// What share of the pixels is to be measured.
    pub check: Share,
    /// Width of its frames, pixels.
    pub width: u32,
    /// Height of its frames, pixels.
    pub height: u32,
    /// Somebody waits for its frames: terrain that is not on the worker's PC is not waited
    /// for, but shown coarser.
    pub live: bool,
}

/// Twin of [`OpenShot`].
#[derive(Serialize, Deserialize)]
pub(crate) struct OpenShotTwin {
    shot: ShotId,
    index: BlobHash,
    shading: ShadingTwin,
    quality: QualityTwin,
    check: ShareTwin,
    size: [u32; 2],
    live: bool,
}

impl Body for OpenShot {
    type Wire = OpenShotTwin;

    fn to_wire(&self) -> OpenShotTwin {
        OpenShotTwin {
            shot: self.shot,
            index: self.index,
            shading: (&self.shading).into(),
            quality: self.quality.into(),
            check: self.check.into(),
            size: [self.width, self.height],
            live: self.live,
        }
    }

    fn from_wire(wire: OpenShotTwin) -> Result<Self, Unfit> {
        Ok(OpenShot {
            shot: wire.shot,
            index: wire.index,
            shading: wire.shading.try_into()?,
            quality: wire.quality.try_into()?,
            check: wire.check.try_into()?,
            width: wire.size[0],
            height: wire.size[1],
            live: wire.live,
        })
    }

    fn check(&self) -> Result<(), Unfit> {
        fit_shading(&self.shading)?;
        fit_quality(self.quality)?;
        fit_size(self.width, self.height)
    }
}

/// One job: a region of one frame, to be answered under its lease by a [`Done`], a
/// [`Failed`] or a [`HandBack`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grant {
    /// The lease. The number is never granted again.
    pub lease: LeaseId,
    /// The shot, opened before.
    pub shot: ShotId,
    /// The frame.
    pub frame: FrameIndex,
    /// Which pixels of it.
    pub region: Region,
    /// Where it is seen from.
    pub camera: Camera,
}

/// Twin of [`Grant`].
#[derive(Serialize, Deserialize)]
pub(crate) struct GrantTwin {
    lease: LeaseId,
    shot: ShotId,
    frame: FrameIndex,
    region: RegionTwin,
    camera: CameraTwin,
}

impl Body for Grant {
    type Wire = GrantTwin;

    fn to_wire(&self) -> GrantTwin {
        GrantTwin {
            lease: self.lease,
            shot: self.shot,
            frame: self.frame,
            region: self.region.into(),
            camera: (&self.camera).into(),
        }
    }

    fn from_wire(wire: GrantTwin) -> Result<Self, Unfit> {
        Ok(Grant {
            lease: wire.lease,
            shot: wire.shot,
            frame: wire.frame,
            region: wire.region.try_into()?,
            camera: wire.camera.try_into()?,
        })
    }

    fn check(&self) -> Result<(), Unfit> {
        fit_camera(&self.camera)?;
        fit_region(&self.region, self.camera.width, self.camera.height)
    }
}

/// Where the cameras of a shot will be: a worker may fetch their terrain before it is
/// granted a job of theirs. It replaces what was said before of the same shot, and promises
/// nothing.
#[derive(Debug, Clone, PartialEq)]
pub struct Ahead {
    /// The shot, opened before.
    pub shot: ShotId,
    /// Frame of the first camera.
    pub first: FrameIndex,
    /// Frames from one camera to the next, at least 1.
    pub stride: u32,
    /// At least one, at most [`AHEAD_CAMERAS_MAX`].
    pub cameras: Vec<Camera>,
}

/// Twin of [`Ahead`].
#[derive(Serialize, Deserialize)]
pub(crate) struct AheadTwin {
    shot: ShotId,
    first: FrameIndex,
    stride: u32,
    cameras: Vec<CameraTwin>,
}

impl Body for Ahead {
    type Wire = AheadTwin;

    fn to_wire(&self) -> AheadTwin {
        AheadTwin {
            shot: self.shot,
            first: self.first,
            stride: self.stride,
            cameras: self.cameras.iter().map(CameraTwin::from).collect(),
        }
    }

    fn from_wire(wire: AheadTwin) -> Result<Self, Unfit> {
        let cameras: Result<Vec<_>, _> = wire.cameras.into_iter().map(Camera::try_from).collect();
        Ok(Ahead { shot: wire.shot, first: wire.first, stride: wire.stride, cameras: cameras? })
    }

    fn check(&self) -> Result<(), Unfit> {
        let fits = (1..=AHEAD_CAMERAS_MAX).contains(&self.cameras.len());
        Unfit::unless(fits, "the number of cameras ahead is out of range")?;
        let last = u64::from(self.first)
            + u64::from(self.stride).saturating_mul(self.cameras.len() as u64 - 1);
        let fits = self.stride > 0 && last < u64::from(FRAMES_MAX);
        Unfit::unless(fits, "the frames ahead are out of range")?;
        self.cameras.iter().try_for_each(fit_camera)
    }
}

/// A lease ends early: stop, and send nothing under it any more. One that has just been
/// answered may cross this message; that is no error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Revoke {
    /// The lease.
    pub lease: LeaseId,
}

impl Body for Revoke {
    own_twin!();
}

/// No more grants of a shot: what was kept for it may go.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CloseShot {
    /// The shot.
    pub shot: ShotId,
}

impl Body for CloseShot {
    own_twin!();
}

/// Finish the job that runs, hand back the others, say goodbye.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Drain {}

impl Body for Drain {
    own_twin!();
}

/// What a job took.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct RenderReport {
    /// Time from the start of rendering to its end, microseconds, waiting for tiles
    /// left out.
    pub cost_us: u64,
    /// Rays cast.
    pub rays: u64,
    /// Cells and blocks that they visited.
    pub steps: u64,
    /// Samples that the method could not do its own way and gave a ray of their own.
    pub fallbacks: u64,
    /// Pixels that show coarser terrain than was asked for, because it had not come: in live
    /// shots only.
    pub coarser: u64,
    /// Whether the camera was below the ground.
    pub below_ground: bool,
}

/// Where a worker's wall time went since its last result, or since it was told of the shot
/// if that came later, microseconds. The parts do not overlap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Timesheet {
    /// No job was in hand.
    pub idle_us: u64,
    /// A job waited for terrain to come.
    pub terrain_us: u64,
    /// A job waited for terrain to be read from disk, checked and unpacked.
    pub unpack_us: u64,
    /// Rendering on a core.
    pub render_us: u64,
    /// Rendering, but another program or worker had the core; 0 where the system does not
    /// tell, which then is part of `render_us`.
    pub coreless_us: u64,
    /// Packing pixels for the link.
    pub pack_us: u64,
    /// Pixels waited for the link to take them, and no job could begin.
    pub send_us: u64,
    /// Spent on jobs of which nothing was used: revoked, failed, or done twice.
    pub redo_us: u64,
    /// Between the others: handing over from thread to thread.
    pub other_us: u64,
}

impl Timesheet {
    /// All of it, microseconds.
    pub fn total_us(&self) -> u64 {
        let parts = [
            self.idle_us,
            self.terrain_us,
            self.unpack_us,
            self.render_us,
            self.coreless_us,
            self.pack_us,
            self.send_us,
            self.redo_us,
            self.other_us,
        ];
        parts.into_iter().fold(0, u64::saturating_add)
    }

    /// Adds another one.
    pub fn add(&mut self, more: &Timesheet) {
        let sum = |own: &mut u64, more: u64| *own = own.saturating_add(more);
        sum(&mut self.idle_us, more.idle_us);
        sum(&mut self.terrain_us, more.terrain_us);
        sum(&mut self.unpack_us, more.unpack_us);
        sum(&mut self.render_us, more.render_us);
        sum(&mut self.coreless_us, more.coreless_us);
        sum(&mut self.pack_us, more.pack_us);
        sum(&mut self.send_us, more.send_us);
        sum(&mut self.redo_us, more.redo_us);
        sum(&mut self.other_us, more.other_us);
    }

    /// What of it can have been within the last so many microseconds: what is more was before
    /// these. A worker that is told of a shot may still be busy with a job that was taken
    /// back, so that goes first.
    pub fn within(mut self, most_us: u64) -> Timesheet {
        let mut before = self.total_us().saturating_sub(most_us);
        let parts = [
            &mut self.redo_us,
            &mut self.idle_us,
            &mut self.other_us,
            &mut self.send_us,
            &mut self.terrain_us,
            &mut self.unpack_us,
            &mut self.pack_us,
            &mut self.coreless_us,
            &mut self.render_us,
        ];
        for part in parts {
            let less = before.min(*part);
            *part -= less;
            before -= less;
        }
        self
    }

    /// The same time for a result that was refused: rendering and packing were for nothing.
    pub fn wasted(self) -> Timesheet {
        let lost = [self.render_us, self.coreless_us, self.pack_us];
        let redo_us = lost.into_iter().fold(self.redo_us, u64::saturating_add);
        Timesheet { render_us: 0, coreless_us: 0, pack_us: 0, redo_us, ..self }
    }
}

/// The pixels of a job. They travel behind the message.
#[derive(Debug, Clone, PartialEq)]
pub struct Done {
    /// The lease.
    pub lease: LeaseId,
    /// What it took.
    pub report: RenderReport,
    /// Where the worker's time went.
    pub timesheet: Timesheet,
    /// The errors of the pixels that were measured; `None` if none were to be.
    pub check: Option<Summary>,
    /// The pixels of the region.
    pub pixels: Pixels,
}

/// Twin of [`Done`].
#[derive(Serialize, Deserialize)]
pub(crate) struct DoneTwin {
    lease: LeaseId,
    report: RenderReport,
    timesheet: Timesheet,
    check: Option<SummaryTwin>,
    pixels: Pixels,
}

impl Body for Done {
    type Wire = DoneTwin;

    fn to_wire(&self) -> DoneTwin {
        DoneTwin {
            lease: self.lease,
            report: self.report,
            timesheet: self.timesheet,
            check: self.check.as_ref().map(SummaryTwin::from),
            pixels: self.pixels.clone(),
        }
    }

    fn from_wire(wire: DoneTwin) -> Result<Self, Unfit> {
        let DoneTwin { lease, report, timesheet, check, pixels } = wire;
        let check = check.map(Summary::try_from).transpose()?;
        Ok(Done { lease, report, timesheet, check, pixels })
    }

    fn check(&self) -> Result<(), Unfit> {
        self.pixels.check()
    }

    fn payload(&self) -> Bytes {
        self.pixels.bytes.clone()
    }

    fn set_payload(&mut self, payload: Bytes) {
        self.pixels.bytes = payload;
    }
}

/// A job could not be done by this worker.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failed {
    /// The lease.
    pub lease: LeaseId,
    /// Why, for people.
    pub reason: String,
}

impl Body for Failed {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        fit_reason(&self.reason)
    }
}

/// How fast a worker renders a small scene that is the same on every PC: said once, after
/// the welcome. It guides the first jobs only; after them, their own times do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Speed {
    /// Pixels in a second on all threads, at least 1.
    pub pixels_per_s: u64,
}

impl Body for Speed {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        Unfit::unless(self.pixels_per_s > 0, "a worker that renders nothing")
    }
}

/// How a worker is off: said after the welcome, then when it has changed, at most once a
/// second. For people only; nothing is decided by it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// Decoded terrain in memory, bytes.
    pub memory_bytes: u64,
    /// The most it may take.
    pub memory_limit_bytes: u64,
    /// Terrain in the cache on disk, bytes; other workers may share it.
    pub disk_bytes: u64,
    /// The most it may take; 0 where nothing is kept on disk.
    pub disk_limit_bytes: u64,
    /// Blobs that came or lay damaged since the welcome.
    pub damaged: u64,
    /// Terrain given to other workers since the welcome, bytes.
    pub given_bytes: u64,
    /// Threads that may render now, at least 1: fewer than it has while it makes room.
    pub threads_allowed: u32,
}

impl Body for Status {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        Unfit::unless(self.threads_allowed > 0, "a worker without a thread")
    }
}

/// Jobs that were not begun and will not be.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct HandBack {
    /// The leases, at most [`HAND_BACK_MAX`].
    pub leases: Vec<LeaseId>,
}

impl Body for HandBack {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        Unfit::unless(self.leases.len() <= HAND_BACK_MAX, "too many leases in one message")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_more_than_has_passed_was_before_and_was_for_jobs_taken_back_first() {
        let sheet = Timesheet { idle_us: 10, render_us: 100, redo_us: 40, ..Timesheet::default() };
        assert_eq!(sheet.within(150), sheet);
        assert_eq!(sheet.within(120), Timesheet { redo_us: 10, ..sheet });
        let rendered = Timesheet { redo_us: 0, idle_us: 0, render_us: 70, ..sheet };
        assert_eq!(sheet.within(70), rendered);
        for most_us in 0..200 {
            assert_eq!(sheet.within(most_us).total_us(), most_us.min(150));
        }
    }
}
