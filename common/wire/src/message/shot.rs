//! Messages between a client and the coordinator: shots and their frames.
//!
//! A client sends [`Submit`] under a number of its own choice, then its [`Cameras`],
//! then hears [`Accepted`] or [`Rejected`]. It supplies the shot's terrain when asked
//! and answers every [`Frame`] by a [`FrameTaken`], which lets the next one be sent.

use super::work::Timesheet;
use super::{Body, Unfit, fit_name, fit_reason, own_twin};
use crate::limits::{CAMERAS_MAX, FRAMES_IN_FLIGHT_MAX, FRAMES_MAX, WORKER_SHARES_MAX};
use crate::message::work::RenderReport;
use crate::pixels::Pixels;
use crate::twin::{
    CameraTwin, QualityTwin, ShadingTwin, ShareTwin, SplitTwin, SummaryTwin, fit_camera,
    fit_quality, fit_shading, fit_size, fit_split,
};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use terrafarm_common::accuracy::{Share, Summary};
use terrafarm_common::camera::Camera;
use terrafarm_common::id::{BlobHash, FrameIndex, ShotId};
use terrafarm_common::quality::Quality;
use terrafarm_common::region::Split;
use terrafarm_common::shading::Shading;

/// A new shot.
#[derive(Debug, Clone, PartialEq)]
pub struct Submit {
    /// The client's own number for it, new on this connection.
    pub number: u32,
    /// What to call it.
    pub name: String,
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
    /// How frames are cut into jobs.
    pub split: Split,
    /// Number of frames, at most [`FRAMES_MAX`].
    pub frames: u32,
    /// How many frames may be begun and not yet taken, at most [`FRAMES_IN_FLIGHT_MAX`].
    pub frames_in_flight: u32,
    /// Shots of a higher priority get every worker they can use; equals take turns.
    pub priority: i32,
    /// Whether somebody waits for each frame: then a worker that falls silent is noticed
    /// within half a second.
    pub live: bool,
}

/// Twin of [`Submit`].
#[derive(Serialize, Deserialize)]
pub(crate) struct SubmitTwin {
    number: u32,
    name: String,
    index: BlobHash,
    shading: ShadingTwin,
    quality: QualityTwin,
    check: ShareTwin,
    size: [u32; 2],
    split: SplitTwin,
    frames: u32,
    frames_in_flight: u32,
    priority: i32,
    live: bool,
}

impl Body for Submit {
    type Wire = SubmitTwin;

    fn to_wire(&self) -> SubmitTwin {
        SubmitTwin {
            number: self.number,
            name: self.name.clone(),
            index: self.index,
            shading: (&self.shading).into(),
            quality: self.quality.into(),
            check: self.check.into(),
            size: [self.width, self.height],
            split: self.split.into(),
            frames: self.frames,
            frames_in_flight: self.frames_in_flight,
            priority: self.priority,
            live: self.live,
        }
    }

    fn from_wire(wire: SubmitTwin) -> Result<Self, Unfit> {
        Ok(Submit {
            number: wire.number,
            name: wire.name,
            index: wire.index,
            shading: wire.shading.try_into()?,
            quality: wire.quality.try_into()?,
            check: wire.check.try_into()?,
            width: wire.size[0],
            height: wire.size[1],
            split: wire.split.try_into()?,
            frames: wire.frames,
            frames_in_flight: wire.frames_in_flight,
            priority: wire.priority,
            live: wire.live,
        })
    }

    fn check(&self) -> Result<(), Unfit> {
        fit_name(&self.name)?;
        fit_shading(&self.shading)?;
        fit_quality(self.quality)?;
        fit_size(self.width, self.height)?;
        fit_split(self.split)?;
        let frames = (1..=FRAMES_MAX).contains(&self.frames);
        Unfit::unless(frames, "the number of frames is out of range")?;
        let in_flight = (1..=FRAMES_IN_FLIGHT_MAX).contains(&self.frames_in_flight);
        Unfit::unless(in_flight, "the number of frames in flight is out of range")
    }
}

/// Cameras of a shot, in order, at most [`CAMERAS_MAX`] a message.
#[derive(Debug, Clone, PartialEq)]
pub struct Cameras {
    /// The client's number for the shot.
    pub number: u32,
    /// The frame of the first of them.
    pub first: FrameIndex,
    /// One a frame.
    pub cameras: Vec<Camera>,
}

/// Twin of [`Cameras`].
#[derive(Serialize, Deserialize)]
pub(crate) struct CamerasTwin {
    number: u32,
    first: FrameIndex,
    cameras: Vec<CameraTwin>,
}

impl Body for Cameras {
    type Wire = CamerasTwin;

    fn to_wire(&self) -> CamerasTwin {
        let cameras = self.cameras.iter().map(CameraTwin::from).collect();
        CamerasTwin { number: self.number, first: self.first, cameras }
    }

    fn from_wire(wire: CamerasTwin) -> Result<Self, Unfit> {
        let cameras = wire.cameras.into_iter().map(Camera::try_from).collect::<Result<_, _>>()?;
        Ok(Cameras { number: wire.number, first: wire.first, cameras })
    }

    fn check(&self) -> Result<(), Unfit> {
        let fits = (1..=CAMERAS_MAX).contains(&self.cameras.len());
        Unfit::unless(fits, "the number of cameras is out of range")?;
        let end = u64::from(self.first) + self.cameras.len() as u64;
        Unfit::unless(end <= u64::from(FRAMES_MAX), "the cameras run past the last frame")?;
        self.cameras.iter().try_for_each(fit_camera)
    }
}

/// A frame has been stored; the next may come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameTaken {
    /// The shot.
    pub shot: ShotId,
    /// The frame.
    pub frame: FrameIndex,
}

impl Body for FrameTaken {
    own_twin!();
}

/// The shot is no longer wanted. Answered by a [`ShotFailed`] or, if it was done just
/// then, a [`ShotDone`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cancel {
    /// The shot.
    pub shot: ShotId,
}

impl Body for Cancel {
    own_twin!();
}

/// The shot is in the queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Accepted {
    /// The client's number for it.
    pub number: u32,
    /// The farm's.
    pub shot: ShotId,
}

impl Body for Accepted {
    own_twin!();
}

/// The shot was not taken.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rejected {
    /// The client's number for it.
    pub number: u32,
    /// Why, and what to do, for people.
    pub reason: String,
}

impl Body for Rejected {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        fit_reason(&self.reason)
    }
}

/// A finished frame. The pixels travel behind the message.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The shot.
    pub shot: ShotId,
    /// The frame.
    pub frame: FrameIndex,
    /// Number of jobs it was made of.
    pub jobs: u32,
    /// The sum over its jobs.
    pub report: RenderReport,
    /// From the first job's grant to the last one's pixels, microseconds.
    pub elapsed_us: u64,
    /// The errors of the pixels that were measured; `None` if none were to be.
    pub check: Option<Summary>,
    /// The pixels of the whole frame.
    pub pixels: Pixels,
}

/// Twin of [`Frame`].
#[derive(Serialize, Deserialize)]
pub(crate) struct FrameTwin {
    shot: ShotId,
    frame: FrameIndex,
    jobs: u32,
    report: RenderReport,
    elapsed_us: u64,
    check: Option<SummaryTwin>,
    pixels: Pixels,
}

impl Body for Frame {
    type Wire = FrameTwin;

    fn to_wire(&self) -> FrameTwin {
        FrameTwin {
            shot: self.shot,
            frame: self.frame,
            jobs: self.jobs,
            report: self.report,
            elapsed_us: self.elapsed_us,
            check: self.check.as_ref().map(SummaryTwin::from),
            pixels: self.pixels.clone(),
        }
    }

    fn from_wire(wire: FrameTwin) -> Result<Self, Unfit> {
        Ok(Frame {
            shot: wire.shot,
            frame: wire.frame,
            jobs: wire.jobs,
            report: wire.report,
            elapsed_us: wire.elapsed_us,
            check: wire.check.map(Summary::try_from).transpose()?,
            pixels: wire.pixels,
        })
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

/// A frame could not be made.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameFailed {
    /// The shot.
    pub shot: ShotId,
    /// The frame.
    pub frame: FrameIndex,
    /// Why, for people.
    pub reason: String,
}

impl Body for FrameFailed {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        fit_reason(&self.reason)
    }
}

/// How far a shot is. Sent now and then; the newest is true.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Progress {
    /// The shot.
    pub shot: ShotId,
    /// Frames finished.
    pub frames_done: u32,
    /// Frames that could not be made.
    pub frames_failed: u32,
    /// Jobs that run now.
    pub jobs_running: u32,
    /// Workers connected now.
    pub workers: u32,
}

impl Body for Progress {
    own_twin!();
}

/// What one worker did for a shot.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerShare {
    /// Its name; workers of the same name count as one.
    pub name: String,
    /// Jobs whose pixels were used.
    pub jobs: u64,
    /// Time it rendered for them, microseconds.
    pub cost_us: u64,
    /// When it was granted its first job, microseconds after the submission.
    pub first_us: u64,
    /// When its last result had come, microseconds after the submission.
    pub last_us: u64,
    /// Where its time went between the two, the ways of the first grant and of the last
    /// result left out.
    pub timesheet: Timesheet,
}

impl WorkerShare {
    /// Adds the sheet of a result that came so many microseconds after the submission: with
    /// those before it, no more than has passed since the first grant. From one result to the
    /// next it may well be more, for the one before may have been longer under way.
    pub fn count(&mut self, sheet: &Timesheet, came_us: u64) {
        let passed_us = came_us.saturating_sub(self.first_us);
        let uncounted_us = passed_us.saturating_sub(self.timesheet.total_us());
        self.timesheet.add(&sheet.within(uncounted_us));
        self.last_us = came_us;
    }
}

/// Every frame is made or has failed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ShotDone {
    /// The shot.
    pub shot: ShotId,
    /// Frames finished.
    pub frames_done: u32,
    /// Frames that could not be made.
    pub frames_failed: u32,
    /// Jobs whose pixels were used.
    pub jobs: u64,
    /// Leases granted again because a worker was lost, failed or slow.
    pub jobs_repeated: u64,
    /// Wall time from the submission to the last frame, microseconds.
    pub elapsed_us: u64,
    /// Sum over all jobs.
    pub report: RenderReport,
    /// Who rendered how much, at most [`WORKER_SHARES_MAX`] workers.
    pub workers: Vec<WorkerShare>,
}

impl Body for ShotDone {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        let fits = self.workers.len() <= WORKER_SHARES_MAX;
        Unfit::unless(fits, "too many workers in one message")?;
        self.workers.iter().try_for_each(|share| fit_name(&share.name))
    }
}

/// The shot has been given up; no more frames come.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ShotFailed {
    /// The shot.
    pub shot: ShotId,
    /// Why, for people.
    pub reason: String,
}

impl Body for ShotFailed {
    own_twin!();

    fn check(&self) -> Result<(), Unfit> {
        fit_reason(&self.reason)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn share(first_us: u64) -> WorkerShare {
        WorkerShare {
            name: "attic".into(),
            jobs: 0,
            cost_us: 0,
            first_us,
            last_us: first_us,
            timesheet: Timesheet::default(),
        }
    }

    fn rendered(render_us: u64) -> Timesheet {
        Timesheet { render_us, ..Timesheet::default() }
    }

    #[test]
    fn results_that_are_held_up_under_way_lose_none_of_a_workers_time() {
        let mut share = share(100);
        // Jobs of 50; the first result is 30 under way, the second comes at once.
        share.count(&rendered(50), 180);
        share.count(&rendered(50), 200);
        assert_eq!((share.timesheet.render_us, share.last_us), (100, 200));
    }

    #[test]
    fn time_before_the_first_grant_is_not_counted() {
        let mut share = share(100);
        share.count(&Timesheet { redo_us: 500, ..rendered(50) }, 160);
        assert_eq!(share.timesheet, Timesheet { redo_us: 10, ..rendered(50) });
        share.count(&rendered(40), 200);
        assert_eq!(share.timesheet.total_us(), 100);
    }
}
